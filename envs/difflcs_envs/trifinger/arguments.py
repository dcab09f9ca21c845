"""Checks of the numbers of a TriFinger task."""

from collections.abc import Mapping
from dataclasses import replace

from difflcs_envs.checks import checked_number
from difflcs_envs.trifinger.task import MoveTask

REWARD_TERMS = ("tips", "position", "yaw", "action")


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
