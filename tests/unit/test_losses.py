"""violation_loss of one LCSModel, and prediction_loss; values and gradients are judged in test_losses_systems.py."""

import pytest
import torch

from difflcs import prediction_loss, violation_loss
from difflcs.errors import InvalidInputError


@pytest.fixture
def model(build):
    return build.model(seed=3)


@pytest.fixture
def data(build):
    n = build.normal(5)
    return n(8, 4), n(8, 2), n(8, 4)


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


def test_reduction(model, data):
    each = violation_loss(model, *data, reduction="none")
    assert each.shape == (8,)
    torch.testing.assert_close(violation_loss(model, *data), each.mean())
    with pytest.raises(InvalidInputError, match="'mean', 'none', got 'sum'"):
        violation_loss(model, *data, reduction="sum")


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_float32_in_is_float32_out(build, data, function):
    model = build.model(seed=3, dtype=torch.float32)
    loss = function(model, *(v.float() for v in data))
    assert loss.dtype == torch.float32
    expected = function(build.model(seed=3), *data).detach()
    torch.testing.assert_close(loss.detach().double(), expected, rtol=1e-3, atol=1e-5)
    loss.backward()
    assert all(p.grad.dtype == torch.float32 and bool(torch.isfinite(p.grad).all()) for p in model.parameters())


def test_prediction_loss_is_half_the_squared_error(model, data):
    x, u, x_next = data
    expected = 0.5 * (model(x, u).x_next - x_next).square().sum(-1)
    torch.testing.assert_close(prediction_loss(model, *data, reduction="none"), expected)
    torch.testing.assert_close(prediction_loss(model, *data), expected.mean())
