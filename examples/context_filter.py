"""Which of several systems is it? A filter that answers from the motion seen, while the robot works.

A hypothesis is a context of a model: a scale of the outline, a friction, a drive, or several of them. After each step
all hypotheses predict the step in one batch, and each is credited with the log-likelihood of what was seen: the Bayes
filter of a quantity that is constant, or forgotten slowly. It needs no gradient and no excitation: where all predict
the same, as on a way without contact, nothing is learned and nothing is lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from difflcs.errors import InvalidInputError

__all__ = ["ContextFilter"]

Array = NDArray[Any]
Predict = Callable[[Array, Array, Array], Array]
"""A state (n_x,), an action and contexts (n, n_context) → the next state by each of them (n, n_x)."""


class ContextFilter:
    """Probabilities of hypotheses about a system, from the transitions seen: `filter.update(x, u, x_next)`.

    The error of a prediction is normal with a standard deviation of `spread` plus `relative` times how far the state
    has moved; no step counts for more than `most` nats, as a model is sometimes wrong altogether.

    Args:
        predict: what each hypothesis says of a step, all in one batch.
        contexts: (n, n_context) hypotheses, all equally likely at first.
        spread: (n_x,) of the state's components, or one number for all [units of the state], > 0; ∞ for what is not to
            be compared.
        relative: part of the motion by which predictions are off, ≥ 0.
        most: largest log-likelihood ratio of a step, > 0.
        forgetting: factor of all log-likelihoods at each step, in (0, 1]: 1 for what is constant.
        hopeless: a hypothesis is no longer asked once the best is so many nats ahead of it, > 0; it loses `most` in
            each step. ∞: all are always asked.
        angles: components of the state that are angles [rad], whose differences are taken the shorter way round.

    Attributes:
        log_likelihood: (n,) of each hypothesis; the best has 0.

    Raises:
        InvalidInputError: an argument does not fit.
    """

    def __init__(
        self,
        predict: Predict,
        contexts: ArrayLike,
        spread: ArrayLike,
        *,
        relative: float = 0.0,
        most: float = 8.0,
        forgetting: float = 1.0,
        hopeless: float = math.inf,
        angles: Sequence[int] = (),
    ):
        self.predict, self.contexts, self.angles = predict, np.asarray(contexts), list(angles)
        self.spread = np.asarray(spread, np.float64)
        if not (self.spread > 0).all():
            raise InvalidInputError(
                f"spread: expected numbers above 0, got {self.spread.tolist()}; give an error's size"
            )
        if relative < 0 or most <= 0 or not 0 < forgetting <= 1 or not hopeless > 0:
            raise InvalidInputError(
                f"expected relative >= 0, most > 0, forgetting in (0, 1] and hopeless > 0, got {relative:g}, {most:g}, "
                f"{forgetting:g} and {hopeless:g}; see the docstring"
            )
        self.relative, self.most, self.forgetting, self.hopeless = relative, most, forgetting, hopeless
        self.reset()

    def reset(self) -> None:
        """Forget all that was seen."""
        self.log_likelihood = np.zeros(len(self.contexts))

    def update(self, x: Array, u: Array, x_next: Array) -> None:
        """Learn from one transition.

        Args:
            x: (n_x,) the state before, or more, if `predict` needs more than it predicts.
            u: the action, as `predict` takes it.
            x_next: (n_x,) the state after.
        """
        asked = np.flatnonzero(self.log_likelihood > -self.hopeless)
        if len(asked) == 1 and self.forgetting == 1:
            return  # it is known
        error = self._difference(self.predict(x, u, self.contexts[asked]), x_next)
        error /= self.spread + self.relative * np.abs(self._difference(x_next, x[: len(x_next)]))
        losses = 0.5 * (error**2).sum(-1)
        loss = np.full(len(self.contexts), self.most)
        loss[asked] = np.minimum(losses - losses.min(), self.most)
        self.log_likelihood = self.forgetting * self.log_likelihood - loss
        self.log_likelihood -= self.log_likelihood.max()

    def _difference(self, a: Array, b: Array) -> Array:
        difference = a - b
        for i in self.angles:
            difference[..., i] = (difference[..., i] + math.pi) % (2 * math.pi) - math.pi
        return difference

    @property
    def best(self) -> int:
        """Index of the most likely hypothesis."""
        return int(self.log_likelihood.argmax())

    @property
    def probabilities(self) -> Array:
        """(n,) of the hypotheses."""
        likelihood = np.exp(self.log_likelihood)
        return likelihood / likelihood.sum()

    @property
    def mean(self) -> Array:
        """(n_context,) expected context."""
        return self.probabilities @ self.contexts
