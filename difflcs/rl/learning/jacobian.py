"""Jacobian of the MPC's action with respect to the parameters of its system, for any `LCSModule`."""

from typing import Any

import torch
from torch import Tensor, nn

from difflcs.errors import DoubleBackwardError
from difflcs.mpc import LCSMPCLayer
from difflcs.mpc.solution import Primal
from difflcs.records import SYSTEM, LCSParams, LCSSequence, system_at
from difflcs.rl.learning.checks import check_depends

FEW_PARAMETERS = 100
"""Up to this many parameters, a system that depends on the state is differentiated for all samples at once."""

_CHUNK = 16
"""With more parameters, the number of samples whose systems are differentiated together. Time and memory grow with its
square, as every gradient is computed with respect to all of their systems."""


def system_jacobian(
    mpc: LCSMPCLayer, state: Tensor, goal: Tensor, guess: Primal | None, context: Tensor | None
) -> Tensor:
    """Compute the Jacobians of the MPC's action with respect to the learned parameters of its `LCSModule`.

    First the Jacobian of the action with respect to the matrices, with a copy of them for each sample, then that of the
    matrices with respect to the parameters. The module need not support batches of parameters.

    Args:
        mpc: the controller.
        state: (N, n_x).
        goal: (N, n_goal).
        guess: plans to start from, or None.
        context: (N, n_context), or None.

    Returns:
        (N, n_u, P) with the parameters that require a gradient in their order.
    """
    lcs: Any = mpc.lcs
    count, learned = len(state), [p for p in lcs.parameters() if p.requires_grad]
    with torch.enable_grad():
        system = system_at(lcs, state, context)
    leaves = {name: _expand_field(system, name, count).detach().clone().requires_grad_() for name in SYSTEM}
    action = mpc(state, goal, guess=guess, lcs=type(system)(**leaves)).action
    upstream = []  # of each component of the action: {name: (N, ...)}
    for component in action.unbind(-1):
        upstream.append(
            torch.autograd.grad(component.sum(), list(leaves.values()), retain_graph=True, materialize_grads=True)
        )
    weights = [torch.stack(parts, 1) for parts in zip(*upstream, strict=True)]  # of each matrix: (N, n_u, ...)
    if not system.batch_shape:
        return _pull_back(system, weights, learned)
    if learned and hasattr(lcs, "slopes_along"):  # its derivatives are differences, two systems for each parameter
        return lcs.slopes_along([w.transpose(0, 1) for w in weights], state, context).transpose(0, 1)
    if sum(p.numel() for p in learned) <= FEW_PARAMETERS:
        jacobian = _push_forward(system, weights, learned)
        if jacobian is not None:
            return jacobian
    rows = []
    for first in range(0, count, _CHUNK):
        part = slice(first, first + _CHUNK)
        with torch.enable_grad():
            chunk = system_at(lcs, state[part], None if context is None else context[part])
        rows.append(_pull_back(chunk, [w[part] for w in weights], learned))
    return torch.cat(rows)


def _push_forward(system: LCSParams | LCSSequence, weights: list[Tensor], learned: list[nn.Parameter]) -> Tensor | None:
    """Map gradients (N, n_u, ...) for the matrices to gradients (N, n_u, P) for the parameters, when P is small.

    The pullback vᵀ ∂system/∂θ is linear in v; its derivative by v is the derivative of all systems by each parameter.
    Returns None if a function in the module cannot be differentiated twice: the pullback then does not depend on v.
    """
    with torch.enable_grad():
        names = [name for name in SYSTEM if getattr(system, name).requires_grad]
        fields = [_expand_field(system, name, len(weights[0])) for name in names]
        if not fields:
            check_depends(weights[0])
        v = [torch.zeros_like(field, requires_grad=True) for field in fields]
        try:
            pulled = torch.autograd.grad(fields, learned, v, create_graph=True, materialize_grads=True)
        except DoubleBackwardError:
            return None
        flat = torch.cat([g.reshape(-1) for g in pulled])
        if not flat.requires_grad:
            return None
        each = torch.eye(len(flat), dtype=flat.dtype, device=flat.device)
        changes = torch.autograd.grad(flat, v, each, is_grads_batched=True, allow_unused=True)  # each (P, N, ...)
    if any(change is None for change in changes):
        return None
    jacobian = weights[0].new_zeros(*weights[0].shape[:2], len(flat))
    gradients = dict(zip(SYSTEM, weights, strict=True))
    for name, change in zip(names, changes, strict=True):
        jacobian += torch.einsum("nak,pnk->nap", gradients[name].flatten(2), change.flatten(2).to(jacobian.dtype))
    return jacobian


def _expand_field(system: LCSParams | LCSSequence, name: str, count: int) -> Tensor:
    """Expand a field to a batch dimension: (count, ...)."""
    value = getattr(system, name)
    n_dims = len(SYSTEM[name]) + isinstance(system, LCSSequence)
    return value.expand(count, *value.shape[value.ndim - n_dims :])


def _pull_back(system: LCSParams | LCSSequence, weights: list[Tensor], learned: list[nn.Parameter]) -> Tensor:
    """Map gradients (k, n_u, ...) for the matrices of k samples to gradients (k, n_u, P) for the parameters."""
    k, n_u = weights[0].shape[:2]
    shared = not system.batch_shape
    fields, vectors = [], []
    for name, weight in zip(SYSTEM, weights, strict=True):
        value = getattr(system, name) if shared else _expand_field(system, name, k)
        if not value.requires_grad:
            continue
        vector = weight.flatten(0, 1)
        if not shared:  # a sample's gradient is with respect to its own matrices
            is_same_sample = torch.eye(k, dtype=torch.bool, device=weight.device).repeat_interleave(n_u, 0)
            vector = is_same_sample.view(k * n_u, k, *[1] * (weight.ndim - 2)) * vector.unsqueeze(1)
        fields.append(value)
        vectors.append(vector.to(value.dtype))
    if not fields:
        check_depends(weights[0])
    pulled = torch.autograd.grad(fields, learned, vectors, is_grads_batched=True, allow_unused=True)
    flat = [
        torch.zeros(k * n_u, p.numel(), dtype=p.dtype) if v is None else v.reshape(k * n_u, -1)
        for v, p in zip(pulled, learned, strict=True)
    ]
    return torch.cat(flat, 1).view(k, n_u, -1)
