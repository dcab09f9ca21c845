"""difflcs itself: its layer, tensors in and tensors out, all checks and certificates included."""

from __future__ import annotations

import numpy as np
import torch

import difflcs
from difflcs import LCSMPCLayer, LCSParams, QuadraticCost
from difflcs.mpc.backends import BatchedBackend, IpoptBackend
from rivals.problem import Answer, Problem, Rival

BACKENDS = {"batched": BatchedBackend(threads=1), "ipopt": IpoptBackend(workers=1)}


def version() -> str:
    """Of difflcs."""
    return f"difflcs {difflcs.__version__}"


class Solver(Rival):
    """`LCSMPCLayer` on one thread.

    Args:
        problem: what is to be solved.
        backend: "batched" or "ipopt".
    """

    def __init__(self, problem: Problem, backend: str = "batched"):
        super().__init__(problem)
        torch.set_num_threads(1)
        self.batches = self.differentiates = backend == "batched"
        self.backend = BACKENDS[backend]
        self.parts = [self._layer(i) for i in range(problem.count)]
        self.whole = self._layer(None)

    def _layer(self, i: int | None) -> tuple[LCSMPCLayer, torch.Tensor]:
        def tensor(name: str) -> torch.Tensor:
            value = getattr(self.problem, name) if i is None else self.problem.at(i, name)
            return torch.from_numpy(np.ascontiguousarray(value))

        lcs = LCSParams(**{name: tensor(name) for name in ("A", "B", "C", "d", "D", "E", "F", "c")})
        cost = QuadraticCost(**{name: tensor(name) for name in ("Q", "R", "Q_final", "q", "r", "q_final")})
        layer = LCSMPCLayer(
            lcs, cost, self.problem.horizon, tensor("u_min"), tensor("u_max"), backend=self.backend,
            relaxation=self.problem.relaxation, on_failure="mask",
        )  # fmt: skip
        x0 = torch.from_numpy(self.problem.x0 if i is None else self.problem.x0[i : i + 1])
        return layer, x0

    def one(self, i: int) -> Answer:
        """One call for one problem."""
        layer, x0 = self.parts[i]
        with torch.no_grad():
            plan = layer(x0)
        return Answer(plan.u.numpy(), plan.converged.numpy())

    def all(self) -> Answer:
        """One call for all."""
        layer, x0 = self.whole
        with torch.no_grad():
            plan = layer(x0)
        return Answer(plan.u.numpy(), plan.converged.numpy())

    def gradient(self) -> Answer:
        """One call for all, and back."""
        layer, x0 = self.whole
        x0 = x0.clone().requires_grad_()
        plan = layer(x0)
        (plan.u[:, 0] @ torch.from_numpy(self.problem.weight)).sum().backward()
        assert x0.grad is not None
        return Answer(plan.u.detach().numpy(), plan.converged.numpy(), x0.grad.numpy())
