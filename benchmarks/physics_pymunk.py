"""Bodies pushed by a disc in pymunk, beside `difflcs.physics.PlanarPushing`: cases for benchmarks/physics.py.

The T of Push-T: two boxes, a kinematic disc led by a PD controller in ten substeps of 0.01 s, and no friction with the
ground: a quasi-static body is one whose velocity pymunk damps away in every substep. Lengths in the plane are in units
of 0.1 m, as in Push-T 100 pixels are.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from difflcs.physics import Inertia, PlanarPushing, Polygon

sys.path.append(str(Path(__file__).resolve().parents[1] / "examples"))
from push_t import DRIVE, RADIUS, tee

Array = NDArray[np.float64]

MASS = 1.0
COORDINATES = {"position": ([0, 1], "mm", 0.01), "yaw": ([2], "rad", 1.0)}
CORNERS = ((-0.6, 0.0), (0.6, 0.0), (0.6, 0.3), (0.15, 0.3), (0.15, 1.2), (-0.15, 1.2), (-0.15, 0.3), (-0.6, 0.3))


def outline() -> Polygon:
    """Make the T as one outline, which has one contact with a disc."""
    whole = Polygon(CORNERS)
    return Polygon(whole.vertices - whole.centroid)


class Simulation:
    """The T and the disc in pymunk.

    Args:
        friction: of each shape; pymunk multiplies them.
        decay: part of a velocity that is left after a second.
    """

    def __init__(self, friction: float, decay: float):
        import pymunk

        shape = tee()
        self.space = pymunk.Space()
        self.space.damping = decay
        self.disc = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.body = pymunk.Body(MASS, MASS * float(shape.gyration) ** 2)
        shapes = [pymunk.Circle(self.disc, RADIUS)]
        shapes += [pymunk.Poly(self.body, part.vertices.tolist()) for part in shape.parts]
        for each in shapes:
            each.friction = friction
        self.space.add(self.disc, self.body, *shapes)
        # By default bodies overlap by 0.1 unit at rest, which is made for pixels.
        self.space.collision_slop = 0.0

    def step(self, x: Array, u: Array) -> Array:
        """Advance 0.1 s from a state of `PlanarPushing` with velocities of disc and body."""
        self.body.position, self.body.angle = x[:2].tolist(), float(x[2])
        self.disc.position, self.disc.velocity = x[3:5].tolist(), x[5:7].tolist()
        self.body.velocity, self.body.angular_velocity = x[7:9].tolist(), float(x[9])
        self.space.reindex_shapes_for_body(self.body)
        target = x[3:5] + u
        for _ in range(DRIVE.substeps):
            place, speed = np.array(self.disc.position), np.array(self.disc.velocity)
            pull = DRIVE.stiffness * (target - place) - DRIVE.damping * speed
            self.disc.velocity = (speed + pull * DRIVE.substep).tolist()
            self.space.step(DRIVE.substep)
        moved = [*self.body.position, self.body.angle, *self.disc.position, *self.disc.velocity]
        return np.array([*moved, *self.body.velocity, self.body.angular_velocity])


def pushes(count: int, random: np.random.Generator) -> tuple[Array, Array]:
    """Draw states with the disc beside the T, at rest, and pushes towards it."""
    shape, pairs = tee(), []
    while len(pairs) < count:
        pose = random.uniform(-1, 1, 3) * [0.5, 0.5, math.pi]
        place = random.uniform(-1.2, 1.2, 2)
        gap, normal, _ = (v.numpy() for v in shape.distance(torch.from_numpy(place)))
        near = int(gap.argmin())
        if not RADIUS < gap[near] < RADIUS + 0.1:
            continue
        turn = np.array([[math.cos(pose[2]), -math.sin(pose[2])], [math.sin(pose[2]), math.cos(pose[2])]])
        towards = math.atan2(*(turn @ -normal[near])[::-1]) + random.uniform(-0.5, 0.5)
        u = random.uniform(0.2, 0.5) * np.array([math.cos(towards), math.sin(towards)])
        pairs.append((np.concatenate([pose, turn @ place + pose[:2], np.zeros(5)]), u))
    x, u = zip(*pairs, strict=True)
    return np.array(x), np.array(u)


def cases(count: int, random: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Make the fields of the cases: without friction, with it, and with a velocity that stays."""
    x, u = pushes(count, random)
    system: dict[str, Any] = {"shape": tee(), "radius": RADIUS, "drive": DRIVE, "compliance": 1e-3}
    stewart = {"cone": "stewart-trinkle"}
    gliding = Inertia(MASS, 0.1, -math.log(0.2))
    for name, mu, decay, mode, options in (
        ("T and disc, no friction", 0.0, 0.0, "quasi-static", {}),
        ("T and disc, friction 0.5", 0.5, 0.0, "quasi-static", {}),
        ("T and disc, friction 0.5", 0.5, 0.0, "quasi-static, one outline", {"shape": outline()}),
        ("T and disc, friction 0.5", 0.5, 0.0, "the same, Stewart-Trinkle", stewart | {"shape": outline()}),
        ("T and disc, friction 0.5", 0.5, 0.0, "quasi-static, Stewart-Trinkle", stewart),
        ("T that glides, and disc", 0.0, 0.2, "velocities", {"inertia": gliding}),
    ):
        simulation = Simulation(math.sqrt(mu), decay)
        planar = PlanarPushing(**(system | {"friction": mu} | options))
        after = np.array([simulation.step(*pair) for pair in zip(x, u, strict=True)])
        speed = {"velocity": ([7, 8], "mm/s", 0.01)} if planar.n_x == 10 else {}
        state, ended = (torch.from_numpy(v[:, : planar.n_x]) for v in (x, after))
        yield {
            "system": name, "mode": mode, "params": planar.params, "x": state, "u": torch.from_numpy(u),
            "after": ended, "coordinates": COORDINATES | speed,
        }  # fmt: skip
