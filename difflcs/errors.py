"""Everything difflcs raises or warns with.

Every message says what was expected, what came, and how to mend it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar


class DiffLCSError(Exception):
    """Base class of every error difflcs raises on purpose.

    Attributes:
        page: the page of the documentation that helps, named at the end of the message.
    """

    page: ClassVar[str | None] = None

    def __str__(self) -> str:
        message = super().__str__()
        return f"{message} (see {self.page})" if self.page else message


class InvalidInputError(DiffLCSError, ValueError):
    """An argument cannot be used."""


class ShapeError(InvalidInputError):
    """A tensor has the wrong shape."""

    page = "docs/notation.md"


class BatchIndexError(ShapeError, IndexError):
    """A record of matrices was indexed where it has no batch dimension, no such element, or no such stage."""


class DTypeError(InvalidInputError, TypeError):
    """A value has the wrong type or dtype."""

    page = "docs/notation.md"


class DeviceError(InvalidInputError):
    """Tensors live on different or unusable devices."""


class NonFiniteError(InvalidInputError):
    """A tensor holds NaN or infinity."""


class BoundsError(InvalidInputError):
    """A lower bound exceeds its upper bound."""


class NotPositiveDefiniteError(InvalidInputError):
    """F + Fᵀ is not positive definite, so that the LCP may have no or many solutions."""

    page = "docs/theory.md"


class GammaError(InvalidInputError):
    """The violation loss's γ is outside 0 < γ ≤ σ_min(F + Fᵀ)."""

    page = "docs/theory.md"


class MissingDependencyError(DiffLCSError, ImportError):
    """An optional package is not installed."""

    page = "docs/quickstart.md"


class BackendNotFoundError(DiffLCSError, LookupError):
    """No such MPC backend, or the package behind it is not installed."""

    page = "docs/backends.md"


class CheckpointError(DiffLCSError):
    """A checkpoint is missing, corrupt, or was written by something else."""

    page = "docs/training.md"


class InUseError(CheckpointError):
    """Another process works in a run directory."""


class DoubleBackwardError(DiffLCSError, RuntimeError):
    """Second derivatives were asked of a function that has first derivatives only."""

    page = "docs/gradients.md"


class SolveError(DiffLCSError, RuntimeError):
    """Some problems of a batch were not solved.

    Attributes:
        elements: flat batch indices of the failures.
        status: the `Status` value of each of them.
    """

    page = "docs/gradients.md"

    def __init__(self, message: str, elements: Sequence[int], status: Sequence[int]):
        super().__init__(message)
        self.elements = tuple(elements)
        self.status = tuple(status)


class DiffLCSWarning(UserWarning):
    """Base class of every warning difflcs gives."""


class SolveWarning(DiffLCSWarning):
    """Some problems of a batch were not solved; their gradient is zero."""


class DegenerateWarning(DiffLCSWarning):
    """Some solutions are not classically differentiable; a regularised gradient is used."""


class FrictionWarning(DiffLCSWarning):
    """The friction of a system is far from Coulomb's law."""
