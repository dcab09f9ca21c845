"""The MPC problem a backend solves: numbers only, checked once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from difflcs._checks import broadcast_batch, check_number, check_positive_int, check_same_device
from difflcs._linalg import quadratic
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.errors import BoundsError, ShapeError
from difflcs.lcp import solve_lcp_arrays
from difflcs.lcs import SystemMatrices, dimensions


def check_bounds(u_min: Tensor, u_max: Tensor, strict: bool = False) -> None:
    """Refuse bounds that do not broadcast, live on different devices, or cross (`strict`: or touch)."""
    broadcast_batch([("u_min", u_min.shape), ("u_max", u_max.shape)])
    check_same_device([("u_min", u_min), ("u_max", u_max)])
    crossed = u_min >= u_max if strict else u_min > u_max
    if bool(crossed.any()):
        index = tuple(torch.nonzero(crossed)[0].tolist())
        low, high = (float(v.detach().expand_as(crossed)[index]) for v in (u_min, u_max))
        raise BoundsError(
            f"u_min: expected u_min {'<' if strict else '<='} u_max, got {low:g} and {high:g} at index {index}; "
            f"swap or widen the bounds"
        )


@dataclass(frozen=True)
class MPCProblem(SystemMatrices):
    """A batch of LCS-MPC problems (Eq. mpc_lcs) with relaxed complementarity.

        min Σ_{k<H} ½x_kᵀQx_k + qᵀx_k + ½u_kᵀRu_k + rᵀu_k + ½x_HᵀQ_final x_H + q_finalᵀx_H
        s.t. x_{k+1} = A x_k + B u_k + C λ_k + d,  s_k = D x_k + E u_k + F λ_k + c,
             λ_k ∘ s_k = relaxation,  λ_k, s_k ≥ 0,  u_min ≤ u_k ≤ u_max.

    With barrier > 0 the cost also has −barrier·Σ (log(u_k − u_min) + log(u_max − u_k)), which keeps actions off their
    bounds and so makes them differentiable everywhere.

    Tensors are float64 on the CPU and detached. x0 is (batch, n_x); every other one is shared, with exactly the
    dimensions that its annotation names, or has the batch dimension in front.

    Attributes:
        A, B, C, d, D, E, F, c: the LCS, see `difflcs.LCSParams`.
        Q, R, Q_final, q, r, q_final: the cost, see `difflcs.QuadraticCost`; Q, R, Q_final symmetric.
        u_min, u_max: bounds of the actions.
        x0: (batch, n_x) initial states.
        horizon: H ≥ 1 steps.
        relaxation: product λ·s > 0; the smaller, the closer to hard contact.
        barrier: weight ≥ 0 of the logarithmic barrier of the action bounds.

    Raises:
        ShapeError, BoundsError, InvalidInputError: inconsistent shapes, u_min > u_max, horizon < 1, relaxation ≤ 0.
    """

    Q: Annotated[Tensor, "n_x", "n_x"]
    R: Annotated[Tensor, "n_u", "n_u"]
    Q_final: Annotated[Tensor, "n_x", "n_x"]
    q: Annotated[Tensor, "n_x"]
    r: Annotated[Tensor, "n_u"]
    q_final: Annotated[Tensor, "n_x"]
    u_min: Annotated[Tensor, "n_u"]
    u_max: Annotated[Tensor, "n_u"]
    x0: Annotated[Tensor, "n_x"]
    horizon: int
    relaxation: float
    barrier: float = 0.0

    def __post_init__(self) -> None:
        check_positive_int("horizon", self.horizon)
        check_number("relaxation", self.relaxation, strict=True)
        check_number("barrier", self.barrier)
        for name in INPUTS:
            tensor, shape = getattr(self, name), self.shape(name)
            if tuple(tensor.shape) not in ((shape, (self.batch, *shape)) if name != "x0" else ((self.batch, *shape),)):
                raise ShapeError(f"{name}: expected {shape} or {(self.batch, *shape)}, got {tuple(tensor.shape)}")
        check_bounds(self.u_min, self.u_max, strict=self.barrier > 0)

    @property
    def batch(self) -> int:
        """Number of problems."""
        return self.x0.shape[0]

    def shape(self, name: str) -> tuple[int, ...]:
        """Dimensions of one input without the batch."""
        return tuple(getattr(self, dim) for dim in INPUTS[name])

    def shared(self, name: str) -> bool:
        """Whether the whole batch shares this input."""
        return getattr(self, name).ndim == len(INPUTS[name])

    def objective(self, x: Tensor, u: Tensor) -> Tensor:
        """Cost (batch,) of trajectories x (batch, H+1, n_x), u (batch, H, n_u)."""
        # A problem's own cost (batch, ...) holds for all of its stages.
        own = {name: getattr(self, name) for name in ("Q", "R", "q", "r")}
        Q, R, q, r = (v if self.shared(name) else v.unsqueeze(1) for name, v in own.items())
        stages = 0.5 * quadratic(Q, x[:, :-1]) + (q * x[:, :-1]).sum(-1) + 0.5 * quadratic(R, u) + (r * u).sum(-1)
        total = 0.5 * quadratic(self.Q_final, x[:, -1]) + (self.q_final * x[:, -1]).sum(-1)
        for k in range(self.horizon):  # one by one: the order of a sum must not depend on the batch
            total = total + stages[:, k]
        if self.barrier > 0:
            below, above = self.distances(u)
            total = total - self.barrier * (below.log() + above.log()).sum((1, 2))
        return total

    def distances(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Distances u − u_min and u_max − u of actions (batch, H, n_u) to their bounds."""
        return u - self.u_min.unsqueeze(-2), self.u_max.unsqueeze(-2) - u

    def rollout(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """The trajectory that actions u (batch, H, n_u) cause: x (batch, H+1, n_x) and λ (batch, H, n_lam)."""
        F = self.F.numpy()
        states, forces = [self.x0], []
        for k in range(self.horizon):
            gap = self.gap(states[-1], u[:, k])
            lam = torch.from_numpy(solve_lcp_arrays(F, gap.numpy(), self.relaxation)[0])
            states.append(self.next_state(states[-1], u[:, k], lam))
            forces.append(lam)
        return torch.stack(states, 1), torch.stack(forces, 1)

    def clip(self, u: Tensor) -> Tensor:
        """Actions (batch, H, n_u) clipped into the bounds."""
        return torch.minimum(torch.maximum(u, self.u_min.unsqueeze(-2)), self.u_max.unsqueeze(-2))

    def start(self, u: Tensor) -> Tensor:
        """Actions (batch, H, n_u) to start from: clipped, and with a barrier 1 % of the range off the bounds."""
        margin = 0.01 * (self.u_max - self.u_min).unsqueeze(-2) if self.barrier > 0 else 0.0
        return torch.minimum(torch.maximum(u, self.u_min.unsqueeze(-2) + margin), self.u_max.unsqueeze(-2) - margin)

    def clip_inside(self, u: Tensor, inside: Tensor) -> Tensor:
        """Actions (batch, H, n_u) moved from `inside` towards `u`, at most nine tenths of the way to a bound."""
        below, above = self.distances(inside)
        return torch.minimum(torch.maximum(u, inside - 0.9 * below), inside + 0.9 * above)

    def select(self, index: Tensor) -> MPCProblem:
        """The problems at some batch indices."""
        chosen = {k: getattr(self, k) if self.shared(k) else getattr(self, k)[index] for k in INPUTS}
        return replace(self, **chosen)


# Differentiable inputs with the kind of each trailing dimension, in the order in which autograd and the kernels take
# them.
INPUTS: dict[str, tuple[str, ...]] = dimensions(MPCProblem)

if list(INPUTS.items()) != list(_kernels.mpc_fields().items()):
    raise ImportError(
        "difflcs: the compiled kernels were built for other fields of the MPC problem than those of this version; "
        "build them again, in a checkout by `pip install -e .`"
    )
