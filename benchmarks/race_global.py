"""Gaps of plans with relaxed contact to the global optimum with hard contact, on small problems."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from race_problems import as_mpc
from rivals.problem import Problem

from difflcs import solve_lcp
from difflcs.mpc.problem import MPCProblem


def hard_cost(mpc: MPCProblem, u: torch.Tensor) -> torch.Tensor:
    """Compute the cost (count,) of executing actions with λ·s = 0."""
    states = [mpc.x0]
    for k in range(mpc.horizon):
        stage = mpc.stage(k)
        lam = solve_lcp(stage.F, stage.gap(states[-1], u[:, k])).lam
        states.append(stage.next_state(states[-1], u[:, k], lam))
    return mpc.objective(torch.stack(states, 1), u)


def global_gaps(
    problems: Iterator[tuple[str, Problem]],
    optimum: Callable[[Problem], dict],
    ours: dict[str, Callable[[Problem], torch.Tensor]],
) -> dict[str, dict]:
    """Compute for each family the relative cost of `ours` above the proved optimum, [mean, worst].

    Args:
        problems: family and problems.
        optimum: plans `u`, whether each is proved (`solved`) and `times`, by branch and bound.
        ours: name → actions.
    """
    families: dict[str, dict] = {}
    for family, problem in problems:
        answer, mpc = optimum(problem), as_mpc(problem)
        table = families.setdefault(family, {"problems": 0, "proved": 0, "seconds": [], "gaps": {}})
        if "error" in answer:
            families[family] = answer
            continue
        proved = np.array(answer["solved"])
        best = hard_cost(mpc, torch.from_numpy(answer["u"]))[proved].numpy()
        table["problems"] += problem.count
        table["proved"] += int(proved.sum())
        table["seconds"] += answer["times"]
        for name, plan in ours.items():
            cost = hard_cost(mpc, mpc.clip(plan(problem)))[proved].numpy()
            gap = (cost - best) / (best + np.broadcast_to(problem.constant, problem.count)[proved])
            table["gaps"].setdefault(name, []).extend(float(v) for v in gap)
    for family, table in families.items():
        if "error" in table:
            continue
        gaps = {name: np.array(values) for name, values in table["gaps"].items()}
        table["seconds"] = float(np.mean(table["seconds"]))
        table["gaps"] = {
            name: {"mean": float(v.mean()), "worst": float(v.max()), "within 0.1 %": float((v <= 1e-3).mean())}
            for name, v in gaps.items()
        }
        shown = "  ".join(
            f"{name} {100 * row['mean']:.3f} % (worst {100 * row['worst']:.2f})" for name, row in table["gaps"].items()
        )
        print(f"{family}: {table['proved']} of {table['problems']} proved, {table['seconds']:.2f} s each; {shown}")
    return families
