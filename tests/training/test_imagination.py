"""Imagined episodes: the environment that an ensemble plays, its data, and the outcomes of tasks against MuJoCo."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces

pytest.importorskip("gymnasium")
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl.dynamics import Ensemble
from difflcs.rl.imagination import Imagination, ImaginationConfig, ImaginedEnv
from difflcs.rl.rollout import collect, episode_seeds, uniform_actions
from difflcs.rl.tasks import get_task

pytestmark = pytest.mark.usefixtures("one_thread")

STEPS, N_X, N_U = 5, 2, 2
SPACES = SimpleNamespace(
    single_observation_space=spaces.Dict(
        {"state": spaces.Box(-9.0, 9.0, (N_X,), np.float64), "goal": spaces.Box(-1.0, 1.0, (1,), np.float64)}
    ),
    single_action_space=spaces.Box(-0.1, 0.1, (N_U,), np.float64),
)
SMALL = ImaginationConfig(iterations=1, rollouts=4, networks=2, width=16, first_epochs=3, epochs=2, minibatch=8)


def outcome(x, u, after, goal):
    return -x[:, 0].abs() - u.square().sum(-1), (after[:, :1] - goal).abs().squeeze(-1) < 0.5


class Drift(Ensemble):
    """x₊ = x + u + 0.01 · (number of the network)."""

    def forward(self, x, u):
        number = torch.arange(self.networks, dtype=x.dtype).view(-1, 1, 1)
        return x + u + 0.01 * number


def make_env(ensemble: Ensemble | None = None, num_envs: int = 3) -> ImaginedEnv:
    ensemble = ensemble or Drift(N_X, N_U, 2, 4)
    env = ImaginedEnv(ensemble, outcome, num_envs, STEPS, SPACES.single_observation_space, SPACES.single_action_space)
    states, _, goals = episodes()
    env.remember(states, goals)
    return env


def episodes(count: int = 6, seed: int = 0):
    """States, actions and goals of x₊ = x + u."""
    generator = torch.Generator().manual_seed(seed)
    goals = torch.rand(count, 1, generator=generator, dtype=torch.float64)
    actions = 0.2 * torch.rand(count, STEPS, N_U, generator=generator, dtype=torch.float64) - 0.1
    states = [torch.randn(count, N_X, generator=generator, dtype=torch.float64)]
    for k in range(STEPS):
        states.append(states[-1] + actions[:, k])
    return torch.stack(states, 1), actions, goals


# --- the environment --------------------------------------------------------------------------------


def test_steps_are_those_of_the_drawn_networks():
    env = make_env()
    observation, info = env.reset(seed=[4, 5, 6])
    assert info == {}
    action = np.full((3, N_U), 0.1)
    first, reward, terminated, truncated, info = env.step(action)
    moved = first["state"] - observation["state"]
    np.testing.assert_allclose(moved, 0.1 + 0.01 * env._networks[0][:, None].numpy().repeat(2, 1), atol=1e-6)
    np.testing.assert_allclose(reward, -abs(observation["state"][:, 0]) - 0.02, atol=1e-6)
    np.testing.assert_array_equal(info["success"], abs(first["state"][:, :1] - first["goal"])[:, 0] < 0.5)
    assert not terminated.any()
    assert not truncated.any()
    second = env.step(np.zeros((3, N_U)))[0]["state"] - first["state"]
    np.testing.assert_allclose(second, 0.01 * env._networks[1][:, None].numpy().repeat(2, 1), atol=1e-6)


def test_starts_and_goals_are_real_ones():
    states, _, goals = episodes()
    observation, _ = make_env(num_envs=40).reset(seed=0)
    starts = {tuple(row) for row in states[:, 0].tolist()}
    assert {tuple(row) for row in observation["state"].tolist()} <= starts
    assert {row[0] for row in observation["goal"].tolist()} <= {row[0] for row in goals.tolist()}
    assert len({tuple(row) for row in observation["state"].tolist()}) > 3


def test_an_episode_depends_on_its_seed_only():
    def play(seeds):
        env = make_env(num_envs=len(seeds))
        seen = [env.reset(seed=seeds)[0]["state"]]
        seen += [env.step(np.full((len(seeds), N_U), 0.05))[0]["state"] for _ in range(STEPS)]
        return np.stack(seen, 1)

    together, other = play([11, 12, 13]), play([13, 11])
    np.testing.assert_array_equal(together[[2, 0]], other)
    assert not np.array_equal(together[0], together[1])


def test_episodes_end_together_and_begin_anew():
    env = make_env()
    env.reset(seed=1)
    ends = [env.step(np.zeros((3, N_U)))[3].all() for _ in range(STEPS)]
    assert ends == [False] * (STEPS - 1) + [True]
    observation, reward, _, truncated, _ = env.step(np.ones((3, N_U)))  # the action is ignored
    assert not reward.any()
    assert not truncated.any()
    starts = episodes()[0][:, 0].tolist()
    assert all(row in starts for row in observation["state"].tolist())


def test_collect_plays_it():
    env = make_env()
    rollouts = collect(env, uniform_actions(env, np.random.default_rng(0)), [1, 2], STEPS)
    assert rollouts.states.shape == (2, STEPS + 1, N_X)
    assert bool(rollouts.stable.all())


def test_predictions_stay_near_the_data_and_finite():
    class Broken(Ensemble):
        def forward(self, x, u):
            return torch.stack([torch.full_like(x[0], float("nan")), x[1] + 1e9])

    env = make_env(Broken(N_X, N_U, 2, 4), num_envs=20)
    start, _ = env.reset(seed=3)
    state = env.step(np.zeros((20, N_U)))[0]["state"]
    drawn = env._networks[0].numpy()
    np.testing.assert_array_equal(state[drawn == 0], start["state"][drawn == 0])
    seen = episodes()[0].flatten(0, 1)
    high = 2 * seen.amax(0) - seen.amin(0)
    np.testing.assert_allclose(state[drawn == 1], high.expand(20, -1)[drawn == 1])


def test_nothing_can_be_imagined_of_nothing():
    env = Imagination(SPACES, outcome, SMALL, 0, STEPS).env
    with pytest.raises(InvalidInputError, match="expected real episodes, got none"):
        env.reset(seed=0)


# --- data and ensemble ------------------------------------------------------------------------------


def test_the_ensemble_learns_the_episodes():
    imagination = Imagination(SPACES, outcome, replace(SMALL, width=64, first_epochs=150), 0, STEPS)
    imagination.add(*episodes(60))
    imagination.fit()
    states, actions, _ = episodes(20, seed=5)
    inputs = (states[:, :-1], actions)
    with torch.no_grad():
        predicted = imagination.ensemble(*(v.flatten(0, 1).float().expand(2, -1, -1) for v in inputs)).mean(0)
    changes = (states[:, 1:] - states[:, :-1]).flatten(0, 1)
    error = predicted - states[:, 1:].flatten(0, 1)
    assert float(error.square().mean()) < 0.05 * float(changes.square().mean())


def test_restored_goes_on_the_same():
    first = Imagination(SPACES, outcome, SMALL, 0, STEPS)
    first.add(*episodes())
    first.fit()
    second = Imagination(SPACES, outcome, SMALL, 0, STEPS)
    second.restore(first.tensors(), first.fits)
    assert len(second) == 6
    for imagination in (first, second):
        imagination.add(*episodes(3, seed=9))
        imagination.fit()
    for a, b in zip(first.tensors().values(), second.tensors().values(), strict=True):
        assert torch.equal(a, b)
    np.testing.assert_array_equal(first.env.reset(seed=2)[0]["state"], second.env.reset(seed=2)[0]["state"])


def test_restore_refuses_what_does_not_fit():
    imagination = Imagination(SPACES, outcome, SMALL, 0, STEPS)
    imagination.add(*episodes())
    other = Imagination(SPACES, outcome, replace(SMALL, width=8), 0, STEPS)
    with pytest.raises(CheckpointError, match="other settings"):
        other.restore(imagination.tensors(), 0)
    tensors = imagination.tensors()
    with pytest.raises(CheckpointError, match="goals"):
        imagination.restore({k: v for k, v in tensors.items() if k != "goals"}, 0)
    assert not len(other)


@pytest.mark.parametrize(
    "change",
    [
        {"iterations": -1},
        {"rollouts": 0},
        {"networks": 0},
        {"learning_rate": 0.0},
        {"real_step": 0.0},
        {"final_iterations": -1},
        {"steps_minibatch": 0},
        {"actions": 0},
        {"actions": 3},
        {"zeta": 1.1},
    ],
)
def test_bad_settings_are_refused(change):
    with pytest.raises(InvalidInputError, match=next(iter(change))):
        replace(SMALL, **change)


# --- the tasks --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cube", "turn_cube", "mug"])
def test_outcomes_are_those_of_the_simulation(name, monkeypatch):
    pytest.importorskip("mujoco", reason="the extra [envs] is not installed")
    import gymnasium

    import difflcs_envs

    monkeypatch.delenv("DIFFLCS_YCB_DIR", raising=False)
    difflcs_envs.register_envs()
    task = get_task(name)
    env = gymnasium.make_vec(task.env_id, num_envs=20, **dict(task.env_kwargs))
    seeds = episode_seeds(3, 0, 0, 20)
    rollouts = collect(env, uniform_actions(env, np.random.default_rng(0)), seeds, task.episode_steps)
    env.close()
    goals = rollouts.goals.unsqueeze(1).expand(-1, task.episode_steps, -1)
    reward, success = task.outcome(rollouts.states[:, :-1], rollouts.actions, rollouts.states[:, 1:], goals)
    torch.testing.assert_close(reward, rollouts.rewards, rtol=1e-9, atol=1e-12)
    assert torch.equal(success[:, -1], rollouts.success)
    if name == "turn_cube":
        assert bool(rollouts.success.any())  # or the comparison says little
