"""CasADi with one of its solvers, as one would write it by hand. The backend `ipopt` of difflcs is in `layer.py`."""

import casadi
import numpy as np

from rivals.problem import Answer, Problem, Rival

_ALWAYS = {"ipopt": {"print_level": 0, "max_iter": 500, "sb": "yes"}, "fatrop": {"print_level": 0, "max_iter": 500}}
_NAMES = ("A", "B", "C", "d", "D", "E", "F", "c", "Q", "R", "Q_final", "q", "r", "q_final", "x0")


class Program:
    """The LCS-MPC as min f(z, p) with low ≤ z ≤ high and least ≤ g(z, p) ≤ most, by direct transcription by stages.

    Args:
        problem: what is to be solved.
        staged: whether x_0 is a variable, equal to a parameter, and s an expression with bounds; else s is a variable.
        start: λ and s to start from; u starts from 0.

    Attributes:
        z, p, f, g: symbols and expressions, as CasADi's solvers take them.
        low, high, least, most: bounds.
        equality: per row of g whether it is an equation.
        actions: (horizon, n_u) where u is in z.
    """

    def __init__(self, problem: Problem, staged: bool, start: float):
        symbols = {name: casadi.SX.sym(name, *problem.at(0, name).shape) for name in _NAMES}
        eps = casadi.SX.sym("relaxation")
        n_x, n_u, n_lam, inf = problem.n_x, problem.n_u, problem.n_lam, np.inf
        z, low, high, first, rows, least, most = [], [], [], [], [], [], []
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

        s_ = symbols
        x, cost = s_["x0"], casadi.SX(0)
        if staged:
            x, _ = variable("x_0", n_x, -inf, inf, 0.0)
        for k in range(problem.horizon):
            u, where_u = variable(f"u_{k}", n_u, problem.u_min, problem.u_max, 0.0)
            lam, _ = variable(f"lam_{k}", n_lam, 0.0, inf, start)
            gap = s_["D"] @ x + s_["E"] @ u + s_["F"] @ lam + s_["c"]
            s = gap if staged else variable(f"s_{k}", n_lam, 0.0, inf, start)[0]
            x_next, where_x = variable(f"x_{k + 1}", n_x, -inf, inf, 0.0)
            cost += casadi.bilin(s_["Q"], x, x) / 2 + casadi.dot(s_["q"], x)
            cost += casadi.bilin(s_["R"], u, u) / 2 + casadi.dot(s_["r"], u)
            row(x_next - (s_["A"] @ x + s_["B"] @ u + s_["C"] @ lam + s_["d"]), 0, 0)
            if staged and k == 0:
                row(x - s_["x0"], 0, 0)
            row(*((gap, 0, inf) if staged else (gap - s, 0, 0)))
            row(lam * s - eps, 0, 0)
            actions.append(where_u)
            states.append(where_x)
            x = x_next
        self.f = cost + casadi.bilin(s_["Q_final"], x, x) / 2 + casadi.dot(s_["q_final"], x)
        self.z, self.g = casadi.vertcat(*z), casadi.vertcat(*rows)
        self.p = casadi.vertcat(*(casadi.vec(symbols[name]) for name in _NAMES), eps)
        self.low, self.high, self.least, self.most = (np.concatenate(part) for part in (low, high, least, most))
        self.equality = (self.least == self.most).tolist()
        self.actions, self._states, self._first = np.array(actions), np.array(states), np.concatenate(first)

    def parameters(self, problem: Problem, i: int) -> np.ndarray:
        """Collect the parameters of one problem."""
        return np.concatenate([problem.at(i, name).ravel("F") for name in _NAMES] + [[problem.relaxation]])

    def begin(self, problem: Problem, i: int) -> np.ndarray:
        """Make the start: the states stay at x0, zero action inside the bounds."""
        z = self._first.copy()
        z[self._states] = problem.x0[i]
        return np.clip(z, self.low, self.high)


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
        self.program = p = Program(problem, self.staged, start)
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
