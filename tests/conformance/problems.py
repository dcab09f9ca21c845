"""Problems that every backend solves, in the terms of the public interface, and what their plans are judged by.

A new form of problem is one more row of the tables at the end.
"""

import torch

import difflcs
from difflcs.cli.bench import pushing_model
from difflcs.systems import pushing_cost
from tests.conformance import judges
from tests.conformance.cases import Case, in_units, rank
from tests.conformance.judges import affine, mul

LCS, COST = ("A", "B", "C", "d", "D", "E", "F", "c"), ("Q", "R", "S", "Q_final", "q", "r", "q_final")
BOUNDS, ROWS = ("u_min", "u_max"), {"G_x": "G", "g": "g", "G_u": "E", "price": "weight"}  # their names in the records
STAGED = (*LCS, "Q", "R", "S", "q", "r", *BOUNDS, *ROWS)  # all but Q_final, q_final, x0
INF = float("inf")


class Asked(torch.nn.Module):
    """A cost that is asked for as a `CostModule`."""

    def __init__(self, cost):
        super().__init__()
        self.cost = cost

    def at(self, x, goal=None, context=None):
        return self.cost


def layer_of(problem, tensors=None, asked=False, **options):
    """The layer of a problem, or of other inputs of its form; `asked`: its cost is a module."""
    t = dict(tensors or problem.inputs)
    staged = {k for k, v in t.items() if v.ndim == rank(k) + 2}
    t |= {k: t[k][0] for k in staged if len(t[k]) == 1 < len(t["x0"])}  # the public records need no element in front
    if staged & set(LCS):  # then all of the system is given by stage
        t |= {k: torch.stack([t[k]] * problem.horizon, -1 - rank(k)) for k in set(LCS) - staged}
        staged |= set(LCS)
    lcs = (difflcs.LCSSequence if "A" in staged else difflcs.LCSParams)(**{k: t[k] for k in LCS})
    weights, by_stage = {k: t[k] for k in COST if k in t}, tuple(staged & set(COST))
    kind = difflcs.CostSequence if by_stage else difflcs.QuadraticCost
    cost = kind(**weights, check=False, **({"by_stage": by_stage} if by_stage else {}))
    limits, by_stage = {k: t[k] for k in BOUNDS if k in t} | (problem.numbers or {}), tuple(staged & set(BOUNDS))
    options = {"barrier": problem.barrier, "relaxation": problem.relaxation, **options}
    options |= {"bounds": difflcs.StageBounds(**limits, by_stage=by_stage)} if by_stage else limits
    if "g" in t:
        rows = {name: t.get(key) for key, name in ROWS.items()}
        by_stage = tuple(ROWS[key] for key in staged & set(ROWS))
        options["constraints"] = (
            difflcs.ConstraintSequence(**rows, by_stage=by_stage) if by_stage else difflcs.LinearConstraints(**rows)
        )
    return difflcs.LCSMPCLayer(lcs, Asked(cost) if asked else cost, problem.horizon, **options)


def solve(problem, backend, guess=None, tensors=None, **options):
    """The plan of the layer of a problem, or of other inputs of its form."""
    t = tensors or problem.inputs
    return layer_of(problem, t, backend=backend, **options)(t["x0"], guess=guess)


# --- judges -----------------------------------------------------------------------------------------------------------


def rollout(problem, t, u):
    """States of actions by the public record, relaxed as the plan is."""
    states = [t["x0"][:, 0]]
    for k in range(problem.horizon):
        now = {name: t[name][:, k % t[name].shape[1]] for name in LCS}
        D, E, F, c = (now[name] for name in "DEFc")
        lam = difflcs.solve_lcp(F, mul(D, states[-1]) + mul(E, u[:, k]) + c, relaxation=problem.relaxation).lam
        states.append(affine(now, "ABCd", states[-1], u[:, k], lam))
    return torch.stack(states, 1)


def cost(problem, t, x, u):
    """The objective of each trajectory without the price of violations."""
    total = judges.cost(t, x, u)
    if problem.barrier:
        total = total - problem.barrier * ((u - t["u_min"]).log() + (t["u_max"] - u).log()).sum((1, 2))
    return total


def fines(problem, t, x, u, most=INF):
    """The price of violations; hard rows, and what is dearer, cost `most`, or nothing where that is infinite."""
    if "g" not in t:
        return torch.zeros(problem.count).double()
    price = t["price"].clamp_max(most)
    return (torch.where(price < INF, price, 0.0) * judges.rows(t, x, u).clamp_min(0.0)).sum((1, 2))


# --- the problems -----------------------------------------------------------------------------------------------------


def make(build, seed=0, batch=4, bound=0.15, n_x=4, n_u=2, n_lam=3, each=(), size=0.2, staged=(), **options):
    """Random problems; of what is in `each` every element has its own, of what is in `staged` every stage."""

    def lead(group):
        return (batch,) if group in each else ()

    sizes, limit = {"n_x": n_x, "n_u": n_u}, torch.full((n_u,), bound, dtype=torch.float64)
    tensors = {
        **build.lcs_tensors(seed, **sizes, n_lam=n_lam, batch=lead("lcs")),
        **build.cost_tensors(seed, **sizes, batch=lead("cost")),
        "u_min": -limit,
        "u_max": limit,
        "x0": size * build.normal(seed + 7)(batch, n_x),
    }
    if "bounds" in each:
        spread = 0.5 + torch.rand(2, batch, n_u, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        tensors |= {"u_min": -limit * spread[0], "u_max": limit * spread[1]}
    return vary(build, Case(tensors, **options), staged)


def vary(build, problem, names, seed=1, spread=0.2):
    """Each stage its own version of some inputs."""
    inputs, n = {}, build.normal(seed)
    for name in names:
        value, stages = problem.inputs[name], problem.horizon + (name in ("G_x", "g", "price"))
        value = (value[None] if problem.shared(name) else value).unsqueeze(1)
        # Definite matrices are scaled as a whole, so that they stay definite.
        shape = [1] * rank(name) if name in ("Q", "R", "F", *BOUNDS) else value.shape[2:]
        inputs[name] = value * (1 + spread * n(len(value), stages, *shape).clamp(-2, 2))
    return problem.changed(**inputs)


def contact(build):
    return make(build, batch=8)


def without_contact(build):
    problem = make(build, seed=3, batch=8, bound=50.0, relaxation=1e-3)
    return problem.changed(C=torch.zeros_like(problem.inputs["C"]))


def paper_sized(build):
    cost = pushing_cost()(0.05 * build.normal(4)(6, 3), horizon=5)
    limit = torch.full((6,), 0.015, dtype=torch.float64)
    weights = {k: v.detach() for k, v in cost.fields().items()}
    bounds = {"u_min": -limit, "u_max": limit}
    tensors = {**pushing_model(5, 0).tensors(), **weights, **bounds, "x0": 0.05 * build.normal(3)(6, 9)}
    return Case(tensors, horizon=5, relaxation=1e-5)


def badly_scaled(build):
    """`contact` in other units of state, action and force; see the test that compares the two."""
    t = contact(build).inputs
    x, u, f = (torch.tensor(v, dtype=torch.float64) for v in ([1e3, 1e-2, 1.0, 1e-3], [1e-2, 10.0], [1e-2, 1e2, 1 / 3]))
    return Case(in_units(t, x, u, f))


def cross(build):
    return make(build, seed=1).changed(S=0.2 * build.normal(9)(4, 2))


def stages(build):
    return vary(build, cross(build), (*LCS, "Q", "R", "S", "q", "r", *BOUNDS))


def stages_per_element(build):
    problem = make(build, seed=3, each=("lcs", "cost")).changed(S=0.1 * build.normal(9)(4, 4, 2))
    return vary(build, problem, (*LCS, "Q", "R", "S", "q", "r"))


def unbounded(build):
    return make(build, seed=6).without(BOUNDS)


def with_rows(build, problem, weight=None, margin=0.01):
    """Two constraints that some plans without them violate; the actions count in the second."""
    n = build.normal(21)
    G, E = n(2, 4), n(2, 2) * torch.tensor([[0.0], [1.0]]).double()
    free = solve(problem, "ipopt")
    value = free.x @ G.mT
    value[:, :-1] += free.u @ E.mT
    g = value.amax(1).quantile(0.5, 0) - margin
    g[0] = torch.maximum(g[0], value[:, 0, 0].max() + 0.01)  # the first row is about x0 alone at the first stage
    return problem.changed(G_x=G, g=g, G_u=E, **({} if weight is None else {"price": torch.tensor(weight).double()}))


def hard(build):
    return with_rows(build, make(build, seed=10, bound=0.4))


def terminal(build):
    """A constraint of the last state alone, by g = ∞ before it."""
    problem = with_rows(build, make(build, seed=13, bound=0.4))
    g = torch.full((1, problem.horizon + 1, 2), INF, dtype=torch.float64)
    free = solve(problem.without(ROWS), "ipopt")
    g[0, -1, 0] = (free.x[:, -1] @ problem.inputs["G_x"][0]).median() - 0.01
    return problem.changed(g=g)


def everything(build):
    problem = make(build, seed=14, bound=0.4, each=("lcs", "cost")).changed(
        S=0.1 * build.normal(9)(4, 4, 2), u_max=torch.tensor([INF, 0.3]).double()
    )
    problem = vary(build, problem, (*LCS, "Q", "R", "S", "q", "r", "u_min"))
    return vary(build, with_rows(build, problem, [0.5, 0.5]), ("G_x", "G_u", "g"))


# Of the public system, cost and bounds alone; the others are for exact backends.
PLAIN = {
    "contact": contact,
    "hard_contact": lambda build: make(build, seed=2, batch=8, relaxation=1e-6),
    "without_contact": without_contact,
    "saturated": lambda build: make(build, seed=1, batch=8, bound=0.01),
    "paper_sized": paper_sized,
    "far_start": lambda build: make(build, seed=5, size=20.0),
    "badly_scaled": badly_scaled,
    "horizon_one": lambda build: make(build, seed=6, horizon=1),
    "other_sizes": lambda build: make(build, seed=8, n_x=6, n_u=3, n_lam=4, horizon=4),
    "smallest": lambda build: make(build, seed=9, n_x=1, n_u=1, n_lam=1, horizon=2),
    "lcs_per_element": lambda build: make(build, seed=10, each=("lcs",)),
    "cost_and_bounds_per_element": lambda build: make(build, seed=11, each=("cost", "bounds")),
    # Zero is not within its bounds.
    "one_sided_bounds": lambda build: make(build, seed=13).changed(u_min=torch.tensor([0.05, -0.3]).double()),
}
CONSTRAINED = {
    "hard": hard,
    "soft": lambda build: with_rows(build, make(build, seed=10, bound=0.4), [0.02, 0.01], margin=0.05),
    "soft_and_hard": lambda build: with_rows(build, make(build, seed=10, bound=0.4), [0.05, INF]),
    "rows_by_stage": lambda build: vary(build, with_rows(build, make(build, seed=12, bound=0.4), [0.3, 0.3]), ROWS),
    "terminal": terminal,
    "everything": everything,
}
FORMS = {
    # The best actions without the barrier are at their bounds.
    "barrier": lambda build: make(build, seed=1, bound=0.05, barrier=1e-3),
    "cross": cross,
    "stages": stages,
    "stages_per_element": stages_per_element,
    "preview": lambda build: make(build, seed=4, staged=("q",)),
    "half_open": lambda build: make(build, seed=5, bound=0.05).changed(u_max=torch.tensor([INF, 0.05]).double()),
    "unbounded": unbounded,
    "no_contact": lambda build: make(build, seed=7, n_lam=0, bound=0.1),
    "no_contact_stages": lambda build: make(
        build, seed=8, n_lam=0, bound=0.1, staged=(*LCS, "Q", "R", "q", "r")
    ).changed(S=0.1 * build.normal(3)(4, 2)),
}
PROBLEMS = PLAIN | FORMS | CONSTRAINED
