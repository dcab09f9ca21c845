"""A value at the end of a short horizon, learned from returns: `python examples/terminal_value.py --horizon 2`.

The MPC of the cube plans a few steps ahead, and its final cost stands for all that comes after them. This script plays
noisy episodes, computes from each state what the next steps cost, and fits to these returns

    V(x, goal) = ½ Σᵢ zᵢᵀ P zᵢ + ½ p yaw_error² + constant,  P ⪰ 0,  p ≥ 0,

where zᵢ, of each fingertip and axis, are the fingertip's place from the cube and the cube's place from its goal. V is a
convex quadratic of the state for each goal, so a mixture with the final cost is a `GoalCost` again, and the solver
stays exact. Printed are success and mean return on the same goals, with the task's final cost and with each mixture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from difflcs import GoalCost, LCSModel, LCSMPCLayer
from difflcs.rl import get_task
from difflcs.rl.rollout import collect, mpc_actions, noisy_actions
from difflcs.rl.seeding import Stream, episode_seeds
from difflcs.rl.tasks import single_start_backend

Maps = tuple[Tensor, Tensor]
"""X (k, m, n_x) and G (k, m, n_goal) of k features z = X x − G goal, of m numbers, that share one quadratic."""


def pushing_features() -> list[Maps]:
    """Return the features of a pushing task: of each fingertip and axis, and the yaw."""
    tips = torch.zeros(6, 2, 9, dtype=torch.float64), torch.zeros(6, 2, 3, dtype=torch.float64)
    for i in range(6):
        axis = i % 2
        tips[0][i, 0, 3 + i], tips[0][i, 0, axis] = 1.0, -1.0
        tips[0][i, 1, axis], tips[1][i, 1, axis] = 1.0, 1.0
    yaw = torch.zeros(1, 1, 9, dtype=torch.float64), torch.zeros(1, 1, 3, dtype=torch.float64)
    yaw[0][0, 0, 2] = yaw[1][0, 0, 2] = 1.0
    return [tips, yaw]


def compute_returns(cost: GoalCost, state: Tensor, action: Tensor, goal: Tensor, lookahead: int) -> Tensor:
    """Compute from each state what the next steps of its episode cost, the final cost after them included.

    Args:
        cost: of the MPC.
        state: (N, T+1, n_x).
        action: (N, T, n_u).
        goal: (N, n_goal).
        lookahead: number of steps L ≤ T.

    Returns:
        (N, T+1−L) returns of the first T+1−L states.
    """
    goals = goal.unsqueeze(1).expand(-1, state.shape[1], -1)
    stages = cost.stage(state[:, :-1], action, goals[:, 1:])
    last = cost(goals, horizon=0)
    final = 0.5 * ((state @ cost.Q_final) * state).sum(-1) + (last.q_final * state).sum(-1) + last.constant
    return stages.unfold(1, lookahead, 1).sum(-1) + final[:, lookahead:]


def fit_value(features: Sequence[Maps], state: Tensor, goal: Tensor, returns: Tensor) -> tuple[list[Tensor], float]:
    """Fit convex quadratics of features to returns, by least squares over their factors.

    Args:
        features: groups of features.
        state: (M, n_x).
        goal: (M, n_goal).
        returns: (M,).

    Returns:
        P (m, m) ⪰ 0 of each group, and the part of the variance of the returns that they explain.
    """
    squares, factors, units = [], [], []
    for X, G in features:
        z = torch.einsum("kij,nj->nki", X, state) - torch.einsum("kij,nj->nki", G, goal)
        unit = z.square().mean((0, 1)).sqrt()
        z = z / unit
        squares.append(torch.einsum("nki,nkj->nij", z, z))
        factors.append(torch.eye(len(unit), dtype=torch.float64).requires_grad_())
        units.append(unit)
    constant = returns.mean().requires_grad_()

    def residual() -> Tensor:
        terms = [0.5 * (s * (L @ L.mT)).sum((-1, -2)) for s, L in zip(squares, factors, strict=True)]
        return torch.stack(terms).sum(0) + constant - returns

    solver = torch.optim.LBFGS([*factors, constant], max_iter=500, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        solver.zero_grad()
        loss = residual().square().mean()
        loss.backward()
        return loss

    solver.step(closure)
    with torch.no_grad():
        explained = 1.0 - float(residual().var() / returns.var())
        return [L @ L.mT / torch.outer(u, u) for L, u in zip(factors, units, strict=True)], explained


def with_value(cost: GoalCost, features: Sequence[Maps], weights: Sequence[Tensor], share: float) -> GoalCost:
    """Return a cost whose final cost is (1 − share) of the present one and `share` of the value, but for a constant."""
    pairs = list(zip(features, weights, strict=True))

    def total(i: int, j: int) -> Tensor:
        return torch.stack([torch.einsum("kia,ij,kjb->ab", maps[i], P, maps[j]) for maps, P in pairs]).sum(0)

    def mix(old: Tensor, new: Tensor) -> Tensor:
        return (1 - share) * old + share * new

    return GoalCost(
        cost.Q,
        cost.R,
        mix(cost.Q_final, total(0, 0)),
        cost.goal_to_q,
        mix(cost.goal_to_q_final, -total(0, 1)),
        cost.goal_stage,
        mix(cost.goal_final, total(1, 1)),
    )


@dataclass
class Options:
    """Fit a value to episodes, and plan with it."""

    model: str = "zoo:trifinger-cube"
    """Model that the MPC plans with."""
    horizon: int = 2
    """Steps that it plans ahead."""
    episodes: int = 90
    """Episodes that the value is fitted to; 30 are a minute of data."""
    noise: float = 0.01
    """Standard deviation of the noise in them [m]: without much of it, all fingertips are where the MPC wants them."""
    lookahead: int = 6
    """Steps that a return sums."""
    shares: tuple[float, ...] = (0.1, 0.2)
    """Shares of the value in the final cost."""
    goals: int = 300
    """Goals of an evaluation."""
    seed: int = 78
    """Seed of these goals; episodes have seed 5."""


def main(o: Options) -> None:
    """Play, fit, compare."""
    torch.set_num_threads(1)
    task = get_task("cube")
    lcs, cost, features = LCSModel.from_pretrained(o.model), task.make_cost(), pushing_features()
    assert isinstance(cost, GoalCost)
    envs = task.make_envs(100)
    low, high = task.bounds

    def play(cost: GoalCost, count: int, seed: int, stream: Stream, noise: float = 0.0) -> list:
        backend = single_start_backend("batched")
        mpc = LCSMPCLayer(lcs, cost, o.horizon, low, high, backend, relaxation=task.relaxation, on_failure="mask")
        act = noisy_actions(mpc_actions(mpc), noise, np.random.default_rng(seed))
        sizes = [(first, min(100, count - first)) for first in range(0, count, 100)]
        seeds = [episode_seeds(seed, stream, first, size) for first, size in sizes]
        return [collect(envs, act, part, task.episode_steps) for part in seeds]

    def report(name: str, cost: GoalCost) -> None:
        parts = play(cost, o.goals, o.seed, Stream.EVALUATION)
        success = torch.cat([part["success"] for part in parts]).double().mean()
        reward = torch.cat([part["reward"].sum(-1) for part in parts]).mean()
        print(f"H {o.horizon}, {name}: {100 * float(success):.1f} %, mean return {float(reward):.2f}", flush=True)

    report("final cost of the task", cost)
    parts = play(cost, o.episodes, 5, Stream.TRAINING, o.noise)
    state, action, goal = (torch.cat([part[part["stable"]][k] for part in parts]) for k in ("state", "action", "goal"))
    returns = compute_returns(cost, state, action, goal, o.lookahead)
    starts = state[:, : returns.shape[1]]
    goals = goal.unsqueeze(1).expand(-1, returns.shape[1], -1)
    weights, explained = fit_value(features, starts.flatten(0, 1), goals.flatten(0, 1), returns.flatten())
    print(f"P {weights[0].tolist()}, p {float(weights[1]):.3g}: {100 * explained:.0f} % of the variance explained")
    for share in o.shares:
        report(f"{share:g} of the value", with_value(cost, features, weights, share))


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Options))
