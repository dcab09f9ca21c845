"""Judo's `cylinder_push`, contact MPC: `python examples/cylinder_push.py --xml DIR/judo/models/xml/cylinder_push.xml`.

A driven cylinder pushes another one, 50 cm wide and damped, to the origin; they begin anywhere on circles of 1 and 2 m.
The model is in the wheel of Judo (`pip install --target DIR --no-deps judo-rai`). There are 200 decisions of 0.1 s. The
contact MPC tells from which of 16 places round the cylinder a push is worth the most, and the pusher travels there.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs import GoalCost, LCSMPCLayer
from difflcs.physics.mujoco import MujocoLCS
from difflcs.planning import SamplingPolicy, SamplingSettings

SECONDS, DECISIONS, REACH = 0.1, 200, 0.56  # of a step, of an episode; from centre to centre as they nearly touch [m]
CLEAR, NEAR = 0.75, 0.8  # how far from the centre the pusher goes round, and where it counts as near [m]
WEIGHT, EFFORT, FINAL = 0.01, 0.0005, 30.0  # of the distance between the two, of the servos, and at the end
SETTINGS = SamplingSettings(travel_price=0.001, switch_price=0.002, smallest_gain=0.002)


@dataclass
class Options:
    """A cylinder that is pushed to the origin."""

    xml: Path
    """Judo's model."""
    episodes: int = 20
    """Episodes."""
    seed: int = 0
    """Seed of the beginnings."""


class Places:
    """Places round the cylinder; states are x, y of the pusher, of the cylinder, and their velocities."""

    def sample(self, x: Tensor) -> Tensor:
        """Return where the pusher may be, from the centre of the cylinder (16, 2)."""
        angle = torch.arange(16, dtype=x.dtype) * (2 * torch.pi / 16)
        return REACH * torch.stack([angle.cos(), angle.sin()], -1)

    def states(self, x: Tensor, places: Tensor) -> Tensor:
        """Return the state x with the pusher there, at rest."""
        states = x.repeat(len(places), 1)
        states[:, :2] = x[2:4] + places
        states[:, 4:] = 0.0
        return states

    def allowed(self, states: Tensor) -> Tensor:
        """All places are."""
        return torch.ones(len(states), dtype=torch.bool)

    def near(self, x: Tensor) -> bool:
        """Whether the pusher is near enough to push."""
        return float((x[:2] - x[2:4]).norm()) < NEAR


class Travel:
    """Ways round the cylinder."""

    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """Return how far the pusher is from where it is in other states [m]."""
        return (states[:, :2] - x[:2]).norm(dim=1)

    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """Return how far the servos pull, straight or along a circle."""
        here, there = x[:2] - x[2:4], target[:2] - x[2:4]
        begin, end = torch.atan2(here[1], here[0]), torch.atan2(there[1], there[0])
        turn = torch.remainder(end - begin + torch.pi, 2 * torch.pi) - torch.pi
        to = target[:2]
        if abs(turn) > 0.3:
            angle = begin + 0.5 * turn.sign()
            to = x[2:4] + CLEAR * torch.stack([angle.cos(), angle.sin()])
        return (3 * (to - x[:2]) - 0.3 * x[4:6]).clamp(-1, 1)

    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """Whether it is there."""
        return float((x[:2] - target[:2]).norm()) < 0.08


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
    mpc = LCSMPCLayer(module, cost, 10, -1.0, 1.0, on_failure="mask", relaxation=1e-4)
    return module, SamplingPolicy(mpc, Places(), Travel(), SETTINGS)


@torch.no_grad()
def main(o: Options) -> None:
    """Play episodes; print how far the cylinder ends from the origin."""
    torch.set_num_threads(1)
    model = mujoco.MjModel.from_xml_path(str(o.xml))
    module, policy = make_policy(model)
    random, data, ends, seconds = np.random.default_rng(o.seed), mujoco.MjData(model), [], []
    for _ in range(o.episodes):
        angle = random.uniform(0, 2 * np.pi, 2)
        mujoco.mj_resetData(model, data)
        data.qpos[:] = [np.cos(angle[0]), np.sin(angle[0]), 2 * np.cos(angle[1]), 2 * np.sin(angle[1])]
        policy.reset()
        for _ in range(DECISIONS):
            x = module.state.to_state(data.qpos, data.qvel)
            start = time.process_time()
            u = policy.act(x, [0.0, 0.0])
            seconds.append(time.process_time() - start)
            data.ctrl[:] = module.control(x, torch.as_tensor(u)).numpy()
            mujoco.mj_step(model, data, round(SECONDS / model.opt.timestep))
        ends.append(float(np.linalg.norm(data.qpos[2:4])))
    close = sum(end < 0.02 for end in ends)
    print(f"{close} of {len(ends)} within 2 cm; median {100 * np.median(ends):.2f} cm, worst {100 * max(ends):.2f} cm;")
    print(f"{1e3 * np.median(seconds):.1f} ms of CPU a decision (median)")


if __name__ == "__main__":
    main(tyro.cli(Options))
