"""Actuators with activation and with limits of control and force, beside MuJoCo's own steps."""

from contextlib import nullcontext

import mujoco
import numpy as np
import pytest
import torch

from difflcs import LCSMPCLayer, QuadraticCost
from difflcs.errors import ContactWarning, InvalidInputError
from difflcs.physics.mujoco import LearnableMujocoLCS, MujocoLCS, drive_mocap
from tests.conftest import refuse

SLIDE = """<mujoco><option timestep=".002" integrator="{0}" gravity="0 0 0"/><worldbody><body>
    <joint name="a" type="slide" axis="1 0 0" damping="2" {2}/><geom size=".1" mass="1"/></body></worldbody>
    <actuator>{1}</actuator></mujoco>"""


def load(actuator, joint="", integrator="Euler"):
    return mujoco.MjModel.from_xml_string(SLIDE.format(integrator, actuator, joint))


def both(model, q, v, act, u, ctrl=None, **options):
    """The state after 20 ms: by the system, with actions u, and in MuJoCo."""
    module = MujocoLCS(model, motion="dynamic", seconds=0.02, **options)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = q, v, act
    x, u = module.state.to_state(data.qpos, data.qvel, data.act), torch.tensor([u], dtype=torch.float64)
    data.ctrl[:] = module.control(x, u)
    context = None if ctrl is None else torch.tensor([ctrl], dtype=torch.float64)
    after = module.params(x, context).step(x, u).x_next
    mujoco.mj_step(model, data, 10)
    return after, module.state.to_state(data.qpos, data.qvel, data.act)


LINEAR = {
    "integrator": '<general joint="a" dyntype="integrator" gainprm="3"/>',
    "velocity": '<intvelocity joint="a" kp="50" kv="2" actrange="-5 5"/>',
    "filter": '<cylinder joint="a" timeconst=".03" area="20"/>',
    "exact filter": '<position joint="a" kp="80" kv="3" timeconst=".03"/>',
}


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("kind", LINEAR)
def test_activation_is_a_state_that_follows_its_control(kind, integrator):
    model = load(LINEAR[kind], integrator=integrator)
    after, true = both(model, 0.1, -0.3, 0.2, 0.5)
    assert MujocoLCS(model, motion="dynamic").state.names == ("a", "a_velocity", "actuator0_activation")
    torch.testing.assert_close(after, true, rtol=0, atol=3e-3 if integrator == "RK4" else 1e-8)
    assert MujocoLCS(model).n_x == 1  # quasi-static


def test_a_muscle_and_what_it_activates_are_right_at_its_nominal_control():
    model = load('<muscle joint="a" lengthrange="-1 1" force="30"/>')
    after, true = both(model, 0.1, 0.0, 0.2, 0.8, ctrl=0.8)
    torch.testing.assert_close(after, true, rtol=0, atol=2e-4)
    assert abs(true[2] - 0.2) > 0.1


@pytest.mark.parametrize("ctrl", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("kind", ['damper kv="60" ctrlrange="0 1"', 'muscle force="900" lengthrange="-1 1"'])
def test_what_is_not_linear_in_the_control_stays_near_over_its_range(kind, ctrl):
    """The tangent at 0 would turn a fast slide round, by many times its speed."""
    model = load(f'<{kind} joint="a"/>', integrator="implicitfast")
    act = [0.3] if "muscle" in kind else []
    ends = [both(model, 0.0, 1.0, act, u, ctrl=ctrl) for u in (0.0, ctrl, 1.0)]
    torch.testing.assert_close(*ends[1], rtol=0, atol=1e-3)
    moved = max(abs(float(true[1]) - 1.0) for _, true in ends)
    assert max(abs(float(ours[1] - true[1])) for ours, true in ends) < 0.65 * moved


def test_a_drive_with_activation_overcomes_the_friction_that_holds():
    model = load('<cylinder joint="a" timeconst=".003" area="60"/>', 'frictionloss="20"')
    for u in (0.2, 1.0):
        after, true = both(model, 0.0, 0.0, [0.0], u)
        assert abs(float(after[1] - true[1])) < 0.25 * (0.1 + float(true[1]))
    assert float(true[1]) > 0.5


def test_a_step_that_is_far_off_at_the_end_of_a_range_is_warned_of():
    """A servo that swings back within the step, and a limit, where one impulse would throw the slide faster."""
    model = load('<position joint="a" kp="40000" ctrlrange="-1 1"/>', 'limited="true" range="-.05 .05"')
    x = torch.zeros(2, dtype=torch.float64)
    with pytest.warns(ContactWarning, match="in 1 of 1 states, most of all joint 'a'") as said:
        MujocoLCS(model, motion="dynamic", seconds=0.02).params(x)
    assert [w.filename for w in said] == [__file__]
    MujocoLCS(model, motion="dynamic", seconds=0.002).params(x)


LIMITED = {
    "forcerange": ('<position joint="a" kp="5000" kv="100" forcerange="-4 4"/>', ""),
    "actuatorfrcrange": ('<position joint="a" kp="5000" kv="100"/>', 'actuatorfrcrange="-4 4"'),
    "actuatorfrcrange behind a gear": ('<position joint="a" gear="2" kp="5000" kv="100"/>', 'actuatorfrcrange="-4 4"'),
    "ctrlrange": ('<motor joint="a" ctrlrange="-4 4"/>', ""),
}


@pytest.mark.parametrize("kind", LIMITED)
def test_what_is_far_beyond_a_limit_has_the_force_at_the_limit(kind):
    """Where the force is at its limit it is the same for other actions, of which a warning speaks."""
    model, servo = load(*LIMITED[kind]), kind != "ctrlrange"
    with pytest.warns(ContactWarning, match="a nominal control near the actions") if servo else nullcontext():
        after, true = both(model, 0.0, 0.0, [], 50.0 if servo else 4.0, ctrl=50.0, relative=False)
    torch.testing.assert_close(after, true, rtol=1e-6, atol=1e-9)
    assert true[1] == pytest.approx(4 * 0.02, rel=0.05)


@pytest.mark.parametrize(("kind", "low", "high"), [
    ("forcerange", -4, 4), ("actuatorfrcrange", -4, 4), ("ctrlrange", -4, 4), ("actuatorfrcrange behind a gear", -2, 2),
])  # fmt: skip
def test_bounds_of_actions_are_those_that_limits_leave(kind, low, high):
    module = MujocoLCS(load(*LIMITED[kind]), motion="dynamic", seconds=1e-4)
    bounds = torch.stack(module.action_bounds(torch.tensor([0.3, 0.02], dtype=torch.float64))).flatten()
    of_force = 1 if kind == "ctrlrange" else 5000  # a servo, whose action counts from where it is, has a drag
    speed = 0.02 * (2 if "gear" in kind else 1)
    wanted = torch.tensor([low, high], dtype=torch.float64) / of_force + speed * 100 / 5000 * (of_force > 1)
    torch.testing.assert_close(bounds, wanted, rtol=0.05, atol=1e-6)


def load_heavy(drive, joint="", tendon=""):
    """A slide that touches 20 kg."""
    heavy = '<body pos=".2 0 0"><joint type="slide" axis="1 0 0"/><geom size=".1" mass="20"/></body></worldbody>'
    xml = SLIDE.format("Euler", drive, joint).replace("</worldbody>", heavy + tendon)
    return mujoco.MjModel.from_xml_string(xml)


TENDON = '<tendon><fixed name="t"><joint joint="a" coef="1"/></fixed></tendon>'
WEAK = {kind: LIMITED[kind] for kind in list(LIMITED)[:3]} | {
    "tendon": ('<position tendon="t" gear="-.5" kp="20000" kv="400" forcerange="-8 8"/>', "", TENDON)
}


@pytest.mark.filterwarnings("ignore:.*farther off")  # the servo on a tendon has no bounds, and is tried at ±1
@pytest.mark.parametrize("motion", ["dynamic", "quasi-dynamic"])
@pytest.mark.parametrize(("kind", "most"), [*zip(WEAK, (8e-4, 8e-4, 4e-4, -4e-4), strict=True)])
def test_a_servo_pushes_no_harder_than_it_can(kind, most, motion):
    """What it can do is as without a limit; told to do more, it moves the weight as far as in MuJoCo."""
    model, strong = load_heavy(*WEAK[kind]), load_heavy(*WEAK[kind])
    strong.actuator_forcelimited[:], strong.jnt_actfrclimited[:] = 0, 0
    module, free = (MujocoLCS(one, motion=motion, seconds=0.1) for one in (model, strong))
    data, x = mujoco.MjData(model), torch.zeros(2, module.n_x, dtype=torch.float64)
    assert module.params(x).n_lam == module.n_lam == free.n_lam + 2
    u = torch.full((2, 1), 0.9 * most, dtype=torch.float64)
    torch.testing.assert_close(*(m.params(x).step(x, u).x_next for m in (module, free)), rtol=0, atol=1e-12)
    for harder in (-40, 10, 40):
        u = torch.full((2, 1), harder * most, dtype=torch.float64)
        after = module.params(x).step(x, u).x_next[:, -1] / (1.0 if motion == "dynamic" else 0.1)
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = module.control(x, u)[0]
        mujoco.mj_step(model, data, 50)
        torch.testing.assert_close(after, torch.full_like(after, data.qvel[1]), rtol=0.1, atol=1e-9)


def test_a_plan_and_what_is_learned_know_how_far_a_weak_servo_moves_what_is_heavy():
    model = load_heavy(*WEAK["forcerange"])
    module, data = LearnableMujocoLCS(model, learn=["gain"], motion="dynamic", seconds=0.1), mujoco.MjData(model)
    wanted = torch.tensor([0.0, -50.0, 0.0, 0.0])
    cost = QuadraticCost(torch.zeros(4, 4), torch.eye(1) * 1e-3, torch.diag(-20 * wanted), q_final=wanted).double()
    with pytest.warns(ContactWarning, match="take fewer seconds"):  # backwards nothing resists, and a step is long
        plan = LCSMPCLayer(module, cost, 4, -0.05, 0.05)(torch.zeros(4, dtype=torch.float64))
    for u in plan.u.detach():
        data.ctrl[:] = module.control(module.physics.observe(data), u)
        mujoco.mj_step(model, data, 50)
    assert 0.01 < data.qpos[1] < plan.x[-1, 1] < 0.02  # 5 cm without limits of the force
    plan.x.sum().backward()
    assert module.change.grad.isfinite().all()


@pytest.mark.parametrize(("drive", "harder"), [
    ('timeconst=".01" joint="a" kp="5000"', True), ('jointinparent="a" kp="5000"', True), ('joint="a" kp="9"', False),
])  # fmt: skip
def test_a_servo_that_pushes_harder_than_it_can_with_no_limit_in_the_system_is_warned_of(drive, harder, recwarn):
    module = MujocoLCS(load_heavy(f'<position name="push" {drive} kv="1" forcerange="-4 4"/>'), motion="dynamic")
    assert ["actuator push, " in str(w.message) for w in recwarn] == [True] * harder
    assert module.n_lam == MujocoLCS(load_heavy(""), motion="dynamic", contacts=module.n_contacts).n_lam


@pytest.mark.parametrize("motion", ["quasi-static", "dynamic"])
def test_a_plan_keeps_a_servo_within_its_range(motion):
    model = load('<position joint="a" kp="100" kv="20" ctrlrange="-.05 .1"/>')
    module = MujocoLCS(model, motion=motion)
    n_x = module.n_x
    cost = QuadraticCost(torch.zeros(n_x, n_x), torch.eye(1) * 1e-6, torch.eye(n_x), q_final=torch.full((n_x,), -9.0))
    mpc = LCSMPCLayer(module, cost.double(), 1, -1.0, 1.0)
    x = torch.zeros(2, n_x, dtype=torch.float64)
    x[:, 0] = torch.tensor([0.0, 0.08])
    for plan in (mpc(x), mpc(x, lcs=module.params(x)), mpc(x.flip(0), lcs=module.params(x.flip(0)))):
        targets = module.control(plan.x[:, 0], plan.action)
        torch.testing.assert_close(targets, torch.full((2, 1), 0.1, dtype=torch.float64), rtol=0, atol=1e-3)
    assert MujocoLCS(load('<motor joint="a"/>'), motion="dynamic").action_bounds(torch.zeros(2))[0].isinf()


def test_what_mocap_moves_is_where_the_data_have_it():
    body = '<body name="wall" mocap="true" pos="1 0 0"><geom size=".1"/></body><body>'
    model = mujoco.MjModel.from_xml_string(SLIDE.format("Euler", "", "").replace("<body>", body))
    module, data = MujocoLCS(model, motion="dynamic"), mujoco.MjData(model)
    data.mocap_pos[0] = 0.5, 0, 0
    module.observe(data)
    for given in (module, MujocoLCS(model, data, motion="dynamic")):
        assert given.contacts(given.state.to_state(data.qpos, data.qvel)).gap.item() == pytest.approx(0.3)


def test_a_plan_with_driven_mocap_bodies_knows_how_they_push_and_pull():
    spec = mujoco.MjSpec.from_string("""<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
      <body name="hand" mocap="true" pos="-.1 0 .02" quat="1 0 0 1"><geom size=".03"/></body>
      <body name="cart"><joint type="slide" axis="1 0 0" damping="1"/><geom size=".05" mass=".2"/></body>
      <body name="grip" mocap="true" pos="0 .3 .3"/>
      <body name="arm" pos="0 .3 .3"><joint type="slide" axis="1 0 0"/><geom size=".02" mass=".1"/></body>
      </worldbody><equality><weld body1="arm" body2="grip"/></equality></mujoco>""")
    jump, driven = spec.compile(), drive_mocap(spec).compile()
    before, data = mujoco.MjData(jump), mujoco.MjData(driven)
    module = MujocoLCS(driven, motion="dynamic", seconds=0.05, distance=0.1)
    x, u = module.observe(data), torch.tensor([0.04, 0.0, 0.0, 0.01, 0.0, 0.0], dtype=torch.float64)
    before.mocap_pos[:] += u.numpy().reshape(2, 3)
    mujoco.mj_step(jump, before, 25)
    with pytest.warns(ContactWarning, match="body 'cart'"):  # which hands may miss that go a decimetre
        planned = module.state.to_mujoco(module.params(x).step(x, u).x_next)[0]
    np.testing.assert_allclose(planned[[3, 7]], before.qpos, atol=1.5e-3)  # of hand, cart, grip, arm
    data.ctrl[:] = module.control(x, 0 * u)
    mujoco.mj_step(driven, data, 25)  # stays, as gravity does not act on it
    np.testing.assert_allclose(data.qpos, module.state.to_mujoco(x)[0], atol=1e-6)
    refuse(InvalidInputError, "mocap", drive_mocap, mujoco.MjSpec.from_string("<mujoco/>"))
