"""The natural gradient: steps of a set length in the behaviour of the policy, not in its parameters.

Amari, "Natural gradient works efficiently in learning", 1998; Kakade, "A natural policy gradient", 2001.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from difflcs.rl.learning.state_tree import State
from difflcs.rl.settings import Settings, bounded

_MEMORY = 0.7
"""Weight of the metric so far against that of a new measurement."""
DAMPING = 0.1
"""Isotropic part of the metric of a policy, in means of its diagonal."""
MOMENTUM = 0.8
"""Weight of the gradient of a policy so far against the newest one; kept across iterations."""
_LONGEST = 3.0
"""Longest Jacobian of one sample, in medians of those of its batch: samples near a jump of the MPC have huge ones."""


@dataclass(frozen=True)
class Natural(Settings):
    """Settings of the natural gradient."""

    step: float = bounded(0.06, above=0)
    """Length of a step at the start: the root of twice the KL divergence that it makes."""


class NaturalGradient(torch.optim.Optimizer):
    """Steps along (F + damping·mean(diag F)·I)⁻¹ g, of length `lr` in the metric F: √(dᵀ F d) = lr.

    g is a moving average of the gradients, and F = E[Jᵀ Σ⁻¹ J] is the Fisher matrix of a Gaussian policy whose mean has
    the Jacobian J. A step d changes the policy by a KL divergence of ½ dᵀ F d: its length is √(2 KL).

    Args:
        parameters: the learned parameters, of one dtype.
        lr: length of a step.
        momentum: weight of the gradients so far against the newest one.
        damping: isotropic part of the metric, in means of its diagonal: directions that hardly change the policy, along
            which the gradient is mostly noise, are taken less far.
    """

    metric: Tensor
    """F (P, P); zero before the first `measure`."""
    average: Tensor
    """g (P,)."""

    def __init__(self, parameters: Sequence[nn.Parameter], lr: float, momentum: float, damping: float):
        super().__init__(parameters, {"lr": lr})
        self.momentum, self.damping = momentum, damping
        flat = nn.utils.parameters_to_vector(self._parameters).detach()
        self.average, self.metric = torch.zeros_like(flat), flat.new_zeros(len(flat), len(flat))
        self._factor: Tensor | None = None

    @property
    def _parameters(self) -> list[nn.Parameter]:
        return [p for group in self.param_groups for p in group["params"]]

    def measure(self, jacobian: Tensor) -> None:
        """Update the metric: the mean of its last value and that of new samples.

        Args:
            jacobian: (N, n_u, P) L⁻¹ J of samples, Σ = L Lᵀ, with the parameters in their order; not finite ones count
                as zero.
        """
        jacobian = jacobian.nan_to_num(0.0, 0.0, 0.0)
        length = jacobian.flatten(1).norm(dim=1)
        longest = _LONGEST * length[length > 0].nanmedian()
        rows = (jacobian * torch.where(length > longest, longest / length, 1.0)[:, None, None]).flatten(0, 1)
        new = rows.mT @ rows / max(len(jacobian), 1)
        if bool(new.any()):  # else nothing moves the actions, and what is known of the metric remains
            self.metric.copy_(torch.lerp(self.metric, new, 1 - _MEMORY) if bool(self.metric.any()) else new)
        scale = self.metric.diagonal().mean()
        identity = torch.eye(len(self.metric), dtype=self.metric.dtype)
        self._factor = torch.linalg.cholesky(self.metric + self.damping * scale * identity) if scale > 0 else None

    @torch.no_grad()
    def step(self, closure: None = None) -> None:
        """Take one step in the metric last measured; none where it or the newest gradient is zero."""
        parameters = self._parameters
        gradient = torch.cat([(torch.zeros_like(p) if p.grad is None else p.grad).flatten() for p in parameters])
        self.average.lerp_(gradient, 1 - self.momentum)
        if self._factor is None or not bool(gradient.any()):
            return
        direction = torch.cholesky_solve(self.average.unsqueeze(-1), self._factor).squeeze(-1)
        length = (direction @ self.metric @ direction).sqrt()
        if not length > 0:
            return
        move = (self.param_groups[0]["lr"] / length * direction).split([p.numel() for p in parameters])
        for p, part in zip(parameters, move, strict=True):
            p -= part.view_as(p)

    def state_dict(self) -> dict[str, Any]:
        """State of the optimiser; a loaded one takes effect at the next `measure`."""
        return {"average": self.average, "metric": self.metric}

    def load_state_dict(self, state_dict: State) -> None:
        """Go on from what `state_dict` gave."""
        self.average.copy_(state_dict["average"])
        self.metric.copy_(state_dict["metric"])
