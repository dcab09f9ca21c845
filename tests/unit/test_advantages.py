"""Rewards to learn from, GAE, and advantages of many actions: their gradient is GAE's with less noise."""

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch.distributions import MultivariateNormal

from difflcs.errors import InvalidInputError
from difflcs.rl import CriticSettings
from difflcs.rl.learning.advantages import MultiActionAdvantages, RewardScale, mirrored_actions, multi_action_advantages
from difflcs.rl.learning.critic import Critic, returns
from difflcs.rl.rollout import elapsed_fractions
from difflcs.rl.seeding import seeded
from tests.conftest import Build, draw, refuse

STEPS = 6


@st.composite
def rewarded(draw):
    """Dense rewards (N, T, ...), successes (N, ...), and the numbers of a `RewardScale`."""
    shape = draw(st.tuples(st.integers(1, 4), st.integers(1, 5), *draw(st.sampled_from([(), (st.integers(1, 3),)]))))
    positive = st.floats(1e-3, 1e3, allow_subnormal=False)
    count = int(np.prod(shape))
    dense = draw(st.lists(st.floats(-1e4, 1e4), min_size=count, max_size=count))
    ends = (shape[0], *shape[2:])
    success = draw(st.lists(st.booleans(), min_size=int(np.prod(ends)), max_size=int(np.prod(ends))))
    numbers = (draw(positive), draw(st.just(0.0) | positive), draw(positive))
    return torch.tensor(dense, dtype=torch.float64).view(shape), torch.tensor(success).view(ends), numbers


@settings(deadline=None, max_examples=200)
@given(rewarded())
@example((torch.tensor([[-1.0, -5.0]]).double(), torch.tensor([True]), (3.0, 10.0, 0.1)))
@example((torch.tensor([[-1.0, -5.0]]).double(), torch.tensor([False]), (3.0, 10.0, 0.1)))
@example((torch.tensor([[-1.0, -0.3]]).double(), torch.tensor([False]), (3.0, 10.0, 0.1)))
def test_rewards_are_those_of_the_rule(case):
    """The dense ones limited, less the penalty in the last step of a failed episode, all scaled: bit for bit.

    The environment's last reward holds the penalty already, so the limit is applied to the sum.
    """
    dense, success, (cost_limit, penalty, factor) = case
    expected = dense.clamp_min(-cost_limit)
    expected[:, -1] -= penalty * (~success).double()
    given_ = dense.clone()
    given_[:, -1] -= penalty * (~success).double()
    before = given_.clone()
    assert torch.equal(RewardScale(cost_limit, penalty, factor)(given_, success), factor * expected)
    assert torch.equal(given_, before)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_rewards_that_are_not_finite_are_refused(bad):
    rewards = torch.zeros(2, 3).double()
    rewards[1, 1] = bad
    refuse(InvalidInputError, "finite rewards", RewardScale(3.0, 10.0, 0.1), rewards, torch.ones(2, dtype=torch.bool))


def make_critic(gamma: float = 0.9) -> Critic:
    return Critic(CriticSettings(), 3, STEPS, gamma, 0.8, (0, 5))


def test_advantages_are_the_papers(monkeypatch):
    """Eq. 5 written out, with a value of zero at the end of an episode."""
    critic, inputs, rewards = make_critic(), draw(5, STEPS + 1, 3), draw(5, STEPS, seed=1)
    value = critic.network(inputs.float()).detach().double().squeeze(-1)
    value[:, -1] = 0
    delta = rewards + 0.9 * value[:, 1:] - value[:, :-1]
    expected = torch.zeros(5, STEPS, dtype=torch.float64)
    for t in range(STEPS):
        expected[:, t] = sum((0.9 * 0.8) ** k * delta[:, t + k] for k in range(STEPS - t))
    values, advantages = critic.gae(inputs, rewards)
    torch.testing.assert_close(advantages, expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(values, value[:, :-1], rtol=1e-5, atol=1e-5)
    assert not advantages.requires_grad
    fitted = []
    monkeypatch.setattr(critic, "_fit", lambda seen, targets, *_: fitted.append(targets))
    critic.learn(inputs, rewards, (0,), 1)
    torch.testing.assert_close(fitted[0], expected + value[:, :-1], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(returns(rewards, 0.9)[:, 0], sum(0.9**k * rewards[:, k] for k in range(STEPS)))
    torch.testing.assert_close(returns(rewards, 0.9)[:, -1], rewards[:, -1])


def gaussian(*shape: int) -> TensorDict:
    """Samples of a Gaussian with a full covariance."""
    n = Build.normal(0)
    mean, factor = n(*shape, 3), n(3, 3).tril(-1) + 0.5 * torch.eye(3)
    taken = {"action": mean + n(*shape, 3) @ factor.mT, "loc": mean, "scale_tril": factor.expand(*shape, -1, -1)}
    return TensorDict(taken, shape)


def test_actions_come_in_mirrored_pairs_the_one_taken_first():
    taken = gaussian(5, 4)
    with seeded((1,)):
        drawn = mirrored_actions(taken, 6)
    assert drawn.batch_size == (5, 4, 6)
    action, mean = drawn["action"], taken["loc"].unsqueeze(2)
    torch.testing.assert_close(action[:, :, 0], taken["action"], rtol=0, atol=1e-14)
    torch.testing.assert_close(0.5 * (action[:, :, ::2] + action[:, :, 1::2]), mean.expand(5, 4, 3, 3))
    density = MultivariateNormal(mean, scale_tril=taken["scale_tril"].unsqueeze(2))
    torch.testing.assert_close(drawn["action_log_prob"], density.log_prob(action))
    assert len(action.flatten(0, 2).unique(dim=0)) == 5 * 4 * 6


def test_advantages_are_those_of_the_formula():
    n = Build.normal(0)
    q, values = n(7, 5, 4), n(7, 5)
    found = multi_action_advantages(q, values, 0.9, 0.7)
    residual = q.mean(-1) - values
    corrections = torch.zeros(7, 5, dtype=torch.float64)
    for t in range(5):
        for later in range(t + 1, 5):
            corrections[:, t] += 0.63 ** (later - t) * residual[:, later]
    expected = q - q.mean(-1, keepdim=True)
    expected[..., 0] += 4 * (corrections - corrections.mean())
    torch.testing.assert_close(found, expected)
    immediate = multi_action_advantages(q, values, 0.9, 0.0)
    torch.testing.assert_close(immediate, q - q.mean(-1, keepdim=True))


BOUND = 0.5


class World:
    """x₊ = x + a, reward −x₊² − 3 in the last step off the goal: knows what other actions would have led to."""

    def predict_alternatives(self, states, actions, goals):
        assert bool((actions.abs() <= BOUND).all())  # what is executed
        after = states.unsqueeze(2) + actions
        success = (after - goals[:, None, None]).abs().squeeze(-1) < 0.4
        reward = -after.square().squeeze(-1)
        reward[:, -1] -= 3.0 * (~success[:, -1]).double()
        return after, reward, success


def inputs_of(state, goal, elapsed):
    return torch.cat([state, goal.expand_as(state), elapsed.unsqueeze(-1)], -1)


def judged(actions: int = 4, zeta: float = 0.0, gamma: float = 0.9):
    """Episodes played in the world, the estimator, and its estimate."""
    count, state = 10, draw(10, 1)
    goal, steps, states = 0.3 * draw(count, 1, seed=3), [], [state]
    for t in range(STEPS):
        step = TensorDict({"loc": -0.3 * state, "scale_tril": torch.full((count, 1, 1), 0.4).double()}, [count])
        step["action"] = step["loc"] + 0.4 * draw(count, 1, seed=10 + t)
        step["action_log_prob"] = torch.zeros(count).double()
        state = state + step["action"].clamp(-BOUND, BOUND)
        steps.append(step)
        states.append(state)
    episodes = TensorDict({"state": torch.stack(states, 1), "goal": goal}, [count])
    episodes["policy"] = torch.stack(steps, 1)
    bound = torch.full((1,), BOUND).double()
    scale = RewardScale(1.0, 3.0, 0.5)
    estimator = MultiActionAdvantages(
        World(), make_critic(gamma), inputs_of, scale, (-bound, bound), actions=actions, zeta=zeta
    )
    inputs = inputs_of(
        episodes["state"], goal.unsqueeze(1).expand(-1, STEPS + 1, -1), elapsed_fractions(STEPS).expand(count, -1)
    )
    executed = episodes["policy", "action"].clamp(-BOUND, BOUND).unsqueeze(2)
    _, reward, success = World().predict_alternatives(episodes["state"][:, :-1], executed, goal)
    rewards = scale(reward.squeeze(2), success[:, -1, 0])
    return episodes, inputs, rewards, estimator, estimator(episodes, inputs, rewards, (0, 6))


def quality(estimator, episodes, action: torch.Tensor) -> torch.Tensor:
    """(N, T) r + γ V of the next state after other actions (N, T, 1), step by step."""
    columns = []
    for t in range(STEPS):
        after = episodes["state"][:, t] + action[:, t].clamp(-BOUND, BOUND)
        failed = (after - episodes["goal"]).abs().squeeze(-1) >= 0.4
        reward = (-after.square().squeeze(-1)).clamp_min(-1.0) - 3.0 * (failed & (t == STEPS - 1))
        value = torch.zeros(len(after)).double()
        if t < STEPS - 1:
            elapsed = torch.full((len(after),), (t + 1) / STEPS, dtype=torch.float64)
            value = estimator.critic.values(inputs_of(after, episodes["goal"], elapsed)).detach()
        columns.append(0.5 * reward + 0.9 * value)
    return torch.stack(columns, 1)


def test_all_actions_are_judged_and_corrected_by_later_values():
    """The formula, with q of each action computed on its own."""
    episodes, inputs, _, estimator, found = judged(zeta=0.7)
    q = torch.stack([quality(estimator, episodes, action) for action in found.samples["action"].unbind(2)], 2)
    values = estimator.critic.values(inputs[:, :-1]).detach()
    torch.testing.assert_close(found.values, values, rtol=1e-5, atol=1e-6)
    expected = multi_action_advantages(q, values, 0.9, 0.7)
    torch.testing.assert_close(found.samples["advantage"].squeeze(-1), expected, rtol=1e-5, atol=1e-5)
    assert bool((found.samples["action"].abs() > BOUND).any())  # judged as executed, but not clipped


def test_rewards_to_fit_values_to_are_without_the_action_advantage():
    *_, rewards, _, found = judged()
    advantage = found.samples["advantage"][:, :, 0, 0]
    assert float(advantage.abs().max()) > 1e-3
    torch.testing.assert_close(found.rewards, rewards - advantage)
