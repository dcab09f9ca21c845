"""Transfer: LCS-RL on six objects from scratch, against its main phase from the cube's model, at equal data.

`python reproduce/fig_transfer.py` draws the tracked results; `--rerun --preset smoke|quick|paper` computes them.
"""

import sys
from functools import partial
from pathlib import Path

import pandas as pd
import report
from matplotlib.figure import Figure
from records import Cell, select
from report import say
from units import OBJECTS, TRANSFER

LABELS = {"scratch": "from scratch", "cube": "from the cube's model"}
COLORS = {"scratch": "#0072b2", "cube": "#d55e00"}
WHEN: dict[str, str | float] = {"6 min": 6.0, "final": "final"}
NOTE = "Differences: from the cube's model − from scratch, paired by seed, with the two-sided p of the t-test."
Cells = dict[str, dict[str, Cell | None]]
"""Object → start → results."""


def table(cells: Cells) -> pd.DataFrame:
    """Success from either start, and the paired difference."""
    columns = {"object": [task.replace("_", " ") for task in cells]}
    columns["cube's model, no data"] = [say(report.at(starts["cube"], 0.0)) for starts in cells.values()]
    for label, when in WHEN.items():
        for start in TRANSFER:
            columns[f"{label}: {LABELS[start]}"] = [say(report.at(starts[start], when)) for starts in cells.values()]
        found = [report.paired(starts["cube"], starts["scratch"], when) for starts in cells.values()]
        means, ps = zip(*map(report.say_difference, found), strict=True)
        columns |= {f"{label}: difference": list(means), f"{label}: p": list(ps)}
    return pd.DataFrame(columns)


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write figure and table."""
    cells = {task: {start: select(rows, task, m, "ours", start) for start, m in TRANSFER.items()} for task in OBJECTS}
    found = [cell for starts in cells.values() for cell in starts.values() if cell is not None]
    if not found:
        return False
    figure = Figure((10.0, 6.4), dpi=150, layout="constrained")
    for axes, (task, starts) in zip(figure.subplots(2, 3, sharey=True).flat, cells.items(), strict=True):
        title = task.replace("_", " ") + (" (stand-in)" if name.endswith("stand-in") else "")
        report.draw_curves(axes, title, [(cell, LABELS[start], COLORS[start]) for start, cell in starts.items()])
        if any(starts.values()):
            axes.legend(fontsize=8, frameon=False, loc="lower right")
    report.write_figure(figure, folder, name)
    title = "LCS-RL from scratch and from the cube's model, mean over the seeds [%]"
    report.write_tables(folder, name, {title: table(cells)}, [NOTE, *report.provenance(found)])
    return True


main = partial(report.main, "fig_transfer", "transfer", draw)

if __name__ == "__main__":
    sys.exit(main())
