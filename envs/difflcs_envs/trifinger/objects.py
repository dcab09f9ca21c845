"""The objects of the tasks: the YCB objects of the paper, their primitive stand-ins, and any mesh.

The YCB meshes (Calli et al., IEEE RAM 2015) do not ship with this package. They are searched in the folder that
`DIFFLCS_YCB_DIR` names, then in that of `difflcs assets download`. Without them a stand-in of boxes, cylinders and
capsules with the size, the mass and the resting height of the object takes its place; `source` says which it is.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from difflcs_envs.assets import YCB_DIR_VARIABLE, find_ycb_mesh
from difflcs_envs.errors import MeshError
from difflcs_envs.trifinger.meshes import LYING, Solid, check_extent, load_mesh, make_solid
from difflcs_envs.trifinger.model import COLLISION_GROUP, GOAL_MARGIN, SceneObject
from difflcs_envs.ycb import YCB, YcbObject

DEFAULT_MASS = 0.05  # [kg] of YCB objects and meshes. The paper gives none; a tip pushes with 0.45 N at osc_kp 1000.
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".dae", ".3mf")
COLORS = {
    "sugar_box": (0.95, 0.80, 0.35, 1.0),
    "fish_can": (0.45, 0.66, 0.86, 1.0),
    "banana": (0.98, 0.83, 0.22, 1.0),
    "mug": (0.92, 0.52, 0.40, 1.0),
    "wrench": (0.45, 0.48, 0.55, 1.0),
}
OTHER_COLOR = (0.55, 0.72, 0.50, 1.0)


@dataclass(frozen=True, kw_only=True)
class MeshObject(SceneObject):
    """An object with the shape of a mesh.

    Attributes:
        solid: Its shape in its rest pose.
    """

    solid: Solid

    @property
    def rest_height(self) -> float:
        """See `SceneObject`."""
        return self.solid.rest_height

    @property
    def height(self) -> float:
        """See `SceneObject`."""
        return float(self.solid.vertices[:, 2].max()) + self.solid.rest_height

    @property
    def outline(self) -> np.ndarray:
        """See `SceneObject`."""
        return np.concatenate(self.solid.parts)[:, :2]

    def describe(self) -> dict[str, Any]:
        """See `SceneObject`."""
        solid = {"sha256": self.solid.digest, "parts": len(self.solid.parts)}
        return {**super().describe(), **solid, "rest_height": round(self.rest_height, 6)}

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, contact: dict[str, Any]) -> None:
        """Add the convex parts, which collide, and the mesh, which is seen."""
        _set_inertia(body, self.mass, self.solid.inertia)
        for i, points in enumerate(self.solid.parts):
            spec.add_mesh(name=f"object_part_{i}", uservert=points.ravel().tolist())
            body.add_geom(
                name=f"object_{i}",
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=f"object_part_{i}",
                mass=0.0,
                group=COLLISION_GROUP,
                **contact,
            )
        self._add_visual(spec, body, "object_visual", 1.0, {"rgba": COLORS.get(self.name, OTHER_COLOR)})

    def add_goal_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, appearance: dict[str, Any]) -> None:
        """See `SceneObject`."""
        # A hair larger than the object: faces in one place would flicker.
        scale = 1.0 + GOAL_MARGIN / float(self.solid.size.max() / 2)
        self._add_visual(spec, body, "goal_visual", scale, appearance)

    def _add_visual(
        self, spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, scale: float, appearance: dict[str, Any]
    ) -> None:
        spec.add_mesh(
            name=name,
            uservert=(scale * self.solid.vertices).ravel().tolist(),
            userface=self.solid.faces.ravel().tolist(),
        )
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, mass=0.0, **{"contype": 0, "conaffinity": 0, **appearance}
        )


@dataclass(frozen=True, kw_only=True)
class StandInObject(SceneObject):
    """Boxes, cylinders and capsules in place of a YCB object whose mesh is not on this machine.

    Size, mass and resting height are those of the object, the rest is rough: results with it are not results with the
    object.

    Attributes:
        ycb: The object it stands in for.
    """

    ycb: YcbObject
    source: str = "stand_in"

    @property
    def rest_height(self) -> float:
        """See `SceneObject`."""
        return self.ycb.rest_height

    @property
    def height(self) -> float:
        """See `SceneObject`."""
        return self.ycb.size[2]

    @property
    def outline(self) -> np.ndarray:
        """See `SceneObject`."""
        return np.concatenate(self.outlines)

    @property
    def outlines(self) -> list[np.ndarray]:
        """Points [m] around each primitive, as seen from above."""
        return [primitive.outline() - self._middle for primitive in self.ycb.stand_in]

    @property
    def _middle(self) -> np.ndarray:
        """Centre of mass of the primitives in the plane [m], (2,)."""
        volumes = np.array([p.volume for p in self.ycb.stand_in])
        return volumes @ np.array([p.center[:2] for p in self.ycb.stand_in]) / volumes.sum()

    def describe(self) -> dict[str, Any]:
        """See `SceneObject`."""
        return {**super().describe(), "parts": len(self.ycb.stand_in), "rest_height": self.rest_height}

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, contact: dict[str, Any]) -> None:
        """See `SceneObject`."""
        origin = np.array([*self._middle, self.rest_height])
        volume = sum(p.volume for p in self.ycb.stand_in)
        _set_inertia(body, self.mass, np.sum([p.inertia(origin) for p in self.ycb.stand_in], axis=0) / volume)
        self._add(body, 0.0, {"mass": 0.0, "rgba": COLORS.get(self.name, OTHER_COLOR), **contact}, name="object")

    def add_goal_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, appearance: dict[str, Any]) -> None:
        """See `SceneObject`."""
        self._add(body, GOAL_MARGIN, appearance)

    def _add(self, body: mujoco.MjsBody, margin: float, keywords: dict[str, Any], name: str = "") -> None:
        origin = np.array([*self._middle, self.rest_height])
        for i, primitive in enumerate(self.ycb.stand_in):
            x, y, z, w = *primitive.axis_quat[1:], primitive.axis_quat[0]
            body.add_geom(
                name=f"{name}_{i}" if name else "",
                type=getattr(mujoco.mjtGeom, f"mjGEOM_{primitive.shape.upper()}"),
                pos=(np.array(primitive.center) - origin).tolist(),
                quat=[w, x, y, z],
                size=[*(s + margin for s in primitive.size), 0.0, 0.0][:3],
                **keywords,
            )


def _set_inertia(body: mujoco.MjsBody, mass: float, unit_inertia: np.ndarray) -> None:
    """Set mass and inertia: MuJoCo's sum over overlapping parts is too large (its issue 2152)."""
    i = mass * unit_inertia
    body.explicitinertial = True
    body.mass = mass
    body.ipos = [0.0, 0.0, 0.0]
    body.fullinertia = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]


def make_object(
    name: str,
    *,
    mass: float | str | None = None,
    friction: float = 0.5,
    source: str = "auto",
    rest_pose: str | int = LYING,
    parts: int | None = None,
    mesh_scale: float = 1.0,
) -> MeshObject | StandInObject:
    """Make an object by name or from a mesh file.

    Args:
        name: Name of a YCB object, or path of a mesh file.
        mass: Mass [kg], "true" for the published mass of a YCB object, None for 0.05 kg.
        friction: Sliding friction between object and table.
        source: "auto": the mesh if it is there, else the stand-in; "mesh": the mesh or an error; "stand_in".
        rest_pose: "lying", "upright", or the number of a stable pose, lowest centre of mass first.
        parts: Most convex parts; None for the default.
        mesh_scale: Length of one unit of the mesh file [m].

    Raises:
        ValueError: An argument has no meaning, or the object is unknown.
        MeshError: The mesh is missing although it is asked for, or unusable.
    """
    if source not in ("auto", "mesh", "stand_in"):
        raise ValueError(f"Expected object_source 'auto', 'mesh' or 'stand_in', got {source!r}. Choose one of them.")
    entry = YCB.get(name)
    if entry is None:
        path, kilograms = _mesh_file(name, source), _mass(mass, None)
        solid = make_solid(load_mesh(path, mesh_scale), path.name, parts, rest_pose)
        return MeshObject(name=path.stem, source="mesh", solid=solid, mass=kilograms, friction=friction)
    kilograms = _mass(mass, entry.mass)
    path = None if source == "stand_in" else find_ycb_mesh(entry)
    if path is not None:
        mesh = load_mesh(path, mesh_scale)
        check_extent(mesh, name, entry.size, path)
        solid = make_solid(mesh, name, entry.parts if parts is None else parts, rest_pose, entry.concavity)
        return MeshObject(name=name, source="ycb_mesh", solid=solid, mass=kilograms, friction=friction)
    if source == "mesh":
        raise MeshError(
            f"Expected the YCB mesh of {name}, found none. Get it with 'difflcs assets download {name}', let "
            f"{YCB_DIR_VARIABLE} name a folder with {entry.code}.stl, or use object_source='stand_in'."
        )
    if rest_pose not in (LYING, 0):
        raise ValueError(
            f"Expected rest_pose 'lying' for the stand-in of {name}, got {rest_pose!r}. Other poses need the mesh: "
            f"difflcs assets download {name}"
        )
    return StandInObject(name=name, ycb=entry, mass=kilograms, friction=friction)


def _mesh_file(name: str, source: str) -> Path:
    path = Path(name).expanduser()
    if path.suffix.lower() not in MESH_SUFFIXES and not path.exists():
        raise ValueError(
            f"Expected an object out of {', '.join(YCB)}, or the path of a mesh file, got {name!r}. Choose one of them."
        )
    if source == "stand_in":
        raise ValueError(
            "Expected object_source 'auto' or 'mesh' for a mesh file, got 'stand_in'. Only YCB objects have one."
        )
    return path


def _mass(mass: float | str | None, published: float | None) -> float:
    if mass is None:
        return DEFAULT_MASS
    if isinstance(mass, str):
        if mass == "true" and published is not None:
            return published
        wanted = "a mass in kg or 'true'" if published is not None else "a mass in kg (no mass is published for it)"
        raise ValueError(f"Expected object_mass to be {wanted}, got {mass!r}. Choose such a value.")
    return float(mass)
