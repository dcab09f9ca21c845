"""Random problems of every form: plans by an own judge, by quadratic programming, and `batched` against `ipopt`.

Their gradients: tests/unit/test_native_problems.py and tests/conformance/test_backends.py.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch

from difflcs import Status
from difflcs.mpc import kkt
from difflcs.mpc.backends import BatchedBackend, IpoptBackend
from tests.conformance.varied.generators import random_case
from tests.conformance.varied.judges import conditions, objective
from tests.conformance.varied.programs import condensed, least_violation, optimum, value

BATCHED, IPOPT = BatchedBackend(threads=1), IpoptBackend(workers=1)

pytestmark = pytest.mark.usefixtures("one_thread")


def wrong(case, result):
    """What breaks a condition: (condition, element, violation), by the own judge and by the library's residual."""
    problem, found = case.problem(), []
    residual = kkt.residual(problem, result.primal, kkt.multipliers(problem, result.primal))
    cost, plan = problem.objective(*result.primal[:2]), [v.numpy() for v in result.primal]
    found += [("finite", -1, 0.0)] * (not all(np.isfinite(v).all() for v in plan))
    for i in torch.nonzero(result.solved).flatten().tolist():
        x, u, lam, mu = (v[i] for v in plan)
        off = conditions(case, i, x, u, lam, mu) | {"residual": 2 * float(residual[i])}
        off["more than it says"] = float(residual[i] > max(1e-7, 2 * float(result.kkt_residual[i])))
        mine = objective(case, i, x, u)
        off["objective"] = 1e3 * abs(mine - float(cost[i])) / (1 + abs(mine))
        found += [(name, i, violation) for name, violation in off.items() if not violation <= 2e-6]
    return found


def test_every_solved_problem_meets_the_conditions_of_an_own_judge():
    solved = 0
    for seed in range(24):
        case = random_case(seed, 4)
        result = BATCHED.solve(case.problem(), None)
        assert not wrong(case, result), seed
        solved += int(result.solved.sum())
    assert solved >= 0.75 * 24 * 4  # of the others some cannot be solved


def test_without_contacts_plans_are_those_of_quadratic_programming():
    pytest.importorskip("clarabel")
    compared = active = 0
    for seed in range(12):
        case = random_case(seed, 4, n_lam=0)
        plan = BATCHED.solve(case.problem(), None)
        for i in range(4):
            program, status = condensed(case, i), Status(int(plan.status[i]))
            least = least_violation(*program[2:])
            if least >= 1e-9:  # no plan keeps the hard rows
                assert least <= 1e-6 or status is Status.INFEASIBLE, (seed, i)
                continue
            best, U, (_, _, _, _, G, g, price) = optimum(program), plan.primal.u[i].numpy().ravel(), program
            if best is None or (G @ best - g)[np.isinf(price)].max(initial=0.0) >= 1e-7:
                continue  # the other solver has no answer
            assert status.solved, (seed, i, status)
            assert value(program, U) - value(program, best) <= 1e-6 * (1 + abs(value(program, best))), (seed, i)
            compared += 1
            active += bool((G @ U - g > -1e-9).any())
    assert compared >= 42
    assert active >= 21


def test_the_judge_sees_a_wrong_plan():
    case = random_case(6, 2)
    problem = case.problem()
    x, u, lam, mu = (v.numpy().copy() for v in BATCHED.solve(problem, None).primal)
    assert max(conditions(case, 0, x[0], u[0], lam[0], mu[0]).values()) < 1e-6
    assert conditions(case, 0, 1.01 * x[0], u[0], lam[0], mu[0])["dynamics"] > 1e-4
    moved = problem.clip(torch.from_numpy(u) + 0.1)
    x, lam = (v.numpy() for v in problem.rollout(moved))
    assert conditions(case, 0, x[0], moved[0].numpy(), lam[0], mu[0])["stationarity"] > 1e-4


@pytest.mark.slow
def test_the_kernels_and_ipopt_agree_on_every_form():
    counts = Counter()
    for seed in range(100, 140):
        case = random_case(seed, 4)
        problem = case.problem()
        mine, other = (solver.solve(problem, None) for solver in (BATCHED, IPOPT))
        assert not wrong(case, mine) + wrong(case, other), seed
        both, values = mine.solved & other.solved, [problem.objective(*r.primal[:2]) for r in (mine, other)]
        difference = (values[0] - values[1]).abs() / (1 + values[1].abs())
        same = both & ((mine.primal.u - other.primal.u).abs().amax((1, 2)) < 1e-4)
        assert bool((difference[same] <= 1e-6).all()), seed
        assert problem.n_lam or bool((difference[both] <= 1e-7).all()), seed  # convex
        lost = (mine.status == Status.INFEASIBLE) & (case.witness is not None)
        active = mine.solved & (mine.primal.mu > 0).flatten(1).any(1)
        for name, which in (("both", both), ("same", same), ("lost", lost), ("active", active)):
            counts[name] += int(which.sum())
    # There are several optima; 179 of 223 were the same in a run of 240 problems.
    assert counts["same"] >= 0.7 * counts["both"] >= 0.5 * 160
    assert counts["active"] >= 0.4 * 160
    assert counts["lost"] <= 0.02 * 160


def test_prices_and_limits_need_not_have_the_same_stages():
    problem = random_case(2, 2).problem()
    assert problem.price.ndim != problem.g.ndim
    result = IPOPT.solve(problem, None)
    residual = kkt.residual(problem, result.primal, kkt.multipliers(problem, result.primal))
    assert bool(torch.isfinite(residual[result.solved]).all())
