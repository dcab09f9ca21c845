"""Push-T learned from two minutes of random pushing, from wrong initial values: `python benchmarks/scoreboard/learn_pusht.py`.

The disc is sent to random places near the T of gym-pusht, 1200 steps of 0.1 s. Nothing is asked of the pushing: no
goal, no reward, no demonstration. A `ContactLCS` that begins with a wrong centre of mass, inertia, friction, compliance
and outline is fitted to the transitions by the violation loss.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs import violation_loss
from difflcs.physics import ContactLCS, Polygon, Union
from difflcs.planning.pusht import GYRATION, PIXELS, from_origin, tee_pushing

LEARNED = ("center_of_mass", "gyration", "friction", "compliance", "outline")
EPISODE = 100
HOLD = 6


class Transitions(NamedTuple):
    """States (n, 7), actions (n, 2) and next states (n, 7), in the units of `tee_pushing`."""

    x: Tensor
    u: Tensor
    x_next: Tensor


def random_pushing(env: Any, steps: int, seed: int) -> Transitions:
    """The disc heads for random places within 90 px of the T's middle, at most 30 px ahead, each for some steps."""
    rng = np.random.default_rng([seed, 1])
    x, u, x_next = [], [], []
    for step in range(steps):
        if step % EPISODE == 0:
            _, info = env.reset(seed=1_000_000 + 1000 * seed + step)
        if step % HOLD == 0:
            place = from_origin(info["block_pose"])[:2] * PIXELS + rng.uniform(-90, 90, 2)
        way = place - info["pos_agent"]
        target = np.clip(info["pos_agent"] + way * min(1.0, 30.0 / np.linalg.norm(way)), 0.0, 512.0)
        x.append(state(info))
        u.append((target - info["pos_agent"]) / PIXELS)
        *_, info = env.step(target)
        x_next.append(state(info))
    return Transitions(*(torch.from_numpy(np.array(rows)) for rows in (x, u, x_next)))


def state(info: dict[str, np.ndarray]) -> np.ndarray:
    """The state (7,) from what the environment tells beside its observation."""
    return np.concatenate([from_origin(info["block_pose"]), info["pos_agent"] / PIXELS, info["vel_agent"] / PIXELS])


def guess(seed: int) -> ContactLCS:
    """Where learning begins: everything that is learned is wrong.

    The centre of mass is 20 px off, the radius of gyration a third too large, friction 0.3 in place of 0, the
    compliance five times as large, and every side of the outline is moved by up to 6 px.
    """
    rng = np.random.default_rng([seed, 3])
    angle = rng.uniform(0, 2 * np.pi)
    center = np.array(tee_pushing().center_of_mass) + 0.2 * np.array([np.cos(angle), np.sin(angle)])
    physics = tee_pushing(
        center_of_mass=tuple(center), gyration=GYRATION * 4 / 3, friction=torch.tensor([0.3]).double(), compliance=0.1
    )
    model = ContactLCS(physics, learn=("outline",))
    with torch.no_grad():
        outline = model.change["outline"]
        outline += 0.06 * torch.from_numpy(rng.uniform(-1, 1, len(outline)))
        moved = [Polygon(part.vertices) for part in model.physics.shape.parts]
    return ContactLCS(physics.replace(shape=Union(tuple(moved))), learn=LEARNED)


class Learned(NamedTuple):
    """What was learned.

    Attributes:
        model: the system.
        before, after: what was learned, as numbers; lengths in units of 100 px.
        losses: mean violation loss before and after.
        seconds: CPU time of learning.
    """

    model: ContactLCS
    before: dict[str, Any]
    after: dict[str, Any]
    losses: tuple[float, float]
    seconds: float


def fit(model: ContactLCS, data: Transitions, iterations: int, rate: float, xi: float) -> list[float]:
    """Adam on the violation loss, with all data at each step; the rate falls to zero along a cosine."""
    optimizer = torch.optim.Adam(model.parameters(), rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    losses = []
    for _ in range(iterations):
        optimizer.zero_grad()
        loss = violation_loss(model, *data, gamma="auto", xi=xi)
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(float(loss))
    return losses
