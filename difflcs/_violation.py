"""The violation loss with one system per transition, and whatever its kernel in C++ does not do: NumPy, any shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import check_tensor
from difflcs._functorch import Solver
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.errors import GammaError, NotPositiveDefiniteError, SolveError
from difflcs.lcp import solve_lcp_arrays
from difflcs.records import SYSTEM
from difflcs.status import Status

_GAMMA_LEAST, _ROUNDING = (_kernels.tolerances()[name] for name in ("gamma_least", "rounding"))
# γ = "auto", in parts of its bound: at the bound itself the inner QP is singular wherever C is. A thousandth below it
# the smallest eigenvalue of F + Fᵀ − γI is a thousandth of that of F + Fᵀ.
AUTO = 0.999

_NAMES = (*SYSTEM, "x", "u", "x_next", "gamma")


@dataclass(frozen=True)
class Transitions(Solver):
    """A, B, C, d, D, E, F, c, x, u, x_next, γ → the loss of each transition; and (λ, φ), r and e at its minimiser.

    The inner problem over z = (λ, φ) ≥ 0 is to minimise ½ zᵀQz + qᵀz, whose optimality is the LCP (Q, q):

        Q = [[CᵀC + FᵀF/(γξ), (I − Fᵀ/γ)/ξ], [·, I/(γξ)]],  q = (Cᵀr + Fᵀe/(γξ), −e/(γξ)) with r and e at z = 0.

    Eliminating φ leaves CᵀC + (F + Fᵀ − γI)/ξ, positive definite for γ < σ_min(F + Fᵀ). The pullback is the envelope
    theorem: the derivative of the objective with z fixed. r and e are linear in every input.
    """

    xi: float

    name = "violation_loss"
    ranks = (2, 2, 2, 1, 2, 2, 2, 1, 1, 1, 1, 0)
    differentiable = 1

    def solve(self, tensors: Sequence[Tensor], transformed: bool) -> tuple[Tensor, ...]:
        if transformed:
            for name, tensor in zip(_NAMES, tensors, strict=True):
                check_tensor(name, tensor)
        A, B, C, d, D, E, F, c, x, u, x_next, gamma = _arrays(tensors)
        check_gamma_range(F, gamma)
        r = _dot(A, x) + _dot(B, u) + d - x_next
        e = _dot(D, x) + _dot(E, u) + c
        rate = gamma[..., None]
        weight = 1 / (rate * self.xi)
        Q = self._hessian(C, F, gamma)
        q = np.concatenate([_dot(_t(C), r) + weight * _dot(_t(F), e), -weight * e], -1)
        z = minimise_over_orthant(Q, q)
        lam, phi = np.split(z, 2, -1)
        lost = self._lost(np.abs(C), np.abs(F), weight, lam, phi, np.abs(r), np.abs(e))
        if lost.any():
            worst = int(lost.argmax())
            raise GammaError(
                f"gamma, xi: expected a product that double precision resolves for these data, got "
                f"{float(np.broadcast_to(gamma, lost.shape)[worst]):.3g} and {self.xi:.3g}: e/(gamma xi) has lost the "
                f"digits of the gradient at batch index {worst}; raise xi or gamma"
            )
        r = r + _dot(C, lam)
        # Where φ is free, e = γλ by stationarity, without the rounding of a difference.
        e = np.where(phi > 0, rate * lam, e + _dot(F, lam) - phi)
        value = 0.5 * (r * r).sum(-1) + ((lam * phi).sum(-1) + (e * e / (2 * rate)).sum(-1)) / self.xi
        like = tensors[8]
        return torch.from_numpy(value).to(like), *(torch.from_numpy(v).to(like.device) for v in (z, r, e))

    def _hessian(self, C: np.ndarray, F: np.ndarray, gamma: np.ndarray) -> np.ndarray:
        n, rate = F.shape[-1], gamma[..., None, None]
        weight, eye = 1 / (rate * self.xi), np.eye(n)
        coupling = eye / self.xi - weight * _t(F)
        corner = _t(C) @ C + weight * (_t(F) @ F)
        Q = np.empty((*np.broadcast_shapes(corner.shape[:-2], coupling.shape[:-2]), 2 * n, 2 * n))
        Q[..., :n, :n], Q[..., :n, n:], Q[..., n:, :n], Q[..., n:, n:] = corner, coupling, _t(coupling), weight * eye
        return Q

    @staticmethod
    def _lost(
        C: np.ndarray, F: np.ndarray, weight: np.ndarray, lam: np.ndarray, phi: np.ndarray, r: np.ndarray, e: np.ndarray
    ) -> np.ndarray:
        """Where rounding e, which is divided by γξ, does not leave its digits; all but λ and φ are sizes, |·|.

        As the dual variable of the contacts, Fᵀe/(γξ) balances Cᵀr.
        """
        balance = _dot(_t(C), r + _dot(C, lam))
        rounding = _dot(_t(F), np.where(phi > 0, 0.0, e + phi + _dot(F, lam)))
        noise = np.where(lam > 0, _ROUNDING * weight * rounding, 0.0).max(-1)
        signal = balance.max(-1)
        return (noise > 1e-6 * signal) & (signal > 0)

    def pullback(
        self, tensors: Sequence[Tensor], outputs: Sequence[Tensor], grads: Sequence[Tensor], needs: Sequence[bool]
    ) -> Sequence[Tensor | None]:
        A, B, _, _, D, E, _, _, x, u, _, gamma = _arrays(tensors)
        z, r, e = _arrays(outputs[1:])
        (upstream,) = _arrays(grads)
        lam = np.split(z, 2, -1)[0]
        r = upstream[:, None] * r
        e = upstream[:, None] * e / (gamma[..., None] * self.xi)
        x_bar = _dot(_t(A), r) + _dot(_t(D), e) if needs[8] else None
        u_bar = _dot(_t(B), r) + _dot(_t(E), e) if needs[9] else None
        # The product of a residual with what its matrix was multiplied by; None: with 1.
        factors = [(r, x), (r, u), (r, lam), (r, None), (e, x), (e, u), (e, lam), (e, None)]
        found = []
        for (left, right), tensor, rank in zip(factors, tensors, self.ranks, strict=False):
            if tensor.ndim == rank:
                found.append(left.sum(0) if right is None else left.T @ right)
            else:
                found.append(left if right is None else left[:, :, None] * right[:, None, :])
        pairs = zip([*found, x_bar, u_bar, -r], tensors, strict=False)
        return [*(None if g is None else torch.from_numpy(g).to(v) for g, v in pairs), None]


def _arrays(tensors: Sequence[Tensor]) -> list[np.ndarray]:
    return [v.detach().cpu().double().numpy() for v in tensors]


def _t(matrix: np.ndarray) -> np.ndarray:
    return matrix.swapaxes(-1, -2)


def _dot(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Matrix · vector for vectors (count, columns) and a matrix that is shared, or one for each."""
    return vector @ matrix.T if matrix.ndim == 2 else (matrix @ vector[..., None])[..., 0]


def largest_gamma(F: Tensor) -> Tensor:
    """`AUTO` times the smallest σ_min(F + Fᵀ) of all F (..., n, n), detached; float64, no dimensions."""
    F = F.detach().double()
    if not F.numel():
        return torch.ones((), dtype=torch.float64, device=F.device)  # nothing limits it
    return AUTO * torch.linalg.eigvalsh(F + F.mT)[..., 0].amin()


def check_gamma_range(F: np.ndarray, gamma: float | np.ndarray) -> None:
    """Refuse γ (...) outside its range for F (..., n, n), and F that is not positive definite."""
    n, gamma = F.shape[-1], np.asarray(gamma, np.float64)
    symmetric = F + _t(F)
    # FᵀF/γ stands beside F + Fᵀ in the inner QP: their difference has to survive the rounding.
    least = _GAMMA_LEAST * n * (F * F).sum(-2).max(-1)  # times 1/σ_min
    if (
        F.ndim > 2
        and (gamma > 0).all()
        and _definite(symmetric - np.maximum(gamma, least / gamma)[..., None, None] * np.eye(n))
    ):
        return
    smallest = np.linalg.eigvalsh(symmetric)[..., 0]

    def refuse(bad: np.ndarray, kind: type[Exception], message: str, *numbers: np.ndarray) -> None:
        if not bad.any():
            return
        i = int(bad.argmax())
        values = (float(np.broadcast_to(v, bad.shape).reshape(-1)[i]) for v in numbers)
        raise kind(message.format(*values, where=f" at batch index {i}" if bad.ndim else ""))

    refuse(
        smallest <= 0,
        NotPositiveDefiniteError,
        "F: expected F + Fᵀ positive definite, got smallest eigenvalue {:.3e}{where}; raise the model's stiffness",
        smallest,
    )
    # The bound itself is allowed; a relative 1e-9 forgives the rounding of the eigenvalue.
    refuse(
        (gamma <= 0) | (gamma > smallest * (1 + 1e-9)),
        GammaError,
        "gamma: expected 0 < gamma <= sigma_min(F + F^T) = {:.6g}, got {:.6g}{where}; lower gamma, raise the model's "
        "stiffness (sigma_min >= 2*stiffness), or take gamma='auto'",
        smallest,
        gamma,
    )
    refuse(
        gamma < least / smallest,
        GammaError,
        "gamma: expected at least {:.3g} for this F in double precision, got {:.3g}{where}; raise gamma, or the "
        "model's stiffness",
        least / smallest,
        gamma,
    )


def _definite(matrices: np.ndarray) -> bool:
    """Whether all are positive definite, ten times as fast as their eigenvalues."""
    try:
        np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        return False
    return True


def minimise_over_orthant(Q: np.ndarray, q: np.ndarray, max_iter: int = 500) -> np.ndarray:
    """Minimise ½ zᵀQz + qᵀz over z ≥ 0 for each row of q (B, m), with Q ⪰ 0 up to its rounding.

    Q is (m, m), shared by all rows, or (B, m, m).
    """
    unit = 1 / np.sqrt(np.diagonal(Q, axis1=-2, axis2=-1))  # of each variable, so that Q has a unit diagonal
    Q, q = unit[..., :, None] * Q * unit[..., None, :], q * unit
    eye = np.eye(Q.shape[-1])
    if Q.ndim > 2 and _definite(Q - 1e-13 * eye):
        return _solved(Q, q) * unit
    smallest = np.linalg.eigvalsh(Q)[..., 0]
    convex = smallest > 1e-13
    if convex.all():
        return _solved(Q, q) * unit
    if convex.any():  # one after the other: each has its own matrix
        z = np.empty_like(q)
        for part in (convex, ~convex):
            z[part] = minimise_over_orthant(Q[part], q[part], max_iter)
        return z * unit
    # γ at its bound: Q is singular. Proximal steps z ← argmin ½zᵀQz + qᵀz + ½ρ‖z − z₋‖² decrease the objective
    # monotonically, and each is an LCP with a positive definite matrix.
    rho = np.maximum(1e-6, -1.1 * smallest)
    proximal = Q + rho[..., None, None] * eye
    z = np.zeros_like(q)
    for _ in range(max_iter):
        step = _solved(proximal, q - rho[..., None] * z)
        change = np.abs(step - z).max(initial=0.0)
        z = step
        if rho.max(initial=0.0) * change <= 1e-10 * np.abs(q).max(initial=0.0):
            return z * unit
    return z * unit


def _solved(Q: np.ndarray, q: np.ndarray) -> np.ndarray:
    z, _, status = solve_lcp_arrays(Q, q)
    failed = np.flatnonzero(status != Status.CONVERGED)
    if len(failed):
        raise SolveError(
            f"violation_loss: the inner QP failed on {len(failed)} of {len(status)} transitions (first: {failed[0]}); "
            f"check the scale of the data and of the parameters",
            failed.tolist(),
            status[failed].tolist(),
        )
    return z
