"""In-hand turning by an Allegro hand: `python examples/allegro_turn.py --assets DIR --episodes 20 --json`.

Task and models are those of Jin (github.com/asu-iris/Complementarity-Free-Dexterous-Manipulation, 17 objects, 96.5 %
over all its tasks) and of IMPACT (github.com/JonasPflaume/IMPACT, MIT, 155 of 170), whose folders `xmls` and `assets`
DIR has to contain; or set DIFFLCS_INHAND_DIR. An object lies on the palm, its place normally distributed by 5 mm, its
yaw uniform in ±90°; the goal is 90° of yaw away, to either side. A decision moves the targets of 16 joint servos by
at most 0.1 rad, 0.2 rad for objects of 100 g, from where the joints are, and holds them for 50 steps of 2 ms.

- Success: 1 − (q·goal)² < 0.04, which is 23°, after each of 21 decisions in a row.
- Failure: 500 decisions, or the object's centre below 5 mm.
- An object is placed if it is within 2 cm of its target place as well: of a success at its end, or with `--position`,
  which plays on for it, in 21 decisions in a row.

Beyond the papers, `--axes any` turns by 30° to 90° about any axis, `--seconds 60` gives the next goal where one is
reached, until the object falls or the time is over, and `--tilt 30` inclines the hand. They can be combined.

The controller knows model and state, and tries each step in MuJoCo before it is executed. Nothing is learned. One set
of settings serves all objects, chosen with seeds below 1500. Final figures are of seeds 5000 and up. Times are CPU
times of one core.
"""

from __future__ import annotations

import copy
import json
import os
import time
import warnings
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import torch
import tyro
from recorded import Recorded
from successes import success_figures, success_text
from trifinger_turn import choose_objects, yaw_quaternion

from difflcs import LCSMPCLayer
from difflcs.cli.bench import machine, save
from difflcs.errors import ContactWarning
from difflcs.mpc.backends import BatchedBackend
from difflcs.physics.mujoco import Effort, MujocoCost, Orientation, Position
from difflcs.planning.mujoco import Rehearsal
from difflcs_envs.tasks import hand_system

OBJECTS = {  # place of the start [m], its height, and the target place, as published
    "airplane": ((-0.03, -0.01), 0.03, (-0.02, -0.01, 0.03)),
    "binoculars": ((-0.03, 0.0), 0.04, (-0.01, 0.0, 0.04)),
    "bowl": ((-0.03, 0.0), 0.04, (-0.03, -0.01, 0.04)),
    "bunny": ((-0.03, 0.0), 0.04, (0.0, 0.0, 0.04)),
    "camera": ((-0.03, 0.0), 0.04, (-0.01, 0.0, 0.04)),
    "can": ((-0.02, 0.0), 0.04, (-0.01, 0.0, 0.06)),
    "cube": ((-0.03, -0.01), 0.04, (-0.01, 0.0, 0.05)),
    "cup": ((-0.03, 0.0), 0.03, (0.0, 0.0, 0.03)),
    "elephant": ((-0.02, 0.0), 0.04, (-0.01, 0.0, 0.04)),
    "foambrick": ((-0.01, 0.0), 0.04, (-0.01, 0.0, 0.04)),
    "mug": ((0.0, 0.0), 0.04, (0.0, 0.0, 0.04)),
    "piggy_bank": ((0.0, 0.0), 0.04, (0.0, 0.0, 0.04)),
    "rubber_duck": ((-0.02, 0.0), 0.05, (0.0, 0.0, 0.05)),
    "stick": ((-0.01, 0.0), 0.03, (-0.01, 0.0, 0.03)),
    "teapot": ((-0.02, 0.0), 0.05, (0.0, 0.0, 0.05)),
    "torus": ((-0.02, 0.0), 0.04, (0.0, 0.0, 0.04)),
    "water_bottle": ((-0.02, 0.0), 0.06, (0.0, 0.0, 0.06)),
}
JOINTS = (0.125, 1.13, 1.45, 1.24, -0.02, 0.445, 1.17, 1.5, -0.459, 1.54, 1.11, 1.23, 0.638, 1.85, 1.5, 1.26)
LINKS = "base", "proximal", "medial", "distal", "tip"
FINGERS = [[f"{finger}_{link}" for link in LINKS] for finger in ("ff", "mf", "rf", "th")]
LONG = 0.12  # length from which on an object does not turn on the palm without touching the base of the thumb [m]
ASIDE = (0.01, -0.01, 0.0), (0.03, 0.03, 0.02)  # from its place to where it can
SECONDS, TRIALS, OPENING = 0.1, 20, 8  # of a decision; steps in which it is tried; decisions for which the hand opens
COLUMNS = "object", "seed", "success", "placed", "dropped", "steps", "position_mm", "angle_deg", "goals"
PARTS = "plan", "rehearsal"
LIMIT, HELD, SUBSTEPS, LOST = 500, 21, 50, 0.005


def make_task(folder: Path, name: str, seed: int) -> tuple[Any, Any, np.ndarray, np.ndarray]:
    """Model, data at the start, target place and target quaternion, drawn as the papers draw them."""
    random = np.random.RandomState(100 + seed)
    start, height, place = OBJECTS[name]
    xy = np.array(start) + 0.005 * random.randn(2)
    yaw = np.pi * random.rand() - np.pi / 2
    goal = yaw_quaternion(yaw + random.choice([-np.pi / 2, np.pi / 2]))
    model = mujoco.MjModel.from_xml_path(str(folder / "xmls" / f"env_allegro_{name}.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([JOINTS, xy, [height], yaw_quaternion(yaw)])
    mujoco.mj_forward(model, data)
    return model, data, np.array(place), goal


@dataclass(frozen=True)
class Settings:
    """Of the controller, the same for all objects."""

    horizon: int = 2
    friction: float = 0.5
    inertia: float = 5.0
    """Factor of the inertia of rotation."""
    compliance: float = 0.1
    relaxation: float = 1e-3
    place: float = 4000.0
    """So high against `turn` and `reach` that the object is not turned off the palm."""
    turn: float = 18.75
    reach: float = 0.5
    """Angle up to which a goal that is farther away pulls harder [rad]."""
    near: float = 8.0
    """Weight of the distances of fingertips from what they are to touch: the middle of the object, and after the hand
    has opened points that are drawn in its box; and of the thumb from its place behind the object."""
    behind: float = 0.03
    """So far towards the wrist it is from the object's place: nothing else can push the object back from there [m]."""
    wide: float = 0.02
    """Distance from its place at which an object is drawn there twice as hard for each metre as near it [m]."""
    effort: float = 0.2
    patience: int = 25
    """Decisions without progress after which the hand opens, and takes the object anew."""
    turned: float = 0.6
    """Angle from which on the object is drawn to its place again after an opening [rad]."""
    pace: float = 0.5
    """Part of the published limit of actions that is used, as drops come from fast motion."""
    paces: tuple[float, ...] = (2.0, 0.7)
    """Factors by which the planned step is tried in MuJoCo, the fastest first; none: it is executed untried."""
    gain: float = 0.1
    """Cost by which a step has to end better than now for no slower one to be tried."""
    slack: float = 0.02
    """Cost by which a faster step may end worse than the best."""
    worse: float = 4.0
    """Cost by which all have to end worse than now for the hand to try to stay as it is as well."""


class HandPolicy:
    """Contact MPC: a quasi-dynamic system and a cost in task space, both linearised where hand and object are."""

    def __init__(self, model: Any, data: Any, place: np.ndarray, goal: np.ndarray, settings: Settings):
        self.settings = s = settings
        self.twin, self.place, model = copy.copy(model), place, copy.copy(model)
        self.twin.opt.timestep, self.twin.opt.impratio, self.twin.opt.tolerance = SECONDS / TRIALS, 1.0, 1e-5
        self.twin.geom_condim[:] = np.minimum(self.twin.geom_condim, 4)  # nothing rolls far
        self.trials = Rehearsal(self.twin, SECONDS, self.miss, s.gain, s.slack, s.worse)
        model.body_inertia[model.body("obj").id] *= s.inertia
        mujoco.mj_setConst(model, mujoco.MjData(model))  # simple bodies have it twice
        self.limit = 0.1 if model.body("obj").mass[0] < 0.05 else 0.2
        self.module = hand_system(
            model, object="obj", fingers=FINGERS, data=data, friction=s.friction, compliance=s.compliance, limits=0
        )  # no limits, as actions are within them already
        cost = MujocoCost(
            self.module,
            [
                Position("body:obj", weight=0.0, weight_final=s.place),
                Orientation("body:obj", weight=0.0, weight_final=s.turn, reach=s.reach),
                *(Position(f"ftp_{i}", weight=s.near, weight_final=0.0) for i in range(4)),
                Effort(s.effort),
            ],
        )
        solver, far = BatchedBackend(restarts=1, threads=1), s.pace * self.limit
        self.mpc = LCSMPCLayer(self.module, cost, s.horizon, -far, far, solver, s.relaxation).controller()
        self.random, self.posture, self.ctrl = np.random.RandomState(0), None, data.qpos[:16].copy()
        self.geom, self.spots = model.geom("obj").id, np.zeros((4, 3))
        self.aim(goal)
        self.mpc.step(self.module.observe(data), np.concatenate([place, goal, np.zeros(12)]))  # the first takes longer
        self.mpc.reset()

    def aim(self, goal: np.ndarray) -> None:
        """Turn the object to this quaternion from now on."""
        self.goal, self.aimed, self.best, self.waited = goal, self.place, np.inf, 0

    def angle(self, data: Any) -> float:
        """Angle by which the object is still to be turned [rad]."""
        return 2 * np.arccos(min(1.0, abs(float(data.qpos[-4:] @ self.goal))))

    def stalls(self, data: Any) -> bool:
        """Tell whether the object has not come nearer for too long: then the hand opens for some decisions."""
        left = self.angle(data) + 20 * float(np.linalg.norm(data.qpos[-7:-4] - self.aimed))
        self.waited += 1
        if self.waited > 0 and left < max(self.best - 0.05, 0.5):  # by 3° or 2.5 mm, or it is almost there
            self.best, self.waited = min(left, self.best), 0
        if self.waited > self.settings.patience:
            self.best, self.waited = np.inf, -OPENING
            self.posture = JOINTS + (0.0 if self.posture is None else 0.3) * self.random.randn(16)
            size = self.twin.geom_aabb[self.geom, 3:]
            if max(size) > LONG / 2:
                self.aimed = self.place + self.random.uniform(*ASIDE)
            self.spots = self.random.uniform(-1, 1, (4, 3)) * size
        return self.waited < 0

    def plan(self, data: Any) -> np.ndarray:
        """Return by how much to move the targets of the servos from the joints [rad]."""
        if self.stalls(data):
            self.mpc.reset()
            return self.posture - data.qpos[:16]
        x, here = self.module.observe(data), data.qpos[-7:-4]
        grips = data.geom_xpos[self.geom] + self.spots @ data.geom_xmat[self.geom].reshape(3, 3).T
        grips[3] = here - [self.settings.behind, 0.0, 0.0]  # the thumb's
        if self.aimed is not self.place and self.angle(data) < self.settings.turned:
            self.aim(self.goal)
        bounds = {} if self.aimed is self.place else self.lay_flat(data, x)
        off = self.aimed - here
        beyond = off * min(1 + off @ off / self.settings.wide**2, 6.0)  # has the slope of the cost in `miss`
        goal = np.concatenate([here + beyond, self.goal, *grips])
        return self.mpc.step(x, goal, **bounds)  # which asks module and cost

    def lay_flat(self, data: Any, x: torch.Tensor) -> dict[str, torch.Tensor]:
        """Bounds of the actions by which the finger lies down into which the end of the object turns."""
        turn, far = np.zeros(4), self.settings.pace * self.limit
        mujoco.mju_mulQuat(turn, self.goal, data.qpos[-4:] * [1, -1, -1, -1])
        finger = slice(8, 12) if turn[0] * turn[3] > 0 else slice(0, 4)
        low, high = (bound.clamp(-far, far) for bound in self.module.action_bounds(x))
        move = torch.from_numpy(-data.qpos[finger]).clamp(low[finger], high[finger])
        low[finger], high[finger] = move - 1e-3, move + 1e-3
        return {"u_min": low, "u_max": high}

    def rehearse(self, data: Any, action: np.ndarray) -> np.ndarray:
        """MuJoCo's ctrl for the next 0.1 s: a step at the faster pace if it ends about as well, or none."""
        paces = self.settings.paces if self.waited >= 0 and self.settings.paces else (1.0,)
        tries = [data.qpos[:16] + np.clip(pace * action, -self.limit, self.limit) for pace in paces]
        last, self.ctrl = self.ctrl, self.trials.choose(data, tries, self.ctrl) if self.settings.paces else tries[0]
        if self.ctrl is last and self.waited < 0:  # to open in this way does harm
            self.posture = JOINTS + 0.3 * self.random.randn(16)
        return self.ctrl

    def miss(self, data: Any) -> float:
        """Cost of the object's place, where it is 0.1 s later if nothing stops it, and of its orientation."""
        s, left = self.settings, self.angle(data)
        square = float(np.sum((data.qpos[-7:-4] + SECONDS * data.qvel[-6:-3] - self.aimed) ** 2))
        near = min(left, s.reach)
        return s.place * square * (1 + square / (2 * s.wide**2)) + s.turn * near * (2 * left - near)


@dataclass
class Options:
    """In-hand turning with an Allegro hand."""

    assets: Path = Path(os.environ.get("DIFFLCS_INHAND_DIR", "."))
    """Folder with the published `xmls` and `assets`."""
    objects: str = "all"
    """Names with commas; all: those that are there."""
    episodes: int = 20
    """Episodes of each object, of seeds `seed`, `seed` + 1, …"""
    seed: int = 0
    """Seed of the first episode."""
    position: bool = False
    """Play on until the object is in its place as well, within 2 cm."""
    axes: Literal["vertical", "any"] = "vertical"
    """Goals are turns of ±90° about the vertical, or of 30° to 90° about any axis, both uniform."""
    seconds: float | None = None
    """Goals follow one another for so long, each from the last (vertical) or from where the object is (any)."""
    tilt: float = 0.0
    """Degrees by which the hand is inclined, to a side drawn for each episode."""
    json: bool = False
    """Print a line of JSON for each object and for all."""
    out: Path | None = None
    """Where episodes are recorded, a line of JSON each, and not played again: take another after a change."""
    results: Path | None = None
    """File for the figures of each object and of all, with their episodes."""
    settings: Settings = field(default_factory=Settings)


def next_goal(random: np.random.RandomState, axes: str, last: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Draw the quaternion of the goal after `last`, where the object's is `now`."""
    turned, turn = np.zeros(4), yaw_quaternion(random.choice([-np.pi / 2, np.pi / 2]))
    if axes == "any":
        axis = random.randn(3)
        mujoco.mju_axisAngle2Quat(turn, axis / np.linalg.norm(axis), random.uniform(np.pi / 6, np.pi / 2))
    mujoco.mju_mulQuat(turned, turn, now if axes == "any" else last)
    return turned


def play(o: Options, name: str, seed: int) -> dict[str, Any]:
    """One episode."""
    model, data, place, goal = make_task(o.assets, name, seed)
    random = np.random.RandomState(100 + seed)  # of what the papers do not have
    side, tilt = 2 * np.pi * random.rand(), np.radians(o.tilt)
    model.opt.gravity[:] = 9.81 * np.array([np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side), -np.cos(tilt)])
    if o.axes == "any":
        goal = next_goal(random, o.axes, goal, data.qpos[-4:])
    limit = LIMIT if o.seconds is None else round(o.seconds / SECONDS)
    policy, held, goals, lost, steps = HandPolicy(model, data, place, goal, o.settings), np.zeros(2), 0, False, 0
    turned, times = None, []  # after so many decisions; milliseconds
    while (goals == 0 or o.seconds is not None) and not lost and steps < limit:
        marks = [time.thread_time()]
        action = policy.plan(data)
        marks.append(time.thread_time())
        data.ctrl[:] = policy.rehearse(data, action)
        if policy.waited >= 0:  # it does not open
            times.append(1e3 * np.diff([*marks, time.thread_time()]))
        mujoco.mj_step(model, data, SUBSTEPS)
        wrong = 1 - float(data.qpos[-4:] @ goal) ** 2
        apart = float(np.linalg.norm(data.qpos[-7:-4] - place))
        held = (held + 1) * (wrong < 0.04) * [1, apart < 0.02]  # by the angle, and with the place
        lost, steps = bool(data.qpos[-5] < LOST), steps + 1
        if turned is None and held[0] == HELD and not lost:
            turned = steps
        if held[int(o.position)] == HELD and not lost:
            goals, held = goals + 1, np.zeros(2)
            goal = next_goal(random, o.axes, goal, data.qpos[-4:])
            policy.aim(goal)
    return {
        "object": name,
        "seed": seed,
        "success": turned is not None,
        "placed": goals > 0 and apart < 0.02,
        "goals": goals,
        "dropped": lost,
        "steps": turned or steps,
        "position_mm": 1e3 * apart,
        "angle_deg": 2 * np.degrees(np.arcsin(np.sqrt(np.clip(wrong, 0, 1)))),
        "milliseconds": np.mean(times, 0).tolist(),
        "all_milliseconds": np.round(np.sum(times, 1), 2).tolist(),
    }


def figures(episodes: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of episodes; place, angle and steps are medians and means of successful ones."""
    good = [e for e in episodes if e["success"]] or episodes
    parts = np.average([e["milliseconds"] for e in episodes], 0, [len(e["all_milliseconds"]) for e in episodes])
    return {
        **success_figures(np.array([e["success"] for e in episodes], float)),
        "placed": sum(e["placed"] for e in episodes),
        "dropped": sum(e["dropped"] for e in episodes),
        "mean_steps": float(np.mean([e["steps"] for e in good])),
        "mean_goals": float(np.mean([e["goals"] for e in episodes])),
        "position_mm": float(np.median([e["position_mm"] for e in good])),
        "angle_deg": float(np.median([e["angle_deg"] for e in good])),
        "milliseconds_per_step": dict(zip(PARTS, parts.round(2).tolist(), strict=True)),
        "milliseconds_p99": float(np.percentile(np.concatenate([e["all_milliseconds"] for e in episodes]), 99)),
    }


def main(o: Options) -> None:
    """Play, print, record."""
    there = [name for name in OBJECTS if (o.assets / "xmls" / f"env_allegro_{name}.xml").exists()]
    names = choose_objects(o.objects, there, o.assets, "env_allegro_*.xml")
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)
    recorded, results, episodes = Recorded(partial(play, o), o.out), {}, []
    for name in [*names, "all"]:
        keys = [(n, o.seed + i) for n in names for i in range(o.episodes) if name in (n, "all")]
        episodes = recorded.episodes(keys)
        results[name] = found = figures(episodes)
        text = ", ".join(f"{key} {value:.4g}" for key, value in found.items() if isinstance(value, (int, float)))
        print(json.dumps({"object": name, **found}) if o.json else f"{name}: {success_text(found)}; {text}", flush=True)
    if o.results is not None:
        asked = {key: getattr(o, key) for key in ("seed", "position", "axes", "seconds", "tilt")}
        record = {"machine": machine(), **asked, "settings": asdict(o.settings), "results": results}
        save(o.results, {**record, "columns": COLUMNS, "rows": [[e[c] for c in COLUMNS] for e in episodes]})


if __name__ == "__main__":
    main(tyro.cli(Options))
