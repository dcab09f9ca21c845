"""Table I: six YCB objects, peak and final success, violation loss only against LCS-RL: `python reproduce/table1.py`.

Without options the table is drawn from the tracked results. `--rerun --preset smoke|quick|paper` computes it.
"""

import itertools
import sys
from functools import partial
from pathlib import Path

import pandas as pd
import report
from recipes import RECIPES
from records import Cell, select
from report import Tables, say
from stats import bootstrap
from units import COMPARED, OBJECTS

WHEN = ("peak", "final")
LABELS = [task.replace("_", " ") for task in OBJECTS]
NOTE = (
    "Success in % of the goals, mean over the seeds; the paper's numbers: mean ± standard deviation. Peak: at the "
    "minute where the mean over the seeds is highest. Differences: LCS-RL − violation only, paired by seed, with the "
    "two-sided p of the t-test. All six: interquartile mean over objects and seeds; of the differences the mean; the "
    "bootstrap draws seeds within each object."
)
STAND_INS = "STAND-INS of boxes and cylinders: no results with the YCB objects."
_COLUMNS = (("violation", "peak"), ("lcs-rl", "peak"), ("violation", "final"), ("lcs-rl", "final"))
PAPER = {
    task: dict(zip(_COLUMNS, numbers, strict=True))
    for task, *numbers in (
        ("sugar_box", (87.5, 9.2), (95.9, 2.4), (44.3, 26.2), (95.9, 2.4)),
        ("fish_can", (59.1, 7.3), (69.9, 8.1), (38.8, 13.1), (69.9, 8.1)),
        ("mug", (32.5, 8.4), (44.6, 3.9), (10.0, 6.3), (44.6, 3.9)),
        ("wrench", (45.5, 8.7), (60.0, 6.5), (11.5, 8.6), (59.5, 6.6)),
        ("clamp", (24.7, 5.3), (39.3, 9.7), (6.1, 5.6), (38.7, 10.2)),
        ("banana", (28.4, 5.8), (35.5, 5.3), (7.5, 6.6), (35.5, 5.3)),
    )
}
"""The paper's: object → (method, when) → mean, standard deviation [%] of 10 seeds and 1000 goals."""
Cells = dict[str, list[Cell | None]]
"""Method → results on each object."""


def success(cells: Cells) -> pd.DataFrame:
    """Success on every object, ours beside the paper's."""
    columns = {"object": [*LABELS, "all six"]}
    for when, method in itertools.product(WHEN, COMPARED):
        name = f"{when}: {report.NAMES[method]}"
        estimates = [*(report.at(cell, when) for cell in cells[method]), report.over_objects(cells[method], when)]
        columns[name] = list(map(say, estimates))
        theirs = (PAPER[task][method, when] for task in OBJECTS)
        columns[f"{name}, paper"] = [*(f"{mean:.1f} ± {sd:.1f}" for mean, sd in theirs), report.MISSING]
    return pd.DataFrame(columns)


def differences(cells: Cells) -> pd.DataFrame:
    """LCS-RL − violation only."""
    columns = {"object": [*LABELS, "all six"]}
    for when in WHEN:
        found = [report.paired(*pair, when) for pair in zip(cells["lcs-rl"], cells["violation"], strict=True)]
        means, ps = zip(*map(report.say_difference, found), strict=True)
        columns[f"{when}: difference"] = [*means, say(bootstrap(found) if all(found) else None, signed=True)]
        columns[f"{when}: p"] = [*ps, report.MISSING]
    return pd.DataFrame(columns)


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write the tables of all recipes that there are results of."""
    tables: Tables = {}
    found: list[Cell | None] = []
    for recipe in ("ours", "paper"):
        label = RECIPES[recipe].label
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
