"""Functions that are computed outside autograd, for `torch.func`, vectorised jacobians and `torch.compile`.

A `Solver` says how to solve, and how to pull a gradient back, for real numbers with one batch dimension. `solve` makes
of it a node of the graph. Whatever transform is active, both are only ever called with plain tensors:

- `torch.func.vmap` folds the dimension that it adds into the batch, in the solve and in its pullback;
- the pullback is a function of its own, so that `torch.func.grad`, which records every backward pass, can record it.
  Its own backward refuses: there are no second derivatives;
- `is_grads_batched`, and with it `torch.autograd.functional.jacobian(vectorize=True)`, maps the backward pass by an
  older vmap, which no rule of ours can reach; there the batched gradients are unwrapped by hand.
"""

from __future__ import annotations

import functools
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
    """A function of tensors that is computed outside autograd, and its pullback; frozen dataclasses, mostly.

    Each input has its own dimensions, and before them one of the batch, or none if the batch shares it. At least one
    has the dimension of the batch. Every output has it first.

    Attributes:
        name: what has first derivatives only, for the error message.
        ranks: number of its own dimensions of each input.
        differentiable: number of outputs that have a gradient. They come first.
    """

    name: ClassVar[str]
    ranks: ClassVar[tuple[int, ...]]
    differentiable: ClassVar[int]

    @abstractmethod
    def solve(self, tensors: Sequence[Tensor], transformed: bool) -> tuple[Tensor, ...]:
        """The outputs. `transformed`: nothing has looked at the numbers yet, and nobody can warn later."""

    @abstractmethod
    def pullback(
        self, tensors: Sequence[Tensor], outputs: Sequence[Tensor], grads: Sequence[Tensor], needs: Sequence[bool]
    ) -> Sequence[Tensor | None]:
        """A gradient for each of `tensors`, of its shape, summed over the batch where it is shared; None for none."""

    def refuse(self) -> None:
        """Raise, where a second derivative was asked."""
        raise DoubleBackwardError(f"{self.name} has first derivatives only; expected create_graph=False")


def solve(solver: Solver, *tensors: Tensor) -> tuple[Tensor, ...]:
    """The outputs of a solver as nodes of the graph."""
    # The style with `setup_context`, which transforms need, costs 20 µs more a call: it reads a signature each time.
    function = _Transformed if transforms_active() else _Eager
    return function.apply(solver, *tensors)  # pyright: ignore[reportReturnType]


def _keep(ctx: Any, solver: Solver, tensors: Sequence[Tensor], outputs: Sequence[Tensor]) -> None:
    ctx.solver, ctx.count = solver, len(tensors)
    ctx.save_for_backward(*tensors, *outputs)
    ctx.mark_non_differentiable(*outputs[solver.differentiable :])


class _Eager(torch.autograd.Function):
    @staticmethod
    def forward(ctx, solver: Solver, *tensors: Tensor):
        outputs = solver.solve(tensors, transformed=False)
        _keep(ctx, solver, tensors, outputs)
        return outputs

    @staticmethod
    def backward(ctx, *grads: Tensor):
        solver, saved, grads = ctx.solver, ctx.saved_tensors, grads[: ctx.solver.differentiable]
        gradients = pull_back(solver, saved[: ctx.count], saved[ctx.count :], grads, ctx.needs_input_grad[1:])
        return None, *gradients


class _Transformed(torch.autograd.Function):
    @staticmethod
    def forward(solver: Solver, *tensors: Tensor):
        return solver.solve(tensors, transformed=True)

    @staticmethod
    def setup_context(ctx, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        _keep(ctx, inputs[0], inputs[1:], output)

    backward = _Eager.backward

    @staticmethod
    def vmap(info, in_dims: tuple, solver: Solver, *tensors: Tensor):
        flat, size = _flatten(info.batch_size, in_dims[1:], tensors, solver.ranks, share=True)
        outputs = _Transformed.apply(solver, *flat)
        outputs = tuple(v.reshape(info.batch_size, size, *v.shape[1:]) for v in outputs)
        return outputs, (0,) * len(outputs)


def pull_back(
    solver: Solver,
    tensors: Sequence[Tensor],
    outputs: Sequence[Tensor],
    grads: Sequence[Tensor],
    needs: Sequence[bool],
) -> Sequence[Tensor | None]:
    """A solver's pullback, for the backward pass of an autograd function, whatever transform it runs in."""
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    if any(functorch.is_legacy_batchedtensor(g) for g in grads):
        if torch.is_grad_enabled():
            solver.refuse()
        return _pull_back_legacy(solver, tensors, outputs, grads)
    if transforms_active():
        # Inside a transform of torch.func every backward pass is recorded; it is refused when it is differentiated.
        return _Pullback.apply(solver, len(tensors), len(outputs), *tensors, *outputs, *grads)  # pyright: ignore
    if torch.is_grad_enabled():
        solver.refuse()
    return solver.pullback(tensors, outputs, grads, needs)


class _Pullback(torch.autograd.Function):
    @staticmethod
    def forward(solver: Solver, n: int, m: int, *values: Tensor):
        tensors, outputs, grads = values[:n], values[n : n + m], values[n + m :]
        gradients = solver.pullback(tensors, outputs, grads, [True] * n)
        return tuple(torch.zeros_like(v) if g is None else g for g, v in zip(gradients, tensors, strict=True))

    @staticmethod
    def setup_context(ctx, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.solver = inputs[0]

    @staticmethod
    def backward(ctx, *_: Tensor):
        ctx.solver.refuse()

    @staticmethod
    def vmap(info, in_dims: tuple, solver: Solver, n: int, m: int, *values: Tensor):
        gradients = _pull_back_many(info.batch_size, in_dims[3:], solver, n, m, values)
        return gradients, (0,) * n


def _pull_back_many(
    count: int, dims: Sequence[int | None], solver: Solver, n: int, m: int, values: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Pullbacks of `count` problems, side by side in one batch: gradients (count, …) of each of the first n values."""
    each = [v.ndim - (dim is not None) for v, dim in zip(values, dims, strict=True)]
    ranks = (*solver.ranks, *(rank - 1 for rank in each[n:]))
    # Shared inputs are repeated: each of the `count` problems wants the gradient of its own.
    flat, size = _flatten(count, dims, values, ranks, share=False)
    gradients = _Pullback.apply(solver, n, m, *flat)
    found = []
    for gradient, value, dim, rank, own in zip(gradients, values, dims, each, ranks, strict=False):
        gradient = gradient.reshape(count, size, *gradient.shape[1:])
        shape = list(value.shape)
        if dim is not None:
            del shape[dim]
        if rank == own:
            gradient = gradient.sum(1)
        elif shape[0] != size:
            gradient = gradient.sum(1, keepdim=True)
        found.append(gradient)
    return tuple(found)


def _flatten(
    count: int, dims: Sequence[int | None], values: Sequence[Tensor], ranks: Sequence[int], share: bool
) -> tuple[list[Tensor], int]:
    """Fold a dimension of size `count` into that of the batch, and the size that the batch had.

    `dims`: where each value has that dimension. `share`: a value that has neither stays as it is.
    """
    front = [v.unsqueeze(0) if dim is None else v.movedim(dim, 0) for v, dim in zip(values, dims, strict=True)]
    front = [v.unsqueeze(1) if v.ndim - 1 == rank else v for v, rank in zip(front, ranks, strict=True)]
    size = next((v.shape[1] for v in front if v.shape[1] != 1), 1)
    flat = []
    for value, whole, dim, rank in zip(values, front, dims, ranks, strict=True):
        keep = share and dim is None and value.ndim == rank
        own = whole.shape[2:]
        flat.append(value if keep else whole.expand(count, size, *own).reshape(count * size, *own))
    return flat, size


def _pull_back_legacy(
    solver: Solver, tensors: Sequence[Tensor], outputs: Sequence[Tensor], grads: Sequence[Tensor]
) -> list[Tensor]:
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    level = torch._C._vmapmode_increment_nesting() - 1  # pyright: ignore[reportAttributeAccessIssue]
    torch._C._vmapmode_decrement_nesting()  # pyright: ignore[reportAttributeAccessIssue]
    values, dims, count = [*tensors, *outputs, *grads], [], 1
    for i, value in enumerate(values):
        batched = functorch.is_legacy_batchedtensor(value)
        dims.append(0 if batched else None)
        if batched:
            values[i] = torch._remove_batch_dim(value, level, 1, 0)  # pyright: ignore[reportPrivateImportUsage]
            count = values[i].shape[0]
    gradients = _pull_back_many(count, dims, solver, len(tensors), len(outputs), values)
    return [torch._add_batch_dim(g, 0, level) for g in gradients]  # pyright: ignore[reportPrivateImportUsage]
