"""mpc.pytorch (Amos et al.): differentiable box-constrained iLQR in PyTorch; n_lam = 0."""

import numpy as np
import torch
from mpc import mpc

from rivals.differentiable import TorchRival
from rivals.problem import Problem


class Solver(TorchRival):
    """Its `MPC` with a linear system, in float64."""

    packages = ("mpc",)

    def __init__(self, problem: Problem):
        super().__init__(problem)
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

    def plan(self, x0: torch.Tensor, only: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Run its iLQR."""
        p, batch = self.problem, len(x0)
        C, c, F, f = (v.unsqueeze(1).expand(-1, batch, *v.shape[1:]).contiguous() for v in self.data)
        low, high = (torch.from_numpy(v).expand(p.horizon + 1, batch, -1).contiguous() for v in (p.u_min, p.u_max))
        solver = mpc.MPC(
            p.n_x, p.n_u, p.horizon + 1, u_lower=low, u_upper=high, lqr_iter=30, verbose=-1,
            n_batch=batch, exit_unconverged=False, detach_unconverged=False, eps=1e-8,
        )  # fmt: skip
        _, u, _ = solver(x0, mpc.QuadCost(C, c), mpc.LinDx(F, f))
        return u[:-1].transpose(0, 1), torch.ones(batch, dtype=torch.bool)
