"""solve_lcp, the losses, the layer and the records under torch.func, vectorised jacobians and torch.compile."""

import warnings
from functools import partial

import pytest
import torch
from torch.autograd.functional import jacobian
from torch.func import functional_call, grad, jacrev, jvp, vjp, vmap

from difflcs import (
    LCSMPCLayer,
    LCSParams,
    LCSSequence,
    MPCSolution,
    QuadraticCost,
    Status,
    prediction_loss,
    solve_lcp,
    violation_loss,
)
from difflcs import errors as e
from difflcs.cli.bench import pushing_model
from difflcs.mpc import Primal
from difflcs.systems import pushing_cost
from tests.conftest import refuse

COUNT = 6
exact_and_relaxed = pytest.mark.parametrize("relaxation", [0.0, 1e-3])


@pytest.fixture
def lcps(build):
    """F (6, 4, 4) and q (6, 4); contacts open and closed, none at a kink."""
    F, q = build.params(seed=1, n_lam=4, batch=(COUNT,)).F, build.normal(2)(COUNT, 4)
    lam, w, _ = solve_lcp(F, q)
    assert float(torch.maximum(lam, w).min()) > 1e-4
    assert 5 < int((lam > 0).sum()) < 20
    return F, q


@pytest.fixture
def data(build):
    n = build.normal(5)
    return n(COUNT, 4), n(COUNT, 2), n(COUNT, 4)


@pytest.fixture
def layer(build):
    return LCSMPCLayer(build.model(seed=3, scale=0.4), build.cost(0), 3, -0.15, 0.15, relaxation=1e-4)


@pytest.fixture
def x0(data):
    return 0.2 * data[0]


@pytest.fixture
def systems(build):
    """One system per element."""
    n = build.normal(1)
    return {k: v + 1e-2 * n(6, *v.shape) * (k != "F") for k, v in build.lcs_tensors(3).items()}


def close(found, expected):
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-11, check_stride=False)


# --- solve_lcp ------------------------------------------------------------------------------------------------------


@exact_and_relaxed
@pytest.mark.parametrize("in_dims", [(0, 0), (None, 0), (0, None), (2, 1)])
def test_vmap_solves_what_a_loop_solves(lcps, relaxation, in_dims):
    F, q = lcps
    at = [F if in_dims[0] is not None else F[0], q if in_dims[1] is not None else q[0]]
    moved = [v if dim is None else v.movedim(0, dim) for v, dim in zip(at, in_dims, strict=True)]
    found = vmap(lambda F, q: tuple(solve_lcp(F, q, relaxation)), in_dims)(*moved)
    for i in range(COUNT):
        one = solve_lcp(*(v if dim is None else v[i] for v, dim in zip(at, in_dims, strict=True)), relaxation)
        for value, expected in zip(found, one, strict=True):
            assert torch.equal(value[i], expected)


def test_a_gradient_inside_an_outer_graph_is_a_gradient_of_it(lcps):
    """torch.func.grad inside code that is differentiated for something else, on which the inner gradient is linear."""
    F, q = lcps
    scale = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    inner = grad(lambda q: solve_lcp(F, q).lam.sum())(q)
    (scale * inner.sum()).backward()
    assert float(scale.grad) == pytest.approx(float(inner.sum()))


REFUSED = {
    "grad of grad": lambda f, z: grad(lambda z: grad(lambda z: f(z).square().sum())(z).sum())(z),
    "jacobian of jacobian": lambda f, z: jacrev(jacrev(f))(z),
    "mapped": lambda f, z: vmap(grad(lambda z: grad(lambda z: f(z).square().sum())(z).sum()))(z.expand(2, *z.shape)),
    "Hessian": lambda f, z: torch.autograd.functional.hessian(lambda z: f(z).square().sum(), z),
    "vectorised, recorded": lambda f, z: jacobian(f, z.requires_grad_(), vectorize=True, create_graph=True),
    "backward through grad": lambda f, z: grad(lambda z: f(z).square().sum())(z.requires_grad_()).sum().backward(),
    "backward through vjp": lambda f, z: vjp(f, z.requires_grad_())[1](f(z).detach())[0].sum().backward(),
    "create_graph": lambda f, z: torch.autograd.grad(f(z.requires_grad_()).sum(), z, create_graph=True),
}


FUNCTIONS = ["LCP by q", "LCP by F", "relaxed LCP", "model", "shared", "each", "layer"]
every_function = pytest.mark.parametrize("what", FUNCTIONS)


@pytest.fixture
def function(build, lcps, data, layer, what):
    """A function of one tensor, and where to evaluate it."""
    (F, q), (x, u, x_next), model = lcps, data, build.model(seed=3)
    if "LCP" in what:
        relaxation = 1e-3 if "relaxed" in what else 0.0
        F = F[0] if "shared" in what else F
        return (lambda F: solve_lcp(F, q).lam, F[0]) if "F" in what else (lambda q: solve_lcp(F, q, relaxation).lam, q)
    if what == "layer":
        return lambda x: layer(x).action, 0.2 * x
    lcs = {"model": model, "shared": model.params().detach(), "each": build.params(seed=3, batch=(COUNT,))}[what]
    return lambda x: violation_loss(lcs, x, u, x_next, 0.02, 0.3, reduction="none"), x


@every_function
def test_every_way_to_a_jacobian_gives_the_same(function):
    of, at = function
    expected = jacobian(of, at)
    assert float(expected.abs().max()) > 0.1
    value, pull = vjp(of, at)
    basis = torch.eye(value.numel(), dtype=value.dtype).reshape(-1, *value.shape)
    rows = torch.stack([pull(row)[0] for row in basis]).reshape(expected.shape)
    for found in (jacobian(of, at, vectorize=True), jacrev(of)(at), jacrev(of, chunk_size=1)(at), rows):
        close(found.detach(), expected)


@pytest.mark.parametrize("what", ["shared LCP", "shared relaxed LCP", "layer"])
def test_vmap_is_a_batch_and_grad_is_backward(function):
    (of, at), leaf = function, function[1].clone().requires_grad_()

    def total(z):
        return (of(z).square() + 3 * of(z).sin()).sum()

    plain, (slope,) = of(at).detach(), torch.autograd.grad(total(leaf), leaf)
    fold, grid = (lambda v: v.flatten(0, 1)), at.reshape(2, 3, 4)
    values = [vmap(of)(at), vmap(of, 1)(at.T), vmap(of, out_dims=1)(at).mT, vmap(of, chunk_size=4)(at)]
    for found in (*values, fold(vmap(of)(grid)), fold(vmap(vmap(of))(grid))):
        close(found.detach(), plain)
    mapped = torch.autograd.grad(vmap(total)(leaf).sum(), leaf)[0]
    slopes = [grad(total)(at), vmap(grad(total))(at), grad(lambda z: vmap(total)(z).sum())(at), mapped]
    for found in (*slopes, fold(vmap(vmap(grad(total)))(grid)), vmap(grad(total), 1, 1)(at.T).T):
        close(found, slope)


def test_gradients_of_problems_sum_to_that_of_the_matrix_that_they_share(lcps):
    F, q = lcps

    def total(F, q):
        return solve_lcp(F, q).lam.square().sum()

    each = vmap(grad(total), (None, 0))(F[0], q)
    torch.testing.assert_close(each.sum(0), grad(total)(F[0], q), rtol=1e-12, atol=1e-14)


@every_function
def test_batched_gradients_of_a_graph_that_was_made_before(build, function):
    of, at = function
    at = at.clone().requires_grad_()
    value = of(at)
    upstream = build.normal(1)(5, *value.shape)
    (many,) = torch.autograd.grad(value, at, upstream, is_grads_batched=True, retain_graph=True)
    for k in range(5):
        (one,) = torch.autograd.grad(value, at, upstream[k], retain_graph=True)
        close(many[k], one)


@pytest.mark.parametrize("how", REFUSED)
@pytest.mark.parametrize("what", ["LCP by q", "model", "each", "layer"])
def test_second_derivatives_are_refused_everywhere(function, what, how):
    of, at = function
    name = {"LCP by q": "solve_lcp", "layer": "LCSMPCLayer"}.get(what, "violation_loss")
    with pytest.raises(e.DoubleBackwardError, match=rf"{name} has first derivatives only; expected create_graph=False"):
        REFUSED[how](of, at.clone())


def test_a_failure_under_vmap_warns_and_has_no_gradient(lcps):
    F, q = lcps[0].clone(), lcps[1].clone()
    F[2], q[2] = -torch.eye(4), -1.0
    with pytest.warns(e.SolveWarning, match="1 of 6 LCPs were not solved"):
        status = vmap(lambda F, q: solve_lcp(F, q).status)(F, q)
    assert (status != Status.CONVERGED).tolist() == [i == 2 for i in range(COUNT)]
    with pytest.warns(e.SolveWarning):
        found = vmap(grad(lambda q, F: solve_lcp(F, q).lam.sum()))(q, F)
    assert float(found[2].abs().max()) == 0
    assert torch.equal(found[1], grad(lambda q: solve_lcp(F[1], q).lam.sum())(q[1]))


# --- losses ---------------------------------------------------------------------------------------------------------


class Loss(torch.nn.Module):
    """A loss of a model, for functional_call."""

    def __init__(self, lcs, function, **options):
        super().__init__()
        self.lcs, self.function, self.options = lcs, function, options

    def forward(self, *data):
        return self.function(self.lcs, *data, **self.options)


LOSSES = {
    "violation": (violation_loss, {"gamma": 0.1, "xi": 0.3}),
    "auto": (violation_loss, {"gamma": "auto", "xi": 0.3}),
    "prediction": (prediction_loss, {}),
}


@pytest.mark.parametrize("which", LOSSES)
def test_gradients_of_a_model_by_functional_call(build, data, which):
    function, options = LOSSES[which]
    model = build.model(seed=3)
    loss = Loss(model, function, **options)
    values = {k: p.detach().clone() for k, p in loss.named_parameters()}

    def of(values, *data):
        return functional_call(loss, values, data)

    eager = loss(*data)
    eager.backward()
    expected = {f"lcs.{k}": p.grad for k, p in model.named_parameters()}
    torch.testing.assert_close(grad(of)(values, *data), expected, rtol=1e-9, atol=1e-12)
    each = vmap(of, (None, 0, 0, 0))(values, *data)
    torch.testing.assert_close(each.mean(), eager.detach(), rtol=1e-12, atol=1e-14)
    per_sample = vmap(grad(of), (None, 0, 0, 0))(values, *data)
    torch.testing.assert_close({k: v.mean(0) for k, v in per_sample.items()}, expected, rtol=1e-9, atol=1e-12)
    for i in (0, 4):
        alone = grad(of)(values, *(v[i : i + 1] for v in data))
        torch.testing.assert_close({k: v[i] for k, v in per_sample.items()}, alone, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("gamma", [0.05, "auto"])
def test_an_ensemble_of_models_is_mapped(build, data, gamma):
    """Each member its own γ, as in a loop, where "auto" is asked."""
    models = [build.model(seed=s) for s in range(3)]
    stacked = {f"lcs.{k}": torch.stack([m.state_dict()[k] for m in models]) for k in models[0].state_dict()}
    loss = Loss(models[0], violation_loss, gamma=gamma)
    found = vmap(lambda values: functional_call(loss, values, data))(stacked)
    expected = torch.stack([violation_loss(m, *data, gamma).detach() for m in models])
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-14)


# --- the layer ------------------------------------------------------------------------------------------------------


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


def test_numbers_that_a_transform_hides_from_the_checks_are_checked_inside(build, lcps, data, layer, x0, systems):
    (F, q), shared, limit = lcps, build.params(seed=3), torch.full((3, 2), 0.1).double()
    signs = torch.tensor([1.0, -1.0, 1.0]).double()[:, None, None]

    def spoilt(value, *index, number=torch.nan):
        return value.index_put(tuple(map(torch.tensor, index)), torch.tensor(number, dtype=value.dtype))

    def loss(F, x=data[0], gamma=0.05):
        return violation_loss(LCSParams(**{**shared.tensors(), "F": F}), x, *data[1:], gamma)

    def plan(system, x):
        return layer(x, lcs=LCSParams(**system)).u

    lcp, of_F = vmap(lambda q: solve_lcp(F[0], q).lam), grad(lambda F: solve_lcp(F, q).lam.sum())
    refuse(e.NonFiniteError, r"q: expected finite numbers, got 1 .* at index \(3, 1\)", lcp, spoilt(q, 3, 1))
    refuse(e.NonFiniteError, "F: expected finite numbers, got 1", of_F, spoilt(F, 1, 0, 0, number=torch.inf))
    refuse(e.NotPositiveDefiniteError, r"expected F \+ Fᵀ positive definite", vmap(loss), signs * shared.F)
    refuse(e.GammaError, "0 < gamma <= sigma_min", vmap(partial(loss, gamma=1e3)), shared.F.expand(2, 3, 3))
    refuse(
        e.NonFiniteError,
        "x: expected finite numbers, got 1",
        vmap(partial(loss, shared.F)),
        spoilt(data[0], 2, 3)[None],
    )
    nan, negative = systems | {"A": torch.nan * systems["A"]}, systems | {"F": -systems["F"]}
    refuse(e.NonFiniteError, "A: expected finite numbers, got 96 NaN", vmap(plan), nan, x0)
    refuse(e.NotPositiveDefiniteError, r"F \+ Fᵀ positive definite", vmap(plan), negative, x0)
    refuse(e.NonFiniteError, "x0: expected finite numbers", vmap(lambda x: layer(x).u), x0 * torch.inf)
    refuse(e.BoundsError, "u_min <= u_max", vmap(lambda b: layer(x0, u_min=b, u_max=-b).u), limit)
    refuse(e.NonFiniteError, "u_max: expected numbers or inf", vmap(lambda b: layer(x0, u_max=b).u), torch.nan * limit)


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


# --- records --------------------------------------------------------------------------------------------------------


def test_steps_and_rollouts_of_records_are_mapped(build):
    n = build.normal(1)
    params = build.params(batch=(COUNT,))
    x, u = n(COUNT, 4), n(COUNT, 5, 2)

    def of(fields, x, u):
        system = LCSParams(**fields)
        sequence = LCSSequence.stack([system] * 5)
        return system.rollout(x, u), sequence.rollout(x, u), system.step(x, u[0]).lam

    rolled, staged, lam = vmap(of)(params.tensors(), x, u)
    assert torch.equal(rolled, params.rollout(x, u))
    assert torch.equal(staged, rolled)
    assert torch.equal(lam, params.step(x, u[:, 0]).lam)
    x0 = x[0].clone().requires_grad_()
    params[0].rollout(x0, u[0]).square().sum().backward()
    found = grad(lambda x: of(params[0].tensors(), x, u[0])[0].square().sum())(x[0])
    torch.testing.assert_close(found, x0.grad, rtol=1e-9, atol=1e-12)


# --- torch.compile --------------------------------------------------------------------------------------------------


@pytest.mark.slow
# Where warnings are errors, the compiler trips over one of its own, which it otherwise hides.
@pytest.mark.filterwarnings("ignore:The .grad attribute", "ignore::DeprecationWarning")
def test_compiled_code_gives_the_result_and_gradient_of_eager_code(build, lcps, data, layer):
    model, params = build.model(seed=3), build.params(seed=3, batch=(COUNT,))
    fields, (F, q), (x, u, x_next) = params.tensors(), lcps, data

    def function(q, x):
        return (
            (2 * solve_lcp(F, 1.5 * q).lam).sin(),
            model(2 * x, u).x_next.sin(),
            model.rollout(2 * x, u[:, None]).sin() + model.params().A.sum(),
            LCSParams(**fields)[1:3].to(torch.float64).step(2 * x[1:3], u[1:3]).x_next.sin(),
            2 * violation_loss(model, 2 * x, u, x_next),
            2 * violation_loss(params, 2 * x, u, x_next, "auto"),
            2 * prediction_loss(model, 2 * x, u, x_next),
            (2 * layer(torch.sin(0.2 * x)).action).square(),
            layer(0.2 * x, cost=QuadraticCost(**build.cost_tensors(0))).action.square(),
        )

    torch.compiler.reset()
    results = []
    for way in (torch.compile(function, backend="aot_eager"), function):
        leaves = [v.clone().requires_grad_() for v in (q, x)]
        values = way(*leaves)
        total = sum((k + 1) * v.sum() for k, v in enumerate(values))
        results.append([v.detach() for v in (*values, *torch.autograd.grad(total, [*leaves, *layer.parameters()]))])
    torch.testing.assert_close(*results, rtol=1e-12, atol=1e-14)
    plan = torch.compile(layer, backend="eager")(0.2 * x, u_max=0.05)
    assert isinstance(plan, MPCSolution)
    assert torch.equal(plan.u, layer(0.2 * x, u_max=0.05).u)
    torch.compiler.reset()
