"""State of a training as a plain tree: dictionaries of tensors, numbers and texts, as `state_dict()` gives them.

One writer flattens a tree into tensors by path and JSON, one reader puts it together again, and one check compares a
tree with that of the object it is for. What the check cannot know is tried: a part that refuses a state keeps its own.

Two names in a tree have a meaning: below "settings" everything must be equal, and below "episodes" the tensors are
data, any number of rows, as many in each.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from difflcs._storage import short
from difflcs.errors import CheckpointError

State = Mapping[str, Any]
"""Name → a tensor, a number, a text, None, or another such mapping."""
SETTINGS, EPISODES, RANDOM = "settings", "episodes", "random"
"""Below these everything must be equal; are rows of data; are states of NumPy's generators, with integers of any size.
"""
_SEPARATOR = "/"
_REMEDY = "was it written with other settings, or by another method?"


class Stateful(Protocol):
    """What can be saved and go on."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        ...

    def load_state_dict(self, state: State, /) -> Any:
        """Go on from what `state_dict` gave."""
        ...


def flatten(state: State) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """A tree in two: path → tensor, and the rest, for JSON."""
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
    """The tree that `flatten` took apart. A tensor whose path leads nowhere stays at the top, for `check_state`."""
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
    """The same tree with tensors of its own."""
    return {
        name: copy_state(value)
        if isinstance(value, Mapping)
        else value.detach().clone()
        if isinstance(value, Tensor)
        else value
        for name, value in state.items()
    }


def check_state(own: State, found: object, where: str = "checkpoint") -> None:
    """Compare a tree with that of the object it is for.

    Args:
        own: what the object's `state_dict` gives.
        found: what was read.
        where: what to call it in the message.

    Raises:
        CheckpointError: other names, another type, shape or dtype, a number that is not finite, or other settings.
    """
    if not isinstance(found, Mapping):
        raise CheckpointError(f"{where}: expected {sorted(own)}, got {short(found)}; {_REMEDY}")
    if different := sorted(map(str, own.keys() ^ found.keys())):
        raise CheckpointError(f"{where}: expected {short(sorted(own))}, got others: {short(different)}; {_REMEDY}")
    for name, value in own.items():
        _check(value, found[name], f"{where}.{name}")


def _check(own: Any, found: Any, where: str) -> None:
    name = where.rpartition(".")[2]
    if name == SETTINGS:
        if found != own:
            raise CheckpointError(f"{where}: expected {short(own)}, got {short(found)}; {_REMEDY}")
    elif isinstance(own, Mapping):
        check_state(own, found, where)
        if name == EPISODES and len({len(value) for value in found.values()}) > 1:
            lengths = {key: len(value) for key, value in found.items()}
            raise CheckpointError(f"{where}: expected as many of each, got {lengths}; is it damaged?")
    elif isinstance(own, Tensor):
        data = f".{EPISODES}." in where
        shape = tuple(own.shape)[data:]
        if not isinstance(found, Tensor) or found.dtype != own.dtype or tuple(found.shape)[data:] != shape:
            got = f"{tuple(found.shape)} {found.dtype}" if isinstance(found, Tensor) else short(found)
            raise CheckpointError(f"{where}: expected {tuple(own.shape)} {own.dtype}, got {got}; {_REMEDY}")
        if data and found.ndim != own.ndim:
            raise CheckpointError(f"{where}: expected {own.ndim} dimensions, got {found.ndim}; {_REMEDY}")
        if found.is_floating_point() and not bool(torch.isfinite(found).all()):
            raise CheckpointError(f"{where}: expected finite numbers, got NaN or infinity; is it damaged?")
    elif not _alike(own, found, where):
        raise CheckpointError(
            f"{where}: expected a {type(own).__name__} such as {short(own)}, got {short(found)}; {_REMEDY}"
        )


def _alike(own: Any, found: Any, where: str) -> bool:
    if type(found) is not type(own):
        return False
    if isinstance(own, int) and not isinstance(own, bool):
        return found >= 0 and (found < 2**63 or f".{RANDOM}." in where)
    if isinstance(own, float):
        return math.isfinite(found)
    return not isinstance(own, str) or found == own


def restore(part: Stateful, state: State, where: str = "checkpoint") -> None:
    """Let an object go on from a state, or leave it as it was.

    Raises:
        CheckpointError: the state is not one of this object.
    """
    own = part.state_dict()
    check_state(own, state, where)
    before = copy_state(own)
    try:
        part.load_state_dict(state)
    except Exception as error:  # numpy and torch refuse values in many ways
        part.load_state_dict(before)
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{where}: its values cannot be used ({error!r}); is it damaged?") from error


def moments(optimiser: torch.optim.Optimizer) -> dict[str, Any]:
    """An optimiser's own tensors by the place of the parameter; its settings come from the configuration."""
    return {str(place): dict(own) for place, own in optimiser.state_dict()["state"].items()}


def load_moments(optimiser: torch.optim.Optimizer, state: State) -> None:
    """Go on from what `moments` gave."""
    whole = optimiser.state_dict()
    optimiser.load_state_dict({**whole, "state": {int(place): copy_state(own) for place, own in state.items()}})


def initialise_moments(optimiser: torch.optim.Optimizer) -> None:
    """Give every parameter of an Adam its moments now, so that its state has the same names at any time."""
    for group in optimiser.param_groups:
        for p in group["params"]:
            zero = {"exp_avg": torch.zeros_like(p), "exp_avg_sq": torch.zeros_like(p)}
            optimiser.state[p] = {"step": torch.tensor(0.0), **zero}
