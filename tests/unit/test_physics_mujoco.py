"""`difflcs.physics.mujoco`: states, contacts and systems of MuJoCo models, against MuJoCo and known solutions."""

import importlib
import itertools
import sys

import mujoco
import numpy as np
import pytest
import torch

from difflcs.errors import (
    ContactWarning,
    DTypeError,
    InvalidInputError,
    MissingDependencyError,
    NonFiniteError,
    ShapeError,
)
from difflcs.physics import PlanarPushing, box
from difflcs.physics.mujoco import MujocoLCS, MujocoState, lcs_from_mujoco
from tests.conftest import refuse

PLANE = '<joint name="{0}x" type="slide" axis="1 0 0"/><joint name="{0}y" type="slide" axis="0 1 0"/>'
PUSHER = f"""
<body name="pusher">{PLANE.format("p")}<geom name="tip" type="sphere" size=".015" mass=".2" {{tip}}/></body>"""
SERVO = '<position joint="{}" kp="1000" dampratio="1"/>'
SERVOS = f"<actuator>{SERVO.format('px')}{SERVO.format('py')}</actuator>"


def load(worldbody, rest="", options=""):
    text = f'<mujoco><option timestep="0.001" {options}/><worldbody>{worldbody}</worldbody>{rest}</mujoco>'
    return mujoco.MjModel.from_xml_string(text)


def pushing(rest=SERVOS, of_box='friction="0.5"', tip='friction="0.3"', options=""):
    """A box on slides and a hinge, and a sphere on slides, in the plane; a floor below."""
    body = f"""<geom name="floor" type="plane" size="1 1 .1" pos="0 0 -.05"/>
      <body name="box">{PLANE.format("")}<joint name="yaw" type="hinge" axis="0 0 1"/>
        <geom name="block" type="box" size=".06 .04 .05" mass=".5" {of_box}/></body>"""
    return load(body + PUSHER.format(tip=tip), rest, options)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def step(model, qpos, qvel=0.0, ctrl=0.0, seconds=0.1):
    """What MuJoCo does."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
    return data.qpos.copy(), data.qvel.copy()


def many_joints():
    return load("""
      <body name="a"><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1"/>
        <body><joint name="ball" type="ball"/><geom size=".1" pos=".3 0 0"/>
          <body pos=".6 0 0"><joint type="hinge" axis="0 1 0"/><geom size=".1" pos=".3 0 0"/></body></body></body>
      <body name="b"><freejoint name="free"/><geom type="box" size=".1 .2 .3"/></body>""")


def random_state(model, seed):
    random, qpos = np.random.default_rng(seed), model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, random.normal(size=model.nv) * 0.8, 1.0)
    return qpos, random.normal(size=model.nv)


def test_the_state_says_what_each_number_is():
    state = MujocoState(many_joints(), velocities=True)
    places = ["slide", "ball_rx", "ball_ry", "ball_rz", "joint2"]
    places += [f"free{end}" for end in ("_x", "_y", "_z", "_rx", "_ry", "_rz")]
    assert list(state.names) == places + [f"{name}_velocity" for name in places]
    assert state.n_x == 22
    assert state.names[state.index("free_z")] == "free_z"
    with pytest.raises(KeyError, match="free_w"):
        state.index("free_w")


@pytest.mark.parametrize("seed", range(2))
def test_states_go_to_mujoco_and_back(seed):
    model = many_joints()
    reference, _ = random_state(model, seed + 100)
    state = MujocoState(model, reference, velocities=True)
    qpos, qvel = random_state(model, seed)
    again, velocity = state.to_mujoco(state.to_state(qpos, qvel))
    for q in (1, 9):  # q and −q are one orientation
        again[q : q + 4] *= np.sign(again[q : q + 4] @ qpos[q : q + 4])
    np.testing.assert_allclose(again, qpos, atol=1e-12)
    np.testing.assert_array_equal(velocity, qvel)
    both = state.to_state(np.stack([reference, qpos]), np.stack([qvel, qvel]))
    torch.testing.assert_close(both, torch.stack([state.to_state(place, qvel) for place in (reference, qpos)]))


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [2, 0, 0, 0], [0, 0, 0, 0.5]])
def test_quaternions_are_read_as_mujoco_does(quaternion):
    """Of any length, and of zeros as no rotation: in the reference, in what becomes a state, and on the way back."""
    data = mujoco.MjData(model := load('<body><freejoint name="b"/><geom type="box" size=".1 .2 .3"/></body>'))
    data.qpos[3:] = quaternion
    mujoco.mj_kinematics(model, data)
    for reference in (data.qpos, np.array([0, 0, 0, 0.8, 0.6, 0, 0])):
        state = MujocoState(model, reference)
        again = state.to_mujoco(state.to_state(data.qpos))[0][3:]
        np.testing.assert_allclose(again * np.sign(again @ data.xquat[1]), data.xquat[1], atol=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_the_tangent_takes_velocities_of_the_state_to_those_of_mujoco(seed):
    model = many_joints()
    state = MujocoState(model)
    qpos, _ = random_state(model, seed)
    x = state.to_state(qpos)
    T, numeric, eps = state.tangent(x.numpy()), np.zeros((model.nv, model.nv)), 1e-6
    for i in range(model.nv):
        ends = [state.to_mujoco(x + sign * eps * torch.eye(model.nv, dtype=x.dtype)[i])[0] for sign in (-1, 1)]
        rate = np.empty(model.nv)
        mujoco.mj_differentiatePos(model, rate, 2 * eps, *ends)
        numeric[:, i] = rate
    np.testing.assert_allclose(T, numeric, atol=1e-8)


def test_a_floor_that_nothing_in_the_plane_can_approach_is_left_out():
    assert (MujocoLCS(pushing()).n_contacts, MujocoLCS(pushing()).n_lam) == (1, 2)
    free = load('<geom type="plane" size="1 1 1"/><body><freejoint/><geom type="box" size=".1 .1 .1"/></body>')
    assert MujocoLCS(free, motion="dynamic").n_contacts == 4
    assert MujocoLCS(free, motion="dynamic").n_lam == 16
    assert MujocoLCS(free, motion="dynamic", cone="stewart-trinkle").n_lam == 24


def test_missing_contacts_are_out_of_reach_and_the_nearest_are_kept():
    ball = '<body pos="{0} 0 0"><joint name="s{0}" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>'
    model = load("".join(map(ball.format, (0, 1, 3))))
    x = torch.zeros(6, dtype=torch.float64)
    two = MujocoLCS(model, motion="dynamic", contacts=2, distance=5.0).contacts(x)
    assert sorted(two.gap.tolist()) == pytest.approx([0.8, 1.8])
    near = MujocoLCS(model, motion="dynamic", contacts=3, distance=1.0)
    found = near.contacts(x)
    assert sorted(found.gap.tolist()) == pytest.approx([0.8, 1.0, 1.0])
    lam = near.params(x).step(x, torch.zeros(0, dtype=torch.float64)).lam
    assert not lam.any()


FRICTION = {
    "the larger": ('friction="0.5"', 'friction="0.3"', "", 0.5),
    "of higher priority": ('friction="0.5"', 'friction="0.3" priority="1"', "", 0.3),
    "of the box, of higher priority": ('friction="0.3" priority="1"', 'friction="0.5"', "", 0.3),
    "none where both have none": ('friction="0.5" condim="1"', 'friction="0.3" condim="1"', "", 0.0),
    "some where one has": ('friction="0.5" condim="1"', 'friction="0.3" condim="3"', "", 0.5),
    "of the pair": ("", "", '<contact><pair geom1="tip" geom2="block" friction=".7 .7 .1 .1 .1"/></contact>', 0.7),
    "of a pair without": ("", "", '<contact><pair geom1="tip" geom2="block" condim="1"/></contact>', 0.0),
}


@pytest.mark.parametrize("case", FRICTION)
def test_friction_is_combined_as_mujoco_does(case):
    of_box, tip, rest, expected = FRICTION[case]
    model = pushing(SERVOS + rest, of_box, tip)
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, 0, -0.07, 0]
    mujoco.mj_forward(model, data)
    contact = next(c for c in data.contact if {model.geom(g).name for g in c.geom} == {"tip", "block"})
    assert (contact.friction[0] if contact.dim > 1 else 0.0) == pytest.approx(expected)
    module = MujocoLCS(model)
    assert module.n_lam == (2 if expected else 1)
    if expected:  # rays n ± μ t
        E = module.params(tensor(0, 0, 0, -0.1, 0)).E
        assert float((E[0] - E[1])[1].abs() / (E[0] + E[1])[0].abs()) == pytest.approx(expected)
    assert MujocoLCS(model, friction=0.0).n_lam == 1


def test_pairs_are_those_of_the_model_or_those_named():
    third = """<body name="other" pos=".3 0 0"><joint name="o" type="slide" axis="0 1 0"/>
      <geom name="ball" size=".02" {}/></body>"""

    def model(of_ball="", rest=""):
        text = f"""<body name="box">{PLANE.format("")}<geom name="block" type="box" size=".06 .04 .05"/></body>"""
        return load(text + PUSHER.format(tip="") + third.format(of_ball), SERVOS + rest)

    def count(of_ball="", rest="", **options):
        return MujocoLCS(model(of_ball, rest), distance=1.0, **options).n_contacts

    assert count() == 3
    assert count('contype="0" conaffinity="0"') == 1
    assert count('contype="2" conaffinity="2"') == 1
    assert count(rest='<contact><exclude body1="other" body2="box"/></contact>') == 2
    pairs = [("tip", "block")]
    assert count(pairs=pairs) == 1
    assert count(pairs=[("pusher", "other"), ("tip", 0)]) == 2
    x = tensor(0.1, 0.0, -0.1, 0.02, 0.0)
    named = MujocoLCS(model('contype="0" conaffinity="0"'), pairs=[("ball", "block")], distance=1.0).contacts(x)
    assert torch.equal(named.gap, MujocoLCS(model(), pairs=[("ball", "block")]).contacts(x).gap)
    assert count(pairs=[]) == 0


def test_parents_touch_only_where_named():
    model = load("""<body name="a"><joint type="hinge" axis="0 0 1"/><geom name="a" size=".1"/>
        <body name="b" pos=".3 0 0"><joint type="hinge" axis="0 0 1"/><geom name="b" size=".1" pos=".1 .1 0"/></body>
      </body>""")
    assert MujocoLCS(model, motion="dynamic").n_contacts == 0
    module = MujocoLCS(model, motion="dynamic", pairs=[("a", "b")])
    assert float(module.contacts(torch.zeros(4, dtype=torch.float64)).gap[0]) == pytest.approx(np.hypot(0.4, 0.1) - 0.2)


CUBE = " ".join(f"{x} {y} {z}" for x, y, z in itertools.product((-0.05, 0.05), repeat=3))
FACES = {
    "sphere": 'type="sphere" size=".03"',
    "capsule": 'type="capsule" size=".02 .04"',
    "ellipsoid": 'type="ellipsoid" size=".05 .04 .03"',
    "cylinder": 'type="cylinder" size=".05 .05"',
    "box": 'type="box" size=".05 .05 .05"',
    "mesh": 'type="mesh" mesh="cube"',
}
MESH = f'<asset><mesh name="cube" vertex="{CUBE}"/><mesh name="slab" vertex="{CUBE}" scale="6 6 1"/></asset>'


@pytest.mark.parametrize("first", ["plane", *FACES])
@pytest.mark.parametrize("second", FACES)
def test_there_is_room_for_all_contacts_that_mujoco_finds(first, second):
    shape = FACES.get(first, 'type="plane" size="1 1 1"')
    model = load(f'<geom {shape} margin=".5"/><body><freejoint/><geom {FACES[second]}/></body>', MESH)
    data, random, most = mujoco.MjData(model), np.random.default_rng(0), 0
    for k in range(60):
        yaw, tilt = random.uniform(0, np.pi), (0, np.pi / 2, 1.0)[k % 3]
        turns = np.array([[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)], [np.cos(tilt / 2), np.sin(tilt / 2), 0, 0]])
        data.qpos[:3] = [*random.uniform(-0.03, 0.03, 2), random.uniform(0.0, 0.16)]
        mujoco.mju_mulQuat(data.qpos[3:], *turns)
        mujoco.mj_forward(model, data)
        most = max(most, data.ncon)
    assert most == MujocoLCS(model, motion="dynamic").n_contacts  # and for no more


def tower(boxes):
    body = f'<body pos="0 0 {{}}"><freejoint/><geom {FACES["box"]} mass="1"/></body>'
    stacked = "".join(body.format(0.1 * k + 0.0499) for k in range(boxes))
    return load('<geom type="plane" size="1 1 .1"/>' + stacked)


def test_geoms_that_cannot_touch_are_told_where_something_should_be_pushed():
    model = pushing(tip='contype="0" conaffinity="0"')
    for options in ({}, {"motion": "dynamic", "contacts": 3}, {"motion": "dynamic", "pairs": [("box", "box")]}):
        with pytest.warns(ContactWarning, match="expected geoms that may touch, got none"):
            MujocoLCS(model, **options)
    assert not MujocoLCS(model, motion="dynamic").n_lam


def test_contacts_that_have_no_room_are_warned_of_once_and_not_where_they_were_chosen():
    module = MujocoLCS(model := tower(4), motion="dynamic")
    state = module.state.to_state(model.qpos0)
    with pytest.warns(ContactWarning, match=r"at most 12 contacts, got 16 .* contacts=16") as said:
        assert module.contacts(state).gap.shape == (12,)
    assert said[0].filename == __file__
    module.params(state)  # nothing is told twice
    low = MujocoLCS(three := tower(3), motion="dynamic")
    low.contacts(low.state.to_state(three.qpos0))  # 12 touch; the others, within its distance, are not near
    MujocoLCS(model, motion="dynamic", contacts=12).contacts(state)


def test_a_tower_stands_on_four_contacts_a_face():
    """MuJoCo finds eight between equal boxes, from which four at one corner must not be taken; and what lies on another
    body is held by it as by a floor."""
    model = tower(4)
    module = MujocoLCS(model, motion="dynamic", contacts=16, seconds=0.05)
    start = x = module.state.to_state(model.qpos0) + 1e-12 * torch.arange(16).double()[:, None]
    speeds = []
    for _ in range(8):
        x = module.params(x).step(x, torch.zeros(16, 0).double()).x_next
        speeds.append(x[:, 24:].abs().amax(1))
    speed = torch.stack(speeds)
    assert float(speed.max()) < 0.1  # as long as it settles; half a step of gravity is .25
    assert float((x - start)[:, :24].abs().max()) < 3e-3
    assert float(speed[-1].median()) < 1e-4  # where rounding chooses other points, MuJoCo's own moves by 2.5e-3


@pytest.mark.parametrize("flag", ["contact", "constraint"])
def test_where_contacts_are_disabled_nothing_touches_but_what_is_named(flag):
    cube = f'<body pos="0 0 .105"><freejoint/><geom name="cube" {FACES["box"]}/></body>'
    slab = '<geom name="slab" type="box" size=".3 .3 .05"/>'
    model = load(slab + cube, f'<option><flag {flag}="disable"/></option>')
    x = torch.zeros(12).double()
    x[2] = 0.105
    assert MujocoLCS(model, motion="dynamic").n_contacts == 0
    assert MujocoLCS(model, motion="dynamic").params(x).n_lam == 0
    named = MujocoLCS(model, motion="dynamic", pairs=[("slab", "cube")]).contacts(x)
    assert named.gap[:4].tolist() == pytest.approx([0.005] * 4)


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_it_is_the_planar_pushing_of_the_same_shapes(friction):
    gyration = float(np.sqrt((0.12**2 + 0.08**2) / 12))  # of the box's mass, which is that of its area
    planar = PlanarPushing(box(-0.06, 0.06, -0.04, 0.04), 0.015, friction=friction, compliance=1e-6)
    ours = MujocoLCS(pushing(), friction=friction, compliance=1e-6)
    assert float(planar.gyration) == pytest.approx(gyration)
    random = np.random.default_rng(0)
    x = torch.from_numpy(random.uniform(-1, 1, (200, 5)) * [0.02, 0.02, 3, 0.15, 0.15])
    u = torch.from_numpy(random.uniform(-0.03, 0.03, (200, 2)))
    apart = ours.contacts(x).gap[:, 0] > 1e-4
    assert apart.sum() > 80
    one, other = (system.params(x[apart]).step(x[apart], u[apart]).x_next for system in (planar, ours))
    assert (one - x[apart])[:, :3].abs().max() > 0.01
    torch.testing.assert_close(one, other, atol=3e-5, rtol=0)


def test_mobility_by_damping_or_by_numbers():
    model = pushing()
    model.dof_damping[:3] = [1.0, 2.0, 0.01]
    x = tensor(0.0, 0.0, 0.0, -0.075, 0.02)
    by_damping, by_numbers = (MujocoLCS(model, mobility=value) for value in ("damping", [1.0, 0.5, 100.0, 0.0, 0.0]))
    C = by_damping.params(x).C
    torch.testing.assert_close(C, by_numbers.params(x).C)
    contacts = by_damping.contacts(x)
    for moved, row in ((C.sum(1), contacts.normal[0]), (C[:, 0] - C[:, 1], contacts.tangent[0, 0])):
        expected = row[:3] * tensor(1.0, 0.5, 100.0)
        torch.testing.assert_close(moved[:3] / moved.norm(), expected / expected.norm())
    fixed = MujocoLCS(model, mobility=np.diag([1.0, 0.0, 0.0, 0.0, 0.0]))
    assert not fixed.params(x).C[1:].any()


@pytest.mark.parametrize("bias", ["40 -400 -40", "0 -400 -40"])
def test_a_servo_with_a_constant_force_goes_where_it_is_told(bias):
    body = '<body><joint name="a" type="slide" axis="1 0 0"/><geom size=".05" mass="1"/></body>'
    servo = f'<general joint="a" gear="2" gainprm="400" biastype="affine" biasprm="{bias}"/>'
    model = load(body, f"<actuator>{servo}</actuator>")
    ctrl = MujocoLCS(model).control(tensor(0.01), tensor(0.05))
    after, _ = step(model, 0.01, ctrl=ctrl.numpy(), seconds=2.0)
    np.testing.assert_allclose(after, 0.06, atol=1e-5)


def test_an_actuator_is_a_servo_only_by_an_affine_bias():
    rest = '<actuator><general joint="px" gainprm="400" biastype="none" biasprm="0 -400 -40"/></actuator>'
    module = MujocoLCS(load(PUSHER.format(tip=""), rest), motion="dynamic")
    torch.testing.assert_close(module.control(np.array([0.3, 0.0, 0.0, 0.0]), np.array([0.05])), tensor(0.05))


def test_forces_in_the_data_act_in_dynamic_motion_alone():
    model = load('<body><freejoint name="b"/><geom size=".05" mass="1"/></body>')
    data = mujoco.MjData(model)
    data.xfrc_applied[1, 0], data.qfrc_applied[1] = 10.0, 4.0
    module = MujocoLCS(model, data, motion="dynamic", seconds=0.05)
    x = torch.zeros(12).double()
    after = module.params(x).step(x, torch.zeros(0).double()).x_next
    torch.testing.assert_close(after[6:8], tensor(0.5, 0.2))
    torch.testing.assert_close(after[:2], tensor(0.01275, 0.0051))  # by MuJoCo's steps of a millisecond
    pushed = pushing()
    data, x, u = mujoco.MjData(pushed), tensor(0, 0, 0, -0.08, 0), tensor(0.02, 0.0)
    without = MujocoLCS(pushed, data).params(x).step(x, u).x_next
    data.xfrc_applied[:], data.qfrc_applied[:] = 10.0, 10.0
    torch.testing.assert_close(MujocoLCS(pushed, data).params(x).step(x, u).x_next, without)


def test_single_precision_comes_back_single():
    module = MujocoLCS(pushing())
    x = torch.tensor([0.0, 0, 0, -0.1, 0])
    assert module.params(x).C.dtype == torch.float32
    torch.testing.assert_close(module.params(x).C.double(), module.params(x.double()).C)


def test_the_system_at_the_state_of_the_data():
    model = pushing()
    data = mujoco.MjData(model)
    data.qpos[:] = [0.1, 0.0, 0.3, 0.0, 0.05]
    x = MujocoState(model, data.qpos).to_state(data.qpos)
    at_data, at_x = lcs_from_mujoco(model, data), lcs_from_mujoco(model, data, x.expand(2, 5), friction=None)
    torch.testing.assert_close(at_data.C, at_x.C[1])
    with pytest.warns(ContactWarning, match="a ctrlrange"):  # a decimetre away, the pusher passes the corner
        assert lcs_from_mujoco(model, data, motion="dynamic").n_x == 10


def test_the_users_model_and_data_are_left_alone():
    model = pushing()
    data = mujoco.MjData(model)
    before = [model.opt.timestep, model.opt.disableflags, model.opt.o_margin, *model.geom_condim, *model.geom_contype]
    MujocoLCS(model, data, motion="dynamic", pairs=[("tip", "block")]).params(torch.zeros(10).double())
    after = [model.opt.timestep, model.opt.disableflags, model.opt.o_margin, *model.geom_condim, *model.geom_contype]
    assert before == after
    assert not data.qpos.any()


# --- what is refused ------------------------------------------------------------------------------------------------

SPHERE = '<body><freejoint/><geom name="ball" size=".1"/></body>'
FIELD = '<asset><hfield name="h" nrow="9" ncol="9" size="1 1 .1 .1"/></asset>'
TERRAIN = f'<geom name="terrain" type="hfield" hfield="h"/><geom name="wall" size=".1" pos="1 0 0"/>{SPHERE}'


def data_of(model, **values):
    data = mujoco.MjData(model)
    for name, value in values.items():
        getattr(data, name)[:] = value
    return data


def at(model, *x, **options):
    """The system at a state, after one at zero; zeros follow x."""
    module = MujocoLCS(model, **options)
    states = torch.zeros(2, module.n_x).double()
    states[1, : len(x)] = tensor(*x)
    return module.params(states)


SMALL = '<body><joint name="a" type="slide" axis="1 0 0" {}/><geom size=".1" mass="1e-10"/></body>'
PAIR = '<contact><pair geom1="tip" geom2="block" friction="1 .1"/></contact>'
OVERRIDE = '<option o_friction=".9 .8 .1 .1 .1"><flag override="enable"/></option>'
TORUS = f"""
<mujoco><extension><plugin plugin="mujoco.sdf.torus"><instance name="t"/></plugin></extension>
  <asset><mesh name="torus"><plugin instance="t"/></mesh></asset>
  <worldbody><geom name="torus" type="sdf" mesh="torus"><plugin instance="t"/></geom>{SPHERE}</worldbody></mujoco>"""
FLAG = SERVOS + '<option><flag {}="{}"/></option>'
GROUP = SERVOS + '<option actuatorgroupdisable="0"/>'
ADHESION = SERVOS.replace("</actuator>", '<adhesion body="box" gain="50" ctrlrange="0 1"/></actuator>')
SINCE_MUJOCO_4 = hasattr(mujoco.MjModel, "nhistory")
# What stands beside the servos of a box and its pusher, the options, and what the error says.
RESTS = {
    "a group of actuators that is disabled": (GROUP, {}, "not disabled.* got actuator 0, actuator 1; rem"),
    "actuators that a flag disables": (FLAG.format("actuation", "disable"), {}, "not disabled"),
    "friction of two kinds": (SERVOS + PAIR, {}, "got 1 and 0.1 between geoms 'block' and 'tip'"),
    "friction by override": (SERVOS + OVERRIDE, {}, "got 0.9 and 0.8"),
    "adhesion": (ADHESION, {"motion": "dynamic"}, "no <adhesion>, .* got actuator 2; remove or"),
    "two on one joint": (SERVOS.replace("py", "px"), {}, "slide or hinge of its own"),
    "no actuators": ("", {}, "actuators"),
    "a motion": (SERVOS, {"motion": "fast"}, "quasi-static"),
    "a mobility of another size": (SERVOS, {"mobility": [1.0, 2.0]}, "mobility"),
    "no damping": (SERVOS, {"mobility": "damping"}, "damping above 0"),
    "nothing gives way": (SERVOS, {"mobility": np.zeros(5)}, "move, got nothing"),
    "an unknown geom": (SERVOS, {"pairs": [("tip", "cup")]}, "'cup'"),
    "half a pair": (SERVOS, {"pairs": ["tip"]}, "pairs"),
    "negative friction": (SERVOS, {"friction": -1.0}, "friction"),
    "no compliance": (SERVOS, {"compliance": 0.0}, "compliance"),
    "no contacts": (SERVOS, {"contacts": 0}, "contacts"),
    "contacts that fit into no memory": (SERVOS, {"contacts": 10**6}, "contacts: expected at most 2000"),
    "caps without loads": (SERVOS, {"caps": 2}, "caps: expected none in quasi-static motion .* got 2"),
    "caps of another cone": (
        SERVOS,
        {"motion": "dynamic", "cone": "stewart-trinkle", "caps": 2},
        "caps: expected none",
    ),
    "a nominal control without forces": (SERVOS, {"ctrl": [0.1, 0.0]}, "ctrl: expected none in quasi-static"),
    "a step of years": (SERVOS, {"motion": "dynamic", "seconds": 1e9}, "time steps: expected at most 100000"),
}
if SINCE_MUJOCO_4:
    RESTS["delay of an actuator"] = (SERVOS.replace("/></", ' delay=".05" nsample="20"/></'), {}, "no delay of actu")
    sensor = '<sensor><jointpos joint="px" delay=".1" nsample="9"/></sensor>'
    RESTS["delay of a sensor"] = (SERVOS + sensor, {}, "no delay of actuators and sensors")
    motor = '<actuator><dcmotor joint="px" motorconst=".1" resistance="1" inductance="1e-3"/></actuator>'
    RESTS["a motor with a state"] = (motor, {}, "activation")
    RESTS["sleep"] = (FLAG.format("sleep", "enable"), {}, "sleep")
if hasattr(mujoco.MjModel, "nplastic"):
    rope = '<tendon><fixed stiffness="1" springyield=".1"><joint joint="px" coef="1"/></fixed></tendon>'
    RESTS["a spring that yields"] = (SERVOS + rope, {}, "springs that do not yield")


@pytest.mark.parametrize("case", RESTS)
def test_what_a_system_does_not_have_is_refused(case):
    rest, options, words = RESTS[case]
    refuse(InvalidInputError, words, MujocoLCS, pushing(rest), **options)


PUSHING = pushing()
REFUSED = [  # calls, errors, and what these say
    (lambda: MujocoLCS(PUSHING, pairs=1.5), DTypeError, "pairs: expected a list, got float"),
    (lambda: MujocoLCS(PUSHING, relative="no"), DTypeError, "relative: expected bool, got str 'no'; give True"),
    (lambda: MujocoLCS(PUSHING, motion="dynamic").states_along(None, None), DTypeError, "x: expected a torch.Tensor"),
    (lambda: at(load(SPHERE), 0, 0, 0, 0, 2 * np.pi, motion="dynamic"), InvalidInputError,
     "near a whole turn .* got 6.28319 rad in joint0_rx .* state 1; .* or move the reference"),
    (lambda: at(load(SPHERE), 0, 0, 0, 4 * np.pi - 0.02, motion="dynamic"), InvalidInputError, "near a whole turn"),
    (lambda: at(load(SPHERE), 1e11, motion="dynamic"), InvalidInputError, "positions below 1e10.*in state 1 of 2"),
    (lambda: at(load(SPHERE), *[0] * 6, 1e11, motion="dynamic"), InvalidInputError, "velocities below 1e10"),
    (lambda: at(load(SMALL.format('stiffness="1e3"')), 1.0, motion="dynamic"), InvalidInputError, "accelerations"),
    (lambda: MujocoLCS("model.xml"), DTypeError, "MjModel"),
    (lambda: MujocoLCS(PUSHING, 3), DTypeError, "MjData"),
    (lambda: lcs_from_mujoco(PUSHING, None), DTypeError, "MjData"),
    (lambda: MujocoLCS(PUSHING, mujoco.MjData(many_joints())), InvalidInputError, "nq=5"),
    (lambda: MujocoLCS(load('<geom size="1"/>')), InvalidInputError, "joints"),
    (lambda: MujocoLCS(load(TERRAIN, FIELD), motion="dynamic"), InvalidInputError,
     "height field .* geom 'terrain'; use a mesh or boxes"),
    (lambda: MujocoLCS(mujoco.MjModel.from_xml_string(TORUS), motion="dynamic"), InvalidInputError,
     "signed distance field .* geom 'torus'"),
    (lambda: MujocoLCS(PUSHING, data_of(PUSHING, xfrc_applied=np.nan), motion="dynamic"), NonFiniteError,
     "xfrc_applied"),
    (lambda: MujocoLCS(load(SPHERE), mujoco.MjData(load("<body/>" + SPHERE)), motion="dynamic"), InvalidInputError,
     r"xfrc_applied \(2, 6\), got \(3, 6\)"),
    (lambda: MujocoLCS(PUSHING).params(), InvalidInputError, "pass x"),
    (lambda: MujocoLCS(PUSHING).params(torch.zeros(4).double()), ShapeError, "n_x=5"),
    (lambda: MujocoLCS(PUSHING).params(tensor(0, 0, 0, 0, np.nan)), NonFiniteError, "NaN"),
    (lambda: MujocoState(PUSHING).to_state([1.0]), ShapeError, "qpos"),
    (lambda: MujocoState(PUSHING).to_state(["a"] * 5), DTypeError, "qpos: expected real numbers"),
    (lambda: MujocoLCS(PUSHING, mobility=[[1.0], []]), DTypeError, "mobility: expected numbers"),
    (lambda: MujocoLCS(PUSHING, motion="dynamic", ctrl="0"), DTypeError, "ctrl: expected real numbers"),
    (lambda: MujocoLCS(PUSHING, motion=np.array(["dynamic", "dynamic"])), InvalidInputError, "motion: expected one"),
    (lambda: MujocoLCS(pushing('<actuator><motor joint="px"/></actuator>')).control(tensor(*[0] * 5), tensor(0)),
     InvalidInputError, "position actuators"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_bad_input_is_refused(call, error, words):
    refuse(error, words, call)


def test_where_memory_is_short_no_contact_is_dropped_in_silence():
    """Nine boxes on a floor; where they are far apart, memory suffices before and after a state that is refused."""
    boxes = "".join(f'<body pos="{0.12 * i} 0 .05"><freejoint/><geom {FACES["box"]}/></body>' for i in range(9))

    def outcome(call, *arguments, **options):
        try:
            return call(*arguments, **options)
        except InvalidInputError as error:
            return str(error)

    def systems(memory):
        model = load('<geom type="plane" size="3 3 .1"/>' + boxes, f'<size memory="{memory}"/>')
        near = torch.zeros(9, 12).double()
        near[:, :3] = torch.from_numpy(model.qpos0.reshape(9, 7)[:, :3])
        far = near.clone()
        far[1:, 2] += 10 + torch.arange(8)
        near, far = (torch.cat([x[:, :6].flatten(), x[:, 6:].flatten()]) for x in (near, far))
        module = outcome(MujocoLCS, model, motion="dynamic", contacts=36)
        return [module if isinstance(module, str) else outcome(module.params, x) for x in (far, near, far)]

    whole, refused = systems("64M"), {}
    for memory in ("16K", "100K", "2M"):
        short = systems(memory)
        refused[memory] = [error for error in short if isinstance(error, str)]
        assert all("memory for all contacts" in error for error in refused[memory])
        assert all(isinstance(s, str) or torch.equal(s.c, w.c) for s, w in zip(short, whole, strict=True))
    assert refused["16K"]
    assert not refused["2M"]


@pytest.mark.parametrize("options", ['actuatorgroupdisable="0"', '><flag actuation="disable"/'])
def test_disabled_actuators_do_nothing_in_dynamic_motion(options):
    one, none = pushing(SERVOS + f"<option {options}></option>"), pushing("")
    x = [0.1, 0.2, 0.3, 0.4, 0.5, 1.0]
    disabled, without = at(one, *x, motion="dynamic"), at(none, *x, motion="dynamic")
    assert not disabled.B.any()
    torch.testing.assert_close(disabled.A, without.A)
    torch.testing.assert_close(disabled.d, without.d)


def test_what_is_refused_for_its_contacts_is_accepted_without_them():
    assert MujocoLCS(load(TERRAIN, FIELD), motion="dynamic", pairs=[("ball", "wall")]).n_contacts == 1
    for rest in (PAIR, OVERRIDE):
        assert MujocoLCS(pushing(SERVOS + rest), friction=0.4).n_lam == 2
        assert MujocoLCS(pushing(SERVOS + rest), pairs=[]).n_lam == 0


def test_equality_constraints_that_the_data_switches_off_do_nothing():
    model = pushing(SERVOS + '<equality><joint joint1="px" joint2="py"/></equality>')
    x, off = tensor(*[0.1] * 3, 0.4, *[0.1] * 6), data_of(model, eq_active=0)
    with pytest.warns(ContactWarning, match="a ctrlrange"):  # some of which lead into the box
        found, wanted = (MujocoLCS(m, d, motion="dynamic").params(x) for m, d in ((model, off), (pushing(), None)))
    torch.testing.assert_close(found.A, wanted.A)
    torch.testing.assert_close(found.F, wanted.F)


def test_without_mujoco_the_error_says_what_to_install(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("difflcs.physics.mujoco")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    refuse(MissingDependencyError, r'pip install "difflcs\[envs\]"', importlib.import_module, "difflcs.physics.mujoco")
