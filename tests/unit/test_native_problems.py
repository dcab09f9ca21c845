"""The kernels on every kind of problem: the same gradients and residuals as the reference, and what must not matter."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from difflcs import GoalCost, LCSMPCLayer, LCSParams, LinearConstraints, QuadraticCost, Status
from difflcs.mpc import kkt
from difflcs.mpc.backends import BatchedBackend
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.systems import cart_pole_between_walls
from tests.problems import KINDS, Kind, random_problem, stated_by_stage

BATCHED = BatchedBackend(threads=1)


def upstream(problem, seed=3):
    generator = torch.Generator().manual_seed(seed)
    shapes = [(problem.horizon + 1, problem.n_x), (problem.horizon, problem.n_u), (problem.horizon, problem.n_lam), ()]
    return tuple(torch.randn(problem.batch, *shape, generator=generator, dtype=torch.float64) for shape in shapes)


def assert_same_gradients(problem, result):
    grads = upstream(problem)
    ours = BATCHED.vjp(problem, result, grads, result.solved)
    reference = kkt.vjp(problem, kkt.linearise(problem, result.primal), grads, result.solved)
    for name in INPUTS:
        if ours[name].numel():
            scale = float(reference[name].abs().max())
            torch.testing.assert_close(ours[name], reference[name], rtol=0, atol=1e-8 * max(scale, 1e-12), msg=name)


@pytest.mark.parametrize("kind", KINDS)
def test_the_native_adjoint_equals_the_reference(kind):
    problem = random_problem(0, KINDS[kind])
    result = BATCHED.solve(problem, None)
    assert int(result.solved.sum()) >= 0.8 * problem.batch
    if problem.n_c:
        assert float((result.primal.mu > 0).flatten(1).any(1).double().mean()) >= 0.5
    assert_same_gradients(problem, result)


@pytest.mark.parametrize("n_lam", [5, 8, 3])
@pytest.mark.parametrize("barrier", [0.0, 1e-2])
@pytest.mark.parametrize("shared", [True, False])
def test_the_native_adjoint_equals_the_reference_on_pushing(build, n_lam, barrier, shared):
    cost = GoalCost.reach(9, 6, goal_weight=[1.0, 1.0, 0.1], input_weight=10.0, pairs=[(3, 0), (4, 1)], pair_weight=0.1)
    lcs = build.pushing(0, n_lam)
    if not shared:
        n = build.normal(2)
        lcs = LCSParams(**{k: v * (1 + 0.01 * n(40, *[1] * v.ndim)) for k, v in lcs.tensors().items()})
    n = build.normal(1)
    mpc = LCSMPCLayer(lcs, cost, 5, -0.015, 0.015, backend=BATCHED, barrier=barrier)
    problem = mpc(0.05 * n(40, 9), 0.05 * n(40, 3)).problem
    assert_same_gradients(problem, BATCHED.solve(problem, None))


@pytest.mark.parametrize("kind", KINDS)
def test_the_certificate_is_the_residual_of_the_reference(kind):
    problem = random_problem(1, KINDS[kind])
    result = BATCHED.solve(problem, None)
    # At a plan that is no solution, so that every part of it is large.
    wrong = result.primal._replace(u=problem.clip(result.primal.u + 0.01))
    for primal in (result.primal, wrong):
        dual = kkt.multipliers(problem, primal)
        reference = kkt.residual(problem, primal, dual)
        if primal is result.primal:
            difference = (result.kkt_residual - reference).abs()[result.solved]
            assert float(difference.max()) < 1e-8
        else:
            assert float(reference.min()) > 1e-6


ALONE = KINDS | {f"9, 6, {n_lam}": Kind(n_x=9, n_u=6, n_lam=n_lam, horizon=5) for n_lam in (5, 8)}


@pytest.mark.parametrize("barrier", [0.0, 0.01])
@pytest.mark.parametrize("kind", ALONE)
def test_a_problem_alone_has_the_numbers_that_it_has_among_others(kind, barrier):
    """Alone it is solved by other code, see difflcs/_native/single.hpp."""
    kind = replace(ALONE[kind], unbounded=ALONE[kind].unbounded and not barrier)  # a barrier needs bounds
    problem = replace(random_problem(5, kind), barrier=barrier)
    unfinished = replace(BATCHED, max_iter=2, restarts=1)
    for backend in (BATCHED, unfinished):
        cold = backend.solve(problem, None)
        guess = type(cold.primal)(*(0.9 * value for value in cold.primal))
        warm = backend.solve(problem, guess)
        for i in range(0, problem.batch, 4):
            one = problem.select(torch.tensor([i]))
            for result, start in ((cold, None), (warm, type(guess)(*(value[[i]] for value in guess)))):
                alone = backend.solve(one, start)
                for a, b in zip(alone.primal, result.primal, strict=True):
                    assert torch.equal(a[0], b[i])
                for name in ("status", "iterations", "kkt_residual", "objective"):
                    assert getattr(alone, name)[0] == getattr(result, name)[i]


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_given_by_stage_gives_the_same_plan(kind):
    problem = random_problem(2, KINDS[kind])
    again = stated_by_stage(problem)
    assert any(again.by_stage(name) for name in INPUTS)
    one, other = BATCHED.solve(problem, None), BATCHED.solve(again, None)
    for a, b in zip(one.primal, other.primal, strict=True):
        assert torch.equal(a, b)
    assert torch.equal(one.status, other.status)
    grads = upstream(problem)
    ours, theirs = (BATCHED.vjp(p, r, grads, r.solved) for p, r in ((problem, one), (again, other)))
    for name in INPUTS:
        # Of a field that is given by stage, the gradients of the stages add up to that of the constant.
        total = theirs[name].sum(1) if again.by_stage(name) and not problem.by_stage(name) else theirs[name]
        total = total[0] if problem.shared(name) and total.ndim > ours[name].ndim else total
        scale = 1e-10 * float(ours[name].abs().max()) if ours[name].numel() else 0.0
        torch.testing.assert_close(total.reshape(ours[name].shape), ours[name], rtol=0, atol=scale, msg=name)


@pytest.mark.parametrize("kind", ["constraints", "the paper's sizes"])
def test_infeasible_elements_are_said_and_leave_the_others_alone(kind):
    problem = random_problem(3, KINDS[kind])
    alone = BATCHED.solve(problem, None)
    g = problem.g.clone()
    g[[2, 7], 1:, 0] = -1e3  # nothing can do this
    result = BATCHED.solve(replace(problem, g=g), None)
    assert result.status[[2, 7]].tolist() == [Status.INFEASIBLE] * 2
    others = torch.ones(problem.batch, dtype=torch.bool)
    others[[2, 7]] = False
    for a, b in zip(alone.primal, result.primal, strict=True):
        assert torch.equal(a[others], b[others])
        assert bool(b.isfinite().all())
    gradients = BATCHED.vjp(problem, result, upstream(problem), result.solved)
    assert not gradients["x0"][[2, 7]].any()
    assert gradients["x0"][others].any()


def one_state_from(x0, growth, stage, least):
    """x₊ = growth x + u with |u| ≤ 1 over three steps, and x ≥ least asked for at one stage."""
    one = torch.ones(1, 1, dtype=torch.float64)
    g = torch.full((1, 4, 1), torch.inf, dtype=torch.float64)
    g[:, stage] = -least
    empty = torch.zeros(1, 0, dtype=torch.float64)
    return MPCProblem(
        A=growth * one, B=one, C=empty, d=one[0] * 0, D=empty.mT, E=empty.mT, F=empty[:, :0].reshape(0, 0), c=empty[0],
        Q=one, R=one, Q_final=one, q=one[0] * 0, r=one[0] * 0, q_final=one[0] * 0, u_min=-one[0], u_max=one[0],
        G_x=-one, G_u=0 * one, g=g, price=one[0] * torch.inf, x0=x0 * one, horizon=3, relaxation=1e-4,
    )  # fmt: skip


def test_an_infeasible_plan_violates_as_little_as_can_be():
    """From 0, x cannot be above 10 after 3 steps; the least violation in squares has u = 1."""
    problem = one_state_from(0.0, growth=1.0, stage=3, least=10.0)
    result = BATCHED.solve(problem, None)
    assert result.status.tolist() == [Status.INFEASIBLE]
    torch.testing.assert_close(problem.violation(result.primal.x, result.primal.u), torch.tensor([7.0]).double())


def test_a_violation_is_measured_by_the_stages_where_the_row_counts():
    """From 100, x is at most 301 after a step, where 1000 are asked for; later it is far above that."""
    problem = one_state_from(100.0, growth=3.0, stage=1, least=1000.0)
    result = BATCHED.solve(problem, None)
    assert result.status.tolist() == [Status.INFEASIBLE]
    expected = torch.tensor([(1000 - 301) / (1000 + 301)], dtype=torch.float64)
    torch.testing.assert_close(result.kkt_residual, expected)
    torch.testing.assert_close(kkt.residual(problem, result.primal, kkt.multipliers(problem, result.primal)), expected)


@pytest.mark.parametrize("price", [torch.inf, 10.0])
@pytest.mark.parametrize("x0", [0.0, 1e-12])
def test_nothing_is_infeasible_where_nothing_hard_is_violated(price, x0):
    """At rest beside a wall at zero all terms of its row vanish, and a rounding error is as large as they are."""
    problem = one_state_from(x0, growth=1.0, stage=1, least=0.0)
    problem = replace(
        problem, q=problem.q + 1.0, q_final=problem.q_final + 1.0, price=0 * problem.price.nan_to_num() + price
    )
    result = BATCHED.solve(replace(problem, g=torch.zeros_like(problem.g)), None)
    assert problem.violation(result.primal.x, result.primal.u).max() <= 1e-11
    assert result.status.tolist() != [Status.INFEASIBLE]


def test_rows_without_a_limit_change_nothing():
    problem = random_problem(4, KINDS["plain"])
    rows = {"G_x": torch.ones(3, 4).double(), "G_u": torch.ones(3, 2).double(), "price": torch.full((3,), torch.inf)}
    free = replace(problem, **{k: v.double() for k, v in rows.items()}, g=torch.full((3,), torch.inf).double())
    one, other = BATCHED.solve(problem, None), BATCHED.solve(free, None)
    torch.testing.assert_close(other.primal.u, one.primal.u, rtol=0, atol=1e-9)
    assert not other.primal.mu.any()


@pytest.mark.parametrize("weight", [None, 1e2, 1e4])
@pytest.mark.parametrize("limit", [0.05, 0.03])
def test_limits_far_from_the_actions_that_they_act_through_are_met(weight, limit):
    """The position of a cart answers to a force by the square of the time step; costs by IPOPT."""
    eye = torch.diag(torch.tensor([10.0, 10.0, 1.0, 1.0], dtype=torch.float64))
    cost = QuadraticCost(eye, 0.1 * torch.ones(1, 1, dtype=torch.float64), 10 * eye)
    row = torch.tensor([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]], dtype=torch.float64)
    rows = LinearConstraints(row, torch.full((2,), limit, dtype=torch.float64), weight=weight)
    backend = BatchedBackend(effort="fast")  # one start, so that the iterations are those of one solve
    mpc = LCSMPCLayer(cart_pole_between_walls(), cost, 25, -2.0, 2.0, backend=backend, constraints=rows)
    plan = mpc(torch.tensor([0.0, 0.1, 0.0, 0.7], dtype=torch.float64))
    assert bool(plan.mu.any())
    expected = {0.05: 12.038, 0.03: 13.954 if weight == 1e2 else 13.958}[limit]
    assert float(plan.objective) == pytest.approx(expected, abs=2e-3)
    assert int(plan.iterations) < 100


def test_a_warm_start_takes_the_multipliers_along():
    problem = random_problem(6, Kind(rows=2, n_x=9, n_u=6, n_lam=5))
    cold = BATCHED.solve(problem, None)
    warm = BATCHED.solve(problem, cold.primal)
    without = BATCHED.solve(problem, cold.primal._replace(mu=torch.zeros_like(cold.primal.mu)))
    solved = cold.solved & warm.solved & without.solved
    torch.testing.assert_close(warm.primal.u[solved], cold.primal.u[solved], rtol=0, atol=1e-7)
    means = [float(r.iterations[solved].double().mean()) for r in (warm, without, cold)]
    assert means[0] < 0.5 * means[1] <= means[2]
