"""Random small MuJoCo scenes: one step of `MujocoLCS` against MuJoCo's, judged by what doing nothing would give.

Trees of bodies with all kinds of joints, shapes, limits, friction, actuators, tendons and equality constraints move at
random for a while; then comes one step with a random action. A fault is silent where the system is made without an
error or a warning, and is not finite, or its velocity is farther from MuJoCo's than the velocity before the step: by
more than a tolerance, in the norm of kinetic energy. An exception that is none of the library's counts as well.

python -m tests.conformance.scenes --count 20000
python -m tests.conformance.scenes --first 17 --count 1
"""

import argparse
import copy
import multiprocessing
import warnings
from collections import Counter
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch

from difflcs.errors import ContactWarning, DiffLCSError
from difflcs.physics.mujoco import MujocoLCS

TOLERANCE = 0.5  # of the speed before and of what forces do to it, what an impact within the step may cost
FAR = 0.5  # motion in a step [m, rad], beyond which nothing about it is linear
JOINTS = ("free", "slide", "hinge", "hinge", "ball")
SHAPES = ("sphere", "capsule", "box", "cylinder", "ellipsoid")


class Writer:
    """Random pieces of MJCF."""

    def __init__(self, random: np.random.Generator):
        self.random, self.names, self.scalar, self.bodies = random, [], [], 0

    def maybe(self, chance: float, text: str) -> str:
        """The text, or nothing."""
        return text if self.random.random() < chance else ""

    def log(self, low: float, high: float) -> str:
        """A number between powers of ten."""
        return f"{10 ** self.random.uniform(low, high):.4g}"

    def vector(self, scale: float, size: int = 3) -> str:
        """Numbers about zero."""
        return " ".join(f"{v:.4g}" for v in self.random.normal(size=size) * scale)

    def range(self, scale: float) -> str:
        """Two numbers, the lower one first, on both sides of zero."""
        return f"{-scale * self.random.uniform(0.2, 1):.4g} {scale * self.random.uniform(0.2, 1):.4g}"

    def joint(self, free: bool) -> str:
        """A joint with some of all that it may have."""
        name = f"j{len(self.names)}"
        kind = self.random.choice(JOINTS if free else JOINTS[1:])
        self.names.append(name)
        if kind == "free":
            return f'<freejoint name="{name}"/>'
        text = f'<joint name="{name}" type="{kind}" axis="{self.vector(1)}"'
        text += self.maybe(0.5, f' damping="{self.log(-3, 0.5)}"') + self.maybe(0.2, f' armature="{self.log(-3, -1)}"')
        text += self.maybe(0.2, f' stiffness="{self.log(-1, 2)}"')
        text += self.maybe(0.3, f' frictionloss="{self.log(-2, 0.5)}"')
        if kind != "ball":
            self.scalar.append(name)
            text += self.maybe(0.4, f' limited="true" range="{self.range(0.5 if kind == "hinge" else 0.1)}"')
            text += self.maybe(0.1, f' actuatorfrcrange="{self.range(5)}"')
        else:
            text += self.maybe(0.3, f' limited="true" range="0 {self.random.uniform(0.3, 1.5):.3g}"')
        return text + "/>"

    def geom(self) -> str:
        """A geom of some centimetres."""
        size = " ".join(f"{v:.4g}" for v in self.random.uniform(0.02, 0.08, 3))
        text = f'<geom type="{self.random.choice(SHAPES)}" size="{size}" pos="{self.vector(0.03)}"'
        text += f' mass="{self.log(-1.5, 0.3)}" friction="{self.random.uniform(0, 1.2):.3g}"'
        text += self.maybe(0.2, f' condim="{self.random.choice([1, 4, 6])}"')
        text += self.maybe(0.15, f' solref="{self.random.choice([0.005, 0.05])} {self.random.choice([0.5, 1])}"')
        return text + "/>"

    def body(self, depth: int) -> str:
        """A body and those that hang on it."""
        place = f"{self.vector(0.15, 2)} {self.random.uniform(0.05, 0.3):.3g}" if not depth else self.vector(0.12)
        name, self.bodies = f"b{self.bodies}", self.bodies + 1
        joints = self.joint(free=not depth)
        if "free" not in joints and "ball" not in joints and self.random.random() < 0.2:
            joints += self.joint(free=False).replace("ball", "hinge")
        text = f'<body name="{name}" pos="{place}"' + self.maybe(0.1, ' gravcomp="1"') + f">{joints}{self.geom()}"
        if depth < 3 and self.random.random() < 0.5:
            text += self.body(depth + 1)
        return text + "</body>"

    def actuator(self, joint: str) -> str:
        """Any kind of actuator on a joint."""
        gain, at = self.log(-1, 1.5), f'joint="{joint}"'
        text = self.random.choice([
            f"<motor {at}", f'<position {at} kp="{gain}" kv="{self.log(-1, 1)}"', f'<position {at} kp="{gain}"',
            f'<position {at} kp="{gain}" dampratio="1" timeconst="{self.log(-2.5, -1)}"',
            f'<velocity {at} kv="{self.log(-1, 1)}"', f'<damper {at} kv="1" ctrlrange="0 2"',
            f'<intvelocity {at} kp="{gain}" actrange="-1 1"', f'<muscle {at} force="{gain}" lengthrange="-1 1"',
            f'<cylinder {at} timeconst="{self.log(-2.5, 0)}" area="{gain}"',
            f'<general {at} gainprm="{gain}" biastype="affine" biasprm="{self.vector(1)[:5]} -{gain} -1"',
        ])  # fmt: skip
        if "damper" not in text and "muscle" not in text:
            text += self.maybe(0.4, f' ctrllimited="true" ctrlrange="{self.range(1)}"')
        return text + self.maybe(0.3, f' forcelimited="true" forcerange="{self.range(10)}"') + "/>"

    def equality(self) -> str:
        """A constraint between two joints or bodies."""
        one, two = (f"b{k}" for k in self.random.integers(0, self.bodies, 2))
        solref = self.maybe(0.3, f'solref="{self.random.choice([0.005, 0.1])} 1"')
        off = self.maybe(0.2, 'active="false"')
        other = self.maybe(0.5 * (one != two), f'body2="{two}"')
        kinds = [f'<weld body1="{one}" {other} {solref} {off}/>']
        kinds.append(f'<connect body1="{one}" anchor="{self.vector(0.05)}" {solref} {off}/>')
        if len(self.scalar) > 1:
            pair = self.random.choice(self.scalar, 2, replace=False)
            kinds.append(f'<joint joint1="{pair[0]}" joint2="{pair[1]}" polycoef="0 {self.vector(1, 1)} 0 0 0" {off}/>')
        return str(self.random.choice(kinds))

    def scene(self) -> str:
        """The whole."""
        random = self.random
        ground = self.maybe(0.7, f'<geom type="plane" size="3 3 .1" friction="{random.uniform(0, 1.2):.3g}"/>')
        bodies = "".join(self.body(0) for _ in range(random.integers(1, 4)))
        drive = "".join(self.actuator(name) for name in self.scalar if random.random() < 0.6)
        held = self.maybe(0.25, f"<equality>{self.equality()}</equality>")
        tendon = ""
        if len(self.scalar) > 1:
            joints = "".join(f'<joint joint="{name}" coef="{self.vector(1, 1)}"/>' for name in self.scalar[:2])
            own = self.maybe(0.5, f'limited="true" range="{self.range(0.3)}"') + self.maybe(0.2, ' frictionloss=".3"')
            own += self.maybe(0.3, f' stiffness="{self.log(0, 2)}"') + self.maybe(0.3, ' damping=".1"')
            tendon = self.maybe(0.25, f'<tendon><fixed name="t" {own}>{joints}</fixed></tendon>')
            drive += self.maybe(0.5, '<position tendon="t" kp="20" kv="1"/>') if tendon else ""
        step, integrator = (
            random.choice([0.001, 0.002, 0.005]),
            random.choice(["Euler", "implicit", "implicitfast", "RK4"]),
        )
        options = f'timestep="{step}" integrator="{integrator}" cone="{random.choice(["pyramidal", "elliptic"])}"'
        options += self.maybe(0.2, ' gravity="0 0 0"') + self.maybe(0.1, ' density="1000" viscosity=".01"')
        return (
            f'<mujoco><compiler angle="radian"/><option {options}/><worldbody>{ground}{bodies}</worldbody>{tendon}'
            f"<actuator>{drive}</actuator>{held}</mujoco>"
        )


class Judged(NamedTuple):
    """A scene: what became of it, and the error beside that of doing nothing [√J]."""

    kind: str
    outcome: str
    error: float
    nothing: float
    scale: float

    def wrong(self) -> bool:
        """Whether a fault is silent."""
        if self.outcome in ("refused", "warned"):
            return False
        return self.outcome != "made" or not self.error <= self.nothing + TOLERANCE * self.scale + 1e-6


def random_scene(seed: int) -> tuple[Any, Any, np.random.Generator] | None:
    """A model and its data after a random motion; None where there is no such scene, or its simulation diverges."""
    random = np.random.default_rng(seed)
    try:
        model = mujoco.MjModel.from_xml_string(Writer(random).scene())
    except ValueError:
        return None
    data = mujoco.MjData(model)
    for _ in range(random.integers(0, 5)):
        data.ctrl[:] = draw(model, random)
        mujoco.mj_step(model, data, 40)
    mujoco.mj_forward(model, data)
    bad = data.warning.number.any() or np.abs(data.qvel).max(initial=0) > 50
    return None if bad or min(data.contact.dist, default=0.0) < -0.01 else (model, data, random)


def draw(model: Any, random: np.random.Generator) -> np.ndarray:
    """Random controls."""
    low, high = model.actuator_ctrlrange.T
    return np.where(
        model.actuator_ctrllimited, random.uniform(low, np.maximum(low, high)), random.normal(size=model.nu)
    )


def simulate(model: Any, data: Any, ctrl: Any, steps: int, finer: int) -> tuple[np.ndarray, set[int]] | None:
    """Velocities after steps of a part of the time step, and kinds of active constraints; None where it diverges."""
    data, kinds, timestep = copy.copy(data), set(), model.opt.timestep
    data.ctrl[:] = ctrl
    model.opt.timestep = timestep / finer
    for _ in range(steps):
        mujoco.mj_step(model, data)
        kinds |= set(data.efc_type[data.efc_force != 0].tolist())
    model.opt.timestep = timestep
    return None if data.warning.number.any() else (data.qvel.copy(), kinds)


def judge(seed: int) -> Judged | None:
    """One step of a scene; None where there is no scene, or where smaller time steps give MuJoCo another result."""
    scene = random_scene(seed)
    if scene is None:
        return None
    model, data, random = scene
    count = int(random.choice([5, 10, 20]))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warnings.filterwarnings("ignore", message=".*rolling friction")  # faults are counted all the same
        try:
            module = MujocoLCS(model, data, motion="dynamic", seconds=count * model.opt.timestep)
            x = module.observe(data)
            low, high = module.action_bounds(x)
            zero = torch.zeros(model.nu, dtype=torch.float64)
            u = torch.from_numpy(draw(model, random)) - module.control(x, zero)
            u = u.clamp(low, high)
            after = module.params(x).step(x, u).x_next[model.nv : 2 * model.nv].numpy()
        except DiffLCSError:
            return Judged("", "refused", 0.0, 0.0, 0.0)
        except Exception as error:  # which the campaign looks for
            return Judged("", type(error).__name__, np.inf, 0.0, 0.0)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    ctrl, before = module.control(x, u), data.qvel.copy()
    found = [simulate(model, data, ctrl, count * times, times) for times in (1, 4)]
    if None in found:
        return None
    (true, kinds), (fine, _) = found
    if np.abs([before, true]).max() * count * model.opt.timestep > FAR:
        return None

    def norm(v: np.ndarray) -> float:
        return float(np.sqrt(v @ mass @ v))

    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    alone = simulate(model, data, ctrl, count * 4, 4)
    scale = norm(before) + (norm(alone[0] - before) if alone else 0.0)
    if norm(true - fine) > 0.2 * norm(true - before) + 0.02 * scale:
        return None
    error, nothing = norm(after - true), norm(before - true)
    names = ",".join(sorted({mujoco.mjtConstraint(k).name.removeprefix("mjCNSTR_").split("_")[0] for k in kinds}))
    warned = any(issubclass(w.category, ContactWarning) for w in said)
    return Judged(names or "free", "warned" if warned else "made", error, nothing, scale)


def table(judged: list[Judged]) -> str:
    """Markdown: what became of scenes, and errors where doing nothing has 1, by the constraints that act in MuJoCo."""
    outcomes = Counter(j.outcome for j in judged)
    lines = [f"{len(judged)} scenes: " + ", ".join(f"{n} {name}" for name, n in outcomes.items()), ""]
    lines += ["| act | scenes | median error | silent faults |", "|---|---|---|---|"]
    for kind in sorted({j.kind for j in judged if j.kind}):
        some = [j for j in judged if j.kind == kind]
        error = np.median([j.error / max(j.nothing, 1e-9) for j in some])
        lines.append(f"| {kind} | {len(some)} | {error:.2f} | {sum(j.wrong() for j in some)} |")
    return "\n".join(lines)


def _prepare() -> None:
    """Prepare a process: one thread; MuJoCo does not print that a scene diverges, which its data counts."""
    torch.set_num_threads(1)
    mujoco.set_mju_user_warning(lambda message: None)


def main() -> None:
    """Judge scenes, print the table and the seeds that are wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    parser.add_argument("--count", type=int, default=1000, help="number of scenes")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.count)
    with multiprocessing.get_context("spawn").Pool(options.processes, _prepare) as pool:
        results = dict(zip(seeds, pool.imap(judge, seeds, chunksize=20), strict=True))
    print(table([j for j in results.values() if j]))
    print(*(f"seed {seed}: {j}" for seed, j in results.items() if j and j.wrong()), sep="\n")


if __name__ == "__main__":
    main()
