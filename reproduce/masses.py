"""What the masses decide, which the paper does not name: six objects of 50 g and of 10 g: `python reproduce/masses.py`.

Without options the table is drawn from the tracked results. `--rerun --preset smoke|quick|paper` computes it.
"""

import sys
from functools import partial
from pathlib import Path

import pandas as pd
import report
from records import Cell, select
from report import Tables, say
from table1 import LABELS, PAPER, below, beyond_paper
from units import MASSES, OBJECTS

WHEN: dict[str, str | float] = {"6 min": 6.0, "final": "final"}
NOTE = "Success in % of the goals, mean over the seeds; the paper's numbers: mean ± standard deviation."
Cells = dict[str, list[Cell | None]]
"""Mass → results on each object."""


def table(cells: Cells) -> pd.DataFrame:
    """Success on objects of each mass, the paper's beside it."""
    columns = {"object": [*LABELS, "all six"]}
    for label, when in WHEN.items():
        for mass, found in cells.items():
            shown = [*(report.at(cell, when) for cell in found), report.over_objects(found, when)]
            columns[f"{label}: {mass}"] = [say(one) for one in shown]
    theirs = (PAPER[task]["lcs-rl", "final"] for task in OBJECTS)
    columns["final: paper"] = [*(f"{mean:.1f} ± {sd:.1f}" for mean, sd in theirs), report.MISSING]
    return pd.DataFrame(columns)


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write the table."""
    cells: Cells = {}
    for recipe in MASSES:
        found = [select(rows, task, "lcs-rl", recipe) for task in OBJECTS]
        if any(found):
            cells[f"{1000 * next(cell for cell in found if cell).first.mass:g} g"] = found
    if len(cells) < len(MASSES):
        return False
    words = [
        f"At {mass}, LCS-RL at the end against the paper's mean: {report.verdict(beyond_paper(found))}."
        for mass, found in cells.items()
    ]
    tables: Tables = {"LCS-RL by the paper's recipe, by the mass of the objects: success [%]": table(cells)}
    every = [cell for found in cells.values() for cell in found]
    report.write_tables(folder, name, tables, below(name, NOTE, words, every))
    return True


main = partial(report.main, "masses", "masses", draw)

if __name__ == "__main__":
    sys.exit(main())
