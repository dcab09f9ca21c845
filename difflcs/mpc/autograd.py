"""The MPC as one node of the autograd graph."""

from __future__ import annotations

import torch
from torch import Tensor

from difflcs.errors import DoubleBackwardError
from difflcs.mpc.backends.base import Backend, Result
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.mpc.solution import Primal
from difflcs.status import Status


class SolveMPC(torch.autograd.Function):
    """Tensors (in the order of `INPUTS`) → x, u, lam, objective, status, iterations, kkt_residual, solve_time."""

    @staticmethod
    def forward(ctx, problem: MPCProblem, backend: Backend, guess: Primal | None, *tensors: Tensor):  # noqa: D102
        # `problem` holds the values of `tensors`; these are here only to receive gradients.
        result = backend.solve(problem, guess)
        ctx.problem, ctx.backend, ctx.result = problem, backend, result
        # Aliases: if the outputs themselves were kept for backward, they would hold this node and it them, a cycle that
        # only the garbage collector breaks.
        x, u, lam = (v.detach() for v in result.primal)
        outputs = (x, u, lam, problem.objective(x, u))
        info = tuple(v.detach() for v in (result.status, result.iterations, result.kkt_residual, result.solve_time))
        ctx.mark_non_differentiable(*info)
        return *outputs, *info

    @staticmethod
    def backward(ctx, *grads: Tensor):  # noqa: D102
        if torch.is_grad_enabled():
            raise DoubleBackwardError("LCSMPCLayer has first derivatives only; expected create_graph=False")
        result: Result = ctx.result
        solved = (result.status == Status.CONVERGED) | (result.status == Status.DEGENERATE)
        # Whatever comes upstream for a failed element is dropped before it can meet the others.
        upstream = tuple(
            torch.where(solved.reshape(-1, *[1] * (g.ndim - 1)), g, torch.zeros_like(g)) for g in grads[:4]
        )
        gradients = ctx.backend.vjp(ctx.problem, result, upstream, solved)
        needed = ctx.needs_input_grad[3:]
        return None, None, None, *(gradients[k] if n else None for k, n in zip(INPUTS, needed, strict=True))
