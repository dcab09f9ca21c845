"""What was made of some tensors, for as long as these hold the same numbers.

A robot plans through one model again and again. What was checked and prepared at the first call holds at the next one
if the numbers are the same. The numbers themselves are compared, as neither the identity of a tensor nor its version
says enough: `tensor.data.mul_(2)`, a NumPy array that shares the memory and `vector_to_parameters` leave no trace
there. It costs 0.6 µs for a matrix of a robot's size.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")
_NONE: Mapping[str, Tensor] = MappingProxyType({})

MOST_NUMBERS = 4096
"""Of a tensor that is kept: it would take as long to compare larger ones as to check and prepare them again."""


class Kept(NamedTuple, Generic[T]):
    """A value with the numbers that it was made of.

    Attributes:
        value: what was made.
        copies: name → copy of a tensor that it was made of.
        inference: whether that was in inference mode.
    """

    value: T
    copies: Mapping[str, Tensor]
    inference: bool

    def same(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Name → copy of those tensors that hold the same numbers as then."""
        return {
            name: copy
            for name, copy in self.copies.items()
            if name in tensors
            and (tensor := tensors[name]).dtype == copy.dtype
            and tensor.is_cpu
            and torch.equal(tensor, copy)
        }

    def holds(self, tensors: Mapping[str, Tensor]) -> bool:
        """Whether all of these tensors hold the same numbers as then."""
        return len(self.same(tensors)) == len(tensors)


class Recall(Generic[T]):
    """The last value that was kept. Copies of a `Recall`, and files, are empty."""

    def __init__(self) -> None:
        self._kept: Kept[T] | None = None

    @property
    def kept(self) -> Kept[T] | None:
        """What was kept, if it can be used now: what was made in inference mode is of no use outside of it."""
        kept = self._kept
        return None if kept is None or kept.inference != torch.is_inference_mode_enabled() else kept

    def keep(self, value: T, tensors: Mapping[str, Tensor], copies: Mapping[str, Tensor] = _NONE) -> None:
        """Keep a value.

        Args:
            value: what was made.
            tensors: what it was made of, each `worth_keeping`.
            copies: of further tensors that it was made of, from an earlier value.
        """
        own = {name: tensor.detach().clone() for name, tensor in tensors.items()}
        self._kept = Kept(value, {**copies, **own}, torch.is_inference_mode_enabled())

    def __reduce__(self) -> tuple[type, tuple]:
        return Recall, ()


def worth_keeping(tensor: Tensor) -> bool:
    """Whether its numbers can be compared, and quickly."""
    return tensor.is_cpu and tensor.numel() <= MOST_NUMBERS
