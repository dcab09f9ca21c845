"""Which of several systems is it? A filter that answers from the motion seen, while the robot works.

Each hypothesis is a context of one `LCSModule`: a scale of the outline, a friction, a drive, or all of them. After each
step all hypotheses predict the step in one batch, and each is credited with the log-likelihood of what was seen: the
Bayes filter of a quantity that is constant, or forgotten slowly. It needs no gradient and no excitation: where all
predict the same, as on a way without contact, nothing is learned and nothing is lost.
"""

from __future__ import annotations

import torch
from torch import Tensor

from difflcs.errors import InvalidInputError
from difflcs.records import LCSModule, LCSParams

__all__ = ["ContextFilter"]


class ContextFilter:
    """Probabilities of hypotheses about a system, from the transitions seen: `filter.update(x, u, x_next)`.

    The error of a prediction is normal with a standard deviation of `spread` plus `relative` times how far the state
    has moved; no step counts for more than `most` nats, as a model is sometimes wrong altogether.

    Args:
        lcs: its `params(x, context)` returns the systems of a batch of states (n, n_x) and contexts (n, n_context).
        contexts: (n, n_context) hypotheses, all equally likely at first.
        spread: (n_x,) of the state's components, or one number for all [units of the state], > 0; ∞ for what is not to
            be compared.
        relative: part of the motion by which predictions are off, ≥ 0.
        most: largest log-likelihood ratio of a step, > 0.
        forgetting: factor of all log-likelihoods at each step, in (0, 1]: 1 for what is constant.

    Attributes:
        log_likelihood: (n,) of each hypothesis; the best has 0.

    Raises:
        InvalidInputError: an argument does not fit.
    """

    def __init__(
        self,
        lcs: LCSModule,
        contexts: Tensor,
        spread: float | Tensor,
        *,
        relative: float = 0.0,
        most: float = 8.0,
        forgetting: float = 1.0,
    ):
        self.lcs, self.contexts = lcs, contexts
        self.spread = torch.as_tensor(spread, dtype=torch.float64)
        if not bool((self.spread > 0).all()):
            raise InvalidInputError(
                f"spread: expected numbers above 0, got {self.spread.tolist()}; give an error's size"
            )
        if relative < 0 or most <= 0 or not 0 < forgetting <= 1:
            raise InvalidInputError(
                f"expected relative >= 0, most > 0 and forgetting in (0, 1], got {relative:g}, {most:g} and "
                f"{forgetting:g}; see the docstring"
            )
        self.relative, self.most, self.forgetting = relative, most, forgetting
        self.reset()

    def reset(self) -> None:
        """Forget all that was seen."""
        self.log_likelihood = torch.zeros(len(self.contexts), dtype=torch.float64)

    @torch.no_grad()
    def update(self, x: Tensor, u: Tensor, x_next: Tensor) -> None:
        """Learn from one transition.

        Args:
            x: (n_x,) the state before.
            u: (n_u,) the action; or (T, n_u), the actions of T parts of the step, each with the system where it begins.
            x_next: (n_x,) the state after.
        """
        state = x.expand(len(self.contexts), -1)
        for part in torch.atleast_2d(u):
            systems = self.lcs.params(state, self.contexts)
            assert isinstance(systems, LCSParams)
            state = systems.step(state, part.expand(len(state), -1)).x_next
        spread = self.spread + self.relative * (x_next - x).abs()
        loss = 0.5 * ((state - x_next) / spread).square().sum(-1)
        loss = (loss - loss.min()).clamp_max(self.most)
        self.log_likelihood = self.forgetting * self.log_likelihood - loss
        self.log_likelihood -= self.log_likelihood.max()

    @property
    def probabilities(self) -> Tensor:
        """(n,) of the hypotheses."""
        return self.log_likelihood.softmax(0)

    @property
    def mean(self) -> Tensor:
        """(n_context,) expected context."""
        return self.probabilities @ self.contexts
