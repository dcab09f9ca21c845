"""Every shape of gym-pushany by sampling-based contact MPC: `python benchmarks/scoreboard/pushany.py --episodes 50`.

The environment (gym-pushany 0.1.13, after Push-T) is as its author publishes it: 21 shapes, its own starts, goals and
success flag (more than 95 % of the goal covered), 300 steps of 0.1 s, and up to four other bodies in the way, which can
be pushed, too. Only its pictures are not drawn. The policy is that of examples/push_t.py, with the outline, mass and
moment of the body, the goal, the true state, and the outlines of the bodies in the way, which it goes round.

Walls stop the body, not the disc, which is kinematic: it may go `--beyond` them, to push a body away from a wall.

The environment's seed draws the goal and how many bodies are in the way: those seeds are played that draw
`--obstacles`. It may draw a goal that lies across its walls. These are played, and count like others. Where no pose
inside the walls covers more than 95 % of the goal, it is out of reach; the success without these is printed beside
(`within_reach`, and the number of goals that are).
"""

import itertools
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from pusht import STEPS, Episode, Variant, play
from successes import success_figures, success_text

from difflcs.errors import InvalidInputError

sys.path.append(str(Path(__file__).resolve().parents[2] / "examples"))
from push_any import OBJECT_NAME_LIST, PushAnyPolicy, StateEnv

MOVED = 5  # px, from which on a body in the way counts as displaced


@dataclass
class Options:
    """Shapes of gym-pushany by sampling-based contact MPC."""

    episodes: int = 50
    """Episodes of each shape."""
    seed: int = 0
    """The first seed that may be played."""
    obstacles: int = 0
    """Bodies in the way, 0 to 4."""
    beyond: float = 40.0
    """How far the disc may go beyond the square of 512 px [px]."""
    learned: bool = False
    """Plan with what two minutes of random pushing teach about each shape."""
    blind: bool = False
    """Do not tell the policy what is in the way."""
    json: bool = False
    """Print a line of JSON of all shapes together."""
    smoke: bool = False
    """Two shapes, an episode of a few steps each."""


def find_seeds(o: Options) -> list[int]:
    """Find the seeds that draw this number of bodies in the way."""
    drawn = (s for s in itertools.count(o.seed) if np.random.RandomState(s).randint(0, 5) == o.obstacles)
    return list(itertools.islice(drawn, o.episodes))


class Played(NamedTuple):
    """An episode, whether its goal is within reach, and how far (n,) the bodies in the way were displaced [px]."""

    episode: Episode
    within_reach: bool
    displaced: NDArray[np.float64]


def figures(played: list[Played]) -> dict[str, Any]:
    """Compute the figures of episodes."""
    success, steps, _, milliseconds = np.array([one.episode for one in played], float).T
    reached = [one.episode.success for one in played if one.within_reach]
    displaced = np.concatenate([one.displaced for one in played])
    return {
        **success_figures(success),
        "mean_steps": float(steps.mean()),
        "milliseconds_per_step": float(milliseconds.sum() / steps.sum()),
        "within_reach": float(np.mean(reached)) if reached else None,
        "goals_within_reach": len(reached),
        "mean_displaced": float(displaced.mean()) if len(displaced) else 0.0,
        "displaced": float((displaced > MOVED).mean()) if len(displaced) else 0.0,
    }


def main(o: Options) -> None:
    """Run the episodes, print the figures of each shape and of all."""
    if not 0 <= o.obstacles <= 4:
        raise InvalidInputError(f"obstacles: expected 0 to 4, got {o.obstacles}")
    names = OBJECT_NAME_LIST
    if o.smoke:
        names, o.episodes = names[:2], 1
    torch.set_num_threads(1)
    everything: list[Played] = []
    for name in names:
        env = StateEnv(object_name=name)
        policy, limit = PushAnyPolicy(env, o.beyond, learned=o.learned, blind=o.blind), 5 if o.smoke else STEPS
        played: list[Played] = []
        for seed in find_seeds(o):
            settled = env.settled(seed)  # what moves because bodies overlap at the start is not displaced
            episode = play(env, policy, seed, Variant(), limit)
            played.append(Played(episode, env.within_reach, np.linalg.norm(env.others - settled, axis=1)))
        everything += played
        if not o.json:
            report(name, figures(played))
    if o.json:
        print(json.dumps({"obstacles": o.obstacles, **figures(everything)}))
    else:
        report("together", figures(everything))


def report(name: str, f: dict[str, Any]) -> None:
    """Print the figures of a shape."""
    reached, of = f["within_reach"], f["goals_within_reach"]
    within = "" if reached is None else f", {100 * reached:.1f} % of {of} within reach"
    within += f", others displaced by {f['mean_displaced']:.1f} px, {100 * f['displaced']:.0f} % of them"
    print(
        f"{name}: {success_text(f)}{within}; {f['mean_steps']:.1f} steps, {f['milliseconds_per_step']:.1f} ms a step",
        flush=True,
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
