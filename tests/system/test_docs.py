"""The documentation: its code runs, its commands exist, its numbers are those measured, no public name is missing."""

from __future__ import annotations

import ast
import contextlib
import importlib
import importlib.util
import io
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(p for p in DOCS.rglob("*.md") if "tutorials" not in p.relative_to(DOCS).parts)
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SKIP = re.compile(r"# doctest: skip \(.+\)")
MODULES = ("difflcs", "difflcs.mpc", "difflcs.mpc.backends", "difflcs.rl", "difflcs.systems", "difflcs_envs")


def blocks(page: Path, language: str) -> list[str]:
    return [code for kind, code in FENCE.findall(page.read_text()) if kind == language]


def name(page: Path) -> str:
    return str(page.relative_to(DOCS))


@pytest.fixture(scope="module")
def generated():
    spec = importlib.util.spec_from_file_location("docs_generated", DOCS / "generated.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_there_are_pages_with_code():
    assert {"quickstart.md", "own_system.md", "gradients.md", "backends.md"} <= {
        name(p) for p in PAGES if blocks(p, "python")
    }


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=name)
def test_the_python_of_a_page_runs(page, tmp_path):
    # In a process and a folder of its own: a page may register backends and environments, and read nothing of ours.
    pytest.importorskip("gymnasium")
    pytest.importorskip("torchrl")
    code = [code for code in blocks(page, "python") if not SKIP.match(code)]
    script = tmp_path / "page.py"
    script.write_text("import torch\n\ntorch.set_num_threads(1)\n" + "\n".join(code))
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=600, check=False, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr[-3000:]
    for line in done.stderr.splitlines():
        assert "difflcs" not in line, f"a warning that the page does not mention: {line}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_code_fits_the_page(page):
    for language in ("python", "bash", "console"):
        for code in blocks(page, language):
            assert [line for line in code.splitlines() if len(line) > 90] == []


def test_blocks_are_rarely_skipped():
    skipped = [code for page in PAGES for code in blocks(page, "python") if SKIP.match(code)]
    assert len(skipped) <= 2


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_the_commands_of_a_page_exist(page):
    tyro = pytest.importorskip("tyro")
    from difflcs import cli

    text = page.read_text()
    shell = [line for kind, code in FENCE.findall(text) if kind in ("bash", "console") for line in code.splitlines()]
    inline = [c for c in re.findall(r"`(difflcs [a-z][^`\n]*)`", text.replace("\n", " "))]
    lines = [re.sub(r"^\$ |\s+#.*$", "", line).strip() for line in [*shell, *inline]]
    for line in lines:
        words = shlex.split(line)
        if words[:1] != ["difflcs"]:
            continue
        arguments = [w for w in words[1:] if w != "…"]
        # Placeholders in running text: RUN, NAME, and a command named without its arguments.
        complete = line in [re.sub(r"^\$ |\s+#.*$", "", s).strip() for s in shell]
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as error:
                tyro.extras.subcommand_cli_from_dict(
                    cli._COMMANDS,
                    args=arguments,
                    config=(tyro.conf.PositionalRequiredArgs, tyro.conf.FlagCreatePairsOff),
                )
        except SystemExit:
            said = " ".join(error.getvalue().split())
            assert not complete, f"{line}: {said}"
            assert "nrecognized" not in said, f"{line}: {said}"
            assert "invalid choice" not in said, f"{line}: {said}"


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


def test_pages_named_by_errors_exist():
    errors = importlib.import_module("difflcs.errors")
    pages = {getattr(value, "page", None) for value in vars(errors).values()} - {None}
    for page in pages:
        assert (ROOT / page).exists(), page


def test_every_setting_is_explained(generated):
    from dataclasses import fields

    from difflcs.rl import TrainConfig

    text = generated.fill((DOCS / "settings.md").read_text())
    for field in fields(TrainConfig):
        flag = f"--{field.name}".replace("_", "-")
        assert f"`{flag}`" in text or f"`{flag}." in text or f"## Group {field.name}" in text
    assert "`--warmup.noise`" in text


def test_the_command_line_page_has_every_command(generated):
    from difflcs import cli

    text = generated.fill((DOCS / "command_line.md").read_text())
    for command in cli._COMMANDS:
        assert f"## difflcs {command}\n" in text
    assert "--warmup.noise" in text
    assert "\x1b" not in text


def test_the_figures_of_the_backends_are_those_measured():
    text = (DOCS / "backends.md").read_text()
    speed = json.loads((ROOT / "benchmarks" / "results" / "mpc.json").read_text())["results"]
    for size in ("n_lam 5", "n_lam 8"):
        for what in ("cold", "gradient", "warm"):
            assert f"{speed[f'{size} {what} ratio']:.0f}×" in text
        assert f"{speed[size]['ipopt warm'] / speed[size]['warm']:.0f}×" in text
        assert f"{1e6 * speed[size]['cold']:.0f} µs" in text
    optima = json.loads((ROOT / "benchmarks" / "results" / "optima.json").read_text())["results"]
    for kind, found in optima.items():
        row = re.search(rf"^\| {kind} \((\d+)\) \|(.*)$", text, re.MULTILINE)
        assert row, kind
        assert int(row[1]) == found["problems"]
        cells = re.findall(r"\((\d+) %\)", row[2])
        names = ("ipopt", "ipopt, start 1", "batched", "batched, 4 starts", "batched, 16 starts")
        assert cells == [f"{100 * found[n]['within 0.1 % of best']:.0f}" for n in names], kind


def test_links_of_included_files_work_in_the_site(generated, tmp_path, monkeypatch):
    (tmp_path / "docs").mkdir()
    (tmp_path / "part").mkdir()
    (tmp_path / "docs" / "page.md").write_text("# Page\n")
    (tmp_path / "part" / "README.md").write_text(
        "# Title\n\n[page](../docs/page.md#there) [file](run.py) [web](https://example.org) ![curve](curve.png)\n"
        "`[no](link.md)` [`part/run.py`](run.py)\n"
    )
    monkeypatch.setattr(generated, "ROOT", tmp_path)
    monkeypatch.setattr(generated, "DOCS", tmp_path / "docs")
    text = generated.repository_file("part/README.md")
    assert "# Title" not in text
    assert "[page](page.md#there)" in text
    assert "file (`part/run.py`)" in text
    assert "[web](https://example.org)" in text
    assert "![curve](../part/curve.png)" in text
    assert "`[no](link.md)`" in text
    assert text.rstrip().endswith(" `part/run.py`")
    assert "not part of this copy" in generated.repository_file("part/none.md")


def test_docstrings_become_restructuredtext(generated):
    lines = [
        "Loss of",
        "",
        "    ½‖r‖² + |e|",
        "",
        "for `MPCProblem`s with |x| > 0.",
        "",
        "| a | b |",
        "|---|---|",
        "| 1 | |",
    ]
    generated.mend_docstring(None, "class", "name", None, None, lines)
    text = "\n".join(lines)
    assert "::\n\n    ½‖r‖² + |e|" in text
    assert r"`MPCProblem`\ s with \|x\| > 0." in text
    assert ".. list-table::" in text
    assert "* - a" in text


def test_the_site_builds(tmp_path):
    pytest.importorskip("sphinx")
    pytest.importorskip("myst_nb")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-E", "-b", "html"]
    done = subprocess.run(
        [*command, "-d", tmp_path / "trees", DOCS, tmp_path / "site"],
        capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
