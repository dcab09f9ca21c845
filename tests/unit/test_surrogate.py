"""The loss of PPO: its gradient, its outliers, and the violation loss beside it."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.distributions import MultivariateNormal

from difflcs import violation_loss
from difflcs.rl import ViolationLoss
from difflcs.rl.learning.policy import make_actor
from difflcs.rl.learning.surrogate import Surrogate, gaussian_kl, trimmed_mean
from difflcs.rl.rollout import transitions
from tests.conftest import Build, draw
from tests.training.slide import drawn, make_model, make_mpc

STD = 0.03
VIOLATION = ViolationLoss(gamma=0.07, xi=0.03)


def made(outlier_kl: float = 2.0, beta: float = 1.0, violation: ViolationLoss | None = None, clip: float = 0.3):
    """The policy, the loss, and what the policy drew."""
    actor = make_actor(make_mpc(make_model()), STD)
    return actor, Surrogate(actor, clip, outlier_kl, beta, violation), drawn(actor)


def judged(data: TensorDict, seed: int = 0) -> TensorDict:
    """(N, 1) the actions taken, with random advantages."""
    samples = data.select("action", "action_log_prob").unsqueeze(-1)
    samples["advantage"] = draw(len(data), 1, 1, seed=seed)
    return samples


def solved(actor, data: TensorDict) -> TensorDict:
    return actor.solve(data.select(*actor.in_keys, "guess", strict=False))


def episodes(count: int = 80) -> TensorDict:
    """Random transitions, more than the violation loss takes in a step."""
    n = Build.normal(1)
    return TensorDict({"state": n(count, 6, 1), "action": n(count, 5, 1)}, [count])


def gradients(loss, actor) -> list[torch.Tensor]:
    learned = [p for p in actor.learned.parameters() if p.requires_grad]
    return list(torch.autograd.grad(loss, learned, materialize_grads=True, allow_unused=True))


def score(actor, data: TensorDict, weights: torch.Tensor) -> list[torch.Tensor]:
    """Gradient of −mean(weight · log π) with the MPC solved cold."""
    mean = actor.mpc(data["state"], data["goal"]).action
    log_prob = -0.5 * ((data["action"] - mean) / STD).square().sum(-1)
    return gradients(-(weights * log_prob).mean(), actor)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_outliers_are_left_out():
    """Samples whose mean has moved too far have no say, however large their advantage; nor do their gradients."""
    actor, surrogate, data = made()
    samples = judged(data)
    samples["advantage"][:5] *= 1e3
    weights = samples["advantage"].flatten().clone()
    weights[:5] = 0
    expected = score(actor, data, weights)
    data["loc"][:5] += 1.0
    new = solved(actor, data)
    kl = gaussian_kl(data, new)
    loss = surrogate(new, data, kl, samples, episodes(), rng())
    torch.testing.assert_close(loss, -weights.mean(), rtol=1e-6, atol=1e-9)  # all other ratios are 1
    found = gradients(loss, actor)
    assert surrogate.outliers == 5 / len(data)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-8)
    _, tolerant, _ = made(outlier_kl=float(kl.max()))  # at the limit itself they count
    tolerant(new, data, kl, judged(data), episodes(), rng())
    assert tolerant.outliers == 0


def test_the_gradient_is_that_of_all_actions():
    """At the parameters that drew them the gradient is that of −mean(A log π) over many actions for each state."""
    (actor, surrogate, data), n = made(), Build.normal(2)
    action = data["loc"].unsqueeze(1) + STD * n(len(data), 4, 1)
    before = MultivariateNormal(data["loc"].unsqueeze(1), scale_tril=data["scale_tril"].unsqueeze(1))
    samples = TensorDict({"action": action, "action_log_prob": before.log_prob(action)}, action.shape[:2])
    samples["advantage"] = n(len(data), 4, 1)
    mean = actor.mpc(data["state"], data["goal"]).action.unsqueeze(1)
    log_prob = -0.5 * ((action - mean) / STD).square().sum(-1)
    expected = gradients(-(samples["advantage"].squeeze(-1) * log_prob).mean(), actor)
    new = solved(actor, data)
    found = gradients(surrogate(new, data, gaussian_kl(data, new), samples, episodes(), rng()), actor)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-8)
    assert any(bool(gradient.any()) for gradient in expected)


def test_the_objective_is_clipped():
    """Eq. 4, written out after the mean has moved."""
    actor, surrogate, data = made(clip=0.2)
    samples = judged(data)
    with torch.no_grad():
        for p in actor.learned.parameters():
            p += 0.05
    new = solved(actor, data)
    log_prob = MultivariateNormal(new["loc"], scale_tril=new["scale_tril"]).log_prob(data["action"])
    ratio, advantage = (log_prob - data["action_log_prob"]).exp(), samples["advantage"].flatten()
    expected = -torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    loss = surrogate(new, data, torch.zeros(len(data)).double(), samples, episodes(), rng())
    torch.testing.assert_close(loss, expected, rtol=1e-6, atol=1e-9)
    outside = ((ratio - 1).abs() > 0.2).double().mean()
    assert surrogate.clip_fraction == pytest.approx(float(outside), abs=1e-6)
    assert 0 < surrogate.clip_fraction < 1


@pytest.mark.parametrize("beta", [0.0, 0.7])
def test_the_losses_are_weighted(beta):
    """Eq. 7: β of the clipped objective, 1 − β of the violation loss on some of the newest transitions."""
    actor, surrogate, data = made(beta=beta, violation=VIOLATION)
    _, alone, _ = made()
    seen, (new, other) = episodes(), [solved(actor, data) for _ in range(2)]
    kl = gaussian_kl(data, new)
    clipped = alone(other, data, kl, judged(data), seen, rng())
    loss = surrogate(new, data, kl, judged(data), seen, rng(3))
    x, u, x_next = transitions(seen)
    chosen = rng(3).permutation(len(x))[:300]
    violation = violation_loss(actor.learned, x[chosen], u[chosen], x_next[chosen], 0.07, 0.03)
    expected = beta * clipped + (1 - beta) * violation
    torch.testing.assert_close(loss, expected)
    for a, b in zip(gradients(loss, actor), gradients(expected, actor), strict=True):
        torch.testing.assert_close(a, b)


def test_trimmed_mean():
    assert trimmed_mean(torch.tensor([17.0, 1.0, 2.0, 3.0]), 0.75) == 2.0
    assert trimmed_mean(torch.tensor([17.0]), 0.5) == 17.0
