"""Differentiable model predictive control through learned linear complementarity systems."""

import logging

from difflcs.animation import Animation
from difflcs.constraints import ConstraintSequence, LinearConstraints, StageBounds
from difflcs.cost import CostModule, CostSequence, GoalCost, QuadraticCost
from difflcs.errors import BackendNotFoundError, DiffLCSError, SolveError
from difflcs.fit import FitReport, Transitions, fit_report
from difflcs.lcp import LCPSolution, solve_lcp
from difflcs.lcs import LCSModel
from difflcs.losses import prediction_loss, violation_loss
from difflcs.mpc.backends import available_backends, register_backend
from difflcs.mpc.layer import LCSMPCLayer
from difflcs.mpc.solution import MPCSolution
from difflcs.records import LCSModule, LCSParams, LCSSequence, sequence_along
from difflcs.scales import ScaledLCS, Scales, suggest_scales
from difflcs.status import Status

logging.getLogger(__name__).addHandler(logging.NullHandler())  # silent unless a program asks for it

__version__ = "0.3.0"

__all__ = [
    "Animation",
    "BackendNotFoundError",
    "ConstraintSequence",
    "CostModule",
    "CostSequence",
    "DiffLCSError",
    "FitReport",
    "GoalCost",
    "LCPSolution",
    "LCSMPCLayer",
    "LCSModel",
    "LCSModule",
    "LCSParams",
    "LCSSequence",
    "LinearConstraints",
    "MPCSolution",
    "QuadraticCost",
    "ScaledLCS",
    "Scales",
    "SolveError",
    "StageBounds",
    "Status",
    "Transitions",
    "available_backends",
    "fit_report",
    "prediction_loss",
    "register_backend",
    "sequence_along",
    "solve_lcp",
    "suggest_scales",
    "violation_loss",
]
