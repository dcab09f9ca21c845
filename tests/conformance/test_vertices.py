"""Plans at a vertex: no curvature decides them, and what is summed to their gradient cancels to rounding."""

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from difflcs import ConstraintSequence, LCSMPCLayer, LinearConstraints, QuadraticCost, Status
from difflcs.errors import SolveWarning
from difflcs.mpc import Primal, kkt
from tests.conftest import linear_system as system
from tests.conftest import tensor

INF = float("inf")
EXACT = pytest.mark.parametrize("backend", ["batched", "ipopt"])


def cost(n, m, Q=None, R=None, **linear) -> QuadraticCost:
    Q, R = tensor(np.zeros((n, n)) if Q is None else Q), tensor(np.zeros((m, m)) if R is None else R)
    return QuadraticCost(Q=Q, R=R, Q_final=Q, **{k: tensor(v) for k, v in linear.items()})


CAR = ([[1, 0.1], [0, 1]], [[0], [0.1]])
TRIPLE = ([[1, 0.1, 0], [0, 1, 0.1], [0, 0, 1]], [[0], [0], [0.1]])
SCHOLTES = {"C": [[1], [1], [0]], "D": np.zeros((1, 3)), "E": [[1, 0]], "F": [[1]], "c": [0]}
ROW = LinearConstraints
# System, cost, horizon, rows, x0, and the objective that is known.
PROBLEMS = {
    "linear": (system([[0]], [[1]]), cost(1, 1, q_final=[-1]), 1, ROW(G=tensor([[1]]), g=tensor([1])), [0], -1),
    "row at zero": (system([[1]], [[1]]), cost(1, 1, q_final=[-3]), 2, ROW(G=tensor([[1]]), g=tensor([0])), [-1], 0),
    "limited speed": (
        system(*CAR), cost(2, 1, q_final=[-1, 0]), 10, ROW(G=tensor([[0, 1]]), g=tensor([1])), [0, 0], -0.9
    ),
    "limited position": (
        system(*TRIPLE), cost(3, 1, q_final=[-1, 0, 0]), 8, ROW(G=tensor([[1, 0, 0]]), g=tensor([0.1])), [0, 0, 0], -0.1
    ),
    "dead beat": (system(*CAR), cost(2, 1, Q=np.diag([1, 0])), 5, None, [0.01, 0], 1e-4),
    "soft absolute value": (
        system([[1]], [[1]]), cost(1, 1, q_final=[0.1]), 3,
        ROW(G=tensor([[1], [-1]]), g=tensor([0, 0]), weight=tensor([1, 1])), [0.3], 0.3,
    ),
    "scholtes4": (
        system(np.zeros((3, 3)), [[0, 0], [1, 0], [0, 1]], **SCHOLTES), cost(3, 2, q_final=[1, 1, -1]), 1,
        ROW(G=tensor([[-4, 0, 1], [0, -4, 1]]), g=tensor([0, 0])), [0, 0, 0], -2e-5**0.5 * 2**0.5,
    ),
}  # fmt: skip


@EXACT
@pytest.mark.parametrize("name", PROBLEMS)
def test_an_exact_plan_at_a_vertex_is_solved(name, backend):
    lcs, weights, horizon, rows, x0, best = PROBLEMS[name]
    layer = LCSMPCLayer(lcs, weights, horizon, -50.0, 50.0, backend=backend, on_failure="mask", constraints=rows)
    plan = layer(tensor(x0))
    assert Status(int(plan.status)) in (Status.CONVERGED, Status.DEGENERATE)
    assert float(plan.kkt_residual) < 1e-8
    assert float(plan.objective) == pytest.approx(best, abs=1e-8)


def programs(n: int, count: int):
    """min cᵀx with x = u, Gx ≤ g and |u| ≤ 10, feasible, some limits tight; and what HiGHS finds."""
    rng = np.random.default_rng(n)
    m = 2 * n + 1
    G, u, c = rng.standard_normal((count, m, n)), rng.uniform(-5, 5, (count, n)), rng.standard_normal((count, n))
    g = np.einsum("bij,bj->bi", G, u) + rng.uniform(0, 2, (count, m)) * (rng.random((count, m)) < 0.8)
    found = [linprog(a, b, h, bounds=[(-10, 10)] * n, method="highs") for a, b, h in zip(c, G, g, strict=True)]
    return c, G, g, np.array([f.fun for f in found])


@pytest.mark.parametrize(("n", "backend"), [*((n, "batched") for n in (1, 2, 3, 4)), (3, "ipopt")])
def test_random_linear_programs_are_solved(n, backend):
    count = 128 if backend == "batched" else 8
    c, G, g, best = programs(n, count)
    rows = ConstraintSequence(
        G=torch.stack([torch.zeros(G.shape).double(), tensor(G)], 1), E=torch.zeros(count, 1, *G.shape[1:]).double(),
        g=torch.stack([torch.full(g.shape, INF).double(), tensor(g)], 1), weight=torch.full(g.shape[1:], INF).double(),
        by_stage=("G", "E", "g"),
    )  # fmt: skip
    weights = cost(n, n)
    weights = QuadraticCost(Q=weights.Q, R=weights.R, Q_final=weights.Q_final, q_final=tensor(c))
    lcs = system(np.zeros((n, n)), np.eye(n))
    layer = LCSMPCLayer(lcs, weights, 1, -10.0, 10.0, backend=backend, on_failure="mask", constraints=rows)
    plan = layer(torch.zeros(count, n).double())
    assert plan.converged.double().mean() >= 0.99
    worse = (plan.objective.numpy() - best)[plan.converged.numpy()]
    assert np.abs(worse).max() < 1e-6
    assert not bool((plan.status == Status.INFEASIBLE).any())


@EXACT
def test_a_small_weight_of_the_action_makes_nothing_infeasible(backend):
    for q, R in ((1.0, 1e-8), (1.0, 1e-10), (1e4, 1e-4), (1e8, 1.0)):
        weights = cost(1, 1, R=[[R]], q_final=[-q])
        rows = LinearConstraints(G=tensor([[1]]), g=tensor([1]))
        layer = LCSMPCLayer(system([[0]], [[1]]), weights, 1, -10.0, 10.0, backend=backend, constraints=rows)
        assert float(layer(tensor([0])).u) == pytest.approx(1.0, abs=1e-9)


@EXACT
def test_the_gradient_at_a_vertex_is_that_of_the_limit_that_holds_it(backend):
    g = tensor([1.0]).requires_grad_()
    rows = LinearConstraints(G=tensor([[1]]), g=g)
    layer = LCSMPCLayer(
        system([[0]], [[1]]), cost(1, 1, q_final=[-1]), 1, -10.0, 10.0, backend=backend, constraints=rows
    )
    plan = layer(tensor([0]))
    assert float(torch.autograd.grad(plan.u.sum() + 0.5 * plan.objective, g)[0]) == pytest.approx(0.5, abs=1e-9)


@pytest.mark.filterwarnings("ignore::difflcs.errors.SolveWarning")
@pytest.mark.parametrize("growth", [0.5, 0.99, 1.5])
def test_the_least_scale_does_not_grow_with_the_horizon(growth):
    """Terms that cancel at every one of 60 stages: a gradient of a millionth of the costs is still seen."""
    rotation = growth * np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
    rows = LinearConstraints(G=tensor([[1, 0], [-1, 0]]), g=tensor([0, 0]), weight=tensor([2, 2]))
    lcs, weights = system(rotation, np.eye(2)), cost(2, 2, q_final=[1e-6, 0])
    layer = LCSMPCLayer(lcs, weights, 60, -1.0, 1.0, constraints=rows, on_failure="mask")
    problem = layer(torch.zeros(1, 2).double()).problem
    u, mu = torch.zeros(1, 60, 2).double(), torch.ones(1, 61, 2).double()
    x, lam = problem.rollout(u)
    primal = Primal(x, u, lam, mu)
    assert float(kkt.residual(problem, primal, kkt.multipliers(problem, primal))) > kkt.CERTIFIED


def test_what_cannot_be_met_in_small_units_is_a_status():
    rows = LinearConstraints(tensor([[1.0]]), tensor([-2.0]), tensor([[-3e4]]))
    lcs, final = system([[1.0]], [[-3e4]]), cost(1, 1, q_final=[1.0])
    mpc = LCSMPCLayer(lcs, final, 1, -1e-6, 1e-6, on_failure="mask", constraints=rows)
    with pytest.warns(SolveWarning, match="INFEASIBLE|NUMERICAL"):
        assert not bool(mpc(torch.zeros(1).double()).converged)
