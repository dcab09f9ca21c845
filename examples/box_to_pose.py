"""A sphere pushes a box to poses in the plane, in MuJoCo: `python examples/box_to_pose.py [--goals 200]`.

A free box of 14 by 10 cm lies on a floor with friction; a sphere of 1.5 cm is held at half its height by two position
servos. Both are simulated in space, at 500 Hz. Goals are up to 20 cm and half a turn away, and the sphere always starts
on the wrong side, between the box and its goal. A goal is reached when the box is within 1 cm and 0.1 rad of it, in at
most 150 steps of 0.1 s. The policy is sampling-based contact MPC (`difflcs.planning`) with the quasi-static system of
the same model (`difflcs.physics.mujoco`), with the box on joints in the plane. No data, no learning; it knows the model
and the true state.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs import GoalCost, LCSMPCLayer
from difflcs.cli.bench import machine, save
from difflcs.physics import box
from difflcs.physics.mujoco import MujocoLCS
from difflcs.planning import DiscPlaces, PlanarTravel, SamplingPolicy, SamplingSettings
from difflcs.rl import wilson_interval

HALF, RADIUS = (0.07, 0.05), 0.015  # of the box's sides and of the sphere [m]
STEPS, SECONDS = 150, 0.1  # of an episode, of a step [s]
NEAR, ALIGNED = 0.01, 0.1  # [m, rad]
WEIGHT, FINAL, EFFORT = (100.0, 100.0, 0.36), (400.0, 400.0, 1.44), 3.0  # of the pose: 0.1 rad as much as 6 mm

WORLD = """
<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
<worldbody>
  <geom type="plane" size="2 2 .1" friction=".4"/>
  <body name="box" pos="0 0 .05">{joints}<geom type="box" size=".07 .05 .05" mass=".5" friction=".4"/></body>
  <body name="pusher" pos="0 0 .05">
    <joint name="px" type="slide" axis="1 0 0"/><joint name="py" type="slide" axis="0 1 0"/>
    <geom type="sphere" size=".015" mass=".2" friction=".4"/>
  </body>
</worldbody>
<actuator><position joint="px" kp="1000" dampratio="1"/><position joint="py" kp="1000" dampratio="1"/></actuator>
</mujoco>"""
PLANE = """<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
  <joint name="yaw" type="hinge" axis="0 0 1"/>"""


@dataclass
class Options:
    """A sphere pushes a box to poses."""

    goals: int = 200
    """Goals, each with a start."""
    seed: int = 1000
    """Of the first goal; the next have the next."""
    out: Path = Path("benchmarks/results/box_to_pose.json")
    """Path of the JSON output."""
    smoke: bool = False
    """Two goals only."""


class Faces(DiscPlaces):
    """Places beside the faces of the box: at a corner, one half plane says little of what a push does."""

    def sample(self, x: Tensor) -> Tensor:
        """Sample places; see `Places`."""
        ring = super().sample(x)
        return ring[(ring.abs() < 0.85 * ring.new_tensor(HALF)).any(-1)]


def make_policy() -> tuple[SamplingPolicy, MujocoLCS]:
    """Make the policy and the system that it plans with: state (x, y, yaw of the box; x, y of the sphere)."""
    module = MujocoLCS(mujoco.MjModel.from_xml_string(WORLD.format(joints=PLANE)))
    cost = GoalCost.reach(5, 2, goal_weight=WEIGHT, goal_weight_final=FINAL, input_weight=EFFORT)
    mpc = LCSMPCLayer(module, cost, 10, -0.03, 0.03, relaxation=1e-5, on_failure="mask")
    shape = box(-HALF[0], HALF[0], -HALF[1], HALF[1])
    travel = PlanarTravel(shape, RADIUS, step=0.06, tolerance=0.004)
    settings = SamplingSettings(travel_price=0.2)
    return SamplingPolicy(mpc, Faces(shape, RADIUS, 64), travel, settings, angles=(2,)), module


class Scene:
    """The box and the sphere in space.

    Args:
        module: the system of the policy, which says what control an action is.

    Attributes:
        goal: x, y [m] and yaw [rad] of the box.
    """

    def __init__(self, module: MujocoLCS):
        self.module, self.model = module, mujoco.MjModel.from_xml_string(WORLD.format(joints="<freejoint/>"))
        self.data, self.goal = mujoco.MjData(self.model), np.zeros(3)

    def start(self, seed: int) -> None:
        """Draw a start and a goal, with the sphere between the box and its goal."""
        mujoco.mj_resetData(self.model, self.data)
        random = np.random.default_rng(seed)
        x, y, yaw = random.uniform(-1, 1, 3) * [0.1, 0.1, math.pi]
        self.goal = random.uniform(-1, 1, 3) * [0.2, 0.2, math.pi]
        towards = (self.goal[:2] - [x, y]) / np.linalg.norm(self.goal[:2] - [x, y])
        turn = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)
        self.data.qpos[:] = [x, y, 0.05, *turn, *([x, y] + 0.12 * towards)]

    @property
    def state(self) -> np.ndarray:
        """The state of the policy's system."""
        q: Any = self.data.qpos
        return np.array([q[0], q[1], 2 * math.atan2(q[6], q[3]), q[7], q[8]])

    def error(self) -> float:
        """Return the distance to the goal, 1 where the box begins to be there."""
        left = self.state[:3] - self.goal
        return max(math.hypot(left[0], left[1]) / NEAR, abs(wrapped(left[2])) / ALIGNED)

    def step(self, u: np.ndarray) -> None:
        """Execute an action for 0.1 s."""
        self.data.ctrl[:] = self.module.control(torch.from_numpy(self.state), torch.from_numpy(u)).numpy()
        mujoco.mj_step(self.model, self.data, round(SECONDS / self.model.opt.timestep))


class Episode(NamedTuple):
    """One goal: whether it was reached, in how many steps, and seconds of CPU time for each decision."""

    success: bool
    steps: int
    seconds: float


def wrapped(angle: float) -> float:
    """Wrap an angle into [−π, π)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def play(seed: int, policy: SamplingPolicy, module: MujocoLCS) -> Episode:
    """Start on the wrong side, and go on until the goal is reached."""
    scene, used = Scene(module), 0.0
    scene.start(seed)
    policy.reset()
    for step in range(STEPS + 1):
        if scene.error() < 1:
            return Episode(True, step, used / max(step, 1))
        start = time.process_time()
        u = policy.act(scene.state, scene.goal)
        used += time.process_time() - start
        scene.step(u)
    return Episode(False, STEPS, used / STEPS)


def main(o: Options) -> None:
    """Run the episodes, print and write the figures."""
    if o.smoke:
        o.goals = 2
    torch.set_num_threads(1)
    policy, module = make_policy()
    episodes = [play(o.seed + k, policy, module) for k in range(o.goals)]
    successes, steps, seconds = (float(np.mean(values)) for values in zip(*episodes, strict=True))
    low, high = wilson_interval(round(successes * o.goals), o.goals)
    results = {"success_rate": successes, "ci_low": low, "ci_high": high, "goals": o.goals, "mean_steps": steps}
    results["milliseconds_per_step"] = 1e3 * seconds
    for name, value in results.items():
        print(f"{name:24s} {value:.4g}")
    if not o.smoke:
        options = {"goals": o.goals, "seed": o.seed}
        save(o.out, {"machine": {**machine(), "mujoco": mujoco.__version__}, "options": options, "results": results})


if __name__ == "__main__":
    main(tyro.cli(Options))
