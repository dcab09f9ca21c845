"""Backend `batched`: difflcs's own solver, thousands of problems side by side on the CPU."""

import time
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import check_choice, check_number, check_positive_int, check_threads, make_plain
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.mpc import conditions, kkt
from difflcs.mpc.backends.base import Backend, Result
from difflcs.mpc.problem import INPUTS, MPCProblem, array
from difflcs.mpc.solution import Primal
from difflcs.status import Status, solved

Effort = Literal["fast", "default", "best"]


class Starts(NamedTuple):
    """Starts of an element.

    Attributes:
        starts: the number of all.
        groups: in which they are tried one after the other.
        sure: an element has no further group once so many starts have found its best plan.
        seeks: rounds in vain that end the search for other contacts; none where `sure` starts, four at least, have
            found the plan, more where starts that make other contacts end at much dearer plans.
    """

    starts: int
    groups: int
    sure: int
    seeks: int = 0


_STARTS = {
    "fast": (Starts(1, 1, 1), Starts(3, 1, 1)),
    "default": (Starts(4, 1, 4, 1), Starts(32, 2, 1, 1)),
    "best": (Starts(64, 4, 4), Starts(96, 6, 96, 24)),
}
# Plans that can make many contacts, horizon × n_lam, in all or for each action, or are long, get the second of these
# numbers: with four starts the worst costs 2.7 times the best on a row of four carts, 45 % more on a cart-pole, H 30.
_MANY_CONTACTS, _MANY_PER_ACTION, _LONG_HORIZON = 100, 20, 40
# From so many forces, or states and actions, on problems are solved one by one. Each start costs as much as the first
# there, and of 400 plans of a hand 32 starts leave a mean gap of .008 %, these .004 %.
_LARGE_FORCES, _LARGE, _STARTS_LARGE = 40, 48, Starts(10, 1, 1)
_GROUP = 16  # so many starts, or more, make a group where their number is given


@dataclass(frozen=True)
class BatchedResult(Result):
    """A `Result` with what its gradient needs.

    Attributes:
        fragile: (batch,) bool: the elimination of λ needs row exchanges, because the skew part of F dominates.
    """

    fragile: Tensor | None = None


_HUGE = np.finfo(np.float64).max  # the objective of an element that was not begun
_FLAT = (1e-2, 1e-6)  # weights of actions beside a price of one: they make the plan of least violations unique


@dataclass(frozen=True)
class BatchedBackend(Backend):
    """Projected Newton on the problem with λ eliminated, one problem per SIMD lane (`difflcs/_native/mpc.cpp`).

    For F + Fᵀ ≻ 0 the relaxed complementarity determines λ as a smooth function of (x, u), which leaves a smooth
    optimal control problem with box bounds. A homotopy follows λ·s down to the relaxation; each step is a Riccati sweep
    with exact second derivatives. An element's result depends on that element alone, bit for bit on one instruction
    set.

    The problem has local optima. `effort` says how many starts are tried: the feedback law of the plant without
    contact, along a long homotopy and a short one; the largest actions forth and then back, and back and then forth,
    which find contacts that are far; random pulses, a push and a brake of each action, or swings to and fro. Starts are
    compared after a few steps at the relaxation, or at 1e-5 if that is softer, and only those that may still win are
    solved to the end; at a harder relaxation the plan that is found is solved once more. Half of the starts, eight for
    each action, are enough where these agree. A local search follows, unless they agree: the best plan or a
    part of it is shifted in time, pushed, or solved again from softer contact, until that finds nothing better, longer
    for long plans. Large problems (n_lam of 40 or more, or n_x + n_u of 48) are solved one by one, and their starts are
    not shared out on lanes: "default" has ten, six that agree are enough, and one round in vain ends the local search.
    Of four to seven starts only four of these are tried. Where few starts have found the best plan, another
    group is searched so, and "default", as "best" where many contacts are possible, seeks contacts round it: the
    actions of a start close or open one gap for some stages as far as they can; most such starts begin softer.

    Every trajectory is judged after the solve by `difflcs.mpc.kkt.residual`, recomputed from the numbers that are
    returned (`difflcs/_native/certificate.hpp`); one that claims to be solved and is not becomes NUMERICAL. Ctrl-C ends
    a solve within a fraction of a second.

    Attributes:
        effort: "fast", one start; "default", four, and one round of eight in vain that seeks contacts, up to six where
            other contacts cost much more; "best", up to four groups of sixteen; 3, 2 × 16 with as many rounds (10 of
            large problems below H 40) and 6 × 16 with 24 where horizon × n_lam is 100 or more, or 20 times n_u, or the
            horizon 40, as such plans have many optima. A guess is the first start, and the only one but for "best".
            Without contact (n_lam = 0) one start is enough.
        restarts: number of starts, whatever the effort; None: that of the effort. From four on with a local search,
            from 32 on in groups of sixteen until five end with the same plan.
        tol: projected gradient dJ/du at which a problem is solved, or 1e-12 of the terms that sum to it if that is
            more. It must also be below 1e-7 of its scale, see `difflcs.mpc.kkt.residual`.
        max_iter: iteration limit of one solve. An element that fails is solved once more, cold and along a longer
            homotopy; and with row exchanges in the elimination of λ if it failed for lack of them.
        time_limit: seconds for one call, of a layer from its beginning to its end; None for no limit. Elements not
            solved by then are MAX_ITER: those under way keep their best iterate, executed at the relaxation; those not
            begun stay at the actions of the guess or zero, with x = x0 and λ = 0.
        seed: seed of the random starts, which are the same for every element.
        homotopy: λ·s at which a cold start begins, as a multiple of the relaxation; None: the square of the mean gap
            of the contacts, in the units in which F has a unit diagonal. A guess starts at the relaxation.
        shrink: factor of the homotopy; large problems take its square.
        threads: threads to use; torch's number if None.
    """

    name: ClassVar[str] = "batched"

    effort: Effort = "default"
    restarts: int | None = None
    tol: float = 1e-8
    max_iter: int = 1000
    time_limit: float | None = None
    seed: int = 0
    homotopy: float | None = None
    shrink: float = 0.3
    threads: int | None = None

    def __post_init__(self) -> None:
        make_plain(self)
        check_choice("effort", self.effort, tuple(_STARTS))
        check_positive_int("max_iter", self.max_iter)
        if self.restarts is not None:
            check_positive_int("restarts", self.restarts)
        check_positive_int("seed", self.seed, minimum=0)
        check_threads(self.threads)
        if self.time_limit is not None:
            check_number("time_limit", self.time_limit, strict=True)
        check_number("tol", self.tol, strict=True)
        if self.homotopy is not None:
            check_number("homotopy", self.homotopy, minimum=1.0)
        if check_number("shrink", self.shrink, strict=True) >= 1:
            check_number("1 - shrink", 1 - self.shrink, strict=True)

    def after(self, seconds: float) -> "BatchedBackend":
        """See `Backend`."""
        limit = self.time_limit
        return self if limit is None else replace(self, time_limit=max(limit - seconds, 1e-9))

    def solve(self, problem: MPCProblem, guess: Primal | None) -> BatchedResult:
        """Solve every element from one start or several."""
        started = time.perf_counter()
        batch, horizon = problem.batch, problem.horizon
        outputs = {  # NumPy makes empty arrays ten times faster than torch
            "x": np.empty((batch, horizon + 1, problem.n_x)),
            "u": np.empty((batch, horizon, problem.n_u)),
            "lam": np.empty((batch, horizon, problem.n_lam)),
            "mu": np.empty((batch, horizon + 1, problem.n_c)),
            "objective": np.empty(batch),
            "residual": np.empty(batch),
            "status": np.empty(batch, np.int8),
            "fragile": np.empty(batch, np.bool_),
            "iterations": np.empty(batch, np.int32),
        }
        # Done before the kernel, which evicts Python's code and data from the cache.
        tensors, seconds = {name: torch.from_numpy(value) for name, value in outputs.items()}, np.empty(batch)
        result = BatchedResult(
            Primal(tensors["x"], tensors["u"], tensors["lam"], tensors["mu"]),
            tensors["status"],
            tensors["iterations"],
            tensors["residual"],
            torch.from_numpy(seconds),
            objective=tensors["objective"],
            fragile=tensors["fragile"],
        )
        outputs["fragile"] = outputs["fragile"].view(np.int8)  # zeros and ones
        vars(result)["all_converged"] = _kernels.solve_mpc(  # so that nobody needs to count
            inputs=problem.arrays,
            horizon=horizon,
            relaxation=problem.relaxation,
            barrier=problem.barrier,
            u_start=None if guess is None else array(guess.u),
            lam_start=None if guess is None else array(guess.lam),
            mu_start=None if guess is None else array(guess.mu),
            **self.starts(problem, guess is not None)._asdict(),
            seed=self.seed,
            homotopy=self.homotopy or 0.0,
            shrink=self.shrink,
            tol=self.tol,
            max_iter=self.max_iter,
            certified=kkt.CERTIFIED,
            time_limit=np.inf if self.time_limit is None else self.time_limit - (time.perf_counter() - started),
            threads=self._threads(),
            **outputs,  # pyright: ignore[reportArgumentType]
        )
        seconds.fill((time.perf_counter() - started) / max(batch, 1))
        if not result.all_converged:
            if not _kernels.all_finite([outputs[name] for name in ("x", "u", "lam", "mu")]):
                self._make_finite(problem, result.primal, result.status)
            if problem.n_c:
                self._confirm_infeasible(problem, result.primal, result.status, started)
            else:  # also what ran out of time has the cost of its plan
                known = (outputs["status"] == Status.CONVERGED) | (outputs["status"] == Status.MAX_ITER)
                vars(result)["costs_known"] = bool((known & (outputs["objective"] < _HUGE)).all())
            np.minimum(outputs["residual"], _HUGE, out=outputs["residual"])
        return result

    def starts(self, problem: MPCProblem, guessed: bool) -> Starts:
        """Return the starts of each element; a guess is the first of them."""
        if self.restarts is not None:
            return Starts(self.restarts, max(1, self.restarts // _GROUP), self.restarts)
        if guessed and self.effort != "best":
            return Starts(1, 1, 1)  # a guess is taken to be near the optimum that is wanted
        contacts = problem.horizon * problem.n_lam
        many = contacts >= min(_MANY_CONTACTS, _MANY_PER_ACTION * problem.n_u) or problem.horizon >= _LONG_HORIZON
        large = problem.n_lam >= _LARGE_FORCES or problem.n_x + problem.n_u >= _LARGE
        if large and many and self.effort == "default" and problem.horizon < _LONG_HORIZON:
            return _STARTS_LARGE
        return _STARTS[self.effort][many]

    def vjp(
        self, problem: MPCProblem, result: Result, grads: tuple[Tensor, Tensor, Tensor, Tensor], solved: Tensor
    ) -> dict[str, Tensor]:
        """Compute the gradients by the adjoint sweep in native code; the same numbers as `difflcs.mpc.kkt.vjp`."""
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
        _kernels.vjp_mpc(
            problem.arrays,
            problem.horizon,
            problem.relaxation,
            problem.barrier,
            *(array(v) for v in (*result.primal, *grads)),
            solved=solved.to(torch.int8).numpy(),
            pivot=pivot,
            threads=self._threads(),
            gradients=[gradient.numpy() for gradient in gradients.values()],
        )
        return gradients

    def _threads(self) -> int:
        return self.threads or torch.get_num_threads()

    def _make_finite(self, problem: MPCProblem, primal: Primal, status: Tensor) -> None:
        """Give failed elements finite numbers inside the bounds."""
        failed = torch.nonzero(~solved(status)).squeeze(-1)
        primal.u[failed] = problem.select(failed).clip(torch.nan_to_num(primal.u[failed], posinf=0.0, neginf=0.0))
        for value in (primal.x, primal.lam, primal.mu):
            value[failed] = torch.nan_to_num(value[failed])

    def _confirm_infeasible(self, problem: MPCProblem, primal: Primal, status: Tensor, started: float) -> None:
        """Make elements NUMERICAL that are called infeasible and need not be."""
        refused = torch.nonzero(status == int(Status.INFEASIBLE)).squeeze(-1)
        if len(refused):
            part, plans = problem.select(refused), Primal(*(value[refused] for value in primal))
            sure = conditions.certainly_missed(part, plans)
            if bool(torch.isinf(part.price).any()):  # else this is the solve for the least violations, which can be met
                sure &= self._impossible(part, plans, started)
            status[refused[~sure]] = int(Status.NUMERICAL)

    def _impossible(self, problem: MPCProblem, plans: Primal, started: float) -> Tensor:
        """Return which elements (batch,) miss a hard constraint at any cost, by a solve for the least violations."""
        # In the units of their rows along the plans, and with actions as large as the states there.
        left = None if self.time_limit is None else max(1e-4, self.time_limit - (time.perf_counter() - started))
        unit, width = conditions.row_units(problem, plans), conditions.ranges(problem, plans.u).amax(1)
        unit, width, size = (torch.where(v > 0, v, 1.0)[:, None] for v in (unit, width, plans.x.abs().amax((1, 2))))
        action, weight = width / size[..., None], torch.eye(problem.n_u, dtype=torch.float64) / size[..., None] ** 2
        easy = {name: torch.zeros_like(getattr(problem, name)) for name in ("Q", "S", "Q_final", "q", "r", "q_final")}
        easy["price"] = torch.where(torch.isinf(conditions.prices(problem)), 1.0, 1e-6) / unit
        for name in ("B", "E", "G_u", "u_min", "u_max"):
            by = 1 / action if name in ("u_min", "u_max") else action.unsqueeze(-2)
            easy[name] = (problem.batch_first(name) * by).expand(problem.batch, problem.horizon, *problem.shape(name))
        missed = torch.ones(problem.batch, dtype=torch.bool)
        known = ~missed
        for part in _FLAT:
            easy["R"] = part * weight
            nearest = replace(self, time_limit=left).solve(replace(problem, **easy, barrier=0.0), None)
            plan = nearest.primal._replace(u=nearest.primal.u * action)
            missed, known = missed & conditions.certainly_missed(problem, plan), known | solved(nearest.status)
        return missed & known
