"""Distance or overlap of two shapes, and the places where their faces meet.

MuJoCo's own contacts are exact between shapes that have a formula (`NATIVE`). All others it inflates by the distance
up to which contacts matter, and then misjudges how deep they are. `mj_geomDistance` does not, if its tolerance is small
beside the shapes. It finds one point on each shape; the faces around the two are cut with each other here.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math
from typing import Any, NamedTuple

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

# In parts of the smaller shape: tolerance of `mj_geomDistance`; the gap below which its two points give no direction;
# how far one of the shapes is then put aside; how far a corner may be outside of a face.
_TOLERANCE, _TOUCHING, _ASIDE, _EDGE = 1e-10, 5e-6, 5e-5, 1e-6
_ITERATIONS = 100
_FEW, _CORNERS, _MOST = 4, 8, 4  # corners of a face; contacts of a pair
_STRIP = 3e-3  # half the width of the line along which a round side touches, in parts of its radius
_SIDES = np.concatenate([np.eye(3), -np.eye(3)])


class Witness(NamedTuple):
    """Nearest or deepest points of pairs (n,).

    Attributes:
        pair: numbers of the pairs.
        gap: distance, or minus the least way that parts them [m].
        normal: (n, 3) unit vector from the first shape to the second.
        first: (n, 3) point on the first shape.
        second: (n, 3) point on the second.
    """

    pair: NDArray[np.intp]
    gap: Array
    normal: Array
    first: Array
    second: Array


Measured = tuple[int, float, Array, Array]  # pair, gap, normal, and both points (6,)


def witnesses(measured: list[Measured]) -> Witness:
    """Stack measurements as arrays."""
    pair, gap, normal, points = zip(*measured, strict=True)
    both = np.array(points)
    return Witness(np.array(pair), np.array(gap), np.array(normal), both[:, :3], both[:, 3:])


class _Face(NamedTuple):
    """Faces of n shapes, seen along a normal: corners (n, _CORNERS, 2), and height = level + slope · place there."""

    corners: Array
    level: Array
    slope: Array
    line: NDArray[np.bool_]
    faces: NDArray[np.bool_]

    def height(self, at: Array) -> Array:
        return self.level[:, None] + np.einsum("nj,nkj->nk", self.slope, at)


class Narrow:
    """Measures pairs of geoms as they are in `data`.

    Args:
        model: a private copy.
        data: its data.
        first: (n_pairs,) geoms, none of them a plane.
        second: (n_pairs,) the others.
        distance: pairs farther apart are left out [m].
        axis: normal (3,) of the plane in which everything moves, or None.
    """

    def __init__(
        self,
        model: Any,
        data: Any,
        first: NDArray[np.intp],
        second: NDArray[np.intp],
        distance: float,
        axis: Array | None,
    ):
        self.model, self.data, self.first, self.second, self.distance = model, data, first, second, distance
        radius, kind = model.geom_rbound, model.geom_type
        self._reach, self.size = radius[first] + radius[second], np.minimum(radius[first], radius[second])
        self._pairs = list(zip(first.tolist(), second.tolist(), self.size.tolist(), strict=True))
        self._ends = np.empty(6)
        with_faces = np.isin(kind, (CAPSULE, CYLINDER, BOX, MESH))
        if axis is not None:  # what is round in the plane of motion touches in one point there
            upright = np.abs(data.geom_xmat.reshape(-1, 3, 3)[:, :, 2] @ axis) > 1 - 1e-9
            with_faces &= ~(upright & np.isin(kind, (CAPSULE, CYLINDER)))
        self._meet = with_faces[first] & with_faces[second]
        geoms = np.unique(np.concatenate([first[self._meet], second[self._meet]]))
        self._solids = {int(g): _Solid(model, int(g)) for g in geoms}
        model.opt.ccd_iterations = _ITERATIONS
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)

    def at_least(self, pairs: Any) -> Array:
        """Return lower bounds of the gaps of these pairs: the gaps of spheres around the shapes."""
        place = self.data.geom_xpos
        apart = place[self.first[pairs]] - place[self.second[pairs]]
        return np.sqrt(np.einsum("ij,ij->i", apart, apart)) - self._reach[pairs]

    def measure(self, pairs: list[int]) -> list[Measured]:
        """Measure these pairs, and return those within the distance."""
        return [(k, *result) for k in pairs if (result := self._measure(*self._pairs[k])) is not None]

    def _measure(self, a: int, b: int, size: float) -> tuple[float, Array, Array] | None:
        model, data, ends = self.model, self.data, self._ends
        # Now and then a tolerance as small as the first leaves the points apart from the depth; a larger one does not.
        for tolerance in (_TOLERANCE, 1e2 * _TOLERANCE, 1e4 * _TOLERANCE):
            model.opt.ccd_tolerance = tolerance * size
            gap = mujoco.mj_geomDistance(model, data, a, b, self.distance, ends)
            if gap >= self.distance:
                return None
            way = ends[3:] - ends[:3]
            if abs(math.sqrt(way @ way) - abs(gap)) < 1e-7 * size:
                break
        if abs(gap) > _TOUCHING * size:
            return gap, way / gap, ends.copy()
        # As good as touching, where the two points give no direction; MuJoCo also says 0 where it failed. The answer is
        # that of the shape put a little aside, the way that parts them most.
        place, best = data.geom_xpos, (-np.inf, gap, _SIDES[0], ends.copy())
        here, aside = place[b].copy(), _ASIDE * size
        for side in _SIDES:
            place[b] = here + aside * side
            apart = mujoco.mj_geomDistance(model, data, a, b, self.distance, ends)
            if apart > best[0] and abs(apart) > 0.1 * aside:
                normal = (ends[3:] - ends[:3]) / apart
                gap = apart - aside * float(normal @ side)
                best = apart, gap, normal, np.concatenate([ends[:3], ends[:3] + gap * normal])
            if best[0] > 0.4 * aside:  # one of the six goes along the normal for more than half of its way
                break
        place[b] = here
        return best[1:]

    def boxes_along(self, geoms: Any, normal: Array) -> float:
        """Compute the gap between two boxes along a normal (3,)."""
        data, size = self.data, self.model.geom_size
        wide = sum(float(np.abs(normal @ data.geom_xmat[g].reshape(3, 3)) @ size[g]) for g in geoms)
        return float(normal @ (data.geom_xpos[geoms[1]] - data.geom_xpos[geoms[0]])) - wide

    def contacts(
        self, of: Witness, frame: Array, where: NDArray[np.intp], places: Array, turns: Array
    ) -> tuple[NDArray[np.intp], Witness]:
        """Return all contacts of these pairs: their witnesses and, where faces meet, the corners of the common area.

        Args:
            of: (n,).
            frame: (n, 3, 3) its rows are the normal and two directions across.
            where: (n,) rows of `places` and `turns`.
            places: (n_states, ngeom, 3) of all geoms.
            turns: (n_states, ngeom, 3, 3).

        Returns:
            Indices into `of`, and the contacts.
        """
        meet = self._meet[of.pair] & (of.gap < self.size[of.pair])
        rows = meet.nonzero()[0]
        if not len(rows):
            return np.arange(len(meet)), of
        n, pair, origin, size = len(rows), of.pair[rows], of.first[rows], self.size[of.pair[rows]]
        frame, where, gap = frame[rows], where[rows], of.gap[rows]
        low, high = self._faces(pair, frame, origin, where, places, turns)
        at, valid = _overlap(low.corners, high.corners, _EDGE * size)
        apart = high.height(at) - low.height(at)
        valid &= (low.faces & high.faces)[:, None] & (apart < self.distance)
        # The witness comes first, or a corner that is as near stands for it.
        at = np.concatenate([np.zeros((n, 1, 2)), at], 1)
        apart = np.concatenate([gap[:, None], np.where(valid, apart, np.inf)], 1)
        each, near = np.arange(n), apart[:, 1:].argmin(-1) + 1
        chosen = np.where(apart[each, near] < gap + 1e-5 * size, near, 0)
        far = np.where(apart < np.inf, np.inf, -1.0)
        far[chosen > 0, 0] = -1.0
        picked, most = [(each, chosen)], np.where(low.line | high.line, 2, _MOST)
        for k in range(1, _MOST):
            step = at - at[each, chosen][:, None]
            far = np.minimum(far, step[..., 0] ** 2 + step[..., 1] ** 2)
            chosen = far.argmax(-1)
            more = ((far[each, chosen] > (1e-3 * size) ** 2) & (k < most)).nonzero()[0]
            picked.append((more, chosen[more]))
        row, column = (np.concatenate(v) for v in zip(*picked, strict=True))
        level = np.where(column > 0, low.level[row] + (low.slope[row] * at[row, column]).sum(-1), 0.0)
        there, gap, axes = at[row, column], apart[row, column], frame[row]
        first = origin[row] + (np.concatenate([level[:, None], there], -1)[:, None] @ axes)[:, 0]
        normal = axes[:, 0]
        corners = Witness(pair[row], gap, normal, first, first + gap[:, None] * normal)
        numbers = rows[row]
        if len(rows) < len(meet):
            single = (~meet).nonzero()[0]
            numbers = np.concatenate([single, numbers])
            both: Any = (np.concatenate([v[single], w]) for v, w in zip(of, corners, strict=True))
            corners = Witness(*both)
        return numbers, corners

    def _faces(self, pair: Any, frame: Array, origin: Array, where: Any, places: Array, turns: Array) -> list[_Face]:
        """Return the faces of the first and second geoms (n,) that point most along and against the normal."""
        n = len(pair)
        geoms, where = np.concatenate([self.first[pair], self.second[pair]]), np.concatenate([where, where])
        place, turn = places[where, geoms] - np.concatenate([origin, origin]), turns[where, geoms]
        axes = np.concatenate([frame, frame])
        local = axes @ turn  # normal and directions across, along the axes of the geoms
        toward = local[:, 0].copy()
        toward[n:] *= -1
        solids = {g: self._solids[g] for g in set(geoms.tolist())}
        count = max(s.corners.shape[1] for s in solids.values())
        corners, outward = np.empty((2 * n, count, 3)), np.empty((2 * n, 3))
        line = np.zeros(2 * n, dtype=bool)
        for geom, solid in solids.items():
            mine = (geoms == geom).nonzero()[0]
            face, outward[mine], line[mine] = solid.face(toward[mine])
            corners[mine] = face[:, np.minimum(np.arange(count), face.shape[1] - 1)]
        corners = (corners + (place[:, None] @ turn)) @ local.swapaxes(1, 2)  # along the normal, and across
        outward = (outward[:, None] @ local.swapaxes(1, 2))[:, 0]
        faces = np.abs(outward[:, 0]) > 0.05  # else there is none, as at the end of a capsule
        outward /= np.where(faces, outward[:, 0], 1.0)[:, None]
        level = corners[:, 0, 0] + (outward[:, 1:] * corners[:, 0, 1:]).sum(-1)
        both = _Face(corners[:, :, 1:], level, -outward[:, 1:], line, faces)
        values: Any = ([v[part] for v in both] for part in (slice(n), slice(n, None)))
        return [_Face(*v) for v in values]


class _Solid:
    """Faces of a geom in its own frame: corners (n, _CORNERS, 3) and outward normals (n, 3) of those that are flat."""

    def __init__(self, model: Any, geom: int):
        kind, self.size = int(model.geom_type[geom]), model.geom_size[geom].copy()
        self.round, self.cap = kind in (CAPSULE, CYLINDER), 0.5**0.5 if kind == CYLINDER else np.inf
        if kind == MESH:
            faces, self.outward = _polygons(model, int(model.geom_dataid[geom]))
        elif kind == BOX:
            square, self.outward = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]]), _SIDES
            faces = [np.insert(square, k % 3, 1 if k < 3 else -1, axis=1) * self.size for k in range(6)]
        else:
            angle, self.outward = np.arange(_CORNERS) * (2 * np.pi / _CORNERS), _SIDES[[2, 5]]
            circle = self.size[0] * np.stack([np.cos(angle), np.sin(angle)], -1)
            faces = [np.insert(circle, 2, height, axis=1) for height in (self.size[1], -self.size[1])]
        count = _CORNERS if any(len(f) > _FEW for f in faces) else _FEW
        rows = (np.round(np.linspace(0, max(len(f), count) - 1, count)).astype(int) for f in faces)
        self.four = np.minimum(np.arange(count), _FEW - 1)
        self.corners = np.stack([f[np.minimum(r, len(f) - 1)] for f, r in zip(faces, rows, strict=True)])

    def face(self, toward: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return corners and outward normals of the faces that point most there; True for the line of a round side."""
        best = (toward @ self.outward.T).argmax(-1)
        corners, outward = self.corners[best], self.outward[best]
        line = np.abs(toward[:, 2]) < self.cap if self.round else np.zeros(len(toward), dtype=bool)
        if line.any():
            radial = toward[line] * (1.0, 1.0, 0.0)
            radial /= np.maximum(np.linalg.norm(radial, axis=-1, keepdims=True), 1e-12)
            aside, (radius, half, _) = np.stack([-radial[:, 1], radial[:, 0], radial[:, 2]], -1), self.size
            ends = [u * half * _SIDES[2] + v * _STRIP * radius * aside for u, v in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
            corners[line] = radius * radial[:, None] + np.stack(ends, 1)[:, self.four]
            outward[line] = radial
        return corners, outward, line


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
    size, left, faces, outward = np.ptp(vertices, axis=0).max(), np.ones(len(one), dtype=bool), [], []
    for k in np.argsort(-np.linalg.norm(cross(one, two), axis=-1)):
        if not left[k]:
            continue
        normal = hull.equations[k, :3]
        flat = np.abs(vertices @ normal + hull.equations[k, 3]) < 1e-6 * size
        left &= ~flat[corners_of].all(-1)
        across = np.stack(perpendicular(normal), -1)
        at = (vertices[flat] - vertices[flat].mean(0)) @ across
        faces.append(vertices[flat][np.argsort(np.arctan2(at[:, 1], at[:, 0]))])
        outward.append(normal)
    return faces, np.array(outward)


def perpendicular(normal: Array) -> tuple[Array, Array]:
    """Return two unit vectors perpendicular to unit vectors (..., 3) and to each other."""
    first = cross(normal, np.eye(3)[np.abs(normal).argmin(-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, cross(normal, first)


def _overlap(first: Array, second: Array, tolerance: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Find the corners of the overlap of convex polygons (n, k, 2): points (n, k + k + k², 2) and a mask of them."""
    n, k, _ = first.shape
    one, two = (np.concatenate([p[:, 1:], p[:, :1]], 1) - p for p in (first, second))
    inside = [-tolerance[:, None] * np.sqrt(_product(side, side, 0)) for side in (one, two)]
    ways = [np.sign(_product(p, side, 1).sum(1))[:, None, None] for p, side in ((first, one), (second, two))]
    one, two = one[:, :, None], two[:, None]
    between, turn = second[:, None] - first[:, :, None], _product(one, two, 1)
    of_one, of_two = _product(between, one, 1), _product(between, two, 1)
    parallel = np.abs(turn) <= 1e-9 * np.sqrt(_product(one, one, 0) * _product(two, two, 0))
    turn = np.where(parallel, np.inf, turn)
    s, t = of_two / turn, of_one / turn
    crossing = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1) & ~parallel
    valid = [
        (of_two * ways[1] >= inside[1][:, None]).all(2),
        (-of_one * ways[0] >= inside[0][:, :, None]).all(1),
        crossing.reshape(n, k * k),
    ]
    crossings = (first[:, :, None] + s[..., None] * one).reshape(n, k * k, 2)
    return np.concatenate([first, second, crossings], 1), np.concatenate(valid, 1)


def _product(a: Array, b: Array, turned: int) -> Array:
    """Compute products of vectors (..., 2): a × b, or a · b."""
    if turned:
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
