"""FetchPush and FetchSlide of gymnasium-robotics by contact MPC: `python benchmarks/scoreboard/fetch.py push --json`.

An arm brings a block (push) or a puck (slide) on a table to a place, in 50 steps of 0.04 s. Each component of an action
moves the mocap body that the gripper is welded to, by at most 5 cm from where the gripper is. Success is the
environment's flag `is_success` after the last step: the object within 5 cm of its goal. The policies are those of
examples/fetch_policies.py, which know the model and the observation and have learned nothing.

Figures are those of seeds 5000 and up, times CPU times of the policy. It needs `pip install gymnasium-robotics`.
"""

# What needs gymnasium-robotics is imported where it is used; MuJoCo is a compiled module without type stubs.
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from successes import success_figures, success_text

sys.path.append(str(Path(__file__).resolve().parents[2] / "examples"))
from fetch_policies import STEPS, PushPolicy, SlidePolicy


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
    model, posture = env.unwrapped.model, env.unwrapped.initial_qpos
    policy = PushPolicy(model) if o.task == "push" else SlidePolicy(model, posture)
    episodes = np.array([play(env, policy, seed) for seed in range(o.seed, o.seed + o.episodes)])
    env.close()
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
        f"{o.task}: {success_text(figures)}, at the goal after {first.mean():.1f} steps, {figures['final_mm']:.0f} mm "
        f"from it at the end, {figures['milliseconds_per_step']:.1f} ms a step; failed: {figures['failed']}"
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
