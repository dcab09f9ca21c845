"""Paths of end effectors to another place without touching the body."""

import math
from functools import partial
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from difflcs._checks import check_kind, check_number, takes
from difflcs.physics.planar import Drive, PositionDrive, to_body
from difflcs.physics.shapes import Shape
from difflcs.planning.obstacles import Obstacles
from difflcs.planning.outline import DistanceGrid, ring
from difflcs.planning.outline import clearance as clearance_of
from difflcs.planning.places import Workspace, from_body

_WAYPOINTS, _ROUND = 56, 10  # round the body, and round each obstacle
_NO_WAY = 1e6  # a distance
_LONGEST = 12  # radii, of a way between two waypoints where there are obstacles
_MOVED = 0.02  # of a pose, from which on straight ways are surveyed anew
_POINTS = 10  # of the way, that are compared for the end of a step
_LEAST = 0.3  # of the clearance, that must be left on the way
_SPEED, _TOUCH = 0.02, 1e3  # prices of a speed at the end [length per speed] and of a gap that is too small


@runtime_checkable
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
    """Travel of a disc on a plane round the shape of the body, as fast as its drive allows.

    The path is the shortest one of straight lines between waypoints on a curve round the body, inside the workspace if
    there is one. A drive is linear: the action that takes the disc to a given point in one step is known, and so is its
    course. Of many points on the path, for the end of this step and of the next, it is sent to those that bring it
    farthest without touching the body. Actions are relative, as in `difflcs.physics.PlanarPushing`.

    Args:
        shape: outline of the body in its own coordinates.
        radius: of the disc [length], > 0.
        step: largest norm of its action, > 0.
        drive: of the disc; None: `PositionDrive()`, it goes where it is sent.
        clearance: between disc and body at waypoints [length]; None: half the radius. On the way it is at least .3 of
            it, or as much as at its ends.
        tolerance: distance to the target at which the disc has arrived [length]; None: half the radius.
        workspace: region in which the way should stay and which the disc is not sent out of; None: everywhere.
        obstacles: what it goes round, too; None: nothing.

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
        workspace: Workspace | None = None,
        obstacles: Obstacles | None = None,
    ):
        self.shape = check_kind("shape", shape, Shape)
        self.radius = check_number("radius", radius, strict=True)
        self.step = check_number("step", step, strict=True)
        self.clearance = 0.5 * radius if clearance is None else check_number("clearance", clearance, strict=True)
        self.tolerance = 0.5 * radius if tolerance is None else check_number("tolerance", tolerance, strict=True)
        self.workspace, self.obstacles = check_kind("workspace", workspace, (Workspace, type(None))), None
        with torch.no_grad():
            course = check_kind("drive", PositionDrive() if drive is None else drive, Drive).course()
            instants, order = len(course.b), course.b.shape[-1]
            self.n_x = f"{3 + 2 * order}+"  # see `takes`
            self._A = course.A.reshape(instants, -1, order, order).expand(-1, 2, -1, -1)  # by coordinate
            self._b = course.b.reshape(instants, -1, order).expand(-1, 2, -1)
            self.grid = DistanceGrid(partial(clearance_of, shape), shape.radius + 2 * (radius + self.clearance))
            self.ring, x = ring(shape, radius + self.clearance, _WAYPOINTS), torch.zeros(3, dtype=torch.float64)
            seen = torch.stack([self._in_sight(x, point, self.ring) for point in self.ring])
            self._between = torch.where(seen & seen.mT, torch.cdist(self.ring, self.ring), math.inf)
        self.obstacles = check_kind("obstacles", obstacles, (Obstacles, type(None)))
        self._surveyed: tuple[Tensor, Tensor, Tensor] | None = None

    @takes(x="n_x", states="n n_x")
    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """See `Travel`: the straight distance; far more than any where obstacles leave no way."""
        straight = (states[:, 3:5] - x[3:5]).norm(dim=-1)
        if self._in_the_way() is None or not len(states):
            return straight
        with torch.no_grad():
            start, ends = to_body(x, x[None, 3:5])[0], to_body(x, states[:, 3:5])
            nodes, length, _ = self._reach(x, start)
            open_to = length[torch.cdist(ends, nodes).argmin(1)].isfinite() | self._in_sight(x, start, ends)
            return torch.where(open_to, straight, _NO_WAY)

    @takes(x="n_x", target="n_x")
    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """See `Travel`."""
        with torch.no_grad():
            return self._send(x, target[3:5])

    @takes(x="n_x", target="n_x")
    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """See `Travel`."""
        return bool((target[3:5] - x[3:5]).norm() < self.tolerance)

    def _send(self, x: Tensor, there: Tensor) -> Tensor:
        """Choose the action (2,) of the disc that is to go there (2,)."""
        order = self._b.shape[-1]
        motion = x[3 : 3 + 2 * order].reshape(order, 2)
        ends = to_body(x, torch.stack([motion[0], there]))
        way = from_body(x, self._way(x, ends[0], ends[1]))
        least = self._gap(x, ends).amin().clamp(max=_LEAST * self.clearance)
        reach = float(self._b[-1, :, 0].max()) * self.step

        def touch(course: Tensor) -> Tensor:
            gap = self._gap(x, to_body(x, course[..., 0, :].reshape(-1, 2))).reshape(course.shape[:-2])
            return (least - gap.amin(-1)).clamp_min(0.0)

        at, goals = _along(way, reach, _POINTS)
        sent, first = self._course(motion, goals)
        arrives = (first[:, -1, 0] - there).norm(dim=-1) < 0.6 * self.tolerance
        come, goals = _along(way, 2 * reach, _POINTS + 4)
        second = self._course(first[:, None, -1], goals)[1]
        missed = (second[..., -1, 0, :] - goals).norm(dim=-1)
        speed = second[..., -1, 1:, :].norm(dim=-1).sum(-1)
        score = come - 2 * missed - _SPEED * speed - _TOUCH * (touch(first)[:, None] + touch(second))
        score += 0.01 * at[:, None] + 10 * reach * arrives[:, None]
        return sent[int(score.amax(1).argmax())]

    def _course(self, motion: Tensor, goals: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the actions by which the disc ends a step at some points, or as near as it may be sent.

        Args:
            motion: (..., order, 2) its place, and its velocity if it has one.
            goals: (..., 2) the points.

        Returns:
            Actions (..., 2), and courses (..., n_instants, order, 2).
        """
        drift = torch.einsum("tcjl,...lc->...tjc", self._A, motion)
        u = (goals - drift[..., -1, 0, :]) / self._b[-1, :, 0]
        u = u * (self.step / u.norm(dim=-1, keepdim=True).clamp_min(self.step))
        if self.workspace is not None:
            u = self.workspace.clamp(motion[..., 0, :] + u) - motion[..., 0, :]
        return u, drift + torch.einsum("tcj,...c->...tjc", self._b, u)

    def _way(self, x: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Find the shortest way (n, 2) from start to end by waypoints, in coordinates of the body."""
        way = torch.stack([start, end])
        if bool(self._in_sight(x, start, end.unsqueeze(0))[0]):
            return way
        nodes, length, before = self._reach(x, start)
        length = length + self._legs(x, end, nodes)
        at, turns = int(length.argmin()), [end]
        if not math.isfinite(float(length[at])):
            return way
        while at >= 0:
            turns.append(nodes[at])
            at = int(before[at])
        return torch.stack([*turns, start]).flip(0)

    def _reach(self, x: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the waypoints (n, 2), the lengths (n,) of shortest ways to them, and what comes before each (n,)."""
        nodes, between = self._survey(x)
        length = self._legs(x, start, nodes)
        outside = torch.zeros_like(length)
        if self.workspace is not None:
            outside = _TOUCH * (~self.workspace.contains(from_body(x, nodes))).to(length)
        length, before = length + outside, torch.full((len(length),), -1)
        while True:
            best, by = (length[:, None] + between + outside).min(0)
            shorter = best < length - 1e-9
            if not bool(shorter.any()):
                return nodes, length, before
            length, before = torch.where(shorter, best, length), torch.where(shorter, by, before)

    def _survey(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the waypoints (n, 2) in coordinates of the body, and the lengths (n, n) of straight ways."""
        obstacles = self._in_the_way()
        if obstacles is None:
            return self.ring, self._between
        poses, last = torch.cat([x[None, :3], obstacles.poses]), self._surveyed
        if last is None or last[0].shape != poses.shape or bool((last[0] - poses).abs().max() > _MOVED):
            around = to_body(x, obstacles.waypoints(self.radius + self.clearance, _ROUND))
            nodes = torch.cat([self.ring[::2], around])
            nodes = nodes[self._gap(x, nodes) > 0.5 * self.clearance]
            last = self._surveyed = poses, nodes, self._straight(x, nodes)
        return last[1], last[2]

    def _straight(self, x: Tensor, nodes: Tensor) -> Tensor:
        """Return the lengths (n, n) of straight ways between points (n, 2), ∞ where they are long or not free."""
        lengths = torch.cdist(nodes, nodes)
        i, j = torch.nonzero((lengths < _LONGEST * self.radius).triu(1)).T
        between = torch.full_like(lengths, math.inf)
        between[i, j] = between[j, i] = torch.where(self._in_sight(x, nodes[i], nodes[j]), lengths[i, j], math.inf)
        return between

    def _legs(self, x: Tensor, point: Tensor, nodes: Tensor) -> Tensor:
        """Return the lengths (n,) of straight ways from a point to the waypoints, ∞ for those that are not in sight."""
        lengths = (nodes - point).norm(dim=-1)
        seen = self._in_sight(x, point, nodes)
        if not bool(seen.any()):  # as at a corner that points inwards: the nearest leads away from the body
            seen[lengths.argmin()] = True
        return torch.where(seen, lengths, math.inf)

    def _in_the_way(self) -> Obstacles | None:
        return self.obstacles if self.obstacles is not None and self.obstacles.shapes else None

    def _gap(self, x: Tensor, points: Tensor) -> Tensor:
        """Compute the gap (...) of a disc at points (..., 2) in coordinates of the body, which is as in the state x."""
        gap, obstacles = self.grid.distance(points), self._in_the_way()
        if obstacles is not None:
            gap = torch.minimum(gap, obstacles.gap(from_body(x, points)))
        return gap - self.radius

    def _in_sight(self, x: Tensor, start: Tensor, ends: Tensor) -> Tensor:
        """Return a mask of the ends (n, 2) to which a disc can go straight from start (2,) or (n, 2), of the body."""
        longest = float((ends - start).norm(dim=-1).max())
        count = 2 + math.ceil(longest / (0.5 * self.clearance + 0.1 * self.radius))
        t = torch.linspace(0.0, 1.0, count, dtype=start.dtype)[:, None]
        gap = self._gap(x, start.unsqueeze(-2) + t * (ends - start).unsqueeze(-2))
        nearest = torch.minimum(gap[:, :1], gap[:, -1:]).clamp(max=_LEAST * self.clearance)
        return (gap >= nearest - 1e-9).all(-1)


def _along(way: Tensor, longest: float, points: int) -> tuple[Tensor, Tensor]:
    """Place points at equal distances along a way (n, 2), at most so far: their distances and places (points, 2)."""
    lengths = torch.cat([way.new_zeros(1), (way[1:] - way[:-1]).norm(dim=-1).cumsum(0)])
    at = torch.linspace(1 / points, 1.0, points, dtype=way.dtype) * min(float(lengths[-1]), longest)
    side = (torch.searchsorted(lengths, at) - 1).clamp(0, len(way) - 2)
    part = (at - lengths[side]) / (lengths[side + 1] - lengths[side]).clamp_min(1e-12)
    return at, torch.lerp(way[side], way[side + 1], part.unsqueeze(-1))
