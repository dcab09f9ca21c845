"""CasADi + IPOPT, as one would write it by hand. The backend `ipopt` of difflcs is in `layer.py`."""

from __future__ import annotations

import functools

import casadi
import numpy as np

from rivals.nlp import Program
from rivals.problem import Answer, Problem, Rival

SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


def version() -> str:
    """Of CasADi, which ships IPOPT."""
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
        n = (problem.n_x, problem.n_u, problem.n_lam, problem.horizon)
        self.program = Program.of(problem, "product", True, start)
        self.solver = _solver(n, tuple(sorted((options or {}).items())))

    def one(self, i: int) -> Answer:
        """One run of IPOPT."""
        p = self.program
        found = self.solver(
            x0=p.begin(self.problem, i), p=p.parameters(self.problem, i),
            lbx=p.low, ubx=p.high, lbg=p.least, ubg=p.most,
        )  # fmt: skip
        z = np.asarray(found["x"]).ravel()
        solved = self.solver.stats()["return_status"] in SOLVED
        return Answer(z[p.actions][None], np.array([solved]))


@functools.lru_cache(maxsize=32)
def _solver(sizes: tuple, options: tuple) -> casadi.Function:
    n_x, n_u, n_lam, horizon = sizes
    shapes = {
        "A": (n_x, n_x), "B": (n_x, n_u), "C": (n_x, n_lam), "d": (n_x,), "D": (n_lam, n_x), "E": (n_lam, n_u),
        "F": (n_lam, n_lam), "c": (n_lam,), "Q": (n_x, n_x), "R": (n_u, n_u), "Q_final": (n_x, n_x), "q": (n_x,),
        "r": (n_u,), "q_final": (n_x,), "u_min": (n_u,), "u_max": (n_u,), "x0": (1, n_x), "weight": (n_u,),
    }  # fmt: skip
    empty = Problem(
        **{k: np.zeros(v) for k, v in shapes.items()}, horizon=horizon, relaxation=1.0, constant=np.zeros(())
    )
    p = Program.of(empty, "product", True, 1.0)
    settings = {"print_time": False, "error_on_fail": False, "calc_lam_p": False}
    settings |= {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 500}
    settings |= {f"ipopt.{name}": value for name, value in options}
    return casadi.nlpsol("mpc", "ipopt", {"x": p.z, "p": p.p, "f": p.f, "g": p.g}, settings)
