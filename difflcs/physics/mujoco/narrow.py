"""Shapes of geoms: those between which MuJoCo's contacts are exact, and the faces of those that have some."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from difflcs.errors import InvalidInputError
from difflcs.physics.mujoco.state import cross

Array = NDArray[np.float64]

PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH, _SDF = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH", "SDF")
)
NATIVE = np.zeros((_SDF + 1, _SDF + 1), dtype=bool)  # kinds of shapes between which MuJoCo's contacts are exact
NATIVE[PLANE] = NATIVE[:, PLANE] = True
for _kind, _others in ((SPHERE, [SPHERE, CAPSULE, CYLINDER, BOX]), (CAPSULE, [CAPSULE, BOX]), (BOX, [BOX])):
    NATIVE[_kind, _others] = NATIVE[_others, _kind] = True

_CORNERS = 8  # of a face, at most
_SIDES = np.concatenate([np.eye(3), -np.eye(3)])


def have_faces(model: Any, data: Any, axis: Array | None) -> NDArray[np.bool_]:
    """Return a mask (ngeom,) of the geoms with faces, or a side that touches along a line.

    Args:
        model: the model.
        data: its data.
        axis: normal (3,) of the plane in which everything moves, or None. What is round there touches in one point.
    """
    with_faces = np.isin(model.geom_type, (CAPSULE, CYLINDER, BOX, MESH))
    if axis is not None:
        upright = np.abs(data.geom_xmat.reshape(-1, 3, 3)[:, :, 2] @ axis) > 1 - 1e-9
        with_faces &= ~(upright & np.isin(model.geom_type, (CAPSULE, CYLINDER)))
    return with_faces


def describe_solid(model: Any, geom: int) -> dict[str, Any]:
    """Describe the faces of a geom in its own frame: corners (n_faces, 8, 3), their counts, and outward normals."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == MESH:
        faces, outward = _polygons(model, int(model.geom_dataid[geom]))
    elif kind == BOX:
        square, outward = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]]), _SIDES
        faces = [np.insert(square, k % 3, 1 if k < 3 else -1, axis=1) * size for k in range(6)]
    else:
        angle, outward = np.arange(_CORNERS) * (2 * np.pi / _CORNERS), _SIDES[[2, 5]]
        circle = size[0] * np.stack([np.cos(angle), np.sin(angle)], -1)
        faces = [np.insert(circle, 2, height, axis=1) for height in (size[1], -size[1])]
    corners, counts = np.zeros((len(faces), _CORNERS, 3)), []
    for face, into in zip(faces, corners, strict=True):
        counts.append(min(len(face), _CORNERS))
        into[: counts[-1]] = face[np.round(np.linspace(0, len(face) - 1, counts[-1])).astype(int)]
    return {
        "round": kind in (CAPSULE, CYLINDER),
        "cap": 0.5**0.5 if kind == CYLINDER else np.inf,
        "radius": size[0],
        "half": size[1],
        "counts": counts,
        "corners": corners.ravel().tolist(),
        "outward": outward.ravel().tolist(),
    }


def _polygons(model: Any, mesh: int) -> tuple[list[Array], Array]:
    """Find the faces of a mesh's hull: corners in order, outward normals. MuJoCo's may be missing or not quite flat."""
    start = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]].astype(np.float64)
    try:
        hull = ConvexHull(vertices)
    except QhullError as error:
        name = model.mesh(mesh).name or mesh
        raise InvalidInputError(
            f"model: expected meshes that may touch something with a volume, got mesh {name!r}, whose vertices lie in "
            f"a plane or on a line; use a box, or name the pairs that may touch, without it, by pairs=[...]"
        ) from error
    corners_of = np.searchsorted(np.sort(hull.vertices), hull.simplices)
    vertices = hull.points[np.sort(hull.vertices)]
    one, two = (vertices[corners_of[:, k]] - vertices[corners_of[:, 0]] for k in (1, 2))
    order, first = np.argsort(corners_of, axis=None), np.zeros(len(vertices) + 1, dtype=int)
    first[1:] = np.bincount(corners_of.ravel()).cumsum()  # order[first[v] : first[v + 1]] // 3: triangles at a vertex
    across = np.stack(perpendicular(hull.equations[:, :3]), -1)
    size, left, faces, outward = np.ptp(vertices, axis=0).max(), np.ones(len(one), dtype=bool), [], []
    for k in np.argsort(-np.linalg.norm(cross(one, two), axis=-1)):
        if not left[k]:
            continue
        normal = hull.equations[k, :3]
        flat = np.abs(vertices @ normal + hull.equations[k, 3]) < 1e-6 * size
        near = np.concatenate([order[first[v] : first[v + 1]] for v in np.flatnonzero(flat)]) // 3
        left[near] &= ~flat[corners_of[near]].all(-1)
        at = (vertices[flat] - vertices[flat].mean(0)) @ across[k]
        faces.append(vertices[flat][np.argsort(np.arctan2(at[:, 1], at[:, 0]))])
        outward.append(normal)
    return faces, np.array(outward)


def perpendicular(normal: Array) -> tuple[Array, Array]:
    """Return two unit vectors perpendicular to unit vectors (..., 3) and to each other."""
    first = cross(normal, np.eye(3)[np.abs(normal).argmin(-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, cross(normal, first)
