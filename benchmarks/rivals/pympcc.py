"""pympcc: mathematical programs with complementarity constraints, by a sequence of relaxations and IPOPT (cyipopt)."""

from __future__ import annotations

import casadi
import numpy as np
import pympcc

from rivals.nlp import Callbacks, Program
from rivals.problem import Answer, Problem, Rival


def version() -> str:
    """Of pympcc and what it calls."""
    from importlib.metadata import version

    import cyipopt

    return f"pympcc {version('pympcc')}, cyipopt {cyipopt.__version__}"


class Solver(Rival):
    """Scholtes' relaxations λ·s ≤ ε, from ε = 1 down to the problem's; all derivatives exact.

    Args:
        problem: what is to be solved.
        start: λ and s to start from.
        strategy: one of pympcc's.
    """

    def __init__(self, problem: Problem, start: float = 1.0, strategy: str = "scholtes"):
        super().__init__(problem)
        self.program = p = Program.of(problem, "none", True, start)
        self.callbacks, self.strategy = Callbacks(p), strategy
        lam, s = p.pairs
        # The Hessian of pympcc's Lagrangian: its rows are the equations, λ, s, and the products λ·s.
        sigma, y = casadi.SX.sym("sigma"), casadi.SX.sym("y", p.g.shape[0] + 3 * len(lam))
        pairs = casadi.dot(y[-len(lam) :], p.z[lam.tolist()] * p.z[s.tolist()])
        lagrangian = sigma * p.f + casadi.dot(y[: p.g.shape[0]], p.g) + pairs
        hessian = casadi.tril(casadi.hessian(lagrangian, p.z)[0])
        self.hessian = casadi.Function("hessian", [p.z, p.p, y, sigma], [hessian])
        self.structure = tuple(np.array(v) for v in hessian.sparsity().get_triplet())

    def one(self, i: int) -> Answer:
        """One sequence of relaxations."""
        calls, p = self.callbacks, self.program
        calls.p[:] = parameters = p.parameters(self.problem, i)
        lam, s = p.pairs
        ones, every = np.ones(len(lam)), np.arange(len(lam))
        problem = pympcc.MPCCProblem(
            n=len(p.low), n_comp=len(lam), x0=p.begin(self.problem, i), xl=p.low, xu=p.high,
            objective=calls.objective, gradient=calls.gradient,
            n_eq=len(p.least), eq_constraints=calls.constraints, eq_jacobian=calls.jacobian,
            eq_jacobian_sparsity=(calls.rows, calls.columns),
            comp_G=lambda z: z[lam], comp_G_jacobian=lambda z: ones, comp_G_jacobian_sparsity=(every, lam),
            comp_H=lambda z: z[s], comp_H_jacobian=lambda z: ones, comp_H_jacobian_sparsity=(every, s),
            lagrangian_hessian=lambda z, y, sigma: np.array(self.hessian(z, parameters, y, sigma).nonzeros()),
            lagrangian_hessian_sparsity=self.structure,
        )  # fmt: skip
        found = pympcc.solve(problem, strategy=self.strategy, epsilon_min=self.problem.relaxation)
        return Answer(np.asarray(found.x)[p.actions][None], np.array([bool(found.success)]))
