"""How a solve ended."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """How the solve of one batch element ended; `advice` says what to do about it."""

    CONVERGED = 0
    MAX_ITER = 1
    INFEASIBLE = 2
    NUMERICAL = 3
    DEGENERATE = 4

    @property
    def solved(self) -> bool:
        """True when the primal solution can be used."""
        return self in (Status.CONVERGED, Status.DEGENERATE)

    @property
    def advice(self) -> str:
        """One sentence for the user."""
        return _ADVICE[self]


_ADVICE = {
    Status.CONVERGED: "the solution meets the tolerance",
    Status.MAX_ITER: "the iteration limit was reached: raise max_iter, pass a guess, or check the scale of the inputs",
    Status.INFEASIBLE: "no feasible point was found: check the bounds and that F + Fᵀ is positive definite",
    Status.NUMERICAL: "the numbers broke down: check the scale of the inputs and the conditioning of F",
    Status.DEGENERATE: "solved, but not classically differentiable there: its gradient is one of several valid ones",
}
