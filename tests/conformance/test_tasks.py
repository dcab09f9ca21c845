"""What every task has in common: its numbers are those of its environment, whoever asks."""

import json

import gymnasium
import numpy as np
import pytest
import torch

from difflcs import LCSModel
from difflcs.rl.rollout import collect, mpc_actions, uniform_actions
from difflcs.rl.tasks import get_task, task_names
from difflcs_envs.tasks import MOVE, trifinger_task
from tests.conformance.toy import make_task

OTHER_NUMBERS = [  # of an environment: model rollouts learn from what its task says
    {"reward_weights": {"tips": 0.0, "action": 100.0}, "sparse_penalty": 3.0, "horizon": 3},
    {"position_tolerance": 0.5, "yaw_tolerance": 3.0, "sparse_penalty": 3.0, "horizon": 4},
]
TASKS = {**{name: get_task(name) for name in task_names()}, "toy": make_task("conformance-toy")}
TASKS |= {
    f"other numbers {i}": trifinger_task("own", "TriFingerMoveCube-v0", MOVE, "Own.", ((0.0, 0.0, 0.0),), **numbers)
    for i, numbers in enumerate(OTHER_NUMBERS)
}


pytestmark = pytest.mark.usefixtures("stand_ins")


@pytest.fixture(scope="module", params=TASKS)
def task(request, stand_ins):
    return TASKS[request.param]


@pytest.fixture(scope="module")
def env(task):
    made = task.make_env()
    yield made
    made.close()


def test_sizes_and_bounds_are_those_of_the_spaces(task, env):
    assert env.observation_space["state"].shape == (task.n_x,)
    assert env.observation_space["goal"].shape == (task.n_goal,)
    assert env.action_space.shape == (task.n_u,)
    for space in (*env.observation_space.values(), env.action_space):
        assert space.dtype == np.float64
    for bound, own in zip(task.bounds, (env.action_space.low, env.action_space.high), strict=True):
        np.testing.assert_array_equal(bound, own)
    assert len(task.goal) in (0, task.n_goal)


def test_the_outcome_is_what_a_step_gives(task, env):
    """Over an episode of random actions, the last step included, for arrays and tensors."""
    rng = np.random.default_rng(0)
    before, _ = env.reset(seed=0)
    low, high = (bound.numpy() for bound in task.bounds)
    steps = []
    for step in range(task.episode_steps):
        action = rng.uniform(low, high)
        after, reward, terminated, truncated, info = env.step(action)
        assert not terminated
        assert truncated == (step + 1 == task.episode_steps)
        executed = info.get("executed_action", action)
        judged = task.outcome(before["state"], executed, after["state"], before["goal"], truncated)
        assert judged == (reward, info["success"])
        assert {q.name for q in task.errors} <= set(info)
        steps.append((before["state"], executed, after["state"], before["goal"], np.asarray(truncated)))
        before = after
    arrays = [np.stack(part) for part in zip(*steps, strict=True)]
    rewards, successes = task.outcome(*arrays)
    found, success = task.outcome(*map(torch.from_numpy, arrays))
    assert isinstance(found, torch.Tensor)
    np.testing.assert_allclose(found, rewards, rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(success, successes)
    many = [torch.from_numpy(part).expand(2, *part.shape) for part in arrays]
    assert torch.equal(task.outcome(*many)[0], found.expand(2, -1))


def test_only_the_end_costs_the_penalty(task):
    rng = np.random.default_rng(1)
    sizes = (task.n_x, task.n_u, task.n_x, task.n_goal)
    step = [rng.uniform(-1, 1, (20, size)) for size in sizes]
    (going, success), (ended, again) = task.outcome(*step, False), task.outcome(*step, True)
    np.testing.assert_array_equal(success, again)
    np.testing.assert_allclose(going - ended, task.failure_penalty * ~success, rtol=0, atol=1e-9)


def test_the_reward_has_a_gradient_and_is_mapped(task, env):
    start, goal = (torch.from_numpy(env.reset(seed=0)[0][key]) for key in ("state", "goal"))
    generator, around = torch.Generator().manual_seed(0), (start, torch.zeros(task.n_u).double(), start)
    step = [v + 0.05 * torch.randn(3, len(v), generator=generator, dtype=torch.float64) for v in around]
    step, ends = [v.requires_grad_() for v in step], torch.arange(3) % 2 == 0
    assert torch.autograd.gradcheck(lambda *step: task.outcome(*step, goal, ends)[0], step)
    mapped = torch.func.vmap(task.outcome, (0, 0, 0, None, 0))(*step, goal, ends)
    for found, expected in zip(mapped, task.outcome(*step, goal, ends), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_features_are_finite_and_as_many_as_it_says(task, env):
    observations = [env.reset(seed=seed)[0] for seed in range(5)]
    state, goal = (torch.from_numpy(np.stack([o[key] for o in observations])) for key in ("state", "goal"))
    elapsed = torch.linspace(0, 1, 5, dtype=torch.float64)
    found = task.features(state, goal, elapsed)
    assert found.shape == (5, task.n_features)
    assert found.dtype == torch.float64
    assert bool(torch.isfinite(found).all())
    assert float(found.abs().max()) < 100  # scaled to about one
    torch.testing.assert_close(task.features(state[3], goal[3], elapsed[3]), found[3])
    assert not torch.equal(
        task.features(state[:1], goal[:1], elapsed[:1]), task.features(state[:1], goal[:1], elapsed[4:])
    )


def test_example_goals_can_be_chosen_and_pictures_say_something(task, env):
    assert task.example_goals
    for goal in task.example_goals:
        assert env.observation_space["goal"].contains(np.array(goal, np.float64))
        observation, info = env.reset(seed=0, options={"goal": goal})
        np.testing.assert_array_equal(observation["goal"], goal)
        assert isinstance(task.say(info), str)
        assert task.say(info)
    assert task.summary.endswith(".")


def test_everything_random_comes_from_the_seed(task):
    def episode(seed: int) -> torch.Tensor:
        envs = task.make_envs(1)
        record = collect(envs, uniform_actions(envs, np.random.default_rng(0)), [seed], task.episode_steps)
        envs.close()
        return torch.cat([record["state"].flatten(), record["goal"].flatten()])

    assert torch.equal(episode(1), episode(1))
    assert not torch.equal(episode(1), episode(2))


def test_it_is_described_in_json_through_wrappers_and_vectors(task, env):
    found = dict(task.describe(env))
    assert json.loads(json.dumps(found)) == found
    vectors = [task.make_envs(2), gymnasium.vector.SyncVectorEnv([task.make_env] * 2)]
    wrapped = gymnasium.wrappers.vector.RecordEpisodeStatistics(task.make_envs(2))
    for one in (env.unwrapped, *vectors, wrapped):
        assert dict(task.describe(one)) == found
    for envs in (*vectors, wrapped):
        envs.close()


def test_the_policy_of_a_random_model_acts(task):
    model = LCSModel(task.n_x, task.n_u, 2, init_scale=1e-2, generator=torch.Generator().manual_seed(0))
    envs = task.make_envs(2)
    record = collect(envs, mpc_actions(task.make_policy(model)), [1, 2], task.episode_steps)
    envs.close()
    low, high = task.bounds
    assert bool(((record["action"] >= low) & (record["action"] <= high)).all())
    assert bool(record["stable"].all())
    torch.testing.assert_close(record["errors"][task.errors[0].name] >= 0, torch.ones(2, dtype=torch.bool))
