"""Cache of a result, valid while the tensors that it was made of hold the same numbers.

A robot plans with one model again and again. Results of checks and preparations at one call hold at the next if the
numbers are the same. The numbers themselves are compared, as neither the identity of a tensor nor its version says
enough: `tensor.data.mul_(2)`, a NumPy array that shares the memory and `vector_to_parameters` leave no trace there. It
costs less than 1 µs for a matrix of a robot's size.
"""

import operator
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import FLOATS, is_array

T = TypeVar("T")

MOST_NUMBERS = 4096
"""Largest size of a tensor that is compared: for larger ones this takes as long as to check and prepare them again."""


class Snapshot:
    """Some values and the numbers of the tensors among them, which are on the CPU.

    Tensors made in inference mode cannot be used outside of it, so a snapshot from there matches nothing outside.
    """

    __slots__ = ("_arrays", "_forms", "_inference", "_numbers", "_values", "tensors")

    def __init__(self, values: Sequence[object]):
        self._values = tuple(values)
        self.tensors = tuple([value for value in values if isinstance(value, Tensor)])
        self._arrays = [tensor.detach().numpy() for tensor in self.tensors]  # so that nobody else gets that memory
        self._forms = _forms(self.tensors)
        self._numbers = _numbers(self._arrays)
        self._inference = torch.is_inference_mode_enabled()

    def same(self, values: Sequence[object]) -> bool:
        """Return whether these are the same values, and the tensors hold the same numbers."""
        return (
            self._inference == torch.is_inference_mode_enabled()
            and len(values) == len(self._values)
            and all(map(operator.is_, values, self._values))
            and _forms(self.tensors) == self._forms
            and _numbers(self._arrays) == self._numbers
        )


def _forms(tensors: Sequence[Tensor]) -> list[object]:
    """List each tensor's memory and layout, which `tensor.data = other` and `t_()` change."""
    return [*map(Tensor.data_ptr, tensors), *map(Tensor.stride, tensors), *map(Tensor.size, tensors)]


def _numbers(arrays: Sequence[np.ndarray]) -> list[bytes]:
    return list(map(np.ndarray.tobytes, arrays))


def snapshot(values: Sequence[object]) -> Snapshot | None:
    """Take a snapshot if the numbers of all tensors among them can be compared, and quickly.

    Take it before something is made of them: what another thread changes meanwhile is then noticed at the next call.
    """
    tensors = [value for value in values if isinstance(value, Tensor)]
    quick = all([is_array(v) and v.dtype in FLOATS and v.numel() <= MOST_NUMBERS for v in tensors])
    return Snapshot(values) if quick else None


class Recall(Generic[T]):
    """Memory of the last value that was kept. Copies of a `Recall`, also in files, are empty."""

    def __init__(self) -> None:
        self._kept: tuple[T, Snapshot] | None = None

    def value(self, tensors: Sequence[Tensor]) -> T | None:
        """Return the kept value if it was made of these tensors with these numbers; else None."""
        kept = self._kept  # once: another thread may keep something else
        return kept[0] if kept is not None and kept[1].same(tensors) else None

    def keep(self, value: T, before: Snapshot | None) -> None:
        """Keep a value and the snapshot of its tensors that was taken before it was made of them."""
        self._kept = None if before is None else (value, before)

    def __reduce__(self) -> tuple[type, tuple]:
        return Recall, ()
