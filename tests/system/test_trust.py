"""Never wrong in silence: what a solve returns is judged by the numbers it returns, and nothing hangs or aborts.

Each test is a failure that was once met, at its smallest; `tests/conformance/hostile` searches for more of their kind.
"""

import pytest
import torch

from difflcs import LCSMPCLayer, LCSParams, QuadraticCost, Status, solve_lcp
from difflcs.errors import DegenerateWarning, SolveWarning
from difflcs.mpc import kkt
from difflcs.mpc.backends import BatchedBackend
from difflcs.mpc.problem import INPUTS, MPCProblem
from tests.conftest import F64, python, tensor


def one_action():
    """One state, one action, one contact that is far away."""
    one, zero, flat = tensor([[1.0]]), tensor([[0.0]]), tensor([1.0])
    system = LCSParams(A=one, B=one, C=zero, d=0 * flat, D=zero, E=zero, F=one, c=flat)
    return system, QuadraticCost(one, one, one)


def test_a_residual_has_no_units(build):
    from tests.conformance.problems import badly_scaled, contact

    rough = {"max_iter": 1, "effort": "fast", "homotopy": 1.0, "shrink": 1e-3}
    found = []
    for problem in (contact(build), badly_scaled(build)):
        values = MPCProblem(**{k: v for k, v in problem.inputs.items() if k in INPUTS}, horizon=3, relaxation=1e-4)
        found.append(BatchedBackend(**rough).solve(values, None).kkt_residual)
    assert float(found[0].max()) > kkt.CERTIFIED
    torch.testing.assert_close(found[1], found[0], rtol=1e-6, atol=1e-10)


def test_a_broken_element_has_a_large_residual():
    system, cost = one_action()
    wild = LCSParams(**{**system.tensors(), "A": 1e3 * system.A})
    with pytest.warns(SolveWarning):
        plan = LCSMPCLayer(wild, cost, 60, -1.0, 1.0, on_failure="mask")(torch.tensor([1.0], dtype=F64))
    assert not bool(plan.converged)
    assert float(plan.kkt_residual) > 1
    for value in (plan.x, plan.u, plan.lam, plan.objective, plan.kkt_residual):
        assert bool(torch.isfinite(value).all())


@pytest.mark.parametrize("backend", ["batched", "ipopt"])
def test_an_action_without_cost_or_effect_is_degenerate_and_has_a_finite_gradient(backend):
    system, cost = one_action()
    B = tensor([[1.0, 0.0]]).requires_grad_()
    A = system.A.clone().requires_grad_()
    wider = LCSParams(**{**system.tensors(), "A": A, "B": B, "E": torch.zeros(1, 2, dtype=F64)})
    R = torch.diag(torch.tensor([1.0, 0.0], dtype=F64)).requires_grad_()
    mpc = LCSMPCLayer(wider, QuadraticCost(cost.Q, R, cost.Q_final), 3, -1.0, 1.0, backend=backend)
    with pytest.warns(DegenerateWarning):
        plan = mpc(torch.tensor([[0.5], [-0.3]], dtype=F64))
    assert bool((plan.status == Status.DEGENERATE).all())
    plan.u.square().sum().backward()
    for leaf in (A, B, R):
        assert bool(torch.isfinite(leaf.grad).all())
    # The other action's gradient is that of the problem without this one.
    alone = A.detach().clone().requires_grad_()
    system = LCSParams(**{**system.tensors(), "A": alone})
    single = QuadraticCost(cost.Q, tensor([[1.0]]), cost.Q_final)
    LCSMPCLayer(system, single, 3, -1.0, 1.0)(torch.tensor([[0.5], [-0.3]], dtype=F64)).u.square().sum().backward()
    torch.testing.assert_close(A.grad, alone.grad, rtol=1e-6, atol=1e-9)


def differentiable(build, backend="batched"):
    leaves = {k: v.clone().requires_grad_() for k, v in build.lcs_tensors(1).items()}
    weights = {k: v.clone().requires_grad_() for k, v in build.cost_tensors(1).items()}
    low, high = (torch.full((2,), v, dtype=F64, requires_grad=True) for v in (-0.15, 0.15))
    x0 = (0.3 * build.normal(2)(5, 4)).requires_grad_()
    cost = QuadraticCost(**weights)
    layer = LCSMPCLayer(LCSParams(**leaves), cost, 3, low, high, relaxation=1e-3, backend=backend)
    return {**leaves, "q": cost.q, "q_final": cost.q_final, "r": cost.r, "u_min": low, "u_max": high, "x0": x0}, layer


# Inputs are kept by the one bridge to autograd, whatever the backend.
@pytest.mark.parametrize(
    ("name", "backend"),
    [*((name, "batched") for name in ("A", "C", "F", "c", "q", "r", "u_min", "x0")), ("A", "ipopt"), ("A", "relaxed")],
)
def test_an_input_changed_in_place_raises_torchs_error(build, backend, name):
    inputs, layer = differentiable(build, backend)
    plan = layer(inputs["x0"])
    with torch.no_grad():
        inputs[name].mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        plan.action.sum().backward()


@pytest.mark.parametrize("backend", ["batched", "ipopt", "relaxed"])
def test_an_output_changed_in_place_does_not_change_the_gradient(build, backend):
    gradients = []
    for change in (False, True):
        inputs, layer = differentiable(build, backend)
        plan = layer(inputs["x0"])
        total = plan.action.sum() + plan.x[:, -1].sum() + plan.objective.sum()
        if change:
            with torch.no_grad():
                for value in (plan.x, plan.u, plan.lam, plan.objective):
                    value.mul_(3)
                plan.status.fill_(int(Status.NUMERICAL))
        total.backward()
        gradients.append([v.grad for v in inputs.values()])
    for plain, changed in zip(*gradients, strict=True):
        assert torch.equal(plain, changed)


@pytest.mark.parametrize("name", ["F", "lam"])
def test_lcp_tensors_changed_in_place_raise_torchs_error(build, name):
    tensors = build.lcs_tensors(0)
    F, q = tensors["F"].requires_grad_(), build.normal(1)(6, 3)
    solution = solve_lcp(F, q)
    total = solution.lam.square().sum()
    with torch.no_grad():
        (F if name == "F" else solution.lam).mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()


def test_an_upstream_gradient_that_overflows_leaves_the_others(build):
    inputs, layer = differentiable(build)
    plan = layer(inputs["x0"])
    weight = torch.ones(5, dtype=F64)
    weight[2] = 1.7e308  # finite, but not its products
    with pytest.warns(DegenerateWarning, match="1 of 5"):
        (weight[:, None] * plan.x[:, -1]).sum().backward()
    for name, value in inputs.items():
        assert bool(torch.isfinite(value.grad).all()), name
    assert torch.equal(inputs["x0"].grad[2], torch.zeros(4, dtype=F64))
    assert float(inputs["x0"].grad[0].abs().max()) > 0


def test_nan_from_the_caller_goes_back_to_the_caller(build):
    inputs, layer = differentiable(build)
    plan = layer(inputs["x0"])
    (plan.x[:, -1] * torch.tensor([1.0, 1.0, torch.nan, 1.0, 1.0]).double()[:, None]).sum().backward()
    assert bool(torch.isnan(inputs["A"].grad).any())


def test_a_thread_that_cannot_start_costs_speed_only():
    code = (
        "import resource, torch\n"
        "from difflcs import GoalCost, LCSModel, LCSMPCLayer\n"
        "from difflcs.mpc.backends import BatchedBackend\n"
        "torch.manual_seed(0)\n"
        "model = LCSModel(4, 2, 3, init_scale=0.1)\n"
        "mpc = LCSMPCLayer(model, GoalCost.reach(4, 2), 5, -1.0, 1.0, backend=BatchedBackend(threads=400))\n"
        "x = torch.randn(20_000, 4).double()\n"
        "mpc(x[:8], x[:8])\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + 300_000_000,) * 2)\n"
        "plan = mpc(x, x)\n"
        "plan.action.sum().backward()\n"
        "print(bool(plan.converged.all()), bool(torch.isfinite(model.A.grad).all()))\n"
    )
    assert python("-c", code).stdout.split() == ["True", "True"]
