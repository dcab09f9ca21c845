"""mpc/kkt.py against derivations built independently here: autograd of the rollout, and the dense KKT matrix."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.autograd.functional import jacobian

from difflcs import Status, solve_lcp
from difflcs.mpc import MPCProblem, Primal, kkt
from difflcs.mpc.backends import IpoptBackend
from difflcs.mpc.problem import INPUTS

BATCH, HORIZON, RELAXATION = 4, 3, 1e-4
MATRICES = ("A", "B", "C", "d", "D", "E", "F", "c", "Q", "R", "Q_final", "q", "r", "q_final", "u_min", "u_max")


def make_problem(build, seed=0, bound=0.15, batch=BATCH, per_element=False):
    lead = (batch,) if per_element else ()
    tensors = {**build.lcs_tensors(seed, batch=lead), **build.cost_tensors(seed, batch=lead)}
    limit = torch.full((*lead, 2), bound, dtype=torch.float64)
    return MPCProblem(
        **tensors, u_min=-limit, u_max=limit, x0=0.2 * build.normal(seed + 7)(batch, 4),
        horizon=HORIZON, relaxation=RELAXATION,
    )  # fmt: skip


def element(problem, i):
    """The numbers of one element as a dict of unbatched tensors."""
    return {k: getattr(problem, k) if problem.shared(k) else getattr(problem, k)[i] for k in INPUTS}


def objective(t, x, u):
    """J of one trajectory, x a list of H+1 states and u of H actions."""
    total = 0.5 * x[-1] @ t["Q_final"] @ x[-1] + t["q_final"] @ x[-1]
    for k in range(len(u)):
        total = total + 0.5 * x[k] @ t["Q"] @ x[k] + t["q"] @ x[k] + 0.5 * u[k] @ t["R"] @ u[k] + t["r"] @ u[k]
    return total


def rollout_objective(t, x0, u):
    """J of actions u (H, n_u) through the relaxed LCP: a function of u and x0 alone."""
    x = [x0]
    for k in range(len(u)):
        lam = solve_lcp(t["F"], t["D"] @ x[-1] + t["E"] @ u[k] + t["c"], relaxation=RELAXATION).lam
        x.append(t["A"] @ x[-1] + t["B"] @ u[k] + t["C"] @ lam + t["d"])
    return objective(t, x, list(u))


def solved(problem):
    return IpoptBackend(workers=1).solve(problem, None)


# --- multipliers and residual ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("per_element", [False, True], ids=["shared", "per-element"])
def test_reduced_gradient_and_costate_are_autograds_of_the_rollout(build, per_element):
    problem = make_problem(build, per_element=per_element)
    u = 0.1 * build.normal(3)(BATCH, HORIZON, 2)  # anywhere, not at a solution
    x, lam = problem.rollout(u)
    dual = kkt.multipliers(problem, Primal(x, u, lam))
    for i in range(BATCH):
        t = element(problem, i)
        action, start = u[i].clone().requires_grad_(), t["x0"].clone().requires_grad_()
        in_u, in_x0 = torch.autograd.grad(rollout_objective(t, start, action), (action, start))
        torch.testing.assert_close(dual.gradient[i], in_u, rtol=1e-8, atol=1e-9)
        torch.testing.assert_close(dual.p[i, 0], in_x0, rtol=1e-8, atol=1e-9)


def test_rollout_satisfies_dynamics_and_relaxed_complementarity(build):
    problem = make_problem(build)
    x, lam = problem.rollout(0.1 * build.normal(3)(BATCH, HORIZON, 2))
    for k in range(HORIZON):
        u = 0.1 * build.normal(3)(BATCH, HORIZON, 2)[:, k]
        predicted = x[:, k] @ problem.A.T + u @ problem.B.T + lam[:, k] @ problem.C.T + problem.d
        slack = x[:, k] @ problem.D.T + u @ problem.E.T + lam[:, k] @ problem.F.T + problem.c
        torch.testing.assert_close(x[:, k + 1], predicted, rtol=1e-12, atol=1e-14)
        assert float((slack * lam[:, k] - RELAXATION).abs().max()) < 1e-12


def test_residual_vanishes_at_a_solution_and_names_each_violation_by_its_size(build):
    problem = make_problem(build)
    primal = solved(problem).primal

    def residual(**changes):
        changed = primal._replace(**changes)
        return kkt.residual(problem, changed, kkt.multipliers(problem, changed))

    assert float(residual().max()) < 1e-8
    for name in ("x", "u", "lam"):
        value = getattr(primal, name).clone()
        value[2, 1, 0] += 0.01
        found = residual(**{name: value})
        assert float(found[2]) > 1e-5
        assert float(found[[0, 1, 3]].max()) < 1e-8
    beyond = primal.u.clone()
    beyond[3] = 0.15 + 0.5
    assert float(residual(u=beyond)[3]) >= 0.5 - 1e-12


def test_residual_sees_a_feasible_trajectory_that_is_not_optimal(build):
    problem = make_problem(build)
    u = torch.zeros(BATCH, HORIZON, 2, dtype=torch.float64)
    x, lam = problem.rollout(u)
    primal = Primal(x, u, lam)
    assert float(kkt.residual(problem, primal, kkt.multipliers(problem, primal)).min()) > 1e-3


# --- sensitivity ----------------------------------------------------------------------------------------------------


class Dense:
    """The KKT system of one element, from the Lagrangian by automatic differentiation; no code of kkt.py inside."""

    def __init__(self, t, primal, lower, upper):
        self.t, self.lower, self.upper = t, lower, upper
        self.sizes = [HORIZON * 4, HORIZON * 2, HORIZON * 3, HORIZON * 4, HORIZON * 3, HORIZON * 2]
        x, u, lam = primal
        self.primal = torch.cat([x[1:].reshape(-1), u.reshape(-1), lam.reshape(-1)])

    def lagrangian(self, z, t):
        x, u, lam, p, y, nu = (v.reshape(HORIZON, -1) for v in torch.split(z, self.sizes))
        x = [t["x0"], *x]
        total = objective(t, x, list(u))
        for k in range(HORIZON):
            s = t["D"] @ x[k] + t["E"] @ u[k] + t["F"] @ lam[k] + t["c"]
            total = total + p[k] @ (t["A"] @ x[k] + t["B"] @ u[k] + t["C"] @ lam[k] + t["d"] - x[k + 1])
            total = total + y[k] @ (lam[k] * s - RELAXATION)
            # ν acts on active bounds; on free actions it is pinned to zero.
            total = total + (nu[k] * (u[k] - t["u_min"]) * self.lower[k]).sum()
            total = total + (nu[k] * (u[k] - t["u_max"]) * self.upper[k]).sum()
            total = total + 0.5 * (nu[k].square() * ~(self.lower[k] | self.upper[k])).sum()
        return total

    def conditions(self, z, t):
        with torch.enable_grad():
            z = z if z.requires_grad else z.clone().requires_grad_()
            return torch.autograd.grad(self.lagrangian(z, t), z, create_graph=True)[0]

    def solve_multipliers(self):
        """p, y, ν from stationarity, linear in them, by least squares."""
        count = len(self.primal)
        duals = sum(self.sizes) - count

        def stationarity(m):
            return self.conditions(torch.cat([self.primal, m]), self.t)[:count]

        zero = torch.zeros(duals, dtype=torch.float64)
        slope = jacobian(stationarity, zero)
        m = torch.linalg.lstsq(slope, -stationarity(zero).detach()[:, None], driver="gelsd").solution[:, 0]
        return torch.cat([self.primal, m])

    def vjp(self, x_bar, u_bar, lam_bar, objective_bar):
        """θ̄ = z̄ᵀ dz/dθ + ∂/∂θ of what depends on θ directly."""
        z = self.solve_multipliers()
        K = jacobian(lambda v: self.conditions(v, self.t), z)
        t = {k: v.clone().requires_grad_() for k, v in self.t.items()}
        split = z[: len(self.primal)].clone().requires_grad_()
        x, u, lam = (v.reshape(HORIZON, -1) for v in torch.split(split, self.sizes[:3]))
        x = torch.cat([t["x0"][None], x])
        upstream = (x * x_bar).sum() + (u * u_bar).sum() + (lam * lam_bar).sum()
        upstream = upstream + objective_bar * objective(t, list(x), list(u))
        z_bar, *direct = torch.autograd.grad(upstream, (split, *t.values()), allow_unused=True)
        z_bar = torch.cat([z_bar, torch.zeros(len(z) - len(z_bar), dtype=torch.float64)])
        w = torch.linalg.solve(K, z_bar)
        implicit = torch.autograd.grad(
            -(w.detach() * self.conditions(z.clone().requires_grad_(), t)).sum(), tuple(t.values()), allow_unused=True
        )
        zero = torch.zeros((), dtype=torch.float64)
        return {k: (a if a is not None else zero) + (b if b is not None else zero)
                for k, a, b in zip(t, direct, implicit, strict=True)}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("upstream", "bound", "per_element"),
    [(upstream, 0.15, False) for upstream in ("x", "u", "lam", "objective")]
    + [("all", bound, per_element) for bound in (10.0, 0.15, 0.03) for per_element in (False, True)],
)
def test_vjp_equals_a_dense_solve_with_the_kkt_matrix(build, per_element, bound, upstream):
    problem = make_problem(build, bound=bound, per_element=per_element)
    result = solved(problem)
    lin = kkt.linearise(problem, result.primal)
    assert not bool(lin.degenerate.any())
    assert (int((lin.lower | lin.upper).sum()) > 0) == (bound < 1)
    n = build.normal(11)
    grads = [n(*v.shape) for v in result.primal] + [n(BATCH)]
    grads = [g * (upstream in ("all", name)) for g, name in zip(grads, ("x", "u", "lam", "objective"), strict=True)]
    found = kkt.vjp(problem, lin, tuple(grads), torch.ones(BATCH, dtype=torch.bool))
    each = [
        Dense(element(problem, i), [v[i] for v in result.primal], lin.lower[i], lin.upper[i]).vjp(
            *(g[i] for g in grads)
        )
        for i in range(BATCH)
    ]
    for name in INPUTS:
        expected = torch.stack([e[name].expand(problem.shape(name)) for e in each])
        if name in ("Q", "R", "Q_final"):  # the inputs are symmetric, and so are their gradients
            expected = 0.5 * (expected + expected.mT)
        if problem.shared(name):
            expected = expected.sum(0)
        torch.testing.assert_close(found[name], expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max() + 1e-3))


def test_vjp_is_linear_in_the_upstream_gradient(build):
    problem = make_problem(build)
    result = solved(problem)
    lin = kkt.linearise(problem, result.primal)
    n = build.normal(2)
    a, b = ([n(*v.shape) for v in result.primal] + [n(BATCH)] for _ in range(2))
    every = torch.ones(BATCH, dtype=torch.bool)
    left, right = (kkt.vjp(problem, lin, tuple(g), every) for g in (a, b))
    both = kkt.vjp(problem, lin, tuple(2 * x - 3 * y for x, y in zip(a, b, strict=True)), every)
    for name in INPUTS:
        expected = 2 * left[name] - 3 * right[name]
        torch.testing.assert_close(both[name], expected, rtol=1e-8, atol=1e-9 * float(1 + expected.abs().max()))


def test_vjp_of_elements_that_were_not_solved_is_exactly_zero(build):
    problem = make_problem(build, per_element=True)
    result = solved(problem)
    lin = kkt.linearise(problem, result.primal)
    grads = (*(torch.ones_like(v) for v in result.primal), torch.ones(BATCH, dtype=torch.float64))
    keep = torch.tensor([True, False, True, False])
    some = kkt.vjp(problem, lin, grads, keep)
    every = kkt.vjp(problem, lin, grads, torch.ones(BATCH, dtype=torch.bool))
    for name in INPUTS:
        assert torch.equal(some[name][~keep], torch.zeros_like(some[name][~keep]))
        assert torch.equal(some[name][keep], every[name][keep])


# --- polish ---------------------------------------------------------------------------------------------------------


def residual_of(problem, primal):
    return kkt.residual(problem, primal, kkt.multipliers(problem, primal))


@pytest.mark.parametrize("noise", [1e-7, 1e-5, 1e-4])
@pytest.mark.parametrize("bound", [10.0, 0.15])
def test_polish_brings_a_rough_solution_to_machine_precision(build, noise, bound):
    problem = make_problem(build, bound=bound)
    exact, n = solved(problem).primal, build.normal(4)
    rough = Primal(*(v + noise * n(*v.shape) for v in exact))
    rough = rough._replace(u=problem.clip(rough.u), lam=rough.lam.clamp_min(1e-9))
    polished = kkt.polish(problem, rough)
    assert float(residual_of(problem, polished).max()) < 1e-9
    torch.testing.assert_close(polished.u, exact.u, rtol=0, atol=1e-7)


def test_polish_never_makes_anything_worse(build):
    problem, n = make_problem(build), build.normal(4)
    u = problem.clip(n(BATCH, HORIZON, 2))
    x, lam = problem.rollout(u)
    for primal in (Primal(x, u, lam), Primal(x + 1, u, lam), solved(problem).primal):
        before = residual_of(problem, primal)
        assert bool((residual_of(problem, kkt.polish(problem, primal)) <= before).all())


def test_active_sets_are_those_of_the_solution(build):
    problem = make_problem(build, bound=0.05)
    result = solved(problem)
    lin = kkt.linearise(problem, result.primal)
    assert torch.equal(lin.lower, result.primal.u <= problem.u_min + 1e-9)
    assert torch.equal(lin.upper, result.primal.u >= problem.u_max - 1e-9)
    assert 0 < int(lin.lower.sum() + lin.upper.sum()) < result.primal.u.numel()


def test_equal_bounds_hold_the_action_without_degeneracy(build):
    problem = make_problem(build)
    fixed = dataclasses.replace(
        problem,
        u_min=torch.tensor([0.02, -0.15], dtype=torch.float64),
        u_max=torch.tensor([0.02, 0.15], dtype=torch.float64),
    )
    result = solved(fixed)
    assert bool((result.status == Status.CONVERGED).all())
    assert float((result.primal.u[..., 0] - 0.02).abs().max()) == 0
    assert float(result.kkt_residual.max()) < 1e-8
