"""Random numbers: one stream for each purpose, and nothing drawn from the global generators."""

import numpy as np
import torch

from difflcs.rl.seeding import Stream, episode_seeds, generator, number, numbers


def test_streams_are_as_they_were():
    """A purpose that got another number would change every result that was ever published."""
    names = "TRAINING EVALUATION MINIBATCH ACTION NOISE VALUE LOSS FIT PLAN MODEL MODEL_ROLLOUT".split()
    assert [(stream.name, stream.value) for stream in Stream] == [(name, i) for i, name in enumerate(names)]
    values = [stream.value for stream in Stream.__members__.values()]  # aliases too
    assert len(set(values)) == len(values)


def test_numbers_are_as_they_were():
    """Those of NumPy's SeedSequence, which promises to keep them."""
    assert number(3, Stream.NOISE, 7) == int(np.random.SeedSequence((3, 4, 7)).generate_state(1)[0])
    assert numbers(3, 3, Stream.MODEL_ROLLOUT, 7, 1) == np.random.SeedSequence((3, 10, 7, 1)).generate_state(3).tolist()
    assert (number(0, 0, 0), number(3, 4, 7)) == (2968811710, 3376495404)
    assert torch.equal(
        torch.rand(4, generator=generator(3, Stream.MODEL, 2)),
        torch.rand(4, generator=torch.Generator().manual_seed(number(3, 9, 2))),
    )


def test_an_episode_has_the_same_seed_however_many_there_are():
    together = episode_seeds(5, Stream.TRAINING, 2, 6)
    assert together == [episode_seeds(5, Stream.TRAINING, 2 + i, 1)[0] for i in range(6)]
    assert not set(together) & set(episode_seeds(5, Stream.EVALUATION, 2, 6))
