"""A task with goals, judged step by step. Knows no physics.

What judges a state or a step takes NumPy arrays or PyTorch tensors with any leading batch dimensions and returns the
like; with tensors, rewards can be differentiated.
"""

import sys
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

Array = Any
"""A NumPy array, or a PyTorch tensor, which this file does not import."""


class GoalTask(ABC):
    """Judges steps by the terms of a dense reward, and a penalty at the end of an episode without success.

    Attributes:
        sparse_penalty: Penalty at the end of an episode whose final state is not a success.
    """

    sparse_penalty: float

    @abstractmethod
    def pose_info(self, state: Array, goal: Array) -> dict[str, Array]:
        """`success`, `position_error` [m] and other entries of a state, each of the batch shape."""

    @abstractmethod
    def dense_reward_terms(self, state: Array, action: Array, goal: Array) -> dict[str, Array]:
        """The terms of the dense reward by name, of the state in which the action is taken, each of the batch shape."""

    def outcome(
        self, state: Array, action: Array, next_state: Array, goal: Array, ended: Array | bool
    ) -> tuple[Array, dict[str, Array]]:
        """Judge one step.

        Args:
            state: The state in which the action was taken.
            action: The executed action.
            next_state: The state after it.
            goal: The goal.
            ended: Whether the episode ends with this step; one for all, or of the batch shape.

        Returns:
            The reward, and info: the pose info of the next state and every term of the reward.
        """
        library = library_of(state)
        info = self.pose_info(next_state, goal)
        terms = self.dense_reward_terms(state, action, goal)
        failed = library.asarray(ended) & ~info["success"]
        # Rewards have 64 bits. PyTorch would make a number of 32 bits of two Python floats.
        zero = library.zeros_like(info["position_error"], dtype=library.float64)
        terms["reward_completion"] = library.where(failed, -self.sparse_penalty, zero)
        return sum(terms.values(), start=zero), info | terms

    def judge(
        self, state: Array, action: Array, next_state: Array, goal: Array, ended: Array | bool
    ) -> tuple[Array, Array]:
        """Reward and success of one step, see `outcome`."""
        reward, info = self.outcome(state, action, next_state, goal, ended)
        return reward, info["success"]


def library_of(array: Array) -> Any:
    """Return PyTorch for its tensors, else NumPy. Nothing is imported: a tensor implies that PyTorch is."""
    torch = sys.modules.get("torch")
    return torch if torch is not None and isinstance(array, torch.Tensor) else np
