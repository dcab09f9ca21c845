"""Transfer: LCS-RL on six objects from scratch, against its main phase from the cube's model, at equal data.

The cube's model is the final LCS-RL model of the same seed, which has seen 30 minutes of the cube. It takes the place
of the warm-up.

`python reproduce/fig_transfer.py` draws the tracked results; `--rerun --preset smoke|quick|paper` computes them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import report
from records import Cell, Row, select
from report import Draw, Grid
from runs import command_line
from units import OBJECTS, STARTS, transfer

LABELS = {"scratch": "from scratch", "cube": "from the cube's model"}
COLORS = {"scratch": "#0072b2", "cube": "#d55e00"}
WHEN: dict[str, str | float] = {"6 min": 6.0, "final": "final"}

Cells = dict[str, dict[str, Cell | None]]


def cells_of(rows: Sequence[Row]) -> Cells:
    """Object → start → results."""
    kinds = {start: transfer(OBJECTS[0], 0, start) for start in STARTS}
    return {
        task: {start: select(rows, task, unit.method, unit.recipe, start) for start, unit in kinds.items()}
        for task in OBJECTS
    }


def table(cells: Cells) -> Grid:
    """Success from either start, and the paired difference."""
    header = ["object", "cube's model, no data"]
    for label in WHEN:
        header += [f"{label}: from scratch", "from the cube", "difference", "p"]
    lines = []
    for task, starts in cells.items():
        line = [task.replace("_", " "), report.plus_minus(report.at(starts["cube"], 0.0))]
        for when in WHEN.values():
            line += [report.plus_minus(report.at(starts[start], when)) for start in STARTS]
            line += report.difference(report.paired(starts["cube"], starts["scratch"], when))
        lines.append(tuple(line))
    title = "LCS-RL from scratch and from the cube's model, mean ± standard deviation over the seeds [%]"
    return Grid(title, tuple(header), tuple(lines))


def draw(options: Draw) -> int:
    """Compute if asked for, then write figure and table; returns the exit code."""
    code, preset, rows, stand_ins = report.script("fig_transfer", "transfer", options)
    drawn = False
    for stand_in, chosen in ((False, rows), (True, stand_ins)):
        cells = cells_of(chosen)
        found = [cell for starts in cells.values() for cell in starts.values() if cell is not None]
        if not found:
            continue
        drawn = True
        figure = report.new_figure(10.0, 6.4)
        for axes, (task, starts) in zip(figure.subplots(2, 3, sharey=True).flat, cells.items(), strict=True):
            for start, cell in starts.items():
                report.draw_curve(axes, cell, LABELS[start], COLORS[start])
            report.style_axes(axes, task.replace("_", " ") + (" (stand-in)" if stand_in else ""))
            if any(starts.values()):
                axes.legend(fontsize=8, frameon=False, loc="lower right")
        name = report.stem("fig_transfer", preset, stand_in)
        report.write_figure(figure, options.results, name)
        report.write_tables(options.results, name, [table(cells)], report.provenance(found))
    if not drawn:
        raise report.nothing("fig_transfer", preset, options)
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return command_line(Draw, draw, arguments)


if __name__ == "__main__":
    sys.exit(main())
