"""Triangle meshes as solids for the simulation: checks, rest pose, convex parts, inertia. No MuJoCo here."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from difflcs_envs.errors import MeshError, extra
from difflcs_envs.locks import one_at_a_time

if TYPE_CHECKING:
    import trimesh

CACHE_VARIABLE = "DIFFLCS_CACHE_DIR"

# A mesh outside these bounds is most likely in other units, or nothing that the fingers can push.
MIN_SIZE, MAX_SIZE = 0.01, 0.45  # [m] longest side
MIN_VOLUME = 1e-8  # [m^3]
# A torus of 20 480 triangles takes 37 s, one of 65 536 takes 94 s, a cylinder of 50 000 minutes (its hull).
# The scans of the YCB set have 16 384.
MAX_TRIANGLES = 20_000
MAX_FILE = 1 << 25  # [byte]: 16 times a text file of so many triangles, or one with textures
SIZE_TOLERANCE = 0.005, 0.05  # [m], and part of the size
DEBRIS = 0.02  # scanned meshes carry loose fragments: smaller in area than this part of the mesh
SUPPORT_THICKNESS = 0.001  # [m] vertices this near to the table carry the object in the rating of a rest pose
MIN_TOPPLING_ANGLE = np.deg2rad(3.0)  # poses that fall at a smaller tilt are not offered
SAME_POSE = np.cos(np.deg2rad(10.0))  # rest poses less than 10 degrees apart are one: a bumpy face has many
AS_LOW = 1.1  # among rest poses that are lower than this times the lowest, lying keeps nearest to how it is stored
BLOCK = 256  # edges of an outline whose boxes are measured at once
KEPT_YAW = np.cos(np.deg2rad(2.0))  # a mesh stored within 2 degrees of its rest pose keeps its yaw

SIMPLIFY = (
    "Simplify it to about 5000 triangles, which is finer than the contacts: the modifier 'Decimate' of Blender, "
    "'Quadric Edge Collapse Decimation' of MeshLab, or mesh.simplify_quadric_decimation(face_count=5000) of trimesh, "
    "which needs: pip install fast-simplification"
)
LYING, UPRIGHT = "lying", "upright"

# Convex decomposition. Remeshing (preprocess) inflates by 0.6 to 1.4 mm and a vertex limit (decimate) tilts what
# should lie flat. Fewer tree searches than the default (150): half of the time, parts as close to the mesh.
COACD_SETTINGS: dict[str, Any] = {"preprocess_mode": "off", "decimate": False, "mcts_iterations": 60, "seed": 0}
SOLID_ENOUGH = 0.95  # a mesh that fills its convex hull to this part is taken as convex
DEFAULT_PARTS = 8  # most convex parts of a mesh that is not
DEFAULT_CONCAVITY = 0.1  # CoACD's threshold; 0.05 takes the mug 30 s instead of 8 s and gains nothing at 6 parts


@dataclass(frozen=True)
class RestPose:
    """A pose in which a solid stays put on a table.

    Attributes:
        height: Height of the centre of mass [m].
        rotation: From the mesh frame to a frame with z up, (3, 3).
    """

    height: float
    rotation: np.ndarray


@dataclass(frozen=True)
class Solid:
    """A mesh ready for the simulation. Origin at the centre of mass, z up in the chosen rest pose.

    Attributes:
        vertices: (V, 3) [m], to draw.
        faces: (F, 3) indices into them.
        parts: Vertices [m] of each convex part, (P, 3) each, to collide with.
        inertia: Moment of inertia about the centre of mass for a mass of 1 kg and uniform density [m^2], (3, 3).
        rest_height: Height of the origin when it rests [m].
        digest: SHA-256 of the mesh, the settings, and the pose.
    """

    vertices: np.ndarray
    faces: np.ndarray
    parts: tuple[np.ndarray, ...]
    inertia: np.ndarray
    rest_height: float
    digest: str

    @property
    def size(self) -> np.ndarray:
        """Extent along x, y, z [m]."""
        return np.ptp(self.vertices, axis=0)


def cache_directory() -> Path:
    """Return the folder of convex parts and downloads: `DIFFLCS_CACHE_DIR`, or `difflcs` in the user's cache."""
    if chosen := os.environ.get(CACHE_VARIABLE):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "difflcs"


def _require_trimesh() -> Any:
    with extra():
        import scipy.spatial  # noqa: F401  (trimesh needs it for convex hulls)
        import trimesh
    return trimesh


# --- loading --------------------------------------------------------------------------------------


def load_mesh(path: Path, scale: float = 1.0) -> trimesh.Trimesh:
    """Read a mesh and check that it is a solid of a sensible size.

    Args:
        path: STL, OBJ, PLY or another format that trimesh reads.
        scale: Length of one unit of the file [m]; 0.001 for millimetres.

    Returns:
        The mesh in metres, watertight, faces outward.

    Raises:
        MeshError: The file is missing, too large, cannot be read, is no solid, or has an unlikely size.
        MissingDependencyError: trimesh is not installed.
    """
    trimesh = _require_trimesh()
    if not path.is_file():
        raise MeshError(f"Expected a mesh file, got {str(path)!r}, which does not exist. Correct the path.")
    if path.suffix.lower().lstrip(".") not in trimesh.available_formats():
        raise MeshError(
            f"Expected a mesh file such as .stl, .obj or .ply, got {str(path)!r}. Convert it to one of these formats."
        )
    if (size := path.stat().st_size) > MAX_FILE:
        raise MeshError(f"Expected a mesh file of at most {MAX_FILE >> 20} MB, got {size >> 20} MB: {path}. {SIMPLIFY}")
    try:
        mesh = trimesh.load(path, force="mesh", process=True, skip_materials=True)
    except Exception as error:  # every format fails in its own way
        raise MeshError(
            f"The mesh {path} cannot be read ({type(error).__name__}: {error}). Expected a complete file; get it or "
            "export it again."
        ) from error
    if len(mesh.faces) < 4 or not np.isfinite(mesh.vertices).all():
        raise MeshError(
            f"The mesh {path} is empty or broken: expected at least 4 triangles with finite corners, got "
            f"{len(mesh.faces)} triangles. Export it again."
        )
    _check_triangles(mesh, str(path))
    mesh.apply_scale(scale)
    size = float(mesh.extents.max())
    if not MIN_SIZE <= size <= MAX_SIZE:
        raise MeshError(
            f"Expected a mesh in metres, {MIN_SIZE:g} to {MAX_SIZE:g} m long, got {size:g} m: {path}. If the file is "
            "in millimetres pass mesh_scale=0.001; otherwise scale it to what the fingers can push."
        )
    mesh = mesh if mesh.is_volume else _repair(mesh)
    if not mesh.is_volume or mesh.volume < MIN_VOLUME:
        raise MeshError(
            f"Expected a watertight mesh with faces that point outward, got one with holes, loose faces or no volume: "
            f"{path}. Close it, for instance with 'Make manifold' in Blender or MeshLab."
        )
    return mesh


def _check_triangles(mesh: trimesh.Trimesh, name: str) -> None:
    if len(mesh.faces) > MAX_TRIANGLES:
        raise MeshError(
            f"Expected a mesh of at most {MAX_TRIANGLES} triangles, got {len(mesh.faces)}: {name}. It would take "
            f"minutes to prepare. {SIMPLIFY}"
        )


def _repair(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Remove loose fragments, close small holes, turn faces outward. The caller checks whether that was enough."""
    trimesh = _require_trimesh()
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    areas = np.bincount(labels, weights=mesh.area_faces)
    mesh.update_faces((areas >= DEBRIS * areas.sum())[labels])
    mesh.remove_unreferenced_vertices()
    with contextlib.suppress(Exception):  # best effort on broken input
        if not mesh.is_watertight:
            trimesh.repair.fill_holes(mesh)
        trimesh.repair.fix_normals(mesh, multibody=True)
    return mesh


# --- rest poses -----------------------------------------------------------------------------------


def rest_poses(points: np.ndarray, center: np.ndarray) -> list[RestPose]:
    """Find all poses in which a solid stays put on a table, lowest centre of mass first.

    The solid rests on a face of its convex hull if the centre of mass projects into that face. The height of the
    centre of mass as a function of the direction that is down has a local minimum exactly there.

    Args:
        points: Points that span the solid [m], (N, 3).
        center: Its centre of mass [m], (3,).
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points - center)
    normals, heights = hull.equations[:, :3], -hull.equations[:, 3]  # outward; distance of each face to the centre
    corners = hull.points[hull.vertices]
    # The projection of the centre lies in a face if it lies in the hull. It does not if it is beyond a neighbour.
    feet = heights[:, None] * normals
    near = hull.neighbors
    beyond = np.einsum("fk,fnk->fn", feet, normals[near]) - heights[near]
    left = (beyond <= 1e-9).all(axis=1)
    poses: list[RestPose] = []
    for face in np.argsort(heights, kind="stable"):
        if not left[face] or (normals @ feet[face] - heights).max() > 1e-9:
            continue
        down, height = normals[face], float(heights[face])
        left &= normals @ down <= SAME_POSE
        angle = _toppling_angle(corners, down, height)
        if not poses or angle >= MIN_TOPPLING_ANGLE:  # the lowest pose always counts
            poses.append(RestPose(height, _upright_rotation(corners, down)))
    return poses


def _toppling_angle(corners: np.ndarray, down: np.ndarray, height: float) -> float:
    """Compute the tilt [rad] at which the centre of mass leaves the area that the corners near the table span."""
    from scipy.spatial import ConvexHull, QhullError

    rotation = _shortest_rotation(down, np.array([0.0, 0.0, -1.0]))
    feet = (corners[height - corners @ down < SUPPORT_THICKNESS] @ rotation.T)[:, :2]
    try:
        margin = float((-ConvexHull(feet).equations[:, 2]).min())
    except (QhullError, ValueError):  # fewer than three feet, or all in one line
        return 0.0
    return float(np.arctan2(margin, height))


def _shortest_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Compute the rotation of smallest angle that takes one unit vector to another, (3, 3)."""
    axis, cosine = np.cross(start, end), float(start @ end)
    if cosine < -1 + 1e-12:  # half a turn about any axis across
        across = np.eye(3)[np.argmin(np.abs(start))]
        across -= (across @ start) * start
        across /= np.linalg.norm(across)
        return 2 * np.outer(across, across) - np.eye(3)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def _upright_rotation(corners: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Turn `down` to -z; unless the mesh was stored like this, also its longest horizontal side along x."""
    from scipy.spatial import ConvexHull

    rotation = _shortest_rotation(down, np.array([0.0, 0.0, -1.0]))
    if rotation[2, 2] > KEPT_YAW:
        return rotation
    flat = (corners @ rotation.T)[:, :2]
    outline = flat[ConvexHull(flat).vertices]
    edges = np.roll(outline, -1, axis=0) - outline
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    across = edges @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    best_area, best = np.inf, np.eye(2)
    for start in range(0, len(edges), BLOCK):  # the smallest box has a side along some edge
        block = slice(start, start + BLOCK)
        sizes = np.stack([np.ptp(outline @ sides[block].T, axis=0) for sides in (edges, across)])
        for (x, y), width, depth in zip(edges[block], *sizes, strict=True):
            if width * depth < best_area * (1 - 1e-9):
                best_area, best = width * depth, np.array([[x, y], [-y, x]] if width >= depth else [[-y, x], [-x, -y]])
    yaw = np.eye(3)
    yaw[:2, :2] = best
    return yaw @ rotation


def _choose_pose(poses: list[RestPose], choice: str | int, name: str) -> RestPose:
    if choice == LYING:
        low = [pose for pose in poses if pose.height <= AS_LOW * poses[0].height]
        return max(low, key=lambda pose: np.trace(pose.rotation))  # the nearest to how the mesh is stored
    if choice == UPRIGHT:
        return poses[-1]
    if isinstance(choice, int) and not isinstance(choice, bool) and 0 <= choice < len(poses):
        return poses[choice]
    heights = ", ".join(f"{i}: {1e3 * pose.height:.1f} mm" for i, pose in enumerate(poses))
    raise ValueError(
        f"Expected rest_pose 'lying', 'upright' or one of the {len(poses)} stable poses of {name} (height of the "
        f"centre of mass, {heights}), got {choice!r}. Choose one of them."
    )


def check_extent(mesh: trimesh.Trimesh, name: str, expected: tuple[float, float, float], path: Path) -> None:
    """Raise unless a mesh, lying on the table, has the size of the object.

    Raises:
        MeshError: They differ by more than scans of one object do (loose fragments, simplification).
    """
    corners = np.array(mesh.convex_hull.vertices)
    rotation = rest_poses(corners, np.array(mesh.center_mass))[0].rotation
    got, wanted = np.sort(np.ptp(corners @ rotation.T, axis=0)), np.sort(expected)
    if np.any(np.abs(got - wanted) > SIZE_TOLERANCE[0] + SIZE_TOLERANCE[1] * wanted):
        raise MeshError(
            f"Expected the mesh of {name} to measure {_millimetres(wanted)}, got {_millimetres(got)}: {path}. Is it "
            f"another object or in other units? Get it again with 'difflcs assets download {name}'."
        )


def _millimetres(size: np.ndarray) -> str:
    return " x ".join(f"{1e3 * s:.0f}" for s in size) + " mm"


# --- convex parts ---------------------------------------------------------------------------------


def _convex_parts(mesh: trimesh.Trimesh, count: int | None, concavity: float) -> tuple[tuple[np.ndarray, ...], str]:
    """Find at most `count` convex parts that cover the mesh, from the cache if possible, and their cache key."""
    if count is None:
        count = 1 if mesh.volume >= SOLID_ENOUGH * mesh.convex_hull.volume else DEFAULT_PARTS
    vertices, faces = np.ascontiguousarray(mesh.vertices, "<f8"), np.ascontiguousarray(mesh.faces, "<i8")
    settings = {"parts": count, "format": 1} | (COACD_SETTINGS | {"threshold": concavity} if count > 1 else {})
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    key.update(vertices.tobytes())
    key.update(faces.tobytes())
    if count == 1:
        return (np.array(mesh.convex_hull.vertices),), key.hexdigest()
    path = cache_directory() / "parts" / f"{key.hexdigest()[:32]}.npz"
    parts = _read_parts(path)
    if parts is None:
        with one_at_a_time(cache_directory() / f".{path.stem}.lock"):
            parts = _read_parts(path)  # another process may have been faster
            if parts is None:
                parts = _decompose(vertices, faces, count, concavity)
                _write_parts(path, parts)
    return parts, key.hexdigest()


def _decompose(vertices: np.ndarray, faces: np.ndarray, count: int, concavity: float) -> tuple[np.ndarray, ...]:
    with extra():
        import coacd
    coacd.set_log_level("error")
    hulls = coacd.run_coacd(coacd.Mesh(vertices, faces), threshold=concavity, max_convex_hull=count, **COACD_SETTINGS)
    return tuple(np.asarray(points, np.float64) for points, _ in hulls)


def _read_parts(path: Path) -> tuple[np.ndarray, ...] | None:
    """Read cached parts; None if there are none or the file is damaged, which the checksums of the archive tell."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return tuple(np.split(stored["points"], stored["ends"][:-1]))
    except Exception:  # a damaged archive fails in many ways; the parts are computed again
        return None


def _write_parts(path: Path, parts: tuple[np.ndarray, ...]) -> None:
    """Write in one step: other processes see the old file or the new one. A cache that is not writable is ignored."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}.") as work:
            new = Path(work, path.name)
            np.savez(new, points=np.concatenate(parts), ends=np.cumsum([len(part) for part in parts]))
            os.replace(new, path)


# --- all steps together --------------------------------------------------------------------------------


def make_solid(
    mesh: trimesh.Trimesh,
    name: str,
    parts: int | None = None,
    rest_pose: str | int = LYING,
    concavity: float = DEFAULT_CONCAVITY,
) -> Solid:
    """Decompose a mesh, lay it on the table, and compute its inertia.

    Args:
        mesh: A checked mesh, see `load_mesh`.
        name: For messages.
        parts: Most convex parts; None: 1 if the mesh is nearly convex, else 8.
        rest_pose: "lying" (lowest centre of mass; of equally low poses the one nearest to how the mesh is stored),
            "upright" (highest), or the number of a pose, from below.
        concavity: How far the parts may leave the mesh, CoACD's threshold (0.01 to 1, smaller is closer).

    Returns:
        The solid. The parts decide how it rests, for it is they that touch the table.

    Raises:
        MeshError: It has so many triangles that this would take minutes.
        ValueError: There is no such rest pose.
        MissingDependencyError: coacd is needed and not installed.
    """
    _check_triangles(mesh, name)
    pieces, key = _convex_parts(mesh, parts, concavity)
    center = np.array(mesh.center_mass)
    pose = _choose_pose(rest_poses(np.concatenate(pieces), center), rest_pose, name)
    rotation = pose.rotation
    return Solid(
        vertices=(mesh.vertices - center) @ rotation.T,
        faces=np.array(mesh.faces),
        parts=tuple((piece - center) @ rotation.T for piece in pieces),
        inertia=rotation @ (mesh.moment_inertia / mesh.volume) @ rotation.T,
        rest_height=pose.height,
        digest=hashlib.sha256(f"{key} {rotation.round(6).tolist()}".encode()).hexdigest(),
    )
