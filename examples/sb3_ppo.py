"""PPO of Stable-Baselines3 goes on training the cube's model of the zoo: `python examples/sb3_ppo.py`.

Prints the success before, and after every five updates, for each seed: does a training keep a good model, with this
learning rate, this many epochs and this batch? Success is that of `difflcs.rl.evaluate`, without noise, on the same
goals each time.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor, nn

import difflcs_envs
from difflcs import LCSModel, LCSMPCLayer
from difflcs.errors import DegenerateWarning, SolveWarning
from difflcs.rl import evaluate, get_task


class MPCAction(nn.Module):
    """The first action of the plan, as a network from observations to actions."""

    def __init__(self, mpc: LCSMPCLayer):
        super().__init__()
        self.mpc = mpc

    def forward(self, observation: Tensor) -> Tensor:
        """Plan for (batch, 12) observations: Stable-Baselines3 puts the parts of one in alphabetical order."""
        goal, state = observation.double().split([3, 9], -1)
        return self.mpc(state, goal).action.float()


@dataclass
class Options:
    """Train, and evaluate."""

    learning_rate: float = 1e-4
    """Of Adam, for the model and the value network."""
    epochs: int = 4
    """Passes over the transitions of an update."""
    batch: int = 300
    """Transitions of a gradient step."""
    std: float = 0.005
    """Standard deviation of the exploration at the beginning [m]."""
    envs: int = 30
    """Episodes of an update, of 20 steps each."""
    updates: int = 10
    """How often episodes are collected and learned from."""
    seeds: tuple[int, ...] = (0,)
    """One training for each."""
    goals: int = 200
    """Goals of an evaluation."""


def train(o: Options, seed: int) -> list[float]:
    """Return the success before, and after every five updates [%]."""
    task, model = get_task("cube"), LCSModel.from_pretrained("trifinger-cube")
    mpc, tests = task.make_policy(model), task.make_envs(20)
    envs = VecNormalize(make_vec_env("difflcs/TriFingerMoveCube-v0", o.envs, seed=seed), norm_obs=False)
    ppo = PPO(
        "MultiInputPolicy",
        envs,
        o.learning_rate,
        n_steps=task.episode_steps,
        batch_size=o.batch,
        n_epochs=o.epochs,
        policy_kwargs={"net_arch": {"pi": [], "vf": [64, 64]}, "log_std_init": math.log(o.std)},
        seed=seed,
        device="cpu",
    )
    ppo.policy.action_net = MPCAction(mpc)
    ppo.policy.optimizer = torch.optim.Adam(ppo.policy.parameters(), o.learning_rate)

    found = []
    for update in range(o.updates + 1):
        if update:
            ppo.learn(o.envs * task.episode_steps, reset_num_timesteps=False)
        if update % 5 == 0:
            found.append(100 * evaluate(tests, mpc, o.goals, 7, task.episode_steps).success_rate)
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
