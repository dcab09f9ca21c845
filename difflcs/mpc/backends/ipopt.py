"""Backend `ipopt`: the reference, CasADi + IPOPT in worker processes."""

from __future__ import annotations

import atexit
import math
import os
import socket
import subprocess
import sys
import threading
from collections import deque
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch

from difflcs._checks import check_number, check_positive_int, check_threads, make_plain, usable_cpus
from difflcs.mpc import conditions, kkt
from difflcs.mpc.backends.base import Backend, Result, certify
from difflcs.mpc.problem import INPUTS, MAY_BE_INFINITE, MPCProblem
from difflcs.mpc.solution import Primal
from difflcs.status import Status

if TYPE_CHECKING:
    from difflcs.mpc.backends._ipopt_worker import Chunk, Options, Sizes, Solved

# Return status of IPOPT → ours; anything else is NUMERICAL.
_STATUS = {
    "Solve_Succeeded": Status.CONVERGED,
    "Solved_To_Acceptable_Level": Status.CONVERGED,  # these are judged by the residual
    "Search_Direction_Becomes_Too_Small": Status.CONVERGED,
    "Maximum_Iterations_Exceeded": Status.MAX_ITER,
    "Maximum_CpuTime_Exceeded": Status.MAX_ITER,
    "Maximum_WallTime_Exceeded": Status.MAX_ITER,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
}


@dataclass(frozen=True)
class IpoptBackend(Backend):
    """Direct transcription over x, u, λ and s, solved by IPOPT (Posa et al.; Wächter & Biegler).

    Every element is a separate IPOPT run; batches go to worker processes, which start at the first batch and stay.
    Solutions are polished by Newton steps with the active bounds and constraints held (`difflcs.mpc.kkt.polish`).

    Where an element with hard constraints fails, a second run minimises the sum of their squared violations alone. What
    still violates them is INFEASIBLE, and this plan is what it returns.

    Attributes:
        tol: IPOPT's tolerance.
        max_iter: iteration limit of one solve.
        workers: processes for a batch; the number of CPUs available if None. 1 solves in this process.
        residual_tol: largest KKT residual that counts as converged.
        start: value of λ and s at a cold start. 0.05 takes fewer iterations than λ = s = 1 and finds better optima.
            The states start at x0: a rollout is a worse start where the system is unstable.
        second_start: the same of a second cold start, with IPOPT's own first barrier, 0.1; the better plan is kept.
            None: one start, in half the time; its plans on pushing models cost up to 1 % more than those of λ = s = 1.
        mu_init: IPOPT's first barrier parameter at a cold start.
        mu_init_warm: the same with a guess.
    """

    name: ClassVar[str] = "ipopt"
    requires: ClassVar[tuple[str, ...]] = ("casadi",)
    install: ClassVar[str] = "pip install casadi"

    tol: float = 1e-8
    max_iter: int = 300
    workers: int | None = None
    residual_tol: float = 1e-6
    start: float = 0.05
    second_start: float | None = 1.0
    mu_init: float = 1e-4
    mu_init_warm: float = 1e-6

    def __post_init__(self) -> None:
        make_plain(self)
        check_positive_int("max_iter", self.max_iter)
        check_threads(self.workers, "workers")
        for name in ("tol", "residual_tol", "start", "mu_init", "mu_init_warm"):
            check_number(name, getattr(self, name), strict=True)
        if self.second_start is not None:
            check_number("second_start", self.second_start, strict=True)

    def solve(self, problem: MPCProblem, guess: Primal | None) -> Result:
        """Solve every element; a failure, even a crash of a worker, stays with its element."""
        run = self._cold(problem) if guess is None else self._run(problem, guess, warm=True)
        if problem.n_c and bool(torch.isinf(problem.price).any()):
            failed = torch.nonzero(run.status != Status.CONVERGED).squeeze(-1)
            if len(failed):
                part = problem.select(failed)
                run.replace(failed, self._least_violation(part, run.select(failed)))
        primal = Primal(run.x, run.u, run.lam, run.mu)
        usable = (run.status == Status.CONVERGED) & torch.isfinite(run.u).all(-1).all(-1)
        index = torch.nonzero(usable).squeeze(-1)
        if len(index):
            polished = kkt.polish(problem.select(index), Primal(*(v[index] for v in primal)))
            for whole, part in zip(primal, polished, strict=True):
                whole[index] = part
        return certify(problem, primal, run.status, run.iterations, run.seconds, self.residual_tol)

    def _cold(self, problem: MPCProblem) -> _Run:
        """Solve from both starts; keep the better plan, and the sum of iterations and seconds."""
        run = self._run(problem, None, warm=False)
        if self.second_start is None or problem.n_lam == 0:
            return run
        other = replace(self, start=self.second_start, mu_init=_MU_INIT)._run(problem, None, warm=False)
        spent = run.iterations + other.iterations, run.seconds + other.seconds
        cost, second = (
            torch.where(r.status == Status.CONVERGED, problem.objective(r.x, r.u), torch.inf) for r in (run, other)
        )
        better = torch.nonzero(second < cost).squeeze(-1)
        run.replace(better, other.select(better))
        run.iterations, run.seconds = spent
        return run

    def _run(self, problem: MPCProblem, guess: Primal | None, warm: bool, elastic: bool = False) -> _Run:
        """Run IPOPT once per element."""
        from difflcs.mpc.backends._ipopt_worker import Options, Sizes, solve_chunk

        P = problem
        sizes = Sizes(P.n_x, P.n_u, P.n_lam, P.n_c, P.horizon, parameters(P))
        slack = P.n_c > 0 and (elastic or bool(torch.isfinite(P.price).any()))
        mu_init = self.mu_init_warm if warm else self.mu_init
        options = Options(self.tol, self.max_iter, mu_init, P.barrier > 0, slack, elastic)
        chunk = self._start(problem, guess, elastic)
        workers = min(self.workers or usable_cpus(), problem.batch)
        if workers <= 1:
            with _locals.here:
                solved = solve_chunk(sizes, options, chunk)
        else:
            solved = _locals.pool.solve(sizes, options, chunk, workers)
        words = [_STATUS.get(str(word), Status.NUMERICAL) for word in solved.status]
        x, u, lam, mu = (torch.from_numpy(v) for v in (solved.x, solved.u, solved.lam, solved.mu))
        return _Run(
            torch.cat([problem.x0.unsqueeze(1), x], 1),
            u,
            lam,
            conditions.within_prices(problem, mu),
            torch.tensor(words, dtype=torch.int8),
            torch.from_numpy(solved.iterations),
            torch.from_numpy(solved.seconds),
        )

    def _least_violation(self, problem: MPCProblem, failed: _Run) -> _Run:
        """Say whether problems that failed can be solved at all: minimise the squared violations alone.

        A problem that stays violated is INFEASIBLE and keeps the plan with the least violation; one that is nearly met
        is solved once more from there.
        """
        start = Primal(failed.x, torch.nan_to_num(failed.u, posinf=0.0, neginf=0.0), failed.lam, failed.mu)
        run = self._run(problem, start, warm=False, elastic=True)
        u = problem.clip(torch.nan_to_num(run.u, posinf=0.0, neginf=0.0))
        x, lam = problem.rollout(u)
        plan = Primal(x, u, lam, problem.no_multipliers())
        excess = conditions.excess(problem, plan)
        sure = run.status == Status.CONVERGED
        spent = failed.iterations + run.iterations, failed.seconds + run.seconds
        status = torch.where(sure & (excess > self.residual_tol), int(Status.INFEASIBLE), failed.status)
        # IPOPT reported it infeasible, but it is not.
        mistaken = sure & (excess <= self.residual_tol) & (failed.status == Status.INFEASIBLE)
        status = torch.where(mistaken, int(Status.NUMERICAL), status).to(torch.int8)
        taken = (sure & (status == Status.INFEASIBLE))[:, None, None]
        kept = Primal(*(torch.where(taken, a, b) for a, b in zip(plan, start, strict=True)))
        result = _Run(kept.x, kept.u, kept.lam, kept.mu, status, *spent)
        again = torch.nonzero(sure & (excess <= _NEARLY)).squeeze(-1)
        if len(again):
            part = problem.select(again)
            second = self._run(part, Primal(*(v[again] for v in plan)), warm=True)
            better = again[second.status == Status.CONVERGED]
            second = second.select(second.status == Status.CONVERGED)
            second.iterations += result.iterations[better]
            second.seconds += result.seconds[better]
            result.replace(better, second)
        return result

    def _start(self, problem: MPCProblem, guess: Primal | None, elastic: bool) -> Chunk:
        from difflcs.mpc.backends._ipopt_worker import Chunk

        batch, horizon = problem.batch, problem.horizon
        flat = []
        for name, rows, columns, copies in parameters(problem):
            value = torch.as_tensor(getattr(problem, name), dtype=torch.float64)
            # Infinite numbers enter as bounds of variables and rows.
            value = (
                torch.where(torch.isinf(value), torch.zeros_like(value), value) if name in MAY_BE_INFINITE else value
            )
            shared = value.ndim == 0 or problem.shared(name)
            size = rows * columns * copies
            flat.append(value.reshape(1 if shared else batch, size).expand(batch, size))
        if guess is None:
            x = problem.x0.unsqueeze(1).expand(batch, horizon + 1, -1)
            u = problem.start(torch.zeros(batch, horizon, problem.n_u, dtype=torch.float64))
            lam = s = torch.full((batch, horizon, problem.n_lam), self.start, dtype=torch.float64)
        else:
            # The guess's actions decide; the rest follows from them, so that a shifted guess starts feasible.
            u = problem.start(guess.u)
            x, lam = problem.rollout(u)
            s = problem.relaxation / lam.clamp_min(1e-300)
        u_min, u_max = (v.expand(batch, horizon, problem.n_u) for v in problem.bounds())
        hard = torch.isinf(conditions.prices(problem))
        c = problem.constraints(x, u)
        none = torch.isinf(c) if not elastic else torch.isinf(c) | ~hard
        row_max, v_max = (torch.where(v, torch.inf, torch.zeros_like(c)) for v in (none, hard if elastic else ~hard))
        arrays = torch.cat(flat, 1), u_min, u_max, row_max, v_max, x[:, 1:], u, lam, s, c.clamp_min(0.0)
        return Chunk(*(np.ascontiguousarray(v.numpy()) for v in arrays))


_MU_INIT = 0.1  # IPOPT's own
# Violation, in parts of a row's unit, up to which a problem is tried again from the plan with the least violation: at
# the boundary of feasibility IPOPT's violation is accurate to the square root of its tolerance.
_NEARLY = 1e-3


@dataclass
class _Run:
    """Result of one IPOPT run of each element."""

    x: torch.Tensor
    u: torch.Tensor
    lam: torch.Tensor
    mu: torch.Tensor
    status: torch.Tensor
    iterations: torch.Tensor
    seconds: torch.Tensor

    def select(self, index: torch.Tensor) -> _Run:
        return _Run(*(v[index] for v in vars(self).values()))

    def replace(self, index: torch.Tensor, part: _Run) -> None:
        for whole, new in zip(vars(self).values(), vars(part).values(), strict=True):
            whole[index] = new


def parameters(problem: MPCProblem) -> tuple[tuple[str, int, int, int], ...]:
    """List name, rows, columns and copies of the program's parameters: the problem's inputs and two numbers.

    An input that varies by stage has a copy for each.
    """
    table = [(name, problem.shape(name), problem.stages(name) if problem.by_stage(name) else 1) for name in INPUTS]
    table += [("relaxation", (1,), 1), ("barrier", (1,), 1)]
    return tuple((name, shape[0], math.prod(shape[1:]), copies) for name, shape, copies in table)


class _Worker:
    """One worker process and the connection to it."""

    def __init__(self):
        ours, theirs = socket.socketpair()
        script = os.path.join(os.path.dirname(__file__), "_ipopt_worker.py")
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        # -P: the script's folder stays off sys.path, where its neighbours would shadow other packages.
        command = [sys.executable, "-P", script, str(theirs.fileno())]
        self.process = subprocess.Popen(
            command, pass_fds=[theirs.fileno()], env=environment, stdin=subprocess.DEVNULL, close_fds=True
        )
        theirs.close()
        self.connection = Connection(ours.detach())
        self.task: np.ndarray = np.empty(0, int)

    def close(self) -> None:
        self.connection.close()
        self.process.kill()
        self.process.wait()


class _Pool:
    """Worker processes that persist between calls and are replaced when they crash."""

    def __init__(self):
        self.lock = threading.Lock()
        self.workers: list[_Worker] = []

    def close(self) -> None:
        while self.workers:
            self.workers.pop().close()

    def solve(self, sizes: Sizes, options: Options, chunk: Chunk, count: int) -> Solved:
        """Solve a batch on `count` workers; results are in the order of the batch."""
        with self.lock:
            try:
                return self._solve(sizes, options, chunk, count)
            except BaseException:
                self.close()  # a reply may be under way: start afresh next time
                raise

    def _solve(self, sizes: Sizes, options: Options, chunk: Chunk, count: int) -> Solved:
        from difflcs.mpc.backends._ipopt_worker import Solved

        batch = len(chunk.u)
        while len(self.workers) < count:
            self.workers.append(_Worker())
        # Four tasks per worker balance the load; a solve costs milliseconds, a message some 0.1 ms.
        todo = deque(np.array_split(np.arange(batch), min(batch, 4 * count)))
        result = Solved.start(chunk)

        def give(slot: int) -> None:
            self.workers[slot].task = todo.popleft()
            part = tuple(v[self.workers[slot].task] for v in chunk)
            self.workers[slot].connection.send((tuple(sizes), tuple(options), part))

        busy: dict[Connection, int] = {}

        def feed(slot: int) -> None:
            while todo:
                try:
                    give(slot)
                except (BrokenPipeError, ConnectionResetError):
                    todo.appendleft(self.workers[slot].task)
                    self._replace(slot)
                    continue
                busy[self.workers[slot].connection] = slot
                return

        for slot in range(count):
            feed(slot)
        while busy:
            for connection in wait(list(busy)):
                assert isinstance(connection, Connection)
                slot = busy.pop(connection)
                task = self.workers[slot].task
                try:
                    for whole, part in zip(result, connection.recv(), strict=True):
                        whole[task] = part
                except (EOFError, ConnectionResetError):
                    # The worker died. A single problem is to blame and stays NUMERICAL; several are tried one by one.
                    self._replace(slot)
                    if len(task) > 1:
                        todo.extend(np.array_split(task, len(task)))
                feed(slot)
        return result

    def _replace(self, slot: int) -> None:
        self.workers[slot].close()
        self.workers[slot] = _Worker()


def worker_pids() -> tuple[int, ...]:
    """List the process ids of this process's workers, in their order of use."""
    return tuple(worker.process.pid for worker in _locals.pool.workers)


class _Locals:
    """State of one process: a forked child must neither talk to its parent's workers nor hold its locks."""

    def __init__(self):
        self.here = threading.Lock()  # IPOPT in several threads of one process crashes
        self.pool = _Pool()


_locals = _Locals()
atexit.register(lambda: _locals.pool.close())
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_locals.__init__)
