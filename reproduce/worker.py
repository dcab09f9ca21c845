"""Computes one unit: in a process of its own (`python reproduce/worker.py SPEC.json`) or as a task of Dask."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import json
import os
import platform
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from units import Unit, code_version, object_source

from difflcs._files import write_atomically, write_json
from difflcs.errors import DiffLCSError
from difflcs.rl.training import Reporter, TrainConfig

FORMAT = 1
"""Of records."""
Spec = Mapping[str, Any]
"""What a unit needs, in JSON types: `key`, `unit`, `config`, `settings`, `source`, `code`, `init`, `folder`."""
Report = Callable[[dict[str, Any]], object]
"""Hears `key`, `pid`, `minutes` and `success` of a running unit."""
_REPORT_SECONDS = 1.0


class UnitError(DiffLCSError):
    """This machine cannot compute a unit as it is meant to be."""


class _Progress(Reporter):
    """Reports a training at most once a second."""

    def __init__(self, key: str, steps_per_minute: float, report: Report) -> None:
        self.state: dict[str, Any] = {"key": key, "pid": os.getpid(), "minutes": 0.0, "success": None}
        self.steps_per_minute, self.report = steps_per_minute, report
        self.steps, self.last = 0, 0.0

    def started(self, done: int, total: int) -> None:
        self.stepped(done)

    def stepped(self, env_steps: int) -> None:
        self.steps += env_steps
        self.state["minutes"] = self.steps / self.steps_per_minute
        if time.monotonic() - self.last > _REPORT_SECONDS:
            self._send()

    def evaluated(self, minutes: float, result: Any) -> None:
        self.state["success"] = result.success_rate
        self._send()

    def _send(self) -> None:
        self.last = time.monotonic()
        self.report(dict(self.state))


def execute(spec: Spec, report: Report = lambda state: None) -> dict[str, Any]:
    """Compute a unit, or go on with it, or return its record if it is finished.

    Only one process at a time works on a unit; another waits for it and returns the same record.

    Args:
        spec: the unit.
        report: hears how far it is.

    Returns:
        The record: `error` is None, or the text of what went wrong. It is also in the unit's folder.
    """
    folder = Path(spec["folder"])
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return failure(
            spec, f"{folder}: expected a folder that can be written here, got: {error}; choose another --work"
        )
    with _locked(folder / ".lock"):
        record = finished_record(folder, spec["key"])
        if record is None:
            try:
                record = _train(spec, folder, report)
            except DiffLCSError as error:
                record = failure(spec, f"{type(error).__name__}: {error}")
            except Exception as error:
                text = "".join(traceback.format_exception(error)[-4:])
                record = failure(spec, f"{type(error).__name__}: {error}", text)
            record = json.loads(json.dumps(record))  # as it will be read
            with contextlib.suppress(OSError):  # a full disk: the record still reaches who asked for it
                write_json(folder / "record.json", record)
        return record


def failure(spec: Spec, error: str, trace: str = "") -> dict[str, Any]:
    """The record of a unit that could not be computed."""
    return {"format": FORMAT, "key": spec["key"], "unit": spec["unit"], "error": error, "traceback": trace}


def finished_record(folder: Path, key: str) -> dict[str, Any] | None:
    """The record of a finished unit in its folder; None if there is none, or if it tells of a failure."""
    try:
        record = json.loads((folder / "record.json").read_text())
    except (OSError, ValueError, RecursionError):
        return None
    usable = isinstance(record, dict) and record.get("format") == FORMAT and record.get("key") == key
    return record if usable and record.get("error") is None else None


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # ends with the process that holds it, however that dies
        yield


def _train(spec: Spec, folder: Path, report: Report) -> dict[str, Any]:
    import torch

    from difflcs.rl._optional import versions
    from difflcs.rl.tasks import get_task
    from difflcs.rl.training import profile, train

    unit, config = Unit(**spec["unit"]), TrainConfig.from_dict(spec["config"])
    here = code_version(unit.method)
    # The C++ is compared only where its sources are installed.
    if here.rpartition(".")[0] != spec["code"].rpartition(".")[0]:
        raise UnitError(
            f"code: expected version {spec['code']}, which submitted the unit, got {here} on {platform.node()}; "
            f"install the same code there, or, if it was edited meanwhile, start again"
        )
    torch.set_num_threads(1)  # of this thread only: one unit, one core
    source = object_source(unit.task)
    if source != spec["source"]:
        raise UnitError(
            f"object {unit.task}: expected {spec['source']}, as where the unit was submitted, got {source} on "
            f"{platform.node()}; set DIFFLCS_YCB_DIR there to the same meshes"
        )
    task = get_task(config.task)
    found: dict[str, Any] = {}

    def make_envs(count: int) -> Any:
        import gymnasium

        import difflcs_envs

        difflcs_envs.register_envs()
        envs: Any = gymnasium.make_vec(task.env_id, num_envs=count, threads=1, **dict(task.env_kwargs))
        found.update(envs.envs[0].object.describe())
        return envs

    out = folder / "run"
    resume = (out / "config.json").is_file()
    if not resume:
        shutil.rmtree(out, ignore_errors=True)  # killed before it began
    init = None
    if spec["init"] is not None:
        init = folder / "init"
        write_files(init, spec["init"])
    began = time.perf_counter()
    progress = _Progress(spec["key"], 60.0 / task.step_seconds, report)
    run = train(config, out, make_envs, init=None if resume else init, resume=resume, reporter=progress)
    if not found:  # it had been finished, but for its record
        make_envs(1).close()
    rows = run.rows()
    record = {
        "format": FORMAT,
        "key": spec["key"],
        "unit": spec["unit"],
        "error": None,
        "settings": spec["settings"],
        "code": spec["code"],
        "config": spec["config"],
        "source": spec["source"],
        "object": found,
        "curve": curve(rows, config),
        "model": None if config.method == "pddm" else read_files(run.model),
        "seconds": {name: round(value, 3) for name, value in profile(rows).items()},
        "wall_seconds": round(time.perf_counter() - began, 3),
        "resumed": resume,
        "versions": {**versions(), "python": platform.python_version()},
        "machine": machine(),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    shutil.rmtree(run.checkpoints, ignore_errors=True)  # megabytes that nobody needs any more
    shutil.rmtree(run.tensorboard, ignore_errors=True)
    return record


def curve(rows: list[dict[str, str]], config: TrainConfig) -> list[dict[str, Any]]:
    """The evaluations of a run: for each asked minute `at`, the first at or after it.

    Iterations have lengths of their own, so that `minutes` may be a little more than `at`.
    """
    evaluated = [row for row in rows if row["evaluation_goals"]]
    points = []
    for at in sorted({*config.evaluate_at, config.minutes}):
        row = next((r for r in evaluated if float(r["minutes"]) > at - 1e-6), evaluated[-1])
        points.append(
            {
                "at": at,
                "minutes": float(row["minutes"]),
                "success": float(row["evaluation_success_rate"]),
                "ci_low": float(row["evaluation_ci_low"]),
                "ci_high": float(row["evaluation_ci_high"]),
                "goals": int(row["evaluation_goals"]),
                "solver_failures": int(row["evaluation_solver_failures"]),
            }
        )
    return points


def read_files(folder: Path) -> dict[str, str]:
    """The files of a folder, in base64: models are small, and workers need not share a disk."""
    return {path.name: base64.b64encode(path.read_bytes()).decode() for path in sorted(folder.iterdir())}


def write_files(folder: Path, files: Mapping[str, str]) -> None:
    """The reverse of `read_files`."""
    for name, text in files.items():
        write_atomically(folder / name, base64.b64decode(text))


def machine() -> str:
    """What kind of machine this is: processor, cores, instruction set of the kernels."""
    from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]

    cpu = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), cpu)
    return f"{cpu}, {os.cpu_count()} cores, {_kernels.isa()}"


def main(path: Path) -> int:
    """Compute the unit that a file describes, and leave its record and its progress beside that file."""
    spec = json.loads(path.read_text())
    parent = os.getppid()

    def report(state: dict[str, Any]) -> None:
        if os.getppid() != parent:  # who wanted it is gone: stop; what is done is on disk
            raise SystemExit(1)
        write_json(path.parent / "progress.json", state)

    record = execute(spec, report)
    return 0 if record["error"] is None else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
