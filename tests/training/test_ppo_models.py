"""PPO on model rollouts between the real episodes, on a small pushing system that needs no simulator."""

import numpy as np
import pytest
import torch

from difflcs.errors import CheckpointError
from difflcs.rl.rollout import collect, uniform_actions
from difflcs.rl.runs.evaluate import evaluate
from tests.conftest import refuse
from tests.training.slide import ROLLOUTS, STEPS, Noting, make_envs, make_models, make_ppo, recorded


def make_practising(seed: int = 0, first_epochs: int = 20, models: dict | None = None, **changes):
    return make_ppo(seed, models=make_models(seed, first_epochs, **(models or {})), **changes)


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
        trainer.remember(
            collect(make_envs(3), uniform_actions(make_envs(3), np.random.default_rng(0)), [1, 2, 3], STEPS)
        )
    seen = recorded(trainer, "practice")
    while not trainer.done:
        before = len(seen.calls)
        report = trainer.step()
        counts.append(len(seen.calls) - before)
        assert (report.model_success is None) == (report.model_loss is None) == (counts[-1] == 0)
    assert counts == expected


def test_steps_on_real_episodes_are_shorter_beside_model_rollouts():
    models = {"iterations": 2, "real_step": 0.25, "steps": 1}
    trainer = make_practising(models=models, final_step=1.0, steps=1)
    trainer.update = Noting(trainer.update)
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
    assert sizes == [ROLLOUTS, ROLLOUTS]


def success(trainer) -> float:
    while not trainer.done:
        trainer.step()
    return evaluate(make_envs(60), trainer.policy, 60, 0, STEPS).success_rate


SHORT = {"target_kl": 0.02}
"""Short steps: with the usual ones rounding decides in one training of twelve whether a late step ruins it."""


def test_model_rollouts_learn_from_less_data():
    models = {"iterations": 6, "rollouts": 30, "actions": 8}
    both = sum(success(make_practising(seed, 100, models, **SHORT)) for seed in range(2)) / 2
    assert both > sum(success(make_ppo(seed, **SHORT)) for seed in range(2)) / 2 + 0.15


def test_iterations_on_model_rollouts_have_an_effort_of_their_own():
    trainer = make_practising(
        models={"iterations": 1, "rollouts": 6, "steps": 5, "value_epochs": 2}, minibatch=STEPS * 4
    )
    trainer.step()
    batches, epochs = [], []
    trainer.actor.gaussian.register_forward_hook(lambda _, inputs, __: batches.append(len(inputs[0])))
    learn = trainer.critic.learn
    trainer.critic.learn = lambda *arguments: (epochs.append(arguments[-1]), learn(*arguments))
    trainer.step()
    steps, size = STEPS, STEPS * 4
    played = [6] * steps + [6 * steps] + [size, 12, size, 12, size]  # in lockstep, the metric, gradient steps
    real = [ROLLOUTS] * steps + [ROLLOUTS * steps] + [size] * 4
    assert batches == played + real
    assert epochs == [2, 3]


@pytest.mark.parametrize("actions", [1, 4])
def test_the_value_network_learns_from_what_the_estimator_says(actions):
    """From rewards without the action advantage in model rollouts, from real ones as they are."""
    trainer = make_practising(models={"iterations": 1, "actions": actions})
    seen = [recorded(trainer, "robot"), recorded(trainer, "practice")]
    for _ in range(2):
        trainer.step()
    (_, _, rewards, _), estimate = seen[1].calls[0], seen[1].results[0]
    assert estimate.samples.batch_size == (10, STEPS, actions)
    torch.testing.assert_close(trainer.critic.history[1][1], estimate.rewards, rtol=0, atol=0)
    assert torch.equal(estimate.rewards, rewards) == (actions == 1)
    assert torch.equal(trainer.critic.history[2][1], seen[0].calls[1][2])


def test_a_state_without_models_is_refused():
    trainer = make_ppo()
    trainer.step()
    refuse(CheckpointError, r"models.*other settings", make_practising().load, trainer.state_dict())
    refuse(CheckpointError, r"models.*other settings", trainer.load, make_practising().state_dict())
