"""The task of moving an object to a goal pose: goals, errors, success and reward. Knows no physics.

All functions take states (..., 9), actions (..., 6) and goals (..., 3) with any leading batch dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

__all__ = ["MoveTask"]


@dataclass(frozen=True)
class MoveTask:
    """Bring the object's pose (x, y, yaw) to the goal's.

    Attributes:
        position_tolerance: Largest distance to the goal position [m] that counts as success.
        yaw_tolerance: Largest difference to the goal yaw [rad] that counts as success.
        sparse_penalty: Penalty at the end of an episode whose final state is not a success.
    """

    position_tolerance: float = 0.02
    yaw_tolerance: float = 0.2
    sparse_penalty: float = 10.0

    # Goals are uniform between -GOAL_HIGH and GOAL_HIGH: x [m], y [m], yaw [rad].
    GOAL_HIGH: ClassVar[tuple[float, float, float]] = (0.06, 0.06, 0.5)
    # Weights of the path cost C(x, u), eq. (cost_function) of the paper.
    TIPS_WEIGHT: ClassVar[float] = 10.0
    POSITION_WEIGHT: ClassVar[float] = 200.0
    YAW_WEIGHT: ClassVar[float] = 0.3
    ACTION_WEIGHT: ClassVar[float] = 200.0

    def sample_goal(self, rng: np.random.Generator) -> np.ndarray:
        """Draw one goal (3,) uniformly from the task space."""
        high = np.array(self.GOAL_HIGH)
        return rng.uniform(-high, high)

    def check_goal(self, goal: np.ndarray) -> None:
        """Raise ValueError if a goal (3,) lies outside the task space."""
        # The margin admits goals that went through float32.
        if np.any(np.abs(goal) > np.array(self.GOAL_HIGH) + 1e-6):
            raise ValueError(
                "Expected options['goal'] = [x, y, yaw] with |x| <= 0.06 m, |y| <= 0.06 m, |yaw| <= 0.5 rad, got "
                f"{goal.tolist()}. Choose a goal inside the task space."
            )

    def errors(self, state: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance [m] and smallest angle [rad, 0 to pi] between the object's pose and the goal's."""
        distance = np.hypot(state[..., 0] - goal[..., 0], state[..., 1] - goal[..., 1])
        turn = state[..., 2] - goal[..., 2]
        # A full turn brings the object back to the same pose.
        return distance, np.abs((turn + np.pi) % (2 * np.pi) - np.pi)

    def is_success(self, position_error: np.ndarray, yaw_error: np.ndarray) -> np.ndarray:
        """Whether both errors are within the tolerances."""
        return (position_error <= self.position_tolerance) & (yaw_error <= self.yaw_tolerance)

    def dense_reward_terms(self, state: np.ndarray, action: np.ndarray, goal: np.ndarray) -> dict[str, np.ndarray]:
        """The terms of -C(x, u) by name; their sum is the dense reward.

        Args:
            state: The state in which the action is taken.
            action: The executed action [m].
            goal: The goal.

        Returns:
            `reward_tips`, `reward_position`, `reward_yaw`, `reward_action`, each of the batch shape.
        """
        position = state[..., :2]
        tips = state[..., 3:].reshape(*state.shape[:-1], 3, 2)
        arms = tips - position[..., None, :]
        shift = position - goal[..., :2]
        turn = state[..., 2] - goal[..., 2]
        return {
            "reward_tips": -self.TIPS_WEIGHT * np.sum(arms * arms, axis=(-2, -1)),
            "reward_position": -self.POSITION_WEIGHT * np.sum(shift * shift, axis=-1),
            "reward_yaw": -self.YAW_WEIGHT * turn * turn,
            "reward_action": -self.ACTION_WEIGHT * np.sum(action * action, axis=-1),
        }
