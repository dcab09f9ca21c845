"""Closed-form forward and inverse kinematics of the three fingers.

In the frame of a finger (x sideways, y radially outward, z up, origin at the mount) both links lie in a plane that
joint 0 turns about y. With theta = -q1 and phi = q2 - q1 the angles of the two links from straight down,

    y = L (sin theta + sin phi),   h = L (cos theta + cos phi),   x = -h sin q0,   z = -h cos q0,

where h > 0 is the depth of the tip below the mount within that plane.
"""

import numpy as np

from difflcs_envs.trifinger.model import FINGER_YAWS, JOINT_RANGES, LINK_LENGTH, MOUNT_HEIGHT, MOUNT_RADIUS

# Rows: the axes of each finger frame in the world, (3 fingers, 3 axes, 3).
FINGER_AXES = np.array([[[np.cos(a), np.sin(a), 0.0], [-np.sin(a), np.cos(a), 0.0], [0, 0, 1]] for a in FINGER_YAWS])
MOUNTS = MOUNT_RADIUS * FINGER_AXES[:, 1] + [0.0, 0.0, MOUNT_HEIGHT]  # (3, 3) [m]


def tip_positions(joints: np.ndarray) -> np.ndarray:
    """Compute fingertip positions from joint angles.

    Args:
        joints: Joint angles [rad], (3 fingers, 3 joints).

    Returns:
        World positions [m], (3 fingers, 3).
    """
    swing, lift, knee = np.asarray(joints, dtype=np.float64).T
    depth = LINK_LENGTH * (np.cos(-lift) + np.cos(knee - lift))
    outward = LINK_LENGTH * (np.sin(-lift) + np.sin(knee - lift))
    local = np.stack([-depth * np.sin(swing), outward, -depth * np.cos(swing)], axis=1)
    return MOUNTS + np.einsum("fi,fij->fj", local, FINGER_AXES)


def joint_angles(tips: np.ndarray) -> np.ndarray:
    """Compute joint angles for fingertip positions, knees bent outward (q2 <= 0) as in the start posture.

    Args:
        tips: World positions [m] below the mounts, (3 fingers, 3).

    Returns:
        Joint angles [rad], (3 fingers, 3 joints).

    Raises:
        ValueError: A position is out of reach or breaks a joint limit.
    """
    tips = np.asarray(tips, dtype=np.float64)
    local = np.einsum("fij,fj->fi", FINGER_AXES, tips - MOUNTS)
    swing = np.arctan2(-local[:, 0], -local[:, 2])
    depth = np.hypot(local[:, 0], local[:, 2])
    distance = np.hypot(local[:, 1], depth)
    for finger in np.flatnonzero(distance > 2 * LINK_LENGTH):
        raise ValueError(
            f"Fingertip {finger} cannot reach {tips[finger].round(4).tolist()} m: it is {distance[finger]:.4f} m from "
            f"the finger's mount and the leg is {2 * LINK_LENGTH} m long. Choose a position nearer to the home "
            "position of this finger."
        )
    # Two links of equal length: the line from mount to tip halves the angle between them.
    knee = -2.0 * np.arccos(distance / (2 * LINK_LENGTH))
    lift = knee / 2 - np.arctan2(local[:, 1], depth)
    joints = np.stack([swing, lift, knee], axis=1)
    outside = (joints < JOINT_RANGES[:, 0]) | (joints > JOINT_RANGES[:, 1])
    for finger, joint in np.argwhere(outside):
        low, high = JOINT_RANGES[joint]
        raise ValueError(
            f"Fingertip {finger} cannot reach {tips[finger].round(4).tolist()} m: joint {joint} would need "
            f"{joints[finger, joint]:.3f} rad and its range is [{low:.3f}, {high:.3f}] rad. Choose a position nearer "
            "to the home position of this finger."
        )
    return joints
