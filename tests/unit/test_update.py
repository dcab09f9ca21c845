"""How PPO moves a policy: sizes of steps, learned deviations, Adam and the natural gradient as update rules."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl import Adam, Natural
from difflcs.rl.learning.optim import AdamUpdate, NaturalGradient, NaturalUpdate, StepSize
from difflcs.rl.learning.optim.update import Deviation
from difflcs.rl.learning.policy import make_actor
from tests.conftest import refuse
from tests.training.slide import drawn, make_model, make_mpc, same

STD = 0.03
ADAM = Adam(learning_rate=0.02, betas=(0.9, 0.99))


def make(kind: str, covariance: str = "fixed", std_learning_rate: float = 0.01, samples: int = 300, **settings):
    """The policy and a rule that moves it."""
    actor = make_actor(make_mpc(make_model()), STD, covariance)
    deviation = Deviation(actor, std_learning_rate, (0.9, 0.99), (0.01, 0.05))
    if kind == "adam":
        return actor, AdamUpdate(actor, ADAM, 0.1, 1.5, deviation)
    return actor, NaturalUpdate(actor, Natural(**settings), 0.1, 1.5, deviation, samples)


def loss_of(actor, data=None) -> torch.Tensor:
    """Some loss that depends on mean and covariance."""
    data = drawn(actor) if data is None else data
    new = actor.solve(data.select(*actor.in_keys, "guess"))
    return (new["loc"] * torch.linspace(-1, 2, len(data)).double().unsqueeze(-1)).sum() + new["scale_tril"].sum()


def values(actor) -> list[torch.Tensor]:
    gaussian = actor.gaussian
    return [p.detach().clone() for p in (*actor.learned.parameters(), gaussian.log_std, gaussian.mixing)]


@pytest.mark.parametrize(("kl", "factor"), [(0.04, 1.5), (0.06, 1.0), (0.14, 1.0), (0.16, 1 / 1.5), (math.nan, 1.0)])
def test_step_size_follows_the_kl(kl, factor):
    size = StepSize(0.06, target_kl=0.1, factor=1.5)
    size.adapt(kl)
    assert size.value == pytest.approx(factor * 0.06)


def test_step_size_grows_up_to_the_longest():
    size = StepSize(0.06, 0.08, 1.5, longest=0.4)
    for _ in range(30):
        size.adapt(0.0)
    assert size.value == 0.4
    beyond = StepSize(0.7, 0.08, 1.5, longest=0.4)  # as the settings say, but not more
    beyond.adapt(0.0)
    assert beyond.value == 0.7
    beyond.adapt(1.0)
    assert beyond.value == pytest.approx(0.7 / 1.5)


def test_no_natural_step_is_longer_than_the_kl_of_an_iteration():
    sizes = {kind: make(kind)[1].size for kind in ("natural", "adam")}
    assert sizes["natural"].value == Natural().step
    assert sizes["natural"].longest == pytest.approx(math.sqrt(2 * 0.1))
    assert sizes["adam"].value == ADAM.learning_rate
    assert sizes["adam"].longest == math.inf


@pytest.mark.parametrize("covariance", ["fixed", "diagonal", "full"])
def test_adam_update_is_adam(covariance):
    """Those of the covariance have a step size of their own; all of them have the factor of the annealing."""
    actor, rule = make("adam", covariance)
    other, _ = make("adam", covariance)
    gaussian = other.gaussian
    learned = [p for p in other.learned.parameters() if p.requires_grad]
    deviation = [p for p in (gaussian.log_std, gaussian.mixing) if p.requires_grad]
    assert len(deviation) == ("fixed", "diagonal", "full").index(covariance)
    groups = [{"params": learned, "lr": 0.02}, *([{"params": deviation, "lr": 0.01}] if deviation else [])]
    adam, data = torch.optim.Adam(groups, betas=(0.9, 0.99)), drawn(actor)
    for scale in (1.0, 0.25):
        assert rule.step(loss_of(actor, data), scale)
        for group, size in zip(adam.param_groups, (0.02, 0.01), strict=False):
            group["lr"] = scale * size
        adam.zero_grad()
        loss_of(other, data).backward()
        adam.step()
    assert same(values(actor), values(other))


def test_the_metric_is_measured_with_some_of_the_samples():
    actor, rule = make("natural", samples=7)
    data, asked, jacobian = drawn(actor), [], actor.jacobian
    actor.jacobian = lambda part: (asked.append(part["state"]), jacobian(part))[1]
    rule.measure(data, np.random.default_rng(3))
    assert torch.equal(asked[0], data["state"][np.random.default_rng(3).permutation(len(data))[:7]])
    torch.testing.assert_close(
        rule.optimiser.metric, make_metric(jacobian(data[np.random.default_rng(3).permutation(len(data))[:7]]))
    )


def make_metric(jacobian: torch.Tensor) -> torch.Tensor:
    """Mean of Jᵀ J, those longer than three medians scaled down."""
    length = jacobian.flatten(1).norm(dim=1)
    limit = 3 * length[length > 0].median()
    shortened = jacobian * (limit / length).clamp_max(1.0).nan_to_num(1.0)[:, None, None]
    return torch.einsum("nip,niq->pq", shortened, shortened) / len(jacobian)


@pytest.mark.parametrize("kind", ["adam", "natural"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_gradient_that_is_not_finite_changes_nothing(kind, bad):
    actor, rule = make(kind, "full")
    data = drawn(actor)
    rule.measure(data, np.random.default_rng(0))
    rule.step(loss_of(actor, data), 1.0)
    before, state = values(actor), [p.clone() for p in _tensors(rule.state_dict())]
    assert not rule.step(loss_of(actor, data) * bad, 1.0)
    assert same(before, values(actor))
    assert same(state, _tensors(rule.state_dict()))
    one = loss_of(actor, data) + bad * actor.gaussian.log_std.sum()  # of the covariance alone
    assert not rule.step(one, 1.0)
    assert same(before, values(actor))
    assert rule.step(loss_of(actor, data), 1.0)
    assert not same(before, values(actor))


def _tensors(state) -> list[torch.Tensor]:
    from difflcs.rl.learning.state_tree import flatten

    return list(flatten(state)[0].values())


@pytest.mark.parametrize("sign", [1, -1])
def test_deviations_stay_within_their_limits(sign):
    actor, rule = make("adam", "diagonal", std_learning_rate=0.5)
    for _ in range(5):
        rule.step(sign * loss_of(actor), 1.0)
        assert 0.01 - 1e-12 <= float(actor.std) <= 0.05 + 1e-12
    assert float(actor.std) == pytest.approx(0.01 if sign > 0 else 0.05)


@pytest.mark.parametrize("covariance", ["fixed", "full"])
@pytest.mark.parametrize("kind", ["adam", "natural"])
def test_a_loaded_rule_goes_on_the_same(kind, covariance):
    first, second = make(kind, covariance), make(kind, covariance)
    data = drawn(first[0])
    first[1].measure(data, np.random.default_rng(0))
    first[1].step(loss_of(first[0], data), 1.0)
    first[1].size.adapt(0.0)
    with torch.no_grad():
        for p, other in zip(second[1].parameters, first[1].parameters, strict=True):
            p.copy_(other)
    second[1].load_state_dict(first[1].state_dict())
    assert second[1].size.value == first[1].size.value != StepSize(0.06, 0.1, 1.5).value
    for actor, rule in (first, second):
        rule.measure(data, np.random.default_rng(1))
        rule.step(loss_of(actor, data), 0.5)
    assert same(values(first[0]), values(second[0]))
    assert same(_tensors(first[1].state_dict()), _tensors(second[1].state_dict()))


@pytest.mark.parametrize("size", [0.0, -1.0, math.nan])
def test_a_step_size_that_is_not_positive_is_refused(size):
    _, rule = make("adam")
    state = rule.state_dict()
    refuse(CheckpointError, "positive step size", rule.load_state_dict, {**state, "step_size": size})
    assert rule.size.value == ADAM.learning_rate


# --- the natural gradient ---------------------------------------------------------------------------------------------


def make_natural(momentum: float = 0.0, damping: float = 0.0) -> tuple[list[nn.Parameter], NaturalGradient]:
    parameters = [nn.Parameter(torch.zeros(2, dtype=torch.float64)), nn.Parameter(torch.zeros(1, 1).double())]
    return parameters, NaturalGradient(parameters, 0.3, momentum, damping)


def flat(parameters) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in parameters])


def backward(parameters, gradient) -> None:
    for p, g in zip(parameters, torch.tensor(gradient, dtype=torch.float64).split([2, 1]), strict=True):
        p.grad = g.view_as(p).clone()


JACOBIAN = torch.tensor([[[1.0, 2.0, 0.0], [0.0, 1.0, 1.0]], [[3.0, 0.0, 1.0], [1.0, 1.0, 1.0]]], dtype=torch.float64)
"""Two samples of two actions, by three parameters."""


def test_a_step_is_the_natural_gradient_of_the_given_length():
    parameters, optimiser = make_natural(damping=0.2)
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
    parameters, optimiser = make_natural(momentum=0.8)
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
    parameters, optimiser = make_natural()
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
    plain, odd = make_natural()[1], make_natural()[1]
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
