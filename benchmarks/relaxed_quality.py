"""How good the plans of backend `relaxed` are, and how long they take.

The actions of a plan are executed in the model itself (the rollout through relaxed complementarity), and the cost that
they really have is compared with that of backend `batched` from one cold start. "guess = plan" is `relaxed` again with
its own plan as guess, "no penalty" drops complementarity altogether, "no action" is u = 0. Times are of one thread, per
problem; ratios are of the same run.

    python benchmarks/relaxed_quality.py            # the table of RelaxedBackend's docstring
    python benchmarks/relaxed_quality.py --smoke    # seconds
"""

from __future__ import annotations

import argparse
import math
import time

import torch
from torch import Tensor

from difflcs import GoalCost, LCSMPCLayer, LCSParams, MPCSolution
from difflcs.mpc.backends import Backend, BatchedBackend, IpoptBackend, RelaxedBackend

HORIZON, U_MAX = 5, 0.015
PAIRS = [(3 + 2 * finger + axis, axis) for finger in range(3) for axis in range(2)]
COST = GoalCost.reach(9, 6, (200.0, 200.0, 0.3), (200.0, 200.0, 1.5), 200.0, PAIRS, 10.0, 6.0)


def normal(seed: int):
    """A function shape → standard normal float64 numbers."""
    generator = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)


def pushing_model(n_lam: int, seed: int) -> LCSParams:
    """Three fingertips around a body on a table, as a linear contact model with a random error of a few per cent.

    State: body x, y [m], yaw [rad], x, y [m] of three tips. Contact i is between tip i mod 3 and a face with normal n
    and lever r: gap n·(tip − body) + r·yaw − 45 mm; its λ moves body and tip apart.
    """
    n = normal(seed)
    unit = torch.tensor([1.0, 1.0, 0.02] + [1.0] * 6, dtype=torch.float64)  # 1 m of a tip, 20 mm of lever per radian
    J = torch.zeros(n_lam, 9, dtype=torch.float64)
    for i in range(n_lam):
        finger = i % 3
        angle = 2 * math.pi * finger / 3 + 0.4 * float(n(1))
        face = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
        J[i, :2], J[i, 2], J[i, 3 + 2 * finger : 5 + 2 * finger] = -face, 0.02 * float(n(1)), face
    mobility = torch.tensor([0.7, 0.7, 0.35 / 0.02**2] + [0.3] * 6, dtype=torch.float64)
    error = 0.03
    C = mobility[:, None] * J.mT + error * n(9, n_lam) / unit[:, None]
    D, E = J + error * n(n_lam, 9) * unit, J[:, 3:] + error * n(n_lam, 6)
    H = 0.05 * n(n_lam, n_lam)
    F = J @ (mobility[:, None] * J.mT) + 0.1 * torch.eye(n_lam, dtype=torch.float64) + H - H.mT
    A = torch.eye(9, dtype=torch.float64) + 0.3 * error * n(9, 9) * unit / unit[:, None]
    B = error * n(9, 6) / unit[:, None]
    B[3:] += torch.eye(6, dtype=torch.float64)
    return LCSParams(A, B, C, 0.0005 * n(9) / unit, D, E, F, -0.045 + 0.003 * n(n_lam))


def states_and_goals(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Bodies with the tips some 55 mm around them, and goals some 30 mm and 0.3 rad away."""
    n = normal(1000 + seed)
    body = torch.cat([0.03 * n(count, 2), 0.3 * n(count, 1)], 1)
    angles = 2 * math.pi / 3 * torch.arange(3, dtype=torch.float64)
    around = 0.055 * torch.stack([angles.cos(), angles.sin()], 1)
    tips = body[:, None, :2] + around + 0.008 * n(count, 3, 2)
    goal = body + torch.cat([0.03 * n(count, 2), 0.3 * n(count, 1)], 1)
    return torch.cat([body, tips.flatten(1)], 1), goal


def executed_cost(sol: MPCSolution, goal: Tensor) -> Tensor:
    """Cost (batch,) that the planned actions have in the model."""
    states, _ = sol.problem.rollout(sol.u)
    return sol.problem.objective(states, sol.u) + COST(goal, horizon=HORIZON).constant


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="models per size, seeds 0, 1, …")
    parser.add_argument("--count", type=int, default=12, help="problems per model")
    parser.add_argument("--smoke", action="store_true", help="2 models, 2 problems each")
    options = parser.parse_args()
    if options.smoke:
        options.seeds = options.count = 2
    torch.set_num_threads(1)
    backends: dict[str, Backend] = {
        "batched": BatchedBackend(),
        "ipopt": IpoptBackend(workers=1),
        "no action": BatchedBackend(),
        "relaxed, no penalty": RelaxedBackend(penalties=(0.0,)),
        "relaxed": RelaxedBackend(),
        "relaxed, guess = plan": RelaxedBackend(),
    }
    print(f"seeds 0…{options.seeds - 1}, {options.count} problems each, H = {HORIZON}, |u| ≤ {U_MAX}, λs = 1e-5")
    print("gap: executed cost above batched's; mean gap is of the mean costs, median and worst tenth of the ratios")
    head = f"{'n_lam':>5} {'backend':22} {'mean gap':>9} {'median':>8} {'worst 10%':>9} {'failed':>6} {'ms':>8}"
    print(f"{head} {'× batched':>9} {'× ipopt':>8}")
    for n_lam in (5, 8):
        costs: dict[str, list[Tensor]] = {name: [] for name in backends}
        seconds, failed = dict.fromkeys(backends, 0.0), dict.fromkeys(backends, 0)
        for seed in range(options.seeds):
            model = pushing_model(n_lam, seed)
            x0, goal = states_and_goals(options.count, seed)
            guess = None
            for name, backend in backends.items():
                layer = LCSMPCLayer(model, COST, HORIZON, -U_MAX, U_MAX, backend=backend, on_failure="mask")
                if seed == 0:
                    layer(x0[:1], goal[:1])  # compile, build, import
                if name == "no action":
                    layer = LCSMPCLayer(model, COST, HORIZON, 0.0, 0.0, backend=backend, on_failure="mask")
                start = time.perf_counter()
                sol = layer(x0, goal, guess=guess if name.endswith("= plan") else None)
                seconds[name] += time.perf_counter() - start
                failed[name] += int((~sol.converged).sum())
                costs[name].append(executed_cost(sol, goal))
                guess = sol
        best = torch.cat(costs["batched"])
        for name in backends:
            cost = torch.cat(costs[name])
            mean, ratio = float(cost.mean() / best.mean() - 1), cost / best - 1
            each = 1e3 * seconds[name] / len(cost)
            print(
                f"{n_lam:5d} {name:22} {mean:9.2%} {float(ratio.median()):8.2%} {float(ratio.quantile(0.9)):9.2%}"
                f" {failed[name]:6d} {each:8.3f} {seconds[name] / seconds['batched']:9.1f}"
                f" {seconds[name] / seconds['ipopt']:8.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
