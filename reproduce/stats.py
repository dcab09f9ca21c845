"""Intervals of 95 % that stay within 0 and 100 %, over goals, seeds and objects.

Over seeds and objects it is the stratified bootstrap of Agarwal et al. (Deep reinforcement learning at the edge of the
statistical precipice, 2021): seeds are drawn anew within each object. Their package rliable draws from NumPy's global
generator whatever generator is passed, and fails to import with pandas 3; SciPy's bootstrap does the same.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import stats


class Estimate(NamedTuple):
    """A number and its interval; NaN where one seed says nothing about others."""

    value: float
    low: float = math.nan
    high: float = math.nan


def wilson(success: float, goals: int) -> Estimate:
    """Compute the success [%] of one run with Wilson's interval, for other goals."""
    interval = stats.binomtest(round(success / 100 * goals), goals).proportion_ci(method="wilson")
    return Estimate(success, 100 * interval.low, 100 * interval.high)


IQM = partial(stats.trim_mean, proportiontocut=0.25)
"""Interquartile mean: of the middle half, which one failed or lucky run does not move."""


def bootstrap(strata: Sequence[Sequence[float]], statistic: Callable[..., np.ndarray] = np.mean) -> Estimate:
    """Compute a statistic over all values, one per seed of each object, with the interval for other seeds."""
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
    """Compute the two-sided p of the permutation test of paired differences, exact; NaN for one seed.

    If a seed made no difference between the two, each difference were as likely with the other sign: p is the share of
    all choices of signs that give a mean as far from zero. No shape of a distribution is assumed. With n seeds it is
    2^(1−n) at least: .25 for three, .002 for ten.
    """
    if len(differences) < 2:
        return math.nan
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=len(differences))))
    sums = np.abs(signs @ np.asarray(differences))
    return float((sums >= sums[0] - 1e-6).mean())  # equal sums may differ by rounding


def apart(a: Estimate, b: Estimate) -> Estimate:
    """Compute the difference a − b of two independent numbers, its interval from theirs (MOVER; Zou & Donner 2008)."""
    low = math.hypot(a.value - a.low, b.high - b.value)
    high = math.hypot(a.high - a.value, b.value - b.low)
    return Estimate(a.value - b.value, a.value - b.value - low, a.value - b.value + high)


def published(mean: float, deviation: float, seeds: int = 10) -> Estimate:
    """Convert a published mean and standard deviation over seeds to an estimate with its t-interval."""
    half = float(stats.t.ppf(0.975, seeds - 1)) * deviation / math.sqrt(seeds)
    return Estimate(mean, mean - half, mean + half)
