"""PPO through the MPC, on a small pushing system that needs no simulator: alone, on model rollouts, after a warm-up."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv

from difflcs.errors import CheckpointError, DTypeError, InvalidInputError, NonFiniteError
from difflcs.rl import LCSRL, CriticSettings, Epochs, Natural, Rollouts, Warmup, WarmupSettings
from difflcs.rl.learning import ppo_settings
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.learning.policy import make_actor
from difflcs.rl.learning.ppo import PPO
from difflcs.rl.learning.state_tree import copy_state
from difflcs.rl.rollout import collect, elapsed_fractions, uniform_actions
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
    episodes = seen.call_args.args[0]
    data = episodes["policy"]
    noise = (data["action"] - data["loc"]).flatten()
    assert float(noise.std()) == pytest.approx(0.2, rel=0.2)
    torch.testing.assert_close(episodes["action"], data["action"].clamp(-most, most))
    assert bool((data["action"].abs() > most).any())


def test_rewards_are_limited_and_end_with_the_penalty():
    trainer = slide.make_ppo(cost_limit=1.0, penalty=7.0, reward_scale=0.5, std=0.1)
    seen = slide.recorded(trainer)
    report = trainer.step()
    episodes, _, rewards, _ = seen.call_args.args
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
    judge, plain, times = trainer.practice.advantages, trainer.practice.advantages.features, []
    seen = [slide.recorded(trainer, "robot"), slide.recorded(trainer, "practice")]
    judge.features = lambda state, goal, elapsed: (times.append(elapsed), plain(state, goal, elapsed))[1]
    for _ in range(2):
        trainer.step()
    elapsed = elapsed_fractions(slide.STEPS)
    assert torch.equal(elapsed, torch.linspace(0, 1, slide.STEPS + 1, dtype=torch.float64))
    for recording in seen:
        for (episodes, inputs, _, _), _ in recording.call_args_list:
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
    data = seen.call_args.args[0]["policy"].flatten(0, 1)
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


# --- model rollouts ---------------------------------------------------------------------------------------------------


def make_practising(seed: int = 0, first_epochs: int = 20, models: dict | None = None, **changes):
    return slide.make_ppo(seed, models=slide.make_models(seed, first_epochs, **(models or {})), **changes)


@pytest.mark.parametrize(
    ("iterations", "last", "remembered", "expected"),
    [
        (2, 0, False, [0, 2, 2, 2]),  # none before the first real episodes
        (2, 0, True, [2, 2, 2, 2]),  # but where those of a warm-up are known
        (2, 3, True, [2, 2, 2, 8]),  # and three times as many after the last
        (0, 3, True, [0, 0, 0, 0]),
    ],
)
def test_iterations_on_model_rollouts_come_before_each_real_one(iterations, last, remembered, expected):
    trainer, counts = make_practising(models={"iterations": iterations, "last": last}), []
    if remembered:
        env = slide.make_envs(3)
        trainer.remember(collect(env, uniform_actions(env, np.random.default_rng(0)), [1, 2, 3], slide.STEPS))
    seen = slide.recorded(trainer, "practice")
    while not trainer.done:
        before = seen.call_count
        report = trainer.step()
        counts.append(seen.call_count - before)
        assert (report.model_success is None) == (report.model_loss is None) == (counts[-1] == 0)
    assert counts == expected


def test_steps_on_real_episodes_are_shorter_beside_model_rollouts():
    models = {"iterations": 2, "real_step": 0.25, "steps": 1}
    trainer = make_practising(models=models, final_step=1.0, steps=1)
    trainer.update = slide.Noting(trainer.update)
    sizes = iter([1.0, 2.0, 3.0, 21.0])  # whatever the real episodes say
    trainer.update.size.adapt = lambda kl: setattr(trainer.update.size, "value", next(sizes))
    for _ in range(2):
        report = trainer.step()
    assert [scale for _, scale in trainer.update.seen] == [0.25, 1.0, 1.0, 0.25]
    assert trainer.update.size.value == 3.0 == report.learning_rate


def test_real_episodes_are_tested_once():
    trainer, sizes = make_practising(models={"iterations": 1, "steps": 1}, steps=1, gain=-3.0), []
    challenge = trainer.incumbent.challenge
    trainer.incumbent.challenge = lambda starts, *rest: sizes.append(len(starts)) or challenge(starts, *rest)
    for _ in range(2):
        trainer.step()
    assert sizes == [slide.ROLLOUTS, slide.ROLLOUTS]


def success(trainer) -> float:
    while not trainer.done:
        trainer.step()
    return evaluate(slide.make_envs(60), trainer.policy, 60, 0, slide.STEPS).success_rate


SHORT = {"target_kl": 0.02}
"""Short steps: with the usual ones rounding decides in one training of twelve whether a late step ruins it."""


def test_model_rollouts_learn_from_less_data():
    models = {"iterations": 6, "rollouts": 30, "actions": 8}
    both = sum(success(make_practising(seed, 100, models, **SHORT)) for seed in range(2)) / 2
    assert both > sum(success(slide.make_ppo(seed, **SHORT)) for seed in range(2)) / 2 + 0.15


def test_iterations_on_model_rollouts_have_an_effort_of_their_own():
    trainer = make_practising(
        models={"iterations": 1, "rollouts": 6, "steps": 5, "value_epochs": 2}, minibatch=slide.STEPS * 4
    )
    trainer.step()
    batches, epochs = [], []
    trainer.actor.gaussian.register_forward_hook(lambda _, inputs, __: batches.append(len(inputs[0])))
    learn = trainer.critic.learn
    trainer.critic.learn = lambda *arguments: (epochs.append(arguments[-1]), learn(*arguments))
    trainer.step()
    steps, size = slide.STEPS, slide.STEPS * 4
    played = [6] * steps + [6 * steps] + [size, 12, size, 12, size]  # in lockstep, the metric, gradient steps
    real = [slide.ROLLOUTS] * steps + [slide.ROLLOUTS * steps] + [size] * 4
    assert batches == played + real
    assert epochs == [2, 3]


@pytest.mark.parametrize("actions", [1, 4])
def test_the_value_network_learns_from_what_the_estimator_says(actions):
    """From rewards without the action advantage in model rollouts, from real ones as they are."""
    trainer = make_practising(models={"iterations": 1, "actions": actions})
    judge, judged, seen = trainer.practice.advantages, [], slide.recorded(trainer)

    def noted(episodes, inputs, rewards, key):
        judged.append((rewards, judge(episodes, inputs, rewards, key)))
        return judged[-1][1]

    trainer.practice = replace(trainer.practice, advantages=noted)
    for _ in range(2):
        trainer.step()
    rewards, estimate = judged[0]
    assert estimate.samples.batch_size == (10, slide.STEPS, actions)
    torch.testing.assert_close(trainer.critic.history[1][1], estimate.rewards, rtol=0, atol=0)
    assert torch.equal(estimate.rewards, rewards) == (actions == 1)
    assert torch.equal(trainer.critic.history[2][1], seen.call_args.args[2])


def test_a_state_without_models_is_refused():
    trainer = slide.make_ppo()
    trainer.step()
    refuse(CheckpointError, r"models.*other settings", make_practising().load, trainer.state_dict())
    refuse(CheckpointError, r"models.*other settings", trainer.load, make_practising().state_dict())


# --- after a warm-up --------------------------------------------------------------------------------------------------


def make_lcsrl(models: bool = False, **changes) -> LCSRL:
    lcs = slide.make_model()
    mpc = slide.make_mpc(lcs)
    settings = WarmupSettings(rollouts=Rollouts(first=2, each=3), noise=0.02, epochs=Epochs(3, 2, 8))
    warmup, envs = Warmup(lcs, mpc, slide.make_envs(3), settings, 0, slide.STEPS), slide.make_envs()

    def make_main(first_episode: int, first_iteration: int) -> PPO:
        options = {"first_episode": first_episode, "first_iteration": first_iteration}
        options["total_episodes"] = 8 + 2 * slide.ROLLOUTS
        rollouts = slide.make_models(0, 2, iterations=1, rollouts=5) if models else None
        return slide.make_ppo(0, env=envs, models=rollouts, controller=mpc, options=options, **changes)

    return LCSRL(warmup, 8 * slide.STEPS, make_main)


def test_phases_follow_each_other():
    trainer = make_lcsrl()
    reports = [trainer.step() for _ in range(5)]
    assert [type(report).__name__ for report in reports] == ["WarmupReport"] * 3 + ["PPOReport"] * 2
    assert [report.iteration for report in reports] == [1, 2, 3, 4, 5]
    assert [report.env_steps for report in reports] == [
        slide.STEPS * n for n in (2, 5, 8, 8 + slide.ROLLOUTS, 8 + 2 * slide.ROLLOUTS)
    ]


def test_episodes_of_both_phases_differ():
    """The main phase goes on in the stream of the warm-up, where that has ended."""
    trainer, seeds = make_lcsrl(), []
    for _ in range(5):
        env = trainer.current.env if isinstance(trainer.current, Warmup) else trainer.current.robot.env
        count, reset = trainer.episodes, env.reset
        env.reset = lambda reset=reset, **options: (seeds.append(options["seed"]), reset(**options))[1]
        trainer.step()
        del env.reset
        seeds[-1] = seeds[-1][: trainer.episodes - count]
    flat = [seed for part in seeds for seed in part]
    assert len(set(flat)) == len(flat) == 8 + 2 * slide.ROLLOUTS


def test_a_trainer_goes_back_to_a_phase():
    """A state of either phase can be loaded in either phase."""
    trainer = make_lcsrl()
    trainer.step()
    early = copy_state(trainer.state_dict())
    for _ in range(3):
        trainer.step()
    late, state = slide.parameters(trainer), copy_state(trainer.state_dict())
    trainer.load(early)
    assert isinstance(trainer.current, Warmup)
    assert (trainer.iteration, trainer.env_steps) == (1, 2 * slide.STEPS)
    trainer.load(state)
    assert isinstance(trainer.current, PPO)
    assert slide.same(late, slide.parameters(trainer))


def test_the_main_phase_remembers_the_warm_up():
    trainer = make_lcsrl(models=True)
    for _ in range(3):
        trainer.step()
    assert len(trainer.current.models) == 8
    trainer.step()
    assert len(trainer.current.models) == 8 + slide.ROLLOUTS


def test_what_is_handed_out_is_bounded_on_states_of_the_warm_up():
    """Inside its episodes: PPO takes no step on these states, and model rollouts do not start there."""
    trainer, seen = make_lcsrl(models=True, gain=-3.0), []
    for _ in range(3):
        trainer.step()
    inside, incumbent = trainer.current.models.episodes["state"][:, 1:].unique(), trainer.current.incumbent
    follow = incumbent.follow
    incumbent.follow = lambda model, held_out: (seen.append(held_out), follow(model, held_out))
    for _ in range(2):
        trainer.step()
    assert all(bool(torch.isin(one["state"], inside).all()) for one in seen)
    assert len(seen[0]["state"].unique()) == len(inside)


# --- bad input --------------------------------------------------------------------------------------------------------


def test_bad_arguments_are_refused():
    options = {"features": slide.features, "total_episodes": 20, "episode_steps": slide.STEPS}
    env, mpc, settings = slide.make_envs(), slide.make_mpc(slide.make_model()), slide.small_settings()
    actor, make = make_actor(mpc, settings.std), ppo_settings.make_ppo
    fixed = make_actor(slide.make_mpc(mpc.lcs.params().detach()), settings.std)
    few, alone, diagonal = slide.make_envs(3), env.envs[0], replace(settings, covariance="diagonal")
    refuse(InvalidInputError, "at least 12 environments, got 3", make, actor, few, settings, 0, **options)
    refuse(InvalidInputError, "use an LCSModel", make, fixed, env, settings, 0, **options)
    refuse(InvalidInputError, "covariance='diagonal'", make, actor, env, diagonal, 0, **options)
    refuse(InvalidInputError, "shorten the warm-up", make, actor, env, settings, 0, **options, first_episode=20)
    refuse(DTypeError, r"use LCSMPCPolicy\(", make, mpc, env, settings, 0, **options)
    refuse(InvalidInputError, "env: expected a VectorEnv", make, actor, alone, settings, 0, **options)
    ppo = make(actor, env, settings, 0, **options | {"features": lambda *seen: slide.features(*seen) / 0})
    refuse(NonFiniteError, "features: expected finite", ppo.step)
    refuse(InvalidInputError, "std_range", replace, settings, std_range=(0.2, 0.1))
    bound = torch.full((1,), slide.U_MAX)
    network = make_actor(MLPController(slide.features, 3, -bound, bound, 4, slide.STEPS), settings.std)
    for changes in ({}, {"update": "adam", "beta": 0.5}):
        refuse(InvalidInputError, "without an LCS", make, network, env, replace(settings, **changes), 0, **options)
    make(network, env, replace(settings, update="adam"), 0, **options)
