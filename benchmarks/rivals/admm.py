"""C3 and C3+ (Aydinoglu et al., Consensus Complementarity Control, 2024; Bui et al., Push Anything, 2025), by ADMM.

Written after the papers and the code of DAIRLab/c3. States are eliminated, and the bounds of the actions are a
projection, too, where theirs solve a quadratic program with bounds in each iteration: faster for the same cost.
"""

import ctypes
import functools
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from rivals.problem import Answer, Condensed, Problem, Rival


@functools.cache
def compiled() -> ctypes.CDLL:
    """Compile the iterations; -ffast-math itself would have the whole process flush small numbers to zero."""
    library = f"{tempfile.mkdtemp()}/admm.so"
    flags = "-O3 -march=native -fno-math-errno -fno-trapping-math -fno-signed-zeros -fassociative-math -shared -fPIC"
    subprocess.run(["cc", *flags.split(), Path(__file__).with_suffix(".c"), "-o", library], check=True)
    return ctypes.CDLL(library)


class Solver(Rival):
    """A fixed number of iterations from zero, as theirs.

    Args:
        problem: what is to be solved; its relaxation plays no part.
        iterations: how many.
        weight: of the consensus of λ in the first iteration; `growth` times as much in each further one.
        gap, action: of the gaps and of the actions, in parts of that.
        prefer: of a gap beside its force, where the projection chooses which is zero.
        project: "pairs", C3+: λ and gap of each pair; "lcp", C3 with its projection by simulation: λ follows from x, u.
        new: whether factors are computed at each call, as for a new system.
    """

    origin = "own, after DAIRLab/c3"

    def __init__(
        self, problem: Problem, iterations: int, weight: float, growth: float = 1.0, gap: float = 1.0,
        action: float = 1.0, prefer: float = 1.0, project: str = "pairs", new: bool = False,
    ):  # fmt: skip
        super().__init__(problem)
        self.iterations, self.weight, self.growth, self.gap, self.action = iterations, weight, growth, gap, action
        self.prefer, self.lcp, self.new = prefer, project == "lcp", new
        self.maps = [self.factor(i) for i in range(problem.count)] if not new else []

    def factor(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Compute the minimiser v = G t + h p of each iteration, v = (u, λ, s), and the bounds of u."""
        c = Condensed.of(self.problem, i)
        order = np.concatenate([c.actions, c.forces])
        H, f, S = c.H[np.ix_(order, order)], c.f[order], c.S[:, order]
        whole, gaps = np.concatenate([np.eye(len(H)), S]), np.concatenate([0 * f, c.s0])
        parts = [(c.actions, self.action), (c.forces, 1.0), (c.s0, 0.0 if self.lcp else self.gap)]
        sizes = np.concatenate([np.full(len(which), part) for which, part in parts])
        G, h = [], []
        for k in range(1 if self.growth == 1 else self.iterations):
            pull = whole.T * (self.weight * self.growth**k * sizes)
            inverse = np.linalg.inv(H + pull @ whole)
            G.append((whole @ (inverse @ pull)).T)
            h.append(gaps - whole @ (inverse @ (f + pull @ gaps)))
        return np.ascontiguousarray(G), np.array(h), c.low[c.actions], c.high[c.actions]

    def one(self, i: int) -> Answer:
        """Iterate; the plan is the projected one."""
        G, h, low, high = self.factor(i) if self.new else self.maps[i]
        h = np.ascontiguousarray(h @ np.concatenate([[1.0], self.problem.x0[i]]))
        if self.lcp:
            u = self.by_lcp(i, G, h, low, high)
        else:
            t, w, v, u = np.empty((4, h.shape[1]))
            arrays = [ctypes.c_void_p(a.ctypes.data) for a in (G, h, low, high, t, w, v, u)]
            sizes = self.iterations, len(h), len(low), (h.shape[1] - len(low)) // 2
            numbers = ctypes.c_double(self.prefer), ctypes.c_double(self.growth)
            compiled().admm(*sizes, *arrays[:4], *numbers, *arrays[4:])
        plan = u[: len(low)].reshape(1, self.problem.horizon, -1)
        return Answer(plan.copy(), np.isfinite(plan).all((1, 2)))

    def by_lcp(self, i: int, G: np.ndarray, h: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Project by the LCP of each stage."""
        from difflcs.lcp import solve_lcp_arrays

        F, n_u, n_lam = self.problem.at(i, "F"), len(low), (h.shape[1] - len(low)) // 2
        t, w = np.zeros((2, h.shape[1]))
        for k in range(self.iterations):
            v = G[min(k, len(G) - 1)].T @ t + h[min(k, len(h) - 1)]
            w += v
            lam, s = v[n_u : n_u + n_lam].reshape(-1, len(F)), v[n_u + n_lam :].reshape(-1, len(F))
            forces = solve_lcp_arrays(F, s - lam @ F.T, 0.0)[0].ravel()
            delta = np.concatenate([np.clip(w[:n_u], low, high), forces, w[n_u + n_lam :]])
            w = (w - delta) / self.growth
            t = delta - w
        return delta
