"""Gradients of small networks written by hand: the same as autograd's."""

from itertools import pairwise

import pytest
import torch

from difflcs.rl.learning.least_squares import BACKWARD, gradients, tanh

REFERENCE = {torch.relu_: torch.relu, tanh: torch.tanh}


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def layers_of(networks: int, sizes: tuple[int, ...]) -> list[tuple[torch.Tensor, torch.Tensor]]:
    pairs = enumerate(pairwise(sizes))
    return [(drawn(networks, a, b, seed=i), drawn(networks, 1, b, seed=i + 9)) for i, (a, b) in pairs]


@pytest.mark.parametrize("activation", list(BACKWARD))
@pytest.mark.parametrize(("networks", "sizes"), [(1, (3, 5, 1)), (3, (4, 6, 7, 2)), (2, (3, 2))])
def test_gradients_are_those_of_autograd(activation, networks, sizes):
    layers, inputs = layers_of(networks, sizes), drawn(networks, 11, sizes[0], seed=3)
    targets = drawn(networks, 11, sizes[-1], seed=4)
    before = [part.clone() for part in (inputs, targets, *(part for layer in layers for part in layer))]
    errors, found = gradients(layers, activation, inputs, targets)
    leaves = [part.clone().requires_grad_() for layer in layers for part in layer]
    hidden = inputs
    for weight, bias in zip(leaves[:-2:2], leaves[1:-2:2], strict=True):
        hidden = REFERENCE[activation](hidden @ weight + bias)
    expected = (hidden @ leaves[-2] + leaves[-1] - targets).square().mean((1, 2))
    torch.testing.assert_close(errors, expected.detach())
    wanted = torch.autograd.grad(expected.sum(), leaves)
    for a, b in zip([part for layer in found for part in layer], wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
        assert bool(b.any())
    after = (inputs, targets, *(part for layer in layers for part in layer))
    assert all(torch.equal(a, b) for a, b in zip(after, before, strict=True))


def test_tanh_is_that_of_torch():
    x = torch.linspace(-20, 20, 4001)
    torch.testing.assert_close(tanh(x), torch.tanh(x), rtol=0, atol=3e-7)
    assert torch.equal(x, torch.linspace(-20, 20, 4001))
