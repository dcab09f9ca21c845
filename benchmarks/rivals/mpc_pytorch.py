"""mpc.pytorch (Amos et al.): differentiable box-constrained iLQR in PyTorch; n_lam = 0."""

from __future__ import annotations

from importlib.metadata import version as version_of

import numpy as np
import torch
from mpc import mpc

from rivals.problem import Answer, Problem, Rival


def version() -> str:
    """Of the package mpc."""
    return f"mpc {version_of('mpc')}"


class Solver(Rival):
    """Its `MPC` with a linear system, in float64."""

    batches = differentiates = True

    def __init__(self, problem: Problem):
        super().__init__(problem)
        torch.set_num_threads(1)
        torch.set_default_dtype(torch.float64)
        p, n_x, n_u = problem, problem.n_x, problem.n_u
        # Its last stage has an action too, which is free: a small weight keeps it at zero.
        C = np.zeros((p.horizon + 1, n_x + n_u, n_x + n_u))
        c = np.zeros((p.horizon + 1, n_x + n_u))
        C[:-1, :n_x, :n_x], C[:, n_x:, n_x:], C[-1, :n_x, :n_x] = p.Q, p.R, p.Q_final
        c[:-1, :n_x], c[:-1, n_x:], c[-1, :n_x] = p.q, p.r, p.q_final
        F = np.tile(np.concatenate([p.A, p.B], 1), (p.horizon, 1, 1))
        f = np.tile(p.d, (p.horizon, 1))
        self.data = [torch.from_numpy(v) for v in (C, c, F, f)]
        self.x0 = torch.from_numpy(p.x0)

    def _plan(self, x0: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        p, batch = self.problem, len(x0)
        C, c, F, f = (v.unsqueeze(1).expand(-1, batch, *v.shape[1:]).contiguous() for v in self.data)
        low, high = (torch.from_numpy(v).expand(p.horizon + 1, batch, -1).contiguous() for v in (p.u_min, p.u_max))
        solver = mpc.MPC(
            p.n_x, p.n_u, p.horizon + 1, u_lower=low, u_upper=high, lqr_iter=30, verbose=-1,
            n_batch=batch, exit_unconverged=False, detach_unconverged=False, eps=1e-8,
        )  # fmt: skip
        _, u, _ = solver(x0, mpc.QuadCost(C, c), mpc.LinDx(F, f))
        return u[:-1].transpose(0, 1), u[0]

    def _answer(self, u: torch.Tensor, gradient: np.ndarray | None = None) -> Answer:
        return Answer(u.detach().numpy(), np.ones(len(u), bool), gradient)

    def one(self, i: int) -> Answer:
        """One call for one problem."""
        with torch.no_grad():
            return self._answer(self._plan(self.x0[i : i + 1])[0])

    def all(self) -> Answer:
        """One call for all."""
        with torch.no_grad():
            return self._answer(self._plan(self.x0)[0])

    def gradient(self) -> Answer:
        """One call for all, and back."""
        x0 = self.x0.clone().requires_grad_()
        u, first = self._plan(x0)
        (first @ torch.from_numpy(self.problem.weight)).sum().backward()
        assert x0.grad is not None
        return self._answer(u, x0.grad.numpy())
