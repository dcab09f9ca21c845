"""The controller of one robot: the solver of backend `batched` with NumPy in and out, and an action for every step.

The work is done by the C++ class of `difflcs/_native/controller.hpp`, the same as in the C library.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from difflcs import _storage
from difflcs._checks import check_finite, check_number, describe
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError, NonFiniteError, ShapeError, SolveError
from difflcs.lcs import LCSParams, LCSSequence
from difflcs.mpc.controller_file import constant_system, controller_bytes
from difflcs.mpc.setup import Setup
from difflcs.records import system_at
from difflcs.status import Status

_FALLBACKS = {"hold": 0, "zero": 1, "unfinished": 3, "raise": 0}
_ACTION = 2
_FLOAT = np.dtype(np.float64)

OnFailure = str | ArrayLike


@dataclass(frozen=True)
class ControllerPlan:
    """Last result of a controller's solver.

    Attributes:
        x: (H+1, n_x) planned states.
        u: (H, n_u) planned actions.
        lam: (H, n_lam) complementarity variables.
        mu: (H+1, n_c) multipliers of the constraints.
        objective: cost of the plan.
        status: how the step ended.
        fallback: whether its action was the fallback.
        late: whether the time limit stopped the solver.
        iterations: of the solver.
        kkt_residual: largest violation of the optimality conditions, see `MPCSolution`.
        solve_time: in the solver [s].
    """

    x: NDArray[np.float64]
    u: NDArray[np.float64]
    lam: NDArray[np.float64]
    mu: NDArray[np.float64]
    objective: float
    status: Status
    fallback: bool
    late: bool
    iterations: int
    kkt_residual: float
    solve_time: float


class MPCController:
    """Closes the loop on one robot: `u = controller.step(x, goal)`. Made by `LCSMPCLayer.controller`, or by `load`.

    It holds a copy of the layer's system, cost, bounds and constraints as they were; make another one after learning.
    Each step begins at the plan of the one before, one step later, as `MPCSolution.shift` has it. A state that is not
    finite is no error but a step that is not solved: on a robot something must happen. A module whose system depends
    on the state or a context (any but `LCSModel`, `ScaledLCS` and plain matrices) is asked for it at each step, which
    takes as long as the module does, and another 100 µs for the checks of its matrices.

    One controller is for one thread at a time; another call at the same time is refused.

    Args:
        setup: what the layer plans with: its backend is `batched`, and nothing in it has a batch dimension.
        on_failure: the action of a step that is not solved. "hold": what the last solved plan has for this time, for
            at most H−1 steps in a row, then zero; "unfinished": what the solver had reached where the time was over,
            else as "hold"; "zero"; an action (n_u,); or "raise" a `SolveError`. An action is clipped into the bounds.
        time_limit: seconds from the begin of a step until the solver is stopped, which it notices at its next
            iteration; that of the backend if None.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(self, setup: Setup, on_failure: OnFailure = "hold", time_limit: float | None = None):
        system = constant_system(setup.lcs)
        limit = getattr(setup.backend, "time_limit", None) if time_limit is None else time_limit
        self._setup = setup if system is None else None
        self._content = b"" if system is None else controller_bytes(setup, system)
        self._native: Any = None
        self._begin(setup.horizon, setup.lcs.n_x, setup.lcs.n_u, getattr(setup.cost, "n_goal", 0), on_failure, limit)
        if system is not None:
            self._make()

    def _begin(
        self, horizon: int, n_x: int, n_u: int, n_goal: int, on_failure: OnFailure, time_limit: float | None
    ) -> None:
        self.horizon, self.n_x, self.n_u, self.n_goal = horizon, n_x, n_u, n_goal
        self._status: int | None = None
        self._fallback_action: NDArray[np.float64] | None = None
        self._raises = isinstance(on_failure, str) and on_failure == "raise"
        if not isinstance(on_failure, str):
            self._fallback_action, self._fallback = _numbers("on_failure", on_failure, (n_u,)), _ACTION
            if not np.isfinite(self._fallback_action).all():
                raise NonFiniteError(f"on_failure: expected a finite action, got {describe(on_failure)}; change it")
        elif on_failure in _FALLBACKS:
            self._fallback = _FALLBACKS[on_failure]
        else:
            raise InvalidInputError(
                f"on_failure: expected {', '.join(map(repr, _FALLBACKS))} or an action, got {on_failure!r:.100}; "
                f"choose one"
            )
        self._time_limit = _limit(time_limit)

    def _make(self) -> None:
        self._native = _kernels.Controller(self._content)
        self._native.set_fallback(self._fallback, self._fallback_action)
        self._native.set_time_limit(self._time_limit or 0.0)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], on_failure: OnFailure = "hold", time_limit: float | None = None
    ) -> Self:
        """Load a controller from a file that `save` or `difflcs export` has written.

        Raises:
            CheckpointError: there is none, or it is damaged, of another kind or of another version.
            InvalidInputError and its kinds: another argument does not fit.
        """
        try:
            content = _storage.read_bytes(Path(path))
            sizes = _kernels.Controller(content).sizes()
        except (FileNotFoundError, RuntimeError) as error:
            raise CheckpointError(f"{path}: {error}") from error
        self = cls.__new__(cls)
        self._setup, self._content, self._native = None, content, None
        self._begin(sizes["horizon"], sizes["n_x"], sizes["n_u"], sizes["n_goal"], on_failure, time_limit)
        self._make()
        return self

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file that `load` and the C library read, atomically.

        Raises:
            InvalidInputError: the system depends on the state or a context.
        """
        if self._setup is not None:
            raise InvalidInputError(
                f"lcs: expected an LCSModel or matrices, got {describe(self._setup.lcs)}, whose system may depend on "
                f"the state; build a layer with lcs=module.params(x, context)"
            )
        _storage.write_atomically(Path(path), self._content)

    def step(
        self,
        x: ArrayLike,
        goal: ArrayLike | None = None,
        reference: ArrayLike | None = None,
        *,
        context: Tensor | None = None,
    ) -> NDArray[np.float64]:
        """Plan from a state.

        Args:
            x: (n_x,) the state.
            goal: (n_goal,), with a `GoalCost`.
            reference: (H+1, n_goal) instead of a goal: one for each state of the plan, see `GoalCost.follow`.
            context: (n_context,) quantities besides x that the system depends on; passed to the module.

        Returns:
            (n_u,) the first action of the plan, or that of `on_failure`; always inside the bounds. A new array.

        Raises:
            SolveError: the step was not solved and on_failure="raise".
            InvalidInputError and its kinds: an argument does not fit; the plan is as it was.
        """
        x = _numbers("x", x, (self.n_x,))
        targets, follow = None, reference is not None
        if self.n_goal:
            if follow == (goal is not None):
                raise ShapeError(
                    f"goal: expected (n_goal={self.n_goal},), or a reference in its place, got "
                    f"{'both' if follow else 'none'}; call step(x, goal) or step(x, reference=...)"
                )
            shape = (self.horizon + 1, self.n_goal) if follow else (self.n_goal,)
            targets = _numbers("reference" if follow else "goal", reference if follow else goal, shape)
        elif follow or goal is not None:
            raise ShapeError(
                f"{'reference' if follow else 'goal'}: expected none with a cost without goals, got one; use a GoalCost"
            )
        if self._setup is not None:
            self._update_system(self._setup, x, context)
        elif context is not None:
            raise ShapeError("context: expected none with a constant system, got one; leave it out")
        u = np.empty(self.n_u)
        self._status = status = self._native.step(x, targets, follow, u)
        if self._raises and not Status(status).solved:
            outcome = Status(status)
            raise SolveError(f"the step was not solved: {outcome.name} ({outcome.advice})", [0], [status])
        return u

    def _update_system(self, setup: Setup, x: NDArray[np.float64], context: Tensor | None) -> None:
        """Update the system from the module, for this state."""
        if not np.isfinite(x).all() and self._native is not None:
            return  # the step fails and reports it
        with torch.no_grad():
            system = system_at(setup.lcs, torch.from_numpy(x), context)  # pyright: ignore
        if not isinstance(system, LCSParams | LCSSequence):
            raise DTypeError(f"lcs: expected LCSParams or LCSSequence from its params, got {describe(system)}")
        system.check_again()
        if self._native is None:
            self._form = {name: tuple(value.shape) for name, value in system.tensors().items()}
            self._content = controller_bytes(setup, system)
            self._make()
            return
        tensors = {name: value.detach().to("cpu", torch.float64) for name, value in system.tensors().items()}
        check_finite(tensors)
        for name, shape in self._form.items():
            if (got := tuple(tensors[name].shape)) != shape:
                raise ShapeError(
                    f"lcs: expected {name} {shape} as in the first step, got {got}; make another controller"
                )
        self._native.set_system([value.contiguous().numpy() for value in tensors.values()])

    def reset(self) -> None:
        """Forget all plans, as at the begin of an episode."""
        self._status = None
        if self._native is not None:
            self._native.reset()

    @property
    def status(self) -> Status | None:
        """Status of the last step; None before the first."""
        return None if self._status is None else Status(self._status)

    @property
    def time_limit(self) -> float | None:
        """Seconds from the start of a step until the solver is stopped; None for no limit."""
        return self._time_limit

    @time_limit.setter
    def time_limit(self, seconds: float | None) -> None:
        self._time_limit = _limit(seconds)
        if self._native is not None:
            self._native.set_time_limit(self._time_limit or 0.0)

    @property
    def isa(self) -> str | None:
        """The instruction set in use, for one problem at a time; None before a module was asked for its system."""
        return None if self._native is None else self._native.sizes()["isa"]

    @property
    def plan(self) -> ControllerPlan | None:
        """Copy of the solver's last result, even if that step was not solved. None before the first step."""
        if self._status is None:
            return None
        sizes, H = self._native.sizes(), self.horizon
        shapes = (H + 1, self.n_x), (H, self.n_u), (H, sizes["n_lam"]), (H + 1, sizes["n_c"])
        x, u, lam, mu = (np.empty(shape) for shape in shapes)
        self._native.plan(x, u, lam, mu)
        status, fallback, late, iterations, objective, residual, seconds = self._native.outcome()
        return ControllerPlan(x, u, lam, mu, objective, Status(status), fallback, late, iterations, residual, seconds)

    def __repr__(self) -> str:
        return (
            f"MPCController(n_x={self.n_x}, n_u={self.n_u}, n_goal={self.n_goal}, horizon={self.horizon}, "
            f"time_limit={self._time_limit})"
        )


def _limit(seconds: float | None) -> float | None:
    return None if seconds is None else check_number("time_limit", seconds, strict=True)


def _numbers(name: str, value: object, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Convert an argument to a float64 array for the native code; NaN and infinity are allowed."""
    if type(value) is np.ndarray and value.dtype is _FLOAT and value.shape == shape and value.flags.c_contiguous:
        return value
    try:
        array = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
    except (TypeError, ValueError) as error:
        raise DTypeError(f"{name}: expected numbers, got {describe(value)}; pass a NumPy array") from error
    if array.dtype.kind not in "fiu":
        raise DTypeError(f"{name}: expected real numbers, got {describe(value)}; pass a NumPy array of floats")
    if array.shape != shape:
        raise ShapeError(f"{name}: expected shape {shape}, got {array.shape}; give one robot's, without a batch")
    return np.ascontiguousarray(array, np.float64)
