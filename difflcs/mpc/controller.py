"""The controller of one robot: the solver of backend `batched` with NumPy in and out, and an action for every step.

The work is done by the C++ class of `difflcs/_native/controller.hpp`, the same as in the C library.
"""

import os
import time
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from difflcs import _storage
from difflcs._checks import check_array, check_finite, check_number, describe, to_tensor
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.constraints import StageBounds, check_bounds
from difflcs.cost import GoalCost
from difflcs.errors import CheckpointError, InvalidInputError, NonFiniteError, ShapeError, SolveError
from difflcs.mpc import controller_file
from difflcs.mpc.setup import PLAIN_COSTS, Call, Cost, Inputs, Setup, System, gather
from difflcs.records import SYSTEM, LCSParams, LCSSequence
from difflcs.status import Status

_FALLBACKS = {"hold": 0, "zero": 1, "unfinished": 3, "raise": 0}
_ACTION = 2
_FLOAT = np.dtype(np.float64)

# Arguments of a step that replace those of the layer, and their fields, in the order of difflcs/_native/fields.hpp.
_CHANGES = {
    "lcs": tuple(SYSTEM),
    "cost": ("Q", "R", "S", "Q_final", "q", "r", "q_final"),
    "u_min": ("u_min",),
    "u_max": ("u_max",),
}

OnFailure = str | ArrayLike


class ControllerPlan(NamedTuple):
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
    finite is no error but a step that is not solved: on a robot something must happen. A module whose system or cost
    depends on the state, a goal or a context (any but `LCSModel`, `ScaledLCS`, plain matrices, and costs that are no
    `CostModule`) is called at each step, which takes as long as the module does, and some 100 µs for checks. The time
    limit includes this.

    One controller is for one thread at a time; another call at the same time is refused.

    Args:
        setup: settings of the layer; its backend is `batched`, and nothing in it has a batch dimension.
        on_failure: the action of a step that is not solved. "hold": that of the last solved plan for this time, for
            at most H−1 steps in a row, then zero; "unfinished": that of the iterate when the time was over,
            else as "hold"; "zero"; an action (n_u,); or "raise" a `SolveError`. An action is clipped into the bounds.
        time_limit: seconds from the start of a step until the solver is stopped, which it notices at its next
            iteration; that of the backend if None.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(self, setup: Setup, on_failure: OnFailure = "hold", time_limit: float | None = None):
        limit = getattr(setup.backend, "time_limit", None) if time_limit is None else time_limit
        self._setup = setup = controller_file.constant_setup(setup)
        self._content = b""
        self._native: Any = None
        n_goal = setup.cost.n_goal if isinstance(setup.cost, GoalCost) else 0  # a module may take any goal
        self._begin(setup.horizon, setup.lcs.n_x, setup.lcs.n_u, n_goal, on_failure, limit)
        known = {"lcs": (LCSParams, LCSSequence), "cost": PLAIN_COSTS}
        self._modules = frozenset(name for name, kinds in known.items() if not isinstance(getattr(setup, name), kinds))
        if not self._modules:
            self._make(controller_file.gather_at_zero(setup))

    def _begin(
        self, horizon: int, n_x: int, n_u: int, n_goal: int, on_failure: OnFailure, time_limit: float | None
    ) -> None:
        self.horizon, self.n_x, self.n_u, self.n_goal = horizon, n_x, n_u, n_goal
        self._setup: Setup | None
        self._modules: frozenset[str]
        self._first_inputs: dict[str, Tensor] = {}
        self._overridden = False
        self._status: int | None = None
        self._action: NDArray[np.float64] | None = None
        self._raises = isinstance(on_failure, str) and on_failure == "raise"
        if not isinstance(on_failure, str):
            self._action, self._fallback = _numbers("on_failure", on_failure, (n_u,)), _ACTION
            if not np.isfinite(self._action).all():
                raise NonFiniteError(f"on_failure: expected a finite action, got {describe(on_failure)}; change it")
        elif on_failure in _FALLBACKS:
            self._fallback = _FALLBACKS[on_failure]
        else:
            raise InvalidInputError(
                f"on_failure: expected {', '.join(map(repr, _FALLBACKS))} or an action, got {on_failure!r:.100}; "
                f"choose one"
            )
        self._time_limit = _limit(time_limit)

    def _make(self, inputs: Inputs) -> None:
        """Make the native controller of the first problem."""
        assert self._setup is not None
        check_finite({name: inputs.tensors[name] for name in SYSTEM})
        problem, self._constant = controller_file.make_problem(self._setup, inputs)
        self._content = controller_file.controller_bytes(self._setup, problem, self._constant)
        self._first_inputs = {name: getattr(problem, name).clone() for names in _CHANGES.values() for name in names}
        self._load()

    def _load(self) -> None:
        self._native = _kernels.Controller(self._content)
        self._native.set_fallback(self._fallback, self._action)
        self._native.set_time_limit(self._time_limit or 0.0)
        sizes, H = self._native.sizes(), self.horizon
        self._shapes = (H + 1, self.n_x), (H, self.n_u), (H, sizes["n_lam"]), (H + 1, sizes["n_c"])

    def __getstate__(self) -> dict[str, Any]:
        """A copy begins anew, without the last plan."""
        return {**vars(self), "_native": None, "_status": None, "_overridden": False}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if self._content:
            self._load()

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
        self._setup, self._content, self._modules = None, content, frozenset()
        self._begin(sizes["horizon"], sizes["n_x"], sizes["n_u"], sizes["n_goal"], on_failure, time_limit)
        self._load()
        return self

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file that `load` and the C library read, atomically.

        Raises:
            InvalidInputError: system or cost may depend on the state, or the file cannot be written.
        """
        if self._setup is not None:
            controller_file.check_constant(self._setup)
        with _storage.place_to_write(Path(path), "path"):
            _storage.write_atomically(Path(path), self._content)

    def step(
        self,
        x: ArrayLike,
        goal: ArrayLike | None = None,
        reference: ArrayLike | None = None,
        *,
        context: ArrayLike | None = None,
        lcs: System | None = None,
        cost: Cost | None = None,
        bounds: StageBounds | None = None,
        u_min: ArrayLike | None = None,
        u_max: ArrayLike | None = None,
    ) -> NDArray[np.float64]:
        """Plan from a state.

        Args:
            x: (n_x,) the state.
            goal: (n_goal,), with a `GoalCost`, or any that a `CostModule` takes.
            reference: (H+1, n_goal) instead of a goal: one for each state of the plan, see `GoalCost.follow`.
            context: (n_context,) quantities besides x that system or cost depend on; passed to the modules.
            lcs: system for this step, or a module that returns one, of the same sizes as the layer's.
            cost: cost for this step, likewise; no `GoalCost`, and none if the layer has one.
            bounds: bounds by stage for this step, if the layer's are by stage.
            u_min: bound for this step, (n_u,), or a number.
            u_max: likewise.

        Returns:
            (n_u,) the first action of the plan, or that of `on_failure`; always inside the bounds. A new array.

        Raises:
            SolveError: the step was not solved and on_failure="raise".
            InvalidInputError and its kinds: an argument does not fit; the plan is as it was.
        """
        x = _numbers("x", x, (self.n_x,))
        targets, follow = None, reference is not None
        if self.n_goal and self._setup is not None and cost is not None:
            raise ShapeError("cost: expected none where the layer has a GoalCost, got one; give the layer another")
        if self.n_goal:
            if follow == (goal is not None):
                raise ShapeError(
                    f"goal: expected (n_goal={self.n_goal},), or a reference in its place, got "
                    f"{'both' if follow else 'none'}; call step(x, goal) or step(x, reference=...)"
                )
            shape = (self.horizon + 1, self.n_goal) if follow else (self.n_goal,)
            targets = _numbers("reference" if follow else "goal", reference if follow else goal, shape)
        elif follow or (goal is not None and cost is None and "cost" not in self._modules):
            raise ShapeError(
                f"{'reference' if follow else 'goal'}: expected none with a cost without goals, got one; use a GoalCost"
            )
        update = bool(self._modules) or self._overridden or not (lcs is cost is bounds is u_min is u_max is None)
        if update:
            own = {"lcs": lcs, "cost": cost, "bounds": bounds, "u_min": to_tensor(u_min), "u_max": to_tensor(u_max)}
            x = self._update(x, goal, to_tensor(context), own)
        elif context is not None:
            raise ShapeError("context: expected none with a constant system, got one; leave it out")
        u = np.zeros(self.n_u)
        if self._native is None:  # the first state has no numbers, so that no module was asked
            self._status = status = int(Status.NUMERICAL)
        else:
            self._status = status = self._native.step(x, targets, follow, u)
        if update:
            self.time_limit = self._time_limit  # the modules have taken a part of it
            if not np.isfinite(x).all():
                u = self._within_bounds(u if self._action is None else self._action, own)
        if self._raises and not Status(status).solved:
            outcome = Status(status)
            raise SolveError(f"the step was not solved: {outcome.name} ({outcome.advice})", [0], [status])
        return u

    def _update(
        self, x: NDArray[np.float64], goal: ArrayLike | None, context: Any, overrides: dict[str, Any]
    ) -> NDArray[np.float64]:
        """Update the native controller from the modules and a step's arguments; return the state to plan from."""
        if self._setup is None:
            raise InvalidInputError(
                f"{', '.join(overrides)}: expected none in a controller of a file, got one; make one from a layer"
            )
        begun = time.perf_counter()
        goal = (
            np.zeros(self.n_goal) if self.n_goal else None if goal is None else _numbers("goal", goal, np.shape(goal))
        )
        finite = np.isfinite(x).all() and (goal is None or np.isfinite(goal).all())
        if not finite:
            return np.full(self.n_x, np.nan)  # the step fails and reports it
        call = Call(torch.from_numpy(x), None if goal is None else torch.from_numpy(goal), context=context)
        self._overridden = any(value is not None for value in overrides.values())
        with torch.no_grad():
            if first := self._native is None:
                self._make(gather(self._setup, call))
            if self._overridden or not first:
                self._set_inputs(self._setup, gather(self._setup, call._replace(**overrides)), overrides)
        if self._time_limit is not None:
            native: Any = self._native
            native.set_time_limit(max(self._time_limit - (time.perf_counter() - begun), 1e-9))
        return x

    def _within_bounds(self, u: NDArray[np.float64], overrides: dict[str, Any]) -> NDArray[np.float64]:
        """Clip the action of a step without a state into the bounds of that step, as far as they are known."""
        inputs = Inputs(self.horizon, sizes={"n_u": self.n_u})
        setup: Any = self._setup
        inputs.take_bounds(setup, Call(torch.empty(0), **overrides), setup.lcs, None)
        low, high = (
            inputs.tensors[name].detach().cpu().reshape(-1, self.n_u)[0].numpy() for name in ("u_min", "u_max")
        )
        return np.clip(u, low, high)

    def _set_inputs(self, setup: Setup, inputs: Inputs, overrides: dict[str, Any]) -> None:
        """Replace the numbers of the problem by others of the same shapes."""
        values, constant = controller_file.numbers_of_one(inputs)
        fields = dict(self._first_inputs)
        for part, names in _CHANGES.items():  # bounds may depend on the state if the layer's system does
            if part in self._modules or overrides[part] is not None or part in ("u_min", "u_max"):
                fields |= {n: values[n] if n in values else torch.zeros_like(self._first_inputs[n]) for n in names}
            for name in names:
                first = self._first_inputs[name]
                if name in ("u_min", "u_max") and fields[name].ndim < first.ndim:  # one for all stages
                    fields[name] = fields[name].expand_as(first).contiguous()
                if fields[name].numel() != first.numel():
                    raise ShapeError(
                        f"{part}: expected {name} {tuple(first.shape)} as in the first step, got "
                        f"{tuple(fields[name].shape)}; make another controller"
                    )
        if setup.barrier > 0 or not bool((fields["u_min"] < fields["u_max"]).all()):  # else neither is infinite wrongly
            check_bounds(fields["u_min"], fields["u_max"], strict=setup.barrier > 0)
        new_cost = "cost" in self._modules or overrides["cost"] is not None
        arrays = [value.numpy() for value in fields.values()]
        if not _kernels.all_finite(arrays[: len(SYSTEM)]):
            check_finite({name: values[name] for name in SYSTEM})
        self._native.set_inputs(arrays, constant if new_cost else self._constant)

    def reset(self) -> None:
        """Forget all plans, as at the start of an episode."""
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
        """The instruction set in use, for one problem at a time; None before the first call of a module."""
        return None if self._native is None else self._native.sizes()["isa"]

    @property
    def plan(self) -> ControllerPlan | None:
        """Copy of the solver's last result, even if that step was not solved. None before the first solve."""
        if self._status is None or self._native is None:
            return None
        x, u, lam, mu = map(np.empty, self._shapes)
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
    array = check_array(name, value)
    if array.shape != shape:
        raise ShapeError(f"{name}: expected shape {shape}, got {array.shape}; give one robot's, without a batch")
    return np.ascontiguousarray(array)
