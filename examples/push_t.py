"""Push-T (gym-pusht) by sampling-based contact MPC: `python examples/push_t.py --out push_t.gif` makes a film of it.

`python examples/push_t.py --export DIR` writes what its program in C, `examples/c/push_t.c`, needs, and episodes to
compare both.

A disc of radius 15 px pushes a T, made of two boxes of 30 by 120 and 30 by 90 px, to a pose on a plane of 512 px. An
action is the target of the disc's PD controller, for ten substeps of 0.01 s. The disc is kinematic: nothing pushes it
back. Velocities are damped away in each substep, so the T moves only while it is pushed. Friction between disc and T is
zero: what the environment sets is an attribute that pymunk does not read. Lengths here are in units of 100 px.

With `--adapt` it finds the scale of the outline, friction and the stiffness of the drive while it pushes, as with
`--scale 0.8`, where it is told a wrong outline.
"""

from __future__ import annotations

import csv
import itertools
import math
import time
import warnings
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from context_filter import ContextFilter
from disc_contact import DiscContact
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from difflcs import Animation, GoalCost, LCSMPCLayer
from difflcs.errors import MissingDependencyError
from difflcs.mpc.export import export_controller
from difflcs.physics import PDDrive, PlanarPushing, Polygon, Union, box
from difflcs.physics.complementarity import Contacts
from difflcs.physics.shapes import Shape
from difflcs.planning import (
    Decision,
    DiscPlaces,
    Mode,
    Obstacles,
    PlanarTravel,
    SamplingPolicy,
    SamplingSettings,
    Workspace,
)

if TYPE_CHECKING:
    from PIL import Image

Array = NDArray[np.float64]

PIXELS = 100.0
"""Pixels in a unit of length."""
RADIUS = 0.15
"""Radius of the disc."""
_BOXES = (box(-0.6, 0.6, 0.0, 0.3), box(-0.15, 0.15, 0.3, 1.2))
_CENTER = Union(_BOXES).centroid
CENTER_OF_MASS = (0.0, 0.45 - float(_CENTER[1]))
"""Centre of mass of the T from the centre of its area: the environment takes the mean of the centres of its boxes."""
GOAL = (256.0, 256.0, math.pi / 4)
"""Pose of the T's origin [px, px, rad]."""
GYRATION = math.sqrt(3000.0) / PIXELS
"""Radius of gyration as in the environment: twice the moment of the bar about the T's origin, with a mass of 1."""
DRIVE = PDDrive(stiffness=100.0, damping=20.0, substep=0.01, substeps=10)
SIDE = 5.12
"""Side of the square that actions are in."""
STEPS = 300
"""Limit of an episode, in steps of 0.1 s."""
GREEN, GREY, BLUE = (0, 158, 115), (150, 150, 150), (0, 114, 178)
"""Colours of a film: places from which a push would gain, those from which it would not, and the plan."""


def tee(scale: float = 1.0) -> Union:
    """Make the T in coordinates about the centre of its area, scaled about it by `scale`."""
    return Union(tuple(Polygon(scale * (part.vertices - _CENTER)) for part in _BOXES))


def scaled(shape: Shape, scale: float) -> Union:
    """Scale a union of polygons about its origin."""
    assert isinstance(shape, Union)
    return Union(tuple(Polygon(scale * part.vertices) for part in shape.parts if isinstance(part, Polygon)))


def tee_pushing(**changes: Any) -> PlanarPushing:
    """Make the system: state (x, y of the centre of the T's area, its yaw, x, y of the disc, its velocity).

    Args:
        changes: other values of fields of `PlanarPushing`.
    """
    defaults: dict[str, Any] = {
        "shape": tee(),
        "radius": RADIUS,
        "drive": DRIVE,
        "center_of_mass": CENTER_OF_MASS,
        "gyration": GYRATION,
        "friction": 0.0,
        "compliance": 0.02,
        "length": 1.0,
    }
    return PlanarPushing(**(defaults | changes))


def make_env(**options: Any) -> Any:
    """Make the environment as its authors publish it, with obs_type="state".

    Args:
        options: for `gymnasium.make`.

    Raises:
        MissingDependencyError: gym-pusht is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pygame, about pkg_resources
            import gym_pusht  # noqa: F401
            import gymnasium
    except ImportError as error:
        raise MissingDependencyError(
            f'expected the package gym-pusht, not installed ({error}); run: pip install "difflcs[scoreboard]"'
        ) from error
    return gymnasium.make("gym_pusht/PushT-v0", obs_type="state", max_episode_steps=STEPS, **options)


class Rigid(PlanarPushing):
    """Planar pushing without overlap: a disc inside the outline counts as touching it.

    If the outline is too large, a disc that touches nothing seems to be inside, and a plan would wait until it is
    pushed out. Without overlap the disc moves on until the body moves.
    """

    def contacts(self, x: Tensor) -> Contacts:
        """See `PlanarPushing`."""
        contacts = super().contacts(x)
        return contacts._replace(gap=contacts.gap.clamp_min(0.0))

    @classmethod
    def of(cls, system: PlanarPushing) -> Rigid:
        """Make a rigid copy of a system."""
        return cls(**{field.name: getattr(system, field.name) for field in fields(system)})


SCALES = np.exp(0.025 * np.arange(-12, 13))
"""Scales of the told outline that `DiscPolicy(adapt=True)` compares: from 0.74 to 1.35."""
FRICTIONS = (0.0, 0.2, 0.5)
"""Frictions between disc and body, likewise."""
STIFFNESSES = SCALES**2
"""Stiffnesses of the drive, as multiples of what was told."""
SPREAD, RELATIVE, MOST, HOPELESS = 0.01, 0.05, 8.0, 10.0
"""Settings of its filters: predictions are off by 1 px and 5 % of the motion; no step counts for more than 8 nats, and
what is 10 nats behind is given up."""
SURE = 3.0
"""Log-likelihood ratio with which another hypothesis replaces that of the plan."""


class DiscPolicy:
    """Sampling-based contact MPC for a disc that pushes a body on the square: an observation to the disc's target.

    The velocity of the disc, which the observation lacks, comes from the drive, as the past actions are known.

    Args:
        system: the system of the MPC, with state and action as in `tee_pushing`; its shape is about the centre of its
            area.
        center: (2,) this centre, from the origin whose pose is observed.
        goal: (3,) of the origin [px, px, rad].
        delay: steps by which actions come late. The plan begins at the state that the system predicts for then.
        turns: turns of the body about its centre that cover it, which all mean the same.
        beyond: how far the disc may go beyond the square [length].
        obstacles: what is in the way of the disc and of the body, if anything.
        adapt: find the scale of the outline, friction and the stiffness of the drive from the motion seen, anew in each
            episode.

    Attributes:
        sampling: the policy inside, with its `decision`.
        adapts: as `adapt` says.
        found: scale of the outline, friction, and factor of the stiffness, with which it plans.
    """

    def __init__(
        self,
        system: PlanarPushing,
        center: ArrayLike,
        goal: ArrayLike = GOAL,
        *,
        delay: int = 0,
        turns: int = 1,
        beyond: float = 0.0,
        obstacles: Obstacles | None = None,
        adapt: bool = False,
    ):
        self.low, self.high = -beyond, SIDE + beyond
        self.told, self.delay, self._period = system, delay, 2 * math.pi / turns
        self.center, self.goal = np.asarray(center), goal
        self.adapts, self.obstacles = adapt, obstacles
        self._contact = DiscContact(system)
        hypotheses = np.array(list(itertools.product(SCALES, FRICTIONS)))
        self._bodies = ContextFilter(
            self._contact, hypotheses, SPREAD, relative=RELATIVE, most=MOST, hopeless=HOPELESS, angles=(2,)
        )
        assert isinstance(system.drive, PDDrive)
        self._drives = [replace(system.drive, stiffness=factor * system.drive.stiffness) for factor in STIFFNESSES]
        steps = [drive.step() for drive in self._drives]
        self._A, self._b = (torch.stack(values).numpy() for values in zip(*[(s.A, s.b) for s in steps], strict=True))
        every = np.arange(len(STIFFNESSES))[:, None]
        self._motions = ContextFilter(
            self._predict_disc, every, SPREAD, relative=RELATIVE, most=MOST, hopeless=HOPELESS
        )
        friction = float(torch.as_tensor(system.friction).reshape(-1)[0])
        self._told = int(np.abs(hypotheses - [1.0, friction]).sum(-1).argmin()), len(STIFFNESSES) // 2
        self._policies: dict[tuple[int, int], tuple[Rigid, SamplingPolicy]] = {}
        self.reset()

    def _use(self, body: int, drive: int) -> None:
        """Plan with one of the hypotheses of each filter."""
        self._hypothesis = body, drive
        scale, friction = self._bodies.contexts[body].tolist()
        self.found = scale, friction, float(STIFFNESSES[drive])
        self._contact.drive = self._drives[drive]
        if self._hypothesis not in self._policies:
            system = self.told
            if self._hypothesis != self._told:
                system = system.replace(
                    shape=scaled(system.shape, scale),
                    friction=torch.tensor(friction, dtype=torch.float64) if friction else 0.0,
                    drive=self._drives[drive],
                )
            self._policies[self._hypothesis] = self._plan(Rigid.of(system))
        self.system, self.sampling = self._policies[self._hypothesis]
        self.sampling.reset()

    def _plan(self, system: Rigid) -> tuple[Rigid, SamplingPolicy]:
        """Make the policy for a system."""
        shape = system.shape
        workspace, obstacles = Workspace((self.low, self.low), (self.high, self.high), step=1.2), self.obstacles
        cost = GoalCost.reach(7, 2, goal_weight=(1.0, 1.0, 0.3), goal_weight_final=(4.0, 4.0, 1.2), input_weight=0.01)
        return system, SamplingPolicy(
            LCSMPCLayer(system, cost, 6, relaxation=1e-5, on_failure="mask"),
            DiscPlaces(shape, RADIUS, 32, gap=0.02, reach=0.2, workspace=workspace, margin=0.02, obstacles=obstacles),
            PlanarTravel(
                shape,
                RADIUS,
                SIDE,
                drive=system.drive,
                clearance=0.08,
                tolerance=0.12,
                workspace=workspace,
                obstacles=obstacles,
            ),
            SamplingSettings(keep=0.6, smallest_gain=0.02, switch_price=0.02, travel_price=0.04),
            bounds=workspace.bounds,
            angles=(2,),
            constraints=None if obstacles is None else obstacles.constraints,
        )

    def reset(self) -> None:
        """Start an episode."""
        self._bodies.reset()
        self._motions.reset()
        self._use(*self._told)
        self._velocities = np.zeros((len(STIFFNESSES), 2))  # of the disc, by each drive
        self._before: tuple[Array, Array, Array] | None = None
        self._under_way: deque[Array] = deque()

    def act(self, observation: ArrayLike) -> Array:
        """Compute an action.

        Args:
            observation: (5,) x, y of the disc, x, y [px] and angle [rad] of the body's origin.

        Returns:
            (2,) the target of the disc [px].
        """
        seen = np.asarray(observation, np.float64)
        disc = seen[:2] / PIXELS
        place = np.concatenate([from_origin(seen[2:], self.center), disc])
        if self.adapts:
            self._adapt(place)
        state = np.concatenate([place, self._velocities[self._hypothesis[1]]])
        if self.delay and not self._under_way:
            self._under_way.extend([disc] * self.delay)
        for target in self._under_way:
            state = self._predict(state, target)
        goal = from_origin(self.goal, self.center)
        goal[2] += self._period * np.round((state[2] - goal[2]) / self._period)
        goal = self._aim(state, goal)
        target = np.clip(state[3:5] + self.sampling.act(state, goal), self.low, self.high)
        self._under_way.append(target)
        sent = self._under_way.popleft() - disc
        self._before = place, self._velocities, sent
        self._velocities = self._velocities * self._A[:, 1, 1:] + self._b[:, 1:] * sent
        return target * PIXELS

    def _aim(self, state: Array, goal: Array) -> Array:
        """Choose the pose (3,) that the body is pushed to now, on its way to the goal (3,)."""
        return goal

    def _predict_disc(self, place: Array, sent: Array, drives: NDArray[Any]) -> Array:
        """Predict the place of the disc (n, 2) by some drives (n, 1), with the velocity that each of them gave it."""
        assert self._before is not None
        each = drives[:, 0]
        return place + self._A[each, 0, 1:] * self._before[1][each] + self._b[each, :1] * sent

    def _adapt(self, place: Array) -> None:
        """Learn from the last step, and plan with other hypotheses where they explain the motion clearly better."""
        if self._before is None:
            return
        before, velocities, sent = self._before
        self._motions.update(before[3:], sent, place[3:])
        body, drive = self._hypothesis
        if float(self._motions.log_likelihood[drive]) < -SURE:
            drive = self._motions.best
            self._contact.drive = self._drives[drive]
        self._bodies.update(np.concatenate([before, velocities[drive]]), sent, place[:3])
        if float(self._bodies.log_likelihood[body]) < -SURE:
            body = self._bodies.best
        if (body, drive) != self._hypothesis:
            self._use(body, drive)

    def _predict(self, state: Array, target: Array) -> Array:
        """Predict the state one step later."""
        with torch.no_grad():
            x, u = torch.from_numpy(state), torch.from_numpy(target - state[3:5])
            return self.system.params(x).step(x, u).x_next.numpy()


class PushTPolicy(DiscPolicy):
    """The policy for gym-pusht: its observation of obs_type="state" to its action.

        policy = PushTPolicy()
        observation, _ = env.reset(seed=0)
        policy.reset()
        ...
        observation, *_ = env.step(policy.act(observation))

    Args:
        system: see `DiscPolicy`; `tee_pushing()` by default.
        delay: likewise.
        adapt: likewise.
    """

    def __init__(self, system: PlanarPushing | None = None, delay: int = 0, *, adapt: bool = False):
        super().__init__(tee_pushing() if system is None else system, _CENTER, delay=delay, adapt=adapt)


def from_origin(pose: ArrayLike, center: ArrayLike = _CENTER) -> Array:
    """Convert the pose (3,) of the body's origin in pixels to that of the centre of its area in units of length."""
    x, y, yaw = np.asarray(pose, np.float64)
    cos, sin = math.cos(yaw), math.sin(yaw)
    cx, cy = np.asarray(center).tolist()
    return np.array([x / PIXELS + cos * cx - sin * cy, y / PIXELS + sin * cx + cos * cy, yaw])


def picture(env: Any, policy: DiscPolicy, text: str = "", size: int = 340) -> Image.Image:
    """The environment as it draws itself, and on top what the policy decided last.

    Places where the disc could be are dots, the greener the more a push from there would gain; that to which it
    travels has a ring. Where it pushes, the planned path of the disc is a line.

    Args:
        env: of `make_env(render_mode="rgb_array")`.
        policy: after `act`.
        text: to write into the upper left corner.
        size: width and height [px].
    """
    from PIL import Image, ImageDraw

    frame = Image.fromarray(env.render()).resize((size, size), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(frame)
    decision = policy.sampling.decision
    if decision is not None:
        _draw(draw, decision, size)
    draw.text((6, 4), text, fill=(20, 20, 30), font_size=max(10, size // 24))
    return frame


def _draw(draw: Any, decision: Decision, size: int) -> None:
    scale, line = size / (SIDE * PIXELS), size / 340

    def dot(point: Tensor, radius: float, **colors: Any) -> None:
        x, y = (scale * PIXELS * point).tolist()
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), **colors)

    scores = decision.scores[1:]
    best = max(float(scores.max()), 1e-12)
    # Dots move with the T while the disc travels.
    for place, score in zip(decision.states[1:, 3:5], scores.tolist(), strict=True):
        share = min(max(score / best, 0.0), 1.0) ** 2
        color = tuple(round(share * a + (1 - share) * b) for a, b in zip(GREEN, GREY, strict=True))
        dot(place, line * (1.5 + 2.0 * share), fill=color)
    if decision.mode is Mode.TRAVEL and decision.target is not None:
        dot(decision.target[3:5], 7.0 * line, outline=BLUE, width=round(2 * line))
    else:
        path = (scale * PIXELS * decision.solution.x[0, :, 3:5]).tolist()
        draw.line([tuple(point) for point in path], fill=BLUE, width=round(2 * line))


def export(directory: Path) -> None:
    """Write the policy for `examples/c/push_t.c`: its MPC as a controller, and numbers by their names.

    Args:
        directory: for `controller.difflcs`, `controller.json` and `push_t.txt`, made if needed.
    """
    policy = PushTPolicy()
    system: Any = policy.system
    sampling: Any = policy.sampling
    mpc, places, travel, settings = sampling.mpc, sampling.places, sampling.travel, sampling.settings
    still = system.params(torch.zeros(system.n_x, dtype=torch.float64))
    step, course = travel.workspace.step, system.drive.course()
    layer = LCSMPCLayer(still, mpc.cost, mpc.horizon, -step, step, relaxation=mpc.relaxation)
    export_controller(layer, directory, step_seconds=0.1)
    values = {
        "pixels": PIXELS,
        "goal": policy.goal,
        "center": policy.center,
        "outline": [part.corners.tolist() for part in system.shape.parts],
        "center_of_mass": system.center_of_mass,
        "gyration": system.gyration,
        "compliance": system.compliance,
        "radius": RADIUS,
        "workspace": (policy.low, policy.high, step),
        "weights": [0.5 * np.diag(constant) for constant in (mpc.cost.goal_stage, mpc.cost.goal_final)],
        **{field.name: getattr(settings, field.name) for field in fields(settings)},
        "reach": places.reach,
        "margin": places.margin,
        **{name: getattr(travel, name) for name in ("step", "clearance", "tolerance")},
        "A": course.A,
        "b": course.b,
        "places": places.ring,
        "waypoints": travel.ring,
        "grid": travel.grid.axis[-1],
    }
    lines = (" ".join([name, *map(repr, np.ravel(value).tolist())]) for name, value in values.items())
    (directory / "push_t.txt").write_text("\n".join(lines) + "\n")


class Episode(NamedTuple):
    """One episode.

    Attributes:
        success: the environment's flag.
        steps: until success or the limit.
        coverage: largest part of the goal that the T has covered.
        milliseconds: CPU time of the policy, of all steps.
    """

    success: bool
    steps: int
    coverage: float
    milliseconds: float


def play(
    env: Any,
    policy: DiscPolicy,
    seed: int,
    limit: int = STEPS,
    *,
    noise: float = 0.0,
    delay: int = 0,
    friction: float = 0.0,
) -> Episode:
    """Play one episode of a seed.

    Args:
        env: of `make_env`, or another with such observations, actions and information.
        policy: whose CPU time is measured.
        seed: of the episode, and of the noise.
        limit: steps after which it ends.
        noise: standard deviation of every observed coordinate [px].
        delay: steps by which the actions come late.
        friction: of disc and body in the environment, which has none.
    """
    random = np.random.default_rng([seed, 2])
    spread = noise * np.array([1.0, 1.0, 1.0, 1.0, 1.0 / (GYRATION * PIXELS)])
    observation, _ = env.reset(seed=seed)
    if friction:
        for shape in env.unwrapped.agent.shapes | env.unwrapped.block.shapes:
            shape.friction = friction**0.5  # pymunk multiplies both
    policy.reset()
    late = [observation[:2].copy()] * delay
    times, best, success = [], 0.0, False
    for _ in range(limit):
        seen = observation + spread * random.standard_normal(5)
        start = time.process_time()
        late.append(policy.act(seen))
        times.append(1e3 * (time.process_time() - start))
        observation, _, success, truncated, info = env.step(late.pop(0))
        best = max(best, float(info["coverage"]))
        if success or truncated:
            break
    return Episode(bool(success), len(times), best, sum(times))


class Simulated:
    """The policy's own system in place of the environment, for episodes of 25 steps; gym-pusht need not be there."""

    def __init__(self) -> None:
        self.system = tee_pushing()
        self._x = torch.zeros(self.system.n_x, dtype=torch.float64)
        self._left = 0

    def reset(self, seed: int) -> tuple[list[float], dict[str, Any]]:
        """Start an episode."""
        place = np.random.default_rng(seed).uniform([1.5, 1.5, -3.0, 0.5, 0.5], [3.6, 3.6, 3.0, 4.6, 4.6])
        self._x[:5], self._x[5:], self._left = torch.from_numpy(place), 0.0, 25
        return self._observe(), {}

    def step(self, action: Array) -> tuple[list[float], float, bool, bool, dict[str, Any]]:
        """Move the disc to a target [px]."""
        u = torch.from_numpy(action) / PIXELS - self._x[3:5]
        self._x, self._left = self.system.params(self._x).step(self._x, u).x_next, self._left - 1
        return self._observe(), 0.0, False, not self._left, {}

    def close(self) -> None:
        """Do nothing."""

    def _observe(self) -> list[float]:
        x, y, yaw, *disc = self._x[:5].tolist()
        dx, dy, _ = from_origin([0.0, 0.0, yaw])
        return [PIXELS * disc[0], PIXELS * disc[1], PIXELS * (x - dx), PIXELS * (y - dy), yaw]


def record(directory: Path, seeds: Iterable[int], env: Any) -> float:
    """Play episodes, and write what the policy saw and decided, as `examples/c/push_t.c` reads and prints it.

    Args:
        directory: for `observations.csv` and `actions.csv`.
        seeds: of the episodes.
        env: of `make_env`, or `Simulated`.

    Returns:
        CPU time of a step [ms], on average.
    """
    policy, seconds = PushTPolicy(), 0.0
    seen, decided = [], []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        policy.reset()
        ended = False
        while not ended:
            began = time.process_time()
            action = policy.act(observation)
            seconds += time.process_time() - began
            decision = policy.sampling.decision
            assert decision is not None
            seen.append((seed, *observation))
            decided.append((str(decision.mode), decision.chosen, *action))
            observation, _, success, truncated, _ = env.step(action)
            ended = success or truncated
    env.close()
    for name, header, rows in (
        ("observations.csv", ("episode", "disc x", "disc y", "x", "y", "angle"), seen),
        ("actions.csv", ("mode", "place", "x", "y"), decided),
    ):
        with (directory / name).open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([header, *rows])
    return 1e3 * seconds / len(seen)


@dataclass
class Options:
    """A film of Push-T, or its export."""

    out: Path = Path("push_t.gif")
    """Where the GIF goes."""
    seed: int = 0
    """Of the first episode; the next have the next."""
    episodes: int = 4
    """How many are played, one after another."""
    scale: float = 1.0
    """Of the outline that the policy is told."""
    adapt: bool = False
    """Find scale, friction and drive while it runs, anew in each episode."""
    export: Path | None = None
    """Folder for the export to C, and the episodes, instead of a film."""
    simulated: bool = False
    """Export episodes of the policy's own system, without gym-pusht."""


def main(o: Options) -> None:
    """Play, and write the film at ten frames a second: real time. Or export."""
    if o.export is not None:
        torch.set_num_threads(1)
        export(o.export)
        env = Simulated() if o.simulated else make_env()
        milliseconds = record(o.export, range(o.seed, o.seed + o.episodes), env)
        print(f"{o.episodes} episodes, {milliseconds:.2f} ms a step in Python")
        return
    system = tee_pushing(shape=tee(o.scale))
    env, policy, frames = make_env(render_mode="rgb_array"), PushTPolicy(system, adapt=o.adapt), []
    for seed in range(o.seed, o.seed + o.episodes):
        observation, info = env.reset(seed=seed)
        policy.reset()
        success = ended = False
        while not (success or ended):
            action = policy.act(observation)
            decision = policy.sampling.decision
            assert decision is not None
            frames.append(picture(env, policy, str(decision.mode)))
            observation, _, success, ended, info = env.step(action)
        verdict = f"{'solved' if success else 'not solved'}, {100 * info['coverage']:.0f} % covered"
        frames += [picture(env, policy, verdict)] * 6
        print(f"seed {seed}: {verdict}")
    env.close()
    Animation(frames, fps=10).save(o.out)
    print(f"written: {o.out}")


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Options))
