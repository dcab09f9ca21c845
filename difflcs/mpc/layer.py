"""LCS-MPC as a PyTorch layer: validate, call a backend, wrap."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor, nn

from difflcs._checks import (
    broadcast_batch,
    check_choice,
    check_number,
    check_positive_int,
    check_same_device,
    check_tensor,
    describe,
)
from difflcs.cost import GoalCost, QuadraticCost
from difflcs.errors import DegenerateWarning, DTypeError, ShapeError, SolveError, SolveWarning
from difflcs.lcs import LCSModel, LCSParams
from difflcs.mpc.autograd import SolveMPC
from difflcs.mpc.backends import Backend, get_backend
from difflcs.mpc.problem import INPUTS, MPCProblem, check_bounds
from difflcs.mpc.solution import MPCSolution, Primal
from difflcs.status import Status, solved

Bound = float | Tensor | nn.Parameter


class LCSMPCLayer(nn.Module):
    """Model predictive control through a linear complementarity system (Eq. mpc_lcs), differentiable in every input.

    Solves, for each batch element, the problem of `difflcs.mpc.MPCProblem`, and differentiates its solution with
    respect to the LCS, the cost, the bounds, x0 and the goal by perturbation of the optimality conditions
    (`difflcs.mpc.kkt`). Everything is solved in float64 on the CPU; results come back in x0's dtype and on x0's device.

    Args:
        lcs: an `LCSModel` (its parameters become this layer's), or `LCSParams`, shared or one per batch element.
        cost: a `GoalCost`, called with the goal, or a `QuadraticCost`.
        horizon: H ≥ 1 steps.
        u_min: lower bound of the actions: a number, or a tensor (n_u,) or (..., n_u); learned if an nn.Parameter.
        u_max: upper bound, likewise.
        backend: name of a registered backend, or an instance with options.
        relaxation: λ·s of the relaxed complementarity, > 0.
        training_relaxation: relaxation in training mode (`layer.train()`), if another; `layer.eval()` returns to
            `relaxation`. A larger one gives smoother gradients across contacts.
        barrier: weight of a logarithmic barrier of the action bounds [cost units]; 0 for none. An action at a bound has
            zero gradient; with a barrier it keeps a small distance and a gradient. The objective includes the barrier.
            Sensible weights are 1e-3 to 1e-1 of the objective; far smaller ones make the problem stiff.
        on_failure: "raise" a `SolveError` when an element is not solved, or "mask" it: finite numbers inside the
            bounds, zero gradient, one `SolveWarning` per layer.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
        BackendNotFoundError: unknown backend, or its package is missing.
    """

    u_min: Tensor
    u_max: Tensor

    def __init__(
        self,
        lcs: LCSModel | LCSParams,
        cost: GoalCost | QuadraticCost,
        horizon: int,
        u_min: Bound,
        u_max: Bound,
        backend: str | Backend = "batched",
        relaxation: float = 1e-5,
        on_failure: str = "raise",
        *,
        training_relaxation: float | None = None,
        barrier: float = 0.0,
    ):
        super().__init__()
        if not isinstance(lcs, LCSModel | LCSParams):
            raise DTypeError(f"lcs: expected LCSModel or LCSParams, got {describe(lcs)}")
        if not isinstance(cost, GoalCost | QuadraticCost):
            raise DTypeError(f"cost: expected GoalCost or QuadraticCost, got {describe(cost)}")
        if (cost.n_x, cost.n_u) != (lcs.n_x, lcs.n_u):
            raise ShapeError(
                f"cost: expected n_x={lcs.n_x}, n_u={lcs.n_u} like the LCS, got n_x={cost.n_x}, n_u={cost.n_u}"
            )
        self.lcs = lcs
        self.cost = cost
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
        for name, value in (("u_min", u_min), ("u_max", u_max)):
            value = self._bound(name, value)
            if isinstance(value, nn.Parameter):
                self.register_parameter(name, value)
            else:
                self.register_buffer(name, value, persistent=False)
        check_bounds(self.u_min, self.u_max, strict=self.barrier > 0)
        self._warned = False

    def extra_repr(self) -> str:
        """What print(layer) shows."""
        return (
            f"horizon={self.horizon}, relaxation={self.relaxation:g}, backend={self.backend}, "
            f"on_failure={self.on_failure!r}"
        )

    def forward(
        self,
        x0: Tensor,
        goal: Tensor | None = None,
        *,
        guess: MPCSolution | Primal | None = None,
        u_min: Bound | None = None,
        u_max: Bound | None = None,
    ) -> MPCSolution:
        """Plan from states.

        Args:
            x0: (..., n_x) initial states, float32 or float64.
            goal: (..., n_goal), with a `GoalCost` only. Batch dimensions broadcast with those of x0.
            guess: warm start for the same batch, such as `solution.shift()`.
            u_min: bound for this call instead of the layer's.
            u_max: likewise.

        Returns:
            `MPCSolution` with the broadcast batch dimensions.

        Raises:
            SolveError: an element was not solved and on_failure="raise".
            InvalidInputError and its kinds: an argument does not fit; nothing was solved.
        """
        check_tensor("x0", x0, [("n_x", self.lcs.n_x)])
        lcs = self.lcs.params() if isinstance(self.lcs, LCSModel) else self.lcs
        cost = self._quadratic(goal)
        bounds = {
            "u_min": self.u_min if u_min is None else self._bound("u_min", u_min),
            "u_max": self.u_max if u_max is None else self._bound("u_max", u_max),
        }
        nothing = x0.new_zeros(0)
        none = {"G_x": x0.new_zeros(0, lcs.n_x), "G_u": x0.new_zeros(0, lcs.n_u), "g": nothing, "price": nothing}
        fields = {**cost.fields(), "S": x0.new_zeros(lcs.n_x, lcs.n_u), **none}
        tensors = {**lcs.tensors(), **fields, **bounds, "x0": x0}
        check_same_device(reversed(tensors.items()))
        ndim = {name: len(dims) for name, dims in INPUTS.items()}
        leading = [(name, tensors[name].shape[: tensors[name].ndim - ndim[name]]) for name in INPUTS]
        batch = broadcast_batch([*reversed(leading), ("constant", cost.constant.shape)])
        flat = []
        for name in INPUTS:
            tensor = tensors[name].to("cpu", torch.float64)
            if name == "x0" or tensor.ndim > ndim[name]:
                own = tensor.shape[tensor.ndim - ndim[name] :]
                tensor = tensor.expand(*batch, *own).reshape(-1, *own)
            flat.append(tensor)
        values = {name: tensor.detach().contiguous() for name, tensor in zip(INPUTS, flat, strict=True)}
        smooth = self.training_relaxation if self.training else None
        relaxation = self.relaxation if smooth is None else smooth
        problem = MPCProblem(**values, horizon=self.horizon, relaxation=relaxation, barrier=self.barrier)
        constant = cost.constant.detach().to("cpu", torch.float64).expand(batch).reshape(-1)
        smallest = torch.float32 if any(t.dtype == torch.float32 for t in tensors.values()) else torch.float64
        outputs = SolveMPC.apply(problem, self.backend, self._guess(guess, batch), x0.dtype, smallest, constant, *flat)
        *primal, objective, status, iterations, residual, seconds, violation = outputs  # pyright: ignore[reportGeneralTypeIssues]
        self._report(status, torch.is_grad_enabled() and any(t.requires_grad for t in flat))

        def shaped(value: Tensor) -> Tensor:
            return value.reshape((*batch, *value.shape[1:])).to(x0.device)

        return MPCSolution(
            *(shaped(v) for v in primal),
            objective=(shaped(objective) + cost.constant).to(x0.dtype),
            status=shaped(status),
            iterations=shaped(iterations),
            kkt_residual=shaped(residual),
            solve_time=shaped(seconds),
            violation=shaped(violation),
            problem=problem,
        )

    def _quadratic(self, goal: Tensor | None) -> QuadraticCost:
        if isinstance(self.cost, QuadraticCost):
            if goal is not None:
                raise ShapeError("goal: expected none with a QuadraticCost, got one; use a GoalCost to plan to goals")
            return self.cost
        if goal is None:
            raise ShapeError(
                f"goal: expected (..., n_goal={self.cost.n_goal}) with a GoalCost, got none; call mpc(x0, goal)"
            )
        return self.cost(goal, horizon=self.horizon)

    def _bound(self, name: str, value: Bound) -> Tensor:
        n_u = self.lcs.n_u
        if isinstance(value, int | float) and not isinstance(value, bool):
            return check_tensor(name, torch.full((n_u,), float(value), dtype=torch.float64, device=self.lcs.A.device))
        return check_tensor(name, value, [("n_u", n_u)])

    def _guess(self, guess: MPCSolution | Primal | None, batch: torch.Size) -> Primal | None:
        if guess is None:
            return None
        if not isinstance(guess, MPCSolution | Primal):
            raise DTypeError(
                f"guess: expected an MPCSolution or a Primal such as solution.shift(), got {describe(guess)}"
            )
        dims = {
            "x": [("H+1", self.horizon + 1), ("n_x", self.lcs.n_x)],
            "u": [("H", self.horizon), ("n_u", self.lcs.n_u)],
            "lam": [("H", self.horizon), ("n_lam", self.lcs.n_lam)],
        }
        flat = []
        for name, dim in dims.items():
            value = check_tensor(f"guess.{name}", getattr(guess, name), dim)
            if value.shape[:-2] != batch:
                raise ShapeError(
                    f"guess.{name}: expected batch dimensions {tuple(batch)} like x0, got {tuple(value.shape[:-2])}"
                )
            flat.append(value.detach().to("cpu", torch.float64).reshape(-1, *value.shape[-2:]))
        return Primal(*flat, torch.zeros(len(flat[0]), self.horizon + 1, 0, dtype=torch.float64))

    def _report(self, status: Tensor, needs_grad: bool) -> None:
        degenerate = int((status == Status.DEGENERATE).sum())
        failed = torch.nonzero(~solved(status)).squeeze(-1).tolist()
        if degenerate and needs_grad:
            warnings.warn(
                f"{degenerate} of {len(status)} solutions are not classically differentiable (a weakly active bound or "
                f"a singular reduced Hessian); their gradient is a regularised one. See MPCSolution.status",
                DegenerateWarning,
                stacklevel=4,
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
                stacklevel=4,
            )
