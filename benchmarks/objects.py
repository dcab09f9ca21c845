"""Success and computing over minutes of data, by any method on any object: `python benchmarks/objects.py [--smoke]`.

Trains each method on each task from each seed, and evaluates what it has learned whenever so many minutes of data are
collected, on the same fresh goals, without noise. Minute 0 is before any data. Every evaluation is written when it is
done; a call with the same options goes on where the last one stopped, and one with other tasks, seeds or methods adds
to the file.

`told` says what a method knew of the object before its first episode: `contact-lcs` is told the outline, the methods
without physics nothing. With `DIFFLCS_YCB_DIR` the objects have their scanned meshes; `object` says which shape it was.
"""

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import tyro

from difflcs.cli.bench import machine, save, smoke_path
from difflcs.rl import evaluate, get_method, get_task, method_names
from difflcs.rl.learning.model_rollouts import ModelRolloutSettings
from difflcs.rl.learning.ppo_settings import PPOSettings
from difflcs.rl.methods.base import Method, Work

QUICK: dict[str, Any] = {
    "n_lam": 5,
    "ppo": PPOSettings(rollouts=68, steps=4),
    "models": ModelRolloutSettings(iterations=3, rollouts=80, steps=10, value_epochs=7),
}
"""LCS-RL where it shall cost little; docs/training.md has it as flags. Chosen on the seeds 1 to 4."""
METHODS: dict[str, Method] = {
    **{name: get_method(name)() for name in method_names()},
    "quick": get_method("lcs-rl")(**QUICK),
}
"""Registered methods with their default settings, and quick settings of LCS-RL."""


@dataclass
class Options:
    """Success over minutes of data."""

    tasks: list[str] = field(
        default_factory=lambda: ["cube", "sugar_box", "fish_can", "mug", "wrench", "clamp", "banana"]
    )
    """Tasks that are known to `difflcs train`."""
    methods: list[str] = field(default_factory=lambda: ["contact-lcs"])
    """Names of `METHODS`."""
    minutes: list[float] = field(default_factory=lambda: [0, 1, 2, 3])
    """When to evaluate; the last one is the length of the training."""
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4, 5, 6, 7])
    """Seeds of the trainings."""
    goals: int = 1000
    """Goals of each evaluation."""
    evaluation_seed: int = 1_000_000
    """Seed of the goals, the same for all."""
    out: Path = Path("benchmarks/results/objects.json")
    """Path of the JSON output."""
    smoke: bool = False
    """Seconds instead of hours, with the methods' smoke settings, in a record of its own; learns nothing."""


def key(row: dict[str, Any]) -> tuple[Any, ...]:
    """Compute the key that identifies an evaluation."""
    names = ("task", "method", "seed", "total_minutes", "minutes", "goals", "evaluation_seed")
    return tuple(row[name] for name in names)


def run(o: Options, task_name: str, method_name: str, seed: int, done: set[tuple[Any, ...]]) -> Iterator[dict]:
    """Run the evaluations of one training that are missing; seconds are CPU time of the training alone."""
    task, method = get_task(task_name), METHODS[method_name]
    same = {"task": task_name, "method": method_name, "seed": seed, "total_minutes": max(o.minutes)}
    same |= {"goals": o.goals, "evaluation_seed": o.evaluation_seed}
    if all(key({**same, "minutes": m}) in done for m in o.minutes):
        return
    told = task.physics.told if task.physics is not None and method.kind == "physics" else "nothing"
    per_minute, spent = task.steps_per_minute / task.episode_steps, 0.0
    with ExitStack() as opened:

        def make_envs(count: int) -> Any:
            return opened.enter_context(closing(task.make_envs(count, threads=1)))

        envs = make_envs(min(100, o.goals))
        work = Work(task, seed, round(max(o.minutes) * per_minute), make_envs)
        trainer = (method.smoke() if o.smoke else method).trainer(work)
        for minutes in sorted(o.minutes):
            begun = time.process_time()
            while trainer.episodes < round(minutes * per_minute):
                trainer.step()
            spent += time.process_time() - begun
            if key({**same, "minutes": minutes}) in done:
                continue
            evaluation = evaluate(envs, trainer.policy, o.goals, o.evaluation_seed, task.episode_steps)
            yield {
                **same,
                "minutes": minutes,
                "episodes": trainer.episodes,
                "success_rate": evaluation.success_rate,
                "successes": evaluation.successes,
                "ci_low": evaluation.ci_low,
                "ci_high": evaluation.ci_high,
                "median_errors": dict(evaluation.median_errors),
                "solver_failures": evaluation.solver_failures,
                "training_cpu_seconds": round(spent, 1),
                "told": told,
                "object": dict(task.describe(envs)),
            }


def main(o: Options) -> None:
    """Train, evaluate, write."""
    if o.smoke:
        o.tasks, o.seeds, o.minutes, o.goals = o.tasks[:1], o.seeds[:1], [0, 0.4], 4
        o.out = smoke_path(o.out)
    torch.set_num_threads(1)
    rows = json.loads(o.out.read_text())["rows"] if o.out.exists() else []
    print(f"{len(rows)} evaluations are in {o.out} already; what is missing is added")
    for seed in o.seeds:
        for task in o.tasks:
            for method in o.methods:
                for row in run(o, task, method, seed, {key(row) for row in rows}):
                    rows.append(row)
                    save(o.out, {"machine": machine(), "rows": rows})
                    print(
                        f"{task:10s} {method} seed {seed} {row['minutes']:4g} min  {row['success_rate']:.3f} "
                        f"({row['ci_low']:.3f} to {row['ci_high']:.3f})  {row['training_cpu_seconds']:.0f} s",
                        flush=True,
                    )


if __name__ == "__main__":
    main(tyro.cli(Options))
