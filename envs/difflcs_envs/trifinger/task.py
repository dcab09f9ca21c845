"""The task of moving an object to a goal pose: goals, errors, success and reward. Knows no physics.

All functions take states (..., 9), actions (..., 6) and goals (..., 3) with any leading batch dimensions. What judges a
state or a step takes NumPy arrays or PyTorch tensors and returns the like; with tensors, rewards can be differentiated.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from difflcs_envs.checks import checked_number
from difflcs_envs.goal_task import Array, GoalTask, library_of

ACTION_SIZE = 6  # x, y of three tips
ACTION_LIMIT = 0.015  # [m] per component and step
GOAL_SIZE = 3  # x, y, yaw
EPISODE_STEPS = 20
REWARD_TERMS = ("tips", "position", "yaw", "action")


@dataclass(frozen=True)
class MoveTask(GoalTask):
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

    def errors(self, state: Array, goal: Array) -> tuple[Array, Array]:
        """Distance [m] and smallest angle [rad, 0 to pi] between the object's pose and the goal's."""
        distance = library_of(state).hypot(state[..., 0] - goal[..., 0], state[..., 1] - goal[..., 1])
        turn = state[..., 2] - goal[..., 2]
        # A full turn brings the object back to the same pose.
        return distance, abs((turn + np.pi) % (2 * np.pi) - np.pi)

    def is_success(self, position_error: Array, yaw_error: Array) -> Array:
        """Return True if both errors are within the tolerances."""
        return (position_error <= self.position_tolerance) & (yaw_error <= self.yaw_tolerance)

    def pose_info(self, state: Array, goal: Array) -> dict[str, Array]:
        """`success`, `position_error` [m] and `yaw_error` [rad] of a state, each of the batch shape."""
        position_error, yaw_error = self.errors(state, goal)
        return {
            "success": self.is_success(position_error, yaw_error),
            "position_error": position_error,
            "yaw_error": yaw_error,
        }

    def dense_reward_terms(self, state: Array, action: Array, goal: Array) -> dict[str, Array]:
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
        arms = state[..., 3:] - library_of(state).concatenate([position] * 3, axis=-1)
        shift = position - goal[..., :2]
        turn = state[..., 2] - goal[..., 2]
        return {
            "reward_tips": -self.tips_weight * (arms * arms).sum(axis=-1),
            "reward_position": -self.position_weight * (shift * shift).sum(axis=-1),
            "reward_yaw": -self.yaw_weight * turn * turn,
            "reward_action": -self.action_weight * (action * action).sum(axis=-1),
        }


MOVE = MoveTask()
"""Push a cube or another object."""
TURN = MoveTask(position_tolerance=0.001, goal_high=(0.0, 0.0, 1.5))
"""Turn a cube on its pivot: the position is practically fixed, and the goal is a yaw."""


def checked_task(
    task: MoveTask, yaw_tolerance: float, sparse_penalty: float, reward_weights: Mapping[str, float] | None
) -> MoveTask:
    """Return a task with other numbers, after checking each of them.

    Raises:
        ValueError: A number is out of range, or a reward weight has an unknown name.
    """
    weights = dict(reward_weights or {})
    if unknown := sorted(set(weights) - set(REWARD_TERMS), key=str):
        raise ValueError(
            f"Expected reward_weights for {', '.join(REWARD_TERMS)}, got also {unknown}. Choose among these terms."
        )
    return replace(
        task,
        position_tolerance=checked_number("position_tolerance", task.position_tolerance, low=0.0),
        yaw_tolerance=checked_number("yaw_tolerance", yaw_tolerance, low=0.0),
        sparse_penalty=checked_number("sparse_penalty", sparse_penalty, low=0.0),
        **{
            f"{name}_weight": checked_number(f"reward_weights['{name}']", value, low=0.0)
            for name, value in weights.items()
        },
    )
