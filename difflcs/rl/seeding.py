"""Random numbers: every purpose has its own stream, derived from the seed.

So nothing depends on the order in which numbers are drawn, and the global generators stay as they were.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum

import numpy as np
import torch


class Stream(IntEnum):
    """Purpose of random numbers. The values are part of every seed: a new purpose gets a new number."""

    TRAINING = 0
    """Initial states and goals of training episodes."""
    EVALUATION = 1
    """Seeds of evaluations: never those of a training with the same seed."""
    MINIBATCH = 2
    """Split and minibatches of the warm-up."""
    ACTION = 3
    """Random actions and noise of the warm-up and of PDDM."""
    NOISE = 4
    """Actions of a stochastic policy."""
    VALUE = 5
    """Weights and minibatches of the value network."""
    LOSS = 6
    """Minibatches of PPO, and the actions that it judges besides those taken."""
    FIT = 7
    """Weights and minibatches of PDDM's networks."""
    PLAN = 8
    """Action sequences that PDDM tries."""
    MODEL = 9
    """Weights and minibatches of the networks that model rollouts are played in."""
    MODEL_ROLLOUT = 10
    """Initial states and goals of model rollouts."""


def number(*key: int) -> int:
    """Derive a random number of 32 bits from a key of numbers, such as (seed, stream, iteration)."""
    return int(np.random.SeedSequence(key).generate_state(1)[0])


def numbers(count: int, *key: int) -> list[int]:
    """Derive `count` random numbers of 32 bits from a key of numbers."""
    return [int(n) for n in np.random.SeedSequence(key).generate_state(count)]


def generator(*key: int) -> torch.Generator:
    """Make a torch generator that is seeded by a key of numbers."""
    return torch.Generator().manual_seed(number(*key))


def episode_seeds(seed: int, stream: int, first: int, count: int) -> list[int]:
    """Return the reset seeds of the episodes first … first + count − 1 of one stream.

    Every episode has its own seed, so that nothing of an environment has to be stored to resume a run, and the first
    goals of an evaluation are the same whatever its size or number of environments.
    """
    return [number(seed, stream, i) for i in range(first, first + count)]


@contextmanager
def seeded(key: Sequence[int]) -> Iterator[None]:
    """Seed torch's global generator, which TorchRL and torch.nn use, by a key of numbers; restore it afterwards."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(number(*key))
        yield
