"""A value at the end of a short horizon, learned from returns: `python examples/terminal_value.py --horizon 2`.

The MPC of the cube plans a few steps ahead, and its final cost stands for all that comes after them. This script plays
noisy episodes, computes from each state what the next steps cost, and fits to these returns

    V(x, goal) = ½ Σᵢ zᵢᵀ P zᵢ + ½ p yaw_error² + constant,  P ⪰ 0,  p ≥ 0,

where zᵢ, of each fingertip and axis, are the fingertip's place from the cube and the cube's place from its goal. V is a
convex quadratic of the state for each goal, so a mixture with the final cost is a `GoalCost` again, and the solver
stays exact. Printed are success and mean return on the same goals, with the task's final cost and with each mixture.

    python examples/terminal_value.py train --method value-lcs --task cube --minutes 10 --seed 20 --out RUN
    python examples/terminal_value.py evaluate RUN

is the command `difflcs` with the method that this file registers: LCS-RL with such a horizon, where a part of V is
added to the final cost after the warm-up, fitted to its episodes. PPO then moves P and p together with the LCS, by its
gradient through the MPC. With `--share 0` the method is the same without V, with `--no-move` V stays as fitted.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from difflcs import GoalCost, LCSModel, LCSMPCLayer, QuadraticCost, cli
from difflcs.rl import TaskSpec, Trainer, bounded, get_task, register_method
from difflcs.rl.learning.lcsrl import LCSRL
from difflcs.rl.methods import LCSRLMethod, Work
from difflcs.rl.methods.phases import main_phase, warmup_phase
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


def fit_to_episodes(cost: GoalCost, episodes: Any, lookahead: int) -> tuple[list[Tensor], float]:
    """Fit the value of pushing to episodes, see `fit_value`."""
    state, action, goal = (episodes[k] for k in ("state", "action", "goal"))
    returns = compute_returns(cost, state, action, goal, lookahead)
    goals = goal.unsqueeze(1).expand(-1, returns.shape[1], -1)
    starts = state[:, : returns.shape[1]].flatten(0, 1)
    return fit_value(pushing_features(), starts, goals.flatten(0, 1), returns.flatten())


class ValueLCS(LCSModel):
    """An `LCSModel` with four numbers of a value besides: the Cholesky factor of P by rows and √p, in `UNIT`."""

    kind = "ValueLCS"
    batched = True
    UNIT = 100.0
    value: nn.Parameter

    def __init__(self, *sizes, **options):
        super().__init__(*sizes, **options)
        with torch.no_grad():
            self.value.zero_()

    @staticmethod
    def _shapes(x: int, u: int, m: int) -> dict[str, tuple[int, ...]]:
        return {**LCSModel._shapes(x, u, m), "value": (4,)}

    def weights(self) -> list[Tensor]:
        """Return P (..., 2, 2) and p (..., 1, 1)."""
        a, b, c, yaw = (self.UNIT * self.value).unbind(-1)
        factor = torch.stack([torch.stack([a, torch.zeros_like(a)], -1), torch.stack([b, c], -1)], -2)
        return [factor @ factor.mT, yaw.square()[..., None, None]]

    @torch.no_grad()
    def take(self, weights: Sequence[Tensor]) -> None:
        """Make these the weights of the value."""
        (a, _), (b, c) = torch.linalg.cholesky(weights[0] + 1e-6 * torch.eye(2, dtype=torch.float64))
        self.value.copy_(torch.stack([a, b, c, weights[1].squeeze().sqrt()]) / self.UNIT)


class ValueCost(nn.Module):
    """A `CostModule`: the cost of the task, and the value of a `ValueLCS` in the final cost."""

    X: Tensor
    G: Tensor
    x_yaw: Tensor
    goal_yaw: Tensor

    def __init__(self, cost: GoalCost, lcs: ValueLCS):
        super().__init__()
        self.cost, self.n_x, self.n_u, self.n_goal = cost, cost.n_x, cost.n_u, cost.n_goal
        self._lcs = (lcs,)  # its parameters are those of the MPC's system already
        (X, G), (x_yaw, goal_yaw) = pushing_features()
        for name, value in {"X": X, "G": G, "x_yaw": x_yaw, "goal_yaw": goal_yaw}.items():
            self.register_buffer(name, value, persistent=False)

    def at(self, x: Tensor, goal: Tensor | None = None, context: Tensor | None = None) -> QuadraticCost:
        """See `CostModule`."""
        assert goal is not None
        P, p = self._lcs[0].weights()
        square = (self.X.mT @ P.unsqueeze(-3) @ self.X).sum(-3) + (self.x_yaw.mT * p @ self.x_yaw).squeeze(0)
        by_goal = (self.X.mT @ P.unsqueeze(-3) @ self.G).sum(-3) + (self.x_yaw.mT * p @ self.goal_yaw).squeeze(0)
        own = self.cost(goal)
        q_final = own.q_final - (by_goal @ goal.unsqueeze(-1)).squeeze(-1)
        return QuadraticCost(own.Q, own.R, own.Q_final + square, own.q, own.r, q_final, own.constant, check=False)


@register_method
@dataclass(frozen=True)
class ValueMethod(LCSRLMethod):
    """LCS-RL with a short horizon and a value at its end, for the pushing tasks of the library."""

    horizon: int = bounded(2, minimum=1, maximum=100)
    """Steps that the MPC plans ahead."""
    share: float = bounded(0.25, minimum=0)
    """Share of the fitted value that is added to the final cost after the warm-up; 0: no value."""
    move: bool = True
    """PPO moves the value together with the LCS."""
    lookahead: int = bounded(6, minimum=1)
    """Steps that a return sums."""

    name: ClassVar[str] = "value-lcs"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "LCS-RL with a learned value at the end of a short horizon (examples/terminal_value.py)"
    kind: ClassVar[str] = ValueLCS.kind
    takes_init: ClassVar[bool] = False
    model: ClassVar[type[LCSModel]] = ValueLCS

    def policy(self, task: TaskSpec, learned: Any) -> LCSMPCLayer:
        """See `Method`."""
        cost: Any = task.make_cost()
        return super().policy(replace(task, horizon=self.horizon, make_cost=lambda: ValueCost(cost, learned)), learned)

    def trainer(self, work: Work) -> Trainer:
        """See `Method`."""
        lcs: Any = self.initial(work)
        lcs.value.requires_grad_(self.move and self.share > 0)
        policy = self.policy(work.task, lcs)
        warmup = warmup_phase(work, lcs, policy, self.warmup)

        def main(first_episode: int, first_iteration: int) -> Any:
            cost: Any = work.task.make_cost()
            if self.share and len(warmup.buffer):  # a resumed training has a value already
                weights, _ = fit_to_episodes(cost, warmup.buffer, self.lookahead)
                lcs.take([self.share * weight for weight in weights])
            return main_phase(work, policy, self.ppo, self.models, first_episode, first_iteration)

        return LCSRL(warmup, round(self.warmup_minutes * work.task.steps_per_minute), main)


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
    episodes: Any = torch.cat(parts)  # pyright: ignore[reportCallIssue, reportArgumentType]
    weights, explained = fit_to_episodes(cost, episodes[episodes["stable"]], o.lookahead)
    print(f"P {weights[0].tolist()}, p {float(weights[1]):.3g}: {100 * explained:.0f} % of the variance explained")
    for share in o.shares:
        report(f"{share:g} of the value", with_value(cost, features, weights, share))


if __name__ == "__main__":
    if sys.argv[1:2] in (["train"], ["evaluate"]):
        sys.exit(cli.main(sys.argv[1:]))
    import tyro

    main(tyro.cli(Options))
