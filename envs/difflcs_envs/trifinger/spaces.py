"""Actions and observations of the TriFinger environments: sizes, units and limits."""

import math

import numpy as np
from gymnasium import spaces

from difflcs_envs.trifinger.physics import STATE_SIZE, WORKSPACE_RADIUS

ACTION_MEANING = "[tip 0 x, y, tip 1 x, y, tip 2 x, y] in m"
STATE_MEANING = "[object x, y, yaw, tip 0 x, y, tip 1 x, y, tip 2 x, y] in m and rad"
GOAL_MEANING = "[x, y, yaw] of the goal in m, m, rad"
MIN_GOAL_BOUND = 1e-3  # Gymnasium wants spaces of some extent even where a goal is fixed (turning: x and y)
# Bound of the observed yaw [rad]: four turns either way. One action turns a cube by a third of a radian at most.
YAW_LIMIT = 8 * math.pi


def make_observation_space(goal_high: tuple[float, float, float], seconds: float | None) -> spaces.Dict:
    """Make the space of state and goal, and of the time to go if it is observed.

    Args:
        goal_high: Bounds of the goal: x [m], y [m], yaw [rad].
        seconds: Duration of an episode [s]; None without the time to go.
    """
    state_high = np.full(STATE_SIZE, WORKSPACE_RADIUS)
    state_high[2] = YAW_LIMIT
    goal_bound = np.maximum(goal_high, MIN_GOAL_BOUND)
    observation: dict[str, spaces.Space] = {
        "state": spaces.Box(-state_high, state_high, dtype=np.float64),
        "goal": spaces.Box(-goal_bound, goal_bound, dtype=np.float64),
    }
    if seconds is not None:
        observation["time_to_go"] = spaces.Box(0.0, seconds, (1,), dtype=np.float64)
    return spaces.Dict(observation)


def continued(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the state after a step, with its yaw on the turn nearest to the yaw before."""
    yaw = unwrap(after[2], before[2])
    if abs(yaw) <= YAW_LIMIT:
        after[2] = yaw
    return after


def unwrap(angle: float, reference: float) -> float:
    """Add full turns to an angle [rad] so that it is nearest to a reference."""
    return reference + math.remainder(angle - reference, 2 * math.pi)
