"""Latency of an action for one robot: `python benchmarks/latency.py [--smoke]`.

A loop is closed on the LCS itself, with a disturbance, and a new start and goal for each episode, so that states vary.
Episode by episode, every way to plan takes its turn at the same problems, with the shifted plans as warm starts:

- kernel: the native solver alone, by the clock of the controller;
- layer: `LCSMPCLayer` without gradient, tensors in, tensors out;
- shift: the warm start of the next call, `MPCSolution.shift`;
- layer and gradient: the plan, and the gradient of its first action in everything that the layer learns and the state;
- controller: `LCSMPCLayer.controller`, NumPy in and out, which shifts its plan itself;
- layer, cold: as the layer, but without a warm start;
- PDDM, for the cube: its planner by the default settings, with networks of the sizes that it learns. They are drawn at
  random: what a product costs does not depend on its numbers.

Prints median and 99th percentile in CPU time, and the median as a ratio to that of the kernel. Times of a shared
machine mean little, ratios more. Then the price of a deadline: the cube's errors in closed loop by what `on_failure`
does, and the share of steps not solved.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from models import diagonal, uniform
from rivals.run import cpu
from torch import Tensor

from difflcs import LCSModel, LCSMPCLayer, LCSParams, MPCSolution, QuadraticCost
from difflcs.cli.bench import ACTION_LIMIT, machine, save, smoke_path, states_and_goals
from difflcs.errors import DegenerateWarning
from difflcs.mpc.solution import Primal
from difflcs.rl import Ensemble, get_method, get_task
from difflcs.rl.learning.pddm import Planner
from difflcs.systems import cart_pole_between_walls, pushing_cost

EPISODE, WARM_UP = 20, 5  # steps from one start to the next; episodes that do not count


@dataclass
class Options:
    """Latency of a call for one robot."""

    episodes: int = 100
    """Episodes of 20 warm calls of each way, for each problem; a few before them do not count."""
    seed: int = 0
    """Seed of starts, goals and disturbances."""
    out: Path = Path("benchmarks/results/latency.json")
    """Path of the JSON output."""
    smoke: bool = False
    """A few calls only, in a record of its own."""


@dataclass
class Case:
    """One robot: its layer and system, starts (N, n_x), goals (N, n_goal) or None, and the disturbance of a step."""

    mpc: LCSMPCLayer
    lcs: LCSParams
    starts: Tensor
    goals: Tensor | None
    disturbance: float
    rival: Planner | None = None


def cart_pole(horizon: int, count: int, seed: int) -> Case:
    """Make a cart-pole to balance upright between two walls, from starts at which the tip touches one or not."""
    weight = diagonal(10, 50, 1, 1)
    cost = QuadraticCost(weight, diagonal(1), 5 * weight)
    lcs = cart_pole_between_walls()
    mpc = LCSMPCLayer(LCSModel.from_params(lcs), cost, horizon, -10.0, 10.0, on_failure="mask").eval()
    return Case(mpc, lcs, uniform([0.05, 0.1, 0.2, 0.2], count, seed), None, 2e-3)


def cube(horizon: int, count: int, seed: int) -> Case:
    """Push the cube with the model of the zoo, 1 mm of disturbance."""
    lcs = LCSModel.from_pretrained("trifinger-cube")
    mpc = LCSMPCLayer(lcs, pushing_cost(), horizon, -ACTION_LIMIT, ACTION_LIMIT, on_failure="mask").eval()
    task, settings = get_task("cube"), get_method("pddm")().pddm  # pyright: ignore[reportAttributeAccessIssue]
    sizes = settings.ensemble.networks, settings.ensemble.width
    ensemble = Ensemble(task.n_x, task.n_u, *sizes, torch.Generator().manual_seed(seed))
    rival = Planner(ensemble, task.make_cost(), settings, *task.bounds)
    return Case(mpc, lcs.params().detach(), *states_and_goals(count, seed), 1e-3, rival)


CASES: dict[str, Callable[[int, int], Case]] = {
    "cart-pole, H 10": lambda count, seed: cart_pole(10, count, seed),
    "cart-pole, H 20": lambda count, seed: cart_pole(20, count, seed),
    "zoo cube, H 5": lambda count, seed: cube(5, count, seed),
    "zoo cube, H 8": lambda count, seed: cube(8, count, seed),
}


class Step(NamedTuple):
    """One state of an episode, as each way takes it; the guess, and the plan that comes of it."""

    inputs: tuple[Tensor, ...]
    leaf: Tensor
    arrays: list[np.ndarray]
    guess: Primal | None
    plan: MPCSolution


def play(case: Case, episode: int, last: MPCSolution | None, generator: torch.Generator) -> list[Step]:
    """Play an episode in closed loop, after one that ended with a plan."""
    x, steps = case.starts[episode : episode + 1].clone(), []
    goal = () if case.goals is None else (case.goals[episode : episode + 1].clone(),)
    for _ in range(EPISODE):
        guess = None if last is None else last.shift()
        last = plan = case.mpc(x, *goal, guess=guess)
        arrays = [value[0].numpy() for value in (x, *goal)]
        steps.append(Step((x, *goal), x.clone().requires_grad_(), arrays, guess, plan))
        noise = torch.randn(x.shape, generator=generator, dtype=torch.float64)
        x = case.lcs.step(x, plan.action).x_next + case.disturbance * noise
    return steps


@torch.no_grad()
def measure(case: Case, o: Options) -> dict[str, dict[str, float]]:
    """Measure every figure of one problem by the name of the way."""
    mpc, controller = case.mpc, case.mpc.controller()

    def differentiate(step: Step) -> None:
        with torch.enable_grad():
            mpc(step.leaf, *step.inputs[1:], guess=step.guess).action.square().sum().backward()

    ways: dict[str, Callable[[Step], Any]] = {
        "layer": lambda step: mpc(*step.inputs, guess=step.guess),
        "shift": lambda step: step.plan.shift(),
        "layer and gradient": differentiate,
        "controller": lambda step: controller.step(*step.arrays),
        "layer, cold": lambda step: mpc(*step.inputs),
    }
    if (rival := case.rival) is not None:
        ways["PDDM"] = lambda step: rival(*step.inputs)
    seconds: dict[str, list[float]] = {name: [] for name in ("kernel", *ways)}
    unsolved, iterations, plan = 0, [], None
    generator = torch.Generator().manual_seed(o.seed + 1)
    for episode in range(-WARM_UP, o.episodes):
        steps = play(case, episode + WARM_UP, plan, generator)
        plan = steps[-1].plan
        for name, way in ways.items():
            for step in steps:
                used, _ = cpu(way, step)
                if episode < 0:
                    continue
                seconds[name].append(used)
                if name == "controller":
                    assert controller.plan is not None
                    seconds["kernel"].append(controller.plan.solve_time)
            mpc.zero_grad()
        if episode >= 0:
            unsolved += sum(not bool(step.plan.converged) for step in steps)
            iterations += [int(step.plan.iterations) for step in steps]
    figures: dict[str, dict[str, float]] = {}
    for name, values in seconds.items():
        p50, p99 = (1e6 * float(np.percentile(values, q)) for q in (50, 99))
        ratio = float(np.median(values) / np.median(seconds["kernel"]))
        figures[name] = {"p50 µs": p50, "p99 µs": p99, "p50 to kernel": ratio}
    figures["plans"] = {"unsolved": unsolved, "iterations": float(np.mean(iterations))}
    return figures


@torch.no_grad()
def track(case: Case, seed: int, on_failure: str, time_limit: float | None) -> dict[str, float]:
    """Close the loop by a controller with a deadline: sum of the cube's squared errors, share of steps not solved."""
    controller, error, unsolved = case.mpc.controller(on_failure, time_limit), 0.0, 0
    generator = torch.Generator().manual_seed(seed)
    assert case.goals is not None
    for x, goal in zip(case.starts, case.goals, strict=True):
        controller.reset()
        for _ in range(EPISODE):
            u = torch.from_numpy(controller.step(x.numpy(), goal.numpy()))
            assert controller.status is not None
            unsolved += not controller.status.solved
            noise = torch.randn(x.shape, generator=generator, dtype=torch.float64)
            x = case.lcs.step(x, u).x_next + case.disturbance * noise
            error += float((x[:3] - goal).square().sum())
    return {"error": error, "unsolved": unsolved / (EPISODE * len(case.starts))}


def main(o: Options) -> None:
    """Measure, print, write."""
    if o.smoke:
        o.episodes = 2
        o.out = smoke_path(o.out)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", DegenerateWarning)
    results = {}
    for name, make in CASES.items():
        results[name] = measure(make(o.episodes + WARM_UP, o.seed), o)
        print(name)
        for way, row in results[name].items():
            print(f"  {way:20s}", "  ".join(f"{label} {value:.3g}" for label, value in row.items()))
    case = cube(8, o.episodes, o.seed)
    limits = ((on_failure, limit) for on_failure in ("hold", "unfinished") for limit in (None, 200e-6, 100e-6))
    deadline = {f"{on_failure} {limit}": track(case, o.seed, on_failure, limit) for on_failure, limit in limits}
    print("\n".join(f"{name}: {row}" for name, row in deadline.items()))
    options = {"calls": o.episodes * EPISODE, "episodes": o.episodes, "warm_up": WARM_UP, "seed": o.seed}
    save(o.out, {"machine": machine(), "options": options, "results": results, "deadline": deadline})


if __name__ == "__main__":
    main(tyro.cli(Options))
