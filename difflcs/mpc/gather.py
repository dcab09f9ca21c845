"""What one call of the layer plans with: tensors under the names of `MPCProblem`, from whatever the caller gave."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from difflcs._checks import broadcast_batch, check_same_device, check_tensor, describe
from difflcs.constraints import ConstraintSequence, LinearConstraints, StageBounds, as_bound
from difflcs.cost import CostSequence, GoalCost, QuadraticCost
from difflcs.errors import DTypeError, ShapeError
from difflcs.lcs import SYSTEM, LCSModule, LCSParams, LCSSequence
from difflcs.mpc.problem import INPUTS
from difflcs.mpc.solution import MPCSolution, Primal
from difflcs.records import system_at

RANKS = {**{name: len(dims) for name, dims in INPUTS.items()}, "constant": 0}
"""Number of dimensions of each input of a call behind those of the batch and of the stages."""

GUESS = {"x": (1, "n_x"), "u": (0, "n_u"), "lam": (0, "n_lam"), "mu": (1, "n_c")}
"""Parts of a guess: how many stages beyond H each has, and its size."""

Bound = float | Tensor
System = LCSModule | LCSParams | LCSSequence
Cost = GoalCost | QuadraticCost | CostSequence
Constraints = LinearConstraints | ConstraintSequence


def check_system(lcs: object) -> System:
    """Refuse what says no system."""
    if not isinstance(lcs, LCSParams | LCSSequence) and not isinstance(lcs, LCSModule):
        raise DTypeError(
            f"lcs: expected LCSModel, LCSParams, LCSSequence or another LCSModule, got {describe(lcs)}; a module "
            f"needs n_x, n_u, n_lam and params(x, context)"
        )
    return lcs


def check_cost(cost: object) -> Cost:
    """Refuse what is no cost."""
    if not isinstance(cost, GoalCost | QuadraticCost | CostSequence):
        raise DTypeError(
            f"cost: expected GoalCost, QuadraticCost or CostSequence, got {describe(cost)}; build one from your weights"
        )
    return cost


def check_constraints(constraints: object) -> Constraints:
    """Refuse what is no constraint."""
    if not isinstance(constraints, LinearConstraints | ConstraintSequence):
        raise DTypeError(
            f"constraints: expected LinearConstraints or ConstraintSequence, got {describe(constraints)}; build one "
            f"from G and g"
        )
    return constraints


def check_stage_bounds(bounds: object, **plain: object) -> StageBounds:
    """Refuse what is no `StageBounds`, and bounds that are given twice."""
    if not isinstance(bounds, StageBounds):
        raise DTypeError(
            f"bounds: expected StageBounds, got {describe(bounds)}; pass constant bounds as u_min and u_max"
        )
    for name, value in plain.items():
        if value is not None:
            raise ShapeError(f"{name}: expected none with bounds, got {describe(value)}; put it into the StageBounds")
    return bounds


@dataclass
class Inputs:
    """What one call plans with: tensors by the names of `MPCProblem`, with the cost's constant.

    Attributes:
        horizon: stages of the plan.
        tensors: name → tensor as the caller gave it, or as the cost made it of a goal.
        by_stage: names of the inputs with a dimension of stages.
        sizes: n_x, n_u, n_lam, n_c.
    """

    horizon: int
    tensors: dict[str, Tensor] = field(default_factory=dict)
    by_stage: set[str] = field(default_factory=set)
    sizes: dict[str, int] = field(default_factory=dict)

    def add_system(self, lcs: System, x0: Tensor, context: Tensor | None) -> None:
        """The matrices, asked for at these states if it is a module."""
        if isinstance(lcs, LCSParams | LCSSequence):
            system = lcs
            if context is not None:
                raise ShapeError(
                    f"context: expected none with {type(lcs).__name__}, got {describe(context)}; pass lcs=a module "
                    f"whose params(x, context) uses it"
                )
        else:
            if context is not None:
                check_tensor("context", context)
            system = system_at(lcs, x0, context)
            if not isinstance(system, LCSParams | LCSSequence):
                raise DTypeError(
                    f"lcs: expected LCSParams or LCSSequence from {type(lcs).__name__}.params, got {describe(system)}; "
                    f"return one of them"
                )
        system.check_again()
        if isinstance(system, LCSSequence):
            self.check_horizon("lcs", system.horizon)
            self.by_stage.update(SYSTEM)
        self.sizes = {"n_x": system.n_x, "n_u": system.n_u, "n_lam": system.n_lam, "n_c": 0}
        self.tensors.update(system.tensors())

    def add_cost(self, cost: Cost, goal: Tensor | None, reference: Tensor | None) -> None:
        """The weights, at a goal or along a reference if the cost has one."""
        self.check_sizes("cost", n_x=cost.n_x, n_u=cost.n_u)
        if isinstance(cost, GoalCost):
            if goal is None and reference is None:
                raise ShapeError(
                    f"goal: expected (..., n_goal={cost.n_goal}) with a GoalCost, got none; call mpc(x0, goal) or "
                    f"mpc(x0, reference=...)"
                )
            if goal is not None and reference is not None:
                raise ShapeError("goal: expected none with a reference, got both; the reference holds a goal per stage")
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
            if isinstance(cost, CostSequence):
                self.check_horizon("cost", cost.horizon)
                self.by_stage |= cost.by_stage
        self.tensors.update(fields)

    def add_bounds(self, bounds: StageBounds) -> None:
        """Bounds by stage."""
        self.check_sizes("bounds", n_u=bounds.n_u)
        self.check_horizon("bounds", bounds.horizon)
        self.tensors.update(bounds.tensors())
        self.by_stage |= bounds.by_stage

    def replace_bound(self, name: str, value: Bound | None) -> None:
        """A bound of this call in place of another, if there is one."""
        if value is not None:
            self.tensors[name] = as_bound(name, value, [("n_u", self.sizes["n_u"])], self.tensors["Q"])
            self.by_stage.discard(name)

    def add_constraints(self, constraints: Constraints | None) -> None:
        """Linear constraints, if there are any."""
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
        """Common batch dimensions; a clear error where devices or batch dimensions do not fit."""
        found = {self._lead(name, tensor) for name, tensor in self.tensors.items()} - {torch.Size()}
        if len(found) <= 1 and all(tensor.is_cpu for tensor in self.tensors.values()):
            return found.pop() if found else torch.Size()
        check_same_device(reversed(self.tensors.items()))
        return broadcast_batch((name, self._lead(name, tensor)) for name, tensor in reversed(self.tensors.items()))

    def _lead(self, name: str, tensor: Tensor) -> torch.Size:
        """Batch dimensions of an input."""
        return tensor.shape[: tensor.ndim - RANKS[name] - (name in self.by_stage)]

    def check_sizes(self, name: str, **found: int) -> None:
        """Refuse something that was built for other sizes than the system's."""
        wanted = {size: self.sizes[size] for size in found}
        if found != wanted:
            expected, got = (", ".join(f"{k}={v}" for k, v in sizes.items()) for sizes in (wanted, found))
            raise ShapeError(f"{name}: expected {expected} like the LCS, got {got}; build them for the same system")

    def check_horizon(self, name: str, horizon: int) -> None:
        """Refuse something that was built for another number of stages than the layer's."""
        if horizon != self.horizon:
            raise ShapeError(
                f"{name}: expected {self.horizon} stages, the layer's horizon, got {horizon}; give one for each stage"
            )


def check_guess(
    guess: MPCSolution | Primal | None,
    batch: tuple[int, ...],
    horizon: int,
    sizes: Mapping[str, int],
    finite: bool = True,
) -> tuple[Tensor | None, ...]:
    """x, u, lam and mu of a guess; mu where it has some. `finite`: whether to look at the numbers."""
    if guess is None:
        return (None,) * 4
    if not isinstance(guess, MPCSolution | Primal):
        raise DTypeError(f"guess: expected an MPCSolution or a Primal such as solution.shift(), got {describe(guess)}")
    found = []
    for name, (extra, size) in GUESS.items():
        value, stages = getattr(guess, name), horizon + extra
        if name == "mu" and (value is None or (isinstance(value, Tensor) and not value.numel())):
            found.append(None)  # a plan without constraints is a guess for one with them
            continue
        fits = isinstance(value, Tensor) and value.shape == (*batch, stages, sizes[size])
        dims = [] if fits else [("H+1" if extra else "H", stages), (size, sizes[size])]
        check_tensor(f"guess.{name}", value, dims, finite)
        if not fits:
            raise ShapeError(
                f"guess.{name}: expected batch dimensions {tuple(batch)} like x0, got {tuple(value.shape[:-2])}; "
                f"expand or index it"
            )
        found.append(value.detach() if value.requires_grad else value)
    return tuple(found)
