"""Episodes in lockstep, on time and late, and what is counted of them, on a small system that needs no simulator."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from difflcs import LCSSequence, StageBounds, solve_lcp
from difflcs.errors import DTypeError, InvalidInputError
from difflcs.rl.rollout import (
    action_bounds,
    append_episodes,
    collect,
    make_empty_record,
    mpc_actions,
    noisy_actions,
    transitions,
)
from difflcs.rl.runs.delay import delay_actions, make_predictor
from difflcs.rl.runs.evaluate import evaluate, wilson_interval
from difflcs.rl.runs.training import TrainConfig, train
from difflcs.rl.seeding import Stream, episode_seeds, generator, number, numbers
from difflcs.rl.tasks import Quantity
from tests.conformance.toy import make_task
from tests.conftest import refuse
from tests.training.pusher import STEPS, U_MAX, PusherEnv, Reach, make_envs, pusher


def test_collect_returns_what_happened():
    env = make_envs(3)
    rng = np.random.default_rng(0)
    rollouts = collect(env, noisy_actions(mpc_actions(Reach()), 0.5, rng), [1, 2, 3], STEPS)
    assert rollouts["state"].shape == (3, STEPS + 1, 2)
    assert rollouts["action"].shape == (3, STEPS, 1)
    assert rollouts["failures"].tolist() == [0, 0, STEPS]  # the third of three, at each step
    assert bool((rollouts["action"].abs() <= U_MAX).all())  # stored as executed, not as noised
    assert bool((rollouts["action"].abs() == U_MAX).any())
    params = pusher()
    x, u, x_next = transitions(rollouts)
    assert torch.equal(x.view(3, STEPS, 2), rollouts["state"][:, :-1])
    lam = solve_lcp(params.F, params.gap(x, u)).lam
    torch.testing.assert_close(params.next_state(x, u, lam), x_next)  # no reset between two steps
    torch.testing.assert_close(
        rollouts["errors", "position_error"], (rollouts["state"][:, -1, :1] - rollouts["goal"]).abs()[:, 0]
    )


@pytest.mark.parametrize(("length", "got"), [(STEPS - 1, f"one of {STEPS - 1}"), (STEPS + 1, "a longer one")])
def test_episodes_of_another_length_are_refused(length, got):
    with pytest.raises(InvalidInputError, match=f"episodes of {STEPS} steps, got {got}"):
        collect(make_envs(2, length=length), mpc_actions(Reach()), [1, 2], STEPS)


def test_same_step_autoreset_is_refused():
    env = SyncVectorEnv([PusherEnv], autoreset_mode=AutoresetMode.SAME_STEP)
    refuse(InvalidInputError, "autoreset", collect, env, mpc_actions(Reach()), [1], STEPS)
    refuse(InvalidInputError, "num_envs=1", collect, make_envs(1), mpc_actions(Reach()), [1, 2], STEPS)
    refuse(InvalidInputError, "seeds: expected at least 0", collect, make_envs(1), mpc_actions(Reach()), [-1], STEPS)
    refuse(InvalidInputError, "env: expected a VectorEnv", collect, None, mpc_actions(Reach()), [1], STEPS)
    refuse(DTypeError, "act: expected a function .* Identity; use", collect, env, torch.nn.Identity(), [1], STEPS)


def test_records_are_extended_by_stable_episodes_and_keep_the_newest():
    env = SyncVectorEnv([lambda: PusherEnv(breaks_at=4), PusherEnv])
    known = make_empty_record(env, STEPS)
    assert len(known) == 0
    record = collect(env, mpc_actions(Reach()), [1, 2], STEPS)
    assert record["stable"].tolist() == [False, True]
    assert not record["success"][0]
    known = append_episodes(known, record)
    assert torch.equal(known["state"], record["state"][1:])
    later = collect(make_envs(2), mpc_actions(Reach()), [3, 4], STEPS)
    assert torch.equal(append_episodes(known, later, keep=2)["goal"], later["goal"])
    assert len(append_episodes(known, later)) == 3
    refuse(InvalidInputError, "stable simulation", append_episodes, make_empty_record(env, STEPS), record[:1])


@pytest.mark.parametrize(
    ("reward", "info", "match"),
    [(1.0, {}, "`success`")]
    + [(1.0, {"success": value}, "True or False") for value in ("no", 0.3, np.nan, [1])]
    + [(value, {"success": True}, "finite rewards, got .* in step 1") for value in (-np.inf, np.nan)]
    + [(1.0, {"success": value}, None) for value in (True, np.True_, 1, np.float32(1))],
)
def test_an_environment_must_say_whether_it_succeeded_and_what_it_earned(reward, info, match):
    class Told(PusherEnv):
        def step(self, action):
            observation, _, *ended, _ = super().step(action)
            return observation, reward, *ended, info

    if match is None:
        assert bool(collect(SyncVectorEnv([Told]), mpc_actions(Reach()), [1], STEPS)["success"])
        return
    refuse(InvalidInputError, match, collect, SyncVectorEnv([Told]), mpc_actions(Reach()), [1], STEPS)


# --- success rates and their intervals --------------------------------------------------------------------------------


def test_wilson_interval_equals_scipy():
    from scipy import stats

    for successes, trials in [(0, 1), (1, 1), (13, 300), (195, 300), (300, 300)]:
        for confidence in (0.9, 0.95):
            reference = stats.binomtest(successes, trials).proportion_ci(confidence, "wilson")
            ours = wilson_interval(successes, trials, confidence)
            assert ours == pytest.approx((reference.low, reference.high), abs=1e-12)
    refuse(InvalidInputError, "trials=3", wilson_interval, 4, 3)


def test_evaluation_does_not_depend_on_the_number_of_environments():
    progress = []
    results = [evaluate(make_envs(n), Reach(), 7, 3, STEPS, after_step=progress.append) for n in (2, 7)]
    assert replace(results[0], solver_failures=0) == replace(results[1], solver_failures=0)
    assert results[0].goals == 7
    assert results[0].success_rate == results[0].successes / 7
    assert set(results[0].median_errors) == {"position_error"}
    assert sum(progress) == 2 * 7 * STEPS


def test_evaluation_bounds():
    policy = Reach()
    bound = torch.tensor([0.01], dtype=torch.float64)
    evaluate(make_envs(2), policy, 2, 0, STEPS, -bound, bound)
    assert policy.bounds[0] == (-bound, bound)


def test_a_policy_may_take_states_and_goals_alone_and_return_actions():
    def toward(x0, goal):
        return (goal - x0[:, 1:]).clamp(-U_MAX, U_MAX)

    policies = toward, lambda *given: toward(*given).numpy(), Reach()
    *found, expected = (evaluate(make_envs(2), policy, 4, 0, STEPS) for policy in policies)
    assert found == [replace(expected, solver_failures=0)] * 2
    bound = torch.tensor([0.01], dtype=torch.float64)
    refuse(InvalidInputError, "u_max: expected none", evaluate, make_envs(2), toward, 2, 0, STEPS, -bound, bound)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (7, "policy: expected a function of states and goals, got int 7"),
        (lambda x0: x0, "policy: expected a function of states and goals, got function"),
        (lambda x0, goal: goal[:, 0], r"policy: expected it to return plans or actions \(2, n_u\), got \(2,\)"),
        (lambda x0, goal: goal.expand(-1, 2), r"policy: expected actions \(2, n_u=1\), .* got \(2, 2\); return"),
    ],
)
def test_what_is_no_policy_is_refused(policy, message):
    refuse(DTypeError, message, evaluate, make_envs(2), policy, 2, 0, STEPS)
    refuse(DTypeError, "config: expected TrainConfig", train, {"task": "cube"})


def test_bounds_of_a_policy_by_stage_and_by_element_narrow_the_action_space():
    env, most = make_envs(2), torch.tensor([[0.03], [0.06]], dtype=torch.float64)
    staged = SimpleNamespace(bounds=StageBounds(-most, most), u_min=-torch.ones(1), u_max=torch.ones(1))
    for policy, bound in ((staged, 0.03), (SimpleNamespace(u_min=-most, u_max=most), 0.06)):
        assert torch.cat(action_bounds(env, policy)).tolist() == [-bound, bound]


def test_broken_episodes_count_as_failures():
    result = evaluate(make_envs(2, breaks_at=4), Reach(), 2, 0, STEPS)
    assert result.unstable == 2
    assert str(result).endswith(", 2 episodes unstable")
    assert result.successes == 0
    mixed = evaluate(SyncVectorEnv([lambda: PusherEnv(breaks_at=4), PusherEnv]), Reach(), 2, 0, STEPS)
    assert mixed.unstable == 1


def test_an_error_of_the_task_that_is_never_reported_ends_the_evaluation(tmp_path):
    errors = Quantity("position_error", "m"), Quantity("angle_error", "rad")
    message = "expected angle_error in the info .* got position_error; report"
    refuse(InvalidInputError, message, evaluate, make_envs(2), Reach(), 2, 0, STEPS, errors=errors)
    config = TrainConfig("toy", 0.1, method="violation", final_goals=2)
    refuse(InvalidInputError, message, train, config, tmp_path, task=make_task(errors=errors))


def test_what_is_counted_is_what_the_episodes_say():
    seeds = episode_seeds(3, Stream.EVALUATION, 0, 7)
    episodes = collect(make_envs(7), mpc_actions(Reach()), seeds, STEPS)
    result = evaluate(make_envs(7), Reach(), 7, 3, STEPS)
    assert result.successes == int(episodes["success"].sum())
    assert result.median_errors["position_error"] == float(episodes["errors", "position_error"].quantile(0.5))
    assert result.solver_failures == int(episodes["failures"].sum())
    assert result.solves == 7 * STEPS
    assert f"{100 * result.success_rate:.1f} % of 7 goals" in str(result)


@pytest.mark.parametrize(("goals", "seed", "name"), [(0, 0, "goals"), (2, -1, "seed"), (True, 0, "goals")])
def test_bad_numbers_are_refused(goals, seed, name):
    refuse(InvalidInputError, name, evaluate, make_envs(2), Reach(), goals, seed, STEPS)


# --- actions that come late -------------------------------------------------------------------------------------------


SEEDS = [1, 2, 3, 4]


def played(steps, predict=None):
    return collect(make_envs(4), delay_actions(mpc_actions(Reach()), 1, steps, predict), SEEDS, STEPS)


@pytest.mark.parametrize("steps", [0, 1, 2, 3])
def test_what_is_planned_is_executed_later_and_an_exact_model_plans_for_then(steps):
    """With such a model only the first steps are lost."""
    act, late, exact = mpc_actions(Reach()), played(steps), played(steps, make_predictor(pusher()))
    assert not late["action"][:, :steps].any()
    for record, lag, rtol in ((late, steps, 0.0), (exact, 0, 1e-7)):
        for t in range(steps, STEPS):
            planned, _ = act(record["state"][:, t - lag], record["goal"])
            torch.testing.assert_close(record["action"][:, t], torch.from_numpy(planned), rtol=rtol, atol=rtol)
    assert torch.equal(exact["state"], late["state"]) == (steps == 0)


def test_evaluation_with_delay():
    policy = Reach()
    cases = (0, None), (2, None), (2, pusher())
    on_time, late, predicted = (evaluate(make_envs(4), policy, 4, 0, STEPS, delay=d, model=m) for d, m in cases)
    assert late.median_errors["position_error"] != on_time.median_errors["position_error"]
    assert late.median_errors["position_error"] != predicted.median_errors["position_error"]
    refuse(InvalidInputError, "delay", evaluate, make_envs(4), policy, 4, 0, STEPS, delay=-1)


def test_a_system_per_stage_predicts_no_single_step():
    class Staged:
        n_x, n_u, n_lam = 2, 1, 1

        def params(self, x=None, context=None):
            return LCSSequence.stack([pusher()] * 2)

    refuse(DTypeError, "one step", played, 1, make_predictor(Staged()))


# --- random numbers ---------------------------------------------------------------------------------------------------


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
