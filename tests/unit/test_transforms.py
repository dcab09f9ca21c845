"""solve_lcp, the losses, the layer and the records under torch.func, vectorised jacobians and torch.compile."""

import pytest
import torch
from torch.autograd.functional import jacobian
from torch.func import functional_call, grad, jacrev, vjp, vmap

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
from difflcs.errors import DoubleBackwardError, GammaError, NonFiniteError, NotPositiveDefiniteError, SolveWarning
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
    assert scale.grad is not None
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
def function(build, lcps, data, what):
    """A function of one tensor, and where to evaluate it."""
    (F, q), (x, u, x_next), model = lcps, data, build.model(seed=3)
    if "LCP" in what:
        relaxation = 1e-3 if "relaxed" in what else 0.0
        F = F[0] if "shared" in what else F
        return (lambda F: solve_lcp(F, q).lam, F[0]) if "F" in what else (lambda q: solve_lcp(F, q, relaxation).lam, q)
    if what == "layer":
        layer = LCSMPCLayer(build.model(seed=3, scale=0.4), build.cost(0), 3, -0.15, 0.15, relaxation=1e-4)
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
        torch.testing.assert_close(found.detach(), expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("what", ["shared LCP", "shared relaxed LCP", "layer"])
def test_vmap_is_a_batch_and_grad_is_backward(function):
    (of, at), leaf = function, function[1].clone().requires_grad_()

    def total(z):
        return (of(z).square() + 3 * of(z).sin()).sum()

    plain, (slope,) = of(at).detach(), torch.autograd.grad(total(leaf), leaf)
    fold, grid = (lambda v: v.flatten(0, 1)), at.reshape(2, 3, 4)
    values = [vmap(of)(at), vmap(of, 1)(at.T), vmap(of, out_dims=1)(at).mT, vmap(of, chunk_size=4)(at)]
    for found in (*values, fold(vmap(of)(grid)), fold(vmap(vmap(of))(grid))):
        torch.testing.assert_close(found.detach(), plain, rtol=1e-9, atol=1e-11, check_stride=False)
    mapped = torch.autograd.grad(vmap(total)(leaf).sum(), leaf)[0]
    slopes = [grad(total)(at), vmap(grad(total))(at), grad(lambda z: vmap(total)(z).sum())(at), mapped]
    for found in (*slopes, fold(vmap(vmap(grad(total)))(grid)), vmap(grad(total), 1, 1)(at.T).T):
        torch.testing.assert_close(found, slope, rtol=1e-9, atol=1e-11, check_stride=False)


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
        torch.testing.assert_close(many[k], one, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("how", REFUSED)
@pytest.mark.parametrize("what", ["LCP by q", "model", "each", "layer"])
def test_second_derivatives_are_refused_everywhere(function, what, how):
    of, at = function
    name = {"LCP by q": "solve_lcp", "layer": "LCSMPCLayer"}.get(what, "violation_loss")
    with pytest.raises(DoubleBackwardError, match=rf"{name} has first derivatives only; expected create_graph=False"):
        REFUSED[how](of, at.clone())


def test_numbers_that_are_hidden_from_the_checks_are_checked_by_the_solver(lcps):
    F, q = lcps
    q = q.clone()
    q[3, 1] = torch.nan
    with pytest.raises(NonFiniteError, match=r"q: expected finite numbers, got 1 .* at index \(3, 1\)"):
        vmap(lambda q: solve_lcp(F[0], q).lam)(q)
    F = F.clone()
    F[1, 0, 0] = torch.inf
    refuse(NonFiniteError, "F: expected finite numbers, got 1", grad(lambda F: solve_lcp(F, lcps[1]).lam.sum()), F)


def test_a_failure_under_vmap_warns_and_has_no_gradient(lcps):
    F, q = lcps[0].clone(), lcps[1].clone()
    F[2], q[2] = -torch.eye(4), -1.0
    with pytest.warns(SolveWarning, match="1 of 6 LCPs were not solved"):
        status = vmap(lambda F, q: solve_lcp(F, q).status)(F, q)
    assert (status != Status.CONVERGED).tolist() == [i == 2 for i in range(COUNT)]
    with pytest.warns(SolveWarning):
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


def test_what_vmap_hides_from_the_records_is_checked_by_the_loss(build, data):
    params = build.params(seed=3)
    F = torch.stack([params.F, -params.F, params.F])

    def of(F):
        return violation_loss(LCSParams(**{**params.tensors(), "F": F}), *data, 0.05)

    refuse(NotPositiveDefiniteError, "expected F \\+ Fᵀ positive definite", vmap(of), F)
    with pytest.raises(GammaError, match="0 < gamma <= sigma_min"):
        vmap(lambda F: violation_loss(LCSParams(**{**params.tensors(), "F": F}), *data, 1e3))(F[[0, 2]])
    x = data[0].clone()
    x[2, 3] = torch.nan
    with pytest.raises(NonFiniteError, match="x: expected finite numbers, got 1"):
        vmap(lambda x, u, y: violation_loss(params, x, u, y))(x, *data[1:])


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
def test_compiled_code_gives_the_result_and_gradient_of_eager_code(build, lcps, data):
    model, params = build.model(seed=3), build.params(seed=3, batch=(COUNT,))
    layer = LCSMPCLayer(build.model(seed=3, scale=0.4), build.cost(0), 3, -0.15, 0.15, relaxation=1e-4)
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
