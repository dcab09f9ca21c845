"""Files that are damaged, foreign, or made up with a right checksum: a typed error, and nothing of their size."""

import hashlib
import json
import os
import random
from functools import reduce

import pytest
import torch
from safetensors.torch import load_file, save

from difflcs import LCSModel, _storage, zoo
from difflcs.errors import CheckpointError
from difflcs.rl.learning.dynamics import Ensemble
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.learning.state_tree import check_state
from difflcs.rl.learning.trainer import save_learned
from difflcs.rl.methods import method_names
from difflcs.rl.runs.checkpoint import RunDirectory, load_checkpoint, save_checkpoint
from difflcs.rl.runs.trained import TrainedPolicy
from difflcs.rl.runs.training import TrainConfig, stored_config
from difflcs_envs.tasks import pushing_features
from tests.conftest import refuse

VALUES = [
    None, True, False, 0, -1, 1.5, 10**12, 10**400, -(10**30), 1e308, "", "x", "\ud800", "\0", "9" * 5000, [], [1],
    [[]], {}, {"a": 1}, [None, True], ["x"] * 3,
]  # fmt: skip
TEXTS = [
    b"", b"\xff\xfe\x00", b"\x00" * 50, b"[" * 100_000, b"[" * 300 + b"]" * 300, b'{"a":' * 40 + b"1" + b"}" * 40,
    b"NaN", b"1" * 10_000, b"1e999", b'{"kind": "run", "config": NaN}', b'{"kind": "run", "config": -Infinity}',
    b'"\xc3"', b"{} {}",
]  # fmt: skip


def small_model(seed=0):
    return LCSModel(2, 1, 1, init_scale=0.1, generator=torch.Generator().manual_seed(seed))


def make_run(path, **changes):
    """An unfinished run with one checkpoint and a log."""
    config = TrainConfig(**changes)
    run = RunDirectory.create(path, {"kind": "run", "config": config.to_json(), "init": None, "versions": {}})
    run.append({"iteration": 0, "loss": None})
    run.append({"iteration": 1, "loss": 0.5})
    return run


def write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())


CHECKPOINT = {"n": 1, "inner": dict(small_model().state_dict())}
RECORDS = {
    "model": (lambda path: small_model().save_pretrained(path), LCSModel.from_pretrained),
    "ensemble": (
        lambda path: save_learned(Ensemble(2, 1, 2, 4), path),
        lambda path: Ensemble.from_config(*_storage.load_record(path, "Ensemble"), str(path)),
    ),
    "network": (
        lambda path: save_learned(MLPController(pushing_features, 15, -torch.ones(6), torch.ones(6), 4), path),
        lambda path: MLPController.from_config(
            *_storage.load_record(path, "MLPController"), str(path), pushing_features
        ),
    ),
    "checkpoint": (
        lambda path: save_checkpoint(path.parent, 1, CHECKPOINT),
        lambda path: check_state(CHECKPOINT, load_checkpoint(path.parent)),
    ),
}


@pytest.fixture(params=RECORDS)
def record(request, tmp_path):
    """A record on disk, what loads it, its description, and what writes another one with checksums that fit."""
    make, load = RECORDS[request.param]
    path = tmp_path / "000001"
    make(path)
    load(path)
    header = json.loads((path / "config.json").read_text())

    def rewrite(changed, tensors=None):
        if "sha256" in header["config"] and isinstance(changed.get("config"), dict):
            content = {k: v for k, v in changed["config"].items() if k != "sha256"}
            digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
            changed = {**changed, "config": {**content, "sha256": digest}}
        write(path / "config.json", changed)
        tensors = load_file(path / "model.safetensors") if tensors is None else tensors
        (path / "model.safetensors").write_bytes(save(tensors, metadata={"sha256": _storage.digest(changed, tensors)}))

    return path, load, header, rewrite


def paths_of(value, path=()):
    """Where every value of a JSON document is."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in items:
        yield from paths_of(part, (*path, key))


def put(document, path, value):
    """A copy of a document with another value at a path."""
    if not path:
        return value
    copy = json.loads(json.dumps(document))
    part = copy
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    return copy


def loads_or_refuses(load, *arguments):
    """A typed error that says something, or no error."""
    try:
        load(*arguments)
    except CheckpointError as error:
        message = str(error)
    else:
        return True
    assert 20 < len(message) < 3000
    return False


# --- text -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("content", TEXTS, ids=lambda c: repr(c[:12]))
def test_no_json_no_traceback(tmp_path, monkeypatch, content):
    monkeypatch.setattr(zoo, "path", lambda _: tmp_path)
    model, run = tmp_path / "model", make_run(tmp_path / "run")
    small_model().save_pretrained(model)
    save_checkpoint(run.checkpoints, 1, dict(small_model().state_dict()))
    card = tmp_path / "card.json"
    for path in (model / "config.json", run.path / "config.json", run.checkpoints / "latest.json", card):
        path.write_bytes(content)
    for load in (
        lambda: LCSModel.from_pretrained(model),
        run.config,
        lambda: load_checkpoint(run.checkpoints),
        lambda: zoo.card("trifinger-cube"),
    ):
        refuse(CheckpointError, ".", load)


def test_what_is_too_large_is_not_read(tmp_path):
    run, model = make_run(tmp_path / "run"), tmp_path / "model"
    small_model().save_pretrained(model)
    for path, size, match, load in (
        (run.path / "config.json", 1 << 40, "at most 64 MB, got 1048576 MB", run.config),
        (run.log, 1 << 40, "at most 64 MB", run.rows),
        (model / "model.safetensors", 1 << 42, "at most 4096 MB", lambda: LCSModel.from_pretrained(model)),
    ):
        os.truncate(path, size)  # sparse
        refuse(CheckpointError, match, load)


def test_a_pipe_does_not_hang(tmp_path):
    small_model().save_pretrained(tmp_path)
    (tmp_path / "config.json").unlink()
    os.mkfifo(tmp_path / "config.json")
    refuse(CheckpointError, "plain file", LCSModel.from_pretrained, tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"iteration,loss\n0,\xff\n", b"loss\n1\n", b"iteration,loss\nx,1\n", b"iteration,loss\n1,x\n",
     b"iteration\n" + b"9" * 200_000 + b"\n"],
)  # fmt: skip
def test_a_foreign_log_is_refused(tmp_path, content):
    run = make_run(tmp_path / "run")
    run.log.write_bytes(content)
    for load in (run.rows, lambda: run.truncate_log(3)):
        refuse(CheckpointError, r"log\.csv", load)
    assert run.log.read_bytes() == content


@pytest.mark.parametrize("name", [1, True, 1.0, "²", "１", " 1", "1" * 5000, "-1", "", None, ["000001"], {}])
def test_the_name_of_the_latest_checkpoint(tmp_path, name):
    save_checkpoint(tmp_path, 1, dict(small_model().state_dict()))
    write(tmp_path / "latest.json", {"checkpoint": name})
    refuse(CheckpointError, "expected", load_checkpoint, tmp_path)
    (tmp_path / "²").mkdir()
    save_checkpoint(tmp_path, 2, dict(small_model().state_dict()))  # does not take it for a number


# --- records with a right checksum ------------------------------------------------------------------------------------


def test_any_value_in_any_field(record):
    path, load, header, rewrite = record
    for place in paths_of(header):
        for value in VALUES:
            changed = put(header, place, value)
            if isinstance(changed, dict) and place[:2] != ("config", "sha256"):
                rewrite(changed)
            else:
                write(path / "config.json", changed)
            loads_or_refuses(load, path)


def test_sizes_are_compared_before_anything_is_made(record):
    path, load, header, rewrite = record
    sizes = {"n_x", "n_u", "n_lam", "width", "networks", "n_features"}
    for place in [p for p in paths_of(header) if sizes & set(p[-1:])]:
        for size in (10**5, 10**9, 10**18):
            rewrite(put(header, place, size))
            refuse(CheckpointError, "expected", load, path)


@pytest.mark.parametrize("name", ["float16", "bfloat16", "int64", "bool", "complex64", "float8_e5m2"])
def test_tensors_of_another_type(record, name):
    path, load, header, rewrite = record
    rewrite(header, {k: v.to(getattr(torch, name)) for k, v in load_file(path / "model.safetensors").items()})
    refuse(CheckpointError, ".", load, path)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_tensors_that_are_not_finite(record, value):
    path, load, header, rewrite = record
    tensors = load_file(path / "model.safetensors")
    for tensor in tensors.values():
        tensor.view(-1)[0] = value
    rewrite(header, tensors)
    refuse(CheckpointError, "finite", load, path)


def test_random_damage(record):
    """Seeded: flipped bits, cuts, runs of random bytes, pieces swapped. The header of the tensors gets half of it.

    None of it goes unnoticed in the file of the tensors.
    """
    path, load, *_ = record
    rng = random.Random(0)
    for name in ("config.json", "model.safetensors"):
        whole = (path / name).read_bytes()
        for _ in range(150):
            data = bytearray(whole)
            end = len(data) if rng.random() < 0.5 else min(len(data), 300)
            for _ in range(rng.choice((1, 1, 4, 40))):
                data[rng.randrange(end)] = rng.randrange(256)
            kind = rng.randrange(4)
            if kind == 1:
                del data[rng.randrange(len(data)) :]
            elif kind == 2:
                data[rng.randrange(end) : rng.randrange(end)] = rng.randbytes(rng.randrange(64))
            (path / name).write_bytes(data)
            assert not loads_or_refuses(load, path) or name == "config.json" or data == whole
        (path / name).write_bytes(whole)
    load(path)


# --- settings of a run ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", method_names())
def test_any_value_in_any_setting(tmp_path, method):
    run = make_run(tmp_path / "run", method=method)
    whole = run.config()
    rng = random.Random(method)  # most settings are those of several methods: each draws others
    for place in paths_of(whole["config"], ("config",)):
        for value in (True, *rng.sample(VALUES, 2)):
            write(run.path / "config.json", put(whole, place, value))
            accepted = loads_or_refuses(stored_config, run)
            stored = reduce(lambda part, key: part[key], place, whole)
            assert not (accepted and value is True) or isinstance(stored, bool)  # true is no number


# --- the zoo ----------------------------------------------------------------------------------------------------------


def test_any_value_in_any_field_of_a_card(tmp_path, monkeypatch):
    card = json.loads((zoo.path("trifinger-cube") / "card.json").read_text())
    monkeypatch.setattr(zoo, "path", lambda _: tmp_path)
    for place in paths_of({k: v for k, v in card.items() if k != "settings"}):
        for value in VALUES:
            write(tmp_path / "card.json", put(card, place, value))
            if loads_or_refuses(zoo.card, "trifinger-cube"):
                known = zoo.card("trifinger-cube")
                assert str(known)
                assert zoo.table([known])
                assert zoo.describe(known.object)


@pytest.mark.parametrize("found", [{"name": ["a"]}, {"mass": {"kg": 1}}])
def test_an_object_that_is_none(tmp_path, found):
    run = make_run(tmp_path / "run")
    write(run.path / "config.json", {**run.config(), "object": found})
    refuse(CheckpointError, "texts and numbers that describe an object", TrainedPolicy.open, run.path)
