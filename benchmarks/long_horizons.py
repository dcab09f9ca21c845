"""Long horizons with weak actions, where contacts decide: `python benchmarks/long_horizons.py [--smoke]`.

Random models and those of `pushing_model`, the cost and the bounds of the cube (15 mm a step), from nothing. Some are
unstable in contact, and actions at their bounds cannot hold them. Printed per family and horizon: which share
`batched` and `ipopt` solve, of all models and of those whose plans stay below 10: a robot is never farther away, and
where a model grows to 1e6 no solver has numbers left to work with. Written as JSON too; the page is docs/limits.md.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from models import ACTION_LIMIT, pushing_model, random_model, states_and_goals

from difflcs import LCSMPCLayer, LCSParams
from difflcs.cli.bench import machine, pushing_cost, save
from difflcs.mpc.backends import Backend, BatchedBackend, IpoptBackend
from difflcs.status import solved

MODELS = {"random": random_model, "pushing": pushing_model}
BACKENDS: dict[str, Backend] = {"batched": BatchedBackend(threads=1), "ipopt": IpoptBackend()}
SANE = 10.0  # states of a plan in metres and radians


@dataclass
class Options:
    """Whether problems with long horizons are solved."""

    models: int = 24
    """Models of a family."""
    problems: int = 8
    """Problems per model."""
    horizons: tuple[int, ...] = (10, 20, 30)
    """Steps of a plan."""
    n_lam: int = 8
    """Contacts."""
    out: Path = Path("benchmarks/results/long_horizons.json")
    """Where the JSON goes."""
    smoke: bool = False
    """Everything tiny."""


def solve(lcs: LCSParams, horizon: int, count: int) -> dict[str, tuple[torch.Tensor, bool, float]]:
    """Of each backend: which problems it solved, whether its plans are sane, and CPU seconds."""
    x0, goal = states_and_goals(count, seed=1)
    found = {}
    for name, backend in BACKENDS.items():
        mpc = LCSMPCLayer(lcs, pushing_cost(), horizon, -ACTION_LIMIT, ACTION_LIMIT, backend=backend, on_failure="mask")
        with torch.no_grad():
            started = time.process_time()
            plan = mpc(x0, goal)
            seconds = time.process_time() - started
        found[name] = solved(plan.status), bool(plan.x.abs().max() < SANE), seconds
    return found


def main(o: Options) -> None:
    """Measure, print, write."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # what fails is counted
    if o.smoke:
        o.models, o.problems, o.horizons = 2, 2, (10,)
    rows = []
    for family, make in MODELS.items():
        for horizon in o.horizons:
            models = [solve(make(o.n_lam, seed), horizon, o.problems) for seed in range(o.models)]
            sane = [all(sane for _, sane, _ in model.values()) for model in models]
            row = {"family": family, "horizon": horizon, "models": o.models, "models with sane plans": sum(sane)}
            for name in BACKENDS:
                ok = torch.stack([model[name][0] for model in models])
                failed = torch.nonzero(~ok.all(1)).flatten().tolist()
                row[name] = {
                    "solved": float(ok.double().mean()),
                    "solved, sane models": float(ok[torch.tensor(sane)].double().mean()),
                    "models with failures": failed,
                    "sane models with failures": [i for i in failed if sane[i]],
                    "ms per problem": 1e3 * sum(model[name][2] for model in models) / ok.numel(),
                }
            rows.append(row)
            print(f"{family}, H {horizon}: plans of {sum(sane)} of {o.models} models stay below {SANE:g}")
            for name in BACKENDS:
                part = row[name]
                print(
                    f"  {name:8s} solved {100 * part['solved']:5.1f} %, of these models "
                    f"{100 * part['solved, sane models']:5.1f} % (failures in {part['sane models with failures']}), "
                    f"{part['ms per problem']:.2f} ms a problem",
                    flush=True,
                )
    save(o.out, {"machine": machine(), "problems per model": o.problems, "rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Options))
