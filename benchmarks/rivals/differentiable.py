"""What the rivals in PyTorch share: one call for a batch, with or without gradients."""

from __future__ import annotations

import torch

from rivals.problem import Answer, Problem, Rival


class TorchRival(Rival):
    """A rival whose `plan` takes initial states (m, n_x) and gives actions (m, horizon, n_u), by autograd."""

    batches = differentiates = True

    def __init__(self, problem: Problem):
        super().__init__(problem)
        torch.set_num_threads(1)
        self.x0 = torch.from_numpy(problem.x0)

    def plan(self, x0: torch.Tensor, only: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions and which of them are said to be solved; `only` says of which problem x0 is, None: of all."""
        raise NotImplementedError

    @torch.no_grad()
    def one(self, i: int) -> Answer:
        """One call for one problem."""
        return Answer(*(value.numpy() for value in self.plan(self.x0[i : i + 1], i)))

    @torch.no_grad()
    def all(self) -> Answer:
        """One call for all."""
        return Answer(*(value.numpy() for value in self.plan(self.x0)))

    def gradient(self) -> Answer:
        """One call for all, and back."""
        x0 = self.x0.clone().requires_grad_()
        u, solved = self.plan(x0)
        (u[:, 0] @ torch.from_numpy(self.problem.weight)).sum().backward()
        assert x0.grad is not None
        return Answer(u.detach().numpy(), solved.numpy(), x0.grad.numpy())
