"""Geometry of the fingers of the TriFinger Pro, that of `trifinger_lift.py`."""

import numpy as np
import trifinger_lift
from numpy.typing import NDArray

Array = NDArray[np.float64]

N_FINGERS, STEP = len(trifinger_lift.TURNS), trifinger_lift.STEP


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
    angles, knee = trifinger_lift.inverse(finger, tips, trifinger_lift.OFFSETS[0])
    possible = ((angles >= trifinger_lift.LOW) & (angles <= trifinger_lift.HIGH)).all(1, keepdims=True)
    return np.where(possible, angles, np.nan), np.where(possible, knee, np.nan)
