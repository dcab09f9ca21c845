"""The Jacobian of the MPC's action by what is learned of its system, forwards and backwards."""

import pytest
import torch
from torch.autograd.function import once_differentiable

from difflcs import GoalCost, LCSMPCLayer
from difflcs.physics import ContactLCS, PlanarPushing, box
from difflcs.rl.learning import jacobian

F64 = torch.float64
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
