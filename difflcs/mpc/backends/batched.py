"""Backend `batched`: difflcs's own solver, thousands of problems side by side on the CPU."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import check_number, check_positive_int
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.mpc.backends.base import Backend, Result
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.mpc.solution import Primal
from difflcs.status import Status


@dataclass(frozen=True)
class BatchedBackend(Backend):
    """Projected Newton on the problem with λ eliminated, one problem per SIMD lane (`difflcs/_native/mpc.cpp`).

    For F + Fᵀ ≻ 0 the relaxed complementarity determines λ as a smooth function of (x, u), which leaves a smooth
    optimal control problem with box bounds. A homotopy follows λ·s from `homotopy`·relaxation down to the relaxation;
    each step is a Riccati sweep with exact second derivatives. An element's result depends on that element alone, bit
    for bit on one instruction set. The problem has local optima: like IPOPT's, a solution is one of them.

    Attributes:
        tol: projected gradient dJ/du at which a problem is solved, or 1e-12 of the terms that sum to it where that is
            more.
        max_iter: iteration limit of one solve. What fails is solved once more, cold and along a longer homotopy.
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
    restarts: int = 1
    seed: int = 0
    homotopy: float = 100.0
    shrink: float = 0.3
    threads: int | None = None

    def __post_init__(self) -> None:
        check_positive_int("max_iter", self.max_iter)
        check_positive_int("restarts", self.restarts)
        check_positive_int("seed", self.seed, minimum=0)
        if self.threads is not None:
            check_positive_int("threads", self.threads)
        check_number("tol", self.tol, strict=True)
        check_number("homotopy", self.homotopy, minimum=1.0)
        if check_number("shrink", self.shrink, strict=True) >= 1:
            check_number("1 - shrink", 1 - self.shrink, strict=True)

    def solve(self, problem: MPCProblem, guess: Primal | None) -> Result:
        """Solve every element from one start or several."""
        started = time.perf_counter()
        first = problem.relaxation * (self.homotopy if guess is None else 1.0)
        best = self._run(problem, guess.u if guess else None, guess.lam if guess else None, first)
        generator = np.random.default_rng(self.seed)
        for _ in range(1, self.restarts):
            # The homotopy of a cold start leads most starts to one optimum; a short one keeps them apart.
            draw = torch.from_numpy(generator.random((problem.horizon, problem.n_u)))
            low, high = (v.unsqueeze(-2) for v in (problem.u_min, problem.u_max))
            start = (low + draw * (high - low)).expand(problem.batch, -1, -1)
            best = _better(best, self._run(problem, start, None, problem.relaxation * min(self.homotopy, 10.0)))
        best = self._second_chance(problem, best)
        x, u, lam, _, status, iterations, residual = best
        seconds = torch.full((problem.batch,), (time.perf_counter() - started) / max(problem.batch, 1))
        return Result(Primal(x, u, lam), status, iterations, residual, seconds.double())

    def vjp(
        self, problem: MPCProblem, result: Result, grads: tuple[Tensor, Tensor, Tensor, Tensor], solved: Tensor
    ) -> dict[str, Tensor]:
        """The adjoint sweep in native code; the same numbers as `difflcs.mpc.kkt.vjp`."""
        gradients = {name: torch.empty_like(getattr(problem, name)) for name in INPUTS}
        x, u, lam, x_bar, u_bar, lam_bar, objective_bar = (_array(v) for v in (*result.primal, *grads))
        _kernels.vjp_mpc(
            inputs=_inputs(problem),
            horizon=problem.horizon,
            relaxation=problem.relaxation,
            barrier=problem.barrier,
            x=x,
            u=u,
            lam=lam,
            x_bar=x_bar,
            u_bar=u_bar,
            lam_bar=lam_bar,
            objective_bar=objective_bar,
            solved=solved.to(torch.int8).numpy(),
            threads=self._threads(),
            gradients=[gradient.numpy() for gradient in gradients.values()],
        )
        return gradients

    def _second_chance(self, problem: MPCProblem, found: list[Tensor]) -> list[Tensor]:
        """Solve the elements that failed (one in a thousand) once more, cold and along a longer homotopy."""
        failed = torch.nonzero(~_solved(found)).squeeze(-1)
        if not len(failed):
            return found
        again = self._run(problem.select(failed), None, None, problem.relaxation * 10 * self.homotopy)
        chosen = _better([v[failed] for v in found], again)
        for whole, part in zip(found, chosen, strict=True):
            whole[failed] = part
        return found

    def _threads(self) -> int:
        return self.threads or torch.get_num_threads()

    def _run(self, problem: MPCProblem, u: Tensor | None, lam: Tensor | None, first: float) -> list[Tensor]:
        batch, horizon = problem.batch, problem.horizon
        out = [
            torch.empty(batch, horizon + 1, problem.n_x, dtype=torch.float64),
            torch.empty(batch, horizon, problem.n_u, dtype=torch.float64),
            torch.empty(batch, horizon, problem.n_lam, dtype=torch.float64),
            torch.empty(batch, dtype=torch.float64),
            torch.empty(batch, dtype=torch.int8),
            torch.empty(batch, dtype=torch.int32),
            torch.empty(batch, dtype=torch.float64),
        ]
        names = ("x", "u", "lam", "objective", "status", "iterations", "residual")
        arrays = {name: value.numpy() for name, value in zip(names, out, strict=True)}
        _kernels.solve_mpc(
            inputs=_inputs(problem),
            horizon=horizon,
            relaxation=problem.relaxation,
            barrier=problem.barrier,
            u_start=None if u is None else _array(u),
            lam_start=None if lam is None else _array(lam),
            first_relaxation=first,
            shrink=self.shrink,
            tol=self.tol,
            max_iter=self.max_iter,
            threads=self._threads(),
            **arrays,  # pyright: ignore[reportArgumentType]
        )
        # Failed elements: finite numbers inside the bounds.
        for value in (*out[:4], out[6]):
            torch.nan_to_num_(value, posinf=torch.finfo(value.dtype).max, neginf=0.0)
        return out


def _inputs(problem: MPCProblem) -> list[np.ndarray]:
    return [_array(getattr(problem, name)) for name in INPUTS]


def _array(value: Tensor) -> np.ndarray:
    return value.contiguous().numpy()


def _solved(found: Sequence[Tensor]) -> Tensor:
    return (found[4] == Status.CONVERGED) | (found[4] == Status.DEGENERATE)


def _better(a: Sequence[Tensor], b: Sequence[Tensor]) -> list[Tensor]:
    """Per element the solved trajectory with the lower objective."""
    solved_a, solved_b = _solved(a), _solved(b)
    take_b = solved_b & (~solved_a | (b[3] < a[3]))
    chosen = [torch.where(take_b.reshape(-1, *[1] * (v.ndim - 1)), w, v) for v, w in zip(a, b, strict=True)]
    chosen[5] = a[5] + b[5]
    return chosen
