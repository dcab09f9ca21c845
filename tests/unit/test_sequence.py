"""A module linearised along a plan, and a layer that plans in several passes."""

import mujoco
import pytest
import torch

from difflcs import GoalCost, LCSMPCLayer, LCSSequence, QuadraticCost, sequence_along
from difflcs.errors import DTypeError, InvalidInputError
from difflcs.physics import ContactLCS, PlanarPushing, PositionDrive, box
from difflcs.physics.mujoco import Effort, MujocoCost, MujocoLCS, Position
from tests.conftest import linear_system, refuse, tensor

DOOR = """<mujoco><option timestep=".002" integrator="implicitfast"/><worldbody>
  <body><joint name="angle" type="hinge" axis="0 0 1" damping=".5"/>
    <geom type="box" pos=".15 0 0" size=".15 .01 .05" mass=".5" friction=".3"/></body>
  <body pos=".2 -.04 0"><joint name="px" type="slide" axis="1 0 0"/><joint name="py" type="slide" axis="0 1 0"/>
    <geom type="sphere" size=".02" mass=".2" friction=".3"/></body></worldbody>
  <actuator><position joint="px" kp="2000" dampratio="1"/><position joint="py" kp="2000" dampratio="1"/></actuator>
</mujoco>"""
PENDULUM = """<mujoco><option timestep=".005" integrator="RK4"/><worldbody><body>
  <joint name="q" axis="0 1 0" damping=".02"/><geom pos="0 0 -.5" size=".05" mass=".7"/></body></worldbody>
  <actuator><motor joint="q"/></actuator></mujoco>"""

ARM = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/>
  <body pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/>
    <site name="tip" pos=".3 0 0"/></body></body></worldbody>
  <actuator><position joint="a" kp="100"/><position joint="b" kp="100"/></actuator></mujoco>"""


def execute(module, model, plan, steps):
    """Where the plan's actions lead in MuJoCo, without looking again: (qpos, qvel)."""
    data = mujoco.MjData(model)
    for x, u in zip(plan.x[:-1], plan.u, strict=True):
        data.ctrl[:] = module.control(x, u).numpy()
        mujoco.mj_step(model, data, steps)
    return tensor([*data.qpos, *data.qvel])


def pushing():
    system = PlanarPushing(box(-0.05, 0.05, -0.05, 0.05), 0.01, friction=0.3, drive=PositionDrive())
    cost = GoalCost.reach(5, 2, goal_weight=(400.0, 400.0, 1.0), input_weight=4.0)
    x = tensor([0, 0, 0, -0.065, 0.02]), tensor([0, 0, 0.3, -0.08, 0.0])
    return system, cost, torch.stack(x), tensor([0.04, 0.01, 0.5])


def test_a_sequence_moves_as_the_module_asked_anew_at_each_step():
    system, cost, x, goal = pushing()
    plan = LCSMPCLayer(system, cost, 6, -0.02, 0.02)(x, goal)
    along = sequence_along(system, plan)
    states = [x]
    for u in plan.u.unbind(1):
        states.append(system.params(states[-1]).step(states[-1], u).x_next)
    torch.testing.assert_close(along.rollout(x, plan.u), torch.stack(states, 1))
    torch.testing.assert_close(along.stage(2).D, system.params(states[2]).D)
    later = sequence_along(system, plan.shift(), states[1])
    torch.testing.assert_close(later.stage(0).D, along.stage(1).D)


@pytest.mark.parametrize(("passes", "wrong"), [(1, 0.38), (2, 0.06), (4, 0.03)])
def test_a_door_is_pushed_as_far_as_several_passes_say(passes, wrong):
    """The direction in which the pusher pushes turns with the door; one system has that of the beginning."""
    module = MujocoLCS(model := mujoco.MjModel.from_xml_string(DOOR), mobility="damping")
    cost = GoalCost.reach(3, 2, goal_weight=(10.0,), goal_weight_final=(100.0,), input_weight=20.0)
    mpc = LCSMPCLayer(module, cost, 10, -0.05, 0.05, passes=passes)
    for goal in (0.6, 1.4):
        plan = mpc(torch.zeros(3, dtype=torch.float64), tensor([goal]))
        assert plan.x[-1, 0] == pytest.approx(goal, abs=0.01)
        error = abs(float(execute(module, model, plan, 50)[0]) - goal)
        assert error > wrong if passes == 1 else error < wrong


@pytest.mark.parametrize(("passes", "wrong"), [(1, 1.5), (5, 0.05)])
def test_a_pendulum_is_turned_upright_in_several_passes(passes, wrong):
    """Gravity turns back on the way up, and one system has it as it hangs."""
    module = MujocoLCS(model := mujoco.MjModel.from_xml_string(PENDULUM), motion="dynamic", seconds=0.05)
    goal = tensor([torch.pi, 0.0])
    Q, Q_final = torch.diag(tensor([0.1, 0.01])), torch.diag(tensor([200.0, 20.0]))
    cost = QuadraticCost(Q, 0.05 * torch.eye(1, dtype=torch.float64), Q_final, q=-Q @ goal, q_final=-Q_final @ goal)
    plan = LCSMPCLayer(module, cost, 20, -4.1, 4.1, passes=passes)(torch.zeros(2, dtype=torch.float64))
    error = float((execute(module, model, plan, 10) - goal).abs().max())
    assert error > wrong if passes == 1 else error < wrong
    along = module.sequence(plan)
    assert isinstance(along, LCSSequence)
    torch.testing.assert_close(  # the plan's actions are the nominal controls of dynamic motion
        along.stage(0).d, module.params(plan.x[0], module.control(plan.x[0], plan.u[0])).d
    )


@pytest.mark.parametrize("constant", [False, True])
def test_an_arm_reaches_as_far_as_a_cost_along_the_plan_says(constant):
    """Where the tip is depends on the joints through sines, of which one pass knows the tangents at the beginning."""
    module = MujocoLCS(model := mujoco.MjModel.from_xml_string(ARM))
    x, goal = tensor([0.1, 0.2]), tensor([0.2, 0.0, -0.35])
    cost, errors = MujocoCost(module, [Position("tip", weight=0.1, weight_final=100.0), Effort(0.1)]), []
    for passes in (1, 8):
        mpc = LCSMPCLayer(module.params(x) if constant else module, cost, 6, -0.4, 0.4, passes=passes)
        plan = mpc(x.expand(2, 2), torch.stack([goal, goal]))
        data, away = mujoco.MjData(model), []
        for state in plan.x[1]:
            data.qpos[:] = state.numpy()
            mujoco.mj_forward(model, data)
            away.append((tensor([*data.site("tip").xpos]) - goal).square().sum())
        errors.append(float(away[-1].sqrt()))
    assert errors[0] > 0.2  # m
    assert errors[1] < 0.002
    squares = 0.1 * (sum(away[:-1]) + plan.u[1].square().sum()) + 100 * away[-1]  # the plan's cost is that of the arm
    torch.testing.assert_close(plan.objective[1], squares, rtol=1e-3, atol=1e-6)


def test_gradients_of_several_passes_are_those_of_the_last():
    system, cost, x, goal = pushing()
    model = ContactLCS(system, ["friction", "center_of_mass"])
    x.requires_grad_()
    plan = LCSMPCLayer(model, cost, 5, -0.02, 0.02, passes=2)(x, goal)
    found = torch.autograd.grad(plan.objective.sum(), [x, *model.parameters()])
    mpc = LCSMPCLayer(model, cost, 5, -0.02, 0.02)
    first = mpc(x.detach(), goal)
    last = mpc(x, goal, lcs=sequence_along(model, first, x), guess=first)
    torch.testing.assert_close(plan.u, last.u)
    torch.testing.assert_close(found, torch.autograd.grad(last.objective.sum(), [x, *model.parameters()]))


class Drift:
    """A system that drifts by its context, and refuses to be asked without."""

    n_x, n_u, n_lam = 1, 1, 0

    def __init__(self, kind=lambda system: system):
        self.kind = kind

    def params(self, x=None, context=None):
        return self.kind(linear_system([[1.0]], [[1.0]], context))


def test_a_context_holds_for_all_stages():
    cost = GoalCost.reach(1, 1, goal_weight=(1.0,), input_weight=1.0)
    plan = LCSMPCLayer(Drift(), cost, 3, passes=3)(tensor([0.0]), tensor([0.0]), context=tensor([0.5]))
    torch.testing.assert_close(plan.x[1:] - plan.x[:-1], plan.u + 0.5)


def test_refuses_what_passes_cannot_do():
    cost = GoalCost.reach(1, 1, goal_weight=(1.0,), input_weight=1.0)
    refuse(InvalidInputError, "passes: expected", LCSMPCLayer, Drift(), cost, 3, passes=0)
    refuse(InvalidInputError, "passes=1", LCSMPCLayer(Drift(), cost, 3, passes=2).controller)
    staged = Drift(lambda system: LCSSequence.stack([system] * 3))
    with pytest.raises(DTypeError, match="expected LCSParams from Drift"):
        LCSMPCLayer(staged, cost, 3, passes=2)(tensor([0.0]), tensor([0.0]), context=tensor([0.5]))
