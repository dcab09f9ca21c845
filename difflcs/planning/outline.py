"""Distances to a shape on a grid, and closed curves at a constant distance round it."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from difflcs._checks import check_number, check_positive_int
from difflcs.errors import InvalidInputError
from difflcs.physics.shapes import Polygon, Shape, shoelace

_CELLS = 160


def clearance(shape: Shape, points: Tensor) -> Tensor:
    """Signed distance (...) of points (..., 2), in coordinates of the body, to the nearest part of a shape."""
    return shape.distance(points).distance.amin(-1)


class DistanceGrid:
    """Signed distance to shapes on a grid of 161 × 161 points, interpolated between them: many points in little time.

    Args:
        distance: of points (..., 2) to what is there (...), such as `partial(clearance, shape)`.
        reach: the grid goes so far from the origin [length], > 0. Points outside it get at most their distance.

    Attributes:
        axis: (161,) coordinates of the grid in x and in y.
        values: (161, 161) distances, the first index along x.
    """

    def __init__(self, distance: Callable[[Tensor], Tensor], reach: float):
        half = 1.05 * reach
        with torch.no_grad():
            self.axis = torch.linspace(-half, half, _CELLS + 1, dtype=torch.float64)
            self.values = distance(torch.stack(torch.meshgrid(self.axis, self.axis, indexing="ij"), -1))

    def distance(self, points: Tensor) -> Tensor:
        """Interpolate the signed distance (...) of points (..., 2) in coordinates of the body."""
        low = float(self.axis[0])
        at = ((points - low) * (_CELLS / (-2 * low))).clamp(0.0, _CELLS * (1 - 1e-12))
        cell = at.long()
        x, y = (at - cell).unbind(-1)
        corner = cell[..., 0] * (_CELLS + 1) + cell[..., 1]
        v, along = self.values.reshape(-1), _CELLS + 1
        left, right = (torch.lerp(v[corner + step], v[corner + step + 1], y) for step in (0, along))
        return torch.lerp(left, right, x)


def ring(shape: Shape, distance: float, n_points: int) -> Tensor:
    """Place points round a shape at one distance from it, at equal steps along a closed curve.

    The curve is a level set of the signed distance, traced on a grid by marching squares and then moved onto the level
    along the gradient. It is as exact as the distance is: at a corner that points inwards it is cut by at most a cell
    of the grid, a 160th of the whole.

    Args:
        shape: in coordinates of its body.
        distance: > 0 [length].
        n_points: number of points, ≥ 3.

    Returns:
        (n_points, 2) in coordinates of the body, counterclockwise; the outer curve, if the shape has holes.

    Raises:
        InvalidInputError: parts are so far apart that one curve at this distance does not go round all of them.
    """
    distance = check_number("distance", distance, strict=True)
    n_points = check_positive_int("n_points", n_points, minimum=3)
    with torch.no_grad():
        grid = DistanceGrid(partial(clearance, shape), shape.radius + distance)
        traced = _trace_loops((grid.values - distance).numpy(), grid.axis.numpy())
        curves = [torch.from_numpy(curve) for curve in traced]
        if not curves:
            raise InvalidInputError(f"distance: expected one that numbers can hold, got {distance:g}; take a smaller")
        curve = max(curves, key=lambda curve: float(shoelace(curve).sum()))
        apart = sum(not bool(Polygon(curve).contains(other).all()) for other in curves if other is not curve)
        if apart:
            raise InvalidInputError(
                f"shape: expected parts that one curve at distance {distance:g} goes round, got {apart + 1} that are "
                f"apart; take a larger distance, or fill what is between them"
            )
        points = _resample(_move_onto_level(shape, curve, distance), n_points)
        return _move_onto_level(shape, points, distance)


def _move_onto_level(shape: Shape, points: Tensor, distance: float) -> Tensor:
    """Move points along the gradient of the distance until they have this distance."""
    for _ in range(3):
        of_parts = shape.distance(points)
        nearest = of_parts.select(of_parts.distance.argmin(-1, keepdim=True))
        points = points + (distance - nearest.distance) * nearest.normal.squeeze(-2)
    return points


def _resample(curve: Tensor, n_points: int) -> Tensor:
    """Place points at equal steps along a closed curve (m, 2)."""
    closed = torch.cat([curve, curve[:1]]).numpy()
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(closed, axis=0), axis=1).cumsum()])
    at = np.linspace(0.0, along[-1], n_points, endpoint=False)
    return torch.from_numpy(np.stack([np.interp(at, along, closed[:, i]) for i in range(2)], -1))


def _trace_loops(values: NDArray[np.float64], axis: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Trace the closed curves of zeros of values on a grid (n, n), counterclockwise, each (m, 2).

    A curve crosses sides of cells; a cell links the crossings of its sides in pairs, so that each crossing has two
    neighbours and the curve can be traced from one to the next.
    """
    inside = values < 0
    neighbours: dict[tuple[int, int, int], list[tuple[int, int, int]]] = {}
    sums = inside[:-1, :-1].astype(int) + inside[1:, :-1] + inside[1:, 1:] + inside[:-1, 1:]
    for i, j in np.argwhere((sums > 0) & (sums < 4)).tolist():
        corners = [inside[i, j], inside[i + 1, j], inside[i + 1, j + 1], inside[i, j + 1]]
        # Sides of the cell in the order of its corners; (i, j, 0) goes along x from corner (i, j), (i, j, 1) along y.
        sides = [(i, j, 0), (i + 1, j, 1), (i, j + 1, 0), (i, j, 1)]
        crossed = [side for k, side in enumerate(sides) if corners[k] != corners[(k + 1) % 4]]
        if len(crossed) == 4 and corners[0]:  # each pair of sides round a corner that is inside
            crossed = crossed[-1:] + crossed[:-1]
        for a, b in zip(crossed[::2], crossed[1::2], strict=True):
            neighbours.setdefault(a, []).append(b)
            neighbours.setdefault(b, []).append(a)

    def place(side: tuple[int, int, int]) -> tuple[float, float]:
        i, j, along = side
        k, m = (i, j + 1) if along else (i + 1, j)
        t = values[i, j] / (values[i, j] - values[k, m])
        return axis[i] + t * (axis[k] - axis[i]), axis[j] + t * (axis[m] - axis[j])

    loops = []
    while neighbours:
        start = at = next(iter(neighbours))
        loop = []
        while at in neighbours:
            loop.append(at)
            following = neighbours.pop(at)
            at = next((side for side in following if side in neighbours), start)
        points = np.array([place(side) for side in loop])
        after = np.roll(points, -1, axis=0)
        turn = (points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]).sum()
        loops.append(points if turn > 0 else points[::-1].copy())
    return loops
