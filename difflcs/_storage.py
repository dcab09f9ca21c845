"""Storage in files: atomic writes, locks, JSON, and records of tensors (safetensors). Never pickle.

Any file that cannot be used raises a `CheckpointError`. Sizes are checked before anything is read.
"""

import hashlib
import json
import os
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from difflcs.errors import CheckpointError, InUseError, InvalidInputError, MissingDependencyError

LOCK = ".lock"
"""Name of the file whose lock shows that a process works in the directory."""
MAX_TEXT = 1 << 26
"""Largest JSON or CSV file that is read [byte]; a training of days writes less than a megabyte."""
MAX_TENSORS = 1 << 32
"""Largest file of tensors that is read [byte]."""
_MAX_DEPTH = 32
"""Deepest nesting of JSON that is read; ours has six levels."""
_FORMAT = 1

M = TypeVar("M", bound=nn.Module)


def check_path(name: str, path: Path) -> None:
    """Refuse a path that cannot be written as text, which TensorBoard and other libraries want.

    Raises:
        InvalidInputError: it is not UTF-8, or has a NUL.
    """
    try:
        os.fsencode(path).decode()
        clean = "\0" not in str(path)
    except UnicodeError:
        clean = False
    if not clean:
        raise InvalidInputError(f"{name}: expected a path in UTF-8, got {str(path)!r:.200}; choose another name")


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a crash leaves either the old content or the new, never half."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:  # a full disk names no file
            error.filename = str(path)
        raise


@contextmanager
def place_to_write(path: Path, name: str = "out") -> Iterator[None]:
    """Turn what the system says of files that cannot be written into an error of ours."""
    try:
        yield
    except OSError as error:
        raise InvalidInputError(f"{name}: expected a place to write {path}, got: {error}; choose another") from error


def check_place(name: str, folder: Path) -> None:
    """Refuse, before long work, a folder that cannot be written or made; nothing is left there."""
    with place_to_write(folder, name):
        nearest = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
        tempfile.TemporaryFile(dir=nearest).close()


def write_json(path: Path, value: object) -> None:
    """Write JSON atomically."""
    write_atomically(path, (json.dumps(value, indent=2, sort_keys=True) + "\n").encode())


def read_text(path: Path) -> str:
    """Read a text file.

    Raises:
        FileNotFoundError: there is none.
        CheckpointError: it is not a file, too large, not UTF-8, or cannot be read.
    """
    try:
        return read_bytes(path, MAX_TEXT).decode()
    except UnicodeDecodeError as error:
        raise CheckpointError(f"{path}: expected text that can be read, got {error}; restore it from a copy") from error


def read_bytes(path: Path, limit: int = MAX_TENSORS) -> bytes:
    """Read a file of at most `limit` bytes.

    Raises:
        FileNotFoundError: there is none.
        CheckpointError: it is not a file, too large, or cannot be read.
    """
    try:
        _check_size(path, limit)
        return path.read_bytes()
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:  # a path may have a NUL
        raise CheckpointError(f"{path}: expected a readable file, got {error}; restore it from a copy") from error


def read_json(path: Path) -> object:
    """Read JSON as the standard has it: no NaN, no infinity.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: it is not JSON, or larger or nested more deeply than anything that difflcs writes.
    """
    text = read_text(path)
    try:
        value = json.loads(text, parse_constant=_refuse, parse_float=_finite)
        if not _is_flat(value):
            raise ValueError(f"more than {_MAX_DEPTH} levels")
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: expected JSON, got {error}; restore it from a copy") from error
    return value


def _refuse(constant: str) -> object:
    raise ValueError(f"{constant}, which is no JSON")


def _finite(text: str) -> float:
    if abs(value := float(text)) == float("inf"):
        raise ValueError(f"{short(text)}, which is too large")
    return value


def _is_flat(value: object, levels: int = _MAX_DEPTH) -> bool:
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return levels > 0 and all(_is_flat(part, levels - 1) for part in parts)


def _check_size(path: Path, limit: int) -> None:
    """Refuse anything but a plain file (a pipe would never end), and one that is too large.

    Raises:
        OSError, ValueError: of the system, about the path.
        CheckpointError: see above.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise CheckpointError(f"{path}: expected a plain file, got another kind; restore it from a copy")
    if status.st_size > limit:
        raise CheckpointError(
            f"{path}: expected at most {limit >> 20} MB, got {status.st_size >> 20} MB; difflcs did not write it"
        )


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Let no other process work in a directory for as long as this lasts.

    The operating system holds the lock: it ends with this process, however that dies.

    Raises:
        InUseError: another process, or another part of this one, works in it.
        MissingDependencyError: filelock, of the extra `rl`, is not installed.
        OSError: the lock cannot be written.
    """
    try:
        import filelock
    except ImportError as error:
        raise MissingDependencyError('expected package filelock, got none; run: pip install "difflcs[rl]"') from error
    path = directory / LOCK
    lock = filelock.FileLock(path)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        raise InUseError(
            f"{directory}: expected a run that no process works on, got one that is in use; wait until that process "
            f"ends, or stop it, and try again, or choose another --out"
        ) from None
    mine = path.stat()
    try:
        yield
    finally:
        with suppress(OSError):
            if os.path.samestat(path.stat(), mine):  # not if the directory was moved and there is a new one
                path.unlink()  # before the release: who has opened it already sees that it is gone, and tries again
        lock.release()


def save_record(directory: Path, kind: str, config: Mapping[str, object], tensors: Mapping[str, Tensor]) -> None:
    """Write `model.safetensors` and `config.json` into a directory, each atomically.

    The tensor file carries a hash of its values (safetensors alone does not notice flipped bits) and of the
    description. A crash between the two writes leaves files that fit each other whenever only the values have changed.
    """
    from safetensors.torch import save

    values: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        value = tensor.detach().cpu().contiguous()
        # safetensors refuses memory that two names share, as tied parameters do.
        tied = any(value.untyped_storage().data_ptr() == v.untyped_storage().data_ptr() for v in values.values())
        values[name] = value.clone() if tied and value.numel() else value
    header = {"format": _FORMAT, "kind": kind, "config": dict(config)}
    write_atomically(directory / "model.safetensors", save(values, metadata={"sha256": digest(header, values)}))
    write_json(directory / "config.json", header)


def digest(header: Mapping[str, object], tensors: Mapping[str, Tensor]) -> str:
    """Compute the SHA-256 of a record: its description and the names, shapes, types and values of its tensors."""
    total = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        total.update(f"{name} {tuple(tensors[name].shape)} {tensors[name].dtype}".encode())
        whole = tensors[name].clone(memory_format=torch.contiguous_format)  # one element may have a stride of 0
        total.update(whole.view(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def load_record(directory: Path, kind: str) -> tuple[dict[str, object], dict[str, Tensor]]:
    """Read and check a record that `save_record` wrote.

    Raises:
        CheckpointError: missing, corrupt, too large, of another kind, or of a newer format.
    """
    remedy = "expected a directory with config.json and model.safetensors written by difflcs"
    try:
        header = read_json(directory / "config.json")
        metadata, tensors = _read_tensors(directory / "model.safetensors")
    except FileNotFoundError as error:
        raise CheckpointError(f"{directory}: a file is missing ({error}); {remedy}") from error
    except CheckpointError as error:
        raise CheckpointError(f"{directory}: corrupt or not a checkpoint ({error.args[0]}); {remedy}") from error
    if not isinstance(header, dict) or header.get("kind") != kind or not isinstance(header.get("config"), dict):
        got = header.get("kind") if isinstance(header, dict) else type(header).__name__
        raise CheckpointError(f"{directory}: expected a record of kind {kind!r}, got {short(got)}; use its own loader")
    if header.get("format") != _FORMAT:
        got = short(header.get("format"))
        raise CheckpointError(f"{directory}: expected format {_FORMAT}, got {got}; update difflcs or save it again")
    if metadata.get("sha256") != digest(header, tensors):
        raise CheckpointError(
            f"{directory}: config.json and model.safetensors do not match their checksum; copy or save them again"
        )
    return header["config"], tensors


def _read_tensors(path: Path) -> tuple[Mapping[str, str], dict[str, Tensor]]:
    from safetensors import safe_open

    try:
        _check_size(path, MAX_TENSORS)
        with safe_open(path, "pt") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}
    except (FileNotFoundError, CheckpointError):
        raise
    except Exception as error:  # the format has many ways to be wrong, and dtypes that torch does not know
        raise CheckpointError(f"{path}: expected tensors, got {type(error).__name__}: {error}") from error


def check_tensors(
    source: object, what: str, got: Mapping[str, Tensor], wanted: Mapping[str, tuple[tuple[int, ...], torch.dtype]]
) -> None:
    """Check tensors of a file against the expected shapes and dtypes, before a model is built.

    Args:
        source: their file or directory, for the message.
        what: name of the object that they belong to, for the message.
        got: name → tensor.
        wanted: name → shape and dtype.

    Raises:
        CheckpointError: another name, shape or dtype, or NaN or infinity.
    """
    actual = {name: (tuple(value.shape), value.dtype) for name, value in got.items()}
    if different := sorted(k for k in {*actual, *wanted} if actual.get(k) != wanted.get(k)):
        name = different[0]
        raise CheckpointError(
            f"{source}: expected {what} of the sizes in its configuration, got others in {short(different)}: {name} is "
            f"{actual.get(name)} instead of {wanted.get(name)}; the file is foreign or corrupt"
        )
    check_finite(source, got)


def load_module(source: object, what: str, tensors: Mapping[str, Tensor], make: Callable[[], M]) -> M:
    """Make a module and load it; sizes are compared before anything of these sizes is made, see `check_tensors`."""
    try:
        with torch.device("meta"):
            wanted = {name: (tuple(value.shape), value.dtype) for name, value in make().state_dict().items()}
    except RuntimeError as error:
        raise CheckpointError(f"{source}: expected sizes that {what} can have, got others: {error}") from error
    check_tensors(source, what, tensors, wanted)
    with torch.random.fork_rng(devices=[]):  # for initial values, which are replaced
        module = make()
    module.load_state_dict(dict(tensors))
    return module


def check_finite(source: object, tensors: Mapping[str, Tensor]) -> None:
    """Refuse NaN and infinity.

    Raises:
        CheckpointError: a tensor holds such a value.
    """
    bad = sorted(name for name, value in tensors.items() if not bool(torch.isfinite(value).all()))
    if bad:
        raise CheckpointError(f"{source}: expected finite numbers, got NaN or infinity in {short(bad)}; save it again")


def short(value: object) -> str:
    """Write a value as text, cut if it gets long."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}…"
