"""Baseline PDDM (Nagabandi et al., "Deep dynamics models for learning dexterous manipulation", 2020).

An ensemble of networks learns the change of the state, and a planner that samples smooth action sequences and weights
them by their rewards acts through it. The planner's objective is that of the LCS-MPC, so that the two differ in the
model and in the search.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import MOST_ENVS, MOST_NETWORKS, MOST_WIDTH, check_number, check_positive_int
from difflcs.cost import GoalCost
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl.checkpoint import Checkpoint, check_episodes, kinds
from difflcs.rl.dynamics import Ensemble
from difflcs.rl.rollout import action_bounds, collect, episode_seeds, mpc_actions, uniform_actions
from difflcs.rl.warmup import TRAINING_STREAM

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

_ACTION_STREAM, _FIT_STREAM, _PLAN_STREAM = 3, 7, 8


@dataclass(frozen=True)
class PDDMConfig:
    """Settings of PDDM: its authors' for dexterous tasks, where not marked as ours."""

    networks: int = 3
    """Networks in the ensemble."""
    width: int = 250
    """Width of their two hidden layers."""
    random_rollouts: int = 20
    """Episodes of uniformly random actions before the first training."""
    rollouts_per_iteration: int = 20
    """Episodes per iteration, run in lockstep."""
    epochs: int = 40
    """Passes over all data in each iteration."""
    minibatch: int = 512
    """Transitions per step."""
    learning_rate: float = 1e-3
    """Adam's step size; Adam is reset in each iteration, the networks are not."""
    horizon: int = 7
    """Steps the planner looks ahead."""
    samples: int = 700
    """Action sequences it tries per step."""
    kappa: float = 10.0
    """Sharpness of the weights exp(kappa · (return − best return)) [1 / cost unit]."""
    filter: float = 0.6
    """Weight of new noise in the filter over time, n_t = filter·ε_t + (1 − filter)·n_{t−1}."""
    noise: float = 0.9
    """Standard deviation of ε, as a fraction of the action bounds' half range."""

    def __post_init__(self) -> None:
        for name, most in (("networks", MOST_NETWORKS), ("width", MOST_WIDTH), ("horizon", 1000), ("samples", 10**6)):
            check_positive_int(name, getattr(self, name), maximum=most)
        for name in ("random_rollouts", "rollouts_per_iteration"):
            check_positive_int(name, getattr(self, name), maximum=MOST_ENVS)
        for name in ("epochs", "minibatch"):
            check_positive_int(name, getattr(self, name))
        for name in ("learning_rate", "kappa", "noise", "filter"):
            check_number(name, getattr(self, name), strict=True)
        if self.filter > 1:
            raise InvalidInputError(f"filter: expected 0 < filter <= 1, got {self.filter}")


@dataclass(frozen=True)
class Plan:
    """What the planner returns, for `difflcs.rl.rollout.mpc_actions`.

    Attributes:
        action: (B, n_u) first actions.
        converged: (B,) True: sampling cannot fail.
    """

    action: Tensor
    converged: Tensor


class Planner:
    """Filtered, reward-weighted sampling of action sequences. It remembers its plan: call `begin` at every reset.

    Args:
        ensemble: the model.
        cost: objective, as of the LCS-MPC.
        config: settings.
        u_min: (n_u,) lower bounds [m].
        u_max: (n_u,) upper bounds [m].
    """

    def __init__(self, ensemble: Ensemble, cost: GoalCost, config: PDDMConfig, u_min: Tensor, u_max: Tensor):
        self.ensemble, self.cost, self.config = ensemble, cost, config
        self.u_min, self.u_max = u_min, u_max
        self.begin()

    def begin(self, seed: int = 0) -> None:
        """Forget the last plan and restart the noise: the same episodes give the same actions."""
        self._mean: Tensor | None = None
        self._generator = torch.Generator().manual_seed(seed)

    def __call__(self, x0: Tensor, goal: Tensor, *, u_min: Tensor | None = None, u_max: Tensor | None = None) -> Plan:
        """Plan from states (B, n_x) to goals (B, n_goal); the batch must not change between two `begin`."""
        bounds = (self.u_min if u_min is None else u_min), (self.u_max if u_max is None else u_max)
        low, high = (bound.float() for bound in bounds)
        batch, n_u, horizon = len(x0), len(low), self.config.horizon
        mean = torch.zeros(batch, horizon, n_u) if self._mean is None else self._mean
        if len(mean) != batch:
            raise InvalidInputError(f"x0: expected {len(mean)} states as before, got {batch}; call begin() at a reset")
        with torch.no_grad():
            planned = torch.stack([self._improve(*one, low, high) for one in zip(x0, goal, mean, strict=True)])
        # The plan one step later, its last step repeated.
        self._mean = torch.cat([planned[:, 1:], planned[:, -1:]], 1)
        # A mean of single precision may leave the bounds by its rounding: 0.1 by up to 1e-8.
        return Plan(planned[:, 0].double().clamp(*bounds), torch.ones(batch, dtype=torch.bool))

    def _improve(self, x0: Tensor, goal: Tensor, mean: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """The next plan (horizon, n_u) of one episode. One at a time: 700 sequences fill the cache."""
        config = self.config
        draw = torch.randn(config.samples, config.horizon, len(low), generator=self._generator)
        draw *= config.noise * 0.5 * (high - low)
        noise, filtered = torch.zeros(config.samples, len(low)), []
        for step in draw.unbind(1):
            noise = config.filter * step + (1 - config.filter) * noise
            filtered.append(noise)
        actions = torch.minimum(torch.maximum(mean + torch.stack(filtered, 1), low), high)
        score = -self._costs(x0, goal, actions)
        weight = torch.softmax(config.kappa * score, 0)
        return (weight[:, None, None] * actions).sum(0)

    def _costs(self, x0: Tensor, goal: Tensor, actions: Tensor) -> Tensor:
        """(samples,) cost of action sequences, averaged over the ensemble; infinite where a prediction overflows."""
        cost = {name: value.float() for name, value in self.cost(goal).fields().items()}
        u = actions.expand(self.ensemble.networks, *actions.shape)
        x = x0.float().expand(*u.shape[:2], -1)
        total = torch.zeros(u.shape[:2])
        for k in range(u.shape[2]):
            total += _quadratic(x, cost["Q"], cost["q"]) + _quadratic(u[:, :, k], cost["R"], cost["r"])
            x = self.ensemble(x, u[:, :, k])
        total += _quadratic(x, cost["Q_final"], cost["q_final"])
        return total.mean(0).nan_to_num(nan=3e38, posinf=3e38).clamp_max(1e30)


def _quadratic(v: Tensor, matrix: Tensor, vector: Tensor) -> Tensor:
    return (v * (0.5 * (v @ matrix) + vector)).sum(-1)


@dataclass(frozen=True)
class PDDMIteration:
    """Report of one iteration.

    Attributes:
        iteration: its number, from 1.
        env_steps: environment steps collected so far.
        success: share of its episodes that ended at the goal.
        loss: mean squared error of the standardised changes in the last epoch.
        unstable: episodes dropped because the simulation broke down.
        collect_seconds: wall time of the episodes.
        learn_seconds: wall time of the training.
    """

    iteration: int
    env_steps: int
    success: float
    loss: float
    unstable: int
    collect_seconds: float
    learn_seconds: float


class PDDM:
    """The baseline as an object that can be stopped between iterations, saved, and resumed with the same result.

    Args:
        cost: the planner's objective.
        env: environments in lockstep, as many as episodes of one iteration.
        config: settings.
        seed: of everything random.
        total_episodes: episodes of the whole training; the last iteration collects no more.
        episode_steps: steps of one episode.
    """

    def __init__(
        self,
        cost: GoalCost,
        env: VectorEnv,
        config: PDDMConfig,
        seed: int,
        *,
        total_episodes: int,
        episode_steps: int = 20,
    ):
        check_positive_int("seed", seed, minimum=0)
        check_positive_int("total_episodes", total_episodes)
        needed = min(max(config.random_rollouts, config.rollouts_per_iteration), total_episodes)
        if env.num_envs < needed:
            raise InvalidInputError(f"env: expected at least {needed} environments, got {env.num_envs}")
        self.env, self.config, self.seed = env, config, seed
        self.iteration = 0
        self.episodes = 0
        self.total_episodes, self.episode_steps = total_episodes, episode_steps
        low, high = (torch.from_numpy(bound) for bound in action_bounds(env))
        self.bounds = (low, high)
        generator = torch.Generator().manual_seed(self._key(_FIT_STREAM))
        self.ensemble = Ensemble(cost.n_x, cost.n_u, config.networks, config.width, generator)
        self.policy = Planner(self.ensemble, cost, config, low, high)
        self.states = torch.zeros(0, episode_steps + 1, cost.n_x, dtype=torch.float64)
        self.actions = torch.zeros(0, episode_steps, cost.n_u, dtype=torch.float64)

    @property
    def env_steps(self) -> int:
        """Environment steps collected so far."""
        return self.episodes * self.episode_steps

    def step(self, after_step: Callable[[int], object] | None = None) -> PDDMIteration:
        """One iteration: collect, then fit the ensemble to all data.

        Args:
            after_step: called with the number of episodes stepped, for progress bars.
        """
        config, first = self.config, self.iteration == 0
        count = min(
            config.random_rollouts if first else config.rollouts_per_iteration, self.total_episodes - self.episodes
        )
        if count < 1:
            raise InvalidInputError(f"step: expected at most {self.total_episodes} episodes, all of them are done")
        start = time.perf_counter()
        seeds = episode_seeds(self.seed, TRAINING_STREAM, self.episodes, count)
        if first:
            act = uniform_actions(self.env, np.random.default_rng((self.seed, _ACTION_STREAM)))
        else:
            act = mpc_actions(self.policy, seed=self._key(_PLAN_STREAM))
        report = None if after_step is None else lambda: after_step(count)
        rollouts = collect(self.env, act, seeds, self.episode_steps, report)
        self.episodes += count
        self.states = torch.cat([self.states, rollouts.states[rollouts.stable]])
        self.actions = torch.cat([self.actions, rollouts.actions[rollouts.stable]])
        if not len(self.states):
            raise InvalidInputError("env: expected a stable simulation, got NaN or a physics error in every episode")
        collected = time.perf_counter()
        x, u, x_next = (v.flatten(0, 1) for v in (self.states[:, :-1], self.actions, self.states[:, 1:]))
        generator = torch.Generator().manual_seed(self._key(_FIT_STREAM, 1))
        loss = self.ensemble.fit(
            x,
            u,
            x_next,
            epochs=config.epochs,
            minibatch=config.minibatch,
            learning_rate=config.learning_rate,
            generator=generator,
        )
        self.iteration += 1
        return PDDMIteration(
            iteration=self.iteration,
            env_steps=self.env_steps,
            success=float(rollouts.success.double().mean()),
            loss=loss,
            unstable=int((~rollouts.stable).sum()),
            collect_seconds=collected - start,
            learn_seconds=time.perf_counter() - collected,
        )

    def _key(self, stream: int, part: int = 0) -> int:
        return int(np.random.SeedSequence((self.seed, stream, self.iteration, part)).generate_state(1)[0])

    def checkpoint(self) -> Checkpoint:
        """Everything needed to go on with the same result."""
        tensors = {f"ensemble.{k}": v for k, v in self.ensemble.state_dict().items()}
        tensors |= {"states": self.states, "actions": self.actions, "u_min": self.bounds[0], "u_max": self.bounds[1]}
        return Checkpoint(self.iteration, None, {"episodes": self.episodes}, tensors)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint.

        Raises:
            CheckpointError: it does not fit the settings; nothing is changed.
        """
        batched = ("states", "actions")
        shapes, wanted = (kinds(source.tensors, batched) for source in (checkpoint, self.checkpoint()))
        if shapes != wanted or checkpoint.model is not None:
            different = sorted({k for k in {*shapes, *wanted} if shapes.get(k) != wanted.get(k)})
            raise CheckpointError(
                f"checkpoint: expected an ensemble like this one, got tensors different in {different}; "
                f"was it written with other settings or another method?"
            )
        try:
            episodes = check_positive_int("episodes", checkpoint.state["episodes"], minimum=0)
        except (KeyError, ValueError, TypeError) as error:
            raise CheckpointError(f"checkpoint: its counters cannot be used ({error})") from error
        check_episodes({name: checkpoint.tensors[name] for name in batched}, empty=checkpoint.iteration == 0)
        self.iteration, self.episodes = checkpoint.iteration, episodes
        self.states, self.actions = checkpoint.tensors["states"], checkpoint.tensors["actions"]
        self.ensemble.load_state_dict(ensemble_tensors(checkpoint))


def ensemble_tensors(checkpoint: Checkpoint) -> dict[str, Tensor]:
    """The ensemble's state dict in a checkpoint."""
    prefix = "ensemble."
    return {k.removeprefix(prefix): v for k, v in checkpoint.tensors.items() if k.startswith(prefix)}
