"""A package of somebody else brings a task: every method trains on it, is evaluated and drawn, by the common commands.

The package is installed for these tests into a folder of its own: its module, and beside it the `.dist-info` with entry
points that `pip install` would leave there. That is what `importlib.metadata` reads, and needs no network and no build.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

pytest.importorskip("torchrl", reason="needs the extra [rl]")
pytest.importorskip("tyro", reason="needs the extra [rl]")

from difflcs.rl.methods import method_names

PACKAGE = Path(__file__).parent / "fixtures" / "block_task"
PROGRAM = """
import json, sys
from difflcs.cli import main
for words in json.loads(sys.argv[1]):
    print(">>>", *words, flush=True)
    code = main(words)
    if code:
        sys.exit(code)
"""


def install(folder: Path) -> None:
    """What `pip install --target folder` does with a pure Python package, as far as Python looks."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    for module in PACKAGE.glob("*.py"):
        shutil.copy(module, folder)
    information = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    information.mkdir()
    about = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (information / "METADATA").write_text(about)
    groups = [
        "\n".join([f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())])
        for group, entries in project["entry-points"].items()
    ]
    (information / "entry_points.txt").write_text("\n\n".join(groups) + "\n")


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site-packages")
    install(folder)
    return folder


def python(*arguments, folder, cwd):
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=environment, cwd=cwd)


def difflcs(*commands, folder, cwd):
    """The commands one after another in one process (starting Python takes longer than they do); output of each."""
    done = python("-c", PROGRAM, json.dumps(commands), folder=folder, cwd=cwd)
    assert done.returncode == 0, done.stderr[-3000:] + done.stdout[-1000:]
    return [part.partition("\n")[2] for part in done.stdout.split(">>> ")[1:]]


# --- the task ---------------------------------------------------------------------------------------------------------


# --- the commands -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", method_names())
def test_every_method_learns_it(method, installed, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra [viz]")
    run = tmp_path / "run"
    _, told, drawn = difflcs(
        ["train", "--task", "block", "--method", method, "--smoke", "--out", str(run)],
        ["evaluate", str(run), "--goals", "6", "--json"],
        ["render", str(run), "--out", str(tmp_path / "video.mp4"), "--goal", "0.12", "-0.1"],
        folder=installed,
        cwd=tmp_path,
    )
    record = json.loads(told)
    assert (record["task"], record["method"], record["goals"], record["finished"]) == ("block", method, 6, True)
    assert 0 <= record["success_rate"] <= 1
    assert record["object"] == record["trained_on"] == {"reach": 0.05, "tolerance": 0.02}
    assert 0 <= record["median_errors"]["position_error"] < 1
    assert [line.partition(":")[0] for line in drawn.splitlines()[:2]] == ["goal 0.12", "goal -0.1"]
    assert (tmp_path / "video.mp4").stat().st_size > 1000
    rows = (run / "log.csv").read_text().splitlines()
    assert len(rows) > 2
    assert json.loads((run / "config.json").read_text())["config"]["task"] == "block"
