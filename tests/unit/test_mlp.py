"""PPO with a network instead of the MPC, on a small system that needs no simulator."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv

from difflcs.errors import CheckpointError, InvalidInputError

pytest.importorskip("torchrl")
from difflcs.rl.critic import CriticSettings
from difflcs.rl.evaluate import evaluate
from difflcs.rl.methods import get_method
from difflcs.rl.mlp import MLPController
from difflcs.rl.policy import make_actor
from difflcs.rl.ppo import PPO
from difflcs.rl.ppo_settings import PPOSettings, make_ppo
from difflcs.rl.rollout import collect, elapsed_fractions, mpc_actions
from difflcs.rl.seeding import Stream, episode_seeds
from difflcs.rl.settings import Adam, Epochs
from tests.training.slide import STEPS, U_MAX, Slide, features

pytestmark = pytest.mark.usefixtures("one_thread")

ROLLOUTS = 20
BOUND = torch.full((1,), U_MAX, dtype=torch.float64)


def make_network(width: int = 16, seed: int = 0) -> MLPController:
    return MLPController(features, 3, -BOUND, BOUND, width, STEPS, torch.Generator().manual_seed(seed))


SETTINGS: PPOSettings = replace(
    get_method("ppo-mlp")().ppo,
    rollouts=ROLLOUTS,
    steps=6,
    minibatch=50,
    std=0.03,
    std_range=(0.01, 0.1),
    critic=CriticSettings(epochs=Epochs(first=10, each=10, minibatch=256)),
)


def make_trainer(seed: int = 0, iterations: int = 3, width: int = 64, **changes: Any) -> PPO:
    settings = replace(SETTINGS, **changes)
    return make_ppo(
        make_actor(make_network(width), settings.std, settings.covariance),
        SyncVectorEnv([Slide] * ROLLOUTS),
        settings,
        seed,
        features=features,
        total_episodes=iterations * ROLLOUTS,
        episode_steps=STEPS,
        failure_penalty=10.0,
    )


@pytest.mark.slow
def test_it_learns():
    trainer = make_trainer(iterations=12, steps=30, adam=Adam(3e-3, (0.9, 0.999)), std_learning_rate=3e-3)
    envs = trainer.robot.env
    before = evaluate(envs, trainer.policy, 60, 0, STEPS).success_rate
    while not trainer.done:
        report = trainer.step()
    assert before < 0.35
    assert evaluate(envs, trainer.policy, 60, 0, STEPS).success_rate > before + 0.4
    assert report.solver_failures == 0
    assert report.gradient_steps == 30
    assert report.std != pytest.approx(0.03)
    assert trainer.learned is trainer.policy


def test_actions_stay_within_the_bounds_and_depend_on_the_time():
    network = make_network()
    with torch.no_grad():
        network.layers[-2].weight.mul_(300)
    state, goal = torch.randn(50, 1).double(), torch.randn(50, 1).double()
    first = network(state, goal)
    assert bool((first.action.abs() <= U_MAX).all())
    assert float(first.action.detach().abs().max()) > 0.9 * U_MAX
    assert bool(first.converged.all())
    actions = [network(state, goal).action for _ in range(STEPS)]
    assert not torch.equal(actions[0], first.action)
    assert torch.equal(actions[-1], first.action)  # the next episode
    network.begin()
    assert torch.equal(network(state, goal).action, first.action)
    tight = network(state, goal, u_min=-0.01 * BOUND, u_max=0.01 * BOUND)
    assert bool((tight.action.abs() <= 0.01 * U_MAX).all())


def test_it_starts_near_the_middle_of_the_bounds():
    low = torch.tensor([0.1, -0.3], dtype=torch.float64)
    network = MLPController(features, 3, low, low + 0.2)
    state = torch.randn(50, 1).double()
    torch.testing.assert_close(network(state, -state).action, (low + 0.1).expand(50, 2), rtol=0, atol=0.01)


def test_training_and_evaluation_see_the_same_time():
    """The actor gets the elapsed time with the data, the controller counts its steps: without noise they agree."""
    trainer = make_trainer(std=1e-9)
    seen = []
    inner = trainer.robot.env.step
    trainer.robot.env.step = lambda actions: (seen.append(actions.copy()), inner(actions))[1]
    seeds = episode_seeds(0, Stream.TRAINING, 0, ROLLOUTS)
    wanted = collect(SyncVectorEnv([Slide] * ROLLOUTS), mpc_actions(trainer.policy), seeds, STEPS)["action"]
    trainer.step()
    torch.testing.assert_close(torch.from_numpy(np.stack(seen, 1)), wanted, rtol=0, atol=1e-7)
    elapsed = elapsed_fractions(STEPS)
    torch.testing.assert_close(elapsed, torch.arange(STEPS + 1).double() / STEPS)
    mean = torch.stack([make_network(64).mean(torch.zeros(1), torch.zeros(1), t) for t in elapsed])
    assert len(set(mean.flatten().tolist())) == STEPS + 1  # it does depend on the time


def test_the_initial_weights_are_the_generators():
    state = torch.random.get_rng_state()
    one, two, other = make_network(seed=0), make_network(seed=0), make_network(seed=1)
    assert torch.equal(state, torch.random.get_rng_state())
    assert torch.equal(one.layers[0].weight, two.layers[0].weight)
    assert not torch.equal(one.layers[0].weight, other.layers[0].weight)


def test_saved_and_loaded(tmp_path):
    network = make_network()
    network.save_pretrained(tmp_path)
    again = MLPController.from_pretrained(tmp_path, features)
    state = torch.randn(5, 1).double()
    assert torch.equal(network(state, -state).action, again(state, -state).action)
    assert again.episode_steps == STEPS
    (tmp_path / "config.json").unlink()
    with pytest.raises(CheckpointError, match="missing"):
        MLPController.from_pretrained(tmp_path, features)


@pytest.mark.parametrize("change", [{"beta": 0.5}, {"update": "natural"}])
def test_what_needs_an_lcs_is_refused(change):
    with pytest.raises(InvalidInputError, match="without an LCS"):
        make_trainer(**change)
