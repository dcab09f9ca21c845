"""LCS-RL with physics inside: a system whose contacts follow the state, learned from what its own MPC does.

A task that says what is known of its physics (`PhysicsSpec`) gives a controller that works before anything is learned.
Its episodes, with some noise, are the data; the few numbers of the physics are fitted to all of them, and the next
episodes are better. A main phase may follow: PPO through the MPC (Algorithm 2), as in LCS-RL.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor

from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.lcp import solve_lcp
from difflcs.lcs import LCSModule, LCSParams
from difflcs.losses import violation_loss
from difflcs.mpc import LCSMPCLayer
from difflcs.mpc.backends import get_backend
from difflcs.records import system_at
from difflcs.rl.lcs_rl import LCSRL
from difflcs.rl.learned import check_depends, check_module
from difflcs.rl.methods import Method, Work, main_phase, register_method, short_main, short_models
from difflcs.rl.model_rollouts import ModelRolloutSettings
from difflcs.rl.ppo import PPOReport
from difflcs.rl.ppo_settings import PPOSettings
from difflcs.rl.rollout import (
    Policy,
    collect,
    contexts,
    episodes_from,
    episodes_state,
    extended,
    mpc_actions,
    no_episodes,
    noisy_actions,
    transitions,
)
from difflcs.rl.seeding import Stream, episode_seeds
from difflcs.rl.settings import MOST_ENVS, Settings, bounded, group
from difflcs.rl.state import State
from difflcs.rl.tasks import PhysicsSpec, TaskSpec, one_start
from difflcs.rl.trainer import AfterStep, Trainer, configuration

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv


# Xi of the violation loss. From 0.001 to 0.2 made no difference to the sugar box: .975, .970 and .980 of 200 goals.
_XI = 0.02


@dataclass(frozen=True)
class PhysicsFitSettings(Settings):
    """How the numbers of a physics are fitted."""

    rollouts: int = bounded(15, minimum=1, maximum=MOST_ENVS)
    """Episodes per iteration."""
    noise: float = bounded(0.003, minimum=0)
    """Standard deviation [units of the action] of the Gaussian noise on executed actions."""
    steps: int = bounded(60, minimum=1)
    """Steps of Adam per iteration, each on all data of the training."""
    learning_rate: float = bounded(0.02, above=0)
    """Step size of Adam, which begins anew in each iteration."""
    loss: Literal["violation", "prediction"] = "violation"
    """The violation loss, or the squared error of the next state through the relaxed contacts."""


def physics_loss(
    lcs: LCSModule,
    x: Tensor,
    u: Tensor,
    x_next: Tensor,
    scale: Tensor,
    settings: PhysicsFitSettings,
    relaxation: float,
    context: Tensor | None = None,
) -> Tensor:
    """The loss of transitions whose system follows the state.

    Args:
        lcs: the module.
        x: (N, n_x) states.
        u: (N, n_u) actions.
        x_next: (N, n_x) next states.
        scale: (n_x,) units in which errors of the states count.
        settings: which loss.
        relaxation: λ·s of the prediction; that of the MPC, so that it is the motion the MPC plans with.
        context: (N, n_context) or none.

    Returns:
        Scalar: half of the mean squared error in units of `scale`, or the mean violation loss in these units.
    """
    system: Any = system_at(lcs, x, context)
    if settings.loss == "violation":
        return violation_loss(_in_units(system, scale), x / scale, u, x_next / scale, "auto", _XI)
    lam = solve_lcp(system.F, system.gap(x, u), relaxation=relaxation).lam
    return 0.5 * ((system.next_state(x, u, lam) - x_next) / scale).square().sum(-1).mean()


def _in_units(system: LCSParams, scale: Tensor) -> LCSParams:
    """The system of states x/scale."""
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
        first_loss: before its first step, on the same data.
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


class PhysicsFit(Trainer):
    """Episodes of the MPC with noise, a fit to all of them, and again; see `Trainer`.

    Args:
        lcs: what is fitted, in place; `policy` must use the same object.
        policy: the MPC around it.
        env: as many environments in lockstep as an iteration has episodes, or more.
        settings: settings.
        seed: of noise, goals and initial states.
        scale: (n_x,) see `PhysicsSpec`.
        relaxation: of the MPC.
        total_episodes: of the whole training; the last iteration collects no more.
        episode_steps: steps of one episode.

    Raises:
        InvalidInputError: too few environments, or a module of other sizes than theirs.
        DTypeError: something else instead of a module.
    """

    def __init__(
        self,
        lcs: LCSModule,
        policy: Policy,
        env: VectorEnv,
        settings: PhysicsFitSettings,
        seed: int,
        scale: Tensor,
        relaxation: float,
        total_episodes: int,
        episode_steps: int,
    ):
        super().__init__(check_module(lcs, env), policy, seed, episode_steps)
        if env.num_envs < min(settings.rollouts, total_episodes):
            raise InvalidInputError(f"env: expected at least {settings.rollouts} environments, got {env.num_envs}")
        self.lcs, self.env, self.settings = lcs, env, settings
        self.scale, self.relaxation, self.total_episodes = scale, relaxation, total_episodes
        self.buffer = no_episodes(env, episode_steps)
        """All episodes."""

    def step(self, after_step: AfterStep | None = None) -> PhysicsFitReport:
        """One iteration: collect, then fit.

        Raises:
            InvalidInputError: all episodes are collected.
        """
        start = time.perf_counter()
        count = min(self.settings.rollouts, self.total_episodes - self.episodes)
        if count < 1:
            raise InvalidInputError(f"step: expected at most {self.total_episodes} episodes, all of them are done")
        seeds = episode_seeds(self.seed, Stream.TRAINING, self.episodes, count)
        noise = np.random.default_rng((self.seed, Stream.ACTION, self.iteration))
        act = noisy_actions(mpc_actions(self.policy), self.settings.noise, noise)
        report = None if after_step is None else lambda: after_step(count)
        episodes = collect(self.env, act, seeds, self.episode_steps, report)
        self.episodes += count
        self.buffer = extended(self.buffer, episodes)
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
        data, context, losses = transitions(self.buffer), contexts(self.buffer), []
        for _ in range(self.settings.steps):
            loss = physics_loss(self.lcs, *data, self.scale, self.settings, self.relaxation, context)
            check_depends(loss)
            adam.zero_grad()
            loss.backward()
            if all(bool(torch.isfinite(p.grad).all()) for p in learned if p.grad is not None):
                adam.step()
            losses.append(float(loss.detach()))
        return losses

    def state_dict(self) -> dict[str, Any]:
        """See `Trainer`."""
        return {**super().state_dict(), "episodes": episodes_state(self.buffer)}

    def load_state_dict(self, state: State) -> None:
        """See `Trainer`."""
        super().load_state_dict(state)
        self.buffer = episodes_from(state["episodes"])


@register_method
@dataclass(frozen=True)
class ContactMethod(Method):
    """LCS-RL with physics inside: known contacts, a dozen numbers fitted to the MPC's own episodes, then PPO."""

    fit_minutes: float = bounded(3.0, above=0, maximum=1e6)
    """Data of the fit [min]; what is left is that of PPO through the MPC."""
    fit: PhysicsFitSettings = group(PhysicsFitSettings)
    """Settings of the fit."""
    ppo: PPOSettings = group(PPOSettings)
    """Settings of PPO."""
    models: ModelRolloutSettings = group(ModelRolloutSettings)
    """Settings of the model rollouts of PPO."""
    backend: str = "batched"
    """MPC solver: batched, or ipopt, the reference."""

    name: ClassVar[str] = "contact-lcs"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "known contacts whose physics is fitted, then PPO through the MPC; told the outline"
    reports: ClassVar[tuple[type, ...]] = (PhysicsFitReport, PPOReport)
    kind: ClassVar[str] = "physics"

    @property
    def solver(self) -> str:
        """See `Method`."""
        return self.backend

    def check(self, minutes: float) -> None:
        """See `Method`."""
        get_backend(self.backend)

    def trainer(self, work: Work) -> Trainer:
        """See `Method`.

        Raises:
            InvalidInputError: nothing is known of the task's physics.
        """
        task, spec = work.task, known_physics(work.task)
        lcs = spec.make_system()
        policy = self.policy(task, lcs)
        first = max(1, round(self.fit_minutes * task.steps_per_minute / task.episode_steps))
        count = min(first, work.total_episodes)
        scale = torch.tensor(spec.scale, dtype=torch.float64)
        envs = work.make_envs(min(self.fit.rollouts, count))
        fit = PhysicsFit(lcs, policy, envs, self.fit, work.seed, scale, policy.relaxation, count, task.episode_steps)
        if count == work.total_episodes:
            return fit
        return LCSRL(
            fit,
            count * task.episode_steps,
            lambda episodes, iterations: main_phase(work, policy, self.ppo, self.models, episodes, iterations),
        )

    def rebuild(
        self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str
    ) -> LCSModule:
        """See `Method`."""
        lcs = known_physics(task).make_system()
        if not _alike(dict(config), configuration(lcs)):
            raise CheckpointError(
                f"{source}: expected what is known of task {task.name} to be as when it was learned, got another "
                f"physics; is the object's mesh there in one place, and a stand-in in the other?"
            )
        own = lcs.state_dict()
        shapes = {name: tuple(value.shape) for name, value in own.items()}
        if shapes != {name: tuple(value.shape) for name, value in tensors.items()}:
            raise CheckpointError(f"{source}: expected tensors {shapes}, got others; the file is foreign or corrupt")
        for name, value in tensors.items():
            if value.dtype != own[name].dtype or not bool(torch.isfinite(value).all()):
                raise CheckpointError(f"{source}: expected finite {own[name].dtype} values in {name}; is it damaged?")
        lcs.load_state_dict(dict(tensors))
        return lcs

    def policy(self, task: TaskSpec, learned: LCSModule) -> LCSMPCLayer:
        """See `Method`: the MPC as `PhysicsSpec` says."""
        return task.make_policy(learned, one_start(self.backend), known_physics(task))

    def smoke(self) -> Self:
        """See `Method`."""
        return replace(
            self,
            fit_minutes=min(self.fit_minutes, 0.2),
            fit=replace(self.fit, rollouts=min(self.fit.rollouts, 3), steps=min(self.fit.steps, 3)),
            ppo=short_main(self.ppo),
            models=short_models(self.models),
        )


def _alike(one: Any, other: Any) -> bool:
    """Whether two configurations are equal but for rounding, which another machine may do differently."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_alike(value, other[name]) for name, value in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_alike, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-9)
    return type(one) is type(other) and one == other


def known_physics(task: TaskSpec) -> PhysicsSpec:
    """What is known of a task's physics.

    Raises:
        InvalidInputError: nothing.
    """
    if task.physics is None:
        raise InvalidInputError(
            f"method: expected a task with known physics for {ContactMethod.name}, got {task.name} without; give its "
            f"TaskSpec a PhysicsSpec, or learn it by lcs-rl"
        )
    return task.physics
