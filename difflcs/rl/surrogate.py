"""The loss of PPO: the clipped objective over the samples that are no outliers, and the violation loss beside it.

Two things are our own, because they decide whether it learns:

- Samples whose own KL divergence exceeds a limit are left out as outliers: there the MPC has jumped to another local
  optimum, and the derivative at the new one says nothing about the old one.
- The KL divergence that is watched is a mean without its largest values (`trimmed_mean`): single jumps reach 17.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor

from difflcs.losses import violation_loss
from difflcs.rl.rollout import contexts, transitions
from difflcs.rl.settings import ViolationLoss

if TYPE_CHECKING:
    from tensordict import TensorDict, TensorDictBase

    from difflcs.lcs import LCSModule
    from difflcs.rl.policy import GaussianPolicy

_VIOLATION_BATCH = 300
"""Transitions of the newest episodes per step in the violation loss."""


class Surrogate:
    """The loss: TorchRL's clipped objective over the samples that are no outliers, and the violation loss beside it.

    Args:
        actor: the policy.
        clip: epsilon of the clipped objective.
        outlier_kl: samples with a KL divergence above this have no say.
        beta: weight of the clipped objective against the violation loss (Eq. total_loss).
        violation: settings of the violation loss; None where there is no LCS.
    """

    def __init__(
        self, actor: GaussianPolicy, clip: float, outlier_kl: float, beta: float, violation: ViolationLoss | None
    ):
        from tensordict.nn import ProbabilisticTensorDictSequential
        from torchrl.objectives import ClipPPOLoss

        # The MPC is solved by PPO, once per step; the loss gets its result, and only builds the distribution.
        parts: Any = actor.module
        head = ProbabilisticTensorDictSequential(parts[-1])
        self.clipped = ClipPPOLoss(head, None, clip_epsilon=clip, entropy_bonus=False, critic_coeff=None)
        self.lcs, self.outlier_kl, self.beta, self.violation = actor.learned, outlier_kl, beta, violation
        self.clip_fraction = self.outliers = 0.0
        """Shares of the samples of the last call."""

    def __call__(
        self,
        new: TensorDict,
        old: TensorDict,
        kl: Tensor,
        samples: TensorDict,
        seen: TensorDict,
        rng: np.random.Generator,
    ) -> Tensor:
        """The loss of a batch.

        Args:
            new: (B,) the policy now.
            old: (B,) the policy that acted.
            kl: (B,) its KL divergence from the policy now.
            samples: (B, M) actions and their advantages.
            seen: the episodes, for the violation loss.
            rng: draws its transitions.
        """
        outlier = (kl > self.outlier_kl).unsqueeze(-1)
        self.outliers = float(outlier.double().mean())
        many = samples.batch_size
        samples["loc"] = torch.where(outlier, old["loc"], new["loc"]).unsqueeze(1).expand(*many, -1)
        samples["scale_tril"] = new["scale_tril"].unsqueeze(1).expand(*many, -1, -1)
        samples["advantage"] = torch.where(outlier.unsqueeze(1), 0.0, samples["advantage"])
        result = self.clipped(samples)
        self.clip_fraction = float(result["clip_fraction"])
        loss = self.beta * result["loss_objective"]
        if self.beta < 1 and self.violation is not None:
            x, u, x_next = transitions(seen)
            context = contexts(seen)
            chosen = torch.from_numpy(rng.permutation(len(x))[:_VIOLATION_BATCH])
            lcs = cast("LCSModule", self.lcs)
            part = (x[chosen], u[chosen], x_next[chosen], self.violation.gamma, self.violation.xi)
            given = None if context is None else context[chosen]
            loss = loss + (1 - self.beta) * violation_loss(lcs, *part, context=given)
        return loss


def gaussian_kl(old: TensorDictBase, new: TensorDictBase) -> Tensor:
    """(N,) KL(old ‖ new) of the Gaussians: far less noisy than the mean of sampled log-ratios."""
    with torch.no_grad():
        before, after = (
            torch.distributions.MultivariateNormal(v["loc"], scale_tril=v["scale_tril"], validate_args=False)
            for v in (old, new)
        )
        return torch.distributions.kl_divergence(before, after)


def trimmed_mean(values: Tensor, fraction: float) -> float:
    """Mean of the lowest `fraction` of the values, at least of one."""
    return float(values.sort().values[: max(1, int(fraction * len(values)))].mean())
