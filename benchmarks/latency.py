"""How long one robot waits for its action: `python benchmarks/latency.py [--smoke]`.

A loop is closed on the LCS itself, with a disturbance, and a new start and goal for each episode, so that states vary.
Episode by episode, every way to plan takes its turn at the same problems, with the shifted plans as warm starts:

- kernel: the native solver alone, its arguments ready;
- layer: `LCSMPCLayer` without gradient, tensors in, tensors out;
- shift: the warm start of the next call, `MPCSolution.shift`;
- layer and gradient: the plan, and the gradient of its first action in everything that the layer learns and the state;
- controller: `LCSMPCLayer.controller`, NumPy in and out, which shifts its plan itself.

Prints median and 99th percentile in CPU time, the median as a ratio to that of the kernel, and the median of what a
call takes beyond the kernel's in the same state. Times of a shared machine mean little, ratios more. The JSON has wall
time too.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs import LCSModel, LCSMPCLayer, LCSParams, MPCSolution, QuadraticCost
from difflcs._native import _kernels
from difflcs.cli.bench import ACTION_LIMIT, machine, pushing_cost, save, states_and_goals
from difflcs.errors import DegenerateWarning
from difflcs.mpc.backends import batched
from difflcs.mpc.solution import Primal
from difflcs.systems import cart_pole_between_walls

EPISODE = 20  # steps from one start to the next


@dataclass
class Options:
    """Latency of a call for one robot."""

    episodes: int = 250
    """Episodes of 20 warm calls of each way, for each problem."""
    warm_up: int = 5
    """Episodes before, which do not count."""
    seed: int = 0
    """Seed of starts, goals and disturbances."""
    out: Path = Path("benchmarks/results/latency.json")
    """Where the JSON goes."""
    smoke: bool = False
    """A few calls only."""


@dataclass
class Case:
    """One robot: its layer and system, starts (N, n_x), goals (N, n_goal) or None, and the disturbance of a step."""

    mpc: LCSMPCLayer
    lcs: LCSParams
    starts: Tensor
    goals: Tensor | None
    disturbance: float


def cart_pole(horizon: int, count: int, seed: int) -> Case:
    """Balance upright between two walls, from starts at which the tip touches one or not."""
    generator = torch.Generator().manual_seed(seed)
    weight = torch.diag(torch.tensor([10.0, 50.0, 1.0, 1.0], dtype=torch.float64))
    cost = QuadraticCost(weight, torch.eye(1, dtype=torch.float64), 5 * weight)
    lcs = cart_pole_between_walls()
    mpc = LCSMPCLayer(LCSModel.from_params(lcs), cost, horizon, -10.0, 10.0, on_failure="mask")
    size = torch.tensor([0.05, 0.1, 0.2, 0.2], dtype=torch.float64)
    starts = size * (2 * torch.rand(count, 4, generator=generator, dtype=torch.float64) - 1)
    return Case(mpc, lcs, starts, None, 2e-3)


def cube(horizon: int, count: int, seed: int) -> Case:
    """Push the cube with the model of the zoo, 1 mm of disturbance."""
    lcs = LCSModel.from_pretrained("trifinger-cube")
    mpc = LCSMPCLayer(lcs, pushing_cost(), horizon, -ACTION_LIMIT, ACTION_LIMIT, on_failure="mask")
    return Case(mpc, lcs.params().detach(), *states_and_goals(count, seed), 1e-3)


CASES: dict[str, Callable[[int, int], Case]] = {
    "cart-pole, H 10": lambda count, seed: cart_pole(10, count, seed),
    "cart-pole, H 20": lambda count, seed: cart_pole(20, count, seed),
    "zoo cube, H 5": lambda count, seed: cube(5, count, seed),
    "zoo cube, H 8": lambda count, seed: cube(8, count, seed),
}


class Recorder:
    """Stands before the kernels and remembers the last call, so that it can be made again alone."""

    def __init__(self) -> None:
        self.again: Callable[[], object] = lambda: None

    def __getattr__(self, name: str) -> Any:
        kernel = getattr(_kernels, name)

        def call(*args: Any, **kwargs: Any) -> object:
            self.again = lambda: kernel(*args, **kwargs)
            return kernel(*args, **kwargs)

        return call


def kernel_call(mpc: LCSMPCLayer, inputs: tuple[Tensor, ...], guess: Primal) -> Callable[[], object]:
    """The call of the native solver that the layer makes for a problem."""
    recorder = Recorder()
    batched._kernels = recorder  # pyright: ignore[reportAttributeAccessIssue]
    try:
        mpc(*inputs, guess=guess)
    finally:
        batched._kernels = _kernels
    return recorder.again


@dataclass
class Step:
    """One state of an episode: what the layer is called with, the plan of the state before, and the one found here."""

    inputs: tuple[Tensor, ...]
    before: MPCSolution
    guess: Primal
    plan: MPCSolution
    kernel: Callable[[], object]


def play(case: Case, episode: int, plan: MPCSolution | None, generator: torch.Generator) -> list[Step]:
    """An episode in closed loop, after one that ended with a plan."""
    x, steps = case.starts[episode : episode + 1].clone(), []
    goal = () if case.goals is None else (case.goals[episode : episode + 1].clone(),)
    for _ in range(EPISODE):
        before = case.mpc(x, *goal) if plan is None else plan
        guess = before.shift()
        found = plan = case.mpc(x, *goal, guess=guess)
        steps.append(Step((x, *goal), before, guess, found, kernel_call(case.mpc, (x, *goal), guess)))
        noise = torch.randn(x.shape, generator=generator, dtype=torch.float64)
        x = case.lcs.step(x, found.action).x_next + case.disturbance * noise
    return steps


def ways(mpc: LCSMPCLayer, controller: Any) -> dict[str, Callable[[Step], Callable[[], Any]]]:
    """Name → the call to be timed, at a step."""

    def with_gradient(step: Step) -> Callable[[], Any]:
        x = step.inputs[0].clone().requires_grad_()

        def work() -> None:
            with torch.enable_grad():
                mpc(x, *step.inputs[1:], guess=step.guess).action.square().sum().backward()

        return work

    def with_controller(step: Step) -> Callable[[], Any]:
        arrays = [value[0].numpy() for value in step.inputs]
        return lambda: controller.step(*arrays)

    found: dict[str, Callable[[Step], Callable[[], Any]]] = {
        "kernel": lambda step: step.kernel,
        "layer": lambda step: lambda: mpc(*step.inputs, guess=step.guess),
        "shift": lambda step: step.before.shift,
        "layer and gradient": with_gradient,
    }
    if controller is not None:
        found["controller"] = with_controller
    return found


def timed(work: Callable[[], Any]) -> tuple[int, int, Any]:
    """CPU and wall time of a call [ns], and its result."""
    wall, start = time.perf_counter_ns(), time.process_time_ns()
    result = work()
    used = time.process_time_ns() - start
    return used, time.perf_counter_ns() - wall, result


@torch.no_grad()
def measure(case: Case, o: Options) -> dict[str, dict[str, float]]:
    """Every figure of one problem by the name of the way."""
    mpc = case.mpc
    make = getattr(mpc, "controller", None)
    if make is None:
        print("this version has no LCSMPCLayer.controller: left out")
    calls = ways(mpc, None if make is None else make())
    times: dict[str, list[tuple[int, int]]] = {name: [] for name in calls}
    apart, unsolved, iterations, plan = 0.0, 0, [], None
    generator = torch.Generator().manual_seed(o.seed + 1)
    for episode in range(o.warm_up + o.episodes):
        steps = play(case, episode, plan, generator)
        plan = steps[-1].plan
        for name, call in calls.items():
            for step in steps:
                used, wall, result = timed(call(step))
                if episode >= o.warm_up:
                    times[name].append((used, wall))
                    if name == "controller":
                        apart = max(apart, float(np.abs(result - step.plan.action[0].numpy()).max()))
            mpc.zero_grad()
        if episode >= o.warm_up:
            unsolved += sum(not bool(step.plan.converged) for step in steps)
            iterations += [int(step.plan.iterations) for step in steps]
    kernel = np.array(times["kernel"]) / 1e3
    figures: dict[str, dict[str, float]] = {}
    for name, found in times.items():
        both = np.array(found) / 1e3
        figures[name] = {
            "p50 µs": float(np.median(both[:, 0])),
            "p99 µs": float(np.percentile(both[:, 0], 99)),
            "wall p50 µs": float(np.median(both[:, 1])),
            "wall p99 µs": float(np.percentile(both[:, 1], 99)),
            "p50 to kernel": float(np.median(both[:, 0]) / np.median(kernel[:, 0])),
            "over kernel µs": float(np.median(both[:, 0] - kernel[:, 0])),
        }
    figures["plans"] = {"unsolved": unsolved, "iterations": float(np.mean(iterations)), "controller apart": apart}
    return figures


def main(o: Options) -> None:
    """Measure, print, write."""
    if o.smoke:
        o.episodes, o.warm_up = 2, 1
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", DegenerateWarning)
    count, total = o.episodes + o.warm_up, o.episodes * EPISODE
    results = {}
    for name, make in CASES.items():
        results[name] = figures = measure(make(count, o.seed), o)
        plans = figures["plans"]
        print(f"{name}: {plans['iterations']:.1f} iterations, {plans['unsolved']:.0f} of {total} not solved")
        for way, row in figures.items():
            if way != "plans":
                print(
                    f"  {way:20s} p50 {row['p50 µs']:7.0f} µs   p99 {row['p99 µs']:7.0f} µs   "
                    f"{row['p50 to kernel']:6.2f} × kernel   {row['over kernel µs']:+7.0f} µs"
                )
    record = {
        "machine": {**machine(), "cores": os.cpu_count()},
        "options": {"calls": total, "episodes": o.episodes, "warm_up": o.warm_up, "seed": o.seed},
        "results": results,
    }
    save(o.out, record)


if __name__ == "__main__":
    main(tyro.cli(Options))
