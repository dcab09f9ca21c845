"""Hostile problems, one seeded generator per class. NumPy only; nothing here calls the code under test.

A generator is a function (rng, count, small=False) → one batch of equal shape. `small` keeps to a few small shapes, for
solvers that are slow or compile per shape. Numbers without a unit are in the caller's own units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.random import Generator

from tests.conformance.cases import Case, in_units

MATRICES = ("A", "B", "C", "D", "E", "F", "Q", "R", "Q_final")  # of the plain problem
SHAPES = [(4, 2, 3), (9, 6, 5), (9, 6, 8), (1, 1, 1), (2, 3, 1), (3, 1, 4), (7, 3, 11), (5, 4, 2), (2, 1, 6)]
SMALL = [(4, 2, 3), (1, 1, 1), (3, 2, 2)]


@dataclass(frozen=True)
class LCP:
    """0 ≤ λ ⊥ Fλ + q ≥ 0: F (count, n, n) or (n, n), q (count, n)."""

    F: np.ndarray
    q: np.ndarray

    @property
    def count(self) -> int:
        return len(self.q)

    def select(self, index) -> LCP:
        return LCP(self.F if self.F.ndim == 2 else self.F[index], self.q[index])

    def each(self) -> LCP:
        """The same problems, each with an F of its own."""
        return replace(self, F=np.array(np.broadcast_to(self.F, (self.count, *self.F.shape[-2:]))))

    def cast(self, dtype) -> LCP:
        with np.errstate(over="ignore", under="ignore"):
            return LCP(self.F.astype(dtype), self.q.astype(dtype))


@dataclass(frozen=True)
class Loss:
    """Transitions under one model, for `violation_loss`: F = G Gᵀ + stiffness·I + H − Hᵀ."""

    system: dict[str, np.ndarray]  # A, B, C, d, D, E, G, H, c
    stiffness: float
    x: np.ndarray
    u: np.ndarray
    x_next: np.ndarray
    gamma: float
    xi: float

    @property
    def count(self) -> int:
        return len(self.x)

    @property
    def F(self) -> np.ndarray:
        G, H = self.system["G"], self.system["H"]
        return G @ G.T + self.stiffness * np.eye(len(G)) + H - H.T

    def select(self, index) -> Loss:
        return replace(self, x=self.x[index], u=self.u[index], x_next=self.x_next[index])


def power(rng: Generator, low: float, high: float, *shape: int) -> np.ndarray:
    """10 to a uniform power."""
    return 10.0 ** rng.uniform(low, high, shape)


def definite(rng: Generator, *shape: int, floor: float = 0.3, skew: float = 0.5) -> np.ndarray:
    """G Gᵀ + floor·I + skew part."""
    G, K = rng.standard_normal((2, *shape)) * 0.6
    return G @ G.swapaxes(-1, -2) + floor * np.eye(shape[-1]) + skew * (K - K.swapaxes(-1, -2))


# ---- LCP ------------------------------------------------------------------------------------------------------------


def _q(rng: Generator, count: int, n: int) -> np.ndarray:
    return rng.standard_normal((count, n)) * power(rng, -2, 1, count, 1)


def _batch(rng: Generator, count: int, n: int) -> tuple[int, ...]:
    """One F for all, or one each."""
    return (n, n) if rng.random() < 0.3 else (count, n, n)


def lcp_plain(rng: Generator, count: int, small: bool = False) -> LCP:
    """Nothing hostile: well-conditioned F ≻ 0 of size 1, n 1 to 12. Everything must be solved."""
    n = int(rng.integers(1, 13))
    return LCP(definite(rng, *_batch(rng, count, n)), _q(rng, count, n))


def lcp_skew(rng: Generator, count: int, small: bool = False, *, epsilon: float) -> LCP:
    """F = K − Kᵀ + ε·I: F + Fᵀ is 2ε·I beside a skew part of size 1; λ up to 1/ε."""
    n = int(rng.integers(2, 13))
    K = rng.standard_normal(_batch(rng, count, n))
    q = rng.standard_normal((count, n))
    return LCP(K - K.swapaxes(-1, -2) + epsilon * np.eye(n), q)


def lcp_nearly_singular(rng: Generator, count: int, small: bool = False) -> LCP:
    """F = G Gᵀ + ε·I with G of low rank and ε = 1e-2 … 1e-12, with or without a skew part: condition up to 1e12."""
    n = int(rng.integers(2, 13))
    shape = _batch(rng, count, n)
    G = rng.standard_normal((*shape[:-1], int(rng.integers(1, n))))
    epsilon = power(rng, -12, -2, *shape[:-2], 1, 1)
    K = rng.standard_normal(shape) * rng.integers(0, 2)
    return LCP(G @ G.swapaxes(-1, -2) + epsilon * np.eye(n) + K - K.swapaxes(-1, -2), _q(rng, count, n))


def lcp_graded(rng: Generator, count: int, small: bool = False) -> LCP:
    """F = S M S with M of size 1 and S² = 1e-8 … 1e8: contacts in wildly different units; q scaled alike or not."""
    n = int(rng.integers(2, 13))
    shape = _batch(rng, count, n)
    S = power(rng, -4, 4, *shape[:-1])
    F = S[..., :, None] * definite(rng, *shape) * S[..., None, :]
    return LCP(F, _q(rng, count, n) * (S if rng.random() < 0.5 else 1.0))


def lcp_scaled(rng: Generator, count: int, small: bool = False) -> LCP:
    """All of F times 10^±(8 … 300), all of q times another such factor or 1."""
    n = int(rng.integers(1, 9))
    factor = power(rng, 8, 300, 1) ** rng.choice([-1.0, 1.0])
    q_factor = rng.choice([1.0, float(factor[0]), 1e-8, 1e8])
    return LCP(definite(rng, *_batch(rng, count, n)) * factor, _q(rng, count, n) * q_factor)


def lcp_degenerate(rng: Generator, count: int, small: bool = False) -> LCP:
    """q with zeros, ties, repeated rows, and λ = w = 0 exactly: q = w* − F λ* with integers and both zero in places."""
    n = int(rng.integers(1, 11))
    shape = _batch(rng, count, n)
    F = np.round(4 * definite(rng, *shape)) / 4 + 2 * np.eye(n) * n
    lam, w = rng.integers(0, 3, (2, count, n)).astype(float)
    w *= lam == 0
    q = w - np.einsum("...ij,...j->...i", F, lam)
    kind = rng.integers(0, 4, count)
    q[kind == 1] = 0.0
    q[kind == 2] = q[kind == 2, :1]
    q[kind == 3] = np.where(rng.random((int((kind == 3).sum()), n)) < 0.5, 0.0, -1.0)
    return LCP(F, q)


def lcp_extreme_q(rng: Generator, count: int, small: bool = False) -> LCP:
    """Entries of q of size 1e150, 1e-300, 1 and 0 beside each other; F of size 1."""
    n = int(rng.integers(1, 9))
    size = rng.choice([1e150, 1e100, 1e-150, 1e-300, 1.0, 0.0], (count, n))
    size[: count // 2] = size[: count // 2, :1]
    return LCP(definite(rng, *_batch(rng, count, n)), rng.standard_normal((count, n)) * size)


def lcp_p_matrix(rng: Generator, count: int, small: bool = False) -> LCP:
    """P-matrices whose symmetric part is not definite: triangular, and D₁ M D₂ with positive diagonals."""
    n = int(rng.integers(2, 11))
    shape = _batch(rng, count, n)
    if rng.random() < 0.5:
        F = np.eye(n) + np.triu(3 * rng.random(shape), 1)
    else:
        left, right = np.exp(2 * rng.standard_normal((2, *shape[:-1])))
        F = left[..., :, None] * definite(rng, *shape) * right[..., None, :]
    return LCP(F, _q(rng, count, n))


def lcp_large(rng: Generator, count: int, small: bool = False) -> LCP:
    """n 33 to 160, where pivoting may take minutes: a large skew part, an obstacle, Murty's and Fathi's, low rank."""
    n = int(rng.integers(33, 161))
    eye, (K, q) = np.eye(n), (rng.standard_normal((n, n)), rng.standard_normal((count, n)))
    murty = eye + 2 * np.triu(np.ones((n, n)), 1)
    J = K[:, : n // 2]
    kinds = [K - K.T + eye, 2 * eye - np.eye(n, k=1) - np.eye(n, k=-1), murty, murty.T @ murty, J @ J.T + 1e-3 * eye]
    F = kinds[rng.integers(len(kinds))]
    q[::2] = np.where(q[::2] > 1, 0.0, -1.0)
    q[::4] -= F @ np.where(K[0] > 0, K[0], 0.0)
    return LCP(F, q)


def lcp_not_definite(rng: Generator, count: int, small: bool = False) -> LCP:
    """F that is no P-matrix: random, zero, or negative. There may be no solution; refusing is right, NaN is not."""
    n = int(rng.integers(1, 9))
    F = rng.standard_normal(_batch(rng, count, n)) * rng.choice([0.0, 1.0, 1e-8, 1e8])
    return LCP(F, _q(rng, count, n))


# ---- MPC ------------------------------------------------------------------------------------------------------------


def _mpc(rng: Generator, count: int, small: bool, horizon: int | None = None) -> Case:
    """A healthy problem: stable system, contacts that open and close, definite cost, |u| ≤ 0.05 … 1."""
    n_x, n_u, n_lam = (SMALL if small else SHAPES)[rng.integers(len(SMALL if small else SHAPES))]
    if horizon is None:
        horizon = int(rng.integers(2, 4)) if small else int(rng.choice([1, 2, 3, 5, 5, 8, 10, 20]))
    lead = () if rng.random() < 0.3 else (count,)
    normal = rng.standard_normal
    wide = rng.choice([0.05, 0.3, 1.0])
    arrays = {
        "A": 0.9 * np.eye(n_x) + 0.05 * normal((*lead, n_x, n_x)),
        "B": 0.5 * normal((*lead, n_x, n_u)),
        "C": 0.4 * normal((*lead, n_x, n_lam)),
        "d": 0.005 * normal((*lead, n_x)),
        "D": normal((*lead, n_lam, n_x)),
        "E": normal((*lead, n_lam, n_u)),
        "F": definite(rng, *lead, n_lam, n_lam, floor=0.4),
        "c": 0.02 * normal((*lead, n_lam)),
        "Q": definite(rng, *lead, n_x, n_x, skew=0),
        "R": definite(rng, *lead, n_u, n_u, skew=0),
        "Q_final": 3 * definite(rng, *lead, n_x, n_x, skew=0),
        "q": 0.1 * normal((*lead, n_x)),
        "r": 0.1 * normal((*lead, n_u)),
        "q_final": 0.1 * normal((*lead, n_x)),
        "u_min": -wide * rng.uniform(0.5, 1, (*lead, n_u)),
        "u_max": wide * rng.uniform(0.5, 1, (*lead, n_u)),
        "x0": 0.3 * normal((count, n_x)),
    }
    return Case(arrays, horizon, relaxation=float(rng.choice([1e-5, 1e-5, 1e-3, 1e-6])))


def mpc_plain(rng: Generator, count: int, small: bool = False) -> Case:
    """Nothing hostile: nine shapes, (9, 6, 8) and odd ones, H 1 to 20, shared or per element."""
    return _mpc(rng, count, small)


def mpc_skew(rng: Generator, count: int, small: bool = False, *, epsilon: float) -> Case:
    """The plain problem with F = K − Kᵀ + ε·I: forces up to 1/ε times the gaps."""
    problem = _mpc(rng, count, small, horizon=int(rng.integers(1, 6)))
    K = rng.standard_normal(problem.inputs["F"].shape)
    return problem.changed(F=K - K.swapaxes(-1, -2) + epsilon * np.eye(K.shape[-1]))


def mpc_stiff(rng: Generator, count: int, small: bool = False) -> Case:
    """F nearly singular (low rank + 1e-2 … 1e-10) or graded (diagonal 1e-8 … 1e8)."""
    problem = _mpc(rng, count, small, horizon=int(rng.integers(1, 6)))
    F = problem.inputs["F"]
    if rng.random() < 0.5:
        G = rng.standard_normal((*F.shape[:-1], max(1, F.shape[-1] // 2)))
        return problem.changed(F=G @ G.swapaxes(-1, -2) + power(rng, -10, -2, 1) * np.eye(F.shape[-1]))
    S = power(rng, -4, 4, *F.shape[:-1])
    return problem.changed(F=S[..., :, None] * F * S[..., None, :])


def _linear_answer(problem: Case) -> np.ndarray:
    """The vertex of a cost that is linear in u and does not see λ (C = 0); NaN where the slope is 1e-6 of its terms."""
    a = problem.full()
    p, size = a["q_final"], np.abs(a["q_final"])
    steps = []
    for _ in range(problem.horizon):
        g = a["r"] + np.einsum("bij,bi->bj", a["B"], p)
        total = np.abs(a["r"]) + np.einsum("bij,bi->bj", np.abs(a["B"]), size)
        vertex = np.where(g > 0, a["u_min"], a["u_max"])
        steps.append(np.where(np.abs(g) > 1e-6 * total, vertex, np.nan))
        p = a["q"] + np.einsum("bij,bi->bj", a["A"], p)
        size = np.abs(a["q"]) + np.einsum("bij,bi->bj", np.abs(a["A"]), size)
    return np.stack(steps[::-1], 1)


def _linear_cost(problem: Case, rng: Generator) -> Case:
    a = problem.inputs
    new = {name: np.zeros_like(a[name]) for name in ("Q", "R", "Q_final")}
    for name in ("q", "r", "q_final"):
        new[name] = rng.standard_normal(a[name].shape)
    return problem.changed(**new)


def mpc_flat(rng: Generator, count: int, small: bool = False) -> Case:
    """Q = R = Q_final = 0, linear terms of size 1, no effect of λ on the states: a linear program, known vertex."""
    problem = _linear_cost(_mpc(rng, count, small), rng)
    problem = problem.changed(C=np.zeros_like(problem.inputs["C"]))
    if rng.random() < 0.5:
        zero = {k: np.zeros_like(problem.inputs[k]) for k in ("q", "q_final")}
        problem = problem.changed(**zero)
    problem = problem.changed(D=np.zeros_like(problem.inputs["D"]), E=np.zeros_like(problem.inputs["E"]))
    return replace(problem, answer=_linear_answer(problem))


def mpc_flat_contact(rng: Generator, count: int, small: bool = False) -> Case:
    """Q = R = Q_final = 0 with contacts in the loop: the only curvature is that of λ."""
    return _linear_cost(_mpc(rng, count, small), rng)


def mpc_flat_tiny(rng: Generator, count: int, small: bool = False) -> Case:
    """R, Q, Q_final of 1e-12 … 1e-4 beside linear terms of 1e-6 … 1, |u| ≤ 0.05: curvature that says nothing."""
    problem = _linear_cost(_mpc(rng, count, small), rng)
    a = problem.inputs
    curvature, linear = float(power(rng, -12, -4, 1)[0]), float(power(rng, -6, 0, 1)[0])
    new = {k: curvature * definite(rng, *a[k].shape, skew=0) for k in ("Q", "R", "Q_final")}
    new |= {k: linear * a[k] for k in ("q", "r", "q_final")}
    new |= {"u_min": np.full_like(a["u_min"], -0.05), "u_max": np.full_like(a["u_max"], 0.05)}
    return problem.changed(**new)


def mpc_no_effect(rng: Generator, count: int, small: bool = False) -> Case:
    """One action without cost or effect (its part of B, E, R zero) in half of the elements, or with a linear cost."""
    problem = _mpc(rng, count, small).each()
    B, E, R, r = (problem.inputs[k] for k in ("B", "E", "R", "r"))
    dead = rng.random(count) < 0.5
    j = int(rng.integers(B.shape[-1]))
    B[dead, :, j] = 0.0
    E[dead, :, j] = 0.0
    R[dead, j, :] = 0.0
    R[dead, :, j] = 0.0
    r[dead, j] *= rng.integers(0, 2, int(dead.sum()))
    if rng.random() < 0.3:  # one such element in a shared system makes all of its gradient NaN
        first = problem.select(slice(0, 1))
        arrays = {k: v if k == "x0" else v[0] for k, v in first.inputs.items()}
        return replace(problem, inputs={**arrays, "x0": problem.inputs["x0"]})
    return problem


def mpc_unstable(rng: Generator, count: int, small: bool = False) -> Case:
    """A = a·I + noise with a = 1.5 … 1e3 and H up to 60: states up to 1e180, past float32 and past float64."""
    horizon = int(rng.integers(2, 4)) if small else int(rng.choice([3, 5, 8, 14, 20, 40, 60]))
    problem = _mpc(rng, count, small, horizon=horizon)
    a = rng.choice([1.5, 3.0, 10.0, 100.0, 1000.0])
    A = problem.inputs["A"]
    return problem.changed(
        A=a * np.eye(A.shape[-1]) + (0.05 * rng.standard_normal(A.shape) if rng.random() < 0.5 else 0)
    )


def mpc_number_bounds(rng: Generator, count: int, small: bool = False) -> Case:
    """Bounds as Python floats that no float32 holds (0.3, 0.1, 1/3, 0.7), most actions pressed against them."""
    problem = _mpc(rng, count, small)
    a = problem.inputs
    bounds = {"u_min": -float(rng.choice([0.1, 0.3, 1 / 3])), "u_max": float(rng.choice([0.3, 0.1, 0.7]))}
    new = {k: np.full(a[k].shape[-1], v) for k, v in bounds.items()}
    return replace(problem.changed(r=20 * a["r"], **new), numbers=bounds)


def mpc_touching(rng: Generator, count: int, small: bool = False) -> Case:
    """Bounds that touch, and ranges of 1e-12, 1e-6, 1 and 1e8 [action units] beside each other, off the origin."""
    problem = _mpc(rng, count, small)
    a = problem.inputs
    centre = rng.standard_normal(a["u_min"].shape)
    width = rng.choice([0.0, 1e-12, 1e-6, 1.0, 1e8], a["u_min"].shape)
    return problem.changed(u_min=centre - 0.5 * width, u_max=centre + 0.5 * width)


def mpc_units(rng: Generator, count: int, small: bool = False) -> Case:
    """A plain problem in other units: states of 1e6, actions of 1e-6, forces of 1e3, or mixed 1e-6 … 1e6 by component.

    λ·s keeps its unit, so that the relaxation stays as it is; the answer is that of the plain problem in these units.
    """
    problem = _mpc(rng, count, small)
    a = problem.inputs
    n_x, n_u, n_lam = a["A"].shape[-1], a["B"].shape[-1], a["C"].shape[-1]
    if rng.random() < 0.5:
        x, u, f = np.full(n_x, 1e6), np.full(n_u, 1e-6), np.full(n_lam, 1e3)
    else:
        x, u, f = power(rng, -6, 6, n_x), power(rng, -6, 6, n_u), power(rng, -3, 3, n_lam)
    return problem.changed(**in_units(a, x, u, f))


def mpc_cost_scale(rng: Generator, count: int, small: bool = False) -> Case:
    """The whole cost times 1e-8 … 1e8: the same plans."""
    problem = _mpc(rng, count, small)
    factor = float(power(rng, -8, 8, 1)[0])
    names = ("Q", "R", "Q_final", "q", "r", "q_final")
    return problem.changed(**{k: factor * problem.inputs[k] for k in names})


def mpc_extreme(rng: Generator, count: int, small: bool = False) -> Case:
    """One input, or the whole cost, times 1e±(50 … 300): past what float64 holds in products. Refusing is right."""
    problem = _mpc(rng, count, small)
    factor = float(power(rng, 50, 300, 1)[0] ** rng.choice([-1.0, 1.0]))
    name = str(rng.choice([*MATRICES, "d", "c", "q", "r", "q_final", "x0", "cost"]))
    names = ("Q", "R", "Q_final", "q", "r", "q_final") if name == "cost" else (name,)
    return problem.changed(**{k: factor * problem.inputs[k] for k in names})


def mpc_stuck(rng: Generator, count: int, small: bool = False) -> Case:
    """Exact zeros: x0, d, c, q, r, q_final zero, contacts that just touch; the origin is a point of symmetry."""
    problem = _mpc(rng, count, small)
    names = [k for k in ("d", "c", "q", "r", "q_final", "x0") if rng.random() < 0.8]
    return problem.changed(**{k: np.zeros_like(problem.inputs[k]) for k in names})


# ---- violation loss -------------------------------------------------------------------------------------------------


def _loss(rng: Generator, count: int, scale: float = 1.0) -> Loss:
    n_x, n_u, n_lam = (int(rng.integers(1, 6)) for _ in range(3))
    normal = rng.standard_normal
    shapes = {"A": (n_x, n_x), "B": (n_x, n_u), "C": (n_x, n_lam), "d": (n_x,), "D": (n_lam, n_x)}
    shapes |= {"E": (n_lam, n_u), "G": (n_lam, n_lam), "H": (n_lam, n_lam), "c": (n_lam,)}
    system = {k: 0.5 * normal(v) for k, v in shapes.items()}
    stiffness = float(rng.choice([0.1, 0.5]))
    data = (normal((count, n_x)), normal((count, n_u)), normal((count, n_x)))
    system["d"], system["c"] = scale * system["d"], scale * system["c"]
    x, u, x_next = (scale * v for v in data)
    return Loss(system, stiffness, x, u, x_next, gamma=0.1, xi=float(scale**2 * power(rng, -2, 1, 1)[0]))


def loss_plain(rng: Generator, count: int, small: bool = False) -> Loss:
    """Data of size 1, γ half of its bound, ξ 0.01 … 10."""
    problem = _loss(rng, count)
    return replace(problem, gamma=0.5 * _bound(problem))


def loss_at_bound(rng: Generator, count: int, small: bool = False) -> Loss:
    """γ at σ_min(F + Fᵀ) itself, or 1 − 1e-6 … 1 − 1e-14 of it: the inner problem loses its last curvature."""
    problem = _loss(rng, count)
    below = rng.choice([0.0, 1e-14, 1e-12, 1e-9, 1e-6])
    return replace(problem, gamma=_bound(problem) * (1 - below))


def loss_scales(rng: Generator, count: int, small: bool = False) -> Loss:
    """Data and gaps of 1e-6 … 1e6, ξ with their square or left as it was."""
    problem = _loss(rng, count, float(power(rng, -6, 6, 1)[0]))
    problem = replace(problem, gamma=0.5 * _bound(problem))
    return problem if rng.random() < 0.5 else replace(problem, xi=0.01)


def loss_tiny_gamma(rng: Generator, count: int, small: bool = False) -> Loss:
    """γ of 1e-3 … 1e-10 of its bound and a nearly skew F: penalties of 1e10 beside terms of 1."""
    problem = _loss(rng, count)
    system = {**problem.system, "G": problem.system["G"] * power(rng, -4, 0, 1)}
    problem = replace(problem, system=system, stiffness=float(power(rng, -6, -1, 1)[0]))
    return replace(problem, gamma=_bound(problem) * float(power(rng, -10, -3, 1)[0]))


def _bound(problem: Loss) -> float:
    return float(np.linalg.eigvalsh(problem.F + problem.F.T)[0])


def by_name(*functions: Callable, prefix: str = "") -> dict[str, Callable]:
    """Classes of problems, named like the functions that generate them."""
    return {prefix + function.__name__.replace("_", "-"): function for function in functions}


LCP_CLASSES: dict[str, Callable[..., LCP]] = {
    **by_name(lcp_plain),
    **{f"lcp-skew-1e-{k}": partial(lcp_skew, epsilon=10.0**-k) for k in (2, 4, 6, 8, 10, 12)},
    **by_name(lcp_nearly_singular, lcp_graded, lcp_scaled, lcp_degenerate),
    **by_name(lcp_extreme_q, lcp_p_matrix, lcp_large, lcp_not_definite),
}
MPC_CLASSES: dict[str, Callable[..., Case]] = {
    **by_name(mpc_plain),
    **{f"mpc-skew-1e-{k}": partial(mpc_skew, epsilon=10.0**-k) for k in (2, 4, 6, 8)},
    **by_name(mpc_stiff, mpc_flat, mpc_flat_contact, mpc_flat_tiny, mpc_no_effect, mpc_unstable, mpc_number_bounds),
    **by_name(mpc_touching, mpc_units, mpc_cost_scale, mpc_stuck, mpc_extreme),
}
LOSS_CLASSES: dict[str, Callable[..., Loss]] = by_name(loss_plain, loss_at_bound, loss_scales, loss_tiny_gamma)
