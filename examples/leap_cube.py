"""The LEAP hand turns a cube, in Judo's task `leap_cube`: `python examples/leap_cube.py --episodes 3 --seed 100`.

The hand faces up. Goals are orientations drawn uniformly: where the cube comes within 0.4 rad of one, the next is
drawn, and where it falls it is laid into the hand again. Model, goals, criterion and resets are Judo's, which has to be
installed (`pip install judo-rai`); it loads its meshes from the internet the first time.

With `--policy mppi`, `cem` or `ps` Judo's own planner plays the same episodes, with Judo's reward and defaults for this
task: 32 rollouts of 1 s, 20 decisions a second, for which the simulator waits. `--rollouts` and `--rate` change that.

Our policy is a contact MPC: a quasi-dynamic system and a cost in task space, both linearised where hand and cube are,
ten times a second. Its plan at several paces, what is left of the last way, and a few variations of the best of these
are rehearsed for half a second in the model with which Judo plans, in steps of 5 ms; the best one is begun. No data.

With `--spin 1` or `--spin -1` the goal runs ahead of the cube about the vertical: where less than 1.2 rad are left, it
goes on by 0.4 rad, which counts as a goal. The seed says where it begins.

Times are CPU times. With `--out FILE` episodes that are in the file are not played again.
"""

# Judo is no dependency; MuJoCo is a compiled module without type stubs.
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

from __future__ import annotations

import copy
import json
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import mujoco
import numpy as np
import torch
import tyro
from mujoco import rollout

from difflcs import LCSMPCLayer
from difflcs.errors import ContactWarning
from difflcs.mpc.backends import BatchedBackend
from difflcs.physics.mujoco import ContactGroup, Distance, Effort, MujocoCost, MujocoLCS, Orientation, Position
from difflcs.status import solved

STEP, AHEAD = 0.4, 1.2  # by how much the goal of a spin runs on, and is ahead at least [rad]
FINGERS = {"if": "bs px md ds", "mf": "bs px md ds", "rf": "bs px md ds", "th": "mp bs px ds"}


@dataclass(frozen=True)
class Settings:
    """Of the contact MPC."""

    seconds: float = 0.1
    horizon: int = 4
    limit: float = 0.6
    """Most by which the target of a servo is from its joint [rad]."""
    place: tuple[float, float, float] = (0.0, 0.03, 0.075)
    """Where the cube should be [m]."""
    place_weight: float = 4000.0
    turn_weight: float = 18.75
    reach: float = 0.5
    """Angle up to which a goal that is farther away pulls harder [rad]."""
    near: float = 1.0
    """Weight of the distances of cube and fingertips."""
    effort: float = 0.01
    inertia: float = 5.0
    """Factor of the inertia of rotation of the cube."""
    compliance: float = 0.1
    relaxation: float = 1e-3
    solver: Literal["fast", "default", "best"] = "fast"
    paces: tuple[float, ...] = (1.5, 1.0, 0.5)
    """Factors by which the planned actions are rehearsed; none: rehearsed is only what varies the last way."""
    ahead: int = 5
    """Decisions that a rehearsal looks ahead; after the plan's last the servos' targets stay."""
    samples: tuple[int, ...] = (4, 2)
    """Variations of the best way so far that are rehearsed, round by round."""
    noise: float = 0.3
    """Standard deviation of the servos' targets in a variation [rad]."""
    step: float = 0.005
    """Time step of the rehearsal [s]; with 10 ms, as Judo plans, cube and hand are elsewhere after half a second."""
    reached: float = 0.38
    """Angle within which a rehearsal has reached the goal and turns no further [rad]."""
    patience: int = 25
    opening: int = 8
    spread: float = 0.3


@dataclass
class Options:
    """The LEAP hand turns a cube."""

    policy: Literal["ours", "mppi", "cem", "ps"] = "ours"
    """Our contact MPC, or one of Judo's planners."""
    episodes: int = 3
    """Episodes, of seeds `seed`, `seed` + 1, …"""
    seed: int = 100
    """Seed of the goals of the first."""
    seconds: float = 60.0
    """Length of an episode."""
    rollouts: int | None = None
    """Rollouts of Judo's planner; None: its default."""
    rate: float | None = None
    """Decisions a second of Judo's planner; None: its default."""
    spin: Literal[-1, 0, 1] = 0
    """Not 0: the cube is to be turned about the vertical all the time, this way."""
    judo: Path | None = None
    """Folder in which Judo is installed, if it is not in this environment."""
    out: Path | None = None
    """Where episodes are recorded, a line of JSON each."""
    settings: Settings = field(default_factory=Settings)


def load_judo(folder: Path | None) -> Any:
    """Import Judo's task, from a folder if one is given."""
    if folder is not None:
        sys.path.append(str(folder))
    try:
        from judo.tasks.leap_cube import LeapCube

        return LeapCube
    except ImportError as error:
        raise SystemExit(
            f"leap_cube needs Judo, which could not be imported ({error}); pip install judo-rai, or install it beside "
            "this environment by pip install --target DIR judo-rai and pass --judo DIR"
        ) from error


class Episode:
    """Judo's simulation, with goals that depend on the seed alone, and counts of goals and drops."""

    def __init__(self, make_task: Any, seed: int, spin: int = 0):
        self.goals, self.drops, self.random = -1, -1, np.random.RandomState(seed).get_state()
        self.spin, self.first = spin, AHEAD + STEP * np.random.RandomState(seed).rand()
        self.task = make_task()
        self.draw, self.lay = self.task._update_goal_quat, self.task.reset
        self.task._update_goal_quat, self.task.reset = self.next_goal, self.reset
        self.task.reset()
        self.goals = self.drops = 0

    def next_goal(self) -> None:
        """Draw the next goal; Judo draws from NumPy's one generator, which its planners use, too."""
        self.goals += 1
        if self.spin:
            self.ahead += STEP * self.spin
            goal = np.array([np.cos(self.ahead / 2), 0.0, 0.0, np.sin(self.ahead / 2)])
            self.task.data.mocap_quat[0] = self.task.goal_quat = goal
            return
        others = np.random.get_state()  # noqa: NPY002
        np.random.set_state(self.random)  # noqa: NPY002
        self.draw()
        self.random = np.random.get_state()  # noqa: NPY002
        np.random.set_state(others)  # noqa: NPY002

    def reset(self) -> None:
        """Lay the cube into the hand, with another goal that was not reached."""
        self.ahead = (self.first - STEP) * self.spin
        self.lay()
        self.goals, self.drops = self.goals - 1, self.drops + 1

    def step(self, ctrl: np.ndarray) -> None:
        """Simulate 2 ms."""
        self.task.data.ctrl[:] = ctrl
        mujoco.mj_step(self.task.sim_model, self.task.data)
        self.task.post_sim_step()
        if self.spin and 2 * np.arccos(min(1.0, abs(float(self.task.data.qpos[3:7] @ self.task.goal_quat)))) < AHEAD:
            self.next_goal()


class HandPolicy:
    """Contact MPC: a quasi-dynamic system and a cost in task space, both linearised where hand and cube are."""

    def __init__(self, model: Any, data: Any, settings: Settings):
        s = settings
        self.twin, self.seconds, model = copy.copy(model), s.seconds, copy.copy(model)
        self.twin.opt.timestep, self.twin.opt.cone = s.step, mujoco.mjtCone.mjCONE_PYRAMIDAL
        self.twin.opt.impratio = 1.0
        self.tried, self.rollout = mujoco.MjData(self.twin), rollout.Rollout(nthread=0)
        model.body_inertia[model.body("cube").id] *= s.inertia
        self.module = MujocoLCS(
            model,
            data,
            motion="quasi-dynamic",
            seconds=s.seconds,
            contacts=[
                ContactGroup(("cube", "palm"), 3),
                *(ContactGroup([("cube", f"{f}_{link}") for link in links.split()], 2) for f, links in FINGERS.items()),
                ContactGroup(None, 4, friction=False, distance=0.006),
            ],
            distance=0.03,
            compliance=s.compliance,
            length=0.02,
            limits=0,  # actions are within them already
        )
        cost = [
            Position("body:cube", s.place, weight=0.0, weight_final=s.place_weight),
            Orientation("body:cube", weight=0.0, weight_final=s.turn_weight, reach=s.reach),
            *(Distance("body:cube", f"trace_{f}_tip", weight=s.near, weight_final=0.0) for f in FINGERS),
            Effort(s.effort),
        ]
        self.cost = MujocoCost(self.module, cost)
        backend = BatchedBackend(effort=s.solver, threads=1)
        self.mpc = LCSMPCLayer(
            self.module, self.cost, s.horizon, -s.limit, s.limit, backend, s.relaxation, on_failure="mask"
        )
        self.range = model.actuator_ctrlrange.T
        self.settings, self.guess, self.goal, self.openings = s, None, np.zeros(4), 0
        self.way = np.tile(data.ctrl, (s.ahead, 1))
        self.random, self.home = np.random.RandomState(0), np.array(data.qpos[7:])

    def angle(self, data: Any) -> float:
        """Angle by which the cube is still to be turned [rad]."""
        return 2 * np.arccos(min(1.0, abs(float(data.qpos[3:7] @ self.goal))))

    def stalls(self, data: Any) -> bool:
        """Tell whether the cube has not turned on for too long: then the hand opens for some decisions."""
        left = self.angle(data)
        self.waited += 1
        if self.waited > 0 and left < self.best - 0.05:  # turned on by 3°
            self.best, self.waited = left, 0
        if self.waited > self.settings.patience:
            self.best, self.waited = np.inf, -self.settings.opening
            self.openings += 1
            self.posture = self.home + self.settings.spread * (self.openings > 1) * self.random.randn(16)
        return self.waited < 0

    def act(self, data: Any, goal: np.ndarray) -> np.ndarray:
        """MuJoCo's ctrl until the next decision."""
        if (goal != self.goal).any():
            self.goal, self.best, self.waited, self.guess = goal.copy(), np.inf, 0, None
        if self.stalls(data):
            self.guess, self.way = None, np.tile(np.clip(self.posture, *self.range), (len(self.way), 1))
        else:
            rest = np.vstack([self.way[1:], self.way[-1:]])
            self.way = self.rehearse(data, np.array([*self.plan(data), rest]))
        return self.way[0]

    def plan(self, data: Any) -> Iterator[np.ndarray]:
        """Yield the servos' targets (ahead, 16) of the plan at each pace."""
        s = self.settings
        if not s.paces:
            return
        x = self.module.observe(data)
        system, cost = self.module.params(x), self.cost.at(x, torch.from_numpy(self.goal))
        low, high = (bound.clamp(-s.limit, s.limit) for bound in self.module.action_bounds(x))
        with torch.no_grad():
            plan = self.mpc(x, lcs=system, cost=cost, guess=self.guess, u_min=low, u_max=high)
        self.guess = plan.shift() if bool(solved(plan.status)) else None
        steps = np.minimum(np.arange(s.ahead), s.horizon - 1)
        for pace in s.paces:
            yield np.clip(self.module.control(plan.x[:-1], pace * plan.u).numpy()[steps], *self.range)

    def rehearse(self, data: Any, ways: np.ndarray) -> np.ndarray:
        """Return the best of these ways (n, ahead, 16) and of their variations."""
        ends = self.simulate(data, ways)
        best, least = ways[ends.argmin()], ends.min()
        for n in self.settings.samples:
            ways = np.clip(best + self.draw(n), *self.range)
            ends = self.simulate(data, ways)
            if ends.min() < least:
                best, least = ways[ends.argmin()], ends.min()
        return best

    def draw(self, n: int) -> np.ndarray:
        """Draw changes of the targets (n, ahead, 16): drawn at beginning, middle and end, linear in between."""
        s = self.settings
        begin, middle, end = s.noise * self.random.randn(3, n, 1, 16)
        part = np.linspace(-1, 1, s.ahead)[:, None]
        return middle + np.where(part < 0, -part * (begin - middle), part * (end - middle))

    def simulate(self, data: Any, ways: np.ndarray) -> np.ndarray:
        """Return the costs (n,) of ways (n, ahead, 16): their mean over time and that of the end."""
        s, full = self.settings, mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.zeros((len(ways), mujoco.mj_stateSize(self.twin, full)))
        mujoco.mj_getState(self.twin, data, start[0], full)
        start[:] = start[0]
        states, _ = self.rollout.rollout(self.twin, [self.tried], start, ways.repeat(round(s.seconds / s.step), axis=1))
        cube = np.asarray(states)[:, :, 1:8]  # after the time
        apart = np.square(cube[:, :, :3] - s.place).sum(-1)
        left = 2 * np.arccos(np.minimum(1.0, np.abs(cube[:, :, 3:] @ self.goal)))
        near = np.minimum(left, s.reach)
        on = np.cumsum(left < s.reached, axis=1) == 0  # until the goal is reached
        costs = s.place_weight * apart + s.turn_weight * on * near * (2 * left - near)
        return costs.mean(1) + costs[:, -1]


class Ours:
    """The contact MPC, asked at each step of the simulator."""

    def __init__(self, task: Any, o: Options):
        self.policy, self.due = HandPolicy(task.model, task.data, o.settings), 0.0

    def control(self, task: Any) -> np.ndarray:
        """Return the controls of the next step of the simulator."""
        if task.data.time >= self.due - 1e-9:
            self.due += self.policy.seconds
            self.last = self.policy.act(task.data, task.goal_quat)
        return self.last


class Judo:
    """A planner of Judo, asked at each step of the simulator."""

    def __init__(self, task: Any, o: Options):
        from judo.controller import controller

        self.controller, self.due = controller.make_controller("leap_cube", o.policy), 0.0
        if o.rollouts is not None:
            self.controller.optimizer_cfg.num_rollouts = o.rollouts
        if o.rate is not None:
            self.controller.controller_cfg.control_freq = o.rate
        backend = self.controller.rollout_backend
        one = rollout.Rollout(nthread=0)  # the same rollouts in this thread, not in 32 on however few cores
        backend._rollout_obj = SimpleNamespace(
            rollout=lambda models, datas, *rest: one.rollout(models, datas[:1], *rest), close=one.close
        )
        self.controller.reset()

    def control(self, task: Any) -> np.ndarray:
        """Return the controls of the next step of the simulator."""
        data, planner = task.data, self.controller
        if data.time >= self.due - 1e-9:
            self.due += 1 / planner.controller_cfg.control_freq
            planner.update_states(
                SimpleNamespace(
                    qpos=data.qpos,
                    qvel=data.qvel,
                    time=data.time,
                    sim_metadata=task.get_sim_metadata(),
                    mocap_pos=data.mocap_pos,
                    mocap_quat=data.mocap_quat,
                    xpos=data.xpos,
                    xquat=data.xquat,
                )
            )
            planner.update_action()
        return planner.action(data.time)


def play(make_task: Any, o: Options, seed: int) -> dict[str, Any]:
    """Play an episode."""
    np.random.seed(seed)  # noqa: NPY002 (Judo draws from there)
    episode = Episode(make_task, seed, o.spin)
    policy = (Ours if o.policy == "ours" else Judo)(episode.task, o)
    policy.control(episode.task)  # what happens once, such as imports, is not counted
    policy.due, used, reached = 0.0, 0.0, []
    while episode.task.data.time < o.seconds - 1e-9:
        began = time.process_time()
        ctrl = policy.control(episode.task)
        used += time.process_time() - began
        before = episode.goals
        episode.step(ctrl)
        if episode.goals > before:
            reached.append(round(episode.task.data.time, 3))
    return {
        "policy": o.policy,
        "rollouts": o.rollouts,
        "rate": o.rate,
        "spin": o.spin,
        "seed": seed,
        "seconds": o.seconds,
        "goals": episode.goals,
        "drops": episode.drops,
        "cpu_seconds": used,
        "reached": reached,
    }


def main(o: Options) -> None:
    """Play, print, record."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)
    make_task = load_judo(o.judo)
    rows: list[dict[str, Any]] = []
    out = o.out
    lines = out.read_text().splitlines() if out is not None and out.exists() else []
    same = {"policy": o.policy, "rollouts": o.rollouts, "rate": o.rate, "seconds": o.seconds, "spin": o.spin}
    known = {row["seed"]: row for row in map(json.loads, lines) if same.items() <= row.items()}
    for seed in range(o.seed, o.seed + o.episodes):
        if seed not in known:
            known[seed] = play(make_task, o, seed)
            if out is not None:
                with out.open("a") as file:
                    file.write(json.dumps(known[seed]) + "\n")
        rows.append(row := known[seed])
        print(f"seed {seed}: {row['goals']} goals, {row['drops']} drops, {row['cpu_seconds']:.1f} s of CPU", flush=True)
    minutes = len(rows) * o.seconds / 60
    goals, drops, used = (sum(row[key] for row in rows) for key in ("goals", "drops", "cpu_seconds"))
    print(
        f"{o.policy}: {goals / minutes:.2f} goals and {drops / minutes:.2f} drops a minute, "
        f"{used / minutes / 60:.3f} s of CPU a second of the robot, {60 * goals / used:.2f} goals a minute of CPU"
        + (f", {STEP * goals / minutes / 60:.2f} rad/s" if o.spin else "")
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
