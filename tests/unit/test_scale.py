"""Large problems: that they converge, and in how many iterations."""

from __future__ import annotations

import pytest
import torch

from difflcs import LCSModel
from difflcs.mpc.backends import BatchedBackend
from difflcs.mpc.problem import MPCProblem

ONE_START = BatchedBackend(threads=1, effort="fast")


def problem(system, horizon, limit, weights, goal, action_weight, x0, relaxation=1e-5):
    """Bring the states to a goal."""
    n_u = system["B"].shape[1]
    Q = torch.diag(weights)
    return MPCProblem(
        **system,
        Q=Q,
        R=action_weight * torch.eye(n_u).double(),
        Q_final=Q,
        q=-Q @ goal,
        r=torch.zeros(n_u).double(),
        q_final=-Q @ goal,
        u_min=torch.full((n_u,), -limit).double(),
        u_max=torch.full((n_u,), limit).double(),
        x0=x0,
        horizon=horizon,
        relaxation=relaxation,
    )


def random_problem(n_x, n_u, n_lam, horizon, count=8, seed=0):
    """A model without any structure, in which contacts couple everything."""
    generator = torch.Generator().manual_seed(seed)
    system = LCSModel(n_x, n_u, n_lam, init_scale=0.3, generator=generator).params().detach().tensors()
    x0 = torch.randn(count, n_x, generator=generator, dtype=torch.float64)
    return problem(system, horizon, 1.0, torch.ones(n_x).double(), torch.zeros(n_x).double(), 0.1, x0)


def carts_problem(carts, horizon, count=8, dt=0.05, stiffness=50.0):
    """Carts in a row between two walls: the first one pushes the others."""
    eye, zero = torch.eye(carts).double(), torch.zeros(carts, carts).double()
    gaps = torch.cat([eye[:1], eye[1:] - eye[:-1], -eye[-1:]])
    A = torch.cat([torch.cat([eye, dt * eye], 1), torch.cat([zero, 0.98 * eye], 1)])
    B, C = torch.cat([dt * dt * eye[:, :1], dt * eye[:, :1]]), torch.cat([dt * dt * gaps.T, dt * gaps.T])
    measured = torch.cat([gaps, 0 * gaps], 1)
    system = {"A": A, "B": B, "C": C, "d": torch.zeros(2 * carts).double(), "c": torch.full((carts + 1,), 0.1).double()}
    system |= {"D": measured @ A, "E": measured @ B}
    system["F"] = measured @ C + torch.eye(carts + 1).double() / stiffness
    ones = torch.ones(carts).double()
    draw = 2 * torch.rand(count, 2 * carts, generator=torch.Generator().manual_seed(0)).double() - 1
    x0 = draw * torch.cat([0.1 * ones, 0.3 * ones])
    goal = torch.cat([0.2 * ones, 0 * ones])
    return problem(system, horizon, 5.0, torch.cat([10 * ones, ones]), goal, 0.01, x0, relaxation=1e-4)


@pytest.mark.parametrize(("n_x", "n_u", "n_lam", "horizon"), [(20, 13, 20, 20), (9, 6, 30, 10), (9, 6, 8, 40)])
def test_large_random_problems_converge(n_x, n_u, n_lam, horizon):
    result = ONE_START.solve(random_problem(n_x, n_u, n_lam, horizon), None)
    assert bool(result.solved.all())
    assert float(result.iterations.double().mean()) < 90


def test_iterations_hardly_grow_with_the_horizon():
    short, long = (ONE_START.solve(carts_problem(4, horizon), None) for horizon in (10, 40))
    assert bool(short.solved.all())
    assert bool(long.solved.all())
    assert float(long.iterations.double().mean()) < 2.2 * float(short.iterations.double().mean())
