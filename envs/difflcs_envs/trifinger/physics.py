"""The simulated robot and object, without any task: reset, step, read-out, save and restore."""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math

import mujoco
import numpy as np

from difflcs_envs.trifinger import kinematics
from difflcs_envs.trifinger.model import (
    NUM_FINGERS,
    SUBSTEPS,
    TIMESTEP,
    TIP_HEIGHT,
    SceneObject,
    build_spec,
)
from difflcs_envs.trifinger.osc import OperationalSpaceController

__all__ = ["TriFingerPhysics"]

CONTROL_PERIOD = TIMESTEP * SUBSTEPS  # [s] one action
# The posture before the tips go down to TIP_HEIGHT; reset noise acts on its joints.
START_POSTURE = np.tile([0.0, -1.0, -1.5], (NUM_FINGERS, 1))  # [rad]
HOME_TIP_RADIUS = 0.0977  # [m] where the tips settle from the start posture
# An object or a tip farther out than this has left the robot's world (tips reach at most 0.36 m).
WORKSPACE_RADIUS = 0.5  # [m]
# Deepest overlap of two bodies that a given start state may have. Random extreme actions make up to 2.2 mm, and states
# met in an episode must be good for another start.
MAX_START_PENETRATION = 0.004  # [m]

_STATE_SIGNATURE = mujoco.mjtState.mjSTATE_INTEGRATION
_INSTABILITY_WARNINGS = [
    int(warning)
    for warning in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
        mujoco.mjtWarning.mjWARN_BADCTRL,
    )
]


class TriFingerPhysics:
    """One robot, one object, one controller.

    Attributes:
        model: The MuJoCo model.
        data: The MuJoCo data. After `reset` and `step` all positions (`xpos`, `site_xpos`, ...) are up to date.
        controller: The operational-space controller of the tips.
        home_tips: Home positions of the tips in the plane [m], (3, 2).
    """

    def __init__(
        self, scene_object: SceneObject, kp: float = 1000.0, max_picture_size: tuple[int, int] = (640, 480)
    ) -> None:
        """Build the scene.

        Args:
            scene_object: The object to push.
            kp: Stiffness of the operational-space controller [1/s^2].
            max_picture_size: Largest width and height [pixel] that will be rendered.
        """
        self.rest_height = scene_object.rest_height
        self.model: mujoco.MjModel = build_spec(scene_object, max_picture_size).compile()
        self.data = mujoco.MjData(self.model)
        self.controller = OperationalSpaceController(self.model, self.data, kp)
        directions = kinematics.FINGER_AXES[:, 1, :2]
        self.home_tips = HOME_TIP_RADIUS * directions
        first_site = self.model.site("tip_0").id
        self._tips = self.data.site_xpos[first_site : first_site + NUM_FINGERS]  # a view
        self._goal = int(self.model.body("goal").mocapid[0])
        self._object_qpos = int(self.model.joint("object").qposadr[0])
        self._finger_qpos = int(self.model.joint("joint_0_0").qposadr[0])
        self._saved = np.empty(mujoco.mj_stateSize(self.model, _STATE_SIGNATURE))

    # --- reset ------------------------------------------------------------------------------------

    def tips_from_noise(self, joint_noise: np.ndarray) -> np.ndarray:
        """Where the tips come down when the joints of the start posture are disturbed.

        Lowering keeps a tip's place in the plane, so it moves by what the disturbance moves it in the start posture.

        Args:
            joint_noise: Disturbance [rad], (3 fingers, 3 joints).

        Returns:
            Tip positions in the plane [m], (3, 2).
        """
        shift = kinematics.tip_positions(START_POSTURE + joint_noise) - kinematics.tip_positions(START_POSTURE)
        return self.home_tips + shift[:, :2]

    def reset(self, object_pose: np.ndarray, tips: np.ndarray) -> None:
        """Put object and fingers at rest in a given pose.

        Args:
            object_pose: x [m], y [m], yaw [rad] of the object, which rests on the table.
            tips: Tip positions in the plane [m], (3, 2), at the height TIP_HEIGHT.

        Raises:
            ValueError: A tip is out of reach, or bodies would overlap.
        """
        heights = np.full((NUM_FINGERS, 1), TIP_HEIGHT)
        joints = kinematics.joint_angles(np.hstack([tips, heights]))
        x, y, yaw = (float(v) for v in object_pose)
        if math.hypot(x, y) > WORKSPACE_RADIUS:
            raise ValueError(
                f"The object cannot stand at ({x:.3f}, {y:.3f}) m: expected it within {WORKSPACE_RADIUS} m of "
                "the middle. Choose a position that the fingers can reach."
            )
        mujoco.mj_resetData(self.model, self.data)
        i = self._object_qpos
        self.data.qpos[i : i + 7] = (x, y, self.rest_height, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        # The posture of `mj_resetData` (straight legs) is singular: set the joints before the controller is asked.
        self.data.qpos[self._finger_qpos : self._finger_qpos + joints.size] = joints.ravel()
        mujoco.mj_forward(self.model, self.data)
        overlap = self.max_penetration()
        if overlap > MAX_START_PENETRATION:
            raise ValueError(
                f"The start state is impossible: bodies overlap by {1e3 * overlap:.1f} mm (at most "
                f"{1e3 * MAX_START_PENETRATION:.0f} mm allowed). Keep the fingertips (radius 9.5 mm) outside "
                "the object and apart from each other."
            )

    def set_goal(self, goal_pose: np.ndarray) -> None:
        """Move the transparent goal to x [m], y [m], yaw [rad]. It takes no part in the physics."""
        x, y, yaw = (float(v) for v in goal_pose)
        self.data.mocap_pos[self._goal] = (x, y, self.rest_height)
        self.data.mocap_quat[self._goal] = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        mujoco.mj_kinematics(self.model, self.data)

    # --- step -------------------------------------------------------------------------------------

    def step(self, displacement: np.ndarray) -> bool:
        """Pull the tips by a displacement from where they are, at constant height, for one control period (0.1 s).

        Args:
            displacement: x and y of every tip [m], (6,).

        Returns:
            True. False if the simulation became unstable: then the state from before this step is restored.
        """
        model, data, control = self.model, self.data, self.controller.apply
        first_half, second_half = mujoco.mj_step1, mujoco.mj_step2
        self._save()
        end_time = data.time + CONTROL_PERIOD
        target = self._tips.copy()
        target[:, :2] += displacement.reshape(NUM_FINGERS, 2)
        target[:, 2] = TIP_HEIGHT
        self.controller.target = target.ravel().tolist()
        try:
            for _ in range(SUBSTEPS):
                first_half(model, data)
                control()
                second_half(model, data)
        except (OverflowError, np.linalg.LinAlgError):  # the controller met non-finite numbers
            stable = False
        else:
            # Integration leaves the positions of bodies and sites one substep behind the joints.
            mujoco.mj_kinematics(model, data)
            stable = self._is_sane(end_time)
        if not stable:
            self._restore()
        return stable

    def _is_sane(self, end_time: float) -> bool:
        # MuJoCo answers NaN or huge numbers by a warning and by resetting the data, the clock with them.
        if abs(self.data.time - end_time) > 0.5 * TIMESTEP or self.data.warning.number[_INSTABILITY_WARNINGS].any():
            return False
        i = self._object_qpos
        positions = [*self.data.qpos[i : i + 2].tolist(), *self._tips.ravel().tolist()]
        # Written so that NaN fails.
        return all(abs(p) <= WORKSPACE_RADIUS for p in positions)

    # --- read-out ---------------------------------------------------------------------------------

    def state(self) -> np.ndarray:
        """Object x, y [m], yaw [rad] in (-pi, pi], then x, y [m] of tips 0, 1, 2. A new array, (9,)."""
        i = self._object_qpos
        x, y, _, qw, qx, qy, qz = self.data.qpos[i : i + 7].tolist()
        state = np.empty(3 + 2 * NUM_FINGERS)
        state[:3] = x, y, math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        state[3:] = self._tips[:, :2].ravel()
        return state

    def max_penetration(self) -> float:
        """Deepest overlap of two bodies [m] at the last collision detection; 0 without contact."""
        contacts = self.data.contact.dist
        return max(0.0, -float(contacts.min())) if len(contacts) else 0.0

    # --- save and restore -------------------------------------------------------------------------

    def _save(self) -> None:
        mujoco.mj_getState(self.model, self.data, self._saved, _STATE_SIGNATURE)

    def _restore(self) -> None:
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, self._saved, _STATE_SIGNATURE)
        mujoco.mj_kinematics(self.model, self.data)

    def get_full_state(self) -> np.ndarray:
        """Everything that the next steps depend on, as one vector."""
        self._save()
        return self._saved.copy()

    def set_full_state(self, full_state: np.ndarray) -> None:
        """Go back to a state from `get_full_state`."""
        self._saved[:] = full_state
        self._restore()
