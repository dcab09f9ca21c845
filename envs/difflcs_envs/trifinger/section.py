"""Cross section of an object at the height of the fingertips, from its convex parts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from difflcs_envs.trifinger.objects import MeshObject, StandInObject

if TYPE_CHECKING:
    from difflcs_envs.trifinger.model import SceneObject

BAND = 0.004  # [m] about the height of the tips: a tip is a sphere, and touches what is a little above or below too
COARSE = 1e-4  # [m] corners that stand out by less are left out
LEAST_SIDE = 1e-3  # [m] parts smaller than this are left out


def cross_section(scene_object: SceneObject) -> list[np.ndarray]:
    """Compute convex polygons that together are the cross section of an object in its rest pose.

    Args:
        scene_object: A cube, an object with a mesh, or a stand-in. Of a stand-in all of every primitive counts, as
            seen from above.

    Returns:
        Corners (n, 2) [m], counterclockwise, in coordinates of the object: the origin is its centre of mass.
    """
    if isinstance(scene_object, MeshObject):
        height = scene_object.tip_height - scene_object.rest_height
        pieces = [
            np.concatenate([_cut(part, height + shift) for shift in (-BAND, 0.0, BAND)])
            for part in scene_object.solid.parts
        ]
    elif isinstance(scene_object, StandInObject):
        pieces = scene_object.outlines
    else:
        pieces = [scene_object.outline]
    polygons = [_simplify(_hull(points)) for points in pieces if len(points) >= 3]
    return [p for p in polygons if len(p) >= 3 and np.ptp(p, axis=0).min() >= LEAST_SIDE]


def _cut(points: np.ndarray, height: float) -> np.ndarray:
    """Find points (k, 2) whose hull is the cross section of the hull of points (n, 3)."""
    above, below = points[points[:, 2] >= height], points[points[:, 2] < height]
    if not len(above) or not len(below):
        return np.zeros((0, 2))
    share = (height - below[:, None, 2]) / (above[None, :, 2] - below[:, None, 2])
    cut = below[:, None, :2] + share[..., None] * (above[None, :, :2] - below[:, None, :2])
    return _hull(cut.reshape(-1, 2))


def _hull(points: np.ndarray) -> np.ndarray:
    """Compute the convex hull (n, 2), counterclockwise from its leftmost corner; empty where all are in one line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners = points[ConvexHull(points).vertices]
    except QhullError:
        return np.zeros((0, 2))
    return np.roll(corners, -np.lexsort(corners.T[::-1])[0], axis=0)


def _simplify(polygon: np.ndarray) -> np.ndarray:
    """Remove the corners of a convex polygon that stand out by less than COARSE, the flattest first."""
    while len(polygon) > 3:
        before, after = np.roll(polygon, 1, 0), np.roll(polygon, -1, 0)
        chord, to = after - before, polygon - before
        length = np.maximum(np.hypot(*chord.T), 1e-12)
        stands_out = np.abs(chord[:, 0] * to[:, 1] - chord[:, 1] * to[:, 0]) / length
        flattest = int(stands_out.argmin())
        if stands_out[flattest] >= COARSE:
            break
        polygon = np.delete(polygon, flattest, 0)
    return polygon
