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

pytestmark = pytest.mark.usefixtures("one_thread")

BATCH, HORIZON, RELAXATION = 4, 3, 1e-4
N_C = 3


def make_problem(build, seed=0, bound=0.15, batch=BATCH, per_element=False, by_stage=(), cross=False, rows=False):
    """Random problems; of the fields in `by_stage` every stage has another one."""
    lead, n = (batch,) if per_element else (), build.normal(seed + 50)
    tensors = {**build.lcs_tensors(seed, batch=lead), **build.cost_tensors(seed, batch=lead)}
    limit = torch.full((*lead, 2), bound, dtype=torch.float64)
    tensors |= {"u_min": -limit, "u_max": limit}
    if cross:
        tensors["S"] = 0.2 * n(*lead, 4, 2)
    if rows:
        tensors |= {"G_x": n(*lead, N_C, 4), "G_u": n(*lead, N_C, 2)}
        tensors |= {"g": torch.full((N_C,), 50.0, dtype=torch.float64), "price": torch.ones(N_C).double()}
    for name in by_stage:
        value, stages = tensors[name], HORIZON + (name == "G_x")
        value = value if per_element else value.unsqueeze(0)
        own = () if name in ("Q", "R", "F") else tensors[name].shape[-len(INPUTS[name]) :]  # these stay definite
        factor = 1 + 0.2 * n(len(value), stages, *(own or [1] * (value.ndim - 1))).clamp(-2, 2)
        tensors[name] = value.unsqueeze(1) * (factor.abs() if name.startswith("u_") else factor)
    problem = MPCProblem(**tensors, x0=0.2 * build.normal(seed + 7)(batch, 4), horizon=HORIZON, relaxation=RELAXATION)
    return with_limits(build, problem) if rows else problem


def with_limits(build, problem):
    """Constraints that the plan without them violates here and there; of the rows the second is soft.

    The third is one of the states only, from the second stage on.
    """
    G_u = problem.G_u.clone()
    G_u[..., 2, :] = 0.0
    everywhere = torch.full((problem.batch, HORIZON + 1, N_C), 50.0, dtype=torch.float64)
    price = torch.tensor([[torch.inf, cheap, torch.inf] for cheap in (0.05, 5.0, 0.05, 5.0)], dtype=torch.float64)
    loose = dataclasses.replace(problem, G_u=G_u, g=everywhere, price=price)
    plan, n = solved(loose).primal, build.normal(5)
    u = loose.clip(0.8 * plan.u + 0.02 * n(*plan.u.shape))  # a plan that all constraints allow
    best, other = (loose.constraints(x, u) + 50.0 for x, u in ((plan.x, plan.u), (loose.rollout(u)[0], u)))
    tight = (other < best) & (n(*best.shape) < -0.2)
    g = torch.where(tight, 0.5 * (best + other), torch.maximum(best, other) + 0.3)
    g[:, 0, 2] = torch.inf
    return dataclasses.replace(loose, g=g)


def element(problem, i):
    """The numbers of one element as a dict of tensors, those of all stages with the stages in front."""
    found = {}
    for name in INPUTS:
        value = getattr(problem, name)
        value = value if problem.shared(name) and not problem.by_stage(name) else value[i if len(value) > 1 else 0]
        stages = problem.stages(name)
        found[name] = value.expand(stages, *problem.shape(name)).clone() if stages else value
    return found


def objective(t, x, u, fined=None):
    """J of one trajectory, x a list of H+1 states and u of H actions; `fined` says which constraints cost."""
    total = 0.5 * x[-1] @ t["Q_final"] @ x[-1] + t["q_final"] @ x[-1]
    for k in range(len(u)):
        total = total + 0.5 * x[k] @ t["Q"][k] @ x[k] + t["q"][k] @ x[k] + x[k] @ t["S"][k] @ u[k]
        total = total + 0.5 * u[k] @ t["R"][k] @ u[k] + t["r"][k] @ u[k]
    if fined is not None and bool(fined.any()):
        total = total + (t["price"] * rows_of(t, x, u))[fined].sum()
    return total


def rows_of(t, x, u):
    """G_x x + G_u u − g, (H+1, n_c)."""
    return torch.stack(
        [t["G_x"][k] @ x[k] + (t["G_u"][k] @ u[k] if k < len(u) else 0.0) - t["g"][k] for k in range(len(x))]
    )


def rollout_objective(t, x0, u, mu):
    """L of actions u (H, n_u) through the relaxed LCP: a function of u and x0 alone."""
    x = [x0]
    for k in range(len(u)):
        lam = solve_lcp(t["F"][k], t["D"][k] @ x[-1] + t["E"][k] @ u[k] + t["c"][k], relaxation=RELAXATION).lam
        x.append(t["A"][k] @ x[-1] + t["B"][k] @ u[k] + t["C"][k] @ lam + t["d"][k])
    return objective(t, x, list(u)) + (mu * rows_of(t, x, u)).sum()


def solved(problem):
    return IpoptBackend(workers=1).solve(problem, None)


STAGEWISE = ("A", "B", "C", "d", "D", "E", "F", "c", "Q", "R", "q", "r", "u_min", "u_max")
KINDS = {
    "constant": {},
    "per element": {"per_element": True},
    "by stage": {"by_stage": STAGEWISE},
    "cross": {"cross": True},
    "rows": {"rows": True},
    "unbounded": {"bound": torch.inf},
    "all": {"per_element": True, "by_stage": (*STAGEWISE, "S", "G_x", "G_u"), "cross": True, "rows": True},
    "all, shared": {"by_stage": (*STAGEWISE, "S", "G_x", "G_u"), "cross": True, "rows": True},
}


# --- multipliers and residual ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_reduced_gradient_and_costate_are_autograds_of_the_rollout(build, kind):
    problem, n = make_problem(build, **KINDS[kind]), build.normal(3)
    u = 0.1 * n(BATCH, HORIZON, 2)  # anywhere, not at a solution
    mu = n(BATCH, HORIZON + 1, problem.n_c).abs() * torch.isfinite(problem.g)
    x, lam = problem.rollout(u)
    dual = kkt.multipliers(problem, Primal(x, u, lam, mu))
    for i in range(BATCH):
        t = element(problem, i)
        t["g"] = t["g"].nan_to_num(posinf=0.0)
        action, start = u[i].clone().requires_grad_(), t["x0"].clone().requires_grad_()
        in_u, in_x0 = torch.autograd.grad(rollout_objective(t, start, action, mu[i]), (action, start))
        torch.testing.assert_close(dual.gradient[i], in_u, rtol=1e-8, atol=1e-9)
        torch.testing.assert_close(dual.p[i, 0], in_x0, rtol=1e-8, atol=1e-9)


def test_a_trajectory_without_multipliers_of_constraints_has_none(build):
    problem = make_problem(build)
    u = 0.1 * build.normal(3)(BATCH, HORIZON, 2)
    x, lam = problem.rollout(u)
    short, long = Primal(x, u, lam), Primal(x, u, lam, problem.no_multipliers())
    assert torch.equal(kkt.multipliers(problem, short).gradient, kkt.multipliers(problem, long).gradient)
    assert kkt.polish(problem, short).mu.shape == (BATCH, HORIZON + 1, 0)


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

    def __init__(self, t, primal, lower, upper, held, fined):
        self.t, self.lower, self.upper, self.held, self.fined = t, lower, upper, held, fined
        # A constraint that is nowhere near has any finite limit.
        self.t["g"] = torch.where(torch.isinf(t["g"]), 100.0, t["g"])
        self.t["price"] = torch.where(fined, t["price"], 0.0)
        H, n_x, n_u, n_lam, n_c = HORIZON, *(primal[i].shape[-1] for i in range(3)), held.shape[-1]
        self.shapes = [(H, n_x), (H, n_u), (H, n_lam), (H, n_x), (H, n_lam), (H, n_u), (H + 1, n_c)]
        self.sizes = [a * b for a, b in self.shapes]
        x, u, lam = primal
        self.primal = torch.cat([x[1:].reshape(-1), u.reshape(-1), lam.reshape(-1)])

    def split(self, z):
        parts = torch.split(z, self.sizes[: 7 if len(z) == sum(self.sizes) else 3])
        return [v.reshape(shape) for v, shape in zip(parts, self.shapes, strict=False)]

    def lagrangian(self, z, t):
        x, u, lam, p, y, nu, m = self.split(z)
        x = [t["x0"], *x]
        total = objective(t, x, list(u), self.fined)
        for k in range(HORIZON):
            s = t["D"][k] @ x[k] + t["E"][k] @ u[k] + t["F"][k] @ lam[k] + t["c"][k]
            ahead = t["A"][k] @ x[k] + t["B"][k] @ u[k] + t["C"][k] @ lam[k] + t["d"][k]
            total = total + p[k] @ (ahead - x[k + 1]) + y[k] @ (lam[k] * s - RELAXATION)
        # ν and m act on active bounds and held constraints; elsewhere they are pinned to zero.
        low, high = (torch.where(v.isinf(), 0.0, v) for v in (t["u_min"], t["u_max"]))
        total = total + (nu * (u - low) * self.lower).sum() + (nu * (u - high) * self.upper).sum()
        total = total + 0.5 * (nu.square() * ~(self.lower | self.upper)).sum()
        return total + (m * rows_of(t, x, u) * self.held).sum() + 0.5 * (m.square() * ~self.held).sum()

    def conditions(self, z, t):
        with torch.enable_grad():
            z = z if z.requires_grad else z.clone().requires_grad_()
            return torch.autograd.grad(self.lagrangian(z, t), z, create_graph=True)[0]

    def solve_multipliers(self):
        """p, y, ν, m from stationarity, linear in them, by least squares."""
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
        x, u, lam = self.split(split)
        x = torch.cat([t["x0"][None], x])
        upstream = (x * x_bar).sum() + (u * u_bar).sum() + (lam * lam_bar).sum()
        # On the objective: what a change does to it at the optimum, where held constraints have their multiplier.
        m = self.split(z)[6]
        upstream = upstream + objective_bar * objective(t, list(x), list(u), self.fined)
        z_bar, *direct = torch.autograd.grad(upstream, (split, *t.values()), allow_unused=True)
        z_bar = torch.cat([z_bar, torch.zeros(len(z) - len(z_bar), dtype=torch.float64)])
        w = torch.linalg.solve(K, z_bar)
        implicit = torch.autograd.grad(
            -(w.detach() * self.conditions(z.clone().requires_grad_(), t)).sum(), tuple(t.values()), allow_unused=True
        )
        zero = torch.zeros((), dtype=torch.float64)
        found = {k: (a if a is not None else zero) + (b if b is not None else zero)
                 for k, a, b in zip(t, direct, implicit, strict=True)}  # fmt: skip
        return found, m


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "upstream", "bound"),
    [("constant", upstream, 0.15) for upstream in ("x", "u", "lam", "objective")]
    + [(kind, "all", bound) for bound in (10.0, 0.15, 0.03) for kind in ("constant", "per element")]
    + [(kind, "all", None) for kind in list(KINDS)[2:]]
    + [(kind, "objective", None) for kind in ("rows", "all")],
)
def test_vjp_equals_a_dense_solve_with_the_kkt_matrix(build, kind, bound, upstream):
    problem = make_problem(build, **{**KINDS[kind], **({} if bound is None else {"bound": bound})})
    result = solved(problem)
    lin = kkt.linearise(problem, result.primal)
    assert result.status.tolist() == [Status.CONVERGED] * BATCH
    if problem.n_c:
        assert int(lin.held.sum()) >= 3
        assert int(lin.fined.sum()) >= 1
        assert bool((lin.held & torch.isfinite(problem.price)).any())
    else:
        assert (int((lin.lower | lin.upper).sum()) > 0) == (float(problem.u_max.max()) < 1)
    n = build.normal(11)
    grads = [n(*v.shape) for v in result.primal[:3]] + [n(BATCH)]
    grads = [g * (upstream in ("all", name)) for g, name in zip(grads, ("x", "u", "lam", "objective"), strict=True)]
    found = kkt.vjp(problem, lin, tuple(grads), torch.ones(BATCH, dtype=torch.bool))
    each = []
    for i in range(BATCH):
        active = (v[i] for v in (lin.lower, lin.upper, lin.held, lin.fined))
        dense, m = Dense(element(problem, i), [v[i] for v in result.primal[:3]], *active).vjp(*(g[i] for g in grads))
        each.append(dense)
        torch.testing.assert_close(result.primal.mu[i] * lin.held[i], m * lin.held[i], rtol=1e-6, atol=1e-8)
    for name in INPUTS:
        stages = (problem.stages(name),) if problem.stages(name) else ()
        expected = torch.stack([e[name].expand(*stages, *problem.shape(name)) for e in each])
        if name in ("Q", "R", "Q_final"):  # the inputs are symmetric, and so are their gradients
            expected = 0.5 * (expected + expected.mT)
        if stages and not problem.by_stage(name):
            expected = expected.sum(1)
        if problem.shared(name):
            expected = expected.sum(0, keepdim=problem.by_stage(name))
        torch.testing.assert_close(found[name], expected, rtol=1e-7, atol=1e-8 * float(_size(expected) + 1e-3))


def _size(value):
    return value.abs().max() if value.numel() else 0.0


def test_vjp_is_linear_in_the_upstream_gradient(build):
    problem = make_problem(build)
    result = solved(problem)
    lin = kkt.linearise(problem, result.primal)
    n = build.normal(2)
    a, b = ([n(*v.shape) for v in result.primal[:3]] + [n(BATCH)] for _ in range(2))
    every = torch.ones(BATCH, dtype=torch.bool)
    left, right = (kkt.vjp(problem, lin, tuple(g), every) for g in (a, b))
    both = kkt.vjp(problem, lin, tuple(2 * x - 3 * y for x, y in zip(a, b, strict=True)), every)
    for name in INPUTS:
        expected = 2 * left[name] - 3 * right[name]
        torch.testing.assert_close(both[name], expected, rtol=1e-8, atol=1e-9 * float(1 + _size(expected)))


def test_vjp_of_elements_that_were_not_solved_is_exactly_zero(build):
    problem = make_problem(build, per_element=True)
    result = solved(problem)
    lin = kkt.linearise(problem, result.primal)
    grads = (*(torch.ones_like(v) for v in result.primal[:3]), torch.ones(BATCH, dtype=torch.float64))
    keep = torch.tensor([True, False, True, False])
    some = kkt.vjp(problem, lin, grads, keep)
    every = kkt.vjp(problem, lin, grads, torch.ones(BATCH, dtype=torch.bool))
    for name in (name for name in INPUTS if not problem.shared(name)):
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
