"""Numbers of a MuJoCo model, found again from two minutes of motion: `python examples/identify_mujoco.py --xml FILE`.

The model in the file is the truth. A guess has some of its numbers wrong by the factor `--wrong`, in turn too large and
too small. The truth moves by random controls; `LearnableMujocoLCS` with the violation loss brings the guess back.
What only contacts tell, such as friction, is fitted by MuJoCo's own steps of the learned model in place of this loss.
Without `--xml` three models are tried: the arm of Gymnasium's Pusher, its half-cheetah, which runs in a plane, and the
hand of `difflcs/HandTurnObject-v0` with a cube on its palm.
"""

from __future__ import annotations

import itertools
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs import violation_loss
from difflcs.errors import ContactWarning
from difflcs.physics.mujoco import LearnableMujocoLCS
from difflcs_envs.hand.model import build_model

OF_CONTACTS = ("friction", "size", "offset", "compliance")  # what only contacts tell
GYMNASIUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


@dataclass
class Options:
    """Find numbers of a MuJoCo model again."""

    xml: Path | None = None
    """Model; without it three are tried."""
    learn: tuple[str, ...] = ()
    """What is wrong in the guess: kinds of `LearnableMujocoLCS`, or kind:name; with --xml."""
    wrong: float = 2.0
    """Factor by which each is wrong, in turn too large and too small."""
    simulate: bool | None = None
    """Compare with MuJoCo's own steps; None: where what only contacts tell is learned."""
    seconds: float = 120.0
    """Of motion."""
    step: float = 0.02
    """Of a transition [s]."""
    steps: int = 150
    """Steps of Adam, each on `batch` transitions drawn at random."""
    batch: int = 200
    seed: int = 0


def gather(model: Any, module: LearnableMujocoLCS, o: Options) -> list[Tensor]:
    """Move the model by controls that change every 10 steps: states, actions and next states, (n, …) each."""
    random, data = np.random.default_rng(o.seed), mujoco.MjData(model)
    before, after, controls = [], [], []
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    for k in range(round(o.seconds / o.step)):
        if k % 50 == 0:
            mujoco.mj_resetData(model, data)
        if k % 10 == 0:
            data.ctrl[:] = random.uniform(low, high)
        controls.append(data.ctrl.copy())
        before.append([data.qpos.copy(), data.qvel.copy()])
        mujoco.mj_step(model, data, round(o.step / model.opt.timestep))
        after.append([data.qpos.copy(), data.qvel.copy()])
    x, x_next = (module.state.to_state(*map(np.stack, zip(*rows, strict=True))) for rows in (before, after))
    ctrl = torch.from_numpy(np.stack(controls))
    return [x, ctrl - module.physics.control(x, torch.zeros_like(ctrl)), x_next]


def simulate(module: LearnableMujocoLCS, change: Tensor, x: Tensor, u: Tensor) -> Tensor:
    """States (n, n_x) after MuJoCo's own steps of the model with parameters `change`."""
    with torch.no_grad():
        module.change.copy_(change)
    after = module.physics.states_along(x, torch.stack([u, u], 1))  # at the beginning of each of two steps
    if after is None:
        raise SystemExit("the simulation has no finite numbers: shorten --step, or change fewer numbers")
    return after[:, 1]


def differentiate(module: LearnableMujocoLCS, x: Tensor, u: Tensor, x_next: Tensor, usual: Tensor) -> None:
    """Set the gradient of what `simulate` misses, where each number of each state counts by its logarithm."""
    middle = module.change.detach().clone()
    scale = (simulate(module, middle, x, u) - x_next).abs().median(0).values + 0.01 * usual + 1e-9
    slopes = []
    for way in 0.01 * torch.eye(len(middle), dtype=torch.float64):
        errors = (simulate(module, middle + sign * way, x, u) - x_next for sign in (1, -1))
        ahead, behind = ((error / scale).square().log1p().mean() for error in errors)
        slopes.append((ahead - behind) / 0.02)
    with torch.no_grad():
        module.change.copy_(middle)
    module.change.grad = torch.stack(slopes)


def identify(name: str, model: Any, learn: list[Any], o: Options) -> None:
    """Fit one model, and print the factors that are left."""
    module = LearnableMujocoLCS(model, learn=learn, motion="dynamic", seconds=o.step)
    signs = torch.tensor([s for s, _ in zip(itertools.cycle([1.0, -1.0]), module.change, strict=False)])
    with torch.no_grad():
        module.change.copy_(signs * np.log(o.wrong))
    x, u, x_next = gather(model, module, o)
    touching = any((what if isinstance(what, str) else what[0]) in OF_CONTACTS for what in learn)
    simulated = touching if o.simulate is None else o.simulate
    if not touching:
        # A system explains impacts badly, and they say nothing of what is to be learned.
        free = [(module.physics.contacts(state).gap > 0).all(-1) for state in (x, x_next)]
        x, u, x_next = (rows[free[0] & free[1]] for rows in (x, u, x_next))
    adam = torch.optim.Adam(module.parameters(), 0.1)
    slower = torch.optim.lr_scheduler.ExponentialLR(adam, 0.03 ** (1 / o.steps))
    usual = (x_next - x).abs().mean(0)
    draw, begun = torch.Generator().manual_seed(o.seed), time.process_time()
    for _ in range(o.steps):
        some = torch.randint(len(x), (o.batch,), generator=draw)
        adam.zero_grad()
        if simulated:
            differentiate(module, x[some], u[some], x_next[some], usual)
        else:
            losses = violation_loss(module, x[some], u[some], x_next[some], "auto", o.step, reduction="none")
            (losses / losses.detach().median()).log1p().mean().backward()
        adam.step()
        slower.step()
    print(f"{name}: {len(x)} transitions used, {time.process_time() - begun:.0f} s")
    for what, sign, left in zip(learn, signs, module.change.detach().exp(), strict=True):
        print(f"  {what}: guessed × {o.wrong ** float(sign):.2f}, found × {left:.3f}")


def main(o: Options) -> None:
    """Identify."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)
    if o.xml is not None:
        learn = [tuple(what.split(":", 1)) if ":" in what else what for what in o.learn]
        identify(o.xml.stem, mujoco.MjModel.from_xml_path(str(o.xml)), learn, o)
        return
    arm = mujoco.MjModel.from_xml_path(str(GYMNASIUM / "pusher_v5.xml"))
    identify("arm", arm, [("mass", "r_upper_arm_link"), ("mass", "r_forearm_link"), "damping", "armature"], o)
    cheetah = mujoco.MjModel.from_xml_path(str(GYMNASIUM / "half_cheetah.xml"))
    identify("half-cheetah", cheetah, [("mass", "torso"), "stiffness", "damping"], o)
    identify("hand", build_model("cube"), [("mass", "object"), "friction", "gain"], o)


if __name__ == "__main__":
    main(tyro.cli(Options))
