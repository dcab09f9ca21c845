"""Model rollouts: the environment that an ensemble plays, its data, and the outcomes of tasks against MuJoCo."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict

from difflcs.errors import DiffLCSWarning, InvalidInputError
from difflcs.rl import EnsembleSettings, Epochs, ModelRollouts, ModelRolloutSettings
from difflcs.rl.learning.dynamics import Ensemble
from difflcs.rl.learning.model_rollouts import ModelEnv
from tests.conftest import refuse

STEPS, N_X, N_U = 5, 2, 2
SPACES = SimpleNamespace(
    single_observation_space=spaces.Dict(
        {"state": spaces.Box(-9.0, 9.0, (N_X,), np.float64), "goal": spaces.Box(-1.0, 1.0, (1,), np.float64)}
    ),
    single_action_space=spaces.Box(-0.1, 0.1, (N_U,), np.float64),
)


def small(width: int = 16, first: int = 3, minibatch: int = 8) -> ModelRolloutSettings:
    ensemble = EnsembleSettings(networks=2, width=width, epochs=Epochs(first=first, each=2, minibatch=minibatch))
    return ModelRolloutSettings(iterations=1, rollouts=4, ensemble=ensemble)


def make_rollouts(**changes) -> ModelRollouts:
    return ModelRollouts(SPACES, outcome, small(**changes), 0, STEPS)


def outcome(x, u, after, goal, ended):
    success = (after[:, :1] - goal).abs().squeeze(-1) < 0.5
    return -x[:, 0].abs() - u.square().sum(-1) - 3.0 * (ended & ~success), success


class Drift(Ensemble):
    """x₊ = x + u + 0.01 · (number of the network)."""

    def forward(self, x, u):
        number = torch.arange(self.networks, dtype=x.dtype).view(-1, 1, 1)
        return x + u + 0.01 * number


def make_env(ensemble: Ensemble | None = None, num_envs: int = 3) -> ModelEnv:
    ensemble = ensemble or Drift(N_X, N_U, 2, 4)
    env = ModelEnv(ensemble, outcome, num_envs, STEPS, SPACES.single_observation_space, SPACES.single_action_space)
    real = episodes()
    env.set_episodes(real["state"], real["goal"])
    return env


def episodes(count: int = 6, seed: int = 0) -> TensorDict:
    """Of x₊ = x + u."""
    generator = torch.Generator().manual_seed(seed)
    goals = torch.rand(count, 1, generator=generator, dtype=torch.float64)
    actions = 0.2 * torch.rand(count, STEPS, N_U, generator=generator, dtype=torch.float64) - 0.1
    states = [torch.randn(count, N_X, generator=generator, dtype=torch.float64)]
    for k in range(STEPS):
        states.append(states[-1] + actions[:, k])
    return TensorDict({"state": torch.stack(states, 1), "action": actions, "goal": goals}, [count])


def drawn(seed: int) -> np.ndarray:
    """(STEPS,) the networks that predict the episode of a seed, which draws start and goal before them."""
    rng = np.random.default_rng(seed)
    rng.integers(6), rng.integers(6)
    return rng.integers(2, size=STEPS)


def test_steps_are_those_of_the_drawn_networks():
    env = make_env()
    observation, info = env.reset(seed=[4, 5, 6])
    networks = np.stack([drawn(seed) for seed in (4, 5, 6)])
    assert set(networks[:, :2].flatten()) == {0, 1}
    assert info == {}
    action = np.full((3, N_U), 0.1)
    first, reward, terminated, truncated, info = env.step(action)
    moved = first["state"] - observation["state"]
    np.testing.assert_allclose(moved, 0.1 + 0.01 * networks[:, :1].repeat(2, 1), atol=1e-6)
    np.testing.assert_allclose(reward, -abs(observation["state"][:, 0]) - 0.02, atol=1e-6)
    np.testing.assert_array_equal(info["success"], abs(first["state"][:, :1] - first["goal"])[:, 0] < 0.5)
    assert not terminated.any()
    assert not truncated.any()
    second = env.step(np.zeros((3, N_U)))[0]["state"] - first["state"]
    np.testing.assert_allclose(second, 0.01 * networks[:, 1:2].repeat(2, 1), atol=1e-6)


def test_episodes_end_together_and_begin_anew():
    env = make_env()
    env.reset(seed=1)
    ends = [env.step(np.zeros((3, N_U)))[3].all() for _ in range(STEPS)]
    assert ends == [False] * (STEPS - 1) + [True]
    observation, reward, _, truncated, _ = env.step(np.ones((3, N_U)))  # the action is ignored
    assert not reward.any()
    assert not truncated.any()
    starts = episodes()["state"][:, 0].tolist()
    assert all(row in starts for row in observation["state"].tolist())


def test_predictions_stay_near_the_data_and_finite():
    class Broken(Ensemble):
        def forward(self, x, u):
            return torch.stack([torch.full_like(x[0], float("nan")), x[1] + 1e9])

    env = make_env(Broken(N_X, N_U, 2, 4), num_envs=20)
    start, _ = env.reset(seed=list(range(20)))
    state = env.step(np.zeros((20, N_U)))[0]["state"]
    networks = np.array([drawn(seed)[0] for seed in range(20)])
    np.testing.assert_array_equal(state[networks == 0], start["state"][networks == 0])
    seen = episodes()["state"].flatten(0, 1)
    high = 2 * seen.amax(0) - seen.amin(0)
    np.testing.assert_allclose(state[networks == 1], high.expand(20, -1)[networks == 1])


def test_nothing_can_be_played_from_nothing():
    env = make_rollouts().env
    refuse(InvalidInputError, "expected real episodes, got none", env.reset, seed=0)


def test_foreseen_is_what_was_played():
    env = make_env()
    state = torch.from_numpy(env.reset(seed=[4, 5, 6])[0]["state"])
    generator = torch.Generator().manual_seed(0)
    actions = 0.2 * torch.rand(3, STEPS, 2, N_U, generator=generator, dtype=torch.float64) - 0.1
    states, rewards, successes = [state], [], []
    for k in range(STEPS):
        observation, reward, _, _, info = env.step(actions[:, k, 0].numpy())
        states.append(torch.from_numpy(observation["state"]))
        rewards.append(torch.from_numpy(reward))
        successes.append(torch.from_numpy(info["success"]))
    played = torch.stack(states, 1)
    goals = torch.from_numpy(observation["goal"])
    after, reward, success = env.predict_alternatives(played[:, :-1], actions, goals)
    assert after.shape == (3, STEPS, 2, N_X)
    torch.testing.assert_close(after[:, :, 0], played[:, 1:])
    torch.testing.assert_close(reward[:, :, 0], torch.stack(rewards, 1))
    assert torch.equal(success[:, :, 0], torch.stack(successes, 1))
    moved = after[:, :, 1] - after[:, :, 0]  # by the same network, from the same state
    torch.testing.assert_close(moved, actions[:, :, 1] - actions[:, :, 0], rtol=0, atol=1e-6)
    ended = (torch.arange(STEPS) == STEPS - 1).expand(3, -1).flatten()
    other = (part.flatten(0, 1) for part in (played[:, :-1], actions[:, :, 1], after[:, :, 1]))
    expected, reached = outcome(*other, goals.repeat_interleave(STEPS, 0), ended)
    torch.testing.assert_close(reward[:, :, 1].flatten(), expected)
    assert torch.equal(success[:, :, 1].flatten(), reached)


def test_the_first_fit_takes_epochs_of_its_own(monkeypatch):
    rollouts, taken = make_rollouts(first=3), []
    monkeypatch.setattr(rollouts.ensemble, "fit", lambda *_, epochs, **__: taken.append(epochs) or 0.0)
    rollouts.add(episodes())
    for _ in range(3):
        rollouts.fit()
    assert taken == [3, 2, 2]


def test_unstable_episodes_are_not_learned_from_and_another_outcome_is_told():
    models = ModelRollouts(SPACES, lambda x, *_: (x[:, 0], x[:, 0] < 9), small(), 0, STEPS)
    real, yes = episodes(), torch.ones(6, dtype=torch.bool)
    stable = torch.tensor([True, False, True, True, False, True])
    real = TensorDict({**real, "reward": real["state"][:, :-1, 0], "success": yes, "stable": stable}, [6])
    models.add(real)  # a warning would be an error
    assert torch.equal(models.episodes["state"], real["state"][stable])
    for name, other in ("reward", real["reward"] + 1), ("success", ~yes):
        with pytest.warns(DiffLCSWarning, match="another task"):
            models.add(TensorDict({**real, name: other}, [6]))
    for wrong in (None, real["reward"], (real["reward"], yes)):
        models = ModelRollouts(SPACES, lambda *_, wrong=wrong: wrong, small(), 0, STEPS)
        refuse(InvalidInputError, r"outcome: expected rewards and successes .*got .*; mend", models.add, real)
