"""Losses that fit an LCS to observed transitions."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import broadcast_batch, check_choice, check_number, check_tensor, describe, is_array
from difflcs._differentiation import is_wrapped, pull_back, runs_eagerly, solve, transforms_active
from difflcs._violation import Transitions, check_gamma_range, largest_gamma, minimise_over_orthant
from difflcs.errors import DTypeError, GammaError, InvalidInputError
from difflcs.lcp import MAX_ITER
from difflcs.lcs import SYSTEM, LCSModel, LCSModule, LCSParams, is_plain
from difflcs.records import system_at


@runs_eagerly
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
    """The violation-based loss of an LCS (Eq. 2 of the paper; Jin et al.).

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
            can be singular, a thousandth below it is well solved. It grows with F where a fixed γ stays behind.
        xi: ξ > 0, weight of the dynamics against complementarity. With a small ξ the loss is the prediction loss, with
            a large one the contact law is broken for free. It compares squared states with forces times gaps: the
            default suits states, forces and gaps of like units. A common unit of all of them changes nothing, as the
            loss grows with its square whatever ξ. `suggest_scales` finds such units.
        context: (..., n_context) passed on to the `params` of an `LCSModule`.
        reduction: "mean" over the batch, or "none" for one value each.

    Returns:
        Scalar, or (...,) with reduction="none"; differentiable in the parameters, x, u and x_next.

    Raises:
        GammaError: γ is outside its range, or γ or γξ is too small for double precision: γ σ_min(F + Fᵀ) below 4e-13
            n_lam times the largest squared column of F loses the digits of the loss, and rounding e/(γξ) by more than
            1e-6 of the Cᵀr that it balances those of its gradient. The message names the limits.
        ShapeError, DTypeError, DeviceError, NonFiniteError, InvalidInputError: the arguments do not fit.
    """
    check_choice("reduction", reduction, ("mean", "none"))
    xi = check_number("xi", xi, strict=True)
    if isinstance(gamma, Tensor):  # nothing is differentiated by γ, nor is it one per transition
        raise DTypeError(f"gamma: expected a number, got {describe(gamma)}; convert it with float(...)")
    if not (isinstance(gamma, str) and gamma == "auto"):
        gamma = check_number("gamma", gamma)
    if is_plain(lcs) and lcs.n_lam and not transforms_active():
        # The loss passes the gradient of F to G and H itself: autograd would take 40 µs for the five small steps, of
        # 190 µs for the loss of 100 transitions and its gradient.
        with torch.no_grad():
            F = lcs.F
        system = (lcs.A, lcs.B, lcs.C, lcs.d, lcs.D, lcs.E, F, lcs.c)
        batch = x.shape[:-1] if _plain(lcs, system, (x, u, x_next)) else None
        if batch is None:
            _check_numbers(lcs, system, (x, u, x_next))
            batch = broadcast_batch([("x", x.shape[:-1]), ("u", u.shape[:-1]), ("x_next", x_next.shape[:-1])])
            x, u, x_next = (v.expand(*batch, v.shape[-1]).reshape(-1, v.shape[-1]) for v in (x, u, x_next))
        return _shared(lcs, system, (x, u, x_next), gamma, xi, reduction, batch, (lcs.G, lcs.H))
    params = _params(lcs, x, u, x_next, context)
    if not params.n_lam:
        return _prediction_loss(params, x, u, x_next, reduction)
    batch = _batch(params, x, u, x_next)
    count = batch.numel()
    x, u, x_next = (v.expand(*batch, v.shape[-1]).reshape(count, v.shape[-1]) for v in (x, u, x_next))
    system = tuple(_for_each(v, batch, len(SYSTEM[name])) for name, v in params.tensors().items())
    if all(v.ndim == len(dims) for v, dims in zip(system, SYSTEM.values(), strict=True)) and not transforms_active():
        return _shared(params, system, (x, u, x_next), gamma, xi, reduction, batch)
    if isinstance(gamma, str):
        rate = largest_gamma(params.F)
    else:
        rate = torch.tensor(float(gamma), dtype=torch.float64, device=x.device)
    loss = solve(Transitions(xi), *system, x, u, x_next, rate)[0]
    return _reduce(loss, batch, reduction)


@runs_eagerly
def prediction_loss(
    lcs: LCSModule | LCSParams,
    x: Tensor,
    u: Tensor,
    x_next: Tensor,
    *,
    context: Tensor | None = None,
    reduction: str = "mean",
) -> Tensor:
    """½‖x̂ − x_next‖² with x̂ predicted through the exact LCP, for comparison with `violation_loss`.

    Its gradient vanishes where contacts are wrongly inactive, which is what the violation loss mends.

    Args:
        lcs: the model, any `LCSModule`, or `LCSParams`, shared or one per transition, as for `violation_loss`.
        x: (..., n_x) states.
        u: (..., n_u) actions.
        x_next: (..., n_x) observed next states.
        context: (..., n_context) passed on to the `params` of an `LCSModule`.
        reduction: "mean" over the batch, or "none" for one value each.

    Returns:
        Scalar, or (...,) with reduction="none"; differentiable in the parameters, x, u and x_next.
    """
    check_choice("reduction", reduction, ("mean", "none"))
    return _prediction_loss(_params(lcs, x, u, x_next, context), x, u, x_next, reduction)


def _prediction_loss(params: LCSParams, x: Tensor, u: Tensor, x_next: Tensor, reduction: str) -> Tensor:
    _batch(params, x, u, x_next)
    loss = 0.5 * (params.step(x, u).x_next - x_next).square().sum(-1)
    return _reduce(loss.reshape(-1), loss.shape, reduction)


def _reduce(loss: Tensor, batch: torch.Size, reduction: str) -> Tensor:
    # The mean of an empty batch is zero, not NaN: no data, no loss, no gradient.
    return loss.sum() / max(loss.numel(), 1) if reduction == "mean" else loss.reshape(batch)


def _params(lcs: LCSModule | LCSParams, x: Tensor, u: Tensor, x_next: Tensor, context: Tensor | None) -> LCSParams:
    """The system of some transitions, which are checked against it."""
    if context is not None:
        check_tensor("context", context)
    if isinstance(lcs, LCSParams):
        if context is not None:
            raise InvalidInputError(
                f"context: expected None beside LCSParams, which depend on nothing, got {describe(context)}; leave it "
                f"out, or pass an LCSModule"
            )
        params = lcs
    elif isinstance(lcs, LCSModule):
        check_tensor("x", x, [("n_x", lcs.n_x)])
        params = system_at(lcs, x, context)
        if not isinstance(params, LCSParams):
            raise DTypeError(
                f"{type(lcs).__name__}.params: expected LCSParams for transitions, which have no stages, got "
                f"{type(params).__name__}; give the system of each transition by batch dimensions"
            )
    else:
        raise DTypeError(
            f"lcs: expected an LCSModel, another LCSModule or LCSParams, got {describe(lcs)}; the stages of a "
            f"sequence become a batch by LCSParams(**sequence.tensors())"
        )
    params.check_inputs(x=x, u=u, x_next=x_next)
    return params


def _batch(params: LCSParams, x: Tensor, u: Tensor, x_next: Tensor) -> torch.Size:
    named = {"x": x, "u": u, "x_next": x_next}
    return broadcast_batch([("the system", params.batch_shape), *((k, v.shape[:-1]) for k, v in named.items())])


def _for_each(value: Tensor, batch: torch.Size, rank: int) -> Tensor:
    """A field that is shared, or (count, …) of each transition."""
    own = value.shape[value.ndim - rank :]
    return value if value.ndim == rank else value.expand(*batch, *own).reshape(batch.numel(), *own)


def _shared(
    lcs: LCSModel | LCSParams,
    system: tuple[Tensor, ...],
    data: tuple[Tensor, ...],
    gamma: float | str,
    xi: float,
    reduction: str,
    batch: torch.Size,
    factors: tuple[Tensor, ...] = (),
) -> Tensor:
    """The loss with one system for all transitions, data (count, ·): in C++."""
    mean = reduction == "mean"
    rate = float(largest_gamma(system[6])) if isinstance(gamma, str) else gamma
    loss = _ViolationLoss.apply(lcs, mean, rate, xi, *system, *data, *factors)
    return loss if mean else loss.reshape(batch)  # pyright: ignore[reportReturnType, reportAttributeAccessIssue]


def _plain(lcs: LCSModel, system: tuple[Tensor, ...], data: tuple[Tensor, ...]) -> bool:
    """Whether these are float64 matrices on the CPU that fit each other: then the kernel can look at the numbers."""
    if not all(is_array(v) and v.dtype is torch.float64 for v in (*system, *data)):
        return False
    count = data[0].shape[0] if data[0].ndim else 0
    return all(v.shape == (count, n) for v, n in zip(data, (lcs.n_x, lcs.n_u, lcs.n_x), strict=True))


def _check_numbers(lcs: LCSModel | LCSParams, system: tuple[Tensor, ...], data: tuple[Tensor, ...]) -> None:
    lcs.check_inputs(**dict(zip(("x", "u", "x_next"), data, strict=True)))
    for name, value in zip(SYSTEM, system, strict=True):
        check_tensor(name, value)


class _ViolationLoss(torch.autograd.Function):
    """The loss of A, B, C, d, D, E, F, c and x, u, x_next (B, ·), then G and H if F is their function.

    The mathematics is that of `Transitions`, in C++ for a system that all transitions share.
    """

    @staticmethod
    def forward(ctx, lcs: LCSModel | LCSParams, mean: bool, gamma: float, xi: float, *tensors: Tensor):
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
            check_gamma_range(F.detach().cpu().double().numpy(), gamma)
            z = minimise_over_orthant(Q, q)
            held = _kernels.violation_value(arrays, gamma, xi, z, r, e, loss)
        if not held:
            raise GammaError(
                f"gamma, xi: expected a product that double precision resolves for these data, got {gamma:.3g} and "
                f"{xi:.3g}: e/(gamma xi) has lost the digits of the gradient; raise xi or gamma"
            )
        ctx.mean, ctx.solution = mean, (arrays, gamma, xi, z, r, e)
        # The arrays look into these tensors; autograd refuses them where they were changed in place.
        x_needs, u_needs = ctx.needs_input_grad[12:14]
        ctx.save_for_backward(x, u, *tensors[11:12], *((A, B, D, E) if x_needs or u_needs else ()))
        value = torch.from_numpy(loss)
        # The mean of an empty batch is zero, not NaN: no data, no loss, no gradient.
        return (value.sum() / max(count, 1) if mean else value).to(x)

    @staticmethod
    def backward(ctx, *grads):
        if is_wrapped(grads[0]) or torch.is_grad_enabled():
            return _pull_back_transformed(ctx, grads[0])
        from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]

        x, _, *rest = ctx.saved_tensors
        arrays, gamma, xi, z, r, e = ctx.solution
        upstream = grads[0].numpy(force=True)
        if ctx.mean:
            upstream = np.full(len(z), upstream / max(len(z), 1))
        # Envelope theorem: derivative of the objective with z fixed. r and e are linear in every input.
        system = [np.empty(v.shape) for v in arrays[:8]]
        needs = zip(arrays[8:], ctx.needs_input_grad[12:15], strict=True)
        data = [np.empty(v.shape) if need else None for v, need in needs]
        _kernels.violation_gradient(arrays, gamma, xi, z, r, e, upstream, [*system, *data])
        gradients = [*system, *data]
        if len(ctx.needs_input_grad) > 15:  # F = G Gᵀ + stiffness·I + H − Hᵀ
            F_bar, G = system[6], rest[0].numpy(force=True)
            gradients += [(F_bar + F_bar.T) @ G, F_bar - F_bar.T]
        return (None,) * 4 + tuple(g if g is None else torch.from_numpy(g).to(x) for g in gradients)


def _pull_back_transformed(ctx, upstream: Tensor):
    """The gradient for an upstream that a transform wraps: NumPy's, of as many problems as it has. None to record."""
    x, _, *rest = ctx.saved_tensors
    arrays, gamma, xi, z, r, e = ctx.solution
    count = len(z)
    if ctx.mean:
        upstream = (upstream / max(count, 1)).expand(count)
    tensors = [*(torch.from_numpy(v) for v in arrays), torch.tensor(gamma, dtype=torch.float64)]
    outputs = [torch.empty(count, dtype=torch.float64), *(torch.from_numpy(v) for v in (z, r, e))]
    gradients = list(pull_back(Transitions(xi), tensors, outputs, [upstream], [True] * 12))[:11]
    if len(ctx.needs_input_grad) > 15:  # F = G Gᵀ + stiffness·I + H − Hᵀ
        F_bar = gradients[6]
        assert F_bar is not None
        gradients += [(F_bar + F_bar.mT) @ rest[0].detach().double(), F_bar - F_bar.mT]
    return (None,) * 4 + tuple(g if g is None else g.to(x) for g in gradients)
