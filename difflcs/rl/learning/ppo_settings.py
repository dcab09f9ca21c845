"""Settings of the main phase (Algorithm 2), and the function that makes PPO from them."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from difflcs._checks import describe
from difflcs.errors import DTypeError, InvalidInputError
from difflcs.records import LCSModule, LCSParams, LCSSequence
from difflcs.rl.learning.advantages import GAEAdvantages, MultiActionAdvantages, RewardScale
from difflcs.rl.learning.critic import Critic, CriticSettings
from difflcs.rl.learning.incumbent import Incumbent
from difflcs.rl.learning.model_rollouts import ModelRollouts
from difflcs.rl.learning.optim import AdamUpdate, Natural, NaturalUpdate, UpdateRule
from difflcs.rl.learning.optim.update import Deviation
from difflcs.rl.learning.ppo import PPO, Source
from difflcs.rl.learning.surrogate import OUTLIER_KL, Surrogate
from difflcs.rl.rollout import CONTEXT, action_bounds, check_env, has_context
from difflcs.rl.seeding import Stream
from difflcs.rl.settings import MOST_ENVS, Adam, Settings, ViolationLoss, bounded, group
from difflcs.rl.tasks import Features, count_features

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from difflcs.rl.learning.policy import GaussianPolicy


@dataclass(frozen=True)
class PPOSettings(Settings):
    """Settings of the main phase. "paper": given there; the others are ours, tuned on the cube."""

    rollouts: int = bounded(30, minimum=1, maximum=MOST_ENVS)
    """Episodes per iteration, run in lockstep; the last ones share what is left of the data evenly."""
    steps: int = bounded(8, minimum=1)
    """Gradient steps per iteration; Adam needs 20 or more."""
    minibatch: int | None = bounded(600, minimum=1)
    """Samples per gradient step, every sample once before any is drawn again; None: each step on all of its data."""
    update: Literal["natural", "adam"] = "natural"
    """Update rule of the policy: the natural gradient, for a policy with an MPC, or Adam."""
    natural: Natural = group(Natural)
    """Settings of the natural gradient."""
    adam: Adam = group(Adam, learning_rate=6e-4, betas=(0.9, 0.99))
    """Settings of Adam; its moments are kept across iterations."""
    target_kl: float = bounded(0.1, above=0)
    """KL divergence per iteration: the step size grows below half of it and shrinks above one and a half of it."""
    step_factor: float = bounded(1.5, minimum=1)
    """Factor by which the step size grows or shrinks after an iteration; 1: it does not follow the KL divergence."""
    max_kl: float = bounded(0.3, above=0)
    """KL divergence at which an iteration ends early."""
    final_step: float = bounded(0.3, above=0)
    """Factor on all steps, falling linearly from 1 to this over the main phase; 1 turns this off."""
    clip: float = bounded(0.3, above=0)
    """Epsilon of the clipped objective (Eq. 4 of the paper)."""
    gamma: float = bounded(0.99, minimum=0, maximum=1)
    """Discount per step."""
    zeta: float = bounded(0.8, minimum=0, maximum=1)
    """Zeta of the advantages (Eq. 5 of the paper), often called lambda."""
    beta: float = bounded(1.0, minimum=0, maximum=1)
    """Weight of the PPO loss against the violation loss (Eq. 7 of the paper). 1 in the paper."""
    violation: ViolationLoss = group(ViolationLoss)
    """The violation loss, where beta < 1."""
    std: float = bounded(0.005, above=0)
    """Standard deviation of the policy [units of the action]."""
    covariance: Literal["fixed", "diagonal", "full"] = "fixed"
    """Part of the policy's covariance that is learned together with the model."""
    std_learning_rate: float = bounded(0.01, above=0)
    """Adam's step size of the logarithms of learned standard deviations."""
    std_range: tuple[float, float] = bounded((0.001, 0.01), above=0)
    """Bounds of learned standard deviations [units of the action]."""
    cost_limit: float = bounded(3.0, above=0)
    """Rewards of single steps are at least minus this, besides the penalty of a failed episode."""
    reward_scale: float = bounded(0.1, above=0)
    """Factor on all rewards: keeps values near one."""
    critic: CriticSettings = group(CriticSettings)
    """Settings of the value network."""
    gain: float | None = bounded(-3.0, minimum=-100, maximum=100)
    """Standard errors by which the newest real returns must exceed those of the best policy so far, for a policy to be
    handed out; below 0: unless they fall short by more. None: the newest always is, as in the paper."""

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.std_range
        if low > high:
            raise InvalidInputError(f"std_range: expected 0 < low <= high, got {self.std_range}; swap them")


def make_ppo(
    actor: GaussianPolicy,
    env: VectorEnv,
    settings: PPOSettings,
    seed: int,
    *,
    features: Features,
    total_episodes: int,
    episode_steps: int = 20,
    first_episode: int = 0,
    first_iteration: int = 0,
    failure_penalty: float = 0.0,
    models: ModelRollouts | None = None,
) -> PPO:
    """Make PPO from its settings.

    Args:
        actor: the policy, made with the deviation that the settings say. Unless `settings.gain` is None, a copy of it
            learns, and it takes over what that has learned only where it may be handed out, see `Incumbent`.
        env: at least `settings.rollouts` environments in lockstep.
        settings: settings.
        seed: of noise, value network, goals and initial states.
        features: inputs of the value network.
        total_episodes: episodes of the whole training; the main phase ends there.
        episode_steps: steps of one episode.
        first_episode: episodes collected before, by a warm-up.
        first_iteration: iterations done before.
        failure_penalty: part of the last reward of a failed episode, see `TaskSpec`.
        models: plays episodes in networks besides those of the robot; None: real ones alone, as in the paper. Pass
            the episodes of a warm-up to `PPO.remember`.

    Raises:
        InvalidInputError: an argument does not fit.
        MissingDependencyError: TorchRL is not installed.
    """
    if not hasattr(actor, "learned"):
        raise DTypeError(f"actor: expected a policy, got {describe(actor)}; use LCSMPCPolicy(mpc, settings.std)")
    lcs = isinstance(actor.learned, LCSModule | LCSParams | LCSSequence)
    if not lcs and (settings.beta < 1 or settings.update == "natural"):
        raise InvalidInputError(
            f'settings: expected beta=1 and update="adam" without an LCS, got beta={settings.beta:g} and '
            f"update={settings.update!r}; drop them"
        )
    if actor.covariance != settings.covariance:
        raise InvalidInputError(
            f"actor: expected one made with covariance={settings.covariance!r}, as the settings say, got "
            f"{actor.covariance!r}; use make_actor(controller, settings.std, settings.covariance)"
        )
    space: Any = check_env(env).single_observation_space
    sizes = [space["state"].shape, space["goal"].shape, ()]
    if has_context(env):
        sizes.append(space[CONTEXT].shape)
    n_inputs = count_features(features, *sizes)
    key = (seed, Stream.VALUE, first_iteration)
    critic = Critic(settings.critic, n_inputs, episode_steps, settings.gamma, settings.zeta, key)
    scale = RewardScale(settings.cost_limit, failure_penalty, settings.reward_scale)
    judge = GAEAdvantages(critic)
    practice = None
    if models is not None:
        own = models.settings
        bounds = action_bounds(env, actor.controller)
        many = MultiActionAdvantages(models.env, critic, features, scale, bounds, own.actions)
        part = many if own.actions > 1 else judge
        practice = Source(models.env, part, own.steps, settings.minibatch, own.value_epochs)
    incumbent = None
    if settings.gain is not None:
        best, actor = actor, copy.deepcopy(actor)
        incumbent = Incumbent(best, actor, settings.reward_scale * failure_penalty, settings.gain, n_inputs)
    deviation = Deviation(actor, settings.std_learning_rate, settings.adam.betas, settings.std_range)
    own = getattr(settings, settings.update)
    rule = _UPDATES[settings.update](actor, own, settings.target_kl, settings.step_factor, deviation)
    return PPO(
        actor,
        Source(env, judge, settings.steps, settings.minibatch, settings.critic.epochs.each),
        critic,
        Surrogate(actor, settings.clip, OUTLIER_KL, settings.beta, settings.violation if lcs else None),
        rule,
        scale,
        seed,
        features=features,
        rollouts=settings.rollouts,
        total_episodes=total_episodes,
        episode_steps=episode_steps,
        first_episode=first_episode,
        first_iteration=first_iteration,
        max_kl=settings.max_kl,
        final_step=settings.final_step,
        models=models,
        practice=practice,
        incumbent=incumbent,
    )


_UPDATES: dict[str, Callable[..., UpdateRule]] = {"natural": NaturalUpdate, "adam": AdamUpdate}
