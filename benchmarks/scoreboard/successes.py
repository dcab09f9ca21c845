"""Success figures that every scoreboard reports."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from difflcs.rl import wilson_interval


def success_figures(success: NDArray[np.floating]) -> dict[str, Any]:
    """Compute the success rate of episodes (N,), 1 or 0 each, with Wilson's 95 % interval, and their number."""
    low, high = wilson_interval(int(success.sum()), len(success))
    return {"success_rate": float(success.mean()), "ci_low": low, "ci_high": high, "episodes": len(success)}
