"""Numbers of a MuJoCo model, found again from two minutes of motion: `python examples/identify_mujoco.py --xml FILE`.

The model in the file is the truth. A guess has some of its numbers wrong by the factor `--wrong`, in turn too large and
too small. The truth moves by random controls, and `identify` brings the guess back by MuJoCo's own steps. Without
`--xml` three models are tried: the arm of Gymnasium's Pusher, its half-cheetah, which runs in a plane, and the hand of
`difflcs/HandTurnObject-v0` with a cube on its palm.

The command line knows arm and half-cheetah as tasks here, with the same guesses; that of the hand comes with the
library. Their goal is a place of the first joint, and their first episodes have random actions:

    python examples/identify_mujoco.py train --task arm --method mujoco-lcs --minutes 2 --fit.random 1 --out RUN
    python examples/identify_mujoco.py found RUN
"""

from __future__ import annotations

import functools
import itertools
import json
import sys
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

from difflcs import GoalCost, cli
from difflcs.errors import ContactWarning
from difflcs.physics.mujoco import LearnableMujocoLCS, MujocoState, identify
from difflcs.rl import PhysicsSpec, Quantity, TaskSpec, load_policy, register_task
from difflcs.rl.rollout import windows
from difflcs_envs.hand.model import build_model

GYMNASIUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
LEARN = {
    "arm": [("mass", "r_upper_arm_link"), ("mass", "r_forearm_link"), "damping", "armature"],
    "half-cheetah": [("mass", "torso"), "stiffness", "damping"],
    "hand": [("mass", "object"), "friction", "gain"],
}
EPISODE_STEPS = 50


@dataclass
class Options:
    """Find numbers of a MuJoCo model again."""

    xml: Path | None = None
    """Model; without it three are tried."""
    learn: tuple[str, ...] = ()
    """What is wrong in the guess: kinds of `LearnableMujocoLCS`, or kind:name; with --xml."""
    wrong: float = 2.0
    """Factor by which each is wrong, in turn too large and too small."""
    seconds: float = 120.0
    """Of motion."""
    step: float = 0.02
    """Of a transition [s]."""
    window: int = 1
    """Transitions of a trajectory that is simulated."""
    transitions: int = 600
    """Of them all, those that are simulated, drawn at random."""
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviations of the noise of what is observed: lengths [m], angles [rad], velocities [m/s, rad/s]."""
    seed: int = 0


def load(name: str) -> Any:
    """Load one of the three models."""
    if name == "hand":
        return build_model("cube")
    return mujoco.MjModel.from_xml_path(
        str(GYMNASIUM / {"arm": "pusher_v5.xml", "half-cheetah": "half_cheetah.xml"}[name])
    )


def guess(model: Any, learn: list[Any], wrong: float, step: float) -> LearnableMujocoLCS:
    """Make a learnable model whose numbers are wrong, in turn too large and too small."""
    module = LearnableMujocoLCS(model, learn=learn, motion="dynamic", seconds=step)
    signs = itertools.cycle([1.0, -1.0])
    with torch.no_grad():
        module.change.copy_(torch.tensor([next(signs) * np.log(wrong) for _ in module.change]))
    return module


def ranges(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the ranges of the controls, ±1 where there is none."""
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    return low, high


def gather(model: Any, module: LearnableMujocoLCS, o: Options) -> tuple[Tensor, Tensor]:
    """Move the model by controls that change every 10 steps: states (N, 51, n_x) and actions (N, 50, n_u)."""
    random, data = np.random.default_rng(o.seed), mujoco.MjData(model)
    states, controls = [], []
    for _ in range(round(o.seconds / o.step / EPISODE_STEPS)):
        mujoco.mj_resetData(model, data)
        states.append([[data.qpos.copy(), data.qvel.copy()]])
        for k in range(EPISODE_STEPS):
            if k % 10 == 0:
                data.ctrl[:] = random.uniform(*ranges(model))
            controls.append(data.ctrl.copy())
            mujoco.mj_step(model, data, round(o.step / model.opt.timestep))
            states[-1].append([data.qpos.copy(), data.qvel.copy()])
    qpos, qvel = (np.stack([[pair[i] for pair in episode] for episode in states]) for i in (0, 1))
    x = module.state.to_state(qpos, qvel)
    straight = [name.endswith(("_x", "_y", "_z")) for name in module.state.names[: model.nv]]
    straight |= model.jnt_type[model.dof_jntid] == mujoco.mjtJoint.mjJNT_SLIDE
    std = np.concatenate([np.where(straight, o.noise[0], o.noise[1]), np.full(model.nv, o.noise[2])])
    x += torch.from_numpy(random.normal(0.0, 1.0, x.shape) * std)
    ctrl = torch.from_numpy(np.stack(controls)).unflatten(0, (-1, EPISODE_STEPS))
    return x, ctrl - module.control(x[:, :-1], torch.zeros_like(ctrl))


def recover(name: str, model: Any, learn: list[Any], o: Options) -> None:
    """Fit one model, and print the factors that are left."""
    module = guess(model, learn, o.wrong, o.step)
    guessed, (x, u), begun = module.change.detach().exp(), gather(model, module, o), time.process_time()
    x, u = windows(x, u, o.window)
    some = np.random.default_rng(o.seed).permutation(len(x))[: o.transitions // o.window]
    losses = identify(module, x[some], u[some])
    print(
        f"{name}: {len(losses)} steps, {time.process_time() - begun:.0f} s, error {losses[0]:.2g} to {losses[-1]:.2g}"
    )
    for what, before, left in zip(learn, guessed, module.change.detach().exp(), strict=True):
        print(f"  {what}: guessed × {before:.2f}, found × {left:.3f}", flush=True)


class Reach(gymnasium.Env):
    """A MuJoCo model as an environment, whose first joint is to reach a place."""

    def __init__(self, name: str, step: float):
        self.model, self.step_seconds = load(name), step
        self.data = mujoco.MjData(self.model)
        self.state = MujocoState(self.model, velocities=True)
        box = functools.partial(gymnasium.spaces.Box, dtype=np.float64)
        self.action_space = box(*ranges(self.model))
        self.observation_space = gymnasium.spaces.Dict(
            state=box(-np.inf, np.inf, (self.state.n_x,)), goal=box(-1.0, 1.0, (1,))
        )

    def _observe(self) -> dict[str, np.ndarray]:
        return {"state": self.state.to_state(self.data.qpos, self.data.qvel).numpy(), "goal": self.goal}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """See Gymnasium."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.goal, self.elapsed = np.asarray((options or {}).get("goal", self.np_random.uniform(-1, 1, 1)), float), 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> Any:
        """See Gymnasium."""
        self.data.ctrl[:], before = action, self._observe()["state"]
        mujoco.mj_step(self.model, self.data, round(self.step_seconds / self.model.opt.timestep))
        self.elapsed += 1
        seen, ended = self._observe(), self.elapsed == EPISODE_STEPS
        reward, success = outcome(before, action, seen["state"], self.goal, ended)
        return (
            seen,
            float(reward),
            False,
            ended,
            {"success": bool(success), "place_error": abs(seen["state"][0] - self.goal[0])},
        )


def outcome(state: Any, action: Any, after: Any, goal: Any, ended: Any) -> tuple[Any, Any]:
    """Judge transitions."""
    far = after[..., 0] - goal[..., 0]
    return -far * far, abs(far) < 0.1


def make_task(name: str, wrong: float = 2.0, step: float = 0.05) -> TaskSpec:
    """Make the task of a model whose numbers are guessed wrong."""
    model, (low, high) = load(name), ranges(load(name))
    n_x = 2 * model.nv
    return TaskSpec(
        name=name,
        summary=f"Bring the first joint of the {name} to a place, with numbers of the model guessed wrong.",
        env=functools.partial(Reach, name, step),
        make_cost=lambda: GoalCost.reach(n_x, model.nu, goal_weight=(10.0,), input_weight=0.1),
        u_min=low.tolist(),
        u_max=high.tolist(),
        horizon=3,
        episode_steps=EPISODE_STEPS,
        step_seconds=step,
        features=lambda state, goal, elapsed: torch.cat([state, goal, elapsed.unsqueeze(-1)], -1),
        outcome=outcome,
        goal=(Quantity("place", "rad"),),
        errors=(Quantity("place_error", "rad"),),
        physics=PhysicsSpec(make_system=lambda: guess(load(name), LEARN[name], wrong, step), scale=(1.0,) * n_x),
    )


def main(o: Options) -> None:
    """Identify."""
    if o.xml is not None:
        learn = [tuple(what.split(":", 1)) if ":" in what else what for what in o.learn]
        recover(o.xml.stem, mujoco.MjModel.from_xml_path(str(o.xml)), learn, o)
        return
    for name, learn in LEARN.items():
        recover(name, load(name), learn, o)


if __name__ == "__main__":
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)
    if sys.argv[1:2] and not sys.argv[1].startswith("-"):
        for task in ("arm", "half-cheetah"):
            register_task(make_task(task))
        if sys.argv[1] == "found":
            print(json.dumps(load_policy(sys.argv[2]).lcs.summary(), indent=1))  # factors of where the guess began
        else:
            sys.exit(cli.main())
    else:
        main(tyro.cli(Options))
