"""What was made of some tensors, for as long as these hold the same numbers.

A robot plans through one model again and again. What was checked and prepared at the first call holds at the next one
if the numbers are the same. The numbers themselves are compared, as neither the identity of a tensor nor its version
says enough: `tensor.data.mul_(2)`, a NumPy array that shares the memory and `vector_to_parameters` leave no trace
there. It costs less than 1 µs for a matrix of a robot's size.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")

MOST_NUMBERS = 4096
"""Of a tensor that is kept: it would take as long to compare larger ones as to check and prepare them again."""


class Numbers:
    """The numbers of one tensor on the CPU, in memory of their own."""

    __slots__ = ("_address", "_array", "_bytes", "_copy", "_shape", "_stride", "_tensor")

    def __init__(self, tensor: Tensor):
        self._copy = tensor.detach().clone()
        self._tensor, self._array = tensor, tensor.detach().numpy()
        self._address, self._shape, self._stride = tensor.data_ptr(), tensor.shape, tensor.stride()
        self._bytes = self._array.tobytes()

    def same(self, tensor: Tensor) -> bool:
        """Whether a tensor has this shape and dtype and these numbers; NaN need not be the same as NaN."""
        if (
            tensor is self._tensor
            and tensor.data_ptr() == self._address  # `_array` keeps that memory from being used otherwise
            and tensor.stride() == self._stride
            and tensor.shape == self._shape
        ):
            return self._array.tobytes() == self._bytes  # a third of the time of the next line
        return tensor.dtype == self._copy.dtype and tensor.is_cpu and torch.equal(tensor, self._copy)


class Kept(NamedTuple, Generic[T]):
    """A value with the numbers that it was made of.

    Attributes:
        value: what was made.
        numbers: name → numbers of a tensor that it was made of.
        inference: whether that was in inference mode.
    """

    value: T
    numbers: Mapping[str, Numbers]
    inference: bool

    def same(self, tensors: Mapping[str, Tensor]) -> dict[str, Numbers]:
        """Name → numbers of those tensors that hold the same as then."""
        numbers = self.numbers
        return {name: numbers[name] for name, t in tensors.items() if name in numbers and numbers[name].same(t)}

    def holds(self, tensors: Mapping[str, Tensor]) -> bool:
        """Whether all of these tensors hold the same numbers as then."""
        return len(self.same(tensors)) == len(tensors)


_NONE: Mapping[str, Numbers] = MappingProxyType({})


class Recall(Generic[T]):
    """The last value that was kept. Copies of a `Recall`, and files, are empty."""

    def __init__(self) -> None:
        self._kept: Kept[T] | None = None

    @property
    def kept(self) -> Kept[T] | None:
        """What was kept, if it can be used now: what was made in inference mode is of no use outside of it."""
        kept = self._kept
        return None if kept is None or kept.inference != torch.is_inference_mode_enabled() else kept

    def keep(self, value: T, tensors: Mapping[str, Tensor], known: Mapping[str, Numbers] = _NONE) -> None:
        """Keep a value.

        Args:
            value: what was made.
            tensors: what it was made of, each `worth_keeping`.
            known: numbers of further tensors that it was made of, from an earlier value.
        """
        own = {name: Numbers(tensor) for name, tensor in tensors.items()}
        self._kept = Kept(value, {**known, **own}, torch.is_inference_mode_enabled())

    def __reduce__(self) -> tuple[type, tuple]:
        return Recall, ()


def worth_keeping(tensor: Tensor) -> bool:
    """Whether its numbers can be compared, and quickly."""
    return tensor.is_cpu and tensor.numel() <= MOST_NUMBERS
