"""`difflcs.physics.mujoco.cost`: squares of places and rotations, against MuJoCo's own kinematics."""

import mujoco
import numpy as np
import pytest
import torch

from difflcs import CostModule, LCSMPCLayer
from difflcs.errors import DTypeError, InvalidInputError, NonFiniteError, ShapeError
from difflcs.physics.mujoco import Distance, Effort, MujocoCost, MujocoLCS, Orientation, Position, Posture, Velocity
from tests.conftest import refuse

MODEL = """
<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="arm"><joint name="shoulder" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
    <body name="fore" pos=".3 0 0"><joint name="wrist" type="ball"/>
      <geom name="pad" type="box" size=".1 .02 .02" pos=".1 0 0" euler="20 30 40"/>
      <site name="tip" pos=".2 0 .1"/></body></body>
  <body name="cube" pos="0 .5 0"><freejoint name="free"/><geom name="cube" size=".05" mass=".3"/></body>
  <body name="cart" pos="0 0 1"><joint name="rail" type="slide" axis="1 0 0"/><geom size=".05"/></body>
</worldbody><actuator><motor joint="shoulder"/><motor joint="rail"/></actuator></mujoco>"""
GOAL = (0.9, 0.1, -0.3, 0.2)


def make(terms, dynamic=True, seed=0):
    """Cost, state and `qpos`; rotations count from another place than where they are."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    random, data = np.random.default_rng(seed), mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, random.normal(size=model.nv), 1.0)
    module = MujocoLCS(model, data, motion="dynamic" if dynamic else "quasi-static", contacts=1)
    qpos = data.qpos.copy()
    mujoco.mj_integratePos(model, qpos, random.normal(size=model.nv), 0.7)
    return MujocoCost(module, terms), module.state.to_state(qpos, random.normal(size=model.nv)), module


def look(module, x):
    """MuJoCo's own data at a state."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = module.state.to_mujoco(x)
    mujoco.mj_kinematics(model, data)
    return data


def truth(module, x, goal):
    """The squares, for the terms below."""
    data = look(module, x)
    left = np.zeros(3)
    mujoco.mju_subQuat(left, np.array(GOAL) / np.linalg.norm(GOAL), data.body("cube").xquat)
    return {
        "position": 3.0 * ((data.site("tip").xpos - goal) ** 2).sum(),
        "distance": ([1.0, 2.0, 3.0] * (data.geom("pad").xpos - data.body("cube").xpos) ** 2).sum(),
        "orientation": 5.0 * (left**2).sum(),
        "posture": 2.0 * ((data.qpos[[0, -1]] - [0.4, 0.1]) ** 2).sum(),
        "velocity": 0.3 * (data.qvel**2).sum(),
    }


TERMS = {
    "position": Position("tip", weight=3.0),
    "distance": Distance("pad", "cube", weight=(1.0, 2.0, 3.0)),
    "orientation": Orientation("cube", goal=GOAL, weight=5.0),
    "posture": Posture(goal=(0.4, 0.1), weight=2.0),
    "velocity": Velocity(weight=0.3),
}


def stage_cost(found, x):
    return 0.5 * x @ found.Q @ x + found.q @ x + found.constant_stage


@pytest.mark.parametrize("name", TERMS)
def test_value_and_gradient_at_the_state_are_those_of_the_squares(name):
    cost, x, module = make([Effort(), TERMS[name]])
    goal = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    found = cost.at(x, goal if name == "position" else None)
    away = torch.from_numpy(np.random.default_rng(1).normal(size=cost.n_x))

    def error(size):
        there = x + size * away
        return float(stage_cost(found, there)) - truth(module, there, goal.numpy())[name]

    assert error(0.0) == pytest.approx(0.0, abs=1e-9)
    assert (error(1e-4) - error(-1e-4)) / 2e-4 == pytest.approx(0.0, abs=1e-5)  # first derivatives are the same
    final = 0.5 * x @ found.Q_final @ x + found.q_final @ x + found.constant
    torch.testing.assert_close(final, stage_cost(found, x))
    assert float(torch.linalg.eigvalsh(found.Q)[0]) >= 0


def test_orientations_do_not_depend_on_the_reference():
    """The same squares, and the same change of them with MuJoCo's velocities, wherever rotation vectors count from."""
    (cost, x, module), found = make([TERMS["orientation"], TERMS["distance"]], seed=3), []
    data = look(module, x)
    for follow in (False, True):
        x = module.observe(data) if follow else x
        fields, T = cost.at(x), module.state.tangent(x.numpy()[: module.state.nv])
        per_velocity = np.eye(module.state.nv) if T is None else np.linalg.inv(T)
        H, g = (v.numpy()[..., : module.state.nv] for v in (fields.Q[: module.state.nv], fields.Q @ x + fields.q))
        found.append((stage_cost(fields, x).item(), per_velocity.T @ g, per_velocity.T @ H @ per_velocity))
    assert T is None  # the reference has moved
    for before, after in zip(*found, strict=True):
        np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("angle", [0.5, 3.0])
def test_a_goal_beyond_the_reach_pulls_no_harder(angle):
    cost, x, module = make([Orientation("cube", weight=2.0, reach=1.0)])
    turn, goal = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.6, 0.8]), angle)
    mujoco.mju_mulQuat(goal, look(module, x).body("cube").xquat, -3.0 * turn)  # of any length, and sign
    found = cost.at(x, torch.from_numpy(goal))
    assert float(stage_cost(found, x)) == pytest.approx(2.0 * min(angle, 1.0) ** 2)


def test_batches_of_states_and_goals_are_those_of_each():
    cost, x, module = make([Position("tip", goal=(0.1, 0.2, 0.3)), Orientation("cube"), Posture(["rail"]), Effort()])
    away = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 3, cost.n_x)))
    goals = torch.from_numpy(np.random.default_rng(1).normal(size=(2, 3, 5)))
    assert (cost.n_goal, cost.constant, MujocoCost(module, [Velocity(), Effort()]).constant) == (5, False, True)
    found = cost.at(x + 0.1 * away, goals).tensors()
    for i in np.ndindex(2, 3):
        own = cost.at((x + 0.1 * away)[i], goals[i]).tensors()
        for name in ("Q", "q", "Q_final", "q_final", "constant", "constant_stage"):
            assert torch.equal(found[name][i], own[name])  # whatever the others are
    assert cost.at(x, goals).q.shape == (2, 3, cost.n_x)
    assert cost.at(x, goals).Q.shape == (cost.n_x, cost.n_x)


@pytest.mark.parametrize("dynamic", [True, False])
def test_no_states_have_no_plans(dynamic):
    cost, x, module = make([Position("tip", goal=(0.1, 0.2, 0.3)), Effort()], dynamic)
    layer = LCSMPCLayer(module, cost, 3, -1.0, 1.0, passes=2)
    assert layer(x[: cost.n_x].expand(0, 2, -1)).u.shape == (0, 2, 3, 2)


def test_weights_and_goals_get_gradients():
    weight = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64, requires_grad=True)
    final = torch.nn.Parameter(torch.tensor(0.5, dtype=torch.float64))
    goal = torch.tensor([0.3, 0.1, 0.2, 1.0, -0.2, 0.3, 0.4], dtype=torch.float64, requires_grad=True)
    turn = Orientation("cube", weight=weight, weight_final=final, reach=2.0)
    cost, x, module = make([Position("tip"), turn, Effort(0.1)])
    assert isinstance(cost, CostModule)
    assert [name for name, _ in cost.named_parameters()] == ["weight_final_1"]

    def fields(*_):
        found = cost.at(x, goal)
        return found.Q, found.q, found.Q_final, found.q_final, found.constant, found.constant_stage

    assert torch.autograd.gradcheck(fields, (weight, final, goal), atol=1e-6)
    wanted = tuple(value.detach() for value in fields())
    with torch.no_grad():  # without gradients NumPy does it
        torch.testing.assert_close(fields(), wanted)
    plan = LCSMPCLayer(module, cost, 2, -1.0, 1.0)(x, goal)
    plan.action.square().sum().backward()
    assert float(weight.grad.abs().sum()) > 0
    for value in (weight, final):
        with torch.no_grad():
            value.mul_(-1)  # as an optimiser may
            refuse(InvalidInputError, "weight: expected at least 0 of weights that are learned", cost.at, x, goal)
            value.mul_(-1)


def test_an_arm_brings_its_hand_to_a_place():
    cost, x, module = make([Position("tip", weight=50.0), Effort(0.01)], dynamic=False)
    data = look(module, x)
    mpc = LCSMPCLayer(module, cost, 3, -0.1, 0.1)
    turn, goal, controller = np.zeros(4), np.zeros(3), mpc.controller()
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), 0.8)
    mujoco.mju_rotVecQuat(goal, data.site("tip").xpos, turn)
    for _ in range(12):
        x[0] += controller.step(x, goal)[0]
    assert np.linalg.norm(look(module, x).site("tip").xpos - goal) < 1e-3


@pytest.mark.parametrize(
    ("terms", "error", "message"),
    [
        ([Position("tipp")], InvalidInputError, r"\[0\] Position: expected a body or site or geom, one of .*cube, .*tip"
         r".*, got str 'tipp' \(did you mean tip\?\); n"),
        ([Position("site:cube")], InvalidInputError, "expected a site, one of tip, got"),
        ([Effort(), Distance("cube", 3)], InvalidInputError, r"terms\[1\] Distance: .*got int 3"),
        ([Posture(["free"], (0.0,))], InvalidInputError, "expected a slide or hinge, one of shoulder, rail, got"),
        ([Velocity("spin")], InvalidInputError, "expected a joint, one of shoulder, wrist, free, rail, got str"),
        ([Position("tip", goal=(1.0, 2.0))], ShapeError, r"goal: expected shape \(3,\), got \(2,\)"),
        ([Orientation("tip", goal=(np.nan, 0, 0, 1))], NonFiniteError, "goal: expected finite numbers"),
        ([Orientation("tip", reach=0.0)], InvalidInputError, "reach: expected .*above 0"),
        ([Effort((1.0, 2.0, 3.0))], ShapeError, "weight: expected one number or 2 of them"),
        ([Position("tip", weight_final=-1.0)], InvalidInputError, "weight_final: expected at least 0, got -1"),
        (["tip"], DTypeError, "expected Position, Orientation, … or Effort, got"),
    ],
)  # fmt: skip
def test_terms_that_do_not_fit_say_why(terms, error, message):
    refuse(error, message, make, terms)


def test_calls_that_do_not_fit_say_why():
    cost, x, module = make([Position("tip")])
    fixed = MujocoCost(module, [TERMS["posture"]])
    goal = torch.zeros(3, dtype=torch.float64)
    for call, message in (
        (lambda: cost.at(x), r"goal: expected \(..., n_goal=3\)"),
        (lambda: cost.at(x, goal[:2]), "n_goal=3"),
        (lambda: cost.at(x[:3], goal), "n_x=22"),
        (lambda: fixed.at(x, goal), "goal: expected none, as all terms have goals"),
        (
            lambda: LCSMPCLayer(module, cost, 2)(x, reference=goal.expand(3, 3)),
            "reference: expected a goal with Mujoco",
        ),
    ):
        refuse(ShapeError, message, call)
    with pytest.raises(
        InvalidInputError, match=r'Velocity: expected a module whose state has velocities \(motion="dyn'
    ):
        make([Velocity()], dynamic=False)
    refuse(DTypeError, "module: expected MujocoLCS", MujocoCost, mujoco.MjModel.from_xml_string(MODEL), [])
