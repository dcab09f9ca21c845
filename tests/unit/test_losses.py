"""violation_loss against an enumerated inner QP, its envelope gradient, and prediction_loss."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.optimize
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck
from torch.func import functional_call

from difflcs import LCSModel, prediction_loss, solve_lcp, violation_loss
from difflcs.errors import DoubleBackwardError, GammaError, InvalidInputError

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


@pytest.mark.parametrize("scale", [1e-3, 1.0, 30.0])
def test_value_equals_nonnegative_least_squares_on_a_paper_sized_model(build, scale):
    model = build.model(seed=1, n_x=9, n_u=6, n_lam=5, scale=0.3)
    n = build.normal(2)
    data = scale * n(10, 9), scale * n(10, 6), scale * n(10, 9)
    found = violation_loss(model, *data, 0.1, 0.01, reduction="none").detach()
    for i, row in enumerate(zip(*data, strict=True)):
        Q, q = inner_qp(model.params().detach(), *row, 0.1, 0.01)
        L = np.linalg.cholesky(Q)
        z = torch.from_numpy(scipy.optimize.nnls(L.T, -np.linalg.solve(L, q), maxiter=1000)[0])
        expected = objective(model.params().detach(), *row, z[:5], z[5:], 0.1, 0.01)
        torch.testing.assert_close(found[i], expected, rtol=1e-8, atol=1e-8 * scale**2)


def test_gamma_at_its_bound_is_allowed_and_exact(model, data):
    gamma = sigma(model)
    lam, phi = reference(model, data, gamma, 0.01)
    expected = objective(model.params().detach(), *data, lam, phi, gamma, 0.01)
    found = violation_loss(model, *data, gamma, 0.01, reduction="none").detach()
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)


def test_gamma_at_its_bound_is_exact_where_the_inner_qp_is_singular(build, data):
    """C = 0 and F = 0.2·I: at γ = 0.4 the inner Hessian is singular along λ = φ·…"""
    model = build.model(seed=3)
    with torch.no_grad():
        for name in "CGH":
            getattr(model, name).zero_()
    lam, phi = reference(model, data, 0.4, 0.01)
    expected = objective(model.params().detach(), *data, lam, phi, 0.4, 0.01)
    found = violation_loss(model, *data, 0.4, 0.01, reduction="none").detach()
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


def test_the_loss_is_never_above_that_of_any_feasible_point(build, model, data):
    n = build.normal(3)
    found = violation_loss(model, *data, reduction="none").detach()
    for _ in range(50):
        other = objective(model.params().detach(), *data, n(8, 3).clamp_min(0), n(8, 3).clamp_min(0), 0.1, 0.01)
        assert bool((found <= other + 1e-12).all())


def formula(model, x, u, x_next, gamma, xi):
    """The loss of each transition, differentiable with λ and φ held: the QP written out and solved as an LCP."""
    p = model.params()
    with torch.no_grad():
        n, weight = len(p.c), 1 / (gamma * xi)
        eye = torch.eye(n, dtype=torch.float64)
        coupling = eye / xi - weight * p.F.mT
        Q = torch.cat([torch.cat([p.C.mT @ p.C + weight * p.F.mT @ p.F, coupling], 1),
                       torch.cat([coupling.mT, weight * eye], 1)])  # fmt: skip
        free, gap = x @ p.A.mT + u @ p.B.mT + p.d - x_next, x @ p.D.mT + u @ p.E.mT + p.c
        z = solve_lcp(Q, torch.cat([free @ p.C + weight * gap @ p.F, -weight * gap], 1)).lam
    return objective(p, x, u, x_next, z[:, :n], z[:, n:], gamma, xi)


def assert_equal_to(found, expected):
    """Tensors within 4e-9 of the largest number of them all: two ways to the digits that a small γ leaves."""
    largest = max(float(v.abs().max()) for v in expected)
    for left, right in zip(found, expected, strict=True):
        torch.testing.assert_close(left, right, rtol=0, atol=4e-9 * largest + 1e-300)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    sizes=st.sampled_from([(9, 6, 5), (9, 6, 8), (1, 1, 1), (4, 2, 3), (3, 7, 6), (2, 1, 9)]),
    count=st.sampled_from([1, 2, 7, 8, 9, 100]),
    part=st.floats(0.01, 0.99),
    xi=st.sampled_from([1e-3, 0.02, 1.0]),
    scale=st.sampled_from([1e-3, 0.3, 1.0]),
)
def test_value_and_gradient_equal_the_formula(build, seed, sizes, count, part, xi, scale):
    n_x, n_u, n_lam = sizes
    model = build.model(seed, n_x, n_u, n_lam, scale=scale)
    n = build.normal(seed + 1)
    data = [n(count, size).requires_grad_() for size in (n_x, n_u, n_x)]
    gamma, upstream = part * sigma(model), n(count)
    inputs = [*model.parameters(), *data]
    found, expected = violation_loss(model, *data, gamma, xi, reduction="none"), formula(model, *data, gamma, xi)
    mean = violation_loss(model, *data, gamma, xi)
    assert_equal_to([found.detach()], [expected.detach()])
    assert_equal_to([mean.detach()], [expected.detach().mean()])
    for left, right in (((found * upstream).sum(), (expected * upstream).sum()), (mean, expected.mean())):
        assert_equal_to(torch.autograd.grad(left, inputs), torch.autograd.grad(right, inputs, retain_graph=True))


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


def test_gradcheck_in_every_parameter_and_datum(build):
    model = build.model(seed=2, n_x=3, n_u=2, n_lam=3)
    n = build.normal(4)
    values = [getattr(model, k).detach().clone().requires_grad_() for k in NAMES]
    data = [n(3, 3).requires_grad_(), n(3, 2).requires_grad_(), n(3, 3).requires_grad_()]

    class Loss(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.lcs = model

        def forward(self, *data):
            return violation_loss(self.lcs, *data, 0.1, 0.5, reduction="none")

    loss = Loss()

    def function(x, u, x_next, *values):
        return functional_call(
            loss, {f"lcs.{k}": v for k, v in zip(NAMES, values, strict=True)}, (x, u, x_next), strict=False
        )

    assert gradcheck(function, (*data, *values), eps=1e-6, atol=1e-5, rtol=1e-5)


def test_gradient_is_that_of_the_objective_with_the_minimisers_held(model, data):
    gamma, xi = 0.1, 0.01
    lam, phi = reference(model, data, gamma, xi)
    x, u, x_next = (v.clone().requires_grad_() for v in data)
    inputs = [*model.parameters(), x, u, x_next]
    expected = torch.autograd.grad(objective(model.params(), x, u, x_next, lam, phi, gamma, xi).mean(), inputs)
    found = torch.autograd.grad(violation_loss(model, x, u, x_next, gamma, xi), inputs)
    for left, right in zip(found, expected, strict=True):
        torch.testing.assert_close(left, right, rtol=1e-7, atol=1e-9)


def test_nothing_is_differentiated_through_the_solve(model, data, monkeypatch):
    """The backward pass solves no linear system."""
    loss = violation_loss(model, *data)

    def refuse(*args, **kwargs):
        raise AssertionError("a linear solve in the backward pass")

    for name in ("solve", "lu_factor", "lu_factor_ex", "inv", "lstsq", "solve_ex"):
        monkeypatch.setattr(torch.linalg, name, refuse)
    loss.backward()
    assert float(model.F.detach().abs().max()) > 0
    assert float(model.G.grad.abs().max()) > 0


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
    expected = torch.autograd.grad(formula(twice, *data, 0.1, 0.01).mean(), [twice.G, twice.H, twice.C])
    assert_equal_to(torch.autograd.grad(violation_loss(twice, *data), [twice.G, twice.H, twice.C]), expected)


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


def test_double_backward_is_refused(model, data):
    with pytest.raises(DoubleBackwardError, match=r"first derivatives only.*create_graph=False"):
        torch.autograd.grad(violation_loss(model, *data), model.A, create_graph=True)


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
def test_an_empty_batch_has_zero_loss_and_zero_gradient(model, function):
    x = torch.empty(0, 4, dtype=torch.float64)
    u = torch.empty(0, 2, dtype=torch.float64)
    assert function(model, x, u, x, reduction="none").shape == (0,)
    loss = function(model, x, u, x)
    assert float(loss.detach()) == 0
    loss.backward()
    assert all(float(p.grad.abs().max()) == 0 for p in model.parameters() if p.grad is not None)


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


def test_prediction_loss_gradcheck(build):
    model = build.model(seed=2, n_x=3, n_u=2, n_lam=3)
    n = build.normal(4)
    data = [n(3, 3).requires_grad_(), n(3, 2).requires_grad_(), n(3, 3).requires_grad_()]
    assert gradcheck(lambda *d: prediction_loss(model, *d, reduction="none"), data, eps=1e-7, atol=1e-6, rtol=1e-5)


# --- learning -------------------------------------------------------------------------------------------------------


def test_gradient_descent_on_the_loss_recovers_the_prediction_of_another_model(build):
    truth = build.model(seed=5, n_x=2, n_u=1, n_lam=1)
    n = build.normal(6)
    x, u = n(60, 2), n(60, 1)
    x_next = truth(x, u).x_next.detach()
    model = LCSModel(2, 1, 1, stiffness=0.2, init_scale=0.1, generator=torch.Generator().manual_seed(0))
    before = float(prediction_loss(model, x, u, x_next).detach())
    optimiser = torch.optim.Adam(model.parameters(), lr=0.02)
    for _ in range(300):
        optimiser.zero_grad()
        violation_loss(model, x, u, x_next, 0.1, 0.1).backward()
        optimiser.step()
    assert float(prediction_loss(model, x, u, x_next).detach()) < 0.05 * before
