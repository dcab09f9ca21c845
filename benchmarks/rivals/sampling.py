"""Sampling MPC on the same LCS under hard contact: CEM (Rubinstein 1999) and MPPI (Williams et al. 2017)."""

import numpy as np

from difflcs.lcp import solve_lcp_arrays
from rivals.problem import Answer, Problem, Rival


class Solver(Rival):
    """Gaussian actions around a mean; the best sequence of all is the plan.

    Args:
        problem: what is to be solved; its relaxation plays no part.
        method: "cem" or "mppi".
        samples, iterations: sequences of an iteration, and how many iterations.
        spread: standard deviation at the start, in parts of half the range of the actions.
        hold: steps for which an action is held.
        keep: "cem": part of the samples that make the next mean and spread; "mppi": temperature, in standard deviations
            of the cost.

    Attributes:
        guess: (count, horizon, n_u) where the mean starts; None: at zero.
    """

    def __init__(
        self, problem: Problem, method: str = "cem", samples: int = 64, iterations: int = 8, spread: float = 0.5,
        hold: int = 1, keep: float = 0.1,
    ):  # fmt: skip
        super().__init__(problem)
        self.cem, self.samples, self.iterations, self.spread = method == "cem", samples, iterations, spread
        self.hold, self.keep = hold, keep
        self.guess: np.ndarray | None = None
        self.random = np.random.default_rng(0)

    def states(self, data: dict[str, np.ndarray], u: np.ndarray) -> np.ndarray:
        """Execute action sequences u (m, horizon, n_u): states (m, horizon + 1, n_x)."""
        x = [np.broadcast_to(data["x0"], (len(u), len(data["x0"])))]
        for action in u.swapaxes(0, 1):
            lam = solve_lcp_arrays(data["F"], x[-1] @ data["D"].T + action @ data["E"].T + data["c"], 0.0)[0]
            x.append(x[-1] @ data["A"].T + action @ data["B"].T + lam @ data["C"].T + data["d"])
        return np.stack(x, 1)

    def costs(self, data: dict[str, np.ndarray], u: np.ndarray) -> np.ndarray:
        """Compute the cost (m,) of executing action sequences u (m, horizon, n_u)."""
        x, total = self.states(data, u), np.zeros(len(u))
        for value, Q, q in ((x[:, :-1], "Q", "q"), (u, "R", "r"), (x[:, -1:], "Q_final", "q_final")):
            total += ((value @ (0.5 * data[Q]) * value).sum(-1) + value @ data[q]).sum(-1)
        return total

    def one(self, i: int) -> Answer:
        """Sample, and move the mean to what costs little."""
        p, data = self.problem, self.problem.only(i)
        low, high = data["u_min"], data["u_max"]
        knots = -(-p.horizon // self.hold)
        mean, spread = np.zeros((knots, p.n_u)), self.spread * 0.5 * (high - low) * np.ones((knots, p.n_u))
        if self.guess is not None:
            mean = self.guess[i, :: self.hold]
        least, best = np.inf, mean
        for _ in range(self.iterations):
            u = np.clip(mean + spread * self.random.standard_normal((self.samples, knots, p.n_u)), low, high)
            u[0] = mean
            cost = self.costs(data, u.repeat(self.hold, 1)[:, : p.horizon])
            order = np.argsort(cost)
            if cost[order[0]] < least:
                least, best = cost[order[0]], u[order[0]]
            if self.cem:
                elite = u[order[: max(2, int(self.keep * self.samples))]]
                mean, spread = elite.mean(0), elite.std(0)
            else:
                weight = np.exp((least - cost) / (self.keep * cost.std() + 1e-300))
                mean = np.einsum("i,ikj->kj", weight / weight.sum(), u)
        return Answer(best.repeat(self.hold, 0)[None, : p.horizon], np.array([True]))
