"""Interface that every solver backend implements, and the registry of backends."""

import functools
import importlib.util
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from difflcs._checks import did_you_mean
from difflcs.errors import BackendNotFoundError, DTypeError, InvalidInputError
from difflcs.mpc import conditions, kkt
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.mpc.solution import Primal
from difflcs.status import Status, all_converged, solved


@dataclass(frozen=True)
class Result:
    """A certified batch of solutions; every number is finite.

    Attributes:
        primal: x (batch, H+1, n_x), u (batch, H, n_u) inside the bounds, lam (batch, H, n_lam), mu (batch, H+1, n_c).
        status: (batch,) int8 `Status`.
        iterations: (batch,) int32.
        kkt_residual: (batch,) see `difflcs.mpc.kkt.residual`; the largest float where it is infinite.
        solve_time: (batch,) seconds.
        linearisation: the factored optimality conditions for the gradient.
        objective: (batch,) the cost of the CONVERGED plans, if the solver returns it; up to rounding it is
            `MPCProblem.objective`.
    """

    primal: Primal
    status: Tensor
    iterations: Tensor
    kkt_residual: Tensor
    solve_time: Tensor
    linearisation: kkt.Linearisation | None = None
    objective: Tensor | None = None

    @functools.cached_property
    def all_converged(self) -> bool:
        """True if every plan is CONVERGED, so that callers can skip further checks."""
        return all_converged(self.status)

    @functools.cached_property
    def costs_known(self) -> bool:
        """True if `objective` is the cost of every plan."""
        return self.objective is not None and self.all_converged

    @property
    def solved(self) -> Tensor:
        """(batch,) bool: the trajectory can be used (CONVERGED or DEGENERATE)."""
        return solved(self.status)


class Backend(ABC):
    """A solver of `MPCProblem`s. Subclass as a frozen dataclass whose fields are its options.

    Attributes:
        name: its name in the registry.
        exact: whether it solves the problem as stated, not an approximation of it.
        requires: import names of the packages it needs.
        install: the pip line that installs them.
    """

    name: ClassVar[str]
    exact: ClassVar[bool] = True
    requires: ClassVar[tuple[str, ...]] = ()
    install: ClassVar[str] = "pip install difflcs"

    def after(self, seconds: float) -> "Backend":
        """Return the backend for a call of a layer that needs some seconds besides; one with a time limit has less."""
        return self

    @abstractmethod
    def solve(self, problem: MPCProblem, guess: Primal | None) -> Result:
        """Solve a batch; see `certify` for turning raw trajectories into a `Result`."""

    def vjp(
        self, problem: MPCProblem, result: Result, grads: tuple[Tensor, Tensor, Tensor, Tensor], solved: Tensor
    ) -> dict[str, Tensor]:
        """Compute the gradients of the inputs; by default from the optimality conditions (`difflcs.mpc.kkt`)."""
        linearisation = result.linearisation or kkt.linearise(problem, result.primal)
        return kkt.vjp(problem, linearisation, grads, solved)

    @classmethod
    def missing(cls) -> tuple[str, ...]:
        """List required packages that are not installed."""
        return tuple(package for package in cls.requires if importlib.util.find_spec(package) is None)


def certify(
    problem: MPCProblem, primal: Primal, status: Tensor, iterations: Tensor, solve_time: Tensor, tol: float
) -> Result:
    """Judge raw trajectories by the optimality conditions themselves, whatever the solver claims.

    Actions are clipped into the bounds first, multipliers of the constraints into [0, price]; a solver without them may
    leave these out. A CONVERGED element whose `difflcs.mpc.kkt.residual` exceeds `tol`
    becomes NUMERICAL; one that is not classically differentiable becomes DEGENERATE. Elements that did not converge get
    finite numbers: actions clipped into the bounds (zero if not finite) and the trajectory that these cause.
    So an INFEASIBLE element keeps the plan that its solver ended with.
    """
    status = status.clone()
    primal = conditions.complete(problem, primal)
    primal = primal._replace(u=problem.clip(primal.u), mu=conditions.within_prices(problem, primal.mu))
    finite = torch.stack([torch.isfinite(v).all(-1).all(-1) for v in primal]).all(0)
    status[~finite & (status == Status.CONVERGED)] = Status.NUMERICAL
    primal = replace_failed(problem, primal, status != Status.CONVERGED)
    linearisation = kkt.linearise(problem, primal)
    residual = kkt.residual(problem, primal, linearisation.multipliers)
    status[(residual > tol) & (status == Status.CONVERGED)] = Status.NUMERICAL
    status[linearisation.degenerate & (status == Status.CONVERGED)] = Status.DEGENERATE
    residual = residual.clamp_max(torch.finfo(residual.dtype).max)
    return Result(primal, status, iterations, residual, solve_time, linearisation)


def replace_failed(problem: MPCProblem, primal: Primal, failed: Tensor) -> Primal:
    """Give failed (batch,) elements finite numbers: actions clipped into the bounds, and the trajectory they cause."""
    primal, index = conditions.complete(problem, primal), torch.nonzero(failed).squeeze(-1)
    if not len(index):
        return primal
    part = problem.select(index)
    u = part.clip(torch.nan_to_num(primal.u[index], posinf=0.0, neginf=0.0))
    x, lam = part.rollout(u)
    fixed = []
    for old, new in zip(primal, (x, u, lam, torch.zeros_like(primal.mu[index])), strict=True):
        old = old.clone()
        old[index] = torch.nan_to_num(new)
        fixed.append(old)
    return Primal(*fixed)


def check_plain(problem: MPCProblem, name: str) -> None:
    """Refuse a problem that varies by stage, or has S, constraints, infinite bounds or no contact.

    For a backend `name` that takes one system, cost and bounds for all stages only.

    Raises:
        InvalidInputError: the problem has one of these; the message says which.
    """
    wrong = [(field, "the same at every stage", "one per stage") for field in INPUTS if problem.by_stage(field)]
    for field in ("u_min", "u_max"):
        if bool(torch.isinf(getattr(problem, field)).any()):
            wrong.append((field, "finite bounds", "infinite ones"))
    if bool(problem.S.any()):
        wrong.append(("S", "zero", "another"))
    if problem.n_c:
        wrong.append(("constraints", "none", f"{problem.n_c} at each stage"))
    if problem.n_lam == 0:
        wrong.append(("n_lam", "at least 1", "0"))
    for field, expected, got in wrong[:1]:
        raise InvalidInputError(
            f"{field}: expected {expected} with backend {name!r}, got {got}; use backend='batched' or 'ipopt'"
        )


REGISTRY: dict[str, type[Backend]] = {}
"""Every registered backend by its name, whether its packages are installed or not."""


def register_backend(backend: type[Backend]) -> type[Backend]:
    """Make a backend available under its `name`; usable as a class decorator.

    Raises:
        DTypeError: not a `Backend` subclass with a name.
    """
    if not (
        isinstance(backend, type) and issubclass(backend, Backend) and isinstance(getattr(backend, "name", None), str)
    ):
        raise DTypeError(f"backend: expected a subclass of Backend with a `name`, got {backend!r}")
    REGISTRY[backend.name] = backend
    return backend


def available_backends() -> tuple[str, ...]:
    """List the names of the backends whose packages are installed."""
    return tuple(name for name, backend in REGISTRY.items() if not backend.missing())


def get_backend(backend: str | Backend) -> Backend:
    """Return the backend itself, or the default instance of a named one.

    Raises:
        BackendNotFoundError: no such name, or its package is missing; the message gives the pip line.
    """
    if not isinstance(backend, str | Backend):
        raise DTypeError(f"backend: expected a name or a Backend instance, got {backend!r}")
    if isinstance(backend, str) and backend not in REGISTRY:
        raise BackendNotFoundError(
            f"backend: expected one of {', '.join(map(repr, REGISTRY))}, got {backend!r}"
            f"{did_you_mean(backend, REGISTRY)}; add your own with difflcs.register_backend"
        )
    kind = REGISTRY[backend] if isinstance(backend, str) else type(backend)
    if kind.missing():
        raise BackendNotFoundError(
            f"backend {kind.name!r}: the package {kind.missing()[0]!r} is not installed; run: {kind.install}"
        )
    return kind() if isinstance(backend, str) else backend
