"""Settings of the main phase, and PPO put together by them."""

from dataclasses import replace

import pytest
import torch

from difflcs.errors import DTypeError, InvalidInputError, NonFiniteError
from difflcs.rl.learning import ppo_settings
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.learning.policy import make_actor
from tests.conftest import refuse
from tests.training.slide import STEPS, U_MAX, features, make_envs, make_model, make_mpc, small_settings


def test_bad_arguments_are_refused():
    options = {"features": features, "total_episodes": 20, "episode_steps": STEPS}
    mpc, settings = make_mpc(make_model()), small_settings()
    actor, make = make_actor(mpc, settings.std), ppo_settings.make_ppo
    refuse(InvalidInputError, "at least 12 environments, got 3", make, actor, make_envs(3), settings, 0, **options)
    with pytest.raises(InvalidInputError, match="use an LCSModel"):
        make(make_actor(make_mpc(mpc.lcs.params().detach()), settings.std), make_envs(), settings, 0, **options)
    with pytest.raises(InvalidInputError, match="covariance='diagonal'"):
        make(actor, make_envs(), replace(settings, covariance="diagonal"), 0, **options)
    refuse(InvalidInputError, "shorten the warm-up", make, actor, make_envs(), settings, 0, **options, first_episode=20)
    refuse(DTypeError, r"use LCSMPCPolicy\(", make, mpc, make_envs(), settings, 0, **options)
    refuse(InvalidInputError, "env: expected a VectorEnv", make, actor, make_envs().envs[0], settings, 0, **options)
    ppo = make(actor, make_envs(), settings, 0, **options | {"features": lambda *seen: features(*seen) / 0})
    refuse(NonFiniteError, "features: expected finite", ppo.step)
    refuse(InvalidInputError, "std_range", replace, settings, std_range=(0.2, 0.1))
    bound = torch.full((1,), U_MAX)
    network = make_actor(MLPController(features, 3, -bound, bound, 4, STEPS), settings.std)
    for changes in ({}, {"update": "adam", "beta": 0.5}):
        with pytest.raises(InvalidInputError, match="without an LCS"):
            make(network, make_envs(), replace(settings, **changes), 0, **options)
    make(network, make_envs(), replace(settings, update="adam"), 0, **options)
