"""Transfer: LCS-RL on six objects from scratch, against its main phase from the cube's model, at equal data.

`python reproduce/fig_transfer.py` draws the tracked results; `--rerun --preset smoke|quick|paper` computes them.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import report
from matplotlib.figure import Figure
from recipes import RECIPES
from records import Cell, select
from report import Tables, say
from units import METHODS, OBJECTS, TRANSFER

LABELS = {"scratch": "from scratch", "cube": "from the cube's model"}
COLORS = {"scratch": "#0072b2", "cube": "#d55e00"}
WHEN: dict[str, str | float] = {"2 min": 2.0, "6 min": 6.0, "final": "final"}
NOTE = "Differences: from the cube's model − from scratch, at equal data of the object."
Cells = dict[str, dict[str, Cell | None]]
"""Object → start → results."""


def success(cells: Cells) -> pd.DataFrame:
    """Make the table of success from either start."""
    columns = {"object": [task.replace("_", " ") for task in cells]}
    columns["cube's model, no data"] = [say(report.at(starts["cube"], 0.0)) for starts in cells.values()]
    for (label, when), start in ((pair, start) for pair in WHEN.items() for start in TRANSFER):
        columns[f"{label}: {LABELS[start]}"] = [say(report.at(starts[start], when)) for starts in cells.values()]
    return pd.DataFrame(columns)


def panel(figure: Figure, cells: Cells, stand_in: bool) -> None:
    """Draw the curves of all objects."""
    for axes, (task, starts) in zip(figure.subplots(2, 3, sharey=True).flat, cells.items(), strict=True):
        title = task.replace("_", " ") + (" (stand-in)" if stand_in else "")
        lines = [(cell, LABELS[start], COLORS[start], "-") for start, cell in starts.items()]
        report.draw_curves(axes, title, lines)
        if any(starts.values()):
            axes.legend(fontsize=8, frameon=False, loc="lower right")


def starts_of(rows: pd.DataFrame, task: str, recipe: str) -> dict[str, Cell | None]:
    """Select the results from either start, of the same seeds where there are some."""
    scratch, cube = (select(rows, task, method, recipe, start) for start, method in TRANSFER.items())
    if scratch is not None and cube is not None:
        same: Any = rows[rows.seed.isin(cube.scores.index)]
        paired = select(same, task, TRANSFER["scratch"], recipe)
        scratch = scratch if paired is None else paired
    return {"scratch": scratch, "cube": cube}


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write a figure for each recipe, and the tables."""
    tables, said, used, figures = Tables(), [], [], {}
    for recipe in METHODS["lcs-rl"]:
        cells: Cells = {task: starts_of(rows, task, recipe) for task in OBJECTS}
        if not any(starts["cube"] for starts in cells.values()):
            continue
        used += [cell for starts in cells.values() for cell in starts.values() if cell is not None]
        label = RECIPES[recipe].label
        tables[f"LCS-RL from scratch and from the cube's model, {label}: success [%]"] = success(cells)
        pairs = {task.replace("_", " "): (starts["cube"], starts["scratch"]) for task, starts in cells.items()}
        tables[f"The differences, {label}"] = report.differences("object", pairs, WHEN)
        found = report.verdicts(pairs, WHEN)
        said += [f"From the cube's model against from scratch, {label}, {time}: {v}." for time, v in found.items()]
        figure = Figure((10.0, 6.4), dpi=150, layout="constrained")
        panel(figure, cells, name.endswith("stand-in"))
        figure.suptitle(label)
        stem = name if recipe == "ours" else f"{name}-{recipe}-recipe"
        report.write_figure(figure, folder, stem)
        figures[stem] = f"From scratch and from the cube's model, {label}"
    if tables:
        report.write_tables(folder, name, tables, [NOTE, *report.bullets(said), *report.provenance(used)], figures)
    return bool(tables)


main = partial(report.main, "fig_transfer", "transfer", draw)

if __name__ == "__main__":
    sys.exit(main())
