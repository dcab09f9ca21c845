"""How long a step of the controller takes, and what a deadline costs: `python benchmarks/controller.py [--smoke]`.

The controller of the zoo's cube goes over one recorded trajectory, in rounds that alternate: in Python, and with
--robot in the C program of examples/c. Of each step it takes the whole, the part that the solver takes (measured in the
C++ class), and the rest. Then it closes the loop on the learned model itself, with a deadline for each step, and
compares what on_failure does. At real-time priority (`chrt -f 50 python …`) other work disturbs it least.
"""

from __future__ import annotations

import csv
import re
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from difflcs import LCSModel
from difflcs.cli.bench import cpu, save
from difflcs.mpc import MPCController
from difflcs.mpc.export import export_controller
from difflcs.rl.tasks import get_task

LIMIT = [-0.05, -0.05, -0.5], [0.05, 0.05, 0.5]


@dataclass
class Options:
    """Benchmark of the controller."""

    steps: int = 5000
    """Timed steps of each round."""
    rounds: int = 3
    """Rounds; the median of their figures counts."""
    robot: Path | None = None
    """The program of examples/c, to be timed as well."""
    out: Path = Path("benchmarks/results/controller.json")
    """Where the JSON goes."""
    smoke: bool = False
    """A few steps only."""


def recorded(controller: MPCController, count: int) -> np.ndarray:
    """A trajectory of the model with noise, a new goal every 20 steps: rows of state and goal."""
    rng, x, goal, rows = np.random.default_rng(0), np.zeros(9), np.zeros(3), []
    for k in range(count):
        if k % 20 == 0:
            goal = rng.uniform(*LIMIT)
        rows.append([*x, *goal])
        controller.step(x, goal)
        plan = controller.plan
        assert plan is not None
        x = plan.x[1] + 1e-3 * rng.normal(size=9)
    controller.reset()
    return np.array(rows)


def spread(microseconds: np.ndarray) -> dict[str, float]:
    """p50, p99 and largest."""
    return {"p50": float(np.median(microseconds)), "p99": float(np.percentile(microseconds, 99)),
            "largest": float(microseconds.max())}  # fmt: skip


def in_python(controller: MPCController, rows: np.ndarray, steps: int) -> dict[str, dict[str, float]]:
    """Times of one round [µs]."""
    whole, solver = np.empty(steps), np.empty(steps)
    for i in range(-len(rows), steps):
        x, goal = rows[i % len(rows), :9].copy(), rows[i % len(rows), 9:].copy()
        begun = time.perf_counter_ns()
        controller.step(x, goal)
        ended = time.perf_counter_ns()
        if i >= 0:
            plan = controller.plan
            assert plan is not None
            whole[i], solver[i] = (ended - begun) / 1e3, 1e6 * plan.solve_time
    return {"step": spread(whole), "solver": spread(solver), "rest": spread(whole - solver)}


def in_c(robot: Path, controller: Path, trajectory: Path, steps: int) -> dict[str, dict[str, float]]:
    """The same of the C program."""
    text = subprocess.check_output([robot, controller, trajectory, "--bench", str(steps)], text=True)
    lines = [line for line in text.splitlines() if "p50" in line]
    found = [[float(v) for v in re.findall(r"(?:p50|p99|largest) ([\d.]+)", line)] for line in lines]
    return {
        k: dict(zip(("p50", "p99", "largest"), v, strict=True)) for k, v in zip(("step", "solver"), found, strict=True)
    }


def median(rounds: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """The median of each figure."""
    first = rounds[0]
    return {part: {name: float(np.median([r[part][name] for r in rounds])) for name in first[part]} for part in first}


def tracking(model: LCSModel, controller: MPCController, episodes: int) -> dict[str, float]:
    """Sum of the squared errors of the cube over closed loops on the model, and the share of steps not solved."""
    rng, error, unsolved = np.random.default_rng(1), 0.0, 0
    for _ in range(episodes):
        x, goal = 0.005 * rng.normal(size=9), rng.uniform(*LIMIT)
        controller.reset()
        for _ in range(20):
            u = controller.step(x, goal)
            status = controller.status
            assert status is not None
            unsolved += not status.solved
            with torch.no_grad():
                x = model(torch.from_numpy(x), torch.from_numpy(u)).x_next.numpy() + 5e-4 * rng.normal(size=9)
            error += float(((x[:3] - goal) ** 2).sum())
    return {"error": error, "unsolved": unsolved / (20 * episodes)}


def main(o: Options) -> None:
    """Measure and print."""
    steps, rounds, episodes = (50, 1, 2) if o.smoke else (o.steps, o.rounds, 50)
    model, task = LCSModel.from_pretrained("trifinger-cube"), get_task("cube")
    mpc = task.make_policy(model)
    controller = mpc.controller()
    rows = recorded(controller, min(1000, steps))
    found: dict[str, object] = {"machine": cpu(), "isa": controller.isa, "steps": steps, "rounds": rounds}
    with tempfile.TemporaryDirectory() as folder:
        path, trajectory = export_controller(mpc, folder), Path(folder) / "trajectory.csv"
        with trajectory.open("w", newline="") as file:
            csv.writer(file).writerows([[f"n{i}" for i in range(12)], *([repr(float(v)) for v in row] for row in rows)])
        python, c = [], []
        for _ in range(rounds):
            python.append(in_python(controller, rows, steps))
            if o.robot is not None:
                c.append(in_c(o.robot, path, trajectory, steps))
    found["python"] = median(python)
    if c:
        found["c"] = median(c)
    print(f"{found['machine']}, {found['isa']}, {steps} warm steps, median of {rounds} rounds [µs]")
    for name in ("python", "c"):
        for part, values in (found[name] if name in found else {}).items():  # pyright: ignore
            print(f"  {name:6} {part:6} " + "  ".join(f"{k} {v:8.1f}" for k, v in values.items()))
    found["deadline"] = {}
    for on_failure in ("hold", "unfinished"):
        for limit in (None, 200e-6, 100e-6):
            result = tracking(model, mpc.controller(on_failure, limit), episodes)
            found["deadline"][f"{on_failure} {limit}"] = result  # pyright: ignore
            print(f"  {on_failure:10} deadline {limit}: squared error {result['error']:.1f}, "
                  f"{100 * result['unsolved']:.0f} % of the steps not solved")  # fmt: skip
    if not o.smoke:
        save(o.out, found)


if __name__ == "__main__":
    main(tyro.cli(Options))
