"""Independent judges of what the library returns: nothing here calls difflcs.

Every judge recomputes the conditions in float64 from the RETURNED numbers and gives, per condition and element,
violation / limit: above 1 is a broken promise, and what is not a number counts as infinite.
"""

import numpy as np
import torch
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from tests.conformance import judges
from tests.conformance.cases import Case
from tests.conformance.hostile.generators import LCP, Loss
from tests.conformance.judges import mul

Ratios = dict[str, np.ndarray]

_TINY = 1e-320


def _ratio(violation: np.ndarray, limit: np.ndarray | float) -> np.ndarray:
    """Largest violation / limit of each element, 0 / 0 = 0, NaN = ∞."""
    with np.errstate(all="ignore"):
        ratio = np.where(violation <= 0, 0.0, violation / np.maximum(limit, _TINY))
    ratio = np.where(np.isnan(violation) | np.isnan(ratio) | np.isnan(limit), np.inf, ratio)
    return ratio.reshape(len(ratio), -1).max(1, initial=0.0)


def finite(*values: np.ndarray) -> np.ndarray:
    """0 where all numbers of an element are finite, else ∞."""
    bad = np.zeros(len(values[0]), bool)
    for v in values:
        bad |= ~np.isfinite(v.reshape(len(v), -1)).all(1)
    return np.where(bad, np.inf, 0.0)


def _t(M: np.ndarray) -> np.ndarray:
    return M.swapaxes(-1, -2)


# ---- LCP ------------------------------------------------------------------------------------------------------------


def judge_lcp(problem: LCP, lam: np.ndarray, w: np.ndarray, relaxation: float) -> Ratios:
    """Promises of `solve_lcp` for CONVERGED elements.

    - sign: λ, w ≥ 0.
    - equation: |w − (Fλ + q)|_i ≤ 1e-9 of the terms of row i, and ≤ 1e-7·max|q| (relaxed: + sqrt(relaxation·max F_ii)).
      What is below 1e-100 of the largest entry of q counts as zero: no float64 spans 1e-301 and 1e150.
    - complementarity: exactly λ_i = 0 or w_i = 0; relaxed: |λ_i w_i − ε| ≤ 1e-9 ε.
    """
    with np.errstate(all="ignore"):
        F, q = problem.F, problem.q
        terms = np.abs(q) + mul(np.abs(F), lam)
        error = np.abs(w - (mul(F, lam) + q))
        size = np.abs(q).max(-1, keepdims=True)
        rounding = 1e-100 * size
        product = np.abs(lam * w - relaxation)
        if relaxation > 0:
            diagonal = np.diagonal(F, axis1=-2, axis2=-1).max(-1)
            size = size + np.sqrt(relaxation * np.maximum(diagonal, 0.0)).reshape(-1, 1)
            complementary = _ratio(product, 1e-9 * relaxation)
        else:
            complementary = np.where(((lam > 0) & (w > 0)).any(-1), np.inf, 0.0)
        return {
            "finite": finite(lam, w),
            "sign": np.where(((lam >= 0) & (w >= 0)).all(-1), 0.0, np.inf),
            "equation": _ratio(error, 1e-9 * terms + rounding),
            "equation in units of q": _ratio(error, 1e-7 * size + rounding),
            "complementarity": complementary,
        }


# ---- MPC ------------------------------------------------------------------------------------------------------------


def judge_mpc(
    problem: Case,
    x: np.ndarray,
    u: np.ndarray,
    lam: np.ndarray,
    objective: np.ndarray,
    mu: np.ndarray | None = None,
    violation: np.ndarray | None = None,
) -> Ratios:
    """Promises of a solution whose status is CONVERGED or DEGENERATE; `mu` and `violation` where there are rows.

    - start: x_0 is the caller's, exactly. bounds: u within them, exactly. sign: λ > 0.
    - dynamics: |x₊ − (Ax + Bu + Cλ + d)|_i ≤ 1e-6 of its terms.
    - complementarity: |λ_i s_i − ε| ≤ 1e-6 ε + 1e-13 λ_i · terms of s_i, s = Dx + Eu + Fλ + c.
    - rows: each is met or paid for, or acts, to 2e-6 of its terms. price: 0 ≤ μ ≤ price. violation: the largest.
    - stationarity: a step of the whole width against the gradient, scaled by its terms, stays:
      |clip(u − width·g/G) − u| ≤ 1e-6 width. Free of units, and blind to no flat direction.
    - objective: the cost of the returned trajectory, to 1e-9 of its terms.
    - answer: the vertex of a linear program.
    """
    with np.errstate(all="ignore"):
        t, relaxation = problem.by_stage(), problem.relaxation
        mu = np.zeros((*x.shape[:2], 0)) if mu is None else mu
        low, high = t["u_min"], t["u_max"]
        predicted, next_terms = affine(t, "ABCd", x, u, lam)
        s, s_terms = affine(t, "DEFc", x, u, lam)
        cost, cost_terms = cost_of(problem, t, x, u)
        found = {}
        if "g" in t and violation is not None:
            found, fines, fine_terms = judge_rows(t, x, u, mu, violation, next_terms)
            cost, cost_terms = cost + fines, cost_terms + fine_terms
        stationary = stationarity(problem, t, x, u, lam, s, mu)
        if (stationary > 1).any():
            # Where the terms of s are so large that their rounding is all of s, its other reading is ε/λ.
            stationary = np.minimum(stationary, stationarity(problem, t, x, u, lam, relaxation / lam, mu))
        return {
            **found,
            "finite": finite(x, u, lam, mu, objective),
            "start": np.where((x[:, 0] == problem.inputs["x0"]).all(-1), 0.0, np.inf),
            "bounds": np.where(((u >= low) & (u <= high)).all((1, 2)), 0.0, np.inf),
            "sign of lam": np.where((lam > 0).all((1, 2)), 0.0, np.inf),
            "dynamics": _ratio(np.abs(x[:, 1:] - predicted), 1e-6 * next_terms),
            "complementarity": _ratio(np.abs(lam * s - relaxation), 1e-6 * relaxation + 1e-13 * lam * s_terms),
            "stationarity": stationary,
            "objective": _ratio(np.abs(objective - cost), 1e-9 * cost_terms),
            "answer": _vertex(problem, u, low, high),
        }


def affine(t: dict, names: str, x, u, lam) -> tuple[np.ndarray, np.ndarray]:
    """Left x + middle u + right λ + constant of the stages, by four names, and the sizes of its terms."""
    x = x[:, :-1]
    return judges.affine(t, names, x, u, lam), judges.affine(judges.absolute(t), names, abs(x), abs(u), abs(lam))


def cost_of(problem: Case, t: dict, x, u) -> tuple[np.ndarray, np.ndarray]:
    """Cost of a trajectory and the sum of the sizes of its terms, (count,)."""
    total, terms = judges.cost(t, x, u), judges.cost(judges.absolute(t), abs(x), abs(u))
    if problem.barrier > 0:
        logs = problem.barrier * (np.log(u - t["u_min"]) + np.log(t["u_max"] - u))
        total, terms = total - logs.sum((1, 2)), terms + np.abs(logs).sum((1, 2))
    return total, terms


def judge_rows(t: dict, x, u, mu, violation, next_terms) -> tuple[Ratios, np.ndarray, np.ndarray]:
    """Promises of the rows; what their violations cost (count,), and how much of that may be rounding, times 1e9."""
    c, terms, price = judges.rows(t, x, u), judges.rows(judges.absolute(t), abs(x), abs(u)), t["price"]
    # A row whose terms are rounding is met to a part of the terms of its states and of the range of its actions.
    range_, size = t["u_max"] - t["u_min"], np.maximum(abs(x[:, :1]), next_terms.max(1, keepdims=True))
    efforts = np.maximum(abs(u), 1e-3 * np.where(np.isfinite(range_), range_, abs(u)))
    size = np.maximum(terms, 1e-3 * mul(abs(t["G_x"]), size))
    size[:, :-1] = np.maximum(size[:, :-1], 1e-3 * mul(abs(t["G_u"]), efforts))
    unit = np.where(np.isfinite(c), size, 0.0).max(1, keepdims=True)
    off = np.where(mu <= 0, np.maximum(c, 0), np.where(mu >= price, np.maximum(-c, 0), abs(c)))
    over, there = np.maximum(c, 0.0), np.isfinite(c)
    largest, room = over.max((1, 2)), np.where(there, terms, 0.0).max((1, 2))
    paid = np.where(np.isfinite(price), price, 0.0)
    # A price of 1e30 makes 1e14 of the rounding of a row that is held.
    fine_terms = np.where(there, paid * (over + 1e-6 * terms), 0.0).sum((1, 2))
    found = {
        "rows": _ratio(off, 2e-6 * np.where(unit > 0, unit, 1.0)),
        "price": np.where(((mu < 0) | (mu > price)).any((1, 2)), np.inf, 0.0),
        "violation": _ratio(np.abs(largest - violation), 1e-9 * (1e-9 + room)),
    }
    return found, (paid * over).sum((1, 2)), 10 * fine_terms


def stationarity(problem: Case, t: dict, x, u, lam, s, mu) -> np.ndarray:
    """The projected step against the reduced gradient, in units of the width, over its limit."""
    g, terms = reduced_gradient(t, x, u, lam, s, mu)
    below, above, width = u - t["u_min"], t["u_max"] - u, np.broadcast_to(t["u_max"] - t["u_min"], u.shape)
    closed, spread = np.isfinite(width), 0.0
    width = np.where(closed, width, 1 + np.abs(u))
    every = np.broadcast_to(t["Q"], (*u.shape[:2], *t["Q"].shape[2:]))
    last = np.concatenate([every[:, 1:], t["Q_final"]], 1)
    curvature = (t["B"] * (last @ t["B"])).sum(2) + np.diagonal(t["R"], axis1=-2, axis2=-1)
    if problem.barrier > 0:
        g = g + problem.barrier * (1 / above - 1 / below)
        terms = terms + problem.barrier * (1 / above + 1 / below)
        spread = problem.barrier * width / np.minimum(below, above) ** 2
    G = np.maximum(terms, np.where(closed, curvature * width, 0.0))
    G, divisor = np.where(G > 0, G, 1.0), np.where(width > 0, width, 1.0)
    # The action itself is rounded, by up to a part of its size; so is its distance in the terms of a barrier.
    allowance = 1e-6 + 2.0**-52 * np.abs(u) / divisor + 1e-14 * spread / G
    move = np.minimum(np.abs(g) / G, np.where(g > 0, below, above) / divisor)
    return _ratio(np.where(width > 0, move, 0.0), allowance)


def reduced_gradient(t: dict, x, u, lam, s, mu) -> tuple[np.ndarray, np.ndarray]:
    """The derivative dJ/du (count, H, n_u) by an own adjoint recursion, and the sizes of its terms.

    With ρ = λ∘y the equation (diag s + Fᵀ diag λ) y = −Cᵀp is (diag s/λ + Fᵀ) ρ = −Cᵀp; rows are scaled by λ/(λ+s).
    """
    t = {"S": np.zeros((1, 1, x.shape[-1], u.shape[-1])), **t}
    t |= {k: np.zeros((1, 1, 0, v.shape[-1])) for k, v in (("G_x", x), ("G_u", u)) if k not in t}
    b, horizon, steps = lam / (lam + s), u.shape[1], []
    p = mul(t["Q_final"][:, 0], x[:, -1]) + t["q_final"][:, 0] + mul(_t(t["G_x"][:, -1]), mu[:, -1])
    for k in reversed(range(horizon)):
        a = {name: v[:, min(k, v.shape[1] - 1)] for name, v in t.items()}
        matrix = b[:, k, :, None] * _t(a["F"]) + np.eye(lam.shape[-1]) * (s / (lam + s))[:, k, :, None]
        rho = _solve(matrix, -b[:, k] * mul(_t(a["C"]), p))
        parts = [(a["R"], u[:, k]), (_t(a["S"]), x[:, k]), (_t(a["B"]), p), (_t(a["E"]), rho), (_t(a["G_u"]), mu[:, k])]
        sizes = sum((mul(abs(M), abs(v)) for M, v in parts), abs(a["r"]))
        steps.append((sum((mul(M, v) for M, v in parts), a["r"]), sizes))
        p = mul(a["Q"], x[:, k]) + a["q"] + mul(a["S"], u[:, k]) + mul(_t(a["A"]), p) + mul(_t(a["D"]), rho)
        p = p + mul(_t(a["G_x"]), mu[:, k])
    g, terms = (np.stack(v[::-1], 1) for v in zip(*steps, strict=True))
    return g, terms


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Batched solve; NaN where a matrix is singular or not finite."""
    ok = np.isfinite(matrix).all((1, 2)) & np.isfinite(right).all(1)
    safe = torch.from_numpy(np.where(ok[:, None, None], matrix, np.eye(matrix.shape[-1])))
    out, singular = torch.linalg.solve_ex(safe, torch.from_numpy(right[..., None]))
    return np.where((ok & (singular.numpy() == 0))[:, None], out[..., 0].numpy(), np.nan)


def _vertex(problem: Case, u, low, high) -> np.ndarray:
    if problem.answer is None or problem.barrier > 0:
        return np.zeros(len(u))
    known = np.isfinite(problem.answer)
    width = np.broadcast_to(high - low, u.shape)
    error = np.where(known, np.abs(u - np.where(known, problem.answer, u)), 0.0)
    return _ratio(error, 1e-5 * width)


def judge_relaxed_program(
    problem: Case, x: np.ndarray, u: np.ndarray, lam: np.ndarray, objective: np.ndarray, *rows: np.ndarray
) -> Ratios:
    """Promises of backend `relaxed`, whose convex program keeps dynamics, bounds and signs, but not λ∘s = ε."""
    with np.errstate(all="ignore"):
        ratios = judge_mpc(problem, x, u, lam, objective)
        s, terms = affine(problem.by_stage(), "DEFc", x, u, lam)
        kept = ("finite", "start", "bounds", "dynamics", "objective", "answer")
        return {
            **{k: ratios[k] for k in kept},
            "sign of lam": np.where((lam >= 0).all((1, 2)), 0.0, np.inf),
            "sign of s": _ratio(-s, 1e-6 * terms),
        }


# ---- violation loss -------------------------------------------------------------------------------------------------


def judge_loss(problem: Loss, value: np.ndarray) -> Ratios:
    """The value against an own solution of the inner QP, to 1e-6 of it and 1e-9 of its value at λ = 0.

    min over λ, φ ≥ 0 of ½‖r + Cλ‖² + (λᵀφ + ‖e + Fλ − φ‖²/(2γ))/ξ, as least squares under z ≥ 0 (Lawson & Hanson).
    """
    best, still = inner_minimum(problem)
    return {"finite": finite(value), "value": _ratio(np.abs(value - best), 1e-6 * np.abs(best) + 1e-9 * still)}


def inner_minimum(problem: Loss) -> tuple[np.ndarray, np.ndarray]:
    """Value of the inner QP of every transition, and the same with λ = 0."""
    a, F, gamma, xi = problem.system, problem.F, problem.gamma, problem.xi
    n = len(F)
    r = problem.x @ a["A"].T + problem.u @ a["B"].T + a["d"] - problem.x_next
    e = problem.x @ a["D"].T + problem.u @ a["E"].T + a["c"]
    eye = np.eye(n)
    cross = (eye - F.T / gamma) / xi
    Q = np.block([[a["C"].T @ a["C"] + F.T @ F / (gamma * xi), cross], [cross.T, eye / (gamma * xi)]])
    q = np.concatenate([r @ a["C"] + e @ F / (gamma * xi), -e / (gamma * xi)], 1)
    scale = 1 / np.sqrt(np.diag(Q))
    values, vectors = np.linalg.eigh(scale[:, None] * Q * scale)
    low = values[-1] * 1e-15
    L = np.linalg.qr((vectors * np.sqrt(np.maximum(values, low))).T)[1]  # Q ≈ LᵀL
    best = np.empty(len(r))
    for i in range(len(r)):
        target = solve_triangular(L, -scale * q[i], trans="T")
        z = nnls(L, target, maxiter=100 * n)[0] * scale
        best[i] = _descend(a["C"], F, gamma, xi, r[i], e[i], z[:n])
    still = _inner_value(a["C"], F, gamma, xi, r, e, np.zeros((len(r), n)))
    return np.minimum(best, still), still


def _descend(C, F, gamma: float, xi: float, r, e, lam, steps: int = 8) -> float:
    """Projected Newton steps in λ alone, φ eliminated: least squares leaves the rounding of 1/γ in its solution."""
    best = _inner_value(C, F, gamma, xi, r, e, lam)
    for _ in range(steps):
        gap = e + F @ lam
        on = (gap > gamma * lam).astype(float)  # φ > 0
        gradient = (
            C.T @ (r + C @ lam) + (F.T @ (on * lam) + on * (gap - gamma * lam) + F.T @ ((1 - on) * gap) / gamma) / xi
        )
        free = (lam > 0) | (gradient < 0)
        if not free.any():
            break
        H = C.T @ C + (F.T * on + on[:, None] * F - gamma * np.diag(on) + (F.T * (1 - on)) @ F / gamma) / xi
        step = np.zeros_like(lam)
        step[free] = np.linalg.lstsq(H[np.ix_(free, free)], -gradient[free], rcond=1e-15)[0]
        trials = [np.maximum(lam + 0.5**k * step, 0.0) for k in range(12)]
        values = [_inner_value(C, F, gamma, xi, r, e, trial) for trial in trials]
        k = int(np.argmin(values))
        if not values[k] < best:
            break
        best, lam = values[k], trials[k]
    return float(best)


def _inner_value(C, F, gamma: float, xi: float, r, e, lam):
    gap = e + lam @ F.T
    phi = np.maximum(gap - gamma * lam, 0.0)  # the best φ for this λ
    left = gap - phi
    moved = r + lam @ C.T
    return 0.5 * (moved**2).sum(-1) + ((lam * phi).sum(-1) + (left**2).sum(-1) / (2 * gamma)) / xi
