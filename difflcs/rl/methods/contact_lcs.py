"""The method contact-lcs: LCS-RL with known contacts, whose physics is fitted."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from difflcs import _storage
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.mpc import LCSMPCLayer
from difflcs.records import LCSModule
from difflcs.rl.learning.lcsrl import LCSRL
from difflcs.rl.learning.model_rollouts import ModelRolloutSettings
from difflcs.rl.learning.physics_fit import PhysicsFit, PhysicsFitReport, PhysicsFitSettings
from difflcs.rl.learning.ppo import PPOReport
from difflcs.rl.learning.ppo_settings import PPOSettings
from difflcs.rl.learning.trainer import Trainer, configuration
from difflcs.rl.methods.base import Method, Work
from difflcs.rl.methods.phases import main_phase
from difflcs.rl.settings import bounded, group
from difflcs.rl.tasks import PhysicsSpec, TaskSpec, single_start_backend


@dataclass(frozen=True)
class ContactMethod(Method):
    """LCS-RL with physics inside: known contacts, a dozen numbers fitted to the MPC's own episodes, then PPO."""

    fit_minutes: float = bounded(3.0, above=0, maximum=1e6)
    """Data of the fit [min]; what is left is that of PPO through the MPC."""
    fit: PhysicsFitSettings = group(PhysicsFitSettings)
    """Settings of the fit."""
    ppo: PPOSettings = group(PPOSettings, gain=1.65)
    """Settings of PPO."""
    models: ModelRolloutSettings = group(ModelRolloutSettings)
    """Settings of the model rollouts of PPO."""
    backend: str = "batched"
    """MPC solver: batched, or ipopt, the reference."""

    name: ClassVar[str] = "contact-lcs"
    version: ClassVar[int] = 3
    summary: ClassVar[str] = "known contacts whose physics is fitted, then PPO through the MPC; told the outline"
    reports: ClassVar[tuple[type, ...]] = (PhysicsFitReport, PPOReport)
    kind: ClassVar[str] = "physics"

    def trainer(self, work: Work) -> Trainer:
        """See `Method`.

        Raises:
            InvalidInputError: the task has no known physics.
        """
        task, spec = work.task, known_physics(work.task)
        lcs = spec.make_system()
        policy = self.policy(task, lcs)
        first = max(1, round(self.fit_minutes * task.steps_per_minute / task.episode_steps))
        count = min(first, work.total_episodes)
        scale = torch.tensor(spec.scale, dtype=torch.float64)
        envs = work.make_envs(min(self.fit.rollouts, count))
        fit = PhysicsFit(lcs, policy, envs, self.fit, work.seed, scale, count, task.episode_steps)
        if count == work.total_episodes:
            return fit
        return LCSRL(
            fit, count * task.episode_steps, lambda *begun: main_phase(work, policy, self.ppo, self.models, *begun)
        )

    def rebuild(
        self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str
    ) -> LCSModule:
        """See `Method`."""
        lcs = known_physics(task).make_system()
        if not _nearly_equal(dict(config), configuration(lcs)):
            raise CheckpointError(
                f"{source}: expected what is known of task {task.name} to be as when it was learned, got another "
                f"physics; is the object's mesh there in one place, and a stand-in in the other?"
            )
        wanted = {name: (tuple(value.shape), value.dtype) for name, value in lcs.state_dict().items()}
        _storage.check_tensors(source, "tensors", tensors, wanted)
        lcs.load_state_dict(dict(tensors))
        return lcs

    def policy(self, task: TaskSpec, learned: LCSModule) -> LCSMPCLayer:
        """See `Method`: the MPC as `PhysicsSpec` says."""
        return task.make_policy(learned, single_start_backend(self.backend), known_physics(task))


def _nearly_equal(one: Any, other: Any) -> bool:
    """Return True if two configurations are equal up to rounding, in which machines differ."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_nearly_equal(value, other[name]) for name, value in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_nearly_equal, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-9)
    return type(one) is type(other) and one == other


def known_physics(task: TaskSpec) -> PhysicsSpec:
    """Return the known physics of a task.

    Raises:
        InvalidInputError: the task has none.
    """
    if task.physics is None:
        raise InvalidInputError(
            f"method: expected a task with known physics, got {task.name} without; give its TaskSpec a PhysicsSpec, "
            f"or learn it by lcs-rl"
        )
    return task.physics
