"""Worker process of Dask that computes one unit."""

import contextlib
import os
import platform
import shutil
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import filelock
import pandas as pd
import records
import units
from deployment import Deployments
from units import Preset, Unit

from difflcs.errors import CheckpointError, InvalidInputError


@dataclass(frozen=True)
class Job:
    """A unit, and the data that a worker needs to compute it."""

    unit: Unit
    preset: Preset
    key: str
    """Key of its result, see `units.key_of`."""
    work: Path
    """Folder of all units."""
    init: Path | None = None
    """Folder of the run that it starts from."""

    @property
    def folder(self) -> Path:
        """Folder of the unit: `run`, `result.csv` when that is finished, `error.txt` after a failure."""
        return self.work / "-".join(map(str, (*asdict(self.unit).values(), self.key)))

    @property
    def identity(self) -> tuple[Any, ...]:
        """Values of `records.IDENTITY` in its results."""
        values = {**asdict(self.unit), "key": self.key}
        return tuple(values[name] for name in records.IDENTITY)

    def result(self) -> pd.DataFrame | None:
        """Read its evaluations, see `records.COLUMNS`, and the run, if its folder holds those of this unit and key."""
        with contextlib.suppress(CheckpointError):
            rows = records.read(self.folder / "result.csv")
            known = len(rows) > 0 and (rows[records.IDENTITY] == list(self.identity)).to_numpy().all()
            return rows if known and (self.folder / "run" / "config.json").is_file() else None


def execute(job: Job) -> pd.DataFrame:
    """Compute a unit, continue it, or read it if it is finished; return its evaluations."""
    job.folder.mkdir(parents=True, exist_ok=True)
    with filelock.FileLock(job.folder / ".lock"):  # another process waits; it ends with the one that holds it
        rows = job.result()
        if rows is None:
            rows = _train(job)
            records.write(job.folder / "result.csv", rows)
        return rows


def _train(job: Job) -> pd.DataFrame:
    import torch

    torch.set_num_threads(1)  # of this thread only: one unit, one core
    unit, run, config = job.unit, job.folder / "run", units.config_of(job.unit, job.preset)
    objects = {one.task: units.describe_object(one.task) for one in (unit, unit.init) if one is not None}
    key = units.key_of(unit, job.preset, objects)
    if key != job.key:
        raise InvalidInputError(
            f"key: expected {job.key}, as where the unit was submitted, got {key} on {platform.node()}, where "
            f"{unit.method} has version {config.method.version} and the object is {objects[unit.task]}; install the "
            f"same version of difflcs there, and set DIFFLCS_YCB_DIR to the same meshes"
        )
    if not (run / "config.json").is_file():
        shutil.rmtree(run, ignore_errors=True)  # killed before it began
    schedule = units.schedule_of(unit, job.preset)
    others = Deployments(unit, schedule, run, job.folder / "deployments.csv")
    others.catch_up()
    finished = units.train_unit(unit, job.preset, run, job.init, others)
    log = pd.read_csv(finished.log)
    evaluated = log.dropna(subset="evaluation_goals").filter(regex="^(minutes$|evaluation_)")
    evaluated.columns = [name.removeprefix("evaluation_") for name in evaluated.columns]
    parts = {"full": evaluated.assign(protocol="full"), **dict(iter(others.rows().groupby("protocol")))}
    # Before any data a model is evaluated by `train` alone, if at all.
    at = [minute for minute in (*schedule.evaluate_at, schedule.minutes) if minute > 0 or "full" in unit.protocols]
    # Iterations vary in length: the first evaluation at a minute or, if need be, a little after it.
    due: Any = [(parts[way][parts[way].minutes > minute - 1e-6], minute) for way in unit.protocols for minute in at]
    rows: Any = pd.DataFrame([part.iloc[0] for part, _ in due]).rename(columns={"success_rate": "success"})
    seconds: Any = log.filter(regex="_seconds$").sum()
    packages: dict[str, Any] = {**cast(Any, finished.config()["versions"]), "python": platform.python_version()}
    rows = rows.assign(
        **asdict(unit),
        at=[minute for _, minute in due],
        evaluation_seed=config.evaluation_seed,
        source=objects[unit.task]["source"],
        mass=unit.changes.task.get("object_mass", objects[unit.task]["mass"]),
        version=str(config.method.version),
        key=key,
        versions=" ".join(f"{name}={version}" for name, version in sorted(packages.items()) if version),
        machine=machine(),
        train_seconds=round(seconds.sum() - seconds["evaluation_seconds"], 1),
        evaluation_seconds=round(seconds["evaluation_seconds"] + others.rows().seconds.sum(), 1),
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    for folder in (finished.checkpoints, finished.tensorboard):
        shutil.rmtree(folder, ignore_errors=True)  # megabytes that nobody needs any more
    return rows[list(records.COLUMNS)].astype(records.COLUMNS).round(6).reset_index(drop=True)


def machine() -> str:
    """Describe this class of machine: processor, cores, instruction set of the kernels."""
    from difflcs.cli import bench

    return f"{bench.cpu()}, {os.cpu_count()} cores, {bench.machine()['instruction set']}"
