"""Success by mass, which the paper does not state: six objects of 50 g and of 10 g: `python reproduce/masses.py`.

Without options the table is drawn from the tracked results. `--rerun --preset smoke|quick|paper` computes it.
"""

import sys
from functools import partial
from pathlib import Path

import pandas as pd
import report
from records import Cell, select
from report import Tables
from table1 import LABELS, PAPER, below, beyond_paper, column
from units import MASSES, OBJECTS

WHEN: dict[str, str | float] = {"6 min": 6.0, "final": "final"}
NOTE = "Success in % of the goals, mean over the seeds; the paper's numbers: mean ± standard deviation."
Cells = dict[str, list[Cell | None]]
"""Mass → results on each object."""


def table(cells: Cells) -> pd.DataFrame:
    """Make the table of success on objects of each mass, with the paper's."""
    columns = {"object": [*LABELS, "all six"]}
    for label, when in WHEN.items():
        for mass, results in cells.items():
            columns[f"{label}: {mass}"] = column(results, when)
    theirs = (PAPER[task]["lcs-rl", "final"] for task in OBJECTS)
    columns["final: paper"] = [*(f"{mean:.1f} ± {sd:.1f}" for mean, sd in theirs), report.MISSING]
    return pd.DataFrame(columns)


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write the table."""
    cells: Cells = {}
    for recipe in MASSES:
        results = [select(rows, task, "lcs-rl", recipe) for task in OBJECTS]
        if any(results):
            cells[f"{1000 * next(cell for cell in results if cell).first.mass:g} g"] = results
    if len(cells) < len(MASSES):
        return False
    words = [
        f"At {mass}, LCS-RL at the end against the paper's mean: {report.verdict(beyond_paper(results))}."
        for mass, results in cells.items()
    ]
    tables: Tables = {"LCS-RL by the paper's recipe, by the mass of the objects: success [%]": table(cells)}
    every = [cell for results in cells.values() for cell in results]
    report.write_tables(folder, name, tables, below(name, NOTE, words, every))
    return True


main = partial(report.main, "masses", "masses", draw)

if __name__ == "__main__":
    sys.exit(main())
