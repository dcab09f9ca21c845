"""The task of moving an object to a goal pose: goals, errors, success and reward. Knows no physics.

All functions take states (..., 9), actions (..., 6) and goals (..., 3) with any leading batch dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["MOVE", "TURN", "MoveTask"]


@dataclass(frozen=True)
class MoveTask:
    """Bring the object's pose (x, y, yaw) to the goal's.

    Attributes:
        position_tolerance: Largest distance to the goal position [m] that counts as success.
        yaw_tolerance: Largest difference to the goal yaw [rad] that counts as success.
        sparse_penalty: Penalty at the end of an episode whose final state is not a success.
        goal_high: Goals are uniform between -goal_high and goal_high: x [m], y [m], yaw [rad].
        tips_weight: Weight [1/m^2] of the squared distances of the tips; this and the next of the path cost C(x, u),
            eq. (cost_function) of the paper.
        position_weight: Weight [1/m^2] of the squared distance to the goal position.
        yaw_weight: Weight [1/rad^2] of the squared difference to the goal yaw.
        action_weight: Weight [1/m^2] of the squared action.
    """

    position_tolerance: float = 0.02
    yaw_tolerance: float = 0.2
    sparse_penalty: float = 10.0
    goal_high: tuple[float, float, float] = (0.06, 0.06, 0.5)
    tips_weight: float = 10.0
    position_weight: float = 200.0
    yaw_weight: float = 0.3
    action_weight: float = 200.0

    def sample_goal(self, rng: np.random.Generator) -> np.ndarray:
        """Draw one goal (3,) uniformly from the task space."""
        high = np.array(self.goal_high)
        return rng.uniform(-high, high)

    def check_goal(self, goal: np.ndarray) -> None:
        """Raise ValueError if a goal (3,) lies outside the task space."""
        # The margin admits goals that went through float32.
        if np.any(np.abs(goal) > np.array(self.goal_high) + 1e-6):
            x, y, yaw = self.goal_high
            raise ValueError(
                f"Expected options['goal'] = [x, y, yaw] with |x| <= {x:g} m, |y| <= {y:g} m, |yaw| <= {yaw:g} rad, "
                f"got {goal.tolist()}. Choose a goal inside the task space."
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

    def pose_info(self, state: np.ndarray, goal: np.ndarray) -> dict[str, np.ndarray]:
        """`success`, `position_error` [m] and `yaw_error` [rad] of a state, each of the batch shape."""
        position_error, yaw_error = self.errors(state, goal)
        return {
            "success": self.is_success(position_error, yaw_error),
            "position_error": position_error,
            "yaw_error": yaw_error,
        }

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
        # Sums over one axis, so that a batch gives the same bits as its elements.
        arms = state[..., 3:] - np.concatenate([position, position, position], axis=-1)
        shift = position - goal[..., :2]
        turn = state[..., 2] - goal[..., 2]
        return {
            "reward_tips": -self.tips_weight * np.sum(arms * arms, axis=-1),
            "reward_position": -self.position_weight * np.sum(shift * shift, axis=-1),
            "reward_yaw": -self.yaw_weight * turn * turn,
            "reward_action": -self.action_weight * np.sum(action * action, axis=-1),
        }

    def outcome(
        self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray, goal: np.ndarray, ended: np.ndarray | bool
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Judge one step.

        Args:
            state: The state in which the action was taken.
            action: The executed action [m].
            next_state: The state after it.
            goal: The goal.
            ended: Whether the episode ends with this step.

        Returns:
            The reward, and info: the pose info of the next state and every term of the reward.
        """
        info = self.pose_info(next_state, goal)
        terms = self.dense_reward_terms(state, action, goal)
        terms["reward_completion"] = np.where(ended & ~info["success"], -self.sparse_penalty, 0.0)
        return sum(terms.values(), start=np.zeros(np.shape(ended))), info | terms


MOVE = MoveTask()
"""Push a cube or another object."""
TURN = MoveTask(position_tolerance=0.001, goal_high=(0.0, 0.0, 1.5))
"""Turn a cube on its pivot: the position is as good as fixed, and the goal is a matter of the yaw."""
