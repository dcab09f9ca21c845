"""All exceptions and warnings of difflcs.

Every message says what was expected, what came, and how to mend it.
"""

import sys
import warnings
from collections.abc import Sequence
from typing import ClassVar


class DiffLCSError(Exception):
    """Base class of every error difflcs raises on purpose.

    Attributes:
        see: where to read more, named at the end of the message: a Python expression or a command of any installation.
    """

    see: ClassVar[str | None] = None

    def __str__(self) -> str:
        message = super().__str__()
        return f"{message} (see {self.see})" if self.see else message


class InvalidInputError(DiffLCSError, ValueError):
    """An argument cannot be used."""


class ShapeError(InvalidInputError):
    """A tensor has the wrong shape."""


class BatchIndexError(ShapeError, IndexError):
    """A record of matrices was indexed where it has no batch dimension, no such element, or no such stage."""


class DTypeError(InvalidInputError, TypeError):
    """A value has the wrong type or dtype."""


class DeviceError(InvalidInputError):
    """Tensors live on different or unusable devices."""


class NonFiniteError(InvalidInputError):
    """A tensor holds NaN or infinity."""


class BoundsError(InvalidInputError):
    """A lower bound exceeds its upper bound."""


class NotPositiveDefiniteError(InvalidInputError):
    """F + Fᵀ is not positive definite, so that the LCP may have no or many solutions."""

    see = "help(difflcs.solve_lcp)"


class GammaError(InvalidInputError):
    """The violation loss's γ is outside 0 < γ ≤ σ_min(F + Fᵀ)."""

    see = "help(difflcs.violation_loss)"


class MissingDependencyError(DiffLCSError, ImportError):
    """An optional package is not installed."""

    see = "difflcs doctor"


class BackendNotFoundError(DiffLCSError, LookupError):
    """No such MPC backend, or the package behind it is not installed."""

    see = "difflcs doctor"


class CheckpointError(DiffLCSError):
    """A checkpoint is missing, corrupt, or was written by something else."""


class InUseError(CheckpointError):
    """Another process works in a run directory."""


class DoubleBackwardError(DiffLCSError, RuntimeError):
    """Second derivatives were asked of a function that has first derivatives only."""


class SolveError(DiffLCSError, RuntimeError):
    """Some problems of a batch were not solved.

    Attributes:
        elements: flat batch indices of the failures.
        status: the `Status` value of each of them.
    """

    see = "help(difflcs.LCSMPCLayer)"

    def __init__(self, message: str, elements: Sequence[int], status: Sequence[int]):
        super().__init__(message)
        self.elements = tuple(elements)
        self.status = tuple(status)


class DiffLCSWarning(UserWarning):
    """Base class of every warning of difflcs."""


class SolveWarning(DiffLCSWarning):
    """Some problems of a batch were not solved; their gradient is zero."""


class DegenerateWarning(DiffLCSWarning):
    """Some solutions are not classically differentiable; a regularised gradient is used."""


class FrictionWarning(DiffLCSWarning):
    """The friction of a system is far from Coulomb's law."""


class ContactWarning(DiffLCSWarning):
    """More contacts are near than there is room for."""


def warn(message: str, category: type[DiffLCSWarning]) -> None:
    """Warn at the line that called this library, outside of it and of torch."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back and frame.f_globals.get("__name__", "").split(".")[0] in ("difflcs", "torch"):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
