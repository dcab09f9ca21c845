"""The method violation: the warm-up alone."""

from dataclasses import dataclass
from typing import ClassVar

from difflcs.rl.learning.warmup import Warmup, WarmupReport, WarmupSettings
from difflcs.rl.methods.base import LCSMethod, Work
from difflcs.rl.methods.phases import warmup_phase
from difflcs.rl.settings import group


@dataclass(frozen=True)
class ViolationMethod(LCSMethod):
    """The warm-up (Algorithm 1) alone: a model fitted by the violation loss."""

    warmup: WarmupSettings = group(WarmupSettings)
    """Settings of the warm-up."""

    name: ClassVar[str] = "violation"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "the warm-up (Algorithm 1) alone: a model fitted by the violation loss"
    reports: ClassVar[tuple[type, ...]] = (WarmupReport,)

    def trainer(self, work: Work) -> Warmup:
        """See `Method`."""
        lcs = self.initial(work)
        return warmup_phase(work, lcs, self.policy(work.task, lcs), self.warmup)
