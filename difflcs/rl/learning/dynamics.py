"""An ensemble of networks that predicts the next state: PDDM plans with it, model rollouts are played in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from difflcs import _storage
from difflcs._checks import check_positive_int
from difflcs._modules import untouched
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl.learning.least_squares import gradients
from difflcs.rl.settings import MOST_NETWORKS, MOST_WIDTH, Epochs, Settings, bounded, group

_SIZES = ("n_x", "n_u", "networks", "width")
_VECTOR = 16
"""Numbers of single precision in the widest vectors of a CPU: products of such sizes are the fastest."""


def _round_up(size: int) -> int:
    """Round a size up to whole vectors."""
    return -(-size // _VECTOR) * _VECTOR


@dataclass(frozen=True)
class EnsembleSettings(Settings):
    """Settings of an ensemble of networks and of its training."""

    networks: int = bounded(4, minimum=1, maximum=MOST_NETWORKS)
    """Networks in the ensemble."""
    width: int = bounded(128, minimum=1, maximum=MOST_WIDTH)
    """Width of their two hidden layers."""
    epochs: Epochs = group(Epochs, first=60, each=3, minibatch=128)
    """Passes over all data in the first training, and in each later one."""
    learning_rate: float = bounded(8e-3, above=0)
    """Adam's step size at the start of each training. Adam is not kept."""


class Ensemble(nn.Module):
    """Networks that predict the next state, evaluated side by side; inputs and outputs are standardised by the data.

    Args:
        n_x: states.
        n_u: actions.
        networks: number of networks.
        width: width of the two hidden layers.
        generator: draws the initial weights.
    """

    def __init__(self, n_x: int, n_u: int, networks: int, width: int, generator: torch.Generator | None = None):
        super().__init__()
        self.n_x, self.n_u, self.networks, self.width = n_x, n_u, networks, width
        sizes = [n_x + n_u, width, width, n_x]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for n_in, n_out in pairwise(sizes):
            self.weights.append(nn.Parameter(torch.empty(networks, n_in, n_out)))
            self.biases.append(nn.Parameter(torch.empty(networks, 1, n_out)))
        self.draw(generator)
        for name, size in (("input", n_x + n_u), ("change", n_x)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    input_mean: Tensor
    input_std: Tensor
    change_mean: Tensor
    change_std: Tensor

    def draw(self, generator: torch.Generator | None = None) -> None:
        """Draw the weights anew, uniform within ± one over the root of the layer's inputs; biases are zero."""
        with torch.no_grad():
            for weight, bias in zip(self.weights, self.biases, strict=True):
                bound = weight.shape[1] ** -0.5
                weight.copy_(bound * (2 * torch.rand(weight.shape, generator=generator) - 1))
                bias.zero_()

    def standardised(self, inputs: Tensor) -> Tensor:
        """(networks, N, n_x + n_u) → (networks, N, n_x) standardised changes of the state."""
        hidden = (inputs - self.input_mean) / self.input_std
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = torch.baddbmm(bias, hidden, weight).relu_()
        return torch.baddbmm(self.biases[-1], hidden, self.weights[-1])

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        """States (networks, N, n_x), actions (networks, N, n_u) → next states, each network from its own states."""
        return x + self.change_mean + self.change_std * self.standardised(torch.cat([x, u], -1))

    @torch.no_grad()
    def rollout(self, x0: Tensor, u: Tensor) -> Tensor:
        """Predict where action sequences lead from one state, without gradients.

        These are the numbers of `forward` but for their rounding, in three quarters of its time: one network after the
        other, so that its activations stay in the cache, by nothing but products and rectifiers, see `_products`.

        Args:
            x0: (n_x,) state.
            u: (N, T, n_u) action sequences.

        Returns:
            (networks, N, T+1, n_x) states, from x0 on.
        """
        (count, steps, _), n_x = u.shape, self.n_x
        first, second, last = self._products()
        seen = u.new_zeros(steps, count, first.shape[1])
        seen[..., n_x : n_x + self.n_u] = (u - self.input_mean[n_x:]).transpose(0, 1)
        seen[..., n_x + self.n_u] = 1
        states = u.new_empty(self.networks, count, steps + 1, n_x)
        hidden, hidden_too = u.new_empty(2, count, first.shape[2])
        for k in range(self.networks):
            x = (x0 - self.input_mean[:n_x]).expand(count, -1).contiguous()
            states[k, :, 0] = x
            for t in range(steps):
                seen[t, :, :n_x] = x
                torch.mm(seen[t], first[k], out=hidden).relu_()
                torch.mm(hidden, second[k], out=hidden_too).relu_()
                states[k, :, t + 1] = x.addmm_(hidden_too, last[k])
        return states.add_(self.input_mean[:n_x])

    def _products(self) -> tuple[Tensor, Tensor, Tensor]:
        """The layers as products alone, (networks, n_in, n_out) each: from inputs less their means to changes.

        A bias is the row of an input that is always one, and scales are parts of the first and the last layer. Zeros
        fill what lies between the layers up to whole vectors.
        """
        inputs, width = self.n_x + self.n_u, self.width
        wide = _round_up(width + 1)
        first = torch.zeros(self.networks, _round_up(inputs + 1), wide)
        second = torch.zeros(self.networks, wide, wide)
        last = torch.zeros(self.networks, wide, self.n_x)
        first[:, :inputs, :width] = self.weights[0] / self.input_std.unsqueeze(-1)
        second[:, :width, :width] = self.weights[1]
        last[:, :width] = self.weights[2] * self.change_std
        first[:, inputs, :width], second[:, width, :width] = self.biases[0].squeeze(1), self.biases[1].squeeze(1)
        last[:, width] = self.biases[2].squeeze(1) * self.change_std + self.change_mean
        first[:, inputs, width] = second[:, width, width] = 1  # hands the one on
        return first, second, last

    def fit(
        self,
        x: Tensor,
        u: Tensor,
        x_next: Tensor,
        *,
        epochs: int,
        minibatch: int,
        learning_rate: float,
        generator: torch.Generator,
        decay: bool = False,
    ) -> float:
        """Fit every network to all transitions (N, ·), each in its own order, from its present weights.

        Args:
            x: (N, n_x) states.
            u: (N, n_u) actions.
            x_next: (N, n_x) next states.
            epochs: passes over the transitions.
            minibatch: transitions per step.
            learning_rate: step size of a new Adam.
            generator: draws the orders.
            decay: let the step size fall linearly to zero. It can begin higher then: less noise stays in the weights.

        Returns:
            The mean loss of the last pass: squared error of the standardised changes.
        """
        if not all(map(untouched, self.modules())):  # the gradients below are those of the weights themselves
            raise InvalidInputError(
                "ensemble: expected weights that are parameters, got some that torch.nn.utils computes; remove its "
                "parametrisations and hooks before fitting"
            )
        inputs, changes = torch.cat([x, u], -1).float(), (x_next - x).float()
        for name, data in (("input", inputs), ("change", changes)):
            getattr(self, f"{name}_mean").copy_(data.mean(0))
            getattr(self, f"{name}_std").copy_(data.std(0, correction=0).clamp_min(1e-6))
        targets = (changes - self.change_mean) / self.change_std
        inputs = (inputs - self.input_mean) / self.input_std
        adam = torch.optim.Adam(self.parameters(), learning_rate, fused=True)
        layers = [(w.detach(), b.detach()) for w, b in zip(self.weights, self.biases, strict=True)]
        done, steps = 0, epochs * math.ceil(len(inputs) / minibatch)
        losses: list[Tensor] = []
        for _ in range(epochs):
            orders = torch.stack([torch.randperm(len(inputs), generator=generator) for _ in range(self.networks)])
            losses = []
            for batch in orders.split(minibatch, 1):
                errors, layer_gradients = gradients(layers, torch.relu_, inputs[batch], targets[batch])
                for weight, bias, gradient in zip(self.weights, self.biases, layer_gradients, strict=True):
                    weight.grad, bias.grad = gradient
                if decay:
                    adam.param_groups[0]["lr"] = learning_rate * (1 - done / steps)
                adam.step()
                done += 1
                losses.append(errors.mean())
        return float(torch.stack(losses).mean())

    def config(self) -> dict[str, Any]:
        """Return the sizes of the ensemble."""
        return {name: getattr(self, name) for name in _SIZES}

    @classmethod
    def from_config(cls, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str) -> Ensemble:
        """Build an ensemble from `config()` and a state dict; `source` names them in the error messages.

        Raises:
            CheckpointError: they do not fit each other, or hold NaN or infinity.
        """
        try:
            n_x, n_u, networks, width = (check_positive_int(name, config[name]) for name in _SIZES)
        except (KeyError, InvalidInputError) as error:
            raise CheckpointError(f"{source}: expected an ensemble written by difflcs, got {error}") from error
        return _storage.load_module(source, "an ensemble", tensors, lambda: cls(n_x, n_u, networks, width))
