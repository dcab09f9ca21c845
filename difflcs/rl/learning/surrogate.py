"""The loss of PPO: the clipped objective over the samples that are no outliers, and the violation loss beside it.

It differs from the usual loss in two points, which decide whether it learns:

- Samples whose KL divergence exceeds a limit are left out as outliers: there the MPC has jumped to another local
  optimum, and the derivative at the new one says nothing about the old one.
- The KL divergence that is watched is a mean without its largest values (`trimmed_mean`): single jumps reach 17.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor

from difflcs.losses import violation_loss
from difflcs.rl.rollout import contexts, transitions
from difflcs.rl.settings import ViolationLoss

if TYPE_CHECKING:
    from tensordict import TensorDict, TensorDictBase

    from difflcs.records import LCSModule
    from difflcs.rl.learning.policy import GaussianPolicy

OUTLIER_KL = 2.0
"""Samples with a KL divergence above this are left out: the MPC has jumped to another optimum."""
_VIOLATION_BATCH = 300
"""Transitions of the newest episodes per step in the violation loss."""


class Surrogate:
    """The loss: the clipped objective over the samples that are no outliers, and the violation loss beside it.

    Args:
        actor: the policy.
        clip: epsilon of the clipped objective.
        outlier_kl: samples with a KL divergence above this are left out.
        beta: weight of the clipped objective against the violation loss (Eq. 7 of the paper).
        violation: settings of the violation loss; None where there is no LCS.
    """

    def __init__(
        self, actor: GaussianPolicy, clip: float, outlier_kl: float, beta: float, violation: ViolationLoss | None
    ):
        self.clip = clip
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
        """Compute the loss of a batch.

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
        mean = torch.where(outlier, old["loc"], new["loc"])
        log_ratio = log_prob(samples["action"], mean, new["scale_tril"]) - samples["action_log_prob"]
        advantage = torch.where(outlier, 0.0, samples["advantage"].squeeze(-1))
        clipped = log_ratio.clamp(math.log1p(-self.clip), math.log1p(self.clip))
        self.clip_fraction = float((clipped != log_ratio).double().mean())
        # The MPC is solved by PPO, once per step: here its result becomes the objective.
        loss = -self.beta * torch.minimum(log_ratio.exp() * advantage, clipped.exp() * advantage).mean()
        if self.beta < 1 and self.violation is not None:
            x, u, x_next = transitions(seen)
            context = contexts(seen)
            chosen = torch.from_numpy(rng.permutation(len(x))[:_VIOLATION_BATCH])
            lcs = cast("LCSModule", self.lcs)
            part = (x[chosen], u[chosen], x_next[chosen], self.violation.gamma, self.violation.xi)
            chosen_context = None if context is None else context[chosen]
            loss = loss + (1 - self.beta) * violation_loss(lcs, *part, context=chosen_context)
        return loss


def log_prob(actions: Tensor, mean: Tensor, factor: Tensor) -> Tensor:
    """(B, M) log densities of actions (B, M, n) under Gaussians of mean (B, n) and Cholesky factor (B, n, n)."""
    offsets = (actions - mean.unsqueeze(-2)) @ _inverse(factor).mT
    constant = 0.5 * mean.shape[-1] * math.log(2 * math.pi)
    return -0.5 * offsets.square().sum(-1) - (_log_det(factor) + constant).unsqueeze(-1)


@torch.no_grad()
def gaussian_kl(old: TensorDictBase, new: TensorDictBase) -> Tensor:
    """(N,) KL(old ‖ new) of the Gaussians: far less noisy than the mean of sampled log-ratios."""
    inverse, n = _inverse(new["scale_tril"]), old["loc"].shape[-1]
    offsets = (inverse @ (old["loc"] - new["loc"]).unsqueeze(-1)).flatten(-2)
    spread = (inverse @ old["scale_tril"]).square().flatten(-2).sum(-1)
    ratio = _log_det(new["scale_tril"]) - _log_det(old["scale_tril"])
    return ratio + 0.5 * (spread + offsets.square().sum(-1) - n)


def _inverse(factor: Tensor) -> Tensor:
    """Inverses (B, n, n) of lower triangles; one of (n, n) where all are the same by their memory."""
    one = factor[0] if factor.stride(0) == 0 else factor
    return torch.linalg.solve_triangular(one, torch.eye(factor.shape[-1], dtype=factor.dtype), upper=False)


def _log_det(factor: Tensor) -> Tensor:
    return factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def trimmed_mean(values: Tensor, fraction: float = 0.97) -> float:
    """Mean of the lowest `fraction` of the values, at least of one; by default that of KL divergences."""
    return float(values.sort().values[: max(1, int(fraction * len(values)))].mean())
