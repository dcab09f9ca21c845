"""Trainings in processes that are killed, on disks that are full; the rest is in tests/conformance/test_methods.py."""

import errno
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from difflcs import _storage, cli

pytest.importorskip("mujoco")
pytest.importorskip("torchrl")


def run(capsys, *arguments) -> tuple[int, str, str]:
    code = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def learned(path: Path) -> list[tuple[str, bytes]]:
    """The final model and the last checkpoint, byte for byte."""
    last = max(path.glob("checkpoints/0*"))
    files = [path / "model/model.safetensors", last / "model.safetensors", last / "config.json"]
    return [(str(file.relative_to(path)), file.read_bytes()) for file in files]


def test_resume_after_kill_9(capsys, tmp_path):
    """Killed in the warm-up, resumed, killed in the main phase, resumed."""
    options = ["--method", "lcs-rl", "--minutes", "1.5", "--warmup-minutes", "0.4", "--ppo.rollouts", "7"]
    options += "--ppo.steps 2 --warmup.epochs.first 20 --models.rollouts 20 --models.iterations 2".split()
    options += ["--final-goals", "0", "--evaluate-at"]
    through, killed = tmp_path / "through", tmp_path / "killed"
    for resume, until in ((False, 1), (True, 4)):
        command = [sys.executable, "-m", "difflcs", "train", *options, "--out", str(killed)]
        process = subprocess.Popen(
            [*command, *["--resume"] * resume], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        deadline = time.monotonic() + 120
        while not (killed / f"checkpoints/{until:06d}").exists() and time.monotonic() < deadline:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not (killed / "model").exists()
    assert run(capsys, "train", "--out", killed, "--resume")[0] == 0
    assert run(capsys, "train", *options, "--out", through)[0] == 0
    assert learned(through) == learned(killed)


def test_a_folder_that_cannot_be_written_is_reported_first(capsys, tmp_path):
    (tmp_path / "file").touch()
    code, _, err = run(capsys, "train", "--smoke", "--out", tmp_path / "file/run")
    assert code == 2
    assert "another --out" in err


def test_a_full_disk_leaves_the_last_checkpoint(capsys, tmp_path, monkeypatch):
    whole, path = tmp_path / "whole", tmp_path / "run"
    assert run(capsys, "train", "--smoke", "--method", "ppo", "--out", whole)[0] == 0
    write, left = _storage.write_atomically, [5]  # config.json, then three files per checkpoint

    def full(*arguments):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(_storage, "write_atomically", full)
        code, _, err = run(capsys, "train", "--smoke", "--method", "ppo", "--out", path)
    assert code == 2
    assert "No space left" in err
    assert "--resume" in err
    assert json.loads((path / "checkpoints/latest.json").read_text()) == {"checkpoint": "000000"}
    assert run(capsys, "train", "--out", path, "--resume")[0] == 0
    assert learned(path) == learned(whole)
