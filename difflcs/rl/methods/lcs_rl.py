"""The method lcs-rl: the warm-up, and then PPO through the MPC."""

from dataclasses import dataclass
from typing import ClassVar

from difflcs.errors import InvalidInputError
from difflcs.rl.learning.lcsrl import LCSRL
from difflcs.rl.learning.model_rollouts import ModelRolloutSettings
from difflcs.rl.learning.ppo import PPOReport
from difflcs.rl.learning.ppo_settings import PPOSettings
from difflcs.rl.learning.trainer import Trainer
from difflcs.rl.learning.warmup import WarmupReport, WarmupSettings
from difflcs.rl.methods.base import LCSMethod, Work
from difflcs.rl.methods.phases import main_phase, warmup_phase
from difflcs.rl.settings import bounded, group


@dataclass(frozen=True)
class LCSRLMethod(LCSMethod):
    """LCS-RL: the warm-up (Algorithm 1), and then PPO through the MPC (Algorithm 2), with model rollouts."""

    warmup_minutes: float = bounded(3.0, above=0, maximum=1e6)
    """Data of the warm-up [min], the rest is the main phase's (6 in the paper)."""
    warmup: WarmupSettings = group(WarmupSettings, keep_support=True)
    """Settings of the warm-up phase."""
    ppo: PPOSettings = group(PPOSettings)
    """Settings of the main phase."""
    models: ModelRolloutSettings = group(ModelRolloutSettings)
    """Settings of the model rollouts in the main phase."""

    name: ClassVar[str] = "lcs-rl"
    version: ClassVar[int] = 2
    summary: ClassVar[str] = "the warm-up (Algorithm 1), and then PPO through the MPC (Algorithm 2)"
    reports: ClassVar[tuple[type, ...]] = (WarmupReport, PPOReport)

    def check(self, minutes: float) -> None:
        """See `Method`."""
        super().check(minutes)
        if minutes <= self.warmup_minutes:
            raise InvalidInputError(
                f"minutes: expected more than the {self.warmup_minutes:g} of the warm-up with lcs-rl, got "
                f"{minutes:g}; pass --minutes 30, a shorter --warmup-minutes, or --method violation for a warm-up alone"
            )

    def trainer(self, work: Work) -> Trainer:
        """See `Method`."""
        lcs = self.initial(work)
        policy = self.policy(work.task, lcs)
        return LCSRL(
            warmup_phase(work, lcs, policy, self.warmup),
            round(self.warmup_minutes * work.task.steps_per_minute),
            lambda *begun: main_phase(work, policy, self.ppo, self.models, *begun),
        )
