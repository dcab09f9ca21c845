"""The MPC as one node of the autograd graph."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from difflcs.errors import DegenerateWarning, DoubleBackwardError
from difflcs.mpc.backends.base import Backend, Result
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.mpc.solution import Primal
from difflcs.status import Status


class SolveMPC(torch.autograd.Function):
    """Tensors (in the order of `INPUTS`) → x, u, lam, mu, objective, status, iterations, kkt_residual, solve_time.

    `dtype` is that of x, u and lam; the objective stays in float64, without the cost's `constant` (batch,), which only
    counts for what `dtype` can hold. `smallest` is the narrowest dtype in which a gradient will arrive.
    """

    @staticmethod
    def forward(  # noqa: D102
        ctx,
        problem: MPCProblem,
        backend: Backend,
        guess: Primal | None,
        dtype: torch.dtype,
        smallest: torch.dtype,
        constant: Tensor,
        *tensors: Tensor,
    ):
        # `problem` holds the values of `tensors`; these are here to receive gradients, and are saved so that autograd
        # refuses them where they were changed in place.
        result = backend.solve(problem, guess)
        objective = problem.objective(result.primal.x, result.primal.u)
        result, objective = _within_range(result, objective, constant, dtype)
        ctx.problem, ctx.backend, ctx.result, ctx.limit = problem, backend, result, torch.finfo(smallest).max
        ctx.save_for_backward(*tensors)
        # Copies: what the caller does with the outputs must not change the gradient.
        x, u, lam, mu = (v.to(dtype, copy=any(ctx.needs_input_grad)) for v in result.primal)
        u = _inside(u, problem) if dtype != torch.float64 else u
        violation = problem.violation(result.primal.x, result.primal.u).to(dtype)
        info = result.status.clone(), result.iterations, result.kkt_residual, result.solve_time, violation
        ctx.mark_non_differentiable(mu, *info)
        return x, u, lam, mu, objective, *info

    @staticmethod
    def backward(ctx, *grads: Tensor):  # noqa: D102
        if torch.is_grad_enabled():
            raise DoubleBackwardError("LCSMPCLayer has first derivatives only; expected create_graph=False")
        _ = ctx.saved_tensors  # raises where one was changed in place
        result: Result = ctx.result
        solved = result.solved
        # Whatever comes upstream for a failed element is dropped before it can meet the others.
        upstream = tuple(
            torch.where(solved.reshape(-1, *[1] * (g.ndim - 1)), g.double(), 0.0) for g in (*grads[:3], grads[4])
        )

        def vjp(keep: Tensor) -> dict[str, Tensor]:
            return ctx.backend.vjp(ctx.problem, result, upstream, keep)

        # NaN that comes from the caller goes back to the caller, as everywhere in torch; our own would be an error.
        theirs = not _all_finite(upstream, torch.finfo(torch.float64).max)
        gradients = vjp(solved) if theirs else _finite(vjp, solved, ctx.limit)
        needed = ctx.needs_input_grad[6:]
        return *[None] * 6, *(gradients[k] if n else None for k, n in zip(INPUTS, needed, strict=True))


def _within_range(result: Result, objective: Tensor, constant: Tensor, dtype: torch.dtype) -> tuple[Result, Tensor]:
    """Elements whose numbers `dtype` cannot hold become NUMERICAL; those that failed get numbers that it can."""
    largest = torch.finfo(dtype).max
    total = objective + constant
    held = total.abs() <= largest
    if dtype != torch.float64:
        for value in result.primal:
            held &= (value.abs() <= largest).flatten(1).all(1)
    solved = result.solved
    if bool((held & solved).all()):
        return result, objective
    status = torch.where(solved & ~held, int(Status.NUMERICAL), result.status).to(torch.int8)
    failed = ~(solved & held)
    rows = failed[:, None, None]
    primal = Primal(*(torch.where(rows, v.clamp(-largest, largest), v) for v in result.primal))
    room = largest / 4 - constant.abs()  # the caller adds the constant
    finite = torch.nan_to_num(objective, nan=largest)
    objective = torch.where(failed, torch.maximum(torch.minimum(finite, room), -room), objective)
    return replace(result, primal=primal, status=status), objective


def _inside(u: Tensor, problem: MPCProblem) -> Tensor:
    """Rounded actions (batch, H, n_u), inside the bounds in float64 too where a number of their dtype lies there."""
    u_min, u_max = problem.bounds()
    low, high = u_min.to(u.dtype), u_max.to(u.dtype)
    up, down = torch.full_like(low, torch.inf), torch.full_like(high, -torch.inf)
    low = torch.where(low.double() < u_min, torch.nextafter(low, up), low)
    high = torch.where(high.double() > u_max, torch.nextafter(high, down), high)
    return torch.where(low <= high, torch.minimum(torch.maximum(u, low), high), u)


def _finite(vjp: Callable[[Tensor], dict[str, Tensor]], solved: Tensor, limit: float) -> dict[str, Tensor]:
    """Gradients without the elements whose own are not finite; they are found by halving the batch."""
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
    warnings.warn(
        f"the gradient of {dropped} of {len(solved)} solutions is not finite and was left out; check the scale of the "
        f"inputs and of the gradient that arrives at the layer",
        DegenerateWarning,
        stacklevel=2,
    )
    return total


def _all_finite(values: Sequence[Tensor], limit: float) -> bool:
    if limit < torch.finfo(torch.float64).max:
        return all(bool((v.abs() <= limit).all()) for v in values)
    # A finite sum has finite terms; large terms can overflow it.
    return math.isfinite(sum(float(v.sum()) for v in values)) or all(bool(torch.isfinite(v).all()) for v in values)
