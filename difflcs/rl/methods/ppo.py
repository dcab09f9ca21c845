"""The method ppo: PPO through the MPC, without a warm-up."""

from dataclasses import dataclass
from typing import ClassVar

from difflcs.rl.learning.model_rollouts import ModelRolloutSettings
from difflcs.rl.learning.ppo import PPO, PPOReport
from difflcs.rl.learning.ppo_settings import PPOSettings
from difflcs.rl.methods.base import LCSMethod, Work
from difflcs.rl.methods.phases import main_phase
from difflcs.rl.settings import group


@dataclass(frozen=True)
class PPOMethod(LCSMethod):
    """PPO through the MPC (Algorithm 2) without a warm-up."""

    ppo: PPOSettings = group(PPOSettings)
    """Settings of PPO."""
    models: ModelRolloutSettings = group(ModelRolloutSettings)
    """Settings of the model rollouts."""

    name: ClassVar[str] = "ppo"
    version: ClassVar[int] = 2
    summary: ClassVar[str] = "PPO through the MPC (Algorithm 2) without a warm-up"
    reports: ClassVar[tuple[type, ...]] = (PPOReport,)

    def trainer(self, work: Work) -> PPO:
        """See `Method`."""
        return main_phase(work, self.policy(work.task, self.initial(work)), self.ppo, self.models)
