"""Warm-up phase (Algorithm 1): collect episodes with the MPC, fit the LCS to them by the violation loss, repeat."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass
from types import UnionType
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import MOST_ENVS, check_number, check_positive_int
from difflcs._files import short
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.losses import violation_loss
from difflcs.rl.checkpoint import Checkpoint, check_episodes, kinds
from difflcs.rl.rollout import (
    Policy,
    Rollouts,
    action_bounds,
    collect,
    episode_seeds,
    mpc_actions,
    noisy_actions,
    uniform_actions,
)

TRAINING_STREAM = 0
"""Stream of `episode_seeds` for training episodes."""
_MINIBATCH_STREAM, _ACTION_STREAM = 2, 3


@dataclass(frozen=True)
class WarmupConfig:
    """Settings of the warm-up. The defaults reach 69 to 83 % success on the cube after 6 minutes of data (4 seeds)."""

    random_rollouts: int = 5
    """Episodes of uniformly random actions before the first training; none when starting from a trained model."""
    rollouts_per_iteration: int = 5
    """Episodes per iteration, run in lockstep."""
    buffer_rollouts: int = 200
    """Newest episodes kept for training."""
    noise: float = 0.003
    """Standard deviation [m] of the Gaussian noise on executed actions. Without it success peaks at 48 to 59 %."""
    trust_region: float = 0.9
    """While collecting, actions stay within mean ± trust_region · std of the buffer's actions; 0 turns this off."""
    trust_region_growth: float = 1.03
    """Factor on trust_region per iteration: nearly the full bounds after 6 minutes."""
    learning_rate: float = 1e-2
    """Adam's step size at the start of every training call; Adam is reset there."""
    learning_rate_decay: float = 0.99
    """Factor on the step size per step."""
    betas: tuple[float, float] = (0.9, 0.9)
    """Adam's averaging factors."""
    adam_eps: float = 1e-6
    """Adam's epsilon."""
    minibatch: int = 100
    """Transitions per step."""
    first_epochs: int = 400
    """Epochs on the random episodes."""
    epochs: int = 15
    """Epochs in each later iteration."""
    held_out: float = 0.2
    """Fraction of the transitions that a training call leaves out, drawn anew for each call."""
    gamma: float = 0.05
    """Gamma of the violation loss. The prior work's loss without ½, with gamma 0.1 and xi 0.01, is twice this one; Adam
    does not notice a factor."""
    xi: float = 0.02
    """Xi of the violation loss."""

    def __post_init__(self) -> None:
        for name in ("random_rollouts", "rollouts_per_iteration"):
            check_positive_int(name, getattr(self, name), maximum=MOST_ENVS)
        for name in ("buffer_rollouts", "minibatch", "first_epochs", "epochs"):
            check_positive_int(name, getattr(self, name))
        for name in ("noise", "trust_region"):
            check_number(name, getattr(self, name))
        for name in ("trust_region_growth", "learning_rate", "learning_rate_decay", "adam_eps", "gamma", "xi"):
            check_number(name, getattr(self, name), strict=True)
        if not all(0 <= beta < 1 for beta in self.betas):
            raise InvalidInputError(f"betas: expected 0 <= beta < 1 for both, got {self.betas}")
        if not 0 <= self.held_out < 1:
            raise InvalidInputError(f"held_out: expected 0 <= held_out < 1, got {self.held_out}")


def trust_region(actions: Tensor, scale: float, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds within which the model has seen actions: mean ± scale · std, intersected with [low, high].

    Args:
        actions: (..., n_u) executed actions, all within [low, high].
        scale: standard deviations on either side of the mean.
        low: (n_u,) lower bounds of the task.
        high: (n_u,) upper bounds of the task.

    Returns:
        Lower and upper bounds (n_u,); never crossed, because the mean lies within [low, high].
    """
    actions = actions.reshape(-1, actions.shape[-1])
    mean, std = actions.mean(0), actions.std(0, correction=0)
    return torch.maximum(mean - scale * std, low), torch.minimum(mean + scale * std, high)


@dataclass
class Fit:
    """What one training call did.

    Attributes:
        loss: mean of its last ten minibatch losses.
        held_out_loss: loss of the transitions it left out, after it; None without any.
        steps: gradient steps.
    """

    loss: float
    held_out_loss: float | None
    steps: int


def fit(
    lcs: LCSModel,
    x: Tensor,
    u: Tensor,
    x_next: Tensor,
    config: WarmupConfig,
    epochs: int,
    rng: np.random.Generator,
) -> Fit:
    """Fit a model to transitions by the violation loss, with a fresh Adam.

    Args:
        lcs: changed in place.
        x: (N, n_x) states.
        u: (N, n_u) actions.
        x_next: (N, n_x) next states.
        config: step size, minibatch, loss.
        epochs: passes over the data.
        rng: draws the split and the minibatches.

    Returns:
        Losses.
    """
    order = torch.from_numpy(rng.permutation(len(x)))
    n_train = max(1, int((1 - config.held_out) * len(x)))
    train, rest = order[:n_train], order[n_train:]
    size = min(config.minibatch, n_train)
    learned = [p for p in lcs.parameters() if p.requires_grad]
    # fused: 66 µs per step against 157 µs, beside 150 µs for the loss and its gradient.
    adam = torch.optim.Adam(learned, config.learning_rate, config.betas, config.adam_eps, fused=True)
    recent: list[Tensor] = []
    steps = 0
    for _ in range(epochs):
        shuffled = train[torch.from_numpy(rng.permutation(n_train))][: n_train - n_train % size]
        batches = zip(x[shuffled].split(size), u[shuffled].split(size), x_next[shuffled].split(size), strict=True)
        for x_batch, u_batch, next_batch in batches:
            loss = violation_loss(lcs, x_batch, u_batch, next_batch, config.gamma, config.xi)
            adam.zero_grad()
            loss.backward()
            adam.step()
            adam.param_groups[0]["lr"] *= config.learning_rate_decay
            recent = [*recent[-9:], loss.detach()]
            steps += 1
    with torch.no_grad():
        left_out = violation_loss(lcs, x[rest], u[rest], x_next[rest], config.gamma, config.xi) if len(rest) else None
    return Fit(float(torch.stack(recent).mean()), None if left_out is None else float(left_out), steps)


@dataclass(frozen=True)
class Iteration:
    """Report of one iteration.

    Attributes:
        iteration: its number, from 1.
        env_steps: environment steps collected so far.
        success: share of its episodes that ended at the goal, under noise and trust region.
        loss: see `Fit`.
        held_out_loss: see `Fit`.
        gradient_steps: in this iteration.
        trust_width: mean width of the action bounds [m].
        solver_failures: MPC solves that did not converge.
        unstable: episodes dropped because the simulation broke down.
        collect_seconds: wall time of the episodes.
        learn_seconds: wall time of the training call.
    """

    iteration: int
    env_steps: int
    success: float
    loss: float
    held_out_loss: float | None
    gradient_steps: int
    trust_width: float
    solver_failures: int
    unstable: int
    collect_seconds: float
    learn_seconds: float


class Warmup:
    """The warm-up phase as an object that can be stopped between iterations, saved, and resumed with the same result.

    Every random number comes from generators of its own, derived from the seed; the global ones are never touched.

    Args:
        lcs: the model; it is trained in place, and `policy` must use the same object.
        policy: the MPC around it.
        env: at least `config.rollouts_per_iteration` and `config.random_rollouts` environments in lockstep.
        config: settings.
        seed: of noise, minibatches, goals and initial states.
        episode_steps: steps of one episode.
        pretrained: the model is already useful: skip the random episodes and the long first training.
    """

    def __init__(
        self,
        lcs: LCSModel,
        policy: Policy,
        env,
        config: WarmupConfig,
        seed: int,
        episode_steps: int = 20,
        pretrained: bool = False,
    ):
        check_positive_int("seed", seed, minimum=0)
        needed = max(config.rollouts_per_iteration, config.random_rollouts)
        if env.num_envs < needed:
            raise InvalidInputError(f"env: expected at least {needed} environments, got {env.num_envs}")
        self.lcs, self.policy, self.env, self.config = lcs, policy, env, config
        self.seed, self.episode_steps, self.pretrained = seed, episode_steps, pretrained
        self.low, self.high = (torch.from_numpy(bound) for bound in action_bounds(env))
        self.iteration = 0
        self.episodes = 0
        self.states = torch.zeros(0, episode_steps + 1, lcs.n_x, dtype=torch.float64)
        self.actions = torch.zeros(0, episode_steps, lcs.n_u, dtype=torch.float64)
        self.goals = torch.zeros(0, *env.single_observation_space["goal"].shape, dtype=torch.float64)
        self.bounds = (self.low, self.high)
        """Action bounds of the last collected episodes."""
        self._action_rng = np.random.default_rng((seed, _ACTION_STREAM))
        self._minibatch_rng = np.random.default_rng((seed, _MINIBATCH_STREAM))

    @property
    def env_steps(self) -> int:
        """Environment steps collected so far."""
        return self.episodes * self.episode_steps

    def step(self, after_step: Callable[[int], object] | None = None) -> Iteration:
        """One iteration: collect, then learn.

        Args:
            after_step: called with the number of episodes stepped, for progress bars.
        """
        start = time.perf_counter()
        rollouts = self._collect(after_step)
        collected = time.perf_counter()
        self._add(rollouts)
        first = self.iteration == 0 and not self.pretrained
        x, u, x_next = self.states[:, :-1], self.actions, self.states[:, 1:]
        outcome = fit(
            self.lcs,
            x.reshape(-1, self.lcs.n_x),
            u.reshape(-1, self.lcs.n_u),
            x_next.reshape(-1, self.lcs.n_x),
            self.config,
            self.config.first_epochs if first else self.config.epochs,
            self._minibatch_rng,
        )
        self.iteration += 1
        return Iteration(
            iteration=self.iteration,
            env_steps=self.env_steps,
            success=float(rollouts.success.double().mean()),
            loss=outcome.loss,
            held_out_loss=outcome.held_out_loss,
            gradient_steps=outcome.steps,
            trust_width=float((self.bounds[1] - self.bounds[0]).mean()),
            solver_failures=rollouts.solver_failures,
            unstable=int((~rollouts.stable).sum()),
            collect_seconds=collected - start,
            learn_seconds=time.perf_counter() - collected,
        )

    def _collect(self, after_step: Callable[[int], object] | None) -> Rollouts:
        config = self.config
        random = self.iteration == 0 and not self.pretrained
        count = config.random_rollouts if random else config.rollouts_per_iteration
        seeds = episode_seeds(self.seed, TRAINING_STREAM, self.episodes, count)
        if random:
            act = uniform_actions(self.env, self._action_rng)
        else:
            if config.trust_region and len(self.actions):
                scale = config.trust_region * config.trust_region_growth ** (self.iteration - 1)
                self.bounds = trust_region(self.actions, scale, self.low, self.high)
            act = noisy_actions(mpc_actions(self.policy, *self.bounds), config.noise, self._action_rng)
        self.episodes += count
        report = None if after_step is None else lambda: after_step(count)
        return collect(self.env, act, seeds, self.episode_steps, report)

    def _add(self, rollouts: Rollouts) -> None:
        keep = self.config.buffer_rollouts
        self.states = torch.cat([self.states, rollouts.states[rollouts.stable]])[-keep:]
        self.actions = torch.cat([self.actions, rollouts.actions[rollouts.stable]])[-keep:]
        self.goals = torch.cat([self.goals, rollouts.goals[rollouts.stable]])[-keep:]
        if not len(self.states):
            raise InvalidInputError("env: expected a stable simulation, got NaN or a physics error in every episode")

    def checkpoint(self) -> Checkpoint:
        """Everything needed to go on with the same result."""
        state = {
            "episodes": self.episodes,
            "action_rng": self._action_rng.bit_generator.state,
            "minibatch_rng": self._minibatch_rng.bit_generator.state,
        }
        low, high = self.bounds
        tensors = {"states": self.states, "actions": self.actions, "goals": self.goals, "u_min": low, "u_max": high}
        return Checkpoint(self.iteration, self.lcs, state, tensors)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint.

        Raises:
            CheckpointError: it does not fit the settings or the model; nothing is changed.
        """
        n_x, n_u, steps = self.lcs.n_x, self.lcs.n_u, self.episode_steps
        shapes = {"states": (steps + 1, n_x), "actions": (steps, n_u), "goals": tuple(self.goals.shape[1:])}
        shapes |= {"u_min": (n_u,), "u_max": (n_u,)}
        wanted = {name: (shape, torch.float64) for name, shape in shapes.items()}
        batched = ("states", "actions", "goals")
        got, model = kinds(checkpoint.tensors, batched), checkpoint.model
        if got != wanted or model is None or model.config() != self.lcs.config():
            raise CheckpointError(
                f"checkpoint: expected {self.lcs.config()} with tensors {wanted}, got {model and model.config()} with "
                f"{got}; was it written with other settings?"
            )
        try:
            episodes = check_positive_int("episodes", checkpoint.state["episodes"], minimum=0)
            generators = [_generator(checkpoint.state[name]) for name in ("action_rng", "minibatch_rng")]
        except Exception as error:  # numpy refuses the state of a generator in many ways
            raise CheckpointError(f"checkpoint: its counters or generators cannot be used ({error!r})") from error
        check_episodes({name: checkpoint.tensors[name] for name in batched}, empty=checkpoint.iteration == 0)
        self.iteration, self.episodes = checkpoint.iteration, episodes
        self._action_rng, self._minibatch_rng = generators
        self.states, self.actions, self.goals = (checkpoint.tensors[name] for name in batched)
        self.bounds = (checkpoint.tensors["u_min"], checkpoint.tensors["u_max"])
        self.lcs.load_state_dict(model.state_dict())


def _generator(state: object) -> np.random.Generator:
    bits = np.random.PCG64()
    bits.state = state  # pyright: ignore[reportAttributeAccessIssue]
    return np.random.Generator(bits)


Config = TypeVar("Config")


def config_from_dict(values: Mapping[str, object], kind: type[Config]) -> Config:
    """Rebuild a configuration dataclass from JSON.

    Raises:
        CheckpointError: other fields than those of `kind`, or values that they cannot have.
    """
    wanted = get_type_hints(kind)
    if set(values) != set(wanted):
        raise CheckpointError(
            f"{kind.__name__}: expected the fields {sorted(wanted)}, got {short(sorted(values))}; "
            f"use the version of difflcs that wrote it"
        )
    plain: dict[str, Any] = {}
    for name, hint in wanted.items():
        value = values[name]
        if not _fits(value, dict if is_dataclass(hint) else hint):
            raise CheckpointError(
                f"{kind.__name__}: expected {name} of the type {hint}, got {short(value)}; restore config.json from a "
                f"copy"
            )
        plain[name] = tuple(value) if isinstance(value, list) else value
        if is_dataclass(hint):
            plain[name] = config_from_dict(plain[name], cast("type", hint))
    try:
        return kind(**plain)
    except InvalidInputError as error:
        raise CheckpointError(f"{kind.__name__}: its values cannot be used: {error}") from error


def _fits(value: object, hint: Any) -> bool:
    """Whether a value of JSON has the type that a field of a configuration says; lists stand for tuples."""
    parts, origin = get_args(hint), get_origin(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is tuple:
        inner = parts[:1] * len(value) if isinstance(value, list | tuple) and parts[-1] is Ellipsis else parts
        return isinstance(value, list | tuple) and len(value) == len(inner) and all(map(_fits, value, inner))
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, hint) and isinstance(value, bool) == (hint is bool)
