"""Linear complementarity systems from known physics: shapes in the plane, MuJoCo models, and what of it is learned."""

from __future__ import annotations

import importlib
from typing import Any

from difflcs.physics.contact import ContactLCS
from difflcs.physics.contacts import Contacts, FreeMotion, contact_lcs
from difflcs.physics.planar import ForceDrive, Inertia, PDDrive, PlanarPushing, PositionDrive
from difflcs.physics.shapes import Circle, Distance, Polygon, Shape, Union, box

__all__ = [
    "Circle",
    "ContactLCS",
    "Contacts",
    "Distance",
    "ForceDrive",
    "FreeMotion",
    "Inertia",
    "PDDrive",
    "PlanarPushing",
    "Polygon",
    "PositionDrive",
    "Shape",
    "Union",
    "box",
    "contact_lcs",
]


def __getattr__(name: str) -> Any:
    # MuJoCo is an extra.
    if name in ("MujocoLCS", "MujocoState", "lcs_from_mujoco"):
        return getattr(importlib.import_module("difflcs.physics.mujoco"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
