"""Backend `ipopt` on what a problem may be: stages, cross terms, infinite bounds, no contact, constraints."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from difflcs import Status
from difflcs.mpc import MPCProblem, Primal
from difflcs.mpc.backends import IpoptBackend, base
from difflcs.mpc.problem import INPUTS, STAGES

pytestmark = pytest.mark.usefixtures("one_thread")

BATCH, HORIZON = 3, 4
SOLVER = IpoptBackend(workers=1)
CONVERGED, DEGENERATE = int(Status.CONVERGED), int(Status.DEGENERATE)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def contact_problem(build, seed=0, by_stage=False, batch=BATCH):
    """Everything at once: contact, S, one infinite bound, and hard and soft constraints that act."""
    n = build.normal(seed + 100)
    t = {**build.lcs_tensors(seed), **build.cost_tensors(seed), "S": 0.2 * n(4, 2)}
    t |= {"u_min": tensor(-0.12, -torch.inf), "u_max": tensor(0.12, 0.15)}
    if by_stage:
        for name in [name for name in t if STAGES[name] == "H"]:
            entries = [1] * t[name].ndim if name in ("Q", "R", "F", "u_min", "u_max") else t[name].shape
            t[name] = t[name] * (1 + 0.1 * n(1, HORIZON, *entries).clamp(-2, 2))
    problem = MPCProblem(**t, x0=0.2 * build.normal(seed + 7)(batch, 4), horizon=HORIZON, relaxation=1e-4)
    stages = (1, HORIZON + 1) if by_stage else ()
    G_x, G_u = n(*stages, 3, 4), n(*stages[:1], *([HORIZON] if stages else []), 3, 2)
    G_u[..., 2, :] = 0.0
    price = tensor(torch.inf, 0.02, torch.inf).expand(*stages, 3).clone()
    loose = dataclasses.replace(problem, G_x=G_x, G_u=G_u, g=torch.full((3,), 90.0, dtype=torch.float64), price=price)
    plan = SOLVER.solve(loose, None).primal
    u = loose.clip(0.8 * plan.u + 0.02 * n(*plan.u.shape))  # a plan that all constraints allow
    best, other = (loose.constraints(x, v) + 90.0 for x, v in ((plan.x, plan.u), (loose.rollout(u)[0], u)))
    g = torch.where(other < best, 0.5 * (best + other), torch.maximum(best, other) + 0.3)
    g = torch.where(n(*g.shape) < 0.3, g, torch.inf)
    g[:, 0, 2] = torch.inf
    return dataclasses.replace(loose, g=g)


def linear_problem(build, seed=0, batch=BATCH, bound=torch.inf, **changes):
    """Without contact."""
    t = {**build.lcs_tensors(seed, n_lam=0), **build.cost_tensors(seed)}
    limit = torch.full((2,), bound, dtype=torch.float64)
    x0 = build.normal(seed + 7)(batch, 4)
    return MPCProblem(
        **{**t, "u_min": -limit, "u_max": limit, "x0": x0, "horizon": HORIZON, "relaxation": 1e-4, **changes}
    )


# --- gradients --------------------------------------------------------------------------------------------------------


def test_with_a_barrier_and_constraints_the_gradient_is_that_of_finite_differences(build):
    problem = contact_problem(build)
    problem = dataclasses.replace(problem, u_min=tensor(-0.2, -0.3), u_max=tensor(0.2, 0.3), barrier=1e-3)
    result = SOLVER.solve(problem, None)
    assert result.status.tolist() == [CONVERGED] * BATCH
    assert bool(result.linearisation.held.any())
    n = build.normal(3)
    weight = n(*result.primal.u.shape)
    upstream = (
        torch.zeros_like(result.primal.x),
        weight,
        torch.zeros_like(result.primal.lam),
        torch.zeros(BATCH).double(),
    )
    gradients = SOLVER.vjp(problem, result, upstream, result.solved)
    for name in ("u_max", "g", "x0", "B"):
        direction = n(*getattr(problem, name).shape) * torch.isfinite(getattr(problem, name))
        ends = [
            SOLVER.solve(dataclasses.replace(problem, **{name: getattr(problem, name) + h * direction}), result.primal)
            for h in (1e-6, -1e-6)
        ]
        quotient = float((weight * (ends[0].primal.u - ends[1].primal.u)).sum()) / 2e-6
        assert float((gradients[name] * direction).sum()) == pytest.approx(quotient, rel=1e-5, abs=1e-6), name


@pytest.mark.parametrize("batch", [0, 1])
def test_no_problem_and_one_step_are_problems_too(build, batch):
    eye = torch.eye(2, dtype=torch.float64)
    problem = reach(build, torch.zeros(batch, 2, dtype=torch.float64))
    short = dataclasses.replace(problem, g=problem.g[:, -2:], horizon=1)
    for each in (problem, short):
        result = SOLVER.solve(each, None)
        assert len(result.status) == batch
        grads = (*(torch.ones_like(v) for v in result.primal[:3]), torch.ones(batch, dtype=torch.float64))
        found = SOLVER.vjp(each, result, grads, result.solved)
        assert all(found[name].shape == getattr(each, name).shape for name in INPUTS)
        torch.testing.assert_close(found["R"], torch.zeros_like(eye), rtol=0, atol=1e-9)


# --- the same problem said in another way -----------------------------------------------------------------------------


def test_workers_give_the_bits_of_this_process(build):
    problem = contact_problem(build, by_stage=True, batch=6)
    one, two = SOLVER.solve(problem, None), IpoptBackend(workers=2).solve(problem, None)
    for a, b in zip(one.primal, two.primal, strict=True):
        assert torch.equal(a, b)


# --- what cannot be met -----------------------------------------------------------------------------------------------


def reach(build, target, price=torch.inf):
    """x₊ = x + u with |u| ≤ 0.1 in two directions; x_1 ≤ target, one number per element and direction."""
    eye, zero = torch.eye(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    batch = len(target)
    g = torch.full((batch, HORIZON + 1, 2), torch.inf, dtype=torch.float64)
    g[:, HORIZON] = target
    empty = {"C": zero[:, None][:, :0], "D": eye[:0], "E": eye[:0], "F": eye[:0, :0], "c": zero[:0]}
    limit, price = tensor(0.1, 0.1), torch.full((2,), price, dtype=torch.float64)
    return MPCProblem(
        **empty, A=eye, B=eye, d=zero, Q=0.1 * eye, R=eye, Q_final=eye, q=zero, r=zero, q_final=zero,
        u_min=-limit, u_max=limit, G_x=eye, G_u=0 * eye, g=g, price=price,
        x0=torch.zeros(batch, 2, dtype=torch.float64), horizon=HORIZON, relaxation=1e-4,
    )  # fmt: skip


def test_what_cannot_be_met_is_infeasible_and_violates_as_little_as_can_be(build):
    target = torch.stack([tensor(-0.2, 1.0), tensor(-1.4, -0.5), tensor(-0.3, -0.1), tensor(-0.7, -0.1)])
    problem = reach(build, target)
    result = SOLVER.solve(problem, None)
    assert result.status.tolist() == [CONVERGED, Status.INFEASIBLE, CONVERGED, Status.INFEASIBLE]
    violation = problem.violation(result.primal.x, result.primal.u)
    torch.testing.assert_close(violation, tensor(0.0, 1.0, 0.0, 0.3), rtol=0, atol=1e-6)
    assert all(bool(torch.isfinite(v).all()) for v in result.primal)
    assert bool((result.primal.u.abs() <= 0.1).all())
    for i in (0, 2):  # the others do not notice
        alone = SOLVER.solve(problem.select(torch.tensor([i])), None)
        for a, b in zip(alone.primal, result.primal, strict=True):
            torch.testing.assert_close(a[0], b[i], rtol=0, atol=1e-14)
    # The unsolved have no gradient, and spoil that of nobody.
    n = build.normal(2)
    grads = (*(n(*v.shape) for v in result.primal[:3]), n(4))
    gradients = SOLVER.vjp(problem, result, grads, result.solved)
    assert bool(torch.isfinite(torch.cat([v.flatten() for k, v in gradients.items() if k != "price"])).all())
    assert torch.equal(gradients["x0"][[1, 3]], torch.zeros(2, 2, dtype=torch.float64))
    assert float(gradients["x0"][0].abs().max()) > 0


def test_contact_that_cannot_hold_a_constraint_keeps_its_plan(build):
    problem = contact_problem(build)
    g = problem.g.clone()
    g[1, 2] = -20.0
    result = SOLVER.solve(dataclasses.replace(problem, g=g, price=torch.full((3,), torch.inf).double()), None)
    assert result.status[1] == Status.INFEASIBLE
    assert bool(torch.isfinite(torch.cat([v.flatten() for v in result.primal])).all())
    assert bool((result.primal.u[1] != 0).any())


# --- what is not differentiable ---------------------------------------------------------------------------------------


def test_constraints_that_depend_on_each_other_are_degenerate(build):
    target = tensor(-0.2, -0.2).unsqueeze(0)
    single = reach(build, target)
    double = {"G_x": torch.cat([single.G_x, single.G_x[:1]]), "G_u": torch.zeros(3, 2).double()}
    double |= {"g": torch.cat([single.g, single.g[..., :1]], -1), "price": torch.full((3,), torch.inf).double()}
    one, two = (SOLVER.solve(p, None) for p in (single, dataclasses.replace(single, **double)))
    assert (one.status.tolist(), two.status.tolist()) == ([CONVERGED], [DEGENERATE])
    torch.testing.assert_close(one.primal.u, two.primal.u, rtol=0, atol=1e-9)
    shared = two.primal.mu[0, HORIZON]
    torch.testing.assert_close(shared[0] + shared[2], one.primal.mu[0, HORIZON, 0], rtol=0, atol=1e-6)


def test_a_constraint_that_is_just_met_is_degenerate(build):
    free = SOLVER.solve(reach(build, tensor(5.0, 5.0).unsqueeze(0)), None).primal
    touched = reach(build, free.x[:, HORIZON])
    assert SOLVER.solve(touched, None).status.tolist() == [DEGENERATE]


def test_a_solver_without_multipliers_may_leave_them_out(build):
    problem = linear_problem(build)
    x, u = SOLVER.solve(problem, None).primal[:2]
    zeros = torch.zeros(BATCH)
    lam = torch.zeros(BATCH, HORIZON, 0, dtype=torch.float64)
    result = base.certify(problem, Primal(x, u, lam), zeros.to(torch.int8), zeros.int(), zeros.double(), 1e-6)
    assert result.status.tolist() == [CONVERGED] * BATCH
    assert result.primal.mu.shape == (BATCH, HORIZON + 1, 0)
