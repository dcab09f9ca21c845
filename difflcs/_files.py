"""Files: atomic writes, and records of tensors (safetensors) with a JSON description. Never pickle."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from difflcs.errors import CheckpointError

_FORMAT = 1


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
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write_json(path: Path, value: object) -> None:
    """Write JSON atomically."""
    write_atomically(path, (json.dumps(value, indent=2, sort_keys=True) + "\n").encode())


def save_record(directory: Path, kind: str, config: Mapping[str, object], tensors: Mapping[str, Tensor]) -> None:
    """Write `model.safetensors` and `config.json` into a directory, each atomically.

    The tensor file carries a hash of its values (safetensors alone does not notice flipped bits) and of the
    description. A crash between the two writes leaves files that fit each other whenever only the values have changed.
    """
    from safetensors.torch import save

    values = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    header = {"format": _FORMAT, "kind": kind, "config": dict(config)}
    write_atomically(directory / "model.safetensors", save(values, metadata={"sha256": _hash(header, values)}))
    write_json(directory / "config.json", header)


def _hash(header: Mapping[str, object], tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        digest.update(f"{name} {tuple(tensors[name].shape)} {tensors[name].dtype}".encode())
        digest.update(tensors[name].contiguous().view(-1).numpy().tobytes())
    return digest.hexdigest()


def load_record(directory: Path, kind: str) -> tuple[dict[str, object], dict[str, Tensor]]:
    """Read and check what `save_record` wrote.

    Raises:
        CheckpointError: missing, corrupt, of another kind, or of a newer format.
    """
    from safetensors import SafetensorError, safe_open

    remedy = "expected a directory with config.json and model.safetensors written by difflcs"
    try:
        header = json.loads((directory / "config.json").read_text())
        with safe_open(directory / "model.safetensors", "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except FileNotFoundError as error:
        raise CheckpointError(f"{directory}: a file is missing ({error}); {remedy}") from error
    except (OSError, SafetensorError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise CheckpointError(f"{directory}: corrupt or not a checkpoint ({error}); {remedy}") from error
    if not isinstance(header, dict) or header.get("kind") != kind or not isinstance(header.get("config"), dict):
        got = header.get("kind") if isinstance(header, dict) else type(header).__name__
        raise CheckpointError(f"{directory}: expected a record of kind {kind!r}, got {got!r}; {remedy}")
    if header.get("format") != _FORMAT:
        raise CheckpointError(
            f"{directory}: expected format {_FORMAT}, got {header.get('format')!r}; update difflcs or save it again"
        )
    if metadata.get("sha256") != _hash(header, tensors):
        raise CheckpointError(
            f"{directory}: config.json and model.safetensors do not match their checksum; copy or save them again"
        )
    return header["config"], tensors
