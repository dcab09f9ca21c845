"""Bounds of the actions by stage, and linear constraints of states and actions."""

from collections.abc import Collection

import torch
from torch import Tensor

from difflcs._checks import broadcast_batch, check_same_device, check_shape, describe, plain, takes_arrays
from difflcs._differentiation import is_wrapped, runs_eagerly
from difflcs._fields import TensorFields, check_by_stage, check_not_nan, check_stages, register
from difflcs.errors import BoundsError, DTypeError, InvalidInputError

_DIMENSIONS = {"G": 2, "g": 1, "E": 2, "weight": 1}
_EXTRA = {"G": 1, "g": 1, "E": 0, "weight": 1}  # stages beyond H
_HARD = 1e300  # price from which on a row is a hard constraint
# Field → its name in a problem (`difflcs.mpc.MPCProblem`).
_NAMES = {"G": "G_x", "E": "G_u", "g": "g", "weight": "price"}


def check_bounds(u_min: Tensor, u_max: Tensor, strict: bool = False) -> None:
    """Raise if bounds do not broadcast, are on different devices, or cross (`strict`: or touch, or are infinite)."""
    broadcast_batch([("u_min", u_min.shape), ("u_max", u_max.shape)])
    check_same_device([("u_min", u_min), ("u_max", u_max)])
    if is_wrapped(u_min) or is_wrapped(u_max):
        return
    crossed = u_min >= u_max if strict else u_min > u_max
    if bool(crossed.any()):
        index = tuple(torch.nonzero(crossed)[0].tolist())
        low, high = (float(v.detach().expand_as(crossed)[index]) for v in (u_min, u_max))
        raise BoundsError(
            f"u_min: expected u_min {'<' if strict else '<='} u_max, got {low:g} and {high:g} at index {index}; "
            f"swap or widen the bounds"
        )
    if strict and bool((torch.isinf(u_min) | torch.isinf(u_max)).any()):
        raise BoundsError("u_min, u_max: expected finite bounds with a barrier, got infinite ones; pass barrier=0")
    for name, value, wrong in (("u_min", u_min, torch.inf), ("u_max", u_max, -torch.inf)):
        if bool((value == wrong).any()):
            raise BoundsError(f"{name}: expected at least one action that it allows, got {wrong}; change its sign")


def as_bound(name: str, value: object, dims: list[tuple[str, int]], like: Tensor) -> Tensor:
    """Convert a bound or weight to a tensor: a number fills the last of its trailing dimensions `dims`."""
    number = plain(value)
    if isinstance(number, bool):
        raise DTypeError(f"{name}: expected a torch.Tensor, got {describe(value)}; or give a number, as a float")
    if isinstance(number, int | float):
        value, dims = torch.full((dims[-1][1],), float(number), dtype=torch.float64, device=like.device), dims[-1:]
    return check_not_nan(name, value, dims)


class StageBounds(TensorFields):
    """Bounds of the actions that change over the horizon.

    Args:
        u_min: (..., H, n_u) lower bounds by stage; a number for all of them; None or −∞ for none.
        u_max: (..., H, n_u) upper bounds, likewise. Either is learned if it is an nn.Parameter.
        by_stage: names of the bounds that change, "u_min", "u_max"; a tensor that does not is (..., n_u).

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: a bound does not fit the other.
        BoundsError: they cross.
        InvalidInputError: neither is a tensor by stage.
    """

    u_min: Tensor
    u_max: Tensor

    @runs_eagerly
    @takes_arrays
    def __init__(
        self,
        u_min: Tensor | float | None = None,
        u_max: Tensor | float | None = None,
        *,
        by_stage: Collection[str] = ("u_min", "u_max"),
    ):
        super().__init__()
        bounds = {"u_min": plain(u_min), "u_max": plain(u_max)}
        tensors = {name: value for name, value in bounds.items() if isinstance(value, Tensor)}
        self.by_stage = check_by_stage(by_stage, ("u_min", "u_max"), tensors)
        for name, value in tensors.items():
            check_not_nan(name, value)
        self.horizon = check_stages({name: (tensors[name], 1, 0) for name in sorted(self.by_stage)})
        like = tensors[min(self.by_stage)]
        self.n_u = like.shape[-1]
        for name, value, none in (("u_min", u_min, -torch.inf), ("u_max", u_max, torch.inf)):
            dims = [("H", self.horizon)] * (name in self.by_stage) + [("n_u", self.n_u)]
            register(self, name, as_bound(name, none if value is None else value, dims, like), persistent=False)
        check_bounds(*self.by_steps())

    def by_steps(self) -> tuple[Tensor, Tensor]:
        """Return the lower and upper bounds, which broadcast with (..., H, n_u)."""
        low, high = (v if k in self.by_stage else v.unsqueeze(-2) for k, v in self.tensors().items())
        return low, high

    def tensors(self) -> dict[str, Tensor]:
        """Return name → tensor."""
        return self._held(("u_min", "u_max"))


class _Constraints(TensorFields):
    """Base of the constraints, constant or by stage."""

    G: Tensor
    g: Tensor
    E: Tensor | None
    weight: Tensor | None

    @runs_eagerly
    def _fill(self, G: Tensor, g: Tensor, E: Tensor | None, weight: Tensor | float | None) -> None:
        each = "pass one row per constraint"
        check_shape("G", G, "... n_c n_x", remedy=each)
        self.n_c, self.n_x = G.shape[-2:]
        rows = ("n_c", self.n_c)
        fields = {"G": G, "g": check_not_nan("g", g, [rows])}
        self.n_u = None
        if E is not None:
            check_shape("E", E, "... n_c n_u", {"n_c": self.n_c}, each)
            fields["E"], self.n_u = E, E.shape[-1]
        if weight is not None:
            fields["weight"] = as_bound("weight", weight, [rows], G)
        check_same_device(fields.items())
        if self.by_stage:
            self.horizon = check_stages(
                {k: (fields[k], _DIMENSIONS[k], _EXTRA[k]) for k in _DIMENSIONS if k in self.by_stage}
            )
        check_constraints(fields["g"], fields.get("weight"))
        for name in _DIMENSIONS:
            register(self, name, fields.get(name))

    def tensors(self) -> dict[str, Tensor]:
        """Return name in a problem → tensor: G_x, g, price, and G_u if the actions count."""
        fields = {_NAMES[name]: value for name, value in self._held(_NAMES).items()}
        if fields["G_u"] is None:
            del fields["G_u"]
        if (price := fields["price"]) is None:
            fields["price"] = fields["g"].new_full((self.n_c,), torch.inf)
        else:
            fields["price"] = torch.where(price >= _HARD, torch.inf, price)
        return fields

    @property
    def staged(self) -> frozenset[str]:
        """Names in a problem of the fields by stage."""
        return frozenset(_NAMES[name] for name in self.by_stage)


def check_constraints(g: Tensor, weight: Tensor | None) -> None:
    """Raise if limits cannot be met or prices are not positive."""
    if not is_wrapped(g) and bool((g == -torch.inf).any()):
        raise InvalidInputError("g: expected limits above −∞, got −∞; +∞ says that there is no constraint")
    if weight is not None and not is_wrapped(weight):
        check_prices("weight", weight)


def check_prices(name: str, prices: Tensor) -> None:
    """Raise if prices of violations are not positive."""
    if not bool((prices > 0).all()):
        raise InvalidInputError(
            f"{name}: expected a positive price of a violation, or infinity for a hard constraint, got "
            f"{float(prices.detach().min()):g}; leave out constraints that do not count"
        )


class LinearConstraints(_Constraints):
    """Linear constraints G x_k + E u_k ≤ g at every stage k = 0 … H; at stage H, without an action, G x_H ≤ g.

    Hard, or soft with a price: violations then cost `weight` per unit, and a price above the constraint's multiplier
    keeps it as if it were hard. Every field is shared by the batch or has leading batch dimensions; it is learned if it
    requires grad (an nn.Parameter is registered as one). If the first state alone violates a hard
    constraint, the problem is INFEASIBLE.

    Args:
        G: (..., n_c, n_x).
        g: (..., n_c); +∞ where a row does not count.
        E: (..., n_c, n_u), zero if None.
        weight: (..., n_c) or a number > 0: price per unit of violation [cost per unit of g]; ∞, from 1e300 on, or
            None: hard.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: a field does not fit the others.
        InvalidInputError: g is −∞, or a weight is not positive.
    """

    @takes_arrays
    def __init__(self, G: Tensor, g: Tensor, E: Tensor | None = None, weight: Tensor | float | None = None):
        super().__init__()
        self._fill(G, g, E, weight)


class ConstraintSequence(_Constraints):
    """Linear constraints that change over the horizon: G_k x_k + E_k u_k ≤ g_k at the stages k = 0 … H.

    As `LinearConstraints`, with the dimension of the stages before the others: H+1 stages, and H for E. A
    constraint of the final state alone has g = +∞ before it.

    Args:
        G: (..., H+1, n_c, n_x).
        g: (..., H+1, n_c); +∞ where a row does not count.
        E: (..., H, n_c, n_u), zero if None.
        weight: (..., H+1, n_c), or one number > 0 for all; ∞ or None: hard.
        by_stage: names of the fields that change; the others are as in `LinearConstraints`. Half-planes that move keep
            their G: `ConstraintSequence(G, g, by_stage=("g",))`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: a field does not fit the others.
        InvalidInputError: g is −∞, or a weight is not positive; no field is by stage.
    """

    @takes_arrays
    def __init__(
        self,
        G: Tensor,
        g: Tensor,
        E: Tensor | None = None,
        weight: Tensor | float | None = None,
        *,
        by_stage: Collection[str] = tuple(_DIMENSIONS),
    ):
        super().__init__()
        values = {"G": G, "g": g, "E": E, "weight": weight}
        for name in ("G", "g"):
            check_not_nan(name, values[name])
        names = [name for name, value in values.items() if isinstance(plain(value), Tensor)]
        self.by_stage = check_by_stage(by_stage, _DIMENSIONS, names)
        self._fill(G, g, E, weight)
