"""`difflcs.physics.mujoco.cost`: squares of places and rotations, against MuJoCo's own kinematics."""

from __future__ import annotations

import numpy as np
import pytest
import torch

mujoco = pytest.importorskip("mujoco")

from difflcs.physics.mujoco import (  # noqa: E402
    Distance,
    Effort,
    MujocoCost,
    MujocoLCS,
    Orientation,
    Position,
    Posture,
    Velocity,
)

pytestmark = pytest.mark.usefixtures("one_thread")

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


# --- the squares ----------------------------------------------------------------------------------------------------


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


def test_at_their_goals_squares_are_right_to_second_order():
    cost, x, module = make([Orientation("cube"), Position("cube")])
    data = look(module, x)
    goal = torch.from_numpy(np.concatenate([data.body("cube").xquat, data.body("cube").xpos]))
    away = 1e-3 * torch.from_numpy(np.random.default_rng(1).normal(size=cost.n_x))
    again = cost.at(x + away, goal)
    assert float(stage_cost(cost.at(x, goal), x)) == pytest.approx(0.0, abs=1e-11)
    assert float(stage_cost(cost.at(x, goal), x + away)) == pytest.approx(float(stage_cost(again, x + away)), rel=1e-2)
