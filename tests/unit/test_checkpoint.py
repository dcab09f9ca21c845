"""Models, checkpoints, states as trees and run directories: what is written comes back, nothing else is accepted."""

import json
import math
import os
import re
import shutil
import stat
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from difflcs import LCSModel, _storage
from difflcs.errors import CheckpointError, InUseError, InvalidInputError, MissingDependencyError
from difflcs.rl.learning.state_tree import check_state, copy_state, flatten, restore, unflatten
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
    with monkeypatch.context() as patch:
        patch.setattr(_storage, step, Mock(side_effect=KeyboardInterrupt))  # while writing, or before switching
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


def _edit(folder, change):
    path = folder / "config.json"
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
    "an edited counter": lambda root: _edit(root / "000002", lambda r: r["config"]["state"].update(collected=99)),
    "another kind": lambda root: _edit(root / "000002", lambda r: r.update(kind="LCSModel")),
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


# --- states as trees --------------------------------------------------------------------------------------------------


NAMES = st.text("abcxyz_.0 é", min_size=1, max_size=5)
NUMBERS = st.integers(-(2**200), 2**200) | st.floats(allow_nan=False) | st.booleans() | st.none() | st.text(max_size=5)
TENSORS = st.lists(st.floats(allow_nan=False, width=32), max_size=4).map(torch.tensor) | st.integers(0, 9).map(
    torch.tensor
)
TREES = st.recursive(
    st.dictionaries(NAMES, NUMBERS | TENSORS, max_size=4),
    lambda inner: st.dictionaries(NAMES, NUMBERS | TENSORS | inner, max_size=4),
    max_leaves=12,
)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(value, other[name]) for name, value in one.items())
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return type(one) is type(other) and one == other


@settings(max_examples=50, deadline=None)
@given(TREES)
def test_a_tree_comes_back(tree):
    tensors, rest = flatten(tree)
    assert all(isinstance(value, torch.Tensor) for value in tensors.values())
    assert same(unflatten(tensors, json.loads(json.dumps(rest))), tree)
    assert same(copy_state(tree), tree)


def test_a_tensor_whose_path_leads_nowhere_stays_at_the_top():
    tree = unflatten({"a/b/c": torch.zeros(1)}, {"a": 3})
    assert set(tree) == {"a", "a/b/c"}
    refuse(CheckpointError, "a/b/c", check_state, {"a": 3}, tree)


def make_tree() -> dict[str, Any]:
    return {
        "iteration": 3,
        "step_size": 0.25,
        "phase": "main",
        "models": None,
        "on": True,
        "learned": {
            "settings": {"n_x": 2, "widths": [1, 2]},
            "parameters": {"A": torch.zeros(2, 3), "count": torch.tensor(4)},
        },
        "episodes": {"state": torch.zeros(5, 3, 2), "action": torch.zeros(5, 2, 1)},
        "random": {"noise": np.random.default_rng(0).bit_generator.state},
    }


CHANGES: dict[str, Any] = {
    "iteration": [None, True, -1, 3.0, "3", 2**63, [3], torch.tensor(3), {}],
    "step_size": [None, 1, math.nan, math.inf, "0.25", torch.tensor(0.25)],
    "phase": [None, "warmup", 3],
    "models": [3, {}, torch.zeros(1)],
    "on": [1, None, "True"],
    "learned": [None, 3, {}, {"settings": {}}, []],
    "learned.settings": [None, {}, {"n_x": 3, "widths": [1, 2]}, {"n_x": 2, "widths": [1]}],
    "learned.parameters.A": [
        None, 0.0, torch.zeros(3, 2), torch.zeros(2, 3, 1), torch.zeros(2, 3).double(), torch.zeros(2, 3).long(),
        torch.full((2, 3), math.nan), torch.full((2, 3), math.inf),
    ],
    "learned.parameters.count": [4, torch.tensor(4.0), torch.tensor([4])],
    "episodes.state": [
        torch.zeros(4, 3, 2), torch.zeros(5, 3, 1), torch.zeros(5, 3), torch.zeros(5, 3, 2, 1),
        torch.full((5, 3, 2), math.nan), None,
    ],
    "episodes": [{"state": torch.zeros(5, 3, 2)}, None],
    "random.noise.state.state": [None, -1, 0.5, "1"],
    "random.noise.bit_generator": ["MT19937", None],
}  # fmt: skip


def changed(path: str, value: Any) -> dict[str, Any]:
    state = copy_state(make_tree())
    *folders, name = path.split(".")
    place = state
    for folder in folders:
        place = place[folder]
    place[name] = value
    return state


@pytest.mark.parametrize(
    ("path", "number"), [(path, n) for path, values in CHANGES.items() for n in range(len(values))]
)
def test_every_single_change_is_refused_by_name(path, number):
    value = CHANGES[path][number]
    refuse(CheckpointError, path.split(".")[0], check_state, make_tree(), changed(path, value))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("iteration", 7),
        ("iteration", 0),
        ("step_size", 0.5),
        ("on", False),
        ("learned.parameters.A", torch.ones(2, 3)),
        ("random.noise.state.state", 2**127),
        *(("episodes", {"state": torch.ones(n, 3, 2), "action": torch.ones(n, 2, 1)}) for n in (0, 9)),
    ],
)
def test_values_that_may_differ_do(path, value):
    check_state(make_tree(), changed(path, value))


@pytest.mark.parametrize("found", [None, 3, [], "x"])
def test_what_is_no_tree_is_refused(found):
    refuse(CheckpointError, "expected", check_state, make_tree(), found)


class Part:
    """Refuses a negative size, after it has taken the rest."""

    def __init__(self, error: type[Exception] = ValueError) -> None:
        self.weights, self.size, self.error = torch.zeros(3), 1.0, error

    def state_dict(self) -> dict[str, Any]:
        return {"weights": self.weights, "size": self.size}

    def load_state_dict(self, state: Any) -> None:
        self.weights.copy_(state["weights"])
        if state["size"] < 0:
            raise self.error("negative")
        self.size = state["size"]


@pytest.mark.parametrize("error", [ValueError, TypeError, OverflowError, CheckpointError])
def test_a_part_that_refuses_a_state_stays_as_it_was(error):
    part = Part(error)
    refuse(CheckpointError, ".", restore, part, {"weights": torch.ones(3), "size": -1.0})
    assert torch.equal(part.weights, torch.zeros(3))
    assert part.size == 1.0
    refuse(CheckpointError, r"mine\.weights", restore, part, {"weights": torch.ones(4), "size": 2.0}, "mine")
    assert torch.equal(part.weights, torch.zeros(3))
    restore(part, {"weights": torch.ones(3), "size": 2.0})
    assert torch.equal(part.weights, torch.ones(3))
    assert part.size == 2.0


# --- models in files --------------------------------------------------------------------------------------------------


@pytest.fixture
def model(build):
    return build.model(seed=3)


@pytest.mark.parametrize("name", [b"run\xff", b"run\0"])
def test_a_training_refuses_a_path_that_is_no_text(name, tmp_path):
    from difflcs.rl import train

    with pytest.raises(InvalidInputError, match=r"out: expected a path in UTF-8, got .*; choose"):
        train(out=f"{tmp_path}/{os.fsdecode(name)}")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def saved(model, tmp_path):
    model.save_pretrained(tmp_path / "saved")
    return tmp_path / "saved"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("learn_c", [True, False])
def test_round_trip_keeps_every_bit(build, tmp_path, dtype, learn_c):
    model = build.model(seed=3, dtype=dtype)
    model.c.requires_grad_(learn_c)
    model.save_pretrained(tmp_path / "deep" / "er")
    loaded = LCSModel.from_pretrained(str(tmp_path / "deep" / "er"))
    for name in LCSModel.parameter_names:
        assert torch.equal(getattr(loaded, name), getattr(model, name))
        assert getattr(loaded, name).dtype == dtype
        assert getattr(loaded, name).requires_grad == getattr(model, name).requires_grad
    assert loaded.config() == model.config()
    x, u = torch.ones(4, dtype=dtype), torch.ones(2, dtype=dtype)
    assert torch.equal(loaded(x, u).x_next, model(x, u).x_next)


def test_files_are_readable_by_others(saved):
    for path in saved.iterdir():
        assert stat.S_IMODE(path.stat().st_mode) & 0o444 == 0o444


NO_MODELS = {
    "a file is missing.*config.json": lambda path: (path / "config.json").unlink(),
    "a file is missing.*model.safetensors": lambda path: (path / "model.safetensors").unlink(),
    "config.json": lambda path: (shutil.rmtree(path), path.write_text("hello")),  # a file in the place of the directory
    "expected a record of kind 'LCSModel', got 'PDDM'": lambda path: _edit(path, lambda r: r.update(kind="PDDM")),
    "expected a record of kind 'LCSModel', got None": lambda path: _edit(path, lambda r: r.update(kind=None)),
    "expected format 1, got 2; update difflcs": lambda path: _edit(path, lambda r: r.update(format=2)),
    "expected": lambda path: _edit(path, lambda r: r.update(config=[1])),
}


@pytest.mark.parametrize("match", NO_MODELS)
def test_what_is_no_model_is_refused_by_its_directory_and_untouched(saved, match):
    NO_MODELS[match](saved)
    before = contents(saved)
    assert str(saved) in refuse(CheckpointError, match, LCSModel.from_pretrained, saved)
    assert contents(saved) == before


@pytest.mark.parametrize("interrupt", [KeyboardInterrupt, SystemExit, MemoryError])
def test_an_interrupt_during_a_write_leaves_the_old_file(tmp_path, monkeypatch, interrupt):
    path = tmp_path / "file"
    _storage.write_atomically(path, b"old")
    monkeypatch.setattr(os, "fsync", Mock(side_effect=interrupt))
    with pytest.raises(interrupt):
        _storage.write_atomically(path, b"new")
    assert contents(tmp_path) == {"file": b"old"}


def test_a_lock_without_its_package_names_the_line_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "filelock", None)
    with (
        pytest.raises(MissingDependencyError, match=r"filelock, got none; run: pip install"),
        _storage.locked(tmp_path),
    ):
        pass
