"""Draws methods.png from benchmarks/results/objects.json and reproduce/results/paper.csv.

`python docs/figures/methods.py`

Above success over minutes of data on the cube, of methods that are told nothing, and apart of the one that is told the
outline; below at the end on all seven objects.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT / "reproduce"), str(HERE.parent)]
from records import path_of, read, select  # noqa: E402 (from the folders above)
from stats import Estimate, bootstrap  # noqa: E402
from tables import largest  # noqa: E402

Points = dict[float, list[float]]
"""Minutes of data → success [%] of each seed."""
OBJECTS = ("cube", "sugar_box", "fish_can", "mug", "wrench", "clamp", "banana")
NOTHING = {
    "lcs-rl": ("LCS-RL", "#d55e00"),
    "frame-lcs": ("LCS in the body's frame", "#56b4e9"),
    "pddm": ("PDDM (networks)", "#009e73"),
    "ppo": ("PPO without warm-up", "#e69f00"),
    "violation": ("violation loss only", "#0072b2"),
}
"""Methods that are told nothing → names, colours."""
OUTLINE = {
    "contact-lcs": ("ContactLCS", "#cc79a7"),
}
"""Those that are told the outline → names, colours."""


def recorded(task: str, method: str) -> Points:
    """From objects.json, of its largest evaluations. ContactLCS is without PPO up to minute 3, with it after that."""
    record = json.loads((ROOT / "benchmarks" / "results" / "objects.json").read_text())
    points: dict[float, dict[int, float]] = defaultdict(dict)
    for row in largest(record, task, method):
        points[float(row["minutes"])][row["seed"]] = 100 * row["success_rate"]
    return {minute: list(seeds.values()) for minute, seeds in sorted(points.items())}


def reproduced(task: str, method: str) -> Points:
    """From the runs of reproduce/, by the default settings."""
    cell = select(read(path_of(ROOT / "reproduce" / "results", "paper")), task, method, "ours")
    return {} if cell is None else {at: list(cell.at(at)) for at in cell.scores.columns}


def points_of(task: str, method: str) -> Points:
    """Of one method on one object."""
    return recorded(task, method) or reproduced(task, method)


def estimates(points: Points) -> dict[float, Estimate]:
    """Means over the seeds with intervals of 95 %."""
    return {minute: bootstrap([values]) for minute, values in points.items()}


def draw_minutes(axes: Axes, methods: dict[str, tuple[str, str]], title: str, lowest: float) -> None:
    """Methods on the cube, which are told the same."""
    for method, (label, color) in methods.items():
        points = points_of("cube", method)
        if not points:
            continue
        found = estimates(points)
        seeds = {len(values) for values in points.values()}
        amount = (
            f"{min(seeds)} seed{'s' * (min(seeds) > 1)}" if len(seeds) == 1 else f"{min(seeds)} to {max(seeds)} seeds"
        )
        axes.plot(list(found), [e.value for e in found.values()], "o-", ms=4, color=color, label=f"{label} ({amount})")
        low, high = [e.low for e in found.values()], [e.high for e in found.values()]
        axes.fill_between(list(found), low, high, color=color, alpha=0.2, linewidth=0)
    axes.set_ylim(lowest, 101)
    axes.set_xlim(0, 30.5)
    axes.set_title(title, loc="left", fontsize=12)
    axes.set_ylabel("goals reached [%]")
    axes.legend(fontsize=11, frameon=False, loc="lower right")


def draw_objects(axes: Axes) -> None:
    """The last evaluation on every object; that of ContactLCS after three minutes."""
    for k, method in enumerate(("contact-lcs", "lcs-rl", "violation")):
        _, color = {**NOTHING, **OUTLINE}[method]
        for y, task in enumerate(OBJECTS):
            points = points_of(task, method)
            minute = 3.0 if method == "contact-lcs" else max(points, default=0.0)
            if minute not in points:
                continue
            found = bootstrap([points[minute]])
            place = -y - 0.22 * (k - 1)
            axes.plot(
                [found.low, found.high], [place, place], color=color, alpha=0.5, linewidth=3, solid_capstyle="butt"
            )
            axes.plot(found.value, place, "o", color=color, ms=5)
    axes.set_xlim(0, 101)
    axes.set_yticks([-y for y in range(len(OBJECTS))], [task.replace("_", " ") for task in OBJECTS])
    axes.set_xlabel("goals reached [%], ContactLCS after 3 min, others after 30")


def main() -> None:
    """Draw it."""
    plt.rcParams["font.size"] = 12  # legible on a phone
    fig, (above, middle, below) = plt.subplots(
        3, 1, figsize=(7.0, 9.0), layout="constrained", height_ratios=[3, 1.2, 3]
    )
    draw_minutes(above, NOTHING, "told nothing", 0)
    draw_minutes(middle, OUTLINE, "told the outline", 79)
    middle.set_xlabel("minutes of data on the cube")
    draw_objects(below)
    for axes in (above, middle, below):
        axes.spines[["top", "right"]].set_visible(False)
    fig.savefig(HERE / "methods.png", dpi=150)


if __name__ == "__main__":
    main()
