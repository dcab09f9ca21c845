"""Episodes in lockstep, on a small contact system that needs no simulator."""

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from difflcs import solve_lcp
from difflcs.errors import InvalidInputError
from difflcs.rl.rollout import append_episodes, collect, make_empty_record, mpc_actions, noisy_actions, transitions
from tests.conftest import refuse
from tests.training.pusher import STEPS, U_MAX, PusherEnv, Reach, make_envs, pusher


def test_collect_returns_what_happened():
    env = make_envs(3)
    rng = np.random.default_rng(0)
    rollouts = collect(env, noisy_actions(mpc_actions(Reach()), 0.5, rng), [1, 2, 3], STEPS)
    assert rollouts["state"].shape == (3, STEPS + 1, 2)
    assert rollouts["action"].shape == (3, STEPS, 1)
    assert rollouts["failures"].tolist() == [0, 0, STEPS]  # the third of three, at each step
    assert bool((rollouts["action"].abs() <= U_MAX).all())  # stored as executed, not as noised
    assert bool((rollouts["action"].abs() == U_MAX).any())
    params = pusher()
    x, u, x_next = transitions(rollouts)
    assert torch.equal(x.view(3, STEPS, 2), rollouts["state"][:, :-1])
    lam = solve_lcp(params.F, params.gap(x, u)).lam
    torch.testing.assert_close(params.next_state(x, u, lam), x_next)  # no reset between two steps
    torch.testing.assert_close(
        rollouts["errors", "position_error"], (rollouts["state"][:, -1, :1] - rollouts["goal"]).abs()[:, 0]
    )


@pytest.mark.parametrize(("length", "got"), [(STEPS - 1, f"one of {STEPS - 1}"), (STEPS + 1, "a longer one")])
def test_episodes_of_another_length_are_refused(length, got):
    with pytest.raises(InvalidInputError, match=f"episodes of {STEPS} steps, got {got}"):
        collect(make_envs(2, length=length), mpc_actions(Reach()), [1, 2], STEPS)


def test_same_step_autoreset_is_refused():
    env = SyncVectorEnv([PusherEnv], autoreset_mode=AutoresetMode.SAME_STEP)
    refuse(InvalidInputError, "autoreset", collect, env, mpc_actions(Reach()), [1], STEPS)
    refuse(InvalidInputError, "num_envs=1", collect, make_envs(1), mpc_actions(Reach()), [1, 2], STEPS)


def test_records_are_extended_by_stable_episodes_and_keep_the_newest():
    env = SyncVectorEnv([lambda: PusherEnv(breaks_at=4), PusherEnv])
    known = make_empty_record(env, STEPS)
    assert len(known) == 0
    record = collect(env, mpc_actions(Reach()), [1, 2], STEPS)
    assert record["stable"].tolist() == [False, True]
    assert not record["success"][0]
    known = append_episodes(known, record)
    assert torch.equal(known["state"], record["state"][1:])
    later = collect(make_envs(2), mpc_actions(Reach()), [3, 4], STEPS)
    assert torch.equal(append_episodes(known, later, keep=2)["goal"], later["goal"])
    assert len(append_episodes(known, later)) == 3
    refuse(InvalidInputError, "stable simulation", append_episodes, make_empty_record(env, STEPS), record[:1])


@pytest.mark.parametrize(
    ("reward", "info", "match"),
    [(1.0, {}, "`success`")]
    + [(1.0, {"success": value}, "True or False") for value in ("no", 0.3, np.nan, [1])]
    + [(value, {"success": True}, "finite rewards, got .* in step 1") for value in (-np.inf, np.nan)]
    + [(1.0, {"success": value}, None) for value in (True, np.True_, 1, np.float32(1))],
)
def test_an_environment_must_say_whether_it_succeeded_and_what_it_earned(reward, info, match):
    class Told(PusherEnv):
        def step(self, action):
            observation, _, *ended, _ = super().step(action)
            return observation, reward, *ended, info

    if match is None:
        assert bool(collect(SyncVectorEnv([Told]), mpc_actions(Reach()), [1], STEPS)["success"])
        return
    refuse(InvalidInputError, match, collect, SyncVectorEnv([Told]), mpc_actions(Reach()), [1], STEPS)
