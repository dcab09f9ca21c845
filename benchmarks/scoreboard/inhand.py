"""In-hand turning by an Allegro hand: `python benchmarks/scoreboard/inhand.py --assets DIR --episodes 20 --json`.

Task and models are those of Jin (github.com/asu-iris/Complementarity-Free-Dexterous-Manipulation, 17 objects, 96.5 %
over all its tasks) and of IMPACT (github.com/JonasPflaume/IMPACT, MIT, 155 of 170), whose folders `xmls` and `assets`
DIR has to contain; or set DIFFLCS_INHAND_DIR. An object lies on the palm, its place normally distributed by 5 mm, its
yaw uniform in ±90°; the goal is 90° of yaw away, to either side. A decision moves the targets of 16 joint servos by
at most 0.1 rad, 0.2 rad for objects of 100 g, from where the joints are, and holds them for 50 steps of 2 ms.

- Success: 1 − (q·goal)² < 0.04, which is 23°, after each of 21 decisions in a row.
- Failure: 500 decisions, or the object's centre below 5 mm.
- An object is placed if it is within 2 cm of its target place as well: of a success at its end, or with `--position`,
  which plays on for it, in 21 decisions in a row.

Beyond the papers, `--axes any` turns by 30° to 90° about any axis, `--seconds 60` gives the next goal where one is
reached, until the object falls or the time is over, and `--tilt 30` inclines the hand. They can be combined.

The controller is that of `examples/allegro_turn.py`. Final figures are of seeds 5000 and up. Times are CPU times of one
core.
"""

import json
import os
import sys
import time
import warnings
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import torch
import tyro

from difflcs.cli.bench import machine, save
from difflcs.errors import ContactWarning, InvalidInputError

sys.path.append(str(Path(__file__).resolve().parents[2] / "examples"))
from allegro_turn import OBJECTS, SECONDS, HandPolicy, Settings, make_task
from recorded import Recorded
from successes import success_figures, success_text
from trifinger_turn import yaw_quaternion

COLUMNS = "object", "seed", "success", "placed", "dropped", "steps", "position_mm", "angle_deg", "goals"
PARTS = "plan", "rehearsal"
LIMIT, HELD, SUBSTEPS, LOST = 500, 21, 50, 0.005


@dataclass
class Options:
    """In-hand turning with an Allegro hand."""

    assets: Path = Path(os.environ.get("DIFFLCS_INHAND_DIR", "."))
    """Folder with the published `xmls` and `assets`."""
    objects: str = "all"
    """Names with commas; all: those that are there."""
    episodes: int = 20
    """Episodes of each object, of seeds `seed`, `seed` + 1, …"""
    seed: int = 0
    """Seed of the first episode."""
    position: bool = False
    """Play on until the object is in its place as well, within 2 cm."""
    axes: Literal["vertical", "any"] = "vertical"
    """Goals are turns of ±90° about the vertical, or of 30° to 90° about any axis, both uniform."""
    seconds: float | None = None
    """Goals follow one another for so long, each from the last (vertical) or from where the object is (any)."""
    tilt: float = 0.0
    """Degrees by which the hand is inclined, to a side drawn for each episode."""
    json: bool = False
    """Print a line of JSON for each object and for all."""
    out: Path | None = None
    """Where episodes are recorded, a line of JSON each, and not played again: take another after a change."""
    results: Path | None = None
    """File for the figures of each object and of all, with their episodes."""
    settings: Settings = field(default_factory=Settings)


def next_goal(random: np.random.RandomState, axes: str, last: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Draw the quaternion of the goal after `last`, where the object's is `now`."""
    turned, turn = np.zeros(4), yaw_quaternion(random.choice([-np.pi / 2, np.pi / 2]))
    if axes == "any":
        axis = random.randn(3)
        mujoco.mju_axisAngle2Quat(turn, axis / np.linalg.norm(axis), random.uniform(np.pi / 6, np.pi / 2))
    mujoco.mju_mulQuat(turned, turn, now if axes == "any" else last)
    return turned


def play(o: Options, name: str, seed: int) -> dict[str, Any]:
    """One episode."""
    model, data, place, goal = make_task(o.assets, name, seed)
    random = np.random.RandomState(100 + seed)  # of what the papers do not have
    side, tilt = 2 * np.pi * random.rand(), np.radians(o.tilt)
    model.opt.gravity[:] = 9.81 * np.array([np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side), -np.cos(tilt)])
    if o.axes == "any":
        goal = next_goal(random, o.axes, goal, data.qpos[-4:])
    limit = LIMIT if o.seconds is None else round(o.seconds / SECONDS)
    policy, held, goals, lost, steps = HandPolicy(model, data, place, goal, o.settings), np.zeros(2), 0, False, 0
    turned, times = None, []  # after so many decisions; milliseconds
    while (goals == 0 or o.seconds is not None) and not lost and steps < limit:
        marks = [time.thread_time()]
        action = policy.plan(data)
        marks.append(time.thread_time())
        data.ctrl[:] = policy.rehearse(data, action)
        if policy.waited >= 0:  # it does not open
            times.append(1e3 * np.diff([*marks, time.thread_time()]))
        mujoco.mj_step(model, data, SUBSTEPS)
        wrong = 1 - float(data.qpos[-4:] @ goal) ** 2
        apart = float(np.linalg.norm(data.qpos[-7:-4] - place))
        held = (held + 1) * (wrong < 0.04) * [1, apart < 0.02]  # by the angle, and with the place
        lost, steps = bool(data.qpos[-5] < LOST), steps + 1
        if turned is None and held[0] == HELD and not lost:
            turned = steps
        if held[int(o.position)] == HELD and not lost:
            goals, held = goals + 1, np.zeros(2)
            goal = next_goal(random, o.axes, goal, data.qpos[-4:])
            policy.aim(goal)
    return {
        "object": name,
        "seed": seed,
        "success": turned is not None,
        "placed": goals > 0 and apart < 0.02,
        "goals": goals,
        "dropped": lost,
        "steps": turned or steps,
        "position_mm": 1e3 * apart,
        "angle_deg": 2 * np.degrees(np.arcsin(np.sqrt(np.clip(wrong, 0, 1)))),
        "milliseconds": np.mean(times, 0).tolist(),
        "all_milliseconds": np.round(np.sum(times, 1), 2).tolist(),
    }


def figures(episodes: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of episodes; place, angle and steps are medians and means of successful ones."""
    good = [e for e in episodes if e["success"]] or episodes
    parts = np.average([e["milliseconds"] for e in episodes], 0, [len(e["all_milliseconds"]) for e in episodes])
    return {
        **success_figures(np.array([e["success"] for e in episodes], float)),
        "placed": sum(e["placed"] for e in episodes),
        "dropped": sum(e["dropped"] for e in episodes),
        "mean_steps": float(np.mean([e["steps"] for e in good])),
        "mean_goals": float(np.mean([e["goals"] for e in episodes])),
        "position_mm": float(np.median([e["position_mm"] for e in good])),
        "angle_deg": float(np.median([e["angle_deg"] for e in good])),
        "milliseconds_per_step": dict(zip(PARTS, parts.round(2).tolist(), strict=True)),
        "milliseconds_p99": float(np.percentile(np.concatenate([e["all_milliseconds"] for e in episodes]), 99)),
    }


def main(o: Options) -> None:
    """Play, print, record."""
    there = [name for name in OBJECTS if (o.assets / "xmls" / f"env_allegro_{name}.xml").exists()]
    names = there if o.objects == "all" else o.objects.split(",")
    if not names or set(names) - set(there):
        raise InvalidInputError(
            f"objects: expected some of {', '.join(there) or 'nothing'}, whose files are in {o.assets}, got "
            f"{o.objects!r}; pass --assets DIR with the published xmls/env_allegro_*.xml"
        )
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)
    recorded, results, episodes = Recorded(partial(play, o), o.out), {}, []
    for name in [*names, "all"]:
        keys = [(n, o.seed + i) for n in names for i in range(o.episodes) if name in (n, "all")]
        episodes = recorded.episodes(keys)
        results[name] = found = figures(episodes)
        text = ", ".join(f"{key} {value:.4g}" for key, value in found.items() if isinstance(value, (int, float)))
        print(json.dumps({"object": name, **found}) if o.json else f"{name}: {success_text(found)}; {text}", flush=True)
    if o.results is not None:
        asked = {key: getattr(o, key) for key in ("seed", "position", "axes", "seconds", "tilt")}
        record = {"machine": machine(), **asked, "settings": asdict(o.settings), "results": results}
        save(o.results, {**record, "columns": COLUMNS, "rows": [[e[c] for c in COLUMNS] for e in episodes]})


if __name__ == "__main__":
    main(tyro.cli(Options))
