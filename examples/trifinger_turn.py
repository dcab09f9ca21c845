"""Three fingers turn and move objects on a table: `python examples/trifinger_turn.py --assets DIR --objects cube,mug`.

Task and models are those of Jin's TriFinger (github.com/asu-iris/Complementarity-Free-Dexterous-Manipulation), whose
folder `envs` DIR has to be. An object lies within 5 cm of the middle at a yaw uniform in ±90°; its goal is drawn
likewise. A decision moves the targets of nine joints by at most 0.01 rad from where they are; torques follow them for
20 steps of 2 ms. Success: within 2 cm and 1 − (q·goal)² < 0.04 (23°) after each of 21 decisions in a row, of 500.

The controller knows model and state. It is that of the Allegro hand (`allegro_turn.py`) in small: a
quasi-dynamic `MujocoLCS` and a `MujocoCost`, linearised where robot and object are; a planned step is tried in MuJoCo,
and where the object comes no nearer the fingers let go, go round it or over it, and take it anew.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, field
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import tyro
from recorded import Recorded

from difflcs import LCSMPCLayer
from difflcs.errors import ContactWarning, InvalidInputError
from difflcs.mpc.backends import BatchedBackend
from difflcs.physics.mujoco import ContactGroup, Effort, MujocoCost, MujocoLCS, Orientation, Position
from difflcs.planning.mujoco import Rehearsal
from difflcs.rl import wilson_interval

HEIGHTS = {  # of the objects' centres at the start and at the goal, as published [m]
    "airplane": 0.015,
    "binoculars": 0.04,
    "bowl": 0.023,
    "bunny": 0.03,
    "camera": 0.03,
    "can": 0.033,
    "cube": 0.03,
    "cup": 0.025,
    "elephant": 0.03,
    "foambrick": 0.025,
    "mug": 0.033,
    "piggy_bank": 0.035,
    "rubber_duck": 0.05,
    "stick": 0.018,
    "teapot": 0.028,
    "torus": 0.018,
    "water_bottle": 0.055,
}
JOINTS = np.tile([0.0, -0.7, -1.1], 3)
FINGERS = "fingertip_0", "fingertip_120", "fingertip_240"
ELBOWS = "finger_lower_link_0", "finger_lower_link_120", "finger_lower_link_240"
STIFFNESS, DAMPING = 10.0, 0.05  # of the torques, as published [Nm/rad, Nms/rad]
LIMIT, HELD, SUBSTEPS, DECISIONS, SECONDS = 0.01, 21, 20, 500, 0.04


@dataclass(frozen=True)
class Settings:
    """Of the controller, the same for all objects."""

    horizon: int = 4
    friction: float = 0.5
    inertia: float = 5.0
    """Factor of the inertia of rotation."""
    compliance: float = 0.1
    relaxation: float = 1e-3
    place: float = 2000.0
    turn: float = 18.75
    reach: float = 0.5
    """Angle up to which a goal that is farther away pulls harder [rad]."""
    near: float = 8.0
    """Weight of the distances of fingertips from what they are drawn to."""
    effort: float = 2.0
    pace: float = 3.0
    """Duration of a step of the plan, in decisions."""
    paces: tuple[float, ...] = (1.0, 0.4)
    """Factors by which the planned step is tried in MuJoCo, the fastest first; none: it is executed untried."""
    gain: float = 0.02
    """Cost by which a step has to end better than now for no slower one to be tried."""
    slack: float = 0.005
    """Cost by which a faster step may end worse than the best."""
    upright: float = 50.0
    """Cost of a tilt, as the square of its sine, in the trials: nothing sets an object upright again."""
    ring: float = 0.05
    """Distance from the object's middle of the points to which fingertips are drawn while they push [m]."""
    patience: int = 25
    """Decisions without progress after which the fingers let go and take the object anew."""
    opening: int = 150
    """Decisions after which they push again, even if they are not there."""
    clear: float = 0.02
    """Height above the object at which a fingertip passes over it [m]."""
    apart: float = 0.02
    """Distance from the object's box of the points to which they go [m]."""
    margin: float = 0.012
    """Distance from the box within which it is in a fingertip's way [m]."""


@dataclass
class Options:
    """Three fingers that turn and move objects on a table."""

    assets: Path
    """Folder `envs` of the published code, with its `xmls` and `assets`."""
    objects: str = "all"
    """Names with commas; all: those that are there."""
    episodes: int = 20
    """Episodes of each object, of seeds `seed`, `seed` + 1, …"""
    seed: int = 0
    """Seed of the first episode."""
    out: Path | None = None
    """Where episodes are recorded, a line of JSON each, and not played again."""
    settings: Settings = field(default_factory=Settings)


def yaw_quaternion(angle: float) -> np.ndarray:
    """Quaternion of a turn about the vertical."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def make_task(folder: Path, name: str, seed: int) -> tuple[Any, Any, Any, np.ndarray, np.ndarray]:
    """Model, the same with servos and weightless fingers, data at the start, target place and target quaternion."""
    random = np.random.RandomState(100 + seed)
    xy, yaw = 0.1 * random.rand(2) - 0.05, -np.pi * random.rand() + np.pi / 2
    place = np.append(0.1 * random.rand(2) - 0.05, HEIGHTS[name])
    goal = yaw_quaternion(np.pi * random.rand() - np.pi / 2)
    spec = mujoco.MjSpec.from_file(str(folder / "xmls" / f"env_trifinger_{name}.xml"))
    model = spec.compile()
    for motor in spec.actuators:
        motor.set_to_position(kp=STIFFNESS, kv=DAMPING)
    for body in spec.bodies:
        if body.name.startswith("finger_"):
            body.gravcomp = 1.0
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([xy, [HEIGHTS[name]], yaw_quaternion(yaw), JOINTS])
    mujoco.mj_forward(model, data)
    return model, spec.compile(), data, place, goal


def follow(model: Any, data: Any, target: np.ndarray) -> None:
    """Simulate a decision: torques that draw the joints to a target, as published."""
    for _ in range(SUBSTEPS):
        mujoco.mj_forward(model, data)
        data.ctrl[:] = STIFFNESS * (target - data.qpos[7:]) - DAMPING * data.qvel[6:] + data.qfrc_bias[6:]
        mujoco.mj_step(model, data)


def find_tips(data: Any) -> np.ndarray:
    """Places (3, 3) of the fingertips."""
    return np.array([data.site(finger).xpos for finger in FINGERS])


class Policy:
    """Contact MPC: a quasi-dynamic system and a cost in task space, both linearised where robot and object are."""

    def __init__(self, model: Any, data: Any, place: np.ndarray, goal: np.ndarray, settings: Settings):
        self.settings, self.place, self.goal, self.twin = settings, place, goal, model.__copy__()
        s, model = settings, model.__copy__()
        self.twin.opt.timestep, self.twin.opt.tolerance = 0.004, 1e-5
        self.twin.geom_condim[:] = np.minimum(self.twin.geom_condim, 4)
        self.trials = Rehearsal(self.twin, SECONDS, self.miss, s.gain, s.slack)
        model.body_inertia[model.body("obj").id] *= s.inertia
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self.module = MujocoLCS(
            model,
            data,
            motion="quasi-dynamic",
            seconds=s.pace * SECONDS,
            torsion=False,
            contacts=[
                ContactGroup(("obj", "table"), 4),
                *(ContactGroup(("obj", finger), 2) for finger in FINGERS),
                ContactGroup(None, 3, friction=False, distance=0.01),
            ],
            distance=0.04,
            friction=s.friction,
            compliance=s.compliance,
            length=0.03,
            limits=0,
        )
        cost = MujocoCost(
            self.module,
            [
                Position("body:obj", weight=0.0, weight_final=s.place),
                Orientation("body:obj", weight=0.0, weight_final=s.turn, reach=s.reach),
                *(Position(f"site:{finger}", weight=s.near, weight_final=0.0) for finger in FINGERS),
                Effort(s.effort),
            ],
        )
        far = s.pace * LIMIT
        solver = BatchedBackend(restarts=1, threads=1)
        self.mpc = LCSMPCLayer(self.module, cost, s.horizon, -far, far, solver, s.relaxation).controller()
        self.random, self.best, self.waited, self.times = np.random.RandomState(0), np.inf, 0, []
        self.geom = model.geom("obj").id
        self.turned, self.spots = 0.0, np.zeros((3, 3))

    def angle(self, data: Any) -> float:
        """Angle by which the object is still to be turned [rad]."""
        return 2 * np.arccos(min(1.0, abs(float(data.qpos[3:7] @ self.goal))))

    def stalls(self, data: Any) -> bool:
        """Tell whether the object has not come nearer for too long: then the fingers let go for some decisions."""
        s, left = self.settings, self.angle(data) + 20 * float(np.linalg.norm(data.qpos[:2] - self.place[:2]))
        self.waited += 1
        if self.waited > 0 and left < max(self.best - 0.05, 0.4):
            self.best, self.waited = min(left, self.best), 0
        if self.waited > s.patience:
            self.best, self.waited = np.inf, -s.opening
        return self.waited < 0

    def around(self, data: Any, apart: float | None = None) -> np.ndarray:
        """Points (3, 3) round the object for the fingertips: one of them is behind it as seen from its place, or two.

        Of the ways to share them out, that which is nearest to where the fingers' elbows are: a finger cannot reach
        over the object. The points lie on the ring, or so far from the box of the object.
        """
        s, here = self.settings, data.qpos[:3]
        away, elbows = here - self.place, np.array([data.body(elbow).xpos for elbow in ELBOWS])
        if apart is None and np.linalg.norm(away[:2]) < 0.01:
            return np.tile(here, (3, 1))
        behind, outside = (np.arctan2(*vector[..., 1::-1].T) for vector in (away, elbows - here))
        thirds = np.array([0.0, 2.0, -2.0]) * np.pi / 3
        ways = [behind + half + thirds[[*order]] for half in (0.0, np.pi) for order in permutations(range(3))]
        turns = (np.array(ways) - outside + np.pi) % (2 * np.pi) - np.pi
        angles = ways[np.sum(turns**2, 1).argmin()] + self.turned
        directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], -1)
        if apart is None:
            return here + s.ring * directions
        middle, axes, half = self.box(data)
        return middle + (apart + np.abs(directions @ axes) @ half)[:, None] * directions

    def box(self, data: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Middle (3,), axes (3, 3) and half sizes (3,) of the box of the object."""
        box, axes = self.twin.geom_aabb[self.geom], data.geom_xmat[self.geom].reshape(3, 3)
        return data.geom_xpos[self.geom] + axes @ box[:3], axes, box[3:]

    def approach(self, data: Any) -> np.ndarray | None:
        """Next points (3, 3) of the fingertips on their ways to `spots`, over the object where it is in the way.

        None: they are there.
        """
        s, tips, points = self.settings, find_tips(data), self.spots.copy()
        middle, axes, half = self.box(data)
        top = middle[2] + np.abs(axes[2]) @ half + s.clear
        for tip, point in zip(tips, points, strict=True):
            path = np.linspace(tip[:2], point[:2], 12)
            inside = np.abs(np.column_stack([path - middle[:2], np.zeros(12)]) @ axes) < half + s.margin
            if np.linalg.norm(path[-1] - path[0]) > 0.01 and inside.all(1).any():
                if tip[2] < top - 0.005:
                    point[:2] = tip[:2]
                point[2] = top
        return points if np.abs(self.spots - tips).max() > 0.015 else None

    def reach(self, data: Any, points: np.ndarray) -> np.ndarray:
        """Targets of the joints that bring the fingertips nearer to points (3, 3)."""
        jacobian, moves = np.zeros((3, self.twin.nv)), []
        for i, finger in enumerate(FINGERS):
            mujoco.mj_jacSite(self.twin, data, jacobian, None, self.twin.site(finger).id)
            own = jacobian[:, 6 + 3 * i : 9 + 3 * i]
            move = np.linalg.solve(own.T @ own + 1e-4 * np.eye(3), own.T @ (points[i] - data.site(finger).xpos))
            moves.append(move * min(1.0, LIMIT / np.abs(move).max()))
        return data.qpos[7:] + np.concatenate(moves)

    def act(self, data: Any) -> np.ndarray:
        """Targets of the joints for the next decision."""
        s = self.settings
        if self.stalls(data):
            self.mpc.reset()
            if self.waited == -s.opening:
                self.turned = 0.5 * self.random.randn()
                self.spots = self.around(data, s.apart)
                self.spots[:, 2] = self.place[2]
            points = self.approach(data)
            if points is not None:
                return self.reach(data, points)
            self.waited = 0
        begun = time.thread_time()
        points = self.around(data)
        action = self.mpc.step(self.module.observe(data), np.concatenate([self.place, self.goal, *points]))
        move = np.clip(action / s.pace, -LIMIT, LIMIT)
        tries = [data.qpos[7:] + pace * move for pace in s.paces or (1.0,)]
        target = self.trials.choose(data, tries) if s.paces else tries[0]
        self.times.append(1e3 * (time.thread_time() - begun))
        return target

    def miss(self, data: Any) -> float:
        """Cost of the object's place and tilt, 0.1 s later if nothing stops it, and of its orientation."""
        s, left = self.settings, self.angle(data)
        square = float(np.sum((data.qpos[:3] + 0.1 * data.qvel[:3] - self.place) ** 2))
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, data.qpos[3:7])
        axes = axes.reshape(3, 3)
        up = axes[:, 2] + 0.1 * np.cross(axes @ data.qvel[3:6], axes[:, 2])
        near = min(left, s.reach)
        return s.place * square + s.turn * near * (2 * left - near) + s.upright * float(up[:2] @ up[:2])


def play(o: Options, name: str, seed: int) -> dict[str, Any]:
    """One episode."""
    model, servos, data, place, goal = make_task(o.assets, name, seed)
    policy, held, steps = Policy(servos, data, place, goal, o.settings), 0, 0
    while held < HELD and steps < DECISIONS:
        follow(model, data, policy.act(data))
        wrong, apart = 1 - float(data.qpos[3:7] @ goal) ** 2, float(np.linalg.norm(data.qpos[:3] - place))
        held = (held + 1) * (wrong < 0.04 and apart < 0.02)
        steps += 1
    return {
        "object": name,
        "seed": seed,
        "success": held == HELD,
        "steps": steps,
        "position_mm": 1e3 * apart,
        "angle_deg": 2 * np.degrees(np.arcsin(np.sqrt(np.clip(wrong, 0, 1)))),
        "milliseconds": float(np.mean(policy.times)),
    }


def is_there(folder: Path, name: str) -> bool:
    """Tell whether the files of an object can be read: not all of its meshes may have been copied."""
    try:
        make_task(folder, name, 0)
    except (OSError, ValueError):
        return False
    return True


def choose_objects(asked: str, there: list[str], assets: Path, files: str) -> list[str]:
    """Return the names that are asked for, "all" or some with commas between them, if they are there."""
    names = there if asked == "all" else asked.split(",")
    if not names or set(names) - set(there):
        raise InvalidInputError(
            f"objects: expected some of {', '.join(there) or 'nothing'}, whose files are in {assets}, got "
            f"{asked!r}; pass --assets DIR with the published xmls/{files}"
        )
    return names


def main(o: Options) -> None:
    """Play, print, record."""
    there = [name for name in HEIGHTS if is_there(o.assets, name)]
    names = choose_objects(o.objects, there, o.assets, "env_trifinger_*.xml")
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)
    recorded = Recorded(partial(play, o), o.out)
    for name in [*names, "all"]:
        rows = recorded.episodes((n, o.seed + i) for n in names for i in range(o.episodes) if name in (n, "all"))
        good = [e for e in rows if e["success"]]
        low, high = wilson_interval(len(good), len(rows))
        means = {
            k: np.mean([e[k] for e in good or rows]) for k in ("steps", "position_mm", "angle_deg", "milliseconds")
        }
        text = ", ".join(f"{key} {value:.3g}" for key, value in means.items())
        print(f"{name}: {len(good)} of {len(rows)} ({100 * low:.1f} to {100 * high:.1f} %); {text}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
