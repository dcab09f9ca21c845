"""Which optima the backends reach: `python benchmarks/optima.py [--models RUN/model …] [--smoke]`.

The LCS-MPC has local optima. Every backend solves the same problems; the best cost seen by anyone is the reference.
Printed per backend: mean gap to it, the share of problems within 0.1 % of it, and better / equal / worse than IPOPT's
cold start (equal: within 0.1 %). Written as JSON too.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from models import ACTION_LIMIT, pushing_model, random_model, states_and_goals

from difflcs import LCSModel, LCSMPCLayer, LCSParams
from difflcs.mpc.backends import Backend, BatchedBackend, IpoptBackend
from difflcs_envs.tasks import pushing_cost

BACKENDS: dict[str, Backend] = {
    "ipopt": IpoptBackend(),
    "ipopt, start 1": IpoptBackend(start=1.0, mu_init=0.1),  # IPOPT's own defaults, as the prior work
    "batched": BatchedBackend(),
    "batched, 4 starts": BatchedBackend(restarts=4),
    "batched, 16 starts": BatchedBackend(restarts=16),
}
EQUAL = 1e-3  # relative difference of costs


@dataclass
class Options:
    """Comparison of the optima that the backends reach."""

    problems: int = 100
    """Problems per model."""
    seeds: int = 3
    """Synthetic models of each kind and size."""
    models: tuple[Path, ...] = ()
    """Learned models to add: directories written by `LCSModel.save_pretrained`, such as RUN/model."""
    out: Path = Path("benchmarks/results/optima.json")
    """Where the JSON goes."""
    smoke: bool = False
    """Everything tiny."""


def costs(model: LCSParams, count: int, seed: int) -> dict[str, torch.Tensor]:
    """Objective of every backend on the same problems; infinite where it failed."""
    x0, goal = states_and_goals(count, seed)
    found = {}
    for name, backend in BACKENDS.items():
        mpc = LCSMPCLayer(model, pushing_cost(), 5, -ACTION_LIMIT, ACTION_LIMIT, backend=backend, on_failure="mask")
        plan = mpc(x0, goal)
        found[name] = torch.where(plan.converged, plan.objective, torch.inf)
    return found


def compare(found: dict[str, torch.Tensor]) -> dict[str, dict[str, float]]:
    """The figures described above for each backend."""
    best = torch.stack(list(found.values())).amin(0)
    rows = {}
    for name, cost in found.items():
        gap = (cost - best) / best
        ratio = cost / found["ipopt"] - 1
        rows[name] = {
            "mean gap": float(gap[cost.isfinite()].mean()),
            "within 0.1 % of best": float((gap <= EQUAL).double().mean()),
            "better than ipopt": float((ratio < -EQUAL).double().mean()),
            "equal to ipopt": float((ratio.abs() <= EQUAL).double().mean()),
            "worse than ipopt": float((ratio > EQUAL).double().mean()),
            "failed": int((~cost.isfinite()).sum()),
        }
    return rows


def main(o: Options) -> None:
    """Compare, print, write."""
    if o.smoke:
        o.problems, o.seeds = 4, 1
    kinds: dict[str, list[LCSParams]] = {}
    for n_lam in (5, 8):
        kinds[f"pushing, n_lam {n_lam}"] = [pushing_model(n_lam, seed) for seed in range(o.seeds)]
        kinds[f"random, n_lam {n_lam}"] = [random_model(n_lam, seed) for seed in range(o.seeds)]
    for path in o.models:
        model = LCSModel.from_pretrained(path).params().detach()
        kinds.setdefault(f"learned, n_lam {model.n_lam}", []).append(model)
    results = {}
    for kind, models in kinds.items():
        parts = [costs(model, o.problems, seed) for seed, model in enumerate(models)]
        found = {name: torch.cat([part[name] for part in parts]) for name in BACKENDS}
        results[kind] = {"problems": len(found["ipopt"]), **compare(found)}
        print(f"{kind}: {len(found['ipopt'])} problems of {len(models)} models")
        for name in BACKENDS:
            row = results[kind][name]
            shares = "/".join(f"{100 * row[f'{word} ipopt']:.0f}" for word in ("better than", "equal to", "worse than"))
            near = 100 * row["within 0.1 % of best"]
            print(
                f"  {name:20s} mean gap {100 * row['mean gap']:6.3f} %   near best {near:5.1f} %   "
                f"better/equal/worse than ipopt {shares} %   failed {row['failed']}"
            )
    o.out.parent.mkdir(parents=True, exist_ok=True)
    o.out.write_text(
        json.dumps({"problems per model": o.problems, "seeds": o.seeds, "results": results}, indent=2) + "\n"
    )
    print(f"written to {o.out}")


if __name__ == "__main__":
    main(tyro.cli(Options))
