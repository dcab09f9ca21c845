"""What can be trained: any `LCSModule` that is a `torch.nn.Module` with parameters, and its Jacobian."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from difflcs._checks import describe
from difflcs.errors import DTypeError, InvalidInputError
from difflcs.lcs import SYSTEM, LCSModule, LCSParams, LCSSequence
from difflcs.mpc import LCSMPCLayer
from difflcs.mpc.solution import Primal
from difflcs.records import system_at

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv


def check_module(lcs: object, env: VectorEnv | None = None, name: str = "lcs") -> nn.Module:
    """Refuse a system that cannot be learned, or, where an environment is given, one of other sizes.

    Args:
        lcs: the candidate.
        env: with observations Dict(state, goal).
        name: what to call it in the message.

    Returns:
        The same object.

    Raises:
        DTypeError: no `torch.nn.Module`, or no `LCSModule`.
        InvalidInputError: it is fixed, has no parameter that requires a gradient, or other sizes than the environment.
    """
    if isinstance(lcs, LCSParams | LCSSequence):
        raise InvalidInputError(
            f"{name}: expected a model that can be learned, got fixed {type(lcs).__name__}; use an LCSModel, or an "
            f"LCSModule of your own"
        )
    if not isinstance(lcs, nn.Module) or not isinstance(lcs, LCSModule):
        raise DTypeError(
            f"{name}: expected a torch.nn.Module with n_x, n_u, n_lam and params(x, context), got {describe(lcs)}; see "
            f"difflcs.LCSModule"
        )
    if not any(p.requires_grad for p in lcs.parameters()):
        count = len(list(lcs.parameters()))
        raise InvalidInputError(
            f"{name}: expected a parameter that requires a gradient in {type(lcs).__name__}, got {count} parameters "
            f"and none of that kind; make what is to be learned a torch.nn.Parameter"
        )
    if env is not None:
        spaces: tuple[Any, Any] = (env.single_observation_space, env.single_action_space)
        wanted, got = (spaces[0]["state"].shape[0], spaces[1].shape[0]), (lcs.n_x, lcs.n_u)
        if got != wanted:
            raise InvalidInputError(
                f"{name}: expected n_x={wanted[0]}, n_u={wanted[1]} like the states and actions of the environment, "
                f"got n_x={got[0]}, n_u={got[1]} of {type(lcs).__name__}; build it for this environment"
            )
    return lcs


def check_learned(learned: object, env: VectorEnv | None = None, name: str = "actor") -> nn.Module:
    """The same for what is behind a policy, where a network is no system and needs no sizes."""
    if isinstance(learned, nn.Module) and not isinstance(learned, LCSModule):
        return learned
    return check_module(learned, env, name)


def check_depends(loss: Tensor) -> None:
    """Refuse a loss that no parameter has a part in, where torch would speak of a grad_fn."""
    if not loss.requires_grad:
        raise InvalidInputError(
            "lcs: expected a system that depends on the module's parameters, got one without gradient; compute it in "
            "params(x, context) without torch.no_grad(), detach() and .data"
        )


# --- the Jacobian -----------------------------------------------------------------------------------------------------

FEW_PARAMETERS = 100
"""Up to so many, a system that depends on the state is differentiated for all samples at once."""

_CHUNK = 16
"""Else: samples whose systems are differentiated together: the gradients of each take no part of those of the others,
so that time and memory grow with the square of this."""


def system_jacobian(
    mpc: LCSMPCLayer, state: Tensor, goal: Tensor, guess: Primal | None, context: Tensor | None
) -> Tensor:
    """Jacobians of the MPC's action with respect to what is learned of its LCS, any `LCSModule`.

    First of the action with respect to the matrices, each sample with a copy of its own, then of these with respect to
    the parameters. The module need not know of batches of parameters.

    Args:
        mpc: the controller.
        state: (N, n_x).
        goal: (N, n_goal).
        guess: plans to start from, or none.
        context: (N, n_context), or none.

    Returns:
        (N, n_u, P) with the parameters that require a gradient in their order.
    """
    lcs: Any = mpc.lcs
    count, learned = len(state), [p for p in lcs.parameters() if p.requires_grad]
    with torch.enable_grad():
        system = system_at(lcs, state, context)
    leaves = {name: _each(system, name, count).detach().clone().requires_grad_() for name in SYSTEM}
    action = mpc(state, goal, guess=guess, lcs=type(system)(**leaves)).action
    upstream = []  # of each component of the action: {name: (N, ...)}
    for component in action.unbind(-1):
        found = torch.autograd.grad(component.sum(), list(leaves.values()), retain_graph=True, materialize_grads=True)
        upstream.append(found)
    weights = [torch.stack(parts, 1) for parts in zip(*upstream, strict=True)]  # of each matrix: (N, n_u, ...)
    if not system.batch_shape:
        return _pull_back(system, weights, learned)
    if sum(p.numel() for p in learned) <= FEW_PARAMETERS:
        found = _push_forward(system, weights, learned)
        if found is not None:
            return found
    rows = []
    for first in range(0, count, _CHUNK):
        part = slice(first, first + _CHUNK)
        with torch.enable_grad():
            own = system_at(lcs, state[part], None if context is None else context[part])
        rows.append(_pull_back(own, [w[part] for w in weights], learned))
    return torch.cat(rows)


def _push_forward(system: LCSParams | LCSSequence, weights: list[Tensor], learned: list[nn.Parameter]) -> Tensor | None:
    """Gradients (N, n_u, ...) with respect to the matrices → (N, n_u, P) to the parameters, of which there are few.

    The pullback vᵀ ∂system/∂θ is linear in v; its derivative by v is the derivative of all systems by each parameter.
    None where the module has a function that cannot be differentiated twice: the pullback does not depend on v then.
    """
    with torch.enable_grad():
        names = [name for name in SYSTEM if getattr(system, name).requires_grad]
        fields = [_each(system, name, len(weights[0])) for name in names]
        if not fields:
            check_depends(weights[0])
        v = [torch.zeros_like(field, requires_grad=True) for field in fields]
        pulled = torch.autograd.grad(fields, learned, v, create_graph=True, materialize_grads=True)
        flat = torch.cat([g.reshape(-1) for g in pulled])
        if not flat.requires_grad:
            return None
        each = torch.eye(len(flat), dtype=flat.dtype, device=flat.device)
        changes = torch.autograd.grad(flat, v, each, is_grads_batched=True, allow_unused=True)  # each (P, N, ...)
    if any(change is None for change in changes):
        return None
    found = weights[0].new_zeros(*weights[0].shape[:2], len(flat))
    of = dict(zip(SYSTEM, weights, strict=True))
    for name, change in zip(names, changes, strict=True):
        found += torch.einsum("nak,pnk->nap", of[name].flatten(2), change.flatten(2).to(found.dtype))
    return found


def _each(system: LCSParams | LCSSequence, name: str, count: int) -> Tensor:
    """A field with a batch dimension: (count, ...)."""
    value = getattr(system, name)
    own = len(SYSTEM[name]) + isinstance(system, LCSSequence)
    return value.expand(count, *value.shape[value.ndim - own :])


def _pull_back(system: LCSParams | LCSSequence, weights: list[Tensor], learned: list[nn.Parameter]) -> Tensor:
    """Gradients (k, n_u, ...) with respect to the matrices of k samples → (k, n_u, P) to the parameters."""
    k, n_u = weights[0].shape[:2]
    shared = not system.batch_shape
    fields, vectors = [], []
    for name, weight in zip(SYSTEM, weights, strict=True):
        value = getattr(system, name) if shared else _each(system, name, k)
        if not value.requires_grad:
            continue
        vector = weight.flatten(0, 1)
        if not shared:  # a sample's gradient is with respect to its own matrices
            own = torch.eye(k, dtype=torch.bool, device=weight.device).repeat_interleave(n_u, 0)
            vector = own.view(k * n_u, k, *[1] * (weight.ndim - 2)) * vector.unsqueeze(1)
        fields.append(value)
        vectors.append(vector.to(value.dtype))
    if not fields:
        check_depends(weights[0])
    found = torch.autograd.grad(fields, learned, vectors, is_grads_batched=True, allow_unused=True)
    flat = [
        torch.zeros(k * n_u, p.numel(), dtype=p.dtype) if v is None else v.reshape(k * n_u, -1)
        for v, p in zip(found, learned, strict=True)
    ]
    return torch.cat(flat, 1).view(k, n_u, -1)
