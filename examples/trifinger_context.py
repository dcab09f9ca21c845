"""TriFinger pushes a cube about which it was told the wrong size or friction, and finds out while it pushes.

`python examples/trifinger_context.py --side 3 --friction 3 [--adapt] [--goals 1000] [--seed 5000]`. The physics is that
of `zoo:trifinger-cube-contact-lcs`, but for the side of the cube (6 cm) and the friction (a factor), which are as told.
With `--adapt`, 27 hypotheses, nine sides and three frictions, predict every step of every robot, and each robot plans
with the one that has explained its motion best: the filter of `context_filter.py`, for many robots at once. Every
episode begins with what was told; 20 steps of 0.1 s are all it has.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import gymnasium
import torch
import tyro
from push_t import scaled
from torch import Tensor

from difflcs import LCSMPCLayer, LCSParams
from difflcs.physics import ContactLCS, PlanarPushing
from difflcs.rl import TrainedPolicy, wilson_interval
from difflcs.rl.rollout import ignore_solver_warnings
from difflcs_envs.trifinger.task import EPISODE_STEPS

SIDE = 6.0  # of the cube [cm]
SIDES, FRICTIONS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5), (1 / 3, 1.0, 3.0)  # in parts of the truth
SPREAD, RELATIVE, MOST = 0.002, 0.3, 3.0
"""Predictions are off by 2 mm and 30 % of how far the cube moves; no step counts for more than 3 nats."""
COUNTS = torch.tensor([1.0, 1.0, 0.03, *[0.5] * 6], dtype=torch.float64)
"""How much an error of each state counts [m, or of the yaw at 3 cm from the middle]; tips are predicted worse."""
BELIEF = 0.1
"""Nats by which a hypothesis begins behind what was told, for each factor e that it differs by."""


@dataclass
class Options:
    """Push a cube about which one was told something wrong."""

    side: float = SIDE
    """Side of the cube that is told [cm]; it has 6."""
    friction: float = 1.0
    """Friction that is told, in parts of the true one."""
    adapt: bool = False
    """Find them from the motion."""
    goals: int = 200
    """Episodes, all at once."""
    seed: int = 5000
    """Of the first episode; the others count up."""
    json: bool = False
    """Print the figures as JSON."""


class Hypotheses:
    """Physics of a cube of several sides and frictions, and how well each explains what each of n robots has seen.

    Args:
        physics: the true one.
        told: side and friction that are told, in parts of the truth.
        others: those that may be true besides.
        n: robots.
    """

    def __init__(self, physics: PlanarPushing, told: tuple[float, float], others: list[tuple[float, float]], n: int):
        self.contexts = [told, *others]
        assert physics.gyration is not None
        self.systems = [
            physics.replace(
                shape=scaled(physics.shape, side),
                gyration=side * physics.gyration,
                friction=friction * physics.friction,
            )
            for side, friction in self.contexts
        ]
        far = [sum(abs(math.log(a / b)) for a, b in zip(context, told, strict=True)) for context in self.contexts]
        self.log_likelihood = -BELIEF * torch.tensor(far, dtype=torch.float64).repeat(n, 1)

    def best(self, x: Tensor) -> LCSParams:
        """Make the system of each robot's best hypothesis, at states x (n, n_x)."""
        chosen, fields = self.log_likelihood.argmax(1), {}
        for k in chosen.unique().tolist():
            robots = (chosen == k).nonzero().squeeze(1)
            for name, value in self.systems[k].params(x[robots]).tensors().items():
                rank = 1 if name in ("c", "d") else 2
                fields.setdefault(name, value.new_empty(len(x), *value.shape[-rank:]))[robots] = value
        return LCSParams(**fields)

    def update(self, x: Tensor, u: Tensor, x_next: Tensor) -> None:
        """Learn from a step of each robot: states (n, n_x) before and after, and actions (n, n_u)."""
        predicted = torch.stack([system.params(x).step(x, u).x_next for system in self.systems], 1)
        moved = (x_next - x)[:, None, :2].norm(dim=-1, keepdim=True)
        error = COUNTS * (predicted - x_next[:, None]) / (SPREAD + RELATIVE * moved)
        loss = 0.5 * error.square().sum(-1)
        self.log_likelihood -= (loss - loss.min(1, keepdim=True).values).clamp_max(MOST)


@torch.no_grad()
def main(o: Options) -> None:
    """Play the episodes and print how many succeed."""
    policy = TrainedPolicy.open("zoo:trifinger-cube-contact-lcs").policy
    assert isinstance(policy, LCSMPCLayer)
    assert isinstance(policy.lcs, ContactLCS)
    told = (o.side / SIDE, o.friction)
    others = [(side, friction) for side in SIDES for friction in FRICTIONS if (side, friction) != told]
    hypotheses = Hypotheses(policy.lcs.physics, told, others if o.adapt else [], o.goals)
    envs = gymnasium.make_vec("difflcs/TriFingerMoveCube-v0", num_envs=o.goals, vectorization_mode="vector_entry_point")
    observed, guess, info = envs.reset(seed=o.seed)[0], None, {}
    for _ in range(EPISODE_STEPS):
        x, goal = (torch.as_tensor(observed[name], dtype=torch.float64).clone() for name in ("state", "goal"))
        with ignore_solver_warnings():
            plan = policy(x, goal, lcs=hypotheses.best(x), guess=guess)
        observed, _, _, _, info = envs.step(plan.action.numpy())
        if o.adapt:
            hypotheses.update(x, plan.action, torch.as_tensor(observed["state"], dtype=torch.float64))
        guess = plan.shift()
    envs.close()
    successes = int(info["success"].sum())
    low, high = wilson_interval(successes, o.goals)
    found = torch.tensor(hypotheses.contexts)[hypotheses.log_likelihood.argmax(1)]
    figures = {
        "success_rate": successes / o.goals,
        "ci_low": low,
        "ci_high": high,
        "episodes": o.goals,
        "side_cm": SIDE * float(found[:, 0].median()),
        "friction": float(found[:, 1].median()),
    }
    print(
        json.dumps(figures)
        if o.json
        else f"{successes} of {o.goals} goals reached [{100 * low:.1f}, {100 * high:.1f}]; at the end the median robot "
        f"takes the cube for {figures['side_cm']:.1f} cm wide, with {figures['friction']:.2g} of its friction"
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
