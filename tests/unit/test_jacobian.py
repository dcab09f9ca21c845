"""The Jacobian of the MPC's action by what is learned of its system, forwards and backwards."""

import pytest
import torch
from mujoco import MjModel
from torch.autograd.function import once_differentiable

from difflcs import GoalCost, LCSMPCLayer
from difflcs.physics import ContactLCS, PlanarPushing, box
from difflcs.physics.mujoco import LearnableMujocoLCS
from difflcs.rl.learning import jacobian

F64 = torch.float64
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
