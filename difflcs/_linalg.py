"""Products of a matrix that is shared by the batch (rows, columns), or one per element (batch, rows, columns)."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


def product(left: Tensor, right: Tensor) -> Tensor:
    """Multiply left @ right, float32 in float64; `torch.autocast` leaves it alone, also in a backward pass."""
    return left @ right if left.dtype is torch.float64 else (left.double() @ right.double()).to(left.dtype)


def matvec(matrix: Tensor, vector: Tensor) -> Tensor:
    """Multiply a matrix with vectors (..., columns)."""
    # A shared matrix is one GEMM for the whole batch; a matrix per element is a batched product.
    return product(vector, matrix.mT) if matrix.ndim == 2 else product(matrix, vector.unsqueeze(-1)).squeeze(-1)


def quadratic(matrix: Tensor, vector: Tensor) -> Tensor:
    """Compute vectorᵀ · matrix · vector, (...)."""
    return (vector * matvec(matrix, vector)).sum(-1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: with two, tiny batched solves and products took 10 to 20 times as long on busy cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
