"""Judo's `cylinder_push`: `python examples/cylinder_push.py --xml DIR/judo/models/xml/cylinder_push.xml`.

A driven cylinder pushes another one, 50 cm wide and damped, to the origin; they begin anywhere on circles of 1 and 2 m.
The model is in the wheel of Judo (`pip install --target DIR --no-deps judo-rai`). There are 200 decisions of 0.1 s. The
contact MPC tells from which of 16 places round the cylinder a push is worth the most, and the pusher travels there.

With `--planner cem`, `mppi` or `ps` Judo's own planner plays the same episodes, with Judo's reward and defaults for
this task: 32 rollouts of 1 s, 20 decisions a second, for which the simulator waits; `--rollouts` gives it others. It
needs all of Judo: `pip install --target DIR judo-rai`. Times are CPU times of all threads.
"""

# Judo is no dependency; MuJoCo is a compiled module without type stubs.
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import mujoco
import numpy as np
import torch
import tyro

from difflcs import GoalCost, LCSMPCLayer
from difflcs.cli.bench import machine, save
from difflcs.physics.mujoco import MujocoLCS
from difflcs.planning import SamplingPolicy, SamplingSettings
from difflcs.planning.mujoco import BodyPlaces, BodyTravel
from difflcs.rl import wilson_interval

SECONDS, DECISIONS = 0.1, 200  # of a step [s], of an episode
CLOSE, REACHED = 0.02, 0.3  # to the origin, where we and where Judo count the cylinder as being there [m]
WEIGHT, EFFORT, FINAL = 0.001, 0.00005, 30.0  # of the distance between the two, of the servos, and at the end
SETTINGS = SamplingSettings(keep=0.8, travel_price=0.001, switch_price=0.002, smallest_gain=0.002)


@dataclass
class Options:
    """A cylinder that is pushed to the origin."""

    xml: Path
    """Judo's model."""
    episodes: int = 20
    """Episodes."""
    seed: int = 0
    """Seed of the beginnings."""
    planner: Literal["contact-mpc", "cem", "mppi", "ps"] = "contact-mpc"
    """Contact MPC, or one of Judo's."""
    rollouts: int | None = None
    """Rollouts of Judo's planner; None: its default."""
    out: Path | None = None
    """JSON in which to write the figures, beside those of other calls."""


def make_policy(model: Any) -> tuple[MujocoLCS, SamplingPolicy]:
    """Make the system and the policy."""
    data = mujoco.MjData(model)
    data.qpos[:] = [1, 0, 2, 0]
    module = MujocoLCS(model, data, motion="dynamic", seconds=SECONDS, pairs=[("pusher", "cart")], contacts=1)
    unit = torch.eye(8, dtype=torch.float64)
    apart = unit[:2] - unit[2:4]
    Q = torch.diag(torch.tensor([0, 0, 2, 2, 0.02, 0.02, 0.02, 0.02], dtype=torch.float64)) + WEIGHT * apart.mT @ apart
    none = torch.zeros(8, 2, dtype=torch.float64)
    cost = GoalCost(Q, EFFORT * torch.eye(2, dtype=torch.float64), FINAL * Q, none, none)
    mpc = LCSMPCLayer(module, cost, 10, -1.0, 1.0, on_failure="mask", relaxation=1e-5)
    places = BodyPlaces(module, "cart", ["pusher"], gap=0.04, reach=0.3)
    travel = BodyTravel(places, clearance=0.2, tolerance=0.04, step=1.0)
    return module, SamplingPolicy(mpc, places, travel, SETTINGS)


def beginnings(episodes: int, seed: int) -> np.ndarray:
    """Draw where the two cylinders begin (episodes, 4), as Judo does."""
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi, (episodes, 2))
    return np.concatenate(
        [np.cos(angle[:, :1]), np.sin(angle[:, :1]), 2 * np.cos(angle[:, 1:]), 2 * np.sin(angle[:, 1:])], 1
    )


class Planner:
    """Contact MPC, asked at each step of the simulator, with a decision every 0.1 s."""

    def __init__(self, model: Any):
        self.module, self.policy = make_policy(model)

    def reset(self) -> None:
        """Begin an episode."""
        self.policy.reset()
        self.decisions = 0

    def control(self, data: Any) -> np.ndarray:
        """Return the controls (2,) of the next step of the simulator."""
        if data.time > self.decisions * SECONDS - 1e-9:
            self.decisions += 1
            x = self.module.state.to_state(data.qpos, data.qvel)
            self.last = self.module.control(x, torch.as_tensor(self.policy.act(x, [0.0, 0.0]))).numpy()
        return self.last


class Judo:
    """A planner of Judo, asked at each step of the simulator.

    Args:
        root: folder in which Judo is installed.
        name: of its optimizer.
        rollouts: None: its default.
    """

    def __init__(self, root: Path, name: str, rollouts: int | None):
        sys.path.append(str(root))
        from judo.controller import controller
        from judo.tasks import base

        base.download_and_extract_meshes = lambda **_: None  # those of other tasks
        self.controller = controller.make_controller("cylinder_push", name)
        if rollouts is not None:
            self.controller.optimizer_cfg.num_rollouts = rollouts

    def reset(self) -> None:
        """Begin an episode."""
        self.controller.reset()
        self.due = 0.0

    def control(self, data: Any) -> np.ndarray:
        """Return the controls (2,) of the next step of the simulator."""
        if data.time >= self.due - 1e-9:
            self.due += 1 / self.controller.controller_cfg.control_freq
            state = SimpleNamespace(qpos=data.qpos, qvel=data.qvel, time=data.time, sim_metadata={})
            self.controller.update_states(state)
            self.controller.update_action()
        return self.controller.action(data.time)


def play(model: Any, start: np.ndarray, planner: Any) -> tuple[float, float]:
    """Play an episode: how far from the origin the cylinder ends [m], and the CPU time of planning [s]."""
    data, used = mujoco.MjData(model), 0.0
    data.qpos[:] = start
    planner.reset()
    while data.time < DECISIONS * SECONDS - 1e-9:
        began = time.process_time()
        data.ctrl[:] = planner.control(data)
        used += time.process_time() - began
        mujoco.mj_step(model, data)
    return float(np.linalg.norm(data.qpos[2:4])), used


@torch.no_grad()
def main(o: Options) -> None:
    """Play episodes; print how far the cylinder ends from the origin."""
    torch.set_num_threads(1)
    model = mujoco.MjModel.from_xml_path(str(o.xml))
    own = o.planner == "contact-mpc"
    planner = Planner(model) if own else Judo(o.xml.parents[3], o.planner, o.rollouts)
    np.random.seed(o.seed)  # noqa: NPY002 (Judo draws from there)
    ends, seconds = np.transpose([play(model, start, planner) for start in beginnings(o.episodes, o.seed)])
    close = (ends < CLOSE).astype(float)
    low, high = wilson_interval(int(close.sum()), len(close))
    milliseconds = 1e3 * float(seconds.mean()) / (DECISIONS * SECONDS)
    print(f"{int(close.sum())} of {len(ends)} within 2 cm ({100 * low:.1f} to {100 * high:.1f} %);", end=" ")
    print(f"median {100 * np.median(ends):.2f} cm, worst {100 * ends.max():.2f} cm;")
    print(f"{milliseconds:.0f} ms of CPU for a second of the robot")
    if o.out is not None:
        record = json.loads(o.out.read_text()) if o.out.exists() else {"results": {}}
        name = o.planner if own or o.rollouts is None else f"{o.planner}, {o.rollouts} rollouts"
        record["results"][name] = {
            "machine": {**machine(), "mujoco": mujoco.__version__},
            "seed": o.seed,
            "episodes": o.episodes,
            "success_rate": float(close.mean()),
            "ci_low": low,
            "ci_high": high,
            "within_30_cm": float((ends < REACHED).mean()),
            "median_cm": 100 * float(np.median(ends)),
            "worst_cm": 100 * float(ends.max()),
            "cpu_ms_per_second": milliseconds,
        }
        save(o.out, record)


if __name__ == "__main__":
    main(tyro.cli(Options))
