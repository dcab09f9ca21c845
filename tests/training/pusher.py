"""A finger that pushes a block on a line: contact without a simulator, and a policy without a model."""

from types import SimpleNamespace

import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv

from difflcs import LCSParams, solve_lcp
from tests.conformance.toy import Reaching

STEPS = 10
U_MAX = 0.1


def pusher() -> LCSParams:
    """A finger at x₁ pushes a block at x₀: x₀₊ = x₀ + λ, x₁₊ = x₁ + u, 0 ≤ λ ⊥ x₀ − x₁ − u + λ ≥ 0."""
    return LCSParams(
        A=[[1.0, 0.0], [0.0, 1.0]],
        B=[[0.0], [1.0]],
        C=[[1.0], [0.0]],
        d=[0.0, 0.0],
        D=[[1.0, -1.0]],
        E=[[-1.0]],
        F=[[1.0]],
        c=[0.0],
    )


class PusherEnv(Reaching):
    """Push the block to a goal ahead of it."""

    def __init__(self, breaks_at: int | None = None, length: int = STEPS):
        super().__init__(2, U_MAX, length, breaks_at)

    def draw(self):
        return self.np_random.uniform([0.05, -0.1], [0.15, 0.0]), self.np_random.uniform([0.2], [0.5])

    def move(self, action):
        params, x, u = pusher(), torch.from_numpy(self.state), torch.from_numpy(action)
        lam = solve_lcp(params.F, params.gap(x, u)).lam
        broken = self.steps + 1 == self.breaks_at
        return np.full(2, np.nan) if broken else params.next_state(x, u, lam).numpy()

    @staticmethod
    def judge(state, action, after, goal, ended):
        error = abs(after[0] - goal[0])
        return -error, error < 0.02


def make_envs(count: int, **kwargs) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: PusherEnv(**kwargs)] * count)


class Reach:
    """Stands in for the MPC: moves toward the goal within the bounds, and says that every third solve failed."""

    def __init__(self, lcs=None):
        self.lcs = lcs
        self.bounds = []

    def __call__(self, x0, goal, *, u_min=None, u_max=None):
        assert not torch.is_grad_enabled()
        low = torch.tensor([-U_MAX], dtype=torch.float64) if u_min is None else u_min
        high = torch.tensor([U_MAX], dtype=torch.float64) if u_max is None else u_max
        self.bounds.append((low, high))
        # The model decides too, so that a difference in parameters shows in the data.
        push = 0.0 if self.lcs is None else self.lcs.B.sum() * 1e-3
        action = torch.minimum(torch.maximum(goal - x0[:, 1:] + push, low), high)
        return SimpleNamespace(action=action, converged=torch.arange(len(x0)) % 3 != 2)
