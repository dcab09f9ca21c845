"""The same problem from another state: what the loop of a robot asks of a layer again and again.

A call without gradients, of a layer whose model, cost, bounds and constraints hold the same numbers as in the last one,
plans with what that one has checked and prepared. Only what the call gives is looked at: a state, a goal, a guess, or a
system that was linearised anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple, TypeGuard

import torch
from torch import Tensor

from difflcs._checks import all_finite, check_tensor, is_array
from difflcs._differentiation import transforms_active
from difflcs._modules import untouched
from difflcs._recall import Snapshot, comparable
from difflcs.constraints import ConstraintSequence, LinearConstraints, StageBounds
from difflcs.cost import CostSequence, GoalCost, QuadraticCost
from difflcs.lcs import LCSModel, LCSParams, LCSSequence
from difflcs.mpc.autograd import Plan
from difflcs.mpc.gather import GUESS, System, check_guess
from difflcs.mpc.solution import MPCSolution, Primal

if TYPE_CHECKING:
    from difflcs.mpc.layer import LCSMPCLayer

_RECORDS = (LCSParams, LCSSequence)
# What depends on its tensors alone. A subclass may depend on anything.
_MODULES = (LCSModel, GoalCost, QuadraticCost, CostSequence, StageBounds, LinearConstraints, ConstraintSequence)


class Given(NamedTuple):
    """What a call may give anew, besides a guess."""

    x0: Tensor
    goal: Tensor | None
    lcs: System | None

    def tensors(self) -> list[Tensor]:
        """All numbers of it, where it has a form."""
        found = [self.x0] if self.goal is None else [self.x0, self.goal]
        return found if self.lcs is None else [*found, *self.lcs.tensors().values()]  # pyright: ignore[reportAttributeAccessIssue]

    def form(self) -> tuple | None:
        """What it is but for its numbers; None of what cannot be used here, or must be refused elsewhere."""
        x0, goal, lcs = self
        if not _is_double(x0) or not (goal is None or is_array(goal)):
            return None
        if not (lcs is None or (type(lcs) is LCSParams and lcs.A.is_cpu)):
            return None
        shapes = None if lcs is None else [value.shape for value in lcs.tensors().values()]
        return x0.shape, None if goal is None else (goal.shape, goal.dtype), shapes


class Repeat:
    """What a layer planned last. Copies, and files, are empty."""

    def __init__(self) -> None:
        self._last: _Planned | None = None

    def plan(
        self, layer: LCSMPCLayer, settings: tuple, given: Given, guess: MPCSolution | Primal | None
    ) -> tuple[Plan, Primal | None] | None:
        """A plan that is ready to run, and its guess, where nothing but numbers of what is given can differ.

        Raises:
            InvalidInputError and its kinds: of the state, the goal or the guess.
        """
        last = self._last  # once: another thread may keep something else
        if last is None or transforms_active() or not last.fits(layer, settings, given):
            return None
        start = last.start(given.x0, guess)
        return last.plan(layer, given), start

    def keep(self, layer: LCSMPCLayer, settings: tuple, plan: Plan, given: Given, sizes: Mapping[str, int]) -> None:
        """Keep what a call has planned, if the numbers that it was made of can all be found, and compared quickly."""
        if plan.own or plan.unseen or given.form() is None:
            return
        held = _held_by(layer, given.lcs is not None)
        if held is not None and comparable([*_values(layer, held), given.goal]):
            self._last = _Planned(layer, held, settings, plan, given, sizes)

    def __reduce__(self) -> tuple[type, tuple]:
        return Repeat, ()


class _Planned:
    """A problem that a layer has planned, in memory of its own, and what it was made of."""

    def __init__(
        self,
        layer: LCSMPCLayer,
        held: list[Mapping[str, object]],
        settings: tuple,
        plan: Plan,
        given: Given,
        sizes: Mapping[str, int],
    ):
        self.held, self.made_of = held, Snapshot(_values(layer, held))
        self.settings, self.form, self.sizes = (*settings, _stiffness(layer)), given.form(), sizes
        self.latest = plan.private(), None if given.goal is None else Snapshot([given.goal])
        own = [(plan.horizon + extra, sizes[size]) for extra, size in GUESS.values()]
        self.flat = [torch.Size((plan.problem.batch, *shape)) for shape in own]
        self.guess = [torch.Size((*plan.batch, *shape)) for shape in own]

    def fits(self, layer: LCSMPCLayer, settings: tuple, given: Given) -> bool:
        """Whether a call can differ in numbers of what it gives alone."""
        return (
            given.form() == self.form
            and (*settings, _stiffness(layer)) == self.settings
            and self.made_of.same(_values(layer, self.held))
            and not (
                torch.is_grad_enabled() and any(v.requires_grad for v in (*self.made_of.tensors, *given.tensors()))
            )
        )

    def plan(self, layer: LCSMPCLayer, given: Given) -> Plan:
        """The plan from a state, to a goal, with a system if one is given."""
        (plan, same), (x0, goal, lcs) = self.latest, given
        if goal is not None and same is not None and not same.same([goal]):
            made = layer.cost.at(goal, plan.horizon)  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
            plan = plan.again({name: made[name] for name in ("q", "q_final", "constant")})
            self.latest = plan, Snapshot([goal])
        if lcs is not None:
            lcs.check_again()  # pyright: ignore[reportAttributeAccessIssue]
            return plan.again({**lcs.tensors(), "x0": x0})  # pyright: ignore[reportAttributeAccessIssue]
        if x0.shape[:-1] != plan.batch:  # one state to several goals
            return plan.again({"x0": x0})
        return plan.at(_shaped(x0.detach(), plan.problem.x0.shape))

    def start(self, x0: Tensor, guess: MPCSolution | Primal | None) -> Primal | None:
        """A guess as solvers want it, after a look at the numbers that are new."""
        plan, flat = self.latest[0], self._flat(guess)
        if flat is None or not all_finite(x0, *flat):
            check_tensor("x0", x0)
            return plan.flat_guess(check_guess(guess, plan.batch, plan.horizon, self.sizes))
        return Primal(*flat) if flat else None

    def _flat(self, guess: object) -> list[Tensor] | None:
        """The parts of a guess that is just as it must be, none of none; None of any other."""
        if guess is None:
            return []
        if not isinstance(guess, MPCSolution | Primal):
            return None
        found = []
        for value, shape, flat in zip((guess.x, guess.u, guess.lam, guess.mu), self.guess, self.flat, strict=True):
            if not (_is_double(value) and value.shape == shape):
                return None
            found.append(_shaped(value.detach() if value.requires_grad else value, flat))
        return found


def _shaped(value: Tensor, shape: torch.Size) -> Tensor:
    """`reshape` takes as long where there is nothing to do."""
    return value if value.shape == shape else value.reshape(shape)


def _is_double(value: object) -> TypeGuard[Tensor]:
    return is_array(value) and value.dtype is torch.float64


def _held_by(layer: LCSMPCLayer, system_given: bool) -> list[Mapping[str, object]] | None:
    """Where a layer and its parts hold what a plan is made of; None where not all of it can be found."""
    if not untouched(layer):
        return None
    found: list[Mapping[str, object]] = [layer._parameters, layer._buffers, layer._modules]
    for part in (None if system_given else layer.lcs, layer.cost, layer.bounds, layer.constraints):
        if type(part) in _RECORDS:
            found.append(vars(part))
        elif type(part) in _MODULES and untouched(part):  # pyright: ignore[reportArgumentType]
            found += [part._parameters, part._buffers]  # pyright: ignore[reportAttributeAccessIssue, reportOptionalMemberAccess]
        elif part is not None:
            return None
    return found


def _values(layer: LCSMPCLayer, held: list[Mapping[str, object]]) -> list[object]:
    """All of it, with the backend, and a model that is no module."""
    own = vars(layer)
    return [own["backend"], own.get("lcs")] + [value for mapping in held for value in mapping.values()]


def _stiffness(layer: LCSMPCLayer) -> float | None:
    """What a plan depends on that a model holds besides its tensors."""
    return getattr(layer._modules.get("lcs"), "stiffness", None)  # pyright: ignore[reportReturnType]
