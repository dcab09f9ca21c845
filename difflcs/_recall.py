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

MOST_NUMBERS = 4096
"""Of a tensor that is kept: it would take as long to compare larger ones as to check and prepare them again."""


class Kept(NamedTuple, Generic[T]):
    """A value, copies of the tensors that it was made of, and whether that was in inference mode."""

    value: T
    copies: Mapping[str, Tensor]
    inference: bool


class Recall(Generic[T]):
    """The last value that was kept, and the numbers that it was made of. Copies of a `Recall`, and files, are empty."""

    def __init__(self) -> None:
        self._kept: Kept[T] | None = None

    def find(self, tensors: Mapping[str, Tensor]) -> tuple[Kept[T] | None, set[str]]:
        """What was kept, and the names of the tensors whose numbers are the same as then."""
        kept = self._kept  # another thread may replace it meanwhile
        # Tensors that were made in inference mode are of no use outside of it.
        if kept is None or kept.inference != torch.is_inference_mode_enabled():
            return None, set()
        return kept, {name for name, copy in kept.copies.items() if name in tensors and _same(tensors[name], copy)}

    def keep(self, value: T, tensors: Mapping[str, Tensor], copies: Mapping[str, Tensor] = MappingProxyType({})) -> None:
        """Keep a value.

        Args:
            value: what was made.
            tensors: what it was made of.
            copies: of further tensors that it was made of; those of an earlier value.
        """
        own = {name: tensor.detach().clone() for name, tensor in tensors.items()}
        self._kept = Kept(value, {**copies, **own}, torch.is_inference_mode_enabled())

    def __reduce__(self) -> tuple[type, tuple]:
        return Recall, ()


def worth_keeping(tensor: Tensor) -> bool:
    """Whether its numbers can be compared, and quickly."""
    return tensor.is_cpu and tensor.numel() <= MOST_NUMBERS


def _same(tensor: Tensor, copy: Tensor) -> bool:
    return tensor.dtype == copy.dtype and tensor.is_cpu and torch.equal(tensor, copy)
