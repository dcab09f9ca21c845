"""Losses that fit an LCS to observed transitions."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from difflcs import _checks
from difflcs._differentiation import Gradients, Solver, Tensors, runs_eagerly, solve, transforms_active
from difflcs._native import TOLERANCES, _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.errors import DTypeError, GammaError, InvalidInputError, NotPositiveDefiniteError, SolveError
from difflcs.lcp import MAX_ITER, solve_lcp_arrays
from difflcs.lcs import LCSModel, is_plain
from difflcs.records import SYSTEM, LCSModule, LCSParams, system_at
from difflcs.status import Status

# Least γ σ_min(F + Fᵀ), in parts of n_lam times the largest squared column of F.
_GAMMA_LEAST = TOLERANCES["gamma_least"]
# γ = "auto", in parts of its bound: at the bound itself the inner QP is singular wherever C is. A thousandth below it
# the smallest eigenvalue of F + Fᵀ − γI is a thousandth of that of F + Fᵀ.
_AUTO = 0.999
# Dimensions of A, B, C, d, D, E, F, c, x, u, x_next.
_RANKS = (*map(len, SYSTEM.values()), 1, 1, 1)


@runs_eagerly
@_checks.takes_arrays
def violation_loss(
    lcs: LCSModule | LCSParams,
    x: Tensor,
    u: Tensor,
    x_next: Tensor,
    gamma: float | Literal["auto"] = 0.1,
    xi: float = 0.01,
    *,
    context: Tensor | None = None,
    reduction: str = "mean",
) -> Tensor:
    """Compute the violation-based loss of an LCS (Eq. 2 of the paper; Jin et al.).

    For each transition, with r = A x + B u + C λ + d − x_next and e = D x + E u + F λ + c − φ,

        min over λ, φ ≥ 0 of  ½‖r‖² + (λᵀφ + ‖e‖²/(2γ))/ξ.

    The inner problem is a convex QP when 0 < γ ≤ σ_min(F + Fᵀ); it is solved exactly, as an LCP. Its value is
    differentiated by the envelope theorem: with (λ, φ) held at the minimiser, nothing is differentiated through the
    solve. The prior work's loss ‖r‖² + (λᵀφ + ‖e‖²/γ')/ξ' is 2·`violation_loss` with γ = γ'/2 and ξ = 2ξ'.

    Args:
        lcs: the model; any `LCSModule`, which is asked for `params(x, context)`; or `LCSParams`. The system may be
            shared, or one per transition: its batch dimensions broadcast with those of the data.
        x: (..., n_x) states.
        u: (..., n_u) actions.
        x_next: (..., n_x) observed next states.
        gamma: γ, weight of the slack; 0 < γ ≤ σ_min(F + Fᵀ) of every transition. "auto" takes 0.999 times the smallest
            of these bounds at each call, as a constant that is not differentiated: at the bound itself the inner QP
            can be singular, a thousandth below it is well solved. It grows with F, unlike a fixed γ.
        xi: ξ > 0, weight of the dynamics against complementarity. With a small ξ the loss is the prediction loss, with
            a large one the contact law is broken for free. It compares squared states with forces times gaps: the
            default suits states, forces and gaps of like units. A common unit of all of them changes nothing, as the
            loss grows with its square whatever ξ. `suggest_scales` finds such units.
        context: (..., n_context) passed on to the `params` of an `LCSModule`.
        reduction: "mean" over the batch, which is 0 of an empty one, or "none" for one value each.

    Returns:
        Scalar, or (...,) with reduction="none"; differentiable in the parameters, x, u and x_next.

    Raises:
        GammaError: γ is outside its range, or γ or γξ is too small for double precision: γ σ_min(F + Fᵀ) below 4e-13
            n_lam times the largest squared column of F loses the digits of the loss, and rounding e/(γξ) by more than
            1e-6 of the Cᵀr that it balances those of its gradient. The message names the limits.
        ShapeError, DTypeError, DeviceError, NonFiniteError, InvalidInputError: the arguments do not fit.
    """
    _checks.check_choice("reduction", reduction, ("mean", "none"))
    xi = _checks.check_number("xi", xi, strict=True)
    if isinstance(gamma, Tensor):  # γ has no gradient, nor is it one per transition
        raise DTypeError(f"gamma: expected a number, got {_checks.describe(gamma)}; convert it with float(...)")
    if not (isinstance(gamma, str) and gamma == "auto"):
        gamma = _checks.check_number("gamma", gamma)
    data = (x, u, x_next)
    if is_plain(lcs) and lcs.n_lam and not transforms_active():
        # The solver passes the gradient of F to G and H itself: autograd would take 40 µs for the five small steps, of
        # 190 µs for the loss of 100 transitions and its gradient.
        with torch.no_grad():
            F = lcs.F
        parameters: dict[str, Any] = lcs._parameters  # attributes, one by one, would take 5 µs
        system = tuple([F if name == "F" else parameters[name] for name in SYSTEM])
        factors = (parameters["G"], parameters["H"])
        if _plain(lcs, system, data):
            return _violation_loss(system, data, x.shape[:-1], gamma, xi, reduction, factors)
        lcs.check_inputs(x=x, u=u, x_next=x_next)
        for name, value in zip(SYSTEM, system, strict=True):
            _checks.check_tensor(name, value)
        batch = _checks.broadcast_batch([("x", x.shape[:-1]), ("u", u.shape[:-1]), ("x_next", x_next.shape[:-1])])
    else:
        params, factors = params_of_transitions(lcs, x, u, x_next, context), ()
        if not params.n_lam:
            return _prediction_loss(params, x, u, x_next, reduction)
        batch = _batch(params, x, u, x_next)
        system = tuple(_for_each(v, batch, len(SYSTEM[name])) for name, v in params.tensors().items())
    data = tuple(v.expand(*batch, v.shape[-1]).reshape(batch.numel(), v.shape[-1]) for v in data)
    return _violation_loss(system, data, batch, gamma, xi, reduction, factors)


@runs_eagerly
@_checks.takes_arrays
def prediction_loss(
    lcs: LCSModule | LCSParams,
    x: Tensor,
    u: Tensor,
    x_next: Tensor,
    *,
    context: Tensor | None = None,
    reduction: str = "mean",
) -> Tensor:
    """Compute ½‖x̂ − x_next‖² with x̂ predicted through the exact LCP, for comparison with `violation_loss`.

    Its gradient vanishes where contacts are wrongly inactive; that of the violation loss does not.

    Args:
        lcs: the model, any `LCSModule`, or `LCSParams`, shared or one per transition, as for `violation_loss`.
        x: (..., n_x) states.
        u: (..., n_u) actions.
        x_next: (..., n_x) observed next states.
        context: (..., n_context) passed on to the `params` of an `LCSModule`.
        reduction: "mean" over the batch, which is 0 of an empty one, or "none" for one value each.

    Returns:
        Scalar, or (...,) with reduction="none"; differentiable in the parameters, x, u and x_next.
    """
    _checks.check_choice("reduction", reduction, ("mean", "none"))
    return _prediction_loss(params_of_transitions(lcs, x, u, x_next, context), x, u, x_next, reduction)


def _prediction_loss(params: LCSParams, x: Tensor, u: Tensor, x_next: Tensor, reduction: str) -> Tensor:
    _batch(params, x, u, x_next)
    loss = 0.5 * (params.step(x, u).x_next - x_next).square().sum(-1)
    return _reduce(loss.reshape(-1), loss.shape, reduction)


def _reduce(loss: Tensor, batch: torch.Size, reduction: str) -> Tensor:
    # The mean of an empty batch is zero, not NaN: no data, no loss, no gradient.
    return loss.sum() / max(loss.numel(), 1) if reduction == "mean" else loss.reshape(batch)


def params_of_transitions(
    lcs: LCSModule | LCSParams, x: Tensor, u: Tensor, x_next: Tensor, context: Tensor | None
) -> LCSParams:
    """Return the system of some transitions, after a check that they fit it."""
    if context is not None:
        _checks.check_tensor("context", context)
    if isinstance(lcs, LCSParams):
        if context is not None:
            raise InvalidInputError(
                f"context: expected None beside LCSParams, which depend on nothing, got {_checks.describe(context)}; "
                f"leave it out, or pass an LCSModule"
            )
        params = lcs
    elif isinstance(lcs, LCSModule):
        _checks.check_tensor("x", x, [("n_x", lcs.n_x)])
        params = system_at(lcs, x, context)
        remedy = "transitions have no stages: give the system of each by batch dimensions"
        params = _checks.check_kind(f"{type(lcs).__name__}.params", params, LCSParams, remedy)
    else:
        raise DTypeError(
            f"lcs: expected an LCSModel, another LCSModule or LCSParams, got {_checks.describe(lcs)}; the stages of a "
            f"sequence become a batch by LCSParams(**sequence.tensors())"
        )
    params.check_inputs(x=x, u=u, x_next=x_next)
    return params


def _batch(params: LCSParams, x: Tensor, u: Tensor, x_next: Tensor) -> torch.Size:
    named = {"x": x, "u": u, "x_next": x_next}
    return _checks.broadcast_batch([("the system", params.batch_shape), *((k, v.shape[:-1]) for k, v in named.items())])


def _for_each(value: Tensor, batch: torch.Size, rank: int) -> Tensor:
    """Expand a field to (count, …), one per transition, unless it is shared."""
    shape = value.shape[value.ndim - rank :]
    return value if value.ndim == rank else value.expand(*batch, *shape).reshape(batch.numel(), *shape)


def _plain(lcs: LCSModel, system: tuple[Tensor, ...], data: tuple[Tensor, ...]) -> bool:
    """Return whether these are float64 matrices on the CPU that fit each other, so that the kernel can read them."""
    for value in system:
        if value.dtype is not torch.float64 or not value.is_cpu or value.layout is not torch.strided:
            return False
    for value, size in zip(data, (lcs.n_x, lcs.n_u, lcs.n_x), strict=True):
        if not _checks.is_array(value) or value.dtype is not torch.float64 or value.shape != (len(data[0]), size):
            return False
    return True


def _violation_loss(
    system: tuple[Tensor, ...],
    data: tuple[Tensor, ...],
    batch: torch.Size,
    gamma: float | str,
    xi: float,
    reduction: str,
    factors: tuple[Tensor, ...],
) -> Tensor:
    """Compute the loss of a system, each field shared or (count, …), on data (count, ·); `factors` of its F."""
    mean = reduction == "mean" and not transforms_active()
    if isinstance(gamma, str):
        rate = largest_gamma(system[6])
        if transforms_active():  # under which γ may differ between elements
            return _reduce(solve(_Transitions(xi, None), *system, *data, rate)[0], batch, reduction)
        gamma = float(rate)
    loss = solve(_Transitions(xi, gamma, mean, bool(factors)), *system, *data, *factors)[0]
    return loss if mean else _reduce(loss, batch, reduction)


@dataclass
class _Transitions(Solver):
    """Solver of the loss: A, B, C, d, D, E, F, c, x, u, x_next → the loss of each transition, or its mean; in C++.

    The inner problem over z = (λ, φ) ≥ 0 is to minimise ½ zᵀQz + qᵀz, whose optimality is the LCP (Q, q):

        Q = [[CᵀC + FᵀF/(γξ), (I − Fᵀ/γ)/ξ], [·, I/(γξ)]],  q = (Cᵀr + Fᵀe/(γξ), −e/(γξ)) with r and e at z = 0.

    Eliminating φ leaves CᵀC + (F + Fᵀ − γI)/ξ, positive definite for γ < σ_min(F + Fᵀ). The pullback is the envelope
    theorem: the derivative of the objective with z fixed. r and e are linear in every input.

    Attributes:
        xi: ξ.
        gamma: γ; None: it is one more input, which has no gradient.
        mean: whether to return the mean, where no transform adds dimensions to the batch. Otherwise autograd would take
            its two steps.
        factored: whether the factors G and H of F are two more inputs, and get the gradient in its place.
        arrays, minimiser: the inputs of the kernels, and z, r and e at the minimum, once it is solved.
    """

    xi: float
    gamma: float | None
    mean: bool = False
    factored: bool = False
    arrays: list[np.ndarray] | None = field(init=False, default=None)
    minimiser: tuple[np.ndarray, np.ndarray, np.ndarray] = field(init=False)

    name = "violation_loss"
    differentiable = 1
    keeps = True

    @property
    def ranks(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (*_RANKS, *((0,) if self.gamma is None else (2, 2) if self.factored else ()))

    def solve(self, tensors: Tensors, transformed: bool) -> tuple[Tensor, ...]:
        arrays = self._arrays(tensors)
        x, c = arrays[8], arrays[7]
        count, n = len(x), c.shape[-1]
        shared = self.factored or (
            not arrays[11].ndim and all([a.ndim == rank for a, rank in zip(arrays[:8], _RANKS, strict=False)])
        )
        Q = np.empty((2 * n, 2 * n) if shared else (count, 2 * n, 2 * n))
        q, z, r = np.empty((count, 2 * n)), np.empty((count, 2 * n)), np.empty(x.shape)
        e, loss = np.empty((count, n)), np.empty(count)
        limit, threads = MAX_ITER["exact"], torch.get_num_threads()
        lost = _kernels.violation_loss(arrays, self.xi, limit, threads, Q, q, z, r, e, loss)
        if lost is None:
            # A number that is not finite, a γ at or above its bound, or an empty batch.
            for name, tensor in zip((*SYSTEM, "x", "u", "x_next"), tensors, strict=False):
                _checks.check_tensor(name, tensor)
            check_gamma_range(arrays[6].astype(np.float64), arrays[11])
            z = minimise_over_orthant(Q, q)
            lost = _kernels.violation_value(arrays, self.xi, z, r, e, loss)
        if lost >= 0:
            rate = float(np.broadcast_to(arrays[11], count)[lost])
            raise GammaError(
                f"gamma, xi: expected a product that double precision resolves for these data, got {rate:.3g} and "
                f"{self.xi:.3g}: e/(gamma xi) has lost the digits of the gradient at batch index {lost}; raise xi or "
                f"gamma"
            )
        self.arrays, self.minimiser = None if transformed else arrays, (z, r, e)
        value = torch.from_numpy(loss)
        return ((value.sum() / max(count, 1) if self.mean else value).to(tensors[8]),)

    def pullback(self, tensors: Tensors, outputs: Tensors, grads: Gradients, needs: Sequence[bool]) -> Gradients:
        # Under a transform, inputs that were shared in the solve may now differ between elements.
        arrays = self._arrays(tensors) if self.arrays is None else self.arrays
        (upstream,) = grads
        assert upstream is not None
        bar = upstream.numpy(force=True)
        if self.mean:  # one number for all
            bar = np.asarray(bar / max(len(arrays[8]), 1))
        gradients: list[Any] = [np.empty(v.shape) if i < 8 or needs[i] else None for i, v in enumerate(arrays[:11])]
        _kernels.violation_gradient(arrays, self.xi, *self.minimiser, bar, [*gradients, None])
        if self.factored:  # F = G Gᵀ + stiffness·I + H − Hᵀ
            F_bar, G = gradients[6], tensors[11].numpy(force=True)
            gradients += [(F_bar + F_bar.T) @ G, F_bar - F_bar.T]
        converted = [None if g is None else torch.from_numpy(g) for g in gradients]
        return converted if len(converted) == len(tensors) else [*converted, None]

    def _arrays(self, tensors: Tensors) -> list[np.ndarray]:
        """Collect the inputs of the kernels."""
        arrays = [v.numpy(force=True) for v in tensors[:11]]
        return [*arrays, tensors[11].numpy(force=True) if self.gamma is None else np.array(self.gamma)]


# --- the range of γ, and inner problems at its end --------------------------------------------------------------------


def largest_gamma(F: Tensor) -> Tensor:
    """Compute `_AUTO` times the smallest σ_min(F + Fᵀ) of all F (..., n, n), detached; float64, no dimensions."""
    F = F.detach().double()
    if not F.numel():
        return torch.ones((), dtype=torch.float64, device=F.device)  # nothing limits it
    try:
        return _AUTO * torch.linalg.eigvalsh(F + F.mT)[..., 0].amin()
    except RuntimeError:  # of LAPACK
        _checks.check_tensor("F", F)  # where a training has diverged
        raise


def check_gamma_range(F: np.ndarray, gamma: float | np.ndarray) -> None:
    """Refuse γ (...) outside its range for F (..., n, n), and F that is not positive definite."""
    n, gamma = F.shape[-1], np.asarray(gamma, np.float64)
    # FᵀF/γ stands beside F + Fᵀ in the inner QP: their difference has to survive the rounding.
    least = _GAMMA_LEAST * n * (F * F).sum(-2).max(-1)  # times 1/σ_min
    smallest = np.linalg.eigvalsh(F + F.swapaxes(-1, -2))[..., 0]

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


def minimise_over_orthant(Q: np.ndarray, q: np.ndarray, max_iter: int = 500) -> np.ndarray:
    """Minimise ½ zᵀQz + qᵀz over z ≥ 0 for each row of q (B, m), with Q ⪰ 0 up to its rounding.

    Q is (m, m), shared by all rows, or (B, m, m).
    """
    unit = 1 / np.sqrt(np.diagonal(Q, axis1=-2, axis2=-1))  # of each variable, so that Q has a unit diagonal
    Q, q = unit[..., :, None] * Q * unit[..., None, :], q * unit
    smallest = np.linalg.eigvalsh(Q)[..., 0]
    convex = smallest > 1e-13
    if convex.all():
        return _solved(Q, q) * unit
    if convex.any():  # one after the other, as their matrices differ
        z = np.empty_like(q)
        for part in (convex, ~convex):
            z[part] = minimise_over_orthant(Q[part], q[part], max_iter)
        return z * unit
    # γ at its bound: Q is singular. Proximal steps z ← argmin ½zᵀQz + qᵀz + ½ρ‖z − z₋‖² decrease the objective
    # monotonically, and each is an LCP with a positive definite matrix.
    rho = np.maximum(1e-6, -1.1 * smallest)
    proximal = Q + rho[..., None, None] * np.eye(Q.shape[-1])
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
    if len(failed):  # by rounding, mostly: a proximal step from there takes the value to ½·1e-8·‖z − z₋‖² of its least
        near, before = (Q[failed] if Q.ndim == 3 else Q) + 1e-8 * np.eye(Q.shape[-1]), z[failed]
        z[failed], _, status[failed] = solve_lcp_arrays(near, q[failed] - 1e-8 * before)
        far = ~(np.abs(z[failed] - before).max(-1) <= 1e4 * np.abs(q[failed]).max(-1))  # residuals above 1e-4 of q
        status[failed[far]] = Status.NUMERICAL
        failed = np.flatnonzero(status != Status.CONVERGED)
    if len(failed):
        raise SolveError(
            f"violation_loss: the inner QP failed on {len(failed)} of {len(status)} transitions (first: {failed[0]}); "
            f"check the scale of the data and of the parameters",
            failed.tolist(),
            status[failed].tolist(),
        )
    return z
