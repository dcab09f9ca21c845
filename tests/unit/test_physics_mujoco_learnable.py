"""LearnableMujocoLCS: it is the system of the changed model, and its gradients are slopes."""

import copy
import io
import math

import mujoco
import numpy as np
import pytest
import torch

from difflcs import GoalCost, LCSMPCLayer
from difflcs.errors import ContactWarning, DTypeError, InvalidInputError, ShapeError
from difflcs.physics.mujoco import LearnableMujocoLCS, MujocoCost, MujocoLCS, Posture, identify
from tests.conftest import F64, refuse

VALUES = {"mass": 0.4, "inertia": 4e-4, "com": 0.004, "friction": 0.5, "size": 0.05, "offset": 0.0, "tip": 0.02}
VALUES |= {"kp": 50.0, "kv": 2.0, "damping": 0.3, "armature": 0.01, "stiffness": 3.0, "loss": 0.2, "torsion": 0.01}
pytestmark = pytest.mark.filterwarnings("ignore:expected a system as near")  # with servos a decimetre away
OPTIONS = {"seconds": 0.02, "length": 0.05, "contacts": 6, "caps": 4}


def scene(**changed):
    """A finger that pushes a cube on a floor."""
    v = VALUES | changed
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><worldbody>
      <geom name="floor" type="plane" size="1 1 .1" friction=".1"/>
      <body name="cube" pos="0 0 .05"><freejoint/>
        <inertial pos="{v["com"]} .002 0" mass="{v["mass"]}" diaginertia="{" ".join(3 * [str(v["inertia"])])}"/>
        <geom name="block" type="box" size="{v["size"]} .05 .05" pos="{v["offset"]} 0 0" friction="{v["friction"]}"/>
      </body>
      <body name="finger" pos="-.075 0 .06">
        <joint name="push" type="slide" axis="1 0 0" damping="{v["damping"]}" armature="{v["armature"]}"
          stiffness="{v["stiffness"]}" frictionloss="{v["loss"]}"/>
        <geom name="tip" type="capsule" size="{v["tip"]} {v["tip"]}" mass=".1" condim="4" friction=".1 {v["torsion"]}"/>
      </body>
    </worldbody><actuator><position name="servo" joint="push" kp="{v["kp"]}" kv="{v["kv"]}"/></actuator></mujoco>""")


def states(n_x, seed=0):
    """Near the state of the model, apart, touching and overlapping a little."""
    x = 0.004 * np.random.default_rng(seed).normal(size=(6, n_x))
    x[:, :3] += [0.0, 0.0, 0.05]
    return torch.from_numpy(x)


@pytest.mark.parametrize("motion", ["dynamic", "quasi-dynamic"])
@pytest.mark.parametrize(
    ("learn", "change", "changed"),
    [
        (("mass", "cube"), [0.5], {"mass": 0.4 * math.exp(0.5), "inertia": 4e-4 * math.exp(0.5)}),
        (("inertia", "cube"), [-0.5], {"inertia": 4e-4 * math.exp(-0.5)}),
        (("center_of_mass", "cube"), [0.2, 0.0, 0.0], {"com": 0.014}),
        (("friction", "block"), [0.3], {"friction": 0.5 * math.exp(0.3)}),
        (("size", "cube"), [0.1, 0.0, 0.0], {"size": 0.05 * math.exp(0.1)}),
        (("size", "tip"), [0.2, 0.2], {"tip": 0.02 * math.exp(0.2)}),
        (("offset", "block"), [-0.1, 0.0, 0.0], {"offset": -0.005}),
        (("gain", "servo"), [0.4], {"kp": 50 * math.exp(0.4), "kv": 2 * math.exp(0.4)}),
        (("servo_damping", "servo"), [0.4], {"kv": 2 * math.exp(0.4)}),
        (("damping", "push"), [-1.0], {"damping": 0.3 * math.exp(-1)}),
        (("armature", "push"), [0.7], {"armature": 0.01 * math.exp(0.7)}),
        ("stiffness", [0.7], {"stiffness": 3 * math.exp(0.7)}),
        ("frictionloss", [0.7], {"loss": 0.2 * math.exp(0.7)}),
        (("torsional_friction", "tip"), [0.7], {"torsion": 0.01 * math.exp(0.7)}),
        ("compliance", [0.7], {}),
    ],
    ids=str,
)
def test_it_is_the_system_of_the_changed_model(motion, learn, change, changed):
    learned = LearnableMujocoLCS(scene(), learn=[learn], motion=motion, **OPTIONS)
    x = states(learned.n_x)
    before, give = learned.params(x), 0.02 if changed else 0.02 * math.exp(0.7)
    with torch.no_grad():
        learned.change.copy_(torch.tensor(change))
    found, wanted = learned.params(x), MujocoLCS(scene(**changed), motion=motion, compliance=give, **OPTIONS).params(x)
    moved = 0.0
    for name, value in wanted.tensors().items():
        # What slides a little has a direction that rounding turns.
        torch.testing.assert_close(found.tensors()[name].detach(), value, rtol=1e-3, atol=1e-3)
        moved += float((value - before.tensors()[name]).abs().sum().detach())
    assert moved > 1e-4


@pytest.mark.parametrize(("motion", "tolerance"), [("dynamic", 0.02), ("quasi-dynamic", 1e-4)])
def test_gradients_are_slopes_of_the_matrices(motion, tolerance):
    learn = [("mass", "cube"), ("friction", "block"), ("size", "tip"), ("center_of_mass", "cube"), "gain", "compliance"]
    learned = LearnableMujocoLCS(scene(), learn=learn, motion=motion, **OPTIONS | {"caps": 0})  # loads of corners bend
    x, ctrl = states(learned.n_x, seed=1)[:1].requires_grad_(), torch.full((1,), 0.01, dtype=F64, requires_grad=True)
    generator = torch.Generator().manual_seed(1)
    weights = {k: torch.randn(v.shape, generator=generator, dtype=F64) for k, v in learned.params(x).tensors().items()}

    def total(change, x, ctrl):
        with torch.no_grad():
            learned.change.copy_(change)
        return sum((weights[name] * v).sum() for name, v in learned.params(x, ctrl).tensors().items())

    inputs = (torch.full_like(learned.change, 0.1).detach(), x.detach(), ctrl.detach())
    total(inputs[0], x, ctrl).backward()
    for k, gradient in enumerate((learned.change.grad, x.grad, ctrl.grad)):
        ways = torch.eye(inputs[k].numel(), dtype=F64).reshape(-1, *inputs[k].shape) * 1e-4
        moved = ([v + way * sign if i == k else v for i, v in enumerate(inputs)] for way in ways for sign in (1, -1))
        with torch.no_grad():
            ends = torch.tensor([float(total(*at)) for at in moved], dtype=F64)
        slopes = ((ends[::2] - ends[1::2]) / 2e-4).reshape(gradient.shape)
        torch.testing.assert_close(gradient, slopes, rtol=tolerance, atol=1e-9 + tolerance * float(slopes.abs().max()))


@pytest.mark.parametrize(("motion", "seconds", "error"), [("dynamic", 0.02, 1e-3), ("quasi-dynamic", 0.1, 0.05)])
def test_numbers_are_identified_by_mujocos_own_steps(motion, seconds, error):
    """A finger pushes the cube over the floor."""
    options, random = OPTIONS | {"motion": motion, "seconds": seconds}, np.random.default_rng(0)
    learn = ["compliance", "gain", ("mass", "cube")][: 3 if motion == "dynamic" else 2]  # else it slides on
    learned = LearnableMujocoLCS(model := scene(), learn=learn, **options)
    with torch.no_grad():
        learned.change.copy_(torch.tensor([0.1, -0.7, 0.7])[: len(learn)])
    data, x, u = mujoco.MjData(model), [], []
    for k in range(41):
        x.append(learned.state.to_state(data.qpos, data.qvel))
        data.ctrl[:] = random.uniform(0.0, 0.2) if k % 4 == 0 else data.ctrl
        u.append(torch.from_numpy(data.ctrl - data.qpos[7:]))
        mujoco.mj_step(model, data, round(500 * seconds))
    x, u = torch.stack(x).unfold(0, 4, 1).mT, torch.stack(u[:-1]).unfold(0, 3, 1).mT
    losses = identify(learned, x, u)
    assert losses[-1] < losses[0]
    assert learned.change.tolist() == pytest.approx([0.1, 0.0, 0.0][: len(learn)], abs=error)
    refuse(ShapeError, "x: expected shape .* one state more", identify, learned, x[..., 1:, :], u)
    refuse(ShapeError, "x, u: expected the same batch of one motion or more", identify, learned, x[1:], u)
    refuse(DTypeError, "module: expected LearnableMujocoLCS", identify, learned.physics, x, u)
    still = LearnableMujocoLCS(model, learn=[("torsional_friction", "block"), ("friction", "floor")], **options)
    still.change.data[1] = 2.0  # more than that of the block, and so too much; below that it has no effect
    with pytest.warns(ContactWarning, match="not depend on torsional_friction block, friction floor near"):
        identify(still, x, u)


def test_a_plan_has_a_gradient():
    learned = LearnableMujocoLCS(scene(), learn=["gain", ("mass", "cube")], motion="quasi-dynamic", **OPTIONS)
    cost = GoalCost.reach(7, 1, goal_weight=(100.0,), input_weight=0.1)
    mpc = LCSMPCLayer(learned, cost, 3, -0.1, 0.1)
    x, goal = states(7)[:2], torch.tensor([0.05], dtype=F64)
    mpc(x, goal).u.sum().backward()
    ends = []
    for sign in (1, -1):
        with torch.no_grad():
            learned.change.copy_(torch.tensor([2e-4 * sign, 0.0]))
            ends.append(float(mpc(x, goal).u.sum()))
    assert learned.change.grad[0] == pytest.approx((ends[0] - ends[1]) / 4e-4, rel=1e-2)


def test_it_counts_rotations_from_where_things_are():
    learned = LearnableMujocoLCS(scene(), learn=["gain"], motion="quasi-dynamic", **OPTIONS)
    data = mujoco.MjData(scene())
    data.qpos[3:7], data.xfrc_applied[1, 2] = [0.6, 0.8, 0.0, 0.0], 1.0
    x = learned.observe(data)
    assert x[3:6].abs().max() == 0
    before = learned.params(x).d
    with torch.no_grad():
        learned.change.fill_(1e-12)  # another model, with what was observed
    torch.testing.assert_close(learned.params(x).d.detach(), before.detach())


@pytest.mark.parametrize("value", [-800.0, 800.0, math.nan])
def test_logarithms_without_a_factor_are_refused(value):
    learned = LearnableMujocoLCS(scene(), learn=[("mass", "finger")], motion="quasi-dynamic", **OPTIONS)
    learned.change.data.fill_(value)
    refuse(InvalidInputError, f"change: .*{value}. of mass finger", learned.params, states(learned.n_x))


@pytest.mark.parametrize(
    ("learn", "message"),
    [
        ("mass", "expected kinds or pairs"),
        ([], "expected kinds or pairs"),
        (["mass", ("mass", "*")], "each once"),
        ([("mass", None)], "expected kinds or pairs"),  # MuJoCo ends the process where it is asked for such a name
        (["masses"], "did you mean"),
        ([("mass", "sphere")], "name of a body with a mass"),
        ([("size", "floor")], "name of a geom with a size"),
        ([("center_of_mass", "*")], "simple"),
    ],
)
def test_what_cannot_be_learned_is_refused(learn, message):
    refuse(InvalidInputError, message, LearnableMujocoLCS, scene(), learn=learn, motion="dynamic")
    refuse(InvalidInputError, "no friction=", LearnableMujocoLCS, scene(), learn=["friction"], friction=0.3)


def saved(value):
    torch.save(value, file := io.BytesIO())
    return torch.load(io.BytesIO(file.getvalue()), weights_only=False)


@pytest.mark.parametrize("motion", ["dynamic", "quasi-dynamic"])
@pytest.mark.parametrize("again", [copy.deepcopy, saved])
def test_a_copy_is_the_same_system_and_knows_nothing_of_the_first_one(motion, again):
    module = LearnableMujocoLCS(scene(), learn=["friction"], motion=motion, **OPTIONS)
    with torch.no_grad():
        module.change.add_(0.1)
    data = mujoco.MjData(scene())
    data.qpos[:], data.xfrc_applied[:, 0] = [0.01, 0, 0.05, 1, 0.1, 0, 0, 0.001], 0.3
    for system in (module, module.physics):
        x = system.observe(data) + 0.001
        other = again(system)
        expected = system.params(x).tensors()
        torch.testing.assert_close(other.params(x).tensors(), expected, rtol=0, atol=0)
        other.observe(mujoco.MjData(scene()))
        torch.testing.assert_close(system.params(x).tensors(), expected, rtol=0, atol=0)


def test_transforms_of_torch_func_map_what_is_learned_and_are_refused_by_fixed_physics():
    module = LearnableMujocoLCS(scene(), learn=["mass"], motion="dynamic", **OPTIONS)
    x = states(module.n_x)
    torch.testing.assert_close(torch.vmap(lambda v: module.params(v).A)(x), module.params(x).A)
    for ask in (module.physics.params, module.action_bounds):
        refuse(InvalidInputError, "inside a transform", torch.vmap(ask), x)
    cost, goal = MujocoCost(module.physics, [Posture(["push"])]), torch.zeros(2, 1).double()
    for where in (torch.func.vmap(cost.at, (None, 0)), torch.func.grad(lambda x, to: cost.at(x, to).q.sum(), 1)):
        refuse(InvalidInputError, "inside a transform", where, x[0], goal)
    refuse(InvalidInputError, "inside a transform", torch.func.grad(lambda to: module.physics.params(x).d.sum()), goal)
    fixed = MujocoLCS(scene(), motion="dynamic", **OPTIONS)  # what is not mapped has numbers
    torch.testing.assert_close(torch.vmap(lambda to: fixed.params(x[0]).d + to)(goal)[0], fixed.params(x[0]).d)
