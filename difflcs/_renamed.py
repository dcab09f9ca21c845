"""Flags of the command line that have another name now, or are gone, so that the error can say so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from difflcs.errors import InvalidInputError

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
    "--ppo.learning-rate": "--ppo.adam.learning-rate",
    "--ppo.betas": "--ppo.adam.betas",
    "--ppo.learning-rate-factor": "--ppo.step-factor",
    "--ppo.jump-kl": "--ppo.outlier-kl",
    "--ppo.learn-std": "--ppo.covariance diagonal",
    "--ppo.no-learn-std": "--ppo.covariance fixed",
    "--ppo.violation-gamma": "--ppo.violation.gamma",
    "--ppo.violation-xi": "--ppo.violation.xi",
    "--ppo.value-width": "--ppo.critic.width",
    "--ppo.value-learning-rate": "--ppo.critic.learning-rate",
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


_GONE: Mapping[str, str] = {
    "--warmup.adam-eps": "it is always 1e-6, as no recipe had another",
    "--ppo.sample-clip": "single samples have no limit of their own, as in all recipes; see --ppo.outlier-kl",
    "--ppo.final-std": "the policy's deviation no longer falls by a schedule; learn it by --ppo.covariance diagonal",
    "--ppo.failure-penalty": "it is a number of the task, `failure_penalty` of its TaskSpec",
    "--pddm.noise": "it is always 0.9, as its authors have for every dexterous task",
    "--warmup.held-out": "it is always 0.2, as no recipe had another",
    "--ppo.kl-quantile": "it is always 0.97, as no recipe had another",
    "--ppo.natural-samples": "there are always 300, as no recipe had others",
    "--ppo.value-weight-decay": "it is always 1e-4, as no recipe had another",
    "--ppo.violation-batch": "it is always 300, as no recipe had another",
    "--imagination.steps-minibatch": "steps on model rollouts have as many samples as those on real ones, "
    "--ppo.minibatch",
    **{
        f"--{group}.final-iterations": "before every real iteration there are as many, see --models.iterations"
        for group in ("imagination", "models")
    },
    **{
        f"--mlp.{name}": "the natural gradient needs a policy with an MPC, which a network is not"
        for name in ("natural", "no-natural", "natural-step", "natural-momentum", "natural-damping", "natural-samples")
    },
}
"""Flags of before that nothing is in the place of → why."""


def gone(flag: str) -> str | None:
    """Why a flag of `difflcs train` of before is there no more; None if it is none."""
    return _GONE.get(flag) or _GONE.get(flag.replace("--mlp.", "--ppo."))


def renamed(flag: str) -> str | None:
    """What a flag of `difflcs train` or `evaluate` of before is called now; None if it is none."""
    for old, new in _RENAMED.items():
        if flag == old:
            return new
        if old.endswith(".") and flag.startswith(old):
            rest = flag.removeprefix(old)
            return renamed(f"{new}{rest}") or f"{new}{rest}"
    return None


def refuse_flags_of_before(words: Sequence[str]) -> None:
    """Say what became of flags of before.

    Args:
        words: of the command line, after the command.

    Raises:
        InvalidInputError: one of them is such a flag.
    """
    for word in words:
        flag = word.partition("=")[0].replace("_", "-")
        if reason := gone(flag):
            raise InvalidInputError(f"{flag}: expected a flag of today, got one of before, which is gone: {reason}")
        if new := renamed(flag):
            raise InvalidInputError(f"{flag}: expected a flag of today, got one of before; it is called {new} now")
