"""Push-T learned from two minutes of random pushing: `python benchmarks/scoreboard/learn_pusht.py --seed 0`.

The disc is sent to random places near the T of gym-pusht, 1200 steps of 0.1 s. Nothing is asked of the pushing: no
goal, no reward, no demonstration. A `ContactLCS` that begins with a wrong centre of mass, inertia, friction, compliance
and outline is fitted to the transitions by the violation loss.
"""

import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs import violation_loss
from difflcs.physics import ContactLCS, PlanarPushing, Polygon, Union

sys.path.append(str(Path(__file__).resolve().parents[2] / "examples"))
from push_t import CENTER_OF_MASS, GYRATION, PIXELS, from_origin, make_env, tee, tee_pushing

LEARNED = ("center_of_mass", "gyration", "friction", "compliance", "outline")
RATE, XI, KEPT = 0.03, 0.1, 0.8
EPISODE = 100
HOLD = 6


class Transitions(NamedTuple):
    """States (n, 7), actions (n, 2) and next states (n, 7), in the units of `tee_pushing`."""

    x: Tensor
    u: Tensor
    x_next: Tensor


def random_pushing(env: Any, steps: int, seed: int) -> Transitions:
    """Collect pushes: the disc goes to random places within 90 px of the T's middle, at most 30 px ahead."""
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
    """Compute the state (7,) from the environment's information."""
    return np.concatenate([from_origin(info["block_pose"]), info["pos_agent"] / PIXELS, info["vel_agent"] / PIXELS])


def guess(seed: int) -> ContactLCS:
    """Make the start of learning: everything that is learned is wrong.

    The centre of mass is 20 px off in a random direction, the radius of gyration a third too large, friction 0.3 where
    there is none, the compliance five times what we use, and every side of the outline is moved by up to 6 px.
    """
    rng = np.random.default_rng([seed, 3])
    angle = rng.uniform(0, 2 * np.pi)
    center = np.array(CENTER_OF_MASS) + 0.2 * np.array([np.cos(angle), np.sin(angle)])
    physics = tee_pushing(
        center_of_mass=center.tolist(), gyration=GYRATION * 4 / 3, friction=torch.tensor([0.3]).double(), compliance=0.1
    )
    model = ContactLCS(physics, learn=("outline",))
    with torch.no_grad():
        outline = model.change["outline"]
        outline += 0.06 * torch.from_numpy(rng.uniform(-1, 1, len(outline)))
    return ContactLCS(frozen(model.physics), learn=LEARNED)


def frozen(physics: PlanarPushing) -> PlanarPushing:
    """Copy the physics without learnable parameters."""
    assert isinstance(physics.shape, Union)
    parts = [Polygon(part.vertices.detach()) for part in physics.shape.parts if isinstance(part, Polygon)]
    names = ["center_of_mass", "gyration", "compliance"] + ([] if physics.frictionless else ["friction"])
    values = {name: torch.as_tensor(getattr(physics, name)).detach() for name in names}
    return physics.replace(shape=Union(tuple(parts)), **values)


class Learned(NamedTuple):
    """Result of learning; pairs are before and after, lengths in units of 100 px.

    Attributes:
        physics: the system; without friction if without it the loss is at most 2 % larger.
        values: of each parameter.
        corners: how far each corner is from where it is [px].
        loss: of the transitions that count.
        seconds: CPU time of learning.
    """

    physics: PlanarPushing
    values: tuple[dict[str, Any], dict[str, Any]]
    corners: tuple[list[float], list[float]]
    loss: tuple[float, float]
    seconds: float


def trimmed(model: ContactLCS | PlanarPushing, data: Transitions) -> Tensor:
    """Compute the mean violation loss without the largest fifth: T at a wall, disc inside the T at the start."""
    each = violation_loss(model, *data, gamma="auto", xi=XI, reduction="none")
    return each.sort().values[: int(KEPT * len(each))].mean()


def fit(model: ContactLCS, data: Transitions, iterations: int) -> None:
    """Fit by Adam on all data at each step; its rate falls to zero along a cosine."""
    optimizer = torch.optim.Adam(model.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    for _ in range(iterations):
        optimizer.zero_grad()
        trimmed(model, data).backward()
        optimizer.step()
        schedule.step()


def learn(env: Any, seed: int, steps: int = 1200, iterations: int = 300) -> Learned:
    """Learn a system from wrong values by random pushing."""
    data = random_pushing(env, steps, seed)
    start = time.process_time()
    model = guess(seed)
    before, first = model.summary(), frozen(model.physics)
    fit(model, data, iterations)
    physics, after = frozen(model.physics), model.summary()
    smooth = ContactLCS(physics.replace(friction=0.0), learn=[name for name in LEARNED if name != "friction"])
    fit(smooth, data, iterations // 3)
    with torch.no_grad():
        loss = (float(trimmed(first, data)), float(trimmed(physics, data)))
        if float(trimmed(smooth, data)) <= 1.02 * loss[1]:
            physics, after = frozen(smooth.physics), {**smooth.summary(), "friction": [0.0]}
    spent = time.process_time() - start
    return Learned(physics, (before, after), (corners(first), corners(physics)), loss, spent)


def corners(physics: PlanarPushing) -> list[float]:
    """Compute each corner's distance to its true place [px], without the two inside the bar, which nothing touches."""
    learned, true = (
        torch.cat([part.vertices for part in shape.parts if isinstance(part, Polygon)])
        for shape in (physics.shape, tee())
        if isinstance(shape, Union)
    )
    outside = [0, 1, 2, 3, 6, 7]
    return (PIXELS * (learned - true)[outside]).norm(dim=1).tolist()


def main(seed: int = 0) -> None:
    """Learn Push-T from random pushing, and print.

    Args:
        seed: of the pushing and of the wrong values.
    """
    torch.set_num_threads(1)
    result = learn(make_env(), seed)
    print(f"{result.seconds:.1f} s of CPU time to learn from two minutes of random pushing")
    print(f"violation loss {result.loss[0]:.2e} before, {result.loss[1]:.2e} after")
    true = {"center_of_mass": list(CENTER_OF_MASS), "gyration": GYRATION, "friction": [0.0]}
    for name in ("center_of_mass", "gyration", "friction", "compliance"):
        before, after = (values[name] for values in result.values)
        print(f"{name}: {before} before, {after} after, true {true.get(name, '—')}")
    for when, apart in zip(("before", "after"), result.corners, strict=True):
        print(f"corners off by {', '.join(f'{v:.1f}' for v in apart)} px {when}")


if __name__ == "__main__":
    tyro.cli(main)
