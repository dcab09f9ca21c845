"""The method mujoco-lcs: LCS-RL with the physics of a MuJoCo model, whose uncertain numbers are fitted."""

from dataclasses import dataclass
from typing import ClassVar

from difflcs._checks import check_kind
from difflcs.rl.learning.physics_fit import PhysicsFitSettings
from difflcs.rl.learning.trainer import Trainer
from difflcs.rl.methods.base import Work
from difflcs.rl.methods.contact_lcs import ContactMethod, known_physics
from difflcs.rl.settings import group


@dataclass(frozen=True)
class MujocoMethod(ContactMethod):
    """LCS-RL with a MuJoCo model inside, whose own steps are fitted to the MPC's episodes; then PPO."""

    fit: PhysicsFitSettings = group(PhysicsFitSettings, rollouts=4, simulated=240)
    """Settings of the fit."""

    name: ClassVar[str] = "mujoco-lcs"
    version: ClassVar[int] = 4
    summary: ClassVar[str] = "a MuJoCo model whose uncertain numbers are fitted, then PPO through the MPC"

    def trainer(self, work: Work) -> Trainer:
        """See `Method`; a DTypeError where the task has no MuJoCo model that can be learned."""
        from difflcs.physics.mujoco import LearnableMujocoLCS  # MuJoCo need not be installed

        system = known_physics(work.task).make_system()
        check_kind("task.physics.make_system()", system, LearnableMujocoLCS, "use contact-lcs for other physics")
        return super().trainer(work)
