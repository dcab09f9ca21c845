"""The method improve: PPO from a model that works already, replaced only by what is better."""

from dataclasses import dataclass
from typing import ClassVar

from difflcs.rl.learning.ppo import PPO
from difflcs.rl.methods.base import Work
from difflcs.rl.methods.phases import main_phase
from difflcs.rl.methods.ppo import PPOMethod


@dataclass(frozen=True)
class ImproveMethod(PPOMethod):
    """PPO from the model of --init, which it replaces only where it is better in the robot's own episodes."""

    name: ClassVar[str] = "improve"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "PPO from the model of --init, which only a better one replaces"

    def trainer(self, work: Work) -> PPO:
        """See `Method`."""
        return main_phase(work, self.policy(work.task, self.initial(work)), self.ppo, self.models, keep_best=True)
