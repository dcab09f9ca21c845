"""The policy that a training hands out: it changes only as far as the robot's own episodes allow.

Many steps of PPO make a good policy worse until later ones mend it. So PPO goes on learning as it does, and its policy
is handed out only if a one-sided test allows it, on the returns of its newest episodes and those of the best policy so
far, all played with the same noise. A start that works already plays first, and is replaced by nothing but what is
certainly better. PPO makes a poor one better in many small steps, none of them certain in few episodes. So what is
handed out follows the policies that have played unless they are certainly worse than the best of them: -1.65 standard
errors, 5 % of a single comparison, refuse the last of six equal policies in 13 to 29 % of all trainings, -3 in 1 to 2
%, as the best of several was lucky, too. And no step of it is longer than a trust region, `REACH`, which also bounds
those that no test can judge, the first and the last. The test has two additions:

- Episodes differ most by their goals. What the value network expects of a start is subtracted from its return.
- A policy that fails in 3 % of its episodes fails in none of thirty as often as not. So the test counts one failed
  episode more than were seen, and few episodes do not replace what rarely fails.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from difflcs.rl.learning.checks import check_learned
from difflcs.rl.learning.state_tree import State, copy_state
from difflcs.rl.learning.surrogate import gaussian_kl, trimmed_mean

if TYPE_CHECKING:
    from tensordict import TensorDict

    from difflcs.rl.learning.policy import GaussianPolicy

ITERATIONS = 3
"""Newest iterations whose episodes count for a policy: the newest alone, the newest two, or three."""
REACH = 1.0
"""KL divergence, on states that PPO takes no step on, by which what is handed out changes at most at once."""


def is_better(new: Tensor, old: Tensor, failure: float, errors: float) -> bool:
    """Test whether returns are higher than others, even with one failed episode more.

    Args:
        new: (N,) returns without what was expected of their starts.
        old: (M,) the same of the best policy so far.
        failure: what a failed episode costs [unit of the returns].
        errors: standard errors that a gain must exceed: 5 % of equal policies pass 1.65, 95 % pass -1.65.
    """
    if min(len(new), len(old)) < 2:
        return False
    new = torch.cat([new, new.mean().unsqueeze(0) - failure])
    error = (new.var() / len(new) + old.var() / len(old)).sqrt()
    return bool(new.mean() - old.mean() > errors * error)


class Incumbent:
    """The model that is handed out, and the episodes that tell how good the best one so far is.

    Args:
        best: the policy that is handed out, changed in place when the learner takes its place.
        learner: a copy of it, which is trained.
        failure: what a failed episode costs, in the scaled rewards that PPO learns from.
        errors: standard errors that a gain must exceed, see `is_better`.
        n_inputs: inputs of the value network.
    """

    def __init__(self, best: GaussianPolicy, learner: GaussianPolicy, failure: float, errors: float, n_inputs: int):
        self.actor, self.learned = best, check_learned(best.learned)
        self.learner = check_learned(learner.learned)
        self.failure, self.errors = failure, errors
        self._playing: State = {}
        self._none = (torch.zeros(0, n_inputs, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
        self.episodes: list[tuple[Tensor, Tensor]] = []
        """Of the best, then of the learner's newest iterations since it was found: inputs of the value network at the
        starts (N, n_inputs), returns (N,)."""

    @property
    def keeps_start(self) -> bool:
        """True if nothing but what is certainly better replaces the start."""
        return self.errors >= 0

    def begin(self) -> None:
        """Remember the learner as it is: it plays now."""
        self._playing = copy_state(self.learner.state_dict())

    def challenge(
        self, starts: Tensor, returns: Tensor, values: Callable[[Tensor], Tensor], held_out: TensorDict
    ) -> bool:
        """Let the model that has played take its place if the test allows it, or follow it, see `follow`.

        The first one is not tested where the start need not be kept.

        Args:
            starts: (N, n_inputs) inputs of the value network at the start of its episodes.
            returns: (N,) sums of scaled rewards.
            values: the value network.
            held_out: see `follow`.

        Returns:
            True if the test allowed it.
        """
        self.episodes.append((starts, returns))
        if len(self.episodes) == 1 and not self.keeps_start:
            self.follow(self._playing, held_out)
            return True
        del self.episodes[1:-ITERATIONS]
        gains = [outcome - values(start) for start, outcome in self.episodes]
        for count in range(1, len(self.episodes)):
            newest = torch.cat(gains[-count:])
            if is_better(newest, gains[0], self.failure, self.errors):
                self.follow(self._playing, held_out)
                if newest.mean() > gains[0].mean():
                    self.episodes = [self._join(self.episodes[-count:])]
                return True
        return False

    @torch.no_grad()
    def follow(self, model: State, held_out: TensorDict) -> None:
        """Hand out a model; where the start need not be kept, the one on the way to it that the trust region reaches.

        Args:
            model: its `state_dict`.
            held_out: (N,) what the policy sees in states from which no step to the model was computed.
        """
        now, before, share = copy_state(self.learned.state_dict()), self.actor.solve(held_out.clone()), 1.0
        self.learned.load_state_dict(model)
        while not self.keeps_start:
            kl = trimmed_mean(gaussian_kl(before, self.actor.solve(held_out.clone())))
            if kl <= REACH or not share:
                break
            share = share * min(0.9, math.sqrt(REACH / kl)) if share > 0.01 else 0.0  # 0.9 where it is not finite
            part = {k: now[k].lerp(v, share) if v.is_floating_point() else v for k, v in model.items()}
            self.learned.load_state_dict(part if share else now)

    def state_dict(self) -> dict[str, Any]:
        """The learner's parameters, and all episodes, one iteration after another; those of the best are number 0."""
        starts, returns = self._join(self.episodes)
        sizes = torch.tensor([len(returns) for _, returns in self.episodes], dtype=torch.int64)
        number = torch.arange(len(sizes)).repeat_interleave(sizes)
        episodes = {"starts": starts, "returns": returns, "iteration": number}
        settings = {"errors": self.errors}
        return {"settings": settings, "learner": dict(self.learner.state_dict()), "episodes": episodes}

    def load_state_dict(self, state: State) -> None:
        """Go on from what `state_dict` gave."""
        self.learner.load_state_dict(state["learner"])
        episodes = state["episodes"]
        sizes = episodes["iteration"].unique_consecutive(return_counts=True)[1].tolist()
        self.episodes = [*zip(episodes["starts"].split(sizes), episodes["returns"].split(sizes), strict=True)]

    def _join(self, parts: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
        starts, returns = zip(self._none, *parts, strict=True)
        return torch.cat(starts), torch.cat(returns)
