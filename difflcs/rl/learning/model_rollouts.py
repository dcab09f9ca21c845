"""Model rollouts: PPO's data in an ensemble of networks fitted to the real episodes (model-ensemble policy search).

Kurutach et al., "Model-ensemble trust-region policy optimization", 2018. The networks are used in training only:
afterwards the LCS and its MPC act alone. Episodes played in the networks do not count as data of the robot; they cost
computing time instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from difflcs._checks import check_positive_int, describe
from difflcs.errors import DiffLCSWarning, InvalidInputError, warn
from difflcs.rl.learning.dynamics import Ensemble, EnsembleSettings
from difflcs.rl.learning.state_tree import State
from difflcs.rl.rollout import (
    CONTEXT,
    append_context,
    append_episodes,
    episodes_from_state,
    episodes_to_state,
    make_empty_record,
    observed_transitions,
    transitions,
)
from difflcs.rl.seeding import Stream, generator
from difflcs.rl.settings import MOST_ENVS, Settings, bounded, group
from difflcs.rl.tasks import Outcome

if TYPE_CHECKING:
    from tensordict import TensorDict


@dataclass(frozen=True)
class ModelRolloutSettings(Settings):
    """Settings of the model rollouts; all ours, tuned on the cube."""

    iterations: int = bounded(5, minimum=0)
    """Iterations of PPO on model rollouts before each one on real episodes; 0: none, as in the paper."""
    last: int = bounded(0, minimum=0)
    """How many times as many follow the last real episodes, so that these teach too; for trainings of few minutes."""
    rollouts: int = bounded(120, minimum=1, maximum=MOST_ENVS)
    """Model rollouts per iteration."""
    steps: int = bounded(12, minimum=1)
    """Gradient steps per iteration on model rollouts."""
    value_epochs: int = bounded(10, minimum=1)
    """Epochs of the value network at the end of such an iteration."""
    actions: int = bounded(8, minimum=1, maximum=MOST_ENVS)
    """Actions that the networks judge in each state, an even number; 1: only the one that is taken, by GAE."""
    real_step: float = bounded(0.3, above=0)
    """Factor on the gradient steps on real episodes where there are model rollouts: their gradient is noisier."""
    ensemble: EnsembleSettings = group(EnsembleSettings)
    """Settings of the networks; every step is predicted by one of them, drawn at random."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.actions > 1 and self.actions % 2:
            raise InvalidInputError(f"actions: expected 1 or an even number, got {self.actions}")


class ModelEnv(VectorEnv):
    """Episodes predicted by an ensemble, in lockstep: start and goal are those of real episodes, not of the same one.

    A prediction is kept within the range of the real states, widened by its width on either side. An episode depends on
    its seed only, as that of a real environment.

    Args:
        ensemble: predicts the next state, of the state with its context behind it where there is one.
        outcome: reward and success of a transition, the task's own.
        num_envs: episodes side by side.
        episode_steps: steps of one episode.
        observation_space: Dict(state, goal), or Dict(state, goal, context), of one real environment.
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
        self._contexts: Tensor | None = None
        self._context: Tensor | None = None
        self._rng = np.random.default_rng(0)

    def set_episodes(self, states: Tensor, goals: Tensor, contexts: Tensor | None = None) -> None:
        """Replace the episodes from which starts, goals and the range of states are taken.

        Args:
            states: (N, T+1, n_x) of real episodes.
            goals: (N, n_goal).
            contexts: (N, n_context) where there are any; an episode has that of its start.
        """
        self._starts, self._goals, self._contexts = states[:, 0], goals, contexts
        low, high = states.flatten(0, 1).amin(0), states.flatten(0, 1).amax(0)
        self._low, self._high = low - (high - low), high + (high - low)

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: Any = None):
        """Begin an episode everywhere.

        Args:
            seed: one for each episode; a number is that of the first, and the others follow it.
            options: ignored.

        Returns:
            Observations and an empty info.

        Raises:
            InvalidInputError: `set_episodes` has not been called yet.
        """
        if not len(self._starts):
            raise InvalidInputError("model rollouts: expected real episodes, got none; call set_episodes() first")
        if seed is None or isinstance(seed, int):
            first = int(self._rng.integers(2**31)) if seed is None else seed
            seed = range(first, first + self.num_envs)
        generators = [np.random.default_rng(one) for one in seed]
        starts = [int(rng.integers(len(self._starts))) for rng in generators]
        goals = [int(rng.integers(len(self._goals))) for rng in generators]
        choices = [rng.integers(self.ensemble.networks, size=self.episode_steps) for rng in generators]
        self._networks = torch.from_numpy(np.stack(choices, 1))
        self._state, self._goal, self._step = self._starts[starts], self._goals[goals], 0
        self._context = None if self._contexts is None else self._contexts[starts]
        return self._observe(), {}

    def step(self, actions: np.ndarray):
        """Predict one step; the step after the last one begins new episodes, whatever the actions.

        Returns:
            Observations, rewards, terminations (all False), truncations, info with `success`.
        """
        nothing = np.zeros(self.num_envs, bool)
        if self._step == self.episode_steps:
            observation, _ = self.reset()
            return observation, np.zeros(self.num_envs), nothing, nothing.copy(), {"success": nothing.copy()}
        u = torch.from_numpy(np.asarray(actions, np.float64))
        after = self._predict(self._state, u, self._networks[self._step], self._context)
        ended = np.full(self.num_envs, self._step + 1 == self.episode_steps)
        reward, success = self.judge(self._state, u, after, self._goal, torch.from_numpy(ended))
        self._state, self._step = after, self._step + 1
        return self._observe(), reward.numpy(), nothing, ended, {"success": success.numpy()}

    def predict_alternatives(self, states: Tensor, actions: Tensor, goals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Predict the outcome of other actions in the episodes just played, by the networks that played them.

        Args:
            states: (num_envs, T, n_x) of the episodes, without the last ones.
            actions: (num_envs, T, M, n_u) executed instead.
            goals: (num_envs, n_goal).

        Returns:
            Next states (num_envs, T, M, n_x), rewards and successes (num_envs, T, M).
        """
        shape = actions.shape[:-1]
        before, goals = (v.expand(*shape, -1).flatten(0, 2) for v in (states.unsqueeze(2), goals[:, None, None]))
        context = self._context
        if context is not None:
            context = context[:, None, None].expand(*shape, -1).flatten(0, 2)
        actions, networks = actions.flatten(0, 2), self._networks.T.unsqueeze(2).expand(shape).flatten()
        ended = (torch.arange(1, shape[1] + 1) == self.episode_steps).view(1, -1, 1).expand(shape).flatten()
        after = self._predict(before, actions, networks, context)
        reward, success = self.judge(before, actions, after, goals, ended)
        return after.view(*shape, -1), reward.view(shape), success.view(shape)

    def judge(self, *transitions: Tensor) -> tuple[Tensor, Tensor]:
        """Return rewards (B,) and successes (B,) of transitions, by the outcome of the task.

        Raises:
            InvalidInputError: it gives something else.
        """
        found: Any = self.outcome(*transitions)  # pyright: ignore[reportCallIssue]
        if not isinstance(found, tuple) or [getattr(v, "shape", None) for v in found] != [transitions[0].shape[:1]] * 2:
            n, got = len(transitions[0]), describe(found)
            raise InvalidInputError(f"outcome: expected rewards and successes ({n},), got {got}; mend TaskSpec.outcome")
        return found

    def _predict(self, states: Tensor, actions: Tensor, networks: Tensor, context: Tensor | None) -> Tensor:
        """States (B, n_x), actions (B, n_u), numbers of networks (B,), contexts → next states (B, n_x) in range."""
        inputs = append_context(states, context)
        rows = [(networks == k).nonzero().squeeze(1) for k in range(self.ensemble.networks)]
        padded = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)  # every network, as many rows
        with torch.no_grad():
            outputs = self.ensemble(inputs[padded].float(), actions[padded].float())[..., : states.shape[-1]]
        predicted = torch.empty_like(states)
        for row, part in zip(rows, outputs, strict=True):
            predicted[row] = part[: len(row)].double()
        predicted = torch.where(predicted.isfinite(), predicted, states)
        return torch.minimum(torch.maximum(predicted, self._low), self._high)

    def _observe(self) -> dict[str, np.ndarray]:
        seen = {"state": self._state, "goal": self._goal}
        if self._context is not None:
            seen[CONTEXT] = self._context
        return {name: value.numpy().copy() for name, value in seen.items()}


class ModelRollouts:
    """The real episodes of a training, the ensemble fitted to them, and the environment that plays it.

    Args:
        env: the real environments.
        outcome: reward and success of a transition, the task's own.
        settings: settings.
        seed: of the networks' initial weights and minibatches.
        episode_steps: steps of one episode.
    """

    def __init__(self, env: VectorEnv, outcome: Outcome, settings: ModelRolloutSettings, seed: int, episode_steps: int):
        self.settings, self.seed = settings, check_positive_int("seed", seed, minimum=0)
        self.episodes = make_empty_record(env, episode_steps)
        """Real episodes, a record of `TRANSITIONS`."""
        n_x, n_u = self.episodes["state"].shape[-1], self.episodes["action"].shape[-1]
        sizes = (settings.ensemble.networks, settings.ensemble.width)
        n_context = self.episodes[CONTEXT].shape[-1] if CONTEXT in self.episodes.keys() else 0
        self.ensemble = Ensemble(n_x + n_context, n_u, *sizes, generator(seed, Stream.MODEL, 0))
        spaces = (env.single_observation_space, env.single_action_space)
        self.env = ModelEnv(self.ensemble, outcome, settings.rollouts, episode_steps, *spaces)
        self.fits = 0

    def __len__(self) -> int:
        return len(self.episodes)

    def add(self, episodes: TensorDict) -> None:
        """Add the stable ones among real episodes, a record of `difflcs.rl.collect` or of `TRANSITIONS`."""
        self.episodes = append_episodes(self.episodes, episodes)
        if self.fits < 2 and "reward" in episodes.keys():
            self._compare(episodes[episodes["stable"]])

    def _compare(self, real: Any) -> None:
        """Warn if the outcome is not that of the environment in real episodes: networks would teach another task."""
        steps = real["reward"].shape[1]
        ended = torch.arange(1, steps + 1).repeat(len(real)) == steps
        goals = real["goal"].repeat_interleave(steps, 0)
        reward, success = self.env.judge(*transitions(real), goals, ended)
        off = (reward - real["reward"].flatten()).abs() > 1e-3 * real["reward"].abs().max()
        off[ended] |= success[ended] != real["success"]
        if (share := float(off.double().mean())) > 0.01:
            text = f"outcome: expected what env.step gives, got another reward or success in {share:.0%} of the steps"
            warn(f"{text}; PPO would learn another task: mend TaskSpec.outcome", DiffLCSWarning)

    def fit(self) -> float:
        """Fit the ensemble to all episodes, and let the environment start from them; returns the loss."""
        settings = self.settings.ensemble
        self.fits += 1
        loss = self.ensemble.fit(
            *observed_transitions(self.episodes),
            epochs=settings.epochs.first if self.fits == 1 else settings.epochs.each,
            minibatch=settings.epochs.minibatch,
            learning_rate=settings.learning_rate,
            generator=generator(self.seed, Stream.MODEL, self.fits),
            decay=True,
        )
        self._remember()
        return loss

    def _remember(self) -> None:
        self.env.set_episodes(self.episodes["state"], self.episodes["goal"], self.episodes.get(CONTEXT, None))

    def state_dict(self) -> dict[str, Any]:
        """State to resume from, the episodes included."""
        return {"fits": self.fits, "episodes": episodes_to_state(self.episodes), "ensemble": self.ensemble.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Go on from what `state_dict` gave."""
        self.fits, self.episodes = state["fits"], episodes_from_state(state["episodes"])
        self.ensemble.load_state_dict(state["ensemble"])
        if len(self):
            self._remember()
