"""The simulated robot and object, without any task: reset, step, read-out, save and restore."""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from difflcs_envs.trifinger import kinematics
from difflcs_envs.trifinger.model import NUM_FINGERS, PIVOT_RANGE, SUBSTEPS, TIMESTEP, SceneObject, build_spec
from difflcs_envs.trifinger.native import make_lane, step_lanes
from difflcs_envs.trifinger.osc import SINGULAR_DAMPING, SINGULAR_DETERMINANT, controller_fields

STATE_SIZE = 3 + 2 * NUM_FINGERS
CONTROL_PERIOD = TIMESTEP * SUBSTEPS  # [s] one action
# The posture before the tips go down to their height; reset noise acts on its joints.
START_POSTURE = np.tile([0.0, -1.0, -1.5], (NUM_FINGERS, 1))  # [rad]
HOME_TIP_RADIUS = 0.0977  # [m] where the tips settle from the start posture
START_CLEARANCE = 0.021  # [m] at least this far out from the object (tip radius 9.5 mm) do the tips start
# An object or a tip farther out than this has left the robot's world (tips reach at most 0.36 m).
WORKSPACE_RADIUS = 0.5  # [m]
# Deepest overlap of two bodies in a start state of the user. Random extreme actions make up to 2.2 mm, and states of
# an episode must be usable as another start.
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
    """One robot, one object, one controller, which steps compiled.

    Attributes:
        model: The MuJoCo model.
        data: The MuJoCo data. After `reset` and `step` all positions (`xpos`, `site_xpos`, ...) are up to date.
        lane: The compiled stepper of this simulation.
    """

    def __init__(
        self,
        scene_object: SceneObject,
        kp: float,
        max_picture_size: tuple[int, int],
        model: mujoco.MjModel | None = None,
    ) -> None:
        """Build the scene.

        Args:
            scene_object: The object to push.
            kp: Stiffness of the operational-space controller [1/s^2].
            max_picture_size: Largest width and height [pixel] that will be rendered.
            model: The model of another simulation of the same scene, to share; None builds one.
        """
        self.object = scene_object
        self.tip_height = scene_object.tip_height
        self.model: mujoco.MjModel = model or build_spec(scene_object, max_picture_size).compile()
        self.data = mujoco.MjData(self.model)
        first_site = self.model.site("tip_0").id
        self._tips = self.data.site_xpos[first_site : first_site + NUM_FINGERS]  # views
        self._object_position = self.data.xpos[self.model.body("object").id]
        self._object_quaternion = self.data.xquat[self.model.body("object").id]
        self._goal = int(self.model.body("goal").mocapid[0])
        self._object_qpos = int(self.model.joint("object").qposadr[0])
        self._finger_qpos = int(self.model.joint("joint_0_0").qposadr[0])
        self._saved = np.empty(mujoco.mj_stateSize(self.model, _STATE_SIGNATURE))
        self._directions = kinematics.FINGER_AXES[:, 1, :2]  # outward, (3, 2)
        self._outline = scene_object.outline
        self.lane = make_lane(
            self.model,
            self.data,
            controller_fields(self.model, self.data)
            | {
                "object_position": self._object_position,
                "object_quaternion": self._object_quaternion,
                "saved": self._saved,
            },
            _INSTABILITY_WARNINGS,
            {
                "kp": float(kp),
                "kd": 2.0 * math.sqrt(kp),
                "singular_determinant": SINGULAR_DETERMINANT,
                "singular_damping": SINGULAR_DAMPING,
                "tip_height": self.tip_height,
                "timestep": TIMESTEP,
                "workspace_radius": WORKSPACE_RADIUS,
                "substeps": SUBSTEPS,
                "time_signature": int(mujoco.mjtState.mjSTATE_TIME),
                "save_signature": int(_STATE_SIGNATURE),
            },
        )

    def check_fit(self) -> None:
        """Raise ValueError if the fingers cannot stand around the object in its home pose."""
        heights = np.full((NUM_FINGERS, 1), self.tip_height)
        try:
            kinematics.joint_angles(np.hstack([self.home_tips(np.zeros(3)), heights]))
        except ValueError as error:
            width, depth = np.ptp(self._outline, axis=0)
            raise ValueError(
                f"Expected an object that the fingers can stand around, got {self.object.name} of {1e3 * width:.0f} x "
                f"{1e3 * depth:.0f} mm, which is too large. Choose a smaller object, or another mesh_scale."
            ) from error

    # --- reset ------------------------------------------------------------------------------------

    def home_tips(self, object_pose: np.ndarray) -> np.ndarray:
        """Places in the plane [m], (3, 2), where the tips start: at the home radius, or outside a long object.

        Args:
            object_pose: x [m], y [m], yaw [rad] of the object.
        """
        x, y, yaw = (float(v) for v in object_pose)
        cosine, sine = math.cos(yaw), math.sin(yaw)
        turn = np.array([[cosine, -sine], [sine, cosine]])
        # No point of the object is farther out along the ray of a finger.
        support = (self._directions @ turn @ self._outline.T).max(axis=1) + self._directions @ (x, y)
        return np.maximum(HOME_TIP_RADIUS, support + START_CLEARANCE)[:, None] * self._directions

    def tips_from_noise(self, joint_noise: np.ndarray, object_pose: np.ndarray) -> np.ndarray:
        """Compute where the tips come down when the joints of the start posture are disturbed.

        Lowering keeps a tip's place in the plane, so it moves by what the disturbance moves it in the start posture.

        Args:
            joint_noise: Disturbance [rad], (3 fingers, 3 joints).
            object_pose: x [m], y [m], yaw [rad] of the object.

        Returns:
            Tip positions in the plane [m], (3, 2).
        """
        shift = kinematics.tip_positions(START_POSTURE + joint_noise) - kinematics.tip_positions(START_POSTURE)
        return self.home_tips(object_pose) + shift[:, :2]

    def reset(self, object_pose: np.ndarray, tips: np.ndarray) -> None:
        """Put object and fingers at rest in a pose.

        Args:
            object_pose: x [m], y [m], yaw [rad] of the object, which rests on the table.
            tips: Tip positions in the plane [m], (3, 2), at the tips' height.

        Raises:
            ValueError: A tip is out of reach, or bodies would overlap.
        """
        heights = np.full((NUM_FINGERS, 1), self.tip_height)
        joints = kinematics.joint_angles(np.hstack([tips, heights]))
        x, y, yaw = (float(v) for v in object_pose)
        if math.hypot(x, y) > WORKSPACE_RADIUS:
            raise ValueError(
                f"The object cannot stand at ({x:.3f}, {y:.3f}) m: expected it within {WORKSPACE_RADIUS} m of "
                "the middle. Choose a position that the fingers can reach."
            )
        if self.object.pinned and (max(abs(x), abs(y)) > 1e-6 or abs(yaw) > PIVOT_RANGE):
            raise ValueError(
                f"The object turns about the middle: expected x = y = 0 and |yaw| <= {PIVOT_RANGE} rad, got "
                f"({x:.3f} m, {y:.3f} m, {yaw:.3f} rad). Choose such a pose."
            )
        mujoco.mj_resetData(self.model, self.data)
        i = self._object_qpos
        if self.object.pinned:
            self.data.qpos[i] = yaw
        else:
            height = self.object.rest_height
            self.data.qpos[i : i + 7] = (x, y, height, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
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
        self.data.mocap_pos[self._goal] = (x, y, self.object.rest_height)
        self.data.mocap_quat[self._goal] = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        mujoco.mj_kinematics(self.model, self.data)

    # --- step -------------------------------------------------------------------------------------

    def step(self, displacement: np.ndarray) -> np.ndarray | None:
        """Pull the tips by a displacement from where they are, at constant height, for one control period (0.1 s).

        Args:
            displacement: x and y of every tip [m], (6,).

        Returns:
            The state after it, see `state`. None if the simulation became unstable: then the state from before this
            step is restored.
        """
        return step_all([self], displacement[None], threads=1)[0]

    # --- read-out ---------------------------------------------------------------------------------

    def state(self) -> np.ndarray:
        """Object x, y [m], yaw [rad] in (-pi, pi], then x, y [m] of tips 0, 1, 2. A new array, (9,)."""
        qw, qx, qy, qz = self._object_quaternion.tolist()
        state = np.empty(STATE_SIZE)
        state[:2] = self._object_position[:2]
        state[2] = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        state[3:] = self._tips[:, :2].ravel()
        return state

    def max_penetration(self) -> float:
        """Return the deepest overlap of two bodies [m] at the last collision detection; 0 without contact."""
        contacts = self.data.contact.dist
        return max(0.0, -float(contacts.min())) if len(contacts) else 0.0

    # --- save and restore -------------------------------------------------------------------------

    def restore(self) -> None:
        """Go back to the state before the last step."""
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, self._saved, _STATE_SIGNATURE)
        mujoco.mj_kinematics(self.model, self.data)

    def get_full_state(self) -> np.ndarray:
        """Return everything that the next steps depend on, as one vector."""
        mujoco.mj_getState(self.model, self.data, self._saved, _STATE_SIGNATURE)
        return self._saved.copy()

    def set_full_state(self, full_state: np.ndarray) -> None:
        """Go back to a state from `get_full_state`."""
        self._saved[:] = full_state
        self.restore()


def step_all(
    simulations: Sequence[TriFingerPhysics], displacements: np.ndarray, threads: int
) -> list[np.ndarray | None]:
    """Do `TriFingerPhysics.step` in several simulations, in native threads.

    Args:
        simulations: The simulations, each once.
        displacements: x and y of every tip [m], (n, 6).
        threads: Most threads to use.

    Returns:
        The state after it of every simulation, None where it became unstable and was restored.
    """
    lanes = [simulation.lane for simulation in simulations]
    states, stable = np.empty((len(simulations), STATE_SIZE)), np.empty(len(simulations), dtype=bool)
    step_lanes(lanes, np.ascontiguousarray(displacements, dtype=np.float64), states, stable, threads)
    result: list[np.ndarray | None] = list(states)
    for i in np.flatnonzero(~stable).tolist():
        simulations[i].restore()
        result[i] = None
    return result
