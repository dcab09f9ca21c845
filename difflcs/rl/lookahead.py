"""Advantages with little noise, for episodes in which one can look a step ahead: imagined ones.

With q(s, a) = r(s, a) + γ V(s₊) and its mean q̄(s) over the policy's actions, an error of GAE (Eq. adv_func) is

    δ_t = [q(s_t, a_t) − q̄(s_t)] + b(s_t),  b = q̄ − V.

In an advantage Σ_l (γζ)^l δ_{t+l} the brackets of later steps are noise: they average out over later actions. So is
b(s_t), the same for all actions. Without them, and with many actions for each state,

    A(s_t, a) = q(s_t, a) − q̄(s_t) + [a = a_t] M Σ_{l≥1} (γζ)^l b(s_{t+l})

has the policy gradient of GAE in expectation, with the same V and ζ. The sum, which corrects what V says wrongly about
the next states, is known for the action taken only: it counts for all M of them.

The bracket is also noise in the rewards that V is fitted to, and left out of them (`luck`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

if TYPE_CHECKING:
    from tensordict import TensorDict


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


def lookahead_advantages(q: Tensor, values: Tensor, gamma: float, zeta: float) -> Tensor:
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


def luck(q: Tensor) -> Tensor:
    """What the actions taken are better than the mean of those judged: (..., M), the one taken first, → (...).

    Zero in expectation over the actions, so returns without it have the same mean and less noise.
    """
    return q[..., 0] - q.mean(-1)
