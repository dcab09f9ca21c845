"""Time of a step of the controller, and the price of a deadline: `python benchmarks/controller.py [--smoke]`.

The controller of the zoo's cube goes over one recorded trajectory, in rounds that alternate: in Python, and with
--robot in the C program of examples/c. Of each step it takes the whole, the part that the solver takes (measured in the
C++ class), and the rest. Then it closes the loop on the learned model itself, with a deadline for each step, and
compares what on_failure does. At real-time priority (`chrt -f 50 python …`) other work disturbs it least.
"""

from __future__ import annotations

import json
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

NAMES = ("p50", "p99", "largest")
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
    """Path of the JSON output."""
    smoke: bool = False
    """A few steps only."""


def recorded(controller: MPCController, count: int) -> np.ndarray:
    """Record a trajectory of the model with noise, a new goal every 20 steps: rows of state and goal."""
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


Figures = dict[str, dict[str, float]]
"""Part of a step → its p50, p99 and largest time [µs]."""


def in_python(controller: MPCController, rows: np.ndarray, steps: int) -> Figures:
    """Time one round in Python."""
    times = np.empty((steps, 2))
    for i in range(-len(rows), steps):
        x, goal = rows[i % len(rows), :9].copy(), rows[i % len(rows), 9:].copy()
        begun = time.perf_counter()
        controller.step(x, goal)
        ended = time.perf_counter()
        if i >= 0:
            plan = controller.plan
            assert plan is not None
            times[i] = 1e6 * (ended - begun), 1e6 * plan.solve_time
    parts = {"step": times[:, 0], "solver": times[:, 1], "rest": times[:, 0] - times[:, 1]}
    return {part: dict(zip(NAMES, np.percentile(v, (50, 99, 100)).tolist(), strict=True)) for part, v in parts.items()}


def in_c(robot: Path, controller: Path, trajectory: Path, steps: int) -> Figures:
    """Time one round of the C program, which prints its times."""
    text = subprocess.check_output([robot, controller, trajectory, "--bench", str(steps)], text=True)
    lines = re.findall(r"p50 ([\d.]+).*p99 ([\d.]+).*largest ([\d.]+)", text)
    rows = [dict(zip(NAMES, map(float, line), strict=True)) for line in lines]
    return dict(zip(("step", "solver"), rows, strict=True))


def median(rounds: list[Figures]) -> Figures:
    """Compute the median of each figure."""
    return {part: {k: float(np.median([r[part][k] for r in rounds])) for k in NAMES} for part in rounds[0]}


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
    model = LCSModel.from_pretrained("trifinger-cube")
    mpc = get_task("cube").make_policy(model)
    controller = mpc.controller()
    rows = recorded(controller, min(1000, steps))
    times: dict[str, list[Figures]] = {"python": []} if o.robot is None else {"python": [], "c": []}
    with tempfile.TemporaryDirectory() as folder:
        path, trajectory = export_controller(mpc, folder), Path(folder) / "trajectory.csv"
        names = ",".join(f"n{i}" for i in range(12))
        np.savetxt(trajectory, rows, fmt="%.17g", delimiter=",", header=names, comments="")
        for _ in range(rounds):
            times["python"].append(in_python(controller, rows, steps))
            if o.robot is not None:
                times["c"].append(in_c(o.robot, path, trajectory, steps))
    record = {"machine": cpu(), "isa": controller.isa, "steps": steps, "rounds": rounds}
    record |= {name: median(each) for name, each in times.items()}
    record["deadline"] = {
        f"{on_failure} {limit}": tracking(model, mpc.controller(on_failure, limit), episodes)
        for on_failure in ("hold", "unfinished")
        for limit in (None, 200e-6, 100e-6)
    }
    print(json.dumps(record, indent=2))
    if not o.smoke:
        save(o.out, record)


if __name__ == "__main__":
    main(tyro.cli(Options))
