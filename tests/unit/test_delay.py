"""Actions that come late, on a small contact system whose model is exact."""

import numpy as np
import pytest
import torch

from difflcs import LCSSequence
from difflcs.errors import DTypeError, InvalidInputError
from difflcs.rl.rollout import collect, mpc_actions
from difflcs.rl.runs.delay import delay_actions, make_predictor
from difflcs.rl.runs.evaluate import evaluate
from tests.conftest import refuse
from tests.training.pusher import STEPS, Reach, make_envs, pusher

SEEDS = [1, 2, 3, 4]


def played(steps=0, predict=None):
    return collect(make_envs(4), delay_actions(mpc_actions(Reach()), 1, steps, predict), SEEDS, STEPS)


def test_no_delay_changes_nothing():
    assert torch.equal(played()["state"], collect(make_envs(4), mpc_actions(Reach()), SEEDS, STEPS)["state"])


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_what_is_planned_is_executed_later(steps):
    record = played(steps)
    assert not record["action"][:, :steps].any()
    act = mpc_actions(Reach())
    for t in range(steps, STEPS):
        planned, _ = act(record["state"][:, t - steps], record["goal"])
        assert np.array_equal(planned, record["action"][:, t].numpy())


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_with_an_exact_model_only_the_first_steps_are_lost(steps):
    """From there on each action is that of the state in which it is executed."""
    record = played(steps, make_predictor(pusher()))
    act = mpc_actions(Reach())
    for t in range(steps, STEPS):
        planned, _ = act(record["state"][:, t], record["goal"])
        torch.testing.assert_close(record["action"][:, t], torch.from_numpy(planned))
    assert not torch.equal(record["state"], played(steps)["state"])


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
