"""Records of measurements: tidy CSV files, one row per evaluation, in the tracked folder of results.

    results/<preset>.csv            with the YCB meshes (and the cube)
    results/<preset>-stand-in.csv   with stand-ins, which are other objects

A row is replaced only by a newly computed result of the same unit with the same key. Whoever reads rows takes those of
one version and one key, see `select`.
"""

from collections.abc import Hashable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import filelock
import pandas as pd

from difflcs.errors import CheckpointError
from difflcs.rl import write_atomically

RESULTS = Path(__file__).parent / "results"
COLUMNS: dict[Hashable, Any] = {
    **{"task": str, "method": str, "recipe": str, "start": str, "seed": int},  # the unit
    "protocol": str,  # how it was evaluated, see `recipes.PROTOCOLS`
    **{"at": float, "minutes": float},  # of data: asked for; really: the end of an iteration
    **{"success": float, "ci_low": float, "ci_high": float},  # share of goals reached, and its Wilson 95 % interval
    **{"goals": int, "evaluation_seed": int},  # goals tried, and what they were drawn from
    "solver_failures": int,  # MPC solves that did not converge
    **{"source": str, "mass": float},  # of the object: built_in, ycb_mesh or stand_in; [kg]
    "version": str,  # of the method
    "key": str,  # see `units.key_of`
    **{"versions": str, "machine": str},  # of the packages; class of machine
    **{"train_seconds": float, "evaluation_seconds": float},  # on one core, all of the unit
    "finished": str,  # when (UTC)
}
IDENTITY = ["task", "method", "recipe", "start", "seed", "key"]
"""Columns that tell the results of one training from those of others."""


def path_of(folder: Path, preset: str, stand_in: bool = False) -> Path:
    """Return the file of a preset's results."""
    return folder / f"{preset}{'-stand-in' if stand_in else ''}.csv"


def read(path: Path) -> pd.DataFrame:
    """Read the rows of a file, none if there is no file; `CheckpointError` if another version or program wrote it."""
    if not path.exists():
        return pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in COLUMNS.items()})
    try:
        rows = pd.read_csv(path, dtype=COLUMNS, keep_default_na=False)
        if list(rows.columns) != list(COLUMNS):
            raise ValueError(f"the columns {', '.join(rows.columns)}")
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path}: expected results with the columns {', '.join(map(str, COLUMNS))}; got {error}. Nothing was "
            f"changed; use the version that wrote it, or pass another --results"
        ) from error
    return rows


def write(path: Path, rows: pd.DataFrame) -> None:
    """Write rows atomically."""
    write_atomically(path, rows[list(COLUMNS)].to_csv(index=False, lineterminator="\n").encode())


def add(folder: Path, preset: str, new: pd.DataFrame) -> Path:
    """Add the rows of a finished unit to the file that they belong to; several processes may at a time."""
    path = path_of(folder, preset, new.source[0] == "stand_in")
    folder.mkdir(parents=True, exist_ok=True)
    with filelock.FileLock(folder / ".lock"):
        old = read(path)
        kept: Any = old[(old[IDENTITY] != new.loc[0, IDENTITY]).any(axis=1)]
        write(path, (pd.concat([kept, new]) if len(kept) else new).sort_values(by=[*IDENTITY, "protocol", "at"]))
    return path


@dataclass(frozen=True, eq=False)
class Cell:
    """All seeds of one method on one object, of one version and one key."""

    rows: pd.DataFrame
    left_out: int
    """Trainings of other versions or settings, which are not in it."""

    first: Any = field(init=False)
    """One row, for the columns that all have in common: task, version, object."""
    scores: Any = field(init=False)
    """Success [%] by seed (rows) and minutes of data (columns), a DataFrame.

    It is of whole goals, where a file has six decimals: equal differences of seeds have to be equal.
    """

    def __post_init__(self) -> None:
        percent = 100 * (self.rows.success * self.rows.goals).round() / self.rows.goals
        scores = self.rows.assign(percent=percent).pivot(index="seed", columns="at", values="percent")
        vars(self).update(first=self.rows.iloc[0], scores=scores)

    @property
    def seeds(self) -> str:
        """Number of seeds."""
        return f"{len(self.scores)} seed{'s' * (len(self.scores) > 1)}"

    def minute(self, when: str | float) -> float:
        """Resolve a minute: a number; "final", the last; "peak", of the highest mean over seeds after the start."""
        if when == "final":
            return self.scores.columns.max()
        return self.scores.drop(columns=0.0, errors="ignore").mean().idxmax() if when == "peak" else float(when)

    @property
    def minutes(self) -> Any:
        """Minutes of data really collected at each evaluation, by the minute asked for: the mean over the seeds."""
        return self.rows.groupby("at").minutes.mean()

    def goals(self, when: str | float) -> int:
        """Count the goals of the evaluations at a time."""
        return int(self.rows.goals[self.rows["at"] == self.minute(when)].iloc[0])

    @property
    def amount(self) -> str:
        """Describe the number of seeds and goals, such as "10 seeds × 1000 goals (300 on the way)"."""
        final, way = self.goals("final"), sorted({*self.rows.goals} - {self.goals("final")})
        return f"{self.seeds} × {final} goals" + (f" ({', '.join(map(str, way))} on the way)" if way else "")

    def at(self, when: str | float) -> pd.Series:
        """Return the success [%] of each seed at a time; empty if it was not evaluated."""
        return self.scores.get(self.minute(when), pd.Series(dtype=float))


def select(
    rows: pd.DataFrame, task: str, method: str, recipe: str, start: str = "scratch", protocol: str = "full"
) -> Cell | None:
    """Select the results of a method on an object, deployed in one way (`recipes.PROTOCOLS`); None without any.

    Where there are several versions or settings, those with the most evaluated goals, then the newest.
    """
    selected: Any = rows[(rows[IDENTITY[:4]] == [task, method, recipe, start]).all(axis=1)]
    if selected.empty:
        return None
    groups = [group for _, group in selected.groupby(["version", "key"])]
    best = max(groups, key=lambda group: (group.goals.sum(), group.finished.max()))
    shown = best[best.protocol == protocol]
    return Cell(shown, sum(group.seed.nunique() for group in groups if group is not best)) if len(shown) else None
