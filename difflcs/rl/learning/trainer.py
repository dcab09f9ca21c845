"""Base class of the trainers, which can be stopped between iterations, saved, and resumed with the same result."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import nn

from difflcs import _storage
from difflcs._checks import check_positive_int, describe
from difflcs._modules import plain_state, untouched
from difflcs.errors import InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.rl.learning.state_tree import State, Stateful, restore
from difflcs.rl.rollout import (
    Act,
    Policy,
    append_episodes,
    collect,
    episodes_from_state,
    episodes_to_state,
    make_empty_record,
)
from difflcs.rl.seeding import Stream, episode_seeds

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

AfterStep = Callable[[int], object]
"""Called after every step of the environments with the number of episodes that were stepped, for progress bars."""


class Trainer(ABC):
    """Base of the trainers.

    Every random number comes from a stream of its own, derived from the seed; the global generators are left as they
    were.

    Args:
        learned: what to train, in place: an `LCSModel`, any other module, an ensemble of networks. It may also have
            `config()`, which returns what its class needs besides the tensors to build it again (JSON types only), and
            `save_pretrained(directory)`, which writes it into a directory, atomically.
        policy: acts by the model, without noise.
        seed: of everything random.
        episode_steps: steps of one episode.
    """

    def __init__(self, learned: Stateful, policy: Policy, seed: int, episode_steps: int):
        self.learned, self.policy = learned, policy
        self.seed = check_positive_int("seed", seed, minimum=0)
        self.episode_steps = check_positive_int("episode_steps", episode_steps)
        self.iteration = 0
        """Iterations done."""
        self.episodes = 0
        """Episodes collected."""

    @property
    def env_steps(self) -> int:
        """Environment steps collected so far."""
        return self.episodes * self.episode_steps

    @abstractmethod
    def step(self, after_step: AfterStep | None = None) -> Any:
        """One iteration; returns its report, a dataclass."""

    def state_dict(self) -> dict[str, Any]:
        """State from which to resume with the same result. Subclasses add to it."""
        return {"iteration": self.iteration, "collected": self.episodes, "learned": learned_state(self.learned)}

    def load_state_dict(self, state: State) -> None:
        """Resume from a state that the caller has checked, see `load`. Subclasses add to it."""
        self.iteration, self.episodes = state["iteration"], state["collected"]
        self.learned.load_state_dict(state["learned"]["parameters"])

    def load(self, state: State) -> None:
        """Go on from what `state_dict` gave.

        Raises:
            CheckpointError: it does not fit the settings or the model; nothing is changed.
        """
        restore(self, state)


@dataclass(frozen=True)
class EpisodesReport:
    """Report of one iteration that collects episodes and learns from them.

    Attributes:
        iteration: its number, from 1.
        env_steps: environment steps collected so far.
        success: share of its episodes that ended at the goal, with all noise and limits of collecting.
        loss: of what is learned, at the end.
        solver_failures: MPC solves that did not converge.
        unstable: episodes dropped because the simulation broke down.
        collect_seconds: wall time of the episodes.
        learn_seconds: wall time of learning.
    """

    iteration: int
    env_steps: int
    success: float
    loss: float
    solver_failures: int
    unstable: int
    collect_seconds: float
    learn_seconds: float


class EpisodeTrainer(Trainer):
    """Base of trainers that collect episodes and learn from those that they keep.

    Args:
        learned, policy, seed, episode_steps: see `Trainer`.
        env: as many environments in lockstep as an iteration has episodes, or more.
        episodes: most episodes of an iteration.

    Raises:
        InvalidInputError: too few environments, or a policy that plans with another model.
    """

    def __init__(self, learned: Stateful, policy: Policy, seed: int, episode_steps: int, env: VectorEnv, episodes: int):
        super().__init__(learned, policy, seed, episode_steps)
        if env.num_envs < episodes:
            raise InvalidInputError(f"env: expected at least {episodes} environments, got {env.num_envs}")
        acts: Any = getattr(policy, "lcs", None)
        parts = acts.modules() if isinstance(acts, nn.Module) else [acts]
        if acts is not None and all(part is not learned for part in parts):
            raise InvalidInputError(
                f"policy: expected an MPC around the model that is learned, got one around {describe(acts)} that is "
                f"another object; build it with this model"
            )
        self.env = env
        self.buffer = make_empty_record(env, episode_steps)
        """Episodes to learn from."""

    def collect(self, act: Act, count: int, after_step: AfterStep | None, kept: int | None = None) -> None:
        """Collect the next episodes of the training; the buffer then holds the newest `kept`, all if None."""
        seeds = episode_seeds(self.seed, Stream.TRAINING, self.episodes, count)
        report, start = None if after_step is None else lambda: after_step(count), time.perf_counter()
        self._newest = collect(self.env, act, seeds, self.episode_steps, report, self.policy)
        self._times = start, time.perf_counter()
        self.episodes += count
        self.buffer = append_episodes(self.buffer, self._newest, kept)

    def report(self, kind: type[EpisodesReport], loss: float, **more: Any) -> Any:
        """End an iteration that has learned from the newest episodes: make its report, with `more` of its fields."""
        self.iteration += 1
        start, collected = self._times
        return kind(
            iteration=self.iteration,
            env_steps=self.env_steps,
            success=float(self._newest["success"].double().mean()),
            loss=loss,
            solver_failures=int(self._newest["failures"].sum()),
            unstable=int((~self._newest["stable"]).sum()),
            collect_seconds=collected - start,
            learn_seconds=time.perf_counter() - collected,
            **more,
        )

    def state_dict(self) -> dict[str, Any]:
        """See `Trainer`."""
        return {**super().state_dict(), "episodes": episodes_to_state(self.buffer)}

    def load_state_dict(self, state: State) -> None:
        """See `Trainer`."""
        super().load_state_dict(state)
        self.buffer = episodes_from_state(state["episodes"])


def learned_state(learned: Stateful) -> dict[str, Any]:
    """Return the part of a state that holds the model."""
    state = {"settings": configuration(learned), "parameters": dict(learned.state_dict())}
    if isinstance(learned, LCSModel) and not untouched(learned):
        state["plain"] = plain_state(learned)  # for readers that cannot build it as it is
    return state


def configuration(learned: Stateful) -> dict[str, Any]:
    """Return the configuration of a model: its `config()`, or the name of its class and its sizes."""
    config: Any = getattr(learned, "config", None)
    if callable(config):
        return config()  # pyright: ignore[reportReturnType]
    sizes = {name: getattr(learned, name) for name in ("n_x", "n_u", "n_lam") if hasattr(learned, name)}
    return {"class": type(learned).__name__, **sizes}


def save_learned(learned: Stateful, directory: Path, kind: str | None = None) -> None:
    """Write a model into a directory, atomically: by its `save_pretrained`, else as a record of `kind` or its class."""
    save = getattr(learned, "save_pretrained", None)
    if callable(save):
        save(directory)
    else:
        tensors = plain_state(learned) if isinstance(learned, nn.Module) else learned.state_dict()
        _storage.save_record(directory, kind or type(learned).__name__, configuration(learned), tensors)
