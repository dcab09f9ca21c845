"""An own recomputation of all optimality conditions, element by element, in NumPy: nothing here calls the library.

Stationarity is judged by the derivative of the Lagrangian along the trajectory, forwards from the actions, where
`difflcs.mpc.kkt` goes backwards by costates.
"""

import numpy as np

from tests.conformance.cases import Case
from tests.conformance.judges import absolute, affine, mul, rows

SYSTEM = ("A", "B", "C", "d", "D", "E", "F", "c")


def conditions(case: Case, i: int, x, u, lam, mu) -> dict[str, float]:
    """Largest violation of each condition of element i, in parts of the sizes of the terms that make it up."""
    t, now = case.element(i), x[:-1]
    predicted, s = (affine(t, names, now, u, lam) for names in ("ABCd", "DEFc"))
    x_terms, s_terms = (affine(absolute(t), names, abs(now), abs(u), abs(lam)) for names in ("ABCd", "DEFc"))
    X = largest_states(case, i, x, u, lam)
    low, high = (np.broadcast_to(t[name], u.shape) for name in ("u_min", "u_max"))
    c = size = price = np.zeros((len(x), 0))
    if "g" in t:  # a row whose terms are rounding is met to a part of its states' terms and of its actions' range
        c, size, price = rows(t, x, u), rows(absolute(t), abs(x), abs(u)), np.broadcast_to(t["price"], mu.shape)
        efforts = np.maximum(abs(u), 1e-3 * np.where(np.isfinite(high - low), high - low, abs(u)))
        size = np.maximum(size, 1e-3 * mul(abs(t["G_x"]), X))
        size[:-1] = np.maximum(size[:-1], 1e-3 * mul(abs(t["G_u"]), efforts))
    unit = np.where(np.isfinite(c), size, 0.0).max(0, initial=0.0)
    unit = np.where(unit > 0, unit, 1.0)
    off = np.where(mu <= 0, np.maximum(c, 0), np.where(mu >= price, np.maximum(-c, 0), abs(c)))
    gradient, terms = reduced_gradient(case, i, x, u, lam, mu)
    free = np.where(gradient > 0, u > low, u < high) & (high > low)
    # A bound that is so near that the step to it is rounding is met.
    near = np.where(gradient > 0, u - low, high - u) <= 1e-6 * np.where(np.isfinite(high - low), high - low, 1 + abs(u))
    return {
        "start": float(abs(x[0] - t["x0"]).max()),
        "dynamics": _part(x[1:] - predicted, x_terms),
        "complementarity": _part(lam * s - case.relaxation, case.relaxation + 1e-7 * lam * s_terms),
        "sign": float((lam <= 0).any()),
        "bounds": float(np.maximum(low - u, u - high).clip(0).max()),
        "rows": float((off / unit).max(initial=0.0)),
        "price": float(((mu < 0) | (mu > price)).any()),
        "stationarity": float(np.where(free & ~near, abs(gradient) / terms, 0.0).max()),
    }


def largest_states(case: Case, i: int, x, u, lam) -> np.ndarray:
    """Σ|terms| of each state, the largest over the stages: what is left of them where they cancel is rounding."""
    terms = affine(absolute(case.element(i)), "ABCd", abs(x[:-1]), abs(u), abs(lam))
    return np.maximum(abs(x[0]), terms.max(0))


def reduced_gradient(case: Case, i: int, x, u, lam, mu) -> tuple[np.ndarray, np.ndarray]:
    """d(J + Σ mᵀc)/du (H, n_u) along the trajectory that the actions cause, and the sizes of its terms."""
    H, n_u = u.shape
    T = np.zeros((x.shape[1], H * n_u))  # dx_k/du
    gradient, terms, X = np.zeros(H * n_u), np.zeros(H * n_u), largest_states(case, i, x, u, lam)

    def add(direction, weight, least=0.0):
        nonlocal gradient, terms
        gradient = gradient + direction.T @ weight
        terms = terms + abs(direction).T @ np.maximum(abs(weight), least)

    for k in range(H):
        A, B, C, _, D, E, F, c = (case.at(name, i, k) for name in SYSTEM)
        Q, R, S, q, r = (case.at(name, i, k) for name in ("Q", "R", "S", "q", "r"))
        U = np.zeros((n_u, H * n_u))
        U[:, k * n_u : (k + 1) * n_u] = np.eye(n_u)
        add(T, Q @ x[k], 1e-3 * abs(Q) @ X)
        add(T, q)
        add(T, S @ u[k])
        add(U, R @ u[k])
        add(U, r)
        add(U, S.T @ x[k])
        if mu.shape[1]:
            add(T, case.at("G_x", i, k).T @ mu[k])
            add(U, case.at("G_u", i, k).T @ mu[k])
        s = D @ x[k] + E @ u[k] + F @ lam[k] + c
        # s dλ + λ ds = 0 with ds = D dx + E du + F dλ; rows are divided by λ + s.
        size = lam[k] + s
        L = -np.linalg.solve(
            np.diag(s / size) + (lam[k] / size)[:, None] * F, (lam[k] / size)[:, None] * (D @ T + E @ U)
        )
        T = A @ T + B @ U + C @ L
    add(T, case.at("Q_final", i, 0) @ x[-1], 1e-3 * abs(case.at("Q_final", i, 0)) @ X)
    add(T, case.at("q_final", i, 0))
    if mu.shape[1]:
        add(T, case.at("G_x", i, H).T @ mu[H])
    return gradient.reshape(H, n_u), np.where(terms > 0, terms, 1.0).reshape(H, n_u)


def _part(value, terms) -> float:
    return float((abs(value) / np.where(terms > 0, terms, 1.0)).max(initial=0.0))
