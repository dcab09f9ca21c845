"""Push-T of gym-pusht by sampling-based contact MPC: `python benchmarks/scoreboard/pusht.py --episodes 500 --json`.

The environment is as its authors publish it: its start, success flag (more than 95 % of the goal covered by the T)
and limit (300 steps of 0.1 s). The policy of examples/push_t.py is given the state (place of the disc, pose of the T)
and, by variant:

- known: geometry, mass and drive as they are;
- learned: what is learned from two minutes of random pushing, see `examples/learn_push.py`;
- inertia, friction, outline: one of them wrong by 20 %, the outline also by 10 % (friction, which is zero, is taken for
  0.2); centre of mass: off by 12 px, a fifth of half the T's width;
- drive: stiffness wrong by 20 %; rough: disc and T have a friction of 0.5, and it is told 0;
- noise: every coordinate observed with a standard deviation of 2 px, the angle with that of 2 px at the T's radius of
  gyration;
- delay: actions come one step late, and the plan begins where the system predicts that it will be.

Times are CPU times of the policy, on one core. With `--out FILE`, variants that are in the file already are not played
again: after a change of the policy begin another file. `--variant all` plays all.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from difflcs.cli.bench import machine, save
from difflcs.errors import InvalidInputError

sys.path.append(str(Path(__file__).resolve().parents[2] / "examples"))
from learn_push import learn
from push_t import CENTER_OF_MASS, DRIVE, GYRATION, STEPS, PushTPolicy, make_env, play, tee, tee_pushing
from successes import success_figures, success_text


@dataclass(frozen=True)
class Variant:
    """Knowledge, observations and actions of the policy.

    Attributes:
        policy: makes it; its argument is the seed.
        noise: standard deviation of every observed coordinate [px].
        delay: steps by which its actions come late.
        friction: of disc and T in the environment, which has none.
    """

    policy: Callable[[int], PushTPolicy] = lambda seed: PushTPolicy()
    noise: float = 0.0
    delay: int = 0
    friction: float = 0.0


def told(**changes: Any) -> Variant:
    """Replace the system of the policy by another than the environment's."""
    return Variant(lambda seed: PushTPolicy(tee_pushing(**changes)))


VARIANTS = {
    "known": Variant(),
    "learned": Variant(lambda seed: PushTPolicy(learn(make_env(), seed).physics)),
    "inertia -20 %": told(gyration=GYRATION * 0.8**0.5),
    "inertia +20 %": told(gyration=GYRATION * 1.2**0.5),
    "centre of mass": told(center_of_mass=(0.0, CENTER_OF_MASS[1] + 0.12)),
    "drive -20 %": told(drive=replace(DRIVE, stiffness=80.0)),
    "drive +20 %": told(drive=replace(DRIVE, stiffness=120.0)),
    "rough": Variant(friction=0.5),
    "friction 0.2": told(friction=torch.tensor(0.2, dtype=torch.float64)),
    "outline -20 %": told(shape=tee(0.8)),
    "outline -10 %": told(shape=tee(0.9)),
    "outline +10 %": told(shape=tee(1.1)),
    "outline +20 %": told(shape=tee(1.2)),
    "noise 2 px": Variant(noise=2.0),
    "one step late": Variant(lambda seed: PushTPolicy(delay=1), delay=1),
}


@dataclass
class Options:
    """Push-T by sampling-based contact MPC."""

    episodes: int = 500
    """Episodes, of seeds `seed`, `seed` + 1, …"""
    seed: int = 0
    """Seed of the first episode."""
    variant: str = "known"
    """One of the variants, or "all"."""
    adapt: bool = False
    """Find scale of the outline, friction and drive while it runs, anew in each episode."""
    json: bool = False
    """Print a line of JSON for each variant."""
    out: Path | None = None
    """Path of the record of the variants' figures; none by default."""
    smoke: bool = False
    """Two episodes of a few steps."""


def measure(variant: Variant, o: Options, env: Any) -> dict[str, float]:
    """Compute the figures of a variant."""
    policy, limit = variant.policy(o.seed), 5 if o.smoke else STEPS
    policy.adapts = o.adapt
    changes = {name: getattr(variant, name) for name in ("noise", "delay", "friction")}
    episodes = [play(env, policy, o.seed + i, limit, **changes) for i in range(o.episodes)]
    success, steps, coverage, milliseconds = np.array(episodes, float).T
    return {
        **success_figures(success),
        "mean_steps": float(steps.mean()),
        "worst_steps": float(steps.max()),
        "milliseconds_per_step": float(milliseconds.sum() / steps.sum()),
        "coverage": float(coverage.mean()),
    }


def main(o: Options) -> None:
    """Run the episodes, print and write the figures."""
    if o.variant not in (*VARIANTS, "all"):
        raise InvalidInputError(f"variant: expected one of {', '.join(VARIANTS)}, or all, got {o.variant!r}")
    if o.smoke:
        o.episodes = min(o.episodes, 2)
    torch.set_num_threads(1)
    env = make_env()
    asked = {"episodes": o.episodes, "seed": o.seed, "smoke": o.smoke, **({"adapt": True} if o.adapt else {})}
    record = {"machine": machine(), "options": asked, "results": {}}
    if o.out is not None and o.out.exists():
        record = json.loads(o.out.read_text())
        if record["options"] != asked:
            raise InvalidInputError(f"out: expected a record of {asked}, got {record['options']}; name another file")
    for name in VARIANTS if o.variant == "all" else (o.variant,):
        figures = record["results"].get(name) or measure(VARIANTS[name], o, env)
        record["results"][name] = figures
        if o.out is not None:
            save(o.out, record)
        if o.json:
            print(json.dumps({"variant": name, **figures}))
            continue
        print(
            f"{name}: {success_text(figures)}, {figures['mean_steps']:.1f} steps, coverage {figures['coverage']:.3f}, "
            f"{figures['milliseconds_per_step']:.1f} ms a step"
        )
    env.close()


if __name__ == "__main__":
    main(tyro.cli(Options))
