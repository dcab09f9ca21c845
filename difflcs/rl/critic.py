"""The value network of PPO: advantages by GAE, and its fit to the newest episodes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import LinearLR

from difflcs._files import check_tensors

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from difflcs.rl.ppo import PPOConfig


class Critic:
    """A network on (state, goal, elapsed time), fitted by mean squares to the returns of the newest iterations.

    Args:
        config: settings.
        n_inputs: inputs of the network.
        key: of the random numbers of its initial weights, see `seeded`.
    """

    def __init__(self, config: PPOConfig, n_inputs: int, key: Sequence[int]):
        self.config, self.n_inputs = config, n_inputs
        width = config.value_width
        with seeded(key):
            self.network = nn.Sequential(
                nn.Linear(n_inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, 1)
            )
        self._adam = torch.optim.AdamW(
            self.network.parameters(), config.value_learning_rate, weight_decay=config.value_weight_decay, fused=True
        )
        initialise_moments(self._adam)
        self.history: list[tuple[Tensor, Tensor]] = []
        """Newest iterations: inputs (N, T+1, n_inputs) and scaled rewards (N, T)."""

    def returns(self, rewards: Tensor) -> Tensor:
        """(N, T) discounted sums of the rewards (N, T) to come."""
        total = torch.zeros(len(rewards), dtype=rewards.dtype)
        sums = []
        for reward in reversed(rewards.unbind(1)):
            total = reward + self.config.gamma * total
            sums.append(total)
        return torch.stack(sums[::-1], 1)

    def values(self, inputs: Tensor) -> Tensor:
        """(..., n_inputs) → (...)."""
        return self.network(inputs.float()).double().squeeze(-1)

    def advantages(self, inputs: Tensor, rewards: Tensor) -> TensorDictBase:
        """TorchRL's GAE (Eq. adv_func): keys "advantage", "value_target", "state_value", (N, T, 1) each.

        The rewards of an episode end with it: V(T) = 0, which the value network can know because it sees the time.
        """
        from tensordict import TensorDict
        from tensordict.nn import TensorDictModule
        from torchrl.objectives.value import GAE

        n, steps = rewards.shape
        end = torch.zeros(n, steps, 1, dtype=torch.bool)
        end[:, -1] = True
        following = {"inputs": inputs[:, 1:], "reward": rewards.unsqueeze(-1), "done": end, "terminated": end}
        data = TensorDict({"inputs": inputs[:, :-1], "next": following}, [n, steps])  # pyright: ignore[reportArgumentType]
        critic = TensorDictModule(lambda v: self.values(v).unsqueeze(-1), ["inputs"], ["state_value"])
        gae = GAE(gamma=self.config.gamma, lmbda=self.config.zeta, value_network=critic, deactivate_vmap=True)
        with torch.no_grad():
            return gae(data)

    def begin(self, inputs: Tensor, rewards: Tensor, key: Sequence[int]) -> None:
        """Fit the network to the returns of the first episodes, before the first advantages; later do nothing."""
        if not self.history:
            self._fit(inputs[:, :-1], self.returns(rewards), self.config.value_first_epochs, (*key, 1))

    def learn(self, inputs: Tensor, rewards: Tensor, key: Sequence[int], epochs: int) -> None:
        """Take in the episodes of an iteration, and fit the network to the newest iterations."""
        self.history = [*self.history, (inputs, rewards)][-self.config.value_iterations :]
        targets = [self.advantages(*part)["value_target"].squeeze(-1) for part in self.history]
        seen = torch.cat([inputs[:, :-1] for inputs, _ in self.history])
        self._fit(seen, torch.cat(targets), epochs, (*key, len(self.history) + 1))

    def _fit(self, inputs: Tensor, targets: Tensor, epochs: int, key: Sequence[int]) -> None:
        x, y = inputs.flatten(0, 1).float(), targets.flatten().float()
        self._adam.param_groups[0]["lr"] = self.config.value_learning_rate
        steps = epochs * math.ceil(len(x) / self.config.value_minibatch)
        schedule = LinearLR(self._adam, 1.0, 0.0, total_iters=steps)
        with seeded(key):
            for _ in range(epochs):
                for batch in torch.randperm(len(x)).split(self.config.value_minibatch):
                    loss = (self.network(x[batch]).squeeze(-1) - y[batch]).square().mean()
                    self._adam.zero_grad()
                    loss.backward()
                    self._adam.step()
                    schedule.step()

    # --- checkpoints ---

    @property
    def sizes(self) -> list[int]:
        """Episodes of each iteration of the history."""
        return [len(rewards) for _, rewards in self.history]

    def tensors(self) -> dict[str, Tensor]:
        """Network and moments: tensors of constant shape."""
        return {**self.network.state_dict(), **moments("adam", self._adam)}

    def history_tensors(self) -> dict[str, Tensor]:
        """The history; nothing while there is none."""
        if not self.history:
            return {}
        names = ("history.inputs", "history.rewards")
        return {name: torch.cat([part[i] for part in self.history]) for i, name in enumerate(names)}

    def restore(self, tensors: Mapping[str, Tensor], history: list[tuple[Tensor, Tensor]]) -> None:
        """Go on from what `tensors` gave, and from a history of `read_history`."""
        self.history = history
        with torch.no_grad():
            for name, value in self.tensors().items():
                value.copy_(tensors[name])


def read_history(
    tensors: Mapping[str, Tensor], sizes: Sequence[int], n_inputs: int, episode_steps: int
) -> list[tuple[Tensor, Tensor]]:
    """The history out of `Critic.history_tensors` and `Critic.sizes`, of episodes of `episode_steps`.

    Raises:
        CheckpointError: they do not fit together.
    """
    if not sizes:
        return []
    n = sum(sizes)
    shapes = {"history.inputs": (n, episode_steps + 1, n_inputs), "history.rewards": (n, episode_steps)}
    found = {name: value for name, value in tensors.items() if name in shapes and value.is_floating_point()}
    dtypes = {name: value.dtype for name, value in found.items()}
    wanted = {name: (shape, dtypes.get(name, torch.float64)) for name, shape in shapes.items()}
    check_tensors("checkpoint", "a history of values", found, wanted)
    inputs, rewards = (found[name].split(list(sizes)) for name in shapes)
    return list(zip(inputs, rewards, strict=True))


@contextmanager
def seeded(key: Sequence[int]) -> Iterator[None]:
    """TorchRL and torch.nn draw from the global generator: seed it by a key of numbers, and give it back as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(np.random.SeedSequence(key).generate_state(1)[0]))
        yield


def initialise_moments(optimiser: torch.optim.Optimizer) -> None:
    """Give every parameter its moments now, so that a checkpoint has the same tensors at any time."""
    for group in optimiser.param_groups:
        for p in group["params"]:
            zero = {"exp_avg": torch.zeros_like(p), "exp_avg_sq": torch.zeros_like(p)}
            optimiser.state[p] = {"step": torch.tensor(0.0), **zero}


def moments(name: str, optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Name → the optimiser's own tensors, by the place of the parameter."""
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    state: Mapping[nn.Parameter, Mapping[str, Tensor]] = optimiser.state  # pyright: ignore[reportAssignmentType]
    return {f"{name}.{i}.{key}": value for i, p in enumerate(parameters) for key, value in state[p].items()}
