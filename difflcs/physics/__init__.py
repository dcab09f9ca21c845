"""Linear complementarity systems from known physics: shapes in the plane, MuJoCo models, and learnable physics."""

import importlib
from typing import TYPE_CHECKING, Any

from difflcs.physics.complementarity import Bounded, Contacts, FreeMotion, Unilateral, contact_lcs
from difflcs.physics.frame import BodyFrameLCS
from difflcs.physics.frame_search import Frame, find_frame
from difflcs.physics.learnable import ContactLCS
from difflcs.physics.planar import ForceDrive, Inertia, PDDrive, PlanarPushing, PositionDrive
from difflcs.physics.shapes import Circle, NearestPoints, Polygon, Shape, Union, box

if TYPE_CHECKING:  # for type checkers; MuJoCo is an extra, imported by the first use
    from difflcs.physics.mujoco import MujocoLCS as MujocoLCS
    from difflcs.physics.mujoco import MujocoState as MujocoState
    from difflcs.physics.mujoco import lcs_from_mujoco as lcs_from_mujoco

__all__ = [
    "BodyFrameLCS",
    "Bounded",
    "Circle",
    "ContactLCS",
    "Contacts",
    "ForceDrive",
    "Frame",
    "FreeMotion",
    "Inertia",
    "NearestPoints",
    "PDDrive",
    "PlanarPushing",
    "Polygon",
    "PositionDrive",
    "Shape",
    "Unilateral",
    "Union",
    "box",
    "contact_lcs",
    "find_frame",
]


def __getattr__(name: str) -> Any:
    if name in ("MujocoLCS", "MujocoState", "lcs_from_mujoco"):
        return getattr(importlib.import_module("difflcs.physics.mujoco"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
