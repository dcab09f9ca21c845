"""Contacts of many geoms and many states at once: those of each pair, and of each state, alone."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import mujoco
import numpy as np
import pytest
import torch

from difflcs.errors import ContactWarning, InvalidInputError
from difflcs.physics.complementarity import FreeMotion
from difflcs.physics.mujoco import Distance, MujocoCost, MujocoLCS
from difflcs.physics.mujoco._native import _mujoco
from difflcs.physics.mujoco.contacts import MujocoContacts
from difflcs.physics.mujoco.limits import ScaledRows
from difflcs.physics.mujoco.readings import Readings
from tests.conftest import refuse

KINDS = ("box", "box", "capsule", "cylinder", "ellipsoid", "mesh")
CUBE = " ".join(f"{x} {y} {z}" for x in (-0.04, 0.04) for y in (-0.03, 0.05) for z in (-0.02, 0.03))


def pile(kinds=KINDS, memory="16M"):
    """Bodies of all kinds above a floor."""
    shape = {"mesh": 'type="mesh" mesh="m"'}
    geoms = (shape.get(kind, f'type="{kind}" size=".05 .06 .04"') for kind in kinds)
    bodies = "".join(
        f'<body name="{i}" pos="{9 * i} 0 1"><freejoint/><geom {geom} mass="1"/></body>' for i, geom in enumerate(geoms)
    )
    return mujoco.MjModel.from_xml_string(f"""<mujoco><size memory="{memory}"/>
        <asset><mesh name="m" vertex="{CUBE}"/></asset>
        <worldbody><geom type="plane" size="1 1 1"/>{bodies}</worldbody></mujoco>""")


def placed(model, n, seed=0):
    """Positions (n, nq) of bodies that lie on the floor, lean on each other or fall."""
    random, data, qpos = np.random.default_rng(seed), mujoco.MjData(model), []
    for steps in random.integers(0, 300, n):
        mujoco.mj_resetData(model, data)
        bodies = data.qpos.reshape(-1, 7)
        bodies[:, :3] = random.uniform([-0.2, -0.2, 0.06], [0.2, 0.2, 0.3], (len(bodies), 3))
        bodies[:, 3:] = random.normal(size=(len(bodies), 4))
        mujoco.mj_step(model, data, int(steps))
        qpos.append(data.qpos.copy())
    return np.array(qpos)


def rows(found, keep):
    """Contacts as rows of numbers, in the order of their gaps."""
    each = torch.cat([found.gap[..., None], found.normal, found.tangent.flatten(-2)], -1)[keep]
    return each[each[:, 0].argsort()].round(decimals=9)


def test_contacts_of_a_scene_are_those_of_its_pairs():
    model = pile()
    qpos = placed(model, 3)
    whole = MujocoLCS(model, contacts=400, distance=0.1, motion="dynamic")
    x = whole.state.to_state(qpos)
    pairs = [(a, b) for a in range(model.ngeom) for b in range(a + 1, model.ngeom)]
    alone = [MujocoLCS(model, contacts=8, distance=0.1, motion="dynamic", pairs=[pair]).contacts(x) for pair in pairs]
    alone = type(alone[0])(*(torch.cat(values, 1) for values in zip(*alone, strict=True)))
    scene = whole.contacts(x)
    nearest = MujocoLCS(model, contacts=9, distance=0.1, motion="dynamic").contacts(x)
    for i in range(len(x)):
        one, all_pairs = (rows(type(f)(*(v[i] for v in f)), f.normal[i].any(-1)) for f in (scene, alone))
        torch.testing.assert_close(one, all_pairs, rtol=0, atol=1e-8)
        assert len(one) > 10
        # Four contacts of a pair are enough where there is no room for all, so that some may be farther.
        near = nearest.gap[i].sort().values
        assert (near >= one[:9, 0] - 1e-9).all()
        assert all((one[:, 0] - gap).abs().min() < 1e-9 for gap in near)


def test_threads_find_what_one_finds():
    model = pile()
    module = MujocoLCS(model, contacts=12, motion="dynamic")
    x = module.state.to_state(placed(model, 6))
    alone, systems = [module.contacts(state) for state in x], [module.params(state) for state in x]
    torch.set_num_threads(3)
    together, system = module.contacts(x), module.params(x)
    for found, expected in zip(together, zip(*alone, strict=True), strict=True):
        assert torch.equal(found, torch.stack(expected))
    for name in ("A", "B", "d"):
        each = torch.stack([getattr(s, name) for s in systems])
        torch.testing.assert_close(getattr(system, name), each, rtol=1e-5, atol=1e-5)


def test_several_threads_may_ask_one_module():
    """They took each other's memory, and the process crashed."""
    module = MujocoLCS(model := pile(("box", "mesh")), contacts=8, motion="dynamic")
    cost, x = MujocoCost(module, [Distance("body:0", "body:1")]), module.state.to_state(placed(model, 5))

    def ask(state):
        return *module.params(state).tensors().values(), *cost.at(state).tensors().values()

    with ThreadPoolExecutor(4) as pool:
        for found, expected in zip(pool.map(ask, [*x] * 10), [*map(ask, x)] * 10, strict=True):
            assert all(map(torch.equal, found, expected))


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_of_mujoco_is_ours_and_leaves_the_module_usable(threads, monkeypatch):
    """There is no memory to measure two meshes, and none is needed where they are far apart."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    module, size = None, 4
    while module is None:  # as little memory as it can be made with, in each version of MuJoCo another
        with suppress(InvalidInputError, ValueError):
            module = MujocoLCS(pile(("mesh", "mesh"), memory=f"{size}K"), motion="dynamic")
        size += 1
    far = torch.tensor([[0, 0, 1, 0, 0, 0, 9, 0, 1, 0, 0, 0, *[0] * 12]] * 2).double()
    near = far.clone()
    near[1, 6] = 0.1
    before = module.contacts(far)
    for _ in range(2):
        refuse(InvalidInputError, r"memory .*in state 1 of 2", module.contacts, near)
        assert all(map(torch.equal, module.contacts(far), before))


@pytest.mark.parametrize(("m", "nv"), [(1, 1), (5, 12), (24, 9), (40, 6)])
def test_soft_forces_are_clipped_by_their_bounds(m, nv):
    """Of random rows, some twice, and a response of less than full rank."""
    random = np.random.default_rng(m)
    rows, gap = random.normal(size=(50, m, nv)), random.normal(size=(50, m))
    rows[:, m // 2 :], gap[:, m // 2 :] = rows[:, : m - m // 2], gap[:, : m - m // 2]
    factor = random.normal(size=(50, nv, nv)) / nv
    factor[:, nv // 2] = 0.0
    response, high = factor @ factor.swapaxes(-1, -2), random.uniform(0, 3, (50, m))
    for low, most in ((0 * high, np.full_like(high, np.inf)), (-high, high)):
        F = rows @ response @ rows.swapaxes(-1, -2) + 1e-3 * np.eye(m)
        force, found = np.zeros_like(gap), np.zeros(len(gap), dtype=bool)
        system = {"D": gap[:, :0], "E": gap[:, :0], "F": F, "c": gap}
        _mujoco.solve_forces(1e-3, 1, system, gap[:, :0], gap[:, :0], low, most, force, found)
        assert found.all()
        slack = gap + np.einsum("nmi,nij,nkj,nk->nm", rows, response, rows, force)
        np.testing.assert_allclose(force, np.clip(-slack / 1e-3, low, most), rtol=0, atol=1e-7 * np.abs(force).max())


SPINNING = """<mujoco><option timestep=".002" cone="elliptic"/>
  <default><geom condim="{}" friction=".3 .002 .0001"/></default><worldbody><geom type="plane" size="1 1 .1"/>
  <body pos="0 0 .03"><freejoint/><geom type="ellipsoid" size=".08 .08 .03" mass="1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("cone", ["anitescu", "stewart-trinkle"])
@pytest.mark.parametrize("rate", [3.0, -3.0, 0.05])
def test_torsional_friction_stops_a_spin_by_the_law_of_coulomb(cone, rate):
    model = mujoco.MjModel.from_xml_string(SPINNING.format(4))
    data, h = mujoco.MjData(model), 0.02
    mujoco.mj_step(model, data, 500)
    data.qvel[5] = rate
    turned = []
    for torsion in (True, False):
        module = MujocoLCS(model, data, motion="dynamic", seconds=h, cone=cone, torsion=torsion)
        turned.append(float(module.params(x := module.observe(data)).step(x, torch.zeros(0).double()).x_next[11]))
    mujoco.mj_step(model, data, 10)
    lost = 0.002 * 9.81 * h / model.body_inertia[1, 2]
    after, near = rate - np.sign(rate) * min(lost, abs(rate)), 0.1 if abs(rate) > lost else 0.25  # it creeps to rest
    assert [*turned, data.qvel[5]] == pytest.approx([after, rate, after], abs=near * lost)


def test_rolling_friction_is_left_out_with_a_warning():
    with pytest.warns(ContactWarning, match=r"rolling friction \(condim 6\).*up to 0.0001.*condim 4"):
        module = MujocoLCS(mujoco.MjModel.from_xml_string(SPINNING.format(6)), motion="dynamic")
    assert module.n_lam == 6


BALL = """<mujoco><option {option}</option><worldbody><geom name="floor" type="plane" size="1 1 1" {floor}/>
  <body pos="0 0 .099"><joint {joint}/><geom name="ball" size=".1" mass="1"/></body></worldbody>{rest}</mujoco>"""


def step_of(option=">", floor="", joint='type="slide" axis="0 0 1"', rest=""):
    """A ball that touches a floor: its module, and its state after 20 ms beside MuJoCo's."""
    model = mujoco.MjModel.from_xml_string(BALL.format(option=option, floor=floor, joint=joint, rest=rest))
    data = mujoco.MjData(model)
    module = MujocoLCS(model, data, motion="dynamic", seconds=0.02)
    x = module.observe(data)
    after = module.params(x).step(x, torch.zeros(0).double()).x_next
    mujoco.mj_step(model, data, 10)
    return module, after, module.state.to_state(data.qpos, data.qvel)


MARGINS = {
    "of geoms": {"floor": 'margin=".02"'},
    "of a pair": {"rest": '<contact><pair geom1="floor" geom2="ball" margin=".02"/></contact>'},
    "by override": {"option": 'o_margin=".02" o_friction=".3 .3 0 0 0"><flag override="enable"/>'},
}


@pytest.mark.parametrize("kind", MARGINS)
def test_contacts_act_from_the_margin_on(kind):
    module, after, true = step_of(**MARGINS[kind])
    assert module.contacts(torch.zeros(2).double()).gap.tolist() == pytest.approx([-0.021])
    torch.testing.assert_close(after, true, rtol=0.35, atol=1e-3)


INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast", "discrete")


@pytest.mark.parametrize("name", [k for k in INTEGRATORS if hasattr(mujoco.mjtIntegrator, f"mjINT_{k.upper()}")])
def test_a_step_is_that_of_the_integrator(name):
    hinge = 'name="a" type="hinge" axis="1 0 0" pos="0 0 .2" stiffness="500" springref="20" damping=".1"'
    held = '<equality><joint joint1="a" solref=".1 1" solimp=".5 .5"/></equality>'
    _, after, true = step_of(f'integrator="{name}">', 'contype="0" conaffinity="0"', hinge, held)
    assert true[1] > 0.5
    torch.testing.assert_close(after, true, rtol=0.03, atol=1e-6)


def test_a_wheel_on_its_axle_rubs():
    _, after, true = step_of(joint='type="hinge" axis="1 0 0"')
    torch.testing.assert_close(after, true)


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "geom_adhesion"), reason="MuJoCo 3.11 and later")
@pytest.mark.parametrize("surface", ['surfacevel="1 0 0 0 0 0"', 'adhesion="5"'])
def test_surfaces_that_move_or_stick_are_left_out_with_a_warning(surface):
    with pytest.warns(ContactWarning, match="neither move nor stick|holds still") as said:
        step_of(floor=surface)
    assert len(said) == 1 + ("vel" in surface)  # what such a surface moves holds still here


@pytest.mark.filterwarnings("ignore:expected a system as near:difflcs.errors.ContactWarning")
@pytest.mark.parametrize(("motion", "nearest"), [("dynamic", 0.2), ("quasi-dynamic", 0.4)])
def test_friction_of_one_on_both_sides_does_not_jam(motion, nearest):
    """A finger that cannot rise pushes a box over a floor, as fast as in MuJoCo; without caps it hardly moves."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
    <body pos="0 0 .05"><freejoint/><geom type="box" size=".05 .05 .05" mass=".2"/></body>
    <body pos="-.061 0 .05"><joint name="x" type="slide" axis="1 0 0" damping="1"/><geom size=".01" mass=".1"/></body>
    </worldbody><actuator><position joint="x" kp="100" ctrlrange="-.2 .2"/></actuator></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 300)
    data.qvel[:] = 0
    moved = []
    for caps in (None, 0):
        module = MujocoLCS(model, data, motion=motion, seconds=0.05, caps=caps)
        system = module.params(x := module.observe(data))
        assert module.n_lam == system.n_lam == 6 * 4 + 8 * (caps is None)
        assert module.params(x.expand(0, 2, -1)).c.shape == (0, 2, module.n_lam)
        u = torch.tensor([0.1], dtype=torch.float64)
        change = system.step(x, u).x_next - x
        moved.append(float(change[model.nv if motion == "dynamic" else 0]))
    data.ctrl[:] = module.control(x, u)
    before = data.qpos[0]
    mujoco.mj_step(model, data, 25)
    true = data.qvel[0] if motion == "dynamic" else data.qpos[0] - before
    assert abs(moved[0] - true) < nearest * true
    assert moved[1] < 0.2 * true
    refuse(InvalidInputError, "caps: expected at most 6, got 7", MujocoLCS, model, motion="dynamic", caps=7)


@pytest.mark.parametrize("all_of_it", [True, False])
def test_the_system_of_cpp_is_that_of_torch(all_of_it):
    """With rotations, rows with effects, bounded forces, caps and forces at rest, or without any of them."""
    n, nv, contacts, others, bounded, caps = (3, 4, 3, 3, 2, 2) if all_of_it else (2, 4, 2, 0, 0, 0)
    normal, size = np.random.default_rng(0).normal, np.random.default_rng(1).random
    eye, half = np.eye(nv), normal(size=(n, nv, nv))
    response = np.zeros((n, 2 * nv, 2 * nv))
    response[:, :nv, :nv] = response[:, nv:, :nv] = half @ half.swapaxes(1, 2) + eye
    turn = eye + 0.1 * normal(size=(n, nv, nv)) if all_of_it else None
    read = Readings(torch.Size([n]), normal(size=(n, 2 * nv)), None, None, turn, None, None, None, None)
    found = MujocoContacts(normal(size=(n, contacts)), normal(size=(n, contacts, nv)),
                           normal(size=(n, contacts, 2, nv)), size((n, contacts)), None)  # fmt: skip
    rows = ScaledRows(normal(size=(n, others)), along := normal(size=(n, others, nv)), along, size((n, bounded)), along)
    free = FreeMotion(normal(size=(n, 2 * nv, 2 * nv)), normal(size=(n, 2 * nv, 2)), normal(size=(n, 2 * nv)), response)
    effect = normal(size=(n, 2 * nv, others)) if all_of_it else None
    rest = normal(size=(n, 4 * contacts + caps + others + bounded + caps)) if all_of_it else None
    more = 50 + size((n, contacts + others)), "anitescu", 0.3, 0.7, rest
    given = found, rows, free, effect, 0.1 + size((n, caps)), *more
    torch.testing.assert_close(read.assemble(*given).tensors(), read.assemble_in_torch(*given))
