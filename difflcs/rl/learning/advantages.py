"""Advantages: by generalised advantage estimation (GAE), or of many actions for each state.

docs/training.md#multi-action-advantages derives the latter. The advantage of the action taken (`action_advantage`) is
also noise in the rewards that V is fitted to, and is subtracted from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from difflcs.errors import InvalidInputError
from difflcs.rl.learning.critic import Critic
from difflcs.rl.rollout import CONTEXT, elapsed_fractions
from difflcs.rl.seeding import seeded
from difflcs.rl.tasks import Features, compute_features

if TYPE_CHECKING:
    from tensordict import TensorDict

    from difflcs.rl.learning.model_rollouts import ModelEnv

SAMPLES = ("action", "action_log_prob")
ZETA = 0.5
"""ζ of advantages of many actions."""


@dataclass(frozen=True)
class Estimate:
    """Result of an estimator of advantages.

    Attributes:
        samples: (N, T, M) "action", "action_log_prob" and "advantage" (…, 1) of M actions for each state.
        values: (N, T) of the states, by the value network.
        rewards: (N, T) that the value network is to be fitted to.
    """

    samples: TensorDict
    values: Tensor
    rewards: Tensor


class Advantages(Protocol):
    """An estimator of advantages."""

    def __call__(self, episodes: TensorDict, inputs: Tensor, rewards: Tensor, key: Sequence[int]) -> Estimate:
        """Judge the actions of episodes.

        Args:
            episodes: a record of `difflcs.rl.collect` with what the policy drew under "policy" (N, T).
            inputs: (N, T+1, n) of the value network.
            rewards: (N, T) to learn from.
            key: of random numbers.
        """
        ...


class RewardScale:
    """Clips and scales the rewards of the environment for learning.

    Args:
        cost_limit: rewards of single steps are at least minus this, besides the penalty of a failed episode.
        failure_penalty: what the last reward of a failed episode holds.
        factor: on all rewards.
    """

    def __init__(self, cost_limit: float, failure_penalty: float, factor: float):
        self.cost_limit, self.failure_penalty, self.factor = cost_limit, failure_penalty, factor

    def __call__(self, rewards: Tensor, success: Tensor) -> Tensor:
        """Rewards (N, T, ...) and successes of the last step (N, ...) bool → (N, T, ...).

        Raises:
            InvalidInputError: rewards that are not finite.
        """
        limit = torch.full_like(rewards, -self.cost_limit)
        limit[:, -1] -= self.failure_penalty * (~success).to(rewards.dtype)
        rewards = torch.maximum(rewards, limit)
        if not bool(torch.isfinite(rewards).all()):
            raise InvalidInputError("env: expected finite rewards, got NaN or infinity; mend the environment's reward")
        return self.factor * rewards


class GAEAdvantages:
    """GAE of the actions taken.

    Args:
        critic: the value network, with its discount and ζ.
    """

    def __init__(self, critic: Critic):
        self.critic = critic

    def __call__(self, episodes: TensorDict, inputs: Tensor, rewards: Tensor, key: Sequence[int]) -> Estimate:
        """See `Advantages`."""
        values, advantages = self.critic.gae(inputs, rewards)
        taken: Any = episodes["policy"]
        samples = taken.select(*SAMPLES).unsqueeze(-1)
        samples["advantage"] = advantages[..., None, None]
        return Estimate(samples, values, rewards)


class MultiActionAdvantages:
    """Advantages of many actions for each state of model rollouts, see the module.

    Args:
        env: the environment that has just played the episodes.
        critic: the value network, with its discount.
        features: inputs of the value network.
        scale: rewards to learn from.
        bounds: (n_u,), (n_u,) within which actions are executed.
        actions: M, an even number.
        zeta: ζ.
    """

    def __init__(
        self,
        env: ModelEnv,
        critic: Critic,
        features: Features,
        scale: RewardScale,
        bounds: tuple[Tensor, Tensor],
        actions: int,
        zeta: float = ZETA,
    ):
        self.env, self.critic, self.features, self.scale, self.bounds = env, critic, features, scale, bounds
        self.actions, self.zeta = actions, zeta

    @torch.no_grad()
    def __call__(self, episodes: TensorDict, inputs: Tensor, rewards: Tensor, key: Sequence[int]) -> Estimate:
        """See `Advantages`."""
        now = self.critic.values(inputs[:, :-1])
        with seeded(key):
            judged = mirrored_actions(episodes["policy"], self.actions)
        executed = torch.clamp(judged["action"], *self.bounds)
        after, seen, success = self.env.predict_alternatives(episodes["state"][:, :-1], executed, episodes["goal"])
        goals = episodes["goal"][:, None, None].expand(*after.shape[:-1], -1)
        elapsed = elapsed_fractions(after.shape[1])[1:, None].expand(after.shape[:-1])
        context = episodes.get(CONTEXT, None)
        if context is not None:
            context = context[:, None, None].expand(*after.shape[:-1], -1)
        values = self.critic.values(compute_features(self.features, after, goals, elapsed, context))
        values[:, -1] = 0  # an episode has ended
        q = self.scale(seen, success[:, -1]) + self.critic.gamma * values
        judged["advantage"] = multi_action_advantages(q, now, self.critic.gamma, self.zeta).unsqueeze(-1)
        return Estimate(judged, now, rewards - action_advantage(q))


def mirrored_actions(taken: TensorDict, count: int) -> TensorDict:
    """Draw actions in pairs that lie symmetrically about the mean: the action taken, its image, and others.

    Args:
        taken: "action", "loc" (..., n_u) and "scale_tril" (..., n_u, n_u) of a Gaussian policy.
        count: M, an even number of actions.

    Returns:
        "action" (..., M, n_u), the one taken first, and "action_log_prob" (..., M); from the global generator.
    """
    from tensordict import TensorDict

    mean, factor = taken["loc"].unsqueeze(-2), taken["scale_tril"].unsqueeze(-3)
    first = taken["action"].unsqueeze(-2) - mean
    noise = torch.randn(*mean.shape[:-2], count // 2 - 1, mean.shape[-1], dtype=mean.dtype)
    offsets = torch.cat([first, (factor @ noise.unsqueeze(-1)).squeeze(-1)], -2)
    action = mean + torch.stack([offsets, -offsets], -2).flatten(-3, -2)
    log_prob = MultivariateNormal(mean, scale_tril=factor, validate_args=False).log_prob(action)
    return TensorDict({"action": action, "action_log_prob": log_prob}, action.shape[:-1])


def multi_action_advantages(q: Tensor, values: Tensor, gamma: float, zeta: float) -> Tensor:
    """A(s_t, a) of the module's docstring.

    Args:
        q: (N, T, M) r + γ V of the next state, the action taken first.
        values: (N, T) V of the states.
        gamma: discount per step.
        zeta: ζ.

    Returns:
        (N, T, M). The corrections have zero mean over N and T.
    """
    mean = q.mean(-1)
    following, corrections = torch.zeros_like(mean[:, 0]), []
    for residual in reversed((mean - values).unbind(1)):
        corrections.append(following)
        following = gamma * zeta * (residual + following)
    correction = torch.stack(corrections[::-1], 1)
    advantages = q - mean.unsqueeze(-1)
    advantages[..., 0] += q.shape[-1] * (correction - correction.mean())
    return advantages


def action_advantage(q: Tensor) -> Tensor:
    """Compute the advantage (...) of the action taken over the mean of all M actions, from their values (..., M).

    The action taken comes first.

    Zero in expectation over the actions, so returns without it have the same mean and less noise.
    """
    return q[..., 0] - q.mean(-1)
