"""Main phase (Algorithm 2): proximal policy optimisation of the MPC's model, or of a network as a reference point.

The parts of PPO are its arguments: the source of episodes (`Source`: the robot, or model rollouts), the estimator of
advantages (`advantages.py`), the loss (`surrogate.py`) and the update rule (`optim/`). `difflcs.rl.make_ppo` makes them
from the settings. Gradients reach the LCS through the MPC layer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor

from difflcs.errors import InvalidInputError
from difflcs.rl.learning.advantages import Advantages, RewardScale
from difflcs.rl.learning.checks import check_learned
from difflcs.rl.learning.critic import Critic, returns
from difflcs.rl.learning.incumbent import Incumbent
from difflcs.rl.learning.model_rollouts import ModelRollouts
from difflcs.rl.learning.optim import UpdateRule
from difflcs.rl.learning.state_tree import State
from difflcs.rl.learning.surrogate import Surrogate, gaussian_kl, trimmed_mean
from difflcs.rl.learning.trainer import AfterStep, Trainer
from difflcs.rl.rollout import CONTEXT, collect, elapsed_fractions
from difflcs.rl.seeding import Stream, episode_seeds, numbers, seeded
from difflcs.rl.tasks import Features, compute_features

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv
    from tensordict import TensorDict, TensorDictBase

    from difflcs.rl.learning.policy import GaussianPolicy


@dataclass(frozen=True)
class PPOReport:
    """Report of one iteration.

    Attributes:
        iteration: its number, those of a warm-up included.
        env_steps: environment steps collected so far.
        success: share of its episodes that ended at the goal, under the policy's noise.
        mean_return: mean undiscounted return of its episodes.
        kl: KL divergence before the last step.
        learning_rate: step size in it: the length of a natural step, or Adam's.
        std: mean standard deviation of the policy that collected [units of the action].
        gradient_steps: gradient steps made.
        skipped_steps: steps left out because a gradient was not finite.
        clip_fraction: share of samples outside the clipping range, before the last step.
        outliers: share of samples left out as outliers, before the last step.
        explained_variance: of the returns by the value network, before it saw them.
        solver_failures: MPC solves that did not converge, while collecting and while learning.
        unstable: episodes dropped because the simulation broke down.
        model_success: share of its last model rollouts that ended at the goal; None without any.
        model_loss: error of the ensemble that they were played in, in the last pass of its training.
        physics_seconds: wall time of the environment.
        solve_seconds: wall time of the MPC.
        gradient_seconds: wall time of gradients and steps.
        value_seconds: wall time of advantages and value network.
        model_seconds: wall time of all model rollouts: the ensemble's training, episodes, solves, gradients.
        accepted: 1 if what is handed out follows its policy, 0 if it stays, see `Incumbent`.
    """

    iteration: int
    env_steps: int
    success: float
    mean_return: float
    kl: float
    learning_rate: float
    std: float
    gradient_steps: int
    skipped_steps: int
    clip_fraction: float
    outliers: float
    explained_variance: float
    solver_failures: int
    unstable: int
    model_success: float | None
    model_loss: float | None
    physics_seconds: float
    solve_seconds: float
    gradient_seconds: float
    value_seconds: float
    model_seconds: float
    accepted: int


_HELD_OUT = 300
"""States on which a trust region bounds what is handed out."""

# --- the parts --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Source:
    """A source of episodes, and the amount of learning from one iteration of them.

    Attributes:
        env: environments in lockstep: the robot's, or those that networks play.
        advantages: judges the actions of its episodes.
        steps: gradient steps.
        minibatch: samples per step; None: all.
        value_epochs: epochs of the value network.
    """

    env: VectorEnv
    advantages: Advantages
    steps: int
    minibatch: int | None
    value_epochs: int


# --- the trainer ------------------------------------------------------------------------------------------------------


class PPO(Trainer):
    """The main phase, see `Trainer`; `make_ppo` builds one.

    Args:
        actor: the policy, from `difflcs.rl.make_actor`; its model is trained in place: an `LCSModel`, any other
            `LCSModule` that is a `torch.nn.Module`, or a network. An MPC in it needs on_failure="mask".
        robot: the real episodes.
        critic: the value network.
        surrogate: the loss.
        update: the rule that moves the policy.
        scale: rewards to learn from.
        seed, features, total_episodes, episode_steps, first_episode, first_iteration: see `make_ppo`.
        rollouts: episodes per iteration.
        max_kl: KL divergence at which an iteration ends early.
        final_step: factor on all steps, falling linearly from 1 to this.
        models: plays episodes in networks, besides the robot's own; None: real episodes alone, as in the paper.
        practice: source of model rollouts, if there are models.
        incumbent: holds the model to hand out, in place of the actor's.

    Raises:
        InvalidInputError: an argument does not fit.
    """

    def __init__(
        self,
        actor: GaussianPolicy,
        robot: Source,
        critic: Critic,
        surrogate: Surrogate,
        update: UpdateRule,
        scale: RewardScale,
        seed: int,
        *,
        features: Features,
        rollouts: int,
        total_episodes: int,
        episode_steps: int = 20,
        first_episode: int = 0,
        first_iteration: int = 0,
        max_kl: float = 0.3,
        final_step: float = 0.3,
        models: ModelRollouts | None = None,
        practice: Source | None = None,
        incumbent: Incumbent | None = None,
    ):
        learned = check_learned(actor.learned, robot.env)
        if total_episodes <= first_episode:
            raise InvalidInputError(
                f"total_episodes: expected more than the {first_episode} collected before, got {total_episodes}; "
                f"train for more minutes or shorten the warm-up"
            )
        remaining = total_episodes - first_episode
        if robot.env.num_envs < min(rollouts, remaining):
            raise InvalidInputError(f"env: expected at least {rollouts} environments, got {robot.env.num_envs}")
        best = (learned, actor.controller) if incumbent is None else (incumbent.learned, incumbent.actor.controller)
        super().__init__(*best, seed, episode_steps)
        self.actor, self.robot, self.critic, self.surrogate, self.update = actor, robot, critic, surrogate, update
        self.scale, self.features, self.max_kl, self.final_step = scale, features, max_kl, final_step
        self.models, self.practice, self.incumbent = models, practice, incumbent
        self.first_episode, self.first_iteration = first_episode, first_iteration
        self.episodes, self.iteration = first_episode, first_iteration
        # As many iterations as `rollouts` asks for, all of the same size up to one episode.
        count = math.ceil(remaining / rollouts)
        self.sizes = [remaining // count + (k < remaining % count) for k in range(count)]
        """Episodes of each iteration."""

    @property
    def done(self) -> bool:
        """True if all episodes are collected."""
        return self.iteration - self.first_iteration >= len(self.sizes)

    def remember(self, episodes: TensorDict) -> None:
        """Add earlier real episodes, such as those of a warm-up, to the data of the model rollouts."""
        if self.models is not None:
            self.models.add(episodes)

    def step(self, after_step: AfterStep | None = None) -> PPOReport:
        """One iteration: collect, estimate advantages, improve the policy, fit the value network.

        Iterations on model rollouts come first, if there are models with real episodes. More of them follow the last
        real episodes where the settings say so. The robot does not try what they teach, so it is handed out only after
        a policy that was accepted, where the start need not be kept, and as far as the trust region reaches.

        Raises:
            InvalidInputError: rewards that are not finite, or no episode with a stable simulation.
        """
        done = self.iteration - self.first_iteration
        if self.done:
            raise InvalidInputError(f"step: expected at most {len(self.sizes)} iterations, all of them are done")
        progress = sum(self.sizes[:done]) / sum(self.sizes)
        scale = 1 - (1 - self.final_step) * progress
        start = time.perf_counter()
        model_success, model_loss = self._train_on_models(scale)
        model_seconds = time.perf_counter() - start

        if self.incumbent is not None:
            self.incumbent.begin()
        count = self.sizes[done]
        seeds = episode_seeds(self.seed, Stream.TRAINING, self.episodes, count)
        self.episodes += count
        std, step_size = float(self.actor.std.mean()), self.update.size.value
        real_scale = scale if self.models is None else self.models.settings.real_step * scale
        outcome = self._iterate(self.robot, seeds, (), real_scale, after_step)
        episodes = outcome.episodes
        held_out = self._held_out(episodes)
        if self.models is not None:
            self.update.size.value = step_size  # it follows the model rollouts alone
            self.models.add(episodes)
        kept = self.incumbent
        accepted = kept is None or kept.challenge(outcome.starts, outcome.returns, self.critic.values, held_out)
        self.iteration += 1
        if self.done and self.models is not None:
            start = time.perf_counter()
            for k in range(self.models.settings.last):
                model_success, model_loss = self._train_on_models(scale, 1 + k * self.models.settings.iterations)
            if kept is not None and accepted and not kept.keeps_start:
                kept.follow(kept.learner.state_dict(), held_out)
            model_seconds += time.perf_counter() - start
        return PPOReport(
            iteration=self.iteration,
            env_steps=self.env_steps,
            success=float(episodes["success"].double().mean()),
            mean_return=float(outcome.returns.mean()) / self.scale.factor,
            learning_rate=step_size,
            std=std,
            unstable=int((~episodes["stable"]).sum()),
            model_success=model_success,
            model_loss=model_loss,
            model_seconds=model_seconds,
            accepted=int(accepted),
            **outcome.report,
        )

    def _held_out(self, newest: TensorDict) -> TensorDict:
        """(N,) what the policy sees inside the episodes of a warm-up, of which no step is computed; else the newest."""
        from tensordict import TensorDict

        earlier = [] if self.models is None else self.models.episodes[: self.first_episode]
        seen = _observed(cast("TensorDict", earlier if len(earlier) else newest[newest["stable"]]))
        inside = {name: value[:, 1:].flatten(0, 1) for name, value in seen.items()}  # models start at the first states
        chosen = torch.linspace(0, len(inside["state"]) - 1, _HELD_OUT).long().unique()
        return TensorDict({name: value[chosen] for name, value in inside.items()}, [len(chosen)])

    def _train_on_models(self, scale: float, first: int = 1) -> tuple[float | None, float | None]:
        """Run the iterations on model rollouts; return the success of the last ones and the loss of the ensemble.

        Iterations are numbered from `first`. Both are None if there are no models, or no real episodes in them yet.
        """
        models = self.models
        kept = self.incumbent
        unknown = kept is not None and kept.keeps_start and not kept.episodes
        if unknown or models is None or self.practice is None or not (len(models) and models.settings.iterations):
            return None, None
        settings = models.settings
        loss, success = models.fit(), 0.0
        for k in range(first, first + settings.iterations):
            seeds = numbers(settings.rollouts, self.seed, Stream.MODEL_ROLLOUT, self.iteration, k)
            episodes = self._iterate(self.practice, seeds, (k,), scale).episodes
            success = float(episodes["success"].double().mean())
        return success, loss

    def _iterate(
        self, source: Source, seeds: list[int], part: tuple[int, ...], scale: float, after_step: AfterStep | None = None
    ) -> _Outcome:
        """Collect an episode for each seed, judge the actions, improve the policy, fit the value network.

        `scale` is the factor on the gradient steps. `part` is () for the robot's episodes and k = 1, 2, … in the
        iterations on model rollouts before them: it tells their random numbers apart.
        """

        def key(stream: Stream) -> tuple[int, ...]:
            return (self.seed, stream, self.iteration, *part)

        episodes, physics_seconds, solve_seconds = self._collect(source.env, seeds, key(Stream.NOISE), after_step)
        stable = cast("TensorDict", episodes[episodes["stable"]])
        rewards = self.scale(stable["reward"], stable["success"])
        start = time.perf_counter()
        inputs, sums = _inputs(self.features, stable), returns(rewards, self.critic.gamma)
        self.critic.begin(inputs, rewards, key(Stream.VALUE))
        estimate = source.advantages(stable, inputs, rewards, key(Stream.LOSS))
        unexplained = (sums - estimate.values).var() / sums.var().clamp_min(1e-12)
        value_seconds = time.perf_counter() - start
        improvement = self._improve(source, stable, estimate.samples, scale, key(Stream.LOSS))
        start = time.perf_counter()
        self.critic.learn(inputs, estimate.rewards, key(Stream.VALUE), source.value_epochs)
        value_seconds += time.perf_counter() - start
        improvement.solver_failures += int(episodes["failures"].sum())
        improvement.solve_seconds += solve_seconds
        report = {"explained_variance": 1 - float(unexplained), **vars(improvement)}
        report |= {"physics_seconds": physics_seconds, "value_seconds": value_seconds}
        return _Outcome(episodes, inputs[:, 0], rewards.sum(1), report)

    def _collect(
        self, env: VectorEnv, seeds: list[int], key: Sequence[int], after_step: AfterStep | None
    ) -> tuple[TensorDict, float, float]:
        """Collect episodes with the policy's samples under "policy" (N, T), and the seconds of physics and solver."""
        from tensordict import TensorDict

        elapsed = elapsed_fractions(self.episode_steps)
        seen: list[TensorDict] = []
        solve_seconds = 0.0

        def act(state: Tensor, goal: Tensor, context: Tensor | None = None) -> tuple[np.ndarray, np.ndarray]:
            nonlocal solve_seconds
            begun = time.perf_counter()
            now = elapsed[len(seen)].repeat(len(state))
            step = TensorDict({"state": state.clone(), "goal": goal.clone(), "elapsed": now}, [len(state)])
            if context is not None:
                step[CONTEXT] = context.clone()
            self.actor.act(step)  # cold: as in evaluation
            seen.append(step)
            solve_seconds += time.perf_counter() - begun
            return np.asarray(step["action"]), _failed(step).numpy()

        start = time.perf_counter()
        report = None if after_step is None else lambda: after_step(len(seeds))
        with seeded(key):
            episodes = collect(env, act, seeds, self.episode_steps, report, self.policy)
        seconds = time.perf_counter() - start
        if not bool(episodes["stable"].any()):
            raise InvalidInputError("env: expected a stable simulation, got NaN or a physics error in every episode")
        episodes["policy"] = TensorDict.maybe_dense_stack(seen, 1)
        return episodes, seconds - solve_seconds, solve_seconds

    def _improve(
        self, source: Source, episodes: TensorDict, samples: TensorDict, scale: float, key: Sequence[int]
    ) -> _Improvement:
        """Take gradient steps on the combined loss (Eq. 7 of the paper), until the KL divergence is used up."""
        outcome = _Improvement()
        data = _step_data(self.actor, episodes["policy"].flatten(0, 1))
        samples = cast("TensorDict", samples.flatten(0, 1))
        advantage = samples["advantage"]
        samples["advantage"] = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
        rng = np.random.default_rng(key)
        start = time.perf_counter()
        self.update.measure(data, rng)
        outcome.gradient_seconds += time.perf_counter() - start
        for chosen in _batches(len(data), source.steps, source.minibatch, rng):
            start = time.perf_counter()
            old = cast("TensorDict", data[chosen])
            asked = old.select(*self.actor.in_keys, "guess", CONTEXT, strict=False)
            new = cast("TensorDict", self.actor.solve(asked))
            if "plan" in new.keys():
                data["guess"][chosen] = new["plan"]
            outcome.solver_failures += int(_failed(new).sum())
            solved = time.perf_counter()
            outcome.solve_seconds += solved - start

            kl = gaussian_kl(old, new)
            outcome.kl = trimmed_mean(kl)
            if not outcome.kl <= self.max_kl and outcome.gradient_steps:
                break
            loss = self.surrogate(new, old, kl, cast("TensorDict", samples[chosen]), episodes, rng)
            outcome.outliers, outcome.clip_fraction = self.surrogate.outliers, self.surrogate.clip_fraction
            if self.update.step(loss, scale):
                outcome.gradient_steps += 1
            else:
                outcome.skipped_steps += 1
            outcome.gradient_seconds += time.perf_counter() - solved
        self.update.size.adapt(outcome.kl / scale**2)
        return outcome

    # --- state ---

    def state_dict(self) -> dict[str, Any]:
        """See `Trainer`."""
        kept = {} if self.incumbent is None else {"incumbent": self.incumbent.state_dict()}
        return {
            **super().state_dict(),
            **kept,
            "settings": {"first_episode": self.first_episode, "first_iteration": self.first_iteration},
            "covariance": {"log_std": self.actor.gaussian.log_std, "mixing": self.actor.gaussian.mixing},
            "critic": self.critic.state_dict(),
            "update": self.update.state_dict(),
            "models": None if self.models is None else self.models.state_dict(),
        }

    def load_state_dict(self, state: State) -> None:
        """See `Trainer`."""
        super().load_state_dict(state)
        with torch.no_grad():
            for name, value in state["covariance"].items():
                getattr(self.actor.gaussian, name).copy_(value)
        self.critic.load_state_dict(state["critic"])
        self.update.load_state_dict(state["update"])
        if self.models is not None:
            self.models.load_state_dict(state["models"])
        if self.incumbent is not None:
            self.incumbent.load_state_dict(state["incumbent"])


@dataclass
class _Improvement:
    """Result of the gradient steps of one iteration, as in `PPOReport`."""

    kl: float = 0.0
    gradient_steps: int = 0
    skipped_steps: int = 0
    clip_fraction: float = 0.0
    outliers: float = 0.0
    solver_failures: int = 0
    solve_seconds: float = 0.0
    gradient_seconds: float = 0.0


@dataclass
class _Outcome:
    """Result of one iteration, on the robot or on model rollouts; `report` has fields of a `PPOReport`."""

    episodes: TensorDict
    starts: Tensor
    returns: Tensor
    report: dict[str, Any]


def _observed(episodes: TensorDict) -> dict[str, Tensor]:
    """(N, T+1, ...) what the policy sees at each state of episodes, by its keys."""
    shape = episodes["state"].shape[:-1]
    seen = {"state": episodes["state"], "elapsed": elapsed_fractions(shape[1] - 1).expand(shape)}
    constant = (name for name in ("goal", CONTEXT) if name in episodes.keys())
    return seen | {name: episodes[name].unsqueeze(1).expand(*shape, -1) for name in constant}


def _inputs(features: Features, episodes: TensorDict) -> Tensor:
    """(N, T+1, n) inputs of the value network."""
    seen = _observed(episodes)
    return compute_features(features, seen["state"], seen["goal"], seen["elapsed"], seen.get(CONTEXT))


def _step_data(actor: GaussianPolicy, policy: Any) -> TensorDict:
    """Return only what a gradient step needs: to index all that the policy wrote would cost as much as the loss."""
    data = policy.select(*actor.in_keys, CONTEXT, "action", "loc", "scale_tril", strict=False)
    if "plan" in policy.keys():
        data["guess"] = policy["plan"].clone()  # the rollout's own optimum, then each step's
    return data


def _batches(samples: int, steps: int, size: int | None, rng: np.random.Generator) -> Iterator[Tensor]:
    """The samples of each gradient step."""
    while steps > 0:
        order = torch.arange(samples) if size is None else torch.from_numpy(rng.permutation(samples))
        parts = order.split(size or samples)[:steps]
        steps -= len(parts)
        yield from parts


def _failed(data: TensorDictBase) -> Tensor:
    """(N,) bool: the solve did not converge; a network has none."""
    none = torch.zeros(data.batch_size, dtype=torch.bool)
    return ~data["converged"].squeeze(-1) if "converged" in data.keys() else none
