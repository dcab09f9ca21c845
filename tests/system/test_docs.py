"""The documentation: its code runs, its commands exist, its numbers are those measured, no public name is missing."""

import ast
import contextlib
import ctypes
import importlib
import importlib.util
import io
import itertools
import re
import shlex
import shutil
import subprocess
import textwrap
from pathlib import Path

import numpy as np
import objects
import pytest

from difflcs import cli, errors
from difflcs.cli import commands
from difflcs.cli.train import Train
from tests.system.forks import run_code

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(p for p in DOCS.rglob("*.md") if "tutorials" not in p.relative_to(DOCS).parts)
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CONTRIBUTING = DOCS / "contributing.md"
SKIP = re.compile(r"# doctest: skip \(.+\)")
MODULES = ("difflcs", "difflcs.mpc", "difflcs.mpc.backends", "difflcs.rl", "difflcs.systems", "difflcs_envs")


def blocks(page: Path, language: str) -> list[str]:
    return [code for kind, code in FENCE.findall(page.read_text()) if kind == language]


def name(page: Path) -> str:
    return str(page.relative_to(DOCS))


@pytest.fixture(scope="module")
def generated():
    spec = importlib.util.spec_from_file_location("docs_generated", DOCS / "generated.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_page(page: Path, code: list[str], folder: Path) -> None:
    """Run blocks of a page, which mentions all our kinds of warnings that come."""
    for said, kind in re.findall(r"^(.*?(\w+Warning): .*)", run_code(code, folder), re.MULTILINE):
        ours = hasattr(errors, kind) or "/difflcs/" in said
        assert not ours or kind in page.read_text(), f"a warning that the page does not mention: {said}"


SHORTER = {
    "fit.md": {"in (0, 2, 3, 5)": "in (0, 5)", "in range(3)]": "in range(1)]"},
    "own_system.md": {"minutes=2.0": "minutes=1.3"},
    "identify.md": {"in range(150)": "in range(100)"},
    "rl_stacks.md": {"n_trials=2": "n_trials=1", "in (0, 1))": "in (0,))"},
}
"""Page → what takes long there, and what is run instead."""


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python") and p != CONTRIBUTING], ids=name)
def test_the_python_of_a_page_runs(page, tmp_path):
    code = "\n".join(code for code in blocks(page, "python") if not SKIP.match(code))
    for long, short in SHORTER.get(name(page), {}).items():
        assert long in code
        code = code.replace(long, short)
    run_page(page, [code], tmp_path)


@pytest.mark.parametrize("what", ["backend", "task", "method"])
def test_what_is_added_by_a_page_works_by_itself(what, tmp_path):
    (section,) = re.findall(rf"^## Add a {what}\n(.*?)(?=^## )", CONTRIBUTING.read_text(), re.MULTILINE | re.DOTALL)
    (code,) = [code for kind, code in FENCE.findall(section) if kind == "python"]
    run_page(CONTRIBUTING, [code], tmp_path)


CALL_OF_THE_KERNEL = """
using namespace difflcs;
#define KERNEL(result, name, parameters) result(*entry) parameters = baseline::name;
{entry}
extern "C" void call(int64_t n, int64_t count, const double* F, const double* q, double* lam, double* residual) {{
  alignas(64) static char workspace[4096];
  const LcpBatch batch{{n, F, n * n, q, 0.0, 0, lam, nullptr, nullptr}};
  entry(batch, 0, count, residual, workspace);
}}
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")
def test_the_kernel_that_a_page_adds_is_one_of_the_list(tmp_path):
    (section,) = re.findall(r"^## Add a kernel\n(.*?)(?=^## )", CONTRIBUTING.read_text(), re.MULTILINE | re.DOTALL)
    kernel, entry = (textwrap.dedent(code) for code in re.findall(r"^ *```cpp\n(.*?)^ *```$", section, re.M | re.S))
    (tmp_path / "kernel.cpp").write_text(kernel + CALL_OF_THE_KERNEL.format(entry=entry))
    options = ["-std=c++17", "-fPIC", "-shared", "-Wno-psabi", "-I", ROOT / "difflcs" / "_native"]
    rng, count, n = np.random.default_rng(0), 5, 3
    F, q, lam = rng.standard_normal((count, n, n)), rng.standard_normal((count, n)), rng.random((count, n))
    w = np.einsum("bij,bj->bi", F, lam) + q
    for lanes in (1, 2):
        library, names = tmp_path / f"{lanes}.so", ["-DDIFFLCS_ISA=baseline", f"-DDIFFLCS_LANES={lanes}"]
        subprocess.run(["c++", *options, *names, tmp_path / "kernel.cpp", "-o", library], check=True)
        residual = np.empty(count)
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in (F, q, lam, residual)]
        ctypes.CDLL(str(library)).call(ctypes.c_int64(n), ctypes.c_int64(count), *pointers)
        np.testing.assert_allclose(residual, np.abs(np.minimum(lam, w)).max(1), rtol=1e-12)


def test_contributing_adds_nothing_else():
    assert len(blocks(CONTRIBUTING, "python")) == 3


def test_the_map_of_the_house_has_every_file_of_the_library():
    (house,) = blocks(CONTRIBUTING, "text")
    (library,) = re.findall(r"^difflcs/.*?(?=^\S)", house, re.MULTILINE | re.DOTALL)
    missing = [
        str(file.relative_to(ROOT))
        for file in (ROOT / "difflcs").rglob("*.py")
        if not file.name.startswith("_")
        and file.name not in library
        and file.parent.name not in ("backends", "methods", "optim")  # a file for each
    ]
    gone = [found for found in re.findall(r"\w+\.py", library) if not [*(ROOT / "difflcs").rglob(found)]]
    assert (missing, gone) == ([], [])


def test_code_fits_the_page():
    for page, language in itertools.product(PAGES, ("python", "bash", "console")):
        for code in blocks(page, language):
            assert [line for line in code.splitlines() if len(line) > 90] == [], page


@pytest.fixture
def parse(monkeypatch):
    """What the command line says against words after `difflcs`, and nothing that it would do."""
    for kind in vars(commands).values():
        if isinstance(kind, type) and callable(getattr(kind, "run", None)):
            monkeypatch.setattr(kind, "run", lambda command: 0)

    def parse(words: list[str]) -> str:
        said = io.StringIO()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
            try:
                code = cli.main(words)
            except SystemExit as end:
                code = end.code
        return " ".join(said.getvalue().split()) if code else ""

    return parse


def test_the_command_line_is_asked(parse):
    assert parse(["train", "--models.iterations", "0"]) == ""
    assert "nrecognized" in parse(["train", "--method", "violation", "--models.iterations", "0"])
    assert parse(["train"]) == ""


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_the_commands_of_a_page_exist(page, parse):
    text = page.read_text()
    fenced = [code.replace("\\\n", " ") for kind, code in FENCE.findall(text) if kind in ("bash", "console")]
    shell = [line for code in fenced for line in code.splitlines()]
    inline = re.findall(r"`(difflcs [a-z][^`\n]*)`", text.replace("\n", " "))
    whole, running = ([re.sub(r"^\$ |\s+#.*$", "", line).strip() for line in lines] for lines in (shell, inline))
    for line in [*whole, *running]:
        words = shlex.split(line)
        if words[:1] != ["difflcs"]:
            continue
        said = parse([w for w in words[1:] if w != "…"])
        if line in whole:
            assert said == "", line
        # In running text there are placeholders, RUN, NAME, and commands named without their arguments; and the lab
        # notebook names flags as they were called at its time.
        archived = page.parent.name == "archive"
        assert archived or not [words for words in ("nrecognized", "invalid choice") if words in said], (
            f"{line}: {said}"
        )


def test_the_quick_settings_are_those_that_were_measured(monkeypatch):
    asked = []
    monkeypatch.setattr(Train, "run", lambda command: asked.append(command))
    page = [code.replace("\\\n", " ") for code in blocks(DOCS / "training.md", "bash")]
    commands = [code for code in page if "--models.rollouts" in code and "--method" not in code]
    assert len(commands) == 1
    assert cli.main(shlex.split(commands[0])[1:]) == 0
    assert asked[0].method == objects.METHODS["quick"] != objects.METHODS["lcs-rl"]


def test_the_flags_of_pages_exist(generated):
    known = set(re.findall(r"`(--[a-z.-]+)`", generated.methods()))
    pattern = r"`(--(?:warmup|ppo|models|pddm|imagination|mlp)\.[a-z.-]+)(?!\*|[a-z.-])"
    for page in (p for p in PAGES if p.parent.name != "archive"):
        assert set(re.findall(pattern, page.read_text())) <= known, page


def test_every_public_name_is_in_the_reference(generated):
    reference = "\n".join(generated.fill(page.read_text()) for page in (DOCS / "api").glob("*.md"))
    missing = []
    for module in MODULES:
        if importlib.util.find_spec(module) is None:
            continue
        for public in importlib.import_module(module).__all__:
            if not re.search(rf"^\.\. auto\w+:: difflcs[\w.]*\.{public}$", reference, re.MULTILINE):
                missing.append(f"{module}.{public}")
    assert not missing


def test_every_error_is_in_the_reference(generated):
    reference = generated.fill((DOCS / "api" / "errors.md").read_text())
    tree = ast.parse((ROOT / "difflcs" / "errors.py").read_text())
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            assert re.search(rf":: difflcs[\w.]*\.{node.name}$", reference, re.MULTILINE), node.name


def test_the_generated_parts_of_pages_are_up_to_date(tmp_path):
    """In a process of its own, since tests register tasks and methods. Mend it by `python docs/generated.py`."""
    script = str(DOCS / "generated.py")
    said = f"import runpy, sys\nsys.argv, sys.stdout = [{script!r}, '--check'], sys.stderr"
    run_code([said, f"runpy.run_path({script!r}, run_name='__main__')"], tmp_path)


def test_a_page_that_is_out_of_date_is_found(generated):
    page = (DOCS / "settings.md").read_text()
    stale = page.replace("| `--seed` |", "| `--sead` |")
    assert page == generated.refresh(stale) != stale
