"""LCS-RL: the warm-up phase (Algorithm 1), then the main phase (Algorithm 2) from its model."""

from collections.abc import Callable
from typing import Any

from difflcs._checks import check_choice, check_positive_int
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl.learning.physics_fit import PhysicsFit, PhysicsFitReport
from difflcs.rl.learning.ppo import PPO, PPOReport
from difflcs.rl.learning.state_tree import State
from difflcs.rl.learning.trainer import AfterStep, Trainer
from difflcs.rl.learning.warmup import Warmup, WarmupReport

_WARMUP, _MAIN = "warmup", "main"


class LCSRL(Trainer):
    """Trainer that runs both phases, see `Trainer`.

    Args:
        warmup: the first phase.
        warmup_steps: environment steps after which the main phase starts.
        make_main: episodes and iterations done before → the second phase, around the same model.
    """

    def __init__(self, warmup: Warmup | PhysicsFit, warmup_steps: int, make_main: Callable[[int, int], PPO]):
        self.current: Any = warmup
        self._warmup, self._warmup_steps, self._make_main = warmup, warmup_steps, make_main
        super().__init__(warmup.learned, warmup.policy, warmup.seed, warmup.episode_steps)
        self._advance_phase()

    def _advance_phase(self) -> None:
        """Begin the main phase once the warm-up is over."""
        warmup = self._warmup
        if self.current is warmup and warmup.env_steps >= self._warmup_steps:
            self.current = self._make_main(warmup.episodes, warmup.iteration)
            self.current.remember(warmup.buffer)
        self.iteration, self.episodes = self.current.iteration, self.current.episodes

    def step(self, after_step: AfterStep | None = None) -> WarmupReport | PhysicsFitReport | PPOReport:
        """One iteration of the current phase."""
        report = self.current.step(after_step)
        self._advance_phase()
        return report

    def state_dict(self) -> dict[str, Any]:
        """See `Trainer`: the state of the current phase, and which one it is."""
        return {**self.current.state_dict(), "phase": _WARMUP if self.current is self._warmup else _MAIN}

    def load_state_dict(self, state: State) -> None:
        """See `Trainer`."""
        self.load(state)

    def load(self, state: State) -> None:
        """See `Trainer`."""
        inner = {name: value for name, value in state.items() if name != "phase"}
        current: Any = self._warmup
        try:
            if check_choice("phase", state.get("phase"), (_WARMUP, _MAIN)) == _MAIN:
                names = ("first_episode", "first_iteration")
                before = [check_positive_int(name, inner["settings"][name], minimum=0) for name in names]
                begun = [getattr(self.current, name, None) for name in names]  # a warm-up has neither
                current = self.current if begun == before else self._make_main(*before)
        except (InvalidInputError, KeyError, TypeError) as error:
            raise CheckpointError(
                f"checkpoint: expected the state of a warm-up or a main phase, got {sorted(state)} ({error}); was it "
                f"written by another method?"
            ) from error
        current.load(inner)
        self.current = current
        self.iteration, self.episodes = current.iteration, current.episodes
