"""The phases that several methods share, and short versions of their settings for smoke tests."""

import copy
from dataclasses import replace

from difflcs.mpc import LCSMPCLayer
from difflcs.records import LCSModule
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.learning.model_rollouts import ModelRollouts, ModelRolloutSettings
from difflcs.rl.learning.ppo import PPO
from difflcs.rl.learning.ppo_settings import PPOSettings, make_ppo
from difflcs.rl.learning.warmup import Warmup, WarmupSettings
from difflcs.rl.methods.base import Work
from difflcs.rl.rollout import Policy
from difflcs.rl.settings import Epochs, Rollouts


def warmup_phase(work: Work, lcs: LCSModule, policy: Policy, settings: WarmupSettings) -> Warmup:
    """Make the warm-up from its settings."""
    envs = work.make_envs(max(settings.rollouts.first, settings.rollouts.each))
    return Warmup(lcs, policy, envs, settings, work.seed, work.task.episode_steps, work.init is not None)


def main_phase(
    work: Work,
    controller: LCSMPCLayer | MLPController,
    settings: PPOSettings,
    models: ModelRolloutSettings | None,
    first_episode: int = 0,
    first_iteration: int = 0,
    keep_best: bool = False,
) -> PPO:
    """Make PPO from its settings, to continue after earlier episodes and iterations.

    With `keep_best` it moves a copy of the controller, which itself changes only for the better, see `Incumbent`.
    """
    # Here and not above: TorchRL takes seconds to import, which `difflcs --help` should not wait for.
    from difflcs.rl.learning.policy import make_actor

    task = work.task
    envs = work.make_envs(min(settings.rollouts, max(1, work.total_episodes - first_episode)))
    rollouts = None
    if models is not None and models.iterations:
        rollouts = ModelRollouts(envs, task.outcome, models, work.seed, task.episode_steps)
    best = controller if keep_best and isinstance(controller, LCSMPCLayer) else None
    return make_ppo(
        make_actor(controller if best is None else copy.deepcopy(best), settings.std, settings.covariance),
        envs,
        settings,
        work.seed,
        features=task.features,
        total_episodes=work.total_episodes,
        episode_steps=task.episode_steps,
        first_episode=first_episode,
        first_iteration=first_iteration,
        failure_penalty=task.failure_penalty,
        models=rollouts,
        best=best,
    )


def few_rollouts(settings: Rollouts) -> Rollouts:
    """Limit settings to five episodes per iteration, see `Method.smoke`."""
    return replace(settings, first=min(settings.first, 5), each=min(settings.each, 5))


def short_epochs(settings: Epochs, first: int, each: int) -> Epochs:
    """Limit settings to so many epochs, see `Method.smoke`."""
    return replace(settings, first=min(settings.first, first), each=min(settings.each, each))


def short_warmup(settings: WarmupSettings) -> WarmupSettings:
    """The warm-up in seconds, see `Method.smoke`."""
    return replace(settings, rollouts=few_rollouts(settings.rollouts), epochs=short_epochs(settings.epochs, 20, 2))


def short_main(settings: PPOSettings, rollouts: int = 3) -> PPOSettings:
    """The main phase in seconds, see `Method.smoke`."""
    return replace(settings, rollouts=min(settings.rollouts, rollouts), steps=min(settings.steps, 2))


def short_models(settings: ModelRolloutSettings) -> ModelRolloutSettings:
    """Model rollouts in seconds, see `Method.smoke`."""
    return replace(
        settings,
        iterations=min(settings.iterations, 1),
        rollouts=min(settings.rollouts, 5),
        steps=min(settings.steps, 2),
        ensemble=replace(settings.ensemble, epochs=short_epochs(settings.ensemble.epochs, 2, 1)),
    )
