"""The compiled stepper against MuJoCo stepped by hand, with torques by its own Jacobians and mass matrix."""

import mujoco
import numpy as np
import pytest

import difflcs_envs
from difflcs_envs.trifinger import native, osc
from difflcs_envs.trifinger.env import TriFingerMoveCubeEnv, TriFingerMoveObjectEnv, TriFingerTurnCubeEnv

ENVS = [
    (TriFingerMoveCubeEnv, {}),
    (TriFingerMoveObjectEnv, {"object": "banana", "object_source": "stand_in"}),
    (TriFingerTurnCubeEnv, {}),
]


def torques(model, data, kp, target):
    """The control law by MuJoCo's own Jacobians, the full mass matrix and a linear solver."""
    mass, found = np.zeros((model.nv, model.nv)), []
    for column, unit in zip(mass, np.eye(model.nv), strict=True):  # mj_fullM has another signature in MuJoCo 3
        mujoco.mj_mulM(model, data, column, unit)
    for finger in range(3):
        site, jacobian = model.site(f"tip_{finger}").id, np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        dofs = slice(model.nv - 9 + 3 * finger, model.nv - 6 + 3 * finger)
        J = jacobian[:, dofs]
        acceleration = kp * (target[finger] - data.site_xpos[site]) - 2 * np.sqrt(kp) * J @ data.qvel[dofs]
        share = max(0.0, 1 - (np.linalg.det(J) / osc.SINGULAR_DETERMINANT) ** 2)
        inverse = J.T @ np.linalg.inv(J @ J.T + share * osc.SINGULAR_DAMPING**2 * np.eye(3))
        found.append(mass[dofs, dofs] @ inverse @ acceleration + data.qfrc_bias[dofs])
    return np.concatenate(found)


def compare(env, action):
    """One period by the compiled stepper, and by hand."""
    model, data, kp = env.model, mujoco.MjData(env.model), 1000.0
    data.qpos[:], data.qvel[:], data.time = env.data.qpos, env.data.qvel, env.data.time
    data.qacc_warmstart[:] = env.data.qacc_warmstart
    mujoco.mj_kinematics(model, data)
    target = data.site_xpos[model.site("tip_0").id :][:3] + np.pad(action.reshape(3, 2), [(0, 0), (0, 1)])
    target[:, 2] = env.physics.tip_height
    for _ in range(50):
        mujoco.mj_step1(model, data)
        data.ctrl[:] = torques(model, data, kp, target)
        mujoco.mj_step2(model, data)
    state = env.physics.step(action)
    np.testing.assert_allclose(env.data.qpos, data.qpos, rtol=0, atol=1e-9)
    np.testing.assert_allclose(env.data.ctrl, data.ctrl, rtol=1e-6, atol=1e-6)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(state[3:], data.site_xpos[:, :2].ravel(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(state[:2], data.body("object").xpos[:2], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("env", "arguments"), ENVS)
def test_a_step_is_mujocos_under_the_control_law(env, arguments):
    env, rng = env(**arguments, osc_kp=1000.0), np.random.default_rng(0)
    for seed in range(2):
        env.reset(seed=seed)
        for _ in range(8):
            compare(env, rng.uniform(-0.015, 0.015, 6))


@pytest.mark.parametrize("posture", [[0, 0, 0], [0, -0.8, 0], [0, -0.8, -1e-3], [np.pi / 2, 0, 0], [0.3, -1.2, 0]])
def test_singular_postures_are_survived(posture):
    env = TriFingerMoveCubeEnv(osc_kp=1000.0)
    env.reset(seed=0)
    env.data.qpos[7:] = np.tile(posture, 3)
    mujoco.mj_forward(env.model, env.data)
    compare(env, np.full(6, 0.01))


@pytest.mark.parametrize(("field", "index", "value"), [("qvel", 3, np.nan), ("qvel", 8, 1e12), ("qpos", 0, 2.0)])
def test_instability_is_noticed(field, index, value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT
    env = TriFingerMoveCubeEnv()
    env.reset(seed=0)
    before = env.step(np.zeros(6))[0]["state"]
    getattr(env.data, field)[index] = value
    with pytest.warns(difflcs_envs.PhysicsWarning, match="unstable"):
        observation, reward, _, truncated, info = env.step(np.zeros(6))
    assert truncated
    assert np.isfinite(reward)
    assert info["physics_error"]
    np.testing.assert_array_equal(observation["state"], before)
    env.reset(seed=0)
    assert not env.step(np.zeros(6))[4]["physics_error"]
    env.reset(seed=0)
    getattr(env.data, field)[index] = value
    with pytest.warns(difflcs_envs.PhysicsWarning):  # in the first step MuJoCo resets its clock to where it was
        assert env.step(np.zeros(6))[4]["physics_error"]


def test_a_mujoco_that_cannot_be_bound_to_is_refused(monkeypatch):
    monkeypatch.setattr(native, "_library", lambda: None)
    with pytest.raises(RuntimeError, match=r"Expected a MuJoCo whose library .* Install one of these"):
        TriFingerMoveCubeEnv()


def test_mujocos_stopwatches_run_again_after_a_step():
    """The compiled stepper does without them; who steps by hand has them as before."""
    env = TriFingerMoveCubeEnv()
    env.reset(seed=0)
    timer = env.data.timer[mujoco.mjtTimer.mjTIMER_POSITION]
    before = timer.duration
    env.step(np.zeros(6))
    assert timer.duration == before
    mujoco.mj_step(env.model, env.data)
    assert timer.duration > before
