"""The global optimum with hard contact, λ·s = 0, by branch and bound over the modes with DAQP's quadratic programs."""

from __future__ import annotations

import heapq
from importlib.metadata import version as version_of

import daqp
import numpy as np

from rivals.problem import Answer, Problem, Rival

FREE, NO_FORCE, CLOSED = 0, 1, 2
EQUALITY = 5  # DAQP's word for a constraint that holds with equality


def version() -> str:
    """Return the version of DAQP."""
    return f"daqp {version_of('daqp')}"


def lcp(F: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Solve 0 ≤ λ ⊥ F λ + q ≥ 0 by Murty's least-index pivoting, which ends if F + Fᵀ ≻ 0."""
    basic = np.zeros(len(q), bool)
    for _ in range(4 ** len(q)):
        lam = np.zeros(len(q))
        lam[basic] = np.linalg.solve(F[np.ix_(basic, basic)], -q[basic])
        wrong = np.where(basic, lam, F @ lam + q) < -1e-12
        if not wrong.any():
            return lam
        first = int(np.argmax(wrong))
        basic[first] = not basic[first]
    raise RuntimeError("the LCP has no solution: F + Fᵀ is not positive definite")


class Solver(Rival):
    """Best-first branch and bound over which of λ and s is zero.

    The variables are all u and λ. A node's lower bound is the quadratic program with λ, s ≥ 0 where nothing is decided;
    its upper bound executes the node's actions. Branching decides the pair with the largest smaller part.

    Args:
        problem: what is to be solved; its relaxation plays no part.
        nodes: quadratic programs before it gives up.
        gap: relative distance of the bounds at which it has proved the optimum.
    """

    def __init__(self, problem: Problem, nodes: int = 20_000, gap: float = 1e-6):
        super().__init__(problem)
        self.nodes, self.gap = nodes, gap

    def execute(self, data: dict[str, np.ndarray], u: np.ndarray) -> float:
        """Compute the cost of actions under hard contact."""
        x, total = data["x0"], 0.0
        for action in u:
            lam = lcp(data["F"], data["D"] @ x + data["E"] @ action + data["c"])
            total += 0.5 * x @ data["Q"] @ x + data["q"] @ x + 0.5 * action @ data["R"] @ action + data["r"] @ action
            x = data["A"] @ x + data["B"] @ action + data["C"] @ lam + data["d"]
        return float(total + 0.5 * x @ data["Q_final"] @ x + data["q_final"] @ x)

    def program(self, data: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """Compute H, f, constant of the cost, S and s0 with s = S z + s0, for z = (u_0, λ_0, u_1, …)."""
        horizon, n_u, n_lam = self.problem.horizon, self.problem.n_u, self.problem.n_lam
        step, size = n_u + n_lam, horizon * (n_u + n_lam)
        N, n = np.zeros((len(data["x0"]), size)), data["x0"]
        H, f, constant, S, s0 = np.zeros((size, size)), np.zeros(size), 0.0, [], []
        for k in range(horizon + 1):
            Q, q = (data["Q"], data["q"]) if k < horizon else (data["Q_final"], data["q_final"])
            H, f, constant = H + N.T @ Q @ N, f + N.T @ (Q @ n + q), constant + 0.5 * n @ Q @ n + q @ n
            if k == horizon:
                break
            in_u, force = slice(k * step, k * step + n_u), slice(k * step + n_u, (k + 1) * step)
            H[in_u, in_u] += data["R"]
            f[in_u] += data["r"]
            row = data["D"] @ N
            row[:, in_u] += data["E"]
            row[:, force] += data["F"]
            S.append(row)
            s0.append(data["D"] @ n + data["c"])
            N, n = data["A"] @ N, data["A"] @ n + data["d"]
            N[:, in_u] += data["B"]
            N[:, force] += data["C"]
        return 0.5 * (H + H.T), f, constant, np.concatenate(S), np.concatenate(s0)

    def one(self, i: int) -> Answer:
        """Find the best plan; return it, and whether it is proved to be the best of all."""
        data, p = self.problem.only(i), self.problem
        H, f, constant, S, s0 = self.program(data)
        size, contacts = len(f), len(s0)
        forces = (np.arange(p.horizon)[:, None] * (p.n_u + p.n_lam) + p.n_u + np.arange(p.n_lam)).ravel()
        actions = np.setdiff1d(np.arange(size), forces)
        # The forces have no cost: 1e-9 of the mean curvature makes their part positive definite.
        H[forces, forces] += 1e-9 * np.trace(H) / size
        low, high = np.full(size + contacts, -np.inf), np.full(size + contacts, np.inf)
        low[actions], high[actions] = np.tile(p.u_min, p.horizon), np.tile(p.u_max, p.horizon)
        low[forces], low[size:] = 0.0, -s0
        best, plan = np.inf, np.zeros((p.horizon, p.n_u))

        def bound(modes: np.ndarray) -> tuple[float, np.ndarray | None]:
            nonlocal best, plan
            above, sense = high.copy(), np.zeros(size + contacts, np.int32)
            above[forces[modes == NO_FORCE]] = 0.0
            above[size:][modes == CLOSED] = -s0[modes == CLOSED]
            sense[forces[modes == NO_FORCE]] = sense[size:][modes == CLOSED] = EQUALITY
            z, value, flag, _ = daqp.solve(H, f, S, above, low, sense, iter_limit=10_000)
            if flag < 1:
                return np.inf, None
            z = np.asarray(z)
            u = np.clip(z[actions].reshape(p.horizon, p.n_u), p.u_min, p.u_max)
            cost = self.execute(data, u)
            if cost < best:
                best, plan = cost, u
            return value + constant, z

        root = np.zeros(contacts, np.int8)
        value, z = bound(root)
        heap, number = ([(value, 0, root, z)] if z is not None else []), 1
        while heap and number < self.nodes:
            value, _, modes, z = heapq.heappop(heap)
            if value >= best - self.gap * abs(best):
                heap = []
                break
            smaller = np.minimum(z[forces], S @ z + s0)
            smaller[modes != FREE] = -1.0
            pair = int(np.argmax(smaller))
            if smaller[pair] <= 1e-9:
                continue  # this node's plan is in contact as it must be: its value has become an upper bound
            for mode in (NO_FORCE, CLOSED):
                child = modes.copy()
                child[pair] = mode
                lower, point = bound(child)
                number += 1
                if point is not None and lower < best - self.gap * abs(best):
                    heapq.heappush(heap, (lower, number, child, point))
        return Answer(plan[None], np.array([not heap]))
