"""The method frame-lcs: LCS-RL with a model that is learned in the frame of the body."""

from dataclasses import dataclass, replace
from typing import ClassVar

from difflcs.lcs import LCSModel
from difflcs.physics.frame import BodyFrameLCS
from difflcs.rl.learning.model_rollouts import ModelRolloutSettings
from difflcs.rl.learning.ppo_settings import PPOSettings
from difflcs.rl.learning.trainer import Trainer
from difflcs.rl.methods.base import Work
from difflcs.rl.methods.lcs_rl import LCSRLMethod
from difflcs.rl.methods.phases import warmup_phase
from difflcs.rl.settings import bounded, group


@dataclass(frozen=True)
class FrameMethod(LCSRLMethod):
    """LCS-RL with a `BodyFrameLCS`, whose frame the warm-up finds in its data; then PPO if there is data left."""

    warmup_minutes: float = bounded(3.0, above=0, maximum=1e6)
    """Data of the warm-up [min], at most half of all; the rest is the main phase's."""
    ppo: PPOSettings = group(PPOSettings, rollouts=15, steps=4)
    """Settings of the main phase."""
    models: ModelRolloutSettings = group(
        ModelRolloutSettings, iterations=3, last=2, rollouts=80, steps=10, value_epochs=7
    )
    """Settings of the model rollouts in the main phase."""
    init_scale: float = bounded(0.3, minimum=0)
    """Initial parameters are uniform within ± this, in units of the first data."""

    name: ClassVar[str] = "frame-lcs"
    version: ClassVar[int] = 3
    summary: ClassVar[str] = "LCS-RL in the frame of a pushed body, which it finds in its data"
    kind: ClassVar[str] = BodyFrameLCS.kind
    takes_init: ClassVar[bool] = False
    model: ClassVar[type[LCSModel]] = BodyFrameLCS
    learn_c: ClassVar[bool] = True

    def check(self, minutes: float) -> None:
        """See `Method`: the warm-up alone will do."""
        super(LCSRLMethod, self).check(minutes)

    def trainer(self, work: Work) -> Trainer:
        """See `Method`: PPO follows only if data of more than an iteration are left after the warm-up."""
        task = work.task
        per_minute = task.steps_per_minute / task.episode_steps
        minutes = min(self.warmup_minutes, work.total_episodes / per_minute / 2)
        if work.total_episodes - minutes * per_minute >= self.warmup.rollouts.each:
            return LCSRLMethod.trainer(replace(self, warmup_minutes=minutes), work)
        lcs = self.initial(work)
        return warmup_phase(work, lcs, self.policy(task, lcs), self.warmup)
