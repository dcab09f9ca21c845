"""cvxpylayers: a convex program as a PyTorch layer; n_lam = 0."""

import cvxpy as cp
import numpy as np
import torch
from cvxpylayers.torch import CvxpyLayer

from rivals.differentiable import TorchRival
from rivals.problem import Problem

PLAIN = {"solve_method": "Clarabel"}
# The default of its derivative, mode "lsqr", was off by the size of the gradient on these problems.
EXACT = {**PLAIN, "mode": "dense"}


class Solver(TorchRival):
    """The program over actions and states with x0 as its parameter."""

    packages = ("cvxpylayers", "cvxpy")

    def __init__(self, problem: Problem):
        super().__init__(problem)
        p = problem
        x, u, x0 = cp.Variable((p.horizon + 1, p.n_x)), cp.Variable((p.horizon, p.n_u)), cp.Parameter(p.n_x)
        cost, limits = 0, [x[0] == x0, u <= np.tile(p.u_max, (p.horizon, 1)), u >= np.tile(p.u_min, (p.horizon, 1))]
        for k in range(p.horizon + 1):
            Q, q = (p.Q, p.q) if k < p.horizon else (p.Q_final, p.q_final)
            cost += cp.sum_squares(_root(Q) @ x[k]) / 2 + q @ x[k]
            if k < p.horizon:
                cost += cp.sum_squares(_root(p.R) @ u[k]) / 2 + p.r @ u[k]
                limits.append(x[k + 1] == p.A @ x[k] + p.B @ u[k] + p.d)
        self.layer = CvxpyLayer(cp.Problem(cp.Minimize(cost), limits), parameters=[x0], variables=[u])

    def plan(self, x0: torch.Tensor, only: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Call the layer."""
        (u,) = self.layer(x0, solver_args=EXACT if x0.requires_grad else PLAIN)
        return u, torch.ones(len(u), dtype=torch.bool)


def _root(weight: np.ndarray) -> np.ndarray:
    value, vectors = np.linalg.eigh(weight)
    return np.sqrt(value.clip(0))[:, None] * vectors.T
