"""Table I: six YCB objects, peak and final success, violation loss only against LCS-RL: `python reproduce/table1.py`.

Without options the table is drawn from the tracked results. `--rerun --preset smoke|quick|paper` computes it.
"""

from __future__ import annotations

import itertools
import sys
from functools import partial
from pathlib import Path

import pandas as pd
import report
from paper import TABLE1
from records import Cell, select
from report import Tables, say
from stats import bootstrap
from units import COMPARED, OBJECTS

WHEN = ("peak", "final")
ALL = "all six"
NOTE = (
    "Success in % of the goals, mean over the seeds; the paper's numbers: mean ± standard deviation. Peak: at the "
    "minute where the mean over the seeds is highest. Differences: LCS-RL − violation only, paired by seed, with the "
    "two-sided p of the t-test. All six: interquartile mean over objects and seeds; of the differences the mean; the "
    "bootstrap draws seeds within each object."
)
STAND_INS = "STAND-INS of boxes and cylinders: no results with the YCB objects."
Cells = dict[str, list[Cell | None]]
"""Method → results on each object."""


def success(cells: Cells) -> pd.DataFrame:
    """Success on every object, ours beside the paper's."""
    columns = [("object", [*(task.replace("_", " ") for task in OBJECTS), ALL])]
    for when in WHEN:
        for method in COMPARED:
            ours = [report.at(cell, when) for cell in cells[method]]
            theirs = [f"{mean:.1f} ± {sd:.1f}" for mean, sd in (TABLE1[task][method, when] for task in OBJECTS)]
            mean = report.over_objects(cells[method], when)
            columns.append((f"{when}: {report.NAMES[method]}", [*map(say, ours), say(mean)]))
            columns.append(("paper", [*theirs, report.MISSING]))
    return _table(columns)


def differences(cells: Cells) -> pd.DataFrame:
    """LCS-RL − violation only."""
    columns = [("object", [*(task.replace("_", " ") for task in OBJECTS), ALL])]
    for when in WHEN:
        found = [report.paired(*pair, when) for pair in zip(cells["lcs-rl"], cells["violation"], strict=True)]
        means, ps = zip(*map(report.say_difference, found), strict=True)
        mean = bootstrap(found) if all(found) else None
        columns += [(f"{when}: difference", [*means, say(mean, signed=True)]), ("p", [*ps, report.MISSING])]
    return _table(columns)


def _table(columns: list[tuple[str, list[str]]]) -> pd.DataFrame:
    """Two columns may have the same name."""
    names, values = zip(*columns, strict=True)
    return pd.DataFrame(dict(enumerate(values))).set_axis(list(names), axis=1)


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write the tables of all recipes that there are results of."""
    tables: Tables = {}
    found: list[Cell | None] = []
    for recipe, label in report.RECIPES.items():
        cells: Cells = {method: [select(rows, task, method, recipe) for task in OBJECTS] for method in COMPARED}
        if any(map(any, cells.values())):
            tables[f"Success on six objects, {label}"] = success(cells)
            tables[f"LCS-RL − violation only, {label}"] = differences(cells)
            found += itertools.chain(*cells.values())
    if tables:
        notes = [STAND_INS] * name.endswith("stand-in") + [NOTE, *report.provenance(found)]
        report.write_tables(folder, name, tables, notes)
    return bool(tables)


main = partial(report.main, "table1", "table1", draw)

if __name__ == "__main__":
    sys.exit(main())
