"""An augmented Lagrangian for contact-implicit MPC in the manner of IMPACT (RSS 2026), in NumPy and LAPACK.

Forces and gaps each have a slack; each pair of slacks is projected onto "one of them is zero" in closed form, in turn
with Newton steps of a smooth problem. States are eliminated. Written after the paper, without its code.
"""

import numpy as np

from rivals.problem import Answer, Condensed, Problem, Rival


class Solver(Rival):
    """Outer iterations with multipliers and growing penalties, from zero, until all violations are below `tolerance`.

    Args:
        problem: what is to be solved; its relaxation plays no part.
        weight, bound: first penalties, of forces and gaps, and of the bounds of the actions.
        growth: factor of a penalty whose violation did not fall to `progress` of the last.
        inner: how often slacks and the smooth problem are solved in turn, at most.
        settle: change of the Lagrangian at which they are solved.
        outer: iterations with multipliers, at most.
        tolerance: of forces, gaps, their products and bounds.
    """

    origin = "own, after the paper"

    def __init__(
        self, problem: Problem, weight: float, bound: float, growth: float = 1.2, progress: float = 0.5,
        inner: int = 10, settle: float = 1e-3, outer: int = 200, tolerance: float = 1e-5,
    ):  # fmt: skip
        super().__init__(problem)
        self.penalties, self.growth, self.progress = (weight, bound), growth, progress
        self.inner, self.settle, self.outer, self.tolerance = inner, settle, outer, tolerance
        self.condensed = [Condensed.of(problem, i) for i in range(problem.count)]

    def one(self, i: int) -> Answer:
        """Iterate from zero."""
        c = self.condensed[i]
        p, order = c.at(self.problem.x0[i]), np.concatenate([c.actions, c.forces])
        n_u, n = len(c.actions), len(order)
        H, f = c.H[np.ix_(order, order)], c.f[order] @ p
        pairs, offset = np.concatenate([np.eye(n)[n_u:], c.S[:, order]]), np.concatenate([0 * c.s0 @ p, c.s0 @ p])
        sides, limits = (
            np.concatenate([np.eye(n)[:n_u], -np.eye(n)[:n_u]]),
            np.concatenate([-c.high[c.actions], c.low[c.actions]]),
        )
        pull, v, slack, y, z = pairs.T @ pairs, np.zeros(n), 0 * offset, 0 * offset, 0 * limits
        (weight, bound), last = self.penalties, np.full(2, np.inf)

        def lagrangian(v: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
            gap = pairs @ v + offset - slack + y / weight
            over = np.maximum(sides @ v + limits + z / bound, 0.0)
            slope = H @ v + f + 2 * weight * pairs.T @ gap + 2 * bound * sides.T @ over
            value = 0.5 * v @ H @ v + f @ v + weight * gap @ gap + bound * over @ over
            return float(value), slope, over

        for _ in range(self.outer):
            known, factor = np.inf, (None, None)
            for _ in range(self.inner):
                value, slope, over = lagrangian(v)
                for _ in range(50):
                    if np.abs(slope).max() < 1e-6:
                        break
                    active = over > 0
                    if factor[0] is None or (factor[0] != active).any():
                        M = H + 2 * weight * pull + 2 * bound * (sides.T * active) @ sides
                        factor = active, np.linalg.inv(M + 1e-8 * np.eye(n))
                    step, size = -factor[1] @ slope, 1.0
                    while size > 1e-4 and not (new := lagrangian(v + size * step))[0] < value:
                        size *= 0.5
                    if size <= 1e-4:
                        break
                    v, (value, slope, over) = v + size * step, new
                force, gap = np.split(pairs @ v + offset + y / weight, 2)
                keep = np.minimum(force, 0) ** 2 + gap**2 <= force**2 + np.minimum(gap, 0) ** 2
                slack = np.maximum(np.concatenate([np.where(keep, force, 0), np.where(keep, 0, gap)]), 0)
                now = lagrangian(v)[0]
                if abs(known - now) < self.settle:
                    break
                known = now
            wrong, beyond = pairs @ v + offset - slack, sides @ v + limits
            y, z = y + weight * wrong, np.maximum(z + bound * beyond, 0)
            products = np.multiply(*np.split(pairs @ v + offset, 2))
            here = np.array([np.abs(wrong).max(), max(beyond.max(), 0.0)])
            if max(here.max(), np.abs(products).max()) < self.tolerance:
                break
            weight, bound = (
                min(rho * self.growth, 1e6) if a >= self.tolerance and a > self.progress * b else rho
                for rho, a, b in zip((weight, bound), here, last, strict=True)
            )
            last = here
        else:
            here = np.array([np.inf])
        u = np.clip(v[:n_u], c.low[c.actions], c.high[c.actions]).reshape(1, self.problem.horizon, -1)
        return Answer(u, np.isfinite(here[:1]))
