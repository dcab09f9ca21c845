"""Settings: frozen dataclasses whose fields declare their bounds, and the groups of them that methods share.

One validator reads types and bounds; one reader rebuilds a configuration from JSON. A group that only one module uses
is defined there.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from types import UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from difflcs._checks import describe, make_plain
from difflcs._storage import short
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError

MOST_ENVS, MOST_WIDTH, MOST_NETWORKS = 10_000, 10_000, 1_000
"""Environments side by side, width of a network, networks of an ensemble: more is a slip or a foreign file."""
_LARGEST = 2**63 - 1
"""The largest integer that torch takes."""


def bounded(
    default: Any,
    *,
    minimum: float | None = None,
    above: float | None = None,
    maximum: float | None = None,
    below: float | None = None,
) -> Any:
    """A field of a dataclass with bounds, for each number in it where it is a tuple; None stays allowed if declared.

    Args:
        default: value of the field if none is passed.
        minimum: smallest value.
        above: number that the value must exceed, instead of a minimum.
        maximum: largest value.
        below: number that the value must stay below, instead of a maximum.
    """
    return field(default=default, metadata={"minimum": minimum, "above": above, "maximum": maximum, "below": below})


def group(kind: type[Any], /, **values: Any) -> Any:
    """A field that holds a group of settings, with other defaults where `values` has them."""
    return field(default_factory=functools.partial(kind, **values))


@dataclass(frozen=True)
class Settings:
    """Base of all groups of settings: every instance has values of the declared types and within their bounds.

    Raises:
        DTypeError: a value of another type.
        InvalidInputError: a value outside its bounds.
    """

    def __post_init__(self) -> None:
        make_plain(self)
        hints = get_type_hints(type(self))
        for f in fields(self):
            _check(f.name, getattr(self, f.name), hints[f.name], f.metadata)


def _check(name: str, value: object, hint: Any, bounds: Mapping[str, float | None]) -> None:
    if not _has_type(value, hint):
        raise DTypeError(f"{name}: expected {_type_name(hint)}, got {describe(value)}; convert it")
    for number in value if isinstance(value, tuple | list) else (value,):
        if isinstance(number, int | float) and not isinstance(number, bool):
            _check_bounds(name, number, bounds)


def _check_bounds(name: str, value: float, bounds: Mapping[str, float | None]) -> None:
    low, above, high, below = (bounds.get(key) for key in ("minimum", "above", "maximum", "below"))
    if isinstance(value, int) and high is None and below is None:
        high = _LARGEST
    ok = (low is None or value >= low) and (above is None or value > above)
    ok &= (high is None or value <= high) and (below is None or value < below)
    if ok and (isinstance(value, int) or math.isfinite(value)):
        return
    least = f"{low:g} <= " if low is not None else f"{above:g} < " if above is not None else ""
    most = f" <= {high:g}" if high is not None else f" < {below:g}" if below is not None else ""
    got = describe(value).partition(" ")[2]
    raise InvalidInputError(f"{name}: expected a finite {least}{name}{most}, got {got}; change it")


def _type_name(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) else str(hint).replace("typing.", "")


def _has_type(value: object, hint: Any) -> bool:
    """Return True if a value has the type that a field declares. Lists pass for tuples, as in JSON; ints for floats."""
    parts, origin = get_args(hint), get_origin(hint)
    if origin is Literal:
        return value in parts
    if origin in (Union, UnionType):
        return any(_has_type(value, part) for part in parts)
    if origin is tuple:
        inner = parts[:1] * len(value) if isinstance(value, list | tuple) and parts[-1] is Ellipsis else parts
        return isinstance(value, list | tuple) and len(value) == len(inner) and all(map(_has_type, value, inner))
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, hint) and isinstance(value, bool) == (hint is bool)


Kind = TypeVar("Kind")


def from_json(values: Mapping[str, object], kind: type[Kind]) -> Kind:
    """Rebuild a dataclass of settings from what JSON holds of it.

    Raises:
        CheckpointError: other fields than those of `kind`, or values that they cannot have.
    """
    hints = get_type_hints(kind)
    wanted = {f.name: hints[f.name] for f in fields(cast(Any, kind))}
    if set(values) != set(wanted):
        raise CheckpointError(
            f"{kind.__name__}: expected the fields {sorted(wanted)}, got {short(sorted(values))}; "
            f"use the version of difflcs that wrote it"
        )
    plain: dict[str, Any] = {}
    for name, hint in wanted.items():
        value = values[name]
        if not _has_type(value, dict if is_dataclass(hint) else hint):
            raise CheckpointError(
                f"{kind.__name__}: expected {name} of the type {_type_name(hint)}, got {short(value)}; "
                f"restore config.json from a copy"
            )
        plain[name] = tuple(value) if isinstance(value, list) else value
        if is_dataclass(hint):
            plain[name] = from_json(plain[name], cast("type", hint))
    try:
        return kind(**plain)
    except InvalidInputError as error:
        raise CheckpointError(f"{kind.__name__}: its values cannot be used: {error}") from error


# --- groups that several parts share ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Adam(Settings):
    """The optimiser Adam."""

    learning_rate: float = bounded(1e-3, above=0)
    """Step size at the start."""
    betas: tuple[float, float] = bounded((0.9, 0.999), minimum=0, below=1)
    """Averaging factors of the gradient and of its square."""


@dataclass(frozen=True)
class Rollouts(Settings):
    """Numbers of episodes that are collected at a time, in lockstep."""

    first: int = bounded(5, minimum=1, maximum=MOST_ENVS)
    """Episodes of uniformly random actions before the first training."""
    each: int = bounded(5, minimum=1, maximum=MOST_ENVS)
    """Episodes of each later iteration."""


@dataclass(frozen=True)
class Epochs(Settings):
    """Passes over the data of a fit."""

    first: int = bounded(100, minimum=1)
    """Passes over the data of the first training."""
    each: int = bounded(10, minimum=1)
    """Passes in each later iteration."""
    minibatch: int = bounded(128, minimum=1)
    """Samples per step."""


@dataclass(frozen=True)
class ViolationLoss(Settings):
    """The violation-based loss (Eq. 2 of the paper), see `difflcs.violation_loss`."""

    gamma: float | Literal["auto"] = bounded(0.05, above=0)
    """Gamma of the loss; auto: as large as F allows, for models whose F has another size."""
    xi: float = bounded(0.02, above=0)
    """Xi of the loss."""
