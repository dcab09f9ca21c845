"""CasADi with one of its solvers, as one would write it by hand. The backend `ipopt` of difflcs is in `layer.py`."""

import casadi
import numpy as np

from rivals.nlp import Program
from rivals.problem import Answer, Problem, Rival

_ALWAYS = {"ipopt": {"print_level": 0, "max_iter": 500, "sb": "yes"}, "fatrop": {"print_level": 0, "max_iter": 500}}


class Solver(Rival):
    """The program over x, u, λ and s; for FATROP, which knows states and controls only, s is an expression with bounds.

    Args:
        problem: what is to be solved.
        name: "ipopt", "fatrop", "uno" or "sleqp".
        start: λ and s to start from.
        options: the solver's.
    """

    packages = ("casadi",)

    def __init__(self, problem: Problem, name: str = "ipopt", start: float = 1.0, options: dict | None = None):
        super().__init__(problem)
        self.staged = name == "fatrop"
        self.program = p = Program.of(problem, not self.staged, start, initial_state=self.staged)
        settings = {"print_time": False, "error_on_fail": False, "calc_lam_p": False}
        if self.staged:
            settings |= {"structure_detection": "auto", "equality": p.equality, "expand": True}
        own = _ALWAYS.get(name, {}) | (options or {})
        settings |= {f"{name}.{option}": value for option, value in own.items()}
        self.solver = casadi.nlpsol("mpc", name, {"x": p.z, "p": p.p, "f": p.f, "g": p.g}, settings)

    def one(self, i: int) -> Answer:
        """Run the solver once."""
        p = self.program
        start, parameters = p.begin(self.problem, i), p.parameters(self.problem, i)
        if self.staged:
            start[: self.problem.n_x] = self.problem.x0[i]
        try:
            solution = self.solver(x0=start, p=parameters, lbx=p.low, ubx=p.high, lbg=p.least, ubg=p.most)
        except RuntimeError:  # SLEQP stops in the middle of some problems
            return Answer(start[p.actions][None], np.array([False]))
        z = np.asarray(solution["x"]).ravel()
        return Answer(z[p.actions][None], np.array([bool(self.solver.stats()["success"])]))
