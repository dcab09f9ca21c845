"""Losses that fit an LCS to observed transitions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import broadcast_batch, check_choice, check_number, check_tensor
from difflcs.errors import DoubleBackwardError, GammaError, NotPositiveDefiniteError, SolveError
from difflcs.lcp import MAX_ITER, solve_lcp_arrays
from difflcs.lcs import SYSTEM, LCSModel
from difflcs.status import Status

# Least γ σ_min(F + Fᵀ), in parts of n_lam times the largest squared column of F (kernels.hpp has the same).
_GAMMA_LEAST = 4e-13


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
        GammaError: γ is outside its range, or γ or γξ is too small for double precision: γ σ_min(F + Fᵀ) below 4e-13
            n_lam times the largest squared column of F loses the digits of the loss, and rounding e/(γξ) by more than
            1e-6 of the Cᵀr that it balances those of its gradient. The message names the limits.
        ShapeError, DTypeError, DeviceError, NonFiniteError, InvalidInputError: the arguments do not fit.
    """
    check_choice("reduction", reduction, ("mean", "none"))
    check_number("xi", xi, strict=True)
    check_number("gamma", gamma)
    F, factors = _contact_matrix(lcs)
    system = (lcs.A, lcs.B, lcs.C, lcs.d, lcs.D, lcs.E, F, lcs.c)
    batch = x.shape[:-1] if _plain(lcs, system, (x, u, x_next)) else None
    if batch is None:
        _check_numbers(lcs, system, (x, u, x_next))
        batch = broadcast_batch([("x", x.shape[:-1]), ("u", u.shape[:-1]), ("x_next", x_next.shape[:-1])])
        x, u, x_next = (v.expand(*batch, v.shape[-1]).reshape(-1, v.shape[-1]) for v in (x, u, x_next))
    mean = reduction == "mean"
    loss = _ViolationLoss.apply(lcs, check_gamma, mean, gamma, xi, *system, x, u, x_next, *factors)
    return loss if mean else loss.reshape(batch)  # pyright: ignore[reportReturnType, reportAttributeAccessIssue]


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


def _contact_matrix(lcs: LCSModel) -> tuple[Tensor, tuple[Tensor, ...]]:
    """F, and G and H if it is their function as in `LCSModel`: the loss then passes its gradient to them itself.

    Autograd would take 40 µs for the five small steps, of 190 µs for the loss of 100 transitions and its gradient.
    """
    if getattr(type(lcs), "F", None) is not LCSModel.F:
        return lcs.F, ()
    with torch.no_grad():
        return lcs.F, (lcs.G, lcs.H)


def _plain(lcs: LCSModel, system: tuple[Tensor, ...], data: tuple[Tensor, ...]) -> bool:
    """Whether these are float64 matrices on the CPU that fit each other: then the kernel can look at the numbers."""
    if not all(isinstance(v, Tensor) and v.dtype is torch.float64 and v.is_cpu for v in (*system, *data)):
        return False
    count = data[0].shape[0] if data[0].ndim else 0
    return all(v.shape == (count, n) for v, n in zip(data, (lcs.n_x, lcs.n_u, lcs.n_x), strict=True))


def _check_numbers(lcs: LCSModel, system: tuple[Tensor, ...], data: tuple[Tensor, ...]) -> None:
    lcs.check_inputs(**dict(zip(("x", "u", "x_next"), data, strict=True)))
    for name, value in zip(SYSTEM, system, strict=True):
        check_tensor(name, value)


def _check_gamma(F: Tensor, gamma: float, refuse_large: bool) -> None:
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
    # FᵀF/γ stands beside F + Fᵀ in the inner QP: their difference has to survive the rounding.
    least = _GAMMA_LEAST * len(F) * float(F.detach().double().square().sum(0).max()) / smallest
    if gamma < least:
        raise GammaError(
            f"gamma: expected at least {least:.3g} for this F in double precision, got {gamma:.3g}; raise gamma, or "
            f"the model's stiffness"
        )


class _ViolationLoss(torch.autograd.Function):
    """The loss of A, B, C, d, D, E, F, c and x, u, x_next (B, ·), then G and H if F is their function.

    The inner problem over z = (λ, φ) ≥ 0 is to minimise ½ zᵀQz + qᵀz, whose optimality is the LCP (Q, q):

        Q = [[CᵀC + FᵀF/(γξ), (I − Fᵀ/γ)/ξ], [·, I/(γξ)]],  q = (Cᵀr + Fᵀe/(γξ), −e/(γξ)) with r and e at z = 0.

    Eliminating φ leaves CᵀC + (F + Fᵀ − γI)/ξ, positive definite for γ < σ_min(F + Fᵀ).
    """

    @staticmethod
    def forward(ctx, lcs: LCSModel, refuse_large: bool, mean: bool, gamma: float, xi: float, *tensors: Tensor):
        from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]

        A, B, _, _, D, E, F, c, x, u, x_next = tensors[:11]
        arrays = [v.numpy(force=True) for v in tensors[:11]]
        count, n = len(x), len(c)
        Q, q, z = np.empty((2 * n, 2 * n)), np.empty((count, 2 * n)), np.empty((count, 2 * n))
        r, e, loss = np.empty(x.shape), np.empty((count, n)), np.empty(count)
        limit, threads = MAX_ITER["exact"], torch.get_num_threads()
        held = _kernels.violation_loss(arrays, gamma, xi, limit, threads, Q, q, z, r, e, loss)
        if held is None:
            # A number that is not finite, a γ at or above its bound, or an empty batch.
            _check_numbers(lcs, tensors[:8], (x, u, x_next))
            _check_gamma(F, gamma, refuse_large)
            z = _minimise_over_orthant(Q, q)
            held = _kernels.violation_value(arrays, gamma, xi, z, r, e, loss)
        if not held:
            raise GammaError(
                f"gamma, xi: expected a product that double precision resolves for these data, got {gamma:.3g} and "
                f"{xi:.3g}: e/(gamma xi) has lost the digits of the gradient; raise xi or gamma"
            )
        ctx.mean, ctx.solution = mean, (arrays, gamma, xi, z, r, e)
        # The arrays look into these tensors; autograd refuses them where they were changed in place.
        x_needs, u_needs = ctx.needs_input_grad[13:15]
        ctx.save_for_backward(x, u, *tensors[11:12], *((A, B, D, E) if x_needs or u_needs else ()))
        value = torch.from_numpy(loss)
        # The mean of an empty batch is zero, not NaN: no data, no loss, no gradient.
        return (value.sum() / max(count, 1) if mean else value).to(x)

    @staticmethod
    def backward(ctx, *grads):
        if torch.is_grad_enabled():
            raise DoubleBackwardError(
                "violation_loss has first derivatives only (envelope theorem); expected create_graph=False"
            )
        from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]

        x, _, *rest = ctx.saved_tensors
        arrays, gamma, xi, z, r, e = ctx.solution
        upstream = grads[0].numpy(force=True)
        if ctx.mean:
            upstream = np.full(len(z), upstream / max(len(z), 1))
        # Envelope theorem: derivative of the objective with z fixed. r and e are linear in every input.
        system = [np.empty(v.shape) for v in arrays[:8]]
        needs = zip(arrays[8:], ctx.needs_input_grad[13:16], strict=True)
        data = [np.empty(v.shape) if need else None for v, need in needs]
        _kernels.violation_gradient(arrays, gamma, xi, z, r, e, upstream, [*system, *data])
        gradients = [*system, *data]
        if len(ctx.needs_input_grad) > 16:  # F = G Gᵀ + stiffness·I + H − Hᵀ
            F_bar, G = system[6], rest[0].numpy(force=True)
            gradients += [(F_bar + F_bar.T) @ G, F_bar - F_bar.T]
        return (None,) * 5 + tuple(g if g is None else torch.from_numpy(g).to(x) for g in gradients)


def _minimise_over_orthant(Q: np.ndarray, q: np.ndarray, max_iter: int = 500) -> np.ndarray:
    """Minimise ½ zᵀQz + qᵀz over z ≥ 0 for each row of q (B, m): exact for Q ≻ 0, else a stationary point."""
    unit = 1 / np.sqrt(np.diag(Q))  # of each variable, so that Q has a unit diagonal
    Q, q = unit[:, None] * Q * unit, q * unit
    smallest = float(np.linalg.eigvalsh(Q)[0])
    if smallest > 1e-13:
        z, _, status = solve_lcp_arrays(Q, q)
        _require_solved(status)
        return z * unit
    # γ at or above its bound: Q is singular or indefinite. Proximal steps z ← argmin ½zᵀQz + qᵀz + ½ρ‖z − z₋‖²
    # decrease the objective monotonically, and each is an LCP with a positive definite matrix.
    rho = max(1e-6, -1.1 * smallest)
    proximal = Q + rho * np.eye(len(Q))
    z = np.zeros_like(q)
    for _ in range(max_iter):
        step, _, status = solve_lcp_arrays(proximal, q - rho * z)
        _require_solved(status)
        change = np.abs(step - z).max(initial=0.0)
        z = step
        if rho * change <= 1e-10 * np.abs(q).max(initial=0.0):
            return z * unit
    return z * unit  # a descent from zero that has not settled; only an indefinite Q needs that many steps


def _require_solved(status: np.ndarray) -> None:
    failed = np.flatnonzero(status != Status.CONVERGED)
    if len(failed):
        raise SolveError(
            f"violation_loss: the inner QP failed on {len(failed)} of {len(status)} transitions (first: {failed[0]}); "
            f"check the scale of the data and of the parameters",
            failed.tolist(),
            status[failed].tolist(),
        )
