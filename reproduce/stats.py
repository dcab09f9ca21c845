"""Statistics over seeds: mean, standard deviation, t-interval, paired comparison."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_t

from difflcs.errors import ShapeError


@dataclass(frozen=True)
class Summary:
    """What several seeds say about one number.

    Attributes:
        n: seeds.
        mean: their mean.
        sd: their standard deviation (n − 1); NaN for one seed.
        low: lower end of the 95 % t-interval of the mean; NaN for one seed.
        high: its upper end.
    """

    n: int
    mean: float
    sd: float
    low: float
    high: float


def summarise(values: Sequence[float], confidence: float = 0.95) -> Summary:
    """Mean, standard deviation and t-interval: mean ± t(n − 1)·sd/√n."""
    n, mean = len(values), float(np.mean(values))
    if n < 2:
        return Summary(n, mean, math.nan, math.nan, math.nan)
    sd = float(np.std(values, ddof=1))
    half = float(student_t.ppf(0.5 + confidence / 2, n - 1)) * sd / math.sqrt(n)
    return Summary(n, mean, sd, mean - half, mean + half)


@dataclass(frozen=True)
class Comparison:
    """Paired t-test of a − b over seeds.

    Attributes:
        difference: the differences, summarised.
        p: two-sided p-value; NaN for one seed.
    """

    difference: Summary
    p: float


def compare(a: Sequence[float], b: Sequence[float]) -> Comparison:
    """Compare two methods that were run with the same seeds.

    Args:
        a: one number per seed.
        b: those of the other method, in the same order.

    Raises:
        ShapeError: they are not as many.
    """
    if len(a) != len(b):
        raise ShapeError(f"b: expected as many seeds as a, {len(a)}, got {len(b)}; pair them by seed")
    difference = summarise(np.subtract(a, b).tolist())
    if difference.n < 2:
        return Comparison(difference, math.nan)
    if difference.sd == 0:  # every seed differs by the same
        return Comparison(difference, 1.0 if difference.mean == 0 else 0.0)
    t = difference.mean / (difference.sd / math.sqrt(difference.n))
    return Comparison(difference, 2 * float(student_t.sf(abs(t), difference.n - 1)))
