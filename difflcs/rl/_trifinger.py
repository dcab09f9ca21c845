"""The tasks by name: which environment, which MPC cost, which sizes. Names only, no environment is imported here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from difflcs.cost import GoalCost
from difflcs.errors import InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.mpc import LCSMPCLayer

N_X = 9
"""State of the pushing tasks: object x, y [m], yaw [rad], then x, y [m] of three fingertips."""
N_U = 6
"""Action: x, y displacement [m] of three fingertips in one step."""


def pushing_cost() -> GoalCost:
    """Cost of the MPC for pushing an object on the table (Eq. cost_function of the paper).

    Stage: 10 Σ‖tip − object‖² + 200 ‖object − goal‖² + 0.3 (yaw − goal yaw)² + 200 ‖u‖²; final: 6, 200 and 1.5.

    Returns:
        A `GoalCost` of goals (x [m], y [m], yaw [rad]).
    """
    return GoalCost.reach(
        N_X,
        N_U,
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


@dataclass(frozen=True)
class Task:
    """What training and evaluation must know about one task.

    Attributes:
        env_id: Gymnasium id of the environment.
        env_kwargs: its keyword arguments.
        episode_steps: steps of one episode, after which it is truncated.
        step_seconds: duration of one step [s].
        u_max: bound of each action component [m].
        horizon: steps the MPC plans ahead.
        relaxation: product λ·s of the MPC's complementarity.
        position_tolerance: distance [m] to the goal that counts as success.
        yaw_tolerance: angle [rad] that counts as success.
    """

    env_id: str
    env_kwargs: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    episode_steps: int = 20
    step_seconds: float = 0.1
    u_max: float = 0.015
    horizon: int = 8
    relaxation: float = 1e-5
    position_tolerance: float = 0.02
    yaw_tolerance: float = 0.2

    def outcome(self, state: Tensor, action: Tensor, after: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """What the environment says of a step without a simulation, for imagined episodes.

        Args:
            state: (..., 9) before.
            action: (..., 6) that is executed [m].
            after: (..., 9) state after it.
            goal: (..., 3).

        Returns:
            Dense reward (...), minus the stage cost of `pushing_cost`, and success (...) bool.
        """
        distance = (after[..., :2] - goal[..., :2]).norm(dim=-1)
        turn = (after[..., 2] - goal[..., 2] + torch.pi) % (2 * torch.pi) - torch.pi
        success = (distance <= self.position_tolerance) & (turn.abs() <= self.yaw_tolerance)
        return -pushing_cost().stage(state, action, goal), success

    def make_policy(self, lcs: LCSModel, backend: str = "batched") -> LCSMPCLayer:
        """The MPC around a model; unsolved elements are masked, never raised, so that they cannot end a training."""
        return LCSMPCLayer(
            lcs,
            pushing_cost(),
            horizon=self.horizon,
            u_min=-self.u_max,
            u_max=self.u_max,
            backend=backend,
            relaxation=self.relaxation,
            on_failure="mask",
        )


_OBJECTS = ("sugar_box", "fish_can", "mug", "wrench", "clamp", "banana", "large_clamp", "extra_large_clamp")
TASKS: Mapping[str, Task] = MappingProxyType(
    {
        "cube": Task("difflcs/TriFingerMoveCube-v0"),
        "turn_cube": Task("difflcs/TriFingerTurnCube-v0", position_tolerance=0.001),
        **{name: Task("difflcs/TriFingerMoveObject-v0", MappingProxyType({"object": name})) for name in _OBJECTS},
    }
)
"""Task name → `Task`."""


def get_task(name: str) -> Task:
    """Look a task up.

    Raises:
        InvalidInputError: no task has this name.
    """
    if name not in TASKS:
        raise InvalidInputError(f"task: expected one of {', '.join(TASKS)}, got {name!r:.200}")
    return TASKS[name]
