"""The task of turning an object in the hand: goals, errors, success and reward. Knows no physics.

Functions take states (..., 22), actions (..., 16) and goals (..., 7) of any batch shape, as NumPy arrays or PyTorch
tensors, and return the like.
"""

from dataclasses import dataclass

import numpy as np

from difflcs_envs.goal_task import Array, GoalTask, library_of

ACTION_LIMIT, ACTION_SIZE = 0.1, 16  # [rad], joint servos
GOAL_SIZE, STATE_SIZE = 7, 22
EPISODE_STEPS = 100
LOST = 0.005  # [m] height of the object's centre below which it is no longer on the palm


@dataclass(frozen=True)
class TurnTask(GoalTask):
    """Bring an object that lies in the hand to an orientation, near a place.

    Attributes:
        tolerance: 1 − (q·goal)² of unit quaternions that counts as success; 0.04 is an angle of 0.40 rad (23°).
        sparse_penalty: Penalty at the end of an episode whose final state is not a success.
        turn_weight: Weight of 1 − (q·goal)², the squared sine of half the angle.
        place_weight: Weight [1/m^2] of the squared distance to the goal's place.
        action_weight: Weight [1/rad^2] of the squared action.
    """

    tolerance: float = 0.04
    sparse_penalty: float = 10.0
    turn_weight: float = 1.0
    place_weight: float = 100.0
    action_weight: float = 0.1

    def pose_info(self, state: Array, goal: Array) -> dict[str, Array]:
        """`success`, `dropped`, `angle_error` [rad] and `position_error` [m] of a state, each of the batch shape."""
        library, wrong = library_of(state), self.squared_sine(state, goal)
        shift = state[..., 16:19] - goal[..., :3]
        dropped = state[..., 18] < LOST
        return {
            "success": (wrong < self.tolerance) & ~dropped,
            "dropped": dropped,
            "angle_error": 2 * library.arcsin(library.sqrt(wrong.clip(0.0, 1.0))),
            "position_error": library.sqrt((shift * shift).sum(-1)),
        }

    def squared_sine(self, state: Array, goal: Array) -> Array:
        """Squared sine of half the angle between the object and its goal, 0 to 1."""
        along = (rotation_to_quaternion(state[..., 19:]) * goal[..., 3:]).sum(-1)
        return 1 - along * along

    def dense_reward_terms(self, state: Array, action: Array, goal: Array) -> dict[str, Array]:
        """`reward_turn`, `reward_place` and `reward_action`, see `GoalTask`."""
        shift = state[..., 16:19] - goal[..., :3]
        return {
            "reward_turn": -self.turn_weight * self.squared_sine(state, goal),
            "reward_place": -self.place_weight * (shift * shift).sum(-1),
            "reward_action": -self.action_weight * (action * action).sum(-1),
        }


def rotation_to_quaternion(rotation: Array) -> Array:
    """Unit quaternions (..., 4) w, x, y, z of rotation vectors (..., 3) [rad]."""
    library = library_of(rotation)
    angle = library.sqrt((rotation * rotation).sum(-1))[..., None]
    half = 0.5 * library.sinc(angle / (2 * np.pi)) * rotation  # sin(angle/2) along the axis
    return library.concatenate([library.cos(angle / 2), half], -1)


TURN_OBJECT = TurnTask()
"""The task of `HandTurnObject-v0`."""
