"""Ways of end effectors to another place without touching the body."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from difflcs._checks import check_number, check_positive_int
from difflcs.errors import ShapeError
from difflcs.physics.planar import to_body
from difflcs.physics.shapes import Shape
from difflcs.planning.outline import clearance, ring
from difflcs.planning.places import Workspace, from_body

__all__ = ["LiftTravel", "PlanarTravel", "Travel"]

_WAYPOINTS = 96
_LOOKS = 12


class Travel(Protocol):
    """A way from a state to another that differs from it in the end effectors alone."""

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """Length (n,) of the way from x (n_x,) to each of the states (n, n_x), or an estimate of it."""
        ...

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """The action (n_u,) of the next step of the way from x (n_x,) to a state target (n_x,)."""
        ...

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """Return True if x is near enough to the target to push from it."""
        ...


class PlanarTravel:
    """Discs on a plane go round the shape of the body, straight where they can.

    Where the straight way meets the body, a disc heads for the farthest point in sight on a curve round it, by the
    shorter way round, or the longer one if the shorter leaves the workspace. Actions are relative: u is how far a disc
    is to be sent, as in `difflcs.physics.PlanarPushing`. Discs ignore each other.

    Args:
        shape: outline of the body in its own coordinates.
        radius: of the discs [length], > 0.
        step: how far a disc is sent in a step [length], > 0.
        clearance: between disc and body on the way round [length]; None: half the radius.
        tolerance: distance to the target at which a disc has arrived [length]; None: half the radius.
        n_discs: number of discs; x[3 : 3 + 2 · n_discs] are their places.
        workspace: region in which the way should stay; None: everywhere.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
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
        workspace: Workspace | None = None,
    ):
        self.shape = shape
        self.radius = check_number("radius", radius, strict=True)
        self.step = check_number("step", step, strict=True)
        self.clearance = 0.5 * radius if clearance is None else check_number("clearance", clearance, strict=True)
        self.tolerance = 0.5 * radius if tolerance is None else check_number("tolerance", tolerance, strict=True)
        self.n_discs = check_positive_int("n_discs", n_discs)
        self.workspace = workspace
        self.ring = ring(shape, radius + self.clearance, _WAYPOINTS)

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """See `Travel`: the straight distance of the disc that has farthest to go."""
        return (self._discs(states) - self._discs(x)).norm(dim=-1).amax(-1)

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """See `Travel`."""
        here, there = self._discs(x), self._discs(target)
        moves = [self._next(x, here[i], there[i]) - here[i] for i in range(self.n_discs)]
        return torch.cat([move * min(1.0, self.step / max(float(move.norm()), 1e-12)) for move in moves])

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """See `Travel`."""
        return bool((self._discs(target) - self._discs(x)).norm(dim=-1).max() < self.tolerance)

    def _discs(self, x: Tensor) -> Tensor:
        return x[..., 3 : 3 + 2 * self.n_discs].reshape(*x.shape[:-1], self.n_discs, 2)

    def _next(self, x: Tensor, here: Tensor, there: Tensor) -> Tensor:
        """The next waypoint of a disc, in the plane."""
        start, end = to_body(x, torch.stack([here, there])).unbind()
        if bool(self._in_sight(start, end.unsqueeze(0))[0]):
            return there
        first, last = (int((self.ring - point).square().sum(-1).argmin()) for point in (start, end))
        ahead, size = (last - first) % len(self.ring), len(self.ring)
        ways = [first + torch.arange(1, ahead + 1), first - torch.arange(1, size - ahead + 1)]
        ways = sorted((way % size for way in ways), key=lambda way: (self._leaves(x, way), len(way)))
        way = ways[0] if len(ways[0]) else torch.tensor([last])
        looked_at = way[torch.linspace(0, len(way) - 1, min(_LOOKS, len(way))).round().long()]
        seen = torch.nonzero(self._in_sight(start, self.ring[looked_at]))
        # Where nothing is in sight, as at a corner that points inwards, the nearest waypoint leads away from the body.
        chosen = looked_at[int(seen[-1])] if len(seen) else way[0]
        return from_body(x, self.ring[chosen])

    def _leaves(self, x: Tensor, way: Tensor) -> bool:
        if self.workspace is None:
            return False
        return not bool(self.workspace.contains(from_body(x, self.ring[way])).all())

    def _in_sight(self, start: Tensor, ends: Tensor) -> Tensor:
        """Return a mask of the ends (n, 2) to which a disc can go straight from start (2,), in coordinates of the body.

        It may come as near as an eighth of the clearance, or as near as it is at both ends.
        """
        longest = float((ends - start).norm(dim=-1).max())
        count = 2 + math.ceil(longest / (0.5 * self.clearance + 0.1 * self.radius))
        t = torch.linspace(0.0, 1.0, count, dtype=start.dtype)[:, None]
        gap = clearance(self.shape, start + t * (ends - start).unsqueeze(-2)) - self.radius
        nearest = torch.minimum(gap[:, :1], gap[:, -1:]).clamp(max=0.125 * self.clearance)
        return (gap >= nearest - 1e-9).all(-1)


class LiftTravel:
    """End effectors in space are lifted off, carried over the body, and lowered.

    Actions are relative, and have three components for each end effector. They rise to `height` before they go
    sideways, and go down only above their target.

    Args:
        height: z at which nothing is in the way [length].
        step: how far an end effector is sent in a step [length], > 0.
        effectors: for each end effector the indices of its x, y and z in the state.
        tolerance: distance to the target at which it has arrived, and to a corner of the way at which it turns
            [length], > 0.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(self, height: float, step: float, effectors: Sequence[Sequence[int]], tolerance: float):
        self.height = check_number("height", height, minimum=-math.inf)
        self.step = check_number("step", step, strict=True)
        self.tolerance = check_number("tolerance", tolerance, strict=True)
        self._effectors = torch.tensor([list(of) for of in effectors], dtype=torch.long)
        if self._effectors.ndim != 2 or self._effectors.shape[1] != 3:
            raise ShapeError(
                f"effectors: expected three indices for each end effector, got shape {tuple(self._effectors.shape)}; "
                f"give those of x, y and z"
            )

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """See `Travel`: up, over and down, of the one that has farthest to go; 0 for one that stays."""
        here, there = x[self._effectors], states[:, self._effectors]
        aside = (there - here)[..., :2].norm(dim=-1)
        up_and_down = (self.height - here[..., 2]).clamp_min(0) + (self.height - there[..., 2]).clamp_min(0)
        goes = (there - here).norm(dim=-1) > self.tolerance
        return torch.where(goes, aside + up_and_down, 0.0).amax(-1)

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """See `Travel`."""
        moves = []
        for here, there in zip(x[self._effectors], target[self._effectors], strict=True):
            aside = float((there - here)[:2].norm())
            above = here.new_tensor([float(here[0]), float(here[1]), self.height])
            if aside <= self.tolerance:
                goal = there
            elif float(here[2]) < self.height - self.tolerance:
                goal = above
            else:
                goal = torch.cat([there[:2], above[2:]])
            move = goal - here
            moves.append(move * min(1.0, self.step / max(float(move.norm()), 1e-12)))
        return torch.cat(moves)

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """See `Travel`."""
        return bool((target - x)[self._effectors].norm(dim=-1).max() < self.tolerance)
