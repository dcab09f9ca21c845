"""Starts of the batched backend: which optima they reach."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from difflcs import GoalCost, LCSModel, LCSMPCLayer, LCSParams, QuadraticCost
from difflcs.errors import SolveWarning
from difflcs.mpc.backends import BatchedBackend
from difflcs.systems import cart_pole_between_walls

PAIRS = [(3 + 2 * finger + axis, axis) for finger in range(3) for axis in range(2)]
COST = GoalCost.reach(9, 6, (200.0, 200.0, 0.3), (200.0, 200.0, 1.5), 200.0, PAIRS, 10.0, 6.0)


def costs(layer, call, **options):
    mpc = LCSMPCLayer(**layer, backend=BatchedBackend(**options), on_failure="mask")
    with torch.no_grad():
        plan = mpc(*call)
    assert bool(plan.converged.all())
    return plan.objective


@pytest.mark.parametrize("n_lam", [5, 8])
def test_more_effort_finds_better_optima(build, n_lam):
    gaps = {effort: [] for effort in ("fast", "default", "best")}
    for seed in range(1, 5):
        layer = {"lcs": build.pushing(seed, n_lam), "cost": COST, "horizon": 5, "u_min": -0.015, "u_max": 0.015}
        generator = torch.Generator().manual_seed(3)
        x0 = 0.05 * torch.randn(64, 9, generator=generator, dtype=torch.float64)
        goal = 0.05 * torch.randn(64, 3, generator=generator, dtype=torch.float64)
        found = {effort: costs(layer, (x0, goal), effort=effort) for effort in gaps}
        best = torch.minimum(torch.stack(list(found.values())).amin(0), costs(layer, (x0, goal), restarts=32))
        for effort, cost in found.items():
            gaps[effort].append(((cost - best) / best.abs()).mean())
    gap = {effort: float(torch.stack(means).mean()) for effort, means in gaps.items()}
    assert gap["best"] <= gap["default"] <= gap["fast"]
    assert gap["default"] < 0.8 * gap["fast"]
    assert gap["best"] < 0.003


def test_an_unstable_plant_starts_from_its_feedback_law():
    """Without action the pole falls onto a wall, and from there every step leads to leaning on it."""

    def diagonal(*weights):
        return torch.diag(torch.tensor(weights, dtype=torch.float64))

    cost = QuadraticCost(diagonal(1, 1, 0.1, 0.1), diagonal(0.01), diagonal(100, 100, 1, 1))
    layer = {"lcs": cart_pole_between_walls(), "cost": cost, "horizon": 50, "u_min": -10.0, "u_max": 10.0}
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([0.02, 0.05, 0.1, 0.3], dtype=torch.float64)
    x0 = size * (2 * torch.rand(32, 4, generator=generator, dtype=torch.float64) - 1)
    ours, best = costs(layer, (x0,)), costs(layer, (x0,), restarts=32)
    assert float((ours <= 1.001 * best).double().mean()) >= 0.9


@pytest.mark.parametrize(("limit", "effort"), [(50.0, "default"), (float("inf"), "best")])
def test_a_contact_that_is_far_is_found(limit, effort):
    """Three carts in a row: only who strikes the first one at once moves the last one before the end."""
    gap, dt, carts, horizon = 0.2, 0.1, 3, 10
    eye = torch.eye(carts, dtype=torch.float64)
    gaps = eye[1:] - eye[:-1]
    A = torch.cat([torch.cat([eye, dt * eye], 1), torch.cat([0 * eye, eye], 1)])
    B, C = torch.cat([dt * dt * eye[:, :1], dt * eye[:, :1]]), torch.cat([dt * dt * gaps.T, dt * gaps.T])
    measured = torch.cat([gaps, 0 * gaps], 1)
    F = measured @ C + 1e-3 * torch.eye(carts - 1, dtype=torch.float64)
    ends = torch.full((carts - 1,), gap, dtype=torch.float64)
    lcs = LCSParams(A=A, B=B, C=C, d=torch.zeros(6, dtype=torch.float64), D=measured @ A, E=measured @ B, F=F, c=ends)
    Q = torch.diag(torch.tensor([0.1, 0.0, 10.0, 0.01, 0.01, 0.01], dtype=torch.float64))
    q = torch.tensor([0.0, 0.0, -3.0, 0.0, 0.0, 0.0], dtype=torch.float64)  # the last one shall be at 0.3
    R = torch.tensor([[1e-4]], dtype=torch.float64)
    layer = {"lcs": lcs, "cost": QuadraticCost(Q, R, 10 * Q, q=q, q_final=10 * q), "horizon": horizon}
    bounds = {"u_min": -limit, "u_max": limit}
    x0 = torch.randn(32, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.1
    x0[:, 3:] = 0
    ours, best = (costs(layer | bounds, (x0,), **options) for options in ({"effort": effort}, {"restarts": 64}))
    assert float((ours <= best + 1e-3 * best.abs()).double().mean()) >= 0.9


def test_a_guess_is_the_only_start_unless_the_best_is_wanted(build):
    layer = {"lcs": build.pushing(1, 8), "cost": COST, "horizon": 5, "u_min": -0.015, "u_max": 0.015}
    generator = torch.Generator().manual_seed(4)
    x0 = 0.05 * torch.randn(32, 9, generator=generator, dtype=torch.float64)
    goal = 0.05 * torch.randn(32, 3, generator=generator, dtype=torch.float64)
    poor = LCSMPCLayer(**layer, backend=BatchedBackend(effort="fast"))(x0, goal)
    stays = LCSMPCLayer(**layer)(x0, goal, guess=poor)
    moves = LCSMPCLayer(**layer, backend=BatchedBackend(effort="best"))(x0, goal, guess=poor)
    assert torch.allclose(stays.objective, poor.objective, rtol=1e-9, atol=0)
    assert bool((moves.objective <= poor.objective * (1 + 1e-9)).all())
    assert bool((moves.objective < poor.objective * (1 - 1e-3)).any())


def test_plans_of_many_contacts_get_more_starts():
    def starts(horizon, n_lam, guessed, **options):
        problem = SimpleNamespace(horizon=horizon, n_lam=n_lam)
        efforts = [options] if options else [{"effort": effort} for effort in ("fast", "default", "best")]
        return [BatchedBackend(**one).starts(problem, guessed) for one in efforts]

    assert starts(5, 8, guessed=False) == [1, 4, 16]
    assert starts(5, 8, guessed=True) == [1, 1, 16]
    assert starts(20, 5, guessed=False) == [1, 16, 64]
    assert starts(20, 5, guessed=True) == [1, 1, 64]
    assert starts(20, 5, guessed=True, restarts=5) == starts(5, 5, guessed=False, restarts=5) == [5]


def test_what_was_given_up_is_solved_where_all_else_fails():
    """With few iterations: 22 of 192 are not solved, and 31 where no start gets a second chance."""
    lcs = LCSModel(9, 6, 8, init_scale=0.3, generator=torch.Generator().manual_seed(2)).params().detach()
    eye = torch.eye(9, dtype=torch.float64)
    cost = QuadraticCost(eye, 0.1 * eye[:6, :6], eye)
    x0 = torch.randn(64, 9, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    failed = 0
    for max_iter in (27, 30, 32):
        backend = BatchedBackend(restarts=4, max_iter=max_iter)
        mpc = LCSMPCLayer(lcs, cost, 30, -1.0, 1.0, backend=backend, on_failure="mask")
        with pytest.warns(SolveWarning):
            failed += int((~mpc(x0).converged).sum())
    assert failed <= 26


def test_one_start_is_enough_without_contact(build):
    lcs = build.pushing(1, 5)
    free = LCSParams(lcs.A, lcs.B, lcs.C[:, :0], lcs.d, lcs.D[:0], lcs.E[:0], lcs.F[:0, :0], lcs.c[:0])
    x0, goal = 0.05 * torch.ones(4, 9, dtype=torch.float64), torch.zeros(4, 3, dtype=torch.float64)
    plans = [
        LCSMPCLayer(free, COST, 5, -0.015, 0.015, backend=BatchedBackend(effort=e))(x0, goal) for e in ("fast", "best")
    ]
    assert torch.equal(plans[0].u, plans[1].u)
    assert torch.equal(plans[0].iterations, plans[1].iterations)
