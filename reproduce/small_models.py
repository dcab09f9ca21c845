"""What a small model is good for: an LCS beside the networks of PDDM, on the cube: `python reproduce/small_models.py`.

Without options the table is drawn from the tracked results of the learning curves; `--rerun --preset smoke|quick|paper`
computes them.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import report
from fig_learning_curves import EARLY, PRIOR
from records import Cell, select
from report import say
from stats import Estimate
from units import PRESETS, Unit, config_of

from difflcs import LCSModel
from difflcs.rl import get_task
from difflcs.rl.dynamics import Ensemble

SHOWN = (("lcs-rl", "ours", "full"), PRIOR, ("pddm", "ours", "full"), ("pddm", "authors", "full"))
"""Method, recipe, protocol."""
WHEN: dict[str, str | float] = {"2 min": 2.0, "6 min": 6.0, "10 min": 10.0, "final": "final"}
HYBRID = (
    "LCS-RL in our recipe is itself a hybrid: it also learns from episodes that are played in an ensemble of such "
    "networks. What acts, what is transferred and what one can read is the LCS; what the networks bring it stands "
    "among the ablations."
)


def size_of(method: str, recipe: str) -> int:
    """Numbers that are learned."""
    task, own = get_task("cube"), config_of(Unit("cube", method, recipe, 0), PRESETS["paper"]).method
    settings: Any = own
    if hasattr(settings, "n_lam"):
        return sum(p.numel() for p in LCSModel(task.n_x, task.n_u, settings.n_lam, learn_c=False).parameters())
    ensemble = settings.pddm.ensemble
    return sum(p.numel() for p in Ensemble(task.n_x, task.n_u, ensemble.networks, ensemble.width).parameters())


def seconds_per_step(rows: pd.DataFrame, cell: Cell) -> float:
    """Of a core, in the evaluations of these trainings: the decision and the simulation of its outcome."""
    mine: Any = rows[(rows.key == cell.first.key) & (rows.version == cell.first.version)]
    mine = mine[(mine.task == cell.first.task) & mine.seed.isin(cell.scores.index)]
    seconds = mine.drop_duplicates("seed").evaluation_seconds.sum()
    return seconds / (mine.goals.sum() * get_task("cube").episode_steps)


def table(rows: pd.DataFrame, cells: dict[str, Cell]) -> pd.DataFrame:
    """Success, computing and size of each."""
    columns: dict[str, list[str]] = {
        "": [*WHEN, "computing per step, with the simulation [ms]", "training [core min]", "learned numbers"]
    }
    for name, cell in cells.items():
        success = [say(report.at(cell, when)) for when in WHEN.values()]
        step = f"{1e3 * seconds_per_step(rows, cell):.2g}"
        training = f"{cell.rows.drop_duplicates('seed').train_seconds.mean() / 60:.1f}"
        columns[name] = [*success, step, training, str(size_of(cell.first.method, cell.first.recipe))]
    return pd.DataFrame(columns)


def words(rows: pd.DataFrame, cells: dict[str, Cell]) -> list[str]:
    """The paper's claim beside either way of PDDM, by the intervals; and what the small model costs."""
    lcs = next((cell for cell in cells.values() if cell.first.method == "lcs-rl"), None)
    networks = {name: cell for name, cell in cells.items() if cell.first.method == "pddm"}
    if lcs is None or not networks:
        return []
    said = []
    for name, cell in networks.items():
        apart: Estimate | None = report.paired_estimate(lcs, cell, EARLY)
        claim = "cannot be decided here"
        if apart is not None and apart.low > 0:
            claim = "holds here"
        elif apart is not None and apart.high < 0:
            claim = "does not hold here: the networks are better"
        difference, _ = report.say_difference(report.paired(lcs, cell, EARLY))
        said.append(
            f"{name}: after {EARLY:g} minutes of data LCS-RL − PDDM is {difference} points, paired by seed. The "
            f"paper's claim that simple models beat deep networks at little data {claim}."
        )
    first = next(iter(networks.values()))
    ratio = seconds_per_step(rows, first) / seconds_per_step(rows, lcs)
    sizes = [size_of(cell.first.method, cell.first.recipe) for cell in (first, lcs)]
    steps = (
        f"A step of PDDM takes {ratio:.0f} times the computing of one of the LCS-MPC, the simulation included, and its "
        f"networks hold {sizes[0] / sizes[1]:.0f} times as many numbers."
    )
    return [*report.bullets(said), steps]


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write the table."""
    found = {report.name_of(m, r, protocol=p): select(rows, "cube", m, r, protocol=p) for m, r, p in SHOWN}
    cells = {label: cell for label, cell in found.items() if cell is not None}
    if not cells:
        return False
    notes = [*words(rows, cells), HYBRID, *report.provenance(list(cells.values()))]
    report.write_tables(folder, name, {"An LCS and networks on the cube": table(rows, cells)}, notes)
    return True


main = partial(report.main, "small_models", "curves", draw)

if __name__ == "__main__":
    sys.exit(main())
