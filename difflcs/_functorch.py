"""What the library's autograd functions need to work under `torch.func`, vectorised jacobians and `torch.compile`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")


def is_wrapped(tensor: Tensor) -> bool:
    """Whether a transform of `torch.func`, or a vectorised backward pass, stands between us and the numbers.

    There is no public question for it. A batched tensor refuses `.numpy()` and `bool()`; one that tracks gradients for
    `torch.func.grad` does not, but what is read from it is lost to the transform.
    """
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return functorch.is_functorch_wrapped_tensor(tensor) or functorch.is_legacy_batchedtensor(tensor)


def runs_eagerly(function: Callable[P, R]) -> Callable[P, R]:
    """A function that `torch.compile` leaves to Python: a break of the graph, and the result of eager code.

    `torch.compiler.disable` at import would import the compiler, which takes seconds.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(function)(*args, **kwargs)  # pyright: ignore[reportCallIssue]
        return function(*args, **kwargs)

    return wrapper
