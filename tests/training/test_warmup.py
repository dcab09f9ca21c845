"""The warm-up, on a small contact system that needs no simulator."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv

from difflcs import LCSModel, violation_loss
from difflcs.errors import InvalidInputError
from difflcs.rl.learning.warmup import Warmup, WarmupSettings, action_support, fit
from difflcs.rl.rollout import collect, uniform_actions
from difflcs.rl.rollout import transitions as transitions_of
from difflcs.rl.seeding import episode_seeds
from difflcs.rl.settings import Epochs, Rollouts
from tests.training.pusher import STEPS, PusherEnv, Reach, make_envs


def small_settings(rollouts: Rollouts | None = None, epochs: Epochs | None = None, **changes: Any) -> WarmupSettings:
    base = WarmupSettings(
        rollouts=rollouts or Rollouts(first=2, each=3), noise=0.02, epochs=epochs or Epochs(20, 3, 16)
    )
    return replace(base, **changes)


def make_trainer(seed=0, **changes) -> Warmup:
    lcs = LCSModel(2, 1, 1, init_scale=1e-2, learn_c=False, generator=torch.Generator().manual_seed(seed))
    return Warmup(lcs, Reach(lcs), make_envs(3), small_settings(**changes), seed, STEPS)


def test_action_support():
    actions = torch.tensor([[[0.0, 0.09]], [[0.02, 0.09]], [[0.04, 0.06]]], dtype=torch.float64)
    limit = torch.full((2,), 0.1, dtype=torch.float64)
    low, high = action_support(actions, 0.9, -limit, limit)
    std = math.sqrt((0.02**2 + 0.02**2) / 3)  # population
    assert low[0].item() == pytest.approx(0.02 - 0.9 * std)
    assert high[0].item() == pytest.approx(0.02 + 0.9 * std)
    assert action_support(actions, 100.0, -limit, limit)[1].tolist() == limit.tolist()
    low, high = action_support(limit.expand(5, 2), 0.9, -limit, limit)  # one action: a point, not an empty box
    assert low.tolist() == pytest.approx(limit.tolist())
    assert bool((low <= high).all())


def test_bounds_while_collecting():
    trainer = make_trainer(action_support=0.5, action_support_growth=2.0)
    trainer.step()
    assert trainer.policy.bounds == []  # random actions
    seen = trainer.buffer["action"].clone()
    for growth in (1.0, 2.0):
        expected = action_support(seen, 0.5 * growth, trainer.low, trainer.high)
        trainer.policy.bounds.clear()
        trainer.step()
        assert all(torch.equal(a, b) for a, b in zip(trainer.policy.bounds[0], expected, strict=True))
        seen = trainer.buffer["action"].clone()
    off = make_trainer(action_support=0.0)
    off.step()
    off.step()
    assert off.bounds == (off.low, off.high)
    policy, most = Reach(off.lcs), torch.tensor([0.01]).double()
    policy.u_min, policy.u_max = -most, most  # narrower than the environment's
    own = Warmup(off.lcs, policy, make_envs(3), small_settings(action_support=9.0, noise=1.0), 0, STEPS)
    for _ in range(2):  # at random, then by the MPC with noise
        own.step()
    assert own.buffer["action"].abs().max() == most
    assert policy.bounds[-1] == (-most, most)


def test_the_model_keeps_the_last_bounds_if_it_is_to():
    trainer = make_trainer(keep_support=True)
    assert torch.equal(trainer.lcs.action_support, torch.stack([trainer.low, trainer.high]))
    for _ in range(3):
        trainer.step()
        assert torch.equal(trainer.lcs.action_support, torch.stack(trainer.bounds))
    assert bool((trainer.bounds[1] < trainer.high).all())
    resumed = make_trainer(seed=0, keep_support=True)
    resumed.load(trainer.state_dict())
    assert torch.equal(resumed.lcs.action_support, trainer.lcs.action_support)
    assert make_trainer().lcs.action_support is None


def test_a_pretrained_model_skips_the_random_episodes():
    lcs = LCSModel(2, 1, 1)
    trainer = Warmup(lcs, Reach(lcs), make_envs(3), small_settings(), 0, STEPS, pretrained=True)
    assert trainer.step().env_steps == 3 * STEPS
    assert len(trainer.policy.bounds) == STEPS


def transitions(episodes: int, seed: int) -> list[torch.Tensor]:
    """States, actions and next states of uniformly random episodes."""
    envs = make_envs(episodes)
    seeds = episode_seeds(seed, 0, 0, episodes)
    return [*transitions_of(collect(envs, uniform_actions(envs, np.random.default_rng(seed)), seeds, STEPS))]


def make_pusher_model(seed: int) -> LCSModel:
    # One contact would do; spare ones avoid local minima (of seeds 0 to 3, some stall with 1 or 2, none with 3).
    return LCSModel(2, 1, 3, init_scale=1e-3, learn_c=False, generator=torch.Generator().manual_seed(seed))


def test_fit_learns_contact():
    data = transitions(20, seed=0)
    lcs = make_pusher_model(0)
    settings = WarmupSettings(learning_rate_decay=0.998)
    before = float(violation_loss(lcs, *data, settings.loss.gamma, settings.loss.xi).detach())
    outcome = fit(lcs, *data, settings, epochs=300, rng=np.random.default_rng(0))
    assert outcome.steps == 300 * (160 // 100)  # 200 transitions, 20 % held out, whole minibatches
    assert max(outcome.loss, outcome.held_out_loss) < before / 100


def test_a_broken_episode_is_left_out():
    lcs = LCSModel(2, 1, 1, init_scale=1e-2)
    envs = SyncVectorEnv([lambda: PusherEnv(breaks_at=4), *[PusherEnv] * 2])
    trainer = Warmup(lcs, Reach(lcs), envs, small_settings(), 0, STEPS)
    assert trainer.step().unstable == 1
    assert bool(torch.isfinite(trainer.buffer["state"]).all())
    assert len(trainer.buffer) == 1


def test_too_few_environments_and_a_policy_with_another_model():
    lcs, other = LCSModel(2, 1, 1), LCSModel(2, 1, 1)
    for model, count, match in ((lcs, 2, "at least 3 environments, got 2"), (other, 3, "around the model that is")):
        with pytest.raises(InvalidInputError, match=match):
            Warmup(lcs, Reach(model), make_envs(count), small_settings(), 0, STEPS)
