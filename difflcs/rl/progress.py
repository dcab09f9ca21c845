"""What a terminal shows of a long work."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from difflcs.rl._optional import require
from difflcs.rl.evaluate import Evaluation
from difflcs.rl.training import Reporter

if TYPE_CHECKING:
    from tqdm import tqdm


def bar(total: int, label: str) -> tqdm:
    """A progress bar on a terminal, nothing elsewhere."""
    require("tqdm")
    from tqdm import tqdm

    return tqdm(total=total, desc=label, unit="step", disable=None, dynamic_ncols=True, leave=False)


class Progress(Reporter):
    """A progress bar on a terminal, and a line per evaluation everywhere."""

    def __init__(self) -> None:
        self.bar: tqdm | None = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def started(self, done: int, total: int) -> None:
        """Open the bar."""
        self.bar = bar(total, "training")
        self.bar.update(done)

    def stepped(self, env_steps: int) -> None:
        """Move it."""
        if self.bar is not None:
            self.bar.update(env_steps)

    def iterated(self, report: Any) -> None:
        """Show loss, KL divergence and success beside it."""
        if self.bar is not None:
            names = [name for name in ("loss", "kl", "success") if hasattr(report, name)]
            self.bar.set_postfix({name: f"{getattr(report, name):.2g}" for name in names})

    def evaluating(self, minutes: float, goals: int) -> None:
        """Say that an evaluation runs."""
        if self.bar is not None:
            self.bar.set_description(f"evaluating {goals} goals")

    def evaluated(self, minutes: float, result: Evaluation) -> None:
        """Print the success rate."""
        if self.bar is not None:
            self.bar.set_description("training")
            self.bar.clear()
        print(f"{minutes:4.1f} min of data: {summary(result)}", flush=True)


def summary(result: Evaluation) -> str:
    """An evaluation in one line."""
    failures = f"{result.solver_failures} of {result.solves} solves failed"
    return f"success {result}, {failures}" + (f", {result.unstable} episodes unstable" if result.unstable else "")
