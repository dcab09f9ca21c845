"""The losses of one LCSModel, of LCSParams, one per transition, and of modules; and gamma="auto"."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from difflcs import LCSModel, LCSParams, LCSSequence, Status, losses, prediction_loss, violation_loss
from difflcs.errors import (
    DTypeError,
    GammaError,
    InvalidInputError,
    NonFiniteError,
    NotPositiveDefiniteError,
    ShapeError,
)
from tests.conformance.hostile.checks import inner_minimum
from tests.conftest import refuse

NAMES = ("A", "B", "C", "d", "D", "E", "F", "c")
COUNT = 8


@pytest.fixture
def data(build):
    n = build.normal(5)
    return n(COUNT, 4), n(COUNT, 2), n(COUNT, 4)


@pytest.fixture
def each(build):
    """A system of its own for each transition."""
    return build.params(seed=3, batch=(COUNT,))


def sigma(F):
    return torch.linalg.eigvalsh((F + F.mT).detach())[..., 0]


def least(params, data, gamma, xi):
    """The losses of one system by the campaign's own solution of their inner problems."""
    system, (x, u, x_next) = {k: v.numpy() for k, v in params.tensors().items()}, (v.numpy() for v in data)
    problem = SimpleNamespace(system=system, F=system["F"], x=x, u=u, x_next=x_next, gamma=gamma, xi=xi)
    return torch.from_numpy(inner_minimum(problem)[0])


# --- one model --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_lam", [3, 5, 8])
def test_neighbours_and_threads_change_no_bit_of_a_loss(build, n_lam):
    model, n = build.model(seed=1, n_x=9, n_u=6, n_lam=n_lam, scale=0.3), build.normal(2)
    data = [n(300, 9), n(300, 6), n(300, 9)]
    whole = violation_loss(model, *data, reduction="none").detach()
    for part in (slice(0, 1), slice(3, 20), slice(299, 300), slice(None, None, 7)):
        assert torch.equal(violation_loss(model, *(v[part] for v in data), reduction="none").detach(), whole[part])
    gradients = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        gradients.append(torch.autograd.grad(violation_loss(model, *data), list(model.parameters())))
    assert all(torch.equal(left, right) for left, right in zip(*gradients, strict=True))


def test_reduction(build, data):
    model = build.model(seed=3)
    each = violation_loss(model, *data, reduction="none")
    assert each.shape == (8,)
    torch.testing.assert_close(violation_loss(model, *data), each.mean())
    refuse(InvalidInputError, "'mean', 'none', got 'sum'", violation_loss, model, *data, reduction="sum")


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_float32_in_is_float32_out(build, data, function):
    model = build.model(seed=3, dtype=torch.float32)
    loss = function(model, *(v.float() for v in data))
    assert loss.dtype == torch.float32
    expected = function(build.model(seed=3), *data).detach()
    torch.testing.assert_close(loss.detach().double(), expected, rtol=1e-3, atol=1e-5)
    loss.backward()
    assert all(p.grad.dtype == torch.float32 and bool(torch.isfinite(p.grad).all()) for p in model.parameters())


def test_prediction_loss_is_half_the_squared_error(build, data):
    model, (x, u, x_next) = build.model(seed=3), data
    expected = 0.5 * (model(x, u).x_next - x_next).square().sum(-1)
    torch.testing.assert_close(prediction_loss(model, *data, reduction="none"), expected)
    torch.testing.assert_close(prediction_loss(model, *data), expected.mean())


# --- one system per transition --------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", [0.05, 0.5, 0.99])
@pytest.mark.parametrize("xi", [1e-3, 0.3])
def test_each_transition_has_the_loss_of_its_own_system(each, data, part, xi):
    gamma = part * float(sigma(each.F).min())
    found = violation_loss(each, *data, gamma, xi, reduction="none")
    expected = [least(each[i], [v[[i]] for v in data], gamma, xi) for i in range(COUNT)]
    torch.testing.assert_close(found, torch.cat(expected), rtol=1e-8, atol=1e-8)
    assert float(found.min()) > 0.01


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
@pytest.mark.parametrize("own", [NAMES, ("A", "F"), ("C",), ("c", "d")], ids="-".join)
def test_the_gradient_is_that_of_finite_differences_in_every_input(build, function, own):
    tensors = build.lcs_tensors(seed=2, n_x=2, n_u=1, n_lam=2, batch=(9,))
    tensors = {k: (v if k in own else v[0]).requires_grad_() for k, v in tensors.items()}
    n = build.normal(4)
    data = [n(9, size).requires_grad_() for size in (2, 1, 2)]  # more than the lanes of a vector
    extra = {"gamma": 0.1, "xi": 0.5} if function is violation_loss else {}

    def loss(x, u, x_next, *values):
        return function(LCSParams(*values), x, u, x_next, reduction="none", **extra)

    assert gradcheck(loss, (*data, *tensors.values()), eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_batch_dimensions_of_systems_and_data_broadcast(build, function):
    params, n = build.params(batch=(3, 1)), build.normal(1)
    x, u, x_next = n(5, 4), n(2), n(3, 5, 4)
    extra = {"gamma": 0.01} if function is violation_loss else {}
    found = function(params, x, u, x_next, reduction="none", **extra)
    assert found.shape == (3, 5)
    alone = function(params[2, 0], x[4], u, x_next[2, 4], reduction="none", **extra)
    torch.testing.assert_close(found[2, 4], alone, rtol=1e-9, atol=1e-11)
    with pytest.raises(ShapeError, match=r"x_?n?e?x?t?: its batch dimensions .* do not fit the others"):
        function(params, x, u, n(2, 5, 4), **extra)


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_an_empty_batch_of_systems_has_no_loss(build, function):
    params = LCSParams(**{k: v.requires_grad_() for k, v in build.lcs_tensors(batch=(0,)).items()})
    x, u = torch.zeros(0, 4, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.float64)
    model = build.model(seed=3)
    for lcs in (params, model):
        loss = function(lcs, x, u, x)
        assert float(loss.detach()) == 0
        loss.backward()
        assert function(lcs, x, u, x, reduction="none").shape == (0,)
    assert not any(bool(p.grad.any()) for p in model.parameters() if p.grad is not None)
    if function is violation_loss:
        assert float(violation_loss(params, x, u, x, "auto").detach()) == 0


# --- without contacts -----------------------------------------------------------------------------------------------


def test_without_contacts_both_losses_are_half_the_squared_error(build, data):
    model = build.model(n_lam=0)
    x, u, x_next = data
    r = x @ model.A.T + u @ model.B.T + model.d - x_next
    for function in (violation_loss, prediction_loss):
        for lcs in (model, model.params()):
            found = function(lcs, *data, reduction="none")
            torch.testing.assert_close(found, 0.5 * r.square().sum(-1))
        model.zero_grad()
        function(model, *data).backward()
        torch.testing.assert_close(model.A.grad, (r.T @ x / COUNT).detach())
    torch.testing.assert_close(violation_loss(model, *data, "auto"), prediction_loss(model, *data))
    batch = LCSParams(**{k: v.expand(COUNT, *v.shape) for k, v in model.params().detach().tensors().items()})
    torch.testing.assert_close(violation_loss(batch, *data), prediction_loss(model, *data).detach())


# --- gamma ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_auto_gamma_is_a_thousandth_below_its_bound(build, data, scale):
    model = build.model(seed=3, scale=scale)
    gamma = 0.999 * float(sigma(model.F))
    torch.testing.assert_close(violation_loss(model, *data, "auto"), violation_loss(model, *data, gamma), rtol=1e-9,
                               atol=0)  # fmt: skip
    left, right = (torch.autograd.grad(violation_loss(model, *data, g), model.G)[0] for g in ("auto", gamma))
    torch.testing.assert_close(left, right, rtol=1e-7, atol=1e-12)


def test_auto_gamma_is_that_of_the_stiffest_transition_for_all(each, data):
    gamma = 0.999 * float(sigma(each.F).min())
    assert float(sigma(each.F).max()) > 1.1 * gamma
    found = violation_loss(each, *data, "auto", reduction="none")
    assert torch.equal(found, violation_loss(each, *data, gamma, reduction="none"))
    assert not torch.allclose(found, violation_loss(each, *data, 0.9 * gamma, reduction="none"), rtol=1e-4)


@pytest.mark.parametrize("xi", [1e-4, 0.01, 1.0])
def test_the_inner_problem_is_solved_at_auto_gamma_where_it_is_nearly_singular(build, data, xi):
    """C = 0 and F = 0.2·I: at the bound itself the inner Hessian is singular in every contact."""
    tensors = build.lcs_tensors(seed=3)
    tensors["C"], tensors["F"] = torch.zeros(4, 3).double(), 0.2 * torch.eye(3).double()
    params = LCSParams(**tensors)
    batch = LCSParams(**{**tensors, "F": tensors["F"].expand(COUNT, 3, 3)})
    for system in (params, batch):
        found = violation_loss(system, *data, "auto", xi, reduction="none")
        torch.testing.assert_close(found, least(params, data, 0.999 * 0.4, xi), rtol=1e-9, atol=1e-9)


def test_an_inner_problem_that_was_given_up_on_is_solved_by_a_proximal_step(monkeypatch):
    Q, q, solve = np.array([[1.0, 0.5], [0.5, 1.0]]), np.array([[-0.5, 3.0]]), losses.solve_lcp_arrays
    stuck = [(np.array([[0.6, 0.0]]), None, np.array([Status.MAX_ITER]))]
    monkeypatch.setattr(losses, "solve_lcp_arrays", lambda *problem: stuck.pop() if stuck else solve(*problem))
    np.testing.assert_allclose(losses.minimise_over_orthant(Q, q), [[0.5, 0.0]], atol=1e-8)


def test_a_singular_inner_problem_is_solved_to_its_conditions():
    Q, q = np.ones((2, 2)), np.array([[-1.0, -1.0], [-2.0, 1.0]])
    z = losses.minimise_over_orthant(Q, q)
    np.testing.assert_allclose(np.minimum(z, z @ Q + q), 0, atol=1e-9)


@pytest.mark.parametrize("gamma", ["Auto", "0.1", None, True, torch.tensor(0.1)])
def test_other_words_for_gamma_are_refused(build, data, gamma):
    refuse(DTypeError, "gamma: expected a number, got", violation_loss, build.model(), *data, gamma)


def test_gamma_above_the_bound_of_one_transition_names_it(each, data):
    bounds = sigma(each.F)
    worst = int(bounds.argmin())
    others = sorted(bounds.tolist())
    gamma = 0.5 * (others[0] + others[1])
    with pytest.raises(GammaError) as error:
        violation_loss(each, *data, gamma)
    for part in (f"{float(bounds[worst]):.6g}", f"{gamma:.6g} at batch index {worst}", "gamma='auto'"):
        assert part in str(error.value)
    fine = [i for i in range(COUNT) if i != worst]
    assert bool(torch.isfinite(violation_loss(each[fine], *(v[fine] for v in data), gamma)))


def test_gamma_at_the_bound_of_one_transition_and_zero(each, data):
    worst = int(sigma(each.F).argmin())
    gamma = float(sigma(each.F)[worst])
    found = violation_loss(each, *data, gamma, reduction="none")
    one = violation_loss(each[worst], *(v[worst] for v in data), gamma)  # by itself
    torch.testing.assert_close(found[worst], one, rtol=1e-5, atol=1e-8)
    refuse(GammaError, "0 < gamma", violation_loss, each, *data, 0.0)


def test_a_gamma_that_double_precision_cannot_resolve_is_refused(each, data):
    with pytest.raises(GammaError, match=r"gamma: expected at least .* in double precision.*batch index \d"):
        violation_loss(each, *data, 1e-14)
    product = "gamma, xi: expected a product that double precision resolves"
    refuse(GammaError, f"{product}.*at batch index", violation_loss, each, *data, 1e-9, 1e-9)
    refuse(GammaError, product, violation_loss, each[0], *data, 1e-9, 1e-9)


def test_an_F_that_was_spoiled_after_its_check_is_named(each, data):
    with torch.no_grad():
        each.F[5] = -torch.eye(3)
    with pytest.raises(NotPositiveDefiniteError, match=r"got smallest eigenvalue -2\.000e\+00 at batch index 5"):
        violation_loss(each, *data, 0.05)


# --- modules --------------------------------------------------------------------------------------------------------


class Moving(torch.nn.Module):
    """An LCSModule whose drift depends on the state, and on a context if there is one."""

    def __init__(self, build, per_transition=True):
        super().__init__()
        self.inner = build.model(seed=3)
        self.n_x, self.n_u, self.n_lam = 4, 2, 3
        self.mass = torch.nn.Parameter(torch.ones((), dtype=torch.float64))
        self.per_transition, self.seen = per_transition, []

    def params(self, x=None, context=None):
        self.seen.append((x, context))
        fields = self.inner.params().tensors()
        if self.per_transition:
            fields["d"] = fields["d"] + self.mass * x.square() + (0 if context is None else context)
        return LCSParams(**fields)


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_a_module_is_asked_for_the_system_of_the_states(build, data, function):
    module, context = Moving(build), build.normal(9)(COUNT, 1)
    loss = function(module, *data, context=context, reduction="none")
    assert len(module.seen) == 1
    assert module.seen[0][0] is data[0]
    assert module.seen[0][1] is context
    by_hand = function(module.params(data[0], context), *data, reduction="none")
    assert torch.equal(loss, by_hand)
    assert not torch.allclose(loss, function(module, *data, reduction="none"))
    loss.sum().backward()
    assert float(module.mass.grad.abs()) > 0
    assert all(float(p.grad.abs().max()) > 0 for p in module.inner.parameters())


def test_a_model_with_params_of_its_own_is_asked_for_them(build, data):
    class Shifted(LCSModel):
        def params(self, x=None, context=None):
            fields = super().params().tensors()
            return LCSParams(**{**fields, "d": fields["d"] + x})

    shifted = Shifted(4, 2, 3, stiffness=0.2)
    shifted.load_state_dict(build.model(seed=3).state_dict())
    for function in (violation_loss, prediction_loss):
        found = function(shifted, *data, reduction="none")
        assert torch.equal(found, function(shifted.params(data[0]), *data, reduction="none"))
    x, u, _ = data
    assert torch.equal(shifted(x, u).x_next, shifted.params(x).step(x, u).x_next)
    assert torch.equal(shifted.rollout(x, u[:, None])[:, 1], shifted(x, u).x_next)


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_what_is_no_system_is_refused(build, each, data, function):
    sequence = LCSSequence(**each.tensors())
    match = r"lcs: expected an LCSModel, another LCSModule or LCSParams, got .*; the st"
    for value in (None, "model", torch.nn.Linear(2, 2), sequence):
        refuse(DTypeError, match, function, value, *data)
    module = Moving(build)
    module.params = lambda x=None, context=None: sequence
    refuse(DTypeError, r"Moving.params: expected LCSParams, got LCSSequence.*; transitions", function, module, *data)
    with pytest.raises(InvalidInputError, match=r"context: expected None beside LCSParams.*; leave it out"):
        function(each, *data, context=data[0])
    with pytest.raises(NonFiniteError, match="context: expected finite numbers"):
        function(Moving(build), *data, context=torch.full((1,), torch.nan))
    with pytest.raises(ShapeError, match=r"x: expected shape \(\.\.\., n_x=4\), got \(8, 2\)"):
        function(Moving(build), data[1], *data[1:])
