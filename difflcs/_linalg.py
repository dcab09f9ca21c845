"""Products of a matrix that is shared by the batch (rows, columns), or one per element (batch, rows, columns)."""

from __future__ import annotations

from torch import Tensor


def matvec(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrix · vector for vectors (..., columns)."""
    # A shared matrix is one GEMM for the whole batch; a matrix per element is a batched product.
    return vector @ matrix.mT if matrix.ndim == 2 else (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def quadratic(matrix: Tensor, vector: Tensor) -> Tensor:
    """vectorᵀ · matrix · vector, (...)."""
    return (vector * matvec(matrix, vector)).sum(-1)
