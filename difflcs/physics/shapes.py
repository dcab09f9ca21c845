"""Shapes in the plane: signed distance, outward normal and nearest point, differentiable in the shape.

    outline = Polygon([[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]])
    distance, normal, point = outline.distance(points)

A `Union` keeps its parts apart, so that each is a contact of its own: a corner between two of them is touched at both
sides. A polygon need not be convex; its nearest point is one contact.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from difflcs._checks import check_array, check_list, check_number, check_shape, check_tensor, describe
from difflcs._differentiation import transforms_active
from difflcs._recall import Recall, snapshot
from difflcs.errors import InvalidInputError

_ROWS = 256  # sides that are compared with all others at a time, so that memory grows with their number alone


class NearestPoints(NamedTuple):
    """The points nearest to some points, one on each part of a shape.

    Attributes:
        distance: (..., n_parts) signed, negative inside.
        normal: (..., n_parts, 2) outward unit vector, the derivative of the distance with respect to the point.
        point: (..., n_parts, 2) nearest point of the outline.
    """

    distance: Tensor
    normal: Tensor
    point: Tensor

    def select(self, parts: Tensor) -> "NearestPoints":
        """Select parts (..., k) of each point."""
        rows = parts.unsqueeze(-1).expand(*parts.shape, 2)
        return NearestPoints(self.distance.gather(-1, parts), self.normal.gather(-2, rows), self.point.gather(-2, rows))


class Moments(NamedTuple):
    """Area, centroid (2,), and polar second moment of area about the centroid."""

    area: Tensor
    centroid: Tensor
    polar: Tensor


class Shape(ABC):
    """A closed outline in coordinates of its body."""

    @property
    def n_parts(self) -> int:
        """Parts, each of which is a contact."""
        return 1

    @abstractmethod
    def distance(self, points: Tensor) -> NearestPoints:
        """Measure the distance to points (..., 2) in coordinates of the body."""

    @abstractmethod
    def moments(self) -> Moments:
        """Return the moments of the area; overlapping parts count twice."""

    @property
    @abstractmethod
    def radius(self) -> float:
        """The largest distance of the outline from the origin of the body."""

    @property
    def centroid(self) -> Tensor:
        """(2,) centre of the area."""
        return self.moments().centroid

    @property
    def gyration(self) -> Tensor:
        """Radius of gyration of the area about its centroid."""
        area, _, polar = self.moments()
        return (polar / area).sqrt()

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...), True for points (..., 2) that are inside."""
        return (self.distance(points).distance < 0).any(-1)


@dataclass(frozen=True, eq=False)
class Polygon(Shape):
    """A simple polygon, convex or not.

    Attributes:
        vertices: (n, 2) corners in order, counterclockwise; clockwise ones are reversed. Numbers, or a tensor, which is
            copied unless it requires a gradient.

    Raises:
        ShapeError, InvalidInputError: not at least three corners, no area, two corners at one place in succession, or
            sides that cross.
    """

    vertices: Tensor

    def __post_init__(self) -> None:
        vertices = _tensor("vertices", self.vertices)
        check_shape("vertices", vertices, "3+ 2", remedy="give one row for each corner")
        at = vertices.detach()
        sides = (at.roll(-1, 0) - at).norm(dim=1)
        longest = float(sides.max())
        if not float(sides.min()) > 0:
            raise InvalidInputError(
                f"vertices: expected every corner apart from the next, got corner {int(sides.argmin())} twice; leave "
                f"one of them out, the last need not repeat the first"
            )
        rounded = longest * 4 * torch.finfo(at.dtype).eps * float(at.abs().max())  # of twice an area
        area = float(shoelace(at - at[0]).sum()) / 2  # far from the origin it would be the difference of large ones
        if not abs(area) > max(1e-12 * longest**2, rounded):
            raise InvalidInputError(f"vertices: expected a polygon with an area, got {area:g}; move the corners apart")
        crossed = _crossing(at, rounded)
        if crossed:
            raise InvalidInputError(
                f"vertices: expected sides that do not cross, got crossing ones from corners {crossed[0]} and "
                f"{crossed[1]}; give the corners in the order in which one meets them along the outline"
            )
        learned = vertices.requires_grad
        object.__setattr__(self, "vertices", vertices.flip(0) if area < 0 and not learned else vertices)
        vars(self)["turned"] = area < 0 and learned

    @property
    def corners(self) -> Tensor:
        """(n, 2) the vertices as they are now, counterclockwise."""
        return self.vertices.flip(0) if vars(self).get("turned") else self.vertices

    @property
    def radius(self) -> float:
        """See `Shape`."""
        return float(self.vertices.detach().norm(dim=1).max())

    def distance(self, points: Tensor) -> NearestPoints:
        """See `Shape`. Ties go to the side that comes first."""
        check_tensor("points", points, [("2", 2)])
        start, side, square, outward = self._sides()
        with torch.no_grad():
            nearest, inside = _nearest_side(points, start, side, square)
        a, side, outward = start[nearest], side[nearest], outward[nearest]
        to = points - a
        along = (to * side).sum(-1) / square[nearest]
        beyond = along.clamp(0.0, 1.0).unsqueeze(-1) * side
        point, apart = a + beyond, to - beyond
        size = torch.linalg.vector_norm(apart, dim=-1)
        sign = torch.where(inside, -1.0, 1.0).to(points.dtype)
        # Beside a side its own normal serves, on the outline too, where the direction to it is none; round a corner
        # the direction from the corner.
        beside = ((along > 0) & (along < 1)) | (size.detach() == 0)
        safe = torch.where(beside, torch.ones_like(size), size)
        normal = torch.where(beside.unsqueeze(-1), outward, (sign / safe).unsqueeze(-1) * apart)
        distance = torch.where(beside, (apart * outward).sum(-1), sign * torch.where(beside, 1.0, size))
        return NearestPoints(distance.unsqueeze(-1), normal.unsqueeze(-2), point.unsqueeze(-2))

    def _sides(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return start (n, 2), vector (n, 2), squared length (n,) and outward normal (n, 2) of every side."""
        # Kept while the corners are the same numbers; with a gradient each call has a graph of its own.
        recalls = not (self.vertices.requires_grad or transforms_active() or torch.compiler.is_compiling())
        made: Recall[tuple[Tensor, Tensor, Tensor, Tensor]] = vars(self).setdefault("made", Recall())
        kept = made.value((self.vertices,)) if recalls else None
        if kept is not None:
            return kept
        before, corners = snapshot((self.vertices,)) if recalls else None, self.corners
        side = corners.roll(-1, 0) - corners
        square = side.square().sum(-1)
        sides = (corners, side, square, torch.stack([side[:, 1], -side[:, 0]], -1) / square.sqrt().unsqueeze(-1))
        if recalls:
            made.keep(sides, before)
        return sides

    def moments(self) -> Moments:
        """See `Shape`."""
        corners = self.corners
        first = corners[0].detach()  # about the origin, large numbers would cancel far from it
        p = corners - first
        n, cross = p.roll(-1, 0), shoelace(p)
        area = cross.sum() / 2
        centroid = ((p + n) * cross.unsqueeze(-1)).sum(0) / (6 * area)
        about_first = (cross * (p.square() + p * n + n.square()).sum(-1)).sum() / 12
        return Moments(area, first + centroid, about_first - area * centroid.square().sum())


@dataclass(frozen=True, eq=False)
class Circle(Shape):
    """A disc.

    Attributes:
        r: radius, above 0, a number or a tensor.
        center: (2,) in coordinates of the body.
    """

    r: Tensor
    center: Tensor = (0.0, 0.0)  # pyright: ignore[reportAssignmentType]

    def __post_init__(self) -> None:
        r, center = _tensor("r", self.r), check_shape("center", _tensor("center", self.center), "2")
        if r.ndim or not float(r.detach()) > 0:
            raise InvalidInputError(f"r: expected one number above 0, got {describe(self.r)}; give the radius")
        object.__setattr__(self, "r", r)
        object.__setattr__(self, "center", center)

    @property
    def radius(self) -> float:
        """See `Shape`."""
        return float(self.r.detach() + self.center.detach().norm())

    def distance(self, points: Tensor) -> NearestPoints:
        """See `Shape`. In the very centre the normal points along x."""
        check_tensor("points", points, [("2", 2)])
        apart = points - self.center
        at_center = apart.detach().square().sum(-1) == 0
        apart = torch.where(at_center.unsqueeze(-1), apart.new_tensor([1.0, 0.0]), apart)
        size = apart.norm(dim=-1)
        normal = apart / size.unsqueeze(-1)
        distance = torch.where(at_center, torch.zeros_like(size), size) - self.r
        return NearestPoints(
            distance.unsqueeze(-1), normal.unsqueeze(-2), (self.center + self.r * normal).unsqueeze(-2)
        )

    def moments(self) -> Moments:
        """See `Shape`."""
        area = math.pi * self.r.square()
        return Moments(area, self.center, 0.5 * area * self.r.square())


@dataclass(frozen=True, eq=False)
class Union(Shape):
    """Several shapes on one body, each a contact of its own.

    Attributes:
        parts: the shapes; unions among them are taken apart.
    """

    parts: tuple[Shape, ...]

    def __post_init__(self) -> None:
        parts = []
        for part in check_list("parts", self.parts, "give Circle, Polygon or Union", Shape):
            parts += part.parts if isinstance(part, Union) else [part]
        if not parts:
            raise InvalidInputError("parts: expected at least one shape, got none; give Circle or Polygon")
        object.__setattr__(self, "parts", tuple(parts))

    @property
    def n_parts(self) -> int:
        """See `Shape`."""
        return len(self.parts)

    @property
    def radius(self) -> float:
        """See `Shape`."""
        return max(part.radius for part in self.parts)

    def distance(self, points: Tensor) -> NearestPoints:
        """See `Shape`."""
        distances = [part.distance(points) for part in self.parts]
        distance, normal, point = zip(*distances, strict=True)
        return NearestPoints(torch.cat(distance, -1), torch.cat(normal, -2), torch.cat(point, -2))

    def moments(self) -> Moments:
        """See `Shape`."""
        moments = [part.moments() for part in self.parts]
        area = torch.stack([m.area for m in moments])
        centers = torch.stack([m.centroid for m in moments])
        centroid = (area.unsqueeze(-1) * centers).sum(0) / area.sum()
        polar = torch.stack([m.polar for m in moments]) + area * (centers - centroid).square().sum(-1)
        return Moments(area.sum(), centroid, polar.sum())


def box(x_min: float, x_max: float, y_min: float, y_max: float) -> Polygon:
    """Make a rectangle along the axes of its body."""
    for name, value in (("x_min", x_min), ("x_max", x_max), ("y_min", y_min), ("y_max", y_max)):
        check_number(name, value, -math.inf)
    if not (x_min < x_max and y_min < y_max):
        raise InvalidInputError(
            f"box: expected x_min < x_max and y_min < y_max, got {(x_min, x_max, y_min, y_max)}; exchange them"
        )
    return Polygon(torch.tensor([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]], dtype=torch.float64))


def _tensor(name: str, value: Any | Sequence) -> Tensor:
    """Convert numbers to float64; copy a tensor, or return it if it requires a gradient."""
    if not isinstance(value, Tensor):
        value = torch.from_numpy(check_array(name, value))
    return check_tensor(name, value if value.requires_grad else value.clone())


def shoelace(vertices: Tensor) -> Tensor:
    """Compute twice the signed area (n,) between each side and the origin; their sum is above 0 counterclockwise."""
    following = vertices.roll(-1, 0)
    return vertices[:, 0] * following[:, 1] - vertices[:, 1] * following[:, 0]


def _crossing(vertices: Tensor, rounded: float) -> tuple[int, int] | None:
    """Find two sides, by their first corners, that cross inside both, by an area above rounding; else None."""
    start, end = vertices, vertices.roll(-1, 0)
    for first in range(0, len(start), _ROWS):
        a, b = (v[first : first + _ROWS].unsqueeze(1) for v in (start, end))
        # The ends of one side are on both sides of the other, and the other way round.
        apart = _turn(a, b, start, rounded) * _turn(a, b, end, rounded) < 0
        apart &= _turn(start, end, a, rounded) * _turn(start, end, b, rounded) < 0
        if bool(apart.any()):
            i, j = apart.nonzero()[0].tolist()
            return first + i, j
    return None


def _turn(a: Tensor, b: Tensor, c: Tensor, rounded: float) -> Tensor:
    """Compute twice the signed area of triangles, above 0 where c is to the left of a → b; 0 up to `rounded`."""
    along, to = b - a, c - a
    return torch.nn.functional.hardshrink(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0], rounded)


def _nearest_side(points: Tensor, start: Tensor, side: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index of the side nearest to each point, and a mask of the points that are inside."""
    to = points.unsqueeze(-2) - start
    t = ((to * side).sum(-1) / square).clamp_(0.0, 1.0)
    nearest = (to - t.unsqueeze(-1) * side).square_().sum(-1).argmin(-1)
    return nearest, is_inside(to, side)


def is_inside(to: Tensor, side: Tensor) -> Tensor:
    """Return a mask of the points inside a closed outline: a ray from them crosses its sides an odd number of times.

    Args:
        to: (..., n, 2) the way from the first corner of each side to the points.
        side: (n, 2) the sides, as vectors.
    """
    x, y = to.unbind(-1)
    width, height = side.unbind(-1)
    below = y < 0  # of each corner, the same for both of its sides: else rounding could count a corner once
    spans = below != below.roll(-1, -1)
    # x of the point against that of the side at its height, both multiplied by the side's height.
    left = x * height.abs() < y * width * height.sign()
    return ((spans & left).sum(-1) % 2).bool()
