"""Problems without contacts and without curvature are linear programs of their actions, which HiGHS solves.

None of this calls the library's mathematics.
"""

import numpy as np
from scipy.optimize import linprog

from tests.conformance import judges
from tests.conformance.cases import Case


def above_optimum(case: Case, i: int, u: np.ndarray) -> float | None:
    """How much more actions cost than those of HiGHS, in parts of the terms; None where it is no linear program."""
    t = {name: value[[i if len(value) > 1 else 0]] for name, value in case.by_stage().items()}
    if any(t[name].any() for name in ("R", "S", "Q_final", *["Q"] * (len(u) > 1))):  # no action moves the first state
        return None
    # Cost and rows are affine in the actions: known from those of no action, and of each alone.
    tried = np.concatenate([np.zeros((1, u.size)), np.eye(u.size)]).reshape(-1, *u.shape)
    x, lam = [t["x0"][:, 0].repeat(len(tried), 0)], np.zeros((len(tried), 0))
    for k in range(len(u)):
        now = {name: t[name][:, k % t[name].shape[1]] for name in "ABCd"}
        x.append(judges.affine(now, "ABCd", x[-1], tried[:, k], lam))
    cost = judges.cost(t, x := np.stack(x, 1), tried)
    rows = judges.rows(t, x, tried) if "g" in t else np.zeros((len(tried), 0, 0))
    there = np.isfinite(rows[0])
    p, g, G = cost[1:] - cost[0], -rows[0, there], (rows[1:, there] - rows[0, there]).T
    price = np.broadcast_to(t["price"][0], there.shape)[there] if "g" in t else g
    soft = np.isfinite(price)
    rows, cost = np.concatenate([G, -np.eye(len(g))[:, soft]], 1), np.concatenate([p, price[soft]])
    bounds = np.stack([np.broadcast_to(t[name][0], u.shape).ravel() for name in ("u_min", "u_max")], 1)
    best = linprog(cost, rows, g, bounds=[*bounds, *[(0, None)] * int(soft.sum())], method="highs")
    if best.status != 0:
        return None
    fines, size = np.maximum(G @ u.ravel() - g, 0), abs(G) @ abs(u.ravel()) + abs(g)
    value = p @ u.ravel() + price[soft] @ fines[soft]
    return float((value - best.fun) / (1e-300 + abs(p) @ abs(u.ravel()) + price[soft] @ size[soft]))
