"""Paths of end effectors to another place without touching the body."""

import math
from typing import Protocol

import torch
from torch import Tensor

from difflcs._checks import check_number, check_positive_int
from difflcs.physics.planar import Drive, PositionDrive, to_body
from difflcs.physics.shapes import Shape
from difflcs.planning.outline import DistanceGrid, ring
from difflcs.planning.places import Workspace, from_body

_WAYPOINTS = 56
_POINTS = 10  # of the way, that are compared for the end of a step
_LEAST = 0.3  # of the clearance, that must be left on the way
_SPEED, _TOUCH = 0.02, 1e3  # prices of a speed at the end [length per speed] and of a gap that is too small


class Travel(Protocol):
    """A path from a state to another that differs from it only in the end effectors."""

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
    """Travel of discs on a plane round the shape of the body, as fast as their drive allows.

    The path is the shortest one of straight lines between waypoints on a curve round the body, inside the workspace if
    there is one. A drive is linear: the action that takes a disc to a given point in one step is known, and so is its
    course. Of many points on the path, for the end of this step and of the next, a disc is sent to those that bring it
    farthest without touching the body. Actions are relative, as in `difflcs.physics.PlanarPushing`. Discs ignore each
    other.

    Args:
        shape: outline of the body in its own coordinates.
        radius: of the discs [length], > 0.
        step: largest norm of the action of a disc, > 0.
        drive: of the discs; None: `PositionDrive()`, they go where they are sent.
        clearance: between disc and body at waypoints [length]; None: half the radius. On the way it is at least .3 of
            it, or as much as at its ends.
        tolerance: distance to the target at which a disc has arrived [length]; None: half the radius.
        n_discs: number of discs; x[3 : 3 + 2 · n_discs] are their places, and their velocities follow if they have any.
        workspace: region in which the way should stay and which no disc is sent out of; None: everywhere.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(
        self,
        shape: Shape,
        radius: float,
        step: float,
        *,
        drive: Drive | None = None,
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
        with torch.no_grad():
            course = (PositionDrive() if drive is None else drive).course()
            self._A = _by_disc(course.A, n_discs, 2)
            self._b = _by_disc(course.b, n_discs, 1)
            self._grid = DistanceGrid(shape, 2 * (radius + self.clearance))
            self.ring = ring(shape, radius + self.clearance, _WAYPOINTS)
            seen = torch.stack([self._in_sight(point, self.ring) for point in self.ring])
            self._between = torch.where(seen & seen.mT, torch.cdist(self.ring, self.ring), math.inf)

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """See `Travel`: the straight distance of the disc that has farthest to go."""
        return (self._discs(states) - self._discs(x)).norm(dim=-1).amax(-1)

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """See `Travel`."""
        there = self._discs(target)
        with torch.no_grad():
            return torch.cat([self._send(x, there[i], i) for i in range(self.n_discs)])

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """See `Travel`."""
        return bool((self._discs(target) - self._discs(x)).norm(dim=-1).max() < self.tolerance)

    def _discs(self, x: Tensor) -> Tensor:
        return x[..., 3 : 3 + 2 * self.n_discs].reshape(*x.shape[:-1], self.n_discs, 2)

    def _send(self, x: Tensor, there: Tensor, disc: int) -> Tensor:
        """Choose the action (2,) of a disc that is to go there (2,)."""
        order = self._b.shape[-1]
        motion = x[3 : 3 + 2 * self.n_discs * order].reshape(order, self.n_discs, 2)[:, disc]
        ends = to_body(x, torch.stack([motion[0], there]))
        way = from_body(x, self._way(x, ends[0], ends[1]))
        least = self._gap(ends).amin().clamp(max=_LEAST * self.clearance)
        reach = float(self._b[-1, disc, :, 0].max()) * self.step

        def touch(course: Tensor) -> Tensor:
            gap = self._gap(to_body(x, course[..., 0, :].reshape(-1, 2))).reshape(course.shape[:-2])
            return (least - gap.amin(-1)).clamp_min(0.0)

        at, goals = _along(way, reach, _POINTS)
        sent, first = self._course(motion, goals, disc)
        arrives = (first[:, -1, 0] - there).norm(dim=-1) < 0.6 * self.tolerance
        come, goals = _along(way, 2 * reach, _POINTS + 4)
        second = self._course(first[:, None, -1], goals, disc)[1]
        missed = (second[..., -1, 0, :] - goals).norm(dim=-1)
        speed = second[..., -1, 1:, :].norm(dim=-1).sum(-1)
        score = come - 2 * missed - _SPEED * speed - _TOUCH * (touch(first)[:, None] + touch(second))
        score += 0.01 * at[:, None] + 10 * reach * arrives[:, None]
        return sent[int(score.amax(1).argmax())]

    def _course(self, motion: Tensor, goals: Tensor, disc: int) -> tuple[Tensor, Tensor]:
        """Compute the actions by which a disc ends a step at some points, or as near as it may be sent.

        Args:
            motion: (..., order, 2) its place, and its velocity if it has one.
            goals: (..., 2) the points.
            disc: its number.

        Returns:
            Actions (..., 2), and courses (..., n_instants, order, 2).
        """
        A, b = self._A[:, disc], self._b[:, disc]
        drift = torch.einsum("tcjl,...lc->...tjc", A, motion)
        u = (goals - drift[..., -1, 0, :]) / b[-1, :, 0]
        u = u * (self.step / u.norm(dim=-1, keepdim=True).clamp_min(self.step))
        if self.workspace is not None:
            u = self.workspace.clamp(motion[..., 0, :] + u) - motion[..., 0, :]
        return u, drift + torch.einsum("tcj,...c->...tjc", b, u)

    def _way(self, x: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Find the shortest way (n, 2) from start to end by waypoints, in coordinates of the body."""
        if bool(self._in_sight(start, end.unsqueeze(0))[0]):
            return torch.stack([start, end])
        length, last = self._legs(start), self._legs(end)
        outside = torch.zeros_like(length)
        if self.workspace is not None:
            outside = _TOUCH * (~self.workspace.contains(from_body(x, self.ring))).to(length)
        length, before = length + outside, torch.full((len(length),), -1)
        while True:
            best, by = (length[:, None] + self._between + outside).min(0)
            shorter = best < length - 1e-9
            if not bool(shorter.any()):
                break
            length, before = torch.where(shorter, best, length), torch.where(shorter, by, before)
        at, way = int((length + last).argmin()), [end]
        while at >= 0:
            way.append(self.ring[at])
            at = int(before[at])
        return torch.stack([*way, start]).flip(0)

    def _legs(self, point: Tensor) -> Tensor:
        """Return the lengths (n,) of straight ways from a point to the waypoints, ∞ for those that are not in sight."""
        lengths = (self.ring - point).norm(dim=-1)
        seen = self._in_sight(point, self.ring)
        if not bool(seen.any()):  # as at a corner that points inwards: the nearest leads away from the body
            seen[lengths.argmin()] = True
        return torch.where(seen, lengths, math.inf)

    def _gap(self, points: Tensor) -> Tensor:
        return self._grid.distance(points) - self.radius

    def _in_sight(self, start: Tensor, ends: Tensor) -> Tensor:
        """Return a mask of the ends (n, 2) to which a disc can go straight from start (2,), of the body."""
        longest = float((ends - start).norm(dim=-1).max())
        count = 2 + math.ceil(longest / (0.5 * self.clearance + 0.1 * self.radius))
        t = torch.linspace(0.0, 1.0, count, dtype=start.dtype)[:, None]
        gap = self._gap(start + t * (ends - start).unsqueeze(-2))
        nearest = torch.minimum(gap[:, :1], gap[:, -1:]).clamp(max=_LEAST * self.clearance)
        return (gap >= nearest - 1e-9).all(-1)


def _by_disc(values: Tensor, n_discs: int, tail: int) -> Tensor:
    """Expand values (n_instants, …, k[, k]), with a tail of 1 or 2, to (n_instants, n_discs, 2, k[, k])."""
    lead, last = values.shape[1 : values.ndim - tail], values.shape[values.ndim - tail :]
    return values.reshape(-1, *[1] * (2 - len(lead)), *lead, *last).expand(-1, n_discs, 2, *last)


def _along(way: Tensor, longest: float, points: int) -> tuple[Tensor, Tensor]:
    """Place points at equal distances along a way (n, 2), at most so far: their distances and places (points, 2)."""
    lengths = torch.cat([way.new_zeros(1), (way[1:] - way[:-1]).norm(dim=-1).cumsum(0)])
    at = torch.linspace(1 / points, 1.0, points, dtype=way.dtype) * min(float(lengths[-1]), longest)
    side = (torch.searchsorted(lengths, at) - 1).clamp(0, len(way) - 2)
    part = (at - lengths[side]) / (lengths[side + 1] - lengths[side]).clamp_min(1e-12)
    return at, torch.lerp(way[side], way[side + 1], part.unsqueeze(-1))
