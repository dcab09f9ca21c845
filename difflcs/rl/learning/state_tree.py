"""State of a training as a plain tree: dictionaries of tensors, numbers and texts, as `state_dict()` gives them.

`flatten` splits a tree into tensors by path and JSON, `unflatten` joins them, and `check_state` compares a tree with
that of the object it is for. `restore` loads it, or leaves the object as it was if the object refuses it.

Two names in a tree have a meaning: below "settings" everything must be equal, and below "episodes" the tensors are
data, any number of rows, as many in each.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from difflcs._storage import short
from difflcs.errors import CheckpointError

State = Mapping[str, Any]
"""Name → a tensor, a number, a text, None, or another such mapping."""
SETTINGS, EPISODES, RANDOM = "settings", "episodes", "random"
"""Names with a meaning: everything below must be equal; is rows of data; is a state of a NumPy generator, with integers
of any size."""
_SEPARATOR = "/"
_REMEDY = "was it written with other settings, or by another method?"


class Stateful(Protocol):
    """An object whose state can be saved and restored."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything that changes."""
        ...

    def load_state_dict(self, state: State, /) -> Any:
        """Go on from what `state_dict` gave."""
        ...


def flatten(state: State) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Split a tree in two: path → tensor, and the rest, for JSON."""
    tensors: dict[str, Tensor] = {}
    rest: dict[str, Any] = {}
    for name, value in state.items():
        if isinstance(value, Mapping):
            inner, rest[name] = flatten(value)
            tensors |= {f"{name}{_SEPARATOR}{path}": tensor for path, tensor in inner.items()}
        elif isinstance(value, Tensor):
            tensors[name] = value.detach()
        else:
            rest[name] = value
    return tensors, rest


def unflatten(tensors: Mapping[str, Tensor], rest: State) -> dict[str, Any]:
    """Join what `flatten` has split. A tensor whose path leads nowhere stays at the top, for `check_state`."""
    state = {name: unflatten({}, value) if isinstance(value, Mapping) else value for name, value in rest.items()}
    for path, tensor in tensors.items():
        *folders, name = path.split(_SEPARATOR)
        place: Any = state
        for folder in folders:
            place = place.get(folder) if isinstance(place, dict) else None
        if isinstance(place, dict):
            place[name] = tensor
        else:
            state[path] = tensor
    return state


def copy_state(state: State) -> dict[str, Any]:
    """Copy a tree and its tensors."""
    return {
        name: copy_state(value)
        if isinstance(value, Mapping)
        else value.detach().clone()
        if isinstance(value, Tensor)
        else value
        for name, value in state.items()
    }


def check_state(expected: State, state: object, where: str = "checkpoint") -> None:
    """Compare a tree with that of the object it is for.

    Args:
        expected: the object's `state_dict`.
        state: the tree to check.
        where: its name in the message.

    Raises:
        CheckpointError: other names, another type, shape or dtype, a number that is not finite, or other settings.
    """
    if not isinstance(state, Mapping):
        raise CheckpointError(f"{where}: expected {sorted(expected)}, got {short(state)}; {_REMEDY}")
    if different := sorted(map(str, expected.keys() ^ state.keys())):
        raise CheckpointError(f"{where}: expected {short(sorted(expected))}, got others: {short(different)}; {_REMEDY}")
    for name, value in expected.items():
        _check(value, state[name], f"{where}.{name}")


def _check(expected: Any, value: Any, where: str) -> None:
    name = where.rpartition(".")[2]
    if name == SETTINGS:
        if value != expected:
            raise CheckpointError(f"{where}: expected {short(expected)}, got {short(value)}; {_REMEDY}")
    elif isinstance(expected, Mapping):
        check_state(expected, value, where)
        if name == EPISODES and len({len(rows) for rows in value.values()}) > 1:
            lengths = {key: len(rows) for key, rows in value.items()}
            raise CheckpointError(f"{where}: expected as many of each, got {lengths}; is it damaged?")
    elif isinstance(expected, Tensor):
        data = f".{EPISODES}." in where
        shape = tuple(expected.shape)[data:]
        if not isinstance(value, Tensor) or value.dtype != expected.dtype or tuple(value.shape)[data:] != shape:
            got = f"{tuple(value.shape)} {value.dtype}" if isinstance(value, Tensor) else short(value)
            raise CheckpointError(f"{where}: expected {tuple(expected.shape)} {expected.dtype}, got {got}; {_REMEDY}")
        if data and value.ndim != expected.ndim:
            raise CheckpointError(f"{where}: expected {expected.ndim} dimensions, got {value.ndim}; {_REMEDY}")
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise CheckpointError(f"{where}: expected finite numbers, got NaN or infinity; is it damaged?")
    elif not _is_compatible(expected, value, where):
        raise CheckpointError(
            f"{where}: expected a {type(expected).__name__} such as {short(expected)}, got {short(value)}; {_REMEDY}"
        )


def _is_compatible(expected: Any, value: Any, where: str) -> bool:
    if type(value) is not type(expected):
        return False
    if isinstance(expected, int) and not isinstance(expected, bool):
        return value >= 0 and (value < 2**63 or f".{RANDOM}." in where)
    if isinstance(expected, float):
        return math.isfinite(value)
    return not isinstance(expected, str) or value == expected


def restore(part: Stateful, state: State, where: str = "checkpoint") -> None:
    """Load a state into an object, or leave it as it was.

    Raises:
        CheckpointError: the state is not one of this object.
    """
    current = part.state_dict()
    check_state(current, state, where)
    before = copy_state(current)
    try:
        part.load_state_dict(state)
    except Exception as error:  # numpy and torch refuse values in many ways
        part.load_state_dict(before)
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{where}: its values cannot be used ({error!r}); is it damaged?") from error


class StatefulAdam(torch.optim.AdamW):
    """Adam whose state is its moments by the place of the parameter, at any time; settings are the configuration's."""

    def __init__(self, parameters: Iterable[Tensor], lr: float, weight_decay: float = 0.0, **options: Any):
        super().__init__(parameters, lr, weight_decay=weight_decay, **options)
        for p in self.param_groups[0]["params"]:
            zero = {"exp_avg": torch.zeros_like(p), "exp_avg_sq": torch.zeros_like(p)}
            self.state[p] = {"step": torch.tensor(0.0), **zero}

    def state_dict(self) -> dict[str, Any]:
        """State of the optimiser, without the parameters."""
        return {str(place): dict(tensors) for place, tensors in super().state_dict()["state"].items()}

    def load_state_dict(self, state_dict: State) -> None:
        """Go on from what `state_dict` gave."""
        own = {int(place): copy_state(tensors) for place, tensors in state_dict.items()}
        super().load_state_dict({**super().state_dict(), "state": own})
