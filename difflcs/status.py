"""Status codes of the solvers."""

from enum import IntEnum

from torch import Tensor

from difflcs._differentiation import is_wrapped
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]

_CODES = _kernels.status_codes()


class Status(IntEnum):
    """Outcome of the solve of one batch element; `advice` says what to do about it."""

    CONVERGED = _CODES["CONVERGED"]
    MAX_ITER = _CODES["MAX_ITER"]
    INFEASIBLE = _CODES["INFEASIBLE"]
    NUMERICAL = _CODES["NUMERICAL"]
    DEGENERATE = _CODES["DEGENERATE"]

    @property
    def solved(self) -> bool:
        """True when the primal solution can be used."""
        return self in (Status.CONVERGED, Status.DEGENERATE)

    @property
    def advice(self) -> str:
        """Advice to the user, one sentence."""
        return _ADVICE[self]


def solved(status: Tensor) -> Tensor:
    """Return `Status.solved` of each of a tensor of codes, as bool."""
    return (status == _CONVERGED) | (status == _DEGENERATE)


def all_converged(status: Tensor) -> bool:
    """Return True if all codes, on the CPU, are CONVERGED: a quick test, before looking for those that are not."""
    if is_wrapped(status):
        return bool((status == _CONVERGED).all())
    codes = status.numpy().tobytes()  # a tenth of the time of a reduction, where there are few
    return codes.count(_CONVERGED) == len(codes)


# Plain integers: torch takes 5 µs longer to compare with a member of an enumeration.
_CONVERGED, _DEGENERATE = int(Status.CONVERGED), int(Status.DEGENERATE)

_ADVICE = {
    Status.CONVERGED: "the solution meets the tolerance",
    Status.MAX_ITER: "iterations or time ran out: raise max_iter or time_limit, pass a guess, or scale the inputs",
    Status.INFEASIBLE: "no plan that meets the constraints was found: see `violation`, and give some a weight",
    Status.NUMERICAL: "the numbers broke down: check the scale of the inputs and the conditioning of F",
    Status.DEGENERATE: "solved, but not classically differentiable there: its gradient is one of several valid ones",
}
