"""Bridge to autograd for computations outside it, also under `torch.func` and `torch.compile`.

A `Solver` defines how to solve and how to pull a gradient back; `solve` makes it a node of the graph. Both are called
with plain tensors only, whatever transform is active:

- `torch.func.vmap` folds the dimension that it adds into the batch, in the solve and in its pullback;
- the pullback is a separate function, so that `torch.func.grad`, which records every backward pass, can record it.
  Its backward pass refuses: there are no second derivatives;
- `is_grads_batched`, and with it `torch.autograd.functional.jacobian(vectorize=True)`, maps the backward pass by an
  older vmap that accepts no rules; there the batched gradients are unwrapped by hand.
"""

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar, NoReturn, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

from difflcs.errors import DoubleBackwardError

P = ParamSpec("P")
R = TypeVar("R")
Tensors = Sequence[Tensor]
Gradients = Sequence[Tensor | None]
"""None stands for zero."""


# --- what is active -------------------------------------------------------------------------------------------------


def is_wrapped(tensor: Tensor) -> bool:
    """Return whether a transform of `torch.func`, or a vectorised backward pass, hides the numbers of a tensor.

    There is no public function for it. A batched tensor refuses `.numpy()` and `bool()`; one that tracks gradients for
    `torch.func.grad` does not, but what is read from it is lost to the transform.
    """
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return functorch.is_functorch_wrapped_tensor(tensor) or functorch.is_legacy_batchedtensor(tensor)


def transforms_active() -> bool:
    """Return whether code runs inside a transform of `torch.func`."""
    return torch._C._are_functorch_transforms_active()


def forward_mode_active() -> bool:
    """Return whether code runs inside `torch.autograd.forward_ad.dual_level`."""
    return torch.autograd.forward_ad._current_level >= 0


def refuse_tangents(tensors: Iterable[Tensor]) -> None:
    """Refuse the inputs of forward mode, whose tangents would be lost without a word.

    Raises:
        NotImplementedError: a tensor has a tangent.
    """
    unpack = torch.autograd.forward_ad.unpack_dual
    if forward_mode_active() and any(unpack(tensor).tangent is not None for tensor in tensors):
        _refuse_forward_mode()


def _refuse_forward_mode() -> NoReturn:
    raise NotImplementedError(
        "expected reverse mode, got inputs with a tangent, but the layer has no forward-mode derivatives; use "
        "backward, torch.func.grad or jacrev, or torch.autograd.functional.jacobian without strategy='forward-mode'"
    )


def runs_eagerly(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function compute as eager code in its own precision, whatever surrounds the call.

    `torch.compile` breaks the graph there. `torch.compiler.disable` at import would import the compiler, which takes
    seconds. `torch.autocast` is off inside.

    Raises:
        NotImplementedError: the call is traced by something else, such as `torch.export` or `torch.jit.trace`.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        compiling = torch.compiler.is_compiling()
        traced = torch.jit.is_tracing()  # pyright: ignore[reportPrivateImportUsage]
        if traced or (compiling and not torch.compiler.is_dynamo_compiling()):
            raise NotImplementedError(
                "expected eager code or torch.compile, got torch.export, torch.jit.trace or the like, whose graph "
                "cannot hold a solver; for C there is layer.controller().save(path)"
            )
        if compiling:
            return torch.compiler.disable(wrapper)(*args, **kwargs)  # pyright: ignore[reportCallIssue]
        if torch._C._is_any_autocast_enabled():
            with torch._C._DisableAutocast():
                return function(*args, **kwargs)
        return function(*args, **kwargs)

    return wrapper


# --- a function and its pullback ------------------------------------------------------------------------------------


class Solver(ABC):
    """A function of tensors that is computed outside autograd, with its pullback.

    Each input has batch dimensions before its trailing ones, or none if the batch shares it; they broadcast. Every
    output has all batch dimensions first. `torch.func.vmap` flattens them into one.

    Attributes:
        name: name of the function in the error for second derivatives.
        ranks: number of trailing dimensions of each input.
        differentiable: number of outputs that have a gradient. They come first.
        keeps: whether `solve` stores in the solver, which then serves one call, the data of its pullback. The pullback
            then covers the whole solve, in the same order, and gets no outputs; several gradients of one solve are
            computed one after the other. So callers may change outputs in place.
    """

    name: ClassVar[str]
    ranks: ClassVar[tuple[int, ...]]
    differentiable: ClassVar[int]
    keeps: ClassVar[bool] = False

    @abstractmethod
    def solve(self, tensors: Tensors, transformed: bool) -> tuple[Tensor, ...]:
        """Compute the outputs. `transformed`: the numbers are unchecked, and nobody can warn later."""

    @abstractmethod
    def pullback(self, tensors: Tensors, outputs: Tensors, grads: Gradients, needs: Sequence[bool]) -> Gradients:
        """Compute a gradient for each of `tensors` that needs one.

        It is of the shape of the input; or has the batch in one dimension, and is summed to that shape by the caller.
        Under `torch.func.vmap` inputs that were shared in the solve may differ between elements.

        Args:
            tensors: the inputs.
            outputs: those of `solve`.
            grads: of the differentiable outputs.
            needs: which of the inputs need a gradient.
        """

    def refuse(self) -> None:
        """Raise, where a second derivative was asked."""
        raise DoubleBackwardError(f"{self.name} has first derivatives only; expected create_graph=False")


def solve(solver: Solver, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Compute the outputs of a solver, as nodes of the graph if there is one."""
    if transforms_active():
        return _Transformed.apply(solver, *tensors)[:-1]  # pyright: ignore[reportReturnType, reportOptionalSubscript]
    if forward_mode_active() or (torch.is_grad_enabled() and any([tensor.requires_grad for tensor in tensors])):
        tensors = tuple([v.clone() if v.is_inference() else v for v in tensors])  # others cannot be saved for backward
        return _Eager.apply(solver, *tensors)  # pyright: ignore[reportReturnType]
    return solver.solve(tensors, transformed=False)


def _keep(ctx: Any, solver: Solver, tensors: Tensors, outputs: Tensors, kept: Iterable[Tensor], recorded: bool):
    ctx.solver, ctx.count, ctx.recorded = solver, len(tensors), recorded
    ctx.save_for_backward(*tensors, *kept)  # also so that autograd refuses inputs that were changed in place
    ctx.mark_non_differentiable(*outputs[solver.differentiable :])
    ctx.set_materialize_grads(False)


class _Eager(torch.autograd.Function):
    # The style with `setup_context`, which transforms need, costs 20 µs more a call: it reads a signature each time.
    @staticmethod
    def forward(ctx, solver: Solver, *tensors: Tensor):
        outputs = solver.solve(tensors, transformed=False)
        _keep(ctx, solver, tensors, outputs, () if solver.keeps else outputs, recorded=False)
        return outputs

    @staticmethod
    def backward(ctx, *grads: Tensor | None):
        solver, saved, grads = ctx.solver, ctx.saved_tensors, grads[: ctx.solver.differentiable]
        if all(grad is None for grad in grads):
            return (None,) * (1 + ctx.count)
        needs, recorded = ctx.needs_input_grad[1:], ctx.recorded
        gradients = pull_back(solver, saved[: ctx.count], saved[ctx.count :], grads, needs, recorded)
        return None, *gradients


class _Transformed(torch.autograd.Function):
    """Outputs, and an empty tensor that records which transforms they have passed through."""

    @staticmethod
    def forward(solver: Solver, *tensors: Tensor):
        outputs = solver.solve(tensors, transformed=True)
        return *outputs, outputs[0].new_empty((*outputs[0].shape[:1], 0))

    @staticmethod
    def setup_context(ctx, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        kept = output[-1:] if inputs[0].keeps else output[:-1]
        _keep(ctx, inputs[0], inputs[1:], output, kept, recorded=True)

    backward = _Eager.backward

    @staticmethod
    def jvp(ctx, *tangents: Tensor | None) -> NoReturn:
        _refuse_forward_mode()

    @staticmethod
    def vmap(info, in_dims: tuple, solver: Solver, *tensors: Tensor):
        flat, batch = _flatten(info.batch_size, in_dims[1:], tensors, solver.ranks, share=True)
        outputs = _Transformed.apply(solver, *flat)
        outputs = tuple(v.reshape(info.batch_size, *batch, *v.shape[1:]) for v in outputs)  # pyright: ignore
        return outputs, (0,) * len(outputs)


def pull_back(
    solver: Solver, tensors: Tensors, outputs: Tensors, grads: Gradients, needs: Sequence[bool], recorded: bool
) -> Gradients:
    """Run a solver's pullback in the backward pass of an autograd function, under any transform.

    `recorded`: the solve was inside a transform. The function that `torch.func.vjp` returns is called outside.
    """
    legacy = torch._C._functorch.is_legacy_batchedtensor  # pyright: ignore[reportAttributeAccessIssue]
    batched = any([grad is not None and legacy(grad) for grad in grads])
    recorded = recorded or transforms_active()
    if torch.is_grad_enabled() and (batched or not recorded):
        solver.refuse()
    if batched or recorded:
        # Transforms of torch.func record every backward pass; it is refused when it is differentiated.
        function = _pull_back_legacy if batched else _Pullback.apply
        results = iter(function(solver, needs, len(tensors), len(outputs), *tensors, *outputs, *grads))  # pyright: ignore
        gradients = [next(results) if needed else None for needed in needs]
    else:
        gradients = _summed(solver, tensors, solver.pullback(tensors, outputs, grads, needs))
    pairs = zip(gradients, tensors, strict=True)
    return [None if gradient is None else gradient.to(like) for gradient, like in pairs]


class _Pullback(torch.autograd.Function):
    """Gradients of those of the first n values, the inputs, that need one; then follow m outputs and the gradients."""

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
    count: int, dims: Sequence[int | None], solver: Solver, needs: Sequence[bool], n: int, m: int, values: Gradients
) -> tuple[Tensor, ...]:
    """Pull back `count` problems, or as many gradients of one; (count, …) each."""
    if solver.keeps and all(dim is None for dim in dims[n : n + m]):  # the solve has no such dimension
        each = []
        for i in range(count):
            one = [v if v is None or dim is None else v.select(dim, i) for v, dim in zip(values, dims, strict=True)]
            each.append(_Pullback.apply(solver, needs, n, m, *one))
        return tuple(torch.stack(parts) for parts in zip(*each, strict=True))
    sizes = [0 if v is None else v.ndim - (dim is not None) for v, dim in zip(values, dims, strict=True)]
    leading = max(size - rank for size, rank in zip(sizes, solver.ranks, strict=False))
    ranks = (*solver.ranks, *(size - leading for size in sizes[n:]))
    # Shared inputs are repeated, as each of the `count` problems needs a gradient.
    flat, batch = _flatten(count, dims, values, ranks, share=False)
    results, gradients = [], iter(_Pullback.apply(solver, needs, n, m, *flat))  # pyright: ignore
    for value, dim, rank, needed in zip(values, dims, ranks, needs, strict=False):
        if not needed or value is None:
            continue
        gradient = next(gradients)
        shape = list(value.shape)
        if dim is not None:
            del shape[dim]
        lead = [1] * (len(batch) - len(shape) + rank) + shape[: len(shape) - rank]
        gradient = gradient.reshape(count, *batch, *gradient.shape[1:])
        shared = [1 + i for i, (size, lead_size) in enumerate(zip(batch, lead, strict=True)) if size != lead_size]
        gradient = gradient.sum(shared, keepdim=True) if shared else gradient
        results.append(gradient.reshape(count, *shape))
    return tuple(results)


def _flatten(
    count: int, dims: Sequence[int | None], values: Sequence[Tensor | None], ranks: Sequence[int], share: bool
) -> tuple[list[Tensor | None], torch.Size]:
    """Fold a dimension of size `count` and the batch dimensions into one; also return the batch dimensions.

    `dims`: where each value has that dimension. `share`: a value that has neither stays as it is.
    """
    front, leads = [], []
    for value, dim, rank in zip(values, dims, ranks, strict=True):
        whole = None if value is None else value.unsqueeze(0) if dim is None else value.movedim(dim, 0)
        front.append(whole)
        leads.append(() if whole is None else whole.shape[1 : whole.ndim - rank])
    batch, flat = torch.Size(np.broadcast_shapes(*leads)), []
    for value, whole, dim, lead in zip(values, front, dims, leads, strict=True):
        if whole is None or (share and dim is None and not lead):
            flat.append(value)
            continue
        shape = whole.shape[1 + len(lead) :]
        whole = whole.reshape(len(whole), *[1] * (len(batch) - len(lead)), *lead, *shape)
        flat.append(whole.expand(count, *batch, *shape).reshape(count * math.prod(batch), *shape))
    return flat, batch


def _summed(solver: Solver, tensors: Tensors, gradients: Gradients) -> list[Tensor | None]:
    """Sum gradients to the shapes of their inputs, over the batch where it shares an input."""
    summed = list(gradients)
    for i, (gradient, like) in enumerate(zip(gradients, tensors, strict=True)):
        if gradient is None or gradient.shape == like.shape:
            continue
        if gradient.numel() != like.numel():
            leads = [tensor.shape[: tensor.ndim - rank] for tensor, rank in zip(tensors, solver.ranks, strict=True)]
            batch, lead, shape = np.broadcast_shapes(*leads), leads[i], like.shape[len(leads[i]) :]
            ones = [1] * (len(batch) - len(lead))
            gradient = gradient.reshape((*batch, *shape)).sum_to_size((*ones, *lead, *shape))
        summed[i] = gradient.reshape(like.shape)
    return summed


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
