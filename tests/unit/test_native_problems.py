"""The kernels beside their references: gradients, alone as among others, what cannot be met, hard limits, warm starts,
and the tables that both share: fields of a problem, and how a solve can end.

Plans and gradients of every form of problem, and that elements leave each other alone: tests/conformance.
"""

import dataclasses
import functools
import re
import runpy
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import difflcs
from difflcs import GoalCost, LCSMPCLayer, LCSParams, LinearConstraints, QuadraticCost, Status
from difflcs._native import _kernels
from difflcs.cli.bench import pushing_model
from difflcs.mpc import kkt
from difflcs.mpc.backends import BatchedBackend, IpoptBackend
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.records import SYSTEM, dimensions
from difflcs.systems import cart_pole_between_walls
from tests.conformance.varied.generators import random_case
from tests.conftest import Build

BATCHED = BatchedBackend(threads=1)
every_solver = pytest.mark.parametrize("solver", [BATCHED, IpoptBackend(workers=1)], ids=["batched", "ipopt"])


def pushing(build, n_lam, count, shared=True, barrier=0.0):
    cost = GoalCost.reach(9, 6, goal_weight=[1.0, 1.0, 0.1], input_weight=10.0, pairs=[(3, 0), (4, 1)], pair_weight=0.1)
    lcs, n = pushing_model(n_lam, 0), build.normal(1)
    if not shared:
        lcs = LCSParams(**{k: v * (1 + 0.01 * n(count, *[1] * v.ndim)) for k, v in lcs.tensors().items()})
    mpc = LCSMPCLayer(lcs, cost, 5, -0.015, 0.015, backend=BATCHED, barrier=barrier)
    return mpc(0.05 * n(count, 9), 0.05 * n(count, 3)).problem


def with_barrier(problem):
    low, high = (v.nan_to_num(posinf=1.0, neginf=-1.0) for v in (problem.u_min, problem.u_max))
    return replace(problem, u_min=low, u_max=high, barrier=0.01)


PROBLEMS = {
    **{f"of the paper's size, {n}": lambda b, n=n: pushing(b, n, 12, n > 5, 0.01 * (n == 3)) for n in (3, 5, 8)},
    **{f"varied {seed}": lambda b, seed=seed: random_case(seed, 12).problem() for seed in (0, 1, 2, 5, 6, 7, 10)},
    **{f"barrier {seed}": lambda b, seed=seed: with_barrier(random_case(seed, 12).problem()) for seed in (0, 5)},
}


@pytest.fixture(scope="module")
def solved(build):
    """Each problem and its plans, made once."""

    @functools.cache
    def get(name):
        problem = PROBLEMS[name](build)
        return problem, BATCHED.solve(problem, None)

    return get


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_native_adjoint_equals_the_reference(solved, name):
    (problem, result), n = solved(name), Build.normal(3)
    grads = tuple(n(*shape) for shape in [*(v.shape for v in result.primal[:3]), (problem.batch,)])
    ours = BATCHED.vjp(problem, result, grads, result.solved)
    reference = kkt.vjp(problem, kkt.linearise(problem, result.primal), grads, result.solved)
    for name in (name for name in INPUTS if ours[name].numel()):
        size = max(float(reference[name].abs().max()), 1e-12)
        torch.testing.assert_close(ours[name], reference[name], rtol=0, atol=1e-8 * size, msg=name)


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_native_residual_is_that_of_kkt(solved, name):
    """Of plans that are far from a solution, where it is no rounding, and at a solution below its limit."""
    problem, result = solved(name)
    rough = BatchedBackend(max_iter=1, effort="fast", homotopy=1.0, shrink=1e-3).solve(problem, None)
    far = rough.status == Status.MAX_ITER
    residual = kkt.residual(problem, rough.primal, kkt.multipliers(problem, rough.primal))
    torch.testing.assert_close(rough.kkt_residual[far], residual[far], rtol=1e-6, atol=0)
    assert int(far.sum()) >= 5
    assert float(residual[far].min()) > kkt.CERTIFIED
    assert float(result.kkt_residual[result.solved].max()) <= kkt.CERTIFIED


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_problem_alone_has_the_numbers_that_it_has_among_others(solved, name):
    """Alone it is solved by other code, see difflcs/_native/single_lane.hpp."""
    problem, result = solved(name)
    unfinished = replace(BATCHED, max_iter=2, restarts=1)
    for backend, cold in ((BATCHED, result), (unfinished, unfinished.solve(problem, None))):
        guess = type(cold.primal)(*(0.9 * value for value in cold.primal))
        warm = backend.solve(problem, guess)
        for i in range(0, problem.batch, 4):
            one = problem.select(torch.tensor([i]))
            for result, start in ((cold, None), (warm, type(guess)(*(value[[i]] for value in guess)))):
                alone = backend.solve(one, start)
                for a, b in zip(alone.primal, result.primal, strict=True):
                    assert torch.equal(a[0], b[i])
                for key in ("status", "iterations", "kkt_residual", "objective"):
                    assert getattr(alone, key)[0] == getattr(result, key)[i]


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


@every_solver
def test_an_infeasible_plan_violates_as_little_as_can_be(solver):
    """From 0, x cannot be above 10 after 3 steps; the least violation in squares has u = 1."""
    problem = one_state_from(0.0, growth=1.0, stage=3, least=10.0)
    result = solver.solve(problem, None)
    assert result.status.tolist() == [Status.INFEASIBLE]
    violation = problem.violation(result.primal.x, result.primal.u)
    torch.testing.assert_close(violation, torch.tensor([7.0]).double(), rtol=0, atol=1e-6)
    small = {name: 1e-8 * getattr(problem, name) for name in ("u_min", "u_max", "g")}
    assert BATCHED.solve(replace(problem, **small), None).status.tolist() == [Status.INFEASIBLE]


def test_small_actions_meet_their_limits_where_the_cost_is_linear():
    """With x₊ = x + 1e6 u, |u| ≤ 1e-6 and x + 1e6 u ≥ 1.5 after a step, the least sum of four states is 2.5."""
    problem = one_state_from(0.0, growth=1.0, stage=1, least=1.5)
    linear = {name: 0 * getattr(problem, name) for name in ("Q", "R", "Q_final")}
    linear |= {name: 1 + getattr(problem, name) for name in ("q", "q_final")}
    small = {name: 1e-6 * getattr(problem, name) for name in ("u_min", "u_max")}
    result = BATCHED.solve(replace(problem, B=1e6 * problem.B, G_u=problem.G_u - 1e6, **linear, **small), None)
    assert (result.status.item(), round(result.objective.item(), 9)) == (Status.CONVERGED, 2.5)


def test_a_violation_is_measured_by_the_stages_where_the_row_counts():
    """From 100, x is at most 301 after a step, where 1000 are asked for; later it is far above that."""
    problem = one_state_from(100.0, growth=3.0, stage=1, least=1000.0)
    result = BATCHED.solve(problem, None)
    assert result.status.tolist() == [Status.INFEASIBLE]
    expected = torch.tensor([(1000 - 301) / (1000 + 301)], dtype=torch.float64)
    torch.testing.assert_close(result.kkt_residual, expected)
    torch.testing.assert_close(kkt.residual(problem, result.primal, kkt.multipliers(problem, result.primal)), expected)


@every_solver
def test_limits_that_depend_on_each_other_or_are_just_met_are_degenerate(solver):
    single = one_state_from(0.0, growth=1.0, stage=3, least=1.0)
    double = {name: getattr(single, name).repeat_interleave(2, -2) for name in ("G_x", "G_u")}
    double |= {"g": single.g.repeat_interleave(2, -1), "price": single.price.repeat(2)}
    one, two = (solver.solve(problem, None) for problem in (single, replace(single, **double)))
    assert (one.status.tolist(), two.status.tolist()) == ([Status.CONVERGED], [Status.DEGENERATE])
    torch.testing.assert_close(one.primal.u, two.primal.u, rtol=0, atol=1e-9)
    torch.testing.assert_close(two.primal.mu.sum(-1), one.primal.mu.sum(-1), rtol=0, atol=1e-6)
    free = replace(one_state_from(1.0, growth=1.0, stage=3, least=-9.0), price=single.price)
    reached = solver.solve(free, None).primal.x[0, 3, 0]
    touched = solver.solve(one_state_from(1.0, growth=1.0, stage=3, least=reached), None)
    assert touched.status.tolist() == [Status.DEGENERATE]


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


@pytest.mark.parametrize("weight", [None, 1e2, 1e4])
@pytest.mark.parametrize("limit", [0.05, 0.03])
def test_limits_far_from_the_actions_that_they_act_through_are_met(weight, limit):
    """The position of a cart answers to a force by the square of the time step; costs by IPOPT."""
    eye = torch.diag(torch.tensor([10.0, 10.0, 1.0, 1.0], dtype=torch.float64))
    cost = QuadraticCost(eye, 0.1 * torch.ones(1, 1, dtype=torch.float64), 10 * eye)
    row = torch.tensor([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]], dtype=torch.float64)
    rows = LinearConstraints(row, torch.full((2,), limit, dtype=torch.float64), weight=weight)
    backend = BatchedBackend(restarts=1)  # one start, so that the iterations are those of one solve
    mpc = LCSMPCLayer(cart_pole_between_walls(), cost, 25, -2.0, 2.0, backend=backend, constraints=rows)
    plan = mpc(torch.tensor([0.0, 0.1, 0.0, 0.7], dtype=torch.float64))
    assert bool(plan.mu.any())
    expected = {0.05: 12.038, 0.03: 13.954 if weight == 1e2 else 13.958}[limit]
    assert float(plan.objective) == pytest.approx(expected, abs=2e-3)
    assert int(plan.iterations) < 100


SOURCE = Path(difflcs.__file__).parent


def test_the_fields_of_a_problem_are_those_of_the_kernels_in_their_order():
    assert list(INPUTS.items()) == list(_kernels.mpc_fields().items())
    assert list(INPUTS) == [f.name for f in dataclasses.fields(MPCProblem)][: len(INPUTS)]
    assert dimensions(MPCProblem) == INPUTS


def test_the_kernels_of_another_version_are_refused(monkeypatch):
    fields = {name: dims for name, dims in INPUTS.items() if name != "q_final"}
    monkeypatch.setattr(_kernels, "mpc_fields", lambda: fields)
    with pytest.raises(ImportError, match=r"(?s)other fields of the MPC problem.*pip install -e \."):
        runpy.run_path(str(SOURCE / "mpc" / "problem.py"))


def test_the_system_is_the_same_everywhere():
    assert list(SYSTEM) == [f.name for f in dataclasses.fields(LCSParams)]
    assert list(INPUTS.items())[: len(SYSTEM)] == list(SYSTEM.items())
    violation = list(_kernels.violation_fields().items())
    assert violation[: len(SYSTEM)] == list(SYSTEM.items())
    assert violation[len(SYSTEM) :] == [("x", ("n_x",)), ("u", ("n_u",)), ("x_next", ("n_x",)), ("gamma", ())]


def test_the_codes_are_those_of_the_kernels():
    assert {s.name: int(s) for s in Status} == _kernels.status_codes()
    assert all(s.advice for s in Status)


def test_codes_and_tolerances_of_the_kernels_have_their_numbers_in_no_other_file():
    code = re.compile(r"\b(CONVERGED|MAX_ITER|INFEASIBLE|NUMERICAL|DEGENERATE|converged|infeasible)\b\s*[=:]\s*\d")
    tolerance = re.compile(rf"^_?({'|'.join(name.upper() for name in _kernels.tolerances())}) = [\d.]", re.MULTILINE)
    for path in (path for kind in ("py", "cpp", "hpp") for path in SOURCE.rglob(f"*.{kind}")):
        assert not code.search(path.read_text()), path.name
    for path in [*SOURCE.glob("*.py"), *(SOURCE / "mpc").rglob("*.py")]:
        assert not tolerance.search(path.read_text()), path.name
