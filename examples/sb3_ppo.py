"""PPO of Stable-Baselines3 goes on training a model that is good already: `python examples/sb3_ppo.py`.

Prints the success before, and after every five updates, for each seed: does a training keep the model, with this
learning rate, this many epochs and this batch? The model is the cube's of the zoo, or with `--system wall` the true one
of a block that a fingertip pushes along a wall, by friction. Success is that of `difflcs.rl.evaluate`, without noise,
on the same goals each time.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor, nn

import difflcs_envs
from difflcs import GoalCost, LCSModel, LCSMPCLayer
from difflcs.errors import DegenerateWarning, SolveWarning
from difflcs.rl import evaluate, get_task
from difflcs.systems import block_along_wall


class MPCAction(nn.Module):
    """The first action of the plan, as a network from observations to actions."""

    def __init__(self, mpc: LCSMPCLayer, n_goal: int):
        super().__init__()
        self.mpc, self.n_goal = mpc, n_goal

    def forward(self, observation: Tensor) -> Tensor:
        """Plan for (batch, n_goal + n_x) observations: their parts are in alphabetical order."""
        goal, state = observation.double().tensor_split([self.n_goal], -1)
        return self.mpc(state, goal).action.float()


class BlockAlongWall(gymnasium.Env):
    """A fingertip pushes a block along a wall to a place; actions are its displacements [m]."""

    steps: ClassVar[int] = 15
    reach: ClassVar[float] = 0.03
    system = block_along_wall(friction=0.6)

    def __init__(self):
        self.action_space = Box(-self.reach, self.reach, (2,), np.float64)
        places = {"state": Box(-1.0, 1.0, (4,), np.float64), "goal": Box(-1.0, 1.0, (1,), np.float64)}
        self.observation_space = Dict(places)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Draw places of block, fingertip and goal."""
        super().reset(seed=seed)
        spread = np.array([0.01, 0.0, 0.01, 0.01])
        self.state = np.array([0.0, 0.0, -0.05, 0.0]) + spread * self.np_random.uniform(-1.0, 1.0, 4)
        self.goal = self.np_random.uniform(0.05, 0.2, 1)
        self.time = 0
        return self.observe(), {}

    def step(self, action: Any) -> Any:
        """Move the fingertip; the reward is the distance to the goal in parts of 10 cm."""
        self.state, self.time = self.system.step(self.state, action).x_next.numpy(), self.time + 1
        error = abs(self.state[0] - self.goal[0])
        info = {"success": bool(error < 0.01), "position_error": error}
        return self.observe(), -float(error) / 0.1, False, self.time == self.steps, info

    def observe(self) -> dict[str, np.ndarray]:
        """Return the observation."""
        return {"state": self.state.copy(), "goal": self.goal.copy()}


@dataclass
class Options:
    """Train, and evaluate."""

    system: Literal["cube", "wall"] = "cube"
    """The cube of the TriFinger, or a block along a wall."""
    learning_rate: float = 1e-4
    """Of Adam, for the model and the value network."""
    epochs: int = 4
    """Passes over the transitions of an update."""
    batch: int = 300
    """Transitions of a gradient step."""
    std: float = 0.005
    """Standard deviation of the exploration at the beginning [m]."""
    envs: int = 20
    """Episodes of an update."""
    updates: int = 10
    """How often episodes are collected and learned from."""
    seeds: tuple[int, ...] = (0,)
    """One training for each."""
    goals: int = 200
    """Goals of an evaluation."""


def make_system(o: Options) -> tuple[LCSMPCLayer, Any, Any, int, int]:
    """Return the controller, an environment, a vector to evaluate on, the length of an episode, the size of a goal."""
    if o.system == "cube":
        task = get_task("cube")
        mpc = task.make_policy(LCSModel.from_pretrained("trifinger-cube"))
        return mpc, "difflcs/TriFingerMoveCube-v0", task.make_envs(20), task.episode_steps, 3  # pyright: ignore
    attract = {"pairs": [(0, 2), (1, 3)], "pair_weight": 0.1}
    cost = GoalCost.reach(4, 2, goal_weight=(10.0,), input_weight=0.1, **attract)
    reach = BlockAlongWall.reach
    lcs = LCSModel.from_params(BlockAlongWall.system)
    # Stable-Baselines3 collects in evaluation mode and updates in training mode: one relaxation for both.
    mpc = LCSMPCLayer(lcs, cost, 5, -reach, reach, relaxation=1e-5, on_failure="mask")
    return mpc, BlockAlongWall, gymnasium.vector.SyncVectorEnv([BlockAlongWall] * 20), BlockAlongWall.steps, 1


def train(o: Options, seed: int) -> list[float]:
    """Return the success before, and after every five updates [%]."""
    mpc, env, tests, steps, n_goal = make_system(o)
    envs = VecNormalize(make_vec_env(env, o.envs, seed=seed), norm_obs=False)
    ppo = PPO(
        "MultiInputPolicy",
        envs,
        o.learning_rate,
        n_steps=steps,
        batch_size=o.batch,
        n_epochs=o.epochs,
        policy_kwargs={"net_arch": {"pi": [], "vf": [64, 64]}, "log_std_init": math.log(o.std)},
        seed=seed,
        device="cpu",
    )
    ppo.policy.action_net = MPCAction(mpc, n_goal)
    ppo.policy.optimizer = torch.optim.Adam(ppo.policy.parameters(), o.learning_rate)

    success = partial(evaluate, tests, mpc, o.goals, 7, steps)
    found = [100 * success().success_rate]
    for update in range(1, o.updates + 1):
        ppo.learn(o.envs * steps, reset_num_timesteps=False)
        if update % 5 == 0:
            found.append(100 * success().success_rate)
    envs.close()
    tests.close()
    return found


def main(o: Options) -> None:
    """Train with each seed."""
    difflcs_envs.register_envs()
    torch.set_num_threads(1)
    for kind in (DegenerateWarning, SolveWarning):  # single samples of a training may fail: their gradient is zero
        warnings.simplefilter("ignore", kind)
    for seed in o.seeds:
        print(f"seed {seed}:", " ".join(f"{rate:.1f} %" for rate in train(o, seed)), flush=True)


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Options))
