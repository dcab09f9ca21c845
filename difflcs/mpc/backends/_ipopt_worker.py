"""The nonlinear program for CasADi + IPOPT, and the loop of a worker process.

This file imports numpy and casadi only and is started as a script, so that a worker is up in a fraction of a second and
never imports the user's main module or torch. Processes and not threads, because IPOPT crashes when several run in one
process (casadi issue 3456).
"""

from __future__ import annotations

import contextlib
import functools
import signal
import sys
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from types import FrameType
from typing import NamedTuple

import casadi
import numpy as np


class Sizes(NamedTuple):
    """Key of the symbolic program.

    Attributes:
        n_x, n_u, n_lam, n_c, horizon: sizes of the problem.
        parameters: name, rows, columns and copies of each parameter of the program in their packed order; each is
            packed row-major. One copy serves all stages, several are those of the stages.
    """

    n_x: int
    n_u: int
    n_lam: int
    n_c: int
    horizon: int
    parameters: tuple[tuple[str, int, int, int], ...]


class Options(NamedTuple):
    """Key of the solver besides `Sizes`.

    Attributes:
        tol, max_iter, mu_init: options of IPOPT.
        barrier: whether the cost has a barrier of the action bounds.
        slack: whether a constraint may be violated, by a variable v ≥ 0 at its price.
        elastic: whether Σ v² / 2 is the whole cost.
    """

    tol: float
    max_iter: int
    mu_init: float
    barrier: bool
    slack: bool
    elastic: bool


def _unpack(packed: casadi.SX, sizes: Sizes) -> dict[str, list[casadi.SX]]:
    """Split packed parameters by name, each as a list of its copies."""
    named, offset = {}, 0
    for name, rows, columns, copies in sizes.parameters:
        named[name] = []
        for _ in range(copies):
            named[name].append(casadi.reshape(packed[offset : offset + rows * columns], columns, rows).T)
            offset += rows * columns
    return named


@functools.lru_cache(maxsize=32)
def _solver(sizes: Sizes, options: Options) -> casadi.Function:
    """Transcribe Eq. 3 of the paper over (u_k, λ_k, s_k, x_{k+1}), k = 0 … H−1, and v_k, k = 0 … H.

    In g the equations come first, stage by stage, then the constraints of the stages 0 … H.
    """
    packed = casadi.SX.sym("p", sum(rows * columns * copies for _, rows, columns, copies in sizes.parameters))
    copies = _unpack(packed, sizes)
    variables, slacks, equations, limits, cost = [], [], [], [], casadi.SX(0)

    def limit(k: int, value: casadi.SX) -> None:
        nonlocal cost
        v = casadi.SX.sym(f"v{k}", sizes.n_c) if options.slack else casadi.SX(sizes.n_c, 1)
        if options.slack:
            slacks.append(v)
            cost += casadi.sumsqr(v) / 2 if options.elastic else casadi.dot(at(k, "price"), v)
        limits.append(value - at(k, "g") - v)

    def at(k: int, name: str) -> casadi.SX:
        return copies[name][k if len(copies[name]) > 1 else 0]

    x = at(0, "x0")
    for k in range(sizes.horizon):
        p = {name: at(k, name) for name in copies}
        u, lam = casadi.SX.sym(f"u{k}", sizes.n_u), casadi.SX.sym(f"lam{k}", sizes.n_lam)
        s, x_next = casadi.SX.sym(f"s{k}", sizes.n_lam), casadi.SX.sym(f"x{k + 1}", sizes.n_x)
        if not options.elastic:
            cost += casadi.bilin(p["Q"], x, x) / 2 + casadi.dot(p["q"], x)
            cost += casadi.bilin(p["R"], u, u) / 2 + casadi.dot(p["r"], u) + casadi.bilin(p["S"], x, u)
        if options.barrier and not options.elastic:
            cost -= p["barrier"] * casadi.sum1(casadi.log(u - p["u_min"]) + casadi.log(p["u_max"] - u))
        equations += [
            p["A"] @ x + p["B"] @ u + p["C"] @ lam + p["d"] - x_next,
            p["D"] @ x + p["E"] @ u + p["F"] @ lam + p["c"] - s,
            lam * s - p["relaxation"],
        ]
        variables += [u, lam, s, x_next]
        if sizes.n_c:
            limit(k, p["G_x"] @ x + p["G_u"] @ u)
        x = x_next
    if sizes.n_c:
        limit(sizes.horizon, at(sizes.horizon, "G_x") @ x)
    if not options.elastic:
        cost += casadi.bilin(at(0, "Q_final"), x, x) / 2 + casadi.dot(at(0, "q_final"), x)
    program = {
        "x": casadi.vertcat(*variables, *slacks),
        "p": packed,
        "f": cost,
        "g": casadi.vertcat(*equations, *limits),
    }
    settings = {
        "print_time": False,
        "error_on_fail": False,
        "calc_lam_p": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": options.tol,
        "ipopt.max_iter": options.max_iter,
        "ipopt.mu_init": options.mu_init,
        "ipopt.bound_relax_factor": 0.0,
        # Another order of the pivots is 10 % faster. Steps without a check of their residual would be, too, and blur
        # which constraints act. Compiled functions (CasADi's JIT) would save 3 to 15 % and take 10 to 50 s to compile.
        "ipopt.mumps_pivot_order": 0,
    }
    return casadi.nlpsol("lcs_mpc", "ipopt", program, settings)


class Chunk(NamedTuple):
    """Some problems of a batch, as arrays with the problems in front.

    Attributes:
        parameters: (m, …) packed as `Sizes.parameters` says.
        u_min, u_max: (m, H, n_u).
        row_max: (m, H+1, n_c) largest G_x x + G_u u − g − v: 0, or infinite where there is no constraint.
        v_max: (m, H+1, n_c) largest v: 0 where a constraint is hard, else infinite.
        x: (m, H, n_x) start of x_1 … x_H.
        u: (m, H, n_u) start of the actions.
        lam, s: (m, H, n_lam) start of λ and s.
        v: (m, H+1, n_c) start of v.
    """

    parameters: np.ndarray
    u_min: np.ndarray
    u_max: np.ndarray
    row_max: np.ndarray
    v_max: np.ndarray
    x: np.ndarray
    u: np.ndarray
    lam: np.ndarray
    s: np.ndarray
    v: np.ndarray


class Solved(NamedTuple):
    """Result of a chunk.

    For each problem: x_1 … x_H, u, λ, the multipliers of the constraints, IPOPT's return status, iterations, seconds.
    """

    x: np.ndarray
    u: np.ndarray
    lam: np.ndarray
    mu: np.ndarray
    status: np.ndarray
    iterations: np.ndarray
    seconds: np.ndarray

    @classmethod
    def start(cls, chunk: Chunk) -> Solved:
        """Make the result of a chunk before IPOPT has run: its start."""
        count = len(chunk.u)
        return cls(
            chunk.x.copy(), chunk.u.copy(), chunk.lam.copy(), np.zeros(chunk.v.shape),
            np.full(count, "", "U64"), np.zeros(count, np.int32), np.zeros(count),
        )  # fmt: skip


def solve_chunk(sizes: Sizes, options: Options, chunk: Chunk) -> Solved:
    """Solve one problem after the other; an exception fails its element only, Ctrl-C ends them all."""
    with _caught_interrupts() as interrupts:
        return _solve_chunk(sizes, options, chunk, interrupts)


@contextlib.contextmanager
def _caught_interrupts() -> Iterator[list[int]]:
    """Collect signals of Ctrl-C: CasADi swallows the KeyboardInterrupt, and merely fails the current problem."""
    caught: list[int] = []
    before = signal.getsignal(signal.SIGINT)
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield caught
        return

    def catch(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        before(number, frame)

    signal.signal(signal.SIGINT, catch)
    try:
        yield caught
    finally:
        signal.signal(signal.SIGINT, before)


def _solve_chunk(sizes: Sizes, options: Options, chunk: Chunk, interrupts: list[int]) -> Solved:
    solver = _solver(sizes, options)
    n_x, n_u, n_lam, n_c, horizon, _ = sizes
    ends = np.cumsum([n_u, n_lam, n_lam, n_x])
    equations = horizon * (n_x + 2 * n_lam)
    rows = (horizon + 1) * n_c
    least = np.concatenate([np.zeros(equations), np.full(rows, -np.inf)])
    free, positive = np.full((horizon, n_x), np.inf), np.zeros((horizon, 2 * n_lam))
    result = Solved.start(chunk)

    def join(*stages: np.ndarray, v: np.ndarray) -> np.ndarray:
        whole = np.concatenate(stages, axis=1).ravel()
        return np.concatenate([whole, v.ravel()]) if options.slack else whole

    for i in range(len(chunk.u)):
        started = time.perf_counter()
        lower = join(chunk.u_min[i], positive, -free, v=np.zeros(rows))
        upper = join(chunk.u_max[i], positive + np.inf, free, v=chunk.v_max[i])
        start = join(chunk.u[i], chunk.lam[i], chunk.s[i], chunk.x[i], v=chunk.v[i])
        most = np.concatenate([np.zeros(equations), chunk.row_max[i].ravel()])
        try:
            out = solver(x0=start, p=chunk.parameters[i], lbx=lower, ubx=upper, lbg=least, ubg=most)
            stats = solver.stats()
            z = np.asarray(out["x"]).ravel()[: horizon * ends[-1]].reshape(horizon, -1)
            result.u[i], result.lam[i], _, result.x[i] = np.split(z, ends[:-1], axis=1)
            result.mu[i] = np.asarray(out["lam_g"]).ravel()[equations:].reshape(horizon + 1, n_c)
            result.status[i] = stats["return_status"]
            result.iterations[i] = stats["iter_count"]
        except RuntimeError:
            pass  # the start stays
        result.seconds[i] = time.perf_counter() - started
        if interrupts:
            raise KeyboardInterrupt
    return result


def main() -> None:
    """Answer (sizes, options, chunk) with `Solved` until the parent closes the connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle; it closes the connection
    connection = Connection(int(sys.argv[1]))
    while True:
        try:
            sizes, options, chunk = connection.recv()
        except (EOFError, OSError):
            return
        # Plain tuples over the wire: in the parent these classes live in another module than in this script.
        connection.send(tuple(solve_chunk(Sizes(*sizes), Options(*options), Chunk(*chunk))))


if __name__ == "__main__":
    main()
