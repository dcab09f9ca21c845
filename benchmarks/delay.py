"""What a step of latency costs on the cube, and what planning ahead gives back: `python benchmarks/delay.py [--smoke]`.

A model of the zoo pushes the cube of the MuJoCo environment to the same goals in each of these ways, without noise:

- on time: the action that is planned from a state is executed in that state, as `difflcs evaluate` does;
- idle first: the same, but nothing is done in the first step. Whoever is late loses that step, whatever it predicts;
- late: the action that is planned from a state is executed one step later (or `--delay` steps);
- late, predicted: the LCS first predicts, from the state and the action that is under way, where it will be executed.

Prints success rates with Wilson's 95 % interval, the difference to "late" goal by goal with its 95 % interval, and the
share of what "late" loses against "on time" that each way gives back. Written as JSON too.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs.cli.bench import machine, save
from difflcs.rl import TrainedPolicy, collect, get_task, wilson_interval
from difflcs.rl.rollout import Act, mpc_actions
from difflcs.rl.runs.delay import delay_actions, make_predictor
from difflcs.rl.seeding import Stream, episode_seeds


@dataclass
class Options:
    """Latency on the cube."""

    model: Path = Path("zoo:trifinger-cube")
    """Run directory, or zoo:NAME."""
    goals: int = 1000
    """Goals, the same for each way."""
    seed: int = 0
    """Seed of the goals and initial states."""
    delay: int = 1
    """Steps by which actions come late."""
    envs: int = 50
    """Environments side by side."""
    out: Path = Path("benchmarks/results/delay.json")
    """Where the JSON goes."""
    smoke: bool = False
    """A few goals only."""


def idle_first(act: Act, n_u: int, steps: int) -> Act:
    """On time, but without action in the first steps."""
    passed = 0

    def idle(*observed: Tensor) -> tuple[np.ndarray, np.ndarray]:
        nonlocal passed
        passed += 1
        if passed <= steps:
            return np.zeros((len(observed[0]), n_u)), np.zeros(len(observed[0]), bool)
        return act(*observed)

    return idle


@dataclass(frozen=True)
class Row:
    """One way to act.

    Attributes:
        success_rate, ci_low, ci_high: with Wilson's 95 % interval.
        to_late: success rate minus that of "late", and half of its 95 % interval, from the differences goal by goal.
        given_back: share of the loss of "late" against "on time".
        median_position_error, median_yaw_error: [m], [rad] after the last step.
        solver_failures: solves that did not converge.
    """

    success_rate: float
    ci_low: float
    ci_high: float
    to_late: tuple[float, float]
    given_back: float
    median_position_error: float
    median_yaw_error: float
    solver_failures: int


def main(o: Options) -> None:
    """Play, print, write."""
    if o.smoke:
        o.goals, o.envs = 4, 4
    torch.set_num_threads(1)
    learned = TrainedPolicy.open(o.model)
    task, policy = get_task(learned.task), learned.policy
    predict = make_predictor(policy.lcs)  # pyright: ignore[reportAttributeAccessIssue]
    ways: dict[str, Callable[[Act], Act]] = {
        "on time": lambda act: act,
        "idle first": lambda act: idle_first(act, task.n_u, o.delay),
        "late": lambda act: delay_actions(act, task.n_u, o.delay),
        "late, predicted": lambda act: delay_actions(act, task.n_u, o.delay, predict),
    }
    envs = task.make_envs(o.envs)
    episodes = {}
    for name, way in ways.items():
        parts = []
        for first in range(0, o.goals, o.envs):
            seeds = episode_seeds(o.seed, Stream.EVALUATION, first, min(o.envs, o.goals - first))
            parts.append(collect(envs, way(mpc_actions(policy)), seeds, task.episode_steps))
        episodes[name] = torch.cat(parts)
    envs.close()
    success = {name: found["success"].double() for name, found in episodes.items()}
    late, lost = success["late"], float((success["on time"] - success["late"]).mean())
    rows = {}
    for name, found in episodes.items():
        low, high = wilson_interval(int(found["success"].sum()), o.goals)
        apart = success[name] - late
        rows[name] = Row(
            success_rate=float(success[name].mean()),
            ci_low=low,
            ci_high=high,
            to_late=(float(apart.mean()), 1.96 * float(apart.std()) / math.sqrt(o.goals)),
            given_back=float(apart.mean()) / lost if lost else math.nan,
            median_position_error=float(found["errors", "position_error"].nanquantile(0.5)),
            median_yaw_error=float(found["errors", "yaw_error"].abs().nanquantile(0.5)),
            solver_failures=int(found["failures"].sum()),
        )
    print(f"{o.model}, {o.goals} goals, seed {o.seed}, {o.delay} step(s) of {task.step_seconds} s late")
    for name, row in rows.items():
        rate, low, high, gain, half = (100 * v for v in (row.success_rate, row.ci_low, row.ci_high, *row.to_late))
        print(
            f"{name:16s} {rate:5.1f} % ({low:.1f} to {high:.1f})   against late {gain:+5.1f} ± {half:.1f} points   "
            f"{1e3 * row.median_position_error:.1f} mm, {row.median_yaw_error:.3f} rad"
        )
    record = {
        "machine": {**machine(), "cores": os.cpu_count()},
        "options": {"model": str(o.model), "goals": o.goals, "seed": o.seed, "delay": o.delay, "envs": o.envs},
        "results": {name: asdict(row) for name, row in rows.items()},
    }
    save(o.out, record)


if __name__ == "__main__":
    main(tyro.cli(Options))
