"""Losses that fit an LCS to observed transitions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import broadcast_batch, check_choice, check_number, check_tensor
from difflcs.errors import DoubleBackwardError, GammaError, NotPositiveDefiniteError, SolveError
from difflcs.lcp import solve_lcp_arrays
from difflcs.lcs import LCSModel
from difflcs.status import Status


def violation_loss(
    lcs: LCSModel,
    x: Tensor,
    u: Tensor,
    x_next: Tensor,
    gamma: float = 0.1,
    xi: float = 0.01,
    *,
    reduction: str = "mean",
    check_gamma: bool = True,
) -> Tensor:
    """The violation-based loss of an LCS (Eq. vio_loss of the paper; Jin et al.).

    For each transition, with r = A x + B u + C λ + d − x_next and e = D x + E u + F λ + c − φ,

        min over λ, φ ≥ 0 of  ½‖r‖² + (λᵀφ + ‖e‖²/(2γ))/ξ.

    The inner problem is a convex QP when 0 < γ ≤ σ_min(F + Fᵀ); it is solved exactly, as an LCP. Its value is
    differentiated by the envelope theorem: with (λ, φ) held at the minimiser, nothing is differentiated through the
    solve. The prior work's loss ‖r‖² + (λᵀφ + ‖e‖²/γ')/ξ' is 2·`violation_loss` with γ = γ'/2 and ξ = 2ξ'.

    Args:
        lcs: the model.
        x: (..., n_x) states.
        u: (..., n_u) actions.
        x_next: (..., n_x) observed next states.
        gamma: γ, weight of the slack; 0 < γ ≤ σ_min(F + Fᵀ).
        xi: ξ > 0, weight of the dynamics against complementarity. The default suits data of the size of meters per
            step, as in the paper; scale it with the square of your data (about 1 for data of size one), or the loss is
            the prediction loss for all practical purposes.
        reduction: "mean" over the batch, or "none" for one value each.
        check_gamma: refuse γ > σ_min(F + Fᵀ). False lets a fixed γ through, as the prior work does; the inner QP may
            then be non-convex, and a stationary point of it is used.

    Returns:
        Scalar, or (...,) with reduction="none"; differentiable in the parameters, x, u and x_next.

    Raises:
        GammaError: γ is outside its range; the message names γ and σ_min(F + Fᵀ).
        ShapeError, DTypeError, DeviceError, NonFiniteError, InvalidInputError: the arguments do not fit.
    """
    check_choice("reduction", reduction, ("mean", "none"))
    check_number("xi", xi, strict=True)
    lcs.check_inputs(x=x, u=u, x_next=x_next)
    F = lcs.F
    for name in "ABCdDEc":
        check_tensor(name, getattr(lcs, name))
    check_tensor("F", F)
    _check_gamma(F, gamma, check_gamma)
    batch = broadcast_batch([("x", x.shape[:-1]), ("u", u.shape[:-1]), ("x_next", x_next.shape[:-1])])
    x, u, x_next = (v.expand(*batch, v.shape[-1]).reshape(-1, v.shape[-1]) for v in (x, u, x_next))
    loss = _ViolationLoss.apply(lcs.A, lcs.B, lcs.C, lcs.d, lcs.D, lcs.E, F, lcs.c, x, u, x_next, gamma, xi)
    return _reduce(loss, batch, reduction)  # pyright: ignore[reportArgumentType]


def prediction_loss(lcs: LCSModel, x: Tensor, u: Tensor, x_next: Tensor, *, reduction: str = "mean") -> Tensor:
    """½‖x̂ − x_next‖² with x̂ predicted through the exact LCP, for comparison with `violation_loss`.

    Its gradient vanishes where contacts are wrongly inactive, which is what the violation loss mends.

    Args:
        lcs: the model.
        x: (..., n_x) states.
        u: (..., n_u) actions.
        x_next: (..., n_x) observed next states.
        reduction: "mean" over the batch, or "none" for one value each.

    Returns:
        Scalar, or (...,) with reduction="none"; differentiable in the parameters, x, u and x_next.
    """
    check_choice("reduction", reduction, ("mean", "none"))
    lcs.check_inputs(x=x, u=u, x_next=x_next)
    broadcast_batch([("x", x.shape[:-1]), ("u", u.shape[:-1]), ("x_next", x_next.shape[:-1])])
    loss = 0.5 * (lcs(x, u).x_next - x_next).square().sum(-1)
    return _reduce(loss.reshape(-1), loss.shape, reduction)


def _reduce(loss: Tensor, batch: torch.Size, reduction: str) -> Tensor:
    # The mean of an empty batch is zero, not NaN: no data, no loss, no gradient.
    return loss.sum() / max(loss.numel(), 1) if reduction == "mean" else loss.reshape(batch)


def _check_gamma(F: Tensor, gamma: float, refuse_large: bool) -> None:
    check_number("gamma", gamma)
    symmetric = (F + F.mT).detach().cpu().double().numpy()
    smallest = float(np.linalg.eigvalsh(symmetric)[0])
    if smallest <= 0:
        raise NotPositiveDefiniteError(
            f"F: expected F + Fᵀ positive definite, got smallest eigenvalue {smallest:.3e}; raise the model's stiffness"
        )
    # The bound itself is allowed; a relative 1e-9 forgives the rounding of the eigenvalue.
    if gamma <= 0 or (refuse_large and gamma > smallest * (1 + 1e-9)):
        raise GammaError(
            f"gamma: expected 0 < gamma <= sigma_min(F + F^T) = {smallest:.6g}, got {gamma:.6g}; lower gamma, "
            f"raise the model's stiffness (sigma_min >= 2*stiffness), or pass check_gamma=False to keep a fixed gamma"
        )


class _ViolationLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, A, B, C, d, D, E, F, c, x, u, x_next, gamma: float, xi: float):
        with torch.no_grad():
            free = x @ A.mT + u @ B.mT + d - x_next  # r at λ = 0
            gap = x @ D.mT + u @ E.mT + c  # e at λ = φ = 0
            lam, phi = _inner_qp(C, F, free, gap, gamma, xi)
            r = free + lam @ C.mT
            e = gap + lam @ F.mT - phi
            loss = 0.5 * (r * r).sum(-1) + ((lam * phi).sum(-1) + (e * e).sum(-1) / (2 * gamma)) / xi
        ctx.save_for_backward(A, B, D, E, x, u, lam, r, e)
        ctx.weight = 1.0 / (gamma * xi)
        return loss

    @staticmethod
    def backward(ctx, *grads):
        if torch.is_grad_enabled():
            raise DoubleBackwardError(
                "violation_loss has first derivatives only (envelope theorem); expected create_graph=False"
            )
        A, B, D, E, x, u, lam, r, e = ctx.saved_tensors
        # Envelope theorem: derivative of the objective with (λ, φ) fixed. r and e are linear in every input.
        r = grads[0].unsqueeze(-1) * r
        e = (ctx.weight * grads[0]).unsqueeze(-1) * e
        need = ctx.needs_input_grad
        return (
            r.mT @ x,
            r.mT @ u,
            r.mT @ lam,
            r.sum(0),
            e.mT @ x,
            e.mT @ u,
            e.mT @ lam,
            e.sum(0),
            r @ A + e @ D if need[8] else None,
            r @ B + e @ E if need[9] else None,
            -r if need[10] else None,
            None,
            None,
        )


def _inner_qp(C: Tensor, F: Tensor, free: Tensor, gap: Tensor, gamma: float, xi: float) -> tuple[Tensor, Tensor]:
    """Minimise over z = (λ, φ) ≥ 0 the violation objective: ½ zᵀ Q z + zᵀ q, whose optimality is the LCP (Q, q).

    Q = [[CᵀC + FᵀF/(γξ), (I − Fᵀ/γ)/ξ], [·, I/(γξ)]],  q = (Cᵀ free + Fᵀ gap/(γξ), −gap/(γξ)).
    Eliminating φ leaves CᵀC + (F + Fᵀ − γI)/ξ, positive definite for γ < σ_min(F + Fᵀ).
    """
    n = F.shape[0]
    device, dtype = free.device, free.dtype
    C_, F_, free_, gap_ = (v.cpu().double().numpy() for v in (C, F, free, gap))
    Q, q = np.empty((2 * n, 2 * n)), np.empty((len(free_), 2 * n))
    weight = 1.0 / (gamma * xi)
    Q[:n, :n] = C_.T @ C_ + weight * (F_.T @ F_)
    Q[:n, n:] = np.eye(n) / xi - weight * F_.T
    Q[n:, :n] = Q[:n, n:].T
    Q[n:, n:] = weight * np.eye(n)
    q[:, :n] = free_ @ C_ + weight * (gap_ @ F_)
    q[:, n:] = -weight * gap_
    z = _minimise_over_orthant(Q, q)
    return tuple(torch.from_numpy(np.ascontiguousarray(v)).to(device, dtype) for v in (z[:, :n], z[:, n:]))  # pyright: ignore[reportReturnType]


def _minimise_over_orthant(Q: np.ndarray, q: np.ndarray, max_iter: int = 500) -> np.ndarray:
    """Minimise ½ zᵀQz + qᵀz over z ≥ 0 for each row of q (B, m): exact for Q ≻ 0, else a stationary point."""
    scale = float(np.abs(np.diag(Q)).max())
    smallest = float(np.linalg.eigvalsh(Q)[0])
    if smallest > 1e-13 * scale:
        z, _, status = solve_lcp_arrays(Q, q)
        _require_solved(status)
        return z
    # γ at or above its bound: Q is singular or indefinite. Proximal steps z ← argmin ½zᵀQz + qᵀz + ½ρ‖z − z₋‖²
    # decrease the objective monotonically, and each is an LCP with a positive definite matrix.
    rho = max(1e-6 * scale, -1.1 * smallest)
    proximal = Q + rho * np.eye(len(Q))
    z = np.zeros_like(q)
    for _ in range(max_iter):
        step, _, status = solve_lcp_arrays(proximal, q - rho * z)
        _require_solved(status)
        change = np.abs(step - z).max(initial=0.0)
        z = step
        if rho * change <= 1e-10 * max(1.0, np.abs(q).max(initial=0.0)):
            break
    return z


def _require_solved(status: np.ndarray) -> None:
    failed = np.flatnonzero(status != Status.CONVERGED)
    if len(failed):
        raise SolveError(
            f"violation_loss: the inner QP failed on {len(failed)} of {len(status)} transitions (first: {failed[0]}); "
            f"check the scale of the data and of the parameters",
            failed.tolist(),
            status[failed].tolist(),
        )
