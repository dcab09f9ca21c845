"""The hand as a Gymnasium environment: turn an object on the palm."""

import functools
import math
from dataclasses import replace
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from difflcs_envs.checks import checked_array, checked_integer, checked_number
from difflcs_envs.errors import extra
from difflcs_envs.goal_env import GoalEnv
from difflcs_envs.hand.task import (
    ACTION_LIMIT,
    ACTION_SIZE,
    EPISODE_STEPS,
    GOAL_SIZE,
    STATE_SIZE,
    TURN_OBJECT,
    TurnTask,
    rotation_to_quaternion,
)
from difflcs_envs.rendering import select_gl_backend

select_gl_backend()  # before the first import of MuJoCo
with extra():
    import mujoco

    from difflcs_envs.hand.model import GOAL_HEIGHT, OBJECTS, PALM_TOP, POSTURE, SUBSTEPS, TIMESTEP, build_model

STEP_SECONDS = SUBSTEPS * TIMESTEP
PLACE = (-0.02, 0.0)  # [m] of the object on the palm
PLACE_NOISE, YAW_NOISE = 0.005, math.pi / 2  # [m] standard deviation, [rad] to either side
CLEARANCE = 0.002  # [m] from which the object comes down
LONGEST_ROTATION = 1.5 * math.pi  # [rad] beyond which a rotation vector is that of less than half a turn again
STATE_MEANING = "16 joints [rad], place [m] and rotation vector [rad] of the object"
GOAL_MEANING = "place [m] and quaternion w, x, y, z of the goal"


class HandTurnObjectEnv(GoalEnv):
    """A hand of four fingers turns an object on its palm.

    ## Description

    The hand faces up. Its three fingers and its thumb have four joints each, placed as those of the Allegro hand, with
    links of capsules and a position servo each. An object lies on the palm and is to be turned by 90° to either side
    within 10 s, without falling. A copy of it above the hand shows the goal. Task and servos are those of Jin
    ("Complementarity-Free Multi-Contact Modeling and Optimization for Dexterous Manipulation"), objects and links ours.

    ## Action space

    `Box(-0.1, 0.1, (16,), float64)`: by how much the target of each joint servo is from where the joint is now [rad],
    held for 0.1 s. Order: index, middle, ring finger, thumb, each from its base. A target outside the joint's range is
    brought to its end; an action outside the box is clipped to it, and `info["executed_action"]` is what was executed.

    ## Observation space

    `Dict(goal=Box(7), state=Box(22))`, all float64; x from the wrist to the fingers, z up.

    | Num      | `state`                                             | Min     | Max    | Unit |
    |----------|-----------------------------------------------------|---------|--------|------|
    | 0 to 15  | joint angles, in the order of the actions           | -pi     | pi     | rad  |
    | 16 to 18 | place of the object's centre x, y, z                | -10     | 10     | m    |
    | 19 to 21 | rotation vector of the object from its upright pose | -1.5 pi | 1.5 pi | rad  |

    | Num      | `goal`                                              | Min     | Max    | Unit |
    |----------|-----------------------------------------------------|---------|--------|------|
    | 0 to 2   | place of the object's centre x, y, z                | -0.2    | 0.2    | m    |
    | 3 to 6   | unit quaternion w, x, y, z of the object            | -1      | 1      |      |

    The rotation vector goes on through half a turn, without a jump, and is brought back by a whole turn beyond 1.5 pi.

    ## Rewards

    The reward of a step is a sum, of the state *in which* the action was taken and the executed action; q and p are
    quaternion and place of the object. Each term is in `info`:

    | `info` key          | Value                                                       |
    |---------------------|-------------------------------------------------------------|
    | `reward_turn`       | -(1 - (q . goal)^2)                                         |
    | `reward_place`      | -100 (squared distance to the goal's place [m^2])           |
    | `reward_action`     | -0.1 (squared norm of the action [rad^2])                   |
    | `reward_completion` | -`sparse_penalty` at the last step without success, else 0  |

    Further entries, after `reset` and `step`, of the state that is returned: `success` (1 - (q . goal)^2 < 0.04, which
    is 0.40 rad, and not dropped; wherever on the palm), `held` (steps in a row with success; the papers ask for 21),
    `dropped` (its centre is less than 5 mm above the middle of the palm), `angle_error` [rad], `position_error` [m];
    after `step` also `executed_action` [rad], `clipped` and `physics_error`.

    ## Starting state

    The fingers are open round the object, which lies on the palm: its place is normally distributed by 5 mm, its yaw
    uniform in ±90°. The goal is `turn` away in yaw, to either side, in the middle of the palm. `reset` takes options:

    - `goal`: (7,) a goal in the goal space, of any rotation;
    - `state`: (22,) a state to start from, at rest.

    ## Episode end

    - Termination: never; what has been dropped lies there.
    - Truncation: after `horizon` steps. Also when the simulation becomes unstable: then the observation is the last
      finite state, `info["physics_error"]` is True and a `PhysicsWarning` is given.

    ## Arguments

    | Argument          | Default  | Meaning                                                              |
    |-------------------|----------|----------------------------------------------------------------------|
    | `object`          | "cube"   | cube, box, cylinder, ellipsoid, capsule, or a mesh: house, nut       |
    | `render_mode`     | None     | "rgb_array"                                                          |
    | `object_mass`     | 0.1      | mass of the object [kg]                                              |
    | `friction`        | 0.5      | sliding friction of object and hand                                  |
    | `servo_gain`      | 1.0      | stiffness of the servos [N m/rad]; the joints' damping is 0.1 N m s/rad |
    | `turn`            | pi/2     | how far the goal is from the start in yaw, to either side [rad]      |
    | `horizon`         | 100      | steps of an episode                                                  |
    | `sparse_penalty`  | 10       | penalty for an episode that ends without success                     |
    | `width`, `height` | 320, 240 | size of rendered pictures [pixel]                                    |

    ## Version history

    - v0: first version.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_SECONDS)}
    dt, action_limit, action_meaning = STEP_SECONDS, ACTION_LIMIT, "targets of the servos from the joints in rad"
    unstable = "The simulation became unstable. The episode is truncated."
    task: TurnTask

    def __init__(
        self,
        object: str = "cube",
        render_mode: str | None = None,
        *,
        object_mass: float = 0.1,
        friction: float = 0.5,
        servo_gain: float = 1.0,
        turn: float = math.pi / 2,
        horizon: int = EPISODE_STEPS,
        sparse_penalty: float = TURN_OBJECT.sparse_penalty,
        width: int = 320,
        height: int = 240,
    ) -> None:
        if object not in OBJECTS:
            raise ValueError(f"Expected object to be one of {', '.join(OBJECTS)}, got {object!r:.100}. Choose one.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'Expected render_mode None or "rgb_array", got {render_mode!r:.100}. Choose one of them.')
        self.render_mode, self.object = render_mode, object
        self.turn = checked_number("turn", turn, low=0.0, high=math.pi)
        self.horizon = checked_integer("horizon", horizon)
        self.task = replace(TURN_OBJECT, sparse_penalty=checked_number("sparse_penalty", sparse_penalty, low=0.0))
        self.width, self.height = checked_integer("width", width), checked_integer("height", height)
        self.model = build_model(
            object,
            checked_number("object_mass", object_mass, low=0.0, low_open=True),
            checked_number("friction", friction, low=0.0),
            checked_number("servo_gain", servo_gain, low=0.0, low_open=True),
            (self.width, self.height),
        )
        self.data = mujoco.MjData(self.model)
        high = np.concatenate([np.full(16, math.pi), np.full(3, 10.0), np.full(3, LONGEST_ROTATION)])
        goal_high = np.array([0.2] * 3 + [1.0] * 4)
        box = functools.partial(gymnasium.spaces.Box, dtype=np.float64)
        self.action_space = box(-ACTION_LIMIT, ACTION_LIMIT, (ACTION_SIZE,))
        self.observation_space = gymnasium.spaces.Dict(goal=box(-goal_high, goal_high), state=box(-high, high))  # pyright: ignore
        self._state, self._goal, self._held = np.zeros(STATE_SIZE), np.zeros(GOAL_SIZE), 0

    def describe(self) -> dict[str, Any]:
        """Describe the object, in JSON types, for records of results."""
        return {
            "name": self.object,
            "mass": float(self.model.body("object").mass[0]),
            "friction": float(self.model.geom("object").friction[0]),
            "servo_gain": float(self.model.actuator_gainprm[0, 0]),
        }

    def _start(self, goal: Any, state: Any) -> dict[str, Any]:
        place = PLACE + PLACE_NOISE * self.np_random.standard_normal(2)
        yaw, side = self.np_random.uniform(-YAW_NOISE, YAW_NOISE), self.np_random.choice([-1.0, 1.0])
        height = PALM_TOP + OBJECTS[self.object][2]
        if state is None:
            state = np.concatenate([POSTURE, place, [height + CLEARANCE, 0.0, 0.0, yaw]])
        if goal is None:
            rotation = np.array([0.0, 0.0, yaw + side * self.turn])
            goal = np.concatenate([PLACE, [height], rotation_to_quaternion(rotation)])
        self._state = self._checked("state", state, STATE_SIZE, STATE_MEANING)
        self._goal = self._checked("goal", goal, GOAL_SIZE, GOAL_MEANING)
        if abs(np.linalg.norm(self._goal[3:]) - 1) > 1e-3:
            raise ValueError(f"Expected a unit quaternion in options['goal'][3:], got {self._goal[3:]}. Normalise it.")
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = np.concatenate([self._state[:19], rotation_to_quaternion(self._state[19:])])
        self.data.ctrl[:] = self._state[:16]
        self.data.mocap_pos[0] = (*self._goal[:2], GOAL_HEIGHT)
        self.data.mocap_quat[0] = self._goal[3:]
        mujoco.mj_forward(self.model, self.data)
        info = self._pose_info()
        self._held = int(info["success"])
        return info | {"held": self._held}

    def _simulate(self, action: np.ndarray) -> np.ndarray | None:
        self.data.ctrl[:] = self._state[:16] + action
        mujoco.mj_step(self.model, self.data, SUBSTEPS)
        after = np.concatenate([self.data.qpos[:19], continued_rotation(self.data.qpos[19:], self._state[19:])])
        stable = not any(warning.number for warning in self.data.warning)
        return after if stable and after in self.observation_space["state"] else None  # pyright: ignore

    def _stepped(self, info: dict[str, Any]) -> None:
        info["held"] = self._held = self._held + 1 if info["success"] else 0

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the scene, uint8 (height, width, 3); None without render mode.

        Raises:
            RenderingError: Nothing can be drawn on this machine. The message says what to install.
        """
        return None if self.render_mode is None else self.picture()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_renderer": None}  # OpenGL stays behind

    def _checked(self, name: str, value: Any, size: int, meaning: str) -> np.ndarray:
        array, space = checked_array(f"options['{name}']", value, (size,), meaning), self.observation_space[name]  # pyright: ignore
        if array not in space:
            raise ValueError(
                f"Expected options['{name}'] within observation_space['{name}'], got {array.tolist()}. "
                "Choose smaller numbers."
            )
        return array


def continued_rotation(quaternion: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) of a quaternion, on the turn nearest to the one before if that is not too long."""
    shortest = np.zeros(3)
    mujoco.mju_quat2Vel(shortest, quaternion, 1.0)
    angle = float(np.linalg.norm(shortest))
    longer = shortest * (1 - 2 * math.pi / max(angle, 1e-9))
    nearer = np.linalg.norm(longer - before) < np.linalg.norm(shortest - before)
    return longer if nearer and 2 * math.pi - angle < LONGEST_ROTATION else shortest


def turn_object(
    num_envs: int = 1, autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP, **arguments: Any
) -> SyncVectorEnv:
    """Make a vector of environments; further arguments are those of the single one."""
    return SyncVectorEnv([functools.partial(HandTurnObjectEnv, **arguments)] * num_envs, autoreset_mode=autoreset_mode)
