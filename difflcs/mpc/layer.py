"""PyTorch layer of the LCS-MPC: it checks a call, has a backend solve it, and wraps the solution."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from difflcs._checks import check_choice, check_number, check_positive_int, takes_arrays, to_tensor
from difflcs._differentiation import runs_eagerly
from difflcs._fields import register
from difflcs._modules import fresh
from difflcs.constraints import StageBounds, as_bound
from difflcs.errors import DegenerateWarning, InvalidInputError, SolveError, SolveWarning, warn
from difflcs.mpc.backends import Backend, get_backend
from difflcs.mpc.controller import MPCController, OnFailure
from difflcs.mpc.repeat import Repeat
from difflcs.mpc.setup import (
    PLAIN_COSTS,
    Bound,
    Call,
    Constraints,
    Cost,
    Setup,
    System,
    check_alone,
    check_constraints,
    check_cost,
    check_stage_bounds,
    check_system,
    is_local,
)
from difflcs.mpc.solution import MPCSolution, Primal
from difflcs.records import LCSParams, LCSSequence
from difflcs.status import Status, solved

HARD, SMOOTH = 1e-7, 1e-5
"""Relaxation by default: of plans that are executed, nearly hard contact; and in training, for gradients."""


def _optional(check: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if value is None else check(value)


_SETTINGS: dict[str, Callable[[Any], Any]] = {
    "lcs": check_system,
    "cost": check_cost,
    "horizon": partial(check_positive_int, "horizon"),
    "passes": partial(check_positive_int, "passes"),
    "relaxation": _optional(partial(check_number, "relaxation", strict=True)),
    "training_relaxation": _optional(partial(check_number, "training_relaxation", strict=True)),
    "barrier": partial(check_number, "barrier"),
    "on_failure": partial(check_choice, "on_failure", choices=("raise", "mask")),
    "backend": get_backend,
    "constraints": _optional(check_constraints),
    "bounds": _optional(check_stage_bounds),
}
"""What checks each setting of a layer, whenever it is set, and converts it."""
_OPEN = {"u_min": -torch.inf, "u_max": torch.inf}
"""Bounds that are none."""


class LCSMPCLayer(nn.Module):
    """Model predictive control through an LCS (Eq. 3 of the paper), differentiable in every input.

    Solves, for each batch element, the problem of `difflcs.mpc.MPCProblem`, and differentiates its solution with
    respect to the LCS, the cost, the bounds, the constraints, x0 and the goal by perturbation of the optimality
    conditions (`difflcs.mpc.kkt`). Everything is solved in float64 on the CPU; results come back in x0's dtype and on
    x0's device. What the layer is built with is the default of each call, and can be changed: `layer.u_max = None`.
    As a stochastic policy for reinforcement learning: `difflcs.rl.LCSMPCPolicy`.

    Args:
        lcs: an `LCSModel` or any other `LCSModule`, asked for its system at each call (parameters of an nn.Module
            become this layer's); or `LCSParams`, shared or one per batch element; or an `LCSSequence`, one per stage.
        cost: a `GoalCost`, called with the goal or along a reference; a `QuadraticCost` or `CostSequence`; or any other
            `CostModule`, asked for its cost at the states and goals of each call.
        horizon: H ≥ 1 steps.
        u_min: lower bound of the actions: a number, or a tensor (n_u,) or (..., n_u), −∞ where there is none; learned
            if an nn.Parameter. None: no bound.
        u_max: upper bound, likewise.
        backend: name of a registered backend, or an instance with options.
        relaxation: product λ·s of the relaxed complementarity, of the plan and of its gradient, > 0. None: 1e-7 for
            plans that are executed, in evaluation mode (`layer.eval()`) and by controllers, where it is nearly hard
            contact; and 1e-5 in training mode, as new modules are, where gradients are smoother across contacts.
        on_failure: "raise" a `SolveError` when an element is not solved, or "mask" it: finite numbers inside the
            bounds, zero gradient, one `SolveWarning` per layer.
        bounds: `StageBounds`, instead of u_min and u_max.
        constraints: `LinearConstraints` or a `ConstraintSequence`, hard or soft.
        training_relaxation: relaxation in training mode (`layer.train()`), if it differs from one that is given.
        barrier: weight of a logarithmic barrier of the action bounds [cost units]; 0 for none. An action at a bound has
            zero gradient; with a barrier it keeps a small distance and a gradient. The objective includes the barrier.
            Sensible weights are 1e-3 to 1e-1 of the objective; far smaller ones make the problem stiff.
        passes: number of solves in a call, where the system of a module depends on the state. Each pass after the first
            is warm-started and plans with the module linearised along the actions of the pass before
            (`difflcs.sequence_along`); a cost module with `local = True`, such as `MujocoCost`, is asked at the states
            of that plan. Plan, status and gradient are those of the last pass, whose systems are treated as that of x0
            is in a single pass. Passes are not compared, as objectives of two systems do not say which plan is better.
            Two see how contacts change on the way; more converge where each changes little, otherwise plans may
            alternate. Matrices with a cost that is no such module are solved once.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
        BackendNotFoundError: unknown backend, or its package is missing.
    """

    u_min: Tensor
    u_max: Tensor
    backend: Backend

    @takes_arrays
    def __init__(
        self,
        lcs: System,
        cost: Cost,
        horizon: int,
        u_min: Bound | None = None,
        u_max: Bound | None = None,
        backend: str | Backend = "batched",
        relaxation: float | None = None,
        on_failure: str = "raise",
        *,
        bounds: StageBounds | None = None,
        constraints: Constraints | None = None,
        training_relaxation: float | None = None,
        barrier: float = 0.0,
        passes: int = 1,
    ):
        super().__init__()
        self.lcs, self.cost, self.horizon, self.passes = lcs, cost, horizon, passes
        self.relaxation, self.training_relaxation, self.barrier = relaxation, training_relaxation, barrier
        self.on_failure, self.constraints, self.bounds = on_failure, constraints, bounds
        self.backend = backend  # pyright: ignore[reportAttributeAccessIssue]  (which makes an instance of a name)
        if bounds is not None:
            check_alone(u_min=u_min, u_max=u_max)
        for name, value in (("u_min", u_min), ("u_max", u_max)):
            register(self, name, self._bound(name, value), persistent=False)
        self.setup().check()
        self._warned = False
        self._repeat = Repeat()

    def __setattr__(self, name: str, value: Any) -> None:
        """Set a setting: what the constructor takes, with the same checks; and anything else as it is."""
        if name in _OPEN:
            value = self._bound(name, to_tensor(value))
        super().__setattr__(name, _SETTINGS[name](value) if name in _SETTINGS else value)

    def _bound(self, name: str, value: Any) -> Tensor:
        like = self.cost.Q if isinstance(self.cost, PLAIN_COSTS) else torch.empty(0)
        return as_bound(name, _OPEN[name] if value is None else value, [("n_u", self.lcs.n_u)], like)

    def setup(self) -> Setup:
        """Collect the settings that the layer plans with now, except those of training mode."""
        if self._forward_pre_hooks:
            fresh(self, ("u_min", "u_max"))
        return Setup(
            self.lcs,
            self.cost,
            self.horizon,
            HARD if self.relaxation is None else self.relaxation,
            self.barrier,
            self.backend,
            time.perf_counter(),
            self.u_min,
            self.u_max,
            self.bounds,
            self.constraints,
            None if type(self).limits is LCSMPCLayer.limits else self.limits,
        )

    def limits(self, system: System | None = None) -> tuple[Tensor, Tensor]:
        """Return the bounds of the actions for calls that pass none.

        They are the layer's `bounds`; or else u_min and u_max, within the action support of an `LCSModel` that knows
        one. A call takes them within the `action_bounds(x0)` of a module that has these, as `MujocoLCS` does, of the
        layer's where the call passes matrices.

        Args:
            system: the model; the layer's if None.

        Returns:
            Lower and upper bounds, (..., n_u), or (..., H, n_u) of bounds that change over the horizon.

        Raises:
            BoundsError: the model's action support lies outside of u_min and u_max.
        """
        return self.setup()._replace(limits=None).action_bounds(self.lcs if system is None else system)

    def extra_repr(self) -> str:
        """Describe the settings for print(layer)."""
        return (
            f"horizon={self.horizon}, relaxation={self.relaxation}, backend={self.backend}, "
            f"on_failure={self.on_failure!r}"
        )

    @runs_eagerly
    @takes_arrays
    def forward(
        self,
        x0: Tensor,
        goal: Tensor | None = None,
        *,
        reference: Tensor | None = None,
        guess: MPCSolution | Primal | None = None,
        u_min: Bound | None = None,
        u_max: Bound | None = None,
        bounds: StageBounds | None = None,
        lcs: System | None = None,
        cost: Cost | None = None,
        constraints: Constraints | None = None,
        context: Tensor | None = None,
    ) -> MPCSolution:
        """Plan from states.

        Args:
            x0: (..., n_x) initial states, float32 or float64.
            goal: (..., n_goal), with a `GoalCost` or a `CostModule` only. Batch dimensions broadcast with those of x0.
            reference: (..., H+1, n_goal), with a `GoalCost` only and instead of a goal: one goal for each state of the
                plan, see `GoalCost.follow`.
            guess: warm start for the same batch, such as `solution.shift()`.
            u_min: bound for this call instead of the layer's.
            u_max: likewise.
            bounds: `StageBounds` for this call.
            lcs: system, or module that is asked for one, for this call.
            cost: cost for this call.
            constraints: constraints for this call.
            context: (..., n_context) quantities besides x0 that system or cost depend on; passed to the modules.

        Returns:
            `MPCSolution` with the broadcast batch dimensions.

        Raises:
            SolveError: an element was not solved and on_failure="raise".
            InvalidInputError and its kinds: an argument does not fit; nothing was solved.
        """
        setup = self.setup()
        if self.training:
            softer = self.training_relaxation or (SMOOTH if self.relaxation is None else self.relaxation)
            setup = setup._replace(relaxation=softer)
        call = Call(x0, goal, reference, guess, u_min, u_max, bounds, lcs, cost, constraints, context)
        plain = isinstance(self.lcs if lcs is None else lcs, LCSParams | LCSSequence)
        if not plain or is_local(self.cost if cost is None else cost):
            for _ in range(self.passes - 1):
                with torch.no_grad():
                    x, u, lam, _, mu, *_ = self._repeat.solve_call(setup, call)[1]
                guess = Primal(x, u, lam, mu)
                call = call._replace(guess=guess, along=guess)
        solver, (x, u, lam, objective, mu, *rest) = self._repeat.solve_call(setup, call)
        if solver.transformed or not solver.result.all_converged:
            self._report(solver.result.status, solver.needs_grad)
        return MPCSolution(x, u, lam, mu, objective, *rest, of=solver.problem)

    def controller(self, on_failure: OnFailure = "hold", time_limit: float | None = None) -> MPCController:
        """Make a controller of one robot with this layer's problem as it is now: NumPy in and out, warm, microseconds.

        Args:
            on_failure: "hold", "unfinished", "zero", "raise" or an action (n_u,), see `MPCController`.
            time_limit: seconds of one step, that of the backend if None.

        Raises:
            InvalidInputError: several passes, which a controller does not make.
        """
        if self.passes > 1:
            raise InvalidInputError(
                f"passes: expected 1 for a controller, got {self.passes}; build a layer with passes=1, or call this one"
            )
        return MPCController(self.setup(), on_failure, time_limit)

    def _report(self, status: Tensor, needs_grad: bool) -> None:
        if needs_grad and (degenerate := int((status == Status.DEGENERATE).sum())):
            warn(
                f"{degenerate} of {len(status)} solutions are not classically differentiable (a weakly active bound or "
                f"a singular reduced Hessian); their gradient is a regularised one. See MPCSolution.status",
                DegenerateWarning,
            )
        if self._warned and self.on_failure == "mask":
            return
        failed = torch.nonzero(~solved(status)).squeeze(-1).tolist()
        if not failed:
            return
        codes = [int(status[i]) for i in failed]
        kinds = ", ".join(f"{codes.count(c)} {Status(c).name} ({Status(c).advice})" for c in sorted(set(codes)))
        shown = ", ".join(map(str, failed[:10])) + (", …" if len(failed) > 10 else "")
        message = f"{len(failed)} of {len(status)} MPC problems were not solved: {kinds}; flat batch elements {shown}"
        if self.on_failure == "raise":
            raise SolveError(f'{message}. Pass on_failure="mask" to go on without them', failed, codes)
        if not self._warned:
            self._warned = True
            warn(
                f"{message}. Their actions are the last iterate inside the bounds and their gradient is zero "
                f"(this layer warns once)",
                SolveWarning,
            )
