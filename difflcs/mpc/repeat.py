"""Fast repeated calls of a layer, as in the loop of a robot: the same problem from another state.

A call without gradients, of a layer whose model, cost, bounds and constraints hold the same numbers as in the last one,
reuses what was checked and prepared there. Only the arguments of the call are checked: a state, a goal, a guess, or a
system that was linearised anew.

With 9 states, 6 actions and 5 contacts that takes 130 µs and `autograd.solve_call` 410 µs; 65 µs of both are the
solve. Without this memory 180 µs would remain if checks and conversions took no time, as the products of matrices that
make F and the cost of a goal have to be torch's.
"""

from collections.abc import Mapping
from typing import Any, TypeGuard

import torch
from torch import Tensor

from difflcs._checks import all_finite, check_tensor, is_array
from difflcs._differentiation import forward_mode_active, transforms_active
from difflcs._modules import untouched
from difflcs._recall import Snapshot, snapshot
from difflcs.constraints import ConstraintSequence, LinearConstraints, StageBounds
from difflcs.cost import CostSequence, GoalCost, QuadraticCost
from difflcs.lcs import LCSModel
from difflcs.mpc.autograd import MPCSolver, solve_call
from difflcs.mpc.setup import GUESS, Call, Setup, check_guess
from difflcs.mpc.solution import MPCSolution, Primal
from difflcs.records import LCSParams, LCSSequence

_RECORDS = (LCSParams, LCSSequence)
# Modules that depend on their tensors alone. A subclass may depend on anything.
_MODULES = (LCSModel, GoalCost, QuadraticCost, CostSequence, StageBounds, LinearConstraints, ConstraintSequence)


class Repeat:
    """Memory of a layer's last plan. Copies of it, also in files, are empty."""

    def __init__(self) -> None:
        self._last: _Prepared | None = None

    def solve_call(self, setup: Setup, call: Call) -> tuple[MPCSolver, tuple[Tensor, ...]]:
        """Return the same as `autograd.solve_call`, sooner if only numbers of a state, goal or system can differ.

        Raises:
            InvalidInputError and its kinds: an argument does not fit; nothing was solved.
        """
        last, signature = self._last, _signature(setup, call)  # once: another thread may keep something else
        if last is not None and signature is not None and last.fits(setup, call, signature):
            start = last.start(call)
            solver = last.solver(setup, call)
            solver.began = setup.began
            return solver, solver.run(start, call.x0.device)
        mappings = _tensor_mappings(setup, call) if signature is not None else None
        values = [] if mappings is None else _values(setup, call, mappings)
        if signature is None or mappings is None or _differentiated([*values, *_inputs(call)]):
            return solve_call(setup, call)
        before, goal = snapshot(values), snapshot([call.goal])
        solver, outputs = solve_call(setup, call)
        if before is not None and goal is not None:
            self._last = _Prepared(signature, mappings, before, goal, solver)
        return solver, outputs

    def __reduce__(self) -> tuple[type, tuple]:
        return Repeat, ()


class _Prepared:
    """Copy of a problem that a layer has solved, with a snapshot of the values that it was made of."""

    def __init__(
        self, signature: tuple, mappings: list[Mapping[str, object]], taken: Snapshot, goal: Snapshot, solver: MPCSolver
    ):
        self.signature, self.mappings, self.snapshot, self.latest = signature, mappings, taken, (solver.copy(), goal)
        inputs, problem = solver.inputs, solver.problem
        shapes = [(inputs.horizon + extra, inputs.sizes[size]) for extra, size in GUESS.values()]
        self.flat = [torch.Size((problem.batch, *shape)) for shape in shapes]
        self.guess = [torch.Size((*solver.batch, *shape)) for shape in shapes]

    def fits(self, setup: Setup, call: Call, signature: tuple) -> bool:
        """Return whether a call can differ from the last only in the numbers of its arguments."""
        return (
            signature == self.signature
            and self.snapshot.same(_values(setup, call, self.mappings))
            and not _differentiated([*self.snapshot.tensors, *_inputs(call)])
        )

    def solver(self, setup: Setup, call: Call) -> MPCSolver:
        """Make the solver of a call: from its state, to its goal, with its system if it has one."""
        (solver, same), (x0, goal, lcs) = self.latest, (call.x0, call.goal, call.lcs)
        if not same.same([goal]):
            cost: Any = setup.cost  # a GoalCost, as there is a goal
            same, made = Snapshot([goal]), cost.at(goal, setup.horizon)
            solver = solver.with_inputs({name: made[name] for name in ("q", "q_final", "constant")})
            self.latest = solver, same
        if lcs is not None:
            lcs.check_again()  # pyright: ignore[reportAttributeAccessIssue]
            return solver.with_inputs({**lcs.tensors(), "x0": x0})  # pyright: ignore[reportAttributeAccessIssue]
        if x0.shape[:-1] != solver.batch:  # one state to several goals
            return solver.with_inputs({"x0": x0})
        return solver.with_x0(_reshape(x0.detach(), solver.problem.x0.shape))

    def start(self, call: Call) -> Primal | None:
        """Make the guess in the form that backends take, after a check of the new numbers."""
        solver, flat = self.latest[0], self._flat(call.guess)
        if flat is None or not all_finite(call.x0, *flat):
            check_tensor("x0", call.x0)
            inputs = solver.inputs
            return solver.flat_guess(check_guess(call.guess, solver.batch, inputs.horizon, inputs.sizes))
        return Primal(*flat) if flat else None

    def _flat(self, guess: object) -> list[Tensor] | None:
        """Return the parts of a guess of the expected shapes and dtype, [] without a guess; None of any other guess."""
        if guess is None:
            return []
        if not isinstance(guess, MPCSolution | Primal):
            return None
        parts = []
        for value, shape, flat in zip((guess.x, guess.u, guess.lam, guess.mu), self.guess, self.flat, strict=True):
            if not (_is_double(value) and value.shape == shape):
                return None
            parts.append(_reshape(value.detach() if value.requires_grad else value, flat))
        return parts


def _inputs(call: Call) -> list[Tensor]:
    """Collect the tensors that a call with a signature passes."""
    tensors = [call.x0] if call.goal is None else [call.x0, call.goal]
    return tensors if call.lcs is None else [*tensors, *call.lcs.tensors().values()]  # pyright: ignore[reportAttributeAccessIssue]


def _differentiated(values: list[object]) -> bool:
    """Return whether a gradient can be asked of what is made of these."""
    return torch.is_grad_enabled() and any([isinstance(v, Tensor) and v.requires_grad for v in values])


def _signature(setup: Setup, call: Call) -> tuple | None:
    """Return what a plan depends on besides tensors; None if a call cannot be repeated, or must be refused."""
    x0, goal, reference, _, u_min, u_max, bounds, lcs, cost, constraints, context, along = call
    if not (reference is u_min is u_max is bounds is cost is constraints is context is along is setup.limits is None):
        return None
    if not _is_double(x0) or not (goal is None or is_array(goal)) or transforms_active() or forward_mode_active():
        return None
    if not (lcs is None or (type(lcs) is LCSParams and lcs.A.is_cpu)):
        return None
    shapes = None if lcs is None else [value.shape for value in lcs.tensors().values()]
    settings = setup.horizon, setup.relaxation, setup.barrier, getattr(setup.lcs, "stiffness", None)
    return x0.shape, None if goal is None else (goal.shape, goal.dtype), shapes, settings


def _reshape(value: Tensor, shape: torch.Size) -> Tensor:
    """Reshape, if needed: `Tensor.reshape` takes as long when there is nothing to do."""
    return value if value.shape == shape else value.reshape(shape)


def _is_double(value: object) -> TypeGuard[Tensor]:
    return is_array(value) and value.dtype is torch.float64


def _tensor_mappings(setup: Setup, call: Call) -> list[Mapping[str, object]] | None:
    """Collect the mappings in which a layer's parts hold their tensors; None if a part may hold others."""
    mappings: list[Mapping[str, object]] = []
    for part in _parts(setup, call):
        if type(part) in _RECORDS:
            mappings.append(vars(part))
        elif type(part) in _MODULES and untouched(part):  # pyright: ignore[reportArgumentType]
            mappings += [part._parameters, part._buffers]  # pyright: ignore[reportAttributeAccessIssue]
        elif part is not None:
            return None
    return mappings


def _parts(setup: Setup, call: Call) -> tuple[object, ...]:
    matters = call.lcs is None or hasattr(setup.lcs, "action_bounds")
    return setup.lcs if matters else None, setup.cost, setup.bounds, setup.constraints


def _values(setup: Setup, call: Call, mappings: list[Mapping[str, object]]) -> list[object]:
    """Collect all values that a plan depends on, except the arguments of the call."""
    values = [*_parts(setup, call), setup.backend, setup.u_min, setup.u_max]
    return values + [value for mapping in mappings for value in mapping.values()]
