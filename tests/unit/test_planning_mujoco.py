"""Places and ways of end effectors of MuJoCo models, on slides and at the end of an arm, and trials of controls."""

import mujoco
import numpy as np
import pytest
import torch

from difflcs.errors import InvalidInputError, ShapeError
from difflcs.physics.mujoco import MujocoLCS
from difflcs.planning.mujoco import BodyPlaces, BodyTravel, Rehearsal
from tests.conftest import refuse

WORLD = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="box" pos=".35 0 .05"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
    <joint axis="0 0 1"/><geom type="box" size=".05 .03 .05"/><geom type="box" pos="0 .05 0" size=".02 .04 .05"/>
  </body>{}</worldbody><actuator>{}</actuator></mujoco>"""
SLIDES = """<body name="tip" pos="0 0 .05"><joint name="a" type="slide" axis="1 0 0" range="-.5 .5"/>
  <joint name="b" type="slide" axis="0 1 0"/><geom type="sphere" size=".015"/></body>"""
ARM = """<body pos="0 0 .35"><joint name="a" axis="0 0 1" range="-3 3"/><joint name="b" axis="0 1 0" range="-2 2"/>
  <geom type="capsule" fromto="0 0 0 .35 0 0" size=".02"/><body pos=".35 0 0"><joint name="c" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .35 0 0" size=".012"/><body pos=".35 0 0"><joint name="d" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .2 0 0" size=".01"/><site name="tip" pos=".2 0 0"/></body></body></body>"""


@pytest.mark.parametrize(("robot", "start"), [(SLIDES, (0.2, 0.0)), (ARM, (0.6, -0.6, 1.2, 0.97))])
def test_places_are_at_the_gap_and_ways_lead_round_the_body_or_over_it_and_touch_nothing(robot, start):
    servos = "".join(f'<position joint="{joint}" kp="100"/>' for joint in "abcd"[: len(start)])
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(WORLD.format(robot, servos)))
    data.qpos[:] = [0.05, 0.1, 0.7, *start]
    module = MujocoLCS(model, data)
    places = BodyPlaces(module, "box", ["tip"], 12, gap=0.005, height=0.0)
    travel = BodyTravel(places, clearance=0.03, over=0.12, step=0.2)
    x = module.observe(data)
    states = places.states(x, places.sample(x))
    assert len(states) == 12
    torch.testing.assert_close(states[:, :3], x[:3].expand(12, 3))
    assert float(states[:, 3].max()) <= (0.5 if robot is SLIDES else 3.0)
    states = states[places.allowed(states)]
    assert 6 <= len(states)
    assert float(places.gaps(states).max()) < 0.0052
    assert robot is ARM or float(places.gaps(states).min()) > 0.0048  # a finger that leans is nearer than its tip
    assert all(places.near(state) for state in states)
    assert not places.near(x)
    x, target = states[0], states[len(states) // 2]
    assert not travel.arrived(x, target)
    for _ in range(40):
        u = travel.action(x, target)
        assert float(u.abs().max()) <= 0.2 + 1e-12
        for _ in range(5):
            x = torch.cat([x[:3], x[3:] + u / 5])
            assert float(places.gaps(x)) > 0
        if travel.arrived(x, target):
            break
    assert travel.arrived(x, target)
    refuse(InvalidInputError, "effectors: expected", BodyPlaces, module, "box", ["box"])
    refuse(InvalidInputError, "may touch the body None", BodyPlaces, module, None, ["tip"])
    refuse(
        InvalidInputError, r"effectors\[0\]: expected a .*'tap' \(did you mean tip", BodyPlaces, module, "box", ["tap"]
    )
    refuse(ShapeError, "states: expected", places.gaps, x[:2])
    refuse(InvalidInputError, r"of\[0\]: expected at most", places.gaps, x, [99])
    refuse(InvalidInputError, "effector: expected at most 0, got 1", places.ring, x, 1, 0.1)


@pytest.mark.filterwarnings("ignore:expected a system as near:difflcs.errors.ContactWarning")  # of ±1 N in 0.1 s
def test_joints_that_move_are_driven_to_where_they_come_to_rest():
    """In two steps, as long as what is no longer driven goes on."""
    model = mujoco.MjModel.from_xml_string(WORLD.format(SLIDES, '<motor joint="a"/><motor joint="b"/>'))
    module = MujocoLCS(model, motion="dynamic", seconds=0.1)
    places = BodyPlaces(module, "box", ["tip"], 12, gap=0.005)
    x = module.observe(mujoco.MjData(model))
    x[8:] = torch.tensor([0.02, -0.01])
    target = x + 0.01 * torch.eye(10, dtype=x.dtype)[3]
    after = module.params(x).step(x, BodyTravel(places, clearance=0.03, step=9.0).action(x, target)).x_next
    torch.testing.assert_close(after[3:5] + 2 * 0.1 * after[8:], target[3:5], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("controls", "options", "chosen", "tried"),
    [
        ([20, 10, 5], {}, 10, 3),
        ([9, 10], {"slack": 0.2}, 9, 2),
        ([9, 10], {"gain": 0.5}, 9, 1),
        ([22, 3], {"harm": 0.5}, 3, 1),  # a little harm: the next is trusted
        ([-20, -10], {"harm": 0.5}, 0, 3),  # all do harm: it stays
    ],
)
def test_the_first_control_that_ends_about_as_well_as_the_best_is_taken(controls, options, chosen, tried):
    body = '<body><joint name="slide" type="slide" damping="1"/><geom size=".1" mass="1e-6"/></body>'
    world = f'<worldbody>{body}</worldbody><actuator><motor joint="slide"/></actuator>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><option gravity='0 0 0' timestep='.01'/>{world}</mujoco>")
    ends, options = [], {"gain": 3.0, **options}
    rehearsal = Rehearsal(model, 0.1, lambda data: ends.append(data.time) or abs(data.qpos[0] - 1), **options)
    data = mujoco.MjData(model)
    arrays = [np.array([float(control)]) for control in controls]
    assert rehearsal.choose(data, arrays, np.zeros(1)) == chosen
    assert (np.round(ends, 9).tolist(), data.time) == ([0.0] + [0.1] * tried, 0.0)
    refuse(InvalidInputError, "seconds: expected", Rehearsal, model, 0.0, len, 0.0)
