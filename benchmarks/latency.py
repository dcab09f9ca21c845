"""How long one robot waits for its action: `python benchmarks/latency.py [--smoke]`.

A loop is closed on the LCS itself, with a disturbance, and a new start and goal for each episode, so that states vary.
At each state every way to plan takes its turn on the same problem with the same warm start, the shifted plan:

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

import json
import os
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

import difflcs
from difflcs import LCSModel, LCSMPCLayer, MPCSolution, QuadraticCost
from difflcs._native import _kernels
from difflcs.bench import ACTION_LIMIT, cpu, pushing_cost, states_and_goals
from difflcs.mpc.backends import batched
from difflcs.systems import cart_pole_between_walls

EPISODE = 20  # steps from one start to the next


@dataclass
class Options:
    """Latency of a call for one robot."""

    calls: int = 5000
    """Warm calls of each way, for each problem."""
    warm_up: int = 100
    """Calls before, which do not count."""
    seed: int = 0
    """Seed of starts, goals and disturbances."""
    out: Path = Path("benchmarks/results/latency.json")
    """Where the JSON goes."""
    smoke: bool = False
    """A few calls only."""


@dataclass
class Case:
    """One robot: its layer, starts (N, n_x), goals (N, n_goal) or None, and the disturbance of a step."""

    mpc: LCSMPCLayer
    starts: Tensor
    goals: Tensor | None
    disturbance: float


def cart_pole(horizon: int, count: int, seed: int) -> Case:
    """Balance upright between two walls, from starts at which the tip touches one or not."""
    generator = torch.Generator().manual_seed(seed)
    weight = torch.diag(torch.tensor([10.0, 50.0, 1.0, 1.0], dtype=torch.float64))
    cost = QuadraticCost(weight, torch.eye(1, dtype=torch.float64), 5 * weight)
    mpc = LCSMPCLayer(LCSModel.from_params(cart_pole_between_walls()), cost, horizon, -10.0, 10.0, on_failure="mask")
    size = torch.tensor([0.05, 0.1, 0.2, 0.2], dtype=torch.float64)
    starts = size * (2 * torch.rand(count, 4, generator=generator, dtype=torch.float64) - 1)
    return Case(mpc, starts, None, 2e-3)


def cube(horizon: int, count: int, seed: int) -> Case:
    """Push the cube with the model of the zoo, 1 mm of disturbance."""
    lcs = LCSModel.from_pretrained("trifinger-cube")
    mpc = LCSMPCLayer(lcs, pushing_cost(), horizon, -ACTION_LIMIT, ACTION_LIMIT, on_failure="mask")
    return Case(mpc, *states_and_goals(count, seed), 1e-3)


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


def kernel_call(mpc: LCSMPCLayer, inputs: tuple[Tensor, ...], guess: Any) -> Callable[[], object]:
    """The call of the native solver that the layer makes for a problem."""
    recorder = Recorder()
    batched._kernels = recorder  # pyright: ignore[reportAttributeAccessIssue]
    try:
        mpc(*inputs, guess=guess)
    finally:
        batched._kernels = _kernels
    return recorder.again


def ways(case: Case, inputs: tuple[Tensor, ...], plan: MPCSolution, controller: Any) -> dict[str, Callable[[], Any]]:
    """Name → call, at one state; `plan` is that of the state before."""
    mpc, guess = case.mpc, plan.shift()
    x = inputs[0].clone().requires_grad_()

    def with_gradient() -> None:
        with torch.enable_grad():
            mpc(x, *inputs[1:], guess=guess).action.square().sum().backward()

    found: dict[str, Callable[[], Any]] = {
        "kernel": kernel_call(mpc, inputs, guess),
        "layer": lambda: mpc(*inputs, guess=guess),
        "shift": plan.shift,
        "layer and gradient": with_gradient,
    }
    if controller is not None:
        arrays = [value[0].numpy() for value in inputs]
        found["controller"] = lambda: controller.step(*arrays)
    return found


def states(case: Case, o: Options) -> Iterator[tuple[tuple[Tensor, ...], Callable[[MPCSolution], None]]]:
    """Inputs of the layer, step by step, and what tells the plant which plan is executed."""
    generator = torch.Generator().manual_seed(o.seed + 1)
    lcs, x = case.mpc.lcs.params(), case.starts[:1]  # pyright: ignore[reportCallIssue]
    for k in range(o.warm_up + o.calls):
        episode = k // EPISODE
        if k % EPISODE == 0:
            x = case.starts[episode : episode + 1].clone()
        goal = () if case.goals is None else (case.goals[episode : episode + 1].clone(),)
        executed: list[MPCSolution] = []
        yield (x, *goal), executed.append
        noise = torch.randn(x.shape, generator=generator, dtype=torch.float64)
        x = lcs.step(x, executed[0].action).x_next + case.disturbance * noise


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
    controller = None if make is None else make()
    times: dict[str, list[tuple[int, int]]] = {}
    apart, unsolved, iterations, plan = 0.0, 0, [], None
    for k, (inputs, execute) in enumerate(states(case, o)):
        if plan is None:
            plan = mpc(*inputs)
        results = {}
        for name, work in ways(case, inputs, plan, controller).items():
            used, wall, results[name] = timed(work)
            if k >= o.warm_up:
                times.setdefault(name, []).append((used, wall))
        plan = results["layer"]
        mpc.zero_grad()
        execute(plan)
        unsolved += int(not bool(plan.converged))
        iterations.append(int(plan.iterations))
        if controller is not None and k > 0:
            apart = max(apart, float(np.abs(results["controller"] - plan.action[0].numpy()).max()))
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
        o.calls, o.warm_up = 30, 10
    torch.set_num_threads(1)
    count = (o.calls + o.warm_up) // EPISODE + 1
    results = {}
    for name, make in CASES.items():
        results[name] = figures = measure(make(count, o.seed), o)
        plans = figures["plans"]
        print(f"{name}: {plans['iterations']:.1f} iterations, {plans['unsolved']:.0f} of {o.calls} not solved")
        for way, row in figures.items():
            if way != "plans":
                print(
                    f"  {way:20s} p50 {row['p50 µs']:7.0f} µs   p99 {row['p99 µs']:7.0f} µs   "
                    f"{row['p50 to kernel']:6.2f} × kernel   {row['over kernel µs']:+7.0f} µs"
                )
    record = {
        "machine": {"cpu": cpu(), "cores": os.cpu_count(), "instruction set": _kernels.isa()},
        "versions": {"python": platform.python_version(), "torch": torch.__version__, "difflcs": difflcs.__version__},
        "options": {"calls": o.calls, "warm_up": o.warm_up, "seed": o.seed},
        "results": results,
    }
    o.out.parent.mkdir(parents=True, exist_ok=True)
    o.out.write_text(json.dumps(record, indent=2, ensure_ascii=False) + "\n")
    print(f"written to {o.out}")


if __name__ == "__main__":
    main(tyro.cli(Options))
