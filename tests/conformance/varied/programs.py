"""Problems without contacts are linear or quadratic programs of their actions; by HiGHS and Clarabel.

None of this calls the library's mathematics.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag
from scipy.optimize import linprog

from tests.conformance.varied.generators import Case

INF = np.inf


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


def least_violation(low, high, G, g, price) -> float:
    """The least largest violation of the hard rows, in parts of each row's size; by linear programming."""
    hard = np.isinf(price)
    if not hard.any():
        return 0.0
    size = np.maximum(np.abs(G[hard]).sum(1) + np.abs(g[hard]), 1.0)
    rows = np.concatenate([G[hard] / size[:, None], -np.ones((int(hard.sum()), 1))], 1)
    bounds = [(a if np.isfinite(a) else None, b if np.isfinite(b) else None) for a, b in zip(low, high, strict=True)]
    cost = np.zeros(rows.shape[1])
    cost[-1] = 1.0
    found = linprog(cost, rows, g[hard] / size, bounds=[*bounds, (0, None)], method="highs")
    return float(found.fun) if found.status == 0 else np.nan


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


def optimum(program) -> np.ndarray | None:
    """The actions of the program by Clarabel, with a slack for every soft row; None without an answer."""
    import clarabel

    P, p, low, high, G, g, price = program
    soft = np.flatnonzero(np.isfinite(price))
    n, m = len(p), len(soft)
    E = np.zeros((len(g), m))
    E[soft, np.arange(m)] = -1.0
    low, high = np.concatenate([low, np.zeros(m)]), np.concatenate([high, np.full(m, INF)])
    A, b = [np.concatenate([G, E], 1)], [g]
    for sign, bound in ((1, high), (-1, -low)):
        there = np.isfinite(bound)
        A.append(sign * np.eye(n + m)[there])
        b.append(bound[there])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    size, upper = np.concatenate(b), sparse.csc_matrix(np.triu(block_diag(P, np.zeros((m, m)))))
    rows, cones = sparse.csc_matrix(np.concatenate(A)), [clarabel.NonnegativeConeT(len(size))]
    found = clarabel.DefaultSolver(upper, np.concatenate([p, price[soft]]), rows, size, cones, settings).solve()
    return np.asarray(found.x)[:n] if "Solved" in str(found.status) else None


def value(program, U) -> float:
    """The cost of actions, prices included."""
    P, p, _, _, G, g, price = program
    soft = np.isfinite(price)
    return float(0.5 * U @ P @ U + p @ U + (price[soft] * np.maximum(G[soft] @ U - g[soft], 0)).sum())
