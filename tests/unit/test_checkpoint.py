"""Checkpoints and run directories: what is written comes back, and nothing else is accepted."""

import json
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from difflcs import LCSModel, _storage
from difflcs.errors import CheckpointError, InUseError
from difflcs.rl.learning.state_tree import flatten
from difflcs.rl.runs.checkpoint import RunDirectory, load_checkpoint, save_checkpoint
from tests.conftest import contents, python, refuse


def make_model(seed: int) -> LCSModel:
    return LCSModel(2, 1, 1, generator=torch.Generator().manual_seed(seed), init_scale=0.1)


def make_state(iteration: int) -> dict[str, Any]:
    return {
        "random": {"noise": np.random.default_rng(iteration).bit_generator.state},
        "collected": 5 * iteration,
        "learned": dict(make_model(iteration).state_dict()),
        "episodes": {"state": torch.full((3, 2), float(iteration), dtype=torch.float64)},
    }


def save(root: Path, iteration: int, **options: int) -> None:
    save_checkpoint(root, iteration, make_state(iteration), **options)


def assert_equal(loaded: Mapping[str, Any], iteration: int) -> None:
    (tensors, rest), (own, other) = flatten(loaded), flatten(make_state(iteration))
    assert rest == other
    assert tensors.keys() == own.keys()
    assert all(torch.equal(tensors[name], own[name]) for name in own)


def test_round_trip_and_pruning(tmp_path):
    for iteration in range(4):
        save(tmp_path, iteration, keep=2)
    assert_equal(load_checkpoint(tmp_path), 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000002", "000003", "latest.json"]


@pytest.mark.parametrize("step", ["save_record", "write_json"])
def test_a_crash_leaves_the_previous_checkpoint(tmp_path, monkeypatch, step):
    save(tmp_path, 1)

    def die(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(_storage, step, die)  # while writing, or between writing and switching
        with pytest.raises(KeyboardInterrupt):
            save(tmp_path, 2)
    assert_equal(load_checkpoint(tmp_path), 1)
    save(tmp_path, 2)
    assert_equal(load_checkpoint(tmp_path), 2)


def test_going_back_to_an_older_checkpoint(tmp_path):
    for iteration in (5, 6, 7):
        save(tmp_path, iteration, keep=2)
    (tmp_path / "latest.json").write_text('{"checkpoint": "000006"}')
    assert load_checkpoint(tmp_path)["collected"] == 5 * 6
    save(tmp_path, 7, keep=2)  # takes the place of the abandoned 7
    assert load_checkpoint(tmp_path)["collected"] == 5 * 7


def _flip(path):
    data = bytearray(path.read_bytes())
    data[-3] ^= 1
    path.write_bytes(bytes(data))


def _edit(path, change):
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


CORRUPTIONS = {
    "no latest": lambda root: (root / "latest.json").unlink(),
    "latest is no JSON": lambda root: (root / "latest.json").write_text("{"),
    "latest is foreign": lambda root: (root / "latest.json").write_text("[]"),
    "latest leads outside": lambda root: (root / "latest.json").write_text('{"checkpoint": "../1"}'),
    "no directory": lambda root: shutil.rmtree(root / "000002"),
    "a flipped bit": lambda root: _flip(root / "000002/model.safetensors"),
    "an edited counter": lambda root: _edit(
        root / "000002/config.json", lambda r: r["config"]["state"].update(collected=99)
    ),
    "another kind": lambda root: _edit(root / "000002/config.json", lambda r: r.update(kind="LCSModel")),
    "another iteration": lambda root: (
        (root / "000002").rename(root / "000009") and (root / "latest.json").write_text('{"checkpoint": "000009"}')
    ),
    "a model's directory": lambda root: make_model(3).save_pretrained(root / "000002"),
}


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_corrupt_checkpoints_are_refused_and_untouched_and_the_older_one_is_named(tmp_path, name):
    for iteration in (1, 2):
        save(tmp_path, iteration)
    CORRUPTIONS[name](tmp_path)
    before = contents(tmp_path)
    message = refuse(CheckpointError, r"expected|match", load_checkpoint, tmp_path)
    assert "000001" in message or name in ("no latest", "latest is no JSON")
    assert contents(tmp_path) == before


def test_run_directory_refuses_what_is_there(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    refuse(CheckpointError, "--resume", RunDirectory.create, tmp_path, {})
    refuse(CheckpointError, "difflcs train", RunDirectory.open, tmp_path)
    assert contents(tmp_path) == {"thesis.txt": b"mine"}


def test_log_has_no_doubled_nor_broken_rows(tmp_path):
    run = RunDirectory.create(tmp_path / "run", {"kind": "run"})
    run.truncate_log(3)
    for iteration in range(4):
        run.append({"iteration": iteration, "loss": None if iteration == 0 else 0.5 * iteration})
    with run.log.open("a") as file:
        file.write("4,2.")  # cut off by a crash
    run.truncate_log(2)
    run.append({"iteration": 3, "loss": 7.0})
    assert run.log.read_text() == "iteration,loss\n0,\n1,0.5\n2,1.0\n3,7.0\n"
    assert [row["loss"] for row in run.rows()] == ["", "0.5", "1.0", "7.0"]
    run.truncate_log(-1)
    assert not run.log.exists()


# --- locks ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_in_use_is_refused_to_another_process(tmp_path):
    """After one that was killed, whose lock is left behind: tests/system/test_reproduce.py."""
    lock = f"_storage.locked(Path({str(tmp_path)!r})).__enter__()"
    code = f"from pathlib import Path; from difflcs import _storage; {lock}"
    with RunDirectory(tmp_path).locked():
        done = python("-c", code, fails=True)
    assert f"InUseError: {tmp_path}" in done.stderr
    assert re.search("in use; wait until .* another --out", done.stderr)


def test_a_lock_moves_with_its_directory(tmp_path):
    (tmp_path / "run").mkdir()
    with RunDirectory(tmp_path / "run").locked():
        os.replace(tmp_path / "run", tmp_path / "old")
        (tmp_path / "run").mkdir()
        with (
            RunDirectory(tmp_path / "run").locked(),
            pytest.raises(InUseError),
            RunDirectory(tmp_path / "old").locked(),
        ):
            pass
        second = RunDirectory(tmp_path / "run").locked()
        second.__enter__()
    assert (tmp_path / "run/.lock").exists()  # the first one leaves the lock of the second alone
    second.__exit__(None, None, None)


def test_a_lock_left_in_an_empty_directory_is_no_file(tmp_path):
    (tmp_path / ".lock").touch()
    RunDirectory.create(tmp_path, {"kind": "run"})
