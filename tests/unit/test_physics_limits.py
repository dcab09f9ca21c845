"""Limits, dry friction and equality constraints against MuJoCo: what rests, slides, stops, and what a system has."""

import mujoco
import numpy as np
import pytest
import torch

from difflcs.errors import ContactWarning
from difflcs.physics.mujoco import MujocoLCS
from tests.unit.test_physics_mujoco import load


def hinge(words=""):
    return f'<body pos="0 0 1"><joint name="j" axis="0 1 0" {words}/><geom size=".05" mass="1" pos=".2 0 0"/></body>'


DRAWER = """<body><joint name="j" type="slide" axis="0 0 1" range="0 .2" {}/>
  <geom type="box" size=".1 .1 .01" mass="1"/></body>"""
BOX = '<body pos="0 0 .06"><freejoint/><geom type="box" size=".05 .05 .05" mass="2"/></body>'
STRING = """<site name="hook" pos="0 0 1"/><body pos=".1 0 .8"><freejoint/><site name="eye"/>
  <geom size=".02" mass=".3"/></body>"""
CORD = '<tendon><spatial limited="true" range="0 .3" {}><site site="hook"/><site site="eye"/></spatial></tendon>'
FIXED = '<tendon><fixed limited="true" range="-1 {}" {}><joint joint="j" coef="1"/></fixed></tendon>'
STILL = '<site name="hook"/><site name="eye" pos=".1 0 0"/>'
MOTOR = '<actuator><motor joint="j"/></actuator>'
LEVER = """<body pos="-.0155 9 .02"><joint type="slide" axis="1 0 0"/><geom size=".01" mass="1"/></body>
  <body pos="0 9 0"><joint axis="0 1 0"/><geom type="box" size=".005 .01 .1" mass=".01"/></body>"""
RESTING = {
    "drawer": (DRAWER.format(""), ""),
    "drawer of soft stops": (DRAWER.format('solreflimit=".05 1" solimplimit=".1 .9 .02"'), ""),
    "drawer that acts before": (DRAWER.format('margin=".01"'), ""),
    "drawer and box": (DRAWER.format("") + BOX, ""),
    "hinge": (hinge('range="-10 10"'), ""),
    "ball": (hinge('type="ball" range="0 30"'), ""),
    "string": (STRING, CORD.format("")),
    "tendon": (hinge(), FIXED.format(".5", "")),
    "friction": (hinge('frictionloss="3"'), ""),
    "friction of a tendon": (hinge(), FIXED.format("9", 'frictionloss="3"')),
    "a cord that nothing moves": (hinge('range="-10 10"') + STILL, CORD.format('frictionloss="1"')),
    "friction of a slide under a box": (DRAWER.format('frictionloss="60"') + BOX, ""),
}


@pytest.mark.parametrize("name", RESTING)
def test_what_rests_on_limits_or_dry_friction_stays_as_in_mujoco(name):
    model = load(*RESTING[name])
    start = mujoco.MjData(model)
    if name == "friction of a slide under a box":
        start.qpos[0], start.qpos[3] = 0.1, 0.16
    for _ in range(2000):  # what swings comes to rest
        mujoco.mj_step(model, start)
        start.qvel[:] *= 0.99
    for seconds in (0.002, 0.02, 0.1):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start.qpos, start.qvel
        mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
        module = MujocoLCS(model, start, motion="dynamic", seconds=seconds)
        x = module.state.to_state(start.qpos, start.qvel)
        after = module.params(x).step(x, torch.zeros(0).double()).x_next
        wrong = (after - module.state.to_state(data.qpos, data.qvel)).abs()
        assert wrong[: model.nv].max() < 2e-4, seconds
        assert wrong[model.nv :].max() < 3e-3, seconds


BAR = (
    '<body name="{0}" pos="{1} 0 1"><joint name="{0}" axis="0 1 0"/><geom size=".03" pos="0 0 .4" mass="1"/>{2}</body>'
)
LINK = '<body name="b" pos="0 0 .4"><joint name="b" axis="0 1 0"/><geom size=".03" pos=".3 0 0" mass="1"/></body>'
PLATE = '<body name="f" pos="0 .5 1"><freejoint/><geom type="box" size=".1 .1 .02" mass="1"/></body>'
EQUAL = {
    "connect": (PLATE, '<connect body1="f" anchor=".3 0 0"/>'),
    "loop": (BAR.format("a", 0, LINK) + BAR.format("c", 0.6, ""), '<connect body1="b" body2="c" anchor=".6 0 0"/>'),
    "weld": (PLATE + BAR.format("a", 0, ""), '<weld body1="a" body2="f"/>'),
    "joints": (BAR.format("a", 0, "") + BAR.format("c", 2, ""), '<joint joint1="a" joint2="c" polycoef="0 -2 0 0 0"/>'),
}
MOVING = {  # bodies, the rest, start, control
    "slides": (hinge('frictionloss=".5" damping=".1"'), "", (0.0, -3.0), 0.0),
    "hits a stop": (hinge('range="-60 10"'), "", (-0.5, 1.0), 0.0),
    "is pushed against a stop": (hinge('range="-20 10"'), MOTOR, (-0.3, 0.0), -4.0),
    "breaks away": (hinge('frictionloss="3"'), MOTOR, (0.0, 0.0), 3.0),
    "holds against a motor": (hinge('frictionloss="3"'), MOTOR, (0.0, 0.0), -3.0),
    **{name: (bodies, f"<equality>{rows}</equality>", (), 0.0) for name, (bodies, rows) in EQUAL.items()},
    "a string goes tight": (STRING, CORD.format(""), (), 0.0),
}


@pytest.mark.parametrize("name", MOVING)
def test_what_moves_against_constraints_goes_as_in_mujoco(name):
    """Twenty steps of 20 ms, each from MuJoCo's state: in the median a fifth of the change in velocity is wrong."""
    bodies, rest, state, ctrl = MOVING[name]
    model = load(bodies, rest)
    data = mujoco.MjData(model)
    if state:
        data.qpos[0], data.qvel[0] = state
    data.ctrl[:] = ctrl
    module = MujocoLCS(model, data, motion="dynamic", seconds=0.02)
    parts = []
    for _ in range(20):
        x = module.state.to_state(data.qpos, data.qvel)
        after = module.params(x).step(x, torch.from_numpy(data.ctrl)).x_next
        mujoco.mj_step(model, data, 20)
        right = module.state.to_state(data.qpos, data.qvel)
        wrong, change = (after - right)[model.nv :].norm(), (right - x)[model.nv :].norm()
        parts.append(float(wrong / change.clamp_min(0.02)))
    assert np.median(parts) < 0.2


@pytest.mark.parametrize("force", [-2.0, -1.0, 1.0, 2.0])
@pytest.mark.parametrize("case", [('frictionloss="3"', 0.01, 0.03), ('range="-60 .6"', 1.0, 0.1)])
def test_friction_and_limits_stop_another_action_than_the_nominal_one(case, force):
    """The nominal one has no force, so that friction, about the vertical, has little to do; a lever is hit."""
    words, speed, most = case
    data = mujoco.MjData(model := load(hinge(words).replace('axis="0 1 0"', 'axis="0 0 1"') + LEVER, MOTOR))
    data.qvel[:2] = speed, 1.0  # so that the lever turns 50 times as fast
    module = MujocoLCS(model, data, motion="dynamic", seconds=0.02)
    x = module.state.to_state(data.qpos, data.qvel)
    data.ctrl[:] = force
    after = module.params(x).step(x, torch.from_numpy(data.ctrl)).x_next
    mujoco.mj_step(model, data, 20)
    assert float((after - module.state.to_state(data.qpos, data.qvel))[model.nv].abs()) < most


def test_a_stiff_servo_that_presses_a_finger_against_its_limit_moves_neither_it_nor_the_arm():
    stop = '<joint name="a" axis="0 1 0" damping="5" range="-1 0"/>'
    hard = 'damping="1000" armature="1" range="0 .05" solreflimit=".002 1" solimplimit=".99 .999 .01"'
    finger = f'<body><joint name="j" type="slide" axis="0 0 1" {hard}/><geom size=".02" mass=".1"/></body>'
    arm = f'<body pos="0 0 1">{stop}<geom size=".05" mass="1" pos=".2 0 0"/>{finger}</body>'
    model = load(arm, '<actuator><position joint="j" kp="30000" ctrlrange="0 .2"/></actuator>')
    data = mujoco.MjData(model)
    data.qpos[1] = data.ctrl[0] = 0.05
    mujoco.mj_step(model, data, 500)
    module = MujocoLCS(model, data, motion="dynamic", seconds=0.02)
    x, u = module.observe(data), torch.tensor([0.01]).double()
    data.ctrl[:] = module.control(x, u).numpy()
    mujoco.mj_step(model, data, 20)
    assert np.abs(module.params(x).step(x, u).x_next[2:].numpy() - data.qvel).max() < 5e-3


def test_an_action_against_an_equality_constraint_that_is_far_from_held_does_what_it_does_in_mujoco():
    arm = BAR.format("a", 0, LINK + '<site name="tip" pos="0 0 .3"/>') + '<site name="far" pos=".4 0 1.2"/>'
    model = load(arm, '<actuator><motor joint="a"/><motor joint="b"/></actuator>'
                 '<equality><connect site1="far" site2="tip"/></equality>')  # fmt: skip
    module = MujocoLCS(model, motion="dynamic", seconds=0.05)
    after = []
    for ctrl in ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0]):
        data = mujoco.MjData(model)
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, 50)
        after.append(data.qvel.copy())
    found = module.params(torch.zeros(4).double()).B[2:].T
    np.testing.assert_allclose(found, np.array(after[1:]) - after[0], rtol=0.15, atol=1e-3)


@pytest.mark.parametrize("motion", ["quasi-static", "quasi-dynamic"])
def test_what_has_no_velocity_keeps_to_an_equality_constraint(motion):
    model = load(
        BAR.format("a", 0, "") + BAR.format("c", 2, LINK.replace("/>", ' range="-90 90"/>', 1)),
        '<equality><joint joint1="c" joint2="a" polycoef=".1 -2 0 0 0"/><joint joint1="b" joint2="c"/></equality>'
        '<actuator><position joint="a" kp="30000" kv="200"/></actuator>',
    )
    module, x = MujocoLCS(model, motion=motion), 0.1 * torch.rand(50, 3, dtype=torch.float64)
    after = module.params(x).step(x, torch.full((50, 1), 0.2).double()).x_next
    assert (after[:, 0] - x[:, 0] - 0.2).abs().max() < 1e-2
    assert (after[:, 1] - 0.1 + 2 * after[:, 0]).abs().max() < 1e-9
    with pytest.warns(ContactWarning, match="move joint 'c' by 1"):
        module.params(torch.tensor([0.0, 1.5, 0.5]).double())


def test_a_weak_servo_does_not_move_what_an_equality_constraint_holds():
    weak = '<actuator><position joint="a" kp="3000" forcerange="-1 1"/></actuator>'
    model = load(BAR.format("a", 0, "") + BAR.format("c", 2, ""), weak + '<equality><weld body1="a"/></equality>')
    x, u = torch.zeros(2, dtype=torch.float64), torch.tensor([0.2], dtype=torch.float64)
    assert MujocoLCS(model, motion="quasi-dynamic").params(x).step(x, u).x_next[0].abs() < 1e-9


def test_what_is_driven_in_quasi_static_motion_stops_at_the_limits_of_its_joint():
    model, x = load(DRAWER.format(""), '<actuator><position joint="j" kp="9"/></actuator>'), torch.tensor([0.15])
    torch.testing.assert_close(MujocoLCS(model).action_bounds(x), (torch.tensor([-0.15]), torch.tensor([0.05])))
    assert MujocoLCS(model, limits=0).action_bounds(x)[1].isinf()


@pytest.mark.parametrize("soft", ["", "solref='.1 1'", "solref='-1000 -20'", "solref='-1000 0'"])
@pytest.mark.parametrize("seconds", [0.002, 0.02, 0.1])
def test_friction_that_a_rail_presses_creeps_as_in_mujoco(seconds, soft):
    geoms = f'<geom type="box" size="1 1 .1" pos="0 0 -.11" {soft}/>', f'<geom type="box" size=".1 .1 .02" {soft}/>'
    model = load(f'{geoms[0]}<body><joint name="j" type="slide" axis="1 0 0"/>{geoms[1]}</body>', MOTOR)
    module, data = MujocoLCS(model, motion="dynamic", seconds=seconds), mujoco.MjData(model)
    moved = module.params(x := module.observe(data)).step(x, torch.tensor([2.0]).double()).x_next
    data.ctrl[:] = 2.0
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
    assert moved[1] == pytest.approx(data.qvel[0], rel=0.1)


@pytest.mark.parametrize("motion", ["quasi-static", "quasi-dynamic"])
def test_a_rope_tows_what_has_no_velocity(motion):
    slides = "".join(f'<body pos="0 {i} 0"><joint name="{name}" type="slide" axis="1 0 0" frictionloss=".01"/>'
                     '<geom size=".05" mass="1"/></body>' for i, name in enumerate("ab"))  # fmt: skip
    rope = '<tendon><fixed range="-1 .05"><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>'
    model = load(slides, rope + '<actuator><position joint="a" kp="3000" kv="20"/></actuator>')
    module, x = MujocoLCS(model, motion=motion), torch.zeros(2, dtype=torch.float64)
    for far, towed in ((0.04, 0.0), (0.1, 0.05), (-0.1, 0.0)):
        after = module.params(x).step(x, torch.tensor([far]).double()).x_next
        torch.testing.assert_close(after, torch.tensor([far, towed]).double(), rtol=0, atol=5e-3)


def test_the_nearest_of_many_limits_are_kept_and_more_are_told():
    chain = "".join(f'<body><joint type="slide" axis="0 0 1" range="0 .1"/><geom size=".01" pos="{i} 0 0"/></body>'
                    for i in range(10))  # fmt: skip
    model = load(chain, '<option><flag contact="disable"/></option>')
    with pytest.warns(ContactWarning, match="pass limits=10"):
        MujocoLCS(model, motion="dynamic").params(torch.zeros(20, dtype=torch.float64))
    module = MujocoLCS(model, motion="dynamic", limits=3)
    x = torch.cat([torch.full((10,), 0.05), torch.zeros(10)]).double()
    x[[2, 5, 7]] = 0.0
    after = module.params(x).step(x, torch.zeros(0).double()).x_next
    assert module.n_lam == 3
    torch.testing.assert_close(after[10:][[2, 5, 7]], torch.zeros(3).double(), rtol=0, atol=1e-2)
    assert MujocoLCS(model, motion="dynamic", limits=0).n_lam == 0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    assert MujocoLCS(model, motion="dynamic").n_lam == 0
