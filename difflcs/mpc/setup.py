"""Inputs of the MPC: the settings of a layer, the arguments of a call, and the problem that they make."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from difflcs._checks import (
    broadcast_batch,
    check_finite,
    check_kind,
    check_positive_definite,
    check_same_device,
    check_shape,
    check_tensor,
    describe,
)
from difflcs._differentiation import is_wrapped
from difflcs._fields import check_not_nan
from difflcs.constraints import ConstraintSequence, LinearConstraints, StageBounds, as_bound, check_bounds
from difflcs.cost import CostModule, CostSequence, GoalCost, QuadraticCost, cost_at
from difflcs.errors import BoundsError, DTypeError, ShapeError
from difflcs.mpc.backends.base import Backend
from difflcs.mpc.problem import INPUTS, MAY_BE_INFINITE
from difflcs.mpc.solution import MPCSolution, Primal
from difflcs.records import SYSTEM, LCSModule, LCSParams, LCSSequence, sequence_along, system_at

RANKS = {**{name: len(dims) for name, dims in INPUTS.items()}, "constant": 0}
"""Number of dimensions of each input of a call behind those of the batch and of the stages."""

GUESS = {"x": (1, "n_x"), "u": (0, "n_u"), "lam": (0, "n_lam"), "mu": (1, "n_c")}
"""Parts of a guess: how many stages beyond H each has, and its size."""

SYMMETRIC = ("Q", "R", "Q_final")
_COST = ("Q", "R", "S", "Q_final", "q", "r", "q_final", "constant")

Bound = float | Tensor
System = LCSModule | LCSParams | LCSSequence
Cost = GoalCost | QuadraticCost | CostSequence | CostModule
Constraints = LinearConstraints | ConstraintSequence

PLAIN_COSTS = (GoalCost, QuadraticCost, CostSequence)
"""Costs whose numbers are known before a call; any other is a `CostModule`."""


class Setup(NamedTuple):
    """Settings of a layer as they are now; the names are those of `LCSMPCLayer`.

    Attributes:
        began: when the layer was called, by `time.perf_counter`: a time limit of its backend counts from then.
        limits: a subclass's function from a system to the bounds of the actions; None: u_min and u_max within the
            action support of the system.
    """

    lcs: System
    cost: Cost
    horizon: int
    relaxation: float
    barrier: float
    backend: Backend
    began: float
    u_min: Tensor
    u_max: Tensor
    bounds: StageBounds | None
    constraints: Constraints | None
    limits: Callable[[System], tuple[Tensor, Tensor]] | None

    def check(self) -> None:
        """Refuse parts that do not fit each other, as far as that does not depend on a call."""
        inputs = Inputs(self.horizon, sizes={name: getattr(self.lcs, name) for name in ("n_x", "n_u", "n_lam")})
        if isinstance(self.lcs, LCSSequence):
            inputs.check_horizon("lcs", self.lcs.horizon)
        if isinstance(self.cost, PLAIN_COSTS):  # a module is asked at a call
            inputs.check_sizes("cost", n_x=self.cost.n_x, n_u=self.cost.n_u)
        if isinstance(self.cost, CostSequence):
            inputs.check_horizon("cost", self.cost.horizon)
        inputs.add_constraints(self.constraints)
        if self.bounds is not None:
            inputs.add_bounds(self.bounds)
        check_bounds(*self.action_bounds(self.lcs), strict=self.barrier > 0)

    def action_bounds(self, system: System, x0: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the bounds of the actions for calls that pass none, see `LCSMPCLayer.limits`."""
        if self.limits is not None:
            return self.limits(system)
        if self.bounds is not None:
            return self.bounds.by_steps()
        u_min, u_max = within_support(self.u_min, self.u_max, system)
        # Matrices of a call are mostly those of the layer's module, whose actuators they do not know.
        reach = getattr(system, "action_bounds", getattr(self.lcs, "action_bounds", None))
        if x0 is None or reach is None:
            return u_min, u_max
        low, high = (v.to(u_min) for v in reach(x0))
        return u_min.clamp(low, high), u_max.clamp(low, high)


class Call(NamedTuple):
    """Arguments of a call of a layer; the names are those of `LCSMPCLayer.forward`.

    Attributes:
        along: the plan along which modules return system and cost; None: at x0.
    """

    x0: Tensor
    goal: Tensor | None = None
    reference: Tensor | None = None
    guess: MPCSolution | Primal | None = None
    u_min: Bound | None = None
    u_max: Bound | None = None
    bounds: StageBounds | None = None
    lcs: System | None = None
    cost: Cost | None = None
    constraints: Constraints | None = None
    context: Tensor | None = None
    along: Primal | None = None


def is_local(cost: Cost) -> bool:
    """Tell whether a cost is a module to ask at each state of a plan, see `CostModule`."""
    return not isinstance(cost, PLAIN_COSTS) and getattr(cost, "local", False) is True


def cost_along(
    cost: CostModule, along: Primal, x0: Tensor, goal: Tensor | None, context: Tensor | None
) -> QuadraticCost | CostSequence:
    """Ask a cost module at each state of a plan: stages have the cost of their states, the end that of the last.

    Raises:
        DTypeError: the module returns another cost than a `QuadraticCost`.
    """
    horizon = along.u.shape[-2]
    x = along.x.detach()
    x = torch.cat([x0.expand(x[..., 0, :].shape).unsqueeze(-2), x[..., 1:, :]], -2)
    found = cost_at(cost, x, *(None if value is None else value.unsqueeze(-2) for value in (goal, context)))
    remedy = f"return one from {type(cost).__name__}.at along a plan, or set its attribute local = False"
    found = check_kind("cost", found, QuadraticCost, remedy)
    fields, by_stage = {}, []
    for name, value in found.tensors().items():
        dim = value.ndim - 1 - RANKS.get(name, 0)  # of the states
        if dim < 0 or value.shape[dim] == 1:
            fields[name] = value if dim < 0 else value.squeeze(dim)
        elif name in ("Q_final", "q_final", "constant"):
            fields[name] = value.select(dim, horizon)
        else:
            fields[name] = value.narrow(dim, 0, horizon)
            by_stage.append(name)
    if (stage := fields.pop("constant_stage", None)) is not None:
        fields["constant"] = fields["constant"] + (stage.sum(-1) if "constant_stage" in by_stage else horizon * stage)
    by_stage = [name for name in by_stage if name != "constant_stage"]
    return CostSequence(**fields, by_stage=by_stage, check=False) if by_stage else QuadraticCost(**fields, check=False)


def gather(setup: Setup, call: Call) -> Inputs:
    """Gather the tensors that a call plans with.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """
    system = setup.lcs if call.lcs is None else check_system(call.lcs)
    check_tensor("x0", call.x0, [("n_x", system.n_x)])
    inputs = Inputs(setup.horizon)
    cost = setup.cost if call.cost is None else check_cost(call.cost)
    check_context(call.context, system, cost)
    inputs.add_system(system, call.x0, call.context, call.along)
    inputs.add_cost(cost, call.x0, call.goal, call.reference, call.context, call.along)
    inputs.take_bounds(setup, call, system, call.x0)
    inputs.add_constraints(setup.constraints if call.constraints is None else check_constraints(call.constraints))
    inputs.tensors["x0"] = call.x0
    return inputs


def within_support(u_min: Tensor, u_max: Tensor, system: System) -> tuple[Tensor, Tensor]:
    """Clip the bounds of the actions to the action support of an `LCSModel` that has one.

    Raises:
        BoundsError: the support lies outside of the bounds.
    """
    support = getattr(system, "action_support", None)
    if support is None:
        return u_min, u_max
    low, high = check_shape("action_support", support, "2 n_u", {"n_u": system.n_u}).to(u_min).unbind()
    limits = u_min.clamp_min(low), u_max.clamp_max(high)
    if not is_wrapped(limits[0]) and bool((limits[0] > limits[1]).any()):
        raise BoundsError(
            f"u_min, u_max: expected bounds that meet the actions {low.tolist()} to {high.tolist()} that the model "
            f"was fitted to, got {u_min.tolist()} to {u_max.tolist()}; set its action_support to None"
        )
    return limits


def check_system(lcs: object) -> System:
    """Refuse anything but a system or a module that has one."""
    if not isinstance(lcs, LCSParams | LCSSequence) and not isinstance(lcs, LCSModule):
        raise DTypeError(
            f"lcs: expected LCSModel, LCSParams, LCSSequence or another LCSModule, got {describe(lcs)}; a module "
            f"needs n_x, n_u, n_lam and params(x, context); LCSSequence.stack takes a list of systems, one per stage"
        )
    return lcs


def check_cost(cost: object) -> Cost:
    """Refuse anything but a cost."""
    if not isinstance(cost, PLAIN_COSTS) and not callable(getattr(cost, "at", None)):
        raise DTypeError(
            f"cost: expected GoalCost, QuadraticCost, CostSequence or another CostModule, got {describe(cost)}; build "
            f"one from your weights, or a module with at(x, goal, context)"
        )
    return cost  # pyright: ignore[reportReturnType]


def check_context(context: Tensor | None, system: System, cost: Cost) -> None:
    """Refuse a context that nothing would use."""
    if context is None:
        return
    if isinstance(system, LCSParams | LCSSequence) and isinstance(cost, PLAIN_COSTS):
        raise ShapeError(
            f"context: expected none with {type(system).__name__}, got {describe(context)}; pass lcs=a module whose "
            f"params(x, context) uses it"
        )
    check_tensor("context", context)


def check_constraints(constraints: object) -> Constraints:
    """Refuse anything but constraints."""
    return check_kind("constraints", constraints, (LinearConstraints, ConstraintSequence), "build one from G and g")


def check_stage_bounds(bounds: object) -> StageBounds:
    """Refuse anything but `StageBounds`."""
    return check_kind("bounds", bounds, StageBounds, "pass constant bounds as u_min and u_max")


def check_alone(**plain: object) -> None:
    """Refuse bounds that are passed beside `StageBounds`."""
    for name, value in plain.items():
        if value is not None:
            raise ShapeError(f"{name}: expected none with bounds, got {describe(value)}; put it into the StageBounds")


@dataclass
class Inputs:
    """Tensors by the names of `MPCProblem`, with the cost's constant.

    Attributes:
        horizon: stages of the plan.
        tensors: name → tensor from the caller, or made from a goal by the cost.
        by_stage: names of the inputs with a dimension of stages.
        sizes: n_x, n_u, n_lam, n_c.
        source: "goal" or "reference", of which the linear terms of the cost were made.
    """

    horizon: int
    tensors: dict[str, Tensor] = field(default_factory=dict)
    by_stage: set[str] = field(default_factory=set)
    sizes: dict[str, int] = field(default_factory=dict)
    source: str = ""

    def add_system(self, lcs: System, x0: Tensor, context: Tensor | None, along: Primal | None = None) -> None:
        """Add the matrices; a module is asked for them at these states, or along a plan from there."""
        if isinstance(lcs, LCSParams | LCSSequence):
            system = lcs
        else:
            system = system_at(lcs, x0, context) if along is None else sequence_along(lcs, along, x0, context)
            returned = f"return one of them from {type(lcs).__name__}.params"
            system = check_kind("lcs", system, (LCSParams, LCSSequence), returned)
            for name in ("n_x", "n_u", "n_lam"):
                if (said := getattr(lcs, name)) != (got := getattr(system, name)):
                    of = type(lcs).__name__
                    raise ShapeError(
                        f"lcs: expected {name}={said} from {of}.params, as {of}.{name} says, got {got}; correct one"
                    )
        system.check_again()
        if isinstance(system, LCSSequence):
            self.check_horizon("lcs", system.horizon)
            self.by_stage.update(SYSTEM)
        self.sizes = {"n_x": system.n_x, "n_u": system.n_u, "n_lam": system.n_lam, "n_c": 0}
        self.tensors.update(system.tensors())

    def add_cost(
        self,
        cost: Cost,
        x0: Tensor,
        goal: Tensor | None,
        reference: Tensor | None,
        context: Tensor | None,
        along: Primal | None = None,
    ) -> None:
        """Add the weights, at a goal or along a reference if the cost has one; a module is asked for them."""
        if not isinstance(cost, PLAIN_COSTS):
            if reference is not None:
                raise ShapeError(
                    f"reference: expected a goal with {type(cost).__name__}, got a reference; return a CostSequence "
                    f"from its method at, or use a GoalCost"
                )
            if along is None or not is_local(cost):
                cost, goal = cost_at(cost, x0, goal, context), None
            else:
                cost, goal = cost_along(cost, along, x0, goal, context), None
        self.check_sizes("cost", n_x=cost.n_x, n_u=cost.n_u)
        cost.check_again()
        if isinstance(cost, GoalCost):
            if goal is None and reference is None:
                raise ShapeError(
                    f"goal: expected (..., n_goal={cost.n_goal}) with a GoalCost, got none; call mpc(x0, goal) or "
                    f"mpc(x0, reference=...)"
                )
            if goal is not None and reference is not None:
                raise ShapeError("goal: expected none with a reference, got both; the reference holds a goal per stage")
            self.source = "reference" if goal is None else "goal"
            if goal is not None:
                fields = cost.at(goal, self.horizon)
            else:
                fields = cost.along(reference, self.horizon)  # pyright: ignore[reportArgumentType]
                self.by_stage.add("q")
        else:
            for name, value in (("goal", goal), ("reference", reference)):
                if value is not None:
                    raise ShapeError(
                        f"{name}: expected none with a {type(cost).__name__}, got one; use a GoalCost to plan to goals"
                    )
            fields = cost.tensors()
            if "constant_stage" in fields:
                fields["constant"] = fields["constant"] + self.horizon * fields.pop("constant_stage")
            if isinstance(cost, CostSequence):
                self.check_horizon("cost", cost.horizon)
                self.by_stage |= cost.by_stage
        self.tensors.update(fields)

    def add_bounds(self, bounds: StageBounds) -> None:
        """Add bounds by stage."""
        self.check_sizes("bounds", n_u=bounds.n_u)
        self.check_horizon("bounds", bounds.horizon)
        self.tensors.update(bounds.tensors())
        self.by_stage |= bounds.by_stage

    def take_bounds(self, setup: Setup, call: Call, system: System, x0: Tensor | None) -> None:
        """Take the bounds of a call, or else of a layer; without x0 those that depend on no state."""
        bounds = setup.bounds
        if call.bounds is not None:
            bounds = check_stage_bounds(call.bounds)
            check_alone(u_min=call.u_min, u_max=call.u_max)
        if bounds is None:
            self.tensors |= dict(zip(("u_min", "u_max"), setup.action_bounds(system, x0), strict=True))
        else:
            self.add_bounds(bounds)
        self.replace_bound("u_min", call.u_min)
        self.replace_bound("u_max", call.u_max)

    def replace_bound(self, name: str, value: Bound | None) -> None:
        """Replace a bound by that of this call, if there is one."""
        if value is not None:
            like = self.tensors.get("Q", self.tensors[name])
            self.tensors[name] = as_bound(name, value, [("n_u", self.sizes["n_u"])], like)
            self.by_stage.discard(name)

    def add_constraints(self, constraints: Constraints | None) -> None:
        """Add linear constraints, if there are any."""
        if constraints is None:
            return
        self.check_sizes("constraints", n_x=constraints.n_x)
        if constraints.n_u is not None:
            self.check_sizes("constraints", n_u=constraints.n_u)
        if isinstance(constraints, ConstraintSequence):
            self.check_horizon("constraints", constraints.horizon)
            self.by_stage |= constraints.staged
        self.sizes["n_c"] = constraints.n_c
        self.tensors.update(constraints.tensors())

    def batch(self) -> torch.Size:
        """Compute the common batch dimensions; an error says where devices or batch dimensions do not fit."""
        leads = {}
        for name, tensor in self.tensors.items():
            size = tensor.ndim - RANKS[name] - (name in self.by_stage)
            if size:
                leads[name] = tensor.shape[:size]
        distinct = set(leads.values())
        if len(distinct) <= 1 and all([tensor.is_cpu for tensor in self.tensors.values()]):
            return distinct.pop() if distinct else torch.Size()
        check_same_device(reversed(self.tensors.items()))
        made = ("q", "q_final", "constant") if self.source else ()
        named = [(self.source if k in made else k, leads.get(k, torch.Size())) for k in reversed(self.tensors)]
        return broadcast_batch(named)

    def rank(self, name: str) -> int:
        """Number of dimensions of an input behind those of the batch."""
        return RANKS[name] + (name in self.by_stage)

    def check_sizes(self, name: str, **actual: int) -> None:
        """Refuse something that was built for other sizes than the system's."""
        expected = {size: self.sizes[size] for size in actual}
        if actual != expected:
            want, got = (", ".join(f"{k}={v}" for k, v in sizes.items()) for sizes in (expected, actual))
            raise ShapeError(f"{name}: expected {want} like the LCS, got {got}; build them for the same system")

    def check_horizon(self, name: str, horizon: int) -> None:
        """Refuse something that was built for another number of stages than the layer's."""
        if horizon != self.horizon:
            raise ShapeError(
                f"{name}: expected {self.horizon} stages, the layer's horizon, got {horizon}; give one for each stage"
            )

    def numbers(
        self, tensors: Mapping[str, Tensor], batch: tuple[int, ...], *, unseen: bool = False, copy: bool = False
    ) -> dict[str, Tensor]:
        """Convert tensors to the numbers of an `MPCProblem`, and the constant; check those that are still unchecked.

        Args:
            tensors: all of the inputs or some; none of them is wrapped.
            batch: dimensions of the batch that all of them broadcast to.
            unseen: whether the numbers are unchecked.
            copy: whether to copy the system, so that a solution is measured by the one that it was planned with even
                after a step of an optimiser.
        """
        values, unchecked, size = {}, {}, math.prod(batch)
        for name, tensor in tensors.items():
            value, by_stage = tensor.detach(), name in self.by_stage
            if value.dtype is not torch.float64 or not value.is_cpu:
                value = check_tensor(name, value, finite=False).to("cpu", torch.float64)
            leading = value.ndim - RANKS[name] - by_stage
            if leading or name == "x0":
                lead, shape = value.shape[:leading], value.shape[leading:]
                if math.prod(lead) == 1 and name != "x0":
                    value = value.reshape(shape)  # shared
                elif lead == batch:
                    value = value.reshape(size, *shape) if leading != 1 else value
                else:
                    value = value.expand(*batch, *shape).reshape(size, *shape)
            if by_stage and value.ndim == 1 + RANKS[name]:
                value = value.unsqueeze(0)
            if name in SYMMETRIC and not torch.equal(value, value.mT):
                value = 0.5 * (value + value.mT)
            if name in MAY_BE_INFINITE:
                if unseen or tensor.requires_grad:
                    check_not_nan(name, value)
            elif unseen or name in _COST:
                unchecked[name] = value
            values[name] = value.contiguous()
            if copy and name in SYSTEM and values[name].data_ptr() == tensor.data_ptr():
                values[name] = value.clone()
        check_finite(unchecked)
        if unseen:
            check_positive_definite(values["F"])
        return values


def check_guess(
    guess: MPCSolution | Primal | None, batch: tuple[int, ...], horizon: int, sizes: Mapping[str, int]
) -> dict[str, Tensor]:
    """Check a guess and return its parts, "guess.x" and so on; mu only if it has some."""
    if guess is None:
        return {}
    if not isinstance(guess, MPCSolution | Primal):
        raise DTypeError(f"guess: expected an MPCSolution or a Primal such as solution.shift(), got {describe(guess)}")
    parts = {}
    for name, (extra, size) in GUESS.items():
        value, stages = getattr(guess, name), horizon + extra
        if name == "mu" and (value is None or (isinstance(value, Tensor) and not value.numel())):
            continue  # a plan without constraints is a guess for one with them
        fits = isinstance(value, Tensor) and value.shape == (*batch, stages, sizes[size])
        dims = [] if fits else [("H+1" if extra else "H", stages), (size, sizes[size])]
        check_tensor(f"guess.{name}", value, dims, finite=False)
        if not fits:
            raise ShapeError(
                f"guess.{name}: expected batch dimensions {tuple(batch)} like x0, got {tuple(value.shape[:-2])}; "
                f"expand or index it"
            )
        parts[f"guess.{name}"] = value.detach() if value.requires_grad else value
    check_finite(parts)
    return parts
