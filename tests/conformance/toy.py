"""A task without contact and simulator that every method trains on in a second."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor, nn

from difflcs import GoalCost, LCSParams
from difflcs.rl.tasks import PhysicsSpec, Quantity, TaskSpec

STEPS = 5
U_MAX = 0.2


def outcome(state: Any, action: Any, after: Any, goal: Any, ended: Any) -> tuple[Any, Any]:
    """Reward and success of a transition, for arrays and tensors of any batch shape."""
    error = abs(after[..., 0] - goal[..., 0])
    success = error < 0.1
    return -error - 1.0 * (ended & ~success), success


class Reaching(gymnasium.Env):
    """Base of environments without a simulator whose first state is to reach a goal.

    Subclasses draw states and goals, move, and judge: reward and success of a transition, see `outcome`.
    """

    def __init__(self, size: int, u_max: float, length: int, breaks_at: int | None = None):
        self.observation_space = spaces.Dict(
            state=spaces.Box(-10.0, 10.0, (size,), np.float64), goal=spaces.Box(-1.0, 1.0, (1,), np.float64)
        )
        self.action_space = spaces.Box(-u_max, u_max, (1,), np.float64)
        self.size, self.length, self.breaks_at = size, length, breaks_at

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.steps, (self.state, self.goal) = 0, self.draw()
        if options and "goal" in options:
            self.goal = np.array(options["goal"], np.float64)
        return self.observe(), {"success": False, "position_error": self.error()}

    def step(self, action: np.ndarray):
        before, self.state = self.state, self.move(np.asarray(action))
        self.steps += 1
        ended, broken = self.steps == self.length, self.steps == self.breaks_at
        reward, success = self.judge(before, action, self.state, self.goal, ended)
        info = {"success": bool(success), "position_error": self.error(), "physics_error": broken}
        return self.observe(), float(reward), False, ended or broken, info

    def error(self) -> float:
        return float(abs(self.state[0] - self.goal[0]))

    def observe(self) -> dict[str, np.ndarray]:
        return {"state": self.state.copy(), "goal": self.goal.copy()}


class Slide(Reaching):
    """The first state moves as told, the others fade."""

    judge = staticmethod(outcome)

    def __init__(self, size: int = 2):
        super().__init__(size, U_MAX, STEPS)

    def draw(self):
        return self.np_random.uniform(-0.1, 0.1, self.size), self.np_random.uniform(-0.8, 0.8, 1)

    def move(self, action: np.ndarray) -> np.ndarray:
        """Return the next state."""
        return np.append(self.state[:1] + action, 0.5 * self.state[1:])


def features(state: Tensor, goal: Tensor, elapsed: Tensor) -> Tensor:
    return torch.cat([state, goal - state[..., :1], elapsed.unsqueeze(-1)], -1)


class Guess(nn.Module):
    """What is known of the slide: the first state moves by some part of what is told, the others fade; no contact."""

    def __init__(self, size: int):
        super().__init__()
        self.n_x, self.n_u, self.n_lam = size, 1, 1
        self.gain = nn.Parameter(torch.tensor(0.5, dtype=torch.float64))
        self.fade = nn.Parameter(torch.full((size - 1,), 0.9, dtype=torch.float64))

    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        one = torch.ones(1, dtype=torch.float64)
        zero, unit = one.new_zeros(self.n_x, 1), torch.eye(self.n_x, 1, dtype=torch.float64)
        return LCSParams(
            A=torch.diag(torch.cat([one, self.fade])),
            B=self.gain * unit,
            C=zero,
            d=zero[:, 0],
            D=zero.mT,
            E=0 * one[None],
            F=one[None],
            c=one,
        )


def make_task(name: str = "toy", size: int = 2, **changes: Any) -> TaskSpec:
    values: dict[str, Any] = {
        "name": name,
        "summary": "Move a point to a place.",
        "env": Slide,
        "env_kwargs": {"size": size},
        "make_cost": partial(GoalCost.reach, size, 1, goal_weight=(5.0,), input_weight=0.1),
        "u_min": -U_MAX,
        "u_max": U_MAX,
        "horizon": 3,
        "episode_steps": STEPS,
        "step_seconds": 0.5,  # 12 episodes in half a minute
        "features": features,
        "outcome": outcome,
        "failure_penalty": 1.0,
        "goal": (Quantity("x", "m"),),
        "errors": (Quantity("position_error", "m"),),
        "example_goals": ((0.5,), (-0.5,)),
        "physics": PhysicsSpec(make_system=partial(Guess, size), scale=(1.0,) * size, relaxation=1e-3),
    }
    return TaskSpec(**{**values, **changes})
