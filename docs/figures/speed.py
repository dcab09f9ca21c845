"""Draws speed.png from benchmarks/results/race_avx512.json: times of the fastest rival over ours.

`python docs/figures/speed.py`
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).parent
RECORD = HERE.parents[1] / "benchmarks" / "results" / "race_avx512.json"
WAYS = {"batch": ("256 problems in one call", "#1f6f8b"), "one": ("one problem a call", "#d98032")}


def main() -> None:
    """Draw it."""
    found = json.loads(RECORD.read_text())["results"]["contact, best rival"]
    families = {name: row for name, row in found.items() if "rival" in row}
    fig, ax = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    for way, (label, color) in WAYS.items():
        for y, row in enumerate(families.values()):
            mean, low, high = row[way]
            place = -y
            ax.plot([low, high], [place, place], color=color, alpha=0.5, linewidth=3, solid_capstyle="round")
            ax.plot(mean, place, "o", color=color, markersize=6, label=None if y else label)
    ax.axvline(1, color="0.3", linewidth=1)
    ax.text(1.04, -len(families) + 0.55, "as fast as the rival", fontsize=10, color="0.3")
    ax.set_xscale("log")
    ax.set_xlim(0.9, 300)
    ax.set_ylim(-len(families) + 0.3, 0.6)
    ax.set_xticks([1, 3, 10, 30, 100], ["1×", "3×", "10×", "30×", "100×"], fontsize=11)
    ax.minorticks_off()
    ax.set_yticks([-y for y in range(len(families))], list(families), fontsize=11)
    ax.set_xlabel("CPU time of the fastest rival that solved all, over that of batched", fontsize=11)
    ax.grid(axis="x", alpha=0.25)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
    ax.legend(fontsize=11, loc="lower right", frameon=False, bbox_to_anchor=(1, 0.98), ncols=2)
    fig.savefig(HERE / "speed.png", dpi=150)


if __name__ == "__main__":
    main()
