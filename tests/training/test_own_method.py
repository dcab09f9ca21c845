"""A task with a context, and a method that learns a module of one's own, by the common code of all trainings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pytest
import torch

from benchmarks.context import FORCE, HeavyBlock, Physics
from difflcs import GoalCost

pytest.importorskip("torchrl")
from difflcs.rl import (
    Epochs,
    Reporter,
    Rollouts,
    TaskSpec,
    TrainConfig,
    ViolationLoss,
    ViolationMethod,
    WarmupSettings,
    evaluate,
    get_method,
    load_policy,
    method_names,
    register_method,
    train,
)
from tests.training.slide import same

pytestmark = pytest.mark.usefixtures("one_thread")

STEPS = HeavyBlock.STEPS
LOSS = ViolationLoss(gamma="auto", xi=0.1)
OFF = {"damping": 2.0, "stiffness": 50.0, "added_mass": 0.6}


def outcome(state, action, after, goal, ended):
    error = abs(after[..., 0] - goal[..., 0])
    return -10 * error, error < 0.03


TASK = TaskSpec(
    name="heavy-block",
    env=HeavyBlock,
    make_cost=lambda: GoalCost.reach(2, 1, goal_weight=(20.0,), input_weight=0.002),
    u_min=-FORCE,
    u_max=FORCE,
    horizon=6,
    episode_steps=STEPS,
    step_seconds=0.1,
    n_context=1,
    features=lambda state, goal, elapsed, context: torch.cat(
        [5 * (state[..., :1] - goal), state[..., 1:], context.log1p(), elapsed.unsqueeze(-1)], -1
    ),
    outcome=outcome,
)


@dataclass(frozen=True)
class PhysicsMethod(ViolationMethod):
    """The warm-up of known physics with unknown numbers."""

    name: ClassVar[str] = "physics"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "the warm-up of known physics with unknown numbers"
    kind: ClassVar[str] = "Physics"
    takes_init: ClassVar[bool] = False

    def initial(self, work):
        return Physics(**OFF)

    def rebuild(self, task, config, tensors, source):
        found = Physics()
        found.load_state_dict(dict(tensors))
        return found


@pytest.fixture
def registered():
    register_method(PhysicsMethod)
    return PhysicsMethod(warmup=WarmupSettings(rollouts=Rollouts(4, 4), epochs=Epochs(8, 4, 20), noise=0.1, loss=LOSS))


class Stopped(Exception):
    """Raised to break a training off."""


class Stop(Reporter):
    def iterated(self, report):
        if report.iteration == 2:
            raise Stopped


def test_a_method_that_learns_a_module_of_ones_own(registered, tmp_path):
    """Its run directory, resumed, is that of an uninterrupted run, and acts as what was trained."""
    config = TrainConfig(task="heavy-block", method=registered, minutes=0.3, evaluate_at=(), final_goals=4)
    whole = train(config, tmp_path / "whole", task=TASK)
    with pytest.raises(Stopped):
        train(config, tmp_path / "parts", task=TASK, reporter=Stop())
    parts = train(config, tmp_path / "parts", task=TASK, resume=True)
    results = [run.learned("Physics") for run in (whole, parts)]
    assert results[0][0] == results[1][0] == {"class": "Physics", "n_x": 2, "n_u": 1, "n_lam": 1}
    assert same([*results[0][1].values()], [*results[1][1].values()])
    policy: Any = load_policy(whole, TASK)
    assert same([*policy.lcs.state_dict().values()], [results[0][1][name] for name in policy.lcs.state_dict()])
    assert float(whole.rows()[-1]["evaluation_success_rate"]) >= 0


@pytest.mark.parametrize("method", method_names())
def test_every_method_trains_a_task_with_a_context(method, tmp_path):
    config = replace(TrainConfig(task="heavy-block", method=get_method(method)()).smoke(), minutes=0.6)
    run = train(config, tmp_path / "run", task=TASK)
    policy = load_policy(run, TASK)
    envs = TASK.make_envs(4)
    again = evaluate(envs, policy, 4, 0, STEPS)
    assert again.success_rate == pytest.approx(float(run.rows()[-1]["evaluation_success_rate"]))
