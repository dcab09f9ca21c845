"""Learning curves on the cube: LCS-RL, violation loss only, PPO without warm-up, PDDM.

`python reproduce/fig_learning_curves.py` draws the tracked results; `--rerun --preset smoke|quick|paper` computes them.
"""

import sys
from functools import partial
from pathlib import Path

import pandas as pd
import report
from matplotlib.figure import Figure
from recipes import RECIPES
from records import Cell, select
from report import NAMES
from units import METHODS

PAPER = {
    "lcs-rl": {6.0: 55.0, 25.0: 65.0, 30.0: 71.4},
    "violation": {7.0: 55.0, 30.0: 30.0},
    "ppo": {30.0: 10.0},
    "pddm": {30.0: 20.0},
}
"""Method → minutes of data → success [%], as the text has it (section "Results of the TriFinger Moving Cube Task").

The curves themselves were not read off the figure. Violation-only peaks at 55 % after 7 minutes and
stops at about 30 %; LCS-RL has the same success at 6 minutes, reaches 65 % after 25 minutes and 71.4 % at the end; PPO
without warm-up and PDDM end at 10 and 20 %. At 6 minutes 55 % is therefore a little too high.
"""
Cells = dict[tuple[str, str], Cell | None]
"""Method, one of its recipes → results."""


def table(cells: Cells) -> pd.DataFrame:
    """What the text of the paper says about the figure, and ours."""
    lines = []
    for (method, recipe), cell in cells.items():
        if cell is not None:
            label = report.name_of(method, recipe)
            said = ", ".join(f"{value:g} at {minute:g} min" for minute, value in PAPER[method].items())
            early, peak, late, final = (report.say(report.at(cell, when)) for when in (6.0, "peak", 24.0, "final"))
            lines.append([label, early, f"{peak} at {cell.minute('peak'):g} min", late, final, said])
    return pd.DataFrame(lines, columns=["method", "6 min", "peak", "24 min", "final", "paper (from its text)"])


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write figure and table."""
    cells: Cells = {(m, recipe): select(rows, "cube", m, recipe) for m in METHODS for recipe in METHODS[m]}
    if not any(cells.values()):
        return False
    figure = Figure((10.0, 4.8), dpi=150, layout="constrained")
    for axes, recipe in zip(figure.subplots(1, 2, sharey=True), ("ours", "paper"), strict=True):
        # A method without this recipe is on both sides.
        shown = {m: cells[m, recipe if recipe in known else known[0]] for m, known in METHODS.items()}
        report.draw_curves(
            axes, RECIPES[recipe].label, [(cell, NAMES[m], report.COLORS[m]) for m, cell in shown.items()]
        )
        if recipe == "paper":
            for method, said in PAPER.items():
                style = {"marker": "x", "s": 60, "zorder": 5, "clip_on": False, "color": report.COLORS[method]}
                axes.scatter(list(said), list(said.values()), **style)
            axes.scatter([], [], marker="x", color="grey", label="what the paper's text says")
        axes.legend(fontsize=8, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)
    report.write_figure(figure, folder, name)
    title = "Success on the cube, mean over the seeds [%]"
    report.write_tables(folder, name, {title: table(cells)}, report.provenance(list(cells.values())))
    return True


main = partial(report.main, "fig_learning_curves", "curves", draw)

if __name__ == "__main__":
    sys.exit(main())
