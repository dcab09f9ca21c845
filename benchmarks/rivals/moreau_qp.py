"""Moreau: a differentiable conic solver in Rust, for the sparse program over actions and states; n_lam = 0."""

from __future__ import annotations

import moreau
import numpy as np
from scipy import sparse

from rivals.problem import Answer, Problem, Rival, sparse_program


def version() -> str:
    """Of Moreau."""
    return f"moreau {moreau.__version__}"


class Solver(Rival):
    """Its compiled solver: one for a single problem, one for the batch, one with gradients.

    Args:
        problem: what is to be solved.
        solver: "auto", "ipm" or "active_set".
    """

    batches = differentiates = True

    def __init__(self, problem: Problem, solver: str = "auto"):
        super().__init__(problem)
        P, q, A, b, self.where = sparse_program(problem)
        eye = np.eye(len(q))[self.where]
        high, low = (np.tile(v, problem.horizon) for v in (problem.u_max, problem.u_min))
        rows = np.concatenate([A, eye, -eye])
        bs = np.tile(np.concatenate([b, high, -low]), (problem.count, 1))
        bs[:, : problem.n_x] += problem.x0 @ problem.A.T
        self.q, self.b = np.tile(q, (problem.count, 1)), bs
        P, rows = sparse.csr_array(P), sparse.csr_array(rows)
        cones = moreau.Cones(num_zero_cones=len(b), num_nonneg_cones=2 * len(high))

        def compiled(batch: int, grad: bool):
            settings = moreau.Settings(solver=solver, device="cpu", batch_size=batch, enable_grad=grad)
            made = moreau.CompiledSolver(
                n=len(q), m=rows.shape[0], P_row_offsets=P.indptr, P_col_indices=P.indices,
                A_row_offsets=rows.indptr, A_col_indices=rows.indices, cones=cones, settings=settings,
            )  # fmt: skip
            made.setup(np.tile(P.data, (batch, 1)), np.tile(rows.data, (batch, 1)))
            return made

        self.single, self.many = compiled(1, False), compiled(problem.count, False)
        self.back = compiled(problem.count, True)

    def _answer(self, solver, found, gradient=None) -> Answer:
        u = np.asarray(found.x)[:, self.where].reshape(-1, self.problem.horizon, self.problem.n_u)
        solved = np.array([str(status).split(".")[-1] == "Solved" for status in solver.info.status])
        return Answer(u, solved, gradient)

    def one(self, i: int) -> Answer:
        """One call for one problem."""
        return self._answer(self.single, self.single.solve(self.q[i : i + 1], self.b[i : i + 1]))

    def all(self) -> Answer:
        """One call for all."""
        return self._answer(self.many, self.many.solve(self.q, self.b))

    def gradient(self) -> Answer:
        """One call for all, and back."""
        found = self.back.solve(self.q, self.b)
        upstream = np.zeros_like(np.asarray(found.x))
        upstream[:, self.where[: self.problem.n_u]] = self.problem.weight
        back = self.back.backward(upstream)
        return self._answer(self.back, found, np.asarray(back["db"])[:, : self.problem.n_x] @ self.problem.A)
