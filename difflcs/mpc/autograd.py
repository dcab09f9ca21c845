"""The MPC as a solver for autograd: how one call is solved, and how its gradients are computed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import all_finite, check_tensor
from difflcs._differentiation import Gradients, Solver, Tensors, refuse_tangents, solve, transforms_active
from difflcs.errors import DegenerateWarning, warn
from difflcs.mpc.backends.base import Backend, Result
from difflcs.mpc.problem import MPCProblem
from difflcs.mpc.setup import GUESS, RANKS, SYMMETRIC, Call, Inputs, Setup, check_guess, gather
from difflcs.mpc.solution import Primal
from difflcs.status import Status

_AFTERWARDS = 1e-4  # seconds of a call that its solver must leave for what comes after it


def solve_call(setup: Setup, call: Call) -> tuple[MPCSolver, tuple[Tensor, ...]]:
    """Solve a call; return its solver, and the outputs of `MPCSolver.solve` as nodes of the graph.

    Raises:
        InvalidInputError and its kinds: an argument does not fit; nothing was solved.
    """
    inputs, transformed = gather(setup, call), transforms_active()
    tensors = inputs.tensors
    if not transformed:
        refuse_tangents(tensors.values())
    batch = inputs.batch()
    guess = check_guess(call.guess, batch, inputs.horizon, inputs.sizes)
    needs_grad = torch.is_grad_enabled() and (transformed or any([tensor.requires_grad for tensor in tensors.values()]))
    solver = MPCSolver(
        setup.backend,
        setup.began,
        setup.relaxation,
        setup.barrier,
        names=(*tensors, *guess),
        inputs=Inputs(inputs.horizon, by_stage=inputs.by_stage, sizes=inputs.sizes),
        batch=batch,
        dtype=call.x0.dtype,
        has_float32=needs_grad and any([tensor.dtype is torch.float32 for tensor in tensors.values()]),
        needs_grad=needs_grad,
        transformed=transformed,
    )
    return solver, solve(solver, *tensors.values(), *guess.values())


@dataclass
class MPCSolver(Solver):
    """Solver of an `MPCProblem`: its inputs and parts of a guess, with any batch dimensions → a plan.

    Attributes:
        backend, began, relaxation, barrier: see `Setup`.
        names: of the tensors that are passed.
        inputs: horizon, sizes and which inputs are by stage, without the tensors.
        batch: batch dimensions that all inputs broadcast to.
        dtype: of x, u, lam and the objective.
        has_float32: whether an input is float32, whose range then limits the gradients.
        needs_grad: whether a backward pass may follow, so that the outputs must be copies.
        transformed: whether the numbers are unchecked, because the inputs came from a transform.
        problem, constant, result: the problem, the constant of its cost and the result, once it is solved.
    """

    backend: Backend
    began: float
    relaxation: float
    barrier: float
    names: tuple[str, ...]
    inputs: Inputs
    batch: tuple[int, ...]
    dtype: torch.dtype
    has_float32: bool
    needs_grad: bool
    transformed: bool
    problem: MPCProblem = field(init=False)
    constant: Tensor = field(init=False)
    result: Result = field(init=False)

    name = "LCSMPCLayer"
    differentiable = 4
    keeps = True

    @property
    def ranks(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Number of dimensions of each tensor behind those of the batch."""
        return tuple([self.inputs.rank(name) if name in RANKS else 2 for name in self.names])

    def solve(self, tensors: Tensors, transformed: bool) -> tuple[Tensor, ...]:
        """Solve; return x, u, lam, objective, mu, status, iterations, kkt_residual, solve_time and violation."""
        if transformed:
            leads = [tensor.shape[: tensor.ndim - rank] for tensor, rank in zip(tensors, self.ranks, strict=True)]
            self.batch = torch.Size(np.broadcast_shapes(*leads))
        named = dict(zip(self.names, tensors, strict=True))
        guess = {name: named.pop(name) for name in self.names if name not in RANKS}
        values = self.inputs.numbers(named, self.batch, unseen=transformed, copy=self.needs_grad)
        self.constant = values.pop("constant")
        self.problem = MPCProblem(
            **values, horizon=self.inputs.horizon, relaxation=self.relaxation, barrier=self.barrier
        )
        return self.run(self.flat_guess(guess), named["x0"].device)

    def with_inputs(self, inputs: Mapping[str, Tensor]) -> MPCSolver:
        """Make a solver of the same problem with some other inputs of the same shapes, dtypes and devices."""
        values = self.inputs.numbers(inputs, self.batch)
        return self._with(values.pop("constant", self.constant), self.problem.with_inputs(values))

    def with_x0(self, x0: Tensor) -> MPCSolver:
        """Make a solver of the same problem from other states (batch, n_x), float64 on the CPU."""
        return self._with(self.constant, self.problem.with_x0(x0))

    def copy(self) -> MPCSolver:
        """Make a copy, not yet solved, that shares no memory with this one."""
        return self._with(self.constant.clone(), self.problem.copy())

    def _with(self, constant: Tensor, problem: MPCProblem) -> MPCSolver:
        other = object.__new__(MPCSolver)
        vars(other).update(vars(self), constant=constant, problem=problem)
        vars(other).pop("result", None)
        return other

    def run(self, start: Primal | None, device: torch.device) -> tuple[Tensor, ...]:
        """Solve the problem as it is and return the outputs of `solve` on a device."""
        problem, constant = self.problem, self.constant
        violation = torch.from_numpy(np.zeros(problem.batch))  # before the solve, and by NumPy, as it is faster
        needed = time.perf_counter() - self.began + _AFTERWARDS
        result = self.backend.after(needed).solve(problem, start)
        if problem.n_c:
            violation = problem.violation(result.primal.x, result.primal.u)
            # The numbers of a failed element can be so large that their products overflow.
            largest = torch.finfo(self.dtype).max
            violation = violation.nan_to_num(nan=largest, posinf=largest)
        self.result, objective = _within_range(result, self._objective(result), constant, self.dtype)
        result = self.result
        primal, status, floats = result.primal, result.status, (objective, violation)
        if self.needs_grad:  # copies: what the caller does with the outputs must not change the gradient
            primal, status = tuple(v.clone() for v in primal), status.clone()
        if self.dtype != torch.float64:
            primal, floats = (tuple(v.to(self.dtype) for v in values) for values in (primal, floats))
            primal = (primal[0], _inside(primal[1], problem), *primal[2:])
        x, u, lam, mu = primal
        outputs = (x, u, lam, floats[0], mu, status, result.iterations, result.kkt_residual, result.solve_time)
        outputs = (*outputs, floats[1])
        if device.type != "cpu":
            outputs = tuple(v.to(device) for v in outputs)
        if not self.batch:
            return tuple([v.squeeze(0) for v in outputs])
        return outputs if len(self.batch) == 1 else tuple(v.reshape((*self.batch, *v.shape[1:])) for v in outputs)

    def _objective(self, result: Result) -> Tensor:
        """Compute the cost of the plans (batch,), unless the solver has returned it."""
        if result.objective is not None and result.costs_known:
            return result.objective
        objective = self.problem.objective(result.primal.x, result.primal.u)
        if result.objective is None:
            return objective
        return torch.where(result.status == int(Status.CONVERGED), result.objective, objective)

    def flat_guess(self, parts: Mapping[str, Tensor]) -> Primal | None:
        """Make a guess in the form that backends take; multipliers that it lacks are zero."""
        if not parts:
            return None
        flat = []
        for name in GUESS:
            value = parts.get(f"guess.{name}")
            if value is None:
                flat.append(self.problem.no_multipliers())
                continue
            value = value.detach() if value.requires_grad else value
            if value.dtype is not torch.float64 or not value.is_cpu:
                value = value.to("cpu", torch.float64)
            if self.transformed:
                check_tensor("guess", value)
            if not self.batch and value.ndim == 2:
                value = value.unsqueeze(0)
            elif len(self.batch) != 1 or value.ndim != 3:
                value = value.expand(*self.batch, *value.shape[-2:]).reshape(self.problem.batch, *value.shape[-2:])
            flat.append(value)
        return Primal(*flat)

    def pullback(self, tensors: Tensors, outputs: Tensors, grads: Gradients, needs: Sequence[bool]) -> Gradients:
        """Compute the gradients of the inputs from those of x, u, lam and the objective."""
        named = zip(self.names, tensors, needs, strict=True)
        wanted = {name: tensor for name, tensor, needed in named if needed and name in RANKS}
        result, solved = self.result, self.result.solved
        upstream = tuple(self._upstream(i, g) for i, g in enumerate(grads))
        problem = self._unshare(wanted)

        def vjp(keep: Tensor) -> dict[str, Tensor]:
            return self.backend.vjp(problem, result, upstream, keep)  # pyright: ignore[reportArgumentType]

        gradients = {}
        if wanted.keys() - {"constant"}:
            # NaN from the caller is passed on, as everywhere in torch; one that arises here would be an error.
            theirs = not _all_finite(upstream, torch.finfo(torch.float64).max)
            limit = torch.finfo(torch.float32 if self.has_float32 else torch.float64).max
            gradients = vjp(solved) if theirs else _finite(vjp, solved, limit)
        gradients["constant"] = upstream[3]
        for name in wanted.keys() & SYMMETRIC:
            gradients[name] = 0.5 * (gradients[name] + gradients[name].mT)
        return [gradients[name] if name in wanted else None for name in self.names]

    def _upstream(self, index: int, grad: Tensor | None) -> Tensor:
        """Flatten the gradient of one output; that of a failed element becomes zero, so that it cannot spread."""
        like = self.result.primal[index] if index < 3 else self.result.kkt_residual
        if grad is None:
            return torch.zeros_like(like)
        flat = grad.to("cpu", torch.float64).reshape(like.shape)
        return torch.where(self.result.solved.reshape(-1, *[1] * (like.ndim - 1)), flat, 0.0)

    def _unshare(self, wanted: Mapping[str, Tensor]) -> MPCProblem:
        """Expand inputs that were shared, but are to get a gradient for each element."""
        problem, changed = self.problem, {}
        for name in wanted.keys() - {"constant"}:
            lead, shape = wanted[name].shape[: -self.inputs.rank(name)], wanted[name].shape[-self.inputs.rank(name) :]
            if lead == (problem.batch,) and problem.shared(name):
                value = getattr(problem, name).reshape(1, *shape)
                changed[name] = value.expand(problem.batch, *shape).contiguous()
        return replace(problem, **changed) if changed else problem


def _within_range(result: Result, objective: Tensor, constant: Tensor, dtype: torch.dtype) -> tuple[Result, Tensor]:
    """Add the constant to the objective; elements whose numbers `dtype` cannot hold become NUMERICAL.

    The numbers of failed elements are clipped to its range.
    """
    total = objective + constant
    largest = torch.finfo(dtype).max
    if dtype == torch.float64 and _all_within(total, largest / 8) and _all_within(constant, largest / 8):
        return result, total
    held = total.abs() <= largest
    if dtype != torch.float64:
        for value in result.primal:
            held &= (value.abs() <= largest).flatten(1).all(1)
    solved = result.solved
    if bool((held & solved).all()):
        return result, total
    status = torch.where(solved & ~held, int(Status.NUMERICAL), result.status).to(torch.int8)
    failed = ~(solved & held)
    rows = failed[:, None, None]
    primal = Primal(*(torch.where(rows, v.clamp(-largest, largest), v) for v in result.primal))
    room = largest / 4 - constant.abs()
    finite = torch.nan_to_num(objective, nan=largest)
    objective = torch.where(failed, torch.maximum(torch.minimum(finite, room), -room), objective)
    return replace(result, primal=primal, status=status), objective + constant


def _all_within(value: Tensor, limit: float) -> bool:
    return abs(float(value)) <= limit if value.numel() == 1 else bool((value.abs() <= limit).all())


def _inside(u: Tensor, problem: MPCProblem) -> Tensor:
    """Move rounded actions (batch, H, n_u) inside the float64 bounds, if a number of their dtype lies there."""
    u_min, u_max = problem.bounds()
    low, high = u_min.to(u.dtype), u_max.to(u.dtype)
    up, down = torch.full_like(low, torch.inf), torch.full_like(high, -torch.inf)
    low = torch.where(low.double() < u_min, torch.nextafter(low, up), low)
    high = torch.where(high.double() > u_max, torch.nextafter(high, down), high)
    return torch.where(low <= high, torch.minimum(torch.maximum(u, low), high), u)


def _finite(vjp: Callable[[Tensor], dict[str, Tensor]], solved: Tensor, limit: float) -> dict[str, Tensor]:
    """Compute gradients without the elements for which they are not finite; these are found by halving the batch."""
    gradients = vjp(solved)
    if _all_finite(list(gradients.values()), limit):
        return gradients
    total, dropped = {name: torch.zeros_like(value) for name, value in gradients.items()}, 0
    todo = [torch.nonzero(solved).squeeze(-1)]
    while todo:
        index = todo.pop()
        keep = torch.zeros_like(solved)
        keep[index] = True
        gradients = vjp(keep)
        if _all_finite(list(gradients.values()), limit):
            total = {name: value + gradients[name] for name, value in total.items()}
        elif len(index) > 1:
            todo += [index[: len(index) // 2], index[len(index) // 2 :]]
        else:
            dropped += 1
    warn(
        f"the gradient of {dropped} of {len(solved)} solutions is not finite and was left out; check the scale of the "
        f"inputs and of the gradient that arrives at the layer",
        DegenerateWarning,
    )
    return total


def _all_finite(values: Tensors, limit: float) -> bool:
    if limit < torch.finfo(torch.float64).max:
        return all(bool((v.abs() <= limit).all()) for v in values)
    return all_finite(*values)
