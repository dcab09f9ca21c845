"""The conformance suite: every backend in the registry solves the same problems, forward and backward.

A new backend is tested here by being registered. One that declares `exact = False` is spared only the checks of what it
does not promise: that its plan solves the problem as stated.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import warnings
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from difflcs import LCSMPCLayer, LCSParams, QuadraticCost, Status, available_backends, solve_lcp
from difflcs.errors import DegenerateWarning, DoubleBackwardError, SolveWarning
from difflcs.mpc import Primal
from difflcs.mpc.backends import get_backend
from tests.conformance.differences import compare, moves, weigh

BACKENDS = available_backends()
EXACT = tuple(name for name in BACKENDS if get_backend(name).exact)
LCS, COST = ("A", "B", "C", "d", "D", "E", "F", "c"), ("Q", "R", "Q_final", "q", "r", "q_final")
INPUTS = (*LCS, *COST, "u_min", "u_max", "x0")
NDIM = {k: 2 if k in ("A", "B", "C", "D", "E", "F", "Q", "R", "Q_final") else 1 for k in INPUTS}


@dataclass(frozen=True)
class Problem:
    """A batch of problems in the terms of the public interface."""

    tensors: dict[str, Tensor]
    horizon: int = 3
    relaxation: float = 1e-4

    @property
    def batch(self):
        return len(self.tensors["x0"])

    def shared(self, name):
        return self.tensors[name].ndim == NDIM[name]

    def each(self):
        """The same problem with every input given per element, copied."""
        full = {k: v.expand(self.batch, *v.shape[-NDIM[k] :]).clone() for k, v in self.tensors.items()}
        return dataclasses.replace(self, tensors=full)

    def element(self, i):
        return {k: v if self.shared(k) else v[i] for k, v in self.tensors.items()}


def solve(problem, backend, guess=None, tensors=None, **options):
    t = tensors or problem.tensors
    layer = LCSMPCLayer(
        LCSParams(**{k: t[k] for k in LCS}), QuadraticCost(**{k: t[k] for k in COST}, check=False),
        problem.horizon, t["u_min"], t["u_max"], backend=backend, relaxation=problem.relaxation, **options,
    )  # fmt: skip
    return layer(t["x0"], guess=guess)


# --- the problems ---------------------------------------------------------------------------------------------------


def make(build, seed=0, batch=8, bound=0.15, n_x=4, n_u=2, n_lam=3, per_element=(), size=0.2, **options):
    def lead(group):
        return (batch,) if group in per_element else ()

    sizes = {"n_x": n_x, "n_u": n_u}
    limit = torch.full((n_u,), bound, dtype=torch.float64)
    u_min, u_max = -limit, limit
    if "bounds" in per_element:
        spread = 0.5 + torch.rand(2, batch, n_u, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        u_min, u_max = u_min * spread[0], u_max * spread[1]
    tensors = {
        **build.lcs_tensors(seed, **sizes, n_lam=n_lam, batch=lead("lcs")),
        **build.cost_tensors(seed, **sizes, batch=lead("cost")),
        "u_min": u_min,
        "u_max": u_max,
        "x0": size * build.normal(seed + 7)(batch, n_x),
    }
    return Problem(tensors, **options)


def contact(build):
    return make(build)


def hard_contact(build):
    return make(build, seed=2, relaxation=1e-6)


def without_contact(build):
    problem = make(build, seed=3, bound=50.0)
    return dataclasses.replace(
        problem, tensors={**problem.tensors, "C": torch.zeros_like(problem.tensors["C"])}, relaxation=1e-3
    )


def saturated(build):
    return make(build, seed=1, bound=0.01)


def paper_sized(build):
    cost = build.paper_cost()(0.05 * build.normal(4)(6, 3), horizon=5)
    limit = torch.full((6,), 0.015, dtype=torch.float64)
    tensors = {
        **build.pushing().tensors(),
        **{k: v.detach() for k, v in cost.fields().items()},
        "u_min": -limit,
        "u_max": limit,
        "x0": 0.05 * build.normal(3)(6, 9),
    }
    return Problem(tensors, horizon=5, relaxation=1e-5)


def far_start(build):
    return make(build, seed=5, size=20.0)


def badly_scaled(build):
    """`contact` in other units of state, action, row of the LCP and force; see the test that compares the two."""
    t = contact(build).tensors
    X, U, S = (torch.tensor(v, dtype=torch.float64) for v in ([1e3, 1e-2, 1.0, 1e-3], [1e-2, 10.0], [1e2, 1e-2, 3.0]))
    changed = {
        "A": X[:, None] * t["A"] / X, "B": X[:, None] * t["B"] / U, "C": X[:, None] * t["C"] * S, "d": X * t["d"],
        "D": S[:, None] * t["D"] / X, "E": S[:, None] * t["E"] / U, "F": S[:, None] * t["F"] * S, "c": S * t["c"],
        "Q": t["Q"] / X / X[:, None], "R": t["R"] / U / U[:, None], "Q_final": t["Q_final"] / X / X[:, None],
        "q": t["q"] / X, "r": t["r"] / U, "q_final": t["q_final"] / X,
        "u_min": U * t["u_min"], "u_max": U * t["u_max"], "x0": X * t["x0"],
    }  # fmt: skip
    return Problem(changed)


def horizon_one(build):
    return make(build, seed=6, horizon=1)


def one_contact(build):
    return make(build, seed=7, n_lam=1)


def other_sizes(build):
    return make(build, seed=8, n_x=6, n_u=3, n_lam=4, horizon=4)


def smallest(build):
    return make(build, seed=9, n_x=1, n_u=1, n_lam=1, horizon=2)


def lcs_per_element(build):
    return make(build, seed=10, per_element=("lcs",))


def cost_and_bounds_per_element(build):
    return make(build, seed=11, per_element=("cost", "bounds"))


def batch_of_one(build):
    return make(build, seed=12, batch=1)


def one_sided_bounds(build):
    """Bounds that do not contain zero."""
    problem = make(build, seed=13)
    return dataclasses.replace(problem, tensors={**problem.tensors, "u_min": torch.tensor([0.05, -0.3]).double()})


PROBLEMS = {
    f.__name__: f
    for f in (
        contact, hard_contact, without_contact, saturated, paper_sized, far_start, badly_scaled, horizon_one,
        one_contact, other_sizes, smallest, lcs_per_element, cost_and_bounds_per_element, batch_of_one,
        one_sided_bounds,
    )
}  # fmt: skip

every_problem = pytest.mark.parametrize("name", PROBLEMS)
every_backend = pytest.mark.parametrize("backend", BACKENDS)
every_exact = pytest.mark.parametrize("backend", EXACT)
# 34 copies of every problem, or as many differences: seconds for a solver that takes milliseconds for one.
every_exact_on_copies = pytest.mark.parametrize(
    "backend", [pytest.param(name, marks=[pytest.mark.slow] * (name == "ipopt")) for name in EXACT]
)


@pytest.fixture(scope="module")
def solutions(build):
    """Each problem solved once per backend."""
    cache = {}

    def get(name, backend):
        if (name, backend) not in cache:
            problem = PROBLEMS[name](build)
            with warnings.catch_warnings():
                if backend not in EXACT:  # an approximation may give up where the problem is hard
                    warnings.simplefilter("ignore", SolveWarning)
                mode = "raise" if backend in EXACT else "mask"
                cache[name, backend] = problem, solve(problem, backend, on_failure=mode)
        return cache[name, backend]

    return get


def test_the_default_backend_is_registered():
    assert "ipopt" in BACKENDS


# --- forward --------------------------------------------------------------------------------------------------------


@every_problem
@every_backend
def test_shapes_and_dtypes(solutions, name, backend):
    problem, sol = solutions(name, backend)
    B, H, t = problem.batch, problem.horizon, problem.tensors
    n_x, n_u, n_lam = t["A"].shape[-1], t["B"].shape[-1], t["F"].shape[-1]
    assert sol.x.shape == (B, H + 1, n_x)
    assert sol.u.shape == (B, H, n_u)
    assert sol.lam.shape == (B, H, n_lam)
    assert sol.action.shape == (B, n_u)
    for info in (sol.objective, sol.status, sol.iterations, sol.kkt_residual, sol.solve_time):
        assert info.shape == (B,)
    assert sol.x.dtype == sol.u.dtype == sol.lam.dtype == sol.objective.dtype == torch.float64
    assert sol.status.dtype == torch.int8
    assert bool((sol.solve_time > 0).all())
    assert bool((sol.iterations > 0).all())


@every_problem
@every_backend
def test_plans_start_at_x0_and_keep_the_bounds_exactly(solutions, name, backend):
    problem, sol = solutions(name, backend)
    low, high = (problem.each().tensors[k][:, None] for k in ("u_min", "u_max"))
    assert torch.equal(sol.x[:, 0], problem.tensors["x0"])
    assert bool(((sol.u >= low) & (sol.u <= high)).all())


@every_problem
@every_exact
def test_every_element_is_solved_to_the_tolerance(solutions, name, backend):
    _, sol = solutions(name, backend)
    assert bool(sol.converged.all())
    assert float(sol.kkt_residual.max()) <= 1e-6


@every_problem
@every_exact
def test_dynamics_and_complementarity_hold_by_hand(solutions, name, backend):
    problem, sol = solutions(name, backend)
    for i in range(problem.batch):
        t, x, u, lam = problem.element(i), sol.x[i], sol.u[i], sol.lam[i]
        predicted = x[:-1] @ t["A"].T + u @ t["B"].T + lam @ t["C"].T + t["d"]
        slack = x[:-1] @ t["D"].T + u @ t["E"].T + lam @ t["F"].T + t["c"]
        size = x.abs().amax(0)
        assert float(((x[1:] - predicted).abs() / (1 + size)).max()) < 1e-7
        assert float(torch.minimum(lam, slack).min()) > 0
        assert float((lam * slack - problem.relaxation).abs().max()) < 1e-7
    assert float(sol.dynamics_residual().max()) < 1e-6
    assert float(sol.complementarity().max()) < 1e-7


def rollout_objective(problem, t, u):
    """J of actions (batch, H, n_u) through the relaxed LCP, for inputs t with a batch dimension."""

    def mul(M, v):
        return (M @ v[..., None])[..., 0]

    x, total = t["x0"], 0.0
    for k in range(problem.horizon):
        total = total + (x * (0.5 * mul(t["Q"], x) + t["q"])).sum(-1)
        total = total + (u[:, k] * (0.5 * mul(t["R"], u[:, k]) + t["r"])).sum(-1)
        lam = solve_lcp(t["F"], mul(t["D"], x) + mul(t["E"], u[:, k]) + t["c"], relaxation=problem.relaxation).lam
        x = mul(t["A"], x) + mul(t["B"], u[:, k]) + mul(t["C"], lam) + t["d"]
    return total + (x * (0.5 * mul(t["Q_final"], x) + t["q_final"])).sum(-1)


@every_problem
@every_exact
def test_the_objective_is_stationary_and_no_action_nearby_is_better(build, solutions, name, backend):
    """Independent of kkt.py: autograd of a rollout, and random feasible neighbours."""
    problem, sol = solutions(name, backend)
    t = problem.each().tensors
    u = sol.u.clone().requires_grad_()
    value = rollout_objective(problem, t, u)
    torch.testing.assert_close(value.detach(), sol.objective, rtol=1e-7, atol=1e-8)
    (gradient,) = torch.autograd.grad(value.sum(), u)
    low, high = t["u_min"][:, None], t["u_max"][:, None]
    projected = sol.u - (sol.u - gradient).clamp(low, high)
    assert float(projected.abs().max()) < 1e-5
    n, width = build.normal(31), (high - low).clamp_max(0.3 * 10)
    for step in (1e-3, 1e-2):
        for _ in range(10):
            near = (sol.u + step * width * n(*sol.u.shape)).clamp(low, high)
            assert bool(
                (rollout_objective(problem, t, near) >= sol.objective - 1e-7 * (1 + value.detach().abs())).all()
            )


@every_exact
def test_without_contact_the_plan_is_that_of_the_dense_kkt_system(solutions, backend):
    """Bounds far away, C = 0: a linear-quadratic problem, its optimality conditions solved as one linear system."""
    problem, sol = solutions("without_contact", backend)
    H, n_x, n_u = problem.horizon, 4, 2
    for i in range(problem.batch):
        t = {k: v.numpy() for k, v in problem.element(i).items()}
        count = H * (n_x + n_u)  # variables x_1 … x_H, u_0 … u_{H−1}; then one costate per step
        K, right = np.zeros((count + H * n_x,) * 2), np.zeros(count + H * n_x)
        for k in range(H):
            xs, us, ps = slice(k * n_x, (k + 1) * n_x), H * n_x + k * n_u, count + k * n_x
            us, ps = slice(us, us + n_u), slice(ps, ps + n_x)
            last = k == H - 1
            K[xs, xs], right[xs] = (t["Q_final"], -t["q_final"]) if last else (t["Q"], -t["q"])
            K[us, us], right[us] = t["R"], -t["r"]
            K[ps, xs], K[ps, us] = -np.eye(n_x), t["B"]
            right[ps] = -t["d"]
            if k == 0:
                right[ps] -= t["A"] @ t["x0"]
            else:
                K[ps, (k - 1) * n_x : k * n_x] = t["A"]
        K[:count, count:] = K[count:, :count].T
        z = np.linalg.solve(K, right)
        np.testing.assert_allclose(sol.x[i, 1:].numpy().ravel(), z[: H * n_x], rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(sol.u[i].numpy().ravel(), z[H * n_x : count], rtol=1e-7, atol=1e-8)


@every_exact
def test_without_contact_bounded_plans_are_those_of_an_enumerated_box_qp(build, backend):
    problem = make(build, seed=3, bound=0.06, horizon=2, batch=6)
    t = {**problem.tensors, "C": torch.zeros(4, 3, dtype=torch.float64)}
    problem = dataclasses.replace(problem, tensors=t)
    sol, at_bound = solve(problem, backend), 0
    for i in range(6):
        e = {k: v.expand(1, *v.shape) for k, v in problem.element(i).items()}

        def value(flat, e=e):
            return rollout_objective(problem, e, flat.reshape(1, 2, 2)).sum()

        zero = torch.zeros(4, dtype=torch.float64)
        P = torch.autograd.functional.hessian(value_without_lcp(e), zero)
        p = torch.autograd.functional.jacobian(value_without_lcp(e), zero)
        best, least = None, np.inf
        for side in itertools.product([-0.06, 0.06, None], repeat=4):
            u = torch.tensor([s or 0.0 for s in side], dtype=torch.float64)
            free = [j for j, s in enumerate(side) if s is None]
            if free:
                u[free] = torch.linalg.solve(P[free][:, free], -(p + P @ u)[free])
            J = float(0.5 * u @ P @ u + p @ u)
            if float(u.abs().max()) <= 0.06 + 1e-12 and J < least:
                best, least = u, J
        torch.testing.assert_close(sol.u[i].reshape(-1), best, rtol=1e-6, atol=1e-8)
        at_bound += int((best.abs() >= 0.06).sum())
    assert 0 < at_bound < 24


def value_without_lcp(e):
    def value(flat):
        u, x, total = flat.reshape(2, 2), e["x0"][0], 0.0
        for k in range(2):
            total = total + x @ (0.5 * e["Q"][0] @ x + e["q"][0]) + u[k] @ (0.5 * e["R"][0] @ u[k] + e["r"][0])
            x = e["A"][0] @ x + e["B"][0] @ u[k] + e["d"][0]
        return total + x @ (0.5 * e["Q_final"][0] @ x + e["q_final"][0])

    return value


@every_exact
def test_saturated_problems_are_saturated(solutions, backend):
    _, sol = solutions("saturated", backend)
    assert float((sol.u.abs() == 0.01).double().mean()) > 0.5


@every_exact
def test_contact_problems_touch_and_slide_free(solutions, backend):
    """The suite would prove little if no force were on, or all."""
    for name in ("contact", "hard_contact", "paper_sized"):
        problem, sol = solutions(name, backend)
        on = float((sol.lam > problem.relaxation**0.5).double().mean())
        assert 0.1 < on < 0.9


@every_exact
def test_units_do_not_change_the_plan(solutions, backend):
    _, plain = solutions("contact", backend)
    problem, scaled = solutions("badly_scaled", backend)
    U = problem.tensors["u_max"] / 0.15
    same = (scaled.objective - plain.objective).abs() < 1e-6 * (1 + plain.objective.abs())
    assert int(same.sum()) >= 6  # another local optimum is allowed, rarely
    torch.testing.assert_close((scaled.u / U)[same], plain.u[same], rtol=1e-4, atol=1e-5)


@every_problem
def test_exact_backends_agree_where_they_find_the_same_optimum(solutions, name):
    """Local optima may differ; where the objectives agree the plans agree."""
    assert len(EXACT) >= 2
    problem, first = solutions(name, EXACT[0])
    for other in EXACT[1:]:
        _, second = solutions(name, other)
        size = 1 + first.objective.abs()
        same = (first.objective - second.objective).abs() <= 1e-6 * size
        assert float(same.double().mean()) >= 0.25
        width = (problem.tensors["u_max"] - problem.tensors["u_min"]).max()
        assert float((first.u - second.u).abs()[same].max()) <= 1e-2 * float(width.clamp_max(1))


@every_exact
def test_a_weakly_active_bound_is_degenerate_and_has_a_finite_gradient(build, backend):
    """The bound of one action is moved to where the free optimum lies: active with multiplier zero."""
    problem = without_contact(build)
    free = solve(problem, backend)
    t = problem.each().tensors
    t["u_max"][2, 1] = free.u[2, :, 1].max()
    t["x0"].requires_grad_()
    with pytest.warns(DegenerateWarning, match=r"1 of 8 solutions are not classically differentiable"):
        sol = solve(problem, backend, tensors=t)
    ok = Status.CONVERGED
    assert sol.status.tolist() == [ok, ok, Status.DEGENERATE, ok, ok, ok, ok, ok]
    assert bool(sol.converged.all())
    torch.testing.assert_close(sol.u[2].detach(), free.u[2], rtol=0, atol=1e-6)
    (gradient,) = torch.autograd.grad(sol.u.sum(), t["x0"])
    assert bool(torch.isfinite(gradient).all())
    assert float(gradient[2].abs().max()) > 0


@every_exact
def test_a_weakly_active_gradient_is_one_of_the_two_sides(build, backend):
    problem = without_contact(build)
    free = solve(problem, backend)
    k = int(free.u[2, :, 1].argmax())

    def gradient(shift):
        t = problem.each().tensors
        t["u_max"][2, 1] = free.u[2, k, 1] + shift
        t["x0"].requires_grad_()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DegenerateWarning)
            sol = solve(problem, backend, tensors=t)
        return torch.autograd.grad(sol.u[2].square().sum(), t["x0"])[0][2]

    found, sides = gradient(0.0), (gradient(-1e-3), gradient(1e-3))
    assert min(float((found - side).norm() / side.norm()) for side in sides) < 0.02
    assert float((sides[0] - sides[1]).norm() / sides[0].norm()) > 0.02


@every_exact
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_kink_of_an_action_with_one_bound_at_zero_is_degenerate(backend, side):
    """An action that rests at its only bound in all steps has no size by which to say how near a kink is."""
    one, none = torch.ones(1, 1, dtype=torch.float64), torch.zeros(1, 0, dtype=torch.float64)
    lcs = LCSParams(A=one, B=side * one, C=none, d=0 * one[0], D=none.mT, E=none.mT, F=none.mT @ none, c=none[0])
    mpc = LCSMPCLayer(lcs, QuadraticCost(Q=one, R=0.1 * one, Q_final=one), 4, 0 * one[0], math.inf, backend=backend)
    x0 = torch.tensor([[0.0], [0.5 * side], [-0.5 * side]], dtype=torch.float64, requires_grad=True)
    with pytest.warns(DegenerateWarning, match="1 of 3 solutions"):
        plan = mpc(x0)
    assert plan.status.tolist() == [Status.DEGENERATE, Status.CONVERGED, Status.CONVERGED]
    (gradient,) = torch.autograd.grad(plan.u[:, 0].sum(), x0)
    assert gradient[1] == 0
    assert float((gradient[0] - gradient[1:, 0]).abs().min()) < 1e-6  # one of the two sides


@every_exact
def test_solving_twice_gives_the_same_bits(build, backend):
    problem = contact(build)
    first, second = solve(problem, backend), solve(problem, backend)
    assert torch.equal(first.u, second.u)
    assert torch.equal(first.lam, second.lam)


@pytest.mark.parametrize("name", ["contact", "lcs_per_element", "cost_and_bounds_per_element"])
@every_backend
def test_batch_equals_loop(build, solutions, name, backend):
    problem, sol = solutions(name, backend)
    for i in range(problem.batch):
        one = dataclasses.replace(
            problem, tensors={k: v[None] if k == "x0" else v for k, v in problem.element(i).items()}
        )
        alone = solve(one, backend)
        torch.testing.assert_close(alone.u[0], sol.u[i], rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(alone.lam[0], sol.lam[i], rtol=1e-5, atol=1e-8)
        assert int(alone.status[0]) == int(sol.status[i])


@every_backend
def test_an_element_does_not_depend_on_its_neighbours(build, solutions, backend):
    problem, sol = solutions("contact", backend)
    order = torch.tensor([5, 2, 7, 0])
    part = dataclasses.replace(problem, tensors={**problem.tensors, "x0": problem.tensors["x0"][order]})
    torch.testing.assert_close(solve(part, backend).u, sol.u[order], rtol=1e-6, atol=1e-8)


@every_backend
def test_an_empty_batch_is_solved(build, backend):
    problem = contact(build)
    t = {**problem.tensors, "x0": torch.empty(0, 4, dtype=torch.float64), "A": problem.tensors["A"].clone()}
    t["A"].requires_grad_()
    sol = solve(problem, backend, tensors=t)
    assert sol.u.shape == (0, 3, 2)
    assert sol.status.shape == (0,)
    (gradient,) = torch.autograd.grad(sol.u.sum() + sol.objective.sum(), t["A"])
    assert torch.equal(gradient, torch.zeros(4, 4, dtype=torch.float64))


@pytest.mark.parametrize("name", ["contact", "paper_sized"])
@every_exact
def test_a_warm_start_ends_in_the_same_plan_with_less_work(solutions, name, backend):
    problem, sol = solutions(name, backend)
    warm = solve(problem, backend, guess=sol)
    assert bool(warm.converged.all())
    same = (warm.u - sol.u).abs().amax((1, 2)) < 1e-5
    assert float(same.double().mean()) > 0.5  # another local optimum is allowed, rarely
    assert float(warm.iterations.double().mean()) < float(sol.iterations.double().mean())


@every_exact
def test_a_wild_guess_does_no_harm(build, solutions, backend):
    problem, sol = solutions("contact", backend)
    n = build.normal(3)
    guess = Primal(1e3 * n(*sol.x.shape), 1e3 * n(*sol.u.shape), 1e3 * n(*sol.lam.shape))
    wild = solve(problem, backend, guess=guess)
    assert bool(wild.converged.all())
    assert float(wild.kkt_residual.max()) <= 1e-6


# --- backward -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def moved(build, solutions):
    """The perturbed copies of each problem solved once per backend, failures masked."""
    return functools.cache(lambda name, backend: moves(build, solve, *solutions(name, backend), backend))


@every_problem
@every_exact_on_copies
def test_a_warm_start_next_to_a_solution_is_solved(moved, name, backend):
    """Where nearly nothing is left to gain, rounding must not be taken for a failure."""
    _, plans = moved(name, backend)
    assert bool(plans.converged.all()), plans.status.bincount()


@every_problem
@every_exact_on_copies
def test_gradient_of_every_input_matches_central_differences(build, solutions, moved, name, backend):
    compare(build, solve, *solutions(name, backend), backend, *moved(name, backend))


@pytest.mark.parametrize("backend", [name for name in BACKENDS if name not in EXACT])
def test_gradient_of_an_approximation_is_roughly_that_of_its_own_solve(build, solutions, backend):
    """A conic solver has few digits: a wide difference quotient, and a loose comparison."""
    problem, base = solutions("contact", backend)
    n, h, each = build.normal(43), 1e-3, problem.each().tensors
    weight, direction = n(*base.u.shape), 0.2 * n(problem.batch, 4)
    leaf = each["x0"].clone().requires_grad_()
    sol = solve(problem, backend, tensors={**each, "x0": leaf})
    (gradient,) = torch.autograd.grad((sol.u * weight).sum(), leaf)
    above, below = (solve(problem, backend, tensors={**each, "x0": each["x0"] + s * h * direction}).u for s in (1, -1))
    quotient = (((above - below) / (2 * h)) * weight).sum((1, 2))
    error = ((gradient * direction).sum(1) - quotient).abs() / quotient.abs().clamp_min(1e-2)
    assert float(error.median()) < 0.05


@pytest.mark.parametrize("k", INPUTS)
@every_exact_on_copies
def test_gradcheck_in_each_input(build, k, backend):
    problem = make(build, seed=20, batch=1, n_x=2, n_u=1, n_lam=2, horizon=2, bound=0.12, relaxation=1e-3)
    t = problem.tensors
    base = solve(problem, backend)
    at_bound = base.u.abs() >= 0.12
    assert 0 < int(at_bound.sum()) < base.u.numel()

    precise = get_backend(backend)
    if "tol" in {field.name for field in dataclasses.fields(precise)}:
        precise = dataclasses.replace(precise, tol=1e-11)  # difference quotients need the digits

    def function(value):
        sol = solve(problem, precise, tensors={**t, k: value}, guess=base)
        return sol.x, sol.u, sol.lam, sol.objective

    assert gradcheck(function, (t[k].clone().requires_grad_(),), eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ["contact", "saturated"])
@every_backend
def test_gradients_of_shared_inputs_are_sums_of_those_of_the_elements(build, name, backend):
    problem, n = PROBLEMS[name](build), build.normal(5)
    shared = {k: v.clone().requires_grad_() for k, v in problem.tensors.items()}
    each = {k: v.requires_grad_() for k, v in problem.each().tensors.items()}
    for tensors in (shared, each):
        sol = solve(problem, backend, tensors=tensors)
        if tensors is shared:
            weights = [n(*v.shape) for v in (sol.x, sol.u, sol.lam)] + [n(problem.batch)]
        weigh(sol, weights).sum().backward()
    for k in INPUTS:
        expected = each[k].grad.sum(0) if problem.shared(k) else each[k].grad
        torch.testing.assert_close(
            shared[k].grad,
            expected,
            rtol=1e-5 if backend in EXACT else 1e-2,
            atol=(1e-7 if backend in EXACT else 1e-3) * float(1 + each[k].grad.abs().max()),
            msg=lambda m, k=k: f"{k}: {m}",
        )


@every_exact
@pytest.mark.parametrize("name", ["contact", "saturated", "lcs_per_element"])
def test_the_objectives_gradient_is_that_of_the_envelope_theorem(build, solutions, name, backend):
    """dJ*/dθ is the derivative of the rollout's objective with the actions held, but for the bounds."""
    problem, _ = solutions(name, backend)
    leaves = {k: v.requires_grad_() for k, v in problem.each().tensors.items()}
    sol = solve(problem, backend, tensors=leaves)
    inner = [k for k in INPUTS if not k.startswith("u_")]
    found = torch.autograd.grad(sol.objective.sum(), [leaves[k] for k in inner])
    held = torch.autograd.grad(rollout_objective(problem, leaves, sol.u.detach()).sum(), [leaves[k] for k in inner])
    for k, left, right in zip(inner, found, held, strict=True):
        if k in ("Q", "R", "Q_final"):
            right = 0.5 * (right + right.mT)
        torch.testing.assert_close(left, right, rtol=1e-5, atol=1e-7, msg=lambda m, k=k: f"{k}: {m}")


@every_exact
def test_an_action_at_its_bound_moves_with_the_bound_and_with_nothing_else(solutions, backend):
    problem, base = solutions("saturated", backend)
    leaves = {k: v.requires_grad_() for k, v in problem.each().tensors.items()}
    sol = solve(problem, backend, tensors=leaves)
    held = (base.action == 0.01).nonzero()
    assert len(held)
    i, j = held[0].tolist()
    grads = torch.autograd.grad(sol.action[i, j], list(leaves.values()))
    for k, g in zip(leaves, grads, strict=True):
        expected = torch.zeros_like(g)
        if k == "u_max":
            expected[i, j] = 1
        torch.testing.assert_close(g, expected, rtol=0, atol=1e-9)


@every_backend
def test_gradients_of_each_output_alone_are_finite(build, backend):
    problem = contact(build)
    leaves = {k: v.requires_grad_() for k, v in problem.each().tensors.items()}
    sol = solve(problem, backend, tensors=leaves)
    for output in (sol.x, sol.u, sol.lam, sol.objective, sol.action):
        for g in torch.autograd.grad(output.sum(), list(leaves.values()), retain_graph=True):
            assert bool(torch.isfinite(g).all())


@every_backend
def test_double_backward_is_refused(build, backend):
    problem = contact(build)
    x0 = problem.tensors["x0"].clone().requires_grad_()
    sol = solve(problem, backend, tensors={**problem.tensors, "x0": x0})
    with pytest.raises(DoubleBackwardError, match=r"first derivatives only.*create_graph=False"):
        torch.autograd.grad(sol.u.sum(), x0, create_graph=True)


# --- options --------------------------------------------------------------------------------------------------------


@every_backend
def test_a_backend_is_a_frozen_dataclass_whose_string_is_its_default_instance(backend):
    instance = get_backend(backend)
    assert dataclasses.is_dataclass(instance)
    assert instance == type(instance)()
    assert instance.name == backend
    assert type(instance).__doc__
    with pytest.raises(dataclasses.FrozenInstanceError):
        instance.name = "other"


# --- barrier and training relaxation ----------------------------------------------------------------------------------


@every_exact
def test_a_barrier_keeps_actions_off_their_bounds_and_gives_them_a_gradient(build, backend):
    problem = make(build, seed=1, bound=0.05, batch=4)
    plain, soft = solve(problem, backend), solve(problem, backend, barrier=1e-3)
    assert float(plain.u.abs().max()) == 0.05
    assert float(soft.u.abs().max()) < 0.05
    t = problem.tensors
    u = soft.u
    logs = ((u - t["u_min"]).log() + (t["u_max"] - u).log()).sum((1, 2))
    bare = rollout_objective(problem, problem.each().tensors, u)
    torch.testing.assert_close(soft.objective, bare - 1e-3 * logs, rtol=1e-8, atol=1e-8)
    leaf = t["x0"].clone().requires_grad_()
    action = solve(problem, backend, tensors={**t, "x0": leaf}, barrier=1e-3).action
    assert float(torch.autograd.grad(action.sum(), leaf)[0].abs().amax(1).min()) > 1e-6


@pytest.mark.parametrize("k", ["A", "F", "c", "Q", "r", "u_min", "u_max", "x0"])
@every_exact_on_copies
def test_gradcheck_with_a_barrier(build, k, backend):
    problem = make(build, seed=20, batch=1, n_x=2, n_u=1, n_lam=2, horizon=2, bound=0.12, relaxation=1e-3)
    precise = get_backend(backend)
    if "tol" in {field.name for field in dataclasses.fields(precise)}:
        precise = dataclasses.replace(precise, tol=1e-11)
    base = solve(problem, backend, barrier=1e-2)

    def function(value):
        sol = solve(problem, precise, tensors={**problem.tensors, k: value}, guess=base, barrier=1e-2)
        return sol.x, sol.u, sol.lam, sol.objective

    assert gradcheck(function, (problem.tensors[k].clone().requires_grad_(),), eps=1e-6, atol=1e-5, rtol=1e-4)


@every_exact
def test_training_mode_plans_at_its_own_relaxation(build, backend):
    problem = make(build, seed=0, batch=4)
    t = problem.tensors
    layer = LCSMPCLayer(
        LCSParams(**{k: t[k] for k in LCS}), QuadraticCost(**{k: t[k] for k in COST}), 3, t["u_min"], t["u_max"],
        backend=backend, relaxation=1e-4, training_relaxation=1e-2,
    )  # fmt: skip
    soft = solve(dataclasses.replace(problem, relaxation=1e-2), backend)
    assert torch.equal(layer.train()(t["x0"]).u, soft.u)
    assert float(layer(t["x0"]).complementarity().max()) < 1e-8
    assert torch.equal(layer.eval()(t["x0"]).u, solve(problem, backend).u)
