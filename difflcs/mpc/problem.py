"""The MPC problem that a backend solves: numbers only, checked once."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import check_number, check_positive_int
from difflcs._linalg import matvec, quadratic
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.constraints import check_bounds, check_prices
from difflcs.errors import ShapeError
from difflcs.lcp import solve_lcp_arrays
from difflcs.records import SystemMatrices, dimensions


@dataclass(frozen=True)
class StageData(SystemMatrices):
    """The data of one stage, or of all stages: system, cost, bounds and constraints.

    Of one stage every field broadcasts with (batch, ...); of all of them with (H, batch, ...), or (H+1, batch, ...)
    for G_x, g and price. The names are those of `MPCProblem`.
    """

    Q: Annotated[Tensor, "n_x", "n_x"]
    R: Annotated[Tensor, "n_u", "n_u"]
    S: Annotated[Tensor, "n_x", "n_u"]
    q: Annotated[Tensor, "n_x"]
    r: Annotated[Tensor, "n_u"]
    u_min: Annotated[Tensor, "n_u"]
    u_max: Annotated[Tensor, "n_u"]
    G_x: Annotated[Tensor, "n_c", "n_x"]
    G_u: Annotated[Tensor, "n_c", "n_u"]
    g: Annotated[Tensor, "n_c"]
    price: Annotated[Tensor, "n_c"]


@dataclass(frozen=True)
class MPCProblem(SystemMatrices):
    """A batch of LCS-MPC problems (Eq. 3 of the paper) with relaxed complementarity.

        min Σ_{k<H} ½x_kᵀQx_k + qᵀx_k + ½u_kᵀRu_k + rᵀu_k + x_kᵀSu_k + ½x_HᵀQ_final x_H + q_finalᵀx_H
            + Σ_{k≤H} Σ_i price_i·max(0, (G_x x_k + G_u u_k − g)_i)       (rows with a finite price)
        s.t. x_{k+1} = A x_k + B u_k + C λ_k + d,  s_k = D x_k + E u_k + F λ_k + c,
             λ_k ∘ s_k = relaxation,  λ_k, s_k ≥ 0,  u_min ≤ u_k ≤ u_max,
             G_x x_k + G_u u_k ≤ g for k ≤ H, without actions at k = H   (rows with an infinite price).

    With barrier > 0 the cost also has −barrier·Σ (log(u_k − u_min) + log(u_max − u_k)), which keeps actions off their
    bounds and so makes them differentiable everywhere.

    Tensors are float64 on the CPU and detached. x0 is (batch, n_x). Every other one has, in front of the dimensions
    that its annotation names, none (shared by batch and stages), the batch (shared by the stages), or the batch and the
    stages, where a batch of 1 is shared. `STAGES` says how many stages a field has: H, or H + 1 for G_x, g and price;
    Q_final, q_final and x0 have none.

    Attributes:
        A, B, C, d, D, E, F, c: the LCS, see `difflcs.LCSParams`.
        Q, R, S, Q_final, q, r, q_final: the cost, see `difflcs.QuadraticCost`; Q, R, Q_final symmetric; S zero if left
            out.
        u_min, u_max: bounds of the actions; infinite for none.
        G_x, G_u, g, price: constraints, n_c rows; none if left out. g = ∞: none at this stage. price = ∞: hard.
        x0: (batch, n_x) initial states.
        horizon: H ≥ 1 steps.
        relaxation: product λ·s > 0; the smaller, the closer to hard contact.
        barrier: weight ≥ 0 of the logarithmic barrier of the action bounds.

    Raises:
        ShapeError, BoundsError, InvalidInputError: inconsistent shapes, u_min > u_max, horizon < 1, relaxation ≤ 0, a
            price that is not positive.
    """

    Q: Annotated[Tensor, "n_x", "n_x"]
    R: Annotated[Tensor, "n_u", "n_u"]
    S: Annotated[Tensor, "n_x", "n_u"] = field(default=None, kw_only=True)  # pyright: ignore
    Q_final: Annotated[Tensor, "n_x", "n_x"]
    q: Annotated[Tensor, "n_x"]
    r: Annotated[Tensor, "n_u"]
    q_final: Annotated[Tensor, "n_x"]
    u_min: Annotated[Tensor, "n_u"]
    u_max: Annotated[Tensor, "n_u"]
    G_x: Annotated[Tensor, "n_c", "n_x"] = field(default=None, kw_only=True)  # pyright: ignore
    G_u: Annotated[Tensor, "n_c", "n_u"] = field(default=None, kw_only=True)  # pyright: ignore
    g: Annotated[Tensor, "n_c"] = field(default=None, kw_only=True)  # pyright: ignore
    price: Annotated[Tensor, "n_c"] = field(default=None, kw_only=True)  # pyright: ignore
    x0: Annotated[Tensor, "n_x"]
    horizon: int
    relaxation: float
    barrier: float = 0.0

    def __post_init__(self) -> None:
        numbers = {"horizon": check_positive_int("horizon", self.horizon)}
        numbers |= {"relaxation": check_number("relaxation", self.relaxation, strict=True)}
        vars(self).update(numbers, barrier=check_number("barrier", self.barrier))
        if self.g is None:
            object.__setattr__(self, "g", self.x0.new_zeros(0))
        batch, sizes = self.batch, {dim: getattr(self, dim) for dim in ("n_x", "n_u", "n_lam", "n_c")}
        for name in ("S", "G_x", "G_u", "price"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, self.x0.new_zeros([sizes[dim] for dim in INPUTS[name]]))
        for name, dims in INPUTS.items():
            expected, actual = tuple([sizes[dim] for dim in dims]), getattr(self, name).shape
            if actual == (batch, *expected) or (actual == expected and name != "x0"):
                continue
            allowed = [(batch, *expected)] if name == "x0" else [expected, (batch, *expected)]
            if stages := self.stages(name):
                allowed += [(1, stages, *expected), (batch, stages, *expected)]
            if actual not in allowed:
                raise ShapeError(f"{name}: expected {' or '.join(map(str, allowed))}, got {tuple(actual)}")
        self._check_numbers(INPUTS)

    def _check_numbers(self, names: Iterable[str]) -> None:
        if "u_min" in names or "u_max" in names:
            low, high = self.bounds() if self.by_stage("u_min") or self.by_stage("u_max") else (self.u_min, self.u_max)
            if self.barrier > 0 or not bool((low < high).all()):  # else neither is infinite the wrong way
                check_bounds(low, high, strict=self.barrier > 0)
        if "price" in names and self.n_c:
            check_prices("price", self.price)

    def with_inputs(self, values: Mapping[str, Tensor]) -> MPCProblem:
        """Make the problem with other inputs; only their shapes and numbers are checked.

        Raises:
            ShapeError, BoundsError, InvalidInputError: they do not fit the others.
        """
        known = vars(self)
        if any([value.shape != known[name].shape for name, value in values.items()]):
            return replace(self, **values)
        other = object.__new__(MPCProblem)
        fields = vars(other)
        fields.update(known, **values)
        fields["arrays"] = arrays = self.arrays.copy()
        for name, value in values.items():
            arrays[_ORDER[name]] = array(value)
        other._check_numbers(values)
        return other

    def with_x0(self, x0: Tensor) -> MPCProblem:
        """Make the problem from other states, as many as before."""
        other = object.__new__(MPCProblem)
        arrays = self.arrays.copy()
        arrays[_ORDER["x0"]] = array(x0)
        vars(other).update(vars(self), x0=x0, arrays=arrays)
        return other

    def copy(self) -> MPCProblem:
        """Make a copy that shares no memory with this one."""
        return replace(self, **{name: getattr(self, name).clone() for name in INPUTS})

    @functools.cached_property
    def arrays(self) -> list[np.ndarray]:
        """The inputs as arrays, in their order, for the kernels."""
        return [array(getattr(self, name)) for name in INPUTS]

    @property
    def batch(self) -> int:
        """Number of problems."""
        return self.x0.shape[0]

    @property
    def n_c(self) -> int:
        """Number of constraints of a stage."""
        return self.g.shape[-1]

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the dimensions of one input without the batch and the stages."""
        return tuple(getattr(self, dim) for dim in INPUTS[name])

    def stages(self, name: str) -> int:
        """Return the number of stages of an input that may vary by stage; 0 of one that cannot."""
        return {"": 0, "H": self.horizon, "H+1": self.horizon + 1}[STAGES[name]]

    def by_stage(self, name: str) -> bool:
        """Return whether this input varies by stage."""
        return getattr(self, name).ndim == len(INPUTS[name]) + 2

    def shared(self, name: str) -> bool:
        """Return whether the whole batch shares this input."""
        value = getattr(self, name)
        return value.ndim == len(INPUTS[name]) or (self.by_stage(name) and value.shape[0] == 1)

    def stage(self, k: int) -> StageData:
        """Return the data of stage k, broadcasting with (batch, ...). At k = H only G_x, g and price have a meaning."""
        at = {"H": min(k, self.horizon - 1), "H+1": k}
        return StageData(
            **{name: v[:, at[STAGES[name]]] if self.by_stage(name) else v for name, v in self._stagewise().items()}
        )

    def steps(self) -> StageData:
        """Return the data of all stages, stages first: broadcasting with (H, batch, ...), see `StageData`."""
        return StageData(
            **{name: v.transpose(0, 1) if self.by_stage(name) else v for name, v in self._stagewise().items()}
        )

    def _stagewise(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name, stages in STAGES.items() if stages}

    def batch_first(self, name: str) -> Tensor:
        """Return one input, broadcasting with (batch, H, ...)."""
        value = getattr(self, name)
        return value.unsqueeze(1) if value.ndim == len(INPUTS[name]) + 1 else value

    def no_multipliers(self) -> Tensor:
        """Return multipliers of the constraints that are all zero, (batch, H+1, n_c)."""
        return torch.zeros(self.batch, self.horizon + 1, self.n_c, dtype=torch.float64)

    def objective(self, x: Tensor, u: Tensor) -> Tensor:
        """Compute the cost (batch,) of trajectories x (batch, H+1, n_x), u (batch, H, n_u)."""
        Q, R, q, r = (self.batch_first(name) for name in ("Q", "R", "q", "r"))
        stages = 0.5 * quadratic(Q, x[:, :-1]) + (q * x[:, :-1]).sum(-1) + 0.5 * quadratic(R, u) + (r * u).sum(-1)
        if bool(self.S.any()):
            stages = stages + (x[:, :-1] * matvec(self.batch_first("S"), u)).sum(-1)
        total = 0.5 * quadratic(self.Q_final, x[:, -1]) + (self.q_final * x[:, -1]).sum(-1)
        # A running sum, from the first stage to the last: the order of a sum must not depend on the batch.
        total = torch.cat([total.unsqueeze(1), stages], 1).cumsum(1)[:, -1]
        if self.barrier > 0:
            below, above = self.distances(u)
            total = total - self.barrier * (below.log() + above.log()).sum((1, 2))
        return total + self._penalties(x, u) if self.n_c else total

    def constraints(self, x: Tensor, u: Tensor) -> Tensor:
        """Compute G_x x + G_u u − g of trajectories, (batch, H+1, n_c); −∞ where there is no constraint."""
        return self.rows(x, u) - self.batch_first("g")

    def rows(self, x: Tensor, u: Tensor) -> Tensor:
        """Compute G_x x + G_u u of trajectories, or of directions, (batch, H+1, n_c)."""
        value = matvec(self.batch_first("G_x"), x)
        value[:, :-1] += matvec(self.batch_first("G_u"), u)
        return value

    def violation(self, x: Tensor, u: Tensor) -> Tensor:
        """Compute the largest violation (batch,) of the constraints, soft ones too; 0 if they hold."""
        if self.n_c == 0:
            return x.new_zeros(len(x))
        return self.constraints(x, u).clamp_min(0.0).amax((1, 2))

    def _penalties(self, x: Tensor, u: Tensor) -> Tensor:
        price = self.batch_first("price")
        penalties = torch.where(torch.isinf(price), 0.0, price) * self.constraints(x, u).clamp_min(0.0)
        total = penalties[:, self.horizon].sum(-1)
        for k in range(self.horizon):
            total = total + penalties[:, k].sum(-1)
        return total

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Return u_min and u_max, broadcasting with (batch, H, n_u)."""
        low, high = (self.batch_first(name) for name in ("u_min", "u_max"))
        return low, high

    def distances(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the distances u − u_min and u_max − u of actions (batch, H, n_u) to their bounds."""
        low, high = self.bounds()
        return u - low, high - u

    def rollout(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the trajectory of actions u (batch, H, n_u): x (batch, H+1, n_x) and λ (batch, H, n_lam)."""
        states, forces = [self.x0], []
        for k in range(self.horizon):
            stage = self.stage(k)
            gap = stage.gap(states[-1], u[:, k])
            F = stage.F[0] if stage.F.ndim == 3 and len(stage.F) == 1 else stage.F
            lam = torch.from_numpy(solve_lcp_arrays(F.numpy(), gap.numpy(), self.relaxation)[0]) if self.n_lam else gap
            states.append(stage.next_state(states[-1], u[:, k], lam))
            forces.append(lam)
        return torch.stack(states, 1), torch.stack(forces, 1)

    def clip(self, u: Tensor) -> Tensor:
        """Clip actions (batch, H, n_u) into the bounds."""
        low, high = self.bounds()
        return torch.minimum(torch.maximum(u, low), high)

    def start(self, u: Tensor) -> Tensor:
        """Move actions (batch, H, n_u) to a start: clipped, and with a barrier 1 % of the range off the bounds."""
        low, high = self.bounds()
        margin = 0.01 * (high - low) if self.barrier > 0 else 0.0
        return torch.minimum(torch.maximum(u, low + margin), high - margin)

    def clip_inside(self, u: Tensor, inside: Tensor) -> Tensor:
        """Move actions (batch, H, n_u) from `inside` towards `u`, at most nine tenths of the way to a bound."""
        below, above = self.distances(inside)
        return torch.minimum(torch.maximum(u, inside - 0.9 * below), inside + 0.9 * above)

    def select(self, index: Tensor) -> MPCProblem:
        """Select the problems at some batch indices."""
        chosen = {k: getattr(self, k) if self.shared(k) else getattr(self, k)[index] for k in INPUTS}
        return replace(self, **chosen)


def array(value: Tensor) -> np.ndarray:
    """Return the memory of a tensor on the CPU, or of a contiguous copy of it."""
    return value.contiguous().numpy()


# Differentiable inputs with the kind of each trailing dimension, in the order in which autograd and the kernels take
# them; and the number of stages of those that may vary by stage.
INPUTS: dict[str, tuple[str, ...]] = dimensions(MPCProblem)
_ORDER = {name: i for i, name in enumerate(INPUTS)}
STAGES: dict[str, str] = {
    name: "H+1" if name in ("G_x", "g", "price") else "" if name in ("Q_final", "q_final", "x0") else "H"
    for name in INPUTS
}
# Inputs that may be infinite: no bound, no constraint, a hard one.
MAY_BE_INFINITE = ("u_min", "u_max", "g", "price")

if list(INPUTS.items()) != list(_kernels.mpc_fields().items()) or _kernels.mpc_stages() != STAGES:
    raise ImportError(
        "difflcs: the compiled kernels were built for other fields of the MPC problem than those of this version; "
        "build them again, in a checkout by `pip install -e .`"
    )
