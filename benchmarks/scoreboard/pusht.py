"""Push-T of gym-pusht by sampling-based contact MPC: `python benchmarks/scoreboard/pusht.py --episodes 500 --json`.

The environment is as its authors publish it: its own start, success flag (more than 95 % of the goal covered by the T)
and limit (300 steps of 0.1 s). The policy is given the state (place of the disc, pose of the T) and, by variant:

- known: geometry, mass and drive as they are;
- learned: what is learned from two minutes of random pushing, see `learn_pusht.py`;
- inertia, friction, outline: one of them wrong by 20 % (friction, which is zero, is taken for 0.2);
- noise: every coordinate observed with a standard deviation of 2 px, the angle with that of 2 px at the T's radius of
  gyration;
- delay: actions come one step late, and the plan begins where the system predicts that it will be.

Times are CPU times of the policy, on one core. With `--out FILE`, episodes are written as they end, and those that are
in the file already are not played again. `--variant all` plays every one.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from difflcs.bench import machine, save
from difflcs.errors import MissingDependencyError
from difflcs.planning.pusht import GYRATION, PIXELS, PushTPolicy, tee, tee_pushing
from difflcs.rl import wilson_interval

STEPS = 300
EVERY = 10
"""Episodes between two writings."""


@dataclass(frozen=True)
class Variant:
    """What the policy is told and how it observes and acts.

    Attributes:
        policy: makes it; its argument is the seed.
        noise: standard deviation of every observed coordinate [px].
        delay: steps by which its actions come late.
    """

    policy: Callable[[int], PushTPolicy] = lambda seed: PushTPolicy()
    noise: float = 0.0
    delay: int = 0


def learned(seed: int) -> PushTPolicy:
    """With what two minutes of pushing teach."""
    from learn_pusht import learn

    return PushTPolicy(learn(seed).model)


VARIANTS = {
    "known": Variant(),
    "learned": Variant(learned),
    "inertia -20 %": Variant(lambda seed: PushTPolicy(tee_pushing(gyration=GYRATION * 0.8**0.5))),
    "inertia +20 %": Variant(lambda seed: PushTPolicy(tee_pushing(gyration=GYRATION * 1.2**0.5))),
    "friction 0.2": Variant(lambda seed: PushTPolicy(tee_pushing(friction=torch.tensor(0.2, dtype=torch.float64)))),
    "outline -20 %": Variant(lambda seed: PushTPolicy(tee_pushing(shape=tee(0.8)))),
    "outline +20 %": Variant(lambda seed: PushTPolicy(tee_pushing(shape=tee(1.2)))),
    "noise 2 px": Variant(noise=2.0),
    "one step late": Variant(lambda seed: PushTPolicy(delay=1), delay=1),
}


@dataclass
class Options:
    """Push-T by sampling-based contact MPC."""

    episodes: int = 500
    """Episodes, of seeds `seed`, `seed` + 1, …"""
    seed: int = 0
    """Seed of the first episode."""
    variant: str = "known"
    """One of the variants, or "all"."""
    json: bool = False
    """Print one line of JSON for each variant, and nothing else."""
    out: Path | None = None
    """Where the episodes are recorded, to go on from there; nowhere if not given."""
    smoke: bool = False
    """Two episodes of a few steps."""


@dataclass(frozen=True)
class Episode:
    """One episode.

    Attributes:
        success: the environment's own flag.
        steps: until success or the limit.
        coverage: largest part of the goal that the T has covered.
        milliseconds: CPU time of the policy, of all steps.
        longest: of one step.
    """

    success: bool
    steps: int
    coverage: float
    milliseconds: float
    longest: float


def make_env() -> Any:
    """The environment, unmodified.

    Raises:
        MissingDependencyError: gym-pusht is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pygame's, about pkg_resources
            import gym_pusht  # noqa: F401
            import gymnasium
    except ImportError as error:
        raise MissingDependencyError(
            f'expected gym-pusht, not installed ({error}); run: pip install "difflcs[rl,scoreboard]"'
        ) from error
    return gymnasium.make("gym_pusht/PushT-v0", obs_type="state", max_episode_steps=STEPS)


def play(env: Any, policy: PushTPolicy, seed: int, variant: Variant, limit: int = STEPS) -> Episode:
    """One episode of a seed."""
    noise = np.random.default_rng([seed, 2])
    spread = variant.noise * np.array([1.0, 1.0, 1.0, 1.0, 1.0 / (GYRATION * PIXELS)])
    observation, _ = env.reset(seed=seed)
    policy.reset()
    late = [observation[:2].copy()] * variant.delay
    times, best, success = [], 0.0, False
    for _ in range(limit):
        seen = observation + spread * noise.standard_normal(5)
        start = time.process_time()
        late.append(policy.act(seen))
        times.append(1e3 * (time.process_time() - start))
        observation, _, success, truncated, info = env.step(late.pop(0))
        best = max(best, float(info["coverage"]))
        if success or truncated:
            break
    return Episode(bool(success), len(times), best, sum(times), max(times))


def summary(episodes: list[list[float]]) -> dict[str, float]:
    """The figures of a variant."""
    success, steps, coverage, milliseconds, longest = np.array(episodes, float).T
    low, high = wilson_interval(int(success.sum()), len(success))
    return {
        "success_rate": float(success.mean()),
        "ci_low": low,
        "ci_high": high,
        "episodes": len(success),
        "mean_steps": float(steps.mean()),
        "milliseconds_per_step": float(milliseconds.sum() / steps.sum()),
        "coverage": float(coverage.mean()),
        "longest_milliseconds": float(np.percentile(longest, 99)),
    }


def measure(name: str, o: Options, env: Any, record: dict[str, Any]) -> dict[str, float]:
    """Play the episodes of a variant that are not in the record yet."""
    variant = VARIANTS[name]
    row = record["results"].setdefault(name, {"rows": []})
    rows: list[list[float]] = row["rows"]
    policy = variant.policy(o.seed) if len(rows) < o.episodes else None
    for i in range(len(rows), o.episodes):
        assert policy is not None
        found = play(env, policy, o.seed + i, variant, 5 if o.smoke else STEPS)
        rows.append([int(found.success), found.steps, *(round(v, 4) for v in list(vars(found).values())[2:])])
        if o.out is not None and ((i + 1) % EVERY == 0 or i + 1 == o.episodes):
            row.update(summary(rows))
            keep(o.out, record)
        if not o.json:
            print(f"{name}: seed {o.seed + i}, {'solved' if found.success else 'not solved'} in {found.steps} steps")
    return summary(rows[: o.episodes])


def keep(path: Path, record: dict[str, Any]) -> None:
    """Write without a word."""
    _files.write_atomically(path, (json.dumps(record, ensure_ascii=False) + "\n").encode())


def main(o: Options) -> None:
    """Play, print, write."""


if __name__ == "__main__":
    main(tyro.cli(Options))
