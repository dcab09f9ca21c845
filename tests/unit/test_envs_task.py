"""The outcome of a transition: what the environment gives, arrays and tensors all agree."""

import subprocess
import sys

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium", reason="the environments need the extra [envs]")
pytest.importorskip("mujoco", reason="the environments need the extra [envs]")

from difflcs_envs.trifinger.task import MOVE, TURN, MoveTask  # noqa: E402

TASKS = {"move": MOVE, "turn": TURN, "other": MoveTask(0.5, 0.5, 0.1, tips_weight=1.5, yaw_weight=0.7)}


def transitions(shape, seed=0):
    rng = np.random.default_rng(seed)
    sizes = (9, 6, 9, 3)
    state, action, after, goal = (0.3 * rng.normal(size=(*shape, size)) for size in sizes)
    after[..., 2] += rng.integers(-2, 3, shape) * 2 * np.pi  # full turns do not matter to success
    near = rng.random(shape) < 0.5
    after[..., :3] = np.where(near[..., None], goal + 0.02 * rng.normal(size=(*shape, 3)), after[..., :3])
    return state, action, after, goal


def tensors(arrays):
    return [torch.from_numpy(np.asarray(array)) for array in arrays]


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
@pytest.mark.parametrize("shape", [(), (40,), (8, 5)])
@pytest.mark.parametrize("ended", [True, False, "each"])
def test_tensors_agree_with_arrays(task, shape, ended):
    arrays = transitions(shape)
    ends = np.random.default_rng(1).random(shape) < 0.5 if ended == "each" else ended
    reward, info = task.outcome(*arrays, ends)
    for given in (ends, torch.as_tensor(ends)):
        found, told = task.outcome(*tensors(arrays), given)
        assert isinstance(found, torch.Tensor)
        assert list(told) == list(info)
        np.testing.assert_allclose(found, reward, rtol=1e-12, atol=1e-12)
        for name, value in info.items():
            np.testing.assert_allclose(told[name], value, rtol=1e-12, atol=1e-12, err_msg=name)
    reward_alone, success = task.judge(*arrays, ends)
    np.testing.assert_array_equal(reward_alone, reward)
    np.testing.assert_array_equal(success, info["success"])
    assert shape == () or task is TURN or 0 < success.sum() < success.size


def test_the_reward_has_a_gradient_in_state_and_action():
    state, action, after, goal = tensors(transitions((6,)))
    state.requires_grad_()
    action.requires_grad_()
    assert torch.autograd.gradcheck(lambda x, u: MOVE.judge(x, u, after, goal, True)[0], (state, action))
    at_goal = torch.zeros(9, dtype=torch.float64, requires_grad=True)
    reward, success = MOVE.judge(at_goal, torch.zeros(6), at_goal, torch.zeros(3), True)
    reward.backward()
    assert success
    assert torch.equal(at_goal.grad, torch.zeros(9))


def test_vmap():
    arrays = tensors(transitions((7,)))
    ends = torch.arange(7) % 2 == 0
    rewards, successes = torch.func.vmap(MOVE.judge)(*arrays, ends)
    expected = MOVE.judge(*arrays, ends)
    torch.testing.assert_close(rewards, expected[0], rtol=1e-12, atol=1e-12)
    assert torch.equal(successes, expected[1])


def test_the_task_needs_no_torch():
    code = (
        "import sys, numpy as np; from difflcs_envs.trifinger.task import MOVE\n"
        "MOVE.outcome(np.zeros(9), np.zeros(6), np.zeros(9), np.zeros(3), True)\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
