"""Problems for a rival, and the interface that it implements. Needs numpy alone: rivals run without difflcs."""

from __future__ import annotations

from dataclasses import dataclass, fields
from importlib import metadata

import numpy as np


@dataclass
class Problem:
    """Problems of one size: the LCS-MPC of `difflcs.mpc.MPCProblem` with bounds on the actions and no constraints.

    Attributes:
        A, B, C, d, D, E, F, c: the system.
        Q, R, Q_final, q, r, q_final: the cost.
        u_min, u_max: bounds of the actions.
        x0: (count, n_x) initial states; any other field may have the count in front, too.
        horizon: steps.
        relaxation: λ·s.
        constant: added to the objective, which is then a sum of squares.
        weight: (n_u,) the gradient asked for is that of weight · u_0 with respect to x0.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    d: np.ndarray
    D: np.ndarray
    E: np.ndarray
    F: np.ndarray
    c: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    Q_final: np.ndarray
    q: np.ndarray
    r: np.ndarray
    q_final: np.ndarray
    u_min: np.ndarray
    u_max: np.ndarray
    x0: np.ndarray
    horizon: int
    relaxation: float
    constant: np.ndarray
    weight: np.ndarray

    @classmethod
    def load(cls, path: str) -> Problem:
        """Read a file that `save` wrote."""
        with np.load(path) as file:
            arrays = {field.name: file[field.name] for field in fields(cls)}
        return cls(**{**arrays, "horizon": int(arrays["horizon"]), "relaxation": float(arrays["relaxation"])})

    def save(self, path: str) -> None:
        """Write a .npz file."""
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})

    @property
    def count(self) -> int:
        """Number of problems."""
        return len(self.x0)

    @property
    def n_x(self) -> int:
        """Number of states."""
        return self.x0.shape[1]

    @property
    def n_u(self) -> int:
        """Number of actions."""
        return self.B.shape[-1]

    @property
    def n_lam(self) -> int:
        """Number of contacts."""
        return self.C.shape[-1]

    def at(self, i: int, name: str) -> np.ndarray:
        """Return one field of one problem."""
        value = getattr(self, name)
        matrix = name in ("A", "B", "C", "D", "E", "F", "Q", "R", "Q_final")
        return value if value.ndim == (2 if matrix else 1) else value[i]

    def only(self, i: int) -> dict[str, np.ndarray]:
        """Return all fields of one problem by name."""
        return {f.name: self.at(i, f.name) for f in fields(self) if f.name not in ("horizon", "relaxation", "constant")}


INPUTS = [f.name for f in fields(Problem) if f.name not in ("horizon", "relaxation", "constant", "weight")]
"""Fields that are inputs of `difflcs.mpc.MPCProblem`."""


@dataclass
class Answer:
    """Plans for some problems.

    Attributes:
        u: (m, horizon, n_u).
        solved: (m,) what the solver itself says.
        gradient: (m, n_x) of weight · u_0 by x0, where it was asked for.
    """

    u: np.ndarray
    solved: np.ndarray
    gradient: np.ndarray | None = None


class Rival:
    """A solver with its settings. The work of `__init__` and of the first call is set-up, which no time includes.

    Attributes:
        packages: those that it calls.
        origin: where a method without packages is from.
        batches: whether it has `all()`, which solves all problems in one call, cold, and is more than a loop.
        differentiates: whether it has `gradient()`, which solves all problems with their gradients.
    """

    packages: tuple[str, ...] = ()
    origin = "own"
    batches = False
    differentiates = False

    def __init__(self, problem: Problem):
        self.problem = problem

    @classmethod
    def version(cls) -> str:
        """List its packages with their versions, or say where it is from."""
        return ", ".join(f"{name} {metadata.version(name)}" for name in cls.packages) or cls.origin

    def one(self, i: int) -> Answer:
        """Plan for problem i, cold."""
        raise NotImplementedError

    def step(self, i: int, x: np.ndarray) -> np.ndarray:
        """Return the first action of problem i from another state, as a step of a closed loop."""
        self.problem.x0[i] = x
        return self.one(i).u[0, 0]


@dataclass
class Condensed:
    """An LCS-MPC in the actions and forces alone, z = (u_0, λ_0, u_1, …): min ½ zᵀHz + (f p)ᵀz + pᵀPp, s = S z + s0 p.

    p = (1, x0), so that one condensation serves for all initial states.
    """

    H: np.ndarray
    f: np.ndarray
    P: np.ndarray
    S: np.ndarray
    s0: np.ndarray
    low: np.ndarray
    high: np.ndarray
    actions: np.ndarray
    forces: np.ndarray

    @classmethod
    def of(cls, problem: Problem, i: int = 0) -> Condensed:
        """Condense problem i."""
        p, horizon, n_x, n_u = problem.only(i), problem.horizon, problem.n_x, problem.n_u
        step = n_u + problem.n_lam
        size = horizon * step
        # x_k = N z + n p, stage by stage
        one, N, n = np.eye(1, 1 + n_x)[0], np.zeros((n_x, size)), np.eye(n_x, 1 + n_x, 1)
        H, f, P, S, s0 = np.zeros((size, size)), np.zeros((size, 1 + n_x)), np.zeros((1 + n_x, 1 + n_x)), [], []
        for k in range(horizon + 1):
            Q, q = (p["Q"], p["q"]) if k < horizon else (p["Q_final"], p["q_final"])
            slope = Q @ n + np.outer(q, one)
            H, f, P = H + N.T @ Q @ N, f + N.T @ slope, P + 0.5 * n.T @ Q @ n + np.outer(one, q @ n)
            if k == horizon:
                break
            in_u, force = slice(k * step, k * step + n_u), slice(k * step + n_u, (k + 1) * step)
            H[in_u, in_u] += p["R"]
            f[in_u, 0] += p["r"]
            row = p["D"] @ N
            row[:, in_u] += p["E"]
            row[:, force] += p["F"]
            S.append(row)
            s0.append(p["D"] @ n + np.outer(p["c"], one))
            N, n = p["A"] @ N, p["A"] @ n + np.outer(p["d"], one)
            N[:, in_u] += p["B"]
            N[:, force] += p["C"]
        stages = np.arange(size).reshape(horizon, step)
        low, high = np.zeros(size), np.full(size, np.inf)
        actions, forces = stages[:, :n_u].ravel(), stages[:, n_u:].ravel()
        low[actions], high[actions] = np.tile(p["u_min"], horizon), np.tile(p["u_max"], horizon)
        return cls(0.5 * (H + H.T), f, P, np.concatenate(S), np.concatenate(s0), low, high, actions, forces)

    def at(self, x0: np.ndarray) -> np.ndarray:
        """Return p for an initial state."""
        return np.concatenate([[1.0], x0])


def lcp(F: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Solve 0 ≤ λ ⊥ F λ + q ≥ 0 by Murty's least-index pivoting, which ends if F + Fᵀ ≻ 0."""
    basic = np.zeros(len(q), bool)
    for _ in range(4 ** len(q)):
        lam = np.zeros(len(q))
        lam[basic] = np.linalg.solve(F[np.ix_(basic, basic)], -q[basic])
        wrong = np.where(basic, lam, F @ lam + q) < -1e-12
        if not wrong.any():
            return lam
        first = int(np.argmax(wrong))
        basic[first] = not basic[first]
    raise RuntimeError("the LCP has no solution: F + Fᵀ is not positive definite")


def execute(data: dict[str, np.ndarray], x0: np.ndarray, u: np.ndarray) -> tuple[float, np.ndarray]:
    """Execute actions under hard contact, λ·s = 0: the cost of the stages, without the final one, and the end."""
    x, total = x0, 0.0
    for action in u:
        lam = lcp(data["F"], data["D"] @ x + data["E"] @ action + data["c"])
        total += 0.5 * x @ data["Q"] @ x + data["q"] @ x + 0.5 * action @ data["R"] @ action + data["r"] @ action
        x = data["A"] @ x + data["B"] @ action + data["C"] @ lam + data["d"]
    return float(total), x


def sparse_program(problem: Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Write a linear MPC over z = (u_0, x_1, u_1, …, x_H): min ½ zᵀPz + qᵀz with A z = b.

    Returns:
        P, q, A, b, and where the actions are in z. The first n_x entries of b are those for x0 = 0: add A x0.
    """
    p, horizon, n_x, n_u = problem, problem.horizon, problem.n_x, problem.n_u
    step = n_x + n_u
    P, q = np.zeros((horizon * step,) * 2), np.zeros(horizon * step)
    A, b = np.zeros((horizon * n_x, horizon * step)), np.zeros(horizon * n_x)
    for k in range(horizon):
        u, x = slice(k * step, k * step + n_u), slice(k * step + n_u, (k + 1) * step)
        P[u, u], q[u] = p.R, p.r
        P[x, x], q[x] = (p.Q, p.q) if k + 1 < horizon else (p.Q_final, p.q_final)
        rows = slice(k * n_x, (k + 1) * n_x)
        A[rows, u], A[rows, x], b[rows] = -p.B, np.eye(n_x), p.d
        if k:
            A[rows, k * step - n_x : k * step] = -p.A
    where = (np.arange(horizon)[:, None] * step + np.arange(n_u)).ravel()
    return P, q, A, b, where
