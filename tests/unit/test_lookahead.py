"""Advantages of many actions per state: what they are, and that their policy gradient is GAE's with less noise."""

from dataclasses import replace

import pytest
import torch
from torch.distributions import MultivariateNormal

pytest.importorskip("torchrl")
from tensordict import TensorDict

from difflcs.rl.critic import seeded
from difflcs.rl.lookahead import lookahead_advantages, luck, mirrored_actions
from difflcs.rl.ppo import _Effort
from tests.training.test_imagination import N_U, N_X, STEPS, make_env, outcome
from tests.training.test_ppo import ROLLOUTS, improve, make_imagining, prepared

pytestmark = pytest.mark.usefixtures("one_thread")


def gaussian(*shape: int, n_u: int = 3, seed: int = 0) -> TensorDict:
    """Samples of a Gaussian with a full covariance."""
    generator = torch.Generator().manual_seed(seed)
    mean = torch.randn(*shape, n_u, generator=generator, dtype=torch.float64)
    factor = torch.randn(n_u, n_u, generator=generator, dtype=torch.float64).tril(-1) + 0.5 * torch.eye(n_u)
    noise = torch.randn(*shape, n_u, generator=generator, dtype=torch.float64)
    taken = {"action": mean + noise @ factor.mT, "loc": mean, "scale_tril": factor.expand(*shape, -1, -1)}
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


def test_the_others_are_drawn_from_the_policy():
    taken = gaussian(1).expand(20000)
    with seeded((2,)):
        offsets = mirrored_actions(taken, 4)["action"][:, 2] - taken["loc"]
    factor = taken["scale_tril"][0]
    torch.testing.assert_close(offsets.T.cov(), factor @ factor.mT, rtol=0.05, atol=0.03)
    assert float(offsets.mean(0).abs().max()) < 0.05


def test_two_actions_are_the_one_taken_and_its_image():
    taken = gaussian(3)
    action = mirrored_actions(taken, 2)["action"]
    torch.testing.assert_close(action[:, 1], 2 * taken["loc"] - taken["action"])


def test_advantages_are_those_of_the_formula():
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(7, 5, 4, generator=generator, dtype=torch.float64)
    values = torch.randn(7, 5, generator=generator, dtype=torch.float64)
    found = lookahead_advantages(q, values, 0.9, 0.7)
    residual = q.mean(-1) - values
    corrections = torch.zeros(7, 5, dtype=torch.float64)
    for t in range(5):
        for later in range(t + 1, 5):
            corrections[:, t] += 0.63 ** (later - t) * residual[:, later]
    expected = q - q.mean(-1, keepdim=True)
    expected[..., 0] += 4 * (corrections - corrections.mean())
    torch.testing.assert_close(found, expected)
    immediate = lookahead_advantages(q, values, 0.9, 0.0)
    torch.testing.assert_close(immediate, q - q.mean(-1, keepdim=True))


def test_the_gradient_is_that_of_gae_with_less_noise():
    """x₊ = x + a, a ~ N(θ x, σ²), reward −x₊², and a V that is wrong: gradients of many episodes, by both."""
    episodes, steps, std, gamma, zeta, count = 40000, 4, 0.4, 0.95, 0.8, 4
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(episodes, generator=generator, dtype=torch.float64)
    states, means, actions = [x], [], []
    for _ in range(steps):
        means.append(-0.3 * x)
        actions.append(means[-1] + std * torch.randn(episodes, generator=generator, dtype=torch.float64))
        x = x + actions[-1]
        states.append(x)
    state, mean, action = torch.stack(states, 1), torch.stack(means, 1), torch.stack(actions, 1)

    def value(x, left):
        return torch.where(left > 0, -0.7 * left * x.square() + 0.5 * x, 0.0)

    left = torch.arange(steps, -1, -1, dtype=torch.float64)
    values = value(state, left)
    errors = -state[:, 1:].square() + gamma * values[:, 1:] - values[:, :-1]
    advantage = torch.zeros(episodes, steps, dtype=torch.float64)
    for t in range(steps):
        advantage[:, t] = sum((gamma * zeta) ** k * errors[:, t + k] for k in range(steps - t))
    score = state[:, :-1] * (action - mean) / std**2  # of θ
    gae = (score * advantage).mean(1)

    factor = torch.full((episodes, steps, 1, 1), std, dtype=torch.float64)
    taken = {"action": action.unsqueeze(-1), "loc": mean.unsqueeze(-1), "scale_tril": factor}
    with seeded((3,)):
        judged = mirrored_actions(TensorDict(taken, [episodes, steps]), count)["action"].squeeze(-1)
    after = state[:, :-1, None] + judged
    q = -after.square() + gamma * value(after, left[1:, None])
    scores = state[:, :-1, None] * (judged - mean.unsqueeze(-1)) / std**2
    ahead = (scores * lookahead_advantages(q, values[:, :-1], gamma, zeta)).mean((1, 2))

    difference = gae - ahead
    assert float(difference.mean().abs()) < 4 * float(difference.std()) / episodes**0.5
    assert float(ahead.mean().abs()) > 20 * float(difference.std()) / episodes**0.5
    assert float(ahead.std()) < 0.6 * float(gae.std())


def test_rewards_without_luck_have_the_same_returns_with_less_noise():
    """x₊ = x + a, reward −x₊², a V that is wrong: returns of many episodes from one state, with and without."""
    episodes, steps, std, gamma, count = 20000, 4, 0.4, 0.95, 8
    x = torch.full((episodes,), 0.7, dtype=torch.float64)
    plain, without = torch.zeros(episodes, dtype=torch.float64), torch.zeros(episodes, dtype=torch.float64)
    for t in range(steps):
        taken = TensorDict({"loc": -0.3 * x.unsqueeze(-1)}, [episodes])
        taken["scale_tril"] = torch.full((episodes, 1, 1), std, dtype=torch.float64)
        with seeded((4, t)):
            taken["action"] = taken["loc"] + std * torch.randn(episodes, 1, dtype=torch.float64)
            after = x.unsqueeze(-1) + mirrored_actions(taken, count)["action"].squeeze(-1)
        left = steps - 1 - t
        q = -after.square() + gamma * (-0.7 * left * after.square() + 0.5 * after * (left > 0))
        x = after[:, 0]
        plain += gamma**t * -x.square()
        without += gamma**t * (-x.square() - luck(q))
    difference = plain - without
    assert float(difference.mean().abs()) < 4 * float(difference.std()) / episodes**0.5
    assert float(without.std()) < 0.6 * float(plain.std())


# --- in imagined episodes ---


def test_foreseen_is_what_was_played():
    env = make_env()
    state = torch.from_numpy(env.reset(seed=[4, 5, 6])[0]["state"])
    generator = torch.Generator().manual_seed(0)
    actions = 0.2 * torch.rand(3, STEPS, 2, N_U, generator=generator, dtype=torch.float64) - 0.1
    states, rewards, successes = [state], [], []
    for k in range(STEPS):
        observation, reward, _, _, info = env.step(actions[:, k, 0].numpy())
        states.append(torch.from_numpy(observation["state"]))
        rewards.append(torch.from_numpy(reward))
        successes.append(torch.from_numpy(info["success"]))
    played = torch.stack(states, 1)
    goals = torch.from_numpy(observation["goal"])
    after, reward, success = env.foresee(played[:, :-1], actions, goals)
    assert after.shape == (3, STEPS, 2, N_X)
    torch.testing.assert_close(after[:, :, 0], played[:, 1:])
    torch.testing.assert_close(reward[:, :, 0], torch.stack(rewards, 1))
    assert torch.equal(success[:, :, 0], torch.stack(successes, 1))
    moved = after[:, :, 1] - after[:, :, 0]  # by the same network, from the same state
    torch.testing.assert_close(moved, actions[:, :, 1] - actions[:, :, 0], rtol=0, atol=1e-6)
    other = (part.flatten(0, 1) for part in (played[:, :-1], actions[:, :, 1], after[:, :, 1]))
    expected, _ = outcome(*other, goals[:1])
    torch.testing.assert_close(reward[:, :, 1].flatten(), expected)


def looked_ahead(**changes):
    """A trainer whose networks know some episodes, imagined episodes, and what is judged in them."""
    trainer = make_imagining(rollouts=10, **changes)
    trainer.step()
    trainer.imagination.fit()
    rollouts, data, *_ = trainer._collect(trainer.imagination.env, list(range(10)))
    now = trainer.critic.values(trainer._inputs(rollouts)[:, :-1]).detach()
    with seeded((0,)):
        data["judged"], data["luck"] = trainer._look_ahead(rollouts, data, now)
    return trainer, rollouts, data


def test_the_action_taken_is_judged_by_what_it_led_to():
    trainer, rollouts, data = looked_ahead(actions=4, zeta=0.0)
    rewards, inputs = trainer._rewards(rollouts), trainer._inputs(rollouts)
    following = trainer.critic.values(inputs[:, 1:]).detach()
    following[:, -1] = 0
    q = rewards + trainer.config.gamma * following
    judged = data["judged", "advantage"].squeeze(-1)
    assert judged.shape == (10, 6, 4)
    torch.testing.assert_close(judged.mean(-1), torch.zeros(10, 6, dtype=torch.float64), rtol=0, atol=1e-12)
    # Up to the mean over the four, which is the state's: with a pair of actions it is half of their difference.
    pair, rollouts, data = looked_ahead(actions=2, zeta=0.0)
    image = torch.clamp(data["judged", "action"][:, :, 1], *pair.bounds)
    after, reward, success = pair.imagination.env.foresee(rollouts.states[:, :-1], image.unsqueeze(2), rollouts.goals)
    elapsed = torch.linspace(0, 1, 7, dtype=torch.float64)[1:].expand(10, 6)
    goals = rollouts.goals.unsqueeze(1).expand(-1, 6, -1)
    other = pair.critic.values(pair.features(after.squeeze(2), goals, elapsed)).detach()
    other[:, -1] = 0
    other = pair._scaled(reward.squeeze(2), success[:, -1, 0]) + pair.config.gamma * other
    torch.testing.assert_close(data["judged", "advantage"][:, :, 0, 0], 0.5 * (q - other), rtol=1e-5, atol=1e-6)


def test_the_first_gradient_is_that_of_all_actions():
    """At the rollout's own parameters all ratios are 1: the gradient is that of −mean(A log π) over all actions."""
    trainer, rollouts, data = looked_ahead(actions=4)
    trainer.config = replace(trainer.config, steps=1, minibatch=None)
    flat = data.flatten(0, 1)
    flat["advantage"] = torch.full((len(flat), 1), torch.nan, dtype=torch.float64)  # GAE's are not used
    flat["guess"] = flat["plan"].clone()
    before = flat.select(*trainer.actor.in_keys, "guess").copy()
    trainer.actor.get_dist_params(before)
    judged = flat["judged"]
    log_prob = MultivariateNormal(before["loc"].unsqueeze(1), scale_tril=before["scale_tril"].unsqueeze(1)).log_prob(
        judged["action"]
    )
    advantage = judged["advantage"].squeeze(-1)
    advantage = (advantage - advantage.mean()) / advantage.std(correction=0)
    parameters = [p for p in trainer.lcs.parameters() if p.requires_grad]
    expected = torch.autograd.grad(-(advantage * log_prob).mean(), parameters, materialize_grads=True)
    assert improve(trainer, flat, rollouts).steps == 1
    for p, gradient in zip(parameters, expected, strict=True):
        found = torch.zeros_like(p) if p.grad is None else p.grad
        torch.testing.assert_close(found, gradient, rtol=1e-5, atol=1e-8)
    assert any(bool(gradient.any()) for gradient in expected)


def test_the_value_network_learns_from_rewards_without_luck(monkeypatch):
    trainer = make_imagining()
    trainer.step()
    trainer.imagination.fit()
    seen = {}
    look_ahead, rewards = trainer._look_ahead, trainer._rewards

    def remember(name, function):
        def wrapped(*arguments):
            seen[name] = function(*arguments)
            return seen[name]

        monkeypatch.setattr(trainer, f"_{name}", wrapped)

    remember("look_ahead", look_ahead)
    remember("rewards", rewards)
    trainer._iterate(trainer.imagination.env, list(range(10)), _Effort(1, None, 1), 1.0)
    _, unearned = seen["look_ahead"]
    assert float(unearned.abs().max()) > 1e-6
    torch.testing.assert_close(trainer.critic.history[-1][1], seen["rewards"] - unearned)
    trainer._iterate(trainer.env, list(range(ROLLOUTS)), _Effort(1, None, 1), 1.0)
    torch.testing.assert_close(trainer.critic.history[-1][1], seen["rewards"])  # real ones as they are


def test_luck_is_what_the_action_taken_is_better():
    _, _, data = looked_ahead(actions=4, zeta=0.0)
    torch.testing.assert_close(data["luck"], data["judged", "advantage"][:, :, 0, 0])


def test_one_action_is_plain_gae(monkeypatch):
    trainer = make_imagining(actions=1)
    monkeypatch.setattr(trainer, "_look_ahead", None)  # never called
    for _ in range(2):
        trainer.step()
    data, _ = prepared(trainer)
    assert "judged" not in data.keys()
