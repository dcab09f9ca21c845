"""PPO through the MPC, on a small pushing system that needs no simulator: the trainer, and parts handed to it."""

import pytest
import torch
from gymnasium.vector import SyncVectorEnv

from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl import CriticSettings, Epochs, Natural
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.rollout import elapsed_fractions
from difflcs.rl.runs.evaluate import evaluate
from tests.conftest import refuse
from tests.training import slide


def test_ppo_learns():
    """From a model whose MPC hardly moves to one that reaches its goals."""
    env = slide.make_envs(40)
    critic = CriticSettings(epochs=Epochs(first=60, each=3, minibatch=256))
    trainer = slide.make_ppo(0, 8, env, rollouts=40, steps=10, std=0.04, target_kl=0.2, max_kl=0.6, critic=critic)
    before = evaluate(env, trainer.policy, 60, 0, slide.STEPS).success_rate
    reports = []
    while not trainer.done:
        reports.append(trainer.step())
    assert before < 0.35
    assert evaluate(env, trainer.policy, 60, 0, slide.STEPS).success_rate > before + 0.4
    assert reports[-1].mean_return > reports[0].mean_return + 5
    assert reports[-1].env_steps == trainer.env_steps == 320 * slide.STEPS
    assert all(report.solver_failures == 0 for report in reports)
    assert all(report.kl > 0 for report in reports)
    assert reports[0].explained_variance > 0.3
    refuse(InvalidInputError, "all of them are done", trainer.step)


def test_a_start_is_replaced_by_what_is_better_and_by_nothing_else():
    """What is handed out is the start, then what played when it was accepted; the learner goes its own way."""
    trainer = slide.make_ppo(0, 5, rollouts=40, steps=10, std=0.04, target_kl=0.2, max_kl=0.6, gain=1.65)
    expected, accepted = slide.parameters(trainer), []
    while not trainer.done:
        playing = [value.clone() for value in trainer.actor.learned.state_dict().values()]
        accepted.append(trainer.step().accepted)
        expected = playing if accepted[-1] else expected
        assert slide.same(slide.parameters(trainer), expected)
        assert not slide.same(list(trainer.actor.learned.state_dict().values()), playing)
    assert not accepted[0]
    assert any(accepted)


def test_what_no_episode_tests_is_handed_out_after_what_was_accepted():
    """Model rollouts follow the last real episodes. They teach what is handed out, unless a good start is kept."""
    for gain, first in ((-100.0, True), (0.0, False)):
        trainer = slide.make_ppo(iterations=2, models=slide.make_models(last=2), gain=gain)
        assert trainer.step().accepted == first
        assert trainer.step().accepted
        assert slide.same(slide.parameters(trainer), list(trainer.actor.learned.state_dict().values())) is first


def test_the_policy_explores_and_the_environment_gets_actions_clipped_into_the_bounds_of_the_mpc():
    most = slide.U_MAX / 2
    trainer = slide.make_ppo(std=0.2, controller=slide.make_mpc(slide.make_model(), most))
    seen = slide.recorded(trainer)
    trainer.step()
    episodes = seen.calls[0][0]
    data = episodes["policy"]
    noise = (data["action"] - data["loc"]).flatten()
    assert float(noise.std()) == pytest.approx(0.2, rel=0.2)
    torch.testing.assert_close(episodes["action"], data["action"].clamp(-most, most))
    assert bool((data["action"].abs() > most).any())


def test_rewards_are_limited_and_end_with_the_penalty():
    trainer = slide.make_ppo(cost_limit=1.0, penalty=7.0, reward_scale=0.5, std=0.1)
    seen = slide.recorded(trainer)
    report = trainer.step()
    episodes, _, rewards, _ = seen.calls[0]
    raw = -20 * (episodes["state"][:, :-1] - episodes["goal"].unsqueeze(1)).abs().squeeze(-1)
    expected = 0.5 * raw.clamp_min(-1.0)
    expected[:, -1] -= 0.5 * 7.0 * (~episodes["success"]).double()
    torch.testing.assert_close(rewards, expected)
    torch.testing.assert_close(trainer.critic.history[-1][1], expected)
    assert report.mean_return == pytest.approx(float(expected.sum(1).mean()) / 0.5)
    assert bool((raw < -1).any())
    assert bool((~episodes["success"]).any())


def test_policy_and_value_network_see_the_same_time():
    """`elapsed_fractions`, bit for bit: while acting, in the value network, and in what networks foresee."""
    trainer = slide.make_ppo(models=slide.make_models(iterations=1, actions=4))
    seen, times = [slide.recorded(trainer, "robot"), slide.recorded(trainer, "practice")], []
    judge, plain = seen[1].part, seen[1].part.features
    judge.features = lambda state, goal, elapsed: (times.append(elapsed), plain(state, goal, elapsed))[1]
    for _ in range(2):
        trainer.step()
    elapsed = elapsed_fractions(slide.STEPS)
    assert torch.equal(elapsed, torch.linspace(0, 1, slide.STEPS + 1, dtype=torch.float64))
    for recording in seen:
        for episodes, inputs, _, _ in recording.calls:
            count = len(episodes)
            assert torch.equal(episodes["policy", "elapsed"], elapsed[:-1].expand(count, -1))
            assert torch.equal(inputs[..., -1], elapsed.expand(count, -1))
    (judged,) = times
    assert torch.equal(judged, elapsed[1:, None].expand(10, slide.STEPS, 4))
    network = MLPController(
        slide.features, 3, torch.full((1,), -slide.U_MAX), torch.full((1,), slide.U_MAX), 4, slide.STEPS
    )
    network.features = lambda state, goal, elapsed: (times.append(elapsed), plain(state, goal, elapsed))[1]
    for _ in range(slide.STEPS):
        network(torch.zeros(2, 1).double(), torch.zeros(2, 1).double())
    assert torch.equal(torch.stack(times[1:], 1), elapsed[:-1].expand(2, -1))


@pytest.mark.parametrize(("size", "sizes"), [(None, [72, 72, 72]), (30, [30, 30, 12]), (100, [72, 72, 72])])
def test_minibatches(size, sizes):
    """Every sample once before any is drawn again, each from its own last plan."""
    trainer = slide.make_ppo(steps=3, minibatch=size, max_kl=100.0, update="adam")
    seen, solved = slide.recorded(trainer), []
    trainer.actor.gaussian.register_forward_hook(lambda _, inputs, __: solved.append(inputs[0].clone()))
    assert trainer.step().gradient_steps == 3
    batches = solved[slide.STEPS :]  # the first ones are those of the episodes in lockstep
    assert [len(batch) for batch in batches] == sizes
    states = torch.cat([batch["state"] for batch in batches]).sort(0).values[:: 3 if sizes[0] == 72 else 1]
    data = seen.calls[0][0]["policy"].flatten(0, 1)
    torch.testing.assert_close(states, data["state"].sort(0).values, rtol=0, atol=0)
    for batch in batches:  # a guess belongs to its state
        torch.testing.assert_close(batch["guess", "x"][:, 0], batch["state"], rtol=0, atol=1e-9)


def test_an_iteration_ends_at_the_kl_limit():
    report = slide.make_ppo(max_kl=1e-6).step()
    assert report.gradient_steps == 1
    assert report.kl > 1e-6


def test_steps_are_annealed():
    trainer = slide.make_ppo(iterations=3, steps=1, final_step=0.1, step_factor=1.0)
    trainer.update = slide.Noting(trainer.update)
    while not trainer.done:
        trainer.step()
    assert [scale for _, scale in trainer.update.seen] == pytest.approx([1.0, 0.7, 0.4])


def test_the_step_size_follows_the_kl_without_annealing():
    """KL grows with the square of a step, so what annealing takes away is divided out."""
    trainer, asked = slide.make_ppo(iterations=2, steps=2, final_step=0.5, natural=Natural(step=0.01)), []
    trainer.update.size.adapt = asked.append
    reports = [trainer.step() for _ in range(2)]
    assert asked == pytest.approx([reports[0].kl, reports[1].kl / 0.75**2])
    assert all(report.kl > 0 for report in reports)


def test_steps_left_out_are_counted():
    trainer = slide.make_ppo(steps=5)
    answers = iter([True, False, True, False, False])
    trainer.update = slide.Noting(trainer.update, lambda: next(answers))
    report = trainer.step()
    assert (report.gradient_steps, report.skipped_steps) == (2, 3)


def test_the_budget_is_met_exactly():
    for total in (slide.ROLLOUTS - 5, 2 * slide.ROLLOUTS + 1, 3 * slide.ROLLOUTS):
        trainer = slide.make_ppo(options={"total_episodes": total + 7, "first_episode": 7})
        assert sum(trainer.sizes) == total
        assert max(trainer.sizes) <= slide.ROLLOUTS
        assert max(trainer.sizes) - min(trainer.sizes) <= 1


def test_broken_episodes_are_dropped():
    env = SyncVectorEnv([lambda: slide.Slide(breaks_at=3), *[slide.Slide] * (slide.ROLLOUTS - 1)])
    trainer = slide.make_ppo(env=env)
    report = trainer.step()
    assert report.unstable == 1
    assert len(trainer.critic.history[0][1]) == slide.ROLLOUTS - 1
    assert all(bool(torch.isfinite(p).all()) for p in slide.parameters(trainer))
    refuse(InvalidInputError, "stable simulation", slide.make_ppo(env=slide.make_envs(breaks_at=2)).step)


def test_load_refuses_what_does_not_fit():
    trainer = slide.make_ppo()
    trainer.step()
    state = trainer.state_dict()
    with pytest.raises(CheckpointError, match=r"'first_episode': 0.*'first_episode': 3"):
        trainer.load({**state, "settings": {**state["settings"], "first_episode": 3}})
    episodes = state["critic"]["episodes"]
    for places in (episodes["iteration"][1:], episodes["iteration"] + 1, torch.arange(slide.ROLLOUTS)):
        critic = {**state["critic"], "episodes": {**episodes, "iteration": places}}
        refuse(CheckpointError, "iteration", trainer.load, {**state, "critic": critic})
