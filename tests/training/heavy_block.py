"""A block of a known mass, another one in every episode, and what can be learned of it: a task with a context.

A block of a mass between 0.3 and 3 kg is pushed along a line, with a soft wall at its end. It is learned as known
physics with three unknown numbers.
"""

import math

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor, nn

from difflcs import GoalCost, LCSModule, LCSMPCLayer, LCSParams
from difflcs.errors import InvalidInputError
from difflcs.mpc.backends import BatchedBackend

MASSES = (0.3, 3.0)  # [kg]
DAMPING, STIFFNESS, ADDED_MASS = 0.8, 100.0, 0.2  # [N s/m], of the wall [N/m], of the finger that moves along [kg]
DT = 0.1  # [s]
FORCE = 5.0  # bound of the action [N]
HORIZON = 6
LOG_MASSES = math.log(MASSES[0]), math.log(MASSES[1])
MIDDLE = math.sqrt(MASSES[0] * MASSES[1])


# --- systems ----------------------------------------------------------------------------------------------------------


def block(mass: Tensor, damping: Tensor, stiffness: Tensor, added_mass: Tensor) -> LCSParams:
    """Blocks of some masses (...) [kg] at p ≥ 0 that a force u pushes along a line; at p = 0 a wall with a spring.

    v₊ = v + h/M (u + λ − b v),  p₊ = p + h v₊,  0 ≤ λ ⊥ p₊ + λ/k ≥ 0,  M = mass + added mass.
    """
    mobility = DT / (mass + added_mass)
    zero, one = torch.zeros_like(mobility), torch.ones_like(mobility)
    kept = 1 - mobility * damping
    A = torch.stack([torch.stack([one, DT * kept], -1), torch.stack([zero, kept], -1)], -2)
    B = torch.stack([DT * mobility, mobility], -1).unsqueeze(-1)
    d = torch.zeros_like(B.squeeze(-1))
    F = B[..., :1, :] + 1 / stiffness
    return LCSParams(A=A, B=B, C=B, d=d, D=A[..., :1, :], E=B[..., :1, :], F=F, c=torch.zeros_like(d[..., :1]))


def _mass(context: Tensor | None) -> Tensor:
    if context is None:
        raise InvalidInputError("context: expected the mass (..., 1) [kg], got none; pass context=")
    return context[..., 0]


class Physics(nn.Module):
    """`block` with three unknown numbers, each learned by its logarithm, which keeps it positive."""

    n_x, n_u, n_lam = 2, 1, 1

    def __init__(self, damping: float = DAMPING, stiffness: float = STIFFNESS, added_mass: float = ADDED_MASS):
        super().__init__()
        self.logarithms = nn.ParameterDict(
            {
                name: nn.Parameter(torch.tensor(math.log(value), dtype=torch.float64))
                for name, value in {"damping": damping, "stiffness": stiffness, "added_mass": added_mass}.items()
            }
        )

    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """The systems of masses (..., 1) [kg]."""
        return block(_mass(context), **{name: value.exp() for name, value in self.logarithms.items()})


def true_system(mass: Tensor | None = None) -> LCSParams:
    """The system of masses (...) [kg]; a middle one if None."""
    mass = torch.tensor(MIDDLE, dtype=torch.float64) if mass is None else mass
    return block(mass, *(torch.tensor(v, dtype=torch.float64) for v in (DAMPING, STIFFNESS, ADDED_MASS)))


# --- data -------------------------------------------------------------------------------------------------------------


class HeavyBlock(gymnasium.Env):
    """Push a block of a known mass to a place: an environment whose observations have a context."""

    STEPS = 12
    observation_space = spaces.Dict(
        {key: spaces.Box(-10.0, 10.0, (n,), np.float64) for key, n in (("state", 2), ("goal", 1), ("context", 1))}
    )
    action_space = spaces.Box(-FORCE, FORCE, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        """Draw the state, the goal and the mass."""
        super().reset(seed=seed)
        self.steps = 0
        self.state = self.np_random.uniform([0.0, -0.5], [0.3, 0.5])
        self.goal = self.np_random.uniform([0.0], [0.3])
        self.context = np.exp(self.np_random.uniform(*LOG_MASSES, 1))
        return self._observe(), {"success": False}

    def step(self, action):
        """One step of the true system."""
        system = true_system(torch.tensor(self.context[0]))
        self.state = system.step(torch.from_numpy(self.state), torch.from_numpy(np.asarray(action))).x_next.numpy()
        self.steps += 1
        error = float(abs(self.state[0] - self.goal[0]))
        info = {"success": error < 0.03, "position_error": error}
        return self._observe(), -10 * error, False, self.steps == self.STEPS, info

    def _observe(self):
        return {"state": self.state.copy(), "goal": self.goal.copy(), "context": self.context.copy()}


# --- what is measured -------------------------------------------------------------------------------------------------


def make_mpc(lcs: LCSModule) -> LCSMPCLayer:
    """Bring the block to a goal, whatever its mass."""
    cost = GoalCost.reach(2, 1, goal_weight=(20.0,), input_weight=0.002)
    # One start and a short homotopy: a plan that is learned from should change little when the system does.
    backend = BatchedBackend(effort="fast", homotopy=100.0, tol=1e-10)
    return LCSMPCLayer(lcs, cost, HORIZON, -FORCE, FORCE, backend=backend, on_failure="mask")
