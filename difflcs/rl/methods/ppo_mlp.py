"""The method ppo-mlp: the same PPO with a network as its policy."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from difflcs.errors import CheckpointError
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.learning.ppo import PPO, PPOReport
from difflcs.rl.learning.ppo_settings import PPOSettings
from difflcs.rl.methods.base import Method, Work
from difflcs.rl.methods.phases import main_phase
from difflcs.rl.settings import MOST_WIDTH, Adam, bounded, group
from difflcs.rl.tasks import TaskSpec


@dataclass(frozen=True)
class PPOMLPMethod(Method):
    """The same PPO with a network instead of an MPC. Its settings are CleanRL's for continuous actions, where known."""

    width: int = bounded(64, minimum=1, maximum=MOST_WIDTH)
    """Width of the two hidden layers of the policy's network."""
    ppo: PPOSettings = group(
        PPOSettings,
        steps=40,
        minibatch=300,
        update="adam",
        adam=Adam(3e-4, (0.9, 0.999)),
        step_factor=1.0,
        final_step=0.01,
        clip=0.2,
        zeta=0.95,
        covariance="diagonal",
        std_learning_rate=3e-4,
    )
    """Settings of PPO: ten passes over 60 episodes of 20 steps in each iteration."""

    name: ClassVar[str] = "ppo-mlp"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "the same PPO with a network instead of an MPC"
    reports: ClassVar[tuple[type, ...]] = (PPOReport,)
    kind: ClassVar[str] = "MLP"

    def trainer(self, work: Work) -> PPO:
        """See `Method`."""
        task, generator = work.task, torch.Generator().manual_seed(work.seed)
        sizes = (task.n_features, *task.bounds, self.width, task.episode_steps)
        return main_phase(work, MLPController(task.features, *sizes, generator), self.ppo, None)

    def rebuild(
        self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str
    ) -> MLPController:
        """See `Method`."""
        network = MLPController.from_config(config, tensors, source, task.features)
        got, wanted = (network.n_features, len(network.u_min)), (task.n_features, task.n_u)
        if got != wanted:
            raise CheckpointError(f"{source}: expected {wanted} features and actions of {task.name}, got {got}")
        return network

    def policy(self, task: TaskSpec, learned: MLPController) -> MLPController:
        """See `Method`."""
        return learned
