"""Baseline without a model: a network trained by the same PPO as the LCS, as a reference point."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from difflcs import _storage
from difflcs._checks import check_positive_int
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl.rollout import PolicyOutput, elapsed_fractions
from difflcs.rl.tasks import Features, compute_features

_SIZES = ("n_features", "width", "episode_steps")


class MLPController(nn.Module):
    """Two hidden tanh layers from features to actions: tanh keeps them within the bounds. float64.

    It is a policy for `difflcs.rl.evaluate` and counts its own steps, because actions depend on the time that is left:
    call `begin` at every reset. After `episode_steps` it starts again from zero.

    Args:
        features: its inputs, of states, goals and the elapsed fraction of the episode.
        n_features: number of inputs.
        u_min: (n_u,) lower bounds of the actions.
        u_max: (n_u,) upper bounds.
        width: width of the hidden layers.
        episode_steps: steps of one episode.
        generator: draws the initial weights (orthogonal; the last layer's are near zero).
    """

    u_min: Tensor
    u_max: Tensor

    def __init__(
        self,
        features: Features,
        n_features: int,
        u_min: Tensor,
        u_max: Tensor,
        width: int = 64,
        episode_steps: int = 20,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.features, self.episode_steps = features, episode_steps
        self.n_features, self.width = n_features, width
        sizes = [n_features, width, width, len(u_min)]
        gains = [math.sqrt(2), math.sqrt(2), 0.01]
        layers: list[nn.Module] = []
        for n_in, n_out, gain in zip(sizes[:-1], sizes[1:], gains, strict=True):
            with torch.random.fork_rng(devices=[]):  # torch's own initial weights are replaced
                linear = nn.Linear(n_in, n_out, dtype=torch.float64)
            nn.init.orthogonal_(linear.weight, gain, generator)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.Tanh()]
        self.layers = nn.Sequential(*layers)
        for name, bound in (("u_min", u_min), ("u_max", u_max)):
            self.register_buffer(name, bound.double())
        self.begin()

    def begin(self, seed: int = 0) -> None:
        """Start an episode. `seed` is for policies that draw random numbers."""
        self._step = 0

    def mean(self, state: Tensor, goal: Tensor, elapsed: Tensor, context: Tensor | None = None) -> Tensor:
        """Compute the actions, without noise.

        Args:
            state: (..., n_x).
            goal: (..., n_goal).
            elapsed: (...) fraction of the episode that has passed.
            context: (..., n_context), the fourth argument of the features where there is one.

        Returns:
            (..., n_u) actions.
        """
        middle, half = 0.5 * (self.u_max + self.u_min), 0.5 * (self.u_max - self.u_min)
        return middle + half * self.layers(compute_features(self.features, state, goal, elapsed, context))

    def forward(
        self,
        x0: Tensor,
        goal: Tensor,
        *,
        u_min: Tensor | None = None,
        u_max: Tensor | None = None,
        context: Tensor | None = None,
    ) -> PolicyOutput:
        """Act once in states (B, n_x) towards goals (B, n_goal), one step after the last call."""
        elapsed = elapsed_fractions(self.episode_steps)[self._step % self.episode_steps].expand(x0.shape[:-1])
        self._step += 1
        action = self.mean(x0, goal, elapsed, context)
        low, high = (self.u_min if u_min is None else u_min), (self.u_max if u_max is None else u_max)
        return PolicyOutput(action.clamp(low, high), torch.ones(x0.shape[:-1], dtype=torch.bool))

    def config(self) -> dict[str, Any]:
        """Return the sizes of the network."""
        return {name: getattr(self, name) for name in _SIZES}

    @classmethod
    def from_config(
        cls, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str, features: Features
    ) -> MLPController:
        """Build a network from `config()` and a state dict; `source` names them in the error messages.

        Raises:
            CheckpointError: they do not fit each other, or hold NaN or infinity.
        """
        try:
            n_features, width, episode_steps = (check_positive_int(name, config[name]) for name in _SIZES)
            zero = torch.zeros(tensors["u_min"].numel())  # in place of the bounds, which are loaded
        except (KeyError, InvalidInputError) as error:
            raise CheckpointError(f"{source}: expected a network written by difflcs, got {error}") from error
        make = partial(cls, features, n_features, zero, zero, width, episode_steps)
        return _storage.load_module(source, "a network", tensors, make)
