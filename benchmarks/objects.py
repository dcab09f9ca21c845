"""Success over minutes of data on the objects, by any method: `python benchmarks/objects.py [--smoke]`.

Trains each method on each task from each seed, and evaluates what it has learned whenever so many minutes of data are
collected, on the same fresh goals, without noise. Minute 0 is before any data. Every evaluation is written when it is
done; a call with the same options goes on where the last one stopped, and one with other tasks, seeds or methods adds
to the file.

`told` says what a method knew of the object before its first episode: `contact-lcs` is told the outline, the methods
without physics nothing. With `DIFFLCS_YCB_DIR` the objects have their scanned meshes; `object` says which shape it was.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import tyro
from trainings import Training

from difflcs.cli.bench import machine, save
from difflcs.rl import get_method, get_task


@dataclass
class Options:
    """Success over minutes of data."""

    tasks: list[str] = field(
        default_factory=lambda: ["cube", "sugar_box", "fish_can", "mug", "wrench", "clamp", "banana"]
    )
    """Tasks that are known to `difflcs train`."""
    methods: list[str] = field(default_factory=lambda: ["contact-lcs"])
    """Methods, each with its default settings."""
    minutes: list[float] = field(default_factory=lambda: [0, 1, 2, 3])
    """When to evaluate; the last one is the length of the training."""
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4, 5, 6, 7])
    """Seeds of the trainings."""
    goals: int = 1000
    """Goals of each evaluation."""
    evaluation_seed: int = 1_000_000
    """Seed of the goals, the same for all."""
    envs: int = 100
    """Environments side by side in evaluations."""
    out: Path = Path("benchmarks/results/objects.json")
    """Where the JSON goes."""
    smoke: bool = False
    """Seconds instead of hours, with the methods' smoke settings; learns nothing."""


def key(row: dict[str, Any]) -> tuple[Any, ...]:
    """What makes an evaluation the same as another."""
    names = ("task", "method", "seed", "total_minutes", "minutes", "goals", "evaluation_seed")
    return tuple(row[name] for name in names)


def run(o: Options, task_name: str, method_name: str, seed: int, done: set[tuple[Any, ...]]) -> Iterator[dict]:
    """The evaluations of one training that are not done yet."""
    task, method = get_task(task_name), get_method(method_name)()
    if o.smoke:
        method = method.smoke()
    same = {
        "task": task_name,
        "method": method_name,
        "seed": seed,
        "total_minutes": max(o.minutes),
        "goals": o.goals,
        "evaluation_seed": o.evaluation_seed,
    }
    if all(key({**same, "minutes": m}) in done for m in o.minutes):
        return
    told = task.physics.told if task.physics is not None and method.kind == "physics" else "nothing"
    with Training(task, method, seed, max(o.minutes), o.envs) as training:
        described = dict(task.describe(training.envs))
        for minutes, spent in training.at(o.minutes):
            if key({**same, "minutes": minutes}) in done:
                continue
            found = training.evaluate(o.goals, o.evaluation_seed)
            yield {
                **same,
                "minutes": minutes,
                "episodes": training.trainer.episodes,
                "success_rate": found.success_rate,
                "successes": found.successes,
                "ci_low": found.ci_low,
                "ci_high": found.ci_high,
                "median_errors": dict(found.median_errors),
                "solver_failures": found.solver_failures,
                "training_cpu_seconds": round(spent, 1),
                "told": told,
                "object": described,
            }


def main(o: Options) -> None:
    """Train, evaluate, write."""
    if o.smoke:
        o.tasks, o.seeds, o.minutes, o.goals, o.envs = o.tasks[:1], o.seeds[:1], [0, 0.2], 4, 4
    torch.set_num_threads(1)
    rows = json.loads(o.out.read_text())["rows"] if o.out.exists() else []
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
