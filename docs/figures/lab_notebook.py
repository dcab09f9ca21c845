"""Draw docs/figures/lab_notebook.png from lab_notebook.csv: every training of the lab notebook as a point."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from statistics import mean

import matplotlib as mpl

mpl.use("Agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).parent


def main() -> None:
    """Draw the picture."""
    found: dict[tuple[str, str], dict[int, float]] = defaultdict(dict)
    with (HERE / "lab_notebook.csv").open() as file:
        for row in csv.DictReader(file):
            found[row["phase"], row["change"]][int(row["seed"])] = float(row["success"])
    fig, axes = plt.subplots(
        2,
        1,
        figsize=(9.5, 1.5 + 0.165 * len(found)),
        sharex=True,
        gridspec_kw={"height_ratios": [6, sum(phase == "main" for phase, _ in found)]},
        layout="constrained",
    )
    titles = {"warm-up": "after the warm-up (6 minutes)", "main": "after the main phase (30 minutes)"}
    for ax, (phase, title) in zip(axes, titles.items(), strict=True):
        changes = sorted(
            (change for p, change in found if p == phase), key=lambda c: mean(found[phase, c].values()), reverse=False
        )
        for y, change in enumerate(changes):
            runs = found[phase, change]
            for seed, success in runs.items():
                ax.plot(success, y, "o", color=f"C{seed - 1}", alpha=0.8, markersize=6)
            ax.plot(mean(runs.values()), y, "|", color="black", markersize=14, markeredgewidth=2)
        ax.set_yticks(range(len(changes)), changes, fontsize=8)
        ax.set_ylim(-1, len(changes))
        ax.set_title(title, fontsize=10)
        ax.grid(axis="x", alpha=0.3)
    axes[1].set_xlabel("success of 1000 goals, one training each (bar: mean)")
    seeds = [plt.Line2D([], [], marker="o", linestyle="", color=f"C{s - 1}", label=f"seed {s}") for s in range(1, 5)]
    axes[1].legend(handles=seeds, fontsize=8, loc="upper left")
    fig.savefig(HERE / "lab_notebook.png", dpi=110)


if __name__ == "__main__":
    main()
