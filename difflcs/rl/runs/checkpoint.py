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
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

from torch import Tensor

from difflcs import _storage
from difflcs.errors import CheckpointError
from difflcs.rl.learning.state_tree import State, flatten, unflatten

_KIND = "training"
_DIGITS = 12
"""Longest number of a checkpoint."""


def save_checkpoint(root: Path, iteration: int, state: State, keep: int = 2) -> None:
    """Write a state into `root/<iteration>/`, make it the latest, and delete all but the newest `keep` up to it."""
    root.mkdir(parents=True, exist_ok=True)
    name = f"{iteration:06d}"
    temporary = Path(tempfile.mkdtemp(dir=root, prefix=f".{name}.", suffix=".tmp"))
    try:
        tensors, rest = flatten(state)
        content = {"iteration": iteration, "state": rest}
        _storage.save_record(temporary, _KIND, {**content, "sha256": _hash(content)}, tensors)
        temporary.chmod(0o755)
        shutil.rmtree(root / name, ignore_errors=True)  # left by a crash before it became the latest
        temporary.rename(root / name)
        _sync(root)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    _storage.write_json(root / "latest.json", {"checkpoint": name})
    for old in sorted(n for n in _numbered(root) if int(n) <= iteration)[:-keep]:
        shutil.rmtree(root / old, ignore_errors=True)
    for left in root.glob(".*.tmp"):  # by a process that was killed; a directory or a file
        shutil.rmtree(left, ignore_errors=True)
        left.unlink(missing_ok=True)


def load_checkpoint(root: Path) -> dict[str, Any]:
    """Read the state of the latest checkpoint below `root`; nothing is written.

    Raises:
        CheckpointError: there is none, or it is incomplete, corrupt or foreign.
    """
    latest = root / "latest.json"
    try:
        content = _storage.read_json(latest)
    except FileNotFoundError:
        raise CheckpointError(
            f"{root}: expected latest.json, found none; was this written by `difflcs train`?"
        ) from None
    except CheckpointError as error:
        newest = max(_numbered(root), default="")
        raise CheckpointError(f'{error.args[0]}; or write {{"checkpoint": "{newest}"}} into it') from error
    name = content.get("checkpoint") if isinstance(content, dict) else None
    if not isinstance(name, str) or not _is_number(name):
        raise CheckpointError(
            f'{latest}: expected {{"checkpoint": "<number>"}}, got {_storage.short(content)}; '
            f"write one of {sorted(_numbered(root))} into it as that number"
        )
    try:
        return _load(root / name, int(name))
    except CheckpointError as error:
        older = max(_numbered(root) - {name}, default=None)
        remedy = f'to go back, write {{"checkpoint": "{older}"}} into {latest}' if older else "start anew"
        raise CheckpointError(f"{error.args[0]}; {remedy}") from error


def _load(directory: Path, number: int) -> dict[str, Any]:
    record, tensors = _storage.load_record(directory, _KIND)
    content = {k: v for k, v in record.items() if k != "sha256"}
    if record.get("sha256") != _hash(content):
        raise CheckpointError(f"{directory}: config.json does not match its checksum")
    iteration, state = content.get("iteration"), content.get("state")
    if iteration != number or not isinstance(state, dict):
        raise CheckpointError(f"{directory}: expected iteration {number} with its state, got {sorted(content)}")
    _storage.check_finite(directory, tensors)
    return unflatten(tensors, state)


def _hash(content: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _numbered(root: Path) -> set[str]:
    return {path.name for path in root.iterdir() if path.is_dir() and _is_number(path.name)} if root.is_dir() else set()


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdecimal() and len(name) <= _DIGITS


def _sync(directory: Path) -> None:
    # A rename is durable only once the directory that holds it is.
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class RunDirectory:
    """The files of one training.

    Args:
        path: the directory; create it with `create`, open an existing one with `open`.
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.checkpoints = self.path / "checkpoints"
        self.model = self.path / "model"
        self.log = self.path / "log.csv"
        self.tensorboard = self.path / "tensorboard"

    @classmethod
    def create(cls, path: Path, config: Mapping[str, object]) -> RunDirectory:
        """Start a run in a new or empty directory.

        Raises:
            CheckpointError: something is there already.
        """
        cls.check_free(path)
        _storage.write_json(path / "config.json", dict(config))
        return cls(path)

    @staticmethod
    def check_free(path: Path) -> None:
        """Raise if there are files at a path.

        Raises:
            CheckpointError: something is there already.
        """
        if path.exists() and (not path.is_dir() or any(entry.name != _storage.LOCK for entry in path.iterdir())):
            raise CheckpointError(
                f"{path}: expected a new or empty directory, found files; "
                f"if it is a run, continue it with --resume, or choose another --out"
            )

    def locked(self) -> AbstractContextManager[None]:
        """Let no other process train in this directory meanwhile. The lock ends with this process, however that dies.

        Raises:
            InUseError: another one does.
            OSError: the directory cannot be written.
        """
        return _storage.locked(self.path)

    @classmethod
    def open(cls, path: Path | str) -> RunDirectory:
        """Open an existing run.

        Raises:
            CheckpointError: there is no run.
        """
        run = cls(path)
        if not (run.path / "config.json").is_file():
            raise CheckpointError(f"{path}: expected a directory written by `difflcs train`, found no config.json")
        return run

    def config(self) -> dict[str, object]:
        """Read the configuration that the run was started with.

        Raises:
            CheckpointError: config.json is not JSON, or not of a run.
        """
        file = self.path / "config.json"
        try:
            config = _storage.read_json(file)
        except FileNotFoundError as error:
            raise CheckpointError(
                f"{file}: expected the config of a run, found no file; restore it from a copy"
            ) from error
        if not isinstance(config, dict) or config.get("kind") != "run":
            raise CheckpointError(f"{file}: expected the config of a run, got something else; is {self.path} a run?")
        return config

    def finished(self) -> bool:
        """Return True if the final model is there."""
        return (self.model / "config.json").is_file()

    def learned(self, kind: str) -> tuple[dict[str, object], dict[str, Tensor]]:
        """Read configuration and tensors of the learned model: the final one, else that of the latest checkpoint.

        Args:
            kind: kind of the record, as the class of the model writes it.

        Raises:
            CheckpointError: there is none, or it is of another kind.
        """
        if self.finished():
            return _storage.load_record(self.model, kind)
        state = load_checkpoint(self.checkpoints).get("learned")
        tensors = "plain" if isinstance(state, dict) and "plain" in state else "parameters"
        if not isinstance(state, dict) or not all(isinstance(state.get(k), dict) for k in ("settings", tensors)):
            raise CheckpointError(f"{self.checkpoints}: expected what was learned, got {_storage.short(state)}")
        return state["settings"], state[tensors]

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
            lines = _storage.read_text(self.log).splitlines(keepends=True)
        except FileNotFoundError:
            return []
        try:
            reader = csv.DictReader(line for line in lines if line.endswith("\n"))
            rows = [row for row in reader if None not in row and None not in row.values()]
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
            _storage.write_atomically(self.log, text.encode())
        else:
            self.log.unlink(missing_ok=True)


def _line(cells: Sequence[object] | object) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


@contextmanager
def wrap_os_errors(path: Path) -> Iterator[None]:
    """Wrap errors of the operating system in ours.

    Raises:
        CheckpointError: something below `path` cannot be written.
    """
    try:
        yield
    except OSError as error:
        begun = os.path.isfile(path / "checkpoints/latest.json")
        remedy = "go on with --resume (the last checkpoint is intact)" if begun else "try again"
        raise CheckpointError(
            f"{path}: expected a folder with free space that can be written, got: {error}; mend that and {remedy}, or "
            f"choose another --out"
        ) from error


@contextmanager
def replace_run(out: Path) -> Iterator[Callable[[], object]]:
    """Move the run in `out` aside. The yielded function deletes it; unless called, the run comes back at the end."""
    out = out.resolve()
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        yield lambda: None
        return
    try:
        RunDirectory.open(out).config()
    except CheckpointError as error:
        raise CheckpointError(f"{error}. --force replaces runs only; choose another --out") from error
    replaced = False

    def discard() -> None:
        nonlocal replaced
        replaced = True
        shutil.rmtree(aside, ignore_errors=True)

    with ExitStack() as held:
        with wrap_os_errors(out):
            held.enter_context(RunDirectory(out).locked())
            aside = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}.", suffix=".old"))
            os.replace(out, aside / out.name)
            out.mkdir()  # `--out` may be a link to it
        try:
            yield discard
        finally:
            if not replaced:
                shutil.rmtree(out, ignore_errors=True)
                os.replace(aside / out.name, out)
                aside.rmdir()
