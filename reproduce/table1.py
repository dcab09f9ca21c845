"""Table I: six YCB objects, peak and final success, violation loss only against LCS-RL: `python reproduce/table1.py`.

Without options the table is drawn from the tracked results. `--rerun --preset smoke|quick|paper` computes it.
"""

import itertools
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import pandas as pd
import report
from fig_learning_curves import PRIOR
from recipes import RECIPES
from records import Cell, select
from report import Tables, say
from stats import Estimate, apart, bootstrap, published
from units import COMPARED, OBJECTS

WHEN = ("peak", "final")
LABELS = [task.replace("_", " ") for task in OBJECTS]
NOTE = (
    "Success in % of the goals, mean over the seeds; the paper's numbers: mean ± standard deviation. Violation only is "
    "with full bounds where nothing else is said, as in the paper. Peak: at the minute where the mean over the seeds "
    "is highest. All six: interquartile mean over objects and seeds; of differences the mean."
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
WAYS = (
    ("ours", "full"), ("paper", "full"), ("jin-posa", "task"),
    ("ours", "support"), ("paper", "support"), ("jin-posa", "support"),
)  # fmt: skip
"""Recipes of violation-only and how its models are deployed: first with the full bounds, then within the support."""
Cells = list[Cell | None]
"""Results on each object."""


def success(cells: Mapping[str, Cells]) -> pd.DataFrame:
    """Make the table of success of each method on every object, ours and the paper's."""
    columns = {"object": [*LABELS, "all six"]}
    for when, method in itertools.product(WHEN, COMPARED):
        name = f"{when}: {report.NAMES[method]}"
        columns[name] = column(cells[method], when)
        theirs = (PAPER[task][method, when] for task in OBJECTS)
        columns[f"{name}, paper"] = [*(f"{mean:.1f} ± {sd:.1f}" for mean, sd in theirs), report.MISSING]
    return pd.DataFrame(columns)


def column(cells: Cells, when: str | float) -> list[str]:
    """Make the column of success on each object and on all."""
    return [say(value) for value in (*(report.at(cell, when) for cell in cells), report.over_objects(cells, when))]


def differences(cells: Cells, baseline: Cells) -> pd.DataFrame:
    """Compute LCS-RL − a baseline, on each object and on all."""
    pairs = dict(zip(LABELS, zip(cells, baseline, strict=True), strict=True))
    table = report.differences("object", pairs, {when: when for when in WHEN})
    last = ["all six"]
    for when in WHEN:
        paired = [report.paired(*pair, when) for pair in pairs.values()]
        last += [say(bootstrap(paired) if all(paired) else None, signed=True), report.MISSING]
    table.loc[len(table)] = last
    return table


def beyond_paper(cells: Cells) -> dict[str, Estimate | None]:
    """Compute the final success of LCS-RL − the paper's, with both intervals; None below `report.FEWEST` seeds."""
    differences = {}
    for task, label, cell in zip(OBJECTS, LABELS, cells, strict=True):
        ours = report.at(cell, "final") if cell and len(cell.scores) >= report.FEWEST else None
        differences[label] = ours and apart(ours, published(*PAPER[task]["lcs-rl", "final"]))
    return differences


def below(name: str, note: str, words: Sequence[str], cells: Cells) -> list[str]:
    """List the notes below a table: whether the objects are stand-ins, a note, sentences, the origin of the numbers."""
    return [STAND_INS] * name.endswith("stand-in") + [note, *report.bullets(words), *report.provenance(cells)]


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write the tables of all recipes that have results."""
    tables, words, used = Tables(), [], Cells()

    def cells_of(*what: str) -> Cells:
        cells = [select(rows, task, *what) for task in OBJECTS]
        used.extend(cells)
        return cells

    prior = {
        report.name_of("violation", recipe, protocol=protocol): cells_of("violation", recipe, "scratch", protocol)
        for recipe, protocol in WAYS
    }
    prior = {label: cells for label, cells in prior.items() if any(cells)}
    known = {label: sum(cell is not None for cell in cells) for label, cells in prior.items()}
    strongest = max(prior, key=lambda label: (known[label], report.mean_over(prior[label], "final")), default=None)
    for recipe in ("ours", "paper"):
        label, cells = RECIPES[recipe].label, {method: cells_of(method, recipe) for method in COMPARED}
        if not any(map(any, cells.values())):
            continue
        tables[f"Success on six objects, {label}"] = success(cells)
        baselines = [report.name_of("violation", recipe), strongest, report.name_of(*PRIOR[:2], protocol=PRIOR[2])]
        words.append(
            f"LCS-RL, {label}, at the end against the paper's mean: {report.verdict(beyond_paper(cells['lcs-rl']))}."
        )
        for against in dict.fromkeys(name for name in baselines if name in prior):
            baseline = prior[against]
            if not any(report.paired(a, b, "final") for a, b in zip(cells["lcs-rl"], baseline, strict=True)):
                continue
            tables[f"LCS-RL, {label} − {against}"] = differences(cells["lcs-rl"], baseline)
            pairs = zip(LABELS, cells["lcs-rl"], baseline, strict=True)
            gains = {label: report.paired_estimate(a, b, "final") for label, a, b in pairs}
            words.append(f"LCS-RL, {label}, at the end against {against}: {report.verdict(gains)}.")
    if not tables:
        return False
    if len(prior) > 1:
        columns = {"object": [*LABELS, "all six"], **{label: column(cells, "final") for label, cells in prior.items()}}
        tables["Violation only, final success, by recipe and how it is deployed"] = pd.DataFrame(columns)
        words.append(f"The strongest baseline, by the mean over the objects at the end: {strongest}.")
        for recipe in ("ours", "paper"):
            full, support = (report.name_of("violation", recipe, protocol=way) for way in ("full", "support"))
            pairs = zip(prior.get(full, []), prior.get(support, []), strict=False)
            ends = [difference for pair in pairs for difference in report.paired(*pair, "final")]
            if ends and not any(ends):
                words.append(f"{support}: at the end every seed has reached as many goals with full bounds.")
    report.write_tables(folder, name, tables, below(name, NOTE, words, used))
    return True


main = partial(report.main, "table1", "table1", draw)

if __name__ == "__main__":
    sys.exit(main())
