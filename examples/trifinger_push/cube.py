"""Estimate of the cube's current pose.

The camera's pose is 90 to 190 ms old, a new one comes ten times a second. Since it was taken the tips have been
measured at every step: the same contact physics that the plan uses is stepped from the old pose along their way.
"""

from collections import deque
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from difflcs.physics import PlanarPushing, box
from difflcs.physics.complementarity import Cone
from trifinger_push.fingers import STEP, planar_turn

Array = NDArray[np.float64]

HALF = 0.0325
"""Half the width of the cube [m]."""
HEIGHT = 2 * HALF
TIP_RADIUS = 0.0145
"""At which a tip touches the cube [m]: 10 mm of its mesh, the rest is what Bullet makes of both meshes."""
GYRATION = 0.037
"""How far from its middle the friction of the table acts on a cube that turns [m]: 0.025 if all of its face carried it,
0.046 if only the corners did; fitted to where it went when it was pushed."""
UNIT = 0.05
"""Of length in the systems [m], so that states are about 1."""
TOUCHING = 0.006
"""Largest gap [m] at which a tip may touch the cube within a step."""
REMEMBERED = 14
"""Steps, more than the oldest pose."""


def pushing(friction: float, compliance: float, cone: Cone) -> PlanarPushing:
    """Make the cube from above, pushed by one tip; quasi-static, in units of `UNIT`."""
    half = HALF / UNIT
    return PlanarPushing(
        box(-half, half, -half, half),
        TIP_RADIUS / UNIT,
        friction=friction,
        compliance=compliance,
        gyration=GYRATION / UNIT,
        cone=cone,
    )


def box_distance(points: Array) -> Array:
    """Compute the distance (n,) of points (n, 2) in the cube's frame from its outline [m], negative inside."""
    beyond = np.abs(points) - HALF
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)


def planar_pose(position: Array, quaternion: Array) -> Array:
    """Compute x, y and yaw of a cube that stands on any of its faces; the yaw is one of four.

    Args:
        position: (3,) [m].
        quaternion: (4,) x, y, z, w.
    """
    x, y, z, w = quaternion
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    side = (int(np.argmax(np.abs(rotation[2]))) + 1) % 3  # an axis that is not the vertical one
    return np.array([position[0], position[1], np.arctan2(rotation[1, side], rotation[0, side])])


class CubeEstimator:
    """Follows the cube: `pose = estimator.update(camera_observation, tips)` at each step.

    Args:
        friction: between tip and cube.
    """

    def __init__(self, friction: float) -> None:
        # Anitescu's cone would push the cube away from tips that slide along it.
        self.model = pushing(friction, 0.02, "stewart-trinkle")
        self.reset()

    def reset(self) -> None:
        """Forget the cube, as at the begin of an episode."""
        self.pose: Array | None = None
        self._age = np.inf
        self._tips: deque[Array] = deque(maxlen=REMEMBERED)

    def update(self, camera: dict[str, Any], tips: Array) -> Array:
        """Estimate the pose (3,) of the cube now: x, y [m], yaw [rad], continuous.

        Args:
            camera: the part `camera_observation` of an observation.
            tips: (3, 3) places of the tips [m].
        """
        self._tips.append(tips.copy())
        age = float(camera["delay"][0])
        if self.pose is None or age < self._age:  # a new picture
            pose = planar_pose(camera["object_position"].astype(float), camera["object_orientation"].astype(float))
            before = pose[2] if self.pose is None else self.pose[2]
            pose[2] = before + (pose[2] - before + np.pi / 4) % (np.pi / 2) - np.pi / 4
            since = min(round(age / STEP), len(self._tips) - 1)
            way = list(self._tips)[len(self._tips) - 1 - since :]
        else:
            pose, way = self.pose, list(self._tips)[-2:]
        for first, second in pairwise(way):
            pose = self._step(pose, first, second)
        self.pose, self._age = pose, age
        return pose

    def _step(self, pose: Array, first: Array, second: Array) -> Array:
        """Predict the pose after the tips have gone from `first` to `second`."""
        gaps = box_distance((first[:, :2] - pose[:2]) @ planar_turn(pose[2])) - TIP_RADIUS
        gaps[np.maximum(first[:, 2], second[:, 2]) > HEIGHT + 0.01] = np.inf
        tip = int(gaps.argmin())
        if gaps[tip] > TOUCHING:
            return pose
        moved = torch.from_numpy((second - first)[tip, :2] / UNIT)
        x = torch.from_numpy(np.concatenate([pose[:2] / UNIT, pose[2:], first[tip, :2] / UNIT]))
        with torch.no_grad():
            after = self.model.params(x).step(x, moved).x_next.numpy()
        return np.array([after[0] * UNIT, after[1] * UNIT, after[2]])
