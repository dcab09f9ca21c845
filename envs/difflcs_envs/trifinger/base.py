"""Base class of the TriFinger environments: Gymnasium's reset, step and render around the simulation."""

import copy
import math
import time
from collections.abc import Mapping
from typing import Any, ClassVar, Self, TypedDict

import gymnasium
import numpy as np

from difflcs_envs.checks import checked_array, checked_integer, checked_number
from difflcs_envs.errors import RenderingError, extra
from difflcs_envs.goal_env import GoalEnv
from difflcs_envs.rendering import SceneViewer, has_display, select_gl_backend
from difflcs_envs.trifinger.task import ACTION_LIMIT, ACTION_SIZE, EPISODE_STEPS, GOAL_SIZE, MoveTask, checked_task

select_gl_backend()  # before the first import of MuJoCo
with extra():
    from difflcs_envs.trifinger.model import SceneObject
    from difflcs_envs.trifinger.physics import CONTROL_PERIOD, STATE_SIZE, TriFingerPhysics
    from difflcs_envs.trifinger.spaces import (
        ACTION_MEANING,
        GOAL_MEANING,
        STATE_MEANING,
        continued,
        make_observation_space,
        unwrap,
    )

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


FullState = tuple[np.random.Generator | None, int | None, np.ndarray]
"""Random generator, its seed, and everything that the simulation's next steps depend on."""


class CommonArguments(TypedDict, total=False):
    """Arguments of every task, besides `render_mode`; the defaults are those of `TriFingerEnv`."""

    osc_kp: float
    yaw_tolerance: float
    horizon: int
    reset_noise: float
    sparse_penalty: float
    reward_weights: Mapping[str, float] | None
    observe_time: bool
    width: int
    height: int


class TriFingerEnv(GoalEnv):
    """Base class of the TriFinger tasks, which are documented below; make one of those.

    Attributes:
        task: Goals, errors, success and reward.
        object: The object that the fingers push; `object.source` is the source of its shape.
        physics: The simulation.
    """

    metadata: ClassVar[dict[str, Any]] = {
        # A window is offered only where one can be opened.
        "render_modes": ["rgb_array", "human"] if has_display() else ["rgb_array"],
        "render_fps": round(1 / CONTROL_PERIOD),
    }
    dt, action_limit, action_meaning, unstable = CONTROL_PERIOD, ACTION_LIMIT, ACTION_MEANING, UNSTABLE
    task: MoveTask

    def __init__(
        self,
        scene_object: SceneObject,
        task: MoveTask,
        *,
        render_mode: str | None = None,
        osc_kp: float = 1000.0,
        yaw_tolerance: float = MoveTask.yaw_tolerance,
        horizon: int = EPISODE_STEPS,
        reset_noise: float = 0.05,
        sparse_penalty: float = MoveTask.sparse_penalty,
        reward_weights: Mapping[str, float] | None = None,
        observe_time: bool = False,
        width: int = 320,
        height: int = 240,
    ) -> None:
        if render_mode == "human" and not has_display():
            raise RenderingError(
                'render_mode="human" opens a window and this machine has no display (DISPLAY and WAYLAND_DISPLAY are '
                'unset). Use render_mode="rgb_array".'
            )
        if render_mode not in (None, "rgb_array", "human"):
            raise ValueError(f'Expected render_mode None, "rgb_array" or "human", got {render_mode!r}. Choose one.')
        self.render_mode = render_mode
        self.object = scene_object
        self.task = checked_task(task, yaw_tolerance, sparse_penalty, reward_weights)
        self.osc_kp = checked_number("osc_kp", osc_kp, low=0.0, high=MAX_OSC_KP, low_open=True)
        self.horizon = checked_integer("horizon", horizon)
        self.reset_noise = checked_number("reset_noise", reset_noise, low=0.0, high=MAX_RESET_NOISE)
        self.observe_time = bool(observe_time)
        self.width = checked_integer("width", width)
        self.height = checked_integer("height", height)

        self.action_space = gymnasium.spaces.Box(-ACTION_LIMIT, ACTION_LIMIT, (ACTION_SIZE,), dtype=np.float64)
        seconds = self.horizon * CONTROL_PERIOD if self.observe_time else None
        self.observation_space = make_observation_space(task.goal_high, seconds)  # pyright: ignore[reportAttributeAccessIssue]

        self.physics = self._make_physics()
        self.physics.check_fit()
        self._viewer: SceneViewer | None = None
        self._last_frame_time = 0.0
        self._state = np.zeros(STATE_SIZE)
        self._goal = np.zeros(GOAL_SIZE)

    def _make_physics(self, model: Any = None) -> TriFingerPhysics:
        return TriFingerPhysics(self.object, self.osc_kp, (self.width, self.height), model)

    def describe(self) -> dict[str, Any]:
        """Describe the object, in JSON types, for records of results."""
        return self.object.describe()

    def sibling(self) -> Self:
        """Make another environment with the same settings, on the same MuJoCo model (building one takes long)."""
        other = copy.copy(self)
        other.physics = self._make_physics(self.physics.model)
        other._np_random = other._np_random_seed = None
        other._renderer = other._viewer = None
        other._state, other._goal, other._steps = np.zeros(STATE_SIZE), np.zeros(GOAL_SIZE), None
        return other

    @property
    def model(self) -> Any:
        """The MuJoCo model."""
        return self.physics.model

    @property
    def data(self) -> Any:
        """The MuJoCo data."""
        return self.physics.data

    # --- Gymnasium --------------------------------------------------------------------------------

    def _start(self, goal: Any, state: Any) -> dict[str, Any]:
        joint_noise = self.np_random.uniform(-JOINT_NOISE, JOINT_NOISE, (3, 3))
        pose_noise = self.np_random.uniform(-1.0, 1.0, 3) * (POSITION_NOISE, POSITION_NOISE, YAW_NOISE)
        random_goal = self.task.sample_goal(self.np_random)
        if goal is None:
            self._goal = random_goal
        else:
            goal = checked_array("options['goal']", goal, (GOAL_SIZE,), GOAL_MEANING)
            self.task.check_goal(goal)
            self._goal = np.clip(goal, -np.array(self.task.goal_high), self.task.goal_high)
        if state is None:
            pose = self.reset_noise * pose_noise * ((0.0, 0.0, 1.0) if self.object.pinned else 1.0)
            tips = self.physics.tips_from_noise(self.reset_noise * joint_noise, pose)
        else:
            state = checked_array("options['state']", state, (STATE_SIZE,), STATE_MEANING)
            # The margin admits pi that went through float32.
            if abs(state[2]) > math.pi + 1e-6:
                raise ValueError(
                    f"Expected the yaw options['state'][2] in [-pi, pi], got {state[2]}. Subtract full turns (2 pi)."
                )
            pose, tips = state[:3], state[3:].reshape(3, 2)
        self.physics.reset(pose, tips)
        self.physics.set_goal(self._goal)
        self._state = self.physics.state()
        self._state[2] = unwrap(self._state[2], float(pose[2]))
        if self.render_mode == "human":
            self.render()
        return self._pose_info()

    def _simulate(self, action: np.ndarray) -> np.ndarray | None:
        after = self.physics.step(action)
        return None if after is None else continued(self._state, after)

    def _stepped(self, info: dict[str, Any]) -> None:
        if self.render_mode == "human":
            self.render()

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the scene, the goal as an outline.

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
        return self.picture()

    def close(self) -> None:
        """Free the renderer and the window. May be called again."""
        super().close()
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    # --- copies -----------------------------------------------------------------------------------

    def get_full_state(self) -> FullState:
        """Random generator and simulation, from which a sibling continues as this one; not the running episode."""
        return self._np_random, self._np_random_seed, self.physics.get_full_state()

    def set_full_state(self, full_state: FullState) -> None:
        """Continue from a result of `get_full_state`. There is no episode to step until `reset`."""
        self._np_random, self._np_random_seed, simulation = full_state
        self.physics.set_full_state(simulation)

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
        observation = super()._observation()
        if self.observe_time:
            left = 0 if self._steps is None else self.horizon - self._steps
            observation["time_to_go"] = np.array([left * CONTROL_PERIOD])
        return observation
