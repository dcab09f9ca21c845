"""A linear complementarity system at each state of a MuJoCo model; needs the extra `envs`."""

from difflcs.errors import MissingDependencyError

try:
    import mujoco as _mujoco  # noqa: F401  the files below import it
except ImportError as error:
    raise MissingDependencyError('expected the package mujoco, got none; run: pip install "difflcs[envs]"') from error

from difflcs.physics.mujoco.cost import Distance, Effort, MujocoCost, Orientation, Position, Posture, Velocity
from difflcs.physics.mujoco.groups import ContactGroup
from difflcs.physics.mujoco.identify import identify
from difflcs.physics.mujoco.lcs import MujocoLCS, lcs_from_mujoco
from difflcs.physics.mujoco.learnable import LearnableMujocoLCS
from difflcs.physics.mujoco.mocap import drive_mocap
from difflcs.physics.mujoco.state import MujocoState

__all__ = [
    "ContactGroup",
    "Distance",
    "Effort",
    "LearnableMujocoLCS",
    "MujocoCost",
    "MujocoLCS",
    "MujocoState",
    "Orientation",
    "Position",
    "Posture",
    "Velocity",
    "drive_mocap",
    "identify",
    "lcs_from_mujoco",
]
