"""Ablations: LCS-RL without one of its parts, on the cube and on the banana: `python reproduce/ablations.py`.

Without options table and figure are drawn from the tracked results. `--rerun --preset smoke|quick|paper` computes them.
"""

import sys
from functools import partial
from pathlib import Path

import pandas as pd
import report
from matplotlib.figure import Figure
from recipes import ABLATIONS
from records import Cell, select
from report import Tables, say
from units import ABLATED, ABLATION_TASKS

LATE: dict[str, str | float] = {"10 min": 10.0, "final": "final"}
WHEN = {"6 min": 6.0, **LATE}
LABELS = {
    **{name: f"with {recipe.label}".replace("with without", "without") for name, recipe in ABLATIONS.items()},
    "no-warm-up": "without warm-up",
    "all": "all parts",
}
NOTE = "LCS-RL in our recipe, without one of its parts each. Differences: without the part − with all, paired by seed."
Cells = dict[str, Cell]
"""Ablation → results; the recipe with all of its parts under its own name, "all"."""


def table(cells: Cells) -> pd.DataFrame:
    """Make the table of success with and without each part, and of the paired differences."""
    pairs = {LABELS[name]: (None if name == "all" else cell, cells["all"]) for name, cell in cells.items()}
    success = {label: [say(report.at(cell, when)) for cell in cells.values()] for label, when in WHEN.items()}
    apart = report.differences("", pairs, LATE)
    return pd.concat([apart[[""]], pd.DataFrame(success), apart.drop(columns="")], axis=1)


def words(cells: Cells, task: str) -> list[str]:
    """Describe the differences of every part by their intervals, at 10 minutes and at the end."""
    said = []
    for label, when in LATE.items():
        apart = {LABELS[n]: report.paired_estimate(c, cells["all"], when) for n, c in cells.items() if n != "all"}
        better, worse, _, unknown = report.sides(apart)
        left = f"; {report.UNTOLD}: {report.listed(unknown)}" if unknown else ""
        higher, lower = report.listed(better), report.listed(worse)
        said.append(f"On the {task}, {label}, success is lower by its interval: {lower}; higher: {higher}{left}.")
    return said


def panel(figure: Figure, cells: dict[str, Cells]) -> None:
    """Draw the differences with their intervals, at 10 minutes and at the end."""
    names = [name for name in ABLATED if any(name in results for results in cells.values())]
    for axes, (task, results) in zip(
        figure.subplots(1, len(cells), sharey=True, squeeze=False)[0], cells.items(), strict=True
    ):
        for offset, (label, when, color) in enumerate((("10 min", 10.0, "#56b4e9"), ("final", "final", "#0072b2"))):
            axes.plot([], [], "o", color=color, label=label)
            for row, name in enumerate(names):
                apart = report.paired_estimate(results.get(name), results["all"], when)
                if apart is not None:
                    y = -row - 0.2 * offset
                    axes.plot([apart.low, apart.high], [y, y], color=color, lw=2)
                    axes.plot(apart.value, y, "o", color=color)
        axes.axvline(0.0, color="grey", lw=0.8)
        axes.set(title=task, xlabel="difference in success [points]", yticks=[-r - 0.1 for r in range(len(names))])
        axes.set_yticklabels([LABELS[name] for name in names])
        axes.grid(alpha=0.25, axis="x")
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=8, frameon=False)


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write figure and tables."""
    shown: dict[str, Cells] = {}
    for task in ABLATION_TASKS:
        full = select(rows, task, "lcs-rl", "ours")
        parts = {name: select(rows, task, *unit) for name, unit in ABLATED.items()}
        cells = {name: cell for name, cell in parts.items() if cell is not None}
        if full is not None and cells:
            shown[task] = {"all": full, **cells}
    if not shown:
        return False
    figure = Figure((9.0, 3.6), dpi=150, layout="constrained")
    panel(figure, shown)
    report.write_figure(figure, folder, name)
    tables: Tables = {f"Without one part, {task}: success [%]": table(cells) for task, cells in shown.items()}
    used = [cell for cells in shown.values() for cell in cells.values()]
    said = [line for task, cells in shown.items() for line in words(cells, task)]
    report.write_tables(
        folder, name, tables, [NOTE, *report.bullets(said), *report.provenance(used)], {name: "What each part is worth"}
    )
    return True


main = partial(report.main, "ablations", "ablations", draw)

if __name__ == "__main__":
    sys.exit(main())
