"""Settings of the documentation: `make docs` builds it into build/docs."""

import logging
import os
import sys
import tomllib
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import difflcs

logging.getLogger("OpenGL").setLevel(logging.WARNING)

project = "difflcs"
author = copyright = "The difflcs authors"
version = release = difflcs.__version__

extensions = [
    "myst_nb",  # Markdown and notebooks
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",  # cards
    "generated",  # generated.py in this folder
    "mathml",  # mathml.py in this folder
]
exclude_patterns = ["figures/*.py"]
default_role = "py:obj"  # `LCSModel` in a docstring becomes a link where it names something, and code where not
suppress_warnings = ["ref.python"]  # two packages have a MissingDependencyError each
smartquotes = False  # would turn --seed into –seed

myst_enable_extensions = ["amsmath", "attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # tutorials show the outputs that are committed

autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
toc_object_entries_show_parents = "hide"

# Links into the documentation of others need the network while the site is built: on Read the Docs, or where asked for.
intersphinx_mapping = {
    "python": ("https://docs.python.org/3", None),
    "torch": ("https://docs.pytorch.org/docs/stable", None),
    "numpy": ("https://numpy.org/doc/stable", None),
    "gymnasium": ("https://gymnasium.farama.org", None),
    "torchrl": ("https://docs.pytorch.org/rl/stable", None),
}
if not (os.environ.get("READTHEDOCS") or os.environ.get("DIFFLCS_DOCS_LINKS")):
    intersphinx_mapping = {}

# What one copies are the commands, without the prompt and what they print.
copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = True
copybutton_exclude = ".linenos, .gp, .go"

html_theme = "furo"
html_title = f"difflcs {difflcs.__version__}"
html_static_path = ["_static"]
html_css_files = ["difflcs.css"]
html_copy_source = html_show_sourcelink = False

# Where the project says that its repository is, every page has a link to its source there.
addresses = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]["urls"]
if "Repository" in addresses:
    html_theme_options = {
        "source_repository": addresses["Repository"],
        "source_branch": "main",
        "source_directory": "docs/",
    }
