"""Every shape of gym-pushany by sampling-based contact MPC: `python examples/push_any.py --episodes 50`.

The environment (gym-pushany 0.1.13, after Push-T) is as its author publishes it: 21 shapes, its own starts, goals and
success flag (more than 95 % of the goal covered), 300 steps of 0.1 s, and up to four other bodies in the way. Only its
pictures are not drawn. The policy is that of Push-T with the outline, mass and moment of the body, the goal, the true
state, and the outlines and poses of what is in the way: obstacles for the disc and for plans. A body is pushed along a
path of poses round them. They can be pushed, too: where there is no path, or no push that helps, they are ignored for a
while.

Walls stop the body, not the disc, which is kinematic: it may go `--beyond` them, to push a body away from a wall.

The environment's seed draws the goal and how many bodies are in the way: those seeds are played that draw
`--obstacles`. It may draw a goal that lies across its walls. These are played, and count like others. Where no pose
inside the walls covers more than 95 % of the goal, it is out of reach; the success without these is printed beside
(`within_reach`, and the number of goals that are).
"""

from __future__ import annotations

import itertools
import json
import math
import warnings
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import shapely
import torch
import tyro
from body_paths import BodyPaths
from learn_push import learn
from numpy.typing import NDArray
from push_t import PIXELS, RADIUS, SIDE, STEPS, DiscPolicy, Episode, Rigid, play, tee_pushing
from shapely import affinity
from successes import success_figures, success_text
from torch import Tensor

from difflcs import LCSMPCLayer, Status
from difflcs.errors import InvalidInputError, MissingDependencyError
from difflcs.mpc import MPCSolution
from difflcs.mpc.backends import BatchedBackend
from difflcs.physics import PlanarPushing, Polygon, Union
from difflcs.planning import Mode, Obstacles, SamplingPolicy

try:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pygame, about pkg_resources
        from gym_pushany.envs.pushany_env import (  # pyright: ignore[reportMissingImports]
            OBJECT_NAME_LIST,
            PushAnyEnv,
        )
except ImportError as error:
    raise MissingDependencyError(
        f"expected the package gym-pushany, not installed ({error}); run: pip install gym-pushany==0.1.13"
    ) from error

Array = NDArray[np.float64]

QUICK = BatchedBackend(restarts=1, max_iter=100)
"""Solver of plans near obstacles: with their constraints, more starts and steps take longer than they are worth."""
LOW, HIGH = 7, 504  # sides of the square inside the walls [px]
ALIKE = 0.99  # part of the area that a turn must cover for a pose to count as the same
MOVED = 5  # px, from which on a body in the way counts as displaced


class StateEnv(PushAnyEnv):
    """The environment with a state as its observation: place of the disc and pose of the body, as gym-pusht has it."""

    def get_obs(self) -> Array:
        """Return x, y of the disc, x, y and angle of the body's origin (5,) [px, rad]."""
        return np.array([*self.agent.position, *self.block.position, self.block.angle])

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode; the seed is that of the goal and of the start."""
        self.seed(seed)
        self.obstacles = []
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """Take a step; the information has the coverage."""
        observation, _, success, truncated, info = super().step(action)
        return observation, 0.0, success, truncated, {**info, "coverage": self._calculate_coverage()}

    @property
    def others(self) -> Array:
        """(n, 2) places of the bodies in the way [px]."""
        return np.array([body.position for body in self.obstacles]).reshape(-1, 2)

    def settled(self, seed: int) -> Array:
        """Return the places (n, 2) of the bodies in the way after three seconds in which the disc stays where it is.

        Bodies that overlap at the start are pushed apart.
        """
        self.reset(seed=seed)
        for _ in range(30):
            self.step(np.array(self.agent.position))
        return self.others

    @property
    def within_reach(self) -> bool:
        """True if a body at some pose inside the walls would cover enough of the goal."""
        x, y, angle = self.goal_pose
        body = shapely.unary_union([shapely.Polygon(shape.get_vertices()) for shape in self.block.shapes])

        def at(angle: float, x: float, y: float) -> Any:
            return affinity.translate(affinity.rotate(body, angle, origin=(0, 0), use_radians=True), x, y)

        goal = at(angle, x, y)
        for turn in np.linspace(-0.3, 0.3, 121):
            pose = at(angle + turn, x, y)
            low_x, low_y, high_x, high_y = pose.bounds  # moved inside by the shortest way
            back = (max(LOW - low_x, 0) + min(HIGH - high_x, 0), max(LOW - low_y, 0) + min(HIGH - high_y, 0))
            if affinity.translate(pose, *back).intersection(goal).area > self.success_threshold * goal.area:
                return True
        return False


def pushing(body: Any) -> tuple[PlanarPushing, Array]:
    """Make the system of a body of pymunk, about the centre of its area, and the place of this centre [length]."""
    parts = [np.array(shape.get_vertices()) / PIXELS for shape in body.shapes]
    center = Union(tuple(Polygon(torch.from_numpy(part)) for part in parts)).centroid
    shape = Union(tuple(Polygon(torch.from_numpy(part) - center) for part in parts))
    mass = torch.tensor(tuple(body.center_of_gravity), dtype=torch.float64) / PIXELS - center
    gyration = (body.moment / body.mass) ** 0.5 / PIXELS
    return tee_pushing(shape=shape, center_of_mass=mass, gyration=gyration, nearest=2), center.numpy()


def count_turns(body: Any, center: Array) -> int:
    """Count the turns of a body of pymunk about a centre [length] that cover it."""
    whole = shapely.unary_union([shapely.Polygon(shape.get_vertices()) for shape in body.shapes])

    def covered(n: int) -> float:
        turned = affinity.rotate(whole, 360 / n, origin=tuple(PIXELS * center))
        return turned.intersection(whole).area / whole.area

    return max(n for n in range(1, 13) if covered(n) > ALIKE)


def outline(body: Any) -> Union:
    """Make the shape of a body of pymunk in its own coordinates."""
    return Union(tuple(Polygon(torch.tensor(shape.get_vertices()) / PIXELS) for shape in body.shapes))


class Hasty(LCSMPCLayer):
    """An MPC that is content with unfinished plans where there are constraints: they were executed, and so count."""

    def forward(self, x0: Tensor, *args: Any, **options: Any) -> MPCSolution:
        """See `LCSMPCLayer`."""
        if options.get("constraints") is None:
            return super().forward(x0, *args, **options)
        thorough, self.backend = self.backend, QUICK
        solution = super().forward(x0, *args, **options)
        self.backend = thorough
        status = solution.status.masked_fill(solution.status == Status.MAX_ITER, Status.CONVERGED)
        return replace(solution, status=status, of=solution.problem)


class PushAnyPolicy(DiscPolicy):
    """The policy for a shape of the environment, which it asks for the goal and for what is in the way.

    Args:
        env: the environment.
        beyond: how far the disc may go beyond the square [px].
        learned: plan with the system that two minutes of random pushing teach, instead of the true one.
        blind: do not tell it what is in the way.
    """

    MARGIN, PRICE = 0.05, 100.0
    """Between what is in the way and the body or the disc, in plans; and what a lack of it costs."""
    ROOM = 0.06
    """Between the body and what is in the way, on a path."""
    BLOCKED, PATIENCE, IGNORED = 8, 45, 20
    """Pushes in succession without a gain, or steps in which the body comes no nearer, after which obstacles are
    ignored for so many steps."""

    def __init__(self, env: StateEnv, beyond: float = 0.0, *, learned: bool = False, blind: bool = False):
        self.env, self._blind = env, blind
        env.reset(seed=0)
        system, center = pushing(env.block)
        if learned:
            alone = StateEnv(object_name=env.object_name, use_obstacles=False)
            system = learn(alone, 0, true=system, center=center, reach=120.0).physics
        assert isinstance(system.shape, Union)
        self._corners = torch.cat([part.vertices for part in system.shape.parts if isinstance(part, Polygon)])
        self._paths = BodyPaths(self._gap, SIDE, self.ROOM)
        super().__init__(
            system,
            center,
            turns=count_turns(env.block, center),
            beyond=beyond / PIXELS,
            obstacles=Obstacles(system.shape, RADIUS, margin=self.MARGIN, price=self.PRICE),
        )

    def _plan(self, system: Rigid) -> tuple[Rigid, SamplingPolicy]:
        """See `DiscPolicy`."""
        system, policy = super()._plan(system)
        mpc = policy.mpc
        policy.mpc = Hasty(system, mpc.cost, mpc.horizon, relaxation=mpc.relaxation, on_failure="mask")
        return system, policy

    def reset(self) -> None:
        """Start an episode."""
        super().reset()
        self.goal = self.env.goal_pose
        self._shapes = [] if self._blind else [outline(body) for body in self.env.obstacles]
        self._blocked = self._ignored = self._since = self._times = 0
        self._best, self._around = math.inf, None

    def act(self, observation: Any) -> Array:
        """See `DiscPolicy`."""
        bodies = self.env.obstacles if self._shapes and not self._ignored else []
        poses = [[body.position.x / PIXELS, body.position.y / PIXELS, body.angle] for body in bodies]
        assert self.obstacles is not None
        shapes = self._shapes if bodies else []
        self.obstacles.place(shapes, torch.tensor(poses, dtype=torch.float64).reshape(-1, 3))
        return super().act(observation)

    def _aim(self, state: Array, goal: Array) -> Array:
        """See `DiscPolicy`: the next pose on a path round what is in the way."""
        if not self._shapes:
            return goal
        self._watch(state, goal)
        assert self.obstacles is not None
        if not self.obstacles.shapes:
            return goal
        around = torch.cat([torch.from_numpy(np.stack([state[:3], goal])), self.obstacles.poses])
        if self._around is None or bool((around - self._around).abs().max() > 1e-3):
            self._around, self._found = around, self._paths.subgoal(around[0], around[1], self.obstacles.poses)
        return goal if self._found is None else self._found.numpy()

    def _watch(self, state: Array, goal: Array) -> None:
        """Ignore what is in the way for some steps where no push gains anything, or the body comes no nearer."""
        decision, settings = self.sampling.decision, self.sampling.settings
        blocked = decision is not None and decision.mode is Mode.PUSH and not decision.gain > settings.smallest_gain
        self._blocked = self._blocked + 1 if blocked else 0
        error = float(np.linalg.norm((state[:3] - goal) * [1.0, 1.0, 0.5]))
        self._since += 1
        if error < self._best - 0.02:
            self._best, self._since = error, 0
        self._ignored = max(0, self._ignored - 1)
        if not self._ignored and (self._blocked > self.BLOCKED or self._since > self.PATIENCE):
            self._times += 1
            self._ignored, self._blocked, self._since, self._best = self.IGNORED * self._times, 0, 0, math.inf

    def _gap(self, poses: Tensor) -> Tensor:
        """Compute the gap (...) between the body at poses (..., 3) and what is in the way, walls too."""
        assert self.obstacles is not None
        cos, sin = poses[..., 2, None].cos(), poses[..., 2, None].sin()
        x, y = self._corners.unbind(-1)
        corners = torch.cat([poses[..., :1] + cos * x - sin * y, poses[..., 1:2] + sin * x + cos * y], -1)
        walls = torch.minimum(corners - LOW / PIXELS, HIGH / PIXELS - corners).amin(-1)
        return torch.minimum(self.obstacles.body_gap(poses), walls)


@dataclass
class Options:
    """Shapes of gym-pushany by sampling-based contact MPC."""

    episodes: int = 50
    """Episodes of each shape."""
    seed: int = 0
    """The first seed that may be played."""
    obstacles: int = 0
    """Bodies in the way, 0 to 4."""
    beyond: float = 40.0
    """How far the disc may go beyond the square of 512 px [px]."""
    learned: bool = False
    """Plan with what two minutes of random pushing teach about each shape."""
    blind: bool = False
    """Do not tell the policy what is in the way."""
    json: bool = False
    """Print a line of JSON of all shapes together."""
    smoke: bool = False
    """Two shapes, an episode of a few steps each."""


def find_seeds(o: Options) -> list[int]:
    """Find the seeds that draw this number of bodies in the way."""
    drawn = (s for s in itertools.count(o.seed) if np.random.RandomState(s).randint(0, 5) == o.obstacles)
    return list(itertools.islice(drawn, o.episodes))


class Played(NamedTuple):
    """An episode, whether its goal is within reach, and how far (n,) the bodies in the way were displaced [px]."""

    episode: Episode
    within_reach: bool
    displaced: Array


def figures(played: list[Played]) -> dict[str, Any]:
    """Compute the figures of episodes."""
    success, steps, _, milliseconds = np.array([one.episode for one in played], float).T
    reached = [one.episode.success for one in played if one.within_reach]
    displaced = np.concatenate([one.displaced for one in played])
    return {
        **success_figures(success),
        "mean_steps": float(steps.mean()),
        "milliseconds_per_step": float(milliseconds.sum() / steps.sum()),
        "within_reach": float(np.mean(reached)) if reached else None,
        "goals_within_reach": len(reached),
        "mean_displaced": float(displaced.mean()) if len(displaced) else 0.0,
        "displaced": float((displaced > MOVED).mean()) if len(displaced) else 0.0,
    }


def main(o: Options) -> None:
    """Run the episodes, print the figures of each shape and of all."""
    if not 0 <= o.obstacles <= 4:
        raise InvalidInputError(f"obstacles: expected 0 to 4, got {o.obstacles}")
    names = OBJECT_NAME_LIST
    if o.smoke:
        names, o.episodes = names[:2], 1
    torch.set_num_threads(1)
    everything: list[Played] = []
    for name in names:
        env = StateEnv(object_name=name)
        policy, limit = PushAnyPolicy(env, o.beyond, learned=o.learned, blind=o.blind), 5 if o.smoke else STEPS
        played: list[Played] = []
        for seed in find_seeds(o):
            settled = env.settled(seed)  # what moves because bodies overlap at the start is not displaced
            episode = play(env, policy, seed, limit)
            played.append(Played(episode, env.within_reach, np.linalg.norm(env.others - settled, axis=1)))
        everything += played
        if not o.json:
            report(name, figures(played))
    if o.json:
        print(json.dumps({"obstacles": o.obstacles, **figures(everything)}))
    else:
        report("together", figures(everything))


def report(name: str, f: dict[str, Any]) -> None:
    """Print the figures of a shape."""
    reached, of = f["within_reach"], f["goals_within_reach"]
    within = "" if reached is None else f", {100 * reached:.1f} % of {of} within reach"
    within += f", others displaced by {f['mean_displaced']:.1f} px, {100 * f['displaced']:.0f} % of them"
    print(
        f"{name}: {success_text(f)}{within}; {f['mean_steps']:.1f} steps, {f['milliseconds_per_step']:.1f} ms a step",
        flush=True,
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
