"""The phases that several methods share."""

from difflcs.mpc import LCSMPCLayer
from difflcs.records import LCSModule
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.learning.model_rollouts import ModelRollouts, ModelRolloutSettings
from difflcs.rl.learning.ppo import PPO
from difflcs.rl.learning.ppo_settings import PPOSettings, make_ppo
from difflcs.rl.learning.warmup import Warmup, WarmupSettings
from difflcs.rl.methods.base import Work
from difflcs.rl.rollout import Policy


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
) -> PPO:
    """Make PPO from its settings, to continue after earlier episodes and iterations."""
    # Here and not above: TorchRL takes seconds to import, which `difflcs --help` should not wait for.
    from difflcs.rl.learning.policy import make_actor

    task = work.task
    envs = work.make_envs(min(settings.rollouts, max(1, work.total_episodes - first_episode)))
    rollouts = None
    if models is not None and models.iterations:
        rollouts = ModelRollouts(envs, task.outcome, models, work.seed, task.episode_steps)
    return make_ppo(
        make_actor(controller, settings.std, settings.covariance),
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
    )
