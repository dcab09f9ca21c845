"""Problems without contacts are quadratic programs: plans of `batched` against DAQP, Clarabel, and a Riccati recursion.

    python -m tests.conformance.varied.linear --first 0 --count 200

DAQP solves the program condensed to the actions (and a slack for every soft row), HiGHS says whether it has a solution
at all. None of this calls the library's mathematics.
"""

from __future__ import annotations

import argparse
import importlib.util

import numpy as np
import torch
from scipy.linalg import block_diag
from scipy.optimize import linprog

from difflcs import Status
from difflcs.mpc.backends import BatchedBackend
from tests.conformance.varied.campaign import Report
from tests.conformance.varied.generators import Case, random_case
from tests.conformance.varied.judges import objective

BATCHED = BatchedBackend(threads=1)
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


def optimum(program, solver: str = "daqp") -> np.ndarray | None:
    """The actions of the program by another solver; None where it says that there are none."""
    P, p, low, high, G, g, price = program
    soft = np.flatnonzero(np.isfinite(price))
    n, m = len(p), len(soft)
    E = np.zeros((len(g), m))
    E[soft, np.arange(m)] = -1.0
    linear = np.concatenate([p, price[soft]])
    rows = np.concatenate([G, E], 1)
    low, high = np.concatenate([low, np.zeros(m)]), np.concatenate([high, np.full(m, INF)])
    if solver == "daqp":
        if importlib.util.find_spec("daqp") is None:
            return None
        import daqp  # pyright: ignore[reportMissingImports]

        # A linear program in the slacks: proximal steps.
        options = {"eps_prox": 1e-4, "eta_prox": 1e-12, "iter_limit": 100000} if m else {}
        big = 1e30
        bupper = np.concatenate([np.where(np.isfinite(high), high, big), g])
        blower = np.concatenate([np.where(np.isfinite(low), low, -big), np.full(len(g), -big)])
        sense = np.zeros(len(bupper), dtype=np.int32)
        quadratic = block_diag(P, np.zeros((m, m)))
        z, _, flag, _ = daqp.solve(quadratic, linear, rows, bupper, blower, sense, **options)
        return np.asarray(z)[:n] if flag > 0 else None
    import clarabel
    from scipy import sparse

    A, b = [rows], [g]
    for sign, bound in ((1, high), (-1, -low)):
        there = np.isfinite(bound)
        A.append(sign * np.eye(n + m)[there])
        b.append(bound[there])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    stacked = sparse.csc_matrix(np.concatenate(A))
    upper = sparse.csc_matrix(np.triu(block_diag(P, np.zeros((m, m)))))
    size = np.concatenate(b)
    found = clarabel.DefaultSolver(
        upper, linear, stacked, size, [clarabel.NonnegativeConeT(len(size))], settings
    ).solve()
    return np.asarray(found.x)[:n] if "Solved" in str(found.status) else None


def value(program, U) -> float:
    """The cost of actions, prices included."""
    P, p, _, _, G, g, price = program
    soft = np.isfinite(price)
    return float(0.5 * U @ P @ U + p @ U + (price[soft] * np.maximum(G[soft] @ U - g[soft], 0)).sum())


def riccati(case: Case, i: int) -> np.ndarray:
    """The plan (H, n_u) of element i without bounds and constraints."""
    P, p, gains = case.at("Q_final", i, 0), case.at("q_final", i, 0), []
    for k in reversed(range(case.horizon)):
        A, B, d, Q, R, S, q, r = (case.at(name, i, k) for name in ("A", "B", "d", "Q", "R", "S", "q", "r"))
        M, h = S + A.T @ P @ B, r + B.T @ (p + P @ d)
        K, f = (-np.linalg.solve(R + B.T @ P @ B, v) for v in (M.T, h))
        p = q + A.T @ (p + P @ d) + M @ f
        P = Q + A.T @ P @ A + M @ K
        gains.insert(0, (K, f))
    x, u = case.arrays["x0"][i], []
    for k, (K, f) in enumerate(gains):
        u.append(K @ x + f)
        x = case.at("A", i, k) @ x + case.at("B", i, k) @ u[-1] + case.at("d", i, k)
    return np.stack(u)


def without_limits(report: Report, seed: int, batch: int) -> None:
    """`batched` against the Riccati recursion."""
    case = random_case(seed, batch, n_lam=0, bounds=False, rows=False)
    plan = BATCHED.solve(case.problem(), None)
    for i in range(batch):
        u = riccati(case, i)
        apart = float(np.abs(plan.primal.u[i].numpy() - u).max() / max(1.0, np.abs(u).max()))
        report.counts["against Riccati"] += 1
        report.note("actions off Riccati's", apart)
        if not (apart < 1e-6 and bool(plan.solved[i])):
            report.find("off Riccati", seed, i, apart)


def with_limits(report: Report, seed: int, batch: int) -> None:
    """`batched` against quadratic programming."""
    case = random_case(seed, batch, n_lam=0)
    problem = case.problem()
    plan = BATCHED.solve(problem, None)
    for i in range(batch):
        program, status = condensed(case, i), Status(int(plan.status[i]))
        _, _, low, high, G, g, price = program
        U = plan.primal.u[i].numpy().reshape(-1)
        least = least_violation(low, high, G, g, price)
        possible = least < 1e-9
        report.counts[f"{'possible' if possible else 'impossible'}: {status.name}"] += 1
        if not possible:
            if status.solved and least > 1e-6:
                report.find("solved what is impossible", seed, i, least)
            if status is not Status.INFEASIBLE and least > 1e-6:
                report.find(f"impossible, and said {status.name}", seed, i, least)
            continue
        if status is Status.INFEASIBLE:
            report.find("false INFEASIBLE", seed, i, least)
        answers = [v for v in (optimum(program, s) for s in ("daqp", "clarabel")) if v is not None]
        # What keeps the hard rows, the cheapest.
        hard = np.isinf(price)
        kept = [v for v in answers if (G[hard] @ v - g[hard]).max(initial=0.0) < 1e-7]
        if not kept:
            report.counts["no other solver has an answer"] += 1
            continue
        if not status.solved:
            report.find(f"possible, and {status.name}", seed, i)
            continue
        best = min(kept, key=lambda v: value(program, v))
        gap = (value(program, U) - value(program, best)) / (1 + abs(value(program, best)))
        report.counts["compared"] += 1
        tight = ((G @ U - g) > -1e-9).any() if len(g) else False
        report.counts["compared, a row active"] += bool(tight)
        report.note("cost above the other's", gap)
        report.note("actions apart", float(np.abs(U - best).max() / max(1.0, np.abs(best).max())))
        if gap > 1e-6:
            report.find("cost above the other's", seed, i, gap)
        if abs(
            value(program, U)
            - value(program, 0 * U)
            + objective_at_rest(case, i)
            - objective(case, i, plan.primal.x[i].numpy(), plan.primal.u[i].numpy())
        ) > 1e-8 * (1 + abs(value(program, U))):
            report.find("the program is not the problem", seed, i)


def objective_at_rest(case: Case, i: int) -> float:
    """The cost of zero actions."""
    x, u = [case.arrays["x0"][i]], np.zeros((case.horizon, case.arrays["B"].shape[-1]))
    for k in range(case.horizon):
        x.append(case.at("A", i, k) @ x[-1] + case.at("d", i, k))
    return objective(case, i, np.stack(x), u)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--batch", type=int, default=8)
    options = parser.parse_args()
    torch.set_num_threads(1)
    report = Report()
    for seed in range(options.first, options.first + options.count):
        before = len(report.findings)
        without_limits(report, seed, options.batch)
        with_limits(report, seed, options.batch)
        for what, _, i, figure in report.findings[before:]:
            print(f"seed {seed} element {i}: {what} {figure:.3g}", flush=True)
    for name, count in sorted(report.counts.items()):
        print(f"{count:8} {name}")
    for name, figure in sorted(report.worst.items()):
        print(f"{figure:10.2e} largest {name}")


if __name__ == "__main__":
    main()
