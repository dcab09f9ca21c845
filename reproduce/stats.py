"""Intervals of 95 % that stay within 0 and 100 %, over goals, seeds and objects.

Over seeds and objects it is the stratified bootstrap of Agarwal et al. (Deep reinforcement learning at the edge of the
statistical precipice, 2021): seeds are drawn anew within each object. Their package rliable draws from NumPy's global
generator whatever generator it is given, and fails to import with pandas 3; SciPy's bootstrap does the same.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy import stats


class Estimate(NamedTuple):
    """A number and its interval; NaN where one seed says nothing about others."""

    value: float
    low: float = math.nan
    high: float = math.nan


def wilson(success: float, goals: int) -> Estimate:
    """Success [%] of one run, with Wilson's interval: what other goals would have given."""
    interval = stats.binomtest(round(success / 100 * goals), goals).proportion_ci(method="wilson")
    return Estimate(success, 100 * interval.low, 100 * interval.high)


IQM = partial(stats.trim_mean, proportiontocut=0.25)
"""Interquartile mean: of the middle half, which one failed or lucky run does not move."""


def bootstrap(strata: Sequence[Sequence[float]], statistic: Callable[..., np.ndarray] = np.mean) -> Estimate:
    """A statistic over all values, one per seed of each object, and what other seeds would have given."""
    value = float(statistic(np.concatenate(strata), axis=-1))
    if min(map(len, strata)) < 2:
        return Estimate(value)
    interval = stats.bootstrap(
        tuple(map(np.asarray, strata)),
        lambda *samples, axis: statistic(np.concatenate(samples, axis), axis=axis),
        n_resamples=5000,
        method="percentile",
        rng=np.random.default_rng(0),  # the same numbers give the same files
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))


def p_value(differences: Sequence[float]) -> float:
    """Two-sided p of the paired t-test; NaN for one seed."""
    rounded = np.round(differences, 6)  # or it would test rounding
    if len(rounded) < 2 or np.ptp(rounded) == 0:  # every seed differs by the same
        return math.nan if len(rounded) < 2 else float(rounded[0] == 0)
    test: Any = stats.ttest_1samp(rounded, 0.0)
    return float(test.pvalue)
