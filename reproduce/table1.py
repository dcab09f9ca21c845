"""Table I: six YCB objects, peak and final success, violation loss only against LCS-RL: `python reproduce/table1.py`.

Without options the table is drawn from the tracked results. `--rerun --preset smoke|quick|paper` computes it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import report
from paper import TABLE1
from records import Cell, Row, select
from report import Draw, Grid
from runs import command_line
from units import OBJECTS

METHODS = ("violation", "lcs-rl")
WHEN = ("peak", "final")
RECIPES = {"ours": "our recipe", "paper": "the paper's recipe"}
PEAK = (
    "Mean ± standard deviation over the seeds [% of the goals]. Peak: at the minute where the mean over the seeds is "
    "highest. Differences: LCS-RL − violation only, paired by seed, with 95 % t-interval and two-sided p."
)


def tables(rows: Sequence[Row]) -> tuple[list[Grid], list[str]]:
    """The tables of all recipes that there are results of, and notes."""
    grids: list[Grid] = []
    cells: list[Cell | None] = []
    for recipe, name in RECIPES.items():
        table = {(task, method): select(rows, task, method, recipe) for task in OBJECTS for method in METHODS}
        if any(table.values()):
            grids += [_success(table, name), _differences(table, name)]
            cells += table.values()
    return grids, [PEAK, *report.provenance(cells)]


def _success(table: dict[tuple[str, str], Cell | None], recipe: str) -> Grid:
    header = ["object"]
    for when in WHEN:
        for method in METHODS:
            header += [f"{when}: {report.NAMES[method]}", "paper"]
    lines = []
    for task in OBJECTS:
        line = [task.replace("_", " ")]
        for when in WHEN:
            for method in METHODS:
                line.append(report.plus_minus(report.at(table[task, method], when)))
                line.append(report.plus_minus(TABLE1[task][method, when]))
        lines.append(tuple(line))
    return Grid(f"Success on six objects, {recipe}", tuple(header), tuple(lines))


def _differences(table: dict[tuple[str, str], Cell | None], recipe: str) -> Grid:
    lines = []
    for task in OBJECTS:
        line = [task.replace("_", " ")]
        for when in WHEN:
            line += report.difference(report.paired(table[task, "lcs-rl"], table[task, "violation"], when))
        lines.append(tuple(line))
    header = ("object", "peak: difference", "p", "final: difference", "p")
    return Grid(f"LCS-RL − violation only, {recipe}", header, tuple(lines))


def draw(options: Draw) -> int:
    """Compute if asked for, then write the tables; returns the exit code."""
    code, preset, rows, stand_ins = report.script("table1", "table1", options)
    drawn = False
    for stand_in, chosen in ((False, rows), (True, stand_ins)):
        chosen = [row for row in chosen if row.task in OBJECTS and row.start == "scratch"]
        if chosen:
            drawn = True
            grids, notes = tables(chosen)
            if stand_in:
                notes = ["STAND-INS of boxes and cylinders: no results with the YCB objects.", *notes]
            report.write_tables(options.results, report.stem("table1", preset, stand_in), grids, notes)
    if not drawn:
        raise report.nothing("table1", preset, options)
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return command_line(Draw, draw, arguments)


if __name__ == "__main__":
    sys.exit(main())
