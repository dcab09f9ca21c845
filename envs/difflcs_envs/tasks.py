"""The environments as tasks of `difflcs`: what its trainings, evaluations and pictures must know of them.

The one file of this package that imports `difflcs`, which finds it by the entry point group `difflcs.tasks`. No
environment is imported here, and no simulation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from difflcs.cost import GoalCost
from difflcs.rl.tasks import Quantity, TaskSpec, register_task
from difflcs_envs.trifinger.task import ACTION_LIMIT, ACTION_SIZE, EPISODE_STEPS, MOVE, TURN, MoveTask
from difflcs_envs.ycb import YCB

__all__ = ["caption", "describe", "pushing_cost", "pushing_features", "register_tasks", "trifinger_task"]

STATE_SIZE = 9  # object x, y [m], yaw [rad], then x, y [m] of three fingertips
STEP_SECONDS = 0.1
HORIZON = 8  # steps that the MPC plans ahead
MOVE_GOALS = ((0.04, 0.03, 0.3), (-0.04, 0.03, -0.3), (0.0, -0.05, 0.4), (0.05, -0.02, 0.0))  # [m, m, rad] to show
TURN_GOALS = ((0.0, 0.0, 0.8), (0.0, 0.0, -0.8), (0.0, 0.0, 1.4), (0.0, 0.0, -0.3))


def pushing_cost() -> GoalCost:
    """Cost of the MPC for pushing an object on the table (Eq. cost_function of the paper).

    Stage: 10 Σ‖tip − object‖² + 200 ‖object − goal‖² + 0.3 (yaw − goal yaw)² + 200 ‖u‖²; final: 6, 200 and 1.5.

    Returns:
        A `GoalCost` of goals (x [m], y [m], yaw [rad]).
    """
    return GoalCost.reach(
        STATE_SIZE,
        ACTION_SIZE,
        goal_weight=(200.0, 200.0, 0.3),
        goal_weight_final=(200.0, 200.0, 1.5),
        input_weight=200.0,
        pairs=[(3 + 2 * finger + axis, axis) for finger in range(3) for axis in range(2)],
        pair_weight=10.0,
        pair_weight_final=6.0,
    )


def pushing_features(state: Tensor, goal: Tensor, elapsed: Tensor) -> Tensor:
    """What the value network sees of a pushing task, scaled to about one.

    Args:
        state: (..., 9).
        goal: (..., 3).
        elapsed: (...) fraction of the episode that has passed; without it a value of truncated episodes is undefined.

    Returns:
        (..., 15): object pose, fingertips from the object, pose error, its norms, time.
    """
    place, yaw = state[..., :2], state[..., 2:3]
    to_place, to_yaw = place - goal[..., :2], yaw - goal[..., 2:]
    return torch.cat(
        [
            place / 0.05,
            yaw / 0.3,
            (state[..., 3:] - torch.cat([place] * 3, -1)) / 0.05,
            to_place / 0.05,
            to_yaw / 0.3,
            to_place.norm(dim=-1, keepdim=True) / 0.05,
            to_yaw.abs() / 0.3,
            (2 * elapsed - 1).unsqueeze(-1),
        ],
        -1,
    )


def caption(info: Mapping[str, Any]) -> str:
    """What a picture says of a step: "off by 12 mm, 0.05 rad"."""
    return f"off by {1000 * info['position_error']:.0f} mm, {info['yaw_error']:.2f} rad"


def describe(env: Any) -> dict[str, Any]:
    """What the fingers push: name, source of its shape, mass, ...; of one environment or a vector, wrapped or not."""
    inner = env.unwrapped
    single = inner.envs[0].unwrapped if hasattr(inner, "envs") else inner
    return single.object.describe()


def trifinger_task(
    name: str, env: str, task: MoveTask, summary: str, goals: tuple[tuple[float, ...], ...], **env_kwargs: Any
) -> TaskSpec:
    """One task of the robot hand.

    Args:
        name: What it is called.
        env: Name of the Gymnasium environment in the namespace `difflcs`.
        task: Goals and reward of that environment.
        summary: What is to be done.
        goals: Goals to show what was learned.
        **env_kwargs: Arguments of the environment.
    """
    return TaskSpec(
        name=name,
        summary=summary,
        env=f"difflcs_envs:difflcs/{env}",
        env_kwargs=env_kwargs,
        make_cost=pushing_cost,
        u_min=-ACTION_LIMIT,
        u_max=ACTION_LIMIT,
        horizon=HORIZON,
        episode_steps=EPISODE_STEPS,
        step_seconds=STEP_SECONDS,
        features=pushing_features,
        outcome=task.judge,
        failure_penalty=task.sparse_penalty,
        goal=(Quantity("x", "m"), Quantity("y", "m"), Quantity("yaw", "rad")),
        errors=(Quantity("position_error", "m"), Quantity("yaw_error", "rad")),
        caption=caption,
        picture={"width": 640, "height": 480},
        example_goals=goals,
        describe=describe,
        requires=("mujoco",),
        threaded=True,
        model_name=f"trifinger-{name.replace('_', '-')}",
    )


def register_tasks() -> None:
    """Make the tasks known to `difflcs`, which calls this itself where this package is installed."""
    register_task(
        trifinger_task("cube", "TriFingerMoveCube-v0", MOVE, "Push a cube of 6 cm to a position and yaw.", MOVE_GOALS)
    )
    register_task(
        trifinger_task("turn_cube", "TriFingerTurnCube-v0", TURN, "Turn a cube on a pivot to a yaw.", TURN_GOALS)
    )
    for name in YCB:
        summary = f"Push a {name.replace('_', ' ')} of the YCB set to a position and yaw."
        register_task(trifinger_task(name, "TriFingerMoveObject-v0", MOVE, summary, MOVE_GOALS, object=name))
