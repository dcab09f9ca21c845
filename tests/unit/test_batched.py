"""Backend `batched`: threads, instruction sets, efforts, and large problems; more in tests/conformance."""

import inspect
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from models import chain_of_carts, diagonal, push_the_last_cart, uniform

from difflcs import GoalCost, LCSModel, LCSMPCLayer, LCSParams, QuadraticCost
from difflcs._native import _kernels
from difflcs.cli.bench import pushing_model
from difflcs.errors import SolveWarning
from difflcs.mpc.backends import BatchedBackend
from difflcs.systems import cart_pole_between_walls, pushing_cost
from tests.conftest import python


def pushing(build, n_lam, system=0, lcs=None, on_failure="raise", **options):
    lcs, backend = pushing_model(n_lam, system) if lcs is None else lcs, BatchedBackend(**options)
    return LCSMPCLayer(lcs, pushing_cost(), 5, -0.015, 0.015, backend=backend, on_failure=on_failure)


def data(build, count, seed=1):
    n = build.normal(seed)
    return 0.05 * n(count, 9), 0.05 * n(count, 3)


def upright(horizon):
    cost = QuadraticCost(diagonal(1, 1, 0.1, 0.1), diagonal(0.01), diagonal(100, 100, 1, 1))
    return LCSMPCLayer(cart_pole_between_walls(), cost, horizon, -10.0, 10.0)


def costs(mpc, *call, **options):
    """The costs of plans by other options of the backend; all of them are solved."""
    mpc.backend = BatchedBackend(**options)
    with torch.no_grad():
        return mpc(*call).objective


@pytest.mark.parametrize("n_lam", [0, 3])
def test_what_a_thread_keeps_of_a_problem_serves_no_other(build, n_lam):
    mpc = LCSMPCLayer(build.params(0, n_lam=n_lam), build.cost(0), 6, -0.3, 0.3)
    first, solve = mpc(build.normal(1)(1, mpc.lcs.n_x)).problem, BatchedBackend().solve
    for change in ({}, {"A": 1.01 * first.A}, {"Q": 2 * first.Q}, {"barrier": 0.1}, {"horizon": 4}, {}):
        problem = replace(first, **change)
        with ThreadPoolExecutor(1) as new:
            assert torch.equal(solve(problem, None).primal.u, new.submit(solve, problem, None).result().primal.u)


def test_threads_change_nothing_not_even_summed_gradients(build):
    model = LCSModel.from_params(pushing_model(5, 0))
    x0, goal = data(build, 100)
    found = []
    for threads in (1, 2, 5):
        model.zero_grad()
        plan = pushing(build, 5, lcs=model, threads=threads, effort="best")(x0, goal)
        plan.action.square().sum().backward()
        found.append([plan.u.detach(), *(p.grad.clone() for p in model.parameters())])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


@pytest.mark.filterwarnings("ignore::difflcs.errors.SolveWarning")
@pytest.mark.parametrize("effort", ["fast", "default"])
@pytest.mark.parametrize("time_limit", [1e-9, 1e-4])
@pytest.mark.parametrize("relaxation", [1e-5, 1e-7])
def test_a_plan_out_of_time_is_executed_at_the_relaxation(build, effort, time_limit, relaxation):
    x0, goal = data(build, 1)
    mpc = pushing(build, 5, effort=effort, time_limit=time_limit, on_failure="mask")
    mpc.relaxation = relaxation
    plan = mpc(x0, goal)
    x, lam = plan.problem.rollout(plan.u)
    torch.testing.assert_close(plan.x, x, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(plan.lam, lam, rtol=1e-5, atol=1e-7)
    cost = mpc.cost(goal, mpc.horizon).constant + plan.problem.objective(x, plan.u)
    torch.testing.assert_close(plan.objective, cost, rtol=1e-7, atol=1e-9)


def test_a_search_out_of_time_leaves_some_to_solve_its_plan_at_the_relaxation(build):
    x0, goal = data(build, 1)
    mpc = pushing(build, 5, restarts=1 << 14, time_limit=0.4, on_failure="mask")
    mpc.relaxation = 1e-7
    plan = mpc(x0, goal)
    assert plan.converged.all()
    assert plan.solve_time.sum() < 0.5


# --- processors ------------------------------------------------------------------------------------------------------


def plans_and_gradient():
    """Objectives of some plans, and the size of their gradient."""
    g = torch.Generator().manual_seed(0)
    lcs = LCSModel(9, 6, 5, init_scale=0.3, generator=g)
    mpc = LCSMPCLayer(lcs, GoalCost.reach(9, 6, (200.0, 200.0, 0.3), input_weight=200.0), 5, -0.015, 0.015)
    plan = mpc(0.05 * torch.randn(30, 9, generator=g, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    plan.action.sum().backward()
    return [*plan.objective.tolist(), lcs.A.grad.norm().item()]


@pytest.mark.slow
@pytest.mark.parametrize("isa", [isa for isa in ("baseline", "avx2", "avx512") if isa != _kernels.isa()])
def test_every_instruction_set_finds_the_same_plans(isa):
    """Other lanes, other rounding: nearly all plans agree closely, a few meet another optimum."""
    script = [
        "import torch",
        "from difflcs import GoalCost, LCSModel, LCSMPCLayer",
        "from difflcs._native import _kernels",
        inspect.getsource(plans_and_gradient),
        "print(_kernels.isa(), *plans_and_gradient())",
    ]
    command, environment = [sys.executable, "-c", "\n".join(script)], {**os.environ, "DIFFLCS_ISA": isa}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if isa != "baseline" and done.returncode != 0:
        assert "is not available" in done.stderr  # a clear refusal on a CPU without it
        return
    words = done.stdout.split()
    assert (done.returncode, words[0]) == (0, isa), done.stderr
    # This process has the widest set that the CPU has, or the one that the environment names.
    values, wanted = (
        torch.tensor(v, dtype=torch.float64) for v in ([float(w) for w in words[1:]], plans_and_gradient())
    )
    close = (values - wanted).abs() <= 1e-8 * (1 + wanted.abs())
    assert int(close.sum()) >= 29


def test_an_unknown_instruction_set_is_refused_with_the_known_ones():
    script = f"""from importlib.util import *
spec = spec_from_file_location("_kernels", {_kernels.__file__!r})
kernels = module_from_spec(spec)
spec.loader.exec_module(kernels)
kernels.isa()"""
    environment = {**os.environ, "DIFFLCS_ISA": "mmx"}
    done = python("-c", script, fails=True, env=environment)
    assert "DIFFLCS_ISA=mmx is not available: expected baseline, avx2 or avx512" in done.stderr


# --- starts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_lam", [5, 8])
def test_more_effort_finds_better_optima(build, n_lam):
    gaps = {effort: [] for effort in ("fast", "default", "best")}
    for seed in range(1, 5):
        mpc, call = pushing(build, n_lam, seed), data(build, 64, 3)
        found = {effort: costs(mpc, *call, effort=effort) for effort in gaps}
        best = torch.minimum(torch.stack(list(found.values())).amin(0), costs(mpc, *call, restarts=32))
        for effort, cost in found.items():
            gaps[effort].append(((cost - best) / best.abs()).mean())
    gap = {effort: float(torch.stack(means).mean()) for effort, means in gaps.items()}
    assert gap["best"] <= gap["default"] <= gap["fast"]
    assert gap["default"] < 0.8 * gap["fast"]
    assert gap["best"] < 0.001


def test_an_unstable_plant_starts_from_its_feedback_law():
    """Without action the pole falls onto a wall, and from there every step leads to leaning on it."""
    mpc = upright(50)
    x0 = uniform([0.02, 0.05, 0.1, 0.3], 32, 0)
    assert float((costs(mpc, x0) <= 1.001 * costs(mpc, x0, restarts=32)).double().mean()) >= 0.9


def test_the_search_ends_after_half_the_starts_where_most_of_them_agree():
    """Every start holds an upright pole; one that falls onto a wall has more optima."""
    x0 = torch.tensor([[0.01, 0.01, 0.0, 0.0], [0.3, 0.6, 0.0, 2.0]], dtype=torch.float64)
    mpc, plans = upright(30), []
    for restarts in (8, 16, 48):
        mpc.backend = BatchedBackend(restarts=restarts)
        plans.append(mpc(x0))
    few, group, groups = plans
    assert (group.iterations == few.iterations).tolist() == [True, False]
    assert (groups.iterations > group.iterations).all()
    assert bool((groups.objective <= group.objective * (1 + 1e-9)).all())


def test_contacts_are_sought_round_the_best_plan(build):
    """Pushing: where three of four starts find it, that is all. Two carts: here 96 starts lack a gentle hit."""
    one, more = (pushing(build, 5, **options)(*data(build, 64)) for options in ({"restarts": 4}, {}))
    assert 10 <= int((more.u == one.u).flatten(1).all(1).sum()) <= 60
    mpc = LCSMPCLayer(chain_of_carts(2), push_the_last_cart(2, 50), 50, -2.0, 2.0)
    x0 = uniform([0.3, 0.1, 0.5, 0.2], 192, 1)[[64, 56, 107]]
    starts, seeks = (costs(mpc, x0, **options) for options in ({"restarts": 96}, {"effort": "best"}))
    for before, after, gain in ((one.objective, more.objective, 1e-3), (starts, seeks, 1e-2)):
        assert bool((after <= before).all())
        assert bool((after < (1 - gain) * before).any())


@pytest.mark.parametrize("effort", ["default", "best"])
def test_the_origin_of_the_states_changes_no_search(build, effort):
    """From 16 m away the costs are large numbers with small differences, which must not look alike."""
    lcs, far, found = build.model(1, n_lam=4, scale=0.6).params().detach(), torch.full((4,), 16.0).double(), []
    Q, R = torch.eye(4).double(), diagonal(0.01, 0.01)
    for o in (0 * far, far):
        moved = replace(lcs, d=lcs.d + o - lcs.A @ o, c=lcs.c - lcs.D @ o)
        cost = QuadraticCost(Q, R, 10 * Q, q=-o, q_final=-10 * o, constant=9 * o @ o)
        found.append(costs(LCSMPCLayer(moved, cost, 8, -1.0, 1.0), build.normal(1)(32, 4) + o, effort=effort))
    assert ((found[1] / found[0] - 1).abs() < 1e-4).double().mean() > 0.9


def test_a_plan_that_creeps_along_kinks_is_not_lost():
    """These 8 of 192 states have best plans that take over fifty steps at their relaxation."""
    which, known = [167, 129, 132, 89, 11, 191, 160, 58], [5.05, 6.08, 9.94, 6.13, 6.04, 14.54, 10.1, 5.78]
    mpc = LCSMPCLayer(chain_of_carts(2), push_the_last_cart(2, 50), 50, -2.0, 2.0)
    found = costs(mpc, uniform([0.3, 0.1, 0.5, 0.2], 192, 152)[which])
    assert int((found <= 1.01 * torch.tensor(known)).sum()) >= 6  # rounding may lead elsewhere


@pytest.mark.parametrize(("limit", "effort"), [(50.0, "default"), (float("inf"), "best")])
def test_a_contact_that_is_far_is_found(limit, effort):
    """Three carts in a row: only who strikes the first one at once moves the last one before the end."""
    mpc = LCSMPCLayer(chain_of_carts(3, 0.1, 1e3), push_the_last_cart(3, 10), 10, -limit, limit)
    x0 = torch.randn(32, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.1
    x0[:, 3:] = 0
    ours, best = costs(mpc, x0, effort=effort), costs(mpc, x0, restarts=64)
    assert float((ours <= best + 1e-3 * best.abs()).double().mean()) >= 0.9


@pytest.mark.parametrize("effort", ["fast", "default"])
def test_plans_for_almost_hard_contact_cost_less_where_contact_is_hard(build, effort):
    lcs, call = pushing_model(5, 1), data(build, 32)
    mpc = pushing(build, 5, lcs=lcs, effort=effort)

    def executed(relaxation):
        mpc.relaxation = relaxation
        plan = mpc(*call)
        assert (plan.status == 0).all()
        assert plan.complementarity().max() < 1e-3 * relaxation
        return mpc(*call, guess=plan).u, plan.problem.objective(lcs.rollout(call[0], plan.u), plan.u)

    (_, soft), (again, hard) = executed(1e-5), executed(1e-7)
    gain = (soft - hard) / (1 + soft.abs())
    assert gain.mean() > 0.002
    assert gain.min() > -0.05
    assert torch.isfinite(again).all()


def test_a_guess_is_the_only_start_unless_the_best_is_wanted(build):
    x0, goal = data(build, 32, 4)
    poor, stays, moves = (pushing(build, 8, 1, effort=effort) for effort in ("fast", "default", "best"))
    poor = poor(x0, goal)
    stays, moves = stays(x0, goal, guess=poor), moves(x0, goal, guess=poor)
    assert torch.allclose(stays.objective, poor.objective, rtol=1e-9, atol=0)
    assert bool((moves.objective <= poor.objective * (1 + 1e-9)).all())
    assert bool((moves.objective < poor.objective * (1 - 1e-3)).any())


@pytest.mark.parametrize("kind", ["pushing", "random", "untrained"])
def test_nearly_every_problem_is_solved(build, kind):
    x0, goal = data(build, 200)
    generator = torch.Generator().manual_seed(0)
    solved = 0
    for n_lam in (5, 8):
        if kind == "pushing":
            lcs = pushing_model(n_lam, 1)
        else:
            lcs = LCSModel(9, 6, n_lam, init_scale=0.3 if kind == "random" else 1e-3, generator=generator)
        with torch.no_grad():
            plan = pushing(build, n_lam, lcs=lcs, on_failure="mask")(x0, goal)
        solved += int(plan.converged.sum())
    assert solved >= 399


def test_plans_of_many_contacts_get_more_starts():
    def starts(horizon, n_lam, guessed, n_u=6, **options):
        problem = SimpleNamespace(horizon=horizon, n_x=9, n_lam=n_lam, n_u=n_u)
        efforts = [options] if options else [{"effort": effort} for effort in ("fast", "default", "best")]
        return [BatchedBackend(**one).starts(problem, guessed)[:2] for one in efforts]

    assert starts(5, 8, guessed=False) == [(1, 1), (4, 1), (64, 4)]
    assert starts(5, 8, guessed=True) == [(1, 1), (1, 1), (64, 4)]
    assert starts(20, 5, guessed=False) == [(3, 1), (32, 2), (96, 6)]
    assert starts(20, 5, guessed=True) == [(1, 1), (1, 1), (96, 6)]
    assert starts(40, 1, guessed=False) == starts(10, 5, guessed=False, n_u=1) == [(3, 1), (32, 2), (96, 6)]
    assert starts(10, 5, guessed=False, n_u=3) == [(1, 1), (4, 1), (64, 4)]
    assert starts(4, 48, guessed=False) == [(3, 1), (10, 1), (96, 6)]  # solved one by one
    assert starts(20, 5, guessed=True, restarts=5) == starts(5, 5, guessed=False, restarts=5) == [(5, 1)]


def test_what_was_given_up_is_solved_where_all_else_fails():
    """With few iterations: 27 of 192 are not solved, and 57 where no start gets a second chance."""
    lcs = LCSModel(9, 6, 8, init_scale=0.3, generator=torch.Generator().manual_seed(2)).params().detach()
    eye = torch.eye(9, dtype=torch.float64)
    cost = QuadraticCost(eye, 0.1 * eye[:6, :6], eye)
    x0 = torch.randn(64, 9, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    failed = 0
    for max_iter in (24, 27, 30):
        backend = BatchedBackend(restarts=4, max_iter=max_iter)
        mpc = LCSMPCLayer(lcs, cost, 30, -1.0, 1.0, backend=backend, on_failure="mask")
        with pytest.warns(SolveWarning):
            failed += int((~mpc(x0).converged).sum())
    assert failed <= 40


# --- large problems ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n_x", "n_u", "n_lam"), [(4, 2, 49), (40, 9, 6)])
def test_large_problems_have_the_same_plans_alone_and_in_a_batch_with_systems_of_their_own(n_x, n_u, n_lam):
    generator = torch.Generator().manual_seed(1)
    models = [LCSModel(n_x, n_u, n_lam, init_scale=0.2, generator=generator).params().detach() for _ in range(3)]
    lcs = LCSParams(**{name: torch.stack([m.tensors()[name] for m in models]) for name in models[0].tensors()})
    cost = GoalCost.reach(n_x, n_u, goal_weight=0.5, input_weight=0.05)
    x0, goal = torch.randn(3, n_x, generator=generator, dtype=torch.float64), torch.zeros(n_x).double()
    mpc = LCSMPCLayer(lcs, cost, 3, -1.0, 1.0, backend=BatchedBackend(threads=1, effort="fast"))
    together = mpc(x0, goal).u
    for model, x, u in zip(models, x0, together, strict=True):
        torch.testing.assert_close(mpc(x, goal, lcs=model).u, u, rtol=1e-9, atol=1e-9)


def test_half_the_starts_of_a_large_problem_are_enough_for_many_actions(build):
    n = build.normal(0)
    rows, B, x0 = n(40, 6), 0.3 * n(6, 5), 0 * n(3, 6)
    F = rows @ rows.mT + 0.1 * torch.eye(40)
    lcs = LCSParams(torch.eye(6).double(), B, 0.01 * rows.mT, 0 * n(6), rows, rows @ B, F, 0 * n(40) + 1)
    mpc, plans = LCSMPCLayer(lcs, GoalCost.reach(6, 5, (1.0,) * 6, 0.01), 4, -1.0, 1.0), []
    for restarts in (4, 8, 16):
        mpc.backend = BatchedBackend(restarts=restarts)
        plans.append(mpc(x0, x0 + torch.tensor([[0.1], [0.5], [1.0]])))
    four, half, all_ = plans
    assert torch.equal(half.u, all_.u)
    assert bool((half.iterations > four.iterations).all())
    assert torch.equal(half.iterations, all_.iterations)


@pytest.mark.parametrize(("compliance", "seed", "restarts"), [(0.3, 3, 1), (1e-4, 2, None)])
@pytest.mark.parametrize(("shared", "capped"), [(False, False), (True, False), (True, True)])
def test_forces_on_few_bodies_have_the_plans_of_elimination(build, shared, capped, compliance, seed, restarts):
    """Alone they are found in the size of what they move, side by side by elimination; also with caps of their sums."""
    n = build.normal(seed)
    rows, caps = n(3, 32, 8), torch.zeros(32, 32).double()
    rows[:, 2:, 6:] = 0.0  # of two states only the first two forces know
    if not shared:
        rows[:, 0, 7] = rows[:, 1, 6] = 0.0
    if capped:
        rows[:, 28:], caps[:24, 28:] = 0.0, torch.eye(4).double().repeat_interleave(6, 0)
    F = rows @ rows.mT + torch.diag_embed(compliance * n(3, 32).exp()) + caps - caps.mT
    F[:, 28, 29] = F[:, 29, 28] = F[:, 28, 29] - capped * 0.5 * (F[:, 28, 28] * F[:, 29, 29]).sqrt()
    A, B, c = 0.9 * torch.eye(8).double(), n(3, 8, 3), n(3, 32)
    c[:, 28:] = 2.0 if capped else c[:, 28:]
    lcs = LCSParams(A=A.expand(3, 8, 8), B=B, C=rows.mT, d=0 * n(3, 8), D=rows @ A, E=rows @ B, F=F, c=c)
    cost, x0, goal = GoalCost.reach(8, 3, goal_weight=0.5, input_weight=0.05), n(3, 8), torch.zeros(8).double()
    mpc = LCSMPCLayer(lcs, cost, 3, -1.0, 1.0, BatchedBackend(restarts=restarts, threads=1))
    together = mpc(x0, goal)
    for i in range(3):
        alone = mpc(x0[i], goal, lcs=LCSParams(**{name: value[i] for name, value in lcs.tensors().items()}))
        torch.testing.assert_close(alone.u, together.u[i], rtol=1e-7, atol=1e-7)
        torch.testing.assert_close(alone.lam, together.lam[i], rtol=1e-6, atol=1e-6)
        assert not restarts or alone.iterations < 1.5 * together.iterations[i]


def test_a_force_of_another_size_does_not_hide_the_others(build):
    n = build.normal(0)
    rows, skew, B, c = n(40, 6), 0.3 * n(40, 40), 0.3 * n(6, 3), torch.tensor([*[0.1] * 39, 1e6]).double()
    F = rows @ rows.mT + 0.01 * torch.eye(40) + skew - skew.mT
    lcs = LCSParams(torch.eye(6).double(), B, rows.mT.clone(), 0 * n(6), rows, rows @ B, F, c)
    mpc = LCSMPCLayer(lcs, GoalCost.reach(6, 3, (1.0,) * 6, 0.01), 5, -1.0, 1.0, BatchedBackend(restarts=1), 1e-8)
    assert mpc.eval()(0 * n(6), 0 * n(6) + 1).iterations < 60


def test_caps_that_forces_reach_by_far_larger_sums_do_not_hide_their_gaps(build):
    """A gap of 1e-6 feels the rounding of a sum of 100 through the cap's force; without polish all is solved again."""
    n = build.normal(0)
    rows, B, caps = n(48, 6), 0.3 * n(6, 3), torch.zeros(48, 48).double()
    rows[44:], caps[:44, 44:] = 0.0, torch.eye(4).double().repeat_interleave(11, 0)
    F, c = rows @ rows.mT + 0.001 * torch.eye(48) + caps - caps.mT, torch.tensor([*[-1.0] * 44, *[100.0] * 4]).double()
    lcs = LCSParams(torch.eye(6).double(), B, 0.01 * rows.mT, 0 * n(6), rows, rows @ B, F, c)
    mpc = LCSMPCLayer(lcs, GoalCost.reach(6, 3, (1.0,) * 6, 0.01), 4, -1.0, 1.0, BatchedBackend(restarts=1), 1e-5)
    assert mpc.eval()(0 * n(6), 0 * n(6) + 1).iterations < 22


def test_iterations_hardly_grow_with_the_horizon():
    cost = GoalCost.reach(8, 1, goal_weight=[5.0] * 4 + [0.5] * 4, input_weight=0.005)
    low = torch.tensor([0.1] * 4 + [0.3] * 4, dtype=torch.float64)
    x0 = low * (2 * torch.rand(8, 8, generator=torch.Generator().manual_seed(0)).double() - 1)
    goal = torch.tensor([0.2] * 4 + [0.0] * 4, dtype=torch.float64)
    lcs, backend = chain_of_carts(4, 0.05, 50.0), BatchedBackend(threads=1, restarts=1)
    means = []
    for horizon in (10, 40):
        mpc = LCSMPCLayer(lcs, cost, horizon, -5.0, 5.0, backend=backend, relaxation=1e-4)
        means.append(float(mpc(x0, goal).iterations.double().mean()))
    assert means[1] < 2.2 * means[0]
