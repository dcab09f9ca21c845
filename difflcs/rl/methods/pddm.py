"""The method pddm: networks that predict, and a planner that samples actions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from difflcs.errors import CheckpointError
from difflcs.rl.learning.dynamics import Ensemble
from difflcs.rl.learning.pddm import PDDM, PDDMSettings, Planner
from difflcs.rl.learning.trainer import EpisodesReport
from difflcs.rl.methods.base import Method, Work
from difflcs.rl.settings import group
from difflcs.rl.tasks import TaskSpec


@dataclass(frozen=True)
class PDDMMethod(Method):
    """PDDM: networks, and a planner that samples actions."""

    pddm: PDDMSettings = group(PDDMSettings)
    """Settings of PDDM."""

    name: ClassVar[str] = "pddm"
    version: ClassVar[int] = 2
    summary: ClassVar[str] = "PDDM: networks, and a planner that samples actions"
    reports: ClassVar[tuple[type, ...]] = (EpisodesReport,)
    kind: ClassVar[str] = "dynamics"

    def trainer(self, work: Work) -> PDDM:
        """See `Method`."""
        needed = max(self.pddm.rollouts.first, self.pddm.rollouts.each)
        return PDDM(
            work.task.make_cost(),
            work.make_envs(min(needed, work.total_episodes)),
            self.pddm,
            work.seed,
            total_episodes=work.total_episodes,
            episode_steps=work.task.episode_steps,
        )

    def rebuild(
        self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str
    ) -> Ensemble:
        """See `Method`."""
        ensemble = Ensemble.from_config(config, tensors, source)
        if (ensemble.n_x, ensemble.n_u) != (task.n_x + task.n_context, task.n_u):
            raise CheckpointError(f"{source}: expected networks of the sizes of {task.name}, got others")
        return ensemble

    def policy(self, task: TaskSpec, learned: Ensemble) -> Planner:
        """See `Method`."""
        return Planner(learned, task.make_cost(), self.pddm, *task.bounds)
