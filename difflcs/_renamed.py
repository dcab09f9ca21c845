"""Flags of the command line that have another name now, so that the error can say which."""

from __future__ import annotations

from collections.abc import Mapping

_RENAMED: Mapping[str, str] = {
    "--trust-region": "--action-support",
    "--warmup.random-rollouts": "--warmup.rollouts.first",
    "--warmup.rollouts-per-iteration": "--warmup.rollouts.each",
    "--warmup.buffer-rollouts": "--warmup.buffer",
    "--warmup.trust-region": "--warmup.action-support",
    "--warmup.trust-region-growth": "--warmup.action-support-growth",
    "--warmup.learning-rate": "--warmup.adam.learning-rate",
    "--warmup.betas": "--warmup.adam.betas",
    "--warmup.minibatch": "--warmup.epochs.minibatch",
    "--warmup.first-epochs": "--warmup.epochs.first",
    "--warmup.epochs": "--warmup.epochs.each",
    "--warmup.gamma": "--warmup.loss.gamma",
    "--warmup.xi": "--warmup.loss.xi",
    "--ppo.natural": "--ppo.update natural",
    "--ppo.no-natural": "--ppo.update adam",
    "--ppo.natural-step": "--ppo.natural.step",
    "--ppo.natural-momentum": "--ppo.natural.momentum",
    "--ppo.natural-damping": "--ppo.natural.damping",
    "--ppo.natural-samples": "--ppo.natural.samples",
    "--ppo.learning-rate": "--ppo.adam.learning-rate",
    "--ppo.betas": "--ppo.adam.betas",
    "--ppo.learning-rate-factor": "--ppo.step-factor",
    "--ppo.jump-kl": "--ppo.outlier-kl",
    "--ppo.learn-std": "--ppo.covariance diagonal",
    "--ppo.violation-gamma": "--ppo.violation.gamma",
    "--ppo.violation-xi": "--ppo.violation.xi",
    "--ppo.value-width": "--ppo.critic.width",
    "--ppo.value-learning-rate": "--ppo.critic.learning-rate",
    "--ppo.value-weight-decay": "--ppo.critic.weight-decay",
    "--ppo.value-minibatch": "--ppo.critic.epochs.minibatch",
    "--ppo.value-first-epochs": "--ppo.critic.epochs.first",
    "--ppo.value-epochs": "--ppo.critic.epochs.each",
    "--ppo.value-iterations": "--ppo.critic.iterations",
    "--imagination.networks": "--models.ensemble.networks",
    "--imagination.width": "--models.ensemble.width",
    "--imagination.first-epochs": "--models.ensemble.epochs.first",
    "--imagination.epochs": "--models.ensemble.epochs.each",
    "--imagination.minibatch": "--models.ensemble.epochs.minibatch",
    "--imagination.learning-rate": "--models.ensemble.learning-rate",
    "--imagination.steps-minibatch": "--ppo.minibatch",
    "--imagination.": "--models.",
    "--mlp.width": "--width",
    "--mlp.": "--ppo.",
    "--pddm.networks": "--pddm.ensemble.networks",
    "--pddm.width": "--pddm.ensemble.width",
    "--pddm.random-rollouts": "--pddm.rollouts.first",
    "--pddm.rollouts-per-iteration": "--pddm.rollouts.each",
    "--pddm.learning-rate": "--pddm.ensemble.learning-rate",
    "--pddm.epochs": "--pddm.ensemble.epochs.each",
    "--pddm.minibatch": "--pddm.ensemble.epochs.minibatch",
}
"""Flags of before → those of now; with a dot at the end, all that begin so."""


def renamed(flag: str) -> str | None:
    """What a flag of `difflcs train` or `evaluate` of before is called now; None if it is none."""
    for old, new in _RENAMED.items():
        if flag == old:
            return new
        if old.endswith(".") and flag.startswith(old):
            rest = flag.removeprefix(old)
            return renamed(f"{new}{rest}") or f"{new}{rest}"
    return None
