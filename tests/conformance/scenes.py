"""Random small MuJoCo scenes: one step of `MujocoLCS` against MuJoCo's, judged by what doing nothing would give.

Trees of bodies with all kinds of joints, shapes, limits, friction, actuators, tendons and equality constraints, from
millimetres to metres, move at random for a while; then comes one step with a random action. A fault is silent where
the system is made without an error or a warning, and is not finite, or its velocity is farther from MuJoCo's than the
velocity before the step: by more than a tolerance, in the norm of kinetic energy. An exception that is none of the
library's counts as well.

python -m tests.conformance.scenes --count 20000 --out scenes.jsonl
"""

import argparse
import copy
import json
import os
import warnings
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch

from difflcs.errors import ContactWarning, DiffLCSError
from difflcs.physics.mujoco import MujocoLCS

TOLERANCE = 0.5  # of the speed before and of what forces do to it, what an impact within the step may cost
CREEP = 0.01  # [m/s, rad/s]: soft constraints creep, so half of this is no fault
FAR = 0.5  # motion in a step [m, rad], beyond which nothing about it is linear
JOINTS = ("free", "slide", "hinge", "hinge", "ball")
SHAPES = ("sphere", "capsule", "box", "cylinder", "ellipsoid", "mesh")
FLAGS = ("eulerdamp", "refsafe", "filterparent", "gravity", "limit", "frictionloss", "spring", "damper", "equality")
NEWER = ["discrete"] if hasattr(mujoco.mjtIntegrator, "mjINT_DISCRETE") else []


class Writer:
    """Random pieces of MJCF, and the names of those written so far."""

    def __init__(self, random: np.random.Generator):
        self.random = random
        self.names, self.scalar = [], []  # joints: all, and those of one degree of freedom
        self.bodies, self.geoms = 0, []  # how many bodies; kinds of geoms
        self.size = (
            10 ** random.uniform(-1.5, 1.5) if random.random() < 0.15 else 1.0
        )  # [m] of what elsewhere has one metre

    def maybe(self, chance: float, text: str) -> str:
        """The text, or nothing."""
        return text if self.random.random() < chance else ""

    def log(self, low: float, high: float) -> str:
        """A number between powers of ten."""
        return f"{10 ** self.random.uniform(low, high):.4g}"

    def vector(self, scale: float, size: int = 3) -> str:
        """Numbers about zero."""
        return " ".join(f"{v:.4g}" for v in self.random.normal(size=size) * scale)

    def place(self, scale: float) -> str:
        """A position about zero, and sometimes an orientation."""
        return f'pos="{self.vector(scale * self.size)}"' + self.maybe(0.3, f' euler="{self.vector(1)}"')

    def range(self, scale: float) -> str:
        """Two numbers, the lower one first, on both sides of zero."""
        return f"{-scale * self.random.uniform(0.2, 1):.4g} {scale * self.random.uniform(0.2, 1):.4g}"

    def soft(self, chance: float, of: str = "") -> str:
        """Sometimes how soft a constraint is; `of` ends the names of attributes where MJCF has several."""
        time, width = self.random.choice(["0.005 0.5", "0.05 1", "0.1 1", "-1000 -20", "-300 -5"]), self.log(-4, -2)
        impedance = f' solimp{of}="{self.random.uniform(0, 0.9):.2g} {self.random.uniform(0.9, 0.99):.3g} {width}"'
        return self.maybe(chance, f' solref{of}="{time}"') + self.maybe(chance / 2, impedance)

    def joint(self, free: bool) -> str:
        """A joint with some of all that it may have."""
        name = f"j{len(self.names)}"
        kind = self.random.choice(JOINTS if free else JOINTS[1:])
        self.names.append(name)
        if kind == "free":
            return f'<joint name="{name}" type="free"' + self.maybe(0.1, ' damping=".1" frictionloss=".05"') + "/>"
        length = self.size if kind == "slide" else 1.0
        text = f'<joint name="{name}" type="{kind}" axis="{self.vector(1)}"'
        text += self.maybe(0.5, f' damping="{self.log(-3, 0.5)}"') + self.maybe(0.2, f' armature="{self.log(-3, -1)}"')
        text += self.maybe(0.2, f' stiffness="{self.log(-1, 2)}"' + self.maybe(0.3, f' springref="{0.2 * length:.4g}"'))
        text += self.maybe(0.3, f' frictionloss="{self.log(-2, 0.5)}"' + self.soft(0.2, "friction"))
        text += self.maybe(0.2, f' pos="{self.vector(0.03 * self.size)}"')
        limit = self.soft(0.2, "limit") + self.maybe(0.2, f' margin="{0.01 * length:.4g}"')
        if kind != "ball":
            self.scalar.append(name)
            reach = self.range(length * (0.5 if kind == "hinge" else 0.1))
            text += self.maybe(0.4, f' limited="true" range="{reach}"{limit}')
            text += self.maybe(0.1, f' actuatorfrcrange="{self.range(5)}"')
            text += self.maybe(0.1, f' ref="{0.1 * length:.4g}"')
        else:
            text += self.maybe(0.3, f' limited="true" range="0 {self.random.uniform(0.3, 1.5):.3g}"{limit}')
        return text + "/>"

    def geom(self) -> str:
        """A geom of some centimetres times the size of the scene."""
        size = " ".join(f"{v:.4g}" for v in self.random.uniform(0.02, 0.08, 3) * self.size)
        kind, mass = self.random.choice(SHAPES), 10 ** self.random.uniform(-1.5, 0.3) * min(self.size, 1.0) ** 2
        of = f'mesh="m{self.random.integers(2)}"' if kind == "mesh" else f'size="{size}"'
        text = f'<geom name="g{len(self.geoms)}" type="{kind}" {of} {self.place(0.03)} mass="{mass:.4g}"'
        self.geoms.append(kind)
        text += f' friction="{self.random.uniform(0, 1.2):.3g}"' + self.soft(0.15)
        text += self.maybe(0.2, f' condim="{self.random.choice([1, 4, 6])}"') + self.maybe(0.05, ' priority="1"')
        far = f'="{0.01 * self.size:.4g}"'
        text += self.maybe(0.1, f" margin{far}") + self.maybe(0.05, f" gap{far}")
        text += self.maybe(0.1, f' contype="{self.random.integers(4)}" conaffinity="{self.random.integers(4)}"')
        text += self.maybe(0.01, f' adhesion="{self.log(-1, 1)}"') + self.maybe(0.01, ' surfacevel=".3 0 0 0 0 1"')
        return text + "/>"

    def body(self, depth: int) -> str:
        """A body and those that hang on it."""
        place = f'pos="{self.vector(0.15 * self.size, 2)} {self.random.uniform(0.05, 0.3) * self.size:.3g}"'
        place = self.place(0.12) if depth else place + self.maybe(0.3, f' euler="{self.vector(1)}"')
        name, self.bodies = f"b{self.bodies}", self.bodies + 1
        joints, least = self.joint(free=not depth), 1e-5 * self.size**2
        while "free" not in joints and "ball" not in joints and self.random.random() < 0.2:
            joints += self.joint(free=False).replace("ball", "hinge")
        text = f'<body name="{name}" {place}' + self.maybe(0.1, f' gravcomp="{self.random.choice([0.5, 1, 2])}"') + ">"
        shapes = "".join(self.geom() for _ in range(1 + (self.random.random() < 0.2)))
        text += f'{joints}{shapes}<site name="{name}" {self.place(0.05)}/>'
        text += self.maybe(0.05, f'<inertial pos="0 0 0" mass=".1" diaginertia="{least} {100 * least} {100 * least}"/>')
        if depth < 3 and self.random.random() < 0.5:
            text += self.body(depth + 1)
        return text + "</body>"

    def actuator(self, at: str) -> str:
        """Any kind of actuator; `at` says on which joint, tendon or site."""
        gain = self.log(-1, 1.5)
        text = self.random.choice([
            f"<motor {at}", f'<position {at} kp="{gain}" kv="{self.log(-1, 1)}"', f'<position {at} kp="{gain}"',
            f'<position {at} kp="{gain}" dampratio="1" timeconst="{self.log(-2.5, -1)}"',
            f'<velocity {at} kv="{self.log(-1, 1)}"', f'<damper {at} kv="1" ctrlrange="0 2"',
            f'<intvelocity {at} kp="{gain}" actrange="-1 1"', f'<muscle {at} force="{gain}" lengthrange="-1 1"',
            f'<cylinder {at} timeconst="{self.log(-2.5, 0)}" area="{gain}"',
            f'<general {at} gainprm="{gain}" biastype="affine" biasprm="{self.vector(1)[:5]} -{gain} -1"',
            f'<general {at} dyntype="filterexact" dynprm="{self.log(-2, 0)}" gainprm="{gain}" actearly="true"',
        ])  # fmt: skip
        if "damper" not in text and "muscle" not in text:
            text += self.maybe(0.4, f' ctrllimited="true" ctrlrange="{self.range(1)}"')
        text += self.maybe(0.1 * ("gear" not in at), f' gear="{self.vector(1, 6)}"')
        return text + self.maybe(0.3, f' forcelimited="true" forcerange="{self.range(10)}"') + "/>"

    def actuators(self, tendon: str) -> str:
        """Actuators on joints, sometimes more than one, on balls, sites and tendons."""
        random, every = self.random, [name for name in self.names if name not in self.scalar]
        at = [f'joint="{name}"' for name in self.scalar for _ in range(2) if random.random() < 0.35]
        at += [f'jointinparent="{name}" gear="{self.vector(1)}"' for name in every if random.random() < 0.1]
        one, two = (f"b{k}" for k in random.integers(0, self.bodies, 2))
        at += [f'site="{one}" gear="{self.vector(1, 6)}"'] * (random.random() < 0.1)
        at += [f'site="{one}" refsite="{two}" gear="{self.vector(1, 6)}"'] * (random.random() < 0.05)
        crank = f'cranksite="{one}" slidersite="{two}" cranklength="{0.5 * self.size:.4g}"'
        at += [crank] * (random.random() < 0.03) + ['tendon="t"'] * (bool(tendon) and random.random() < 0.5)
        return "".join(self.actuator(place) for place in at)

    def tendon(self) -> str:
        """A fixed tendon, or one from site to site and round a geom."""
        spatial = self.random.random() < 0.5
        if (not spatial and len(self.scalar) < 2) or self.bodies < 2:
            return ""
        reach = f"0 {self.random.uniform(0.1, 0.6) * self.size:.4g}" if spatial else self.range(0.3)
        own = self.maybe(0.5, f' limited="true" range="{reach}"' + self.soft(0.2, "limit"))
        own += self.maybe(0.2, ' frictionloss=".3"') + self.maybe(0.3, f' stiffness="{self.log(0, 2)}"')
        own += self.maybe(0.3, ' damping=".1"') + self.maybe(0.1, ' armature=".01"')
        if not spatial:
            joints = "".join(f'<joint joint="{name}" coef="{self.vector(1, 1)}"/>' for name in self.scalar[:2])
            return f'<tendon><fixed name="t"{own}>{joints}</fixed></tendon>'
        sites = [f'<site site="b{k}"/>' for k in self.random.permutation(self.bodies)[:3]]
        round_ = [f'<geom geom="g{k}"/>' for k, kind in enumerate(self.geoms) if kind in ("sphere", "cylinder")]
        sites[1:1] = [str(self.random.choice(round_))] if round_ and self.random.random() < 0.5 else []
        return f'<tendon><spatial name="t"{own}>{"".join(sites)}</spatial></tendon>'

    def equality(self, tendon: str) -> str:
        """A constraint between two joints or bodies."""
        one, two = (f"b{k}" for k in self.random.integers(0, self.bodies, 2))
        soft, off = self.soft(0.3), self.maybe(0.2, 'active="false"')
        other = self.maybe(0.5 * (one != two), f'body2="{two}"')
        kinds = [f'<weld body1="{one}" {other} {soft} {off}/>']
        kinds.append(f'<connect body1="{one}" {other} anchor="{self.vector(0.05 * self.size)}" {soft} {off}/>')
        kinds += [f'<connect site1="{one}" site2="{two}" {soft} {off}/>'] * (one != two)
        if len(self.scalar) > 1:
            pair = self.random.choice(self.scalar, 2, replace=False)
            curve = f'polycoef="0 {self.vector(1, 1)} {self.vector(0.3, 1)} 0 0"'
            kinds.append(f'<joint joint1="{pair[0]}" joint2="{pair[1]}" {curve} {soft} {off}/>')
        kinds += [f'<tendon tendon1="t" {soft} {off}/>'] * bool(tendon)
        return str(self.random.choice(kinds))

    def contact(self) -> str:
        """Pairs of geoms that touch in their own way, or bodies that do not."""
        one, two = (int(k) for k in self.random.permutation(len(self.geoms))[:2])
        pair = f'<pair geom1="g{one}" geom2="g{two}" condim="{self.random.choice([1, 3, 4])}"{self.soft(0.3)}'
        pair += self.maybe(0.3, f' margin="{0.01 * self.size:.4g}"') + self.maybe(0.3, ' friction=".5 .5 .01 0 0"')
        return self.maybe(0.5, pair + "/>") + self.maybe(0.5 * (self.bodies > 1), '<exclude body1="b0" body2="b1"/>')

    def scene(self) -> str:
        """The MJCF of a whole scene."""
        random, tilt = self.random, self.maybe(0.2, ' euler="0.3 0 0"')
        world = self.maybe(0.7, f'<geom type="plane" size="3 3 .1" friction="{random.uniform(0, 1.2):.3g}"{tilt}/>')
        world += (hills := self.maybe(0.01, '<geom type="hfield" hfield="h" pos="0 0 -.2"/>'))
        bodies = "".join(self.body(0) for _ in range(random.integers(1, 4)))
        tendon = self.maybe(0.3, self.tendon())
        drives, contact = self.actuators(tendon), self.maybe(0.15, self.contact() if len(self.geoms) > 1 else "")
        held = self.maybe(0.25, self.equality(tendon) + self.maybe(0.2, self.equality(tendon)))
        grip = f'<body name="m" mocap="true" {self.place(0.2)}>{self.geom()}</body>' if random.random() < 0.05 else ""
        held += '<weld body1="m" body2="b0"/>' * bool(grip)
        points = (self.vector(0.04 * self.size, 24) for _ in range(2))
        assets = "".join(f'<mesh name="m{k}" vertex="{vertex}"/>' for k, vertex in enumerate(points))
        assets += '<hfield name="h" nrow="2" ncol="2" size="3 3 .1 .1" elevation="0 1 0 1"/>' * bool(hills)
        step, cone = random.choice([0.001, 0.002, 0.005]), random.choice(["pyramidal", "elliptic"])
        integrator = random.choice(["Euler", "implicit", "implicitfast", "RK4", *NEWER])
        options = f'timestep="{step}" integrator="{integrator}" cone="{cone}"' + self.maybe(0.1, ' impratio="10"')
        options += self.maybe(0.2, ' gravity="0 0 0"') + self.maybe(0.1, ' density="1000" viscosity=".01"')
        flag = self.maybe(0.15, f'{random.choice(FLAGS)}="disable"') + self.maybe(0.02, ' override="enable"')
        return (
            f'<mujoco><compiler angle="radian"/><option {options}><flag {flag}/></option><asset>{assets}</asset>'
            f"<worldbody>{world}{grip}{bodies}</worldbody>{tendon}<actuator>{drives}</actuator>"
            f"<contact>{contact}</contact><equality>{held}</equality></mujoco>"
        )


class Judged(NamedTuple):
    """A scene: what became of it, and the error beside that of doing nothing [√J]."""

    outcome: str
    error: float
    nothing: float
    scale: float

    def off(self) -> bool:
        """Whether the velocity is farther from MuJoCo's than it may be."""
        return not self.error <= self.nothing + TOLERANCE * self.scale

    def wrong(self) -> bool:
        """Whether a fault is silent."""
        return self.outcome not in ("refused", "warned") and (self.outcome != "made" or self.off())


def random_scene(seed: int) -> tuple[Any, Any, np.random.Generator] | None:
    """A model and its data after a random motion; None where there is no such scene, or its simulation diverges."""
    random = np.random.default_rng(seed)
    try:
        model = mujoco.MjModel.from_xml_string(Writer(random).scene())
    except ValueError:
        return None
    data = mujoco.MjData(model)
    data.mocap_pos[:] += 0.05 * random.normal(size=(model.nmocap, 3))
    data.qfrc_applied[:] = random.normal(size=model.nv) * (random.random() < 0.05)
    for _ in range(random.integers(0, 5)):
        data.ctrl[:] = draw(model, random)
        mujoco.mj_step(model, data, 40)
    mujoco.mj_forward(model, data)
    bad = data.warning.number.any() or np.abs(data.qvel).max(initial=0) > 50
    return None if bad or min(data.contact.dist, default=0.0) < -0.01 else (model, data, random)


def draw(model: Any, random: np.random.Generator) -> np.ndarray:
    """Random controls: in their ranges; else within ±1, about zero, and of servos on slides within a decimetre."""
    low, high = model.actuator_ctrlrange.T
    on_slide = (model.actuator_trntype == 0) & (model.jnt_type[model.actuator_trnid[:, 0]] == 2)
    free = random.normal(size=model.nu).clip(-1, 1) * np.where(on_slide & (model.actuator_biasprm[:, 1] < 0), 0.1, 1.0)
    return np.where(model.actuator_ctrllimited, random.uniform(low, np.maximum(low, high)), free)


def simulate(model: Any, data: Any, ctrl: Any, steps: int, finer: int) -> np.ndarray | None:
    """Velocities after steps of a part of the time step; None where it diverges."""
    data, timestep = copy.copy(data), model.opt.timestep
    data.ctrl[:] = ctrl
    model.opt.timestep = timestep / finer
    for _ in range(steps):
        mujoco.mj_step(model, data)
    model.opt.timestep = timestep
    return None if data.warning.number.any() else data.qvel.copy()


def judge(seed: int) -> Judged | None:
    """One step of a scene; None where there is no scene, or where smaller time steps give MuJoCo another result."""
    scene = random_scene(seed)
    if scene is None:
        return None
    model, data, random = scene
    count = int(random.choice([5, 10, 20]))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warnings.filterwarnings("ignore", ".*(rolling friction|servos that push no)")  # faults are counted all the same
        try:
            module = MujocoLCS(model, data, motion="dynamic", seconds=count * model.opt.timestep)
            x = module.observe(data)
            low, high = module.action_bounds(x)
            zero = torch.zeros(model.nu, dtype=torch.float64)
            u = torch.from_numpy(draw(model, random)) - module.control(x, zero)
            u = u.clamp(low, high)
            after = module.params(x).step(x, u).x_next[model.nv : 2 * model.nv].numpy()
        except DiffLCSError:
            return Judged("refused", 0.0, 0.0, 0.0)
        except Exception as error:  # which the campaign looks for
            return Judged(type(error).__name__, np.inf, 0.0, 0.0)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    ctrl, before = module.control(x, u), data.qvel.copy()
    true, fine = (simulate(model, data, ctrl, count * times, times) for times in (1, 4))
    if true is None or fine is None or np.abs([before, true]).max() * count * model.opt.timestep > FAR:
        return None

    trees = model.dof_treeid == np.unique(model.dof_treeid)[:, None]

    def norm(v: np.ndarray) -> np.ndarray:
        """Of each tree of bodies, as an object may be much lighter than the robot."""
        return np.sqrt(np.maximum(trees @ (v * (mass @ v)), 0.0))

    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT  # others may diverge where nothing holds stiff drives
    alone = simulate(model, data, ctrl, count * 4, 4)
    scale = norm(before) + (norm(alone - before) if alone is not None else 0.0) + CREEP * np.sqrt(trees @ np.diag(mass))
    alike = norm(true - fine) <= 0.2 * norm(true - before) + 0.02 * scale
    if not alike.any():
        return None
    error, nothing = norm(after - true), norm(before - true)
    worst = int(np.argmax(np.where(alike, (error - nothing) / scale, -np.inf)))
    warned = any(issubclass(w.category, ContactWarning) for w in said)
    return Judged("warned" if warned else "made", *(float(v[worst]) for v in (error, nothing, scale)))


def table(judged: list[Judged]) -> str:
    """What became of scenes, and how many with a warning are wrong for the random action."""
    outcomes = Counter(j.outcome for j in judged)
    outcomes["warned, wrong for the random action"] = sum(j.outcome == "warned" and j.off() for j in judged)
    return f"{len(judged)} scenes: " + ", ".join(f"{n} {name}" for name, n in outcomes.items())


def judge_seeds(parser: argparse.ArgumentParser, judge: Any, table: Any, kind: Any) -> tuple[Any, str]:
    """Judge the scenes that the command line asks for; print and return their table, and print the wrong ones."""
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    parser.add_argument("--count", type=int, default=1000, help="number of scenes")
    parser.add_argument("--out", type=Path, default=Path(os.devnull), help="keeps what was judged, to go on")
    options = parser.parse_args()
    torch.set_num_threads(1)
    mujoco.set_mju_user_warning(lambda message: None)  # of what diverges, which the data count
    seeds = range(options.first, options.first + options.count)
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    known = {seed: judged and kind(*judged) for seed, judged in map(json.loads, lines)}
    with options.out.open("a") as out:
        for seed in (seed for seed in seeds if seed not in known):
            known[seed] = judge(seed)
            print(json.dumps([seed, known[seed]]), file=out, flush=True)
    text = table([known[seed] for seed in seeds if known[seed]])
    print(text, *(f"seed {s}: {known[s]}" for s in seeds if known[s] and known[s].wrong()), sep="\n")
    return options, text


if __name__ == "__main__":
    judge_seeds(argparse.ArgumentParser(description="Judge random scenes."), judge, table, Judged)
