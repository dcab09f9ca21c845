"""Base of the rivals in PyTorch: one call for a batch, with or without gradients."""

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
        """Plan; return actions and which of them are solved. `only`: index of the problem of x0; None: all of them."""
        raise NotImplementedError

    @torch.no_grad()
    def one(self, i: int) -> Answer:
        """Solve one problem in one call."""
        return Answer(*(value.numpy() for value in self.plan(self.x0[i : i + 1], i)))

    @torch.no_grad()
    def all(self) -> Answer:
        """Solve all problems in one call."""
        return Answer(*(value.numpy() for value in self.plan(self.x0)))

    def gradient(self) -> Answer:
        """Solve all problems in one call, and differentiate."""
        x0 = self.x0.clone().requires_grad_()
        u, solved = self.plan(x0)
        (u[:, 0] @ torch.from_numpy(self.problem.weight)).sum().backward()
        assert x0.grad is not None
        return Answer(u.detach().numpy(), solved.numpy(), x0.grad.numpy())
