"""difflcs itself: its layer, tensors in and tensors out, all checks and certificates included."""

import numpy as np
import torch

import difflcs
from difflcs import LCSMPCLayer, LCSParams, QuadraticCost
from difflcs.mpc.backends import BatchedBackend, IpoptBackend
from difflcs.mpc.backends.batched import Effort
from difflcs.mpc.controller import MPCController
from rivals.differentiable import TorchRival
from rivals.problem import Answer, Problem


class Solver(TorchRival):
    """`LCSMPCLayer` on one thread; in a closed loop its controller, warm.

    Args:
        problem: what is to be solved.
        backend: "batched", "ipopt", or "controller", which plans from a state of its own system, NumPy in and out.
        relaxation: instead of the problem's.
        effort: of `batched`.
    """

    origin = f"difflcs {difflcs.__version__}"

    def __init__(
        self, problem: Problem, backend: str = "batched", relaxation: float | None = None, effort: Effort = "default"
    ):
        super().__init__(problem)
        self.batches = self.differentiates = backend == "batched"
        self.alone = backend == "controller"
        self.backend = IpoptBackend(workers=1) if backend == "ipopt" else BatchedBackend(effort=effort, threads=1)
        self.relaxation = relaxation or problem.relaxation
        self.parts = [self._layer(i) for i in range(problem.count)]
        self.whole = self._layer(None)
        self.controllers: dict[int, MPCController] = {}

    def one(self, i: int) -> Answer:
        """Solve one problem in one call."""
        if not self.alone:
            return super().one(i)
        if not self.controllers:
            self.controllers[0] = self.whole.controller()
        controller = self.controllers[0]
        controller.reset()
        controller.step(self.problem.x0[i])
        plan = controller.plan
        assert plan is not None
        return Answer(plan.u[None], np.array([plan.status.solved]))

    def step(self, i: int, x: np.ndarray) -> np.ndarray:
        """Return the action of a warm controller."""
        if i not in self.controllers:
            self.controllers[i] = self.parts[i].controller()
        return self.controllers[i].step(x)

    def _layer(self, i: int | None) -> LCSMPCLayer:
        def tensor(name: str) -> torch.Tensor:
            value = getattr(self.problem, name) if i is None else self.problem.at(i, name)
            return torch.from_numpy(np.ascontiguousarray(value))

        lcs = LCSParams(**{name: tensor(name) for name in ("A", "B", "C", "d", "D", "E", "F", "c")})
        cost = QuadraticCost(**{name: tensor(name) for name in ("Q", "R", "Q_final", "q", "r", "q_final")})
        return LCSMPCLayer(
            lcs, cost, self.problem.horizon, tensor("u_min"), tensor("u_max"), backend=self.backend,
            relaxation=self.relaxation, on_failure="mask",
        )  # fmt: skip

    def plan(self, x0: torch.Tensor, only: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Plan by the layer of this problem, or by that of all."""
        solution = (self.whole if only is None else self.parts[only])(x0)
        return solution.u, solution.converged
