"""Every notebook in `tutorials/` runs, is committed with its outputs, and keeps the form that readers know."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    import nbformat

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
SECONDS = 300  # of one cell; a notebook takes about five on a free machine


def read(path: Path) -> nbformat.NotebookNode:
    import nbformat  # takes seconds; collecting the tests does without

    return nbformat.read(path, as_version=4)


def code(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def execute(path: Path, folder: Path) -> nbformat.NotebookNode:
    """Run a notebook in a folder, over sockets in that folder instead of TCP ports."""
    from jupyter_client import AsyncKernelManager
    from nbclient import NotebookClient

    notebook = read(path)
    place = folder / path.parent.name  # beside `examples`, as in a checkout
    place.mkdir()
    (folder / "examples").symlink_to(FOLDER.parent / "examples")
    manager = AsyncKernelManager(kernel_name="python3", transport="ipc", ip=str(folder / "kernel"))
    client = NotebookClient(
        notebook, km=manager, timeout=SECONDS, resources={"metadata": {"path": str(place)}}, record_timing=False
    )
    # A loop of our own, so that none is left open (filterwarnings = error sees it).
    asyncio.run(client.async_execute(cleanup_kc=True))
    return notebook


def said(notebook: nbformat.NotebookNode) -> str:
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
def test_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SMOKE", "1")
    before = sorted(FOLDER.rglob("*"))
    notebook = execute(path, tmp_path)
    assert [cell.execution_count for cell in code(notebook)] == list(range(1, len(code(notebook)) + 1))
    streams = [output for cell in code(notebook) for output in cell.outputs if output.output_type == "stream"]
    assert [output.text for output in streams if output.name == "stderr"] == []
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
