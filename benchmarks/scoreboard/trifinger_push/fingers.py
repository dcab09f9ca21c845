"""Geometry of the fingers of the TriFinger Pro: where the joints and the knee are when a tip is somewhere.

A finger has three joints: the first turns it about a horizontal axis y through the middle of the holder, the other two
bend it in the plane that the first has turned. All lengths are those of trifingerpro.urdf. Finger 0 is described; the
others are turned about the vertical by ∓120°.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

N_FINGERS = 3
STEP = 0.02
"""Of the environment [s]."""
TURNS = (0.0, -2 * np.pi / 3, 2 * np.pi / 3)
"""About the vertical, of each finger [rad]."""
HEIGHT = 0.29
"""Of the first joint [m]."""
HIP = 0.0505
"""From the middle to the second joint, along y [m]."""
LINKS = (0.16, 0.16)
"""From the second joint to the third, and from there to the tip, in the plane of the finger [m]."""
OFFSETS = (0.067, 0.086)
"""Of the third joint and of the tip from the axis of the first, perpendicular to that plane [m]."""
LOW, HIGH = np.array([-0.33, 0.0, -2.7]), np.array([1.0, 1.57, 0.0])
"""Limits of the joints [rad]."""


def planar_turn(angle: float) -> Array:
    """Make a (2, 2) rotation matrix."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def inverse(finger: int, tips: Array) -> tuple[Array, Array]:
    """Compute the inverse kinematics of one finger.

    Args:
        finger: 0, 1 or 2.
        tips: (n, 3) places of its tip [m].

    Returns:
        Joint angles (n, 3) [rad] and places of the knee (n, 3) [m], not a number where the tip cannot be.
    """
    turn = planar_turn(TURNS[finger])
    x, y = (tips[:, :2] @ turn).T
    z = tips[:, 2] - HEIGHT
    with np.errstate(invalid="ignore"):
        down = np.sqrt(x**2 + z**2 - OFFSETS[1] ** 2)  # in the plane of the finger, below the axis of the first joint
        first = np.arctan2(z, x) + np.arctan2(down, OFFSETS[1])
        out = y - HIP
        bend = (out**2 + down**2 - LINKS[0] ** 2 - LINKS[1] ** 2) / (2 * LINKS[0] * LINKS[1])
        third = -np.arccos(bend)
        lower = LINKS[1] * np.sin(third)
        second = np.arctan2(out, down) - np.arctan2(lower, LINKS[0] + LINKS[1] * np.cos(third))
        angles = np.stack([-first, second, third], 1)
        angles[~((angles >= LOW) & (angles <= HIGH)).all(1)] = np.nan
    first, second = -angles[:, 0], angles[:, 1]
    depth = -LINKS[0] * np.cos(second)
    c, s = np.cos(first), np.sin(first)
    knee = np.stack([OFFSETS[0] * c - depth * s, HIP + LINKS[0] * np.sin(second), OFFSETS[0] * s + depth * c], 1)
    knee[:, 2] += HEIGHT
    knee[:, :2] = knee[:, :2] @ turn.T
    return angles, knee
