"""The method frame-lcs: LCS-RL with a model that is learned in the frame of the body."""

from dataclasses import dataclass
from typing import ClassVar

from difflcs.errors import InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.physics.frame import BodyFrameLCS
from difflcs.rl.learning.trainer import Trainer
from difflcs.rl.methods.base import Work
from difflcs.rl.methods.lcs_rl import LCSRLMethod
from difflcs.rl.methods.phases import warmup_phase
from difflcs.rl.settings import bounded


@dataclass(frozen=True)
class FrameMethod(LCSRLMethod):
    """LCS-RL with a `BodyFrameLCS`: the warm-up, and then PPO if there is data left. For tasks that are `planar`."""

    init_scale: float = bounded(0.3, minimum=0)
    """Initial parameters are uniform within ± this, in units of the first data."""

    name: ClassVar[str] = "frame-lcs"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "LCS-RL in the frame of the body; told that the state is a pose and points of a plane"
    kind: ClassVar[str] = BodyFrameLCS.kind
    takes_init: ClassVar[bool] = False
    model: ClassVar[type[LCSModel]] = BodyFrameLCS
    learn_c: ClassVar[bool] = True

    def check(self, minutes: float) -> None:
        """See `Method`: the warm-up alone will do."""
        super(LCSRLMethod, self).check(minutes)

    def trainer(self, work: Work) -> Trainer:
        """See `Method`: PPO follows only if data of more than an iteration are left after the warm-up.

        Raises:
            InvalidInputError: the state of the task is no pose and points of a plane.
        """
        task = work.task
        if not task.planar:
            raise InvalidInputError(
                f"method: expected a planar task for {self.name}, got {task.name}; set `planar` in its TaskSpec if its "
                f"state is the pose of a body and points of a plane, or learn it by lcs-rl"
            )
        left = work.total_episodes - self.warmup_minutes * task.steps_per_minute / task.episode_steps
        if left >= self.warmup.rollouts.each:
            return super().trainer(work)
        lcs = self.initial(work)
        return warmup_phase(work, lcs, self.policy(task, lcs), self.warmup)
