"""A training, stopped at some minutes of data to see what it has learned: for `objects.py` and `training_time.py`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from typing import Any

from difflcs.rl import Evaluation, Method, TaskSpec, Trainer, evaluate
from difflcs.rl.methods import Work


class Training:
    """One training on one core, with its environments; use it as a context manager.

    Args:
        task: what is learned.
        method: how, with its settings.
        seed: of the training.
        minutes: of data.
        envs: environments side by side in evaluations.
    """

    def __init__(self, task: TaskSpec, method: Method, seed: int, minutes: float, envs: int):
        self.task, self.per_minute = task, task.steps_per_minute / task.episode_steps
        self._opened = ExitStack()
        self.envs = self._make_envs(envs)
        work = Work(task, seed, round(minutes * self.per_minute), self._make_envs)
        self.trainer: Trainer = method.trainer(work)

    def _make_envs(self, count: int) -> Any:
        return self._opened.enter_context(closing(self.task.make_envs(count, threads=1)))

    def __enter__(self) -> Training:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def at(self, minutes: Sequence[float]) -> Iterator[tuple[float, float]]:
        """Train, and stop whenever so many minutes of data are there: these minutes, and CPU seconds so far."""
        spent = 0.0
        for stop in sorted(minutes):
            begun = time.process_time()
            while self.trainer.episodes < round(stop * self.per_minute):
                self.trainer.step()
            spent += time.process_time() - begun
            yield stop, spent

    def evaluate(self, goals: int, seed: int) -> Evaluation:
        """Success without noise, of what is learned so far."""
        return evaluate(self.envs, self.trainer.policy, goals, seed, self.task.episode_steps)
