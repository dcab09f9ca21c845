"""Clarabel: an interior-point method, for the sparse program over actions and states; n_lam = 0."""

import clarabel
import numpy as np
from scipy import sparse

from rivals.problem import Answer, Problem, Rival, sparse_program


class Solver(Rival):
    """Clarabel's solver with data that is updated; the structure is set-up."""

    packages = ("clarabel",)

    def __init__(self, problem: Problem):
        super().__init__(problem)
        P, q, A, b, self.where = sparse_program(problem)
        eye = np.eye(len(q))[self.where]
        high, low = (np.tile(v, problem.horizon) for v in (problem.u_max, problem.u_min))
        self.b = np.concatenate([b, high, -low])
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False  # data of a solver with presolve cannot be updated
        cones = [clarabel.ZeroConeT(len(b)), clarabel.NonnegativeConeT(2 * len(high))]
        rows = sparse.csc_matrix(np.concatenate([A, eye, -eye]))
        upper = sparse.triu(sparse.csc_matrix(P)).tocsc()
        self.solver = clarabel.DefaultSolver(upper, q, rows, self.b, cones, settings)

    def one(self, i: int) -> Answer:
        """Solve one program."""
        b = self.b.copy()
        b[: self.problem.n_x] += self.problem.A @ self.problem.x0[i]
        self.solver.update(b=b)
        solution = self.solver.solve()
        u = np.array(solution.x)[self.where].reshape(1, self.problem.horizon, -1)
        return Answer(u, np.array([str(solution.status) == "Solved"]))
