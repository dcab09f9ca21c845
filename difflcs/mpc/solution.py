"""Solutions of the MPC."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import InitVar, dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import register_pytree_node, tree_map

from difflcs._checks import describe_shapes
from difflcs._differentiation import is_wrapped
from difflcs._optional import require
from difflcs.errors import BatchIndexError
from difflcs.mpc.problem import MPCProblem
from difflcs.records import index_batch
from difflcs.status import Status, solved

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Primal(NamedTuple):
    """A trajectory: x (..., H+1, n_x), u (..., H, n_u), lam (..., H, n_lam). Usable as a guess.

    mu (..., H+1, n_c) are the multipliers of the constraints. A guess may leave them out; solvers always return them.
    """

    x: Tensor
    u: Tensor
    lam: Tensor
    mu: Tensor = None  # pyright: ignore[reportAssignmentType]


@dataclass(frozen=True, repr=False)
class MPCSolution:
    """Solutions of a batch of MPC problems, each with its certificate.

    Attributes:
        x: (..., H+1, n_x) planned states, x[..., 0, :] = x0. Differentiable, as u, lam and objective.
        u: (..., H, n_u) planned actions.
        lam: (..., H, n_lam) complementarity variables.
        mu: (..., H+1, n_c) multipliers of the constraints: the cost that one more unit of g would save. Detached.
        objective: (...) cost of the plan.
        status: (...) `Status` as int8.
        iterations: (...) iterations of the solver, int32, from all its starts; those of variations of a plan that were
            given up before they were solved are left out.
        kkt_residual: (...) largest violation of the optimality conditions by the numbers above, dimensionless; at most
            1e-6 where an exact backend has solved the plan. See `kkt.residual`, or a bound of it below 1e-12.
        solve_time: (...) seconds spent on each problem.
        violation: (...) largest violation of a constraint over the stages, soft ones too [its units]; 0 without any.
            For an INFEASIBLE problem it is what remains at a plan that violates as little as possible.
    """

    x: Tensor
    u: Tensor
    lam: Tensor
    mu: Tensor
    objective: Tensor
    status: Tensor
    iterations: Tensor
    kkt_residual: Tensor
    solve_time: Tensor
    violation: Tensor
    of: InitVar[MPCProblem]

    def __post_init__(self, of: MPCProblem) -> None:
        self.__dict__["_problem"] = of

    def __repr__(self) -> str:
        tensors = {name: getattr(self, name) for name in ("x", "u", "lam", "mu")}
        text = f"MPCSolution({describe_shapes(tensors)}"
        if self.status.numel() and not is_wrapped(self.status):
            codes = self.status.flatten().tolist()
            text += "; status " + ", ".join(f"{codes.count(c)} {Status(c).name}" for c in sorted(set(codes)))
            for name in ("objective", "kkt_residual", "violation"):
                text += f"; {name} ≤ {float(getattr(self, name).detach().max()):.3g}"
        return text + ")"

    @property
    def problem(self) -> MPCProblem:
        """The problem that was solved. It is not a field, so that a TensorDict of the fields has the batch's shape."""
        return self.__dict__["_problem"]

    @property
    def action(self) -> Tensor:
        """First action, (..., n_u): what a receding-horizon controller executes."""
        return self.u[..., 0, :]

    @property
    def converged(self) -> Tensor:
        """(...) bool: the plan can be used (CONVERGED or DEGENERATE)."""
        return solved(self.status)

    def detach(self) -> MPCSolution:
        """Return the solutions without the graph, so that they can be kept or copied."""
        return tree_map(Tensor.detach, self)

    def __getitem__(self, index: Any) -> MPCSolution:
        """Select solutions: an integer, slice, tensor, or a tuple of these, of the batch dimensions alone.

        Raises:
            BatchIndexError: there are no batch dimensions, or not these; or this is inside of `torch.func.vmap`.
        """
        if is_wrapped(self.status):
            raise BatchIndexError("MPCSolution: expected an index outside of vmap, got one inside; index its result")
        batch = self.status.shape
        tensors, _ = _flatten(self)
        places = torch.arange(batch.numel(), device=self.status.device).reshape(batch)
        *tensors, places = (index_batch("MPCSolution", v, batch, index) for v in (*tensors, places))
        return MPCSolution(*tensors, of=self.problem.select(places.flatten().cpu()))

    def __iter__(self) -> Iterator[MPCSolution]:
        """Iterate over the solutions along the first batch dimension."""
        return (self[i] for i in range((self.status.shape or (1,))[0]))

    def complementarity(self) -> Tensor:
        """(...) largest |λ·s − relaxation| over the horizon."""
        x, u, lam = self._flat()
        slack = self.problem.steps().gap(*_by_step(x[:, :-1], u, lam))
        worst = largest((slack * lam.transpose(0, 1) - self.problem.relaxation).abs())
        return worst.reshape(self.status.shape).to(self.status.device)

    def dynamics_residual(self) -> Tensor:
        """(...) largest |x_{k+1} − (A x_k + B u_k + C λ_k + d)| over the horizon."""
        x, u, lam = self._flat()
        predicted = self.problem.steps().next_state(*_by_step(x[:, :-1], u, lam))
        worst = largest((x[:, 1:].transpose(0, 1) - predicted).abs())
        return worst.reshape(self.status.shape).to(self.status.device)

    def shift(self) -> Primal:
        """Shift the plan by one step and repeat its last: a guess for the next solve of a receding horizon."""
        parts = (self.x, self.u, self.lam, self.mu)
        return Primal(*(torch.cat([v[..., 1:, :], v[..., -1:, :]], -2).detach() for v in parts))

    def plot(self, element: int = 0) -> Figure:
        """Draw a plan: states, actions between their bounds, forces and gaps; needs matplotlib.

        Args:
            element: of a batch, counted through all its dimensions.

        Raises:
            BatchIndexError: there is no such element.
            MissingDependencyError: matplotlib is not installed.
        """
        count = self.status.numel()
        if not -count <= element < count:
            raise BatchIndexError(f"element: expected one of a batch of {count}, got {element}; choose another")
        x, u, lam = self._flat()
        gap = self.problem.steps().gap(*_by_step(x[:, :-1], u, lam)).transpose(0, 1)
        bounds = [bound.expand(u.shape)[element] for bound in self.problem.bounds()]
        status, cost = Status(int(self.status.flatten()[element])).name, self.objective.detach().flatten()[element]
        title = f"{status}, cost {float(cost):.4g}"
        return draw_trajectory(x[element], u[element], lam[element], gap[element], bounds, title)

    def _flat(self) -> tuple[Tensor, Tensor, Tensor]:
        return tuple(  # pyright: ignore[reportReturnType]
            v.detach().to("cpu", torch.float64).reshape(self.status.numel(), *v.shape[-2:])
            for v in (self.x, self.u, self.lam)
        )


def draw_trajectory(x: Tensor, u: Tensor, lam: Tensor, gap: Tensor, bounds: Sequence[Tensor], title: str) -> Figure:
    """Draw states (T+1, n_x), actions (T, n_u) between bounds of their shape, forces and gaps (T, n_lam)."""
    require("matplotlib")
    from difflcs._figure import page_figure

    with page_figure() as figure:
        panels = figure.subplots(2, 2, sharex=True).flat
        parts = {"states x": x, "actions u": u, "forces λ": lam, "gaps": gap}
        for axes, (name, values) in zip(panels, parts.items(), strict=True):
            for i, row in enumerate(values.T.numpy()):
                # A state is at a stage; the rest holds from one stage to the next.
                axes.plot(row, ".-", label=i) if values is x else axes.stairs(row, baseline=None, lw=1.5, label=i)
            for bound in bounds if values is u else ():
                for i, row in enumerate(bound.T.numpy()):
                    if np.isfinite(row).all():
                        axes.stairs(row, baseline=None, ls=":", color=f"C{i}")
            axes.xaxis.get_major_locator().set_params(integer=True)
            axes.set(title=name, xlabel="" if values is x or values is u else "stage")
            if 0 < values.shape[1] <= 10:
                axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), handlelength=0.7, borderpad=0, frameon=False)
        figure.suptitle(title)
    return figure


def largest(values: Tensor) -> Tensor:
    """Compute the largest of (steps, batch, n) per batch element, (batch,); 0 if there is none, NaN if one is."""
    values = values.transpose(0, 1).flatten(1)
    return values.amax(1) if values.shape[1] else values.new_zeros(len(values))


def _by_step(*trajectories: Tensor) -> tuple[Tensor, ...]:
    # (batch, steps, n) → (steps, batch, n), so that per-element matrices broadcast over the steps.
    return tuple(v.transpose(0, 1) for v in trajectories)


class _Kept:
    """Problem that a tree of tensors carries along; equal only to itself, as tensors cannot be compared as a whole."""

    def __init__(self, problem: MPCProblem):
        self.problem = problem


def _flatten(solution: MPCSolution) -> tuple[list[Tensor], _Kept]:
    return [getattr(solution, name) for name in _TENSORS], _Kept(solution.problem)


# So that `torch.func.vmap(layer)(x0)` returns a solution.
_TENSORS = tuple(f.name for f in fields(MPCSolution))
register_pytree_node(MPCSolution, _flatten, lambda tensors, kept: MPCSolution(*tensors, of=kept.problem))
