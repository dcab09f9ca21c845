"""difflcs itself: its layer, tensors in and tensors out, all checks and certificates included."""

from __future__ import annotations

import numpy as np
import torch

import difflcs
from difflcs import LCSMPCLayer, LCSParams, QuadraticCost
from difflcs.mpc.backends import BatchedBackend, IpoptBackend
from rivals.differentiable import TorchRival
from rivals.problem import Problem

BACKENDS = {"batched": BatchedBackend(threads=1), "ipopt": IpoptBackend(workers=1)}


def version() -> str:
    """Return the version of difflcs."""
    return f"difflcs {difflcs.__version__}"


class Solver(TorchRival):
    """`LCSMPCLayer` on one thread.

    Args:
        problem: what is to be solved.
        backend: "batched" or "ipopt".
    """

    def __init__(self, problem: Problem, backend: str = "batched"):
        super().__init__(problem)
        self.batches = self.differentiates = backend == "batched"
        self.backend = BACKENDS[backend]
        self.parts = [self._layer(i) for i in range(problem.count)]
        self.whole = self._layer(None)

    def _layer(self, i: int | None) -> LCSMPCLayer:
        def tensor(name: str) -> torch.Tensor:
            value = getattr(self.problem, name) if i is None else self.problem.at(i, name)
            return torch.from_numpy(np.ascontiguousarray(value))

        lcs = LCSParams(**{name: tensor(name) for name in ("A", "B", "C", "d", "D", "E", "F", "c")})
        cost = QuadraticCost(**{name: tensor(name) for name in ("Q", "R", "Q_final", "q", "r", "q_final")})
        return LCSMPCLayer(
            lcs, cost, self.problem.horizon, tensor("u_min"), tensor("u_max"), backend=self.backend,
            relaxation=self.problem.relaxation, on_failure="mask",
        )  # fmt: skip

    def plan(self, x0: torch.Tensor, only: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Plan by the layer of this problem, or by that of all."""
        solution = (self.whole if only is None else self.parts[only])(x0)
        return solution.u, solution.converged
