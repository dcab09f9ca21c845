"""Obstacles on a plane, which a disc and the body that it pushes keep out of: in places, in travel, in the MPC."""

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from difflcs._checks import check_kind, check_list, check_number, check_positive_int, check_shape, takes
from difflcs.constraints import LinearConstraints
from difflcs.physics.planar import to_body
from difflcs.physics.shapes import Shape
from difflcs.planning.outline import DistanceGrid, clearance, ring

_OUTLINE, _ARCS, _ROWS = 48, 8, 4  # points round the body; arcs of them, of which the nearest give a constraint each
_STEP = 0.1  # of differences, as a part of the disc's radius
_FAR = 5  # gaps of so many radii are out of reach of a plan; smaller ones are right
_STILL = 0.01  # of a radius: a pose that has changed by less is the same


class Obstacles:
    """Shapes on a plane that count as fixed where they are, for a body and a disc as in `PlanarPushing`.

    Give the same to `DiscPlaces` and `PlanarTravel`, and its `constraints` to `SamplingPolicy`; say by `place` what is
    in the way, before each step where that moves. The constraints are half-planes: at the nominal state, each of a few
    points round the body, and the disc, has a gap, which may not close along its gradient. They are soft, so that a
    plan exists where something overlaps. Round a corner of an obstacle they turn from step to step, not within a plan.

    Args:
        body: outline of the body, in its own coordinates.
        radius: of the disc [length], > 0.
        margin: that plans leave between an obstacle and body or disc [length]; None: a third of the radius.
        price: of a violation in each state of a plan [cost per length], > 0.

    Attributes:
        shapes: what is in the way, each in its own coordinates.
        poses: (n, 3) x, y and angle of each.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(self, body: Shape, radius: float, *, margin: float | None = None, price: float = 100.0):
        self.radius, self.price = check_number("radius", radius, strict=True), check_number("price", price, strict=True)
        self.margin = radius / 3 if margin is None else check_number("margin", margin, strict=True)
        self._outline = ring(check_kind("body", body, Shape), self.margin, _OUTLINE)
        axis = torch.arange(-body.radius, body.radius, self.radius, dtype=torch.float64)
        points = torch.cartesian_prod(axis, axis)
        self._inside = points[body.contains(points)]
        self._rings: dict[tuple[Shape, float, int], Tensor] = {}
        self._grids: dict[Shape, DistanceGrid] = {}
        self.shapes, self.poses = (), torch.zeros(0, 3, dtype=torch.float64)

    def place(self, shapes: Sequence[Shape], poses: Tensor) -> None:
        """Say which shapes are in the way, and their poses (n, 3).

        Raises:
            ShapeError: there is not one pose for each shape.
        """
        shapes = check_list("shapes", shapes, "give Circle, Polygon or Union", Shape)
        poses = check_shape("poses", poses, f"{len(shapes)} 3").to("cpu", torch.float64)
        if self.shapes == tuple(shapes) and bool(((self.poses - poses).abs() < _STILL * self.radius).all()):
            return
        self.shapes, self.poses = tuple(shapes), poses.clone()
        self._rings = {key: points for key, points in self._rings.items() if key[0] in self.shapes}
        kept, reach = self._grids, _FAR * self.radius
        self._grids = {
            shape: kept.get(shape) or DistanceGrid(partial(clearance, shape), shape.radius + reach) for shape in shapes
        }
        if shapes:
            self._middle = self.poses[:, :2].mean(0)
            apart = (self.poses[:, :2] - self._middle).norm(dim=1).tolist()
            extent = max(away + shape.radius for away, shape in zip(apart, shapes, strict=True))
            self._grid = DistanceGrid(self._distance, extent + reach)

    @takes(points="... 2")
    def gap(self, points: Tensor) -> Tensor:
        """Compute the distance (...) of points (..., 2) to the nearest obstacle, or less where it is far; ∞ without."""
        if not self.shapes:
            return points.new_full(points.shape[:-1], math.inf)
        return self._grid.distance(points - self._middle)

    def _distance(self, points: Tensor) -> Tensor:
        """Compute the distance (...) of points (..., 2) from the middle of all obstacles."""
        flat = points.reshape(-1, 2) + self._middle
        placed = zip(self.shapes, self.poses, strict=True)
        gaps = [self._grids[shape].distance(to_body(pose, flat)) for shape, pose in placed]
        return torch.stack(gaps).amin(0).reshape(points.shape[:-1])

    @takes(poses="... 3")
    def body_gap(self, poses: Tensor) -> Tensor:
        """Compute the gap (...) between the body at poses (..., 3) and the obstacles."""
        outline, inside = (poses[..., None, :2] + _turned(poses, points) for points in (self._outline, self._inside))
        gaps = torch.cat([self.gap(outline) + self.margin, self.gap(inside)], -1)  # small obstacles may be inside
        return gaps.amin(-1)

    @takes(states="n 5+")
    def constraints(self, states: Tensor) -> LinearConstraints | None:
        """Make half-planes for plans from states (n, n_x); None where everything is far away."""
        arms = _turned(states, self._outline)
        gap, nearest = self.gap(states[:, None, :2] + arms).unflatten(1, (_ARCS, -1)).min(-1)
        if not bool((gap < _FAR * self.radius).any()):
            return None
        rows = gap.topk(_ROWS, largest=False).indices
        rows = rows * (_OUTLINE // _ARCS) + nearest.gather(1, rows)
        arms = arms.gather(1, rows.unsqueeze(-1).expand(-1, -1, 2))
        points = torch.cat([states[:, None, :2] + arms, states[:, None, 3:5]], 1)
        gap = self.gap(points)
        gap[:, -1] -= self.radius + self.margin
        step = _STEP * self.radius * torch.eye(2, dtype=points.dtype)
        ahead, back = (self.gap(points.unsqueeze(-2) + side * step) for side in (1, -1))
        slope = (ahead - back) / (2 * _STEP * self.radius)
        G = states.new_zeros(*gap.shape, states.shape[-1])
        G[:, :-1, :2], G[:, -1, 3:5] = -slope[:, :-1], -slope[:, -1]
        G[:, :-1, 2] = slope[:, :-1, 0] * arms[..., 1] - slope[:, :-1, 1] * arms[..., 0]
        limit = torch.where(gap < _FAR * self.radius, gap + (G @ states.unsqueeze(-1)).squeeze(-1), math.inf)
        return LinearConstraints(G, limit, weight=self.price)

    def waypoints(self, distance: float, n_points: int) -> Tensor:
        """Place points (n, 2) round each obstacle at a distance [length]."""
        distance, points = check_number("distance", distance, strict=True), []
        check_positive_int("n_points", n_points)
        for shape, pose in zip(self.shapes, self.poses, strict=True):
            key = shape, distance, n_points
            if key not in self._rings:
                self._rings[key] = ring(*key)
            points.append(pose[:2] + _turned(pose, self._rings[key]))
        return torch.cat(points)


def _turned(poses: Tensor, points: Tensor) -> Tensor:
    """Turn points (n, 2) by the angles of poses (..., 3 or more) → (..., n, 2)."""
    cos, sin = poses[..., 2, None].cos(), poses[..., 2, None].sin()
    x, y = points.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)
