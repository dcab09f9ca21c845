"""The stochastic policy as a TorchRL actor, on the small pushing system of `conftest`."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type

from difflcs import GoalCost, LCSMPCLayer
from difflcs.errors import DTypeError, InvalidInputError
from difflcs.rl.learning.policy import LCSMPCPolicy
from tests.conftest import refuse

U_MAX = 0.1
STD = 0.02


@pytest.fixture
def mpc(build):
    lcs = build.model(seed=3, n_x=2, n_u=2, n_lam=2, scale=0.3)
    cost = GoalCost.reach(2, 2, goal_weight=(5.0,), input_weight=0.5)
    return LCSMPCLayer(lcs, cost, horizon=4, u_min=-U_MAX, u_max=U_MAX, on_failure="mask")


def observations(*batch: int) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    state = 0.1 * torch.randn(*batch, 2, generator=generator, dtype=torch.float64)
    goal = 0.1 * torch.randn(*batch, 1, generator=generator, dtype=torch.float64)
    return TensorDict({"state": state, "goal": goal}, batch)


def test_mean_is_the_mpcs_action_and_noise_is_gaussian(mpc):
    policy = LCSMPCPolicy(mpc, torch.tensor([0.01, 0.03], dtype=torch.float64))
    one = observations()
    many = one.expand(4000).clone()
    with torch.no_grad(), torch.random.fork_rng():
        torch.manual_seed(0)
        policy(many)
    torch.testing.assert_close(many["loc"], mpc(many["state"], many["goal"]).action)
    noise = many["action"] - many["loc"]
    assert noise.mean(0).abs().max() < 4 * 0.03 / math.sqrt(4000)
    torch.testing.assert_close(noise.std(0), policy.std, rtol=0.05, atol=0.0)
    z = noise / policy.std
    expected = -0.5 * z.square().sum(-1) - policy.std.log().sum() - math.log(2 * math.pi)
    torch.testing.assert_close(many["action_log_prob"], expected)


def test_a_layer_is_a_tensordict_module(mpc):
    module = TensorDictModule(mpc, ["state", "goal"], ["plan"])
    data = module(observations(5, 3))
    assert torch.equal(data["plan", "u"], mpc(data["state"], data["goal"]).u)
    data["plan", "objective"].sum().backward()
    assert module.get_parameter("module.lcs.A").grad.abs().sum() > 0


def test_observations_in_single_precision_give_actions_in_it(mpc):
    data = LCSMPCPolicy(mpc, STD)(observations(3).float())
    assert data["action"].dtype == data["action_log_prob"].dtype == torch.float32
    torch.testing.assert_close(data["loc"].double(), mpc(*observations(3).values()).action, rtol=0, atol=1e-6)


def test_deterministic_mode_is_the_mean(mpc):
    policy = LCSMPCPolicy(mpc, STD)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        data = policy(observations(6))
    assert torch.equal(data["action"], data["loc"])
    assert bool((policy(observations(6))["action"] != data["loc"]).all())  # but by default it explores


def test_log_probability_is_that_of_the_unclipped_sample(mpc):
    policy = LCSMPCPolicy(mpc, 3 * U_MAX)
    data = policy(observations(200))
    clipped = policy.clip(data["action"])
    assert bool((data["action"].abs() > U_MAX).any())
    assert bool((clipped.abs() <= U_MAX).all())
    inside = (data["action"].abs() <= U_MAX).all(-1)
    assert torch.equal(clipped[inside], data["action"][inside])
    again = policy.get_dist(observations(200)).log_prob(data["action"])
    torch.testing.assert_close(again, data["action_log_prob"])
    outside = ~inside
    assert bool((policy.get_dist(observations(200)).log_prob(clipped)[outside] != again[outside]).all())


def test_what_is_learned(mpc):
    def learned(**options) -> set[str]:
        policy = LCSMPCPolicy(mpc, STD, **options)
        return {name.rpartition(".")[2] for name, p in policy.named_parameters() if p.requires_grad}

    model = set("ABCdDEGHc")
    assert learned() == model
    assert learned(covariance="diagonal") == model | {"log_std"}
    assert learned(covariance="full") == model | {"log_std", "mixing"}


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"mpc": None}, DTypeError, "LCSMPCLayer"),
        ({"std": 0.0}, InvalidInputError, "std"),
        ({"std": torch.tensor([0.1, -0.1])}, InvalidInputError, "positive"),
        ({"std": torch.tensor([0.1])}, InvalidInputError, "n_u=2"),
        ({"in_keys": ("state",)}, InvalidInputError, "two keys"),
        ({"covariance": "round"}, InvalidInputError, "covariance"),
    ],
)
def test_bad_arguments(mpc, arguments, error, message):
    refuse(error, message, LCSMPCPolicy, **{"mpc": mpc, **arguments})
