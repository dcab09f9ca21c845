"""C3 and C3+ (Aydinoglu et al., Consensus Complementarity Control, 2024; Bui et al., Push Anything, 2025), by ADMM.

Written after the papers and the code of DAIRLab/c3. States are eliminated, and the bounds of the actions are a
projection, too, where theirs solve a quadratic program with bounds in each iteration: faster for the same cost.
"""

import ctypes
import functools
import itertools
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
        project: "pairs", C3+: λ and gap of each pair; "lcp", C3 with its projection by simulation: λ follows from x, u;
            "exact", C3 with the projection of its paper, the integer program of each stage, see `by_stage`.
        new: whether factors are computed at each call, as for a new system.
    """

    origin = "own, after DAIRLab/c3"

    def __init__(
        self, problem: Problem, iterations: int, weight: float, growth: float = 1.0, gap: float = 1.0,
        action: float = 1.0, prefer: float = 1.0, project: str = "pairs", new: bool = False,
    ):  # fmt: skip
        super().__init__(problem)
        self.iterations, self.weight, self.growth, self.gap, self.action = iterations, weight, growth, gap, action
        self.prefer, self.project, self.new = prefer, project, new
        self.maps = [self.factor(i) for i in range(problem.count)] if not new else []

    def factor(self, i: int) -> tuple[np.ndarray, ...]:
        """Compute the minimiser v = G t + h p of each iteration, v = (u, λ, s), the bounds of u, and `supports`."""
        c, F = Condensed.of(self.problem, i), self.problem.at(i, "F")
        order = np.concatenate([c.actions, c.forces])
        H, f, S = c.H[np.ix_(order, order)], c.f[order], c.S[:, order]
        if self.project == "exact":  # in place of the gaps: a = D x + E u + c
            S[:, len(c.actions) :] -= np.kron(np.eye(self.problem.horizon), F)
        whole, gaps = np.concatenate([np.eye(len(H)), S]), np.concatenate([0 * f, c.s0])
        parts = [(c.actions, self.action), (c.forces, 1.0), (c.s0, 0.0 if self.project == "lcp" else self.gap)]
        sizes = np.concatenate([np.full(len(which), part) for which, part in parts])
        G, h = [], []
        for k in range(1 if self.growth == 1 else self.iterations):
            pull = whole.T * (self.weight * self.growth**k * sizes)
            inverse = np.linalg.inv(H + pull @ whole)
            G.append((whole @ (inverse @ pull)).T)
            h.append(gaps - whole @ (inverse @ (f + pull @ gaps)))
        bounds = c.low[c.actions], c.high[c.actions]
        return np.ascontiguousarray(G), np.array(h), *bounds, *(self.supports(F) if self.project == "exact" else ())

    def supports(self, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Prepare least squares ‖M (λ, s) − (λ_0, a_0)‖ on each support: M, and (MᵀM)⁻¹ there, 0 elsewhere."""
        eye, side = np.eye(len(F)), np.sqrt(self.gap * self.prefer)
        M = np.block([[eye, 0 * eye], [-side * F, side * eye]])
        chosen = np.array(list(itertools.product((0, 1, 2), repeat=len(F))))
        on = np.concatenate([chosen == 1, chosen == 2], 1).astype(float)
        both = on[:, :, None] * on[:, None, :]
        return M, both * np.linalg.inv(both * (M.T @ M) + np.eye(2 * len(F)) * (1 - on)[:, None, :])

    def one(self, i: int) -> Answer:
        """Iterate; the plan is the projected one."""
        G, h, low, high, *programs = self.factor(i) if self.new else self.maps[i]
        h = np.ascontiguousarray(h @ np.concatenate([[1.0], self.problem.x0[i]]))
        if self.project != "pairs":
            u = self.by_stage(self.problem.at(i, "F"), G, h, low, high, *programs)
        else:
            t, w, v, u = np.empty((4, h.shape[1]))
            arrays = [ctypes.c_void_p(a.ctypes.data) for a in (G, h, low, high, t, w, v, u)]
            sizes = self.iterations, len(h), len(low), (h.shape[1] - len(low)) // 2
            numbers = ctypes.c_double(self.prefer), ctypes.c_double(self.growth)
            compiled().admm(*sizes, *arrays[:4], *numbers, *arrays[4:])
        plan = u[: len(low)].reshape(1, self.problem.horizon, -1)
        return Answer(plan.copy(), np.isfinite(plan).all((1, 2)))

    def by_stage(
        self, F: np.ndarray, G: np.ndarray, h: np.ndarray, low: np.ndarray, high: np.ndarray, *programs: np.ndarray
    ) -> np.ndarray:
        """Project stage by stage: by its LCP, or exactly.

        Exactly: onto the nearest λ and a = D x + E u + c, by weights, with 0 ≤ λ ⊥ F λ + a ≥ 0. Their code has Gurobi
        find it; here each of the 3^n_lam supports of (λ, s) is tried. The consensus of states and actions is of a
        alone, which is all of them that this program knows.
        """
        from difflcs.lcp import solve_lcp_arrays

        n_u, n_lam = len(low), (h.shape[1] - len(low)) // 2
        t, w = np.zeros((2, h.shape[1]))
        for k in range(self.iterations):
            v = G[min(k, len(G) - 1)].T @ t + h[min(k, len(h) - 1)]
            w += v
            lam, s = (w if programs else v)[n_u:].reshape(2, -1, len(F))
            if programs:
                M, inverses = programs
                slopes = np.concatenate([lam, M[-1, -1] * s], 1) @ M
                pairs = inverses @ slopes.T  # (supports, 2 n_lam, stages)
                worth = np.where((pairs >= 0).all(1), (pairs * slopes.T).sum(1), -np.inf)
                forces, gaps = pairs[worth.argmax(0), :, np.arange(len(lam))].reshape(len(lam), 2, -1).swapaxes(0, 1)
                third = (gaps - forces @ F.T).ravel()
            else:
                forces, third = solve_lcp_arrays(F, s - lam @ F.T, 0.0)[0], w[n_u + n_lam :]
            delta = np.concatenate([np.clip(w[:n_u], low, high), forces.ravel(), third])
            w = (w - delta) / self.growth
            t = delta - w
        return delta
