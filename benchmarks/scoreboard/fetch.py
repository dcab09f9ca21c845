"""FetchPush and FetchSlide of gymnasium-robotics by contact MPC: `python benchmarks/scoreboard/fetch.py push --json`.

An arm brings a block (push) or a puck (slide) on a table to a place, in 50 steps of 0.04 s. Each component of an action
moves the mocap body that the gripper is welded to, by at most 5 cm from where the gripper is. Success is the
environment's flag `is_success` after the last step: the object within 5 cm of its goal.

The policy is given the environment's observation and what its MJCF says: sizes, masses, friction, stiffness of the
weld. Nothing is learned, and nothing is simulated: it plans with a planar contact LCS, the two closed fingers a disc.

Settings were chosen with seeds from 1000 on; figures are those of seeds 5000 and up. Times are CPU times of the policy.
It needs `pip install gymnasium-robotics`.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from successes import success_figures

from difflcs import GoalCost, LCSMPCLayer
from difflcs.physics import PlanarPushing, box
from difflcs.planning import DiscPlaces, PlanarTravel, SamplingPolicy, SamplingSettings

STEPS, SECONDS, REACH = 50, 0.04, 0.05  # of an episode, of a step; how far an action of 1 moves the mocap body [m]
STRIDE = 0.0325  # how far the gripper goes in each step at an action of 1 [m]
NEAR = 0.015  # from the goal, where the gripper stops [m]
HEIGHT = 0.418  # of the gripper's site above the floor, fingers just above the table [m]


@dataclass
class Options:
    """FetchPush or FetchSlide by contact MPC."""

    task: tyro.conf.Positional[Literal["push", "slide"]]
    """FetchPush-v4 or FetchSlide-v4."""
    episodes: int = 500
    """Episodes, of seeds `seed`, `seed` + 1, …"""
    seed: int = 0
    """Seed of the first episode."""
    json: bool = False
    """Print a line of JSON."""


def make_env(task: str) -> Any:
    """Make the environment as it is published, for MuJoCo 4 as well."""
    import gymnasium_robotics
    from gymnasium_robotics.utils import mujoco_utils

    # With MuJoCo 4 the kinds of joints are no longer equal to their numbers, which an assertion there expects.
    kinds = SimpleNamespace(**{name: int(kind) for name, kind in mujoco.mjtJoint.__members__.items()})
    mujoco_utils.mujoco = SimpleNamespace(**{**vars(mujoco), "mjtJoint": kinds})
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make("FetchPush-v4" if task == "push" else "FetchSlide-v4")


def fingers(model: Any) -> np.ndarray:
    """Half the width and depth of the two closed fingers together [m], as seen from above."""
    finger = model.geom("robot0:r_gripper_finger_link")
    aside = model.body("robot0:r_gripper_finger_link").pos[1] + finger.pos[1] + finger.size[1]
    return np.array([finger.size[2], aside])


def friction_with_table(model: Any) -> float:
    """Coefficient of friction of object and table: the larger of the two geoms', as MuJoCo combines them."""
    table = model.geom(model.body("table0").geomadr[0])
    return float(max(model.geom("object0").friction[0], table.friction[0]))


def place_of_rest(seen: np.ndarray, friction: float) -> np.ndarray:
    """Return where an object that slides on the table comes to rest (2,), if nothing pushes it: v² / 2 μ g ahead."""
    velocity = (seen[14:16] + seen[20:22]) / SECONDS  # the environment gives ways in a step, relative to the gripper
    return seen[3:5] + velocity * np.linalg.norm(velocity) / (2 * 9.81 * friction)


class PushPolicy:
    """Sampling-based contact MPC of a block that moves only while it is pushed."""

    def __init__(self, model: Any):
        block, tip, corner = model.geom("object0"), float(fingers(model).mean()), float(np.linalg.norm(fingers(model)))
        self.friction = friction_with_table(model)
        friction = max(block.friction[0], model.geom("robot0:r_gripper_finger_link").friction[0])
        half = block.size[:2]
        outline = box(-half[0], half[0], -half[1], half[1])
        system = PlanarPushing(outline, tip, friction=float(friction), length=0.02)
        cost = GoalCost.reach(5, 2, goal_weight=(100.0, 100.0, 0.01), input_weight=200.0)
        mpc = LCSMPCLayer(system, cost, 8, -0.02, 0.02, on_failure="mask", relaxation=1e-5)
        self.policy = SamplingPolicy(
            mpc,
            DiscPlaces(outline, corner, 24, gap=0.005, reach=0.02),
            PlanarTravel(outline, corner, step=0.032, clearance=0.01, tolerance=0.01),
            SamplingSettings(travel_price=0.5),
        )

    def reset(self) -> None:
        """Begin an episode."""
        self.policy.reset()

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """The action (4,) of the environment."""
        seen, goal = observation["observation"], observation["desired_goal"]
        rest = place_of_rest(seen, self.friction)
        if np.linalg.norm(rest - goal[:2]) < NEAR:
            return np.zeros(4)
        x = np.array([*rest, seen[13], *seen[:2]])
        u = self.policy.act(x, [*goal[:2], x[2]])
        return np.clip([*(u / STRIDE), (HEIGHT - seen[2]) / REACH, 0.0], -1.0, 1.0)


def play(env: Any, policy: Any, seed: int) -> tuple[bool, int, float, float]:
    """Play an episode: success, steps until the object first was at its goal, final distance [m], CPU time [s]."""
    observation, _ = env.reset(seed=seed)
    policy.reset()
    seconds, first, info = 0.0, STEPS, {}
    for step in range(STEPS):
        start = time.process_time()
        action = policy.act(observation)
        seconds += time.process_time() - start
        observation, _, _, _, info = env.step(action.astype(np.float32))
        if info["is_success"]:
            first = min(first, step + 1)
    away = float(np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"]))
    return bool(info["is_success"]), first, away, seconds


def main(o: Options) -> None:
    """Play the episodes, print the figures."""
    torch.set_num_threads(1)
    env = make_env(o.task)
    policy = PushPolicy(env.unwrapped.model)
    episodes = np.array([play(env, policy, seed) for seed in range(o.seed, o.seed + o.episodes)])
    success, first, away, seconds = episodes.T
    figures = {
        **success_figures(success),
        "mean_steps": float(first.mean()),
        "final_mm": 1e3 * float(np.median(away)),
        "milliseconds_per_step": 1e3 * float(seconds.sum()) / (STEPS * len(episodes)),
        "failed": [o.seed + int(i) for i in np.flatnonzero(success == 0)],
    }
    if o.json:
        print(json.dumps({"task": o.task, **figures}))
        return
    print(
        f"{o.task}: {100 * figures['success_rate']:.1f} % of {len(episodes)} ({100 * figures['ci_low']:.1f} to "
        f"{100 * figures['ci_high']:.1f}), at the goal after {first.mean():.1f} steps, {figures['final_mm']:.0f} mm "
        f"from it at the end, {figures['milliseconds_per_step']:.1f} ms a step; failed: {figures['failed']}"
    )
    env.close()


if __name__ == "__main__":
    main(tyro.cli(Options))
