"""What was measured: tidy CSV files, one row per evaluation, in the tracked folder of results.

    results/<preset>.csv            with the YCB meshes (and the cube)
    results/<preset>-stand-in.csv   with stand-ins, which are other objects

A row is replaced only by a newly computed result of the same unit on the same number of goals. Whoever reads rows takes
those of one setting, one code version and one mesh, see `select`.
"""

from __future__ import annotations

import csv
import fcntl
import io
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

from units import Unit

from difflcs._files import write_atomically
from difflcs.errors import DiffLCSError

RESULTS = Path(__file__).parent / "results"
FORMAT = 2
"""Of the CSV files."""


class ResultsError(DiffLCSError):
    """Results are missing, or cannot be used."""


@dataclass(frozen=True)
class Row:
    """One evaluation of one unit; success and its Wilson 95 % interval as fractions.

    Attributes:
        format: of the file.
        task: what the unit was, see `Unit`.
        method: likewise.
        recipe: likewise.
        start: likewise.
        seed: likewise.
        at: minutes of data asked for.
        minutes: minutes at which the evaluation was: the end of an iteration.
        success: share of goals reached.
        ci_low: lower end of its interval.
        ci_high: its upper end.
        goals: goals tried.
        evaluation_seed: what they were drawn from.
        solver_failures: MPC solves that did not converge.
        source: of the object: built_in, ycb_mesh, stand_in.
        mass: of the object [kg].
        settings: hash of all settings but the seed.
        code: version of the code, see `code_version`.
        key: of the unit.
        versions: of the packages.
        machine: class of machine.
        train_seconds: training, without evaluations, on one core.
        evaluation_seconds: all evaluations of the unit.
        finished: when (UTC).
    """

    format: int
    task: str
    method: str
    recipe: str
    start: str
    seed: int
    at: float
    minutes: float
    success: float
    ci_low: float
    ci_high: float
    goals: int
    evaluation_seed: int
    solver_failures: int
    source: str
    mass: float
    settings: str
    code: str
    key: str
    versions: str
    machine: str
    train_seconds: float
    evaluation_seconds: float
    finished: str

    @property
    def unit(self) -> Unit:
        """The unit it belongs to."""
        return Unit(self.task, self.method, self.recipe, self.seed, self.start)


_COLUMNS = [field.name for field in fields(Row)]
_TYPES = {"int": int, "float": float, "str": str}


def rows_of(record: dict[str, Any]) -> list[Row]:
    """The rows of a finished unit's record."""
    evaluation = record["seconds"].get("evaluation", 0.0)
    common: dict[str, Any] = {
        "format": FORMAT,
        **record["unit"],
        "evaluation_seed": record["config"]["evaluation_seed"],
        "source": record["source"]["source"],
        "mass": record["object"]["mass"],
        "settings": record["settings"],
        "code": record["code"],
        "key": record["key"],
        "versions": " ".join(f"{name}={version}" for name, version in sorted(record["versions"].items()) if version),
        "machine": record["machine"],
        "train_seconds": round(sum(record["seconds"].values()) - evaluation, 1),
        "evaluation_seconds": round(evaluation, 1),
        "finished": record["finished"],
    }
    return [Row(**common, **{k: round(v, 6) for k, v in point.items()}) for point in record["curve"]]


def path_of(folder: Path, preset: str, stand_in: bool = False) -> Path:
    """The file of a preset's results."""
    return folder / f"{preset}{'-stand-in' if stand_in else ''}.csv"


def read(path: Path) -> list[Row]:
    """The rows of a file; none if there is no file.

    Raises:
        ResultsError: it was written by another version, or by something else.
    """
    if not path.exists():
        return []
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            if reader.fieldnames != _COLUMNS:
                raise ValueError(f"the columns {reader.fieldnames}")
            rows = [Row(**{f.name: _TYPES[str(f.type)](line[f.name]) for f in fields(Row)}) for line in reader]
        if any(row.format != FORMAT for row in rows):
            raise ValueError(f"format {next(row.format for row in rows if row.format != FORMAT)}")
    except (OSError, ValueError, TypeError, KeyError, csv.Error) as error:
        raise ResultsError(
            f"{path}: expected results of format {FORMAT} with the columns {', '.join(_COLUMNS)}; got {error}. Nothing "
            f"was changed; use the version that wrote it, or pass another --results"
        ) from error
    return rows


def add(folder: Path, preset: str, new: Sequence[Row]) -> Path:
    """Add the rows of a finished unit; those of the same unit on as many goals are replaced.

    Returns:
        The file, written atomically. Several processes may add at a time.
    """
    path = path_of(folder, preset, new[0].source == "stand_in")
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        replaced = {(row.unit, row.goals) for row in new}
        rows = [row for row in read(path) if (row.unit, row.goals) not in replaced]
        rows = sorted([*rows, *new], key=lambda row: (row.unit, row.goals, row.at))
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(_COLUMNS)
        writer.writerows(astuple(row) for row in rows)
        write_atomically(path, buffer.getvalue().encode())
    return path


@dataclass(frozen=True)
class Cell:
    """All seeds of one method on one object, of one setting, one code version and one mesh.

    Attributes:
        rows: theirs.
        left_out: how many units of other settings or code there are, which are not in it.
    """

    rows: tuple[Row, ...]
    left_out: int

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds."""
        return tuple(sorted({row.seed for row in self.rows}))

    @property
    def minutes(self) -> tuple[float, ...]:
        """Minutes of data at which it was evaluated."""
        return tuple(sorted({row.at for row in self.rows}))

    def at(self, minute: float) -> dict[int, float]:
        """Seed → success [%] after these minutes of data."""
        return {row.seed: 100 * row.success for row in self.rows if row.at == minute}

    @property
    def peak_minute(self) -> float:
        """Minutes of data after which the mean over the seeds is highest; the untrained model does not count."""
        after = [minute for minute in self.minutes if minute > 0]
        return max(after, key=lambda minute: sum(self.at(minute).values()))


def select(rows: Iterable[Row], task: str, method: str, recipe: str, start: str = "scratch") -> Cell | None:
    """The results of one method on one object.

    Where there are several settings or code versions, the one with the most evaluated goals, then the newest.

    Returns:
        The cell; None if there is none.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if (row.task, row.method, row.recipe, row.start) == (task, method, recipe, start):
            groups.setdefault((row.settings, row.code), []).append(row)
    if not groups:
        return None
    best = max(groups.values(), key=lambda group: (sum(row.goals for row in group), max(row.finished for row in group)))
    others = {row.key for group in groups.values() if group is not best for row in group}
    return Cell(tuple(best), len(others))
