"""Policies of PPO: a stochastic one around the MPC as a TorchRL actor, its Jacobian, and a network in its place."""

import math

import pytest
import torch
from mujoco import MjModel
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.autograd.function import once_differentiable
from torchrl.envs.utils import ExplorationType, set_exploration_type

from difflcs import GoalCost, LCSMPCLayer
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError
from difflcs.physics import ContactLCS, PlanarPushing, box
from difflcs.physics.mujoco import LearnableMujocoLCS
from difflcs.rl.learning import jacobian
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.learning.policy import LCSMPCPolicy
from tests.conftest import F64, Build, refuse
from tests.training.slide import STEPS, U_MAX, features

STD = 0.02


@pytest.fixture
def mpc(build):
    lcs = build.model(seed=3, n_x=2, n_u=2, n_lam=2, scale=0.3)
    cost = GoalCost.reach(2, 2, goal_weight=(5.0,), input_weight=0.5)
    return LCSMPCLayer(lcs, cost, horizon=4, u_min=-U_MAX, u_max=U_MAX, on_failure="mask")


def observations(*batch: int) -> TensorDict:
    n = Build.normal(0)
    return TensorDict({"state": 0.1 * n(*batch, 2), "goal": 0.1 * n(*batch, 1)}, batch)


def test_mean_is_the_mpcs_action_and_noise_is_gaussian(mpc):
    policy = LCSMPCPolicy(mpc, torch.tensor([0.01, 0.03], dtype=torch.float64))
    one = observations()
    many, none = one.expand(4000).clone(), policy(observations(0))
    assert (none["action"].shape, none["action_log_prob"].shape) == ((0, 2), (0,))
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


# --- the Jacobian of the mean -----------------------------------------------------------------------------------------


RAIL = """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0" damping=".5"/>
  <geom size=".1"/></body></worldbody><actuator><motor joint="rail" gear="40"/></actuator></mujoco>"""
LEARN = ("center_of_mass", "gyration", "friction", "radius")


class Once(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value):
        return value.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        return grad


class Stubborn(ContactLCS):
    """With a part that cannot be differentiated twice."""

    def params(self, x=None, context=None):
        system = super().params(x, context)
        return type(system)(**{**system.tensors(), "c": Once.apply(system.c)})


@pytest.mark.parametrize("kind", [ContactLCS, Stubborn])
def test_forwards_and_backwards_agree(build, kind, monkeypatch):
    system = PlanarPushing(box(-0.5, 0.5, -0.5, 0.5), 0.2, friction=0.3, compliance=0.1)
    cost = GoalCost.reach(5, 2, goal_weight=(1.0, 1.0, 0.3), goal_weight_final=(5.0, 5.0, 1.5), input_weight=0.01)
    goal = torch.tensor([0.3, 0.1, 0.2], dtype=F64).expand(40, 3)
    mpc = LCSMPCLayer(kind(system, LEARN), cost, 3, -0.2, 0.2, relaxation=1e-3)
    x = 0.1 * build.normal(0)(40, 5)
    x[:, 3] -= 0.7
    found = []
    for few in (jacobian.FEW_PARAMETERS, 0):
        monkeypatch.setattr(jacobian, "FEW_PARAMETERS", few)
        found.append(jacobian.system_jacobian(mpc, x, goal, None, None))
    torch.testing.assert_close(found[0], found[1])
    assert found[0].shape == (40, 2, 5)
    assert bool((found[0].abs().amax((0, 1)) > 1e-6).all())


def test_a_mujoco_model_by_differences_and_backwards_agree(monkeypatch):
    learned = LearnableMujocoLCS(MjModel.from_xml_string(RAIL), learn=["mass", "gain"], motion="dynamic", seconds=0.1)
    cost = GoalCost.reach(2, 1, goal_weight=(1.0,), goal_weight_final=(5.0,), input_weight=0.01)
    mpc = LCSMPCLayer(learned, cost, 3, -20.0, 20.0, relaxation=1e-3)
    at = torch.linspace(-0.1, 0.1, 6, dtype=F64).view(3, 2), torch.full((3, 1), 0.2, dtype=F64), None, None
    by_differences = jacobian.system_jacobian(mpc, *at)
    monkeypatch.delattr(LearnableMujocoLCS, "slopes_along")
    torch.testing.assert_close(by_differences, jacobian.system_jacobian(mpc, *at))
    assert by_differences.abs().min() > 1e-4


# --- a network instead of the MPC -------------------------------------------------------------------------------------


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
