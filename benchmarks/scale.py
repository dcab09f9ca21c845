"""How large problems may be, and how long their horizons: `python benchmarks/scale.py [--problems 16] [--smoke]`.

All are solved with the default settings from nothing, on one thread:

- "random": `random_model` of any size, two actions for three states, |u| ≤ 1, x0 ~ N(0, 1). Nothing in it is like a
  robot: contacts couple everything, and larger ones are unstable.
- "carts": a chain of carts between two walls whose first cart must push the last one.
- "random, weak" and "pushing, weak": the cost and the bounds of the cube (15 mm a step) over long horizons, by
  `batched` and by `ipopt`. Some of these models are unstable in contact, and actions at their bounds cannot hold them.

Printed per size: the share of problems solved, iterations of one start on average (most are given up after a few), and
CPU time per problem. Written as JSON too. `--hand 4` prints times of plans of a hand instead.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from models import Instance, chain, chain_of_carts, pushing, pushing_model, random_model, to_rest
from rivals.run import cpu

from difflcs import LCSMPCLayer
from difflcs.cli.bench import machine, save, smoke_path
from difflcs.mpc.backends import Backend, BatchedBackend, IpoptBackend
from difflcs.mpc.solution import Primal
from difflcs.physics.mujoco import ContactGroup
from difflcs_envs.hand.env import HandTurnObjectEnv
from difflcs_envs.hand.model import FINGERS, LINKS
from difflcs_envs.tasks import hand_cost, hand_system

# n_x, n_lam, H
RANDOM = [
    *[(9, n_lam, 10) for n_lam in (2, 5, 8, 12, 20, 30)],
    *[(20, 8, 10), (40, 8, 10), (9, 8, 20), (9, 8, 40), (20, 5, 20), (20, 20, 20), (40, 30, 10), (40, 30, 40)],
]
CARTS = [(carts, horizon) for carts in (2, 4, 10, 20) for horizon in (10, 20, 40)]
WEAK = {"random, weak": random_model, "pushing, weak": pushing_model}
HORIZONS, WEAK_MODELS, WEAK_PROBLEMS = (10, 20, 30), 24, 8
BACKENDS: dict[str, Backend] = {"batched": BatchedBackend(threads=1), "ipopt": IpoptBackend(workers=1)}
# Plans of a hand: options of the solver, whether from the last plan, whether all in one call, and the relaxation.
HAND: dict[str, tuple[dict[str, Any], bool, bool, float]] = {
    'from nothing, "fast"': ({"effort": "fast"}, False, False, 1e-3),
    'from nothing, "default"': ({}, False, False, 1e-3),
    "from the last plan": ({"restarts": 1}, True, False, 1e-3),
    "from the last plan, 1e-7": ({"restarts": 1}, True, False, 1e-7),
    "in a batch, from nothing, one start": ({"restarts": 1}, False, True, 1e-3),
    "in a batch, from the last plan": ({"restarts": 1}, True, True, 1e-3),
}


@dataclass
class Options:
    """Convergence, iterations and time by size."""

    problems: int = 16
    """Problems per model of the first two families."""
    seeds: int = 4
    """Models of each size; the carts have one."""
    hand: int = 0
    """Closed loops of a hand, of 8 states each, whose plans are timed instead."""
    out: Path = Path("benchmarks/results/scale.json")
    """Path of the JSON output."""
    smoke: bool = False
    """Everything tiny, in a record of its own."""


@torch.no_grad()
def measure(family: str, name: str, instances: list[Instance]) -> dict[str, Any]:
    """Solve problems of one size by one backend, print a line, and give the figures; times are seconds of CPU."""
    backend = BACKENDS[name]
    options = {"backend": backend, "on_failure": "mask"}
    spent, plans = cpu(lambda: [LCSMPCLayer(**options, **instance.layer)(*instance.call) for instance in instances])
    solved, iterations = (torch.cat([getattr(p, n) for p in plans]).double() for n in ("converged", "iterations"))
    problem = plans[0].problem
    size = backend.starts(problem, guessed=False) if isinstance(backend, BatchedBackend) else None
    starts = size.starts // size.groups if size else 1
    row = {
        "family": family,
        "backend": name,
        **{size: getattr(problem, size) for size in ("n_x", "n_u", "n_lam", "horizon")},
        "problems": len(solved),
        "solved": float(solved.mean()),
        "starts": starts,
        "iterations": float(iterations.mean()) / starts,
        "per_problem": spent / len(solved),
    }
    print("  ".join(f"{label} {v:.4g}" if isinstance(v, float) else f"{label} {v}" for label, v in row.items()))
    return row


@torch.no_grad()
def time_hand(loops: int, limits: int | None, each: int, palm: int) -> None:
    """Print CPU milliseconds of plans of a hand with so many contacts of each finger, and of the palm."""
    env, met = HandTurnObjectEnv(), []
    groups = [ContactGroup([("object", f"{finger}_{link}") for link in LINKS], each) for finger in FINGERS]
    groups += [ContactGroup(("object", "palm"), palm), ContactGroup(None, 2 * each, False, 0.006)]
    system = hand_system(env.model, contacts=groups, limits=limits)
    layer = LCSMPCLayer(system, hand_cost(system), 4, -0.05, 0.05, relaxation=1e-3, on_failure="mask")
    for seed in range(loops):
        goal, plan = torch.from_numpy(env.reset(seed=seed)[0]["goal"]), None
        for _ in range(9):
            x, guess = system.observe(env.data), plan and plan.shift()
            met += [(x, goal, *guess[:3])] if guess else []
            plan = layer(x, goal, guess=guess)
            env.step(plan.action.numpy())
    x, goal, *last = (torch.stack(values) for values in zip(*met, strict=True))
    problem = layer(x, goal).problem
    for name, (options, warm, batch, relaxation) in HAND.items():
        backend, ms = BatchedBackend(threads=1, **options), []
        for part in torch.arange(len(x)).split(len(x) if batch else 1):
            asked = replace(problem.select(part), relaxation=relaxation)
            guess = Primal(*(v[part] for v in last), x.new_zeros(len(part), 5, 0)) if warm else None
            ms.append(1e3 * cpu(backend.solve, asked, guess)[0] / len(part))
        print(f"{asked.n_lam} forces, {name}: mean {np.mean(ms):.2f}, median {np.median(ms):.2f}, most {max(ms):.1f}")


def main(o: Options) -> None:
    """Measure, print, write."""
    torch.set_num_threads(1)
    if o.hand:
        for limits, each, palm in ((0, 2, 1), (0, 2, 3), (None, 2, 3), (0, 4, 2)):
            time_hand(o.hand, limits, each, palm)
        return
    warnings.simplefilter("ignore")  # what fails is counted
    random, carts, horizons, models, few = RANDOM, CARTS, HORIZONS, WEAK_MODELS, WEAK_PROBLEMS
    if o.smoke:
        o.problems, o.seeds, random, carts, horizons, models, few = 4, 1, random[:1], carts[:1], horizons[:1], 2, 2
        o.out = smoke_path(o.out)
    rows = []
    for n_x, n_lam, horizon in random:
        systems = [random_model(n_lam, seed, n_x, n_u=2 * n_x // 3) for seed in range(o.seeds)]
        instances = [to_rest(system, horizon, o.problems, seed) for seed, system in enumerate(systems)]
        rows.append(measure("random", "batched", instances))
    for count, horizon in carts:  # whose middle ones have a price, too
        whole = chain(chain_of_carts(count, dt=0.1), horizon, o.problems * o.seeds, count, others=0.1)
        rows.append(measure("carts", "batched", [whole]))
    make: Callable[[int, int], Any]
    for family, make in WEAK.items():
        for horizon in horizons:
            instances = [pushing(make(8, seed), few, 1, horizon) for seed in range(models)]
            rows += [measure(family, name, instances) for name in BACKENDS]
    save(o.out, {"machine": machine(), "rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Options))
