"""Time of one decision: the LCS-MPC against PDDM's planner, on the cube: `python benchmarks/decision.py [--smoke]`.

The same states of the task, one state a call, in turn by each way, one thread, CPU time without the simulation:

- LCS-MPC: `LCSMPCLayer` around a model of the zoo, cold as in evaluations, tensors in, tensors out;
- controller: `LCSMPCLayer.controller` around the same, NumPy in and out, cold as well;
- PDDM: its planner by the default settings, with networks of the sizes that it learns. They are drawn at random: what a
  product costs does not depend on its numbers.

Prints medians, and PDDM's as a ratio to the LCS-MPC's.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs.cli.bench import machine, save
from difflcs.rl import Ensemble, TrainedPolicy, get_method, get_task
from difflcs.rl.learning.pddm import Planner


@dataclass
class Options:
    """Time of one decision."""

    model: str = "zoo:trifinger-cube"
    """Run directory, or zoo:NAME, of LCS-RL on the cube."""
    states: int = 200
    """Starts and goals of the task."""
    repeats: int = 5
    """How often each is decided by each way; the shortest time counts."""
    seed: int = 0
    """Seed of the first start and goal."""
    out: Path = Path("benchmarks/results/decision.json")
    """Path of the JSON output."""
    smoke: bool = False
    """A few decisions only."""


def states_and_goals(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Draw states (count, 9) and goals (count, 3) from resets of the task."""
    envs = get_task("cube").make_envs(1, threads=1)
    try:
        seen = [envs.reset(seed=seed + k)[0] for k in range(count)]
    finally:
        envs.close()
    states, goals = (torch.from_numpy(np.concatenate([one[name] for one in seen])) for name in ("state", "goal"))
    return states, goals


def ways(o: Options) -> Mapping[str, Callable[[Tensor, Tensor], Any]]:
    """Make the planners, each a function of one state (9,) and goal (3,)."""
    task, settings = get_task("cube"), get_method("pddm")().pddm  # pyright: ignore[reportAttributeAccessIssue]
    mpc: Any = TrainedPolicy.open(o.model).policy
    controller, sizes = mpc.controller(), (settings.ensemble.networks, settings.ensemble.width)
    ensemble = Ensemble(task.n_x, task.n_u, *sizes, torch.Generator().manual_seed(o.seed))
    planner = Planner(ensemble, task.make_cost(), settings, *task.bounds)

    def plan(state: Tensor, goal: Tensor) -> Any:
        with torch.no_grad():
            return mpc(state, goal)

    def control(state: Tensor, goal: Tensor) -> Any:
        controller.reset()
        return controller.step(state.numpy(), goal.numpy())

    return {
        "LCS-MPC": plan,
        "controller": control,
        "PDDM": lambda state, goal: planner(state.unsqueeze(0), goal.unsqueeze(0)),
    }


def main(o: Options) -> None:
    """Measure, print, write."""
    if o.smoke:
        o.states, o.repeats = 3, 2
    torch.set_num_threads(1)
    decide, cases = ways(o), list(zip(*states_and_goals(o.states, o.seed), strict=True))
    spent = {name: np.full((o.repeats, o.states), np.inf) for name in decide}
    for repeat in range(o.repeats):
        for k, (state, goal) in enumerate(cases):
            for name, way in decide.items():
                begun = time.process_time()
                way(state, goal)
                spent[name][repeat, k] = time.process_time() - begun
    milliseconds = {name: 1e3 * float(np.median(seconds.min(0))) for name, seconds in spent.items()}
    ratio = milliseconds["PDDM"] / milliseconds["LCS-MPC"]
    print(", ".join(f"{name} {median:.3f} ms" for name, median in milliseconds.items()), f"PDDM / LCS-MPC: {ratio:.0f}")
    asked = {"model": o.model, "states": o.states, "repeats": o.repeats, "seed": o.seed}
    save(o.out, {"machine": machine(), **asked, "milliseconds": milliseconds, "ratio": ratio})


if __name__ == "__main__":
    main(tyro.cli(Options))
