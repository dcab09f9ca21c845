"""The policy of `examples/trifinger_push`: its geometry here, and the simulator where it is installed."""

import sys

import numpy as np
import pytest
import torch
import trifinger_rl
from trifinger_push.cube import HALF, TIP_RADIUS, UNIT, CubeEstimator, planar_pose
from trifinger_push.fingers import inverse
from trifinger_push.places import OVER, FingerPlaces, FingerTravel, OneFinger

from difflcs.errors import MissingDependencyError

# Places of the tips at joint angles (0, 0.9, -1.7) of every finger, by Pinocchio from trifingerpro.urdf.
START = np.array([[0.086, 0.06106], [0.00988, -0.10501], [-0.09588, 0.04395]])
START_HEIGHT = 0.07907


def quaternion(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.array([*(np.sin(angle / 2) * axis), np.cos(angle / 2)])


def product(p, q):
    """Of quaternions x, y, z, w."""
    return np.array([*(p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])), p[3] * q[3] - p[:3] @ q[:3]])


def camera(pose, age):
    return {
        "object_position": np.array([*pose[:2], 0.0325], np.float32),
        "object_orientation": quaternion([0, 0, 1], pose[2]).astype(np.float32),
        "delay": np.array([age], np.float32),
    }


def state(pose, tip, finger):
    return torch.tensor([pose[0] / UNIT, pose[1] / UNIT, pose[2], *(np.asarray(tip) / UNIT), finger])


@pytest.mark.parametrize("finger", [0, 1, 2])
def test_inverse_kinematics_knows_the_start_posture(finger):
    angles, knee = inverse(finger, np.array([[*START[finger], START_HEIGHT]]))
    np.testing.assert_allclose(angles, [[0.0, 0.9, -1.7]], atol=2e-4)
    # The first link hangs 0.9 rad out of the vertical.
    np.testing.assert_allclose(knee[0, 2], 0.29 - 0.16 * np.cos(0.9), atol=1e-4)


@pytest.mark.parametrize("face", [([1, 0, 0], 0), ([1, 0, 0], 1), ([1, 0, 0], 2), ([1, 0, 0], 3), ([0, 1, 0], 1)])
def test_yaw_of_a_cube_on_any_face(face):
    axis, quarters = face
    lying = product(quaternion([0, 0, 1], 0.3), quaternion(axis, quarters * np.pi / 2))
    pose = planar_pose(np.array([0.1, -0.05, 0.0325]), lying)
    np.testing.assert_allclose(pose[:2], [0.1, -0.05])
    assert (pose[2] - 0.3 + np.pi / 4) % (np.pi / 2) - np.pi / 4 == pytest.approx(0, abs=1e-9)


def test_the_cube_has_moved_since_its_picture():
    estimator = CubeEstimator(friction=0.5)
    tips = np.array([[-HALF - TIP_RADIUS, 0.0, 0.02], [0.1, 0.1, 0.1], [0.1, -0.1, 0.1]])
    ages = [0.09, 0.11, 0.13, 0.15, 0.17]
    for age in ages:
        pose = estimator.update(camera([0.0, 0.0, 0.0], age), tips)
        tips[0, 0] += 0.004
    # The tip pushes the middle of a face: since the first picture by four steps, which the cube has made with it.
    np.testing.assert_allclose(pose, [0.016, 0.0, 0.0], atol=5e-4)
    # A new picture replaces what was predicted; here the cube is farther off than the tip has come since.
    pose = estimator.update(camera([0.03, 0.001, 0.0], 0.04), tips)
    np.testing.assert_allclose(pose, [0.03, 0.001, 0.0], atol=1e-6)
    # In this one it is where the tip has just come to.
    estimator.update(camera([0.03, 0.001, 0.0], 0.06), tips)
    pose = estimator.update(camera([0.02, 0.0, 0.0], 0.02), tips)
    np.testing.assert_allclose(pose, [0.02, 0.0, 0.0], atol=5e-4)


def test_the_system_of_a_finger_is_that_of_the_plane_and_stays_what_it_is():
    model = OneFinger(friction=0.3, compliance=0.05)
    x = state([0.01, 0.02, 0.3], [-0.04, 0.02, 0.022], 2.0)
    u = torch.tensor([0.2, 0.05, -0.1])
    after = model.params(x).step(x, u.double()).x_next
    flat = model.plane.params(x[:5]).step(x[:5], u[:2].double()).x_next
    torch.testing.assert_close(after[:5], flat)
    assert float(flat[0]) > float(x[0])
    torch.testing.assert_close(after[5:], torch.stack([x[5] - 0.1, x[6]]))


def test_a_face_that_was_refused_is_not_offered_until_later():
    places, x = FingerPlaces(), state([0.0, 0.0, 0.0], [0.1, 0.0, 0.1], 0.0)
    before = places.sample(x)
    face = before[before[:, 0] == 0][0]
    tip = np.array([*(face[1:].numpy() * UNIT), 0.022])
    places.refuse(np.array([0.0, 0.0, 0.0, *tip, 0.0]), steps=10)
    assert not places.near(state([0.0, 0.0, 0.0], tip, 0.0))
    after = places.sample(x)
    assert len(after) < len(before)
    assert not (after == face).all(1).any()
    places.now = 10
    assert len(places.sample(x)) == len(before)


def test_a_tip_goes_straight_where_it_can_and_over_the_cube_where_it_must():
    travel, pose = FingerTravel(), [0.0, 0.0, 0.0]
    target = state(pose, [-0.055, 0.0, 0.022], 0.0)
    travel.tips = np.array([[-0.09, 0.02, 0.1]] * 3)
    straight = travel.action(target, target).numpy() * UNIT
    np.testing.assert_allclose(travel.tips[0] + straight, [-0.055, 0.0, 0.022], atol=1e-9)
    travel.tips = np.array([[0.09, 0.0, 0.1]] * 3)
    over = travel.tips[0] + travel.action(target, target).numpy() * UNIT
    np.testing.assert_allclose(over, [-0.055, 0.0, OVER], atol=1e-9)
    travel.tips = np.array([[0.05, 0.0, 0.02]] * 3)  # beside the far face: up, and away from it
    lifted = travel.tips[0] + travel.action(target, target).numpy() * UNIT
    assert lifted[0] > 0.05
    assert lifted[2] == pytest.approx(OVER)
    states = torch.stack([target, target])
    states[:, 6] = torch.tensor([0.0, 1.0])
    travel.tips = np.array([[0.09, 0.0, 0.1], [-0.09, 0.02, 0.1], [0.0, 0.1, 0.1]])
    far, near = travel.distance(target, states).tolist()
    assert far > near
    assert travel.arrived(states[0], target)
    assert not travel.arrived(states[1], target)  # another finger
    assert not travel.arrived(state(pose, [-0.055, 0.02, 0.022], 0.0), target)


def test_the_package_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "trifinger_rl_datasets", None)
    with pytest.raises(MissingDependencyError, match=r"pip install trifinger-rl-datasets==1\.0\.3"):
        trifinger_rl.main(trifinger_rl.Options(policy="contact-mpc"))
