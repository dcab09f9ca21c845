"""Compute the runs behind the tables and figures: `python reproduce/runs.py --preset paper`.

A unit of work is one training with its evaluations (`units.py`). What is finished is never computed again; what was
interrupted goes on; a failure is kept and shown, does not stop the rest, and is tried again next time. Results go to
`reproduce/results/`, everything else (models, logs) to `runs/reproduce/`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pools
import records
from pools import DaskPool, LocalPool, Pool
from progress import Display
from units import Preset, Unit, code_version, config_of, get_preset, matrix, object_source, settings_hash, unit_key
from worker import failure, finished_record

from difflcs._files import write_json
from difflcs.errors import DiffLCSError, InvalidInputError

WORK = Path("runs") / "reproduce"
_POLL_SECONDS = 0.25
FAILED = 1
"""Exit code where units have failed."""


@dataclass(frozen=True)
class Compute:
    """What to compute, and where. Without --preset and --rerun the scripts only draw what is there."""

    preset: str | None = None
    """smoke (under a minute), quick (about 15 minutes a script on 2 cores) or paper (10 seeds, 1000 goals). To draw:
    the results to take, by default those of the largest preset there is."""
    seeds: int | None = None
    """Runs per method and object, with the seeds 10, 11, …; the preset's number by default."""
    goals: int | None = None
    """Goals of every evaluation; the preset's number by default."""
    objects: tuple[str, ...] = ()
    """Some of sugar_box, fish_can, mug, wrench, clamp, banana; all by default."""
    methods: tuple[str, ...] = ()
    """Some of lcs-rl, violation, ppo, pddm; all by default."""
    recipes: tuple[str, ...] = ()
    """Some of ours, paper; by default both on the cube and ours on the objects."""
    workers: int | None = None
    """Processes on this machine, one core each; the number of cores by default."""
    dask: str | None = None
    """local:N computes on N Dask workers on this machine."""
    scheduler: str | None = None
    """Address of a Dask scheduler, tcp://host:port, whose workers compute."""
    work: Path = WORK
    """Folder for models, logs and checkpoints."""
    results: Path = records.RESULTS
    """Folder of results."""
    accept_code: tuple[str, ...] = ()
    """Versions of the code (column `code` of the results) whose finished units count as finished."""


def make_specs(
    units: Sequence[Unit], preset: Preset, work: Path, accept: Sequence[str] = ()
) -> dict[Unit, dict[str, Any]]:
    """What workers need to know of the units; `init` is filled in when the model is there.

    Raises:
        InvalidInputError: DIFFLCS_YCB_DIR is set, but a mesh is not there.
    """
    sources = {task: object_source(task) for task in dict.fromkeys(unit.task for unit in units)}
    codes = {method: code_version(method) for method in dict.fromkeys(unit.method for unit in units)}
    specs = {}
    for unit in units:
        code = codes[unit.method]
        keys = [unit_key(unit, preset, sources, version) for version in (code, *accept)]
        done = (key for key in keys if finished_record(work / key, key) is not None)
        key = next(done, keys[0])
        specs[unit] = {
            "key": key,
            "unit": asdict(unit),
            "config": asdict(config_of(unit, preset)),
            "settings": settings_hash(unit, preset, sources),
            "source": sources[unit.task],
            "code": code,
            "init": None,
            "folder": str((work / key).resolve()),
        }
    return specs


def compute(
    specs: Mapping[Unit, dict[str, Any]],
    pool: Pool,
    store: Callable[[dict[str, Any]], object],
    display: Display | None = None,
    observe: Callable[[Mapping[str, dict[str, Any]]], object] = lambda progress: None,
) -> dict[Unit, dict[str, Any]]:
    """Compute the units that are not finished, a unit after the one that it starts from.

    Args:
        specs: the units.
        pool: what computes.
        store: called with the record of every finished unit, also of those finished before.
        display: shows what goes on.
        observe: called with the progress of the running units, by key.

    Returns:
        The record of every unit.

    Raises:
        InvalidInputError: what a unit starts from is missing.
    """
    for unit in specs:
        if unit.init is not None and unit.init not in specs:
            raise InvalidInputError(f"units: expected {unit.init}, from which {unit} starts, among them; add it")
    found: dict[Unit, dict[str, Any]] = {}
    for unit, spec in specs.items():
        record = finished_record(Path(spec["folder"]), spec["key"])
        if record is not None:
            found[unit] = record
            store(record)
    waiting = [unit for unit in specs if unit not in found]
    running: dict[str, Unit] = {}

    def end(unit: Unit, record: dict[str, Any]) -> None:
        found[unit] = record
        if record["error"] is None:
            path = Path(specs[unit]["folder"]) / "record.json"
            if not path.exists():  # the worker has another disk
                write_json(path, record)
            store(record)
        if display is not None:
            display.end(unit, record)

    while waiting or running:
        for unit in list(waiting):
            first = found.get(unit.init) if unit.init is not None else None
            if first is not None and first["error"] is not None:
                waiting.remove(unit)
                end(unit, failure(specs[unit], f"it starts from {unit.init}, which failed"))
            elif len(running) < pool.slots and (unit.init is None or first is not None):
                waiting.remove(unit)
                pool.submit({**specs[unit], "init": None if first is None else first["model"]})
                running[specs[unit]["key"]] = unit
        for record in pool.finished():
            end(running.pop(record["key"]), record)
        progress = pool.progress()
        observe(progress)
        if display is not None:
            display.update({unit: progress.get(key, {}) for key, unit in running.items()}, waiting, pool.slots)
        if running:
            time.sleep(_POLL_SECONDS)
    return found


def make_pool(options: Compute) -> Pool:
    """The pool that the options ask for.

    Raises:
        InvalidInputError: two kinds are asked for, or an address makes no sense.
        SchedulerError: the scheduler does not answer.
    """
    if options.dask is not None and options.scheduler is not None:
        raise InvalidInputError(
            "expected --dask or --scheduler, got both; --scheduler uses a cluster that runs already"
        )
    if options.dask is not None and not options.dask.startswith("local:"):
        raise InvalidInputError(f"dask: expected local:N, got {options.dask!r}; an address goes to --scheduler")
    address = options.dask or options.scheduler
    return LocalPool(options.workers) if address is None else DaskPool(address)


def run(options: Compute, artefacts: Sequence[str]) -> int:
    """Compute what artefacts need.

    Args:
        options: what, how much and where.
        artefacts: some of `units.ARTEFACTS`; none for all.

    Returns:
        Exit code: 0, or 1 if units have failed.

    Raises:
        DiffLCSError: an option cannot be used, or results in the folder are of another version. Nothing was changed.
    """
    preset = get_preset(options.preset or "quick", options.seeds, options.goals)
    units = matrix(artefacts, preset.seeds, options.objects, options.methods, options.recipes)
    for stand_in in (False, True):
        records.read(records.path_of(options.results, preset.name, stand_in))  # an error now, not after hours
    specs = make_specs(units, preset, options.work, options.accept_code)
    stand_ins = sorted({unit.task for unit in units if specs[unit]["source"]["source"] == "stand_in"})
    if stand_ins:
        print(
            f"no meshes of {', '.join(stand_ins)}: computing with stand-ins, whose results are kept apart. For the YCB "
            f"objects set DIFFLCS_YCB_DIR, or run `difflcs assets download`"
        )
    done = sum(finished_record(Path(spec["folder"]), spec["key"]) is not None for spec in specs.values())
    print(
        f"{preset.name}: {len(units)} units of {preset.evaluate_at[-1]:g} minutes of data, {preset.seeds} seeds, "
        f"{preset.goals} goals; {done} finished before"
    )
    store = lambda record: records.add(options.results, preset.name, records.rows_of(record))  # noqa: E731
    if done == len(units):
        found = compute(specs, _NoPool(), store)
    else:
        pool = make_pool(options)
        try:
            with Display(len(units) - done, preset.evaluate_at[-1]) as display:
                found = compute(specs, pool, store, display)
        finally:
            pool.close()
    failed = {unit: record for unit, record in found.items() if record["error"] is not None}
    for unit, record in failed.items():
        print(f"failed: {unit}: {record['error']}\n        its files: {specs[unit]['folder']}")
    if failed:
        print(
            f"{len(failed)} of {len(units)} units failed; the same command tries them again and computes nothing else"
        )
    return FAILED if failed else 0


class _NoPool:
    """Where nothing is left to compute."""

    slots = 0

    def submit(self, spec: pools.Spec) -> None:
        """See `Pool`."""

    def finished(self) -> list[dict[str, Any]]:
        """See `Pool`."""
        return []

    def progress(self) -> Mapping[str, dict[str, Any]]:
        """See `Pool`."""
        return {}

    def close(self) -> None:
        """See `Pool`."""


def command_line(kind: type[Any], action: Callable[[Any], int], arguments: Sequence[str] | None = None) -> int:
    """Run a script's `action` with the options that its command line gives.

    Args:
        kind: dataclass of the options.
        action: what the script does; returns the exit code.
        arguments: words of the command line; those of the process if None.

    Returns:
        The exit code: that of the action, 2 after an error of ours, 130 after Ctrl-C.
    """
    import tyro

    from difflcs_envs import DifflcsEnvsError

    try:
        return action(tyro.cli(kind, args=arguments, config=(tyro.conf.FlagCreatePairsOff,)))
    except (DiffLCSError, DifflcsEnvsError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on where this one stopped", file=sys.stderr)
        return 130


@dataclass(frozen=True)
class Runs(Compute):
    """Compute runs for tables and figures. Interrupt it at any time; the same command goes on."""

    artefacts: tuple[str, ...] = ()
    """Some of table1, curves, transfer; all by default."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return command_line(Runs, lambda options: run(options, options.artefacts), arguments)


if __name__ == "__main__":
    sys.exit(main())
