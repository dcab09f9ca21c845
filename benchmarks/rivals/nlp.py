"""The LCS-MPC as a nonlinear program in CasADi, for the rivals that take one."""

from __future__ import annotations

from dataclasses import dataclass

import casadi
import numpy as np

from rivals.problem import Problem

NAMES = ("A", "B", "C", "d", "D", "E", "F", "c", "Q", "R", "Q_final", "q", "r", "q_final", "x0")


@dataclass
class Program:
    """min f(z, p) with low ≤ z ≤ high and least ≤ g(z, p) ≤ most.

    Attributes:
        z, p, f, g: symbols and expressions.
        low, high, least, most: bounds.
        equality: per row of g whether it is an equation.
        start: z to start from but for x; `states` says where these are.
        actions: (horizon, n_u) where u is in z.
        states: (horizon, n_x) where x_1 … x_H are in z.
    """

    z: casadi.SX
    p: casadi.SX
    f: casadi.SX
    g: casadi.SX
    low: np.ndarray
    high: np.ndarray
    least: np.ndarray
    most: np.ndarray
    equality: list[bool]
    start: np.ndarray
    actions: np.ndarray
    states: np.ndarray

    @classmethod
    def of(cls, problem: Problem, slack: bool, start: float, initial_state: bool = False) -> Program:
        """Make the program by direct transcription, stage by stage.

        Args:
            problem: what is to be solved.
            slack: whether s is a variable.
            start: value of λ and s, and u = 0.
            initial_state: whether x_0 is a variable, equal to a parameter.
        """
        symbols = {name: casadi.SX.sym(name, *problem.at(0, name).shape) for name in NAMES}
        eps = casadi.SX.sym("relaxation")
        n_x, n_u, n_lam, inf = problem.n_x, problem.n_u, problem.n_lam, np.inf
        z, low, high, first, rows, least, most, equality = [], [], [], [], [], [], [], []
        at, actions, states = 0, [], []

        def variable(name: str, size: int, lower, upper, value) -> tuple[casadi.SX, np.ndarray]:
            nonlocal at
            new = casadi.SX.sym(name, size)
            z.append(new)
            for whole, part in ((low, lower), (high, upper), (first, value)):
                whole.append(np.broadcast_to(part, size))
            at += size
            return new, np.arange(at - size, at)

        def row(value: casadi.SX, lower: float, upper: float) -> None:
            rows.append(value)
            least.append(np.full(value.shape[0], lower))
            most.append(np.full(value.shape[0], upper))
            equality.extend([lower == upper] * value.shape[0])

        s_ = symbols
        x, cost = s_["x0"], casadi.SX(0)
        if initial_state:
            x, _ = variable("x_0", n_x, -inf, inf, 0.0)
        for k in range(problem.horizon):
            u, where_u = variable(f"u_{k}", n_u, problem.u_min, problem.u_max, 0.0)
            lam, _ = variable(f"lam_{k}", n_lam, 0.0, inf, start)
            gap = s_["D"] @ x + s_["E"] @ u + s_["F"] @ lam + s_["c"]
            s = gap
            if slack:
                s, _ = variable(f"s_{k}", n_lam, 0.0, inf, start)
            x_next, where_x = variable(f"x_{k + 1}", n_x, -inf, inf, 0.0)
            cost += casadi.bilin(s_["Q"], x, x) / 2 + casadi.dot(s_["q"], x)
            cost += casadi.bilin(s_["R"], u, u) / 2 + casadi.dot(s_["r"], u)
            row(x_next - (s_["A"] @ x + s_["B"] @ u + s_["C"] @ lam + s_["d"]), 0, 0)
            if initial_state and k == 0:
                row(x - s_["x0"], 0, 0)
            row(*((gap - s, 0, 0) if slack else (gap, 0, inf)))
            row(lam * s - eps, 0, 0)
            actions.append(where_u)
            states.append(where_x)
            x = x_next
        cost += casadi.bilin(s_["Q_final"], x, x) / 2 + casadi.dot(s_["q_final"], x)
        packed = casadi.vertcat(*(casadi.vec(symbols[name]) for name in NAMES), eps)
        joined = (np.concatenate(part) for part in (low, high, least, most))
        return cls(
            casadi.vertcat(*z), packed, cost, casadi.vertcat(*rows), *joined, equality, np.concatenate(first),
            np.array(actions), np.array(states),
        )  # fmt: skip

    def parameters(self, problem: Problem, i: int) -> np.ndarray:
        """Collect the parameters of one problem."""
        return np.concatenate([problem.at(i, name).ravel("F") for name in NAMES] + [[problem.relaxation]])

    def begin(self, problem: Problem, i: int) -> np.ndarray:
        """Make the start: the states stay at x0, zero action inside the bounds."""
        z = self.start.copy()
        z[self.states] = problem.x0[i]
        return np.clip(z, self.low, self.high)
