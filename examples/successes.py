"""Success figures that programs report which play benchmarks of others."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from difflcs.rl import wilson_interval


def success_figures(success: NDArray[np.floating]) -> dict[str, Any]:
    """Compute the success rate of episodes (N,), 1 or 0 each, with Wilson's 95 % interval, and their number."""
    low, high = wilson_interval(int(success.sum()), len(success))
    return {"success_rate": float(success.mean()), "ci_low": low, "ci_high": high, "episodes": len(success)}


def success_text(figures: dict[str, Any]) -> str:
    """Say the figures of `success_figures` in words."""
    rate, low, high = (100 * figures[name] for name in ("success_rate", "ci_low", "ci_high"))
    return f"{rate:.1f} % of {figures['episodes']} ({low:.1f} to {high:.1f})"
