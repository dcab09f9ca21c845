"""Places where end effectors could be, in coordinates of the body, and the states that they mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from difflcs.physics.shapes import Shape

__all__ = ["DiscPlaces", "Places", "Workspace"]


class Places(Protocol):
    """Where the end effectors could be. A place is a row of numbers that moves with the body, in a form of its own."""

    def sample(self, x: Tensor) -> Tensor:
        """Places (n_places, n_place) to compare at a state x (n_x,); the same at each call, or drawn anew."""
        ...

    def states(self, x: Tensor, places: Tensor) -> Tensor:
        """States (n_places, n_x) with the end effectors at rest at places (n_places, n_place), all else as in x."""
        ...

    def allowed(self, states: Tensor) -> Tensor:
        """Which of the states (n_places, n_x) the robot may be in, (n_places,) bool."""
        ...

    def near(self, x: Tensor) -> bool:
        """Whether the robot at x is so near the body that the system linearised there means something."""
        ...


@dataclass(frozen=True)
class Workspace:
    """A rectangle that discs may not leave, and how far one may be sent in a step.

    Attributes:
        low: (x, y) of its lower corner [length].
        high: (x, y) of its upper corner.
        step: largest |u| of each component [length].
        n_discs: discs, whose places are x[3 : 3 + 2 · n_discs] as in `difflcs.physics.PlanarPushing`.
    """

    low: Sequence[float]
    high: Sequence[float]
    step: float
    n_discs: int = 1

    def bounds(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """u_min and u_max (n, 2 · n_discs) of relative actions at states (n, n_x)."""
        raise NotImplementedError

    def contains(self, points: Tensor, margin: float = 0.0) -> Tensor:
        """(...) bool: which points (..., 2) are inside, and `margin` away from the border."""
        raise NotImplementedError


class DiscPlaces:
    """Discs round a body on a plane, as in `difflcs.physics.PlanarPushing`: on a ring round its shape.

    Each disc in turn goes to each place of the ring while the others stay; with several discs, `together` random
    choices of places for all of them come on top, no two of which overlap.

    Args:
        shape: outline of the body in its own coordinates.
        radius: of the discs [length].
        n_places: on the ring, at equal distances along it.
        gap: between a disc on the ring and the body [length]; None: a tenth of the radius.
        reach: gap up to which pushing from where a disc is may be thought of [length]; None: the radius.
        n_discs: how many there are.
        together: choices of places for all discs at once.
        workspace: that a disc on a place must be inside of; None: everywhere.
        margin: between a place and its border [length].
    """

    def __init__(
        self,
        shape: Shape,
        radius: float,
        n_places: int = 64,
        *,
        gap: float | None = None,
        reach: float | None = None,
        n_discs: int = 1,
        together: int = 0,
        workspace: Workspace | None = None,
        margin: float = 0.0,
    ):
        raise NotImplementedError

    def sample(self, x: Tensor) -> Tensor:
        """See `Places`: (n, 2 · n_discs) in coordinates of the body."""
        raise NotImplementedError

    def states(self, x: Tensor, places: Tensor) -> Tensor:
        """See `Places`."""
        raise NotImplementedError

    def allowed(self, states: Tensor) -> Tensor:
        """See `Places`."""
        raise NotImplementedError

    def near(self, x: Tensor) -> bool:
        """See `Places`."""
        raise NotImplementedError
