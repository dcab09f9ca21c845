"""LCS-MPC as a PyTorch layer: validate, call a backend, wrap."""

from __future__ import annotations

import sys
import warnings

import torch
from torch import Tensor, nn

from difflcs._checks import check_choice, check_number, check_positive_int, check_tensor
from difflcs._differentiation import forward_mode_active, is_wrapped, refuse_tangents, runs_eagerly, transforms_active
from difflcs._modules import fresh
from difflcs.constraints import StageBounds, as_bound, check_bounds
from difflcs.cost import CostSequence
from difflcs.errors import BoundsError, DegenerateWarning, SolveError, SolveWarning
from difflcs.lcs import LCSSequence
from difflcs.mpc.autograd import Plan, solve
from difflcs.mpc.backends import Backend, get_backend
from difflcs.mpc.controller import MPCController, OnFailure
from difflcs.mpc.gather import (
    Bound,
    Constraints,
    Cost,
    Inputs,
    System,
    check_constraints,
    check_cost,
    check_guess,
    check_stage_bounds,
    check_system,
)
from difflcs.mpc.repeat import Given, Repeat
from difflcs.mpc.solution import MPCSolution, Primal
from difflcs.status import Status, solved


class LCSMPCLayer(nn.Module):
    """Model predictive control through an LCS (Eq. 3 of the paper), differentiable in every input.

    Solves, for each batch element, the problem of `difflcs.mpc.MPCProblem`, and differentiates its solution with
    respect to the LCS, the cost, the bounds, the constraints, x0 and the goal by perturbation of the optimality
    conditions (`difflcs.mpc.kkt`). Everything is solved in float64 on the CPU; results come back in x0's dtype and on
    x0's device. What the layer is built with is the default of each call.

    Args:
        lcs: an `LCSModel` or any other `LCSModule`, asked for its system at each call (parameters of an nn.Module
            become this layer's); or `LCSParams`, shared or one per batch element; or an `LCSSequence`, one per stage.
        cost: a `GoalCost`, called with the goal or along a reference; or a `QuadraticCost` or `CostSequence`.
        horizon: H ≥ 1 steps.
        u_min: lower bound of the actions: a number, or a tensor (n_u,) or (..., n_u), −∞ where there is none; learned
            if an nn.Parameter. None: no bound.
        u_max: upper bound, likewise.
        backend: name of a registered backend, or an instance with options.
        relaxation: λ·s of the relaxed complementarity, > 0.
        on_failure: "raise" a `SolveError` when an element is not solved, or "mask" it: finite numbers inside the
            bounds, zero gradient, one `SolveWarning` per layer.
        bounds: `StageBounds`, instead of u_min and u_max.
        constraints: `LinearConstraints` or a `ConstraintSequence`, hard or soft.
        training_relaxation: relaxation in training mode (`layer.train()`), if another; `layer.eval()` returns to
            `relaxation`. A larger one gives smoother gradients across contacts.
        barrier: weight of a logarithmic barrier of the action bounds [cost units]; 0 for none. An action at a bound has
            zero gradient; with a barrier it keeps a small distance and a gradient. The objective includes the barrier.
            Sensible weights are 1e-3 to 1e-1 of the objective; far smaller ones make the problem stiff.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
        BackendNotFoundError: unknown backend, or its package is missing.
    """

    u_min: Tensor
    u_max: Tensor

    def __init__(
        self,
        lcs: System,
        cost: Cost,
        horizon: int,
        u_min: Bound | None = None,
        u_max: Bound | None = None,
        backend: str | Backend = "batched",
        relaxation: float = 1e-5,
        on_failure: str = "raise",
        *,
        bounds: StageBounds | None = None,
        constraints: Constraints | None = None,
        training_relaxation: float | None = None,
        barrier: float = 0.0,
    ):
        super().__init__()
        self.lcs = check_system(lcs)
        self.cost = check_cost(cost)
        self.horizon = check_positive_int("horizon", horizon)
        self.relaxation = check_number("relaxation", relaxation, strict=True)
        self.training_relaxation = (
            None
            if training_relaxation is None
            else check_number("training_relaxation", training_relaxation, strict=True)
        )
        self.barrier = check_number("barrier", barrier)
        self.on_failure = check_choice("on_failure", on_failure, ("raise", "mask"))
        self.backend = get_backend(backend)
        self.constraints = None if constraints is None else check_constraints(constraints)
        self.bounds = None if bounds is None else check_stage_bounds(bounds, u_min=u_min, u_max=u_max)
        for name, value, none in (("u_min", u_min, -torch.inf), ("u_max", u_max, torch.inf)):
            value = as_bound(name, none if value is None else value, [("n_u", lcs.n_u)], cost.Q)
            if isinstance(value, nn.Parameter):
                self.register_parameter(name, value)
            else:
                self.register_buffer(name, value, persistent=False)
        self._check_parts()
        self._warned = False
        self._repeat = Repeat()

    def _check_parts(self) -> None:
        """What does not depend on a call is refused before the first one."""
        inputs = Inputs(self.horizon, sizes={name: getattr(self.lcs, name) for name in ("n_x", "n_u", "n_lam")})
        if isinstance(self.lcs, LCSSequence):
            inputs.check_horizon("lcs", self.lcs.horizon)
        inputs.check_sizes("cost", n_x=self.cost.n_x, n_u=self.cost.n_u)
        if isinstance(self.cost, CostSequence):
            inputs.check_horizon("cost", self.cost.horizon)
        inputs.add_constraints(self.constraints)
        if self.bounds is not None:
            inputs.add_bounds(self.bounds)
        check_bounds(*self.limits(), strict=self.barrier > 0)

    def limits(self, system: System | None = None) -> tuple[Tensor, Tensor]:
        """Bounds of the actions where a call gives none.

        They are the layer's `bounds`; or else u_min and u_max, within the action support of an `LCSModel` that knows
        one.

        Args:
            system: the model; the layer's own if None.

        Returns:
            Lower and upper bounds, (..., n_u), or (..., H, n_u) of bounds that change over the horizon.

        Raises:
            BoundsError: the model's action support lies outside of u_min and u_max.
        """
        if self._forward_pre_hooks:
            fresh(self, ("u_min", "u_max"))
        if self.bounds is not None:
            return self.bounds.by_steps()
        support = getattr(self.lcs if system is None else system, "action_support", None)
        if support is None:
            return self.u_min, self.u_max
        low, high = support.to(self.u_min).unbind()
        limits = self.u_min.clamp_min(low), self.u_max.clamp_max(high)
        if not is_wrapped(limits[0]) and bool((limits[0] > limits[1]).any()):
            raise BoundsError(
                f"u_min, u_max: expected bounds that meet the actions {low.tolist()} to {high.tolist()} that the model "
                f"was fitted to, got {self.u_min.tolist()} to {self.u_max.tolist()}; set its action_support to None"
            )
        return limits

    def extra_repr(self) -> str:
        """What print(layer) shows."""
        return (
            f"horizon={self.horizon}, relaxation={self.relaxation:g}, backend={self.backend}, "
            f"on_failure={self.on_failure!r}"
        )

    @runs_eagerly
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
            goal: (..., n_goal), with a `GoalCost` only. Batch dimensions broadcast with those of x0.
            reference: (..., H+1, n_goal), with a `GoalCost` only and instead of a goal: one goal for each state of the
                plan, see `GoalCost.follow`.
            guess: warm start for the same batch, such as `solution.shift()`.
            u_min: bound for this call instead of the layer's.
            u_max: likewise.
            bounds: `StageBounds` for this call.
            lcs: system, or module that is asked for one, for this call.
            cost: cost for this call.
            constraints: constraints for this call.
            context: (..., n_context) whatever the system depends on besides x0; given to the module.

        Returns:
            `MPCSolution` with the broadcast batch dimensions.

        Raises:
            SolveError: an element was not solved and on_failure="raise".
            InvalidInputError and its kinds: an argument does not fit; nothing was solved.
        """
        smooth = self.training_relaxation if self.training else None
        settings = (self.horizon, self.relaxation if smooth is None else smooth, self.barrier)
        extras = (reference, u_min, u_max, bounds, cost, constraints, context)
        plain = not any(value is not None for value in extras) and not forward_mode_active()
        given = Given(x0, goal, lcs)
        again = self._repeat.plan(self, settings, given, guess) if plain else None
        if again is not None:
            plan, start = again
            outputs = plan.run(start, x0)
        else:
            system = self.lcs if lcs is None else check_system(lcs)
            check_tensor("x0", x0, [("n_x", system.n_x)])
            inputs = Inputs(self.horizon)
            inputs.add_system(system, x0, context)
            inputs.add_cost(self.cost if cost is None else check_cost(cost), goal, reference)
            bounds = self.bounds if bounds is None else check_stage_bounds(bounds, u_min=u_min, u_max=u_max)
            if bounds is None:
                inputs.tensors |= dict(zip(("u_min", "u_max"), self.limits(system), strict=True))
            else:
                inputs.add_bounds(bounds)
            inputs.replace_bound("u_min", u_min)
            inputs.replace_bound("u_max", u_max)
            inputs.add_constraints(self.constraints if constraints is None else check_constraints(constraints))
            inputs.tensors["x0"] = x0
            plan = self._plan(settings, inputs)
            outputs = solve(plan, inputs.tensors, check_guess(guess, plan.batch, self.horizon, inputs.sizes))
            if plain and type(self).limits is LCSMPCLayer.limits:  # another's bounds may depend on anything
                self._repeat.keep(self, settings, plan, given, inputs.sizes)
        if plan.unseen or not plan.result.all_converged:
            self._report(plan.result.status, plan.own)
        return MPCSolution(*outputs, problem=plan.problem)

    def _plan(self, settings: tuple, inputs: Inputs) -> Plan:
        """How to solve what a call asks."""
        tensors, unseen = inputs.tensors, transforms_active()
        if not unseen:
            refuse_tangents(tensors.values())
        needs_grad = torch.is_grad_enabled() and (unseen or any(t.requires_grad for t in tensors.values()))
        single = needs_grad and any(t.dtype == torch.float32 for t in tensors.values())
        return Plan(
            self.backend,
            *settings,
            by_stage=frozenset(inputs.by_stage),
            dtype=tensors["x0"].dtype,
            smallest=torch.float32 if single else torch.float64,
            batch=inputs.batch(),
            own=needs_grad,
            unseen=unseen,
        )

    def controller(self, on_failure: OnFailure = "hold", time_limit: float | None = None) -> MPCController:
        """A controller of one robot with this layer's problem as it is now: NumPy in and out, warm, microseconds.

        Args:
            on_failure: "hold", "unfinished", "zero", "raise" or an action (n_u,), see `MPCController`.
            time_limit: seconds of one step, that of the backend if None.
        """
        return MPCController(self, on_failure, time_limit)

    def _report(self, status: Tensor, needs_grad: bool) -> None:
        degenerate = int((status == Status.DEGENERATE).sum())
        failed = torch.nonzero(~solved(status)).squeeze(-1).tolist()
        if degenerate and needs_grad:
            warnings.warn(
                f"{degenerate} of {len(status)} solutions are not classically differentiable (a weakly active bound or "
                f"a singular reduced Hessian); their gradient is a regularised one. See MPCSolution.status",
                DegenerateWarning,
                stacklevel=_stacklevel(),
            )
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
            warnings.warn(
                f"{message}. Their actions are the last iterate inside the bounds and their gradient is zero "
                f"(this layer warns once)",
                SolveWarning,
                stacklevel=_stacklevel(),
            )


def _stacklevel() -> int:
    """Where a warning points to: the line that called the layer, outside this package and torch."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back and frame.f_globals.get("__name__", "").split(".")[0] in ("difflcs", "torch"):
        level, frame = level + 1, frame.f_back
    return level
