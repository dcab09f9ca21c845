"""Optima that the solver reaches, and their price: `python benchmarks/optima.py [--smoke]`.

The LCS-MPC has local optima. Every effort of the batched backend solves the same problems, cold; the reference is the
best cost seen by anyone, 160 other starts among them. Printed and written per family and effort: the mean gap, the
worst, the share within 0.1 %, what failed, and the CPU time as a ratio to `"fast"`, of all in one call and of the
first one by one.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from bouncing import FAMILIES as BOUNCING
from models import FAMILIES, Instance
from rivals.run import cpu

from difflcs import LCSMPCLayer
from difflcs.cli.bench import machine, save, smoke_path
from difflcs.mpc.backends import Backend, BatchedBackend

EFFORTS: dict[str, Backend] = {
    "fast": BatchedBackend(effort="fast", threads=1),
    "default": BatchedBackend(threads=1),
    "best": BatchedBackend(effort="best", threads=1),
}
REFERENCE: dict[str, Backend] = {
    "128 starts": BatchedBackend(restarts=128, seed=1, threads=1),
    "32 starts, long homotopy": BatchedBackend(restarts=32, homotopy=1e4, seed=1, max_iter=600, threads=1),
}
EQUAL = 1e-3  # relative difference of costs
ALONE = 24  # problems of a model that are solved one by one


@dataclass
class Options:
    """Comparison of the optima that the efforts reach."""

    problems: int = 128
    """Problems per model."""
    repetitions: int = 5
    """Solves of each, in turn with the other efforts; the fastest counts."""
    only: tuple[str, ...] = ()
    """Families to run; the others stay as they are in the file. All if none is named."""
    out: Path = Path("benchmarks/results/optima.json")
    """Path of the JSON output."""
    smoke: bool = False
    """Everything tiny, in a record of its own."""


def solve(instance: Instance, backend: Backend) -> tuple[torch.Tensor, float]:
    """Solve; return the objective of each problem, infinite where it failed, and CPU seconds."""
    mpc = LCSMPCLayer(backend=backend, on_failure="mask", **instance.layer)
    with torch.no_grad():
        seconds, plan = cpu(mpc, *instance.call)
    return torch.where(plan.converged, plan.objective, torch.inf), seconds


def time_alone(instance: Instance, repetitions: int) -> dict[str, float]:
    """Time each effort's solver on the first problems one by one; the fastest repetition counts."""
    mpc = LCSMPCLayer(backend=EFFORTS["fast"], on_failure="mask", **instance.layer)
    seconds = dict.fromkeys(EFFORTS, 0.0)
    with torch.no_grad():
        for i in range(min(ALONE, len(instance.call[0]))):
            problem = mpc(*(value[i : i + 1] for value in instance.call)).problem
            taken = {name: [] for name in EFFORTS}
            for _ in range(repetitions):
                for name, backend in EFFORTS.items():
                    taken[name].append(cpu(backend.solve, problem, None)[0])
            for name, times in taken.items():
                seconds[name] += min(times)
    return seconds


def compare(instances: list[Instance], repetitions: int) -> dict[str, dict[str, float]]:
    """Compute the figures described above for each effort."""
    gaps: dict[str, list[torch.Tensor]] = {name: [] for name in EFFORTS}
    seconds, alone = dict.fromkeys(EFFORTS, 0.0), dict.fromkeys(EFFORTS, 0.0)
    for instance in instances:
        for name, spent in time_alone(instance, repetitions).items():
            alone[name] += spent
        costs, least = {}, dict.fromkeys(EFFORTS, float("inf"))
        for _ in range(repetitions):
            for name, backend in EFFORTS.items():
                costs[name], spent = solve(instance, backend)
                least[name] = min(least[name], spent)
        objectives = [*costs.values(), *(solve(instance, backend)[0] for backend in REFERENCE.values())]
        best = torch.stack(objectives).amin(0)
        for name in EFFORTS:
            gaps[name].append((costs[name] - best) / best.abs())
            seconds[name] += least[name]
    rows = {}
    for name, parts in gaps.items():
        gap = torch.cat(parts)
        solved = gap.isfinite()
        rows[name] = {
            "mean gap": float(gap[solved].mean()),
            "worst gap": float(gap[solved].max()),
            "within 0.1 % of best": float((gap <= EQUAL).double().mean()),
            "failed": int((~solved).sum()),
            "time": seconds[name] / seconds["fast"],
            "time alone": alone[name] / alone["fast"],
        }
    return rows


def main(o: Options) -> None:
    """Compare, print, write."""
    torch.set_num_threads(1)
    if o.smoke:
        o.problems, o.repetitions = 4, 1
        o.out = smoke_path(o.out)
    results = json.loads(o.out.read_text())["results"] if o.only and o.out.exists() else {}
    for kind, make in {**FAMILIES, **BOUNCING}.items():
        if o.only and kind not in o.only:
            continue
        instances = make(o.problems)
        count = o.problems * len(instances)
        results[kind] = {"problems": count, **compare(instances, o.repetitions)}
        print(f"{kind}: {count} problems of {len(instances)} models")
        for name in EFFORTS:
            print(f"  {name:8s}", "   ".join(f"{label} {value:.4g}" for label, value in results[kind][name].items()))
        save(o.out, {"machine": machine(), "results": results})


if __name__ == "__main__":
    main(tyro.cli(Options))
