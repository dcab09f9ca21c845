"""Push-T learned from two minutes of random pushing: `python examples/learn_push.py --seed 0`.

The disc is sent to random places near the body, 1200 steps of 0.1 s. Nothing is asked of the pushing: no goal, no
reward, no demonstration. A `ContactLCS` that begins with a wrong centre of mass, inertia, friction, compliance and
outline is fitted to the transitions by the violation loss. `--shape 4` learns one of the shapes of gym-pushany.
"""

import time
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from push_t import _CENTER, PIXELS, from_origin, make_env, tee_pushing
from torch import Tensor

from difflcs import violation_loss
from difflcs.physics import ContactLCS, PlanarPushing, Polygon, Union

LEARNED = ("center_of_mass", "gyration", "friction", "compliance", "outline")
RATE, XI, KEPT = 0.03, 0.1, 0.8
EPISODE = 100
HOLD = 6
ROUND = 6


class Transitions(NamedTuple):
    """States (n, 7), actions (n, 2) and next states (n, 7), in the units of `tee_pushing`."""

    x: Tensor
    u: Tensor
    x_next: Tensor


def random_pushing(env: Any, center: NDArray[np.float64], steps: int, seed: int, reach: float = 90.0) -> Transitions:
    """Collect pushes: the disc goes to random places within `reach` px of the body's middle, at most 30 px ahead."""
    rng = np.random.default_rng([seed, 1])
    x, u, x_next = [], [], []
    for step in range(steps):
        if step % EPISODE == 0:
            _, info = env.reset(seed=1_000_000 + 1000 * seed + step)
        if step % HOLD == 0:
            place = from_origin(info["block_pose"], center)[:2] * PIXELS + rng.uniform(-reach, reach, 2)
        way = place - info["pos_agent"]
        target = np.clip(info["pos_agent"] + way * min(1.0, 30.0 / np.linalg.norm(way)), 0.0, 512.0)
        x.append(state(info, center))
        u.append((target - info["pos_agent"]) / PIXELS)
        *_, info = env.step(target)
        x_next.append(state(info, center))
    return Transitions(*(torch.from_numpy(np.array(rows)) for rows in (x, u, x_next)))


def state(info: dict[str, NDArray[np.float64]], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the state (7,) from the environment's information."""
    pose = from_origin(info["block_pose"], center)
    return np.concatenate([pose, info["pos_agent"] / PIXELS, info["vel_agent"] / PIXELS])


def guess(true: PlanarPushing, seed: int) -> ContactLCS:
    """Make the start of learning: everything that is learned is wrong.

    The centre of mass is 20 px off in a random direction, the radius of gyration a third too large, friction 0.3 where
    there is none, the compliance five times what we use, and every side of the outline is moved by up to 6 px, but
    where parts join: there one reaches 10 px into the other, so that they stay one body. A round part has one size.
    """
    rng = np.random.default_rng([seed, 3])
    angle = rng.uniform(0, 2 * np.pi)
    center = torch.as_tensor(true.center_of_mass) + 0.2 * torch.tensor([np.cos(angle), np.sin(angle)])
    physics = true.replace(
        center_of_mass=center,
        gyration=torch.as_tensor(true.gyration) * 4 / 3,
        friction=torch.tensor([0.3]).double(),
        compliance=0.1,
    )
    model = ContactLCS(physics, learn=("outline",))
    with torch.no_grad():
        outline = model.change["outline"]
        outline += 0.06 * torch.from_numpy(rng.uniform(-1, 1, len(outline)))[together(true)]
        outline[joined(true)] = 0.1
    return ContactLCS(frozen(model.physics), learn=LEARNED)


def touches(shape: Union, part: int, points: Tensor) -> Tensor:
    """Return a mask (...) of points (..., 2) of a part that lie at or in another one."""
    others = [other.distance(points).distance.amin(-1) for i, other in enumerate(shape.parts) if i != part]
    return torch.stack([*others, torch.ones(points.shape[:-1]).double()]).amin(0) <= 1e-6


def joined(physics: PlanarPushing) -> Tensor:
    """Return a mask of the sides that lie at or in another part from corner to corner: no disc ever touches them."""
    assert isinstance(physics.shape, Union)
    inside = []
    for i, part in enumerate(physics.shape.parts):
        assert isinstance(part, Polygon)
        ends = part.vertices
        points = torch.stack([ends, (ends + ends.roll(-1, 0)) / 2, ends.roll(-1, 0)])
        inside.append(touches(physics.shape, i, points).all(0))
    return torch.cat(inside)


def together(physics: PlanarPushing) -> Tensor:
    """Return the index of the side that each side moves with: itself, in a round part of many sides the first."""
    assert isinstance(physics.shape, Union)
    counts = [len(part.vertices) for part in physics.shape.parts if isinstance(part, Polygon)]
    first = np.cumsum([0, *counts])
    return torch.cat([torch.arange(n) * (n <= ROUND) + int(k) for n, k in zip(counts, first, strict=False)])


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
        corners: how far each corner is from where it is [px], without those that touch another part.
        loss: of the transitions that count.
        seconds: CPU time of learning.
    """

    physics: PlanarPushing
    values: tuple[dict[str, Any], dict[str, Any]]
    corners: tuple[list[float], list[float]]
    loss: tuple[float, float]
    seconds: float


def trimmed(model: ContactLCS | PlanarPushing, data: Transitions) -> Tensor:
    """Compute the mean violation loss without the largest fifth: body at a wall, disc inside it at the start."""
    each = violation_loss(model, *data, gamma="auto", xi=XI, reduction="none")
    return each.sort().values[: int(KEPT * len(each))].mean()


def fit(model: ContactLCS, data: Transitions, fixed: Tensor, iterations: int) -> None:
    """Fit by Adam on all data at each step; its rate falls to zero along a cosine. Some sides stay where they are."""
    groups = together(model.guess)
    optimizer = torch.optim.Adam(model.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    for _ in range(iterations):
        optimizer.zero_grad()
        trimmed(model, data).backward()
        outline = model.change["outline"].grad
        assert outline is not None
        outline.copy_(torch.zeros_like(outline).index_add(0, groups, outline)[groups])
        outline[fixed] = 0.0
        optimizer.step()
        schedule.step()


def learn(
    env: Any,
    seed: int,
    steps: int = 1200,
    iterations: int = 300,
    *,
    true: PlanarPushing | None = None,
    center: NDArray[np.float64] | None = None,
    reach: float = 90.0,
) -> Learned:
    """Learn a system from wrong values by random pushing.

    Args:
        env: gym-pusht's environment, or `push_any.StateEnv`.
        seed: of the pushing and of the wrong values.
        steps: of pushing.
        iterations: of the fit.
        true: the system as it is, from which the wrong values begin; `tee_pushing()` by default.
        center: (2,) centre of its area, from the origin whose pose is observed; None: that of the T.
        reach: how far from it the disc pushes, along both axes [px].
    """
    true = tee_pushing() if true is None else true
    data = random_pushing(env, _CENTER.numpy() if center is None else center, steps, seed, reach)
    start = time.process_time()
    model, fixed = guess(true, seed), joined(true)
    before, first = model.summary(), frozen(model.physics)
    fit(model, data, fixed, iterations)
    physics, after = frozen(model.physics), model.summary()
    smooth = ContactLCS(physics.replace(friction=0.0), learn=[name for name in LEARNED if name != "friction"])
    fit(smooth, data, fixed, iterations // 3)
    with torch.no_grad():
        loss = (float(trimmed(first, data)), float(trimmed(physics, data)))
        if float(trimmed(smooth, data)) <= 1.02 * loss[1]:
            physics, after = frozen(smooth.physics), {**smooth.summary(), "friction": [0.0]}
    spent = time.process_time() - start
    return Learned(physics, (before, after), (corners(first, true), corners(physics, true)), loss, spent)


def corners(physics: PlanarPushing, true: PlanarPushing) -> list[float]:
    """Compute each corner's distance to its true place [px], without those that touch another part."""
    apart = []
    assert isinstance(physics.shape, Union)
    assert isinstance(true.shape, Union)
    for i, (learned, part) in enumerate(zip(physics.shape.parts, true.shape.parts, strict=True)):
        assert isinstance(learned, Polygon)
        assert isinstance(part, Polygon)
        outside = ~touches(true.shape, i, part.vertices)
        apart.append(PIXELS * (learned.vertices - part.vertices)[outside].norm(dim=1))
    return torch.cat(apart).tolist()


def main(seed: int = 0, shape: str | None = None) -> None:
    """Learn from random pushing, and print.

    Args:
        seed: of the pushing and of the wrong values.
        shape: of gym-pushany; None: the T of gym-pusht.
    """
    torch.set_num_threads(1)
    if shape is None:
        true, result = tee_pushing(), learn(make_env(), seed)
    else:
        from push_any import StateEnv, pushing

        env = StateEnv(object_name=shape, use_obstacles=False)
        env.reset(seed=0)
        true, center = pushing(env.block)
        result = learn(env, seed, true=true, center=center, reach=120.0)
    print(f"{result.seconds:.1f} s of CPU time to learn from two minutes of random pushing")
    print(f"violation loss {result.loss[0]:.2e} before, {result.loss[1]:.2e} after")
    right = {name: torch.as_tensor(getattr(true, name)).tolist() for name in ("center_of_mass", "gyration", "friction")}
    for name in ("center_of_mass", "gyration", "friction", "compliance"):
        before, after = (values[name] for values in result.values)
        print(f"{name}: {before} before, {after} after, true {right.get(name, '—')}")
    for when, apart in zip(("before", "after"), result.corners, strict=True):
        print(f"corners off by {', '.join(f'{v:.1f}' for v in apart)} px {when}")


if __name__ == "__main__":
    tyro.cli(main)
