"""Fit of known physics to the episodes of its own MPC.

A task with known physics (`PhysicsSpec`) has a controller that works before anything is learned.
Its episodes, with some noise, are the data; the few numbers of the physics are fitted to all of them, and the next
episodes are better. A main phase may follow: PPO through the MPC (Algorithm 2), as in LCS-RL.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from difflcs.errors import InvalidInputError
from difflcs.losses import violation_loss
from difflcs.records import LCSModule, LCSParams, system_at
from difflcs.rl.learning.checks import check_depends, check_module
from difflcs.rl.learning.trainer import AfterStep, EpisodeTrainer
from difflcs.rl.rollout import Policy, contexts, mpc_actions, noisy_actions, transitions
from difflcs.rl.seeding import Stream
from difflcs.rl.settings import MOST_ENVS, Settings, bounded

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
    batch: int | None = bounded(None, minimum=1)
    """Transitions per step, drawn anew for each; None: all. A MuJoCo system takes 5 to 10 ms per transition."""
    learning_rate: float = bounded(0.02, above=0)
    """Step size of Adam, which begins anew in each iteration."""
    last_rate: float = bounded(1.0, above=0, maximum=1)
    """Fraction of it at the end of an iteration, to which it falls linearly."""
    explained: float | None = bounded(None, above=0, maximum=1)
    """Share of transitions that count by their loss, the others by its logarithm, so that impacts do not dominate;
    None: all count by their loss."""


def physics_loss(
    lcs: LCSModule,
    x: Tensor,
    u: Tensor,
    x_next: Tensor,
    scale: Tensor,
    explained: float | None = None,
    context: Tensor | None = None,
) -> Tensor:
    """Compute the loss of transitions of a system that depends on the state.

    Args:
        lcs: the module.
        x: (N, n_x) states.
        u: (N, n_u) actions.
        x_next: (N, n_x) next states.
        scale: (n_x,) units in which errors of the states count.
        explained: see `PhysicsFitSettings`.
        context: (N, n_context) or None.

    Returns:
        Scalar: the mean violation loss in units of `scale`; with `explained` a mean between the geometric and the
        arithmetic one.
    """
    system: Any = system_at(lcs, x, context)
    losses = violation_loss(_in_units(system, scale), x / scale, u, x_next / scale, "auto", _XI, reduction="none")
    if explained is None:
        return losses.mean()
    usual = losses.detach().quantile(explained).clamp(min=1e-12)
    return usual * (losses / usual).log1p().mean().expm1()


def _in_units(system: LCSParams, scale: Tensor) -> LCSParams:
    """Express a system in states x/scale."""
    column = scale.unsqueeze(-1)
    return replace(
        system,
        A=system.A * scale / column,
        B=system.B / column,
        C=system.C / column,
        d=system.d / scale,
        D=system.D * scale,
    )


@dataclass(frozen=True)
class PhysicsFitReport:
    """Report of one iteration.

    Attributes:
        iteration: its number, from 1.
        env_steps: environment steps collected so far.
        success: share of its episodes that ended at the goal, under noise.
        loss: before the last step of the fit.
        first_loss: before its first step, on the same data, or on another batch of it.
        solver_failures: MPC solves that did not converge.
        unstable: episodes dropped because the simulation broke down.
        collect_seconds: wall time of the episodes.
        learn_seconds: wall time of the fit.
    """

    iteration: int
    env_steps: int
    success: float
    loss: float
    first_loss: float
    solver_failures: int
    unstable: int
    collect_seconds: float
    learn_seconds: float


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
        self.lcs, self.settings = lcs, settings
        self.scale, self.total_episodes = scale, total_episodes

    def step(self, after_step: AfterStep | None = None) -> PhysicsFitReport:
        """One iteration: collect, then fit.

        Raises:
            InvalidInputError: all episodes are collected.
        """
        start = time.perf_counter()
        count = min(self.settings.rollouts, self.total_episodes - self.episodes)
        if count < 1:
            raise InvalidInputError(f"step: expected at most {self.total_episodes} episodes, all of them are done")
        noise = np.random.default_rng((self.seed, Stream.ACTION, self.iteration))
        act = noisy_actions(mpc_actions(self.policy), self.settings.noise, noise)
        episodes = self.collect(act, count, after_step)
        collected = time.perf_counter()
        losses = self._fit()
        self.iteration += 1
        return PhysicsFitReport(
            iteration=self.iteration,
            env_steps=self.env_steps,
            success=float(episodes["success"].double().mean()),
            loss=losses[-1],
            first_loss=losses[0],
            solver_failures=int(episodes["failures"].sum()),
            unstable=int((~episodes["stable"]).sum()),
            collect_seconds=collected - start,
            learn_seconds=time.perf_counter() - collected,
        )

    def _fit(self) -> list[float]:
        module: Any = self.lcs
        learned = [p for p in module.parameters() if p.requires_grad]
        adam = torch.optim.Adam(learned, self.settings.learning_rate)
        slower = torch.optim.lr_scheduler.LinearLR(adam, 1.0, self.settings.last_rate, self.settings.steps)
        data, context, losses = transitions(self.buffer), contexts(self.buffer), []
        random = np.random.default_rng((self.seed, Stream.MINIBATCH, self.iteration))
        size = min(self.settings.batch or len(data[0]), len(data[0]))
        for _ in range(self.settings.steps):
            chosen = torch.from_numpy(np.sort(random.choice(len(data[0]), size, replace=False)))
            x, u, x_next = (part[chosen] for part in data)
            known = None if context is None else context[chosen]
            loss = physics_loss(self.lcs, x, u, x_next, self.scale, self.settings.explained, known)
            check_depends(loss)
            adam.zero_grad()
            loss.backward()
            if all(bool(torch.isfinite(p.grad).all()) for p in learned if p.grad is not None):
                adam.step()
            slower.step()
            losses.append(float(loss.detach()))
        return losses
