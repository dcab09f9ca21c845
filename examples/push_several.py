"""A disc pushes two or three bodies to poses, in MuJoCo: `python examples/push_several.py --bodies 2 --episodes 100`.

Bodies of different outline (T, L, box, triangle; about 12 cm wide, 4 cm high, .13 to .18 kg) lie on a table, free in
space, with friction. A disc of 1.5 cm radius on two servos pushes them. Starts, goals and which bodies there are come
from the seed; a goal may lie under another body. An episode is solved when all bodies are within 1.5 cm and 0.1 rad of
their goals in the same step, and lie still. It is a scene after "Push Anything" (H. Bui et al., arXiv:2510.19974),
where an arm pushes scanned objects; here shapes, masses, friction and the true state are known.

The policy moves one body at a time by sampling-based contact MPC (`difflcs.planning`), with the others in the way:

- `Scheduler` says which body is moved, and where to: to its goal, or round others on the way there, or aside where
  it lies on the goal of another.
- `Watchful`, the MPC, refuses plans in which body or disc comes too near to other bodies.
- `TableTravel` leads the disc round all bodies.

Lengths in the policy are in units of 10 cm.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
import tyro
from body_paths import BodyPaths
from numpy.typing import NDArray
from push_t import Rigid
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from successes import success_figures
from torch import Tensor

from difflcs import Animation, GoalCost, LCSMPCLayer, Status
from difflcs.cli.bench import machine
from difflcs.errors import InvalidInputError
from difflcs.mpc import MPCSolution
from difflcs.physics import Polygon, Union, box
from difflcs.physics.planar import to_body
from difflcs.planning import DiscPlaces, Mode, SamplingPolicy, SamplingSettings, Workspace
from difflcs.planning.outline import DistanceGrid, clearance, ring
from difflcs.planning.places import from_body

if TYPE_CHECKING:
    from PIL import Image

LENGTH = 0.1
"""Unit of length of the policy [m]."""
RADIUS = 0.15
"""Of the disc."""
APART = 0.4
"""Least distance between bodies as they start, between goals, and of the disc from bodies."""
HEIGHT = 0.4
"""Of the bodies."""
NEAR, ALIGNED, STILL = 0.15, 0.1, 0.05
"""Tolerances of a goal [length, rad], and the largest speed [length/s, rad/s] of a body that lies still."""
PERIOD, SUBSTEPS = 0.1, 50
"""Of a step [s], and steps of MuJoCo in it."""
LIMIT = 100
"""Steps of an episode for each body."""
PUSH, TRAVEL = 0.25, 0.8
"""Longest way of the disc in a step, while it pushes (in x and in y) and while it travels."""
GRIP = 0.3
"""Friction between disc and bodies."""
MARGIN = 0.08
"""Between a moving body and others in a plan."""
LENIENT = 0.03
"""By how much less it may be after each step in which no plan gains anything."""
COLORS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167))
"""Of the bodies in a film."""
Array = NDArray[np.float64]


def _centred(*parts: Polygon) -> Union:
    """Put polygons together, about the centre of their area."""
    center = Union(parts).centroid
    return Union(tuple(Polygon(part.vertices - center) for part in parts))


SHAPES = {
    "T": _centred(box(-0.6, 0.6, 0.0, 0.3), box(-0.15, 0.15, -0.9, 0.0)),
    "L": _centred(box(-0.15, 0.15, 0.0, 1.0), box(0.15, 0.75, 0.0, 0.3)),
    "box": _centred(box(-0.5, 0.5, -0.3, 0.3)),
    "triangle": _centred(Polygon(torch.tensor([[-0.6, 0.0], [0.6, 0.0], [0.1, 1.0]], dtype=torch.float64))),
}
"""The outlines, each about the centre of its area."""


class Body:
    """What the policy knows of a body, in its own coordinates.

    Args:
        shape: its outline, a union of polygons.

    Attributes:
        outline: (n, 2) points along it, at most .15 apart.
        grid: distances to it.
        ring: (20, 2) waypoints of a disc round it.
    """

    def __init__(self, shape: Union):
        self.shape = shape
        points = []
        for part in shape.parts:
            assert isinstance(part, Polygon)
            for a, b in zip(part.corners, part.corners.roll(-1, 0), strict=True):
                t = torch.arange(math.ceil(float((b - a).norm()) / 0.15), dtype=a.dtype)[:, None]
                points.append(a + t / len(t) * (b - a))
        points = torch.cat(points)
        self.outline = points[shape.distance(points).distance.amin(-1) > -1e-6]
        self.grid = DistanceGrid(partial(clearance, shape), shape.radius + 1.0)
        self.ring = ring(shape, RADIUS + 0.1, 20)


BODIES = {name: Body(shape) for name, shape in SHAPES.items()}


def outlines(body: Body, poses: Tensor) -> Tensor:
    """Return the points (..., n, 2) of the outline of a body at poses (..., 3)."""
    cos, sin = poses[..., 2, None].cos(), poses[..., 2, None].sin()
    x, y = body.outline.unbind(-1)
    return poses[..., None, :2] + torch.stack([cos * x - sin * y, sin * x + cos * y], -1)


class Table:
    """Bodies on the table, for the policy: their poses, and how far points are from them.

    Args:
        bodies: that are there.
    """

    def __init__(self, bodies: list[Body]):
        self.bodies = bodies
        self.poses = torch.zeros(len(bodies), 3, dtype=torch.float64)

    def gap(self, points: Tensor, but: int | None = None) -> Tensor:
        """Return the distance (...) of points (..., 2) to the nearest body, at most 1, of all bodies but one."""
        gap = points.new_ones(points.shape[:-1])
        for i, body in enumerate(self.bodies):
            if i != but:
                local = to_body(self.poses[i], points.reshape(-1, 2)).reshape(points.shape)
                gap = torch.minimum(gap, body.grid.distance(local))
        return gap

    def body_gap(self, i: int, poses: Tensor) -> Tensor:
        """Return the distance (...) of body i at poses (..., 3) to the others, as they lie."""
        return self.gap(outlines(self.bodies[i], poses), but=i).amin(-1)


class Watchful(LCSMPCLayer):
    """An MPC for one body that refuses plans which come too near to other bodies: they count as not solved.

    Where every plan does, those are left that come no nearer than the best of them.

    Args:
        table: with all bodies.
        moved: number of the body.
        options: of `LCSMPCLayer`.

    Attributes:
        lenience: by how much less a plan may leave [length].
    """

    def __init__(self, table: Table, moved: int, *options: Any, **more: Any):
        super().__init__(*options, **more)
        self.table, self.moved, self.lenience = table, moved, 0.0

    def forward(self, x0: Tensor, *args: Any, **options: Any) -> MPCSolution:
        """See `LCSMPCLayer`."""
        solution = super().forward(x0, *args, **options)
        if len(self.table.bodies) == 1:
            return solution
        plans = solution.x[:, 1:5]
        body = self.table.body_gap(self.moved, plans[..., :3]).amin(-1)
        disc = self.table.gap(plans[..., 3:5], but=self.moved).amin(-1) - RADIUS
        now = float(self.table.body_gap(self.moved, x0[0, :3]))
        lack = torch.maximum(min(MARGIN, now) - 0.01 - body, -disc) - self.lenience
        lack = lack.clamp_min(0.0)
        refused = lack > lack[solution.converged].amin() if bool(solution.converged.any()) else lack > 0
        return replace(solution, status=solution.status.masked_fill(refused, Status.INFEASIBLE), of=solution.problem)


class TablePlaces(DiscPlaces):
    """Places round one body, where the disc does not touch the others."""

    def __init__(self, table: Table, moved: int, workspace: Workspace):
        shape = table.bodies[moved].shape
        super().__init__(shape, RADIUS, 32, gap=0.02, reach=0.2, workspace=workspace)
        self.table, self.moved = table, moved

    def allowed(self, states: Tensor) -> Tensor:
        """See `DiscPlaces`."""
        apart = self.table.gap(states[:, 3:5], but=self.moved) > RADIUS + 0.02
        return super().allowed(states) & apart


class TableTravel:
    """The disc goes by straight lines over waypoints round all bodies; see `difflcs.planning.Travel`."""

    def __init__(self, table: Table, workspace: Workspace):
        self.table, self.workspace = table, workspace
        self._poses: Tensor | None = None

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """See `Travel`: the length of the way; where none is found, as far as the farthest waypoint and straight."""
        self._survey()
        start, ends = x[3:5], states[:, 3:5]
        length = torch.from_numpy(self._from(start)[0][:-1])
        legs = torch.where(self._in_sight(self._nodes[:, None], ends), torch.cdist(self._nodes, ends), math.inf)
        straight = (ends - start).norm(dim=-1)
        length = torch.minimum(
            torch.where(self._in_sight(start, ends), straight, math.inf), (length[:, None] + legs).amin(0)
        )
        return torch.where(length.isfinite(), length, 5.0 + straight)

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """See `Travel`."""
        return bool((x[3:5] - target[3:5]).norm() < 0.06)

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """See `Travel`."""
        way = self.way(x[3:5], target[3:5])
        for point in way:
            step = point - x[3:5]
            if float(step.norm()) > 0.05 or point is way[-1]:
                return step * min(1.0, TRAVEL / max(float(step.norm()), 1e-9))
        raise AssertionError("a way has an end")

    def way(self, start: Tensor, end: Tensor) -> list[Tensor]:
        """Find the corners (2,) of the shortest way of the disc, and its end."""
        self._survey()
        if bool(self._in_sight(start, end)):
            return [end]
        length, before = self._from(start)
        legs = self._legs(end)
        at = int((torch.from_numpy(length[:-1]) + legs).argmin())
        way = [end]
        while 0 <= at < len(self._nodes):
            way.append(self._nodes[at])
            at = int(before[at])
        return way[::-1]

    def _from(self, start: Tensor) -> tuple[Array, Array]:
        """Compute the lengths of ways from a point to all waypoints and, last, itself; and what comes before each."""
        count = len(self._nodes)
        lengths = torch.full((count + 1, count + 1), math.inf, dtype=start.dtype)
        lengths[:-1, :-1] = self._between
        lengths[-1, :-1] = self._legs(start)
        graph = csr_array(torch.where(lengths.isfinite(), lengths, 0.0).numpy())
        return dijkstra(graph, indices=count, return_predecessors=True)

    def _legs(self, point: Tensor) -> Tensor:
        """Return the lengths of straight ways (n,) between a point and the waypoints, ∞ where something is between."""
        lengths = (self._nodes - point).norm(dim=-1)
        seen = self._in_sight(point, self._nodes)
        if not bool(seen.any()):  # as in a corner: the nearest leads out
            seen[lengths.argmin()] = True
        return torch.where(seen, lengths, math.inf)

    def _survey(self) -> None:
        """Place waypoints anew where a body has moved."""
        poses = self.table.poses
        if self._poses is not None and bool((poses - self._poses).abs().max() < 0.02):
            return
        self._poses = poses.clone()
        nodes = torch.cat([from_body(p, body.ring) for p, body in zip(poses, self.table.bodies, strict=True)])
        fit = (self.table.gap(nodes) > RADIUS + 0.04) & self.workspace.contains(nodes)
        self._nodes = nodes[fit] if int(fit.sum()) > 1 else nodes
        self._between = torch.full((len(self._nodes),) * 2, math.inf, dtype=nodes.dtype)
        i, j = torch.triu_indices(*self._between.shape, offset=1)
        seen = self._in_sight(self._nodes[i], self._nodes[j])
        lengths = (self._nodes[j] - self._nodes[i]).norm(dim=-1)
        self._between[i, j] = self._between[j, i] = torch.where(seen, lengths, math.inf)

    def _in_sight(self, starts: Tensor, ends: Tensor) -> Tensor:
        """Return a mask (...) of the ends (..., 2) to which the disc can go straight from the starts (..., 2)."""
        way = ends - starts
        count = 2 + math.ceil(float(way.norm(dim=-1).max()) / 0.2)
        t = torch.linspace(0.0, 1.0, count, dtype=way.dtype)[:, None]
        gap = self.table.gap(starts[..., None, :] + t * way[..., None, :]) - RADIUS
        least = torch.minimum(gap[..., :1], gap[..., -1:]).clamp(max=0.03)
        return (gap >= least - 1e-9).all(-1)


class SeveralPolicy:
    """Moves bodies to goals, one at a time: poses and the place of the disc to the next step of the disc.

    Args:
        names: of the bodies, in `BODIES`.
        goals: (n, 3) their poses.
        side: of the square that bodies should stay in.
    """

    def __init__(self, names: list[str], goals: Array, side: float):
        self.names, self.side = names, side
        self.table = table = Table([BODIES[name] for name in names])
        self.goals = torch.from_numpy(goals)
        workspace = Workspace((-1.0, -1.0), (side + 1.0, side + 1.0), step=PUSH)
        cost = GoalCost.reach(5, 2, goal_weight=(1.0, 1.0, 0.3), goal_weight_final=(4.0, 4.0, 1.2), input_weight=0.05)
        settings = SamplingSettings(keep=0.6, smallest_gain=0.02, switch_price=0.02, travel_price=0.04)
        self.paths = [BodyPaths(partial(table.body_gap, i), side) for i in range(len(names))]
        self.travel = travel = TableTravel(table, workspace)
        self.policies = []
        for i, body in enumerate(table.bodies):
            system = Rigid(body.shape, RADIUS, friction=GRIP, compliance=0.02, length=1.0, nearest=2)
            mpc = Watchful(table, i, system, cost, 6, relaxation=1e-5, on_failure="mask")
            places = TablePlaces(table, i, workspace)
            self.policies.append(SamplingPolicy(mpc, places, travel, settings, bounds=workspace.bounds, angles=(2,)))
        self.scheduler = Scheduler(table, self.paths, self.goals)

    def act(self, poses: Array, disc: Array) -> Array:
        """Choose how far the disc goes (2,) from poses (n, 3) and its place (2,)."""
        self.table.poses = torch.from_numpy(poses)
        before = self.scheduler.active
        active, target = self.scheduler.choose(torch.from_numpy(disc))
        policy = self.policies[active]
        mpc = policy.mpc
        assert isinstance(mpc, Watchful)
        if active != before:
            policy.reset()
            mpc.lenience = 0.0
        u = policy.act(np.concatenate([poses[active], disc]), target)
        decision = policy.decision
        assert decision is not None
        if decision.mode is Mode.PUSH:
            blocked = not decision.gain > policy.settings.smallest_gain
            mpc.lenience = mpc.lenience + LENIENT if blocked else max(0.0, mpc.lenience - LENIENT)
        return u


class Scheduler:
    """Which body is moved, and where to.

    The body stays the same until it is on its goal, or has not come nearer for `PATIENCE` steps. Then comes, of those
    that are not on their goals, the one that has least to go, among those whose goal is free and which has a way. If
    there is none, a body that lies on the goal of another goes aside.
    """

    PATIENCE = 40
    MARGIN = 0.03
    """Between a body on its goal and others as they lie."""
    CLEAR = 0.8
    """Between a body that went aside and others, and goals of others, if there is room."""

    def __init__(self, table: Table, paths: list[BodyPaths], goals: Tensor):
        self.table, self.paths, self.goals = table, paths, goals
        self.active: int | None = None
        self.aside: Tensor | None = None
        self._best, self._since = math.inf, 0
        self._failed = [0] * len(goals)

    def error(self, i: int, goal: Tensor) -> float:
        """Return how far a body is from a goal, as a multiple of the tolerance."""
        difference = goal - self.table.poses[i]
        turn = math.remainder(float(difference[2]), 2 * math.pi)
        return max(float(difference[:2].norm()) / NEAR, abs(turn) / ALIGNED)

    def choose(self, disc: Tensor) -> tuple[int, Tensor]:
        """Choose the body, and the pose it should go to (3,)."""
        i = self.active
        if i is not None:
            error = self.error(i, self._target(i))
            if error < 0.95 * self._best:
                self._best, self._since = error, 0
            self._since += 1
            arrived = error < 0.8 if self.aside is None else self._away(i)
            stuck = self._since > self.PATIENCE
            self._failed[i] += stuck
            if arrived or stuck:
                i = None
        if i is None:
            i = self._next(disc)
            self._best, self._since = math.inf, 0
            self.active = i
        return i, self.subgoal(i, self._target(i))

    def _target(self, i: int) -> Tensor:
        """Return where the active body goes in the end: to its goal, or aside."""
        return self.goals[i] if self.aside is None else self.aside

    def _away(self, i: int) -> bool:
        """Return True if body i is where it should go aside, turned in any way."""
        assert self.aside is not None
        return float((self.aside - self.table.poses[i])[:2].norm()) < 0.3

    def subgoal(self, i: int, goal: Tensor) -> Tensor:
        """Return where a body is pushed on the way to its goal."""
        found = self._way(i, goal) if len(self.goals) > 1 else goal
        return goal if found is None else found

    def _way(self, i: int, goal: Tensor) -> Tensor | None:
        poses = self.table.poses
        return self.paths[i].subgoal(poses[i], goal, torch.cat([poses[:i], poses[i + 1 :]]))

    def _next(self, disc: Tensor) -> int:
        """Choose the next body; sets `aside`, where it goes if not to its goal."""
        self.aside = None
        todo = [i for i in range(len(self.goals)) if self.error(i, self.goals[i]) > 0.8]
        if not todo:
            return max(range(len(self.goals)), key=lambda i: self.error(i, self.goals[i]))
        price = {i: float((self.table.poses[i, :2] - disc).norm()) + 10.0 * self._failed[i] for i in todo}
        free = [i for i in todo if float(self.table.body_gap(i, self.goals[i])) > self.MARGIN]
        free = [i for i in free if len(self.goals) == 1 or self._way(i, self.goals[i]) is not None]
        if free:
            return min(free, key=price.__getitem__)
        for i in sorted(todo, key=price.__getitem__):
            for j in self._blockers(i):
                self.aside = self._find_aside(j)
                if self.aside is not None:
                    return j
        return min(todo, key=price.__getitem__)

    def _blockers(self, i: int) -> list[int]:
        """Return the other bodies by their distance to body i on its goal, the nearest first."""
        points = outlines(self.table.bodies[i], self.goals[i])
        gaps = {}
        for j, body in enumerate(self.table.bodies):
            if j != i:
                gaps[j] = float(body.grid.distance(to_body(self.table.poses[j], points)).min())
        return sorted(gaps, key=gaps.__getitem__)

    def _find_aside(self, j: int) -> Tensor | None:
        """Find the nearest pose of a body that is away from others and from goals of others."""
        paths = self.paths[j]
        poses = paths.nodes[2:-2, 2:-2, 0].reshape(-1, 3).clone()
        poses[:, 2] = self.table.poses[j, 2]
        goals = Table(self.table.bodies)
        goals.poses = self.goals
        free, useful = self.table.body_gap(j, poses), goals.body_gap(j, poses)
        price = 2.0 * (self.CLEAR - torch.minimum(free, useful)).clamp_min(0.0)
        price += torch.where((free > 0.4) & (useful > 0.3), 0.0, math.inf)
        distance = (poses - self.table.poses[j])[:, :2].norm(dim=-1) + price
        best = int(distance.argmin())
        return poses[best] if math.isfinite(float(distance[best])) else None


@dataclass
class Task:
    """What an episode begins with, and what is asked for.

    Attributes:
        names: of the bodies.
        starts: (n, 3) poses.
        goals: (n, 3) poses.
        disc: (2,) place.
        side: of the square that starts and goals are in. The disc may go a unit beyond it.
    """

    names: list[str]
    starts: Array
    goals: Array
    disc: Array
    side: float

    def alone(self, i: int) -> Task:
        """Return the same with one body only."""
        one = slice(i, i + 1)
        return Task(self.names[one], self.starts[one], self.goals[one], self.disc, self.side)


def draw_task(seed: int, bodies: int, side: float) -> Task:
    """Draw a task: which bodies, their starts and goals in a square, and where the disc is."""
    random = np.random.default_rng(seed)
    names = [str(name) for name in random.permutation(list(SHAPES))[:bodies]]
    table = Table([BODIES[name] for name in names])

    def poses() -> Tensor:
        while True:
            drawn = random.uniform([0.9, 0.9, -math.pi], [side - 0.9, side - 0.9, math.pi], (bodies, 3))
            table.poses = torch.from_numpy(drawn)
            if all(float(table.body_gap(i, table.poses[i])) > APART for i in range(bodies)):
                return table.poses

    goals, starts = poses(), poses()  # the table has the starts
    while True:
        disc = random.uniform(0.0, side, 2)
        if float(table.gap(torch.from_numpy(disc))) > APART:
            return Task(names, starts.numpy(), goals.numpy(), disc, side)


class Scene:
    """The scene in MuJoCo, in metres; poses and places in and out are in units of the policy.

    Args:
        task: bodies, where they start, and where the disc does.
    """

    MASS, STIFFNESS = 1.0, 1e4
    """Of the disc [kg], and of its servos [N/m], which are critically damped."""

    def __init__(self, task: Task):
        spec = mujoco.MjSpec()
        spec.option.timestep = PERIOD / SUBSTEPS
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        world = spec.worldbody
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], friction=[0.4, 0.005, 0.0001])
        for name, (x, y, yaw) in zip(task.names, task.starts, strict=True):
            quat = [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
            body = world.add_body(name=name, pos=[LENGTH * x, LENGTH * y, LENGTH * HEIGHT / 2], quat=quat)
            body.add_freejoint()
            for k, part in enumerate(SHAPES[name].parts):
                assert isinstance(part, Polygon)
                self._add_prism(spec, body, f"{name}{k}", part)
        disc = world.add_body(name="disc", pos=[*(LENGTH * task.disc), LENGTH * HEIGHT / 2])
        damping = 2 * math.sqrt(self.STIFFNESS * self.MASS)
        for axis, direction in (("x", [1, 0, 0]), ("y", [0, 1, 0])):
            disc.add_joint(name=axis, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
            servo = spec.add_actuator(name=axis, target=axis, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=self.STIFFNESS, kv=damping)
        disc.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[LENGTH * RADIUS, 0.4 * LENGTH * HEIGHT, 0],
            mass=self.MASS,
            friction=[GRIP, 0.005, 0.0001],
            priority=1,
        )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._ahead, self._home = damping / self.STIFFNESS, LENGTH * task.disc
        self.n_bodies = len(task.names)
        mujoco.mj_step(self.model, self.data, SUBSTEPS)  # bodies settle

    @staticmethod
    def _add_prism(spec: Any, body: Any, name: str, part: Polygon) -> None:
        corners = LENGTH * part.corners.numpy()
        options = {"density": 700, "friction": [0.4, 0.005, 0.0001]}
        half = LENGTH * HEIGHT / 2
        if len(corners) == 4:  # along the axes
            low, high = corners.min(0), corners.max(0)
            size, pos = [*((high - low) / 2), half], [*((high + low) / 2), 0]
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos, **options)
            return
        vertices = [[*corner, z] for corner in corners for z in (-half, half)]
        spec.add_mesh(name=name, uservert=np.array(vertices).ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **options)

    @property
    def poses(self) -> Array:
        """(n, 3) of the bodies."""
        q = self.data.qpos[: 7 * self.n_bodies].reshape(-1, 7)
        yaw = np.arctan2(2 * (q[:, 3] * q[:, 6] + q[:, 4] * q[:, 5]), 1 - 2 * (q[:, 5] ** 2 + q[:, 6] ** 2))
        return np.column_stack([q[:, :2] / LENGTH, yaw])

    @property
    def disc(self) -> Array:
        """(2,) place of the disc."""
        return (self._home + self.data.qpos[-2:]) / LENGTH

    def step(self, u: Array) -> None:
        """Move the disc by u (2,) at even speed: its servos are led along the way, ahead by what they lag behind."""
        start, way = self.data.qpos[-2:].copy(), LENGTH * u
        for k in range(SUBSTEPS):
            self.data.ctrl[:] = start + ((k + 1) / SUBSTEPS + self._ahead / PERIOD) * way
            mujoco.mj_step(self.model, self.data)

    def solved(self, goals: Array) -> bool:
        """Return True if all bodies lie still on their goals."""
        difference = self.poses - goals
        turn = (difference[:, 2] + math.pi) % (2 * math.pi) - math.pi
        speed = self.data.qvel[: 6 * self.n_bodies].reshape(-1, 6)[:, [0, 1, 5]] * [1 / LENGTH, 1 / LENGTH, 1]
        near = np.hypot(difference[:, 0], difference[:, 1]) < NEAR
        return bool((near & (np.abs(turn) < ALIGNED)).all() and np.abs(speed).max() < STILL)


@dataclass
class Played:
    """An episode: whether it was solved, in how many steps, and CPU time of all decisions [s]."""

    success: bool
    steps: int
    seconds: float


def play(task: Task, watch: Any = None) -> Played:
    """Play a task; `watch(scene, policy)` is called after each decision."""
    scene, policy, seconds = Scene(task), SeveralPolicy(task.names, task.goals, task.side), 0.0
    limit = LIMIT * len(task.names)
    for step in range(limit + 1):
        if scene.solved(task.goals):
            return Played(True, step, seconds)
        begin = time.thread_time()
        u = policy.act(scene.poses, scene.disc)
        seconds += time.thread_time() - begin
        if watch is not None:
            watch(scene, policy)
        scene.step(u)
    return Played(False, limit, seconds)


def picture(scene: Scene, policy: SeveralPolicy, text: str, size: int = 340) -> Image.Image:
    """Draw the table from above: bodies, and as lines of the same colours their goals; the disc, and what it plans."""
    from PIL import Image, ImageDraw

    fine = 2 * size
    scale, low = fine / (policy.side + 2.0), -1.0
    frame = Image.new("RGB", (fine, fine), "white")
    draw = ImageDraw.Draw(frame)

    def pixels(points: Tensor | Array) -> list[tuple[float, float]]:
        return [(scale * (x - low), fine - scale * (y - low)) for x, y in points.tolist()]

    def placed(name: str, pose: Array) -> list[list[tuple[float, float]]]:
        parts = [part.corners for part in SHAPES[name].parts if isinstance(part, Polygon)]
        return [pixels(from_body(torch.from_numpy(pose), corners)) for corners in parts]

    for name, color, pose, goal in zip(policy.names, COLORS, scene.poses, policy.goals.numpy(), strict=False):
        pale = tuple(255 - (255 - value) // 4 for value in color)
        for corners in placed(name, goal):
            draw.polygon(corners, fill=pale)
        for corners in placed(name, pose):
            draw.polygon(corners, fill=color)
    active = policy.scheduler.active
    decision = None if active is None else policy.policies[active].decision
    if decision is not None and decision.mode is Mode.TRAVEL and decision.target is not None:
        points = [torch.from_numpy(scene.disc), *policy.travel.way(torch.from_numpy(scene.disc), decision.target[3:5])]
        draw.line(pixels(torch.stack(points)), fill=(120, 120, 120), width=3)
    ((x, y),) = pixels(scene.disc[None])
    r = scale * RADIUS
    draw.ellipse((x - r, y - r, x + r, y + r), fill=(60, 60, 60))
    draw.text((12, 8), text, fill=(20, 20, 30), font_size=fine // 26)
    return frame.resize((size, size), Image.Resampling.LANCZOS)


def film(task: Task, path: Path) -> None:
    """Play a task and write a film of it, at twice the speed."""
    frames = []

    def watch(scene: Scene, policy: SeveralPolicy) -> None:
        frames.append(picture(scene, policy, f"{PERIOD * len(frames):.1f} s"))

    played = play(task, watch)
    Animation(frames + frames[-1:] * 20, fps=20, colors=24).save(path)
    print(f"{'solved' if played.success else 'not solved'} in {played.steps} steps; written: {path}")


@dataclass
class Options:
    """Several bodies to poses by one disc."""

    bodies: int = 2
    """2 or 3."""
    side: float = 60.0
    """Of the square that starts and goals are in [cm]."""
    episodes: int = 100
    seed: int = 0
    """Of the first episode; the next have the next."""
    json: bool = False
    """Print a line of JSON."""
    alone: int | None = None
    """Episodes of which each body is moved alone, too, for the time of one after the other; None: all."""
    out: Path | None = None
    """File of episodes played, a line each; those that are there are not played again. One file for each setting."""
    gif: Path | None = None
    """Film the first episode instead."""


def figures(played: list[Played], alone: list[Played], bodies: int) -> dict[str, Any]:
    """Compute the figures of episodes, and of each of their bodies alone.

    `mean_alone` is the mean of the steps in which a body comes to its goal with the others absent, from the same start
    and place of the disc. An episode is a success if it is solved within twice `bodies` times as many steps.
    """
    steps = np.array([one.steps for one in played])
    solved = np.array([one.success for one in played])
    mean_alone = float(np.mean([one.steps for one in alone]))
    within = solved & (steps <= 2 * bodies * mean_alone)
    return {
        **success_figures(within.astype(float)),
        "solved": int(solved.sum()),
        "mean_steps": float(steps.mean()),
        "longest": int(steps.max()),
        "mean_alone": mean_alone,
        "alone": len(alone),
        "solved_alone": sum(one.success for one in alone),
        "milliseconds_per_step": 1e3 * sum(one.seconds for one in played) / max(int(steps.sum()), 1),
    }


def main(o: Options) -> None:
    """Play, print the figures."""
    if not 1 <= o.bodies <= len(SHAPES):
        raise InvalidInputError(f"bodies: expected 1 to {len(SHAPES)}, got {o.bodies}; there are so many shapes")
    torch.set_num_threads(1)
    if o.gif is not None:
        film(draw_task(o.seed, o.bodies, o.side / (100 * LENGTH)), o.gif)
        return
    out = o.out
    lines = out.read_text().splitlines() if out is not None and out.exists() else []
    done: dict[tuple[int, int | None], Played] = {}
    for record in map(json.loads, lines):
        done[record.pop("seed"), record.pop("body")] = Played(**record)
    seeds = range(o.seed, o.seed + o.episodes)
    alone = list(itertools.product(seeds[: o.alone], range(o.bodies)))
    for key in [*((seed, None) for seed in seeds), *alone]:
        if key in done:
            continue
        seed, body = key
        task = draw_task(seed, o.bodies, o.side / (100 * LENGTH))
        done[key] = played = play(task if body is None else task.alone(body))
        if out is not None:
            with out.open("a") as file:
                file.write(json.dumps({"seed": seed, "body": body, **asdict(played)}) + "\n")
        if not o.json:
            names = task.names if body is None else [task.names[body]]
            verdict = "solved" if played.success else "not solved"
            print(f"seed {seed}, {', '.join(names)}: {verdict} in {played.steps} steps", flush=True)
    result = figures([done[seed, None] for seed in seeds], [done[key] for key in alone], o.bodies)
    if o.json:
        print(json.dumps({"bodies": o.bodies, "side": o.side, "seed": o.seed, **result, "machine": machine()}))
    else:
        for name, value in result.items():
            print(f"{name:24s} {value:.4g}")


if __name__ == "__main__":
    main(tyro.cli(Options))
