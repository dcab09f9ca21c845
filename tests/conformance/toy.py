"""A task without contact and simulator that every method trains on in a second, and a method of ten lines."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from difflcs import GoalCost, LCSParams
from difflcs.errors import CheckpointError
from difflcs.rl.learning.trainer import AfterStep, Trainer
from difflcs.rl.methods import Method, Work
from difflcs.rl.rollout import PolicyOutput, collect, mpc_actions
from difflcs.rl.seeding import Stream, episode_seeds, generator
from difflcs.rl.settings import bounded
from difflcs.rl.tasks import PhysicsSpec, Quantity, TaskSpec

STEPS = 5
U_MAX = 0.2


def outcome(state: Any, action: Any, after: Any, goal: Any, ended: Any) -> tuple[Any, Any]:
    """Reward and success of a transition, for arrays and tensors of any batch shape."""
    error = abs(after[..., 0] - goal[..., 0])
    success = error < 0.1
    return -error - 1.0 * (ended & ~success), success


class Slide(gymnasium.Env):
    """The first state moves as told, the others fade."""

    def __init__(self, size: int = 2):
        box = spaces.Box
        self.observation_space = spaces.Dict(
            state=box(-9.0, 9.0, (size,), np.float64), goal=box(-1.0, 1.0, (1,), np.float64)
        )
        self.action_space = box(-U_MAX, U_MAX, (1,), np.float64)
        self.size = size

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.steps, self.state = 0, self.np_random.uniform(-0.1, 0.1, self.size)
        self.goal = self.np_random.uniform(-0.8, 0.8, 1)
        if options and "goal" in options:
            self.goal = np.array(options["goal"], np.float64)
        return self._observe(), {"success": False, "position_error": self._error()}

    def step(self, action: np.ndarray):
        before, self.state = self.state, self.move(action)
        self.steps += 1
        ended = self.steps == STEPS
        reward, success = outcome(before, action, self.state, self.goal, ended)
        return self._observe(), float(reward), False, ended, {"success": bool(success), "position_error": self._error()}

    def move(self, action: np.ndarray) -> np.ndarray:
        """Return the next state."""
        return np.append(self.state[:1] + action, 0.5 * self.state[1:])

    def _error(self) -> float:
        return float(abs(self.state[0] - self.goal[0]))

    def _observe(self) -> dict[str, np.ndarray]:
        return {"state": self.state.copy(), "goal": self.goal.copy()}


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


# --- a method ---------------------------------------------------------------------------------------------------------


class Gain(nn.Module):
    """u = gain · (goal − x), within the bounds."""

    def __init__(self, gain: float):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor([gain], dtype=torch.float64), requires_grad=False)

    def forward(
        self, x0: Tensor, goal: Tensor, *, u_min: Tensor | None = None, u_max: Tensor | None = None
    ) -> PolicyOutput:
        action = (self.gain * (goal - x0[:, :1])).clamp(-U_MAX, U_MAX)
        return PolicyOutput(action, torch.ones(len(x0), dtype=torch.bool))

    def config(self) -> dict[str, Any]:
        return {"size": 1}

    def save_pretrained(self, directory: Path) -> None:
        from difflcs import _storage

        _storage.save_record(directory, "gain", self.config(), self.state_dict())


@dataclass(frozen=True)
class SearchReport:
    iteration: int
    env_steps: int
    best_error: float


class Search(Trainer):
    """Keeps a random gain if it ends nearer to the goals."""

    def __init__(self, env: VectorEnv, episodes: int, spread: float, seed: int, episode_steps: int):
        gain = Gain(0.1)
        super().__init__(gain, gain, seed, episode_steps)
        self.gain, self.env, self.count, self.spread = gain, env, episodes, spread
        self.best = 1e9

    def step(self, after_step: AfterStep | None = None) -> SearchReport:
        before = self.gain.gain.clone()
        draw = torch.randn(1, generator=generator(self.seed, Stream.NOISE, self.iteration), dtype=torch.float64)
        self.gain.gain += self.spread * draw
        seeds = episode_seeds(self.seed, Stream.TRAINING, self.episodes, self.count)
        report = None if after_step is None else lambda: after_step(self.count)
        record = collect(self.env, mpc_actions(self.policy), seeds, self.episode_steps, report)
        error = float(record["errors", "position_error"].mean())
        if error < self.best:
            self.best = error
        else:
            self.gain.gain.copy_(before)
        self.iteration, self.episodes = self.iteration + 1, self.episodes + self.count
        return SearchReport(self.iteration, self.env_steps, self.best)

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "best": self.best}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self.best = state["best"]


@dataclass(frozen=True)
class SearchMethod(Method):
    """Random search for the gain of a proportional controller."""

    spread: float = bounded(0.5, above=0)
    """Standard deviation of a change of the gain."""
    tries: int = bounded(4, minimum=1, maximum=100)
    """Episodes that a gain is judged by."""

    name: ClassVar[str] = "search"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "random search for the gain of a proportional controller"
    reports: ClassVar[tuple[type, ...]] = (SearchReport,)
    kind: ClassVar[str] = "gain"

    def trainer(self, work: Work) -> Search:
        return Search(work.make_envs(self.tries), self.tries, self.spread, work.seed, work.task.episode_steps)

    def rebuild(self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str) -> Gain:
        if config != {"size": 1} or set(tensors) != {"gain"} or tensors["gain"].shape != (1,):
            raise CheckpointError(f"{source}: expected a gain, got {sorted(tensors)}")
        return Gain(float(tensors["gain"]))

    def policy(self, task: TaskSpec, learned: Gain) -> Gain:
        return learned

    def smoke(self) -> Self:
        return self
