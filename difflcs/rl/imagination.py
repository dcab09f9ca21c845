"""Imagined episodes: PPO's data in an ensemble of networks fitted to the real episodes (model-ensemble policy search).

Kurutach et al., "Model-ensemble trust-region policy optimization", 2018. Nothing of it is left in what is learned: the
LCS and its MPC act alone. What is imagined counts as no data of the robot, and costs time of the computer instead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from difflcs._checks import MOST_ENVS, MOST_NETWORKS, MOST_WIDTH, check_number, check_positive_int
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl.checkpoint import check_episodes, kinds
from difflcs.rl.dynamics import Ensemble

Outcome = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""States (B, n_x), executed actions (B, n_u), next states, goals (B, n_goal) → dense rewards (B,), successes (B,)."""
_STREAM = 9
EPISODES = ("states", "actions", "goals")
"""What is kept of real episodes."""


@dataclass(frozen=True)
class ImaginationConfig:
    """Settings of the imagined episodes; all ours, tuned on the cube."""

    iterations: int = 5
    """Iterations of PPO on imagined episodes between two on real ones, in the first half of the main phase; 0: none, as
    in the paper."""
    final_iterations: int = 1
    """At most as many in its second half."""
    rollouts: int = 120
    """Imagined episodes per iteration."""
    steps: int = 12
    """Gradient steps per imagined iteration."""
    steps_minibatch: int | None = 600
    """Samples per gradient step, every sample once before any is drawn again; None: each step on all of them."""
    value_epochs: int = 10
    """Epochs of the value network at the end of an imagined iteration."""
    actions: int = 8
    """Actions that the networks judge in each imagined state, an even number (`difflcs.rl.lookahead`); 1: only the one
    that is taken, by GAE as in real episodes."""
    zeta: float = 0.5
    """Zeta of the advantages where several actions are judged, that of PPO otherwise."""
    real_step: float = 0.3
    """Factor on the gradient steps on real episodes once there are imagined ones: their gradient is noisier."""
    networks: int = 4
    """Networks in the ensemble; every imagined step is predicted by one of them, drawn at random."""
    width: int = 128
    """Width of their two hidden layers."""
    first_epochs: int = 60
    """Passes over the data of the first training."""
    epochs: int = 3
    """Passes over all data before the imagined iterations."""
    minibatch: int = 128
    """Transitions per step."""
    learning_rate: float = 8e-3
    """Adam's step size at the start of each training; it falls linearly to zero. The networks are kept, Adam is not."""

    def __post_init__(self) -> None:
        for name in ("iterations", "final_iterations"):
            check_positive_int(name, getattr(self, name), minimum=0)
        for name in ("steps", "value_epochs", "first_epochs", "epochs", "minibatch"):
            check_positive_int(name, getattr(self, name))
        for name, most in (("rollouts", MOST_ENVS), ("networks", MOST_NETWORKS), ("width", MOST_WIDTH)):
            check_positive_int(name, getattr(self, name), maximum=most)
        if check_positive_int("actions", self.actions, maximum=MOST_ENVS) > 1 and self.actions % 2:
            raise InvalidInputError(f"actions: expected 1 or an even number, got {self.actions}")
        if not 0 <= check_number("zeta", self.zeta) <= 1:
            raise InvalidInputError(f"zeta: expected 0 <= zeta <= 1, got {self.zeta}")
        if self.steps_minibatch is not None:
            check_positive_int("steps_minibatch", self.steps_minibatch)
        for name in ("real_step", "learning_rate"):
            check_number(name, getattr(self, name), strict=True)


class ImaginedEnv(VectorEnv):
    """Episodes predicted by an ensemble, in lockstep: start and goal are those of real episodes, not of the same one.

    A prediction is kept within the range of the real states, widened by its width on either side. An episode depends on
    its seed only, as that of a real environment.

    Args:
        ensemble: predicts the next state.
        outcome: the task.
        num_envs: episodes side by side.
        episode_steps: steps of one episode.
        observation_space: Dict(state, goal) of one real environment.
        action_space: of one real environment.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self, ensemble: Ensemble, outcome: Outcome, num_envs: int, episode_steps: int, observation_space, action_space
    ):
        self.ensemble, self.outcome, self.num_envs, self.episode_steps = ensemble, outcome, num_envs, episode_steps
        self.single_observation_space, self.single_action_space = observation_space, action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        self._starts = self._goals = self._low = self._high = torch.zeros(0, ensemble.n_x)
        self._rng = np.random.default_rng(0)

    def remember(self, states: Tensor, goals: Tensor) -> None:
        """Replace what starts, goals and the range of states are taken from: real states (N, T+1, n_x), goals."""
        self._starts, self._goals = states[:, 0], goals
        low, high = states.flatten(0, 1).amin(0), states.flatten(0, 1).amax(0)
        self._low, self._high = low - (high - low), high + (high - low)

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: Any = None):
        """Begin an episode everywhere.

        Args:
            seed: one for each episode; a number is that of the first, and the others follow it.
            options: none are known.

        Returns:
            Observations and an empty info.

        Raises:
            InvalidInputError: there is nothing to remember yet.
        """
        if not len(self._starts):
            raise InvalidInputError("imagination: expected real episodes, got none; call remember() first")
        if seed is None or isinstance(seed, int):
            first = int(self._rng.integers(2**31)) if seed is None else seed
            seed = range(first, first + self.num_envs)
        generators = [np.random.default_rng(one) for one in seed]
        starts = [int(rng.integers(len(self._starts))) for rng in generators]
        goals = [int(rng.integers(len(self._goals))) for rng in generators]
        choices = [rng.integers(self.ensemble.networks, size=self.episode_steps) for rng in generators]
        self._networks = torch.from_numpy(np.stack(choices, 1))
        self._state, self._goal, self._step = self._starts[starts], self._goals[goals], 0
        return self._observe(), {}

    def step(self, actions: np.ndarray):
        """Predict one step; the step after the last one begins new episodes, whatever the actions.

        Returns:
            Observations, dense rewards, terminations (all False), truncations, info with `success`.
        """
        nothing = np.zeros(self.num_envs, bool)
        if self._step == self.episode_steps:
            observation, _ = self.reset()
            return observation, np.zeros(self.num_envs), nothing, nothing.copy(), {"success": nothing.copy()}
        u = torch.from_numpy(np.asarray(actions, np.float64))
        after = self._predict(self._state, u, self._networks[self._step])
        reward, success = self.outcome(self._state, u, after, self._goal)
        self._state, self._step = after, self._step + 1
        ended = np.full(self.num_envs, self._step == self.episode_steps)
        return self._observe(), reward.numpy(), nothing, ended, {"success": success.numpy()}

    def foresee(self, states: Tensor, actions: Tensor, goals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What other actions would have led to in the episodes just played, by the networks that played them.

        Args:
            states: (num_envs, T, n_x) of the episodes, without the last ones.
            actions: (num_envs, T, M, n_u) executed instead.
            goals: (num_envs, n_goal).

        Returns:
            Next states (num_envs, T, M, n_x), dense rewards and successes (num_envs, T, M).
        """
        shape = actions.shape[:-1]
        before, goals = (v.expand(*shape, -1).flatten(0, 2) for v in (states.unsqueeze(2), goals[:, None, None]))
        actions, networks = actions.flatten(0, 2), self._networks.T.unsqueeze(2).expand(shape).flatten()
        after = self._predict(before, actions, networks)
        reward, success = self.outcome(before, actions, after, goals)
        return after.view(*shape, -1), reward.view(shape), success.view(shape)

    def _predict(self, states: Tensor, actions: Tensor, networks: Tensor) -> Tensor:
        """States (B, n_x), actions (B, n_u), numbers of networks (B,) → next states (B, n_x) within the range."""
        rows = [(networks == k).nonzero().squeeze(1) for k in range(self.ensemble.networks)]
        padded = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)  # every network, as many rows
        with torch.no_grad():
            found = self.ensemble(states[padded].float(), actions[padded].float())
        predicted = torch.empty_like(states)
        for own, part in zip(rows, found, strict=True):
            predicted[own] = part[: len(own)].double()
        predicted = torch.where(predicted.isfinite(), predicted, states)
        return torch.minimum(torch.maximum(predicted, self._low), self._high)

    def _observe(self) -> dict[str, np.ndarray]:
        return {"state": self._state.numpy().copy(), "goal": self._goal.numpy().copy()}


class Imagination:
    """The real episodes of a training, the ensemble fitted to them, and the environment that plays it.

    Args:
        env: the real environments.
        outcome: the task: what its rewards and successes are.
        config: settings.
        seed: of the networks' initial weights and minibatches.
        episode_steps: steps of one episode.
    """

    def __init__(self, env: VectorEnv, outcome: Outcome, config: ImaginationConfig, seed: int, episode_steps: int):
        check_positive_int("seed", seed, minimum=0)
        self.config, self.seed = config, seed
        space: Any = env.single_observation_space
        n_x, n_u = space["state"].shape[0], env.single_action_space.shape[0]  # pyright: ignore[reportOptionalSubscript]
        sizes = ((episode_steps + 1, n_x), (episode_steps, n_u), space["goal"].shape)
        empty = {name: torch.zeros(0, *size, dtype=torch.float64) for name, size in zip(EPISODES, sizes, strict=True)}
        self.episodes: dict[str, Tensor] = empty
        """Real episodes: states (N, T+1, n_x), executed actions (N, T, n_u), goals (N, n_goal)."""
        generator = torch.Generator().manual_seed(self._key(0))
        self.ensemble = Ensemble(n_x, n_u, config.networks, config.width, generator)
        self.env = ImaginedEnv(self.ensemble, outcome, config.rollouts, episode_steps, space, env.single_action_space)
        self.fits = 0

    def __len__(self) -> int:
        return len(self.episodes["states"])

    def add(self, states: Tensor, actions: Tensor, goals: Tensor) -> None:
        """Take in real episodes: (N, T+1, n_x), (N, T, n_u), (N, n_goal)."""
        new = zip(EPISODES, (states, actions, goals), strict=True)
        self.episodes = {name: torch.cat([self.episodes[name], part]) for name, part in new}

    def fit(self) -> float:
        """Fit the ensemble to all episodes, and let the environment start from them; returns the loss."""
        states, actions = self.episodes["states"], self.episodes["actions"]
        config = self.config
        self.fits += 1
        loss = self.ensemble.fit(
            states[:, :-1].flatten(0, 1),
            actions.flatten(0, 1),
            states[:, 1:].flatten(0, 1),
            epochs=config.first_epochs if self.fits == 1 else config.epochs,
            minibatch=config.minibatch,
            learning_rate=config.learning_rate,
            generator=torch.Generator().manual_seed(self._key(self.fits)),
            decay=True,
        )
        self.env.remember(states, self.episodes["goals"])
        return loss

    def _key(self, part: int) -> int:
        return int(np.random.SeedSequence((self.seed, _STREAM, part)).generate_state(1)[0])

    def tensors(self) -> dict[str, Tensor]:
        """Everything to go on with, the episodes included."""
        return {**self.episodes, **{f"ensemble.{name}": value for name, value in self.ensemble.state_dict().items()}}

    def restore(self, tensors: Mapping[str, Tensor], fits: int) -> None:
        """Go on from what `tensors` gave after `fits` trainings.

        Raises:
            CheckpointError: it does not fit the settings; nothing is changed.
        """
        own = self.tensors()
        for name in {*own, *tensors}:
            got, wanted = (kinds(part, EPISODES).get(name) for part in (tensors, own))
            if got != wanted:
                raise CheckpointError(
                    f"checkpoint: expected {name} of shape and type {wanted}, got {got}; was it written with other "
                    f"settings?"
                )
        check_episodes({name: tensors[name] for name in EPISODES}, empty=True)
        self.episodes = {name: tensors[name] for name in EPISODES}
        self.ensemble.load_state_dict({k.removeprefix("ensemble."): v for k, v in tensors.items() if "." in k})
        self.fits = fits
        if len(self):
            self.env.remember(self.episodes["states"], self.episodes["goals"])
