"""DAQP: a dual active-set method, for the dense program in the actions alone; n_lam = 0."""

import daqp
import numpy as np

from rivals.problem import Answer, Condensed, Problem, Rival


class Solver(Rival):
    """Its workspace: the factors of the Hessian are set-up, a new linear term and a solve are timed."""

    packages = ("daqp",)

    def __init__(self, problem: Problem):
        super().__init__(problem)
        self.condensed = c = Condensed.of(problem)
        self.model = daqp.Model()
        empty = np.zeros((0, len(c.low)))
        self.model.setup(c.H, c.f[:, 0].copy(), empty, c.high, c.low, np.zeros(len(c.low), np.int32))

    def one(self, i: int) -> Answer:
        """Solve one program."""
        c = self.condensed
        self.model.update(f=c.f @ c.at(self.problem.x0[i]))
        z, _, flag, _ = self.model.solve()
        return Answer(np.array(z).reshape(1, self.problem.horizon, -1), np.array([flag >= 1]))
