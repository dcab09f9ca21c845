"""What a training costs on one core, and what is lost where it shall cost little: `python benchmarks/training_time.py`.

Trains LCS-RL on the cube by its default settings and by quick ones (`QUICK`, fewer and smaller iterations on model
rollouts), from the same seeds, and evaluates both on the same fresh goals. Seconds are CPU time of one thread without
the evaluations. Every training is written when it is done; the same call goes on where the last one stopped.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import tyro
from trainings import Training

from difflcs.cli.bench import machine, save
from difflcs.rl import get_method, get_task
from difflcs.rl.learning.model_rollouts import ModelRolloutSettings
from difflcs.rl.learning.ppo_settings import PPOSettings

LCS_RL = get_method("lcs-rl")
QUICK: dict[str, Any] = {
    "n_lam": 5,
    "ppo": PPOSettings(rollouts=68, steps=4),
    "models": ModelRolloutSettings(iterations=3, rollouts=80, steps=10, value_epochs=7),
}
"""docs/training.md has them as flags. They were chosen on the seeds 1 to 4."""
RECIPES = {"quick": LCS_RL(**QUICK), "default": LCS_RL()}


@dataclass
class Options:
    """What a training costs."""

    recipes: list[str] = field(default_factory=lambda: list(RECIPES))
    """Which of both."""
    minutes: list[float] = field(default_factory=lambda: [10, 30])
    """When to evaluate; the last one is the length of the training."""
    seeds: list[int] = field(default_factory=lambda: list(range(1000, 1008)))
    """Seeds of the trainings."""
    goals: int = 1000
    """Goals of each evaluation."""
    evaluation_seed: int = 0
    """Seed of the goals, the same for all."""
    envs: int = 100
    """Environments side by side in evaluations."""
    out: Path = Path("benchmarks/results/training_time.json")
    """Where the JSON goes."""
    smoke: bool = False
    """Seconds instead of minutes, with the method's smoke settings; learns nothing."""


def run(o: Options, recipe: str, seed: int) -> dict[str, Any]:
    """One training: its seconds and its success, at each of the minutes."""
    method, rows = RECIPES[recipe], []
    with Training(get_task("cube"), method.smoke() if o.smoke else method, seed, max(o.minutes), o.envs) as training:
        for minutes, spent in training.at(o.minutes):
            found = training.evaluate(o.goals, o.evaluation_seed)
            rows.append({"minutes": minutes, "seconds": round(spent, 1), "success_rate": found.success_rate})
    same = {"recipe": recipe, "seed": seed, "goals": o.goals, "evaluation_seed": o.evaluation_seed}
    return {**same, "evaluations": rows}


def main(o: Options) -> None:
    """Train, evaluate, write."""
    if o.smoke:
        o.minutes, o.seeds, o.goals, o.envs = [0.2, 0.4], o.seeds[:1], 4, 4
    torch.set_num_threads(1)
    rows = json.loads(o.out.read_text())["rows"] if o.out.exists() else []
    asked = {"goals": o.goals, "evaluation_seed": o.evaluation_seed}

    def known(recipe: str) -> dict[int, list[dict[str, Any]]]:
        """Seed → evaluations that are there, at these minutes and on these goals."""
        own = [row for row in rows if {"recipe": recipe, **asked}.items() <= row.items()]
        at = sorted(o.minutes)
        return {row["seed"]: row["evaluations"] for row in own if [e["minutes"] for e in row["evaluations"]] == at}

    for seed in o.seeds:
        for recipe in o.recipes:
            if seed in known(recipe):
                continue
            rows.append(run(o, recipe, seed))
            save(o.out, {"machine": machine(), "rows": rows})
            for e in rows[-1]["evaluations"]:
                line = f"{recipe:8s} seed {seed}  {e['minutes']:4g} min  {100 * e['success_rate']:5.1f} %"
                print(f"{line}  {e['seconds']:.1f} s", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
