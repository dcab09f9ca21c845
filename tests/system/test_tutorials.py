"""Every notebook in `tutorials/` runs, is committed with its outputs, and keeps the form that readers know."""

import re
from pathlib import Path
from typing import Any

import pytest

from tests.system.forks import run_code

FOLDER = Path(__file__).parents[2] / "tutorials"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
BYTES = 1_000_000
# What a reader's machine does not have, and what must not be published.
PRIVATE = re.compile(r"/work\b|/tmp\b|/home/|/root\b|/Users/|site-packages|Traceback|Warning: |[A-Z]:\\\\")
# As long as no package index has the library, it comes from the checkout that the notebook lies in.
INSTALL = re.compile(
    r"# From a checkout .*\ntry:\n    import difflcs  # noqa: F401\nexcept ImportError:\n"
    r'    %pip install --quiet "\.\.\[([a-z,]+)\]"$'
)
# A kernel of Jupyter runs cells in such a shell; here it has no sockets. Figures are drawn after each cell.
SHELL = """
os.environ["SMOKE"] = "1"
from IPython.core.interactiveshell import InteractiveShell

shell = InteractiveShell.instance()
shell.enable_gui = lambda gui: None  # there is no window
shell.enable_matplotlib("inline")
"""


def read(path: Path) -> Any:
    import nbformat  # takes seconds; collecting the tests does without

    return nbformat.read(path, as_version=4)


def code(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def said(notebook: Any) -> str:
    """All text of the outputs."""
    parts = []
    for cell in code(notebook):
        for output in cell.outputs:
            data = output.get("data", {})
            parts += [output.get("text", ""), *(v for k, v in data.items() if k.startswith("text/"))]
    return "\n".join(parts)


def test_there_are_ten_in_order():
    assert [path.stem[:3] for path in NOTEBOOKS] == [f"{i:02d}_" for i in range(1, len(NOTEBOOKS) + 1)]
    assert len(NOTEBOOKS) >= 10


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs(path: Path, tmp_path: Path, monkeypatch):
    monkeypatch.delenv("VIRTUAL_ENV", raising=False)  # IPython warns where another one is active
    place = tmp_path / path.parent.name  # beside `examples`, as in a checkout
    place.mkdir()
    (tmp_path / "examples").symlink_to(FOLDER.parent / "examples")
    before = sorted(FOLDER.rglob("*"))
    cells = [cell.source for cell in code(read(path))]
    assert run_code([SHELL, f"for cell in {cells!r}:\n    shell.run_cell(cell).raise_error()"], place) == ""
    assert sorted(FOLDER.rglob("*")) == before


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_is_committed_with_its_outputs(path: Path):
    notebook = read(path)
    assert path.stat().st_size < BYTES
    assert [cell.execution_count for cell in code(notebook)] == list(range(1, len(code(notebook)) + 1))
    outputs = [output for cell in code(notebook) for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]
    # A GIF vanishes where the notebook becomes a page.
    assert not [output for output in outputs if "image/gif" in output.get("data", {})]
    found = PRIVATE.search(said(notebook)) or PRIVATE.search("\n".join(cell.source for cell in notebook.cells))
    assert found is None, found


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_has_the_form(path: Path):
    notebook = read(path)
    assert re.match(rf"# {int(path.stem[:2])} · \w", notebook.cells[0].source)
    assert INSTALL.match(code(notebook)[0].source)
    assert 'SMOKE = os.environ.get("SMOKE") == "1"' in code(notebook)[1].source
    *_, last_text, last_code = notebook.cells
    headings = re.findall(r"^## (.+)$", last_text.source, re.MULTILINE)
    assert headings[-1] == "Use it in your own project"
    assert last_code.cell_type == "code"
    assert re.match(r"import |from ", last_code.source), "the last cell can be copied as it is"
    assert notebook.metadata.kernelspec.name == "python3"
    assert all(re.fullmatch(r"[a-z][a-z0-9-]*", cell.id) for cell in notebook.cells), "stable ids, small diffs"
