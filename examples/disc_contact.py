"""What a disc does to a body in one step of gym-pusht, by many hypotheses at once: exact to rounding, in NumPy.

The physics is pymunk's (Chipmunk's) where nothing has a memory: damping takes all velocities away in each substep. A
body moves only where the disc overlaps it, with the velocity that impulses give it against the velocity of the disc,
and it moves by it in the next substep. So it lags a substep behind a disc that makes up to 14 px in one, and what
overlap is left closes by 6 % a substep. A model in which the disc never overlaps the body explains the same motion by
an outline that is 4 to 5 % too small.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from difflcs.physics import PDDrive, PlanarPushing, Polygon, Union

__all__ = ["DiscContact"]

Array = NDArray[Any]

_LEFT = (1.0 - 0.1) ** 60.0
"""Part of an overlap that is left after a second."""
_SLOP = 0.001
"""Overlap that stays [length]."""
_ITERATIONS = 8
"""Of impulses, where the disc touches several parts."""


class DiscContact:
    """Predict a step: `contact(x, sent, contexts)`, for hypotheses (n, 2) of the outline's scale and of friction.

    Vectors of the plane are complex numbers here.

    Args:
        system: its outline, a union of convex polygons, at scale 1; centre of mass, gyration, radius of the disc, and
            the drive, a `PDDrive`.

    Attributes:
        drive: of the disc.
    """

    def __init__(self, system: PlanarPushing):
        assert isinstance(system.shape, Union)
        assert isinstance(system.drive, PDDrive)
        outlines = [_plane(part.corners.detach().numpy()) for part in system.shape.parts if isinstance(part, Polygon)]
        sides = [np.stack([corners, np.roll(corners, -1) - corners]) for corners in outlines]
        most = max(side.shape[1] for side in sides)
        # A side that is there twice does no harm.
        self._starts, sides = np.stack([np.pad(s, ((0, 0), (0, most - s.shape[1])), "edge") for s in sides], 1)
        self._lengths = np.abs(sides)
        self._along = sides / self._lengths
        self._center = complex(*np.asarray(system.center_of_mass).tolist())
        self._turns = float(torch.as_tensor(system.gyration)) ** -2
        self._radius = float(torch.as_tensor(system.radius).reshape(-1)[0])
        self.drive = system.drive
        self._close = (1 - _LEFT**self.drive.substep) / self.drive.substep

    def __call__(self, x: Array, sent: Array, contexts: Array) -> Array:
        """Predict the pose after a step.

        Args:
            x: (7,) pose of the body, about the centre of its area; place and velocity of the disc.
            sent: (2,) target of the disc, from its place.
            contexts: (n, 2) scales and frictions.

        Returns:
            (n, 3) poses.
        """
        (x0, y0, yaw0, *disc), (scale, friction) = x.tolist(), contexts.T
        places, velocities = self._course(complex(*disc[:2]), complex(*disc[2:]), complex(*sent.tolist()))
        start = np.exp(-1j * yaw0) * (places - complex(x0, y0))
        sizes = np.unique(scale)
        distance, _, _ = self._nearest((start[:, None] / sizes).ravel())
        gap = (distance.min(-1).reshape(len(start), -1) * sizes - self._radius).min(-1)
        origin, yaw = np.full(len(scale), complex(x0, y0)), np.full(len(scale), yaw0)
        first = int((gap < 0).argmax()) if (gap < 0).any() else len(places)  # before it nothing moves
        for place, velocity in zip(places[first:], velocities[first:], strict=True):
            motion, spin = self._motion(origin, yaw, place, velocity, scale, friction)
            center, yaw = origin + self._center * np.exp(1j * yaw), yaw + self.drive.substep * spin
            origin = center + self.drive.substep * motion - self._center * np.exp(1j * yaw)
        return np.stack([np.real(origin), np.imag(origin), yaw], -1)

    def _course(self, place: complex, velocity: complex, sent: complex) -> tuple[Array, Array]:
        """Compute places and velocities of the disc at the begin of each substep (substeps,)."""
        drive, target, course = self.drive, place + sent, []
        for _ in range(drive.substeps):
            course.append((place, velocity))
            velocity += drive.substep * (float(drive.stiffness) * (target - place) - float(drive.damping) * velocity)
            place += drive.substep * velocity
        places, velocities = np.array(course).T
        return places, velocities

    def _motion(
        self, origin: Array, yaw: Array, place: complex, velocity: complex, scale: Array, friction: Array
    ) -> tuple[Array, Array]:
        """Compute how fast the disc moves bodies: their centres of mass (n,), and their spin (n,)."""
        turned = np.exp(1j * yaw)
        distance, normal, point = self._nearest((place - origin) / turned / scale)
        gap = scale[:, None] * distance - self._radius
        contacts = []
        for i in np.flatnonzero((gap < 0).any(0)):
            direction, arm = turned * normal[:, i], turned * (scale * point[:, i] - self._center)
            limit = np.where(gap[:, i] < 0, np.inf, 0.0)
            closing = self._close * np.minimum(0.0, gap[:, i] + _SLOP) * direction
            contacts.append((self._row(direction, arm), self._row(1j * direction, arm), closing, limit))
        # Velocities by which bodies give way, and those by which overlaps close.
        gives, closes = _Motion(len(scale), self._turns), _Motion(len(scale), self._turns)
        if len(contacts) == 1:
            push, rub, closing, limit = contacts[0]
            gives.press(push, rub, velocity, friction, limit)
            closes.add(push, closing, np.zeros(len(scale)), 0.0, limit)
        else:
            totals = np.zeros((len(contacts), 3, len(scale)))
            for _ in range(_ITERATIONS):
                for (push, rub, closing, limit), (pushed, rubbed, closed) in zip(contacts, totals, strict=True):
                    gives.add(push, velocity, pushed, 0.0, limit)
                    closes.add(push, closing, closed, 0.0, limit)
                    gives.add(rub, velocity, rubbed, -friction * pushed, friction * pushed)
        return gives.velocity + closes.velocity, gives.spin + closes.spin

    def _row(self, direction: Array, arm: Array) -> _Row:
        torque = np.imag(np.conj(arm) * direction)
        return _Row(direction, torque, 1.0 + self._turns * torque**2)

    def _nearest(self, points: Array) -> tuple[Array, Array, Array]:
        """Compute signed distances of points (n,), outward normals and nearest points, each (n, parts)."""
        apart = (points[:, None, None] - self._starts) * np.conj(self._along)  # along a side, and inwards of it
        beside = apart - np.clip(apart.real, 0.0, self._lengths)
        inside = (apart.imag >= 0).all(-1, keepdims=True)
        square = beside.real**2 + beside.imag**2
        side = np.where(inside, apart.imag, square).argmin(-1).ravel()
        parts = np.arange(len(side)) % len(self._starts)
        beside = beside.reshape(len(side), -1)[np.arange(len(side)), side].reshape(inside.shape[:-1])
        along = self._along[parts, side].reshape(beside.shape)
        distance = np.where(inside[..., 0], -beside.imag, np.abs(beside))
        flat = np.abs(distance) < 1e-9
        normal = along * np.where(flat, -1j, beside / np.where(flat, 1.0, distance))
        return distance, normal, points[:, None] - along * beside


class _Row(NamedTuple):
    """How fast a point of a body goes along a direction (n,) by its motion, and by a unit impulse along it."""

    direction: Array
    torque: Array
    mobility: Array


class _Motion:
    """Velocities (n,) of centres of mass of bodies, and their spin (n,), as impulses change them."""

    def __init__(self, n: int, turns: float):
        self.velocity, self.spin, self.turns = np.zeros(n, complex), np.zeros(n), turns

    def add(self, row: _Row, velocity: complex | Array, total: Array, low: Array | float, high: Array | float) -> None:
        """Add the impulses against a direction by which bodies move as fast along it, as far as totals are allowed."""
        speed = np.real(np.conj(row.direction) * (self.velocity - velocity)) + row.torque * self.spin
        more = np.clip(total + speed / row.mobility, low, high) - total
        total += more
        self._give(row, more)

    def press(self, push: _Row, rub: _Row, velocity: complex, friction: Array, limit: Array) -> None:
        """Add the impulses of one contact to bodies at rest: it sticks where friction suffices, else it slides."""
        speed, slip = (-np.real(np.conj(row.direction) * velocity) for row in (push, rub))
        both = self.turns * push.torque * rub.torque
        sticks = (push.mobility * slip - both * speed) / (push.mobility * rub.mobility - both**2)
        most = np.copysign(friction, sticks)
        pushed = speed / (push.mobility + most * both)
        slides = np.abs(sticks) > friction * (speed - both * sticks) / push.mobility
        rubbed = np.where(slides, most * pushed, sticks)
        pushed = np.clip((speed - both * rubbed) / push.mobility, 0.0, limit)
        self._give(push, pushed)
        self._give(rub, np.where(pushed > 0, rubbed, 0.0))

    def _give(self, row: _Row, impulse: Array) -> None:
        self.velocity = self.velocity - impulse * row.direction
        self.spin = self.spin - self.turns * impulse * row.torque


def _plane(points: Array) -> Array:
    """Take points (..., 2) for complex numbers (...)."""
    return points[..., 0] + 1j * points[..., 1]
