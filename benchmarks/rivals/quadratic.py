"""Solvers of one quadratic program, at n_lam = 0: DAQP and Clarabel."""

from __future__ import annotations

import importlib
from importlib.metadata import version as version_of

import numpy as np

from rivals.problem import Answer, Condensed, Problem, Rival, sparse_program


def version() -> str:
    """Nothing is needed but the solver itself, which `Solver` imports."""
    return "numpy"


class Solver(Rival):
    """One of them; what does not depend on x0 is set-up.

    Args:
        problem: what is to be solved.
        solver: "daqp" (dense, in the actions alone) or "clarabel" (sparse, actions and states).
    """

    def __init__(self, problem: Problem, solver: str):
        super().__init__(problem)
        importlib.import_module(solver)
        self.one = getattr(self, f"_{solver}")
        self.version = version_of(solver)
        if solver == "daqp":
            import daqp

            self.condensed = c = Condensed.of(problem)
            self.model = daqp.Model()
            empty = np.zeros((0, len(c.low)))
            self.model.setup(c.H, c.h.copy(), empty, c.high, c.low, np.zeros(len(c.low), np.int32))
        else:
            self._clarabel_program()

    def _daqp(self, i: int) -> Answer:
        c = self.condensed
        self.model.update(f=c.G @ self.problem.x0[i] + c.h)
        z, _, flag, _ = self.model.solve()
        return Answer(np.array(z).reshape(1, self.problem.horizon, -1), np.array([flag >= 1]))

    def _clarabel_program(self) -> None:
        import clarabel
        from scipy import sparse

        P, q, A, b, self.where = sparse_program(self.problem)
        eye = np.eye(len(q))[self.where]
        high, low = (np.tile(v, self.problem.horizon) for v in (self.problem.u_max, self.problem.u_min))
        self.b = np.concatenate([b, high, -low])
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False
        cones = [clarabel.ZeroConeT(len(b)), clarabel.NonnegativeConeT(2 * len(high))]
        rows = sparse.csc_matrix(np.concatenate([A, eye, -eye]))
        upper = sparse.triu(sparse.csc_matrix(P)).tocsc()
        self.solver = clarabel.DefaultSolver(upper, q, rows, self.b, cones, settings)

    def _clarabel(self, i: int) -> Answer:
        b = self.b.copy()
        b[: self.problem.n_x] += self.problem.A @ self.problem.x0[i]
        self.solver.update(b=b)
        found = self.solver.solve()
        u = np.array(found.x)[self.where].reshape(1, self.problem.horizon, -1)
        return Answer(u, np.array([str(found.status) == "Solved"]))
