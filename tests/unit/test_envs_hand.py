"""The hand that turns objects: what lies on the palm, what the numbers mean, and its physics as a system."""

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

import difflcs_envs  # noqa: F401
from difflcs.rl.tasks import get_task
from difflcs_envs.hand.env import HandTurnObjectEnv, continued_rotation
from difflcs_envs.hand.model import FINGERS, LINKS, OBJECTS, PALM_TOP, POSTURE
from difflcs_envs.hand.task import rotation_to_quaternion
from difflcs_envs.tasks import hand_cost, hand_system
from tests.conftest import refuse

ID = "difflcs/HandTurnObject-v0"


def make(name="cube", **arguments):
    return gymnasium.make(ID, object=name, **arguments).unwrapped


@pytest.mark.parametrize("name", OBJECTS)
def test_the_object_rests_on_the_palm_within_open_fingers(name):
    env = make(name, object_mass=0.07, friction=0.4, servo_gain=2.0)
    before, _ = env.reset(seed=0)
    for _ in range(10):
        after, *_, info = env.step(np.zeros(16))
    assert not info["dropped"]
    moved = np.abs(after["state"] - before["state"])
    assert moved[:16].max() < 0.2  # targets relative to joints that sag a little in each step
    assert moved[16:19].max() < 5e-3
    assert after["state"][18] == pytest.approx(PALM_TOP + OBJECTS[name][2], abs=2e-3)
    assert min(contact.dist for contact in env.data.contact) > -2e-3
    assert env.describe() == {"name": name, "mass": pytest.approx(0.07), "friction": 0.4, "servo_gain": 2.0}


def test_the_fingers_are_those_of_the_allegro_hand():
    """Where the tips are at the start and stretched out; sums of how far joints go, how thick and long links are."""
    data = mujoco.MjData(model := make().model)
    tips = [[-15.9, -48.8, 52.1], [37.5, 1.2, 62.3], [-39.0, 64.3, 48.5], [-89.2, 8.2, 50.7]]
    stretched = [[133.4, -55.3, 0.0], [136.2, 0.0, 0.0], [133.4, 55.3, 0.0], [-86.1, -167.7, -13.2]]
    for posture, places in ((POSTURE, tips), ([0.0] * 16, stretched)):
        data.qpos[:16] = posture
        mujoco.mj_kinematics(model, data)
        found = [1000 * data.site(f"{finger}_tip").xpos for finger in FINGERS]  # [mm]
        np.testing.assert_allclose(found, places, atol=0.1)
    np.testing.assert_allclose(model.jnt_range[:16].sum(0), [-3.394, 23.143], atol=1e-9)
    sizes = sum(model.geom(f"{finger}_{link}").size for finger in FINGERS for link in LINKS)
    np.testing.assert_allclose(sizes, [0.1825, 0.28317, 0.0], atol=1e-5)


@pytest.mark.parametrize(("name", "size", "volume"), [("house", (50, 40, 50), 82.5), ("nut", (60, 51.96, 40), 93.53)])
def test_meshes_have_their_sizes(name, size, volume):
    corners = 1000 * OBJECTS[name][1]  # [mm]
    np.testing.assert_allclose([corners.min(0), corners.max(0)], np.outer([-0.5, 0.5], size), atol=0.01)
    assert 1e-3 * ConvexHull(corners).volume == pytest.approx(volume, rel=1e-3)


def test_the_goal_is_a_quarter_turn_away_to_either_side():
    env = make()
    turns = []
    for seed in range(20):
        observation, info = env.reset(seed=seed)
        assert info["angle_error"] == pytest.approx(np.pi / 2)
        w, _, _, z = observation["goal"][3:]
        turns.append(np.remainder(2 * np.arctan2(z, w) - observation["state"][21] + np.pi, 2 * np.pi) - np.pi)
    np.testing.assert_allclose(np.unique(np.round(turns, 9)), [-np.pi / 2, np.pi / 2])


def test_success_is_within_23_degrees_and_not_dropped():
    env, state = make(horizon=2), np.zeros(22)
    env.reset(seed=0)
    for yaw, height, success in ((0.40, 0.05, True), (0.41, 0.05, False), (0.0, 0.004, False)):
        state[18], state[21] = height, yaw
        options = {"state": state, "goal": [0, 0, 0.05, 1, 0, 0, 0]}
        observation, info = env.reset(options=options)
        np.testing.assert_array_equal(observation["state"], state)
        assert (info["success"], info["held"], info["angle_error"]) == (success, success, pytest.approx(yaw))


def test_rotations_are_those_of_mujoco_and_continue_through_half_a_turn():
    rng, before = np.random.default_rng(0), np.zeros(3)
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    for angle in np.linspace(0.0, 1.5 * np.pi - 0.01, 40):
        quaternion = np.zeros(4)
        mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
        before = continued_rotation(quaternion, before)
        np.testing.assert_allclose(before, angle * axis, atol=1e-7)
        np.testing.assert_allclose(rotation_to_quaternion(before), quaternion, atol=1e-7)
    mujoco.mju_axisAngle2Quat(quaternion, axis, 1.5 * np.pi + 0.1)
    np.testing.assert_allclose(continued_rotation(quaternion, before), (0.1 - 0.5 * np.pi) * axis, atol=1e-7)


def test_bad_arguments_and_options():
    env, bad = make(), {"object": "cup", "object_mass": 0.0, "friction": -1, "servo_gain": 0, "turn": 4}
    for name, value in {**bad, "render_mode": "human"}.items():
        refuse(ValueError, r"Expected .*got", HandTurnObjectEnv, **{name: value})
    for options in ({"goal": [0, 0, 0]}, {"goal": np.zeros(7)}, {"state": np.full(22, 7.0)}, {"yaw": 1.0}, [1]):
        refuse(ValueError, r"Expected .*got", env.reset, options=options)


def test_the_system_predicts_open_joints_and_the_cost_is_zero_at_the_goal():
    """Fingers that touch nothing go as the system says; where the object is at its goal, the turn costs nothing."""
    env = make()
    state = np.array([*[0.0, 0.3, 0.3, 0.3] * 3, 0.8, 0.6, 0.3, 0.3, 0.0, 0.0, 0.3, 0.0, 0.0, 1.0])
    observation, _ = env.reset(options={"state": state})
    system = hand_system(env.model)
    x, u = system.observe(env.data), torch.full((16,), -0.05, dtype=torch.float64)
    u[[0, 4, 8, 12]] = 0.02
    predicted = system.params(x).step(x, u).x_next
    fingers = [[f"{finger}_{link}" for link in LINKS] for finger in FINGERS]
    named = hand_system(env.model, object="object", fingers=fingers, compliance=0.2)
    assert torch.equal(named.params(x).E, system.params(x).E)
    assert hand_system(env.model, fingers=fingers[:2]).params(x).n_lam < named.params(x).n_lam == system.params(x).n_lam
    assert named.compliance == 0.2
    after, *_ = env.step(u.numpy())
    assert np.abs(predicted[:16].numpy() - after["state"][:16]).max() < 0.01
    pose = np.concatenate([observation["state"][16:19], rotation_to_quaternion(observation["state"][19:])])
    cost = hand_cost(system).at(x, torch.from_numpy(pose))
    final = x @ cost.Q_final @ x / 2 + cost.q_final @ x + cost.constant
    assert float(final) == pytest.approx(0, abs=1e-9)


def test_the_unknown_hand_is_told_wrong():
    right, wrong = (get_task(name).physics.make_system().mujoco_model() for name in ("hand", "hand_unknown"))
    for found, factor in (
        (wrong.body("object").mass / right.body("object").mass, 3.0),
        (wrong.geom("object").friction[0] / right.geom("object").friction[0], 0.5),
        (wrong.actuator_gainprm[:, 0] / right.actuator_gainprm[:, 0], 0.5),
    ):
        np.testing.assert_allclose(found, factor)
