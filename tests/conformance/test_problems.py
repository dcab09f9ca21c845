"""Every form a problem may take, for every exact backend: stages, cross terms, open bounds, constraints, no contact.

As in `test_backends.py` a new backend is tested here by being registered. Plans are judged by sums and products that
are written out here, and gradients by differences of plans.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from difflcs import (
    ConstraintSequence,
    CostSequence,
    LCSMPCLayer,
    LCSParams,
    LCSSequence,
    LinearConstraints,
    QuadraticCost,
    StageBounds,
    Status,
    available_backends,
)
from difflcs.errors import SolveWarning
from difflcs.mpc import Primal
from difflcs.mpc.backends import get_backend
from tests.conformance.differences import compare, moves, weigh

EXACT = tuple(name for name in available_backends() if get_backend(name).exact)
LCS, COST = ("A", "B", "C", "d", "D", "E", "F", "c"), ("Q", "R", "S", "Q_final", "q", "r", "q_final")
BOUNDS, ROWS = ("u_min", "u_max"), ("G", "g", "E_rows", "weight")
MATRICES = ("A", "B", "C", "D", "E", "F", "Q", "R", "S", "Q_final", "G", "E_rows")
STAGED = (*LCS, "Q", "R", "S", "q", "r", *BOUNDS, *ROWS)  # all but Q_final, q_final, x0
HORIZON, INF = 3, float("inf")

every_exact = pytest.mark.parametrize("backend", EXACT)
every_exact_on_copies = pytest.mark.parametrize(
    "backend", [pytest.param(name, marks=[pytest.mark.slow] * (name == "ipopt")) for name in EXACT]
)


@dataclass(frozen=True)
class Problem:
    """A batch of problems in the terms of the public interface; `staged` names what is given by stage."""

    tensors: dict[str, Tensor]
    staged: frozenset[str] = frozenset()
    horizon: int = HORIZON
    relaxation: float = 1e-4

    @property
    def batch(self):
        return len(self.tensors["x0"])

    def own(self, name):
        return (2 if name in MATRICES else 1) + (name in self.staged)

    def stages(self, name):
        return self.horizon + (name in ("G", "g", "weight"))

    def each(self):
        """The same with every input given per element, copied."""
        full = {k: v.expand(self.batch, *v.shape[v.ndim - self.own(k) :]).clone() for k, v in self.tensors.items()}
        return dataclasses.replace(self, tensors=full)

    def at(self, name, i, k):
        """One input of element i at stage k."""
        value = self.tensors[name]
        value = value[i] if value.ndim > self.own(name) else value
        return value[k] if name in self.staged else value

    def has(self, name):
        return name in self.tensors


def parts(problem, t):
    """Arguments of the layer: system, cost, and by keyword the bounds and constraints."""
    staged = problem.staged
    system = (LCSSequence if "A" in staged else LCSParams)(**{k: t[k] for k in LCS})
    weights = {k: t[k] for k in COST if k in t}
    by_stage = tuple(staged & set(COST))
    cost = (
        CostSequence(**weights, by_stage=by_stage, check=False) if by_stage else QuadraticCost(**weights, check=False)
    )
    limits = {k: t[k] for k in BOUNDS if k in t}
    by_stage = tuple(staged & set(BOUNDS))
    options = {"bounds": StageBounds(**limits, by_stage=by_stage)} if by_stage else limits
    if "G" in t:
        rows = {"G": t["G"], "g": t["g"], "E": t.get("E_rows"), "weight": t.get("weight")}
        by_stage = tuple(name.removesuffix("_rows") for name in staged & set(ROWS))
        kind = ConstraintSequence(**rows, by_stage=by_stage) if by_stage else LinearConstraints(**rows)
        options["constraints"] = kind
    return system, cost, options


def solve(problem, backend, guess=None, tensors=None, **options):
    t = tensors or problem.tensors
    system, cost, limits = parts(problem, t)
    layer = LCSMPCLayer(
        system, cost, problem.horizon, backend=backend, relaxation=problem.relaxation, **limits, **options
    )
    return layer(t["x0"], guess=guess)


# --- the problems ---------------------------------------------------------------------------------------------------


def make(build, seed=0, batch=4, n_lam=3, bound=0.15, staged=(), each=(), **options):
    """Random problems; of what is in `staged` each stage has another, of what is in `each` each element."""
    lead, n = ((batch,) if each else ()), build.normal(seed + 7)
    limit = torch.full((2,), bound, dtype=torch.float64)
    tensors = {**build.lcs_tensors(seed, n_lam=n_lam, batch=lead), **build.cost_tensors(seed, batch=lead)}
    tensors |= {"u_min": -limit, "u_max": limit, "x0": 0.2 * n(batch, 4)}
    problem = Problem(tensors, **options)
    return vary(build, problem, staged)


def vary(build, problem, names, seed=1):
    """Each stage its own version of some inputs."""
    tensors, n = dict(problem.tensors), build.normal(seed)
    for name in names:
        value, rank = tensors[name], problem.own(name)
        stages = problem.stages(name)
        lead, own = value.shape[: value.ndim - rank], value.shape[value.ndim - rank :]
        # Definite matrices are scaled as a whole, so that they stay definite.
        shape = [1] * rank if name in ("Q", "R", "F", *BOUNDS) else own
        factor = 1 + 0.2 * n(*lead, stages, *shape).clamp(-2, 2)
        tensors[name] = value.unsqueeze(len(lead)) * factor
    return dataclasses.replace(problem, tensors=tensors, staged=problem.staged | frozenset(names))


def cross(build):
    problem = make(build, seed=1)
    return dataclasses.replace(problem, tensors={**problem.tensors, "S": 0.2 * build.normal(9)(4, 2)})


def stages(build):
    return vary(build, cross(build), (*LCS, "Q", "R", "S", "q", "r", *BOUNDS))


def stages_per_element(build):
    problem = make(build, seed=3, each=("all",))
    problem = dataclasses.replace(problem, tensors={**problem.tensors, "S": 0.1 * build.normal(9)(4, 4, 2)})
    return vary(build, problem, (*LCS, "Q", "R", "S", "q", "r"))


def preview(build):
    return make(build, seed=4, staged=("q",))


def half_open(build):
    problem = make(build, seed=5, bound=0.05)
    return dataclasses.replace(problem, tensors={**problem.tensors, "u_max": torch.tensor([INF, 0.05]).double()})


def unbounded(build):
    tensors = make(build, seed=6).tensors
    return Problem({k: v for k, v in tensors.items() if k not in BOUNDS})


def no_contact(build):
    return make(build, seed=7, n_lam=0, bound=0.1)


def no_contact_stages(build):
    problem = make(build, seed=8, n_lam=0, bound=0.1)
    return vary(build, problem, (*LCS, "Q", "R", "q", "r"))


def with_rows(build, problem, weight=None, margin=0.01):
    """Two constraints that some plans without them violate; the actions count in the second."""
    n = build.normal(21)
    G, E = n(2, 4), n(2, 2) * torch.tensor([[0.0], [1.0]]).double()
    free = solve(problem, "ipopt")
    value = free.x @ G.mT
    value[:, :-1] += free.u @ E.mT
    g = value.amax(1).quantile(0.5, 0) - margin
    g[0] = torch.maximum(g[0], value[:, 0, 0].max() + 0.01)  # the first row is about x0 alone at the first stage
    tensors = {**problem.tensors, "G": G, "g": g, "E_rows": E}
    if weight is not None:
        tensors["weight"] = weight
    return dataclasses.replace(problem, tensors=tensors)


def hard(build):
    return with_rows(build, make(build, seed=10, bound=0.4))


def soft(build):
    return with_rows(build, make(build, seed=10, bound=0.4), torch.tensor([0.02, 0.01]).double(), margin=0.05)


def soft_and_hard(build):
    return with_rows(build, make(build, seed=10, bound=0.4), torch.tensor([0.05, INF]).double())


def rows_by_stage(build):
    return vary(build, with_rows(build, make(build, seed=12, bound=0.4), torch.tensor([0.3, 0.3]).double()), ROWS)


def terminal(build):
    """A constraint of the last state alone, by g = ∞ before it."""
    problem = with_rows(build, make(build, seed=13, bound=0.4))
    g = torch.full((HORIZON + 1, 2), INF, dtype=torch.float64)
    free = solve(
        dataclasses.replace(problem, tensors={k: v for k, v in problem.tensors.items() if k not in ROWS}), "ipopt"
    )
    g[-1, 0] = (free.x[:, -1] @ problem.tensors["G"][0]).median() - 0.01
    tensors = {**problem.tensors, "g": g}
    return dataclasses.replace(problem, tensors=tensors, staged=problem.staged | {"g"})


def everything(build):
    problem = make(build, seed=14, bound=0.4, each=("all",))
    tensors = {**problem.tensors, "S": 0.1 * build.normal(9)(4, 4, 2)}
    tensors["u_max"] = torch.tensor([INF, 0.3]).double()
    problem = vary(build, dataclasses.replace(problem, tensors=tensors), (*LCS, "Q", "R", "S", "q", "r", "u_min"))
    return vary(build, with_rows(build, problem, torch.tensor([0.5, 0.5]).double()), ("G", "E_rows", "g"))


PROBLEMS = {
    f.__name__: f
    for f in (
        cross, stages, stages_per_element, preview, half_open, unbounded, no_contact, no_contact_stages, hard, soft,
        soft_and_hard, rows_by_stage, terminal, everything,
    )
}  # fmt: skip
CONSTRAINED = ("hard", "soft", "soft_and_hard", "rows_by_stage", "terminal", "everything")

every_problem = pytest.mark.parametrize("name", PROBLEMS)


@pytest.fixture(scope="module")
def solutions(build):
    """Each problem solved once per backend."""
    cache = {}

    def get(name, backend):
        if (name, backend) not in cache:
            problem = PROBLEMS[name](build)
            cache[name, backend] = problem, solve(problem, backend)
        return cache[name, backend]

    return get


# --- forward --------------------------------------------------------------------------------------------------------


@every_problem
@every_exact
def test_every_element_is_solved_to_the_tolerance(solutions, name, backend):
    problem, sol = solutions(name, backend)
    assert bool(sol.converged.all()), sol.status
    assert float(sol.kkt_residual.max()) <= 1e-6
    n_c = problem.tensors["g"].shape[-1] if problem.has("g") else 0
    assert sol.mu.shape == (problem.batch, problem.horizon + 1, n_c)
    assert sol.violation.shape == (problem.batch,)
    assert not sol.mu.requires_grad


@every_problem
@every_exact
def test_dynamics_complementarity_and_bounds_hold_by_hand(solutions, name, backend):
    problem, sol = solutions(name, backend)
    for i, k in itertools.product(range(problem.batch), range(problem.horizon)):
        A, B, C, d, D, E, F, c = (problem.at(key, i, k) for key in LCS)
        x, u, lam = sol.x[i, k], sol.u[i, k], sol.lam[i, k]
        torch.testing.assert_close(A @ x + B @ u + C @ lam + d, sol.x[i, k + 1], rtol=1e-8, atol=1e-8)
        slack = D @ x + E @ u + F @ lam + c
        assert bool((lam > 0).all() and (slack > 0).all())
        torch.testing.assert_close(lam * slack, torch.full_like(lam, problem.relaxation), rtol=0, atol=1e-8)
        if problem.has("u_min"):
            assert bool((u >= problem.at("u_min", i, k)).all() and (u <= problem.at("u_max", i, k)).all())
    assert torch.equal(sol.x[:, 0], problem.tensors["x0"])


def rows(problem, i, x, u):
    """G x + E u − g of one trajectory, (H+1, n_c)."""
    found = []
    for k in range(problem.horizon + 1):
        value = problem.at("G", i, k) @ x[k] - problem.at("g", i, k)
        if k < problem.horizon and problem.has("E_rows"):
            value = value + problem.at("E_rows", i, k) @ u[k]
        found.append(value)
    return torch.stack(found)


def prices(problem, i):
    if not problem.has("weight"):
        return torch.full_like(problem.at("g", i, 0), INF).expand(problem.horizon + 1, -1)
    return torch.stack([problem.at("weight", i, k) for k in range(problem.horizon + 1)])


def cost(problem, i, x, u):
    """The objective of one trajectory without the price of violations."""
    total = 0.0
    for k in range(problem.horizon):
        Q, R, q, r = (problem.at(key, i, k) for key in ("Q", "R", "q", "r"))
        total = total + x[k] @ (0.5 * Q @ x[k] + q) + u[k] @ (0.5 * R @ u[k] + r)
        if problem.has("S"):
            total = total + x[k] @ problem.at("S", i, k) @ u[k]
    return total + x[-1] @ (0.5 * problem.at("Q_final", i, 0) @ x[-1] + problem.at("q_final", i, 0))


@every_problem
@every_exact
def test_the_objective_is_the_sum_of_its_terms(solutions, name, backend):
    problem, sol = solutions(name, backend)
    for i in range(problem.batch):
        expected = cost(problem, i, sol.x[i], sol.u[i])
        if problem.has("G"):
            price = prices(problem, i)
            excess = rows(problem, i, sol.x[i], sol.u[i]).clamp_min(0.0)
            expected = expected + (torch.where(price < INF, price, 0.0) * excess).sum()
        assert float(sol.objective[i]) == pytest.approx(float(expected), rel=1e-9, abs=1e-10)


@pytest.mark.parametrize("name", CONSTRAINED)
@every_exact
def test_constraints_hold_or_are_paid_for(solutions, name, backend):
    problem, sol = solutions(name, backend)
    held = 0
    for i in range(problem.batch):
        value, price, mu = rows(problem, i, sol.x[i], sol.u[i]), prices(problem, i), sol.mu[i]
        assert float(sol.violation[i]) == pytest.approx(float(value.max().clamp_min(0.0)), abs=1e-9)
        hard = price == INF
        assert float(value[hard].max() if hard.any() else 0.0) <= 1e-7
        assert bool((mu >= 0).all() and (mu <= price * (1 + 1e-12)).all())
        free, paid = mu <= 1e-9, mu >= price * (1 - 1e-9)
        assert float(value[~paid].max()) <= 1e-6
        assert float(value[~free].min() if (~free).any() else 0.0) >= -1e-6
        held += int((~free & ~paid).sum())
    assert held > 0 or name == "soft"
    if name == "soft":
        assert float(sol.violation.min()) >= 0
        assert float(sol.violation.max()) > 1e-3


@every_problem
@every_exact
def test_no_plan_nearby_is_better(build, solutions, name, backend):
    """Random actions nearby, rolled out by hand, with every violation at more than its multiplier."""
    problem, sol = solutions(name, backend)
    n, each = build.normal(31), problem.each()
    dear = 2 * float(sol.mu.max()) + 1 if problem.has("G") else 0.0
    for step in (1e-3, 1e-2):
        for _ in range(8):
            u = sol.u + step * n(*sol.u.shape)
            if problem.has("u_min"):
                low, high = (
                    torch.stack([torch.stack([problem.at(b, i, k) for k in range(problem.horizon)])
                                 for i in range(problem.batch)]) for b in BOUNDS
                )  # fmt: skip
                u = u.clamp(low, high)
            x = rollout(each, u)
            for i in range(problem.batch):
                value = float(cost(problem, i, x[i], u[i]))
                if problem.has("G"):
                    price = prices(problem, i).clamp_max(dear)
                    value += float((price * rows(problem, i, x[i], u[i]).clamp_min(0.0)).sum())
                best = float(sol.objective[i])
                assert value >= best - 1e-7 * (1 + abs(best))


def rollout(each, u):
    """States of actions by the public record, relaxed as the plan is."""
    from difflcs import solve_lcp

    x, states = each.tensors["x0"], [each.tensors["x0"]]
    for k in range(each.horizon):
        t = {key: each.tensors[key][:, k] if key in each.staged else each.tensors[key] for key in LCS}
        mul = lambda M, v: (M @ v.unsqueeze(-1)).squeeze(-1)  # noqa: E731
        lam = solve_lcp(t["F"], mul(t["D"], x) + mul(t["E"], u[:, k]) + t["c"], relaxation=each.relaxation).lam
        x = mul(t["A"], x) + mul(t["B"], u[:, k]) + mul(t["C"], lam) + t["d"]
        states.append(x)
    return torch.stack(states, 1)


@every_problem
def test_exact_backends_agree(solutions, name):
    _, first = solutions(name, EXACT[0])
    for other in EXACT[1:]:
        _, second = solutions(name, other)
        same = (first.objective - second.objective).abs() <= 1e-6 * (1 + first.objective.abs())
        assert float(same.double().mean()) >= 0.5  # another local optimum is allowed
        assert float((first.u - second.u).abs()[same].max()) <= 1e-3
        assert float((first.mu - second.mu).abs()[same].sum()) <= 1e-3 * (1 + float(first.mu.sum()))


@pytest.mark.parametrize("name", ["no_contact", "no_contact_stages"])
@every_exact
def test_without_contact_and_bounds_the_plan_is_riccatis(build, name, backend):
    problem = PROBLEMS[name](build)
    t = {k: v for k, v in problem.tensors.items() if k not in BOUNDS}
    problem = dataclasses.replace(problem, tensors={**t, "S": 0.1 * build.normal(3)(4, 2)})
    sol = solve(problem, backend)
    assert sol.lam.shape == (4, HORIZON, 0)
    assert float(sol.dynamics_residual().max()) < 1e-9
    assert not sol.complementarity().any()
    for i in range(problem.batch):
        P, p = problem.at("Q_final", i, 0), problem.at("q_final", i, 0)
        gains = []
        for k in reversed(range(HORIZON)):
            A, B, d, Q, R, S, q, r = (problem.at(key, i, k) for key in ("A", "B", "d", "Q", "R", "S", "q", "r"))
            H, M, h = R + B.T @ P @ B, S + A.T @ P @ B, r + B.T @ (p + P @ d)
            K, f = -torch.linalg.solve(H, M.T), -torch.linalg.solve(H, h)
            p = q + A.T @ (p + P @ d) + M @ f
            P = Q + A.T @ P @ A + M @ K
            gains.insert(0, (K, f))
        x = problem.tensors["x0"][i]
        for k, (K, f) in enumerate(gains):
            u = K @ x + f
            torch.testing.assert_close(sol.u[i, k], u, rtol=1e-7, atol=1e-9)
            x = problem.at("A", i, k) @ x + problem.at("B", i, k) @ u + problem.at("d", i, k)
        torch.testing.assert_close(sol.x[i, -1], x, rtol=1e-7, atol=1e-9)


@every_exact
def test_an_infinite_bound_is_one_that_never_matters(build, backend):
    problem = unbounded(build)
    far = torch.full((2,), 1e3, dtype=torch.float64)
    wide = dataclasses.replace(problem, tensors={**problem.tensors, "u_min": -far, "u_max": far})
    torch.testing.assert_close(solve(problem, backend).u, solve(wide, backend).u, rtol=1e-5, atol=1e-6)


@every_exact
def test_stages_that_are_alike_are_a_constant_problem(build, backend):
    problem = hard(build)
    t = problem.tensors
    repeated = {}
    for key in problem.tensors:
        if key in STAGED:
            repeated[key] = t[key].unsqueeze(0).expand(problem.stages(key), *t[key].shape).clone()
        else:
            repeated[key] = t[key]
    sequence = dataclasses.replace(problem, tensors=repeated, staged=frozenset(set(t) & set(STAGED)))
    torch.testing.assert_close(solve(sequence, backend).u, solve(problem, backend).u, rtol=1e-6, atol=1e-8)


@every_exact
def test_a_price_above_the_multiplier_makes_a_soft_constraint_hard(build, backend):
    problem = hard(build)
    plan = solve(problem, backend)
    dear = {**problem.tensors, "weight": torch.full((2,), 3 * float(plan.mu.max()), dtype=torch.float64)}
    # From the same local optimum: another program may lead a cold start to another one.
    soft_plan = solve(problem, backend, guess=plan, tensors=dear)
    torch.testing.assert_close(soft_plan.u, plan.u, rtol=1e-5, atol=1e-6)
    cheap = {**problem.tensors, "weight": torch.full((2,), 0.2 * float(plan.mu.max()), dtype=torch.float64)}
    cheap_plan = solve(problem, backend, tensors=cheap)
    assert float(cheap_plan.violation.max()) > 1e-4
    assert float(cheap_plan.mu.max()) == pytest.approx(float(cheap["weight"][0]), rel=1e-9)


@every_exact
def test_multipliers_are_what_a_wider_limit_would_save(build, backend):
    problem = hard(build)
    t = problem.each().tensors
    g = t["g"].clone().requires_grad_()
    sol = solve(problem, backend, tensors={**t, "g": g})
    (gradient,) = torch.autograd.grad(sol.objective.sum(), g)
    torch.testing.assert_close(gradient, -sol.mu.sum(1), rtol=1e-6, atol=1e-8)


@every_exact
def test_an_infeasible_element_is_a_status_and_spoils_no_other(build, backend):
    problem = hard(build).each()
    t = dict(problem.tensors)
    bad = t["g"].clone()
    bad[2, 0] = (t["G"][2, 0] * t["x0"][2]).sum() - 0.3  # the first state violates it by 0.3, whatever follows
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


@pytest.mark.parametrize("name", ["stages", "hard", "rows_by_stage", "no_contact_stages"])
@every_exact
def test_a_warm_start_ends_in_the_same_plan(solutions, name, backend):
    problem, sol = solutions(name, backend)
    for guess in (sol, Primal(sol.x, sol.u, sol.lam)):  # with the multipliers, and without
        warm = solve(problem, backend, guess=guess)
        assert bool(warm.converged.all())
        same = (warm.u - sol.u).abs().amax((1, 2)) < 1e-5
        assert float(same.double().mean()) > 0.5


@pytest.mark.parametrize("name", ["stages_per_element", "everything", "hard"])
@every_exact
def test_batch_equals_loop(solutions, name, backend):
    problem, sol = solutions(name, backend)
    for i in range(problem.batch):
        t = {k: v if v.ndim == problem.own(k) else v[i : i + 1] for k, v in problem.tensors.items()}
        alone = solve(problem, backend, tensors=t)
        torch.testing.assert_close(alone.u[0], sol.u[i], rtol=1e-5, atol=1e-7)
        torch.testing.assert_close(alone.mu[0], sol.mu[i], rtol=1e-4, atol=1e-6)


# --- backward -------------------------------------------------------------------------------------------------------


@every_problem
@every_exact_on_copies
def test_gradient_of_every_input_matches_central_differences(build, solutions, name, backend):
    problem, base = solutions(name, backend)
    directions, moved = moves(build, solve, problem, base, backend)
    some = compare(build, solve, problem, base, backend, directions, moved)
    assert some >= 0.6 * len(directions)  # most inputs matter


@pytest.mark.parametrize("name", ["stages", "preview", "hard", "soft_and_hard", "rows_by_stage", "no_contact"])
@every_exact
def test_gradients_of_shared_inputs_are_sums_of_those_of_the_elements(build, solutions, name, backend):
    problem, base = solutions(name, backend)
    n = build.normal(5)
    weights = [n(*v.shape) for v in (base.x, base.u, base.lam)] + [n(problem.batch)]
    shared = {k: v.clone().requires_grad_() for k, v in problem.tensors.items()}
    each = {k: v.requires_grad_() for k, v in problem.each().tensors.items()}
    for tensors in (shared, each):
        weigh(solve(problem, backend, tensors=tensors), weights).sum().backward()
    for k, value in problem.tensors.items():
        expected = each[k].grad.sum(0) if value.ndim == problem.own(k) else each[k].grad
        torch.testing.assert_close(
            shared[k].grad, expected, rtol=1e-5, atol=1e-7 * float(1 + expected.norm()),
            msg=lambda m, k=k: f"{k}: {m}",
        )  # fmt: skip


class Asked(torch.nn.Module):
    """A cost that is asked for as a `CostModule`."""

    def __init__(self, cost):
        super().__init__()
        self.cost = cost

    def at(self, x, goal=None, context=None):
        return self.cost


@every_problem
def test_a_cost_that_is_asked_for_counts_as_one_that_is_given(build, solutions, name):
    problem, found = solutions(name, "batched")[0], []
    for kind in (lambda cost: cost, Asked):
        leaves = {k: v.clone().requires_grad_() for k, v in problem.tensors.items()}
        system, cost, options = parts(problem, leaves)
        layer = LCSMPCLayer(system, kind(cost), problem.horizon, relaxation=problem.relaxation, **options)
        plan = layer(leaves["x0"])
        (plan.u.sum() + plan.objective.sum()).backward()
        found.append([plan.u, plan.objective, *(leaves[k].grad for k in COST if k in leaves)])
    for given, asked in zip(*found, strict=True):
        torch.testing.assert_close(asked, given, rtol=0, atol=0)


@every_exact
def test_what_is_infinite_has_no_gradient(build, backend):
    for make_problem, key in ((half_open, "u_max"), (terminal, "g"), (soft_and_hard, "weight")):
        problem = make_problem(build)
        leaf = problem.tensors[key].clone().requires_grad_()
        sol = solve(problem, backend, tensors={**problem.tensors, key: leaf})
        (gradient,) = torch.autograd.grad(sol.u.sum() + sol.objective.sum(), leaf)
        infinite = torch.isinf(leaf)
        assert bool(infinite.any())
        assert torch.equal(gradient[infinite], torch.zeros_like(gradient[infinite]))
        assert bool(torch.isfinite(gradient).all())
