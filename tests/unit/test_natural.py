"""The natural gradient: its steps, its metric, and what it does to a policy with an MPC."""

import numpy as np
import pytest
import torch
from torch import nn

from difflcs.errors import InvalidInputError
from difflcs.rl.learning.optim import NaturalGradient
from difflcs.rl.learning.policy import make_actor
from tests.conftest import refuse
from tests.training.slide import drawn, make_model, make_mpc

STD = 0.03


def make(momentum: float = 0.0, damping: float = 0.0, lr: float = 0.3) -> tuple[list[nn.Parameter], NaturalGradient]:
    parameters = [nn.Parameter(torch.zeros(2, dtype=torch.float64)), nn.Parameter(torch.zeros(1, 1).double())]
    return parameters, NaturalGradient(parameters, lr, momentum, damping)


def flat(parameters) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in parameters])


def backward(parameters, gradient) -> None:
    for p, g in zip(parameters, torch.tensor(gradient, dtype=torch.float64).split([2, 1]), strict=True):
        p.grad = g.view_as(p).clone()


JACOBIAN = torch.tensor([[[1.0, 2.0, 0.0], [0.0, 1.0, 1.0]], [[3.0, 0.0, 1.0], [1.0, 1.0, 1.0]]], dtype=torch.float64)
"""Two samples of two actions, by three parameters."""


def test_a_step_is_the_natural_gradient_of_the_given_length():
    parameters, optimiser = make(damping=0.2)
    optimiser.measure(JACOBIAN)
    metric = torch.einsum("nip,niq->pq", JACOBIAN, JACOBIAN) / 2
    torch.testing.assert_close(optimiser.metric, metric)
    gradient = [1.0, -2.0, 0.5]
    backward(parameters, gradient)
    optimiser.step()
    damped = metric + 0.2 * metric.diagonal().mean() * torch.eye(3)
    expected = -torch.linalg.solve(damped, torch.tensor(gradient, dtype=torch.float64))
    step = flat(parameters)
    torch.testing.assert_close(step / step.norm(), expected / expected.norm())
    assert float(step @ metric @ step) == pytest.approx(0.3**2)


def test_gradients_and_metrics_are_averaged():
    parameters, optimiser = make(momentum=0.8)
    for gradient in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]):
        backward(parameters, gradient)
        optimiser.step()
    torch.testing.assert_close(optimiser.average, torch.tensor([0.16, 0.2, 0.0], dtype=torch.float64))
    optimiser.measure(JACOBIAN)
    first = optimiser.metric.clone()
    optimiser.measure(2 * JACOBIAN)
    torch.testing.assert_close(optimiser.metric, 0.7 * first + 0.3 * 4 * first)


@pytest.mark.parametrize("jacobian", [torch.zeros(2, 2, 3), torch.full((2, 2, 3), torch.nan), torch.zeros(0, 2, 3)])
def test_no_step_without_a_metric(jacobian):
    parameters, optimiser = make()
    backward(parameters, [1.0, 1.0, 1.0])
    optimiser.step()
    optimiser.measure(jacobian.double())
    optimiser.step()
    assert not flat(parameters).any()
    optimiser.measure(JACOBIAN)
    optimiser.average.zero_()
    optimiser.zero_grad()
    optimiser.step()
    assert not flat(parameters).any()


def test_samples_near_a_jump_do_not_make_the_metric():
    one = torch.cat([JACOBIAN] * 5)
    plain, odd = make()[1], make()[1]
    plain.measure(one)
    odd.measure(torch.cat([one, 1e6 * JACOBIAN[:1]]))
    assert float(odd.metric.norm()) < 3 * float(plain.metric.norm())


def test_the_metric_is_the_fisher_matrix():
    """The mean outer product of the scores of many sampled actions."""
    actor = make_actor(make_mpc(make_model()), STD)
    data = drawn(actor, 72)
    jacobian = actor.jacobian(data)
    torch.testing.assert_close(actor.jacobian(data.exclude("guess")), jacobian)
    refuse(InvalidInputError, r"data: expected the keys .*; add goal", actor.jacobian, data.exclude("goal"))
    optimiser = NaturalGradient([p for p in actor.learned.parameters() if p.requires_grad], 0.1, 0.0, 0.1)
    optimiser.measure(jacobian)
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=(4000, *jacobian.shape[:2])))
    scores = torch.einsum("kni,nip->knp", noise, jacobian).flatten(0, 1)
    sampled = scores.mT @ scores / len(scores)
    torch.testing.assert_close(optimiser.metric, sampled, rtol=0.05, atol=0.02 * float(sampled.abs().max()))
