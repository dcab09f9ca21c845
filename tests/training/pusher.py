"""A finger that pushes a block on a line: contact without a simulator, and a policy without a model."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from difflcs import LCSParams, solve_lcp

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


class PusherEnv(gymnasium.Env):
    """Push the block to a goal ahead of it."""

    observation_space = spaces.Dict(
        {key: spaces.Box(-10.0, 10.0, (size,), np.float64) for key, size in (("state", 2), ("goal", 1))}
    )
    action_space = spaces.Box(-U_MAX, U_MAX, (1,), np.float64)

    def __init__(self, breaks_at: int | None = None, length: int = STEPS):
        self.breaks_at, self.length = breaks_at, length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.state = self.np_random.uniform([0.05, -0.1], [0.15, 0.0])
        self.goal = self.np_random.uniform([0.2], [0.5])
        return self._observation(), {}

    def step(self, action):
        params, x, u = pusher(), torch.from_numpy(self.state), torch.from_numpy(np.asarray(action))
        lam = solve_lcp(params.F, params.gap(x, u)).lam
        self.state = params.next_state(x, u, lam).numpy()
        self.steps += 1
        broken = self.steps == self.breaks_at
        if broken:
            self.state = np.full(2, np.nan)
        error = abs(float(self.state[0] - self.goal[0]))
        info = {"success": error < 0.02, "position_error": error, "physics_error": broken}
        return self._observation(), -error, False, self.steps >= self.length or broken, info

    def _observation(self):
        return {"state": self.state.copy(), "goal": self.goal.copy()}


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
