"""The TriFinger environment: Gymnasium's contract, the paper's numbers, physics, controller, bad input, pictures."""

import copy
import math
import pickle
import sys

import gymnasium
import mujoco
import numpy as np
import pytest

import difflcs_envs
from difflcs_envs.hand.env import HandTurnObjectEnv
from difflcs_envs.rendering import SceneRenderer, has_display, select_gl_backend
from difflcs_envs.trifinger import kinematics
from difflcs_envs.trifinger.env import TriFingerMoveCubeEnv
from difflcs_envs.trifinger.model import FINGER_YAWS
from tests.conftest import python, refuse

OUTWARD = np.stack([-np.sin(FINGER_YAWS), np.cos(FINGER_YAWS)], axis=1)  # (3, 2)
REST = np.zeros(6)


def make(**arguments):
    return TriFingerMoveCubeEnv(**{"reset_noise": 0.0, **arguments})


@pytest.fixture(scope="module")
def gl():
    """Skip where no OpenGL context can be made, and say why."""
    env = make()
    try:
        SceneRenderer(env.physics.model, 32, 24).close()
    except difflcs_envs.RenderingError as error:
        pytest.skip(str(error))


# --- Gymnasium's contract -------------------------------------------------------------------------


def test_import_does_not_load_mujoco_and_what_needs_it_names_the_install_line():
    code = (
        "import sys, difflcs_envs; assert 'mujoco' not in sys.modules and 'difflcs' not in sys.modules\n"
        "sys.modules['mujoco'] = None\n"
        "try:\n    import difflcs_envs.trifinger.env\n"
        "except difflcs_envs.MissingDependencyError as error:\n"
        "    assert 'pip install \"difflcs[envs]\"' in str(error)\n"
        "else:\n    raise SystemExit('no error')"
    )
    python("-c", code)


def test_truncates_after_20_steps_and_never_terminates():
    env = make()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(REST)
    env.reset(seed=0)
    flags = [env.step(REST)[2:4] for _ in range(20)]
    assert [terminated for terminated, _ in flags] == [False] * 20
    assert [truncated for _, truncated in flags] == [False] * 19 + [True]
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(REST)


# --- reward and success ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("goal", "success"),
    [([0.019, 0, 0.19], True), ([0.021, 0, 0], False), ([0, 0, 0.21], False), ([0.015, 0.015, 0], False)],
)
def test_success_tolerances_and_sparse_penalty(goal, success):
    env = make(sparse_penalty=7.0)
    _, info = env.reset(seed=0, options={"goal": goal})
    assert info["success"] is success
    for _ in range(20):
        info = env.step(REST)[4]
    assert info["success"] is success
    assert info["reward_completion"] == (0.0 if success else -7.0)
    assert make(position_tolerance=0.03, yaw_tolerance=0.3).reset(options={"goal": goal})[1]["success"]


# --- start ----------------------------------------------------------------------------------------


def test_goals_fill_the_task_space():
    env = make()
    goals = np.array([env.reset(seed=seed)[0]["goal"] for seed in range(300)])
    high = np.array([0.06, 0.06, 0.5])
    assert np.all(np.abs(goals) <= high)
    assert np.all(goals.max(axis=0) > 0.95 * high)
    assert np.all(goals.min(axis=0) < -0.95 * high)


def test_given_state_and_goal_come_back():
    env = make(reset_noise=0.05)
    rng = np.random.default_rng(0)
    for _ in range(20):
        tips = (0.11 + rng.uniform(-0.01, 0.03, (3, 1))) * OUTWARD + rng.uniform(-0.02, 0.02, (3, 2))
        state = np.concatenate([rng.uniform(-0.02, 0.02, 2), rng.uniform(-np.pi, np.pi, 1), tips.ravel()])
        goal = rng.uniform(-0.06, 0.06, 3)
        observation, _ = env.reset(options={"state": state, "goal": goal})
        np.testing.assert_allclose(observation["state"], state, atol=1e-6)
        np.testing.assert_array_equal(observation["goal"], goal)
        np.testing.assert_array_equal(env.physics.data.qvel, 0.0)


@pytest.mark.parametrize("yaw", [np.pi, -np.pi, np.float32(np.pi)])
def test_half_turn_start_comes_back_with_its_sign(yaw):
    env = make()
    state = np.concatenate([[0.0, 0.0, yaw], (0.1 * OUTWARD).ravel()])
    assert env.reset(options={"state": state})[0]["state"][2] == pytest.approx(yaw, abs=1e-6)


def test_given_goal_leaves_later_episodes_alone():
    one, other = make(reset_noise=0.05), make(reset_noise=0.05)
    one.reset(seed=5, options={"goal": [0, 0, 0]})
    other.reset(seed=5)
    np.testing.assert_array_equal(one.reset()[0]["goal"], other.reset()[0]["goal"])


# --- determinism and copies -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"]
)
@pytest.mark.parametrize(
    ("kind", "arguments", "size", "limit"),
    [
        (TriFingerMoveCubeEnv, {"osc_kp": 2500.0, "reset_noise": 0.05}, 6, 0.015),
        (HandTurnObjectEnv, {"object": "nut"}, 16, 0.2),
    ],
)
def test_copies_continue_the_episode(kind, arguments, size, limit, clone):
    env, rng = kind(**arguments), np.random.default_rng(0)
    env.reset(seed=2)
    for _ in range(7):
        env.step(rng.uniform(-limit, limit, size))
    twin = clone(env)
    for _ in range(13):
        action = rng.uniform(-limit, limit, size)
        a, b = env.step(action), twin.step(action)
        np.testing.assert_array_equal(a[0]["state"], b[0]["state"])
        assert a[1:4] == b[1:4]
    np.testing.assert_array_equal(env.reset()[0]["goal"], twin.reset()[0]["goal"])


# --- physics --------------------------------------------------------------------------------------


def test_yaw_is_continuous_through_half_a_turn():
    env = make()
    start = np.concatenate([[0.0, 0.0, np.pi - 0.01], (0.0977 * OUTWARD).ravel()])
    env.reset(options={"state": start})
    for part in range(1, 7):  # one more turn
        yaw = np.pi - 0.01 + part * np.pi / 3
        env.data.qpos[3:7] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
        assert env.step(REST)[0]["state"][2] == pytest.approx(yaw, abs=1e-4)
    assert env.step(REST)[0]["state"][2] == pytest.approx(3 * np.pi - 0.01, abs=1e-4)
    info = env.reset(options={"state": start, "goal": [0, 0, 0.5]})[1]
    assert info["yaw_error"] == pytest.approx(np.pi - 0.51, abs=1e-6)


def test_mass_and_friction_reach_the_model():
    model = make(object_mass=0.05, object_friction=0.7).physics.model
    assert model.body("object").mass[0] == pytest.approx(0.05)
    assert model.geom("object").friction[0] == model.geom("table").friction[0] == 0.7


def test_kinematics_agree_with_mujoco():
    physics = make().physics
    rng = np.random.default_rng(0)
    for _ in range(20):
        joints = np.array([0.0, -0.9, -1.3]) + rng.uniform(-0.4, 0.4, (3, 3))
        physics.data.qpos[7:] = joints.ravel()
        mujoco.mj_kinematics(physics.model, physics.data)
        tips = kinematics.tip_positions(joints)
        np.testing.assert_allclose(tips, physics.data.site_xpos, atol=1e-12)
        np.testing.assert_allclose(kinematics.joint_angles(tips), joints, atol=1e-9)


# --- input ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "action",
    [np.zeros(5), np.zeros((1, 6)), 0.0, np.full(6, np.nan), np.full(6, np.inf), "push", [0, 0, None, 0, 0, 0]],
)
def test_bad_action(action):
    env = make()
    env.reset(seed=0)
    refuse(ValueError, r"Expected action = .*got", env.step, action)
    env.step(REST)  # the episode goes on


def home_state(**changes):
    state = np.concatenate([np.zeros(3), (0.0977 * OUTWARD).ravel()])
    for index, value in changes.items():
        state[int(index[1:])] = value
    return state


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal": [0.061, 0, 0]}, r"task space"),
        ({"goal": [0, 0, -0.51]}, r"task space"),
        ({"goal": [0, 0]}, r"shape \(3,\), got shape \(2,\)"),
        ({"goal": [0, np.nan, 0]}, r"finite"),
        ({"state": np.zeros(8)}, r"shape \(9,\), got shape \(8,\)"),
        ({"state": home_state(_4=0.3)}, r"Fingertip 0 cannot reach"),
        ({"state": home_state(_5=0.02, _6=0.0)}, r"overlap"),
        ({"state": home_state(_2=4.0)}, r"\[-pi, pi\]"),
        ({"state": home_state(_0=0.8)}, r"cannot stand"),
        ({"gaol": [0, 0, 0]}, r"got also \['gaol'\]"),
    ],
)
def test_bad_options(options, message):
    refuse(ValueError, message, make().reset, seed=0, options=options)


@pytest.mark.parametrize("options", [[0.0, 0.0, 0.0], [], "goal", 3, np.zeros(3), [("goal", [0, 0, 0])]])
@pytest.mark.parametrize("count", [None, 2])
def test_options_are_a_dictionary(options, count):
    env = make() if count is None else gymnasium.make_vec("difflcs/TriFingerMoveCube-v0", num_envs=count)
    with pytest.raises(difflcs_envs.OptionsError, match=r"Expected options as a dictionary, got .*Pass options=\{"):
        env.reset(seed=0, options=options)
    env.reset(seed=0, options={})
    env.close()


@pytest.mark.parametrize(
    "arguments",
    [
        {"render_mode": "ascii"},
        {"osc_kp": 0.0},
        {"osc_kp": math.inf},
        {"position_tolerance": -0.01},
        {"yaw_tolerance": math.nan},
        {"horizon": 0},
        {"horizon": 2.5},
        {"object_mass": 0.0},
        {"object_friction": -0.1},
        {"reset_noise": 0.3},
        {"sparse_penalty": "ten"},
        {"width": 0},
    ],
)
def test_bad_arguments(arguments):
    refuse(ValueError, r"Expected .*, got .*\. Choose", make, **arguments)


# --- pictures -------------------------------------------------------------------------------------


@pytest.mark.usefixtures("gl")
@pytest.mark.parametrize("camera", ["front", "top"])
def test_the_goal_is_an_outline_that_hides_nothing(camera):
    env = make(render_mode="rgb_array", width=320, height=240, reset_noise=0.0).unwrapped

    def drawn(goal):
        env.reset(seed=0, options={"goal": goal})
        return env.picture(camera).astype(int)

    here, there = drawn([0.0, 0.0, 0.0]), drawn([0.06, 0.06, 0.5])
    cube = (there[..., 0] > 180) & (there[..., 1] > 110) & (there[..., 2] < 100)
    marked = (here[..., 0] > 180) & (here[..., 1] < 90) & (here[..., 2] < 90)
    new = marked & (np.abs(here - there).max(2) > 20)
    assert 30 < new.sum() < 0.5 * cube.sum()  # a line round it
    inside = cube & ~marked
    assert inside.sum() > 0.5 * cube.sum()
    assert np.abs(here - there)[inside].max(1).mean() < 40  # lightly tinted, edges of the cube stay visible
    env.close()


def test_render_without_mode_warns():
    env = make()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render mode"):
        assert env.render() is None


@pytest.mark.skipif(has_display(), reason="this machine has a display")
def test_human_mode_without_display_is_refused():
    assert "human" not in TriFingerMoveCubeEnv.metadata["render_modes"]
    refuse(difflcs_envs.RenderingError, "rgb_array", make, render_mode="human")


def test_the_users_choice_of_opengl_is_kept(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert select_gl_backend() == "osmesa"
    monkeypatch.delenv("MUJOCO_GL")
    own = select_gl_backend()
    monkeypatch.setenv("MUJOCO_GL", "")
    assert select_gl_backend() == own
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    refuse(difflcs_envs.RenderingError, r"MUJOCO_GL: expected egl.*got 'nonsense'; change", select_gl_backend)


def test_broken_opengl_names_the_packages(monkeypatch):
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    refuse(difflcs_envs.RenderingError, "apt-get install libegl1", env.render)
