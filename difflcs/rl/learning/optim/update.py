"""Update rules of PPO: the natural gradient or Adam, with a step size that follows the KL divergence.

The step size follows the KL divergence that an iteration has reached. Large steps make PPO work here: a KL of 0.005 per
iteration gains little, 0.03 to 0.1 gains 15 points of success.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from difflcs.errors import CheckpointError
from difflcs.rl.learning.checks import check_depends, check_learned
from difflcs.rl.learning.optim.natural import DAMPING, MOMENTUM, Natural, NaturalGradient
from difflcs.rl.learning.state_tree import State, StatefulAdam
from difflcs.rl.settings import Adam

if TYPE_CHECKING:
    from tensordict import TensorDict

    from difflcs.rl.learning.policy import GaussianPolicy, LCSMPCPolicy


METRIC_SAMPLES = 300
"""Samples per iteration that the metric of the natural gradient is measured with."""


class StepSize:
    """A step size that grows below half of a KL divergence and shrinks above one and a half of it.

    Args:
        value: at the start.
        target_kl: KL divergence per iteration that is aimed at.
        factor: by which it grows or shrinks after an iteration; 1: it stays.
        longest: it does not grow beyond this.
    """

    def __init__(self, value: float, target_kl: float, factor: float, longest: float = math.inf):
        self.value, self.target_kl, self.factor, self.longest = value, target_kl, factor, longest

    def adapt(self, kl: float) -> None:
        """Follow the KL divergence of an iteration. It grows with the square of a step: divide annealing out before."""
        if kl > 1.5 * self.target_kl:
            self.value = self.value / self.factor
        elif kl < 0.5 * self.target_kl:
            self.value = min(self.value * self.factor, max(self.longest, self.value))


class Deviation:
    """Adam for the logarithms of a policy's standard deviations (and its correlations), which stay within bounds.

    Args:
        actor: the policy; where its covariance is fixed, nothing is done.
        learning_rate: step size.
        betas: Adam's averaging factors.
        limits: bounds of the standard deviations [units of the action].
    """

    def __init__(
        self, actor: GaussianPolicy, learning_rate: float, betas: tuple[float, float], limits: tuple[float, float]
    ):
        self.log_std = actor.gaussian.log_std
        self.parameters = [p for p in (self.log_std, actor.gaussian.mixing) if p.requires_grad]
        self.learning_rate, self._limits = learning_rate, (math.log(limits[0]), math.log(limits[1]))
        self.adam = StatefulAdam(self.parameters, learning_rate, betas=betas) if self.parameters else None

    def step(self, scale: float) -> None:
        """Take one step."""
        if self.adam is not None:
            self.adam.param_groups[0]["lr"] = scale * self.learning_rate
            self.adam.step()
            with torch.no_grad():
                self.log_std.clamp_(*self._limits)

    def state_dict(self) -> dict[str, Any]:
        """State of the optimiser, without the parameters."""
        return {} if self.adam is None else self.adam.state_dict()

    def load_state_dict(self, state: State) -> None:
        """Go on from what `state_dict` gave."""
        if self.adam is not None:
            self.adam.load_state_dict(state)


class UpdateRule:
    """Base of the rules that move a policy by the gradients of a loss.

    Args:
        learned: parameters behind the mean of the policy.
        optimiser: moves them.
        size: size of its steps.
        deviation: moves the covariance.
    """

    def __init__(
        self, learned: Sequence[nn.Parameter], optimiser: torch.optim.Optimizer, size: StepSize, deviation: Deviation
    ):
        self.optimiser, self.size, self.deviation = optimiser, size, deviation
        self.parameters = [*learned, *deviation.parameters]

    def measure(self, data: TensorDict, rng: np.random.Generator) -> None:
        """Look at the data of an iteration before its first step."""

    def step(self, loss: torch.Tensor, scale: float) -> bool:
        """Take one step down a loss; return False, without a step, if a gradient is not finite."""
        check_depends(loss)
        for p in self.parameters:
            p.grad = None
        loss.backward()
        if not all(p.grad is None or bool(torch.isfinite(p.grad).all()) for p in self.parameters):
            return False
        self.optimiser.param_groups[0]["lr"] = scale * self.size.value
        self.optimiser.step()
        self.deviation.step(scale)
        return True

    def state_dict(self) -> dict[str, Any]:
        """State of the optimiser, without the parameters."""
        return {
            "step_size": self.size.value,
            "optimiser": self.optimiser.state_dict(),
            "deviation": self.deviation.state_dict(),
        }

    def load_state_dict(self, state: State) -> None:
        """Go on from what `state_dict` gave.

        Raises:
            CheckpointError: a step size that is not positive.
        """
        if not state["step_size"] > 0:
            raise CheckpointError(
                f"checkpoint: expected a positive step size, got {state['step_size']}; is it damaged?"
            )
        self.size.value = state["step_size"]
        self.optimiser.load_state_dict(dict(state["optimiser"]))
        self.deviation.load_state_dict(state["deviation"])


def learned_parameters(actor: GaussianPolicy) -> list[nn.Parameter]:
    """Return the learned parameters of the model behind the mean of a policy.

    Raises:
        InvalidInputError, DTypeError: the model is fixed, or no `torch.nn.Module`.
    """
    return [p for p in check_learned(actor.learned).parameters() if p.requires_grad]


class AdamUpdate(UpdateRule):
    """Adam, for any policy.

    Args:
        actor: the policy.
        settings: step size at the start, averaging factors; its moments are kept across iterations.
        target_kl: see `StepSize`.
        factor: see `StepSize`.
        deviation: moves the covariance.
    """

    def __init__(self, actor: GaussianPolicy, settings: Adam, target_kl: float, factor: float, deviation: Deviation):
        learned = learned_parameters(actor)
        adam = StatefulAdam(learned, settings.learning_rate, betas=settings.betas)
        super().__init__(learned, adam, StepSize(settings.learning_rate, target_kl, factor), deviation)


class NaturalUpdate(UpdateRule):
    """The natural gradient, for a policy that knows its Jacobian: one with an MPC.

    No step is longer than the KL divergence of a whole iteration: where all actions are at their bounds there is none,
    whatever the step.

    Args:
        actor: the policy.
        settings: settings.
        target_kl: see `StepSize`.
        factor: see `StepSize`.
        deviation: moves the covariance.
        samples: samples per iteration that the metric is measured with.
    """

    optimiser: NaturalGradient

    def __init__(
        self,
        actor: LCSMPCPolicy,
        settings: Natural,
        target_kl: float,
        factor: float,
        deviation: Deviation,
        samples: int = METRIC_SAMPLES,
    ):
        learned = learned_parameters(actor)
        natural = NaturalGradient(learned, settings.step, MOMENTUM, DAMPING)
        super().__init__(
            learned, natural, StepSize(settings.step, target_kl, factor, math.sqrt(2 * target_kl)), deviation
        )
        self.actor, self.samples = actor, samples

    def measure(self, data: TensorDict, rng: np.random.Generator) -> None:
        """Measure the metric at some of the samples."""
        chosen = torch.from_numpy(rng.permutation(len(data))[: self.samples])
        part: Any = data[chosen]
        self.optimiser.measure(self.actor.jacobian(part))
