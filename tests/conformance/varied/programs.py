"""Problems without contacts are quadratic programs of their actions; the linear ones are solved by HiGHS.

None of this calls the library's mathematics.
"""

import numpy as np
from scipy.optimize import linprog

from tests.conformance.cases import Case


def condensed(case: Case, i: int):
    """½UᵀPU + pᵀU + constant, low ≤ U ≤ high, rows GU ≤ g and their prices, of element i."""
    H, (n_x, n_u) = case.horizon, case.arrays["B"].shape[-2:]
    N = H * n_u
    T, t = np.zeros((n_x, N)), case.arrays["x0"][i]  # x_k = T U + t
    P, p = np.zeros((N, N)), np.zeros(N)
    G, g, price = [], [], []
    for k in range(H + 1):
        U = np.zeros((n_u, N))
        if k < H:
            U[:, k * n_u : (k + 1) * n_u] = np.eye(n_u)
            Q, R, S, q, r = (case.at(name, i, k) for name in ("Q", "R", "S", "q", "r"))
            cross = T.T @ S @ U
            P += T.T @ Q @ T + U.T @ R @ U + cross + cross.T
            p += T.T @ (Q @ t + q) + U.T @ (r + S.T @ t)
        else:
            Q, q = case.at("Q_final", i, 0), case.at("q_final", i, 0)
            P += T.T @ Q @ T
            p += T.T @ (Q @ t + q)
        if "g" in case.arrays:
            G_x = case.at("G_x", i, k)
            rows = G_x @ T + (case.at("G_u", i, k) @ U if k < H else 0)
            G.append(rows)
            g.append(case.at("g", i, k) - G_x @ t)
            price.append(case.at("price", i, k))
        if k < H:
            A, B, d = (case.at(name, i, k) for name in ("A", "B", "d"))
            T, t = A @ T + B @ U, A @ t + d
    low, high = (np.concatenate([case.at(name, i, k) for k in range(H)]) for name in ("u_min", "u_max"))
    if not G:
        return P, p, low, high, np.zeros((0, N)), np.zeros(0), np.zeros(0)
    G, g, price = np.concatenate(G), np.concatenate(g), np.concatenate(price)
    there = np.isfinite(g)
    return P, p, low, high, G[there], g[there], price[there]


def above_optimum(case: Case, i: int, u: np.ndarray) -> float | None:
    """How much more actions cost than those of HiGHS, in parts of the terms; None where it is no linear program."""
    P, p, low, high, G, g, price = condensed(case, i)
    soft = np.isfinite(price)
    if P.any():
        return None
    rows, cost = np.concatenate([G, -np.eye(len(g))[:, soft]], 1), np.concatenate([p, price[soft]])
    limits = [(a if np.isfinite(a) else None, b if np.isfinite(b) else None) for a, b in zip(low, high, strict=True)]
    best = linprog(cost, rows, g, bounds=limits + [(0, None)] * int(soft.sum()), method="highs")
    if best.status != 0:
        return None
    fines, size = np.maximum(G @ u.ravel() - g, 0), abs(G) @ abs(u.ravel()) + abs(g)
    value = p @ u.ravel() + (price * fines)[soft].sum()
    return float((value - best.fun) / (1e-300 + abs(p) @ abs(u.ravel()) + (price * size)[soft].sum()))
