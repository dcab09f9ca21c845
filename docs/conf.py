"""Settings of the documentation: `make docs` builds it into build/docs."""

import logging
import sys
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
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "generated",  # generated.py in this folder
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

# Long formulas break into lines where the page is narrow.
mathjax4_config = {"output": {"displayOverflow": "linebreak", "linebreaks": {"inline": True}}}

html_theme = "furo"
html_title = f"difflcs {difflcs.__version__}"
html_static_path = ["_static"]
html_css_files = ["difflcs.css"]
html_copy_source = html_show_sourcelink = False
