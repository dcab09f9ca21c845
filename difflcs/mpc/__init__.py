"""Model predictive control through a linear complementarity system (Eq. 3 of the paper)."""

from difflcs.mpc.controller import ControllerPlan, MPCController
from difflcs.mpc.layer import LCSMPCLayer
from difflcs.mpc.problem import MPCProblem
from difflcs.mpc.solution import MPCSolution, Primal

__all__ = ["ControllerPlan", "LCSMPCLayer", "MPCController", "MPCProblem", "MPCSolution", "Primal"]
