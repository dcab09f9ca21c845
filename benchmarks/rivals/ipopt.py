"""CasADi + IPOPT, as one would write it by hand. The backend `ipopt` of difflcs is in `layer.py`."""

from __future__ import annotations

import casadi
import numpy as np

from rivals.nlp import Program
from rivals.problem import Answer, Problem, Rival

SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


def version() -> str:
    """Return the version of CasADi, which ships IPOPT."""
    return f"casadi {casadi.__version__}"


class Solver(Rival):
    """The program over x, u, λ and s.

    Args:
        problem: what is to be solved.
        start: λ and s to start from.
        options: IPOPT's.
    """

    def __init__(self, problem: Problem, start: float = 1.0, options: dict | None = None):
        super().__init__(problem)
        self.program = p = Program.of(problem, True, start)
        settings = {"print_time": False, "error_on_fail": False, "calc_lam_p": False}
        settings |= {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 500}
        settings |= {f"ipopt.{name}": value for name, value in (options or {}).items()}
        self.solver = casadi.nlpsol("mpc", "ipopt", {"x": p.z, "p": p.p, "f": p.f, "g": p.g}, settings)

    def one(self, i: int) -> Answer:
        """Run IPOPT once."""
        p = self.program
        solution = self.solver(
            x0=p.begin(self.problem, i), p=p.parameters(self.problem, i),
            lbx=p.low, ubx=p.high, lbg=p.least, ubg=p.most,
        )  # fmt: skip
        z = np.asarray(solution["x"]).ravel()
        solved = self.solver.stats()["return_status"] in SOLVED
        return Answer(z[p.actions][None], np.array([solved]))
