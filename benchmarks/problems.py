"""What more general problems cost: `python benchmarks/problems.py [--smoke]`.

Every line is the time of a solve and of its gradient as a ratio to the constant problem of the paper's form (one
system, one cost, bounds on the actions) of the same size, in the same run, on one thread; the best of several
repetitions. The same problem stated by stage must end in the same plan, bit for bit. Written as JSON too.

Constraints are random rows on states and actions that a known plan meets and the unconstrained plan does not: so they
can be met, and they act.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro
from models import ACTION_LIMIT, pushing_model, states_and_goals

from difflcs import (
    CostSequence,
    GoalCost,
    LCSMPCLayer,
    LCSParams,
    LCSSequence,
    LinearConstraints,
    MPCSolution,
    QuadraticCost,
    StageBounds,
)
from difflcs.cli.bench import pushing_cost, save
from difflcs.mpc.backends import BatchedBackend


@dataclass
class Options:
    """Cost of stages, previews, constraints and systems per call."""

    problems: int = 512
    """Problems of a batch."""
    repetitions: int = 9
    """Repetitions, of which the best counts."""
    out: Path = Path("benchmarks/results/problems.json")
    """Where the JSON goes."""
    smoke: bool = False
    """Everything tiny."""


Call = Callable[[], MPCSolution]


def seconds(work: Callable[[], object]) -> float:
    """CPU time of one call."""
    start = time.process_time()
    work()
    return time.process_time() - start


def backward(call: Call) -> None:
    """One plan and the gradient of its first action."""
    call().action.square().sum().backward()


def compare(calls: dict[str, Call], repetitions: int) -> dict[str, dict[str, float]]:
    """Best times of plan, warm plan and plan with gradient, as ratios to the first call's; they take turns."""
    best: dict[str, dict[str, float]] = {name: {} for name in calls}
    for _ in range(repetitions):
        for name, call in calls.items():
            with torch.no_grad():
                plain = seconds(call)
            found = {"plan": plain, "plan and gradient": seconds(lambda call=call: backward(call))}
            for kind, value in found.items():
                best[name][kind] = min(value, best[name].get(kind, value))
    base = next(iter(best.values()))
    return {name: {kind: value / base[kind] for kind, value in times.items()} for name, times in best.items()}


def by_stage(lcs: LCSParams, cost: QuadraticCost, horizon: int) -> tuple[LCSSequence, CostSequence, StageBounds]:
    """The constant problem stated anew for each stage."""

    def repeat(value: torch.Tensor, own: int) -> torch.Tensor:
        lead, rest = value.shape[: value.ndim - own], value.shape[value.ndim - own :]
        return value.reshape(*lead, 1, *rest).expand(*lead, horizon, *rest).contiguous()

    sequence = LCSSequence.stack([lcs] * horizon)
    stages = {name: repeat(getattr(cost, name), 2 if name in ("Q", "R") else 1) for name in ("Q", "R", "q", "r")}
    limit = torch.full((horizon, lcs.n_u), ACTION_LIMIT, dtype=torch.float64)
    final = {"Q_final": cost.Q_final, "q_final": cost.q_final, "constant": cost.constant}
    return sequence, CostSequence(**stages, **final), StageBounds(-limit, limit)


def acting_constraints(mpc: LCSMPCLayer, x0: torch.Tensor, goal: torch.Tensor, rows: int) -> LinearConstraints:
    """Rows that the plan to half the goal meets at every stage, and that the plan to the goal violates where it can."""
    generator = torch.Generator().manual_seed(0)
    G = torch.randn(rows, mpc.lcs.n_x, generator=generator, dtype=torch.float64)
    E = 0.3 * torch.randn(rows, mpc.lcs.n_u, generator=generator, dtype=torch.float64)

    def largest(plan: MPCSolution) -> torch.Tensor:
        value = plan.x @ G.mT
        value[..., :-1, :] += plan.u @ E.mT
        return value.amax(-2)

    with torch.no_grad():
        wanted, known = largest(mpc(x0, goal)), largest(mpc(x0, 0.5 * goal))
    # Where the wanted plan stays below the known one anyway, the row is turned round by its sign.
    sign = torch.where((wanted > known).double().mean(0) >= 0.5, 1.0, -1.0)
    G, E = sign[:, None] * G, sign[:, None] * E
    with torch.no_grad():
        limit = largest(mpc(x0, 0.5 * goal))
    return LinearConstraints(G, limit + 1e-2 * limit.abs(), E=E)


def measure(n_lam: int, horizon: int, seed: int, o: Options) -> dict[str, object]:
    """All ratios for one size."""
    lcs = pushing_model(n_lam, seed)
    x0, goal = states_and_goals(o.problems, seed=1)
    x0.requires_grad_()
    backend = BatchedBackend(threads=1)
    cost: GoalCost = pushing_cost()
    mpc = LCSMPCLayer(lcs, cost, horizon, -ACTION_LIMIT, ACTION_LIMIT, backend=backend, on_failure="mask")
    quadratic = cost(goal, horizon)
    sequence, costs, bounds = by_stage(lcs, quadratic, horizon)
    reference = goal.unsqueeze(1).expand(-1, horizon + 1, -1).contiguous()
    generator = torch.Generator().manual_seed(2)
    spread = {k: 1 + 1e-9 * torch.rand(o.problems, *v.shape, generator=generator, dtype=torch.float64)
              for k, v in lcs.tensors().items()}  # fmt: skip
    own = {k: (v * spread[k]).requires_grad_() for k, v in lcs.tensors().items()}
    with torch.no_grad():
        plan = mpc(x0, goal)
        for call in (lambda: mpc(x0, reference=reference), lambda: mpc(x0, lcs=sequence, cost=costs, bounds=bounds)):
            assert torch.equal(call().u, plan.u)
    constrained = {f"{rows} constraints": acting_constraints(mpc, x0.detach(), goal, rows) for rows in (2, 4)}
    calls: dict[str, Call] = {
        "constant": lambda: mpc(x0, goal),
        "a reference for each stage": lambda: mpc(x0, reference=reference),
        "all data by stage": lambda: mpc(x0, lcs=sequence, cost=costs, bounds=bounds),
        "a system of its own for each": lambda: mpc(x0, goal, lcs=LCSParams(**own)),
        **{name: lambda rows=rows: mpc(x0, goal, constraints=rows) for name, rows in constrained.items()},
    }
    ratios = compare(calls, o.repetitions)
    acting = {}
    for name, rows in constrained.items():
        with torch.no_grad():
            found = mpc(x0, goal, constraints=rows)
        acting[name] = {
            "solved": float(found.converged.double().mean()),
            "active": float((found.mu > 0).flatten(1).any(1).double().mean()),
            "largest violation": float(found.violation[found.converged].max()),
        }
    return {"ratios": ratios, "constraints": acting}


def main(o: Options) -> None:
    """Compare, print, write."""
    if o.smoke:
        o = replace(o, problems=16, repetitions=1)
    torch.set_num_threads(1)
    results = {}
    # Over 20 steps the states of the model of seed 0 reach 2e9: what one measures there is failures.
    for n_lam, horizon, seed in ((5, 5, 0), (8, 5, 0), (5, 20, 1)):
        size = f"n_x 9, n_u 6, n_lam {n_lam}, H {horizon}"
        results[size] = measure(n_lam, horizon, seed, o)
        print(f"{size}, {o.problems} problems: times as ratios to the constant problem")
        for name, ratio in results[size]["ratios"].items():
            print(f"  {name:30s}" + "".join(f"  {kind} {value:5.2f}" for kind, value in ratio.items()))
        for name, found in results[size]["constraints"].items():
            print(f"  {name}: {', '.join(f'{kind} {value:.3g}' for kind, value in found.items())}")
    save(o.out, {"problems": o.problems, "results": results})


if __name__ == "__main__":
    main(tyro.cli(Options))
