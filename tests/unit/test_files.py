"""Checkpoints: round trips, every kind of damage, and writes that leave the old file or the new."""

import json
import os
import stat
import sys

import pytest
import torch

from difflcs import LCSModel, _storage
from difflcs.errors import CheckpointError, DiffLCSError, InvalidInputError, MissingDependencyError
from tests.conftest import contents


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


def refuse(directory, match=None):
    """Loading fails with the typed error, names the directory, and changes no file."""
    before = contents(directory) if directory.is_dir() else None
    with pytest.raises(CheckpointError, match=match) as error:
        LCSModel.from_pretrained(directory)
    assert str(directory) in str(error.value)
    assert isinstance(error.value, DiffLCSError)
    if before is not None:
        assert contents(directory) == before


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


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_missing_file_is_refused(saved, name):
    (saved / name).unlink()
    refuse(saved, f"a file is missing.*{name}")


def test_a_file_in_the_place_of_the_directory_is_refused(tmp_path):
    (tmp_path / "file").write_text("hello")
    refuse(tmp_path / "file")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"kind": "PDDM"}, "expected a record of kind 'LCSModel', got 'PDDM'"),
        ({"kind": None}, "expected a record of kind 'LCSModel', got None"),
        ({"format": 2}, "expected format 1, got 2; update difflcs"),
        ({"config": [1]}, "expected"),
    ],
)
def test_a_record_of_another_kind_or_format_is_refused(saved, change, match):
    path = saved / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    refuse(saved, match)


@pytest.mark.parametrize("interrupt", [KeyboardInterrupt, SystemExit, MemoryError])
def test_an_interrupt_during_a_write_leaves_the_old_file(tmp_path, monkeypatch, interrupt):
    path = tmp_path / "file"
    _storage.write_atomically(path, b"old")

    def fail(*args):
        raise interrupt

    monkeypatch.setattr(os, "fsync", fail)
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
