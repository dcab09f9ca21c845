"""The conformance suite: every backend in the registry solves the same problems, forward and backward.

A new backend is tested here by being registered. One that declares `exact = False` is spared the checks of what it does
not promise: that its plan solves the problem as stated, in every form.
"""

import dataclasses
import functools
import math
import pickle
import warnings

import pytest
import torch

from difflcs import LCSMPCLayer, LCSParams, QuadraticCost, Status, available_backends
from difflcs.errors import DegenerateWarning, SolveWarning
from difflcs.mpc import Primal
from difflcs.mpc.backends import get_backend
from tests.conformance import judges, problems
from tests.conformance.differences import compare, moves, weigh
from tests.conformance.problems import BOUNDS, COST, INF, LCS, PROBLEMS, STAGED, make, solve
from tests.conftest import linear_system

BACKENDS = available_backends()
EXACT = tuple(name for name in BACKENDS if get_backend(name).exact)

every_problem = pytest.mark.parametrize("name", PROBLEMS)
every_backend = pytest.mark.parametrize("backend", BACKENDS)
every_exact = pytest.mark.parametrize("backend", EXACT)
# 34 copies of every problem: seconds for a solver that takes milliseconds for one, whose gradient is that of kkt.py.
FEW = ("contact", "paper_sized", "barrier", "no_contact_stages", "soft_and_hard", "everything")
every_exact_on_copies = pytest.mark.parametrize(
    ("name", "backend"),
    [(name, backend) for backend in EXACT for name in (FEW if backend == "ipopt" else PROBLEMS)],
)


def every_backend_on(*names, exact=()):
    """Parametrise by problems and backends; on those in `exact` by exact backends alone."""
    pairs = [(name, backend) for backend in BACKENDS for name in (*names, *(exact if backend in EXACT else ()))]
    return pytest.mark.parametrize(("name", "backend"), pairs)


@pytest.fixture(scope="module")
def solutions(build):
    """Each problem solved once per backend."""

    @functools.cache
    def get(name, backend):
        problem = PROBLEMS[name](build)
        with warnings.catch_warnings():
            if backend not in EXACT:  # an approximation may give up where the problem is hard
                warnings.simplefilter("ignore", SolveWarning)
            return problem, solve(problem, backend, on_failure="raise" if backend in EXACT else "mask")

    return get


# --- forward --------------------------------------------------------------------------------------------------------


@every_backend_on(*problems.PLAIN, exact=[name for name in PROBLEMS if name not in problems.PLAIN])
def test_plans_have_their_shapes_and_keep_bounds_and_exact_ones_dynamics_and_complementarity(solutions, name, backend):
    problem, sol = solutions(name, backend)
    B, H, t = problem.count, problem.horizon, problem.by_stage()
    n_x, n_u, n_lam = (problem.inputs[k].shape[-1] for k in "ABF")
    n_c = problem.inputs["g"].shape[-1] if "g" in t else 0
    assert (sol.x.shape, sol.u.shape, sol.lam.shape) == ((B, H + 1, n_x), (B, H, n_u), (B, H, n_lam))
    assert (sol.action.shape, sol.mu.shape, sol.violation.shape) == ((B, n_u), (B, H + 1, n_c), (B,))
    for info in (sol.objective, sol.status, sol.iterations, sol.kkt_residual, sol.solve_time):
        assert info.shape == (B,)
    assert sol.x.dtype == sol.u.dtype == sol.lam.dtype == sol.objective.dtype == torch.float64
    assert sol.status.dtype == torch.int8
    assert bool((sol.solve_time > 0).all())
    assert bool((sol.iterations > 0).all())
    assert torch.equal(sol.x[:, 0], problem.inputs["x0"])
    assert bool(((sol.u >= t["u_min"]) & (sol.u <= t["u_max"])).all())
    if backend not in EXACT:
        return
    assert bool(sol.converged.all()), sol.status
    assert float(sol.kkt_residual.max()) <= 1e-6
    assert not sol.mu.requires_grad
    following, slack = (judges.affine(t, names, sol.x[:, :-1], sol.u, sol.lam) for names in ("ABCd", "DEFc"))
    assert float(((sol.x[:, 1:] - following).abs() / (1 + sol.x.abs().amax(1, keepdim=True))).max()) < 1e-8
    assert bool((sol.lam > 0).all() and (slack > 0).all())
    torch.testing.assert_close(sol.lam * slack, torch.full_like(slack, problem.relaxation), rtol=0, atol=1e-8)
    assert float(sol.dynamics_residual().max()) < 1e-6
    assert float(sol.complementarity().max() if slack.numel() else 0.0) < 1e-7


@every_problem
@every_exact
def test_the_objective_is_the_sum_of_its_terms_and_no_plan_nearby_is_better(build, solutions, name, backend):
    """Independent of kkt.py: autograd of a rollout, and random neighbours, violations at more than their multiplier."""
    problem, sol = solutions(name, backend)
    t = problem.by_stage()
    expected = problems.cost(problem, t, sol.x, sol.u) + problems.fines(problem, t, sol.x, sol.u)
    torch.testing.assert_close(sol.objective, expected, rtol=1e-9, atol=1e-10)

    u = sol.u.clone().requires_grad_()
    x = problems.rollout(problem, t, u)
    value = problems.cost(problem, t, x, u).sum()
    if "g" in t:
        value = value + torch.where(sol.mu > 0, sol.mu * judges.rows(t, x, u), 0.0).sum()
    (gradient,) = torch.autograd.grad(value, u)
    assert float((sol.u - (sol.u - gradient).clamp(t["u_min"], t["u_max"])).abs().max()) < 1e-5

    n, dear = build.normal(31), 2 * float(sol.mu.max()) + 1 if "g" in t else INF
    low, high = (torch.as_tensor(t[k]).expand_as(sol.u) for k in BOUNDS)
    inside = 1e-9 * (high - low) if problem.barrier else 0.0
    for step in (1e-3, 1e-2):
        for _ in range(10):
            near = sol.u + step * (high - low).clamp_max(3.0) * n(*sol.u.shape)
            near = near.clamp(low + inside, high - inside)
            x = problems.rollout(problem, t, near)
            other = problems.cost(problem, t, x, near) + problems.fines(problem, t, x, near, dear)
            assert bool((other >= sol.objective - 1e-7 * (1 + sol.objective.abs())).all())


@pytest.mark.parametrize("name", problems.CONSTRAINED)
@every_exact
def test_constraints_hold_or_are_paid_for(solutions, name, backend):
    problem, sol = solutions(name, backend)
    t, mu = problem.by_stage(), sol.mu
    value, price = judges.rows(t, sol.x, sol.u), t["price"].expand(mu.shape)
    torch.testing.assert_close(sol.violation, value.amax((1, 2)).clamp_min(0.0), rtol=0, atol=1e-9)
    assert float(value[price == INF].max() if (price == INF).any() else 0.0) <= 1e-7
    assert bool((mu >= 0).all() and (mu <= price * (1 + 1e-12)).all())
    free, paid = mu <= 1e-9, mu >= price * (1 - 1e-9)
    assert float(value[~paid].max()) <= 1e-6
    assert float(value[~free].min()) >= -1e-6
    assert bool((~free & ~paid).any()) or name == "soft"
    assert name != "soft" or float(sol.violation.max()) > 1e-3


@every_problem
def test_exact_backends_agree_where_they_find_the_same_optimum(solutions, name):
    """Local optima may differ; where the objectives agree the plans agree."""
    _, first = solutions(name, EXACT[0])
    for other in EXACT[1:]:
        problem, second = solutions(name, other)
        same = (first.objective - second.objective).abs() <= 1e-6 * (1 + first.objective.abs())
        assert float(same.double().mean()) >= 0.25
        t = problem.by_stage()
        width = float(torch.as_tensor(t["u_max"] - t["u_min"]).clamp_max(1.0).max())
        assert float((first.u - second.u).abs()[same].max()) <= 1e-2 * width
        assert float((first.mu - second.mu).abs()[same].sum()) <= 1e-3 * (1 + float(first.mu.sum()))


@every_exact
def test_problems_are_of_the_kind_that_they_are_said_to_be(solutions, backend):
    """The suite would prove little if no force were on, or all."""
    for name in ("contact", "hard_contact", "paper_sized"):
        problem, sol = solutions(name, backend)
        assert 0.1 < float((sol.lam > problem.relaxation**0.5).double().mean()) < 0.9
    assert float((solutions("saturated", backend)[1].u.abs() == 0.01).double().mean()) > 0.5
    assert float(solutions("barrier", backend)[1].u.abs().max()) < 0.05
    assert float(solve(solutions("barrier", backend)[0], backend, barrier=0.0).u.abs().max()) == 0.05


@every_exact
def test_units_do_not_change_the_plan(solutions, backend):
    _, plain = solutions("contact", backend)
    problem, scaled = solutions("badly_scaled", backend)
    U = problem.inputs["u_max"] / 0.15
    same = (scaled.objective - plain.objective).abs() < 1e-6 * (1 + plain.objective.abs())
    assert int(same.sum()) >= 6  # another local optimum is allowed, rarely
    torch.testing.assert_close((scaled.u / U)[same], plain.u[same], rtol=1e-4, atol=1e-5)


@every_exact
def test_a_weakly_active_bound_is_degenerate_and_has_the_gradient_of_one_side(build, backend):
    """The bound of one action is moved to where the free optimum lies: active with multiplier zero."""
    problem = problems.without_contact(build)
    free = solve(problem, backend)
    k, ok = int(free.u[2, :, 1].argmax()), Status.CONVERGED

    def plan(shift):
        t = problem.full()
        t["u_max"][2, 1] = free.u[2, k, 1] + shift
        t["x0"].requires_grad_()
        sol = solve(problem, backend, tensors=t)
        return sol, torch.autograd.grad(sol.u[2].square().sum(), t["x0"])[0][2]

    with pytest.warns(DegenerateWarning, match=r"1 of 8 solutions are not classically differentiable"):
        sol, found = plan(0.0)
    assert sol.status.tolist() == [ok, ok, Status.DEGENERATE, ok, ok, ok, ok, ok]
    assert bool(sol.converged.all())
    torch.testing.assert_close(sol.u[2].detach(), free.u[2], rtol=0, atol=1e-6)
    sides = (plan(-1e-3)[1], plan(1e-3)[1])
    assert min(float((found - side).norm() / side.norm()) for side in sides) < 0.02
    assert float((sides[0] - sides[1]).norm() / sides[0].norm()) > 0.02


@every_exact
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_kink_of_an_action_with_one_bound_at_zero_is_degenerate(backend, side):
    """An action that rests at its only bound in all steps has no size by which to say how near a kink is."""
    lcs, one = linear_system([[1.0]], [[side]]), torch.ones(1, 1, dtype=torch.float64)
    mpc = LCSMPCLayer(lcs, QuadraticCost(Q=one, R=0.1 * one, Q_final=one), 4, 0 * one[0], math.inf, backend=backend)
    x0 = torch.tensor([[0.0], [0.5 * side], [-0.5 * side]], dtype=torch.float64, requires_grad=True)
    with pytest.warns(DegenerateWarning, match="1 of 3 solutions"):
        plan = mpc(x0)
    assert plan.status.tolist() == [Status.DEGENERATE, Status.CONVERGED, Status.CONVERGED]
    (gradient,) = torch.autograd.grad(plan.u[:, 0].sum(), x0)
    assert gradient[1] == 0
    assert float((gradient[0] - gradient[1:, 0]).abs().min()) < 1e-6  # one of the two sides


@every_backend_on("contact", "cost_and_bounds_per_element", exact=("stages_per_element", "everything", "hard"))
def test_batch_equals_loop(solutions, name, backend):
    problem, sol = solutions(name, backend)
    for i in range(problem.count):
        alone = solve(problem.select(slice(i, i + 1)), backend)
        torch.testing.assert_close(alone.u[0], sol.u[i], rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(alone.lam[0], sol.lam[i], rtol=1e-5, atol=1e-8)
        torch.testing.assert_close(alone.mu[0], sol.mu[i], rtol=1e-4, atol=1e-6)
        assert int(alone.status[0]) == int(sol.status[i])


@every_backend
def test_an_empty_batch_is_solved(build, backend):
    problem = problems.contact(build)
    t = {**problem.inputs, "x0": torch.empty(0, 4, dtype=torch.float64), "A": problem.inputs["A"].clone()}
    t["A"].requires_grad_()
    sol = solve(problem, backend, tensors=t)
    assert sol.u.shape == (0, 3, 2)
    assert sol.status.shape == (0,)
    (gradient,) = torch.autograd.grad(sol.u.sum() + sol.objective.sum(), t["A"])
    assert torch.equal(gradient, torch.zeros(4, 4, dtype=torch.float64))


@pytest.mark.parametrize("name", ["contact", "paper_sized", "stages", "hard", "rows_by_stage", "no_contact_stages"])
@every_exact
def test_a_warm_start_ends_in_the_same_plan_with_less_work(solutions, name, backend):
    problem, sol = solutions(name, backend)
    for guess in (sol, Primal(sol.x, sol.u, sol.lam)):  # with the multipliers, and without
        warm = solve(problem, backend, guess=guess)
        assert bool(warm.converged.all())
        same = (warm.u - sol.u).abs().amax((1, 2)) < 1e-5
        assert float(same.double().mean()) > 0.5  # another local optimum is allowed, rarely
        if guess is sol or not sol.mu.numel():
            assert float(warm.iterations.double().mean()) < float(sol.iterations.double().mean())


@every_exact
def test_forms_that_say_the_same_have_the_same_plan(build, backend):
    """A far bound and none; stages that are alike and one matrix for all."""
    problem, far = problems.unbounded(build), torch.full((2,), 1e3, dtype=torch.float64)
    wide = problem.changed(u_min=-far, u_max=far)
    torch.testing.assert_close(solve(problem, backend).u, solve(wide, backend).u, rtol=1e-5, atol=1e-6)
    problem = problems.hard(build)
    sequence = problems.vary(build, problem, set(problem.inputs) & set(STAGED), spread=0.0)
    torch.testing.assert_close(solve(sequence, backend).u, solve(problem, backend).u, rtol=1e-6, atol=1e-8)


@every_problem
def test_a_cost_that_is_asked_for_counts_as_one_that_is_given(solutions, name):
    problem, found = solutions(name, "batched")[0], []
    for asked in (False, True):
        leaves = {k: v.clone().requires_grad_() for k, v in problem.inputs.items()}
        plan = solve(problem, "batched", tensors=leaves, asked=asked)
        (plan.u.sum() + plan.objective.sum()).backward()
        found.append([plan.u, plan.objective, *(leaves[k].grad for k in COST if k in leaves)])
    for given, taken in zip(*found, strict=True):
        torch.testing.assert_close(taken, given, rtol=0, atol=0)


@every_exact
def test_a_price_above_the_multiplier_makes_a_soft_constraint_hard(build, backend):
    problem = problems.hard(build)
    plan = solve(problem, backend)
    dear = {**problem.inputs, "price": torch.full((2,), 3 * float(plan.mu.max()), dtype=torch.float64)}
    # From the same local optimum: another program may lead a cold start to another one.
    soft_plan = solve(problem, backend, guess=plan, tensors=dear)
    torch.testing.assert_close(soft_plan.u, plan.u, rtol=1e-5, atol=1e-6)
    cheap = {**problem.inputs, "price": torch.full((2,), 0.2 * float(plan.mu.max()), dtype=torch.float64)}
    cheap_plan = solve(problem, backend, tensors=cheap)
    assert float(cheap_plan.violation.max()) > 1e-4
    assert float(cheap_plan.mu.max()) == pytest.approx(float(cheap["price"][0]), rel=1e-9)


@every_exact
def test_multipliers_are_what_a_wider_limit_would_save(build, backend):
    problem = problems.hard(build)
    t = problem.full()
    g = t["g"].clone().requires_grad_()
    sol = solve(problem, backend, tensors={**t, "g": g})
    (gradient,) = torch.autograd.grad(sol.objective.sum(), g)
    torch.testing.assert_close(gradient, -sol.mu.sum(1), rtol=1e-6, atol=1e-8)


@every_exact
def test_an_infeasible_element_is_a_status_and_spoils_no_other(build, backend):
    problem = problems.hard(build).each()
    t = dict(problem.inputs)
    bad = t["g"].clone()
    bad[2, 0] = (t["G_x"][2, 0] * t["x0"][2]).sum() - 0.3  # the first state violates it by 0.3, whatever follows
    x0 = t["x0"].clone().requires_grad_()
    with pytest.warns(SolveWarning, match="1 of 4 .*1 INFEASIBLE"):
        sol = solve(problem, backend, tensors={**t, "g": bad, "x0": x0}, on_failure="mask")
    good = solve(problem, backend)
    ok = Status.CONVERGED
    assert sol.status.tolist() == [ok, ok, Status.INFEASIBLE, ok]
    others = [0, 1, 3]
    torch.testing.assert_close(sol.u[others].detach(), good.u[others], rtol=1e-6, atol=1e-8)
    assert float(sol.violation[2]) == pytest.approx(0.3, abs=0.02)
    (gradient,) = torch.autograd.grad(sol.u.sum() + sol.objective.sum(), x0)
    assert torch.equal(gradient[2], torch.zeros(4).double())
    assert float(gradient[others].abs().amax(1).min()) > 0


# --- backward -------------------------------------------------------------------------------------------------------


@every_exact_on_copies
def test_gradient_of_every_input_matches_central_differences(build, solutions, name, backend):
    problem, base = solutions(name, backend)
    if backend == "ipopt":  # which takes milliseconds for one: a few elements of every form
        problem = problem.select(slice(3))
        base = solve(problem, backend)
    directions, moved = moves(build, solve, problem, base, backend)
    # Next to a solution nearly nothing is left to gain; rounding must not be taken for a failure.
    assert bool(moved.converged.all()), moved.status.bincount()
    some = compare(build, solve, problem, base, backend, directions, moved)
    assert some >= 0.6 * len(directions)  # most inputs matter


@pytest.mark.parametrize("backend", [name for name in BACKENDS if name not in EXACT])
def test_gradient_of_an_approximation_is_roughly_that_of_its_own_solve(build, solutions, backend):
    """A conic solver has few digits: a wide difference quotient, and a loose comparison."""
    problem, base = solutions("contact", backend)
    n, h, each = build.normal(43), 1e-3, problem.full()
    weight, direction = n(*base.u.shape), 0.2 * n(problem.count, 4)
    leaf = each["x0"].clone().requires_grad_()
    sol = solve(problem, backend, tensors={**each, "x0": leaf})
    (gradient,) = torch.autograd.grad((sol.u * weight).sum(), leaf)
    above, below = (solve(problem, backend, tensors={**each, "x0": each["x0"] + s * h * direction}).u for s in (1, -1))
    quotient = (((above - below) / (2 * h)) * weight).sum((1, 2))
    error = ((gradient * direction).sum(1) - quotient).abs() / quotient.abs().clamp_min(1e-2)
    assert float(error.median()) < 0.05


@every_backend_on("contact", "saturated", exact=("stages", "soft_and_hard", "rows_by_stage", "no_contact"))
def test_gradients_of_shared_inputs_are_sums_of_those_of_the_elements(build, solutions, name, backend):
    problem, base = solutions(name, backend)
    n, (rtol, atol) = build.normal(5), (1e-5, 1e-7) if backend in EXACT else (1e-2, 1e-3)
    weights = [n(*v.shape) for v in (base.x, base.u, base.lam)] + [n(problem.count)]
    shared = {k: v.clone().requires_grad_() for k, v in problem.inputs.items()}
    each = {k: v.requires_grad_() for k, v in problem.full().items()}
    for tensors in (shared, each):
        weigh(solve(problem, backend, tensors=tensors), weights).sum().backward()
    for k in problem.inputs:
        expected = each[k].grad.sum(0).view_as(shared[k]) if problem.shared(k) else each[k].grad
        size = float(1 + each[k].grad.norm())
        torch.testing.assert_close(
            shared[k].grad, expected, rtol=rtol, atol=atol * size, msg=lambda m, k=k: f"{k}: {m}"
        )


@every_exact
def test_what_is_infinite_has_no_gradient(build, backend):
    for name, key in (("half_open", "u_max"), ("terminal", "g"), ("soft_and_hard", "price")):
        problem = PROBLEMS[name](build)
        leaf = problem.inputs[key].clone().requires_grad_()
        sol = solve(problem, backend, tensors={**problem.inputs, key: leaf})
        (gradient,) = torch.autograd.grad(sol.u.sum() + sol.objective.sum(), leaf)
        infinite = torch.isinf(leaf)
        assert bool(infinite.any())
        assert torch.equal(gradient[infinite], torch.zeros_like(gradient[infinite]))
        assert bool(torch.isfinite(gradient).all())


# --- options --------------------------------------------------------------------------------------------------------


@every_backend
def test_a_backend_is_a_frozen_dataclass_whose_string_is_its_default_instance(backend):
    instance = get_backend(backend)
    assert dataclasses.is_dataclass(instance)
    assert instance == type(instance)()
    assert vars(pickle.loads(pickle.dumps(instance))) == vars(instance)
    assert instance.name == backend
    assert type(instance).__doc__
    with pytest.raises(dataclasses.FrozenInstanceError):
        instance.name = "other"


@every_exact
@pytest.mark.parametrize(
    ("options", "training", "evaluation"),
    [({}, 1e-5, 1e-7), ({"relaxation": 1e-4, "training_relaxation": 1e-2}, 1e-2, 1e-4)],
)
def test_each_mode_plans_at_its_own_relaxation(build, backend, options, training, evaluation):
    problem = make(build)
    t = problem.inputs
    lcs, cost = LCSParams(**{k: t[k] for k in LCS}), QuadraticCost(**{k: t[k] for k in COST if k in t})
    layer = LCSMPCLayer(lcs, cost, 3, t["u_min"], t["u_max"], backend, **options)
    for relaxation, mode in ((training, layer.train), (evaluation, layer.eval)):
        plan = mode()(t["x0"])
        assert torch.equal(plan.u, solve(problem, backend, relaxation=relaxation).u)
        assert float(plan.complementarity().max()) < 1e-3 * relaxation
