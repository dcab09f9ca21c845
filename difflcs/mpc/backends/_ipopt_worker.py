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
    """What decides the symbolic program.

    Attributes:
        n_x, n_u, n_lam, horizon: sizes of the problem.
        parameters: name, rows and columns of each parameter of the program in their packed order; each is packed
            row-major.
    """

    n_x: int
    n_u: int
    n_lam: int
    horizon: int
    parameters: tuple[tuple[str, int, int], ...]


class Options(NamedTuple):
    """What decides the solver besides `Sizes`."""

    tol: float
    max_iter: int
    mu_init: float
    barrier: bool


@functools.lru_cache(maxsize=32)
def _solver(sizes: Sizes, options: Options) -> casadi.Function:
    """Direct transcription of Eq. mpc_lcs over (u_k, λ_k, s_k, x_{k+1}), k = 0 … H−1."""
    packed = casadi.SX.sym("p", sum(rows * columns for _, rows, columns in sizes.parameters))
    p, at = {}, 0
    for name, rows, columns in sizes.parameters:
        p[name] = casadi.reshape(packed[at : at + rows * columns], columns, rows).T
        at += rows * columns
    x, variables, constraints, cost = p["x0"], [], [], casadi.SX(0)
    for k in range(sizes.horizon):
        u, lam = casadi.SX.sym(f"u{k}", sizes.n_u), casadi.SX.sym(f"lam{k}", sizes.n_lam)
        s, x_next = casadi.SX.sym(f"s{k}", sizes.n_lam), casadi.SX.sym(f"x{k + 1}", sizes.n_x)
        cost += casadi.bilin(p["Q"], x, x) / 2 + casadi.dot(p["q"], x)
        cost += casadi.bilin(p["R"], u, u) / 2 + casadi.dot(p["r"], u)
        if options.barrier:
            cost -= p["barrier"] * casadi.sum1(casadi.log(u - p["u_min"]) + casadi.log(p["u_max"] - u))
        constraints += [
            p["A"] @ x + p["B"] @ u + p["C"] @ lam + p["d"] - x_next,
            p["D"] @ x + p["E"] @ u + p["F"] @ lam + p["c"] - s,
            lam * s - p["relaxation"],
        ]
        variables += [u, lam, s, x_next]
        x = x_next
    cost += casadi.bilin(p["Q_final"], x, x) / 2 + casadi.dot(p["q_final"], x)
    program = {"x": casadi.vertcat(*variables), "p": packed, "f": cost, "g": casadi.vertcat(*constraints)}
    return casadi.nlpsol(
        "lcs_mpc",
        "ipopt",
        program,
        {
            "print_time": False,
            "error_on_fail": False,
            "calc_lam_p": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.tol": options.tol,
            "ipopt.max_iter": options.max_iter,
            "ipopt.mu_init": options.mu_init,
            "ipopt.bound_relax_factor": 0.0,
        },
    )


class Chunk(NamedTuple):
    """Some problems of a batch, as arrays with the problems in front.

    Attributes:
        parameters: (m, …) packed as `Sizes.parameters` says.
        u_min, u_max: (m, n_u).
        x: (m, H, n_x) start of x_1 … x_H.
        u: (m, H, n_u) start of the actions.
        lam, s: (m, H, n_lam) start of λ and s.
    """

    parameters: np.ndarray
    u_min: np.ndarray
    u_max: np.ndarray
    x: np.ndarray
    u: np.ndarray
    lam: np.ndarray
    s: np.ndarray


class Solved(NamedTuple):
    """Result of a chunk: x_1 … x_H, u, λ, IPOPT's word for how it ended, iterations and seconds of each problem."""

    x: np.ndarray
    u: np.ndarray
    lam: np.ndarray
    status: np.ndarray
    iterations: np.ndarray
    seconds: np.ndarray


def no_words(count: int) -> np.ndarray:
    """The statuses of problems that IPOPT has said nothing about."""
    return np.full(count, "", "U64")


def solve_chunk(sizes: Sizes, options: Options, chunk: Chunk) -> Solved:
    """Solve one problem after the other; an exception fails its element only, Ctrl-C ends them all."""
    with _heard_interrupts() as interrupts:
        return _solve_chunk(sizes, options, chunk, interrupts)


@contextlib.contextmanager
def _heard_interrupts() -> Iterator[list[int]]:
    """The signals of Ctrl-C that came: CasADi swallows the KeyboardInterrupt, and merely fails the problem at hand."""
    heard: list[int] = []
    before = signal.getsignal(signal.SIGINT)
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield heard
        return

    def hear(number: int, frame: FrameType | None) -> None:
        heard.append(number)
        before(number, frame)

    signal.signal(signal.SIGINT, hear)
    try:
        yield heard
    finally:
        signal.signal(signal.SIGINT, before)


def _solve_chunk(sizes: Sizes, options: Options, chunk: Chunk, interrupts: list[int]) -> Solved:
    solver = _solver(sizes, options)
    n_x, n_u, n_lam, horizon, _ = sizes
    count = len(chunk.u)
    ends = np.cumsum([n_u, n_lam, n_lam, n_x])
    constraint = np.zeros(horizon * (n_x + 2 * n_lam))
    result = Solved(
        np.zeros((count, horizon, n_x)), np.zeros((count, horizon, n_u)), np.zeros((count, horizon, n_lam)),
        no_words(count), np.zeros(count, np.int32), np.zeros(count),
    )  # fmt: skip
    free = np.full(n_x, np.inf)
    for i in range(count):
        started = time.perf_counter()
        positive = np.zeros(2 * n_lam)
        lower = np.tile(np.concatenate([chunk.u_min[i], positive, -free]), horizon)
        upper = np.tile(np.concatenate([chunk.u_max[i], positive + np.inf, free]), horizon)
        start = np.concatenate([chunk.u[i], chunk.lam[i], chunk.s[i], chunk.x[i]], axis=1).ravel()
        try:
            out = solver(x0=start, p=chunk.parameters[i], lbx=lower, ubx=upper, lbg=constraint, ubg=constraint)
            stats = solver.stats()
            z = np.asarray(out["x"]).reshape(horizon, -1)
            result.u[i], result.lam[i], _, result.x[i] = np.split(z, ends[:-1], axis=1)
            result.status[i] = stats["return_status"]
            result.iterations[i] = stats["iter_count"]
        except RuntimeError:
            result.u[i], result.lam[i], result.x[i] = chunk.u[i], chunk.lam[i], chunk.x[i]
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
