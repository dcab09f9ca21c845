"""Run directories and checkpoints that survive a crash at any instant. Tensors as safetensors, the rest as JSON.

    RUN/config.json           everything the run was started with, and the versions of the packages
    RUN/log.csv               one row per iteration
    RUN/tensorboard/          the same numbers for TensorBoard
    RUN/checkpoints/000012/   complete state after iteration 12: config.json, model.safetensors
    RUN/checkpoints/latest.json   names the checkpoint to resume from
    RUN/model/                the final model, for `LCSModel.from_pretrained`
    RUN/.lock                 while a training works in it

A checkpoint is written into a hidden directory, renamed to its number, and only then named by `latest.json`, which is
replaced atomically. Whatever instant a crash comes at, `latest.json` names a complete checkpoint.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor, dtype

from difflcs import _files
from difflcs.errors import CheckpointError
from difflcs.lcs import LCSModel

_KIND = "training"
_MODEL = "model."
"""Prefix of the model's tensors in a checkpoint."""
_DIGITS = 12
"""Longest number of a checkpoint."""


@dataclass(frozen=True)
class Checkpoint:
    """The state of a training between two iterations.

    Attributes:
        iteration: iterations done.
        model: the learned system; None where the method learns something else, which is then among the tensors.
        state: counters and random generators, JSON types only.
        tensors: data buffer and whatever else the trainer holds.
    """

    iteration: int
    model: LCSModel | None
    state: Mapping[str, object]
    tensors: Mapping[str, Tensor]


def save_checkpoint(root: Path, checkpoint: Checkpoint, keep: int = 2) -> None:
    """Write `root/<iteration>/`, make it the latest, and delete all but the newest `keep` up to it."""
    root.mkdir(parents=True, exist_ok=True)
    name = f"{checkpoint.iteration:06d}"
    model = checkpoint.model
    temporary = Path(tempfile.mkdtemp(dir=root, prefix=f".{name}.", suffix=".tmp"))
    try:
        content = {
            "iteration": checkpoint.iteration,
            "model": None if model is None else model.config(),
            "state": dict(checkpoint.state),
        }
        parameters = {} if model is None else model.state_dict()
        tensors = {f"{_MODEL}{k}": v for k, v in parameters.items()} | dict(checkpoint.tensors)
        _files.save_record(temporary, _KIND, {**content, "sha256": _hash(content)}, tensors)
        temporary.chmod(0o755)
        shutil.rmtree(root / name, ignore_errors=True)  # left by a crash before it became the latest
        temporary.rename(root / name)
        _sync(root)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    _files.write_json(root / "latest.json", {"checkpoint": name})
    for old in sorted(n for n in _numbered(root) if int(n) <= checkpoint.iteration)[:-keep]:
        shutil.rmtree(root / old, ignore_errors=True)


def load_checkpoint(root: Path) -> Checkpoint:
    """Read the latest checkpoint below `root`; nothing is written.

    Raises:
        CheckpointError: there is none, or it is incomplete, corrupt or foreign.
    """
    latest = root / "latest.json"
    try:
        content = _files.read_json(latest)
    except FileNotFoundError:
        raise CheckpointError(
            f"{root}: expected latest.json, found none; was this written by `difflcs train`?"
        ) from None
    except CheckpointError as error:
        raise CheckpointError(f"{error.args[0]}; or write one of {sorted(_numbered(root))} into it") from error
    name = content.get("checkpoint") if isinstance(content, dict) else None
    if not isinstance(name, str) or not _is_number(name):
        raise CheckpointError(
            f'{latest}: expected {{"checkpoint": "<number>"}}, got {_files.short(content)}; '
            f"write one of {sorted(_numbered(root))} into it"
        )
    try:
        return _load(root / name, int(name))
    except CheckpointError as error:
        older = sorted(_numbered(root) - {name})
        remedy = f"to go back to an older one, write one of {older} into {latest}" if older else "start anew"
        raise CheckpointError(f"{error.args[0]}; {remedy}") from error


def _load(directory: Path, number: int) -> Checkpoint:
    record, tensors = _files.load_record(directory, _KIND)
    content = {k: v for k, v in record.items() if k != "sha256"}
    if record.get("sha256") != _hash(content):
        raise CheckpointError(f"{directory}: config.json does not match its checksum")
    iteration, config, state = content.get("iteration"), content.get("model"), content.get("state")
    if iteration != number or not isinstance(config, dict | None) or not isinstance(state, dict):
        raise CheckpointError(f"{directory}: expected iteration {number} with model and state, got {sorted(content)}")
    _files.check_finite(directory, tensors)
    parameters = {k.removeprefix(_MODEL): v for k, v in tensors.items() if k.startswith(_MODEL)}
    model = None if config is None else LCSModel.from_config(config, parameters, str(directory))
    return Checkpoint(number, model, state, {k: v for k, v in tensors.items() if not k.startswith(_MODEL)})


def _hash(content: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _numbered(root: Path) -> set[str]:
    return {path.name for path in root.iterdir() if path.is_dir() and _is_number(path.name)} if root.is_dir() else set()


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdecimal() and len(name) <= _DIGITS


def kinds(tensors: Mapping[str, Tensor], varying: Collection[str] = ()) -> dict[str, tuple[tuple[int, ...], dtype]]:
    """Name → shape and dtype; of the `varying` without their first dimension."""
    return {k: (tuple(v.shape[1:] if k in varying else v.shape), v.dtype) for k, v in tensors.items()}


def _sync(directory: Path) -> None:
    # A rename is durable only once the directory that holds it is.
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def check_episodes(episodes: Mapping[str, Tensor], empty: bool) -> None:
    """Check that tensors of episodes have as many episodes as each other.

    Args:
        episodes: name → (N, …).
        empty: whether there may be none.

    Raises:
        CheckpointError: the numbers differ, or there is none.
    """
    lengths = {name: len(value) for name, value in episodes.items()}
    if len(set(lengths.values())) > 1 or (not empty and not all(lengths.values())):
        raise CheckpointError(f"checkpoint: expected as many {' as '.join(lengths)}, got {lengths}; is it damaged?")


class RunDirectory:
    """The files of one training.

    Args:
        path: the directory; create it with `create`, open an existing one with `open`.
    """

    def __init__(self, path: Path):
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.model = path / "model"
        self.log = path / "log.csv"
        self.tensorboard = path / "tensorboard"

    @classmethod
    def create(cls, path: Path, config: Mapping[str, object]) -> RunDirectory:
        """Start a run in a new or empty directory.

        Raises:
            CheckpointError: something is there already.
        """
        cls.check_free(path)
        _files.write_json(path / "config.json", dict(config))
        return cls(path)

    @staticmethod
    def check_free(path: Path) -> None:
        """Refuse a path where there are files.

        Raises:
            CheckpointError: something is there already.
        """
        if path.exists() and (not path.is_dir() or any(entry.name != _files.LOCK for entry in path.iterdir())):
            raise CheckpointError(
                f"{path}: expected a new or empty directory, found files; "
                f"pass --resume to continue the run in it, or choose another --out"
            )

    def locked(self) -> AbstractContextManager[None]:
        """Let no other process train in this directory meanwhile. The lock ends with this process, however that dies.

        Raises:
            InUseError: another one does.
            OSError: the directory cannot be written.
        """
        return _files.locked(self.path)

    @classmethod
    def open(cls, path: Path) -> RunDirectory:
        """Open an existing run.

        Raises:
            CheckpointError: there is no run.
        """
        if not (path / "config.json").is_file():
            raise CheckpointError(f"{path}: expected a directory written by `difflcs train`, found no config.json")
        return cls(path)

    def config(self) -> dict[str, object]:
        """What the run was started with.

        Raises:
            CheckpointError: config.json is not JSON, or not of a run.
        """
        file = self.path / "config.json"
        try:
            config = _files.read_json(file)
        except FileNotFoundError as error:
            raise CheckpointError(
                f"{file}: expected the config of a run, found no file; restore it from a copy"
            ) from error
        if not isinstance(config, dict) or config.get("kind") != "run":
            raise CheckpointError(f"{file}: expected the config of a run, got something else; is {self.path} a run?")
        return config

    def finished(self) -> bool:
        """Whether the final model is there."""
        return (self.model / "config.json").is_file()

    def load_model(self) -> LCSModel:
        """The final model, or that of the latest checkpoint of an unfinished run.

        Raises:
            CheckpointError: there is none, or the method learned something else.
        """
        model = LCSModel.from_pretrained(self.model) if self.finished() else load_checkpoint(self.checkpoints).model
        if model is None:
            raise CheckpointError(f"{self.path}: expected a run that learned an LCSModel, got one of another method")
        return model

    def append(self, row: Mapping[str, object]) -> None:
        """Add one row to log.csv; None becomes an empty cell."""
        new = not self.log.exists()
        with self.log.open("a", newline="") as file:
            file.write(_line(row.keys()) * new + _line(["" if v is None else v for v in row.values()]))
            file.flush()
            os.fsync(file.fileno())

    def rows(self) -> list[dict[str, str]]:
        """The complete rows of log.csv; a last line cut off by a crash is left out.

        Raises:
            CheckpointError: log.csv is not a table of numbers, a row for each iteration.
        """
        try:
            lines = _files.read_text(self.log).splitlines(keepends=True)
        except FileNotFoundError:
            return []
        try:
            found = csv.DictReader(line for line in lines if line.endswith("\n"))
            rows = [row for row in found if None not in row and None not in row.values()]
            for row in rows:
                int(row["iteration"])
                for cell in filter(None, row.values()):
                    float(cell)
        except (csv.Error, KeyError, ValueError) as error:
            raise CheckpointError(
                f"{self.log}: expected a table of numbers with the column iteration, got {type(error).__name__}: "
                f"{error}; restore it from a copy, or delete it"
            ) from error
        return rows

    def truncate_log(self, iteration: int) -> None:
        """Drop the rows after an iteration, so that resuming there does not write them twice."""
        rows = [row for row in self.rows() if int(row["iteration"]) <= iteration]
        if rows:
            text = _line(rows[0].keys()) + "".join(_line(row.values()) for row in rows)
            _files.write_atomically(self.log, text.encode())
        else:
            self.log.unlink(missing_ok=True)


def _line(cells: Sequence[object] | object) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()
