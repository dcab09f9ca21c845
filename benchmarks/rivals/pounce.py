"""POUNCE: IPOPT's algorithm in Rust, with the functions of CasADi."""

from __future__ import annotations

import numpy as np
import pounce

from rivals.nlp import Callbacks, Program
from rivals.problem import Answer, Problem, Rival


def version() -> str:
    """Of the package pounce-solver."""
    from importlib.metadata import version

    return f"pounce-solver {version('pounce-solver')}"


class Solver(Rival):
    """The program over x, u, λ and s, called back from Rust.

    Args:
        problem: what is to be solved.
        start: λ and s to start from.
        options: POUNCE's, named as IPOPT's.
    """

    def __init__(self, problem: Problem, start: float = 1.0, options: dict | None = None):
        super().__init__(problem)
        self.program = p = Program.of(problem, "product", True, start)
        self.callbacks = Callbacks(p)
        self.solver = pounce.Problem(
            n=len(p.low), m=len(p.least), problem_obj=self.callbacks, lb=p.low, ub=p.high, cl=p.least, cu=p.most
        )
        for name, value in {"print_level": 0, "max_iter": 500, **(options or {})}.items():
            self.solver.add_option(name, value)

    def one(self, i: int) -> Answer:
        """One run."""
        self.callbacks.p[:] = self.program.parameters(self.problem, i)
        z, info = self.solver.solve(x0=self.program.begin(self.problem, i))
        return Answer(np.asarray(z)[self.program.actions][None], np.array([info["status"] in (0, 1)]))
