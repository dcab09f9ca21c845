"""What a long work shows of its progress: a bar on a terminal, plain lines elsewhere.

The lines are records of the logger "difflcs": `logging.basicConfig(level=logging.INFO)` shows them in a program of
one's own, and the command line shows them by itself.
"""

from __future__ import annotations

import logging
import sys
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from difflcs._optional import require
from difflcs.rl.runs.evaluate import Evaluation
from difflcs.rl.runs.training import ITERATIONS, Reporter, notable

if TYPE_CHECKING:
    from tqdm import tqdm

LIBRARY = logging.getLogger("difflcs")
_LOG = logging.getLogger(__name__)
_SECONDS = 5.0
"""Between two lines about one work."""


def bar(total: int, label: str) -> tqdm | Lines:
    """A progress bar on a terminal, a line every few seconds elsewhere."""
    if not sys.stderr.isatty():
        return Lines(total, label)
    require("tqdm")
    from tqdm import tqdm

    return tqdm(total=total, desc=label, unit="step", dynamic_ncols=True, leave=False)


class Lines:
    """Stands for a progress bar where there is no terminal."""

    def __init__(self, total: int, label: str):
        self.total, self.label, self.done, self.last = total, label, 0, time.monotonic()

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is open."""

    def update(self, count: int) -> None:
        """Count what was done, and say it now and then."""
        self.done += count
        now = time.monotonic()
        if now - self.last >= _SECONDS:
            self.last = now
            _LOG.info("%s: %d of %d steps", self.label, self.done, self.total)


class Progress(Reporter):
    """A progress bar on a terminal. Elsewhere it shows nothing: what `train` logs is enough.

    On a terminal the bar stands for the lines about iterations, and other lines appear above it.
    """

    def __init__(self) -> None:
        self.bar: tqdm | None = None
        self._held = ExitStack()

    def __enter__(self) -> Progress:
        if sys.stderr.isatty():
            require("tqdm")
            from tqdm.contrib.logging import logging_redirect_tqdm

            self._held.enter_context(logging_redirect_tqdm([LIBRARY]))
            self._held.callback(ITERATIONS.setLevel, ITERATIONS.level)
            ITERATIONS.setLevel(logging.WARNING)
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()
        self._held.close()

    def started(self, done: int, total: int) -> None:
        """Open the bar."""
        if sys.stderr.isatty():
            from tqdm import tqdm

            self.bar = tqdm(initial=done, total=total, desc="training", unit="step", dynamic_ncols=True, leave=False)

    def stepped(self, env_steps: int) -> None:
        """Move it."""
        if self.bar is not None:
            self.bar.update(env_steps)

    def iterated(self, report: Any) -> None:
        """Show loss, KL divergence and success beside it."""
        if self.bar is not None:
            self.bar.set_postfix(notable(report))

    def evaluating(self, minutes: float, goals: int) -> None:
        """Say that an evaluation runs."""
        if self.bar is not None:
            self.bar.set_description(f"evaluating {goals} goals")

    def evaluated(self, minutes: float, result: Evaluation) -> None:
        """Say that it is over."""
        if self.bar is not None:
            self.bar.set_description("training")
