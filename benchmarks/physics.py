"""Systems made from known physics, against the simulators they stand for: `python benchmarks/physics.py [--smoke]`.

For every system and mode: how long it takes to make the LCS of one state, in a batch, on one core; and how far its
prediction of one step of 0.1 s is from what the simulator does in many small ones, from the same states and actions.
The error is that of the coordinates named, root mean square over the states, beside how far they moved: a prediction
that nothing moves has an error of 100 %. The exact LCP is solved, without relaxation.
The times of larger models are those of physics_models.py.
"""

from __future__ import annotations

import importlib.util
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs import LCSParams
from difflcs.cli.bench import machine, save
from difflcs.errors import FrictionWarning
from difflcs.physics.mujoco import MujocoLCS

SECONDS = 0.1  # of a step


@dataclass
class Options:
    """Time and one-step error of systems from physics."""

    states: int = 400
    """States for the errors."""
    batch: int = 100
    """States of a call that is timed."""
    repeats: int = 30
    """Calls that are timed; the median counts."""
    seed: int = 0
    """Seed of states and actions."""
    out: Path = Path("benchmarks/results/physics.json")
    """Path of the JSON output."""
    smoke: bool = False
    """A few states only."""


@dataclass
class Case:
    """One system in one mode.

    Attributes:
        system: what it is.
        mode: how it is modelled.
        params: states (n, n_x) to the systems there.
        x: (n, n_x) states.
        u: (n, n_u) actions.
        after: (n, n_x) states of the simulator one step later.
        coordinates: what is compared, name → (numbers in the state, unit in which errors are told, its size).
    """

    system: str
    mode: str
    params: Callable[[Tensor], LCSParams]
    x: Tensor
    u: Tensor
    after: Tensor
    coordinates: dict[str, tuple[list[int], str, float]]


PUSHER = """
<mujoco><option timestep="0.0005" integrator="implicitfast" cone="elliptic"/>{contact}
<worldbody>
  <geom type="plane" size="2 2 .1" friction=".4"/>
  <body name="box" pos="0 0 .05">{joints}<geom type="box" size=".05 .05 .05" mass=".5" friction=".4"/></body>
  <body name="pusher" pos="0 0 .05">
    <joint name="px" type="slide" axis="1 0 0"/><joint name="py" type="slide" axis="0 1 0"/>
    <geom type="sphere" size=".015" mass=".2" friction=".4"/></body>
</worldbody>
<actuator><position joint="px" kp="{kp}" dampratio="1"/><position joint="py" kp="{kp}" dampratio="1"/></actuator>
</mujoco>"""
PLANAR = """<joint name="x" type="slide" axis="1 0 0" damping="{damping}"/>
  <joint name="y" type="slide" axis="0 1 0" damping="{damping}"/>
  <joint name="yaw" type="hinge" axis="0 0 1" damping="{of_yaw}"/>"""
CART_POLE = """
<mujoco><option timestep="0.001" integrator="RK4"/>
<worldbody><body><joint name="cart" type="slide" axis="1 0 0" damping=".1"/>
  <geom type="box" size=".1 .05 .05" mass="1"/>
  <body><joint name="pole" type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 .6" size=".02" mass=".1"/></body>
</body></worldbody>
<actuator><motor joint="cart"/></actuator></mujoco>"""
BOX = """
<mujoco><option timestep="0.001" integrator="implicitfast" cone="elliptic"/>
<worldbody><geom type="plane" size="2 2 .1" friction=".4"/>
  <body pos="0 0 .05"><freejoint name="box"/><geom type="box" size=".05 .05 .05" mass=".5" friction=".4"/></body>
</worldbody></mujoco>"""


def simulated(model: Any, qpos: Any, qvel: Any, ctrl: Any, start: Any = None) -> tuple[Any, Any]:
    """Step each state in MuJoCo; with `start`, controls go from there to `ctrl` in 80 % of the step."""
    data, steps = mujoco.MjData(model), round(SECONDS / model.opt.timestep)
    places, speeds = np.empty_like(qpos), np.empty_like(qvel)
    for i in range(len(qpos)):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[i], qvel[i], ctrl[i]
        for k in range(steps):
            if start is not None:
                data.ctrl[:] = start[i] + min(1.0, (k + 1) / (0.8 * steps)) * (ctrl[i] - start[i])
            mujoco.mj_step(model, data)
        places[i], speeds[i] = data.qpos, data.qvel
    return places, speeds


def of_mujoco(
    system: str,
    mode: str,
    module: MujocoLCS,
    model: Any,
    qpos: Any,
    qvel: Any,
    u: Tensor,
    coordinates: dict,
    slowly: bool = False,
) -> Case:
    """Make a case of a MuJoCo model, whose names of coordinates are those of `MujocoState`."""
    x = module.state.to_state(qpos, qvel)
    ctrl, start = (module.control(x, v).numpy() for v in (u, 0 * u))
    after = module.state.to_state(*simulated(model, qpos, qvel, ctrl, start if slowly else None))
    found = {
        label: ([module.state.index(name) for name in names], unit, size)
        for label, (names, unit, size) in coordinates.items()
        if all(name in module.state.names for name in names)
    }
    return Case(system, mode, module.params, x, u, after, found)


PLACE = {"position": (["x", "y"], "mm", 1e-3), "yaw": (["yaw"], "rad", 1.0)}
PLACE_FREE = {"position": (["box_x", "box_y"], "mm", 1e-3), "yaw": (["box_rz"], "rad", 1.0)}
SPEED = {"velocity": (["x_velocity", "y_velocity"], "mm/s", 1e-3)}

HARD = """<option impratio="100"/>
<default><geom solref=".002 1" solimp=".99 .999 .001 .5 2"/></default>"""
# Damping [N s/m], stiffness of the servos [N/m], contacts, whether the servos' target moves to its place at constant
# speed or jumps there, and the largest gap at the start [m].
PLANAR_BOXES = {
    "pusher and box, slow, in contact": (200, 100000, HARD, True, 1e-4),
    "pusher and box, slow": (200, 100000, HARD, True, 0.02),
    "pusher and box that coasts": (5, 1000, "", False, 0.02),
}


def around_the_box(count: int, random: np.random.Generator, gap: float = 0.02) -> tuple[Any, Any, Tensor]:
    """Draw the box's pose (n, 3), the pusher's place beside it, and pushes (n, 2) of 1 to 4 cm towards it."""
    pose = random.uniform(-1, 1, (count, 3)) * [0.1, 0.1, 1.0]
    side, along = random.integers(0, 4, count) * np.pi / 2, random.uniform(-0.025, 0.025, count)
    away = 0.05 + 0.015 + random.uniform(0.0, gap, count)
    direction = pose[:, 2] + side
    normal = np.stack([np.cos(direction), np.sin(direction)], -1)
    tangent = np.stack([-np.sin(direction), np.cos(direction)], -1)
    pusher = pose[:, :2] + away[:, None] * normal + along[:, None] * tangent
    towards = direction + np.pi + random.uniform(-0.5, 0.5, count)
    u = random.uniform(0.01, 0.04, (count, 1)) * np.stack([np.cos(towards), np.sin(towards)], -1)
    return pose, pusher, torch.from_numpy(u)


def pushing(count: int, random: np.random.Generator) -> list[Case]:
    """Make a sphere that pushes a box: on joints in the plane with damping, or free on a floor with friction."""
    cases = []
    for system, (damping, stiffness, contact, slowly, gap) in PLANAR_BOXES.items():
        pose, pusher, u = around_the_box(count, random, gap)
        qpos, rest = np.concatenate([pose, pusher], -1), np.zeros((count, 5))
        joints = PLANAR.format(damping=damping, of_yaw=0.0014 * damping)
        model = mujoco.MjModel.from_xml_string(PUSHER.format(joints=joints, kp=stiffness, contact=contact))
        modes = {"quasi-static": MujocoLCS(model, mobility="damping")}
        if not slowly:
            modes["velocities"] = MujocoLCS(model, motion="dynamic")
        for mode, module in modes.items():
            cases.append(of_mujoco(system, mode, module, model, qpos, rest, u, PLACE | SPEED, slowly))
    pose, pusher, u = around_the_box(count, random)
    model = mujoco.MjModel.from_xml_string(PUSHER.format(joints='<freejoint name="box"/>', kp=1000, contact=""))
    turn = np.stack([np.cos(pose[:, 2] / 2), *np.zeros((2, count)), np.sin(pose[:, 2] / 2)], -1)
    # As deep in the floor as it is at rest.
    qpos = np.concatenate([pose[:, :2], np.full((count, 1), settled(model)), turn, pusher], -1)
    rest = np.zeros((count, 8))
    flat = [1.0, 1.0, 0.0, 0.0, 0.0, 1 / 0.038**2, 0.0, 0.0]  # with the radius of gyration of a square
    for mode, module in {
        "quasi-static": MujocoLCS(model, mobility=flat, contacts=1, pairs=[("box", "pusher")]),
        "velocities": MujocoLCS(model, motion="dynamic", contacts=5),
    }.items():
        cases.append(of_mujoco("pusher and box on a floor", mode, module, model, qpos, rest, u, PLACE_FREE))
    return cases


def settled(model: Any) -> float:
    """Compute the height of the box at rest."""
    data = mujoco.MjData(model)
    data.qpos[7:], data.ctrl[:] = 0.5, 0.5  # the pusher, out of the way
    for _ in range(1000):
        mujoco.mj_step(model, data)
    return float(data.qpos[2])


def cart_pole(count: int, random: np.random.Generator) -> list[Case]:
    """Make a cart-pole without contact: the cost of linearisation and step alone."""
    model = mujoco.MjModel.from_xml_string(CART_POLE)
    qpos, qvel = random.uniform(-1, 1, (count, 2)) * [1.0, 0.5], random.uniform(-1, 1, (count, 2)) * [1.0, 1.0]
    u = torch.from_numpy(random.uniform(-5, 5, (count, 1)))
    names = {
        "cart": (["cart"], "mm", 1e-3),
        "pole": (["pole"], "rad", 1.0),
        "pole velocity": (["pole_velocity"], "rad/s", 1.0),
    }
    module = MujocoLCS(model, motion="dynamic", pairs=[])
    return [of_mujoco("cart-pole, no contact", "velocities", module, model, qpos, qvel, u, names)]


def boxes(count: int, random: np.random.Generator) -> list[Case]:
    """Make a box that falls and turns in the air, and one that slides on the floor."""
    model = mujoco.MjModel.from_xml_string(BOX)
    names = {
        "position": (["box_x", "box_y", "box_z"], "mm", 1e-3),
        "velocity": (["box_x_velocity", "box_y_velocity", "box_z_velocity"], "mm/s", 1e-3),
    }
    turn = random.normal(size=(count, 4))
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    falling = np.concatenate([random.uniform(-0.2, 0.2, (count, 2)), random.uniform(0.25, 0.5, (count, 1)), turn], -1)
    flight = random.normal(size=(count, 6)) * [0.3, 0.3, 0.3, 1, 1, 1]
    yaw = random.uniform(-np.pi, np.pi, count) / 2
    upright = np.stack([np.cos(yaw), *np.zeros((2, count)), np.sin(yaw)], -1)
    sliding = np.concatenate([random.uniform(-0.2, 0.2, (count, 2)), np.full((count, 1), settled(model)), upright], -1)
    heading = random.uniform(-np.pi, np.pi, count)
    speed = random.uniform(0.5, 1.0, count)
    slide = np.zeros((count, 6))
    slide[:, 0], slide[:, 1] = speed * np.cos(heading), speed * np.sin(heading)
    u, cases = torch.zeros(count, 0, dtype=torch.float64), []
    for system, qpos, qvel in (("box in the air", falling, flight), ("box sliding on a floor", sliding, slide)):
        for mode, cone in {"velocities": "anitescu", "velocities, Stewart-Trinkle": "stewart-trinkle"}.items():
            module = MujocoLCS(model, motion="dynamic", cone=cone, contacts=4)
            cases.append(of_mujoco(system, mode, module, model, qpos, qvel, u, names))
    return cases


def median_time(repeats: int, call: Callable[..., Any], *arguments: Any) -> float:
    """Processor time of a call [s], the median; three at once, as a clock has its time too."""
    used = []
    for _ in range(repeats + 1):
        start = time.process_time()
        for _ in range(3):
            call(*arguments)
        used.append((time.process_time() - start) / 3)
    return float(np.median(used[1:]))


@torch.no_grad()
def measure(case: Case, o: Options) -> dict[str, Any]:
    """Time of a state, and errors."""
    batch = case.x[: o.batch]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FrictionWarning)  # the table shows what it says
        seconds = median_time(o.repeats, case.params, batch) / len(batch)
        system = case.params(case.x)
    predicted = system.step(case.x, case.u).x_next
    errors = {}
    for name, (numbers, unit, size) in case.coordinates.items():
        error = (predicted - case.after)[:, numbers].square().sum(-1).mean().sqrt() / size
        moved = (case.x - case.after)[:, numbers].square().sum(-1).mean().sqrt() / size
        errors[name] = {"error": float(error), "moved": float(moved), "unit": unit}
    return {"ms a state": 1e3 * seconds, "n_lam": system.n_lam, "states": len(case.x), **errors}


def planar(count: int, random: np.random.Generator) -> list[Case]:
    """Make bodies in the plane, if pymunk is installed, which the scoreboard's Push-T needs."""
    if importlib.util.find_spec("pymunk") is None:
        print("T and disc: left out, as pymunk is not installed")
        return []
    import physics_pymunk

    return [Case(**fields) for fields in physics_pymunk.cases(count, random)]


CASES: list[Callable[[int, np.random.Generator], list[Case]]] = [pushing, cart_pole, boxes, planar]


def main(o: Options) -> None:
    """Measure, print, write."""
    if o.smoke:
        o.states, o.batch, o.repeats = 20, 10, 2
    torch.set_num_threads(1)
    results: dict[str, dict[str, Any]] = {}
    for make in CASES:
        for case in make(o.states, np.random.default_rng(o.seed)):
            row = results.setdefault(case.system, {})[case.mode] = measure(case, o)
            told = "   ".join(
                f"{name} {v['error']:.3g} of {v['moved']:.3g} {v['unit']}"
                for name, v in row.items()
                if isinstance(v, dict)
            )
            print(f"{case.system:32s} {case.mode:31s} {row['ms a state']:.3f} ms, n_lam {row['n_lam']:2d}   {told}")
    options = {"states": o.states, "batch": o.batch, "seed": o.seed, "seconds": SECONDS}
    save(o.out, {"machine": {**machine(), "mujoco": mujoco.__version__}, "options": options, "results": results})


if __name__ == "__main__":
    main(tyro.cli(Options))
