"""Places from which each finger can push, and ways for its tip: `Places` and `Travel` of `difflcs.planning`.

State of the plan: x, y, yaw of the cube; x, y, z of the tip that pushes; which finger it is. Lengths in `UNIT`.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from difflcs.records import LCSParams
from trifinger_push.cube import HALF, HEIGHT, TIP_RADIUS, UNIT, box_distance, pushing
from trifinger_push.fingers import N_FINGERS, inverse, planar_turn

Array = NDArray[np.float64]

POSE, TIP, FINGER = slice(0, 3), slice(3, 6), 6
"""Slices of the state."""
PUSH_HEIGHT = 0.022
"""Of a tip that pushes [m]: friction on the table is 1, so that above half the cube's width it would topple."""
OVER = 0.088
"""Of a tip that is carried over the cube [m]."""
GAP = 0.004
"""Between a tip at a place and the cube [m]."""
PER_FACE, PART = 9, 0.6
"""Places on each face, and the part of its width that they take: at its ends a tip slips off the corner."""
ARENA = 0.183
"""Largest distance of a tip from the middle [m]; the wall is at 0.195."""
LINK_RADIUS = 0.012
"""Of the lower link, with some room [m]."""


class OneFinger:
    """The cube pushed by one tip, an `LCSModule`: quasi-static in the plane; height and finger stay as they are.

    Args:
        friction: between tip and cube.
        compliance: of the contact, see `PlanarPushing`.
    """

    n_x, n_u = 7, 3

    def __init__(self, friction: float, compliance: float) -> None:
        self.plane = pushing(friction, compliance, "anitescu")
        self.n_lam = self.plane.n_lam

    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """Return the system at states x (..., 7)."""
        assert x is not None
        flat = self.plane.params(x[..., :5])
        n_x, n_u = self.n_x - 5, self.n_u - 2
        return replace(
            flat,
            A=torch.block_diag(flat.A, torch.eye(n_x, dtype=x.dtype)),
            B=torch.block_diag(flat.B, torch.eye(n_x, n_u, dtype=x.dtype)),
            C=torch.nn.functional.pad(flat.C, (0, 0, 0, n_x)),
            d=torch.nn.functional.pad(flat.d, (0, n_x)),
            D=torch.nn.functional.pad(flat.D, (0, n_x)),
            E=torch.nn.functional.pad(flat.E, (0, n_u)),
        )


def _ring() -> tuple[Array, Array]:
    """Compute places round the cube in its frame and the outward normals there, both (4 · PER_FACE, 2)."""
    along = np.linspace(-PART * HALF, PART * HALF, PER_FACE)
    face = np.stack([np.full(PER_FACE, HALF + TIP_RADIUS + GAP), along], 1)
    turns = [planar_turn(k * np.pi / 2) for k in range(4)]
    return np.concatenate([face @ t.T for t in turns]), np.repeat([t[:, 0] for t in turns], PER_FACE, 0)


def _free(finger: int, pose: Array, points: Array, normals: Array) -> NDArray[np.bool_]:
    """Return which points (n, 2) [m] a finger can push from: in reach, also further on, its link not in the cube."""
    height = np.full(len(points), PUSH_HEIGHT)
    _, knee = inverse(finger, np.column_stack([points, height]))
    _, ahead = inverse(finger, np.column_stack([points - 0.02 * normals, height]))
    free = np.isfinite(knee[:, 0]) & np.isfinite(ahead[:, 0]) & (np.linalg.norm(points, axis=1) < ARENA)
    lean = (knee[:, :2] - points) / (knee[:, 2:] - PUSH_HEIGHT)
    turn = planar_turn(pose[2])
    for z in (PUSH_HEIGHT + 0.012, PUSH_HEIGHT + 0.026, HEIGHT + 0.003):
        link = (points + np.nan_to_num(lean) * (z - PUSH_HEIGHT) - pose[:2]) @ turn
        free &= box_distance(link) > LINK_RADIUS
    return free


@dataclass
class Refused:
    """A face that a finger failed to push."""

    finger: int
    normal: Array
    until: int


class FingerPlaces:
    """Places round the cube for each finger that can push from there; a place is (finger, x, y) in the cube's frame."""

    def __init__(self) -> None:
        self.ring, self.normals = _ring()
        self.reset()

    def reset(self) -> None:
        """Forget which places were refused."""
        self.refused: list[Refused] = []
        self.now = 0
        self.held = False

    def refuse(self, x: Array, steps: int) -> None:
        """Refuse the face of the finger at x, which does not move the cube, for some steps."""
        local = (x[TIP][:2] - x[:2]) @ planar_turn(x[2])
        axis = int(np.argmax(np.abs(local)))
        normal = np.eye(2)[axis] * np.sign(local[axis])
        self.refused.append(Refused(int(x[FINGER]), normal, self.now + steps))
        self.held = True

    def sample(self, x: Tensor) -> Tensor:
        """Sample places; see `Places`."""
        pose = x[POSE].numpy() * [UNIT, UNIT, 1]
        turn = planar_turn(pose[2])
        points, normals = self.ring @ turn.T + pose[:2], self.normals @ turn.T
        self.refused = [r for r in self.refused if r.until > self.now]
        rows = []
        for finger in range(N_FINGERS):
            free = _free(finger, pose, points, normals)
            for r in self.refused:
                if r.finger == finger:
                    free &= self.normals @ r.normal < 0.5
            rows.append(np.column_stack([np.full(free.sum(), float(finger)), self.ring[free] / UNIT]))
        return torch.from_numpy(np.concatenate(rows))

    def states(self, x: Tensor, places: Tensor) -> Tensor:
        """Make the states at places; see `Places`."""
        cos, sin = float(x[2].cos()), float(x[2].sin())
        states = x.expand(len(places), -1).clone()
        states[:, 3] = x[0] + cos * places[:, 1] - sin * places[:, 2]
        states[:, 4] = x[1] + sin * places[:, 1] + cos * places[:, 2]
        states[:, 5] = PUSH_HEIGHT / UNIT
        states[:, FINGER] = places[:, 0]
        return states

    def allowed(self, states: Tensor) -> Tensor:
        """Return whether places are allowed; see `Places`. Those that are not were not sampled."""
        return torch.ones(len(states), dtype=torch.bool)

    def near(self, x: Tensor) -> bool:
        """Return whether the finger is near the cube; see `Places`."""
        if self.held:
            return False
        state = x.numpy()
        local = (state[3:5] - state[:2]) @ planar_turn(state[2]) * UNIT
        return bool(state[5] * UNIT < PUSH_HEIGHT + 0.03 and box_distance(local) - TIP_RADIUS < 0.025)


def lift(pose: Array, tip: Array) -> Array:
    """Compute a waypoint (3,) [m] of a tip beside the cube: up, and away from the face that it may touch."""
    turn = planar_turn(pose[2])
    local = (tip[:2] - pose[:2]) @ turn
    axis = int(np.argmax(np.abs(local)))
    return np.array([*(tip[:2] + 0.012 * np.sign(local[axis]) * turn[:, axis]), OVER])


class FingerTravel:
    """A tip goes straight to its place where the cube is not in the way, else over it. Actions: offset to a waypoint.

    Attributes:
        tips: (3, 3) where the tips are now [m], to be set before each decision.
    """

    room = TIP_RADIUS + 0.0015
    tolerance = 0.010

    def __init__(self) -> None:
        self.tips = np.zeros((N_FINGERS, 3))

    def _crosses(self, pose: Array, start: Array, ends: Array) -> Array:
        """Return which straight ways in the plane from start (2,) to ends (n, 2) touch the cube."""
        s = np.linspace(0, 1, 25)[:, None, None]
        way = (start * (1 - s) + ends * s - pose[:2]) @ planar_turn(pose[2])
        return box_distance(way).min(0) < self.room

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """Compute the distance of each state's finger, in units; see `Travel`."""
        pose, distances = x[POSE].numpy() * [UNIT, UNIT, 1], np.zeros(len(states))
        fingers, ends = states[:, FINGER].numpy(), states[:, TIP].numpy() * UNIT
        for finger, tip in enumerate(self.tips):
            mine = fingers == finger
            across = np.linalg.norm(ends[mine, :2] - tip[:2], axis=1)
            climb = np.maximum(OVER - tip[2], 0) + OVER - ends[mine, 2]
            over = np.maximum(across, 0.5 * across + climb)
            straight = np.hypot(across, ends[mine, 2] - tip[2])
            distances[mine] = np.where(self._crosses(pose, tip[:2], ends[mine, :2]), over, straight)
        return torch.from_numpy(distances / UNIT)

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """Compute the action; see `Travel`."""
        pose = x[POSE].numpy() * [UNIT, UNIT, 1]
        tip, end = self.tips[int(target[FINGER])], target[TIP].numpy() * UNIT
        waypoint = end.copy()
        if self._crosses(pose, tip[:2], end[None, :2])[0]:
            waypoint[2] = OVER
            if tip[2] <= OVER - 0.012:
                waypoint = lift(pose, tip)
        return torch.from_numpy((waypoint - tip) / UNIT)

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """Return whether the tip has arrived; see `Travel`."""
        near = float((x[TIP] - target[TIP]).norm()) * UNIT < self.tolerance
        return near and float(x[FINGER]) == float(target[FINGER])
