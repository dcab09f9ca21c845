"""Baseline PDDM (Nagabandi et al., "Deep dynamics models for learning dexterous manipulation", 2020).

An ensemble of networks learns the change of the state, and a planner that samples smooth action sequences and weights
them by their rewards acts through it. The planner's objective is that of the LCS-MPC, so that the two differ in the
model and in the search.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from difflcs._checks import check_positive_int
from difflcs.cost import CostModule, GoalCost, cost_at
from difflcs.errors import InvalidInputError
from difflcs.rl import rollout
from difflcs.rl.learning.dynamics import Ensemble, EnsembleSettings
from difflcs.rl.learning.trainer import AfterStep, EpisodesReport, EpisodeTrainer
from difflcs.rl.seeding import Stream, generator, number
from difflcs.rl.settings import Epochs, Rollouts, Settings, bounded, group

NOISE = 0.9
"""Standard deviation of ε, the noise of the sampled actions, as a fraction of the action bounds' half range: that of
the authors for every dexterous task."""


@dataclass(frozen=True)
class PDDMSettings(Settings):
    """Settings of PDDM: its authors' for dexterous tasks, but that the networks are kept."""

    rollouts: Rollouts = group(Rollouts, first=20, each=20)
    """Episodes per iteration."""
    ensemble: EnsembleSettings = group(
        EnsembleSettings, networks=3, width=250, epochs=Epochs(first=40, each=40, minibatch=512), learning_rate=1e-3
    )
    """Settings of the networks."""
    horizon: int = bounded(7, minimum=1, maximum=1000)
    """Steps the planner looks ahead."""
    samples: int = bounded(700, minimum=1, maximum=10**6)
    """Action sequences it tries per step."""
    kappa: float = bounded(10.0, above=0)
    """Sharpness of the weights exp(kappa · (return − best return)) [1 / cost unit]."""
    filter: float = bounded(0.6, above=0, maximum=1)
    """Weight of new noise in the filter over time, n_t = filter·ε_t + (1 − filter)·n_{t−1}."""
    keep_networks: bool = True
    """Train the networks on from one iteration to the next. Its authors draw them anew for each iteration, which makes
    them worse where data are few."""


class Planner:
    """Filtered, reward-weighted sampling of action sequences. It remembers its plan: call `begin` at every reset.

    Args:
        ensemble: the model.
        cost: objective, as of the LCS-MPC.
        settings: settings.
        u_min: (n_u,) lower bounds of the action.
        u_max: (n_u,) upper bounds.
    """

    def __init__(
        self, ensemble: Ensemble, cost: GoalCost | CostModule, settings: PDDMSettings, u_min: Tensor, u_max: Tensor
    ):
        self.ensemble, self.cost, self.settings = ensemble, cost, settings
        self.u_min, self.u_max = u_min, u_max
        self.begin()

    def begin(self, seed: int = 0) -> None:
        """Forget the last plan and restart the noise: the same episodes give the same actions."""
        self._mean: Tensor | None = None
        self._generator = torch.Generator().manual_seed(seed)

    def __call__(
        self,
        x0: Tensor,
        goal: Tensor,
        *,
        u_min: Tensor | None = None,
        u_max: Tensor | None = None,
        context: Tensor | None = None,
    ) -> rollout.PolicyOutput:
        """Plan from states (B, n_x) to goals (B, n_goal); the batch must not change between two `begin`."""
        bounds = (self.u_min if u_min is None else u_min), (self.u_max if u_max is None else u_max)
        low, high = (bound.float() for bound in bounds)
        batch, n_u, horizon = len(x0), len(low), self.settings.horizon
        x0 = rollout.append_context(x0, context)
        mean = torch.zeros(batch, horizon, n_u) if self._mean is None else self._mean
        if len(mean) != batch:
            raise InvalidInputError(f"x0: expected {len(mean)} states as before, got {batch}; call begin() at a reset")
        with torch.no_grad():
            planned = torch.stack([self._improve(*one, low, high) for one in zip(x0, goal, mean, strict=True)])
        # The plan one step later, its last step repeated.
        self._mean = torch.cat([planned[:, 1:], planned[:, -1:]], 1)
        # A mean of single precision may leave the bounds by its rounding: 0.1 by up to 1e-8.
        return rollout.PolicyOutput(planned[:, 0].double().clamp(*bounds), torch.ones(batch, dtype=torch.bool))

    def _improve(self, x0: Tensor, goal: Tensor, mean: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """The next plan (horizon, n_u) of one episode. One at a time: 700 sequences fill the cache."""
        settings = self.settings
        draw = torch.randn(settings.samples, settings.horizon, len(low), generator=self._generator)
        draw *= NOISE * 0.5 * (high - low)
        noise, filtered = torch.zeros(settings.samples, len(low)), []
        for step in draw.unbind(1):
            noise = settings.filter * step + (1 - settings.filter) * noise
            filtered.append(noise)
        actions = torch.minimum(torch.maximum(mean + torch.stack(filtered, 1), low), high)
        score = -self._costs(x0, goal, actions)
        weight = torch.softmax(settings.kappa * score, 0)
        return (weight[:, None, None] * actions).sum(0)

    def _costs(self, x0: Tensor, goal: Tensor, actions: Tensor) -> Tensor:
        """(samples,) cost of action sequences, averaged over the ensemble; infinite where a prediction overflows."""
        found = self.cost(goal) if isinstance(self.cost, GoalCost) else cost_at(self.cost, x0, goal)
        cost = {name: value.float() for name, value in found.fields().items()}
        x = self.ensemble.rollout(x0.float(), actions)[..., : found.n_x]  # (networks, samples, horizon + 1, n_x)
        stages = _quadratic(x[..., :-1, :], cost["Q"], cost["q"]) + _quadratic(actions, cost["R"], cost["r"])
        total = stages.sum(-1) + _quadratic(x[..., -1, :], cost["Q_final"], cost["q_final"])
        return total.mean(0).nan_to_num(nan=3e38, posinf=3e38).clamp_max(1e30)


def _quadratic(v: Tensor, matrix: Tensor, vector: Tensor) -> Tensor:
    return (v * (0.5 * (v @ matrix) + vector)).sum(-1)


class PDDM(EpisodeTrainer):
    """Trainer of the PDDM baseline, see `Trainer`.

    Args:
        cost: the planner's objective.
        env: environments in lockstep, as many as episodes of one iteration.
        settings: settings.
        seed: of everything random.
        total_episodes: episodes of the whole training; the last iteration collects no more.
        episode_steps: steps of one episode.
    """

    def __init__(
        self,
        cost: Any,
        env: VectorEnv,
        settings: PDDMSettings,
        seed: int,
        *,
        total_episodes: int,
        episode_steps: int = 20,
    ):
        total_episodes = check_positive_int("total_episodes", total_episodes)
        needed = min(max(settings.rollouts.first, settings.rollouts.each), total_episodes)
        sizes = (settings.ensemble.networks, settings.ensemble.width)
        seed = check_positive_int("seed", seed, minimum=0)
        space: Any = env.single_observation_space
        n_seen = cost.n_x + (space[rollout.CONTEXT].shape[0] if rollout.has_context(env) else 0)
        self.ensemble = Ensemble(n_seen, cost.n_u, *sizes, generator(seed, Stream.FIT, 0, 0))
        planner = Planner(self.ensemble, cost, settings, *rollout.action_bounds(env))
        super().__init__(self.ensemble, planner, seed, episode_steps, env, needed)
        self.settings, self.total_episodes = settings, total_episodes

    def step(self, after_step: AfterStep | None = None) -> EpisodesReport:
        """One iteration: collect, then fit the ensemble to all data."""
        settings, first = self.settings, self.iteration == 0
        wanted = settings.rollouts.first if first else settings.rollouts.each
        count = min(wanted, self.total_episodes - self.episodes)
        if count < 1:
            raise InvalidInputError(f"step: expected at most {self.total_episodes} episodes, all of them are done")
        if first:
            act = rollout.uniform_actions(self.env, np.random.default_rng((self.seed, Stream.ACTION)))
        else:
            act = rollout.mpc_actions(self.policy, seed=number(self.seed, Stream.PLAN, self.iteration, 0))
        self.collect(act, count, after_step)
        if not settings.keep_networks:
            self.ensemble.draw(generator(self.seed, Stream.FIT, self.iteration, 0))
        loss = self.ensemble.fit(
            *rollout.observed_transitions(self.buffer),
            epochs=settings.ensemble.epochs.first if first else settings.ensemble.epochs.each,
            minibatch=settings.ensemble.epochs.minibatch,
            learning_rate=settings.ensemble.learning_rate,
            generator=generator(self.seed, Stream.FIT, self.iteration, 1),
        )
        return self.report(EpisodesReport, loss)
