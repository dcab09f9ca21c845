"""FATROP, through CasADi: an interior-point method whose linear algebra knows the stages of optimal control."""

from __future__ import annotations

import casadi
import numpy as np

from rivals.nlp import Program
from rivals.problem import Answer, Problem, Rival


def version() -> str:
    """Return the version of CasADi, which ships FATROP."""
    if not casadi.has_nlpsol("fatrop"):
        raise ImportError("this CasADi has no FATROP")
    return f"casadi {casadi.__version__}"


class Solver(Rival):
    """The program over x, u and λ; s is an expression with bounds, for FATROP knows states and controls only.

    Args:
        problem: what is to be solved.
        start: λ to start from.
        options: FATROP's.
    """

    def __init__(self, problem: Problem, start: float = 1.0, options: dict | None = None):
        super().__init__(problem)
        self.program = p = Program.of(problem, False, start, initial_state=True)
        settings = {"print_time": False, "error_on_fail": False, "structure_detection": "auto", "equality": p.equality}
        settings |= {"calc_lam_p": False, "expand": True, "fatrop.print_level": 0, "fatrop.max_iter": 500}
        settings |= {f"fatrop.{name}": value for name, value in (options or {}).items()}
        self.solver = casadi.nlpsol("mpc", "fatrop", {"x": p.z, "p": p.p, "f": p.f, "g": p.g}, settings)

    def one(self, i: int) -> Answer:
        """Run FATROP once."""
        p = self.program
        start = p.begin(self.problem, i)
        start[: self.problem.n_x] = self.problem.x0[i]
        solution = self.solver(
            x0=start, p=p.parameters(self.problem, i), lbx=p.low, ubx=p.high, lbg=p.least, ubg=p.most
        )  # fmt: skip
        z = np.asarray(solution["x"]).ravel()
        return Answer(z[p.actions][None], np.array([bool(self.solver.stats()["success"])]))
