"""How end effectors get from where they are to another place without touching the body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from difflcs.physics.shapes import Shape

__all__ = ["LiftTravel", "PlanarTravel", "Travel"]


class Travel(Protocol):
    """A way from a state to another that differs from it in the end effectors alone."""

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """Length (n,) of the way from x (n_x,) to each of the states (n, n_x), or an estimate of it."""
        ...

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """The action (n_u,) of the next step of the way from x (n_x,) to a state target (n_x,)."""
        ...

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """Whether x is near enough to the target to push from it."""
        ...


class PlanarTravel:
    """Discs on a plane go round the shape of the body, each by the shorter way that is open.

    Actions are relative: u = how far a disc is to be sent in a step, as in `difflcs.physics.PlanarPushing`.

    Args:
        shape: outline of the body in its own coordinates.
        radius: of the discs [length].
        step: how far a disc is sent in a step [length].
        clearance: between disc and body on the way round [length]; None: half the radius.
        tolerance: distance to the target at which a disc has arrived [length]; None: half the radius.
        n_discs: how many there are; with x[3 : 3 + 2 · n_discs] their places.
    """

    def __init__(
        self,
        shape: Shape,
        radius: float,
        step: float,
        *,
        clearance: float | None = None,
        tolerance: float | None = None,
        n_discs: int = 1,
    ):
        raise NotImplementedError

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """See `Travel`: the straight distance of the disc that has farthest to go."""
        raise NotImplementedError

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """See `Travel`."""
        raise NotImplementedError

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """See `Travel`."""
        raise NotImplementedError


class LiftTravel:
    """End effectors in space are lifted off, carried over the body, and lowered.

    Actions are relative, and have three components for each end effector.

    Args:
        height: z at which nothing is in the way [length].
        step: how far an end effector is sent in a step [length].
        effectors: for each end effector the indices of its x, y and z in the state.
        tolerance: distance to the target at which it has arrived [length].
    """

    def __init__(self, height: float, step: float, effectors: Sequence[Sequence[int]], tolerance: float):
        raise NotImplementedError

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """See `Travel`: up, over and down, of the one that has farthest to go."""
        raise NotImplementedError

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """See `Travel`."""
        raise NotImplementedError

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """See `Travel`."""
        raise NotImplementedError
