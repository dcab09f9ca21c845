"""Fit of known physics to the episodes of its own MPC.

A task with known physics (`PhysicsSpec`) has a controller that works before anything is learned.
Its episodes, with some noise, are the data; the few numbers of the physics are fitted to all of them, and the next
episodes are better. A main phase may follow: PPO through the MPC (Algorithm 2), as in LCS-RL.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from difflcs._checks import check_kind
from difflcs.errors import InvalidInputError
from difflcs.losses import violation_loss
from difflcs.records import LCSModule, LCSParams, system_at
from difflcs.rl.learning.checks import check_depends, check_module
from difflcs.rl.learning.trainer import AfterStep, EpisodesReport, EpisodeTrainer
from difflcs.rl.rollout import Policy, contexts, mpc_actions, noisy_actions, transitions, uniform_actions, windows
from difflcs.rl.seeding import Stream
from difflcs.rl.settings import MOST_ENVS, Settings, bounded
from difflcs.scales import Scales

# Xi of the violation loss. From 0.001 to 0.2 made no difference to the sugar box: .975, .970 and .980 of 200 goals.
_XI = 0.02


@dataclass(frozen=True)
class PhysicsFitSettings(Settings):
    """Settings of the fit of known physics."""

    rollouts: int = bounded(15, minimum=1, maximum=MOST_ENVS)
    """Episodes per iteration."""
    noise: float = bounded(0.003, minimum=0)
    """Standard deviation [units of the action] of the Gaussian noise on executed actions."""
    steps: int = bounded(60, minimum=1)
    """Steps of Adam per iteration, on the data of the whole training."""
    learning_rate: float = bounded(0.02, above=0)
    """Step size of Adam, which begins anew in each iteration."""
    simulated: int | None = bounded(None, minimum=1)
    """Transitions of a MuJoCo model to which its own steps are fitted (`identify`), drawn from all in each iteration;
    None: the violation loss of all."""
    window: int = bounded(6, minimum=1)
    """Actions of each motion that is simulated."""
    random: int = bounded(0, minimum=0)
    """First iterations whose actions are uniformly random, instead of the MPC's."""


def physics_loss(
    lcs: LCSModule, x: Tensor, u: Tensor, x_next: Tensor, scale: Tensor, context: Tensor | None = None
) -> Tensor:
    """Compute the mean violation loss of x (N, n_x), u (N, n_u), x_next (N, n_x), in units `scale` (n_x,) of states."""
    units = Scales(torch.zeros_like(scale), 1 / scale, torch.ones_like(u[0]), 1.0, 1.0)
    system = units.params(check_kind("params", system_at(lcs, x, context), LCSParams))
    return violation_loss(system, x / scale, u, x_next / scale, "auto", _XI)


@dataclass(frozen=True)
class PhysicsFitReport(EpisodesReport):
    """Report of one iteration, whose loss is that before the last step of the fit; see `identify` for simulated motion.

    Attributes:
        first_loss: before its first step, on the same data.
    """

    first_loss: float


class PhysicsFit(EpisodeTrainer):
    """Trainer that alternates noisy episodes of the MPC with a fit to all of them, see `Trainer`.

    Args:
        lcs: the system to fit, in place; `policy` must use the same object.
        policy: the MPC around it.
        env: as many environments in lockstep as an iteration has episodes, or more.
        settings: settings.
        seed: of noise, goals and initial states.
        scale: (n_x,) see `PhysicsSpec`.
        total_episodes: of the whole training; the last iteration collects no more.
        episode_steps: steps of one episode.

    Raises:
        InvalidInputError: too few environments, or a module of other sizes than theirs.
        DTypeError: `lcs` is no module.
    """

    def __init__(
        self,
        lcs: LCSModule,
        policy: Policy,
        env: VectorEnv,
        settings: PhysicsFitSettings,
        seed: int,
        scale: Tensor,
        total_episodes: int,
        episode_steps: int,
    ):
        needed = min(settings.rollouts, total_episodes)
        super().__init__(check_module(lcs, env), policy, seed, episode_steps, env, needed)
        self.lcs: Any = lcs
        self.settings, self.scale, self.total_episodes = settings, scale, total_episodes

    def step(self, after_step: AfterStep | None = None) -> PhysicsFitReport:
        """One iteration: collect, then fit; an InvalidInputError where all episodes are collected."""
        count = min(self.settings.rollouts, self.total_episodes - self.episodes)
        if count < 1:
            raise InvalidInputError(f"step: expected at most {self.total_episodes} episodes, all of them are done")
        noise = np.random.default_rng((self.seed, Stream.ACTION, self.iteration))
        if self.iteration < self.settings.random:
            act = uniform_actions(self.env, noise, self.policy)
        else:
            act = noisy_actions(mpc_actions(self.policy), self.settings.noise, noise)
        self.collect(act, count, after_step)
        losses = self._fit() if self.settings.simulated is None else self._identify(self.settings.simulated)
        return self.report(PhysicsFitReport, losses[-1], first_loss=losses[0])

    def _fit(self) -> list[float]:
        learned = [p for p in self.lcs.parameters() if p.requires_grad]
        adam = torch.optim.Adam(learned, self.settings.learning_rate)
        x, u, x_next = transitions(self.buffer)
        context, losses = contexts(self.buffer), []
        for _ in range(self.settings.steps):
            loss = physics_loss(self.lcs, x, u, x_next, self.scale, context)
            check_depends(loss)
            adam.zero_grad()
            loss.backward()
            if all(bool(torch.isfinite(p.grad).all()) for p in learned if p.grad is not None):
                adam.step()
            losses.append(float(loss.detach()))
        return losses

    def _identify(self, simulated: int) -> list[float]:
        from difflcs.physics.mujoco import identify  # MuJoCo need not be installed

        window = min(self.settings.window, self.episode_steps)
        x, u = windows(self.buffer["state"], self.buffer["action"], window)
        random = np.random.default_rng((self.seed, Stream.MINIBATCH, self.iteration))
        chosen = random.choice(len(x), min(len(x), max(1, simulated // window)), replace=False)
        return identify(self.lcs, x[chosen], u[chosen])
