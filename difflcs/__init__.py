"""Differentiable model predictive control through learned linear complementarity systems."""

from difflcs.errors import BackendNotFoundError, DiffLCSError, SolveError
from difflcs.lcp import LCPSolution, solve_lcp
from difflcs.lcs import LCSModel, LCSParams
from difflcs.losses import prediction_loss, violation_loss
from difflcs.status import Status

__version__ = "0.1.0"

__all__ = [
    "BackendNotFoundError",
    "DiffLCSError",
    "LCPSolution",
    "LCSModel",
    "LCSParams",
    "SolveError",
    "Status",
    "prediction_loss",
    "solve_lcp",
    "violation_loss",
]
