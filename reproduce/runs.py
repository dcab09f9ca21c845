"""Compute the runs behind the tables and figures: `python reproduce/runs.py --preset paper`.

Worker processes of Dask compute the units of work (`units.py`) on this machine. What is finished is never
computed again; what was interrupted goes on; a failure is shown, does not stop the rest, and is tried again next time.
Results go to `reproduce/results/`, everything else (models, logs) to `runs/reproduce/`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import deployment
import pandas as pd
import recipes
import records
import tyro
import units
import worker
from recipes import Chosen
from rich.progress import Progress, TaskID, TimeElapsedColumn
from units import Artefact, Method, Object, Preset, PresetName, Unit
from worker import Job

from difflcs.errors import DiffLCSError, InvalidInputError
from difflcs.rl import write_atomically

if TYPE_CHECKING:
    from distributed import Client


def check_amounts(**amounts: int | None) -> None:
    """Raise `InvalidInputError` if an amount is below 1."""
    for name, amount in amounts.items():
        if amount is not None and amount < 1:
            raise InvalidInputError(f"{name}: expected at least 1, got {amount}; pass another --{name}")


@dataclass(frozen=True)
class Compute:
    """Options of the computation. Without --preset and --rerun the scripts only draw existing results."""

    preset: PresetName | None = None
    """smoke (about a minute), quick (about half an hour a script on 2 cores) or paper (10 seeds, 1000 goals). To draw:
    the results to take, by default those of the largest preset there is."""
    seeds: int | None = None
    """Runs per method and object, with the seeds 1000, 1001, …; the preset's number by default."""
    goals: int | None = None
    """Goals of every evaluation; by default the preset's numbers, on the way and at the end."""
    objects: tuple[Object, ...] = ()
    """All by default."""
    methods: tuple[Method, ...] = ()
    """All by default."""
    recipes: tuple[Chosen, ...] = ()
    """By default all; on the objects with the presets quick and smoke ours alone."""
    missing: bool = False
    """Leave out what is in the results already, wherever it was computed; by default only what is in --work."""
    workers: int | None = None
    """Processes on this machine, one core each; the number of cores by default."""
    work: Path = Path("runs") / "reproduce"
    """Folder for models, logs and checkpoints."""
    results: Path = records.RESULTS
    """Folder of results."""

    def __post_init__(self) -> None:
        check_amounts(seeds=self.seeds, goals=self.goals, workers=self.workers)


def make_jobs(wanted: Sequence[Unit], preset: Preset, work: Path) -> list[Job]:
    """Make the jobs of units, in their order."""
    objects = {task: units.describe_object(task) for task in dict.fromkeys(unit.task for unit in wanted)}
    stand_ins = [task for task, described in objects.items() if described["source"] == "stand_in"]
    if stand_ins:
        print(f"no YCB meshes of {', '.join(stand_ins)} (`difflcs assets download`): stand-ins, with results apart")
    return [Job(unit, preset, units.key_of(unit, preset, objects), work.resolve()) for unit in wanted]


def still_missing(jobs: Sequence[Job], results: Sequence[pd.DataFrame]) -> list[Job]:
    """List the jobs without results, and those whose runs they start from."""
    known = {tuple(row) for rows in results for row in rows[records.IDENTITY].itertuples(index=False)}
    starts = {job.unit.init for job in jobs if job.identity not in known}
    return [job for job in jobs if job.identity not in known or job.unit in starts]


def compute(
    jobs: Sequence[Job],
    client: Any,
    store: Callable[[pd.DataFrame], object],
    show: Progress,
    execute: Callable[[Job], pd.DataFrame] = worker.execute,
) -> dict[Unit, str]:
    """Compute the units that are not finished, a unit after the one that it starts from, which is among `jobs`.

    `client` is of Dask. The results of each are handed to `store` as they come. Returns which failed, and why.
    """
    by_unit = {job.unit: job for job in jobs}
    waiting = [job for job in jobs if job.result() is None]
    running: dict[Any, tuple[Job, TaskID]] = {}
    failed: dict[Unit, str] = {}
    done = show.add_task("units", total=len(waiting))

    def end(job: Job, outcome: str) -> None:
        show.advance(done)
        # Without markup: an error may hold brackets.
        show.console.print(f"{job.unit}: {outcome}", markup=False, highlight=False, soft_wrap=True)

    def fail(job: Job, error: str) -> None:
        failed[job.unit] = error
        end(job, f"FAILED: {error}")

    while waiting or running:
        # Not more than there are threads: a worker that dies would take the blame for units that only waited there.
        slots = max(1, sum(client.nthreads().values()))
        for job in list(waiting):
            first = by_unit[job.unit.init] if job.unit.init else None
            if first is not None and first.unit in failed:
                waiting.remove(job)
                fail(job, f"it starts from {first.unit}, which failed")
            elif len(running) < slots and (first is None or first.result() is not None):
                waiting.remove(job)
                ready = job if first is None else replace(job, init=first.folder / "run")
                # A closure is pickled by value, with all it refers to: workers need not have this folder.
                future = client.submit(lambda ready=ready: execute(ready), pure=False)
                running[future] = job, show.add_task(str(job.unit), total=None)
        time.sleep(0.1)
        for future in [future for future in running if future.done()]:
            job, bar = running.pop(future)
            show.remove_task(bar)
            try:
                rows = future.result()
            except Exception as error:  # whatever a unit, its worker or Dask may raise
                write_atomically(job.folder / "error.txt", traceback.format_exc().encode())
                fail(job, f"{type(error).__name__}: {error}")
                continue
            store(rows)
            end(job, f"{100 * rows.success.iloc[-1]:.1f} % of {rows.goals.iloc[-1]} goals")
    return failed


@contextlib.contextmanager
def connect(workers: int | None = None) -> Iterator[Client]:
    """Start worker processes on this machine, which end with this one however that ends.

    A unit whose worker dies goes on from its last checkpoint, as often as Dask allows (`allowed-failures`, 3).
    """
    import cloudpickle
    import dask.config
    from distributed import Client, LocalCluster

    for module in (sys.modules[__name__], recipes, records, units, deployment, worker):
        cloudpickle.register_pickle_by_value(module)
    options: Any = {"memory_limit": None, "dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
    count = workers or len(os.sched_getaffinity(0))
    # Dask gives up a worker that is not there 15 s after a loss, even one that has come back since, is lost again and
    # is just being started: then nobody would compute the rest. Here each is started again for ever.
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "52 weeks"}),
        LocalCluster(n_workers=count, threads_per_worker=1, **options) as cluster,
        Client(cluster) as client,
    ):
        yield client


def run(options: Compute, artefacts: Sequence[str]) -> int:
    """Compute the units that artefacts (none: all) need; return the exit code, 1 if units have failed."""
    preset = units.PRESETS[options.preset or "quick"]
    preset = preset.with_amounts(options.seeds, options.goals)
    wanted = units.matrix(artefacts, preset, options.objects, options.methods, options.recipes)
    # An error in a file of results comes now, not after hours.
    known = [records.read(records.path_of(options.results, preset.name, stand_in)) for stand_in in (False, True)]
    every = make_jobs(wanted, preset, options.work)
    jobs = still_missing(every, known) if options.missing else every
    finished = [rows for job in jobs if (rows := job.result()) is not None]
    store = partial(records.add, options.results, preset.name)
    for rows in finished:
        store(rows)
    print(
        f"{preset.name}: {len(every)} units of {preset.evaluate_at[-1]:g} minutes of data, {preset.seeds} seeds, "
        f"{preset.final_goals} goals; {len(every) - len(jobs) + len(finished)} finished before"
    )
    if len(finished) == len(jobs):
        return 0
    columns = (*Progress.get_default_columns(), TimeElapsedColumn())
    bars = Progress(*columns, disable=not sys.stdout.isatty())  # the lines of units that have ended are printed anyway
    with connect(options.workers) as client, bars:
        failed = compute(jobs, client, store, bars)
    for job in jobs:
        if job.unit in failed:
            print(f"failed: {job.unit}: {failed[job.unit]}\n        its files: {job.folder}")
    if failed:
        print(f"{len(failed)} of {len(jobs)} units failed; the same command tries them again and computes nothing else")
    return 1 if failed else 0


def command_line(kind: type[Any], action: Callable[[Any], int], arguments: Sequence[str] | None = None) -> int:
    """Run a script with its options, a dataclass; return the exit code, 2 after a user's error, 130 after Ctrl-C."""
    from difflcs_envs import DifflcsEnvsError

    try:
        return action(tyro.cli(kind, args=arguments, config=(tyro.conf.FlagCreatePairsOff,)))
    except (DiffLCSError, DifflcsEnvsError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on where this one stopped", file=sys.stderr)
        return 130


@dataclass(frozen=True)
class Runs(Compute):
    """Compute runs for tables and figures. Interrupt it at any time; the same command goes on."""

    artefacts: tuple[Artefact, ...] = ()
    """All by default."""


if __name__ == "__main__":
    sys.exit(command_line(Runs, lambda options: run(options, options.artefacts)))
