"""The TriFinger tasks as Gymnasium environments: move a cube, move an object, turn a cube."""

from __future__ import annotations

import copy
import math
import numbers
import os
import time
import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np

from difflcs_envs.errors import MissingDependencyError, OptionsError, PhysicsWarning, RenderingError
from difflcs_envs.trifinger.rendering import SceneRenderer, SceneViewer, has_display, select_gl_backend
from difflcs_envs.trifinger.task import MoveTask
from difflcs_envs.ycb import YCB

select_gl_backend()  # before the first import of MuJoCo
try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.error import ResetNeeded
except ImportError as error:
    raise MissingDependencyError("gymnasium") from error
try:
    from difflcs_envs.trifinger.model import CubeObject, SceneObject
    from difflcs_envs.trifinger.objects import make_object
    from difflcs_envs.trifinger.physics import CONTROL_PERIOD, STATE_SIZE, WORKSPACE_RADIUS, TriFingerPhysics
except ImportError as error:
    if (error.name or "").partition(".")[0] != "mujoco":
        raise
    raise MissingDependencyError("mujoco") from error

__all__ = ["TriFingerEnv", "TriFingerMoveCubeEnv", "TriFingerMoveObjectEnv", "TriFingerTurnCubeEnv"]

ACTION_SIZE = 6  # x, y of three tips
ACTION_MEANING = "[tip 0 x, y, tip 1 x, y, tip 2 x, y] in m"
GOAL_SIZE = 3  # x, y, yaw
ACTION_LIMIT = 0.015  # [m] per component and step
# Bound of the observed yaw [rad]: four turns either way. One action turns a cube by a third of a radian at most.
YAW_LIMIT = 8 * math.pi

MIN_GOAL_BOUND = 1e-3  # Gymnasium wants spaces of some extent even where a goal is fixed (turning: x and y)
REWARD_TERMS = ("tips", "position", "yaw", "action")
TURN_CUBE_EDGE = 0.07  # [m] of the turning task (Jin & Posa 2024)
TURN_YAW_HIGH = 1.5  # [rad]
UNSTABLE = (
    "The simulation became unstable (not finite, or out of the workspace). The episode is truncated at the last finite "
    "state. A smaller osc_kp or a heavier object makes this less likely."
)

# Reset noise of 1 disturbs by at most this much.
JOINT_NOISE = 0.2  # [rad]
POSITION_NOISE = 0.1  # [m]
YAW_NOISE = 0.5  # [rad]
# Above this the fingers could start inside the object.
MAX_RESET_NOISE = 0.2
MAX_OSC_KP = 1e5  # [1/s^2]; the controller with 2 ms substeps is stable below kd * dt = 2, kp = 2.5e5


class TriFingerEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """What the TriFinger tasks have in common. The tasks below say what they do; make one of those.

    Attributes:
        task: Goals, errors, success and reward.
        object: What the fingers push; `object.source` says where its shape comes from.
        physics: The simulation.
    """

    metadata: ClassVar[dict[str, Any]] = {
        # A window is offered only where one can be opened.
        "render_modes": ["rgb_array", "human"] if has_display() else ["rgb_array"],
        "render_fps": round(1 / CONTROL_PERIOD),
    }

    def __init__(
        self,
        scene_object: SceneObject,
        task: MoveTask,
        render_mode: str | None,
        osc_kp: float,
        horizon: int,
        reset_noise: float,
        observe_time: bool,
        width: int,
        height: int,
    ) -> None:
        if render_mode == "human" and not has_display():
            raise RenderingError(
                'render_mode="human" opens a window and this machine has no display (DISPLAY and WAYLAND_DISPLAY are '
                'unset). Use render_mode="rgb_array".'
            )
        if render_mode not in (None, "rgb_array", "human"):
            raise ValueError(
                f'Expected render_mode None, "rgb_array" or "human", got {render_mode!r}. Choose one of them.'
            )
        self.render_mode = render_mode
        self.object = scene_object
        self.task = task
        self.osc_kp = _checked_number("osc_kp", osc_kp, low=0.0, high=MAX_OSC_KP, low_open=True)
        self.horizon = _checked_integer("horizon", horizon)
        self.reset_noise = _checked_number("reset_noise", reset_noise, low=0.0, high=MAX_RESET_NOISE)
        self.observe_time = bool(observe_time)
        self.width = _checked_integer("width", width)
        self.height = _checked_integer("height", height)

        self.action_space = spaces.Box(-ACTION_LIMIT, ACTION_LIMIT, (ACTION_SIZE,), dtype=np.float64)
        state_high = np.full(STATE_SIZE, WORKSPACE_RADIUS)
        state_high[2] = YAW_LIMIT
        goal_high = np.maximum(task.goal_high, MIN_GOAL_BOUND)
        observation: dict[str, spaces.Box] = {
            "state": spaces.Box(-state_high, state_high, dtype=np.float64),
            "goal": spaces.Box(-goal_high, goal_high, dtype=np.float64),
        }
        if self.observe_time:
            observation["time_to_go"] = spaces.Box(0.0, self.horizon * CONTROL_PERIOD, (1,), dtype=np.float64)
        self.observation_space = spaces.Dict(observation)  # pyright: ignore[reportAttributeAccessIssue, reportArgumentType]

        self.physics = self._make_physics()
        self.physics.check_fit()
        self._renderer: SceneRenderer | None = None
        self._viewer: SceneViewer | None = None
        self._last_frame_time = 0.0
        self._state = np.zeros(STATE_SIZE)
        self._goal = np.zeros(GOAL_SIZE)
        self._steps: int | None = None  # steps made in this episode; None: reset is needed

    def _make_physics(self, model: Any = None) -> TriFingerPhysics:
        return TriFingerPhysics(self.object, self.osc_kp, (self.width, self.height), model)

    def sibling(self) -> Self:
        """Another environment with the same settings, on the same MuJoCo model (building one takes long)."""
        other = copy.copy(self)
        other.physics = self._make_physics(self.physics.model)
        other._np_random = other._np_random_seed = None
        other._renderer = other._viewer = None
        other._state, other._goal, other._steps = np.zeros(STATE_SIZE), np.zeros(GOAL_SIZE), None
        return other

    @property
    def dt(self) -> float:
        """Duration of one step [s]."""
        return CONTROL_PERIOD

    @property
    def model(self) -> Any:
        """The MuJoCo model."""
        return self.physics.model

    @property
    def data(self) -> Any:
        """The MuJoCo data."""
        return self.physics.data

    # --- Gymnasium --------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the random generator; None goes on with the current one.
            options: May hold `goal` (3,) and `state` (9,), see the class.

        Returns:
            Observation and info.

        Raises:
            OptionsError: The options are no dictionary.
            ValueError: An option is unknown, has the wrong shape, or is outside what the robot and the task allow.
        """
        options = checked_options(options)
        super().reset(seed=seed)
        goal, state = options.pop("goal", None), options.pop("state", None)
        if options:
            raise ValueError(
                f"Expected only the options 'goal' and 'state', got also {sorted(options, key=str)}. Remove them."
            )
        # Always the same draws, so that an option given now does not change the episodes after it.
        joint_noise = self.np_random.uniform(-JOINT_NOISE, JOINT_NOISE, (3, 3))
        pose_noise = self.np_random.uniform(-1.0, 1.0, 3) * (POSITION_NOISE, POSITION_NOISE, YAW_NOISE)
        random_goal = self.task.sample_goal(self.np_random)

        self._steps = None  # an option that is refused below leaves no episode to step
        if goal is None:
            self._goal = random_goal
        else:
            goal = _checked_array("options['goal']", goal, GOAL_SIZE, "[x, y, yaw] of the goal in m, m, rad")
            self.task.check_goal(goal)
            self._goal = np.clip(goal, -np.array(self.task.goal_high), self.task.goal_high)
        if state is None:
            pose = self.reset_noise * pose_noise * ((0.0, 0.0, 1.0) if self.object.pinned else 1.0)
            tips = self.physics.tips_from_noise(self.reset_noise * joint_noise, pose)
        else:
            state = _checked_array(
                "options['state']",
                state,
                STATE_SIZE,
                "[object x, y, yaw, tip 0 x, y, tip 1 x, y, tip 2 x, y] in m and rad",
            )
            # The margin admits pi that went through float32.
            if abs(state[2]) > math.pi + 1e-6:
                raise ValueError(
                    f"Expected the yaw options['state'][2] in [-pi, pi], got {state[2]}. Subtract full turns (2 pi)."
                )
            pose, tips = state[:3], state[3:].reshape(3, 2)
        self.physics.reset(pose, tips)
        self.physics.set_goal(self._goal)
        self._state = self.physics.state()
        self._state[2] = _unwrap(self._state[2], float(pose[2]))
        self._steps = 0
        if self.render_mode == "human":
            self.render()
        return self._observation(), self._pose_info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Move the fingertips for 0.1 s.

        Args:
            action: Displacements of the fingertips [m], (6,).

        Returns:
            Observation, reward, terminated (always False), truncated, info.

        Raises:
            ValueError: The action has the wrong shape or is not finite.
            gymnasium.error.ResetNeeded: No episode is running.
        """
        if self._steps is None:
            raise ResetNeeded(
                "Expected a running episode, but it has ended or never began. Call reset() before step()."
            )
        given = _checked_array("action", action, ACTION_SIZE, ACTION_MEANING)
        executed = given.clip(-ACTION_LIMIT, ACTION_LIMIT)
        before, after = self._state, self.physics.step(executed)
        stable = after is not None
        self._state = continued(before, after) if stable else before.copy()
        self._steps += 1
        truncated = self._steps >= self.horizon or not stable

        reward, outcome = self.task.outcome(before, executed, self._state, self._goal, truncated)
        info: dict[str, Any] = {name: value.item() for name, value in outcome.items()}
        info["executed_action"] = executed
        info["clipped"] = bool((executed != given).any())
        info["physics_error"] = not stable
        if truncated:
            self._steps = None
        if not stable:
            warnings.warn(UNSTABLE, PhysicsWarning, stacklevel=2)
        if self.render_mode == "human":
            self.render()
        return self._observation(), float(reward), False, truncated, info

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the scene, the goal as a transparent cube.

        Returns:
            A picture, uint8 (height, width, 3), with `render_mode="rgb_array"`; otherwise None.

        Raises:
            RenderingError: Nothing can be drawn on this machine. The message says what to install.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() was called on an environment without render mode. Make it with "
                'gymnasium.make(..., render_mode="rgb_array").'
            )
            return None
        if self.render_mode == "human":
            if self._viewer is None:
                self._viewer = SceneViewer(self.physics.model, self.physics.data)
            self._viewer.render()
            # Real time: one step, one control period.
            time.sleep(max(0.0, self._last_frame_time + CONTROL_PERIOD - time.monotonic()))
            self._last_frame_time = time.monotonic()
            return None
        if self._renderer is None:
            self._renderer = SceneRenderer(self.physics.model, self.width, self.height)
        return self._renderer.render(self.physics.data)

    def close(self) -> None:
        """Free the renderer and the window. May be called again."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    # --- copies -----------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        members = self.__dict__.copy()
        # MuJoCo's objects and OpenGL stay behind: the copy builds its own and takes over the state of the simulation.
        members["physics"] = self.physics.get_full_state()
        members["_renderer"] = members["_viewer"] = None
        return members

    def __setstate__(self, members: dict[str, Any]) -> None:
        self.__dict__.update(members)
        full_state = members["physics"]
        self.physics = self._make_physics()
        self.physics.set_full_state(full_state)

    # --- helpers ----------------------------------------------------------------------------------

    def _observation(self) -> dict[str, np.ndarray]:
        observation = {"state": self._state.copy(), "goal": self._goal.copy()}
        if self.observe_time:
            left = 0 if self._steps is None else self.horizon - self._steps
            observation["time_to_go"] = np.array([left * CONTROL_PERIOD])
        return observation

    def _pose_info(self) -> dict[str, Any]:
        return {name: value.item() for name, value in self.task.pose_info(self._state, self._goal).items()}


class TriFingerMoveCubeEnv(TriFingerEnv):
    """Three fingers push a cube on a table to a goal pose.

    ## Description

    The TriFinger Moving Cube task of LCS-RL (Bui & Posa), simulated with MuJoCo. A hand with three fingers of three
    joints each stands above a table, on which lies a cube of 6 cm. The fingers must bring the cube to a goal position
    and yaw within 20 steps of 0.1 s. An action says how far each fingertip shall move in the plane; an
    operational-space controller turns it into joint torques and keeps the fingertips 3 cm above the table.

    The controller is compliant: with the default stiffness a fingertip reaches 83 % of its command within the step
    (96 % with `osc_kp=2500`), and a blocked fingertip pushes with 0.45 N (1.07 N).

    ## Action space

    `Box(-0.015, 0.015, (6,), float64)`: the displacement of each fingertip from where it is now. Actions outside the
    box are clipped to it; `info["executed_action"]` is what was executed, `info["clipped"]` says whether it differs.

    | Num | Action                         | Min    | Max   | Unit |
    |-----|--------------------------------|--------|-------|------|
    | 0   | displacement of fingertip 0, x | -0.015 | 0.015 | m    |
    | 1   | displacement of fingertip 0, y | -0.015 | 0.015 | m    |
    | 2   | displacement of fingertip 1, x | -0.015 | 0.015 | m    |
    | 3   | displacement of fingertip 1, y | -0.015 | 0.015 | m    |
    | 4   | displacement of fingertip 2, x | -0.015 | 0.015 | m    |
    | 5   | displacement of fingertip 2, y | -0.015 | 0.015 | m    |

    ## Observation space

    `Dict(goal=Box(3), state=Box(9))`, all float64, in the frame of the table (z up, origin below the hand).

    | Num | `state`           | Min    | Max   | Unit |
    |-----|-------------------|--------|-------|------|
    | 0   | cube x            | -0.5   | 0.5   | m    |
    | 1   | cube y            | -0.5   | 0.5   | m    |
    | 2   | cube yaw          | -8 pi  | 8 pi  | rad  |
    | 3   | fingertip 0, x    | -0.5   | 0.5   | m    |
    | 4   | fingertip 0, y    | -0.5   | 0.5   | m    |
    | 5   | fingertip 1, x    | -0.5   | 0.5   | m    |
    | 6   | fingertip 1, y    | -0.5   | 0.5   | m    |
    | 7   | fingertip 2, x    | -0.5   | 0.5   | m    |
    | 8   | fingertip 2, y    | -0.5   | 0.5   | m    |

    | Num | `goal`            | Min    | Max   | Unit |
    |-----|-------------------|--------|-------|------|
    | 0   | cube x            | -0.06  | 0.06  | m    |
    | 1   | cube y            | -0.06  | 0.06  | m    |
    | 2   | cube yaw          | -0.5   | 0.5   | rad  |

    The yaw is continuous within an episode: it starts in [-pi, pi] and each step adds the turn made, so that no jump
    by 2 pi disturbs a learned model or the cost. Beyond the bounds, which no push reaches, it is wrapped.

    ## Rewards

    The dense reward of step t is minus the path cost C(x_t, u_t) of the paper, at the state x_t *in which* the action
    was taken and the executed (clipped) action u_t. At the last step a penalty is added unless the final state x_T is
    a success. Each term is in `info` and the reward is their sum:

    | `info` key          | Value                                                             |
    |---------------------|-------------------------------------------------------------------|
    | `reward_tips`       | -10 (sum of squared distances of the fingertips to the cube's centre) |
    | `reward_position`   | -200 (squared distance of the cube to the goal position)          |
    | `reward_yaw`        | -0.3 (yaw - goal yaw)^2                                           |
    | `reward_action`     | -200 (squared norm of the executed action)                        |
    | `reward_completion` | -`sparse_penalty` at the last step without success, else 0        |

    Further entries of `info`, after `reset` and `step`, about the state that is returned: `success` (both errors within
    the tolerances), `position_error` [m], `yaw_error` [rad] (0 to pi, the smallest angle between the poses); after
    `step` also `executed_action` [m], `clipped` and `physics_error`.

    ## Starting state

    The cube lies at the origin, the fingertips are at a radius of 0.0977 m around it, everything at rest. `reset_noise`
    s disturbs this uniformly: the cube's position by up to 0.1 s m, its yaw by up to 0.5 s rad, and each joint of the
    posture from which the fingers come down by up to 0.2 s rad. The goal is uniform over the goal space. All depends on
    the seed only. `reset` takes the options

    - `goal`: x [m], y [m], yaw [rad] of the goal, inside the goal space;
    - `state`: a state (9,) to start from exactly, at rest; yaw in [-pi, pi].

    ## Episode end

    - Termination: never.
    - Truncation: after `horizon` steps. Also when the simulation becomes unstable: then the observation is the last
      finite state, `info["physics_error"]` is True and a `PhysicsWarning` is given.

    ## Arguments

    | Argument             | Default | Meaning                                                                        |
    |----------------------|---------|--------------------------------------------------------------------------------|
    | `render_mode`        | None    | "rgb_array", or "human" (a window; only where a display is)                    |
    | `osc_kp`             | 1000    | stiffness of the controller [1/s^2]; too soft above 0.45 N of resistance       |
    | `position_tolerance` | 0.02    | distance [m] that counts as success                                            |
    | `yaw_tolerance`      | 0.2     | angle [rad] that counts as success                                             |
    | `horizon`            | 20      | steps of an episode                                                            |
    | `object_mass`        | 0.01    | mass of the cube [kg]                                                          |
    | `object_friction`    | 0.5     | sliding friction of cube and table (fingertip and cube: at least 0.9)          |
    | `reset_noise`        | 0.05    | scale of the disturbed start, 0 to 0.2                                         |
    | `sparse_penalty`     | 10      | penalty for an episode that ends without success                               |
    | `reward_weights`     | None    | other weights than those above, such as `{"tips": 0, "action": 100}`            |
    | `observe_time`       | False   | adds `time_to_go` [s] to the observation, shape (1,)                           |
    | `width`, `height`    | 320, 240 | size of rendered pictures [pixel]                                             |

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        render_mode: str | None = None,
        osc_kp: float = 1000.0,
        position_tolerance: float = 0.02,
        yaw_tolerance: float = 0.2,
        horizon: int = 20,
        object_mass: float = 0.01,
        object_friction: float = 0.5,
        reset_noise: float = 0.05,
        sparse_penalty: float = 10.0,
        reward_weights: Mapping[str, float] | None = None,
        observe_time: bool = False,
        width: int = 320,
        height: int = 240,
    ) -> None:
        cube = CubeObject(
            mass=_checked_number("object_mass", object_mass, low=0.0, low_open=True),
            friction=_checked_number("object_friction", object_friction, low=0.0),
        )
        task = make_task(position_tolerance, yaw_tolerance, sparse_penalty, reward_weights)
        super().__init__(cube, task, render_mode, osc_kp, horizon, reset_noise, observe_time, width, height)


class TriFingerMoveObjectEnv(TriFingerEnv):
    """Three fingers push an everyday object on a table to a goal pose.

    ## Description

    The task of `TriFingerMoveCube-v0` with an object of the YCB set (Calli et al. 2015) or any mesh. The fingertips
    push at half the height of the object, 10.5 to 40 mm above the table, and start at least 21 mm away from it.

    The YCB meshes do not ship with this package. They are taken from the folder `DIFFLCS_YCB_DIR`, or from where
    `difflcs assets download` puts them. Without them primitive stand-ins of the same size, mass and resting height are
    used: `env.unwrapped.object.source` is then "stand_in" instead of "ycb_mesh", and results must say so
    (`env.unwrapped.object.describe()` has what belongs in a record).

    The paper gives no masses. With the default stiffness a fingertip pushes with 0.45 N, which moves no more than 90 g
    at the default friction, so all objects weigh 50 g unless asked otherwise; with `object_mass="true"` also raise
    `osc_kp` (2500 gives 1.07 N, 6000 gives 2.4 N).

    | `object`            | YCB name              | Published mass | Size at rest            |
    |---------------------|-----------------------|----------------|-------------------------|
    | `sugar_box`         | 004_sugar_box         | 514 g          | 176 x 92 x 45 mm        |
    | `fish_can`          | 007_tuna_fish_can     | 171 g          | 85 x 85 x 33 mm         |
    | `banana`            | 011_banana            | 66 g           | 198 x 69 x 36 mm        |
    | `mug`               | 025_mug               | 118 g          | 105 x 93 x 81 mm        |
    | `wrench`            | 042_adjustable_wrench | 252 g          | 203 x 58 x 13 mm        |
    | `clamp`             | 050_medium_clamp      | 59 g           | 85 x 77 x 26 mm         |
    | `large_clamp`       | 051_large_clamp       | 125 g          | 165 x 122 x 36 mm       |
    | `extra_large_clamp` | 052_extra_large_clamp | 202 g          | 202 x 165 x 35 mm       |

    The paper names no size of its clamp; `clamp` is the medium one.

    ## Action space, observation space, rewards, episode end

    As in `TriFingerMoveCube-v0`; read "object" for "cube". The object's position is that of its centre of mass, its yaw
    is 0 with the longest horizontal side along x (a mesh stored in its rest pose keeps the yaw it is stored with).

    ## Starting state

    As in `TriFingerMoveCube-v0`, but each fingertip starts at a radius of at least 0.0977 m and 21 mm outside the
    object.

    ## Arguments

    Those of `TriFingerMoveCube-v0` and:

    | Argument        | Default | Meaning                                                                             |
    |-----------------|---------|-------------------------------------------------------------------------------------|
    | `object`        | "mug"   | a name from the table, or the path of a mesh (.stl, .obj, .ply, ...)                |
    | `object_mass`   | 0.05    | mass [kg], or "true" for the published mass                                         |
    | `object_source` | "auto"  | "auto" (mesh if there, else stand-in), "mesh" (or an error), "stand_in"             |
    | `rest_pose`     | "lying" | "lying" (lowest), "upright" (highest), or the number of a stable pose, from below   |
    | `mesh_scale`    | 1.0     | length of one unit of the mesh file [m]; 0.001 for millimetres                      |
    | `mesh_parts`    | None    | most convex parts for the collisions of a mesh; None for our choice                 |

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        object: str | os.PathLike[str] = "mug",
        render_mode: str | None = None,
        osc_kp: float = 1000.0,
        position_tolerance: float = 0.02,
        yaw_tolerance: float = 0.2,
        horizon: int = 20,
        object_mass: float | str | None = None,
        object_friction: float = 0.5,
        object_source: str = "auto",
        rest_pose: str | int = "lying",
        mesh_scale: float = 1.0,
        mesh_parts: int | None = None,
        reset_noise: float = 0.05,
        sparse_penalty: float = 10.0,
        reward_weights: Mapping[str, float] | None = None,
        observe_time: bool = False,
        width: int = 320,
        height: int = 240,
    ) -> None:
        if not isinstance(object, str | os.PathLike):
            raise ValueError(f"Expected object to be a name or a path, got {object!r}. Choose one of {', '.join(YCB)}.")
        if not isinstance(object_mass, str | None):
            object_mass = _checked_number("object_mass", object_mass, low=0.0, low_open=True)
        scene_object = make_object(
            os.fspath(object),
            mass=object_mass,
            friction=_checked_number("object_friction", object_friction, low=0.0),
            source=object_source,
            rest_pose=rest_pose,
            parts=None if mesh_parts is None else _checked_integer("mesh_parts", mesh_parts),
            mesh_scale=_checked_number("mesh_scale", mesh_scale, low=0.0, low_open=True),
        )
        task = make_task(position_tolerance, yaw_tolerance, sparse_penalty, reward_weights)
        super().__init__(scene_object, task, render_mode, osc_kp, horizon, reset_noise, observe_time, width, height)


class TriFingerTurnCubeEnv(TriFingerEnv):
    """Three fingers turn a cube about a fixed vertical axis to a goal yaw.

    ## Description

    The turning task of Jin & Posa (2024), the prior work of LCS-RL: a cube of 7 cm on a pivot with a damping of
    0.01 N m s/rad and stops at 1.5008 rad either way.

    ## Action space, observation space, rewards, episode end

    As in `TriFingerMoveCube-v0`. The cube's x and y are always 0, the goal is (0, 0, yaw) with |yaw| <= 1.5 rad,
    and success is a matter of the yaw alone.

    ## Starting state

    As in `TriFingerMoveCube-v0`, with the cube on its pivot; a given `state` needs x = y = 0 and |yaw| <= 1.5008 rad.

    ## Arguments

    Those of `TriFingerMoveCube-v0`, but `position_tolerance`.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        render_mode: str | None = None,
        osc_kp: float = 1000.0,
        yaw_tolerance: float = 0.2,
        horizon: int = 20,
        object_mass: float = 0.01,
        object_friction: float = 0.5,
        reset_noise: float = 0.05,
        sparse_penalty: float = 10.0,
        reward_weights: Mapping[str, float] | None = None,
        observe_time: bool = False,
        width: int = 320,
        height: int = 240,
    ) -> None:
        cube = CubeObject(
            half_size=TURN_CUBE_EDGE / 2,
            mass=_checked_number("object_mass", object_mass, low=0.0, low_open=True),
            friction=_checked_number("object_friction", object_friction, low=0.0),
            pinned=True,
        )
        task = make_task(0.001, yaw_tolerance, sparse_penalty, reward_weights, goal_high=(0.0, 0.0, TURN_YAW_HIGH))
        super().__init__(cube, task, render_mode, osc_kp, horizon, reset_noise, observe_time, width, height)


def make_task(
    position_tolerance: float,
    yaw_tolerance: float,
    sparse_penalty: float,
    reward_weights: Mapping[str, float] | None,
    goal_high: tuple[float, float, float] = MoveTask.goal_high,
) -> MoveTask:
    """Check the arguments of a task and make it.

    Raises:
        ValueError: A number is out of range, or a reward weight has an unknown name.
    """
    weights = dict(reward_weights or {})
    if unknown := sorted(set(weights) - set(REWARD_TERMS), key=str):
        raise ValueError(
            f"Expected reward_weights for {', '.join(REWARD_TERMS)}, got also {unknown}. Choose among these terms."
        )
    return MoveTask(
        position_tolerance=_checked_number("position_tolerance", position_tolerance, low=0.0),
        yaw_tolerance=_checked_number("yaw_tolerance", yaw_tolerance, low=0.0),
        sparse_penalty=_checked_number("sparse_penalty", sparse_penalty, low=0.0),
        goal_high=goal_high,
        **{
            f"{name}_weight": _checked_number(f"reward_weights['{name}']", value, low=0.0)
            for name, value in weights.items()
        },
    )


def checked_options(options: Any) -> dict[str, Any]:
    """A copy of the options of `reset`, empty for None.

    Raises:
        OptionsError: They are no dictionary.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise OptionsError(
            f"Expected options as a dictionary, got {type(options).__name__}: {options!r:.100}. Pass "
            "options={'goal': [x, y, yaw]}."
        )
    return dict(options)


def continued(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The state after a step, its yaw on the turn nearest to that of the state before."""
    yaw = _unwrap(after[2], before[2])
    if abs(yaw) <= YAW_LIMIT:
        after[2] = yaw
    return after


def _unwrap(angle: float, reference: float) -> float:
    """The angle plus full turns [rad] that is nearest to a reference."""
    return reference + math.remainder(angle - reference, 2 * math.pi)


def _checked_array(name: str, value: Any, size: int, meaning: str) -> np.ndarray:
    """A finite float64 array of shape (size,), or a ValueError."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"Expected {name} = {meaning}, shape ({size},), got {value!r}. Pass {size} numbers."
        ) from error
    if array.shape != (size,):
        raise ValueError(
            f"Expected {name} = {meaning}, shape ({size},), got shape {array.shape}. Pass {size} numbers, unbatched."
        )
    if not np.isfinite(array).all():
        raise ValueError(
            f"Expected {name} = {meaning}, all finite, got {array.tolist()}. Find out where NaN or infinity comes from."
        )
    return array


def _checked_number(name: str, value: Any, low: float, high: float = math.inf, low_open: bool = False) -> float:
    """A finite float within bounds, or a ValueError."""
    number = float(value) if isinstance(value, numbers.Real) and not isinstance(value, bool) else math.nan
    if not math.isfinite(number) or not low <= number <= high or (low_open and number == low):
        bounds = f"{'>' if low_open else '>='} {low:g}" + (f" and <= {high:g}" if math.isfinite(high) else "")
        raise ValueError(
            f"Expected {name} to be a finite number {bounds}, got {value!r}. Choose a value in this range."
        )
    return number


def _checked_integer(name: str, value: Any) -> int:
    """A positive int, or a ValueError."""
    if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
        raise ValueError(f"Expected {name} to be a whole number >= 1, got {value!r}. Choose a value in this range.")
    return int(value)
