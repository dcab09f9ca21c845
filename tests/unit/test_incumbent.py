"""A policy is replaced only by what did better, as far as few episodes can tell."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from difflcs.rl.learning.incumbent import ITERATIONS, REACH, Incumbent, is_better

F64 = torch.float64
SEEN = TensorDict({"state": torch.linspace(-1, 1, 9, dtype=F64).unsqueeze(-1)}, [9])


def drawn(seed, count, mean=0.0, failing=0):
    """Returns around a mean, some of them with the cost of a failure, which is 5."""
    values = mean + 0.1 * torch.randn(count, generator=torch.Generator().manual_seed(seed), dtype=F64)
    values[:failing] -= 5
    return values


def nothing(inputs):
    """What a value network expects that knows nothing."""
    return torch.zeros(len(inputs), dtype=F64)


class Line:
    """A policy that is a line, with noise of one."""

    def __init__(self):
        self.learned = nn.Linear(1, 1, dtype=F64)

    def solve(self, data):
        data["loc"], data["scale_tril"] = self.learned(data["state"]), torch.ones(*data.shape, 1, 1, dtype=F64)
        return data


def make(failure, errors=1.65):
    """A line that is handed out, and another one that learns."""
    return Incumbent(Line(), Line(), failure, errors, 1)  # pyright: ignore


def test_a_better_policy_passes_and_what_is_as_good_rarely_does():
    assert is_better(drawn(0, 30), drawn(1, 30, failing=15), 5.0, 1.65)
    assert not is_better(drawn(0, 30, failing=15), drawn(1, 30), 5.0, 1.65)
    passed = sum(is_better(drawn(k, 30), drawn(1000 + k, 30), 0.0, 1.65) for k in range(400))
    assert 4 < passed < 40  # 5 %
    assert not is_better(drawn(0, 1, mean=9.0), drawn(1, 30), 0.0, 1.65)  # one episode tells nothing


def test_a_failure_that_was_not_seen_counts():
    """A small gain in all of 30 episodes is no proof against rare failures; in 3000 it is."""
    few, many = (is_better(drawn(0, count, mean=0.1), drawn(1, count), 2.0, 1.65) for count in (30, 3000))
    assert not few
    assert many
    assert is_better(drawn(0, 30, mean=0.1), drawn(1, 30), 0.0, 1.65)


def test_starts_are_judged_by_what_was_expected_of_them():
    """A worse policy that had easier goals does not pass, a better one that had harder ones does."""
    starts = torch.cat([torch.zeros(30, 1), torch.ones(30, 1)]).double()
    easy, hard = starts[:30], starts[30:]
    for own, gain, passes in ((hard, -1.0, False), (easy, 1.0, True)):
        incumbent, other = make(1.0), easy if own is hard else hard
        model = incumbent.learner.state_dict()

        def values(inputs):
            return -9 * inputs.squeeze(-1)

        incumbent.begin()
        assert not incumbent.challenge(own, values(own) + drawn(0, 30), values, SEEN)  # its own episodes
        assert incumbent.challenge(other, values(other) + drawn(1, 30, gain), values, SEEN) is passes
        same = all(torch.equal(value, incumbent.learned.state_dict()[name]) for name, value in model.items())
        assert same is passes


def test_several_iterations_count_together_and_its_state_goes_on():
    incumbent, starts, outcomes = make(5.0), torch.zeros(30, 1, dtype=F64), []
    incumbent.challenge(starts, drawn(0, 30, failing=4), nothing, SEEN)
    for k in range(ITERATIONS):
        copied = make(5.0)
        copied.load_state_dict(incumbent.state_dict())
        arguments = (starts, drawn(k + 1, 30), nothing, SEEN)
        for one in (incumbent, copied):
            one.begin()
        outcomes.append(incumbent.challenge(*arguments))
        assert copied.challenge(*arguments) is outcomes[-1]
        assert len(copied.episodes) == len(incumbent.episodes)
    assert not outcomes[0]
    assert any(outcomes)


def test_unless_it_is_worse_a_policy_passes_but_many_small_losses_do_not():
    def passed(mean):
        return sum(is_better(drawn(k, 30, mean), drawn(1000 + k, 30), 0.0, -1.65) for k in range(400)) / 400

    assert 0.9 < passed(0.0) < 0.99 < passed(0.05)
    assert passed(-0.2) == 0.0
    incumbent, starts = make(0.0, -1.65), torch.zeros(30, 1, dtype=F64)
    accepted = []
    for k in range(12):
        incumbent.begin()
        accepted.append(incumbent.challenge(starts, drawn(k, 30, -0.02 * k), nothing, SEEN))
    assert accepted[0]  # there is nothing to compare it with
    assert any(accepted[1:])
    assert not any(accepted[6:])


def test_the_last_of_several_equal_policies_is_seldom_refused():
    """It is compared with the luckiest one, so that -1.65 refuses far more than the 5 % of a single comparison."""

    def refused(errors):
        count, starts = 0, torch.zeros(15, 1, dtype=F64)
        for seed in range(100):
            incumbent, passed = make(0.0, errors), []
            for k in range(6):
                incumbent.begin()
                passed.append(incumbent.challenge(starts, drawn(10 * seed + k, 15), nothing, SEEN))
            count += not passed[-1]
        return count

    assert refused(-3.0) <= 3
    assert refused(-1.65) > 10


@pytest.mark.parametrize("errors", [-3.0, 1.65])
def test_what_is_handed_out_changes_no_further_than_the_trust_region(errors):
    """KL = offset²/2; only a start that is kept is replaced as a whole, by what is certainly better."""
    incumbent = make(0.0, errors)
    handed_out, model = incumbent.learned.state_dict(), incumbent.learner.state_dict()
    for line, offset in ((handed_out, 0.0), (model, 4.0)):
        line["weight"].zero_()
        line["bias"].fill_(offset)
    before, reached = 0.0, 0.0
    while reached < 4.0:
        incumbent.follow(model, SEEN)
        before, reached = reached, float(handed_out["bias"])
        assert errors > 0 or 0.8 * REACH < (reached - before) ** 2 / 2 <= REACH or reached == 4.0
        assert float(handed_out["weight"]) == 0.0
    assert (before == 0.0) is (errors > 0)
    incumbent.follow({**model, "bias": torch.full((1,), torch.nan, dtype=F64)}, SEEN)
    assert bool(handed_out["bias"].isfinite()) is (errors < 0)
