"""An object is turned in the hand, through the physics of the hand's own model: `python examples/hand_turn.py`.

`difflcs/HandTurnObject-v0` is a hand of four fingers that faces up, with an object on its palm. At each decision
`HandPolicy` linearises its MuJoCo model where hand and object are, in quasi-dynamic motion, and solves a contact MPC of
four steps. Nothing is learned: it is given the model and the state. `--mass 3` and the like tell it a wrong model, and
`--run DIRECTORY` one that was learned by `difflcs train --method mujoco-lcs --task hand_unknown`. `--out hand.gif`
makes a film.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
import tyro

import difflcs_envs
from difflcs import Animation, LCSMPCLayer
from difflcs.errors import ContactWarning
from difflcs.mpc.backends import BatchedBackend
from difflcs.rl import TrainedPolicy
from difflcs.status import solved
from difflcs_envs.hand.model import OBJECTS, build_model
from difflcs_envs.tasks import HAND_GUESS, hand_cost, hand_system


class HandPolicy:
    """Contact MPC that is linearised where hand and object are; it opens the hand where nothing goes on.

    Args:
        model: MuJoCo's model of hand and object.
        pace: part of the action's limit that it uses, as what moves fast is thrown.
        patience: decisions without progress after which it opens the hand.
    """

    def __init__(self, model: Any, pace: float = 0.5, patience: int = 25):
        self.system, self.limit, self.patience = hand_system(model), 0.1 * pace, patience
        cost = hand_cost(self.system)
        self.mpc = LCSMPCLayer(
            self.system, cost, 4, -self.limit, self.limit, BatchedBackend(restarts=1, threads=1), 1e-3, "mask"
        )
        self.posture, self.guess, self.best, self.waited, self.openings = None, None, np.inf, 0, 0
        self.random = np.random.default_rng(0)

    def act(self, data: Any, goal: np.ndarray) -> np.ndarray:
        """Return by how much the targets of the servos are from the joints [rad], for 0.1 s."""
        if self.posture is None:
            self.posture = data.qpos[:16].copy()
        left = 2 * np.arccos(min(1.0, abs(float(data.qpos[-4:] @ goal[3:]))))
        self.waited += 1
        if self.waited > 0 and left < max(self.best - 0.05, 0.35):  # turned on by 3°, or almost there
            self.best, self.waited = min(left, self.best), 0
        if self.waited > self.patience:
            self.best, self.waited, self.openings = np.inf, -8, self.openings + 1  # it opens for 8 decisions
            self.target = self.posture + 0.3 * (self.openings > 1) * self.random.standard_normal(16)
        if self.waited < 0:
            self.guess = None
            return np.clip(self.target - data.qpos[:16], -0.1, 0.1)
        x = self.system.observe(data)  # rotations count from here
        with torch.no_grad():
            plan = self.mpc(x, torch.from_numpy(goal), guess=self.guess)
        self.guess = plan.shift() if bool(solved(plan.status)) else None
        return plan.action.numpy()


@dataclass
class Options:
    """Turn objects in the hand."""

    objects: str = ",".join(OBJECTS)
    """Names with commas."""
    episodes: int = 10
    """Episodes of each object."""
    seed: int = 5000
    """Seed of the first of them."""
    mass: float = 1.0
    friction: float = 1.0
    gain: float = 1.0
    """Factors of mass, friction and servo gain in the model that it plans with."""
    run: Path | None = None
    """Run of `mujoco-lcs` on `hand_unknown`, whose factors are these three instead."""
    steps: int = 300
    """Most decisions of an episode; it ends after 21 in a row at the goal, or when the object is dropped."""
    out: Path | None = None
    """Where a film at twice the speed goes, .gif or .png; without it none is made."""


def learned_factors(run: Path) -> tuple[float, ...]:
    """Factors of mass, friction and servo gain that a run has learned, of the true ones; not the compliance."""
    policy: Any = TrainedPolicy.open(run).policy
    guesses = (HAND_GUESS[name] for name in ("object_mass", "friction", "servo_gain"))
    return tuple(guess * change for guess, (change,) in zip(guesses, policy.lcs.summary().values(), strict=False))


def play(env: Any, policy: HandPolicy, seed: int, frames: list[np.ndarray]) -> tuple[dict[str, Any], int]:
    """Play an episode until the object was held at its goal or dropped: the last info, and how many decisions."""
    observation, info = env.reset(seed=seed)
    for step in range(env.unwrapped.horizon):
        observation, _, _, _, info = env.step(policy.act(env.unwrapped.data, observation["goal"]))
        if env.render_mode:
            frames.append(env.render())
        if info["held"] == 21 or info["dropped"]:
            return info, step + 1
    return info, step + 1


def main(o: Options) -> None:
    """Play."""
    difflcs_envs.register_envs()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)
    good, count, frames = 0, 0, []
    mode = None if o.out is None else "rgb_array"
    mass, friction, gain = (o.mass, o.friction, o.gain) if o.run is None else learned_factors(o.run)
    print(f"planned with mass x {mass:.3g}, friction x {friction:.3g}, servo gain x {gain:.3g}")
    for name in o.objects.split(","):
        env = gymnasium.make("difflcs/HandTurnObject-v0", object=name, horizon=o.steps, render_mode=mode)
        model = build_model(name, 0.1 * mass, 0.5 * friction, gain)
        steps, results, start = [], [], time.process_time()
        for seed in range(o.seed, o.seed + o.episodes):
            info, length = play(env, HandPolicy(model), seed, frames)
            results.append("+" if info["held"] == 21 else "d" if info["dropped"] else "-")
            steps.append(length)
        seconds = (time.process_time() - start) / sum(steps)
        won = results.count("+")
        good, count = good + won, count + len(results)
        print(
            f"{name:10} {won}/{len(results)} {''.join(results)}, {np.mean(steps):.0f} decisions, "
            f"{1e3 * seconds:.1f} ms each",
            flush=True,
        )
        env.close()
    print(f"all {good}/{count}")
    if o.out is not None:
        Animation(frames[::2], fps=10).save(o.out)
        print(f"written: {o.out}")


if __name__ == "__main__":
    main(tyro.cli(Options))
