"""The method frame-lcs: LCS-RL with a model that is learned in the frame of the body."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.mpc.backends import get_backend
from difflcs.physics.frame import BodyFrameLCS
from difflcs.rl.learning.phases import LCSRL
from difflcs.rl.learning.warmup import Warmup
from difflcs.rl.methods.base import Work, check_fits
from difflcs.rl.methods.lcs_rl import LCSRLMethod
from difflcs.rl.methods.phases import main_phase, warmup_phase
from difflcs.rl.tasks import TaskSpec


@dataclass(frozen=True)
class FrameMethod(LCSRLMethod):
    """LCS-RL with a `BodyFrameLCS`: the warm-up, and then PPO if there is data left. For tasks that are `planar`."""

    keep_best: bool = True
    """Whether what PPO learns replaces the policy so far only where it is better in the robot's own episodes."""

    name: ClassVar[str] = "frame-lcs"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "LCS-RL in the frame of the body; told that the state is a pose and points of a plane"
    kind: ClassVar[str] = "BodyFrameLCS"
    takes_init: ClassVar[bool] = False

    def check(self, minutes: float) -> None:
        """See `Method`: the warm-up alone will do."""
        get_backend(self.backend)

    def initial(self, work: Work) -> BodyFrameLCS:
        """Make the model to start from.

        Raises:
            InvalidInputError: the state of the task is no pose and points of a plane.
        """
        if not work.task.planar:
            raise InvalidInputError(
                f"method: expected a planar task for {self.name}, got {work.task.name}; set `planar` in its TaskSpec "
                f"if its state is the pose of a body and points of a plane, or learn it by lcs-rl"
            )
        generator = torch.Generator().manual_seed(work.seed)
        sizes = (work.task.n_x, work.task.n_u, self.n_lam, self.stiffness)
        return BodyFrameLCS(*sizes, init_scale=self.init_scale, generator=generator)

    def trainer(self, work: Work) -> Warmup | LCSRL:
        """See `Method`."""
        lcs = self.initial(work)
        policy, first = self.policy(work.task, lcs), round(self.warmup_minutes * work.task.steps_per_minute)
        warmup = warmup_phase(work, lcs, policy, self.warmup)
        count, rollouts = math.ceil(first / work.task.episode_steps), self.warmup.rollouts
        ended = rollouts.first + max(0, math.ceil((count - rollouts.first) / rollouts.each)) * rollouts.each
        if work.total_episodes <= ended:
            return warmup
        return LCSRL(
            warmup,
            first,
            lambda episodes, iterations: main_phase(
                work, policy, self.ppo, self.models, episodes, iterations, self.keep_best
            ),
        )

    def rebuild(
        self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str
    ) -> BodyFrameLCS:
        """See `Method`."""
        lcs = BodyFrameLCS.from_config(config, tensors, source)
        check_fits(lcs, task, source, CheckpointError)
        return lcs
