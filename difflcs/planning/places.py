"""Candidate places of the end effectors, in coordinates of the body, and the corresponding states."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from difflcs._checks import check_array, check_kind, check_number, describe, make_plain, takes
from difflcs._linalg import product
from difflcs.errors import InvalidInputError, ShapeError
from difflcs.physics.planar import to_body
from difflcs.physics.shapes import Shape
from difflcs.planning.obstacles import Obstacles
from difflcs.planning.outline import clearance, ring


@runtime_checkable
class Places(Protocol):
    """Candidate places of the end effectors. A place is a row of numbers that moves with the body."""

    def sample(self, x: Tensor) -> Tensor:
        """Places (n_places, n_place) to compare at a state x (n_x,); the same at each call, or drawn anew."""
        ...

    def states(self, x: Tensor, places: Tensor) -> Tensor:
        """States (n_places, n_x) with end effectors at places (n_places, n_place), the body as in x, at rest."""
        ...

    def allowed(self, states: Tensor) -> Tensor:
        """Return a mask (n_places,), True for states (n_places, n_x) in which the robot may be."""
        ...

    def near(self, x: Tensor) -> bool:
        """Return True if the robot at x is so near the body that the system linearised there is meaningful."""
        ...


@dataclass(frozen=True)
class Workspace:
    """A rectangle that the targets of a disc may not leave, and how far it may be sent in a step.

    Attributes:
        low: (x, y) of its lower corner [length].
        high: (x, y) of its upper corner.
        step: largest |u| of each component [length], > 0.

    Raises:
        InvalidInputError and its kinds: a value does not fit.
    """

    low: Sequence[float]
    high: Sequence[float]
    step: float

    def __post_init__(self) -> None:
        make_plain(self)
        vars(self)["step"] = check_number("step", self.step, strict=True)
        for name in ("low", "high"):
            if check_array(name, getattr(self, name)).shape != (2,):
                raise ShapeError(f"{name}: expected x and y, got {describe(getattr(self, name))}; give a corner")
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise InvalidInputError(
                f"low: expected less than high in x and y, got {tuple(self.low)} and {tuple(self.high)}; exchange them"
            )

    @takes(states="... 5+")
    def bounds(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return u_min and u_max (..., 2) of relative actions at states (..., n_x) of `difflcs.physics.PlanarPushing`.

        A disc that is outside is sent no further out.
        """
        disc = states[..., 3:5]
        low, high = (disc.new_tensor(corner) - disc for corner in (self.low, self.high))
        return low.clamp(-self.step, 0.0), high.clamp(0.0, self.step)

    @takes(points="... 2")
    def clamp(self, points: Tensor) -> Tensor:
        """Move points (..., 2) that are outside to the border."""
        return torch.minimum(torch.maximum(points, points.new_tensor(self.low)), points.new_tensor(self.high))

    @takes(points="... 2")
    def contains(self, points: Tensor, margin: float = 0.0) -> Tensor:
        """Return a mask (...), True for points (..., 2) that are inside and `margin` away from the border [length]."""
        margin = check_number("margin", margin, -math.inf)
        low, high = points.new_tensor(self.low) + margin, points.new_tensor(self.high) - margin
        return ((points >= low) & (points <= high)).all(-1)


def from_body(x: Tensor, points: Tensor) -> Tensor:
    """Convert points (..., 2) from coordinates of the body whose pose begins the state x (n_x,) to the plane."""
    cos, sin = float(x[2].cos()), float(x[2].sin())
    return product(points, x.new_tensor([[cos, -sin], [sin, cos]]).mT) + x[:2]


class DiscPlaces:
    """A disc round a body on a plane, as in `difflcs.physics.PlanarPushing`: on a ring round its shape.

    Args:
        shape: outline of the body in its own coordinates.
        radius: of the disc [length], > 0.
        n_places: on the ring, at equal distances along it.
        gap: between the disc on the ring and the body [length]; None: a tenth of the radius.
        reach: largest gap between disc and body at which pushing is considered [length]; None: the radius.
        workspace: region for places; None: everywhere.
        margin: between a place and the border of the workspace [length].
        obstacles: in which, or nearer to which than the gap, there are no places; None: there are none.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(
        self,
        shape: Shape,
        radius: float,
        n_places: int = 64,
        *,
        gap: float | None = None,
        reach: float | None = None,
        workspace: Workspace | None = None,
        margin: float = 0.0,
        obstacles: Obstacles | None = None,
    ):
        self.shape = check_kind("shape", shape, Shape)
        self.obstacles = check_kind("obstacles", obstacles, (Obstacles, type(None)))
        self.radius = check_number("radius", radius, strict=True)
        self.reach = radius if reach is None else check_number("reach", reach)
        self.workspace = check_kind("workspace", workspace, (Workspace, type(None)))
        self.margin = check_number("margin", margin)
        self.gap = 0.1 * radius if gap is None else check_number("gap", gap, strict=True)
        self.ring = ring(shape, radius + self.gap, n_places)

    def sample(self, x: Tensor) -> Tensor:
        """See `Places`: (n_places, 2) in coordinates of the body."""
        return self.ring

    @takes(x="5+", places="n 2")
    def states(self, x: Tensor, places: Tensor) -> Tensor:
        """See `Places`."""
        states = x.expand(len(places), -1).clone()
        states[:, 3:5] = from_body(x, places)
        states[:, 5:] = 0.0  # velocities of disc and body, if the state has any: both are at rest by then
        return states

    @takes(states="n 5+")
    def allowed(self, states: Tensor) -> Tensor:
        """See `Places`."""
        allowed, discs = torch.ones(len(states), dtype=torch.bool), states[:, 3:5]
        if self.workspace is not None:
            allowed &= self.workspace.contains(discs, self.margin)
        if self.obstacles is not None:
            allowed &= self.obstacles.gap(discs) > self.radius + self.gap
        return allowed

    @takes(x="5+")
    def near(self, x: Tensor) -> bool:
        """See `Places`."""
        return bool(clearance(self.shape, to_body(x, x[None, 3:5])) - self.radius < self.reach)
