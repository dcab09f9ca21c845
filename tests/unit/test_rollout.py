"""Episodes in lockstep, on a small contact system that needs no simulator."""

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from difflcs import solve_lcp
from difflcs.errors import InvalidInputError
from difflcs.rl.rollout import (
    append_episodes,
    collect,
    make_empty_record,
    mpc_actions,
    noisy_actions,
    transitions,
    uniform_actions,
)
from difflcs.rl.seeding import episode_seeds
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
    x, u = rollouts["state"][:, :-1], rollouts["action"]
    lam = solve_lcp(params.F, params.gap(x, u)).lam
    torch.testing.assert_close(params.next_state(x, u, lam), rollouts["state"][:, 1:])  # no reset between two steps
    torch.testing.assert_close(
        rollouts["errors", "position_error"], (rollouts["state"][:, -1, :1] - rollouts["goal"]).abs()[:, 0]
    )


def test_episodes_depend_on_their_seed_only():
    together = collect(make_envs(4), mpc_actions(Reach()), [7, 8, 9], STEPS)
    env = make_envs(2)
    for _ in range(2):  # used environments start afresh
        alone = [collect(env, mpc_actions(Reach()), [seed], STEPS) for seed in (7, 8, 9)]
    assert torch.equal(together["state"], torch.cat([one["state"] for one in alone]))
    assert torch.equal(together["goal"], torch.cat([one["goal"] for one in alone]))
    assert len(set(episode_seeds(0, 0, 0, 50) + episode_seeds(0, 1, 0, 50) + episode_seeds(1, 0, 0, 50))) == 150
    assert episode_seeds(0, 1, 3, 2) == episode_seeds(0, 1, 0, 5)[3:]


def test_a_broken_simulation_is_counted_not_fatal():
    env = SyncVectorEnv([lambda: PusherEnv(breaks_at=4), PusherEnv])
    rollouts = collect(env, mpc_actions(Reach()), [1, 2], STEPS)
    assert rollouts["stable"].tolist() == [False, True]
    assert not rollouts["success"][0]


@pytest.mark.parametrize(("length", "got"), [(STEPS - 1, f"one of {STEPS - 1}"), (STEPS + 1, "a longer one")])
def test_episodes_of_another_length_are_refused(length, got):
    with pytest.raises(InvalidInputError, match=f"episodes of {STEPS} steps, got {got}"):
        collect(make_envs(2, length=length), mpc_actions(Reach()), [1, 2], STEPS)


def test_same_step_autoreset_is_refused():
    env = SyncVectorEnv([PusherEnv], autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(InvalidInputError, match="autoreset"):
        collect(env, mpc_actions(Reach()), [1], STEPS)
    with pytest.raises(InvalidInputError, match="num_envs=1"):
        collect(make_envs(1), mpc_actions(Reach()), [1, 2], STEPS)


def test_a_record_has_one_row_per_episode():
    env = make_envs(2)
    record = collect(env, uniform_actions(env, np.random.default_rng(0)), [1, 2], STEPS)
    assert tuple(record.batch_size) == (2,)
    assert set(record.keys()) == {"state", "action", "reward", "goal", "success", "stable", "failures", "errors"}
    assert record["reward"].shape == (2, STEPS)
    torch.testing.assert_close(record["reward"][:, -1], -record["errors", "position_error"])
    x, u, x_next = transitions(record)
    assert torch.equal(x[STEPS:], record["state"][1, :-1])
    assert torch.equal(u[:STEPS], record["action"][0])
    assert torch.equal(x_next[:STEPS], record["state"][0, 1:])


def test_records_are_extended_by_stable_episodes_and_keep_the_newest():
    env = SyncVectorEnv([lambda: PusherEnv(breaks_at=4), PusherEnv])
    known = make_empty_record(env, STEPS)
    assert len(known) == 0
    record = collect(env, mpc_actions(Reach()), [1, 2], STEPS)
    known = append_episodes(known, record)
    assert torch.equal(known["state"], record["state"][1:])
    later = collect(make_envs(2), mpc_actions(Reach()), [3, 4], STEPS)
    assert torch.equal(append_episodes(known, later, keep=2)["goal"], later["goal"])
    assert len(append_episodes(known, later)) == 3
    with pytest.raises(InvalidInputError, match="stable simulation"):
        append_episodes(make_empty_record(env, STEPS), record[:1])


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
    with pytest.raises(InvalidInputError, match=match):
        collect(SyncVectorEnv([Told]), mpc_actions(Reach()), [1], STEPS)
