"""PPO with a network instead of the MPC, on a small system that needs no simulator."""

import pytest
import torch

from difflcs.errors import CheckpointError
from difflcs.rl.learning.mlp import MLPController
from tests.training.slide import STEPS, U_MAX, features

BOUND = torch.full((1,), U_MAX, dtype=torch.float64)


def make_network() -> MLPController:
    return MLPController(features, 3, -BOUND, BOUND, 16, STEPS, torch.Generator().manual_seed(0))


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


@pytest.mark.parametrize("config", [{}, {"n_features": 3, "width": 0, "episode_steps": STEPS}])
def test_sizes_that_make_no_network_are_refused(config):
    with pytest.raises(CheckpointError, match="expected a network written by difflcs"):
        MLPController.from_config(config, make_network().state_dict(), "here", features)
