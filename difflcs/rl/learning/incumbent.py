"""The policy that a training hands out: replaced only by one that did better in the robot's own episodes.

Many steps of PPO make a good policy worse until later ones mend it. So PPO goes on learning as it does, and its policy
takes the place of the incumbent only if its newest episodes had higher returns, by a one-sided test with two additions:

- Episodes differ most by their goals. What the value network expects of a start is subtracted from its return.
- A policy that fails in 3 % of its episodes fails in none of thirty as often as not. So the test counts one failed
  episode more than were seen, and few episodes do not replace what rarely fails.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from difflcs.rl.learning.state_tree import State, copy_state
from difflcs.rl.learning.trainer import TrainableModel
from difflcs.rl.rollout import Policy

ITERATIONS = 3
"""Newest iterations whose episodes count for a policy: the newest alone, the newest two, or three."""
_DEVIATIONS = 1.65
"""Standard errors that a gain must exceed: 5 % of equal policies pass."""


def is_better(new: Tensor, old: Tensor, failure: float) -> bool:
    """Test whether returns are higher than others, even with one failed episode more.

    Args:
        new: (N,) returns without what was expected of their starts.
        old: (M,) the same of the incumbent.
        failure: what a failed episode costs [unit of the returns].
    """
    if min(len(new), len(old)) < 2:
        return False
    new = torch.cat([new, new.mean().unsqueeze(0) - failure])
    error = (new.var() / len(new) + old.var() / len(old)).sqrt()
    return bool(new.mean() - old.mean() > _DEVIATIONS * error)


class Incumbent:
    """The best model so far, and the episodes that tell how good it is.

    Args:
        policy: acts by it.
        learned: the model, changed in place when the learner's takes its place.
        learner: the model that is trained, of the same class.
        failure: what a failed episode costs, in the scaled rewards that PPO learns from.
        n_inputs: inputs of the value network.
    """

    def __init__(self, policy: Policy, learned: TrainableModel, learner: TrainableModel, failure: float, n_inputs: int):
        self.policy, self.learned, self.learner, self.failure = policy, learned, learner, failure
        self._playing: State = {}
        none = (torch.zeros(0, n_inputs, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
        self.own: tuple[Tensor, Tensor] = none
        """Its episodes: inputs of the value network at their starts (N, n_inputs), returns (N,)."""
        self.others: list[tuple[Tensor, Tensor]] = []
        """The same of the learner's newest iterations, since the incumbent was found."""

    def __len__(self) -> int:
        """Episodes of its own: none before the first call of `challenge`."""
        return len(self.own[1])

    def begin(self) -> None:
        """Remember the learner as it is: it plays now."""
        self._playing = copy_state(self.learner.state_dict())

    def challenge(self, starts: Tensor, returns: Tensor, values: Callable[[Tensor], Tensor]) -> bool:
        """Let the model that has played take its place if it did better. The first episodes are its own.

        Args:
            starts: (N, n_inputs) inputs of the value network at the start of its episodes.
            returns: (N,) sums of scaled rewards.
            values: the value network.

        Returns:
            True if the model took its place.
        """
        if not len(self):
            self.own = (starts, returns)
            return False
        self.others = [*self.others, (starts, returns)][-ITERATIONS:]
        own = self.own[1] - values(self.own[0])
        for count in range(1, len(self.others) + 1):
            newest = _join(self.others[-count:])
            if is_better(newest[1] - values(newest[0]), own, self.failure):
                self.learned.load_state_dict(self._playing)
                self.own, self.others = newest, []
                return True
        return False

    def state_dict(self) -> dict[str, Any]:
        """The learner's parameters, and all episodes, one iteration after another; its own are number 0."""
        parts = [self.own, *self.others]
        numbers = [torch.full((len(returns),), k) for k, (_, returns) in enumerate(parts)]
        starts, returns = _join(parts)
        episodes = {"starts": starts, "returns": returns, "iteration": torch.cat(numbers)}
        return {"learner": dict(self.learner.state_dict()), "episodes": episodes}

    def load_state_dict(self, state: State) -> None:
        """Go on from what `state_dict` gave."""
        self.learner.load_state_dict(state["learner"])
        episodes = state["episodes"]
        number = episodes["iteration"]
        count = int(number.max()) + 1 if len(number) else 1
        parts = [(episodes["starts"][number == k], episodes["returns"][number == k]) for k in range(count)]
        self.own, self.others = parts[0], parts[1:]


def _join(parts: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    starts, returns = zip(*parts, strict=True)
    return torch.cat(starts), torch.cat(returns)
