"""The compiled stepper against its Python twin."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the environments need the extra [envs]")

import mujoco

import difflcs_envs
from difflcs_envs.trifinger import native
from difflcs_envs.trifinger.env import TriFingerMoveCubeEnv, TriFingerMoveObjectEnv, TriFingerTurnCubeEnv

pytestmark = pytest.mark.skipif(native.stepper is None, reason="the stepper is not compiled for this Python")
ENVS = [
    (TriFingerMoveCubeEnv, {}),
    (TriFingerMoveObjectEnv, {"object": "banana", "object_source": "stand_in"}),
    (TriFingerTurnCubeEnv, {}),
]


def twins(monkeypatch, env=TriFingerMoveCubeEnv, **arguments):
    """One environment that steps natively, one that steps in Python."""
    one = env(**arguments)
    monkeypatch.setenv(native.NATIVE_VARIABLE, "0")
    other = env(**arguments)
    monkeypatch.delenv(native.NATIVE_VARIABLE)
    assert one.physics.lane is not None
    assert other.physics.lane is None
    return one, other


@pytest.mark.parametrize(("env", "arguments"), ENVS)
def test_native_and_python_give_the_same_numbers(monkeypatch, env, arguments):
    """Bit for bit on x86-64; contact amplifies rounding, so other machines compare one step only."""
    one, other = twins(monkeypatch, env, **arguments)
    rng = np.random.default_rng(0)
    for _ in range(3):
        seed = int(rng.integers(1000))
        one.reset(seed=seed)
        other.reset(seed=seed)
        for _ in range(20):
            action = rng.uniform(-0.015, 0.015, 6)
            other.physics.set_full_state(one.physics.get_full_state())
            a, b = one.step(action), other.step(action)
            np.testing.assert_allclose(a[0]["state"], b[0]["state"], rtol=0, atol=1e-12)
            np.testing.assert_allclose(one.data.ctrl, other.data.ctrl, rtol=1e-9, atol=1e-9)
            assert a[1] == pytest.approx(b[1], abs=1e-9)


@pytest.mark.parametrize("posture", [[0, 0, 0], [0, -0.8, 0], [0, -0.8, -1e-3], [np.pi / 2, 0, 0], [0.3, -1.2, 0]])
def test_singular_postures_are_survived_alike(monkeypatch, posture):
    one, other = twins(monkeypatch)
    for env in (one, other):
        env.reset(seed=0)
        env.data.qpos[7:] = np.tile(posture, 3)
        mujoco.mj_forward(env.model, env.data)
    results = [env.physics.step(np.full(6, 0.01)) for env in (one, other)]
    assert (results[0] is None) == (results[1] is None)
    if results[0] is not None:
        assert np.isfinite(results[0]).all()
        np.testing.assert_allclose(results[0], results[1], atol=1e-6)


@pytest.mark.parametrize(("field", "index", "value"), [("qvel", 3, np.nan), ("qvel", 8, 1e12), ("qpos", 0, 2.0)])
def test_instability_is_noticed(field, index, value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT
    env = TriFingerMoveCubeEnv()
    env.reset(seed=0)
    before = env.step(np.zeros(6))[0]["state"]
    getattr(env.data, field)[index] = value
    with pytest.warns(difflcs_envs.PhysicsWarning, match="unstable"):
        observation, _, _, truncated, info = env.step(np.zeros(6))
    assert truncated
    assert info["physics_error"]
    np.testing.assert_array_equal(observation["state"], before)
    env.reset(seed=0)
    assert not env.step(np.zeros(6))[4]["physics_error"]


def test_instability_in_the_first_step_is_noticed(tmp_path, monkeypatch):
    """MuJoCo resets its clock to where it was; only the warning tells."""
    monkeypatch.chdir(tmp_path)
    env = TriFingerMoveCubeEnv()
    env.reset(seed=0)
    env.data.qvel[0] = np.nan
    with pytest.warns(difflcs_envs.PhysicsWarning):
        assert env.step(np.zeros(6))[4]["physics_error"]


def test_falls_back_to_python(monkeypatch):
    monkeypatch.setattr(native, "stepper", None)
    env = TriFingerMoveCubeEnv()
    assert env.physics.lane is None
    env.reset(seed=0)
    env.step(np.zeros(6))


def test_rows_must_fit():
    physics = TriFingerMoveCubeEnv().physics
    with pytest.raises(ValueError, match="one row"):
        native.step_lanes([physics.lane], np.zeros((2, 6)), np.zeros((1, 9)), np.zeros(1, bool), 1)


def test_mujocos_stopwatches_run_again_after_a_step():
    """The compiled stepper does without them; who steps by hand has them as before."""
    env = TriFingerMoveCubeEnv()
    env.reset(seed=0)
    timer = env.data.timer[mujoco.mjtTimer.mjTIMER_POSITION]
    assert env.physics.lane is not None
    before = timer.duration
    env.step(np.zeros(6))
    assert timer.duration == before
    mujoco.mj_step(env.model, env.data)
    assert timer.duration > before
