"""Batched, differentiable linear complementarity problems."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import broadcast_batch, check_number, check_same_device, check_tensor
from difflcs.errors import DoubleBackwardError, ShapeError, SolveWarning
from difflcs.status import Status

# Block principal pivoting needs 3–10 iterations; the limit only bounds pathological inputs. The relaxed solve follows
# its path in about 5 + 2·log10(1/relaxation) iterations.
MAX_ITER = {"exact": 80, "relaxed": 200}


class LCPSolution(NamedTuple):
    """Solution of a batch of LCPs.

    Attributes:
        lam: (..., n) λ ≥ 0, differentiable.
        w: (..., n) F λ + q ≥ 0, differentiable.
        status: (...) `Status` of each problem, int8. Elements not CONVERGED carry their best iterate and no gradient.
    """

    lam: Tensor
    w: Tensor
    status: Tensor


def solve_lcp(F: Tensor, q: Tensor, relaxation: float = 0.0) -> LCPSolution:
    """Solve 0 ≤ λ ⊥ F λ + q ≥ 0 for a batch of P-matrices F (in particular F + Fᵀ ≻ 0).

    Exact problems go through block principal pivoting with Murty's finite rule as the fallback; relaxed ones,
    λ ∘ (F λ + q) = relaxation, through damped Newton on the Chen–Harker–Kanzow–Smale function.

    The gradient is that of the implicit function, M δλ = −b ∘ (δF λ + δq) with a = w/(λ+w), b = λ/(λ+w) and
    M = diag(a) + diag(b) F. Where strict complementarity fails (λᵢ = wᵢ = 0) an exact solution has a kink; index i then
    counts as inactive (δλᵢ = 0). For a P-matrix that choice is the derivative of a linear piece next to q, hence an
    element of the generalised (Bouligand) Jacobian.

    Args:
        F: (..., n, n), or (n, n) shared by the batch.
        q: (..., n).
        relaxation: 0 for the exact problem, else the product λᵢ wᵢ, in the units of λ·w.

    Returns:
        `LCPSolution` with λ, w of q's dtype. float32 is solved in float64 inside.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError, InvalidInputError: the arguments do not fit.
    """
    check_number("relaxation", relaxation)
    check_tensor("q", q)
    if q.ndim < 1 or q.shape[-1] < 1:
        raise ShapeError(f"q: expected shape (..., n) with n ≥ 1, got {tuple(q.shape)}")
    n = q.shape[-1]
    check_tensor("F", F, [("n", n), ("n", n)])
    check_same_device([("q", q), ("F", F)])
    batch = broadcast_batch([("q", q.shape[:-1]), ("F", F.shape[:-2])])
    q_flat = q.expand(*batch, n).reshape(-1, n).double()
    F_flat = F.double() if F.ndim == 2 else F.expand(*batch, n, n).reshape(-1, n, n).double()
    lam, w, status = _SolveLCP.apply(F_flat, q_flat, float(relaxation))  # pyright: ignore[reportGeneralTypeIssues]
    failed = int((status != Status.CONVERGED).sum())
    if failed:
        warnings.warn(
            f"{failed} of {status.numel()} LCPs were not solved; their gradient is zero. Expected P-matrices: check "
            f"that F + Fᵀ is positive definite, and read .status",
            SolveWarning,
            stacklevel=2,
        )
    return LCPSolution(
        lam.reshape(*batch, n).to(q.dtype), w.reshape(*batch, n).to(q.dtype), status.reshape(batch).to(q.device)
    )


def solve_lcp_arrays(
    F: np.ndarray, q: np.ndarray, relaxation: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The native solve on float64 arrays F (n, n) or (B, n, n) and q (B, n): λ, w (B, n) and status (B,), no NaN."""
    from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]

    F, q = np.ascontiguousarray(F), np.ascontiguousarray(q)
    lam, w = np.empty_like(q), np.empty_like(q)
    status, iterations = np.empty(len(q), np.int8), np.empty(len(q), np.int32)
    limit = MAX_ITER["relaxed" if relaxation > 0 else "exact"]
    _kernels.solve_lcp(F, q, relaxation, limit, torch.get_num_threads(), lam, w, status, iterations)
    failed = status != Status.CONVERGED
    if failed.any():
        np.nan_to_num(lam, copy=False, posinf=0.0, neginf=0.0)
        np.nan_to_num(w, copy=False, posinf=0.0, neginf=0.0)
        lam[failed] = np.maximum(lam[failed], 0.0)
        w[failed] = np.maximum(w[failed], 0.0)
    return lam, w, status


class _SolveLCP(torch.autograd.Function):
    @staticmethod
    def forward(ctx, F: Tensor, q: Tensor, relaxation: float):
        lam, w, status = (
            torch.from_numpy(a).to(q.device)
            for a in solve_lcp_arrays(F.detach().cpu().numpy(), q.detach().cpu().numpy(), relaxation)
        )
        ctx.save_for_backward(F, lam, w, status)
        ctx.mark_non_differentiable(status)
        return lam, w, status

    @staticmethod
    def backward(ctx, *grads):
        F, lam, w, status = ctx.saved_tensors
        if torch.is_grad_enabled():
            raise DoubleBackwardError("solve_lcp has first derivatives only; expected create_graph=False")
        lam_bar, w_bar = grads[0], grads[1]
        solved = (status == Status.CONVERGED).unsqueeze(-1)
        total = lam + w
        # Strictly complementary: b = λ/(λ+w). At λ = w = 0 the index counts as inactive: b = 0, a = 1.
        b = torch.where(total > 0, lam / total.clamp_min(torch.finfo(lam.dtype).tiny), torch.zeros_like(lam))
        b = torch.where(solved, b, torch.zeros_like(b))
        M = torch.diag_embed(1 - b) + b.unsqueeze(-1) * F
        lam_bar = lam_bar + (w_bar.unsqueeze(-2) @ F).squeeze(-2)
        v = torch.linalg.solve(M.mT, lam_bar)
        q_bar = torch.where(solved, w_bar - b * v, torch.zeros_like(v))
        if not ctx.needs_input_grad[0]:
            return None, q_bar, None
        F_bar = q_bar.mT @ lam if F.ndim == 2 else q_bar.unsqueeze(-1) * lam.unsqueeze(-2)
        return F_bar, q_bar, None
