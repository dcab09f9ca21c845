"""Main phase (Algorithm 2): proximal policy optimisation of the MPC's model, or of a network as a reference point.

Episodes of the stochastic policy, advantages by GAE and the clipped objective are TorchRL's; gradients reach the LCS
through the MPC layer. What only a policy with an MPC has stands in one section of `PPO`. Four things are this file's
own, because TorchRL has no counterpart and because they decide whether it learns:

- Steps follow the natural gradient (`difflcs.rl.natural`), measured with the sensitivities of the MPC.
- The step size follows the KL divergence that an iteration has reached (`_adapt`). Large steps make PPO work here: a KL
  of 0.005 per iteration gains little, 0.03 to 0.1 gains 15 points of success.
- Samples whose own KL exceeds `jump_kl` are left out (`_improve`): there the MPC has jumped to another local optimum,
  and the derivative at the new one says nothing about the old one.
- The KL that is watched is a mean without its largest values (`_trimmed_mean`): single jumps reach 17.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call

from difflcs._checks import MOST_ENVS, MOST_WIDTH, check_choice, check_number, check_positive_int
from difflcs.errors import CheckpointError, DegenerateWarning, InvalidInputError, SolveWarning
from difflcs.lcs import LCSModel, LCSParams
from difflcs.losses import violation_loss
from difflcs.rl.checkpoint import Checkpoint, kinds
from difflcs.rl.critic import Critic, initialise_moments, moments, read_history, seeded
from difflcs.rl.imagination import EPISODES, Imagination
from difflcs.rl.lookahead import lookahead_advantages, luck, mirrored_actions
from difflcs.rl.natural import NaturalGradient
from difflcs.rl.rollout import Rollouts, action_bounds, collect, episode_seeds
from difflcs.rl.warmup import TRAINING_STREAM

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv
    from tensordict import TensorDict, TensorDictBase

    from difflcs.rl.policy import GaussianPolicy

_NOISE_STREAM, _VALUE_STREAM, _LOSS_STREAM, _IMAGINED_STREAM = 4, 5, 6, 10
_LCS = "mpc.lcs."
"""Where the LCS is in the actor's module `gaussian`."""
_VALUE, _IMAGINATION = "value.", "imagination."
_NETWORK = "network."
"""Prefix of the learned module's tensors in a checkpoint, where it is not an LCS."""

Features = Callable[[Tensor, Tensor, Tensor], Tensor]
"""States (..., n_x), goals (..., n_goal), elapsed fraction of the episode (...) → value network's inputs (..., n)."""


@dataclass(frozen=True)
class PPOConfig:
    """Settings of the main phase. "paper": given there; the others are ours, tuned on the cube."""

    rollouts: int = 60
    """Episodes per iteration, run in lockstep; the last ones share what is left of the data evenly."""
    steps: int = 8
    """Gradient steps per iteration; Adam needs 20 or more."""
    minibatch: int | None = 600
    """Samples per gradient step, every sample once before any is drawn again; None: each step on all of its data."""
    natural: bool = True
    """Natural gradient of the LCS; False: Adam, as in the training of networks."""
    natural_step: float = 0.06
    """Length of a natural step at the start: the root of twice the KL divergence that it makes."""
    natural_momentum: float = 0.8
    """Weight of the natural gradient so far against the newest one; kept across iterations."""
    natural_damping: float = 0.1
    """Isotropic part of the natural gradient's metric, in means of its diagonal."""
    natural_samples: int = 300
    """Samples per iteration that its metric is measured with."""
    learning_rate: float = 6e-4
    """Adam's step size at the start."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Adam's averaging factors; its moments are kept across iterations."""
    target_kl: float = 0.1
    """KL divergence per iteration: the step size grows below half of it and shrinks above one and a half of it."""
    learning_rate_factor: float = 1.5
    """Factor by which the step size grows or shrinks after an iteration."""
    max_kl: float = 0.3
    """KL divergence at which an iteration ends early."""
    final_step: float = 0.3
    """Factor on all steps, falling linearly from 1 to this over the main phase; 1 turns this off."""
    kl_quantile: float = 0.97
    """Fraction of the samples, those of lowest KL, whose mean is the KL divergence of an iteration."""
    jump_kl: float = 2.0
    """Samples with a KL divergence of their own above this are left out: the MPC has jumped to another optimum."""
    sample_clip: float | None = None
    """Longest gradient that a single sample may have, in medians of those of its batch; longer ones are scaled down.
    None: no limit."""
    clip: float = 0.3
    """Epsilon of the clipped objective (Eq. explicit_ppo_loss)."""
    gamma: float = 0.99
    """Discount per step."""
    zeta: float = 0.8
    """Zeta of the advantages (Eq. adv_func), often called lambda."""
    beta: float = 1.0
    """Weight of the PPO loss against the violation loss (Eq. total_loss). 1 in the paper."""
    violation_batch: int = 300
    """Transitions of the newest episodes per step in the violation loss, where beta < 1."""
    violation_gamma: float = 0.05
    """Gamma of the violation loss, where beta < 1."""
    violation_xi: float = 0.02
    """Xi of the violation loss, where beta < 1."""
    std: float = 0.005
    """Standard deviation [m] of the policy."""
    final_std: float | None = None
    """Standard deviation [m] at the end, approached geometrically; as at the start if None."""
    learn_std: bool = False
    """Learn the covariance of the policy together with the model."""
    covariance: str = "diagonal"
    """diagonal, or full: let a learned covariance have correlations."""
    std_learning_rate: float = 0.01
    """Adam's step size of the logarithms of the standard deviations, where they are learned."""
    std_range: tuple[float, float] = (0.001, 0.01)
    """Bounds [m] of learned standard deviations."""
    failure_penalty: float = 10.0
    """Taken from the last reward of an episode that does not reach its goal (paper)."""
    cost_limit: float = 3.0
    """Rewards of single steps are at least minus this."""
    reward_scale: float = 0.1
    """Factor on all rewards: keeps values near one."""
    value_width: int = 64
    """Width of the two hidden layers of the value network."""
    value_learning_rate: float = 2e-3
    """Step size of AdamW for the value network at the start of each fit; it falls linearly to zero."""
    value_weight_decay: float = 1e-4
    """Weight decay of AdamW for the value network."""
    value_minibatch: int = 256
    """Steps of the environment per step of AdamW."""
    value_first_epochs: int = 80
    """Epochs on the discounted returns of the first episodes, before the first advantages."""
    value_epochs: int = 10
    """Epochs at the end of each iteration."""
    value_iterations: int = 3
    """Newest iterations whose episodes the value network is fitted to."""

    def __post_init__(self) -> None:
        check_positive_int("rollouts", self.rollouts, maximum=MOST_ENVS)
        check_positive_int("value_width", self.value_width, maximum=MOST_WIDTH)
        for name in ("steps", "natural_samples", "violation_batch", "value_minibatch"):
            check_positive_int(name, getattr(self, name))
        for name in ("value_first_epochs", "value_epochs", "value_iterations"):
            check_positive_int(name, getattr(self, name))
        if self.minibatch is not None:
            check_positive_int("minibatch", self.minibatch)
        if self.sample_clip is not None:
            check_number("sample_clip", self.sample_clip, strict=True)
        positive = ("learning_rate", "target_kl", "max_kl", "final_step", "jump_kl", "clip", "std", "std_learning_rate")
        positive += ("natural_step", "natural_damping")
        for name in (*positive, "cost_limit", "reward_scale", "value_learning_rate", "violation_gamma", "violation_xi"):
            check_number(name, getattr(self, name), strict=True)
        for name in ("failure_penalty", "value_weight_decay"):
            check_number(name, getattr(self, name))
        check_number("learning_rate_factor", self.learning_rate_factor, minimum=1.0)
        for name in ("kl_quantile", "gamma", "zeta", "beta"):
            if not 0 <= check_number(name, getattr(self, name)) <= 1:
                raise InvalidInputError(f"{name}: expected 0 <= {name} <= 1, got {getattr(self, name)}")
        if not 0 <= check_number("natural_momentum", self.natural_momentum) < 1:
            raise InvalidInputError(
                f"natural_momentum: expected 0 <= natural_momentum < 1, got {self.natural_momentum}; 0 turns it off"
            )
        if self.kl_quantile == 0:
            raise InvalidInputError("kl_quantile: expected above 0, got 0; 1 keeps every sample")
        if self.final_std is not None:
            check_number("final_std", self.final_std, strict=True)
            if self.learn_std:
                raise InvalidInputError("final_std: expected None with learn_std; a deviation is annealed or learned")
        check_choice("covariance", self.covariance, ("diagonal", "full"))
        if self.covariance == "full" and not self.learn_std:
            raise InvalidInputError('covariance: expected "diagonal" without learn_std, got "full"; pass learn_std')
        if not all(0 <= beta < 1 for beta in self.betas):
            raise InvalidInputError(f"betas: expected 0 <= beta < 1 for both, got {self.betas}")
        low, high = self.std_range
        if not 0 < low <= high < math.inf:
            raise InvalidInputError(f"std_range: expected 0 < low <= high, got {self.std_range}")


def check_without_lcs(config: PPOConfig) -> None:
    """Refuse settings that only a policy with an LCS can follow."""
    if config.beta < 1 or config.sample_clip is not None or config.natural:
        raise InvalidInputError(
            f"config: expected beta=1, sample_clip=None and natural=False without an LCS, got beta={config.beta:g}, "
            f"sample_clip={config.sample_clip} and natural={config.natural}; drop them"
        )


@dataclass(frozen=True)
class PPOIteration:
    """Report of one iteration.

    Attributes:
        iteration: its number, those of a warm-up included.
        env_steps: environment steps collected so far.
        success: share of its episodes that ended at the goal, under the policy's noise.
        mean_return: mean undiscounted return of its episodes.
        kl: KL divergence before the last step.
        learning_rate: step size in it: the length of a natural step, or Adam's.
        std: mean standard deviation [m] of the policy that collected.
        gradient_steps: gradient steps made.
        skipped_steps: steps left out because a gradient was not finite.
        clip_fraction: share of samples outside the clipping range, before the last step.
        ignored: share of samples left out as jumps, before the last step.
        explained_variance: of the returns by the value network, before it saw them.
        solver_failures: MPC solves that did not converge, while collecting and while learning.
        unstable: episodes dropped because the simulation broke down.
        imagined_success: share of the last imagined episodes before it that ended at the goal; None without any.
        model_loss: error of the ensemble in which they were imagined, in the last pass of its training.
        physics_seconds: wall time of the environment.
        solve_seconds: wall time of the MPC.
        gradient_seconds: wall time of gradients and steps.
        value_seconds: wall time of advantages and value network.
        imagination_seconds: wall time of everything imagined: the ensemble's training, episodes, solves, gradients.
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
    ignored: float
    explained_variance: float
    solver_failures: int
    unstable: int
    imagined_success: float | None
    model_loss: float | None
    physics_seconds: float
    solve_seconds: float
    gradient_seconds: float
    value_seconds: float
    imagination_seconds: float


class PPO:
    """The main phase as an object that can be stopped between iterations, saved, and resumed with the same result.

    Random numbers come from generators derived from the seed and the iteration; the global ones are left as they were.

    Args:
        actor: the policy, from `difflcs.rl.make_actor`; what it has learned is trained in place. An MPC in it
            needs on_failure="mask".
        env: at least `config.rollouts` environments in lockstep.
        config: settings, those that the actor was made with.
        seed: of noise, value network, goals and initial states.
        features: inputs of the value network.
        total_episodes: episodes of the whole training; the main phase ends there.
        episode_steps: steps of one episode.
        first_episode: episodes collected before, by a warm-up.
        first_iteration: iterations done before.
        imagination: plays episodes besides those of `env`, None: real ones alone, as in the paper. Let it `add` the
            episodes of a warm-up.

    Raises:
        InvalidInputError: an argument does not fit.
        MissingDependencyError: TorchRL is not installed.
    """

    def __init__(
        self,
        actor: GaussianPolicy,
        env: VectorEnv,
        config: PPOConfig,
        seed: int,
        *,
        features: Features,
        total_episodes: int,
        episode_steps: int = 20,
        first_episode: int = 0,
        first_iteration: int = 0,
        imagination: Imagination | None = None,
    ):
        check_positive_int("seed", seed, minimum=0)
        check_positive_int("episode_steps", episode_steps)
        learned, gaussian = actor.learned, actor.gaussian
        if isinstance(learned, LCSParams):
            raise InvalidInputError("actor: expected a model that can be learned, got fixed LCSParams; use an LCSModel")
        if gaussian.log_std.requires_grad != config.learn_std:
            raise InvalidInputError(
                f"actor: expected one made with learn_std={config.learn_std}, as the settings say, got "
                f"{gaussian.log_std.requires_grad}; use make_actor(controller, config)"
            )
        if not isinstance(learned, LCSModel):
            check_without_lcs(config)
        if total_episodes <= first_episode:
            raise InvalidInputError(
                f"total_episodes: expected more than the {first_episode} collected before, got {total_episodes}; "
                f"train for more minutes or shorten the warm-up"
            )
        remaining = total_episodes - first_episode
        if env.num_envs < min(config.rollouts, remaining):
            raise InvalidInputError(f"env: expected at least {config.rollouts} environments, got {env.num_envs}")
        self.actor, self.learned, self.policy = actor, learned, actor.controller
        self.lcs = learned if isinstance(learned, LCSModel) else None
        self.env, self.config, self.imagination = env, config, imagination
        self.seed, self.features, self.episode_steps = seed, features, episode_steps
        self.first_episode, self.first_iteration = first_episode, first_iteration
        self.episodes, self.iteration = first_episode, first_iteration
        self._imagined = 0  # 1, 2, … in the imagined iterations before a real one: part of the seeds
        # As many iterations as `rollouts` asks for, all of the same size up to one episode.
        count = math.ceil(remaining / config.rollouts)
        self._sizes = [remaining // count + (k < remaining % count) for k in range(count)]

        model, deviation = (
            [p for p in part if p.requires_grad] for part in (learned.parameters(), (gaussian.log_std, gaussian.mixing))
        )
        self._parameters = [*model, *deviation]
        self.learning_rate = config.natural_step if config.natural else config.learning_rate
        self._optimiser: NaturalGradient | torch.optim.Adam
        if config.natural:
            self._optimiser = NaturalGradient(
                model, config.natural_step, config.natural_momentum, config.natural_damping
            )
        else:
            self._optimiser = torch.optim.Adam(model, config.learning_rate, config.betas)
            initialise_moments(self._optimiser)
        self._std_adam: torch.optim.Adam | None = None
        if deviation:
            self._std_adam = torch.optim.Adam(deviation, config.std_learning_rate, config.betas)
            initialise_moments(self._std_adam)

        low, high = (torch.from_numpy(bound) for bound in action_bounds(env))
        self.bounds = (low, high)
        space = env.single_observation_space
        sizes = (space[key].shape for key in ("state", "goal"))  # pyright: ignore[reportIndexIssue]
        example = features(*(torch.zeros(size, dtype=torch.float64) for size in (*sizes, ())))
        self.critic = Critic(config, len(example), self._key(_VALUE_STREAM))

    @property
    def env_steps(self) -> int:
        """Environment steps collected so far, those of a warm-up included."""
        return self.episodes * self.episode_steps

    @property
    def done(self) -> bool:
        """Whether all episodes are collected."""
        return self.iteration - self.first_iteration >= len(self._sizes)

    def step(self, after_step: Callable[[int], object] | None = None) -> PPOIteration:
        """One iteration: collect, estimate advantages, improve the policy, fit the value network.

        Before it, iterations on imagined episodes, if there is an imagination and it has real ones to start from.

        Args:
            after_step: called with the number of episodes stepped, for progress bars.

        Raises:
            InvalidInputError: rewards that are not finite, or no episode with a stable simulation.
        """
        if self.done:
            raise InvalidInputError(f"step: expected at most {len(self._sizes)} iterations, all of them are done")
        progress = sum(self._sizes[: self.iteration - self.first_iteration]) / sum(self._sizes)
        if self.config.final_std is not None:
            self.actor.set_std(self.config.std * (self.config.final_std / self.config.std) ** progress)
        scale = 1 - (1 - self.config.final_step) * progress
        start = time.perf_counter()
        imagined_success, model_loss = self._imagine(scale, progress)
        imagination_seconds = time.perf_counter() - start

        count = self._sizes[self.iteration - self.first_iteration]
        seeds = episode_seeds(self.seed, TRAINING_STREAM, self.episodes, count)
        self.episodes += count
        std, learning_rate = float(self.actor.std.mean()), self.learning_rate
        effort = _Effort(self.config.steps, self.config.minibatch, self.config.value_epochs)
        if self.imagination is None or imagined_success is None:
            outcome = self._iterate(self.env, seeds, effort, scale, after_step)
        else:
            outcome = self._iterate(self.env, seeds, effort, self.imagination.config.real_step * scale, after_step)
            self.learning_rate = learning_rate  # it follows the imagined iterations alone
        rollouts, improvement = outcome.rollouts, outcome.improvement
        if self.imagination is not None:
            stable = rollouts.stable
            self.imagination.add(rollouts.states[stable], rollouts.actions[stable], rollouts.goals[stable])
        self.iteration += 1
        return PPOIteration(
            iteration=self.iteration,
            env_steps=self.env_steps,
            success=float(rollouts.success.double().mean()),
            mean_return=outcome.mean_return,
            kl=improvement.kl,
            learning_rate=learning_rate,
            std=std,
            gradient_steps=improvement.steps,
            skipped_steps=improvement.skipped,
            clip_fraction=improvement.clip_fraction,
            ignored=improvement.ignored,
            explained_variance=outcome.explained_variance,
            solver_failures=rollouts.solver_failures + improvement.solver_failures,
            unstable=int((~rollouts.stable).sum()),
            imagined_success=imagined_success,
            model_loss=model_loss,
            physics_seconds=outcome.physics_seconds,
            solve_seconds=outcome.solve_seconds + improvement.solve_seconds,
            gradient_seconds=improvement.gradient_seconds,
            value_seconds=outcome.value_seconds,
            imagination_seconds=imagination_seconds,
        )

    def _imagine(self, scale: float, progress: float) -> tuple[float | None, float | None]:
        """Iterations on imagined episodes: the success of the last ones, and the loss of the ensemble.

        `progress` is that of the main phase, from 0 to 1.

        None before the first real one: what a warm-up has seen within its trust region says too little.
        """
        imagination = self.imagination
        if imagination is None or self.iteration == self.first_iteration:
            return None, None
        config = imagination.config
        count = config.iterations if progress < 0.5 else min(config.iterations, config.final_iterations)
        if count == 0:
            return None, None
        effort = _Effort(config.steps, config.steps_minibatch, config.value_epochs)
        model_loss, success = imagination.fit(), 0.0
        for self._imagined in range(1, count + 1):
            stream = (self.seed, _IMAGINED_STREAM, self.iteration, self._imagined)
            seeds = [int(s) for s in np.random.SeedSequence(stream).generate_state(config.rollouts)]
            rollouts = self._iterate(imagination.env, seeds, effort, scale).rollouts
            success = float(rollouts.success.double().mean())
        self._imagined = 0
        return success, model_loss

    def _iterate(
        self,
        env: VectorEnv,
        seeds: list[int],
        effort: _Effort,
        scale: float,
        after_step: Callable[[int], object] | None = None,
    ) -> _Outcome:
        """Collect an episode for each seed, estimate advantages, improve the policy, fit the value network.

        `scale` is the factor on the gradient steps.
        """
        rollouts, data, physics_seconds, solve_seconds = self._collect(env, seeds, after_step)
        rewards = self._rewards(rollouts)
        start = time.perf_counter()
        critic, inputs, returns = self.critic, self._inputs(rollouts), self.critic.returns(rewards)
        with seeded(self._key(_LOSS_STREAM)):
            critic.begin(inputs, rewards, self._key(_VALUE_STREAM))
            estimated = critic.advantages(inputs, rewards)
            data["advantage"] = estimated["advantage"]
            lasting = rewards  # what the value network learns from
            unexplained = (returns - estimated["state_value"].squeeze(-1)).var() / returns.var().clamp_min(1e-12)
            if self.imagination is not None and env is self.imagination.env and self.imagination.config.actions > 1:
                data["judged"], unearned = self._look_ahead(rollouts, data, estimated["state_value"].squeeze(-1))
                lasting = rewards - unearned
            value_seconds = time.perf_counter() - start
            improvement = self._improve(data.flatten(0, 1), rollouts, effort, scale)
            start = time.perf_counter()
            critic.learn(inputs, lasting, self._key(_VALUE_STREAM), effort.value_epochs)
            value_seconds += time.perf_counter() - start
        return _Outcome(
            rollouts=rollouts,
            improvement=improvement,
            mean_return=float(rewards.sum(1).mean()) / self.config.reward_scale,
            explained_variance=1 - float(unexplained),
            physics_seconds=physics_seconds,
            solve_seconds=solve_seconds,
            value_seconds=value_seconds,
        )

    # --- data ---

    def _collect(
        self, env: VectorEnv, seeds: list[int], after_step: Callable[[int], object] | None = None
    ) -> tuple[Rollouts, TensorDict, float, float]:
        """Episodes of the stochastic policy, and its tensordicts of the stable ones (N, T)."""
        from tensordict import TensorDict

        seen: list[TensorDict] = []
        solve_seconds = 0.0

        def act(state: Tensor, goal: Tensor) -> tuple[np.ndarray, int]:
            nonlocal solve_seconds
            begun = time.perf_counter()
            elapsed = torch.full((len(state),), len(seen) / self.episode_steps, dtype=torch.float64)
            step = TensorDict({"state": state.clone(), "goal": goal.clone(), "elapsed": elapsed}, [len(state)])
            with torch.no_grad(), _quiet():
                self.actor(step)  # cold: as in evaluation
            seen.append(step)
            solve_seconds += time.perf_counter() - begun
            return np.asarray(step["action"]), _failures(step)

        start = time.perf_counter()
        report = None if after_step is None else lambda: after_step(len(seeds))
        with seeded(self._key(_NOISE_STREAM)):
            rollouts = collect(env, act, seeds, self.episode_steps, report)
        seconds = time.perf_counter() - start
        if not bool(rollouts.stable.any()):
            raise InvalidInputError("env: expected a stable simulation, got NaN or a physics error in every episode")
        data = TensorDict.maybe_dense_stack(seen, 1)[rollouts.stable]
        return rollouts, data, seconds - solve_seconds, solve_seconds  # pyright: ignore[reportReturnType]

    def _rewards(self, rollouts: Rollouts) -> Tensor:
        """(N, T) scaled rewards of the stable episodes."""
        return self._scaled(rollouts.rewards[rollouts.stable], rollouts.success[rollouts.stable])

    def _scaled(self, rewards: Tensor, success: Tensor) -> Tensor:
        """Rewards (N, T, ...) and successes of the last step (N, ...) → rewards to learn from (N, T, ...)."""
        config = self.config
        rewards = rewards.clamp_min(-config.cost_limit)
        if not bool(torch.isfinite(rewards).all()):
            raise InvalidInputError("env: expected finite rewards, got NaN or infinity; mend the environment's reward")
        rewards[:, -1] -= config.failure_penalty * (~success).double()
        return config.reward_scale * rewards

    def _inputs(self, rollouts: Rollouts) -> Tensor:
        """(N, T+1, n) inputs of the value network for the stable episodes."""
        states = rollouts.states[rollouts.stable]
        goals = rollouts.goals[rollouts.stable].unsqueeze(1).expand(-1, states.shape[1], -1)
        elapsed = torch.linspace(0, 1, states.shape[1], dtype=torch.float64).expand(states.shape[:-1])
        return self.features(states, goals, elapsed)

    @torch.no_grad()
    def _look_ahead(self, rollouts: Rollouts, data: TensorDict, now: Tensor) -> tuple[TensorDict, Tensor]:
        """Actions judged in imagined episodes, see `difflcs.rl.lookahead`: data of them (N, T, M) and the luck (N, T).

        `now` are the values (N, T) of the states.
        """
        assert self.imagination is not None
        config, gamma = self.imagination.config, self.config.gamma
        judged = mirrored_actions(data, config.actions)
        executed = torch.clamp(judged["action"], *self.bounds)
        after, rewards, success = self.imagination.env.foresee(rollouts.states[:, :-1], executed, rollouts.goals)
        goals = rollouts.goals[:, None, None].expand(*after.shape[:-1], -1)
        elapsed = torch.linspace(0, 1, after.shape[1] + 1, dtype=torch.float64)[1:, None].expand(after.shape[:-1])
        values = self.critic.values(self.features(after, goals, elapsed))
        values[:, -1] = 0  # an episode has ended
        q = self._scaled(rewards, success[:, -1]) + gamma * values
        judged["advantage"] = lookahead_advantages(q, now, gamma, config.zeta).unsqueeze(-1)
        return judged, luck(q)

    # --- policy ---

    def _improve(self, data: TensorDictBase, rollouts: Rollouts, effort: _Effort, scale: float) -> _Improvement:
        """Gradient steps on the combined loss (Eq. total_loss), until the KL divergence is used up."""
        from tensordict.nn import ProbabilisticTensorDictSequential
        from torchrl.objectives import ClipPPOLoss

        config, outcome = self.config, _Improvement()
        # The MPC is solved here, once per step; the loss gets its result, and only builds the distribution.
        head = ProbabilisticTensorDictSequential(self.actor.module[-1])  # pyright: ignore
        clipped = ClipPPOLoss(head, None, clip_epsilon=config.clip, entropy_bonus=False, critic_coeff=None)
        data, own = data.copy(), data.select("action", "action_log_prob", "advantage").unsqueeze(-1)
        judged = data.get("judged", own).copy()  # (N, M): M actions for each state
        advantage = judged["advantage"]
        judged["advantage"] = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
        if "plan" in data.keys():
            data["guess"] = data["plan"].clone()  # the rollout's own optimum, then each step's
        rng = np.random.default_rng(self._key(_LOSS_STREAM))
        optimisers: list[torch.optim.Optimizer] = [self._optimiser]
        self._optimiser.param_groups[0]["lr"] = scale * self.learning_rate
        if self._std_adam is not None:
            optimisers.append(self._std_adam)
            self._std_adam.param_groups[0]["lr"] = scale * config.std_learning_rate
        if isinstance(self._optimiser, NaturalGradient):
            start = time.perf_counter()
            chosen = torch.from_numpy(rng.permutation(len(data))[: config.natural_samples])
            self._optimiser.measure(self._jacobian(cast("TensorDict", data[chosen])))
            outcome.gradient_seconds += time.perf_counter() - start
        for chosen in _batches(len(data), effort, rng):
            start = time.perf_counter()
            old = cast("TensorDict", data[chosen])
            batch = old.select(*self.actor.in_keys, "guess", strict=False)
            copies = None if config.sample_clip is None else self._copies(len(batch))
            with _quiet():
                if copies is None:
                    self.actor.get_dist_params(batch)
                else:
                    functional_call(self.actor.gaussian, copies, (batch,))
            if "plan" in batch.keys():
                data["guess"][chosen] = batch["plan"]
            outcome.solver_failures += _failures(batch)
            solved = time.perf_counter()
            outcome.solve_seconds += solved - start

            kl = _kl(old, batch)
            outcome.kl = _trimmed_mean(kl, config.kl_quantile)
            if not outcome.kl <= config.max_kl and outcome.steps:
                break
            jumped = (kl > config.jump_kl).unsqueeze(-1)
            outcome.ignored = float(jumped.double().mean())
            samples = judged[chosen]
            many = samples.batch_size
            samples["loc"] = torch.where(jumped, old["loc"], batch["loc"]).unsqueeze(1).expand(*many, -1)
            samples["scale_tril"] = batch["scale_tril"].unsqueeze(1).expand(*many, -1, -1)
            samples["advantage"] = torch.where(jumped.unsqueeze(1), 0.0, samples["advantage"])
            result = clipped(samples)
            outcome.clip_fraction = float(result["clip_fraction"])
            loss = config.beta * result["loss_objective"]
            if config.beta < 1:
                loss = loss + (1 - config.beta) * self._violation(rollouts, rng)
            for optimiser in optimisers:
                optimiser.zero_grad()
            loss.backward()
            if copies is not None:
                self._add_clipped(copies)
            if all(p.grad is None or bool(torch.isfinite(p.grad).all()) for p in self._parameters):
                for optimiser in optimisers:
                    optimiser.step()
                self._bound_std()
                outcome.steps += 1
            else:
                outcome.skipped += 1
            outcome.gradient_seconds += time.perf_counter() - solved
        self.learning_rate = self._adapt(outcome.kl / scale**2)
        return outcome

    def _adapt(self, kl: float) -> float:
        """The next step size. KL grows with the square of a step, so the caller divides annealing out.

        No natural step is longer than the KL divergence of a whole iteration: where all actions are at their bounds
        there is none, whatever the step.
        """
        config = self.config
        longest = math.sqrt(2 * config.target_kl) if config.natural else math.inf
        if kl > 1.5 * config.target_kl:
            return self.learning_rate / config.learning_rate_factor
        longer = min(self.learning_rate * config.learning_rate_factor, max(longest, self.learning_rate))
        return longer if kl < 0.5 * config.target_kl else self.learning_rate

    def _bound_std(self) -> None:
        low, high = self.config.std_range
        if self.config.learn_std:
            with torch.no_grad():
                self.actor.gaussian.log_std.clamp_(math.log(low), math.log(high))

    # --- only with an LCS ---

    def _violation(self, rollouts: Rollouts, rng: np.random.Generator) -> Tensor:
        assert self.lcs is not None
        config, states, actions = self.config, rollouts.states[rollouts.stable], rollouts.actions[rollouts.stable]
        x, u, x_next = (v.flatten(0, 1) for v in (states[:, :-1], actions, states[:, 1:]))
        chosen = torch.from_numpy(rng.permutation(len(x))[: config.violation_batch])
        return violation_loss(
            self.lcs, x[chosen], u[chosen], x_next[chosen], config.violation_gamma, config.violation_xi
        )

    def _copies(self, samples: int) -> dict[str, Tensor]:
        """A copy of the LCS for each sample, by its names within the actor: their gradients are the samples' own."""
        assert self.lcs is not None
        parameters = {name: p for name, p in self.lcs.named_parameters() if p.requires_grad}
        copies = {name: p.detach().expand(samples, *p.shape).clone() for name, p in parameters.items()}
        return {f"{_LCS}{name}": copy.requires_grad_() for name, copy in copies.items()}

    def _jacobian(self, data: TensorDict) -> Tensor:
        """(N, n_u, P) Jacobians of the mean at the samples' own plans, in standard deviations: Σ = L Lᵀ, L⁻¹ ∂u/∂θ."""
        copies = self._copies(len(data))
        batch = data.select(*self.actor.in_keys, "guess")
        with _quiet():
            functional_call(self.actor.gaussian, copies, (batch,))
        mean = torch.linalg.solve_triangular(batch["scale_tril"].detach(), batch["loc"].unsqueeze(-1), upper=False)
        leaves, rows = list(copies.values()), []
        for component in mean.squeeze(-1).unbind(-1):
            found = torch.autograd.grad(component.sum(), leaves, retain_graph=True, materialize_grads=True)
            rows.append(torch.cat([part.flatten(1) for part in found], 1))
        return torch.stack(rows, 1)

    def _add_clipped(self, copies: dict[str, Tensor]) -> None:
        """Add the samples' gradients to the model's, long ones scaled down.

        The length is that over all parameters. Zeros do not count in the median: samples whose action is at its bounds
        or whose ratio is clipped have no gradient.
        """
        assert self.lcs is not None
        assert self.config.sample_clip is not None
        gradients = {name: copy.grad.flatten(1) for name, copy in copies.items() if copy.grad is not None}
        length = torch.cat(list(gradients.values()), 1).norm(dim=1)
        limit = self.config.sample_clip * length[length > 0].nanmedian()
        factor = torch.where(length > limit, limit / length, 1.0)
        for name, p in self.lcs.named_parameters():
            if f"{_LCS}{name}" in gradients:
                total = (factor @ gradients[f"{_LCS}{name}"]).view_as(p)
                p.grad = total if p.grad is None else p.grad + total

    def _key(self, stream: int) -> tuple[int, ...]:
        """Of the random numbers of one purpose in one iteration, see `seeded`."""
        return (self.seed, stream, self.iteration, *([self._imagined] if self._imagined else []))

    # --- checkpoints ---

    def _tensors(self) -> dict[str, Tensor]:
        """Everything besides model and history, in tensors of constant shape."""
        gaussian = self.actor.gaussian
        network = {} if self.lcs is not None else self.learned.state_dict()
        return {
            **{f"{_NETWORK}{name}": value for name, value in network.items()},
            "u_min": self.bounds[0],
            "u_max": self.bounds[1],
            "policy.log_std": gaussian.log_std.detach(),
            "policy.mixing": gaussian.mixing.detach(),
            **self._optimiser_tensors(),
            **_prefixed(_VALUE, self.critic.tensors()),
            **({} if self.imagination is None else _prefixed(_IMAGINATION, self.imagination.tensors())),
        }

    def _optimiser_tensors(self) -> dict[str, Tensor]:
        own, std = self._optimiser, self._std_adam
        natural = isinstance(own, NaturalGradient)
        tensors = _prefixed("policy_natural.", own.tensors()) if natural else moments("policy_adam", own)
        return {**tensors, **({} if std is None else moments("std_adam", std))}

    def checkpoint(self) -> Checkpoint:
        """Everything needed to go on with the same result."""
        state = {
            "episodes": self.episodes,
            "first_episode": self.first_episode,
            "first_iteration": self.first_iteration,
            "learning_rate": self.learning_rate,
            "history": self.critic.sizes,
            "fits": 0 if self.imagination is None else self.imagination.fits,
        }
        tensors = {**self._tensors(), **_prefixed(_VALUE, self.critic.history_tensors())}
        return Checkpoint(self.iteration, self.lcs, state, tensors)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint.

        Raises:
            CheckpointError: it does not fit the settings or the model; nothing is changed.
        """
        own, state = self._tensors(), checkpoint.state
        # The lengths of these follow from the episodes so far; who holds them checks the rest.
        varying = {f"{_VALUE}history.{name}" for name in ("inputs", "rewards")}
        varying |= {f"{_IMAGINATION}{name}" for name in EPISODES}
        shapes, wanted = (
            {k: kind for k, kind in kinds(part).items() if k not in varying} for part in (checkpoint.tensors, own)
        )
        got, expected = (model and model.config() for model in (checkpoint.model, self.lcs))
        if shapes != wanted or got != expected:
            different = sorted({k for k in {*shapes, *wanted} if shapes.get(k) != wanted.get(k)})
            raise CheckpointError(
                f"checkpoint: expected {expected} and the tensors of this training, got {got}, different in "
                f"{different}; was it written with other settings?"
            )
        try:
            names = ("episodes", "first_episode", "first_iteration", "fits")
            episodes, first_episode, first_iteration, fits = (check_positive_int(k, state[k], minimum=0) for k in names)
            learning_rate = check_number("learning_rate", state["learning_rate"], strict=True)
            sizes = [check_positive_int("history", size, minimum=0) for size in cast("list[int]", state["history"])]
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(f"checkpoint: its counters or history cannot be used ({error})") from error
        if (first_episode, first_iteration) != (self.first_episode, self.first_iteration):
            raise CheckpointError(
                f"checkpoint: expected a main phase that starts after {self.first_episode} episodes, got one after "
                f"{first_episode}; was it written with other settings?"
            )
        values = _of(_VALUE, checkpoint.tensors)
        history = read_history(values, sizes, self.critic.n_inputs, self.episode_steps)
        if self.imagination is not None:
            self.imagination.restore(_of(_IMAGINATION, checkpoint.tensors), fits)
        self.critic.restore(values, history)
        self.iteration, self.episodes, self.learning_rate = checkpoint.iteration, episodes, learning_rate
        if self.lcs is not None and checkpoint.model is not None:
            self.lcs.load_state_dict(checkpoint.model.state_dict())
        with torch.no_grad():
            for name, value in own.items():
                if not name.startswith((_VALUE, _IMAGINATION, "u_")):
                    value.copy_(checkpoint.tensors[name])


@dataclass(frozen=True)
class _Effort:
    """How much an iteration learns: gradient steps, samples per step (None: all), epochs of the value network."""

    steps: int
    minibatch: int | None
    value_epochs: int


@dataclass
class _Outcome:
    """What one iteration, real or imagined, has done."""

    rollouts: Rollouts
    improvement: _Improvement
    mean_return: float
    explained_variance: float
    physics_seconds: float
    solve_seconds: float
    value_seconds: float


@dataclass
class _Improvement:
    """What the gradient steps of one iteration did."""

    kl: float = 0.0
    steps: int = 0
    skipped: int = 0
    clip_fraction: float = 0.0
    ignored: float = 0.0
    solver_failures: int = 0
    solve_seconds: float = 0.0
    gradient_seconds: float = 0.0


def _batches(samples: int, effort: _Effort, rng: np.random.Generator) -> Iterator[Tensor]:
    """The samples of each gradient step."""
    size, left = effort.minibatch, effort.steps
    while left > 0:
        order = torch.arange(samples) if size is None else torch.from_numpy(rng.permutation(samples))
        parts = order.split(size or samples)[:left]
        left -= len(parts)
        yield from parts


def network_tensors(checkpoint: Checkpoint) -> dict[str, Tensor]:
    """The learned network's state dict in a checkpoint."""
    return _of(_NETWORK, checkpoint.tensors)


def _failures(data: TensorDictBase) -> int:
    """Solves that did not converge; a network has none."""
    return int((~data["converged"]).sum()) if "converged" in data.keys() else 0


def _kl(old: TensorDictBase, new: TensorDictBase) -> Tensor:
    """(N,) KL(old ‖ new) of the Gaussians: far less noisy than the mean of sampled log-ratios."""
    with torch.no_grad():
        before, after = (
            torch.distributions.MultivariateNormal(v["loc"], scale_tril=v["scale_tril"], validate_args=False)
            for v in (old, new)
        )
        return torch.distributions.kl_divergence(before, after)


def _trimmed_mean(values: Tensor, fraction: float) -> float:
    """Mean of the lowest `fraction` of the values, at least of one."""
    return float(values.sort().values[: max(1, int(fraction * len(values)))].mean())


@contextmanager
def _quiet() -> Iterator[None]:
    # Failures are counted and reported; a regularised gradient of single samples is expected here.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SolveWarning)
        warnings.simplefilter("ignore", DegenerateWarning)
        yield


def _prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {f"{prefix}{name}": value for name, value in tensors.items()}


def _of(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
