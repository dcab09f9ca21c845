"""What the environments publish to the library: every number of a task is that of its environment."""

from itertools import combinations

import numpy as np
import pytest
import torch

from difflcs.rl.tasks import get_task
from difflcs.systems import pushing_cost
from difflcs_envs.tasks import MOVE, caption, contact_cost, trifinger_task
from difflcs_envs.ycb import YCB
from tests.conftest import python

NAMES = ("cube", "turn_cube", *YCB)


pytestmark = pytest.mark.usefixtures("stand_ins")


@pytest.mark.slow
def test_what_a_program_registers_itself_is_not_replaced_by_what_is_installed():
    code = (
        "from difflcs.rl.tasks import get_task, register_task, task_names\n"
        "from difflcs_envs.tasks import MOVE, trifinger_task\n"
        "mine = register_task(trifinger_task('cube', 'TriFingerMoveCube-v0', MOVE, 'Mine.', ()))\n"
        "assert get_task('cube') is mine and 'mug' in task_names()"
    )
    python("-c", code)


@pytest.mark.parametrize("name", NAMES)
def test_its_step_and_its_names_are_those_of_the_environment(name):
    """What else a task says, tests/conformance/test_tasks.py compares."""
    task = get_task(name)
    env = task.make_env()
    assert task.step_seconds == env.unwrapped.dt
    assert task.model_name == f"trifinger-{name.replace('_', '-')}"
    assert [q.name for q in task.goal] == ["x", "y", "yaw"]
    info = env.reset(seed=0)[1]
    assert task.say(info) == caption(info)
    goals = np.array(task.example_goals)  # which show different pushes, and turns to both sides
    assert name == "turn_cube" or min(np.hypot(*(a - b)[:2]) for a, b in combinations(goals, 2)) > 0.05
    assert goals[:, 2].min() < 0 < goals[:, 2].max()
    env.close()


def random_tensors(count, task):
    generator = torch.Generator().manual_seed(0)
    sizes = (task.n_x, task.n_u, task.n_x, task.n_goal)
    state, action, after, goal = (0.05 * torch.randn(count, n, generator=generator, dtype=torch.float64) for n in sizes)
    return state, action, after, torch.where(torch.arange(count)[:, None] % 2 == 0, after[:, :3] + 0.001, goal)


@pytest.mark.parametrize("name", ["cube", "turn_cube"])
def test_the_reward_is_minus_the_stage_cost_of_the_mpc(name):
    task = get_task(name)
    step = random_tensors(200, task)
    ended = torch.arange(200) % 3 == 0
    reward, success = task.outcome(*step, ended)
    assert 0 < int(success.sum()) < 200 or name == "turn_cube"
    expected = -pushing_cost().stage(*step[:2], step[3]) - task.failure_penalty * (ended & ~success)
    torch.testing.assert_close(reward, expected, rtol=1e-12, atol=1e-12)


def test_a_full_turn_is_the_same_pose_for_arrays_and_tensors():
    state, action, after, goal = random_tensors(40, get_task("cube"))
    turned = after + 4 * torch.pi * (torch.arange(9) == 2)
    reward, info = MOVE.outcome(state, action, turned, goal, True)
    assert torch.equal(info["success"], MOVE.outcome(state, action, after, goal, True)[1]["success"])
    arrays, told = MOVE.outcome(*(part.numpy() for part in (state, action, turned, goal)), True)
    np.testing.assert_allclose(reward, arrays, rtol=1e-12, atol=1e-12)
    for name, value in told.items():
        np.testing.assert_allclose(info[name], value, rtol=1e-12, atol=1e-12, err_msg=name)


def test_the_outcome_of_a_step_needs_no_torch():
    code = (
        "import sys, numpy as np; from difflcs_envs.trifinger.task import MOVE\n"
        "MOVE.outcome(np.zeros(9), np.zeros(6), np.zeros(9), np.zeros(3), True)\n"
        "assert 'torch' not in sys.modules"
    )
    python("-c", code)


def test_the_cost_of_contact_plans_is_what_it_says():
    cost, rng = contact_cost(), torch.Generator().manual_seed(0)
    x, u, goal = (torch.randn(5, n, dtype=torch.float64, generator=rng) for n in (9, 6, 3))

    def wanted(tips, place, yaw, action):
        behind = x[:, :2] + 0.8 * (x[:, :2] - goal[:, :2])
        arms = x[:, 3:].reshape(5, 3, 2) - behind.unsqueeze(1)
        return (
            tips * arms.square().sum((1, 2))
            + place * (x[:, :2] - goal[:, :2]).square().sum(1)
            + yaw * (x[:, 2] - goal[:, 2]).square()
            + action * u.square().sum(1)
        )

    torch.testing.assert_close(cost.stage(x, u, goal), wanted(35, 200, 2, 60))
    at_the_end = 0.5 * (x @ cost.Q_final * x).sum(1) + (goal @ cost.goal_to_q_final.mT * x).sum(1)
    at_the_end = at_the_end + 0.5 * (goal @ cost.goal_final * goal).sum(1)
    torch.testing.assert_close(at_the_end, wanted(40, 200, 10, 0))


@pytest.mark.parametrize(("name", "parts"), [("cube", 1), ("mug", None), ("banana", None)])
def test_what_is_known_of_an_object_is_its_outline(name, parts):
    task = get_task(name)
    system = task.physics.make_system()
    assert (system.n_x, system.n_u) == (task.n_x, task.n_u)
    assert system.n_lam == 6 * system.guess.parts_touched
    shape = system.guess.shape
    assert parts is None or shape.n_parts == parts
    assert len(task.physics.scale) == task.n_x
    env = task.make_env()
    state = env.reset(seed=0)[0]["state"]
    around = env.unwrapped.object.outline
    corners = np.concatenate([part.vertices.numpy() for part in shape.parts])
    np.testing.assert_allclose(np.ptp(corners, axis=0), np.ptp(around, axis=0), atol=3e-4)
    # No tip touches the object at the start: gaps are above zero, and those of the simulation.
    gaps = system.guess.replace(radius=0.0095).contacts(torch.from_numpy(state)).gap
    assert float(gaps.min()) > 0.001
    env.close()


def test_what_is_known_of_an_own_object_is_how_it_lies(tmp_path):
    import trimesh

    path = tmp_path / "box.stl"
    trimesh.creation.box((60, 80, 160)).export(path)
    given = {"object": str(path), "mesh_scale": 0.001, "rest_pose": "upright"}
    task = trifinger_task("own", "TriFingerMoveObject-v0", MOVE, "Own.", (), **given)
    corners = np.concatenate([part.vertices.numpy() for part in task.physics.make_system().guess.shape.parts])
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.06, 0.08], atol=1e-6)
