"""The vector environment, and TorchRL."""

import multiprocessing
import pickle
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.mujoco.utils import check_mujoco_reset_state
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import difflcs_envs
from difflcs_envs.vector import TriFingerVectorEnv, move_cube
from tests.conftest import refuse

CUBE, OBJECT, TURN = (f"difflcs/TriFinger{name}-v0" for name in ("MoveCube", "MoveObject", "TurnCube"))
OBJECT_ARGUMENTS = {"object": "clamp", "object_source": "stand_in"}
TASKS = [(CUBE, {}), (OBJECT, OBJECT_ARGUMENTS), (TURN, {"observe_time": True})]


def assert_same(one, other):
    assert set(one) == set(other)
    for name in one:
        assert one[name].dtype == other[name].dtype, name
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


@pytest.mark.parametrize(("env_id", "arguments"), [*TASKS, ("difflcs/HandTurnObject-v0", {"object": "house"})])
def test_checkers(env_id, arguments):
    env = gymnasium.make(env_id, **arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)
        check_mujoco_reset_state(env.unwrapped)


@pytest.mark.parametrize(("env_id", "arguments"), TASKS)
def test_same_as_single_environments_bit_for_bit(env_id, arguments):
    """Gymnasium's own vector steps single environments one by one, and is taken for resets in the same step."""
    ours = gymnasium.make_vec(env_id, num_envs=3, **arguments)
    assert isinstance(ours, TriFingerVectorEnv)
    assert ours.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    refuse(ValueError, "gymnasium.make_vec", TriFingerVectorEnv, ours.envs[0], 3, AutoresetMode.SAME_STEP)
    theirs = gymnasium.make_vec(env_id, num_envs=3, vectorization_mode="sync", **arguments)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    seeds = [7, 3, 11]
    a, b = ours.reset(seed=seeds), theirs.reset(seed=seeds)
    assert_same(a[0], b[0])
    assert_same(a[1], b[1])
    rng = np.random.default_rng(0)
    for _ in range(43):
        actions = rng.uniform(-0.02, 0.02, (3, 6))
        a, b = ours.step(actions), theirs.step(actions)
        assert_same(a[0], b[0])
        for x, y in zip(a[1:4], b[1:4], strict=True):
            np.testing.assert_array_equal(x, y)
            assert x.dtype == y.dtype
        assert_same(a[4], b[4])
    ours.close()
    at_once = gymnasium.make_vec(env_id, num_envs=2, autoreset_mode=AutoresetMode.SAME_STEP, horizon=1, **arguments)
    at_once.reset(seed=0)
    assert "final_obs" in at_once.step(np.zeros((2, 6)))[4]


def test_threads_and_place_in_the_vector_change_nothing():
    actions = np.random.default_rng(0).uniform(-0.015, 0.015, (20, 6))

    def states(num_envs, threads, place):
        envs = move_cube(num_envs, threads=threads)
        seeds = [5] * num_envs
        envs.reset(seed=seeds)
        for action in actions:
            batch = np.zeros((num_envs, 6))
            batch[place] = action
            last = envs.step(batch)[0]["state"][place]
        return last

    expected = states(1, 1, 0)
    for num_envs, threads, place in ((3, 1, 2), (3, 4, 0), (7, 2, 5)):
        np.testing.assert_array_equal(states(num_envs, threads, place), expected)


def _step_after_fork(envs, queue):
    queue.put(envs.step(np.full((4, 6), 0.003))[0]["state"])


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_threads_survive_a_fork():
    envs = move_cube(4, threads=2)
    envs.reset(seed=0)
    context = multiprocessing.get_context("fork")
    envs.step(np.zeros((4, 6)))  # the threads exist now
    queue = context.Queue()
    process = context.Process(target=_step_after_fork, args=(envs, queue))
    process.start()
    states = queue.get(timeout=20)
    process.join(timeout=20)
    np.testing.assert_array_equal(states, envs.step(np.full((4, 6), 0.003))[0]["state"])


def test_disabled_autoreset_needs_a_mask():
    envs = move_cube(3, horizon=2, autoreset_mode="Disabled")
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros((3, 6)))
    envs.reset(seed=0)
    envs.step(np.full((3, 6), 0.01))
    mask = np.array([False, True, False])
    before = envs.step(np.full((3, 6), 0.01))[0]
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros((3, 6)))
    observation, infos = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(observation["state"][~mask], before["state"][~mask])
    assert not np.array_equal(observation["state"][1], before["state"][1])
    assert infos["_success"].tolist() == mask.tolist()
    for bad in ([True, True], np.zeros(3, bool), np.ones(3)):
        refuse(ValueError, "reset_mask", envs.reset, options={"reset_mask": bad})


def test_goal_and_state_options_reach_every_environment():
    envs = move_cube(2)
    goal = [0.01, -0.02, 0.3]
    np.testing.assert_allclose(envs.reset(seed=0, options={"goal": goal})[0]["goal"], [goal, goal])
    refuse(ValueError, "task space", envs.reset, options={"goal": [1, 0, 0]})


def test_instability_stays_in_its_lane(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT
    envs, calm = move_cube(3), move_cube(3)
    for env in (envs, calm):
        env.reset(seed=0)
        env.step(np.zeros((3, 6)))
    envs.envs[1].data.qvel[0] = np.nan
    with pytest.warns(difflcs_envs.PhysicsWarning, match=r"environments \[1\]"):
        observation, rewards, _, truncated, infos = envs.step(np.zeros((3, 6)))
    expected = calm.step(np.zeros((3, 6)))[0]["state"]
    np.testing.assert_array_equal(observation["state"][[0, 2]], expected[[0, 2]])
    assert np.isfinite(observation["state"]).all()
    assert np.isfinite(rewards).all()
    assert infos["physics_error"].tolist() == truncated.tolist() == [False, True, False]
    assert not envs.step(np.zeros((3, 6)))[4]["physics_error"].any()


def test_copies_continue_alike():
    envs = move_cube(3)
    envs.reset(seed=0)
    envs.step(np.full((3, 6), 0.01))
    copied = pickle.loads(pickle.dumps(envs))
    for _ in range(21):
        one, other = envs.step(np.full((3, 6), -0.01)), copied.step(np.full((3, 6), -0.01))
        assert_same(one[0], other[0])


@pytest.mark.parametrize("arguments", [{"num_envs": 0}, {"num_envs": 2.5}, {"num_envs": 2, "threads": 0}])
def test_bad_arguments(arguments):
    refuse(ValueError, r"Expected .*got", move_cube, **arguments)


@pytest.mark.parametrize("actions", [np.zeros(6), np.zeros((3, 6)), np.full((2, 6), np.nan), "push"])
def test_bad_actions(actions):
    envs = move_cube(2)
    envs.reset(seed=0)
    refuse(ValueError, r"Expected actions = .*got", envs.step, actions)
    refuse(ValueError, "2 seeds", envs.reset, seed=[1, 2, 3])


def test_torchrl_that_is_missing_is_named(monkeypatch):
    from difflcs_envs.torchrl import make_env

    monkeypatch.setitem(sys.modules, "torchrl.envs", None)
    refuse(difflcs_envs.MissingDependencyError, "torchrl", make_env, "cube")


@pytest.mark.parametrize(("task", "arguments"), [("cube", {}), ("clamp", {"object_source": "stand_in"}), (TURN, {})])
@pytest.mark.parametrize("num_envs", [None, 3])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_torchrl(task, arguments, num_envs):
    from torchrl import envs as torchrl_envs

    from difflcs_envs.torchrl import make_env

    env = make_env(task, num_envs=num_envs, **arguments)
    torchrl_envs.check_env_specs(env)
    env.set_seed(0)
    rollout = env.rollout(25, break_when_any_done=False)
    batch = [] if num_envs is None else [num_envs]
    assert list(rollout["state"].shape) == [*batch, 25, 9]
    assert list(rollout["goal"].shape) == [*batch, 25, 3]
    time_to_go = rollout["time_to_go"].reshape(-1, 25)
    np.testing.assert_allclose(time_to_go[0, :20], 0.1 * np.arange(20, 0, -1), atol=1e-12)
    np.testing.assert_allclose(time_to_go[:, 20], 2.0)  # the next episode
    truncated = rollout["next", "truncated"].reshape(-1, 25)
    assert truncated[:, 19].all()
    assert truncated.sum() == len(truncated)
    assert not rollout["next", "terminated"].any()
    env.close()
