"""Planners that are made for contact, beside ours, judged under hard contact: single plans and closed loops."""

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from race_problems import as_mpc, hard_cost, with_contact
from rivals import admm, impact, layer, sampling
from rivals.problem import Problem, execute
from rivals.run import cpu

from difflcs.mpc.backends import BatchedBackend

TUNED = Path(__file__).parent / "rivals" / "tuned.json"
ITERATIONS = (3, 10, 30, 100)  # of C3+
LOOPS = ("pushing, n_lam 5", "pushing, n_lam 8", "cart-pole, H 10", "cart-pole, H 30", "chain of 4, H 10")
STEPS = 25
OTHER_SEEDS = 1000
MOST_EXACT = 5  # n_lam for which all 3^n_lam supports are tried; 8 take 85 ms
MODULES: dict[str, Any] = {"layer": layer, "admm": admm, "impact": impact, "sampling": sampling}
OURS: dict[str, dict[str, Any]] = {
    "difflcs": {},
    'difflcs `"fast"`': {"effort": "fast"},
    "difflcs, 1e-7": {"relaxation": 1e-7},
    'difflcs `"fast"`, 1e-7': {"effort": "fast", "relaxation": 1e-7},
}
# Closed loops of C3+ and sampling are cold in each step, as theirs are; ours is the warm controller.
Draw = Callable[[np.random.Generator], dict[str, Any]]


def sampled(random: np.random.Generator, methods: tuple[str, ...], rollouts: int) -> dict[str, Any]:
    """Draw settings of one of these methods with so many rollouts."""
    iterations = int(random.choice([n for n in (1, 2, 4, 8, 16, 32) if rollouts // n >= 4]))
    method = str(random.choice(methods))
    keep = float(random.uniform(0.02, 0.3)) if method == "cem" else float(10 ** random.uniform(-2, 0))
    spread, hold = float(10 ** random.uniform(-1, 0.3)), int(random.choice([1, 2, 3, 5, 10]))
    how = {"method": method, "samples": rollouts // iterations, "iterations": iterations}
    return {**how, "spread": spread, "hold": hold, "keep": keep}


def draws() -> dict[str, tuple[str, Draw]]:
    """List the rivals whose settings are tuned: module, and how random settings are drawn."""

    def consensus(random: np.random.Generator, iterations: int, **fixed: str) -> dict[str, Any]:
        growth = float(random.choice([1.0, 1.0, 1.05, 1.1, 1.2, 1.5, 2.0][: 7 if iterations <= 30 else 4]))
        weight, gap, action, prefer = (float(10 ** random.uniform(*v)) for v in [(-3, 3.5), (-2, 2), (-3, 2), (-1, 2)])
        numbers = {"weight": weight, "growth": growth, "gap": gap, "action": action, "prefer": prefer}
        return {**fixed, "iterations": iterations, **numbers}

    def lagrangian(random: np.random.Generator) -> dict[str, Any]:
        weight, bound, settle = (float(10 ** random.uniform(*v)) for v in [(-2, 3.5), (-1, 4), (-4, -2)])
        growth, progress = float(random.choice([1.05, 1.2, 1.5, 2.0, 5.0])), float(random.choice([0.5, 0.9]))
        numbers = {"weight": weight, "bound": bound, "growth": growth, "progress": progress}
        return {**numbers, "inner": int(random.choice([5, 10, 50])), "settle": settle}

    rivals: dict[str, tuple[str, Draw]]
    rivals = {f"C3+, {n} iterations": ("admm", partial(consensus, iterations=n)) for n in ITERATIONS}
    rivals["C3, 10 iterations"] = ("admm", partial(consensus, iterations=10, project="lcp"))
    rivals["C3, 10 iterations, exact"] = ("admm", partial(consensus, iterations=10, project="exact"))
    rivals["IMPACT-like"] = ("impact", lagrangian)
    drawn = {m: partial(sampled, methods=(m,), rollouts=1024) for m in ("cem", "mppi")}
    return rivals | {f"{m.upper()}, 1024 rollouts": ("sampling", draw) for m, draw in drawn.items()}


def objectives(problem: Problem, u: np.ndarray) -> np.ndarray:
    """Compute the objectives of executing actions with λ·s = 0, their constant included."""
    mpc = as_mpc(problem)
    return hard_cost(mpc, mpc.clip(torch.from_numpy(np.nan_to_num(u)))).numpy() + problem.constant


def reference(problem: Problem) -> np.ndarray:
    """Compute the hard objectives of our plans from many starts at two relaxations: the better ones."""
    mpc = as_mpc(problem)
    plans = (BatchedBackend(restarts=32, max_iter=600).solve(mpc, None), BatchedBackend(effort="best").solve(mpc, None))
    return np.minimum(*(objectives(problem, result.primal.u.numpy()) for result in plans))


def closed_loop(rival: Any, few: int) -> tuple[float, np.ndarray]:
    """Execute the first actions of plans, with hard contact, for some steps: seconds of a step, and costs (few,)."""
    problem, costs, times = rival.problem, np.zeros(few), []
    for i in range(few):
        data, x = problem.only(i), problem.x0[i].copy()
        start = x
        for _ in range(STEPS):
            seconds, u = cpu(rival.step, i, x)
            cost, x = execute(data, x, u[None])
            costs[i] += cost
            times.append(seconds)
        problem.x0[i] = start
    return float(np.median(times)), costs


def tune(seconds: float, only: tuple[str, ...] = ()) -> None:
    """Draw settings of each rival, or `only` some, for each family on other seeds, for some seconds; write the best."""
    tuned: dict[str, dict[str, dict]] = json.loads(TUNED.read_text()) if only else {}
    for family, problems in with_contact(3, 2, OTHER_SEEDS).items():
        every = {k: v for k, v in draws().items() if "exact" not in k or problems[0].n_lam <= MOST_EXACT}
        wanted = {k: v for k, v in every.items() if not only or k in only}
        known = [reference(p) for p in problems] if wanted else []
        for label, (module, draw) in wanted.items():
            random, least, until = np.random.default_rng(0), np.inf, time.process_time() + seconds
            while time.process_time() < until:
                settings, gaps = draw(random), []
                for p, best in zip(problems, known, strict=True):
                    solver = MODULES[module].Solver(p, **settings)
                    u = np.concatenate([solver.one(i).u for i in range(p.count)])
                    gaps.append(np.minimum(objectives(p, u) / best - 1, 3.0))
                if np.mean(gaps) < least:
                    least = float(np.mean(gaps))
                    tuned.setdefault(family, {})[label] = {"module": module, "settings": settings}
            print(f"{family:20s} {label:22s} gap {100 * least:.3g} %", flush=True)
    TUNED.write_text(json.dumps(tuned, indent=1) + "\n")


def measure(problems: int, seeds: int, rounds: int, only: tuple[str, ...] = ()) -> dict[str, dict[str, dict]]:
    """Measure every planner on the families of the race, or the first and `only` some.

    Args:
        problems: of each model.
        seeds: models of a family.
        rounds: how often everybody solves everything, taking turns; the shortest time of each problem counts.
        only: labels; all if none is named.

    Returns:
        family → label → median seconds of a plan, mean and worst gap to the best plan of all under hard contact; and in
        families with closed loops seconds of a step, and the cost of all loops in parts of that of the first planner.
    """
    tuned, families = json.loads(TUNED.read_text()), {}
    for family, members in with_contact(problems, seeds).items():
        rivals = {label: (row["module"], row["settings"]) for label, row in tuned[family].items()}
        fresh = {"C3+, 10 iterations, new system": ("admm", {**rivals["C3+, 10 iterations"][1], "new": True})}
        planners = {label: ("layer", settings) for label, settings in OURS.items()} | rivals | fresh
        planners = {k: v for k, v in planners.items() if not only or k == "difflcs" or k in only}
        if only and len(planners) == 1:
            continue
        table = {label: {"times": [], "gaps": [], "steps": [], "costs": []} for label in planners}
        for problem in members:
            found = {}
            solvers = {
                label: MODULES[module].Solver(problem, **settings) for label, (module, settings) in planners.items()
            }
            times = {label: np.full(problems, np.inf) for label in planners}
            for _ in range(rounds + 1):  # the first is set-up
                for label, solver in solvers.items():
                    solved = [cpu(solver.one, i) for i in range(problems)]
                    times[label] = np.minimum(times[label], [seconds for seconds, _ in solved])
                    found[label] = objectives(problem, np.concatenate([answer.u for _, answer in solved]))
            best = np.minimum(np.min([*found.values()], axis=0), reference(problem))
            for label, row in table.items():
                row["times"] += list(times[label])
                row["gaps"] += list(found[label] / best - 1)
            q, Q = np.broadcast_to(problem.q, (problems, problem.n_x)), problem.Q
            least = 0.5 * ((q @ np.linalg.pinv(Q)) * q).sum(1)  # makes the cost of a stage a sum of squares
            for label, solver in solvers.items() if family in LOOPS else ():
                seconds, costs = closed_loop(solver, problems)
                table[label]["steps"].append(seconds)
                table[label]["costs"] += list(costs + STEPS * least)
        first = np.sum(table["difflcs"]["costs"])
        families[family] = {}
        for label, row in table.items():
            gaps = row["gaps"]
            values = {"seconds": np.median(row["times"]), "gap": np.mean(gaps), "worst": np.max(gaps)}
            if row["steps"]:
                values |= {"step": np.mean(row["steps"]), "cost": np.sum(row["costs"]) / first}
            families[family][label] = figures = {name: float(value) for name, value in values.items()}
            text = "  ".join(f"{name} {value:.4g}" for name, value in figures.items())
            print(f"{family:20s} {label:32s} {text}", flush=True)
    return families
