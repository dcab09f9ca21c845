"""Fast repeated calls of a layer, as in the loop of a robot: the same problem from another state.

A call without gradients, of a layer whose model, cost, bounds and constraints hold the same numbers as in the last one,
plans with what that one has checked and prepared. Only what the call gives is looked at: a state, a goal, a guess, or a
system that was linearised anew.

With 9 states, 6 actions and 5 contacts that takes 130 µs and `autograd.solve_call` 410 µs; 65 µs of both are the
solve. Without this memory 180 µs would remain if checks and conversions took no time, as the products of matrices that
make F and the cost of a goal have to be torch's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeGuard

import torch
from torch import Tensor

from difflcs._checks import all_finite, check_tensor, is_array
from difflcs._differentiation import forward_mode_active, transforms_active
from difflcs._modules import untouched
from difflcs._recall import Snapshot, comparable
from difflcs.constraints import ConstraintSequence, LinearConstraints, StageBounds
from difflcs.cost import CostSequence, GoalCost, QuadraticCost
from difflcs.lcs import LCSModel, LCSParams, LCSSequence
from difflcs.mpc.autograd import MPCSolver, solve_call
from difflcs.mpc.setup import GUESS, Call, Setup, check_guess
from difflcs.mpc.solution import MPCSolution, Primal

_RECORDS = (LCSParams, LCSSequence)
# What depends on its tensors alone. A subclass may depend on anything.
_MODULES = (LCSModel, GoalCost, QuadraticCost, CostSequence, StageBounds, LinearConstraints, ConstraintSequence)


class Repeat:
    """The last plan of a layer. Copies, and files, are empty."""

    def __init__(self) -> None:
        self._last: _Planned | None = None

    def solve_call(self, setup: Setup, call: Call) -> tuple[MPCSolver, tuple[Tensor, ...]]:
        """What `autograd.solve_call` returns, sooner where nothing but numbers of a state, goal or system can differ.

        Raises:
            InvalidInputError and its kinds: an argument does not fit; nothing was solved.
        """
        last, form = self._last, _form(call)  # once: another thread may keep something else
        if last is not None and form is not None and last.fits(setup, call, form):
            start = last.start(call)
            solver = last.solver(setup, call)
            return solver, solver.run(start, call.x0.device)
        solver, outputs = solve_call(setup, call)
        if form is not None and not solver.own and setup.limits is None:
            held = _held_by(setup, call)
            if held is not None and comparable([*_values(setup, call, held), call.goal]):
                self._last = _Planned(setup, call, form, held, solver)
        return solver, outputs

    def __reduce__(self) -> tuple[type, tuple]:
        return Repeat, ()


class _Planned:
    """A problem that a layer has planned, in memory of its own, and what it was made of."""

    def __init__(self, setup: Setup, call: Call, form: tuple, held: list[Mapping[str, object]], solver: MPCSolver):
        self.held, self.made_of = held, Snapshot(_values(setup, call, held))
        self.form, self.settings = form, _settings(setup)
        self.latest = solver.private(), None if call.goal is None else Snapshot([call.goal])
        inputs, problem = solver.inputs, solver.problem
        own = [(inputs.horizon + extra, inputs.sizes[size]) for extra, size in GUESS.values()]
        self.flat = [torch.Size((problem.batch, *shape)) for shape in own]
        self.guess = [torch.Size((*solver.batch, *shape)) for shape in own]

    def fits(self, setup: Setup, call: Call, form: tuple) -> bool:
        """Whether a call can differ in numbers of what it gives alone."""
        return (
            form == self.form
            and _settings(setup) == self.settings
            and self.made_of.same(_values(setup, call, self.held))
            and not (torch.is_grad_enabled() and any(v.requires_grad for v in (*self.made_of.tensors, *_given(call))))
        )

    def solver(self, setup: Setup, call: Call) -> MPCSolver:
        """The solver of a call: from its state, to its goal, with its system if it gives one."""
        (solver, same), (x0, goal, lcs) = self.latest, (call.x0, call.goal, call.lcs)
        if goal is not None and same is not None and not same.same([goal]):
            made = setup.cost.at(goal, setup.horizon)  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
            solver = solver.again({name: made[name] for name in ("q", "q_final", "constant")})
            self.latest = solver, Snapshot([goal])
        if lcs is not None:
            lcs.check_again()  # pyright: ignore[reportAttributeAccessIssue]
            return solver.again({**lcs.tensors(), "x0": x0})  # pyright: ignore[reportAttributeAccessIssue]
        if x0.shape[:-1] != solver.batch:  # one state to several goals
            return solver.again({"x0": x0})
        return solver.at(_shaped(x0.detach(), solver.problem.x0.shape))

    def start(self, call: Call) -> Primal | None:
        """A guess as backends want it, after a look at the numbers that are new."""
        solver, flat = self.latest[0], self._flat(call.guess)
        if flat is None or not all_finite(call.x0, *flat):
            check_tensor("x0", call.x0)
            inputs = solver.inputs
            return solver.flat_guess(check_guess(call.guess, solver.batch, inputs.horizon, inputs.sizes))
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


def _given(call: Call) -> list[Tensor]:
    """The numbers that a call with a form gives."""
    found = [call.x0] if call.goal is None else [call.x0, call.goal]
    return found if call.lcs is None else [*found, *call.lcs.tensors().values()]  # pyright: ignore[reportAttributeAccessIssue]


def _form(call: Call) -> tuple | None:
    """What a call gives but for its numbers; None of one that cannot be used here, or must be refused elsewhere."""
    x0, goal, reference, _, u_min, u_max, bounds, lcs, cost, constraints, *rest = call
    if not (reference is u_min is u_max is bounds is cost is constraints is None) or any(v is not None for v in rest):
        return None
    if not _is_double(x0) or not (goal is None or is_array(goal)) or transforms_active() or forward_mode_active():
        return None
    if not (lcs is None or (type(lcs) is LCSParams and lcs.A.is_cpu)):
        return None
    shapes = None if lcs is None else [value.shape for value in lcs.tensors().values()]
    return x0.shape, None if goal is None else (goal.shape, goal.dtype), shapes


def _shaped(value: Tensor, shape: torch.Size) -> Tensor:
    """`reshape` takes as long where there is nothing to do."""
    return value if value.shape == shape else value.reshape(shape)


def _is_double(value: object) -> TypeGuard[Tensor]:
    return is_array(value) and value.dtype is torch.float64


def _held_by(setup: Setup, call: Call) -> list[Mapping[str, object]] | None:
    """Where the parts of a layer hold what a plan is made of; None where not all of it can be found."""
    found: list[Mapping[str, object]] = []
    for part in _parts(setup, call):
        if type(part) in _RECORDS:
            found.append(vars(part))
        elif type(part) in _MODULES and untouched(part):  # pyright: ignore[reportArgumentType]
            found += [part._parameters, part._buffers]  # pyright: ignore[reportAttributeAccessIssue]
        elif part is not None:
            return None
    return found


def _parts(setup: Setup, call: Call) -> tuple[object, ...]:
    return None if call.lcs is not None else setup.lcs, setup.cost, setup.bounds, setup.constraints


def _values(setup: Setup, call: Call, held: list[Mapping[str, object]]) -> list[object]:
    """All that a plan is made of but for what a call gives."""
    own = [*_parts(setup, call), setup.backend, setup.u_min, setup.u_max]
    return own + [value for mapping in held for value in mapping.values()]


def _settings(setup: Setup) -> tuple:
    """The numbers that a plan depends on: also what a model holds besides its tensors."""
    return setup.horizon, setup.relaxation, setup.barrier, getattr(setup.lcs, "stiffness", None)
