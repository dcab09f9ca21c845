"""Backend `batched`: difflcs's own solver, thousands of problems side by side on the CPU."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import check_number, check_positive_int, check_threads
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.mpc import kkt
from difflcs.mpc.backends.base import Backend, Result
from difflcs.mpc.problem import INPUTS, MPCProblem, array
from difflcs.mpc.solution import Primal
from difflcs.status import Status, all_converged, solved

# An iteration with row exchanges takes ten times as long, and what it can mend it mends soon.
_MAX_ITER_PIVOT = 60


@dataclass(frozen=True)
class BatchedResult(Result):
    """A `Result` that remembers how to differentiate it.

    Attributes:
        fragile: (batch,) bool: the elimination of λ needs row exchanges, because the skew part of F dominates.
    """

    fragile: Tensor | None = None


@dataclass(frozen=True)
class BatchedBackend(Backend):
    """Projected Newton on the problem with λ eliminated, one problem per SIMD lane (`difflcs/_native/mpc.cpp`).

    For F + Fᵀ ≻ 0 the relaxed complementarity determines λ as a smooth function of (x, u), which leaves a smooth
    optimal control problem with box bounds. A homotopy follows λ·s from `homotopy`·relaxation down to the relaxation;
    each step is a Riccati sweep with exact second derivatives. An element's result depends on that element alone, bit
    for bit on one instruction set. The problem has local optima: like IPOPT's, a solution is one of them.

    Every trajectory is judged after the solve by `difflcs.mpc.kkt.residual`, recomputed from the numbers that are
    returned (`difflcs/_native/certificate.hpp`); one that claims to be solved and is not becomes NUMERICAL. Ctrl-C ends
    a solve within a fraction of a second.

    Attributes:
        tol: projected gradient dJ/du at which a problem is solved, or 1e-12 of the terms that sum to it where that is
            more. It must also be below 1e-7 of its own scale, see `difflcs.mpc.kkt.residual`.
        max_iter: iteration limit of one solve. What fails is solved once more, cold and along a longer homotopy; and
            with row exchanges in the elimination of λ, where it failed for want of them.
        time_limit: seconds for one call, None for no limit. Elements not solved by then are MAX_ITER: those under way
            keep their iterate, those not begun stay at the actions of the guess or zero, with x = x0 and λ = 0.
        restarts: number of starts; the best optimum wins. 1 starts from the guess or from zero action, further ones
            from random actions inside the bounds, the same for every element.
        seed: seed of the random starts.
        homotopy: first relaxation as a multiple of the problem's, at a cold start; a guess starts at the relaxation.
        shrink: factor of the homotopy.
        threads: threads to use; torch's number if None.
    """

    name: ClassVar[str] = "batched"

    tol: float = 1e-8
    max_iter: int = 150
    time_limit: float | None = None
    restarts: int = 1
    seed: int = 0
    homotopy: float = 100.0
    shrink: float = 0.3
    threads: int | None = None

    def __post_init__(self) -> None:
        check_positive_int("max_iter", self.max_iter)
        check_positive_int("restarts", self.restarts)
        check_positive_int("seed", self.seed, minimum=0)
        check_threads(self.threads)
        if self.time_limit is not None:
            check_number("time_limit", self.time_limit, strict=True)
        check_number("tol", self.tol, strict=True)
        check_number("homotopy", self.homotopy, minimum=1.0)
        if check_number("shrink", self.shrink, strict=True) >= 1:
            check_number("1 - shrink", 1 - self.shrink, strict=True)

    def solve(self, problem: MPCProblem, guess: Primal | None) -> BatchedResult:
        """Solve every element from one start or several."""
        started = time.perf_counter()
        ends = started + (self.time_limit or np.inf)
        first = problem.relaxation * (self.homotopy if guess is None else 1.0)
        best = self._run(problem, guess, first, ends)
        if self.restarts > 1:
            best = self._from_other_starts(problem, best, ends)
        if not all_converged(best.status):
            best = self._second_chance(problem, best, ends)
            best.mend(problem)
        seconds = (time.perf_counter() - started) / max(problem.batch, 1)
        return BatchedResult(
            Primal(best.x, best.u, best.lam, best.mu),
            best.status,
            best.iterations,
            best.residual,
            torch.full((problem.batch,), seconds, dtype=torch.float64),
            objective=best.objective,
            fragile=best.fragile,
        )

    def _from_other_starts(self, problem: MPCProblem, best: _Found, ends: float) -> _Found:
        generator = np.random.default_rng(self.seed)
        for _ in range(1, self.restarts):
            # The homotopy of a cold start leads most starts to one optimum; a short one keeps them apart.
            draw = torch.from_numpy(generator.random((problem.horizon, problem.n_u)))
            low, high = _span(problem, best)
            start = (low + draw * (high - low)).expand(problem.batch, -1, -1)
            if time.perf_counter() < ends:
                again = self._run(problem, start, problem.relaxation * min(self.homotopy, 10.0), ends)
                best = best.better(again)
        return best

    def vjp(
        self, problem: MPCProblem, result: Result, grads: tuple[Tensor, Tensor, Tensor, Tensor], solved: Tensor
    ) -> dict[str, Tensor]:
        """The adjoint sweep in native code; the same numbers as `difflcs.mpc.kkt.vjp`."""
        assert isinstance(result, BatchedResult)
        fragile = torch.zeros_like(solved) if result.fragile is None else result.fragile & solved
        gradients = self._vjp(problem, result, grads, solved & ~fragile, pivot=False)
        if bool(fragile.any()):
            exchanged = self._vjp(problem, result, grads, fragile, pivot=True)
            gradients = {name: value + exchanged[name] for name, value in gradients.items()}
        return gradients

    def _vjp(
        self, problem: MPCProblem, result: Result, grads: tuple[Tensor, ...], solved: Tensor, pivot: bool
    ) -> dict[str, Tensor]:
        gradients = {name: torch.empty_like(getattr(problem, name)) for name in INPUTS}
        x, u, lam, mu, x_bar, u_bar, lam_bar, objective_bar = (array(v) for v in (*result.primal, *grads))
        _kernels.vjp_mpc(
            inputs=problem.arrays,
            horizon=problem.horizon,
            relaxation=problem.relaxation,
            barrier=problem.barrier,
            x=x,
            u=u,
            lam=lam,
            mu=mu,
            x_bar=x_bar,
            u_bar=u_bar,
            lam_bar=lam_bar,
            objective_bar=objective_bar,
            solved=solved.to(torch.int8).numpy(),
            pivot=pivot,
            threads=self._threads(),
            gradients=[gradient.numpy() for gradient in gradients.values()],
        )
        return gradients

    def _second_chance(self, problem: MPCProblem, found: _Found, ends: float) -> _Found:
        """Solve the elements that failed (one in a thousand) again, cold and along a longer homotopy.

        Then, where the numbers broke down and not the patience, with row exchanges in the elimination of λ.
        """
        for pivot in (False, True):
            failed = ~found.solved
            if pivot:
                failed &= (found.status == Status.NUMERICAL) | found.fragile
            index = torch.nonzero(failed).squeeze(-1)
            if not len(index) or time.perf_counter() >= ends:
                break
            part = problem.select(index)
            again = self._run(part, None, problem.relaxation * 10 * self.homotopy, ends, pivot=pivot)
            found.replace(index, found.select(index).better(again))
        return found

    def _threads(self) -> int:
        return self.threads or torch.get_num_threads()

    def _run(
        self,
        problem: MPCProblem,
        start: Primal | Tensor | None,
        first: float,
        ends: float,
        pivot: bool = False,
    ) -> _Found:
        """One run of the kernel from a guess, from actions alone, or from zero actions."""
        batch, horizon = problem.batch, problem.horizon
        guess = start if isinstance(start, Primal) else None
        u = start.u if isinstance(start, Primal) else start
        outputs = {
            "x": np.empty((batch, horizon + 1, problem.n_x)),
            "u": np.empty((batch, horizon, problem.n_u)),
            "lam": np.empty((batch, horizon, problem.n_lam)),
            "mu": np.empty((batch, horizon + 1, problem.n_c)),
            "objective": np.empty(batch),
            "residual": np.empty(batch),
            "status": np.empty(batch, np.int8),
            "fragile": np.empty(batch, np.int8),
            "iterations": np.empty(batch, np.int32),
        }
        _kernels.solve_mpc(
            inputs=problem.arrays,
            horizon=horizon,
            relaxation=problem.relaxation,
            barrier=problem.barrier,
            u_start=None if u is None else array(u),
            lam_start=None if guess is None else array(guess.lam),
            mu_start=None if guess is None else array(guess.mu),
            first_relaxation=first,
            shrink=self.shrink,
            tol=self.tol,
            max_iter=min(self.max_iter, _MAX_ITER_PIVOT) if pivot else self.max_iter,
            certified=kkt.CERTIFIED,
            pivot=pivot,
            time_limit=max(ends - time.perf_counter(), 0.0),
            threads=self._threads(),
            **outputs,
        )
        found = _Found(**{name: torch.from_numpy(value) for name, value in outputs.items()})
        found.fragile = found.fragile.view(torch.bool)  # zeros and ones
        return found


@dataclass
class _Found:
    """What one run of the kernel returns, by the names of its arguments."""

    x: Tensor
    u: Tensor
    lam: Tensor
    mu: Tensor
    objective: Tensor
    residual: Tensor
    status: Tensor
    fragile: Tensor
    iterations: Tensor

    def tensors(self) -> dict[str, Tensor]:
        return dict(vars(self))

    @property
    def solved(self) -> Tensor:
        return solved(self.status)

    def select(self, index: Tensor) -> _Found:
        return _Found(**{name: value[index] for name, value in self.tensors().items()})

    def replace(self, index: Tensor, part: _Found) -> None:
        for name, value in self.tensors().items():
            value[index] = part.tensors()[name]

    def better(self, other: _Found) -> _Found:
        """Per element the solved trajectory with the lower objective; iterations add up."""
        take = other.solved & (~self.solved | (other.objective < self.objective))
        theirs = other.tensors()
        chosen = {
            name: torch.where(take.reshape(-1, *[1] * (value.ndim - 1)), theirs[name], value)
            for name, value in self.tensors().items()
        }
        return _Found(**{**chosen, "iterations": self.iterations + other.iterations})

    def mend(self, problem: MPCProblem) -> None:
        """Finite numbers for what failed, actions inside the bounds."""
        failed = torch.nonzero(~self.solved).squeeze(-1)
        if not len(failed):
            return
        self.u[failed] = problem.select(failed).clip(torch.nan_to_num(self.u[failed], posinf=0.0, neginf=0.0))
        for value in (self.x, self.lam, self.mu):
            value[failed] = torch.nan_to_num(value[failed])
        self.residual = self.residual.clamp_max(torch.finfo(torch.float64).max)


def _span(problem: MPCProblem, found: _Found) -> tuple[Tensor, Tensor]:
    """Where random starts lie: within the bounds; where there are none, as far out as the actions found are large."""
    low, high = problem.bounds()
    if bool(torch.isfinite(low).all()) and bool(torch.isfinite(high).all()):
        return low, high
    reach = 1.0 + found.u.abs().nan_to_num(posinf=0.0).amax((1, 2), keepdim=True)
    return torch.maximum(low, -reach), torch.minimum(high, reach)
