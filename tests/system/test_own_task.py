"""A package of somebody else brings a task: it is learned, evaluated and drawn by the common commands."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torchrl", reason="needs the extra [rl]")
pytest.importorskip("tyro", reason="needs the extra [rl]")

ROOT = Path(__file__).resolve().parents[2]
MODULE = """
import numpy as np
from difflcs.rl.tasks import register_task
from tests.conformance.toy import Slide, make_task

class Drawn(Slide):
    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode=None, **options):
        super().__init__(**options)
        self.render_mode = render_mode

    def render(self):
        return np.full((64, 96, 3), 90, np.uint8)

def register():
    register_task(make_task("own", env=Drawn, describe=lambda env: {"length": 0.5}))
"""
PROGRAM = """
import json, sys
from difflcs.cli import main
for words in json.loads(sys.argv[1]):
    print(">>>", *words, flush=True)
    code = main(words)
    if code:
        sys.exit(code)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A module, and beside it the `.dist-info` with its entry point that `pip install` would leave there."""
    folder = tmp_path_factory.mktemp("site-packages")
    information = folder / "own_task-1.0.dist-info"
    information.mkdir()
    (folder / "own_task.py").write_text(MODULE)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: own-task\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[difflcs.tasks]\nown = own_task:register\n")
    return folder


@pytest.mark.parametrize("method", ["lcs-rl", "ppo-mlp"])  # a model, a network; all: tests/conformance/test_methods.py
def test_it_is_learned_evaluated_and_drawn(method, installed, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra [viz]")
    run = tmp_path / "run"
    commands = [
        ["train", "--task", "own", "--method", method, "--smoke", "--out", str(run)],
        ["evaluate", str(run), "--goals", "6", "--json"],
        ["render", str(run), "--out", str(tmp_path / "video.mp4"), "--goal", "0.12", "-0.1"],
    ]  # one after another in one process: starting Python takes longer than they do
    environment = {**os.environ, "PYTHONPATH": f"{installed}{os.pathsep}{ROOT}", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(commands)],
        capture_output=True, text=True, timeout=300, check=False, env=environment, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:] + done.stdout[-1000:]
    _, told, drawn = (part.partition("\n")[2] for part in done.stdout.split(">>> ")[1:])
    record = json.loads(told)
    assert (record["task"], record["method"], record["goals"], record["finished"]) == ("own", method, 6, True)
    assert 0 <= record["success_rate"] <= 1
    assert record["object"] == record["trained_on"] == {"length": 0.5}
    assert 0 <= record["median_errors"]["position_error"] < 1
    assert [line.partition(":")[0] for line in drawn.splitlines()[:2]] == ["goal 0.12", "goal -0.1"]
    assert (tmp_path / "video.mp4").stat().st_size > 1000
    assert len((run / "log.csv").read_text().splitlines()) > 2
    assert json.loads((run / "config.json").read_text())["config"]["task"] == "own"
