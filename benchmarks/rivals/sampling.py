"""Sampling MPC on the same LCS under hard contact: CEM (Rubinstein 1999) and MPPI (Williams et al. 2017)."""

import numpy as np

from difflcs.lcp import solve_lcp_arrays
from rivals.problem import Answer, Problem, Rival


class Solver(Rival):
    """Gaussian actions around a mean, which starts at zero; the best sequence of all is the plan.

    Args:
        problem: what is to be solved; its relaxation plays no part.
        method: "cem" or "mppi".
        samples, iterations: sequences of an iteration, and how many iterations.
        spread: standard deviation at the start, in parts of half the range of the actions.
        hold: steps for which an action is held.
        keep: "cem": part of the samples that make the next mean and spread; "mppi": temperature, in standard deviations
            of the cost.
    """

    def __init__(
        self, problem: Problem, method: str = "cem", samples: int = 64, iterations: int = 8, spread: float = 0.5,
        hold: int = 1, keep: float = 0.1,
    ):  # fmt: skip
        super().__init__(problem)
        self.cem, self.samples, self.iterations, self.spread = method == "cem", samples, iterations, spread
        self.hold, self.keep = hold, keep

    def costs(self, data: dict[str, np.ndarray], u: np.ndarray) -> np.ndarray:
        """Compute the cost (m,) of executing action sequences u (m, horizon, n_u)."""
        x, total = np.broadcast_to(data["x0"], (len(u), len(data["x0"]))), np.zeros(len(u))
        for action in u.swapaxes(0, 1):
            total += (x @ (0.5 * data["Q"]) * x).sum(1) + x @ data["q"]
            total += (action @ (0.5 * data["R"]) * action).sum(1) + action @ data["r"]
            lam = solve_lcp_arrays(data["F"], x @ data["D"].T + action @ data["E"].T + data["c"], 0.0)[0]
            x = x @ data["A"].T + action @ data["B"].T + lam @ data["C"].T + data["d"]
        return total + (x @ (0.5 * data["Q_final"]) * x).sum(1) + x @ data["q_final"]

    def one(self, i: int) -> Answer:
        """Sample, and move the mean to what costs little."""
        p, data, random = self.problem, self.problem.only(i), np.random.default_rng(i)
        low, high = data["u_min"], data["u_max"]
        knots = -(-p.horizon // self.hold)
        mean, spread = np.zeros((knots, p.n_u)), self.spread * 0.5 * (high - low) * np.ones((knots, p.n_u))
        least, best = np.inf, mean
        for _ in range(self.iterations):
            u = np.clip(mean + spread * random.standard_normal((self.samples, knots, p.n_u)), low, high)
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
