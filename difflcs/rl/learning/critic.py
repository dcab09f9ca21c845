"""The value network of PPO, its fit to the newest episodes, and generalised advantage estimation (GAE) by it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from difflcs.errors import CheckpointError
from difflcs.rl.learning.least_squares import FlatAdam, gradients, tanh
from difflcs.rl.learning.state_tree import State
from difflcs.rl.seeding import seeded
from difflcs.rl.settings import MOST_WIDTH, Epochs, Settings, bounded, group

_LEARNING_RATE, _WEIGHT_DECAY = 2e-3, 1e-4  # of AdamW; the step size falls linearly to zero in each fit
_ITERATIONS = 3
"""Newest iterations whose episodes the network is fitted to."""


@dataclass(frozen=True)
class CriticSettings(Settings):
    """Settings of the value network."""

    width: int = bounded(64, minimum=1, maximum=MOST_WIDTH)
    """Width of its two hidden layers."""
    epochs: Epochs = group(Epochs, first=80, each=10, minibatch=256)
    """Passes over its data: on the discounted returns of the first episodes, before the first advantages; and at the
    end of each iteration."""


class Critic:
    """A network on (state, goal, elapsed time), fitted by mean squares to the returns of the newest iterations.

    Args:
        settings: settings.
        n_inputs: inputs of the network.
        episode_steps: T, steps of one episode.
        gamma: discount per step.
        zeta: ζ of the advantages that give its targets, often called lambda.
        key: of the random numbers of its initial weights, see `seeded`.
    """

    def __init__(
        self, settings: CriticSettings, n_inputs: int, episode_steps: int, gamma: float, zeta: float, key: Sequence[int]
    ):
        self.settings, self.n_inputs, self.gamma, self.zeta = settings, n_inputs, gamma, zeta
        width = settings.width
        with seeded(key):
            self.network = nn.Sequential(
                nn.Linear(n_inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, 1)
            )
        self._adam = FlatAdam(self.network, _WEIGHT_DECAY)
        self._none = (torch.zeros(0, episode_steps + 1, n_inputs).double(), torch.zeros(0, episode_steps).double())
        self.history: list[tuple[Tensor, Tensor]] = []
        """Newest iterations: inputs (N, T+1, n_inputs) and rewards (N, T)."""

    @torch.no_grad()
    def values(self, inputs: Tensor) -> Tensor:
        """(..., n_inputs) → (...), without gradients."""
        return self.network(inputs.float()).double().squeeze(-1)

    def gae(self, inputs: Tensor, rewards: Tensor) -> tuple[Tensor, Tensor]:
        """Values and advantages (N, T), see `gae`; their sum is what values aim at."""
        values = self.values(inputs)
        return values[:, :-1], gae(values, rewards, self.gamma, self.zeta)

    def begin(self, inputs: Tensor, rewards: Tensor, key: Sequence[int]) -> None:
        """Fit the network to the returns of the first episodes, before the first advantages; later do nothing.

        Args:
            inputs: (N, T+1, n_inputs).
            rewards: (N, T).
            key: of random numbers.
        """
        if not self.history:
            self._fit(inputs[:, :-1], returns(rewards, self.gamma), self.settings.epochs.first, (*key, 1))

    def learn(self, inputs: Tensor, rewards: Tensor, key: Sequence[int], epochs: int) -> None:
        """Take in the episodes of an iteration, and fit the network to the newest iterations.

        Args:
            inputs: (N, T+1, n_inputs).
            rewards: (N, T) to be predicted.
            key: of random numbers.
            epochs: passes over the episodes.
        """
        self.history = [*self.history, (inputs, rewards)][-_ITERATIONS:]
        targets = [torch.add(*self.gae(*part)) for part in self.history]
        seen = torch.cat([inputs[:, :-1] for inputs, _ in self.history])
        self._fit(seen, torch.cat(targets), epochs, (*key, len(self.history) + 1))

    def _fit(self, inputs: Tensor, targets: Tensor, epochs: int, key: Sequence[int]) -> None:
        x, y, minibatch = inputs.flatten(0, 1).float(), targets.flatten().float(), self.settings.epochs.minibatch
        linear = [layer for layer in self.network if isinstance(layer, nn.Linear)]
        layers = [(layer.weight.detach().mT.unsqueeze(0), layer.bias.detach().expand(1, 1, -1)) for layer in linear]
        done, steps = 0, epochs * math.ceil(len(x) / minibatch)
        with seeded(key):
            for _ in range(epochs):
                for batch in torch.randperm(len(x)).split(minibatch):
                    _, layer_gradients = gradients(layers, tanh, x[batch].unsqueeze(0), y[batch].view(1, -1, 1))
                    parts = [part for weight, bias in layer_gradients for part in (weight.mT.flatten(), bias.flatten())]
                    self._adam.descend(torch.cat(parts), _LEARNING_RATE * (1 - done / steps))
                    done += 1

    def state_dict(self) -> dict[str, Any]:
        """Network, moments, and the newest iterations, one after another."""
        inputs, rewards = (torch.cat(part) for part in zip(self._none, *self.history, strict=True))
        ages = [torch.full((len(part),), age) for age, (_, part) in enumerate(self.history)]
        place = torch.cat([torch.zeros(0, dtype=torch.int64), *ages])
        return {
            "network": self.network.state_dict(),
            "adam": self._adam.state_dict(),
            "episodes": {"inputs": inputs, "rewards": rewards, "iteration": place},
        }

    def load_state_dict(self, state: State) -> None:
        """Go on from what `state_dict` gave.

        Raises:
            CheckpointError: iterations that are not numbered from the oldest one, or more than are kept.
        """
        episodes = state["episodes"]
        ages, counts = torch.unique_consecutive(episodes["iteration"], return_counts=True)
        if not torch.equal(ages, torch.arange(len(ages))) or len(ages) > _ITERATIONS:
            raise CheckpointError(
                f"checkpoint: expected at most {_ITERATIONS} iterations of episodes, numbered from 0, got "
                f"{ages[:9].tolist()}; is it damaged?"
            )
        self.network.load_state_dict(state["network"])
        self._adam.load_state_dict(state["adam"])
        sizes = counts.tolist()
        self.history = list(zip(episodes["inputs"].split(sizes), episodes["rewards"].split(sizes), strict=True))


def returns(rewards: Tensor, gamma: float) -> Tensor:
    """Sum the discounted rewards (N, T) from each step to the end: (N, T)."""
    total = torch.zeros(len(rewards), dtype=rewards.dtype)
    sums = []
    for reward in reversed(rewards.unbind(1)):
        total = reward + gamma * total
        sums.append(total)
    return torch.stack(sums[::-1], 1)


def gae(values: Tensor, rewards: Tensor, gamma: float, zeta: float) -> Tensor:
    """Generalised advantage estimation (Eq. 5 of the paper): (N, T) advantages.

    The rewards of an episode end with it: V(T) = 0, which the value network can know because it sees the time.

    Args:
        values: (N, T+1) of the states, the last of which does not count.
        rewards: (N, T).
        gamma: discount per step.
        zeta: ζ, often called lambda.
    """
    now, following = values[:, :-1], values[:, 1:].clone()
    following[:, -1] = 0
    return returns(rewards + gamma * following - now, gamma * zeta)
