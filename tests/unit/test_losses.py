"""violation_loss against an enumerated inner QP, its envelope gradient, and prediction_loss."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from difflcs import LCSModel, prediction_loss, violation_loss
from difflcs.errors import GammaError, InvalidInputError

NAMES = ("A", "B", "C", "d", "D", "E", "G", "H", "c")


@pytest.fixture
def model(build):
    return build.model(seed=3)


@pytest.fixture
def data(build):
    n = build.normal(5)
    return n(8, 4), n(8, 2), n(8, 4)


def sigma(model):
    return float(torch.linalg.eigvalsh((model.F + model.F.mT).detach())[0])


def objective(p, x, u, x_next, lam, phi, gamma, xi):
    """Eq. 2 for given λ and φ, one transition or a batch."""
    r = x @ p.A.mT + u @ p.B.mT + lam @ p.C.mT + p.d - x_next
    e = x @ p.D.mT + u @ p.E.mT + lam @ p.F.mT + p.c - phi
    return 0.5 * r.square().sum(-1) + ((lam * phi).sum(-1) + e.square().sum(-1) / (2 * gamma)) / xi


def inner_qp(p, x, u, x_next, gamma, xi):
    """Hessian and linear term of the inner problem, from derivatives of the objective itself."""
    n = len(p.c)

    def value(z):
        return objective(p, x, u, x_next, z[:n], z[n:], gamma, xi)

    zero = torch.zeros(2 * n, dtype=torch.float64)
    return torch.autograd.functional.hessian(value, zero).numpy(), torch.autograd.functional.jacobian(
        value, zero
    ).numpy()


def minimiser(model, x, u, x_next, gamma, xi):
    """λ, φ of one transition by enumeration of the active sets of the inner QP."""
    p = model.params().detach()
    Q, q = inner_qp(p, x, u, x_next, gamma, xi)
    size, best, least = len(q), np.zeros(len(q)), np.inf
    for chosen in itertools.product([False, True], repeat=size):
        free = np.flatnonzero(chosen)
        z = np.zeros(size)
        z[free] = np.linalg.lstsq(Q[np.ix_(free, free)], -q[free], rcond=None)[0]
        value = 0.5 * z @ Q @ z + q @ z
        if z.min() >= -1e-12 and value < least:
            best, least = z.clip(0), value
    z = torch.from_numpy(best)
    return z[: size // 2], z[size // 2 :]


def reference(model, data, gamma, xi):
    found = [minimiser(model, *row, gamma, xi) for row in zip(*data, strict=True)]
    lam, phi = (torch.stack(v) for v in zip(*found, strict=True))
    return lam, phi


# --- value ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", [0.05, 0.5, 0.99])
@pytest.mark.parametrize("xi", [1e-3, 0.01, 1.0])
@pytest.mark.parametrize("n_lam", [1, 3, 4])
def test_value_equals_the_enumerated_inner_qp(build, data, part, xi, n_lam):
    model = build.model(seed=n_lam, n_lam=n_lam)
    gamma = part * sigma(model)
    lam, phi = reference(model, data, gamma, xi)
    expected = objective(model.params().detach(), *data, lam, phi, gamma, xi)
    found = violation_loss(model, *data, gamma, xi, reduction="none").detach()
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)


def test_gamma_at_its_bound_is_allowed_and_exact(model, data):
    gamma = sigma(model)
    lam, phi = reference(model, data, gamma, 0.01)
    expected = objective(model.params().detach(), *data, lam, phi, gamma, 0.01)
    found = violation_loss(model, *data, gamma, 0.01, reduction="none").detach()
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)


def test_it_is_half_the_prior_works_loss_with_its_gamma_and_xi(model, data):
    """Prior work: min ‖r‖² + (λᵀφ + ‖e‖²/γ′)/ξ′, the factors ½ missing."""
    gamma, xi = 0.5 * sigma(model), 0.02
    lam, phi = reference(model, data, gamma / 2, 2 * xi)
    p = model.params().detach()
    x, u, x_next = data
    r = x @ p.A.T + u @ p.B.T + lam @ p.C.T + p.d - x_next
    e = x @ p.D.T + u @ p.E.T + lam @ p.F.T + p.c - phi
    prior = r.square().sum(-1) + ((lam * phi).sum(-1) + e.square().sum(-1) / gamma) / xi
    ours = violation_loss(model, *data, gamma / 2, 2 * xi, reduction="none").detach()
    torch.testing.assert_close(2 * ours, prior, rtol=1e-8, atol=1e-8)


def test_data_of_the_model_itself_has_zero_loss_and_zero_gradient(model, data):
    x, u, _ = data
    x_next, lam = model(x, u)
    assert float(lam.detach().max()) > 0.1
    x.requires_grad_()
    loss = violation_loss(model, x, u, x_next.detach(), 0.1, 0.01, reduction="none")
    assert 0 <= float(loss.detach().max()) < 1e-16
    loss.sum().backward()
    for value in (x, *model.parameters()):
        assert float(value.grad.abs().max()) < 1e-9


@pytest.mark.parametrize("n_lam", [3, 5, 8])
def test_neighbours_and_threads_change_no_bit_of_a_loss(build, n_lam):
    model, n = build.model(seed=1, n_x=9, n_u=6, n_lam=n_lam, scale=0.3), build.normal(2)
    data = [n(300, 9), n(300, 6), n(300, 9)]
    whole = violation_loss(model, *data, reduction="none").detach()
    for part in (slice(0, 1), slice(3, 20), slice(299, 300), slice(None, None, 7)):
        assert torch.equal(violation_loss(model, *(v[part] for v in data), reduction="none").detach(), whole[part])
    before = torch.get_num_threads()
    gradients = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            gradients.append(torch.autograd.grad(violation_loss(model, *data), list(model.parameters())))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(left, right) for left, right in zip(*gradients, strict=True))


def test_layout_and_shape_of_the_data_do_not_matter(build, model):
    n = build.normal(1)
    x, u, x_next = n(4, 6).mT, n(6, 2), n(6, 8)[:, ::2]
    expected = violation_loss(model, x.contiguous(), u.contiguous(), x_next.contiguous())
    assert torch.equal(violation_loss(model, x, u, x_next), expected)
    assert torch.equal(violation_loss(model, x, u, x_next, reduction="none")[2],
                       violation_loss(model, x[2], u[2], x_next[2]))  # fmt: skip
    with torch.no_grad():
        model.A.set_(model.A.t().contiguous().t())
    assert torch.equal(violation_loss(model, x, u, x_next), expected)


# --- gradient -------------------------------------------------------------------------------------------------------


def test_each_input_can_be_the_only_one_that_needs_a_gradient(model, data):
    whole = dict(zip(NAMES, torch.autograd.grad(violation_loss(model, *data), list(model.parameters())), strict=True))
    for name in NAMES:
        for other, parameter in model.named_parameters():
            parameter.requires_grad_(other == name)
        (gradient,) = torch.autograd.grad(violation_loss(model, *data), getattr(model, name))
        torch.testing.assert_close(gradient, whole[name])
    model.requires_grad_(False)
    x = data[0].clone().requires_grad_()
    violation_loss(model, x, *data[1:]).backward()
    assert float(x.grad.abs().max()) > 0
    assert all(p.grad is None for p in model.parameters())


def test_a_subclass_with_another_F_gets_the_gradient_of_its_own(model, data):
    class Twice(LCSModel):
        @property
        def F(self):
            return 2 * super().F

    twice = Twice(4, 2, 3, stiffness=model.stiffness)
    twice.load_state_dict(model.state_dict())
    inputs = [twice.G, twice.H, twice.C]
    expected = torch.autograd.grad(violation_loss(twice.params(), *data), inputs)
    torch.testing.assert_close(torch.autograd.grad(violation_loss(twice, *data), inputs), expected)
    assert float(violation_loss(twice, *data).detach()) != float(violation_loss(model, *data).detach())


def test_a_second_backward_pass_gives_the_same_gradient(model, data):
    loss = violation_loss(model, *data)
    loss.backward(retain_graph=True)
    first = {k: p.grad.clone() for k, p in model.named_parameters()}
    loss.backward()
    assert all(torch.equal(p.grad, 2 * first[k]) for k, p in model.named_parameters())


@pytest.mark.parametrize("name", ["x", "A", "G"])
def test_what_the_gradient_needs_cannot_be_changed_in_place_before_it(model, data, name):
    x = data[0].clone()
    loss = violation_loss(model, x if name == "x" else x.requires_grad_(), *data[1:])
    with torch.no_grad():
        (x if name == "x" else getattr(model, name)).add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


# --- gamma ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1.001, 2.0, 100.0])
def test_gamma_above_its_bound_is_refused_with_both_numbers(model, data, factor):
    bound = sigma(model)
    with pytest.raises(GammaError) as error:
        violation_loss(model, *data, factor * bound)
    assert f"{bound:.6g}" in str(error.value)
    assert f"{factor * bound:.6g}" in str(error.value)
    assert "gamma='auto'" in str(error.value)


def test_gamma_zero_is_refused(model, data):
    with pytest.raises(GammaError, match="0 < gamma"):
        violation_loss(model, *data, 0.0)
    with pytest.raises(InvalidInputError, match="gamma"):
        violation_loss(model, *data, -0.1)


# --- shapes ---------------------------------------------------------------------------------------------------------


def test_reduction(model, data):
    each = violation_loss(model, *data, reduction="none")
    assert each.shape == (8,)
    torch.testing.assert_close(violation_loss(model, *data), each.mean())
    with pytest.raises(InvalidInputError, match="'mean', 'none', got 'sum'"):
        violation_loss(model, *data, reduction="sum")


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_leading_dimensions(build, model, function):
    n = build.normal(1)
    x, u, x_next = n(2, 3, 4), n(2, 3, 2), n(2, 3, 4)
    each = function(model, x, u, x_next, reduction="none")
    assert each.shape == (2, 3)
    torch.testing.assert_close(each[1, 2], function(model, x[1, 2], u[1, 2], x_next[1, 2], reduction="none"))
    assert function(model, x[0, 0], u[0, 0], x_next[0, 0], reduction="none").shape == ()
    assert function(model, x, u[0, 0], x_next, reduction="none").shape == (2, 3)
    assert function(model, x, u, x_next).shape == ()


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_float32_in_is_float32_out(build, data, function):
    model = build.model(seed=3, dtype=torch.float32)
    loss = function(model, *(v.float() for v in data))
    assert loss.dtype == torch.float32
    expected = function(build.model(seed=3), *data).detach()
    torch.testing.assert_close(loss.detach().double(), expected, rtol=1e-3, atol=1e-5)
    loss.backward()
    assert all(p.grad.dtype == torch.float32 and bool(torch.isfinite(p.grad).all()) for p in model.parameters())


# --- prediction loss ------------------------------------------------------------------------------------------------


def test_prediction_loss_is_half_the_squared_error(model, data):
    x, u, x_next = data
    expected = 0.5 * (model(x, u).x_next - x_next).square().sum(-1)
    torch.testing.assert_close(prediction_loss(model, *data, reduction="none"), expected)
    torch.testing.assert_close(prediction_loss(model, *data), expected.mean())
