"""Quasi-dynamic motion of MuJoCo models, contacts by groups and the reference of rotations that moves along."""

import copy

import mujoco
import numpy as np
import pytest
import torch

from difflcs import LCSModule
from difflcs.errors import DTypeError, InvalidInputError, ShapeError
from difflcs.physics.mujoco import ContactGroup, MujocoLCS, MujocoState
from tests.conftest import refuse

FLOOR = '<geom name="floor" type="plane" size="1 1 .1"/>'
BOX = '<body name="box" pos="{}"><freejoint/><geom name="block" type="box" size=".05 .03 .02" mass="{}"/></body>'


def load(worldbody, rest=""):
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{worldbody}</worldbody>{rest}</mujoco>")


def next_state(module, x, u=()):
    return module.params(x).step(x, torch.tensor(u, dtype=torch.float64)).x_next


def test_a_free_body_has_the_mobility_of_its_inertia():
    """It falls by g h², and given forces move it by h² / m, whatever its orientation."""
    data = mujoco.MjData(model := load(BOX.format("0 0 1", 2)))
    data.qpos[3:7] = 0.5
    data.xfrc_applied[1, :3] = 4, 0, 0
    module = MujocoLCS(model, data, motion="quasi-dynamic", seconds=0.05)
    assert isinstance(module, LCSModule)
    x = module.observe(data)
    np.testing.assert_allclose(next_state(module, x) - x, [0.05**2 * 2, 0, -9.81 * 0.05**2, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize(("kp", "damping"), [(1, 0.1), (3, 0.05), (0.2, 1), (400, 8)])
@pytest.mark.parametrize("joint", ['gear="2"', "tendon", "site"])
def test_a_servo_goes_the_way_that_mujoco_simulates(kp, damping, joint):
    """Damped so that its momentum is gone long before the step is over."""
    at = {"tendon": 'tendon="t"', "site": 'site="s" gear="0 0 0 0 0 2"'}  # the force at a site alone does not fall
    drive = at.get(joint, f'joint="j" {joint}')
    body = f'<body><joint name="j" damping="{damping}" stiffness=".1"/><geom size=".02" pos=".05 0 0" mass=".01"/>'
    body += '<site name="s"/></body>'
    rest = f'<actuator><position {drive} kp="{kp}"/></actuator>'
    if joint == "tendon":
        rest = '<tendon><fixed name="t"><joint joint="j" coef="2"/></fixed></tendon>' + rest
    model = load(body, f'<option timestep="1e-4" gravity="0 0 0"/>{rest}')
    data = mujoco.MjData(model)
    data.qpos[:] = 0.2
    module = MujocoLCS(model, motion="quasi-dynamic", seconds=0.1)
    x = module.observe(data)
    u = 0.1 if joint != "tendon" else 0.5  # a servo on a tendon is told where to go
    after = next_state(module, x, [u])
    data.ctrl[:] = module.control(x, torch.tensor([u], dtype=torch.float64))
    mujoco.mj_step(model, data, 1000)
    np.testing.assert_allclose(after - x, data.qpos - x.numpy(), rtol=0.03)


def test_a_servo_holds_against_gravity_and_gives_way_by_its_stiffness():
    """An arm held by a servo sags as statics say; two servos press a box to where their forces are in balance."""
    arm = '<body><joint name="j" axis="0 1 0"/><geom size=".02" pos=".1 0 0" mass=".3"/></body>'
    module = MujocoLCS(
        model := load(arm, '<actuator><position joint="j" kp="50"/></actuator>'), motion="quasi-dynamic", seconds=5
    )
    x = module.observe(mujoco.MjData(model))
    np.testing.assert_allclose(next_state(module, x, [0.0]), [0.3 * 9.81 * 0.1 / 50], rtol=1e-3)
    joint = '<joint name="{}" type="slide" axis="1 0 0" damping="5"/>'
    slide = f'<body pos="{{}}">{joint}<geom type="box" size=".02 .02 .02" mass=".1"/></body>'
    rest = '<option gravity="0 0 0"/><actuator><position joint="a" kp="100"/><position joint="b" kp="300"/></actuator>'
    model = load(slide.format("-.0205 0 0", "a") + slide.format(".0205 0 0", "b"), rest)
    module = MujocoLCS(model, motion="quasi-dynamic", seconds=10, compliance=1e-6)
    a, b = next_state(module, x := module.observe(mujoco.MjData(model)), [0.01, -0.006])
    assert abs(a - b - 0.001) < 1e-6  # they touch
    np.testing.assert_allclose(100 * (0.01 - a), 300 * (b + 0.006), rtol=1e-3)


def test_a_box_rests_on_the_floor_and_is_dragged_by_friction():
    """It stays though gravity acts; a force below the friction does not move it far, one above it does."""
    model = load(FLOOR + BOX.format("0 0 .02", 0.5))
    for force, least, most in ((0.0, -1e-5, 1e-5), (2.0, 0.0, 3e-3), (10.0, 0.05, 0.2)):
        data = mujoco.MjData(model)
        data.xfrc_applied[1, 0] = force
        module = MujocoLCS(model, data, motion="quasi-dynamic", compliance=0.01, friction=0.5)
        x = module.observe(data)
        moved = next_state(module, x) - x
        assert abs(moved[2]) < 5e-4 + force / 10
        assert least <= moved[0] <= most


def stack():
    """Two boxes side by side on a floor, a ball beside them."""
    ball = '<body name="ball" pos="0 .1 .02"><freejoint/><geom name="round" size=".02" mass=".1"/></body>'
    other = BOX.replace('"box"', '"other"', 1).replace('"block"', '"brick"')
    return load(FLOOR + BOX.format("0 0 .02", 0.5) + other.format(".101 0 .02", 1) + ball)


def test_groups_have_budgets_of_contacts_and_of_friction():
    model = stack()
    groups = [
        ContactGroup([("floor", "box"), ("block", "other"), ("block", "round")], 5),  # geoms and bodies
        ContactGroup("round", 1, distance=0.01),
        ContactGroup(None, 3, friction=False),
    ]
    module = MujocoLCS(model, motion="quasi-dynamic", contacts=groups, distance=0.05)
    x = module.observe(mujoco.MjData(model))
    contacts, system = module.contacts(x), module.params(x)
    assert (module.n_contacts, module.n_lam) == (9, 4 * 6 + 3) == (len(contacts.gap), system.n_lam)
    torch.testing.assert_close(contacts.gap, torch.tensor([0, 0, 0, 0, 1e-3, 0, 0, 0, 0]).double(), atol=1e-9, rtol=0)
    both = module.params(torch.stack([x, x + 1e-3]))
    torch.testing.assert_close(both[0].F, system.F)
    far = x.clone()
    far[14] += 0.02  # the ball: beyond its own distance, so that its contact is padded with one out of reach
    assert module.contacts(far).gap[5] == 0.05
    assert not module.contacts(far).normal[5].any()
    assert MujocoLCS(model, motion="quasi-dynamic", contacts={("floor", "box"): 4, "round": 1}).n_contacts == 5


@pytest.mark.parametrize("cone", ["anitescu", "stewart-trinkle"])
def test_what_rests_on_contacts_of_a_group_without_friction_does_not_creep(cone):
    model = load(FLOOR + BOX.format("0 0 .02", 0.5))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    module = MujocoLCS(model, motion="dynamic", contacts=[ContactGroup(None, 4, friction=False)], cone=cone)
    x = module.observe(data)
    torch.testing.assert_close(module.params(x).step(x, torch.zeros(0).double()).x_next, x, atol=1e-7, rtol=0)


@pytest.mark.parametrize(
    ("contacts", "words"),
    [([], "one at least"), (["block"], "ContactGroup"), ([ContactGroup("x", 1)], "'x'"), ({"round": "all"}, "an int")],
)
def test_groups_that_do_not_fit_are_refused(contacts, words):
    refuse(InvalidInputError, words, MujocoLCS, stack(), motion="quasi-dynamic", contacts=contacts)


def test_the_reference_of_rotations_moves_along():
    """By any number of turns, and the system is the same in the new numbers."""
    data = mujoco.MjData(model := load(BOX.format("0 0 .0199", 1) + '<geom type="plane" size="1 1 .1"/>'))
    module = MujocoLCS(model, data, motion="dynamic")
    for _ in range(9):
        mujoco.mj_integratePos(model, data.qpos, np.array([0, 0, 0, 0, 0, 1.0]), 1.0)
        before = module.state.to_state(data.qpos)
        expected = module.state.to_mujoco(module.params(before).step(before, torch.zeros(0).double()).x_next)[0]
        x = module.observe(data)
        assert not x[3:6].any()
        after = module.state.to_mujoco(module.params(x).step(x, torch.zeros(0).double()).x_next)[0]
        np.testing.assert_allclose(after, expected, atol=1e-9)
        mujoco.mj_step(model, ahead := copy.copy(data), 50)
        np.testing.assert_allclose(after, ahead.qpos, atol=1e-6)  # what MuJoCo's soft contacts do more is slight
        np.testing.assert_allclose(module.state.to_mujoco(x)[0], data.qpos, atol=1e-12)
    refuse(DTypeError, "follow", module.observe, data.qpos)


def test_each_state_of_a_batch_has_a_reference_of_its_own():
    state = MujocoState(load(BOX.format("0 0 0", 1)))
    qpos = np.random.default_rng(0).normal(size=(3, 7))
    state.follow(qpos)
    x = state.to_state(qpos)
    assert not x[:, 3:].any()
    turned = x.unsqueeze(1) + torch.linspace(0, 0.2, 4).double()[:, None]  # (3, 4, 6): a plan for each
    again = state.to_mujoco(turned)[0]
    np.testing.assert_allclose(again[:, 0, 3:], qpos[:, 3:] / np.linalg.norm(qpos[:, 3:], axis=-1, keepdims=True))
    torch.testing.assert_close(state.to_state(again), turned)
    refuse(ShapeError, "first batch dimensions", state.to_mujoco, x[0])
