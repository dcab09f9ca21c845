"""What surrounds the code: types as a strict user sees them, addresses, citation, versions, workflows, extras."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import difflcs

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
STRICT = Path(__file__).parent / "fixtures" / "strict_user" / "user.py"


def load(name: str):
    return yaml.safe_load((ROOT / name).read_text())


@pytest.mark.slow
def test_a_strict_user_sees_no_error_of_ours(tmp_path):
    """Pyright, strict, on a file that uses what is public, with the packages where pip would put them."""
    packages = tmp_path / "packages"
    packages.mkdir()
    for package in ("difflcs", "envs/difflcs_envs"):
        assert (ROOT / package / "py.typed").exists()
        (packages / Path(package).name).symlink_to(ROOT / package, target_is_directory=True)
    project = tmp_path / "project"
    project.mkdir()
    wrong = 'from difflcs import LCSModel\n\nLCSModel(n_x="four", n_u=2, n_lam=3)\n'
    (project / "user.py").write_text(STRICT.read_text())
    (project / "wrong.py").write_text(wrong)
    (project / "pyrightconfig.json").write_text(json.dumps({"typeCheckingMode": "strict", "pythonVersion": "3.11"}))
    done = subprocess.run(
        [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, "-p", project],
        capture_output=True, text=True, timeout=300, check=False, env={**os.environ, "PYTHONPATH": str(packages)},
    )  # fmt: skip
    report = json.loads(done.stdout)
    assert report["summary"]["filesAnalyzed"] == 2
    found = [(Path(d["file"]).name, d["message"]) for d in report["generalDiagnostics"]]
    assert [message for name, message in found if name == "user.py"] == []
    assert any("four" in message for name, message in found if name == "wrong.py"), "the types are not seen"


def test_the_strict_user_uses_every_public_name():
    text = STRICT.read_text()
    assert [name for name in difflcs.__all__ if not re.search(rf"\b{name}\b", text)] == []


def test_the_citation_names_the_version_and_the_addresses_of_the_project():
    citation = load("CITATION.cff")
    assert citation["version"] == difflcs.__version__
    assert citation["license"] == PROJECT["project"]["license"]
    (paper,) = citation["references"]
    urls = PROJECT["project"]["urls"]
    assert paper["url"] == urls["Paper"]
    identifiers = {item["value"] for item in paper["identifiers"]}
    assert urls["Homepage"] in identifiers
    assert f"arXiv:{urls['Paper'].rsplit('/', 1)[1]}" in identifiers


def test_the_changelog_begins_with_this_version():
    versions = re.findall(
        r"^## (\d+\.\d+\.\d+) - (\d{4}-\d\d-\d\d|unreleased)$", (ROOT / "CHANGELOG.md").read_text(), re.M
    )
    assert [version for version, _ in versions] == sorted({version for version, _ in versions}, reverse=True)
    assert all(date != "unreleased" for version, date in versions if version == difflcs.__version__)
    assert difflcs.__version__ in dict(versions)
    assert [date for _, date in versions[1:] if date == "unreleased"] == []


@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs cmake")
def test_microsofts_compiler_is_refused_in_a_sentence(tmp_path):
    # What CMake would have found out about the compiler, said in advance.
    found = ["-DCMAKE_CXX_COMPILER_ID_RUN=1", "-DCMAKE_CXX_COMPILER_ID=MSVC", "-DCMAKE_CXX_COMPILER_FORCED=1"]
    done = subprocess.run(
        ["cmake", "-S", ROOT, "-B", tmp_path, *found], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode != 0
    said = " ".join(done.stderr.split())
    assert "expected GCC or Clang, got MSVC" in said
    assert "Windows Subsystem for Linux" in said


@pytest.mark.parametrize("name", ["tests", "docs", "wheels"])
def test_a_workflow_calls_what_exists(name):
    workflow = load(f".github/workflows/{name}.yml")
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for job in workflow["jobs"].values():
        assert job["runs-on"]
        for step in job["steps"]:
            assert set(step) & {"run", "uses"}
            assert set(re.findall(r"\bmake ([a-z-]+)", step.get("run", ""))) <= targets
            if action := step.get("uses"):
                assert re.fullmatch(r"[\w-]+/[\w-]+@v\d[\d.]*", action)


def test_extras_that_are_installed_somewhere_exist():
    extras = set(PROJECT["project"]["optional-dependencies"])
    (install,) = load(".readthedocs.yaml")["python"]["install"]
    used = set(install["extra_requirements"])
    used |= {e for names in re.findall(r"EXTRAS := (.+)", (ROOT / "Makefile").read_text()) for e in names.split(",")}
    assert used <= extras
    assert {"rl", "envs", "viz", "all"} <= used
    for name in re.findall(r'\.\[([\w,]+)\]"', (ROOT / "docs" / "installing.md").read_text()):
        assert set(name.split(",")) <= extras


def test_what_puts_commits_in_order_has_the_pinned_version_of_ruff():
    (ruff,) = re.findall(r"^ruff==(.+)$", (ROOT / "constraints.txt").read_text(), re.M)
    hooks = {repo["repo"].rsplit("/", 1)[1]: repo["rev"] for repo in load(".pre-commit-config.yaml")["repos"]}
    assert hooks["ruff-pre-commit"] == f"v{ruff}"
