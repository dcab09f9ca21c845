"""A small pushing system that needs no simulator, also one with a context, and trainers on it."""

from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import Mock

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from tensordict import TensorDict
from torch import Tensor, nn

from difflcs import GoalCost, LCSModel, LCSModule, LCSMPCLayer, LCSParams
from difflcs.rl import CriticSettings, EnsembleSettings, Epochs, ModelRollouts, ModelRolloutSettings, PPOSettings
from difflcs.rl.learning import ppo_settings
from difflcs.rl.learning.optim import UpdateRule
from difflcs.rl.learning.policy import GaussianPolicy, make_actor
from difflcs.rl.learning.ppo import PPO
from tests.conformance.toy import Reaching

STEPS = 6
U_MAX = 0.1
ROLLOUTS = 12
PENALTY = 10.0


def outcome(state, action, after, goal, ended, penalty=PENALTY):
    """Reward and success of a transition; also for model rollouts."""
    success = abs(after - goal)[..., 0] < 0.05
    return -20 * abs(state - goal)[..., 0] - penalty * (ended & ~success), success


class Slide(Reaching):
    """x₊ = x + gain·u: what a model with another B must find out."""

    def __init__(self, breaks_at: int | None = None, penalty: float = PENALTY):
        super().__init__(1, U_MAX, STEPS, breaks_at)
        self.judge = partial(outcome, penalty=penalty)

    def draw(self):
        return np.zeros(1), self.np_random.uniform(-0.3, 0.3, 1)

    def move(self, action):
        return self.state + 0.5 * action


class Gains(Slide):
    """`Slide` with another start and another gain in each episode, which is known: x₊ = x + gain·u."""

    def __init__(self, drifts: bool = False):
        super().__init__()
        self.observation_space["context"] = spaces.Box(0.0, 1.0, (1,), np.float64)
        self.drifts = drifts

    def draw(self):
        _, goal = super().draw()
        state, self.context = self.np_random.uniform(-0.1, 0.1, 1), self.np_random.uniform(0.2, 0.8, 1)
        return state, goal

    def move(self, action):
        after = super().move(action * self.context / 0.5)
        self.context = self.context + 0.01 * self.drifts
        return after

    def observe(self):
        return {**super().observe(), "context": self.context.copy()}


class Gain(nn.Module):
    """x₊ = a x + effect·gain·u + λ beside a wall; the effect is underestimated, so that the MPC hardly acts."""

    n_x, n_u, n_lam = 1, 1, 1

    def __init__(self, effect: float = 0.2, wall: float = -9.0):
        super().__init__()
        self.a, self.effect = (nn.Parameter(torch.tensor(v, dtype=torch.float64)) for v in (0.97, effect))
        self.unused = nn.Parameter(torch.zeros(2, dtype=torch.float64))
        self.wall = wall

    def params(self, x=None, context=None):
        """The systems of gains (..., 1): the wall is soft, 0 ≤ λ ⊥ x₊ − wall + λ/2 ≥ 0."""
        assert context is not None
        A, B, one = self.a.view(1, 1), (self.effect * context).unsqueeze(-1), torch.ones(1, dtype=torch.float64)
        return LCSParams(A=A, B=B, C=one[None], d=0 * one, D=A, E=B, F=1.5 * one[None], c=-self.wall * one)


def features(state, goal, elapsed):
    return torch.cat([10 * (state - goal), 10 * (state - goal).abs(), elapsed.unsqueeze(-1)], -1)


def make_envs(count: int = ROLLOUTS, **kwargs) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: Slide(**kwargs)] * count)


def make_model(seed: int = 0) -> LCSModel:
    """x₊ = 0.97 x + 0.1 u: the effect of an action is underestimated five times, so that the MPC hardly acts."""
    lcs = LCSModel(1, 1, 1, init_scale=0.01, learn_c=False, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        lcs.A.fill_(0.97)
        lcs.B.fill_(0.1)
    return lcs


def make_mpc(lcs: LCSModule, u_max: float = U_MAX) -> LCSMPCLayer:
    cost = GoalCost.reach(1, 1, goal_weight=(1.0,), input_weight=3.0)
    return LCSMPCLayer(lcs, cost, horizon=3, u_min=-u_max, u_max=u_max, on_failure="mask")


def small_settings(**changes: Any) -> PPOSettings:
    critic = CriticSettings(epochs=Epochs(first=10, each=3, minibatch=256))
    return replace(PPOSettings(rollouts=ROLLOUTS, steps=4, std=0.03, critic=critic, gain=None), **changes)


def make_ppo(
    seed: int = 0,
    iterations: int = 4,
    env: SyncVectorEnv | None = None,
    models: ModelRollouts | None = None,
    penalty: float = PENALTY,
    controller: LCSMPCLayer | None = None,
    options: dict[str, Any] | None = None,
    **changes: Any,
) -> PPO:
    """PPO with other settings where `changes` has them, and other arguments where `options` has them."""
    settings = small_settings(**changes)
    usual = {"features": features, "total_episodes": iterations * settings.rollouts, "failure_penalty": penalty}
    options = {**usual, "episode_steps": STEPS, "models": models, **(options or {})}
    actor = make_actor(controller or make_mpc(make_model()), settings.std, settings.covariance)
    env = make_envs(settings.rollouts, penalty=penalty) if env is None else env
    return ppo_settings.make_ppo(actor, env, settings, seed, **options)


def make_models(seed: int = 0, first_epochs: int = 20, **changes: Any) -> ModelRollouts:
    epochs = Epochs(first=first_epochs, each=3, minibatch=128)
    ensemble = EnsembleSettings(networks=2, width=16, epochs=epochs)
    settings = replace(ModelRolloutSettings(iterations=2, rollouts=10, ensemble=ensemble), **changes)
    return ModelRollouts(make_envs(), outcome, settings, seed, STEPS)


def recorded(trainer: PPO, source: str = "robot") -> Mock:
    """Note what the advantages of a trainer are asked for: (episodes, inputs, rewards, key) → `Estimate`."""
    part = getattr(trainer, source)
    recording = Mock(wraps=part.advantages)
    setattr(trainer, source, replace(part, advantages=recording))
    return recording


class Noting(UpdateRule):
    """A rule that notes what it is asked for, and moves nothing."""

    def __init__(self, rule, answers=lambda: True):
        super().__init__(rule.parameters, rule.optimiser, rule.size, rule.deviation)
        self.seen, self.answers = [], answers

    def step(self, loss, scale):
        self.seen.append((float(loss.detach()), scale))
        return self.answers()


def drawn(actor: GaussianPolicy, count: int = 60, seed: int = 0) -> TensorDict:
    """(count,) what a policy draws at random states, with its own plans as guesses."""
    generator = torch.Generator().manual_seed(seed)
    state, goal = (0.3 * (2 * torch.rand(count, 1, generator=generator, dtype=torch.float64) - 1) for _ in range(2))
    data = TensorDict({"state": state, "goal": goal, "elapsed": torch.zeros(count).double()}, [count])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        actor.act(data)
    data["guess"] = data["plan"].clone()
    return data


def parameters(trainer: Any) -> list[Tensor]:
    return [value.clone() for value in trainer.learned.state_dict().values()]


def same(a: list[Tensor], b: list[Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))
