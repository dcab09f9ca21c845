"""Dynamic motion of MuJoCo models against MuJoCo: what rests or slides, free motion, nominal controls, fast robots."""

import copy
import math
from contextlib import nullcontext

import mujoco
import numpy as np
import pytest
import torch

from difflcs import GoalCost, LCSMPCLayer, Status
from difflcs.errors import ContactWarning, InvalidInputError
from difflcs.physics.mujoco import MujocoLCS
from tests.conftest import refuse

SECONDS = (0.002, 0.02, 0.1)
FIRM = '<option timestep=".001" cone="elliptic" impratio="100"/>'  # friction that hardly creeps; by default it does


def load(worldbody, rest="", option=FIRM):
    return mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{worldbody}</worldbody>{rest}</mujoco>")


def tilted(degrees, friction, *geoms):
    """Bodies on a plane that is tilted about y, each a geom and its height above the plane."""
    a = math.radians(degrees)
    bodies = "".join(
        f'<body pos="{z * math.sin(a)} 0 {z * math.cos(a)}" euler="0 {degrees} 0"><freejoint/>'
        f'<geom {geom} friction="{friction}"/></body>'
        for z, geom in geoms
    )
    return f'<geom type="plane" size="5 5 .1" euler="0 {degrees} 0" friction="{friction}"/>{bodies}'


def finger(name, x, sign):
    return f"""<body pos="{x} 0 .5"><joint name="{name}" type="slide" axis="{sign} 0 0"/>
      <geom type="box" size=".01 .02 .02" mass=".1" friction=".8"/></body>"""


HELD = '<body pos="0 0 .5"><freejoint/><geom type="box" size=".02 .02 .02" mass=".05" friction=".8"/></body>'
PINCH = HELD + finger("left", -0.03, 1) + finger("right", 0.03, -1)
WALL = '<geom type="box" size=".1 2 2" pos="-.12 0 .5" friction=".8"/>' + HELD + finger("right", 0.03, -1)
LINK = """<geom type="plane" size="5 5 .1"/><body pos="0 0 .05"><freejoint/><geom type="box" size=".05 .05 .05"/></body>
  <body pos="-.15 0 .11"><joint type="hinge" axis="0 1 0"/>
    <geom type="capsule" size=".01" fromto="0 0 0 .2 0 0" mass=".2"/></body>"""
SERVOS = '<actuator><position joint="left" kp="300" kv="20"/><position joint="right" kp="300" kv="20"/></actuator>'
MOTOR = '<actuator><motor joint="right"/></actuator>'
CUBE = 'type="box" size=".05 .05 .05" mass="1"'
RESTING = {  # bodies, the rest of the model, control, number of free bodies
    "flat": (tilted(0, 1.0, (0.05, CUBE)), "", 0.0, 1),
    "slope": (tilted(20, 0.5, (0.05, CUBE)), "", 0.0, 1),
    "slope across": (tilted(20, 0.5, (0.05, CUBE + ' euler="0 0 30"')), "", 0.0, 1),
    "cylinder on a slope": (tilted(25, 0.7, (0.03, 'type="cylinder" size=".05 .03" mass=".1"')), "", 0.0, 1),
    "box on a tilted box": (tilted(15, 0.6, (0.05, CUBE), (0.13, 'type="box" size=".04 .04 .03"')), "", 0.0, 2),
    "pinch": (PINCH, SERVOS, 0.01, 1),
    "wall": (WALL, MOTOR, 3.0, 1),
    "link on a box": (LINK, "", 0.0, 1),
}


@pytest.mark.parametrize("option", [FIRM, ""])
@pytest.mark.parametrize("name", RESTING)
@pytest.mark.filterwarnings("ignore:expected a system as near:difflcs.errors.ContactWarning")  # as one lets go
def test_what_friction_holds_stays_as_in_mujoco_by_the_right_force(name, option):
    bodies, rest, ctrl, free = RESTING[name]
    model = load(bodies, rest, option)
    start = mujoco.MjData(model)
    start.ctrl[:] = ctrl
    mujoco.mj_step(model, start, 1500)
    assert np.abs(start.qvel).max() < 5e-3
    u = torch.from_numpy(start.ctrl - (start.qpos[-2:] if name == "pinch" else 0.0))
    held = [6 * body + axis for body in range(free) for axis in range(3)]
    for seconds in SECONDS:
        data = copy.copy(start)
        mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
        for nominal in [None, start.ctrl] if name == "pinch" else [None]:  # with None the servos press nothing
            module = MujocoLCS(model, start, motion="dynamic", seconds=seconds, ctrl=nominal)
            x = module.state.to_state(start.qpos, start.qvel)
            params = module.params(x)
            after, lam = params.step(x, u)
            wrong = (after - module.state.to_state(data.qpos, data.qvel)).abs()
            assert wrong[model.nv :][held].max() < 1e-3  # m/s
            assert wrong[: model.nv][held].max() < 1e-4  # m
            carried = (params.C @ lam)[model.nv :][: 6 * free].reshape(-1, 6)[:, 2] / seconds
            torch.testing.assert_close(carried[-1:], torch.full((1,), 9.81).double(), rtol=2e-2, atol=0)


@pytest.mark.filterwarnings("ignore:expected a system as near")  # also where the grip would open without a control
def test_a_grip_that_the_nominal_control_does_not_close_holds_from_step_to_step():
    model = load(PINCH, SERVOS, "")
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.01
    mujoco.mj_step(model, data, 300)
    module = MujocoLCS(model, data, motion="dynamic", seconds=0.1)
    x = module.state.to_state(data.qpos, data.qvel)
    for _ in range(8):
        x = module.params(x).step(x, torch.from_numpy(data.ctrl) - x[6:8]).x_next
        assert abs(float(x[10])) < 0.01  # m/s; in half a step it falls at .5


@pytest.mark.parametrize(("motion", "compliance"), [("dynamic", 1e-6), ("quasi-dynamic", 0.02)])
def test_no_contact_is_far_stiffer_than_what_it_moves_and_what_is_held_does_not_sag(motion, compliance):
    heavy = "".join(f'<body pos="{x} 0 3"><freejoint/><geom size=".02" mass="1e3"/></body>' for x in (0, 1))
    data = mujoco.MjData(model := load(PINCH + heavy, SERVOS))
    module = MujocoLCS(model, data, motion=motion, ctrl=(0.01, 0.01), compliance=compliance, caps=0)
    with pytest.warns(ContactWarning, match="ctrlrange") if motion == "dynamic" else nullcontext():  # far away it jams
        system = module.params(x := module.observe(data))
    F, after = system.F, system.step(x, torch.tensor([0.01, 0.01]).double()).x_next
    assert torch.linalg.eigvalsh(F / F.diag().outer(F.diag()).sqrt())[0] > 0.003
    assert (after - x)[:3].abs().max() < 1e-5  # m; in a step it would fall by .098


@pytest.mark.parametrize(
    ("degrees", "heading", "speed"), [(0, 0.0, 0.8), (0, 0.7, 0.8), (30, 0.0, 0.3), (40, 0.0, 0.0)]
)
def test_what_slides_goes_as_coulomb_says(degrees, heading, speed):
    a, h = math.radians(degrees), 0.1
    model = load(tilted(degrees, 0.5, (0.01, 'type="box" size=".2 .2 .01" mass="1"')))
    module = MujocoLCS(model, motion="dynamic", seconds=h)
    along = np.array([math.cos(a) * math.cos(heading), math.sin(heading), -math.sin(a)])
    x = module.state.to_state(model.qpos0, np.concatenate([speed * along, np.zeros(3)]))
    moved = (module.params(x).step(x, torch.zeros(0).double()).x_next - x).numpy()
    gains = 9.81 * (math.sin(a) - 0.5 * math.cos(a))
    np.testing.assert_allclose(moved[:3], (speed * h + gains * h * h / 2) * along, atol=3e-3)
    np.testing.assert_allclose(moved[6:9], gains * h * along, atol=0.04)


FREE = """<body><joint name="a" type="hinge" axis="0 1 0" damping=".05"/>
  <geom type="capsule" size=".02" fromto="0 0 0 .2 0 0" mass=".2"/>
  <body pos=".2 0 0"><joint name="b" type="hinge" axis="0 1 0" damping=".05"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .2 0 0" mass=".2"/></body></body>"""
TENDON = '<tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>'
ACTUATORS = {
    "motors": '<actuator><motor joint="a" gear="2"/><motor joint="b"/></actuator>',
    "absolute servos": '<actuator><position joint="a" kp="20"/><position joint="b" kp="20" gear="2"/></actuator>',
    "tendon servo": f'{TENDON}<actuator><position tendon="t" kp="20"/></actuator>',
    "dampers": '<actuator><motor joint="a"/><damper joint="b" kv=".2" ctrlrange="0 1"/></actuator>',
}


@pytest.mark.parametrize(
    "option", ['timestep=".005"', 'integrator="RK4"', 'integrator="implicitfast"', 'timestep=".02"']
)
@pytest.mark.parametrize(("name", "speed"), [*((name, 1.0) for name in ACTUATORS), ("motors", 100.0)])
@pytest.mark.filterwarnings("ignore:expected a system as near:difflcs.errors.ContactWarning")  # of a damper's far ends
def test_free_motion_is_as_right_as_differences_of_the_simulation(name, speed, option):
    """Beside x₊ = f(x, ū) + ∂f/∂u (u − ū) of MuJoCo's own steps, at the balance of servos and half of the others."""
    model = load(FREE, ACTUATORS[name], f'<option {option}><flag contact="disable"/></option>')
    data, random, errors = mujoco.MjData(model), np.random.default_rng(0), []
    steps = round(0.02 / model.opt.timestep)

    def simulate(qpos, qvel, ctrl):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_step(model, data, steps)
        return np.concatenate([data.qpos, data.qvel])

    for _ in range(8):
        qpos, qvel = random.normal(size=2), speed * random.normal(size=2)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        nominal = data.actuator_length.copy() if "servo" in name else np.full(model.nu, 0.5)
        ctrl = nominal + random.uniform(-0.5, 0.5, model.nu)
        module = MujocoLCS(model, motion="dynamic", seconds=0.02, relative=False)
        x = module.state.to_state(qpos, qvel)
        params = module.params(x, None if "servo" in name else torch.from_numpy(nominal))
        ours = params.step(x, torch.from_numpy(ctrl)).x_next.numpy()
        start = simulate(qpos, qvel, nominal)
        columns = [simulate(qpos, qvel, nominal + 1e-5 * e) - start for e in np.eye(model.nu)]
        differences = start + np.array(columns).T @ (ctrl - nominal) / 1e-5
        right = simulate(qpos, qvel, ctrl)
        errors.append([np.abs(v - right).max() / np.abs(right[2:] - qvel).max() for v in (ours, differences)])
    ours, differences = np.median(errors, 0)
    assert ours < 1.5 * differences + 1e-4


def test_a_nominal_control_is_checked():
    model = load(FREE, ACTUATORS["motors"])
    refuse(InvalidInputError, "ctrl", MujocoLCS, model, motion="dynamic", ctrl=[0.0])
    module = MujocoLCS(model, motion="dynamic", ctrl=[0.1, 0.2])
    x, ctrl = torch.zeros(4).double(), torch.tensor([0.1, 0.2]).double()
    torch.testing.assert_close(module.params(x).A, MujocoLCS(model, motion="dynamic").params(x, ctrl).A)


@pytest.mark.parametrize("seconds", [0.02, 0.1])
@pytest.mark.filterwarnings("ignore:expected a system as near:difflcs.errors.ContactWarning")
def test_fast_and_unstable_robots_have_a_system_at_every_state(seconds):
    floor = '<geom type="plane" size="2 2 .1" pos="0 0 -.42"/>'
    module = MujocoLCS(load(floor + FREE, ACTUATORS["motors"]), motion="dynamic", seconds=seconds)
    random = np.random.default_rng(0)
    x = torch.from_numpy(random.normal(size=(60, 4)) * [3, 3, 30, 30])
    F = module.params(x).F
    assert torch.linalg.eigvalsh(F + F.mT)[:, 0].min() > 0.9 * 2 * module.compliance
    pole = """<body><joint type="hinge" axis="0 1 0"/><geom size=".01" pos="0 0 .05" mass=".1"/></body>
      <body pos="-.03 0 .05"><joint name="p" type="slide" axis="1 0 0"/><geom size=".01" mass=".1"/></body>"""
    upright = MujocoLCS(load(pole, '<actuator><motor joint="p"/></actuator>'), motion="dynamic", seconds=seconds)
    assert float(upright.params(torch.zeros(4).double()).F.min()) > 0
    mpc = LCSMPCLayer(module, GoalCost.reach(4, 2, (1.0, 1.0), input_weight=0.1), 5, -1.0, 1.0, on_failure="mask")
    assert mpc(x[:8], torch.zeros(8, 2).double()).status[0] == Status.CONVERGED


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize(("shape", "depth"), [("box", 0.001), ("sphere", 2e-4)])
@pytest.mark.parametrize("speed", [0.0, 0.05])
def test_what_is_pressed_across_its_rail_has_friction(shape, depth, cone, speed):
    bodies = f"""<body><joint name="rail" type="slide" axis="1 0 0"/><geom type="box" size=".1 .1 .05" mass="1"/></body>
      <geom type="{shape}" size=".05 .05 .05" pos="0 {0.15 - depth} 0"/>
      <body pos="1 0 0"><joint type="slide" axis="1 0 0"/><geom size=".1"/></body>"""
    option = f'<option timestep=".002" cone="{cone}" gravity="0 0 0"/><default><geom friction=".5"/></default>'
    model = load(bodies, '<actuator><position joint="rail" kp="100" kv="5"/></actuator>', option)
    for ctrl in (0.05, -0.1):
        data = mujoco.MjData(model)
        data.qvel[0] = speed
        module = MujocoLCS(model, data, motion="dynamic", seconds=0.02)
        x = module.observe(data)
        found = float(module.params(x).step(x, torch.tensor([ctrl]).double()).x_next[model.nv])
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, 10)
        assert abs(found - data.qvel[0]) < 0.12 * 1.9 * abs(ctrl)  # of the speed that it gets without friction
    # What can only rub is no contact where positions are the state, or where MuJoCo has none.
    assert (module.contacts(x).gap < 0).any()
    positions = MujocoLCS(model, data, motion="quasi-static"), MujocoLCS(model, data, motion="quasi-dynamic")
    model.geom_contype[:] = 0
    for other in (*positions, MujocoLCS(model, data, motion="dynamic", pairs=[(0, 1)])):
        assert (other.contacts(torch.zeros(other.n_x, dtype=torch.float64)).gap >= 0).all()


def test_a_light_object_that_goes_wrong_is_warned_of_beside_a_heavy_robot_at_calls_1_2_and_4():
    slides = '<joint name="x{0}" type="slide" axis="1 0 0"/><joint name="z{0}" type="slide" axis="0 0 1"/>'
    model = load(
        f"""<geom type="plane" size="1 1 .1"/><body name="box" pos="0 0 .03">{slides.format(0)}<joint axis="0 1 0"/>
          <geom type="box" size=".03 .03 .03" mass=".05"/></body>
        <body pos="-.038 0 .05">{slides.format(1)}<geom type="box" size=".01 .02 .04" mass="1"/></body>""",
        """<actuator><position joint="x1" kp="100" kv="10" ctrlrange="-.1 .1"/>
          <position joint="z1" kp="1000" kv="60" ctrlrange="-.2 .2"/></actuator>""",
        option="",
    )
    module = MujocoLCS(model, motion="dynamic", seconds=0.02)
    for tried in (True, True, False, True, False):  # each time that twice as many states were asked for
        with pytest.warns(ContactWarning, match="body 'box'") if tried else nullcontext():
            module.params(torch.zeros(module.n_x, dtype=torch.float64))
