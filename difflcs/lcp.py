"""Batched, differentiable linear complementarity problems."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import broadcast_batch, check_number, check_same_device, check_tensor, takes_arrays
from difflcs._differentiation import Gradients, Solver, Tensors, is_wrapped, runs_eagerly, solve
from difflcs.errors import ShapeError, SolveWarning, warn
from difflcs.status import Status

# Block principal pivoting needs 3–10 iterations; the limit only bounds pathological inputs. The relaxed solve follows
# its path in about 5 + 2·log10(1/relaxation) iterations.
MAX_ITER = {"exact": 80, "relaxed": 200}
# Largest λ and w, and reciprocal of the smallest diagonal of F, for which every gradient fits into float32.
_FLOAT32 = 1e18


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


@runs_eagerly
@takes_arrays
def solve_lcp(F: Tensor, q: Tensor, relaxation: float = 0.0, time_limit: float | None = None) -> LCPSolution:
    """Solve 0 ≤ λ ⊥ F λ + q ≥ 0 for a batch of P-matrices F (in particular F + Fᵀ ≻ 0).

    Exact problems go through block principal pivoting, if that fails through an interior-point method that identifies
    the positive λ, with Murty's finite rule as the last resort; relaxed ones, λ ∘ (F λ + q) = relaxation, through
    damped Newton on the Chen–Harker–Kanzow–Smale function, from n = 128 on and if that fails through the
    interior-point method. Large problems and fallbacks eliminate with row exchanges, which a dominant skew part needs.

    CONVERGED is a certificate, recomputed from the λ and w that are returned: λ, w ≥ 0; λᵢwᵢ is 0, or the relaxation;
    and |F λ + q − w|ᵢ is at most 1e-10 of the terms |qᵢ| + Σⱼ|Fᵢⱼλⱼ| that sum to it and at most 1e-8 of the largest
    |q| (with a relaxation: plus √(relaxation·Fᵢᵢ)), in the caller's units and in those that give F a unit diagonal. So
    an F whose smallest eigenvalue is below about 1e-8 of its entries may be refused: NUMERICAL.

    The gradient is that of the implicit function, M δλ = −b ∘ (δF λ + δq) with a = w/(λ+w), b = λ/(λ+w) and
    M = diag(a) + diag(b) F. Where strict complementarity fails (λᵢ = wᵢ = 0) an exact solution has a kink; index i then
    counts as inactive (δλᵢ = 0). For a P-matrix that choice is the derivative of a linear piece next to q, hence an
    element of the generalised (Bouligand) Jacobian.

    Args:
        F: (..., n, n), or (n, n) shared by the batch.
        q: (..., n), n ≥ 0.
        relaxation: 0 for the exact problem, else the product λᵢ wᵢ, in the units of λ·w.
        time_limit: seconds for the solve, None for no limit. Elements not solved by then are MAX_ITER.

    Returns:
        `LCPSolution` with λ, w of q's dtype. float32 is solved in float64 inside; λ or w above 1e150, or 1e18 in
        float32, is NUMERICAL, and so is an F with a diagonal below 1e-100, or 1e-18.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError, InvalidInputError: the arguments do not fit.
    """
    relaxation = check_number("relaxation", relaxation)
    limit = math.inf if time_limit is None else check_number("time_limit", time_limit, strict=True)
    check_tensor("q", q)
    if q.ndim < 1:
        raise ShapeError(f"q: expected shape (..., n), got {tuple(q.shape)}; add the dimension of the variables")
    n = q.shape[-1]
    check_tensor("F", F, [("n", n), ("n", n)])
    check_same_device([("q", q), ("F", F)])
    batch = broadcast_batch([("q", q.shape[:-1]), ("F", F.shape[:-2])])
    if n == 0:  # no contacts: nothing to solve
        lam = (F.to(q.dtype) @ q.unsqueeze(-1)).squeeze(-1).expand(*batch, 0)
        return LCPSolution(lam, lam + q, torch.full(batch, int(Status.CONVERGED), dtype=torch.int8, device=q.device))
    q_flat = q.expand(*batch, n).reshape(-1, n).double()
    F_flat = F.double() if F.ndim == 2 else F.expand(*batch, n, n).reshape(-1, n, n).double()
    single = torch.float32 in (F.dtype, q.dtype)
    lam, w, status = solve(_Problems(relaxation, limit, single), F_flat, q_flat)
    if not is_wrapped(status):
        _warn_of_failures(status)
    return LCPSolution(
        lam.reshape(*batch, n).to(q.dtype), w.reshape(*batch, n).to(q.dtype), status.reshape(batch).to(q.device)
    )


def solve_lcp_arrays(
    F: np.ndarray, q: np.ndarray, relaxation: float = 0.0, time_limit: float = math.inf
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve with the native code: F (n, n) or (B, n, n), q (B, n), float64 → λ, w (B, n) and status (B,), no NaN."""
    from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]

    F, q = np.ascontiguousarray(F), np.ascontiguousarray(q)
    lam, w = np.empty_like(q), np.empty_like(q)
    status = np.empty(len(q), np.int8)
    limit = MAX_ITER["relaxed" if relaxation > 0 else "exact"]
    _kernels.solve_lcp(F, q, relaxation, limit, time_limit, torch.get_num_threads(), lam, w, status)
    failed = status != Status.CONVERGED
    if failed.any():
        np.nan_to_num(lam, copy=False, posinf=0.0, neginf=0.0)
        np.nan_to_num(w, copy=False, posinf=0.0, neginf=0.0)
        lam[failed] = np.maximum(lam[failed], 0.0)
        w[failed] = np.maximum(w[failed], 0.0)
    return lam, w, status


def _warn_of_failures(status: Tensor) -> None:
    failed = int((status != Status.CONVERGED).sum())
    if failed:
        warn(
            f"{failed} of {status.numel()} LCPs were not solved; their gradient is zero. Expected P-matrices: check "
            f"that F + Fᵀ is positive definite, and read .status (MAX_ITER: not within time_limit)",
            SolveWarning,
        )


@dataclass(frozen=True)
class _Problems(Solver):
    """Solver of LCPs: F, q in float64 → λ, w, status. `single`: the caller has float32, which limits gradients."""

    relaxation: float
    time_limit: float
    single: bool

    name = "solve_lcp"
    ranks = (2, 1)
    differentiable = 2

    def solve(self, tensors: Tensors, transformed: bool) -> tuple[Tensor, ...]:
        F, q = tensors
        if transformed:
            check_tensor("q", q)
            check_tensor("F", F)
        lam, w, status = (
            torch.from_numpy(a)
            for a in solve_lcp_arrays(
                F.detach().cpu().numpy(), q.detach().cpu().numpy(), self.relaxation, self.time_limit
            )
        )
        if self.single:
            diagonal = F.detach().cpu().diagonal(dim1=-2, dim2=-1)
            too_large = (torch.maximum(lam, w).amax(-1) > _FLOAT32) | (diagonal < 1 / _FLOAT32).any(-1)
            status = torch.where(too_large, int(Status.NUMERICAL), status).to(torch.int8)
            lam, w = (torch.where(too_large.unsqueeze(-1), v.clamp_max(_FLOAT32), v) for v in (lam, w))
        if transformed:
            _warn_of_failures(status)
        return lam.to(q.device), w.to(q.device), status.to(q.device)

    def pullback(self, tensors: Tensors, outputs: Tensors, grads: Gradients, needs: Sequence[bool]) -> Gradients:
        (F, _), (lam, w, status) = tensors, outputs
        solved = (status == Status.CONVERGED).unsqueeze(-1)
        # The upstream gradient of a failed element is dropped, so that it cannot spread to the others.
        lam_bar, w_bar = (torch.zeros_like(lam) if g is None else torch.where(solved, g, 0.0) for g in grads)
        total = lam + w
        # Strictly complementary: b = λ/(λ+w). At λ = w = 0 the index counts as inactive: b = 0, a = 1.
        b = torch.where(total > 0, lam / total.clamp_min(torch.finfo(lam.dtype).tiny), torch.zeros_like(lam))
        b = torch.where(solved, b, torch.zeros_like(b))
        # a = w/(λ+w), not 1 − b, which has no digits left where λ is 1e10 times w.
        a = torch.where(b > 0, w / total.clamp_min(torch.finfo(lam.dtype).tiny), torch.ones_like(b))
        M = torch.diag_embed(a) + b.unsqueeze(-1) * F
        lam_bar = lam_bar + (w_bar.unsqueeze(-2) @ F).squeeze(-2)
        v = torch.linalg.solve_ex(M.mT, lam_bar)[0]
        # Rounding can make M singular where F is hardly positive definite: no gradient then, rather than NaN.
        v = torch.where(torch.isfinite(v).all(-1, keepdim=True), v, torch.zeros_like(v))
        q_bar = torch.where(solved, w_bar - b * v, torch.zeros_like(v))
        if not needs[0]:
            return None, q_bar
        F_bar = q_bar.mT @ lam if F.ndim == 2 else q_bar.unsqueeze(-1) * lam.unsqueeze(-2)
        return F_bar, q_bar
