"""LCS-RL: the warm-up phase (Algorithm 1), then the main phase (Algorithm 2) from its model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from difflcs._checks import check_choice, check_positive_int
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl.checkpoint import Checkpoint
from difflcs.rl.warmup import Iteration, Warmup

if TYPE_CHECKING:
    from difflcs.rl.ppo import PPO, PPOIteration

_WARMUP, _MAIN = "warmup", "main"


class LCSRL:
    """Both phases as one object that can be stopped between iterations, saved, and resumed with the same result.

    Args:
        warmup: the first phase.
        warmup_steps: environment steps after which the main phase starts.
        make_main: episodes and iterations done before → the second phase, around the same model.
    """

    def __init__(self, warmup: Warmup, warmup_steps: int, make_main: Callable[[int, int], PPO]):
        self.current: Warmup | PPO = warmup
        self._warmup, self._warmup_steps, self._make_main = warmup, warmup_steps, make_main
        self.lcs, self.policy = warmup.lcs, warmup.policy
        self._switch()

    @property
    def iteration(self) -> int:
        """Iterations done, of both phases."""
        return self.current.iteration

    @property
    def env_steps(self) -> int:
        """Environment steps collected so far."""
        return self.current.env_steps

    def step(self, after_step: Callable[[int], object] | None = None) -> Iteration | PPOIteration:
        """One iteration of the current phase."""
        outcome = self.current.step(after_step)
        self._switch()
        return outcome

    def _switch(self) -> None:
        if self.current is self._warmup and self.env_steps >= self._warmup_steps:
            warmup = self._warmup
            self.current = self._make_main(warmup.episodes, warmup.iteration)
            if self.current.imagination is not None:
                self.current.imagination.add(warmup.states, warmup.actions, warmup.goals)

    def checkpoint(self) -> Checkpoint:
        """Everything needed to go on with the same result."""
        inner = self.current.checkpoint()
        phase = _WARMUP if self.current is self._warmup else _MAIN
        return replace(inner, state={**inner.state, "phase": phase})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint.

        Raises:
            CheckpointError: it does not fit the settings or the model.
        """
        phase = checkpoint.state.get("phase")
        if phase == _WARMUP:
            self._warmup.restore(checkpoint)
            self.current = self._warmup
            return
        names = ("first_episode", "first_iteration")
        try:
            episodes, iterations = (check_positive_int(name, checkpoint.state.get(name), minimum=0) for name in names)
            check_choice("phase", phase, (_MAIN,))
        except InvalidInputError as error:
            raise CheckpointError(
                f"checkpoint: expected the state of a warm-up or a main phase, got {sorted(checkpoint.state)} "
                f"({error}); was it written by another method?"
            ) from error
        main = self._make_main(episodes, iterations)
        main.restore(checkpoint)
        self.current = main
