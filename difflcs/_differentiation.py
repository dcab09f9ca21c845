"""The bridge to autograd of whatever is computed outside it, also for `torch.func` and `torch.compile`.

A `Solver` says how to solve, and how to pull a gradient back. `solve` makes of it a node of the graph. Whatever
transform is active, both are only ever called with plain tensors:

- `torch.func.vmap` folds the dimension that it adds into the batch, in the solve and in its pullback;
- the pullback is a function of its own, so that `torch.func.grad`, which records every backward pass, can record it.
  Its own backward refuses: there are no second derivatives;
- `is_grads_batched`, and with it `torch.autograd.functional.jacobian(vectorize=True)`, maps the backward pass by an
  older vmap, which no rule of ours can reach; there the batched gradients are unwrapped by hand.
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar, ParamSpec, TypeVar

import torch
from torch import Tensor

from difflcs.errors import DoubleBackwardError

P = ParamSpec("P")
R = TypeVar("R")


# --- what is active -------------------------------------------------------------------------------------------------


def is_wrapped(tensor: Tensor) -> bool:
    """Whether a transform of `torch.func`, or a vectorised backward pass, stands between us and the numbers.

    There is no public question for it. A batched tensor refuses `.numpy()` and `bool()`; one that tracks gradients for
    `torch.func.grad` does not, but what is read from it is lost to the transform.
    """
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return functorch.is_functorch_wrapped_tensor(tensor) or functorch.is_legacy_batchedtensor(tensor)


def transforms_active() -> bool:
    """Whether code runs inside a transform of `torch.func`."""
    return torch._C._are_functorch_transforms_active()


def forward_mode_active() -> bool:
    """Whether code runs inside `torch.autograd.forward_ad.dual_level`."""
    return torch.autograd.forward_ad._current_level >= 0


def refuse_tangents(tensors: Iterable[Tensor]) -> None:
    """Refuse the inputs of forward mode, whose tangents would be lost without a word.

    Raises:
        NotImplementedError: a tensor has a tangent.
    """
    unpack = torch.autograd.forward_ad.unpack_dual
    if forward_mode_active() and any(unpack(tensor).tangent is not None for tensor in tensors):
        raise NotImplementedError(
            "expected reverse mode, got inputs with a tangent, but the layer has no forward-mode derivatives; use "
            "backward, torch.func.grad or jacrev, or torch.autograd.functional.jacobian without strategy='forward-mode'"
        )


def runs_eagerly(function: Callable[P, R]) -> Callable[P, R]:
    """A function whose numbers are those of eager code in its own precision, whatever runs around it.

    `torch.compile` leaves it to Python: a break of the graph. `torch.compiler.disable` at import would import the
    compiler, which takes seconds. And `torch.autocast` is off inside.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(wrapper)(*args, **kwargs)  # pyright: ignore[reportCallIssue]
        if torch._C._is_any_autocast_enabled():
            with torch._C._DisableAutocast():
                return function(*args, **kwargs)
        return function(*args, **kwargs)

    return wrapper


# --- a function and its pullback ------------------------------------------------------------------------------------


class Solver(ABC):
    """A function of tensors that is computed outside autograd, and its pullback.

    Each input has its own dimensions, and before them those of the batch, or none of these if the batch shares it; they
    broadcast. Every output has all dimensions of the batch first. `torch.func.vmap` makes one dimension of them.

    Attributes:
        name: what has first derivatives only, for the error message.
        ranks: number of its own dimensions of each input.
        differentiable: number of outputs that have a gradient. They come first.
        keeps: whether `solve` leaves in the solver, which then serves one call, what its pullback needs. The pullback
            is always of all that was solved, in the same order, and gets no outputs: of several gradients for one
            solve, one after the other. So callers may change outputs in place.
    """

    name: ClassVar[str]
    ranks: ClassVar[tuple[int, ...]]
    differentiable: ClassVar[int]
    keeps: ClassVar[bool] = False

    @abstractmethod
    def solve(self, tensors: Sequence[Tensor], transformed: bool) -> tuple[Tensor, ...]:
        """The outputs. `transformed`: nothing has looked at the numbers yet, and nobody can warn later."""

    @abstractmethod
    def pullback(
        self,
        tensors: Sequence[Tensor],
        outputs: Sequence[Tensor],
        grads: Sequence[Tensor | None],
        needs: Sequence[bool],
    ) -> Sequence[Tensor | None]:
        """A gradient for each of `tensors` that needs one, None for zero.

        It is of the shape of the input; or has the batch in one dimension, and is summed to that shape by the caller.
        Under `torch.func.vmap` each element may have inputs of its own that were shared in the solve.

        Args:
            tensors: the inputs.
            outputs: what `solve` returned.
            grads: of the differentiable outputs; None for zero.
            needs: which of the inputs need a gradient.
        """

    def refuse(self) -> None:
        """Raise, where a second derivative was asked."""
        raise DoubleBackwardError(f"{self.name} has first derivatives only; expected create_graph=False")


def solve(solver: Solver, *tensors: Tensor) -> tuple[Tensor, ...]:
    """The outputs of a solver, as nodes of the graph if there is one."""
    if transforms_active():
        return _Transformed.apply(solver, *tensors)[:-1]  # pyright: ignore[reportReturnType, reportOptionalSubscript]
    if forward_mode_active() or (torch.is_grad_enabled() and any([tensor.requires_grad for tensor in tensors])):
        return _Eager.apply(solver, *tensors)  # pyright: ignore[reportReturnType]
    return solver.solve(tensors, transformed=False)


def _keep(ctx: Any, solver: Solver, tensors: Sequence[Tensor], outputs: Sequence[Tensor], kept: Iterable[Tensor]):
    ctx.solver, ctx.count = solver, len(tensors)
    ctx.save_for_backward(*tensors, *kept)  # also so that autograd refuses inputs that were changed in place
    ctx.mark_non_differentiable(*outputs[solver.differentiable :])
    ctx.set_materialize_grads(False)


class _Eager(torch.autograd.Function):
    # The style with `setup_context`, which transforms need, costs 20 µs more a call: it reads a signature each time.
    @staticmethod
    def forward(ctx, solver: Solver, *tensors: Tensor):
        outputs = solver.solve(tensors, transformed=False)
        _keep(ctx, solver, tensors, outputs, () if solver.keeps else outputs)
        return outputs

    @staticmethod
    def backward(ctx, *grads: Tensor | None):
        solver, saved, grads = ctx.solver, ctx.saved_tensors, grads[: ctx.solver.differentiable]
        if all(grad is None for grad in grads):
            return (None,) * (1 + ctx.count)
        gradients = pull_back(solver, saved[: ctx.count], saved[ctx.count :], grads, ctx.needs_input_grad[1:])
        return None, *gradients


class _Transformed(torch.autograd.Function):
    """The outputs, and an empty tensor that knows which transforms they have met."""

    @staticmethod
    def forward(solver: Solver, *tensors: Tensor):
        outputs = solver.solve(tensors, transformed=True)
        return *outputs, outputs[0].new_empty((*outputs[0].shape[:1], 0))

    @staticmethod
    def setup_context(ctx, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        _keep(ctx, inputs[0], inputs[1:], output, output[-1:] if inputs[0].keeps else output[:-1])

    backward = _Eager.backward

    @staticmethod
    def vmap(info, in_dims: tuple, solver: Solver, *tensors: Tensor):
        flat, batch = _flatten(info.batch_size, in_dims[1:], tensors, solver.ranks, share=True)
        outputs = _Transformed.apply(solver, *flat)
        outputs = tuple(v.reshape(info.batch_size, *batch, *v.shape[1:]) for v in outputs)  # pyright: ignore
        return outputs, (0,) * len(outputs)


def pull_back(
    solver: Solver,
    tensors: Sequence[Tensor],
    outputs: Sequence[Tensor],
    grads: Sequence[Tensor | None],
    needs: Sequence[bool],
) -> Sequence[Tensor | None]:
    """A solver's pullback, for the backward pass of an autograd function, whatever transform it runs in."""
    legacy = torch._C._functorch.is_legacy_batchedtensor  # pyright: ignore[reportAttributeAccessIssue]
    batched = any([grad is not None and legacy(grad) for grad in grads])
    if torch.is_grad_enabled() and (batched or not transforms_active()):
        solver.refuse()
    if batched or transforms_active():
        # Inside a transform of torch.func every backward pass is recorded; it is refused when it is differentiated.
        function = _pull_back_legacy if batched else _Pullback.apply
        found = iter(function(solver, needs, len(tensors), len(outputs), *tensors, *outputs, *grads))  # pyright: ignore
        gradients = [next(found) if needed else None for needed in needs]
    else:
        gradients = _summed(solver, tensors, solver.pullback(tensors, outputs, grads, needs))
    pairs = zip(gradients, tensors, strict=True)
    return [None if gradient is None else gradient.to(like) for gradient, like in pairs]


class _Pullback(torch.autograd.Function):
    """Gradients of the first n values, which are inputs, where they need one; then come m outputs and the gradients."""

    @staticmethod
    def forward(solver: Solver, needs: Sequence[bool], n: int, m: int, *values: Tensor):
        tensors, outputs, grads = values[:n], values[n : n + m], values[n + m :]
        gradients = _summed(solver, tensors, solver.pullback(tensors, outputs, grads, needs))
        needed = [pair for pair, need in zip(zip(gradients, tensors, strict=True), needs, strict=True) if need]
        return tuple(torch.zeros_like(v) if g is None else g for g, v in needed)

    @staticmethod
    def setup_context(ctx, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.solver = inputs[0]

    @staticmethod
    def backward(ctx, *_: Tensor):
        ctx.solver.refuse()

    @staticmethod
    def vmap(info, in_dims: tuple, solver: Solver, needs: Sequence[bool], n: int, m: int, *values: Tensor | None):
        gradients = _pull_back_many(info.batch_size, in_dims[4:], solver, needs, n, m, values)
        return gradients, (0,) * len(gradients)


def _pull_back_many(
    count: int,
    dims: Sequence[int | None],
    solver: Solver,
    needs: Sequence[bool],
    n: int,
    m: int,
    values: Sequence[Tensor | None],
) -> tuple[Tensor, ...]:
    """What `_Pullback` returns of `count` problems, or of as many gradients of one, (count, …) each."""
    if solver.keeps and all(dim is None for dim in dims[n : n + m]):  # the solve has not met this dimension
        each = []
        for i in range(count):
            one = [v if v is None or dim is None else v.select(dim, i) for v, dim in zip(values, dims, strict=True)]
            each.append(_Pullback.apply(solver, needs, n, m, *one))
        return tuple(torch.stack(parts) for parts in zip(*each, strict=True))
    sizes = [0 if v is None else v.ndim - (dim is not None) for v, dim in zip(values, dims, strict=True)]
    leading = max(size - rank for size, rank in zip(sizes, solver.ranks, strict=False))
    ranks = (*solver.ranks, *(size - leading for size in sizes[n:]))
    # Shared inputs are repeated: each of the `count` problems wants the gradient of its own.
    flat, batch = _flatten(count, dims, values, ranks, share=False)
    found, gradients = [], iter(_Pullback.apply(solver, needs, n, m, *flat))  # pyright: ignore
    for value, dim, rank, needed in zip(values, dims, ranks, needs, strict=False):
        if not needed or value is None:
            continue
        gradient = next(gradients)
        shape = list(value.shape)
        if dim is not None:
            del shape[dim]
        lead = [1] * (len(batch) - len(shape) + rank) + shape[: len(shape) - rank]
        gradient = gradient.reshape(count, *batch, *gradient.shape[1:])
        shared = [1 + i for i, (size, own) in enumerate(zip(batch, lead, strict=True)) if size != own]
        gradient = gradient.sum(shared, keepdim=True) if shared else gradient
        found.append(gradient.reshape(count, *shape))
    return tuple(found)


def _flatten(
    count: int, dims: Sequence[int | None], values: Sequence[Tensor | None], ranks: Sequence[int], share: bool
) -> tuple[list[Tensor | None], torch.Size]:
    """Fold a dimension of size `count` and those of the batch into one, and the dimensions that the batch had.

    `dims`: where each value has that dimension. `share`: a value that has neither stays as it is.
    """
    front, leads = [], []
    for value, dim, rank in zip(values, dims, ranks, strict=True):
        whole = None if value is None else value.unsqueeze(0) if dim is None else value.movedim(dim, 0)
        front.append(whole)
        leads.append(() if whole is None else whole.shape[1 : whole.ndim - rank])
    batch, flat = torch.broadcast_shapes(*leads), []
    for value, whole, dim, lead in zip(values, front, dims, leads, strict=True):
        if whole is None or (share and dim is None and not lead):
            flat.append(value)
            continue
        own = whole.shape[1 + len(lead) :]
        whole = whole.reshape(len(whole), *[1] * (len(batch) - len(lead)), *lead, *own)
        flat.append(whole.expand(count, *batch, *own).reshape(count * math.prod(batch), *own))
    return flat, batch


def _summed(solver: Solver, tensors: Sequence[Tensor], gradients: Sequence[Tensor | None]) -> list[Tensor | None]:
    """Gradients in the shapes of their inputs, summed over the batch where it shares an input."""
    found = list(gradients)
    for i, (gradient, like) in enumerate(zip(gradients, tensors, strict=True)):
        if gradient is None or gradient.shape == like.shape:
            continue
        if gradient.numel() != like.numel():
            leads = [tensor.shape[: tensor.ndim - rank] for tensor, rank in zip(tensors, solver.ranks, strict=True)]
            batch, lead, own = torch.broadcast_shapes(*leads), leads[i], like.shape[len(leads[i]) :]
            ones = [1] * (len(batch) - len(lead))
            gradient = gradient.reshape((*batch, *own)).sum_to_size((*ones, *lead, *own))
        found[i] = gradient.reshape(like.shape)
    return found


def _pull_back_legacy(solver: Solver, needs: Sequence[bool], n: int, m: int, *values: Tensor | None) -> list[Tensor]:
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    level = torch._C._vmapmode_increment_nesting() - 1  # pyright: ignore[reportAttributeAccessIssue]
    torch._C._vmapmode_decrement_nesting()  # pyright: ignore[reportAttributeAccessIssue]
    plain, dims, count = list(values), [], 1
    for i, value in enumerate(values):
        batched = value is not None and functorch.is_legacy_batchedtensor(value)
        dims.append(0 if batched else None)
        if batched:
            plain[i] = torch._remove_batch_dim(value, level, 1, 0)  # pyright: ignore
            count = plain[i].shape[0]  # pyright: ignore[reportOptionalMemberAccess]
    gradients = _pull_back_many(count, dims, solver, needs, n, m, plain)
    return [torch._add_batch_dim(g, 0, level) for g in gradients]  # pyright: ignore[reportPrivateImportUsage]
