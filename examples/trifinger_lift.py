"""Lift and pose the cube of trifinger-rl-datasets, without data: `python examples/trifinger_lift.py --episodes 6`.

Simulator, task, reward, goals and evaluation are those of the authors (`trifinger_rl_datasets.Evaluation`, PyBullet,
torques at 50 Hz, a pose of the cube that is 90 to 190 ms old, 1500 steps; `pip install trifinger-rl-datasets==1.0.3`).
A goal is a pose in the air: any rotation, the middle 56 to 100 mm high, up to 139 mm from the axis. The reward of a
step is the mean over the cube's corners of sech²(15 d), with d [m] the distance of a corner from its place.

The controller is told geometry and dynamics of the robot, mass, width and friction of the cube. It knows one skill: to
hold the cube by three tips (by two, at the border), to carry it along a way and to let go. A search over grasps finds a
way to the goal, over poses in which the cube is laid down, or let fall on another face, and grasped anew.
"""

# The simulator and its packages are no dependency.
# pyright: reportMissingImports=false

from __future__ import annotations

import contextlib
import io
import json
import time
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

STEP = 0.02
"""Of the environment [s]."""
DELAY = 0.002
"""Of the torques [s]."""
HALF = 0.0325
"""Half the width of the cube [m]."""
MASS = 0.094
"""Of the cube [kg]."""
TIP = 0.0125
"""Distance of a tip's frame from a face that it touches [m]."""
HEIGHT, HIP, LINKS, OFFSETS = 0.29, 0.0505, (0.16, 0.16), (0.067, 0.086)
"""Of a finger [m]: height of the first joint; from the middle to the second joint; lengths of the links; distances of
the third joint and of the tip from the plane in which the first joint's axis lies."""
TURNS = (0.0, -2 * np.pi / 3, 2 * np.pi / 3)
"""Of the fingers about the vertical [rad]."""
LOW, HIGH = np.array([-0.33, 0.0, -2.7]), np.array([1.0, 1.57, 0.0])
"""Limits of a finger's joints [rad]."""


# --- rotations ---


def rotation(v: Array) -> Array:
    """Rotations (…, 3, 3) by vectors (…, 3) [rad]."""
    return Rotation.from_rotvec(v.reshape(-1, 3)).as_matrix().reshape(*v.shape, 3)


def rotation_vector(r: Array) -> Array:
    """Vectors (…, 3) [rad] of rotations (…, 3, 3)."""
    return Rotation.from_matrix(r.reshape(-1, 3, 3)).as_rotvec().reshape(r.shape[:-1])


def angle_between(a: Array, b: Array) -> float:
    """Angle between two rotations (3, 3) [rad]."""
    return float(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1)))


def fit(first: Array, second: Array) -> tuple[Array, Array]:
    """Rigid motion (rotation, translation) that brings points (n, 3) next to others."""
    a, b = first.mean(0), second.mean(0)
    u, _, vt = np.linalg.svd((second - b).T @ (first - a))
    r = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return r, b - r @ a


CORNERS = np.array([[[1.0 if bit == "0" else -1.0 for bit in f"{i:03b}"][::-1] for i in range(8)]])[0] * HALF
"""Of the cube in its frame, in the order of the package [m]."""


# --- fingers ---


def inverse(finger: int, tips: Array, offset: float = OFFSETS[1]) -> tuple[Array, Array]:
    """Joint angles (…, 3) [rad] and a point (…, 3) of the third joint's axis for places of a tip (…, 3) [m], or nan.

    `offset` is how far the point is from the plane in which the first joint's axis lies: by default as far as the tip,
    where the lower link ends.
    """
    c, s = np.cos(TURNS[finger]), np.sin(TURNS[finger])
    turn = np.array([[c, -s], [s, c]])
    x, y = np.moveaxis(tips[..., :2] @ turn, -1, 0)
    z = tips[..., 2] - HEIGHT
    with np.errstate(invalid="ignore"):
        down = np.sqrt(x**2 + z**2 - OFFSETS[1] ** 2)
        first = np.arctan2(z, x) + np.arctan2(down, OFFSETS[1])
        out = y - HIP
        third = -np.arccos((out**2 + down**2 - LINKS[0] ** 2 - LINKS[1] ** 2) / (2 * LINKS[0] * LINKS[1]))
        lower = LINKS[1] * np.sin(third)
        second = np.arctan2(out, down) - np.arctan2(lower, LINKS[0] + LINKS[1] * np.cos(third))
    depth = -LINKS[0] * np.cos(second)
    c, s = np.cos(first), np.sin(first)
    knee = np.stack([offset * c - depth * s, HIP + LINKS[0] * np.sin(second), offset * s + depth * c], -1)
    knee[..., 2] += HEIGHT
    knee[..., :2] = knee[..., :2] @ turn.T
    return np.stack([-first, second, third], -1), knee


def static_torques(finger: int, angles: Array, force: Array) -> Array:
    """Torques (…, 3) [N m] with which a finger at rest at joint angles (…, 3) pushes with a force (…, 3) [N]."""
    c, s = np.cos(TURNS[finger]), np.sin(TURNS[finger])
    f = np.concatenate([force[..., :2] @ np.array([[c, -s], [s, c]]), force[..., 2:]], -1)
    q0, q1, q2 = np.moveaxis(angles, -1, 0)
    o = np.zeros_like(q0)
    x = np.stack([np.cos(q0), o, -np.sin(q0)], -1)  # axes of the frame that the first joint turns
    y = np.stack([o, o + 1, o], -1)
    z = np.stack([np.sin(q0), o, np.cos(q0)], -1)
    middle = np.sin(q1)[..., None] * y - np.cos(q1)[..., None] * z  # down the links
    lower = np.sin(q1 + q2)[..., None] * y - np.cos(q1 + q2)[..., None] * z
    second = 0.01685 * x + HIP * y
    knee = OFFSETS[0] * x + HIP * y + LINKS[0] * middle
    tip = knee + (OFFSETS[1] - OFFSETS[0]) * x + LINKS[1] * lower
    weight = np.array([0.0, 0.0, 9.81])
    at = [  # places and forces that the joints carry; links after which joint
        (tip, f, 2),
        (0.006 * x + 0.122 * y, 0.26689 * weight, 0),
        (second + 0.03935 * x + 0.08667 * middle, 0.27163 * weight, 1),
        (knee + 0.01633 * x + 0.04284 * lower, 0.05569 * weight, 2),
        (tip - 0.0156 * lower, 0.0092 * weight, 2),
    ]
    joints = ((y, np.zeros(3)), (x, second), (x, knee))
    return np.stack(
        [
            sum((np.cross(axis, p - origin) * w).sum(-1) for p, w, last in at if j <= last)
            for j, (axis, origin) in enumerate(joints)
        ],
        -1,
    )


class Robot:
    """Kinematics and computed torque of the three fingers, from the package's URDF.

    At the time when a torque begins to act it asks for the acceleration

        a = r̈ + k_p (r − p) + k_d (ṙ − ṗ)

    of each tip, with the gains that put both poles of a double integrator with held input to `pole`. Computed torque
    gives it, τ = M J⁻¹ a + bias + what the damping of the robot's safety layer takes away + Jᵀ f. The term of dJ/dt is
    left out.
    """

    damping = np.array([0.08, 0.08, 0.04] * 3)
    """Of the joints, by the robot's safety layer [N m s/rad]."""
    largest = 0.396
    """Torque [N m]."""
    pole = 0.5
    """Per step, of the error of a tip."""

    def __init__(self) -> None:
        import pinocchio as pin
        import robot_properties_fingers

        urdf = Path(str(robot_properties_fingers.__file__)).parent / "urdf" / "pro" / "trifingerpro.urdf"
        self.pin, self.model = pin, pin.buildModelFromUrdf(str(urdf))
        self.data = self.model.createData()
        self.frames = [self.model.getFrameId(f"finger_tip_link_{a}") for a in (0, 120, 240)]
        self.k_p = (1 - self.pole) ** 2 / STEP**2
        self.k_d = (1 - self.pole**2 + (1 - self.pole) ** 2 / 2) / STEP
        self.sent = np.zeros(9)

    def tips(self, q: Array) -> tuple[Array, Array]:
        """Places (3, 3) of the tips [m] at joint angles (9,), and their Jacobians (3, 3, 9)."""
        pin = self.pin
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        places = np.array([self.data.oMf[i].translation for i in self.frames])
        around = pin.LOCAL_WORLD_ALIGNED
        return places, np.stack([pin.getFrameJacobian(self.model, self.data, i, around)[:3] for i in self.frames])

    def dynamics(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Mass matrix and bias."""
        upper = np.triu(self.pin.crba(self.model, self.data, q))
        return upper + np.triu(upper, 1).T, self.pin.nonLinearEffects(self.model, self.data, q, v)

    def predict(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Joint angles and velocities at the time when the next torque begins to act."""
        return q + DELAY * v, v

    def torque(self, q: Array, v: Array, reference: tuple[Array, Array, Array], force: Array) -> NDArray[np.float32]:
        """Torques (9,) [N m] that lead the tips along a reference (place, velocity, acceleration; (3, 3) each).

        Args:
            q: (9,) measured joint angles [rad].
            v: (9,) measured joint velocities [rad/s].
            reference: for the time when the torque begins to act.
            force: (3, 3) with which the tips push [N].
        """
        q, v = self.predict(q, v)
        places, jacobians = self.tips(q)
        mass, bias = self.dynamics(q, v)
        where, speed, ahead = reference
        a = ahead + self.k_p * (where - places) + self.k_d * (speed - np.einsum("fij,j->fi", jacobians, v))
        # A far reference asks for more [m/s²] than motors have.
        a *= np.minimum(1, 25.0 / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-9))
        wanted, push = np.zeros(9), np.zeros(9)
        for f in range(3):
            joints = slice(3 * f, 3 * f + 3)
            j = jacobians[f][:, joints]
            damping = 1e-4 if abs(np.linalg.det(j)) < 5e-4 else 1e-8
            wanted[joints] = j.T @ np.linalg.solve(j @ j.T + damping * np.eye(3), a[f])
            push[joints] = j.T @ force[f]
        torque = mass @ wanted + bias + self.damping * (v + wanted * STEP / 2) + push
        self.sent = np.clip(torque, -self.largest, self.largest)
        return self.sent.astype(np.float32)


# --- which grasp brings the cube where ---


def grasps(up: Array, sides: Array, heights: tuple[float, ...]) -> tuple[Array, Array]:
    """Ways to hold a cube by three of its side faces, two of them opposite.

    Args:
        up: (3,) axis of the cube that is vertical, in its frame.
        sides: (3,) one of its horizontal axes.
        heights: of the contacts above the middle [m].

    Returns:
        Places (n, 3, 3) of the tips and outward normals (n, 3, 3) of their faces, in the frame of the cube. The second
        face in the order round the cube is that between the two opposite ones.
    """
    around = [sides, np.cross(up, sides), -sides, -np.cross(up, sides)]
    points, normals = [], []
    for first in range(4):
        faces = [around[(first + k) % 4] for k in range(3)]
        for shift in range(3):
            order = [0, 0, 0]
            for k, finger in enumerate((0, 2, 1)):  # counter-clockwise
                order[finger] = (k + shift) % 3
            n = np.array([faces[k] for k in order])
            for height in heights:
                points.append(n * (HALF + TIP) + up * height)
                normals.append(n)
    return np.array(points), np.array(normals)


def pinches(up: Array, side: Array, heights: tuple[float, ...]) -> tuple[Array, Array]:
    """Ways to hold a cube by two opposite side faces, as `grasps`; the normal of the tip that is not used is 0."""
    points, normals = [], []
    for first, second in permutations(range(3), 2):
        for axis in (side, np.cross(up, side)):
            for height in heights:
                n = np.zeros((3, 3))
                n[first], n[second] = axis, -axis
                points.append(n * (HALF + TIP) + up * height)
                normals.append(n)
    return np.array(points), np.array(normals)


def support(r: Array) -> Array:
    """Height (…) of the middle of a cube with rotations (…, 3, 3) that stands on the table [m]."""
    return HALF * np.abs(r[..., 2, :]).sum(-1)


@dataclass
class Way:
    """Of the cube through the air, from one pose to another."""

    p0: Array
    r0: Array
    p1: Array
    r1: Array

    def __post_init__(self) -> None:
        self.turn = rotation_vector(np.swapaxes(self.r0, -1, -2) @ self.r1)

    def at(self, s: Array) -> tuple[Array, Array]:
        """Places (…, m, 3) and rotations (…, m, 3, 3) at parts s (m,) of the way."""
        r = self.r0[..., None, :, :] @ rotation(self.turn[..., None, :] * s[:, None])
        p = self.p0[..., None, :] + (self.p1 - self.p0)[..., None, :] * s[:, None]
        clear = 0.008 * np.clip(np.minimum(12 * s, 12 * (1 - s)), 0, 1)
        p = p.copy()
        p[..., 2] = np.maximum(p[..., 2], support(r) + clear)
        return p, r


PARTS = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])


SQUEEZE = 1.3
"""Least force of the two opposite tips [N]."""
STRONGER = (2.2, 1.9, 1.6)
"""Forces that are tried instead, where the motors have them [N]."""
THIRD = 0.45
"""Of the force of the tip between them, as a part of theirs."""


def squeezing(normals: Array, force: float = SQUEEZE) -> Array:
    """Forces (…, 3, 3) of the tips [N] that press on faces with outward normals (…, 3, 3)."""
    beside = np.abs(np.einsum("...ik,...jk->...ij", normals, normals)).sum(-1) < 1.5
    return -normals * force * np.where(beside, THIRD, 1.0)[..., None]


def margins(points: Array, normals: Array, p: Array, r: Array, squeeze: float = SQUEEZE) -> Array:
    """How far the fingers are from their limits with tips at points (g, 3, 3) of a cube [rad, and 0.5 N m].

    Args:
        points: in the frame of the cube.
        normals: (g, 3, 3) of the faces there, outward.
        p: (…, m, 3) places of the cube.
        r: (…, m, 3, 3) rotations.
        squeeze: force of the opposite tips [N].

    Returns:
        Margins (…, g), the least on the way; below zero where a finger cannot be, or where a link would be in the
        cube or a tip in the table.
    """
    tips = p[..., None, :, None, :] + np.einsum("...mij,...gfj->...gmfi", r, points)
    least, joints = np.full(tips.shape[:-2], np.inf), []
    for f in range(3):
        angles, knee = inverse(f, tips[..., f, :])
        joints.append(angles)
        inside = np.minimum(angles - LOW, HIGH - angles)
        inside[..., 2] = np.minimum(inside[..., 2], -0.3 - angles[..., 2])
        margin = np.where(np.isnan(angles).any(-1), -1.0, inside.min(-1))
        back = np.swapaxes(r, -1, -2)[..., None, :, :, :]
        tip_in, knee_in = (
            np.einsum("...ij,...j->...i", back, at - p[..., None, :, :]) for at in (tips[..., f, :], knee)
        )
        for part, clear in ((0.2, 0.0095), (0.35, 0.0105), (0.5, 0.0145), (0.75, 0.018), (1.0, 0.022)):
            beyond = np.abs(tip_in + part * (knee_in - tip_in)) - HALF
            gap = np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)
            margin = np.where(gap < clear, -1.0, margin)
        margin = np.where(tips[..., f, 2] < 0.012, -1.0, margin)
        idle = (normals[..., f, :] == 0).all(-1)[..., None]
        least = np.minimum(least, np.where(idle, np.inf, np.nan_to_num(margin, nan=-1.0)))
    best = least.min(-1)
    possible = best > 0
    force = np.einsum("...mij,...gfj->...gmfi", r, squeezing(normals, squeeze))[possible]
    force[..., 2] += MASS * 9.81 / 3
    for f in range(3):
        load = np.nan_to_num(np.abs(static_torques(f, joints[f][possible], force[..., f, :]))).max((-1, -2))
        best[possible] = np.minimum(best[possible], 2 * (0.36 - load))
    return best


def flat(r: Array) -> tuple[Array, Array, Array]:
    """The axis of the cube that points up most, a horizontal one, and the rotation made flat."""
    k = int(np.argmax(np.abs(r[2])))
    up = np.eye(3)[k] * np.sign(r[2, k])
    side = np.eye(3)[(k + 1) % 3]
    axis = np.cross(r @ up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    return up, side, rotation(axis / max(sine, 1e-12) * np.arcsin(min(1.0, sine))) @ r


@dataclass
class Plan:
    """A grasp and the way of the cube in it."""

    points: Array
    normals: Array
    way: Way
    final: bool
    margin: float
    cost: float

    def squeeze(self) -> float:
        """Force of the opposite tips that the motors have on all of the way [N]."""
        grasp = self.points[None], self.normals[None], *self.way.at(PARTS)
        return max((force for force in STRONGER if margins(*grasp, force)[0] > 0.05), default=SQUEEZE)


class Planner:
    """Which grasps, one after the other, bring the cube to a goal: it may be laid down and grasped anew.

    Poses between are flat, near the middle, at multiples of 30° of yaw. There the fingers (which are alike, 120° apart)
    and the cube (which is alike from all sides) make all of them the same, so the ways from one are the ways from all.
    """

    margin = 0.08
    """Least distance from the joints' limits [rad]."""
    least = 0.02
    """The same, to fetch the cube from the border."""
    stage = 1.0
    """Price of a grasp."""
    heights = (0.0, 0.008)
    fall = np.radians((36.0, 30.0))
    """From flat, of a cube that is let fall on another face [rad]."""
    fetching = 5.0
    """Price above which the cube is fetched from the border by two tips."""
    between = 2
    """Grasps between the first and the last."""
    residuals = np.radians((0.0, 6.0, 11.0, 16.0, 30.0, 45.0))

    def __init__(self) -> None:
        faces = [np.eye(3)] + [rotation(np.pi / 2 * axis * sign) for axis in np.eye(3)[:2] for sign in (1, -1)]
        faces.append(rotation(np.array([np.pi, 0, 0])))
        yaws = [rotation(np.array([0, 0, np.pi / 6 * k])) for k in range(12)]
        self.flats: Array = np.array([yaw @ face for yaw in yaws for face in faces])
        # Where the cube is let go for each: flat, or tilted from it about one of its edges.
        self.releases = []
        for i, r in enumerate(self.flats):
            k = int(np.argmax(np.abs(r[2])))
            self.releases.append((i, r))
            for axis in (r[:, (k + 1) % 3], r[:, (k + 2) % 3]):
                for fall in self.fall:
                    self.releases += [(i, rotation(fall * axis) @ r), (i, rotation(-fall * axis) @ r)]
        self.index = np.array([i for i, _ in self.releases])
        self.turned = np.array([r for _, r in self.releases])
        self.places = np.zeros((len(self.releases), 3))
        self.places[:, 2] = support(self.turned) + 0.002
        self.next = self.reach(np.array([0, 0, HALF]), np.eye(3))[0]
        """Margins of the ways from the first flat pose."""
        self.led = np.array([self.leads(f) for f in self.flats])
        """Where these ways, turned and the cube's sides renamed, lead to from each."""

    def leads(self, f: Array) -> NDArray[np.intp]:
        """Which flat poses (72,) the ways from the first lead to if they begin at flat pose f."""
        for third in range(3):
            turn = rotation(np.array([0, 0, 2 * np.pi / 3 * third]))
            renamed = turn.T @ f
            if np.abs(np.abs(renamed).max(0) - 1).max() < 1e-6:
                to = turn @ self.flats @ renamed
                return np.einsum("aij,bij->ab", to, self.flats).argmax(1)
        raise AssertionError("yaw is a multiple of 30°")

    def reach(self, p: Array, r: Array) -> tuple[Array, tuple[Array, Array], Array]:
        """Which flat poses one grasp leads to from a flat pose.

        Returns:
            Best margins (72,), the grasps, and the releases and grasps (72, 2) that have them.
        """
        up, side, r = flat(r)
        points, normals = grasps(up, side, self.heights)
        n = len(self.releases)
        way = Way(np.broadcast_to(p, (n, 3)), np.broadcast_to(r, (n, 3, 3)), self.places, self.turned)
        margin = margins(points, normals, *way.at(PARTS))
        tilted = np.abs(self.turned[:, 2, :]).max(-1) < 0.999
        margin = np.where(tilted[:, None] & (margin > self.margin), 0.5 * margin + 0.5 * self.margin, margin)
        best, which = np.full(len(self.flats), -1.0), np.zeros((len(self.flats), 2), int)
        for k in range(n):
            g = int(margin[k].argmax())
            if margin[k, g] > best[self.index[k]]:
                best[self.index[k]], which[self.index[k]] = margin[k, g], (k, g)
        return best, (points, normals), which

    def finals(self, p: Array, r: Array) -> tuple[Array, list[Plan | None]]:
        """Prices of the best grasps from flat poses (t, 3), (t, 3, 3) to the goal or as near as they can, and these."""
        held = [grasps(*flat(f)[:2], self.heights) for f in r]
        points, normals = np.array([h[0] for h in held]), np.array([h[1] for h in held])
        end = np.broadcast_to(self.goal[0], p.shape), np.broadcast_to(self.goal[1], r.shape)
        turn = Way(p, r, *end).turn
        angle = np.linalg.norm(turn, axis=-1)
        cost = np.full(len(p), np.inf)
        choice: list[Plan | None] = [None] * len(p)
        for residual in self.residuals:
            least = self.stage + 15.0 * residual**2
            open_ = np.flatnonzero((angle < 0.6 * np.pi) & (angle >= residual) & (cost > least - 0.15))
            if len(open_) == 0 or (residual > 0.4 and np.isfinite(cost).any()):
                continue
            part = 1 - residual / np.maximum(angle[open_], 1e-9)
            ends = r[open_] @ rotation(turn[open_] * part[:, None])
            margin = margins(points[open_], normals[open_], *Way(p[open_], r[open_], end[0][open_], ends).at(PARTS))
            for k, m, e in zip(open_, margin, ends, strict=True):
                g = int(m.argmax())
                price = least - 0.5 * min(m[g], 0.3)
                if m[g] > self.margin and price < cost[k]:
                    cost[k] = price
                    way = Way(p[k], r[k], self.goal[0], e)
                    choice[k] = Plan(points[k, g], normals[k, g], way, True, float(m[g]), price)
        return cost, choice

    def begin(self, goal: tuple[Array, Array]) -> None:
        """Compute what reaching a goal costs from each flat pose near the middle."""
        self.goal = goal
        cost, _ = self.finals(np.tile([0, 0, HALF], (len(self.flats), 1)), self.flats)
        following = np.where(self.next > self.margin, self.stage - 0.5 * np.minimum(self.next, 0.3), np.inf)
        for _ in range(self.between):  # shortest ways, one more grasp each time
            cost = np.minimum(cost, (following + cost[self.led]).min(1))
        self.cost = cost

    def plan(self, p: Array, r: Array) -> Plan | None:
        """The first grasp of the cheapest sequence found."""
        _, (best,) = self.finals(p[None], flat(r)[2][None])
        if best is not None and best.cost < self.stage + 0.2:
            return best
        margin, (points, normals), which = self.reach(p, r)
        price = np.where(margin > self.margin, self.stage - 0.5 * np.minimum(margin, 0.3), np.inf)
        total = price + self.cost
        i = int(total.argmin())
        if best is not None and best.cost <= total[i]:
            return best
        if not total[i] < self.fetching:
            return self.fetch(p, r)
        k, g = which[i]
        way = Way(p, flat(r)[2], self.places[k], self.turned[k])
        return Plan(points[g], normals[g], way, False, float(margin[i]), float(total[i]))

    def fetch(self, p: Array, r: Array) -> Plan | None:
        """Bring the cube nearer to the middle, held by two tips."""
        up, side, r = flat(r)
        points, normals = pinches(up, side, (0.0, 0.008, 0.016))
        far = np.linalg.norm(p[:2])
        for radius in (0.04, 0.07, 0.1, 0.13):
            if radius < far - 0.01:
                way = Way(p, r, np.array([*p[:2] * radius / far, HALF + 0.003]), r)
                margin = margins(points, normals, *way.at(PARTS))
                g = int(margin.argmax())
                if margin[g] > self.least:
                    return Plan(points[g], normals[g], way, False, float(margin[g]), self.fetching)
        return None


# --- the policy ---


class Follow:
    """Reference of the tips, with bounded speed and acceleration."""

    speed, acceleration = 0.9, 10.0

    def __init__(self, places: Array) -> None:
        self.place, self.velocity = places.copy(), np.zeros_like(places)

    def towards(self, targets: Array, speed: float | None = None) -> tuple[Array, Array, Array]:
        """Step towards targets (3, 3), to arrive at rest; place and velocity before it, and the acceleration."""
        gap = targets - self.place
        distance = np.linalg.norm(gap, axis=1, keepdims=True)
        # The fastest from which it can still stop, in steps.
        half = self.acceleration * STEP / 2
        brake = np.sqrt(half**2 + 2 * self.acceleration * distance) - half
        wanted = gap / np.maximum(distance, 1e-9) * np.minimum(np.minimum(speed or self.speed, brake), distance / STEP)
        change = wanted - self.velocity
        size = np.linalg.norm(change, axis=1, keepdims=True)
        a = change * np.minimum(1, self.acceleration * STEP / np.maximum(size, 1e-9)) / STEP
        before = self.place, self.velocity
        self.place = self.place + STEP * self.velocity + STEP**2 / 2 * a
        self.velocity = self.velocity + STEP * a
        return *before, a


class LiftPolicy:
    """Grasps, moves, lays down and grasps anew until the cube has the goal's pose, and holds it there."""

    away = 0.016
    """From a face, before and after a grasp [m]."""
    high = 0.095
    """Of tips that travel [m]."""
    pace, turning = 0.2, 2.2
    """Of the cube in the air [m/s, rad/s], on average."""
    reaching, pressing, settling = 9, 6, 3
    """Steps from beside the cube to its faces, until the tips press in full, and from a way's end to letting go."""
    patience, latest = 40, 1250
    """Steps until a goal that is missed is tried again, and the last of an episode in which it is."""
    trust = 0.4
    """Part of what a picture says about where on the cube the tips are that is believed at once."""

    def __init__(self, *_: Any) -> None:
        self.robot, self.planner = Robot(), Planner()
        self.reset()

    @staticmethod
    def get_policy_config() -> Any:
        """Return the configuration: observations as dictionaries."""
        from trifinger_rl_datasets import PolicyConfig

        return PolicyConfig(flatten_obs=False, image_obs=False)

    def reset(self) -> None:
        """Forget the episode."""
        self.follow: Follow | None = None
        self.phase, self.since, self.now, self.laid = "look", 0, 0, True
        self.history: list[Array] = []
        self.plan: Plan | None = None
        self.grasps = self.drops = 0
        self.log: list[tuple[int, str]] = []

    def enter(self, phase: str) -> None:
        """Begin a phase."""
        self.phase, self.since = phase, -1  # 0 at its first step
        self.log.append((self.now, phase))

    def get_action(self, observation: Any) -> NDArray[np.float32]:
        """Joint torques (9,) [N m]."""
        robot, camera = observation["robot_observation"], observation["camera_observation"]
        q, v = robot["position"].astype(float), robot["velocity"].astype(float)
        tips, _ = self.robot.tips(q)
        self.history.append(tips)
        age = float(camera["delay"][0])
        fresh = self.now == 0 or age < self.age
        self.age = age
        seen = camera["object_position"].astype(float), Rotation.from_quat(camera["object_orientation"]).as_matrix()
        if self.follow is None:
            self.follow = Follow(tips)
            self.goal = self.read_goal(observation["desired_goal"]["object_keypoints"].astype(float))
            self.planner.begin(self.goal)
        then = self.history[max(0, len(self.history) - 1 - round(age / STEP))]
        reference, force = getattr(self, self.phase)(tips, then, seen, fresh)
        self.now, self.since = self.now + 1, self.since + 1
        return self.robot.torque(q, v, reference, force)

    @staticmethod
    def read_goal(corners: Array) -> tuple[Array, Array]:
        """Place and rotation of the cube from its corners (8, 3)."""
        r, p = fit(CORNERS, corners)
        return p, r

    # Each phase returns the reference of the tips and the forces with which they push.

    def look(self, tips: Array, then: Array, seen: Any, fresh: bool) -> tuple[Any, Array]:
        """Take the tips out and up until a picture shows where the cube rests, and plan."""
        assert self.follow is not None
        p, r = seen
        at_rest = abs(p[2] - HALF) < 0.003 and np.abs(r[2]).max() > 0.997
        taken = self.since - self.age / STEP  # steps since the release
        known = self.now == 0 or (fresh and taken > (2 if self.laid else 10) and (at_rest or self.since > 60))
        if known:
            self.plan = self.planner.plan(p, r)
            if self.plan is not None:
                self.grasps += 1
                self.force = self.plan.squeeze()
                self.pose = p, flat(r)[2]
                self.leg = 0
                self.idle = (self.plan.normals == 0).all(1)
                self.waiting = np.array([*self.follow.place.T[:2], np.full(3, self.high)]).T
                self.enter("travel")
        targets = self.out.copy() if self.now else tips
        if self.since > 4:
            targets[:, 2] = self.high
        return self.follow.towards(targets), np.zeros((3, 3))

    def contact(self, beyond: float = 0.0) -> Array:
        """Places of the tips at the faces of the cube, or beside them."""
        assert self.plan is not None
        p, r = self.pose
        places = p + (self.plan.points + beyond * self.plan.normals) @ r.T
        return np.where(self.idle[:, None], self.waiting, places)

    def travel(self, tips: Array, then: Array, seen: Any, fresh: bool) -> tuple[Any, Array]:
        """Bring the tips over the cube and down beside it."""
        assert self.follow is not None
        beside = self.contact(self.away)
        above = beside.copy()
        above[:, 2] = self.high
        if self.leg == 0:  # up
            targets = self.follow.place.copy()
            targets[:, 2] = np.maximum(targets[:, 2], self.high)
        elif self.leg == 1:
            targets = above
        else:
            targets = beside
        reference = self.follow.towards(targets)
        if np.linalg.norm(self.follow.place - targets, axis=1).max() < (0.015 if self.leg < 2 else 0.003):
            self.leg += 1
            if self.leg == 3:
                self.enter("close")
        return reference, np.zeros((3, 3))

    def close(self, tips: Array, then: Array, seen: Any, fresh: bool) -> tuple[Any, Array]:
        """Press the tips against the cube."""
        assert self.follow is not None
        assert self.plan is not None
        if self.since < self.reaching:
            return self.follow.towards(self.contact(-0.004), 0.2), np.zeros((3, 3))
        part = min(1.0, (self.since - self.reaching + 1) / self.pressing)
        if part < 1:
            self.follow = Follow(tips)
        else:
            (p, r), way = seen, self.plan.way
            self.points = (tips - p) @ r
            self.way = Way(p, r, way.p1, way.r1)
            angle, far = np.linalg.norm(self.way.turn), np.linalg.norm(way.p1 - p)
            self.steps = max(12, int(max(angle / self.turning, far / self.pace) / STEP))
            self.enter("move")
        return self.follow.towards(self.follow.place), part * self.inner(self.pose[1])

    def inner(self, r: Array) -> Array:
        """Forces (3, 3) of the tips that squeeze the cube [N], in the world."""
        assert self.plan is not None
        return squeezing(self.plan.normals, self.force) @ r.T

    def let_go(self, tips: Array, r: Array) -> None:
        """Take the tips off the cube, whose rotation is r."""
        assert self.plan is not None
        self.follow = Follow(tips)
        self.out = tips + 0.03 * self.plan.normals @ r.T
        self.out[:, 2] = np.maximum(self.out[:, 2], 0.02)
        self.laid = np.abs(r[2]).max() > 0.997
        self.enter("look")

    def hold(self, r: Array, up: Array) -> Array:
        """Forces (3, 3) near the squeeze that carry the cube with an acceleration (3,)."""
        assert self.plan is not None
        arms = (self.points - TIP * self.plan.normals) @ r.T
        g = np.concatenate([np.tile(np.eye(3), 3), np.concatenate([np.cross(a, np.eye(3)).T for a in arms], 1)], 0)
        inner = self.inner(r).ravel()
        # what a tip takes is in proportion to the force with which it presses
        share = np.repeat(np.linalg.norm(inner.reshape(3, 3), axis=1), 3) / self.force
        wrench = np.concatenate([MASS * (up + np.array([0, 0, 9.81])), np.zeros(3)])
        scale = np.array([1, 1, 1, 20, 20, 20.0])
        change = share * (np.linalg.pinv(scale[:, None] * g * share) @ (scale * (wrench - g @ inner)))
        return (inner + change).reshape(3, 3)

    def desired(self, step: float) -> tuple[Array, Array, Array]:
        """Pose of the cube at a step of its way, and where the tips are then."""
        t = np.clip(step / self.steps, 0, 1)
        s = t * t * t * (10 - 15 * t + 6 * t * t)
        p, r = self.way.at(np.array([s]))
        return p[0], r[0], p[0] + self.points @ r[0].T

    def move(self, tips: Array, then: Array, seen: Any, fresh: bool) -> tuple[Any, Array]:
        """Carry the cube along its way."""
        assert self.plan is not None
        p, r = seen
        before, here, after = (self.desired(self.since + k) for k in (-1, 0, 1))
        if fresh and self.since > 10:
            points = (then - p) @ r
            self.points += self.trust * (points - self.points)
            there = self.desired(self.since - self.age / STEP)
            if np.linalg.norm(p - there[0]) > 0.035 or there[0][2] - p[2] > 0.025:
                self.drops += 1
                self.let_go(tips, here[1])
            missed = np.linalg.norm(p - here[0]) > 0.015 or angle_between(r, here[1]) > np.radians(14)
            if self.plan.final and missed and self.since > self.steps + self.patience and self.now < self.latest:
                self.let_go(tips, here[1])
        velocity = (after[2] - before[2]) / (2 * STEP)
        acceleration = (after[2] - 2 * here[2] + before[2]) / STEP**2
        if self.since > self.steps + self.settling and not self.plan.final:
            self.let_go(tips, here[1])
        here[2][self.idle] = self.waiting[self.idle]
        velocity[self.idle] = acceleration[self.idle] = 0.0
        return (here[2], velocity, acceleration), self.hold(here[1], acceleration[~self.idle].mean(0))


# --- episodes ---

BATCH = 6
"""Episodes of the package's evaluation between two resets."""


class Timed:
    """A policy with a clock."""

    def __init__(self, policy: LiftPolicy) -> None:
        self.policy = policy
        self.seconds: list[float] = []

    def reset(self) -> None:
        """Begin an episode."""
        self.policy.reset()
        self.seconds = []

    def get_action(self, observation: Any) -> NDArray[np.float32]:
        """Compute the action and time it."""
        start = time.thread_time()
        action = self.policy.get_action(observation)
        self.seconds.append(time.thread_time() - start)
        return action


@dataclass
class Options:
    """The cube of trifinger-rl-datasets, lifted and posed."""

    episodes: int = 6
    """Episodes."""
    seed: int = 0
    """Of the first six: the package begins anew after six, and so does the seed, with the next number."""
    json: bool = False
    """Print the figures as JSON."""
    out: Path | None = None
    """Where episodes are recorded, a line of JSON each; a seed with all its episodes in it is not played again."""


def play(env: Any, policy: Timed, seed: int, episodes: int, out: Path | None) -> list[dict[str, Any]]:
    """Play up to six episodes of the authors' evaluation."""
    from trifinger_rl_datasets import Evaluation
    from trifinger_simulation.tasks import move_cube

    rows: list[dict[str, Any]] = []

    class Recorded(Evaluation):
        def run_episode(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
            result = super().run_episode(*args, **kwargs)
            rows.append(
                {
                    "seed": seed,
                    "episode": len(rows),
                    **{k: float(v) for k, v in result.items()},
                    "grasps": policy.policy.grasps,
                    "drops": policy.policy.drops,
                    "milliseconds_per_step": 1e3 * float(np.mean(policy.seconds)),
                    "milliseconds_longest": 1e3 * max(policy.seconds),
                }
            )
            if out is not None:
                with out.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
            return result

    np.random.seed(seed)  # noqa: NPY002 (from there the package draws the cube's places)
    move_cube.seed(seed)  # the goals
    with contextlib.redirect_stdout(io.StringIO()):
        Recorded(env).evaluate(policy, episodes)
    return rows


def interval(successes: int, n: int) -> tuple[float, float]:
    """Wilson's interval of 95 % of a rate."""
    z, p = 1.959964, successes / n
    middle, width = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return (middle - width) / (1 + z * z / n), (middle + width) / (1 + z * z / n)


def main(o: Options) -> None:
    """Play, print, record."""
    try:
        import gymnasium
        import trifinger_rl_datasets  # noqa: F401 (it registers the environment)
    except ImportError as error:
        raise SystemExit(
            f"trifinger_lift needs the simulator, which could not be imported ({error}); "
            "pip install trifinger-rl-datasets==1.0.3"
        ) from error
    environment = "trifinger-cube-lift-sim-expert-v0"
    env: Any = gymnasium.make(
        environment, disable_env_checker=True, visualization=False, flatten_obs=False, image_obs=False
    ).unwrapped
    lines = o.out.read_text().splitlines() if o.out is not None and o.out.exists() else []
    known = {(row["seed"], row["episode"]): row for row in map(json.loads, lines)}
    policy, rows = Timed(LiftPolicy()), []
    for batch in range(-(-o.episodes // BATCH)):
        seed, n = o.seed + batch, min(BATCH, o.episodes - BATCH * batch)
        played = [known[seed, i] for i in range(n) if (seed, i) in known]
        if len(played) < n:
            played = play(env, policy, seed, n, o.out)
        rows += played
        if not o.json:
            for row in played:
                print(
                    f"seed {seed}, episode {row['episode']}: return {row['return']:.0f}, "
                    f"{'success' if row['success_rate'] else 'failure'}, {row['grasps']} grasps, {row['drops']} drops",
                    flush=True,
                )
    returns = np.array([row["return"] for row in rows])
    half = 1.96 * returns.std(ddof=min(1, len(rows) - 1)) / len(rows) ** 0.5
    successes = int(sum(row["success_rate"] for row in rows))
    figures = {
        "episodes": len(rows),
        "mean_return": float(returns.mean()),
        "return_low": float(returns.mean() - half),
        "return_high": float(returns.mean() + half),
        "median_return": float(np.median(returns)),
        "success_rate": successes / len(rows),
        "success_low": interval(successes, len(rows))[0],
        "success_high": interval(successes, len(rows))[1],
        "share_of_steps_at_goal": float(np.mean([row["mean_momentary_success"] for row in rows])),
        "grasps": float(np.mean([row["grasps"] for row in rows])),
        "drops": int(sum(row["drops"] for row in rows)),
        "milliseconds_per_step": float(np.mean([row["milliseconds_per_step"] for row in rows])),
        "milliseconds_longest": float(np.max([row["milliseconds_longest"] for row in rows])),
    }
    if o.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:24s} {value:.4g}")


if __name__ == "__main__":
    main(tyro.cli(Options))
