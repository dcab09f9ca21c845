"""Success and cost of a small model: an LCS against PDDM's networks, on the cube: `python reproduce/small_models.py`.

Without options the table is drawn from the tracked results of the learning curves; `--rerun --preset smoke|quick|paper`
computes them.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import report
from fig_learning_curves import EARLY, PRIOR
from records import Cell, select
from report import say
from stats import Estimate
from units import PRESETS, Unit, config_of

from difflcs import LCSModel
from difflcs.rl import get_task
from difflcs.rl.learning.dynamics import Ensemble

SHOWN = (("lcs-rl", "ours", "full"), PRIOR, ("pddm", "ours", "full"), ("pddm", "authors", "full"))
"""Method, recipe, protocol."""
WHEN: dict[str, str | float] = {"2 min": 2.0, "6 min": 6.0, "10 min": 10.0, "final": "final"}
NO_TIMES = "No times are given: no class of machine has computed all of these methods."
HYBRID = (
    "LCS-RL in our recipe is itself a hybrid: it also learns from episodes that are played in an ensemble of such "
    "networks. What acts, what is transferred and what one can read is the LCS; what the networks bring it stands "
    "among the ablations."
)


def size_of(method: str, recipe: str) -> int:
    """Count the learned numbers."""
    task, method_settings = get_task("cube"), config_of(Unit("cube", method, recipe, 0), PRESETS["paper"]).method
    settings: Any = method_settings
    if hasattr(settings, "n_lam"):
        return sum(p.numel() for p in LCSModel(task.n_x, task.n_u, settings.n_lam, learn_c=False).parameters())
    ensemble = settings.pddm.ensemble
    return sum(p.numel() for p in Ensemble(task.n_x, task.n_u, ensemble.networks, ensemble.width).parameters())


class Times(NamedTuple):
    """Computing time of one method on one core: medians over the trainings on one class of machine."""

    step: float
    """Milliseconds of one step in the evaluations: the decision and the simulation of its outcome."""
    training: float
    """Minutes of a whole training."""
    trainings: int


def shared_machine(cells: dict[str, Cell]) -> str | None:
    """Find the class of machine that has computed most of all methods, so that times compare; None without one."""
    counts = pd.concat([cell.rows.drop_duplicates("seed").machine.value_counts() for cell in cells.values()], axis=1)
    fewest = counts.min(axis=1, skipna=False).dropna()
    return None if fewest.empty else str(fewest.idxmax())


def times_of(rows: pd.DataFrame, cell: Cell, machine: str) -> Times:
    """Compute the times of a method on a class of machine, over all deployments of its models there."""
    row: Any = cell.first
    same = (rows.key == row.key) & (rows.version == row.version) & (rows.task == row.task) & (rows.machine == machine)
    trainings = (
        rows[same]
        .groupby("seed")
        .agg(goals=("goals", "sum"), train=("train_seconds", "first"), evaluation=("evaluation_seconds", "first"))
    )
    step = (trainings.evaluation / trainings.goals).median() / get_task("cube").episode_steps
    return Times(1e3 * step, trainings.train.median() / 60, len(trainings))


def table(cells: dict[str, Cell], times: dict[str, Times]) -> pd.DataFrame:
    """Make the table of success, computing time and size of each."""
    columns: dict[str, list[str]] = {
        "": [*WHEN, "computing per step, with the simulation [ms]", "training [core min]", "learned numbers"]
    }
    for name, cell in cells.items():
        success = [say(report.at(cell, when)) for when in WHEN.values()]
        took = [f"{times[name].step:.2g}", f"{times[name].training:.1f}"] if times else [report.MISSING] * 2
        columns[name] = [*success, *took, str(size_of(cell.first.method, cell.first.recipe))]
    return pd.DataFrame(columns)


def words(cells: dict[str, Cell], times: dict[str, Times]) -> list[str]:
    """Describe the paper's claim against both forms of PDDM by the intervals, and the cost of the small model."""
    lcs = next((name for name, cell in cells.items() if cell.first.method == "lcs-rl"), None)
    networks = {name: cell for name, cell in cells.items() if cell.first.method == "pddm"}
    if lcs is None or not networks:
        return []
    said = []
    for name, cell in networks.items():
        apart: Estimate | None = report.paired_estimate(cells[lcs], cell, EARLY)
        claim = "cannot be decided here"
        if apart is not None and apart.low > 0:
            claim = "holds here"
        elif apart is not None and apart.high < 0:
            claim = "does not hold here: the networks are better"
        difference, _ = report.say_difference(report.paired(cells[lcs], cell, EARLY))
        said.append(
            f"{name}: after {EARLY:g} minutes of data LCS-RL − PDDM is {difference} points, paired by seed. The "
            f"paper's claim that simple models beat deep networks at little data {claim}."
        )
    first = next(iter(networks))
    sizes = [size_of(cell.first.method, cell.first.recipe) for cell in (networks[first], cells[lcs])]
    costs = f"The networks of PDDM hold {sizes[0] / sizes[1]:.0f} times as many numbers as the LCS"
    if times:
        ratio = times[first].step / times[lcs].step
        costs += f", and a step of PDDM takes {ratio:.0f} times the computing, the simulation included"
    return [*report.bullets(said), f"{costs}."]


def draw(rows: pd.DataFrame, folder: Path, name: str) -> bool:
    """Write the table."""
    results = {report.name_of(m, r, protocol=p): select(rows, "cube", m, r, protocol=p) for m, r, p in SHOWN}
    cells = {label: cell for label, cell in results.items() if cell is not None}
    if not cells:
        return False
    machine = shared_machine(cells)
    times = {label: times_of(rows, cell, machine) for label, cell in cells.items()} if machine else {}
    counts = report.listed([str(took.trainings) for took in times.values()])
    where = f"Times are medians of the trainings on {machine}, which are {counts}." if machine else NO_TIMES
    notes = [*words(cells, times), where, HYBRID, *report.provenance(list(cells.values()))]
    report.write_tables(folder, name, {"An LCS and networks on the cube": table(cells, times)}, notes)
    return True


main = partial(report.main, "small_models", "curves", draw)

if __name__ == "__main__":
    sys.exit(main())
