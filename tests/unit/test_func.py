"""The layer under torch.func: the numbers of plain calls, or an error. What all solvers share: test_transforms."""

import warnings
from functools import partial

import pytest
import torch
from torch.autograd.functional import jacobian
from torch.func import grad, jvp, vmap

from difflcs import LCSMPCLayer, LCSParams, Status
from difflcs import errors as e
from difflcs.cli.bench import pushing_model
from difflcs.mpc import Primal
from difflcs.systems import pushing_cost
from tests.conftest import refuse


@pytest.fixture
def layer(build):
    return LCSMPCLayer(build.model(seed=3, scale=0.4), build.cost(0), 3, -0.15, 0.15, relaxation=1e-4)


@pytest.fixture
def x0(build):
    return 0.2 * build.normal(5)(6, 4)


@pytest.fixture
def systems(build):
    """One system per element."""
    n = build.normal(1)
    return {k: v.expand(6, *v.shape) + 1e-2 * n(6, *v.shape) for k, v in build.lcs_tensors(3).items() if k != "F"} | {
        "F": build.lcs_tensors(3)["F"].expand(6, 3, 3).clone()
    }


def close(found, expected):
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-11, check_stride=False)


def test_vmap_over_systems_states_and_both(build, layer, x0, systems):
    own = LCSMPCLayer(build.params(3), build.cost(3), 3, -0.15, 0.15, relaxation=1e-4)

    def plan(system, x):
        return own(x, lcs=LCSParams(**system)).u

    close(vmap(plan)(systems, x0), own(x0, lcs=LCSParams(**systems)).u)
    one = {k: v[2] for k, v in systems.items()}
    close(vmap(plan, in_dims=(None, 0))(one, x0), own(x0, lcs=LCSParams(**one)).u)
    close(vmap(plan, in_dims=(0, None))(systems, x0[1]), own(x0[1], lcs=LCSParams(**systems)).u)
    # Every system with every state: a mapped dimension beside one of the batch.
    grid = vmap(plan, in_dims=(0, None))(systems, x0)
    for i in (0, 4):
        close(grid[i], own(x0, lcs=LCSParams(**{k: v[i] for k, v in systems.items()})).u)


def test_vmap_over_guesses_bounds_and_goals(build, layer, x0):
    limit = torch.linspace(0.01, 0.1, 6, dtype=torch.float64)[:, None].expand(6, 2)
    close(vmap(lambda x, b: layer(x, u_min=-b, u_max=b).u)(x0, limit), layer(x0, u_min=-limit, u_max=limit).u)
    sol = layer(x0)
    warm = vmap(lambda x, *g: layer(x, guess=Primal(*g)).iterations)(x0, sol.x, sol.u, sol.lam)
    assert torch.equal(warm, layer(x0, guess=sol).iterations)
    assert int(warm.sum()) < int(sol.iterations.sum())
    pusher = LCSMPCLayer(pushing_model(5, 0), pushing_cost(), 2, -0.015, 0.015, relaxation=1e-4)
    n = build.normal(2)
    x, goal, reference = 0.05 * n(3, 9), 0.05 * n(4, 3), 0.05 * n(4, 3, 3)
    close(vmap(lambda g: pusher(x, g).u)(goal), pusher(x, goal[:, None]).u)
    close(vmap(lambda r: pusher(x, reference=r).u)(reference), pusher(x, reference=reference[:, None]).u)


def test_numbers_that_no_check_could_read_before_are_refused_inside(build, layer, x0, systems):
    def plan(system, x):
        return layer(x, lcs=LCSParams(**system)).u

    for change, error, match in (
        ({"A": systems["A"] * torch.nan}, e.NonFiniteError, "A: expected finite numbers, got 96 NaN"),
        ({"F": -systems["F"]}, e.NotPositiveDefiniteError, r"F \+ Fᵀ positive definite"),
    ):
        refuse(error, match, vmap(plan), {**systems, **change}, x0)
    refuse(e.NonFiniteError, "x0: expected finite numbers", vmap(lambda x: layer(x).u), x0 * torch.inf)
    with pytest.raises(e.BoundsError, match="u_min <= u_max"):
        vmap(lambda b: layer(x0, u_min=b, u_max=-b).u)(torch.full((3, 2), 0.1).double())
    with pytest.raises(e.NonFiniteError, match="u_max: expected numbers or infinity"):
        vmap(lambda b: layer(x0, u_max=b).u)(torch.full((3, 2), torch.nan).double())


def test_failures_are_reported_inside(layer, x0):
    far = torch.full((4,), 1e200, dtype=torch.float64)
    bad = torch.stack([x0[0], far, x0[2]])
    with pytest.raises(e.SolveError, match=r"1 of 3 MPC problems were not solved.*elements 1") as error:
        vmap(lambda x: layer(x).u)(bad)
    assert error.value.elements == (1,)
    layer.on_failure = "mask"
    with pytest.warns(e.SolveWarning, match="1 of 3"):
        status = vmap(lambda x: layer(x).status)(bad)
    assert status[0] == status[2] == Status.CONVERGED != status[1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", e.SolveWarning)
        found = vmap(grad(lambda x: layer(x).u.sum()))(bad)
    assert torch.equal(found[1], torch.zeros(4, dtype=torch.float64))
    assert float(found[[0, 2]].detach().abs().amax(1).min()) > 0


def test_a_gradient_inside_a_loss_is_refused_even_where_the_loss_is_linear(layer, x0):
    """The gradient of the objective does not move linearly with x0; a constant would be wrong in silence."""
    refuse(e.DoubleBackwardError, ".", grad(lambda x: grad(lambda y: layer(y).objective)(x).sum()), x0[0])


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, in forward mode
@pytest.mark.parametrize("learnable", [True, False])
def test_forward_mode_is_refused_whatever_requires_a_gradient(layer, x0, learnable):
    """A tangent that is dropped would be a derivative without the part of the plan."""
    system = layer.lcs if learnable else layer.lcs.params().detach()
    mpc = LCSMPCLayer(system, layer.cost, layer.horizon, u_min=-1.0, u_max=1.0)
    with torch.no_grad():
        mpc(x0)  # what it remembers is not used either
    with torch.no_grad(), torch.autograd.forward_ad.dual_level():
        with pytest.raises(NotImplementedError, match="forward-mode"):
            mpc(torch.autograd.forward_ad.make_dual(x0, torch.ones_like(x0)))
        assert mpc(x0).converged.all()  # without a tangent there is nothing to lose
    with pytest.raises(NotImplementedError, match="forward"):
        jacobian(lambda x: mpc(x).u, x0, strategy="forward-mode", vectorize=True)
    with pytest.raises(NotImplementedError, match="no forward-mode derivatives"):
        jvp(lambda x: mpc(x).u, (x0,), (x0,))


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_a_graph_that_cannot_hold_a_solver_is_refused(layer, x0):
    for trace in (partial(torch.export.export, strict=False), torch.jit.trace):
        with pytest.raises(NotImplementedError, match=r"got torch\.export, torch\.jit\.trace or the like"):
            trace(layer, (x0,))


def test_what_was_made_in_inference_mode_serves_where_gradients_are_recorded(layer, x0):
    with torch.inference_mode():
        states, guess = x0.clone(), layer(x0)
    found, expected = layer(states, guess=guess).u, layer(x0, guess=layer(x0)).u
    close(
        *(torch.autograd.grad(u.square().sum(), list(layer.parameters()), allow_unused=True) for u in (found, expected))
    )


def test_a_plan_is_measured_by_the_system_it_was_planned_with(layer, x0):
    plan = layer(x0)
    before = plan.complementarity(), plan.dynamics_residual()
    with torch.no_grad():  # a step of an optimiser
        for p in layer.parameters():
            p.mul_(1.1)
    assert torch.equal(plan.complementarity(), before[0])
    assert torch.equal(plan.dynamics_residual(), before[1])
