"""Models by others, one step of `MujocoLCS` against MuJoCo: `python benchmarks/physics_models.py [--packages DIR ...]`.

The models are the scenes of dm_control, gymnasium, gymnasium-robotics, robosuite, metaworld and judo-rai: packages that
are installed, or that lie in a folder (`pip install --target DIR --no-deps gymnasium-robotics metaworld ...`). For each
model: is it accepted, and if not, why; how far the velocity after one step of 20 ms is from MuJoCo's, in parts of the
change of velocity, so that doing nothing has an error of 1. States are along a random motion, actions are random within
the ranges of the actuators and within `action_bounds`. Medians are told for states that move freely, that have a
contact, or where a joint or tendon is at its limit in this step. Beside them are those of differences: MuJoCo's own
steps with the nominal control, linearised at each by `mjd_transitionFD`, contacts included. Both are also told with a
nominal control near the action, nine tenths of the way, as that of a plan's next pass is.

With `--times` only CPU and wall time of a state in one batch are told, of each motion and MuJoCo's own steps, in turn.
Judo's LEAP hands and arm are there too; in place of their meshes, which its wheel lacks, are hulls of 32 points.
"""

import importlib.util
import re
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

import mujoco
import numpy as np
import torch
import tyro
from rivals.run import cpu

from difflcs.cli.bench import machine, save
from difflcs.errors import DiffLCSError
from difflcs.physics.mujoco import MujocoLCS
from difflcs.physics.mujoco.lcs import Motion

SECONDS = 0.02  # of a step
NEAR = 0.9  # of the way from the usual nominal control to the action
MODELS = {  # package → its scenes; what does not load alone, or has no joint, is a part of others
    "dm_control": ["suite/*.xml"],
    "gymnasium": ["envs/mujoco/assets/*.xml"],
    "gymnasium_robotics": [
        "envs/assets/adroit_hand/adroit_*.xml",
        "envs/assets/fetch/*.xml",
        "envs/assets/hand/manipulate_*[!s].xml",
        "envs/assets/hand/reach.xml",
        "envs/assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml",
        "envs/assets/point/point.xml",
    ],
    "judo": ["models/xml/*.xml"],
    "metaworld": ["assets/sawyer_xyz/*.xml"],
    "robosuite": [
        "models/assets/robots/*/robot.xml",
        "models/assets/grippers/*.xml",
        "models/assets/objects/door*.xml",
    ],
}
EULER, RK4 = int(mujoco.mjtIntegrator.mjINT_EULER), int(mujoco.mjtIntegrator.mjINT_RK4)
LIMITS = (mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT, mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON)
CONTACTS = tuple(
    getattr(mujoco.mjtConstraint, f"mjCNSTR_CONTACT_{name}") for name in ("FRICTIONLESS", "PYRAMIDAL", "ELLIPTIC")
)


@dataclass
class Options:
    """Refusals, errors of one step and times on models by others."""

    packages: tuple[Path, ...] = ()
    """Folders with packages, besides those that are installed."""
    only: str = ""
    """Part of the name of the models that count."""
    states: int = 30
    """States of a model."""
    seed: int = 0
    """Seed of motions and controls."""
    times: bool = False
    """Times alone; their JSON lies beside that of the errors."""
    threads: int = 1
    """Threads of a batch."""
    out: Path = Path("benchmarks/results/physics_models.json")
    """Where the JSON goes."""


def find(packages: tuple[Path, ...]) -> dict[str, tuple[Path, ...]]:
    """Files by package."""
    found = {}
    for package, patterns in MODELS.items():
        roots = [folder / package for folder in packages if (folder / package).is_dir()]
        spec = None if roots else importlib.util.find_spec(package)
        roots = roots or [Path(place) for place in (spec.submodule_search_locations if spec else None) or ()]
        found[package] = tuple(sorted(path for root in roots for p in patterns for path in root.glob(p)))
    return found


def load(path: Path, hulls: bool) -> Any:
    """Load a model; with `hulls` in place of Judo's meshes."""
    spec, points = mujoco.MjSpec.from_file(str(path)), np.random.default_rng(0).normal(size=(32, 3))
    points *= [[0.012, 0.01, 0.016]] / np.linalg.norm(points, axis=1, keepdims=True)  # of a finger tip [m]
    for mesh in spec.meshes if hulls and path.parents[1].name == "models" else ():
        mesh.file, mesh.uservert = "", points.ravel().tolist()
    return spec.compile()


def draw(model: Any, data: Any, random: np.random.Generator) -> np.ndarray:
    """Random controls: in their ranges, or of servos near to where these are."""
    low, high = model.actuator_ctrlrange.T
    near = np.where(model.actuator_biasprm[:, 1] < 0, data.actuator_length, 0.0) + random.normal(size=model.nu) * 0.3
    return np.where(model.actuator_ctrllimited, random.uniform(low, np.maximum(high, low)), near)


def place(model: Any, data: Any, random: np.random.Generator) -> None:
    """Begin near the model's own place, or as far from it as bodies need that are deep in each other there."""
    for spread in (0.05, 0.05, 0.2, 0.5, 1.0):
        mujoco.mj_resetData(model, data)
        qpos = data.qpos.copy()
        mujoco.mj_integratePos(model, qpos, random.normal(size=model.nv) * spread, 1.0)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        if min(data.contact.dist, default=0.0) > -0.02:
            break


def roam(model: Any, count: int, random: np.random.Generator) -> list[tuple[np.ndarray, ...]]:
    """States (qpos, qvel, act) along random motions of two seconds, one each tenth of a second."""
    data, states = mujoco.MjData(model), []
    steps = max(1, round(0.1 / model.opt.timestep))
    for _ in range(4 * count):
        if not 0 < data.time < 2.5:
            place(model, data, random)
        mujoco.mj_forward(model, data)
        data.ctrl[:] = draw(model, data, random)
        mujoco.mj_step(model, data, steps)
        if data.warning.number.any():
            data.warning.number[:] = 0
            mujoco.mj_resetData(model, data)
        elif data.time > 0.25:
            states.append((data.qpos.copy(), data.qvel.copy(), data.act.copy()))
        if len(states) == count:
            break
    return states


def count_steps(model: Any) -> int:
    """MuJoCo's steps in one of ours, of 20 ms, or of MuJoCo's where these are longer."""
    return max(1, round(SECONDS / model.opt.timestep))


class Simulated:
    """One step in MuJoCo from a state.

    Attributes:
        after: (nv,) velocities; NaN where MuJoCo diverges.
        kind: "free", "contact" or "limit".
    """

    def __init__(self, model: Any, state: tuple[np.ndarray, ...], ctrl: np.ndarray, linearise: bool = False):
        data, nv = mujoco.MjData(model), model.nv
        data.qpos[:], data.qvel[:], data.act[:] = state
        data.ctrl[:] = ctrl
        self.kind, self.by_ctrl = "free", np.zeros((2 * nv + model.na, model.nu))
        A, B = np.zeros((len(self.by_ctrl), len(self.by_ctrl))), np.zeros_like(self.by_ctrl)
        for _ in range(count_steps(model)):
            if linearise:
                integrator = model.opt.integrator
                model.opt.integrator = EULER if integrator == RK4 else integrator  # RK4 has no differences
                mujoco.mjd_transitionFD(model, data, 1e-6, 1, A, B, None, None)
                model.opt.integrator = integrator
                self.by_ctrl = A @ self.by_ctrl + B
            mujoco.mj_step(model, data)
            active = data.efc_type[data.efc_force != 0]
            if np.isin(active, LIMITS).any():
                self.kind = "limit"
            elif self.kind == "free" and np.isin(active, CONTACTS).any():
                self.kind = "contact"
        self.after = data.qvel + np.where(data.warning.number.any(), np.nan, 0.0)


@torch.no_grad()
def measure(model: Any, o: Options, asked: dict[str, Any] | None = None) -> dict[str, Any] | None:
    """Errors by kind, and the time of a state, with as many contacts and limits as a `ContactWarning` asks for.

    None where every simulation of the model diverges.
    """
    module = MujocoLCS(model, motion="dynamic", seconds=count_steps(model) * model.opt.timestep, **(asked or {}))
    random, nv = np.random.default_rng(o.seed), model.nv
    states = roam(model, o.states, random)
    if not states:
        return None
    x = torch.stack([module.state.to_state(*state) for state in states])
    data, ctrl, nominal = mujoco.MjData(model), [], []
    for state, low, high in zip(states, *(v.numpy() for v in module.action_bounds(x)), strict=True):
        data.qpos[:], data.qvel[:] = state[:2]
        mujoco.mj_fwdPosition(model, data)
        here = module.state.to_state(*state)
        zero = module.control(here, torch.zeros(model.nu, dtype=torch.float64)).numpy()
        ctrl.append(np.clip(draw(model, data, random), zero + low, zero + high))
        nominal.append(zero)
    zeros, actions = torch.tensor(np.array(nominal)), torch.tensor(np.array(ctrl))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        module.params(x)  # what is done once
        seconds, system = cpu(module.params, x)
    more = {name: int(n) for w in said for name, n in re.findall(r"pass (contacts|limits)=(\d+)", str(w.message))}
    if more and asked is None:
        return measure(model, o, more)
    for w in said:
        warnings.warn(w.message, stacklevel=1)
    near = zeros + NEAR * (actions - zeros)
    systems = {"": (zeros, system), "near_": (near, module.params(x, near))}
    predicted = {w: s.step(x, actions - zeros).x_next[:, nv : 2 * nv].numpy() for w, (_, s) in systems.items()}
    errors: dict[str, dict[str, list[float]]] = {
        kind: {f"{way}{of}": [] for way in systems for of in ("lcs", "fd")} for kind in ("free", "contact", "limit")
    }
    for i, state in enumerate(states):
        true = Simulated(model, state, ctrl[i])
        change = np.linalg.norm(true.after - state[1])
        if change < 1e-6 or not np.isfinite(change):
            continue
        for way, (controls, _) in systems.items():
            at = controls[i].numpy()
            base = Simulated(model, state, at, linearise=True)
            differences = base.after + (base.by_ctrl @ (ctrl[i] - at))[nv : 2 * nv]
            for of, velocity in (("lcs", predicted[way][i]), ("fd", differences)):
                errors[true.kind][way + of].append(float(np.linalg.norm(velocity - true.after) / change))
    told = {
        kind: {"states": len(v["lcs"]), **{n: float(np.median(e)) if e else None for n, e in v.items()}}
        for kind, v in errors.items()
    }
    return {"ms": 1e3 * seconds / len(x), "n_x": module.n_x, "n_u": module.n_u, "n_lam": module.n_lam, **told}


def clock(model: Any, o: Options) -> dict[str, Any] | None:
    """Median CPU and wall times of a state [µs], in one batch of all, by motion; "mujoco": its own steps one by one."""
    states, data, steps = roam(model, o.states, np.random.default_rng(o.seed)), mujoco.MjData(model), count_steps(model)

    def simulate() -> None:
        for data.qpos[:], data.qvel[:], data.act[:] in states:
            mujoco.mj_step(model, data, steps)

    ways: dict[str, Callable[[], Any]] = {"mujoco": simulate}
    for motion in get_args(Motion) if states else ():
        with suppress(DiffLCSError):
            module = MujocoLCS(model, motion=motion, seconds=steps * model.opt.timestep)
            ways[motion] = partial(module.params, torch.stack([module.state.to_state(*state) for state in states]))
    times: dict[str, list[list[float]]] = {name: [] for name in ways}
    for _ in range(10):  # the first does not count
        for name, way in ways.items():
            cpu, wall = time.process_time(), time.perf_counter()
            way()
            times[name].append([time.process_time() - cpu, time.perf_counter() - wall])
    medians = {name: (1e6 * np.median(each[1:], 0) / len(states)).tolist() for name, each in times.items()}
    return medians if len(ways) > 1 else None


def main(o: Options) -> None:
    """Measure, print, write."""
    torch.set_num_threads(o.threads)
    if o.times:
        o.out = o.out.with_stem(f"{o.out.stem}-times")
    results: dict[str, dict[str, Any]] = {}
    for package, paths in find(o.packages).items():
        for path in paths:
            name = f"{package}/{path.parent.name if path.stem == 'robot' else path.stem}"
            if o.only not in name:
                continue
            name = f"{package}/{path.parent.name}/{path.stem}" if name in results else name
            try:
                model = load(path, o.times)
            except ValueError:
                continue
            if not model.nv:
                continue
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                try:
                    row = clock(model, o) if o.times else measure(model, o)
                except DiffLCSError as error:
                    row = {"refused": str(error)}
            if row is None:
                continue
            row |= {"warnings": sorted({str(w.message) for w in said})}
            results[name] = row
            print(name, row.get("refused") or (row if o.times else describe(row)), flush=True)
    options = {"states": o.states, "seed": o.seed, "seconds": SECONDS, "threads": o.threads}
    save(o.out, {"machine": {**machine(), "mujoco": mujoco.__version__}, "options": options, "results": results})


def describe(row: dict[str, Any]) -> str:
    """One line of a model."""
    kinds = (
        f"{kind} {v['lcs']:.2f} ({v['fd']:.2f}), near {v['near_lcs']:.2f} ({v['near_fd']:.2f}); {v['states']} states"
        for kind in ("free", "contact", "limit")
        if (v := row[kind])["states"]
    )
    return f"{row['ms']:.2f} ms  n_lam {row['n_lam']}  " + "  ".join(kinds)


if __name__ == "__main__":
    main(tyro.cli(Options))
