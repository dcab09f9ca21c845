"""Where units are computed: processes of this machine, or the workers of a Dask cluster. Both do the same."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import units
import worker
from worker import Spec

from difflcs._files import write_json
from difflcs.errors import DiffLCSError, InvalidInputError, MissingDependencyError

ATTEMPTS = 3
"""How often a unit is begun whose worker dies; it goes on from its last checkpoint."""
_CONNECT_SECONDS = 5.0
_TOPIC = "difflcs-reproduce"
_ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


class SchedulerError(DiffLCSError):
    """The Dask scheduler cannot be used."""


class Pool(Protocol):
    """Computes units side by side. Used by one thread."""

    @property
    def slots(self) -> int:
        """Units that can run at a time; it may change."""
        ...

    def submit(self, spec: Spec) -> None:
        """Start a unit."""
        ...

    def finished(self) -> list[dict[str, Any]]:
        """The records of units that have ended since the last call."""
        ...

    def progress(self) -> Mapping[str, dict[str, Any]]:
        """Key → what the running units last reported, see `worker.Report`."""
        ...

    def close(self) -> None:
        """Stop everything at once; what runs can be resumed."""
        ...


class LocalPool:
    """One process per unit: nothing that happens in one can harm another, or the process that waits for them.

    Args:
        slots: processes at a time; one per core by default.
    """

    def __init__(self, slots: int | None = None):
        if slots is not None and slots < 1:
            raise InvalidInputError(f"workers: expected at least 1, got {slots}; pass a larger number")
        self.slots = slots or len(os.sched_getaffinity(0))
        self._running: dict[str, tuple[Spec, subprocess.Popen[bytes], int]] = {}

    def submit(self, spec: Spec) -> None:
        """See `Pool`."""
        self._start(spec, 1)

    def finished(self) -> list[dict[str, Any]]:
        """See `Pool`."""
        records = []
        for key, (spec, process, attempt) in list(self._running.items()):
            code = process.poll()
            if code is None:
                continue
            del self._running[key]
            record = _read(Path(spec["folder"]) / "record.json")
            if record is not None:
                records.append(record)
            elif attempt < ATTEMPTS:
                self._start(spec, attempt + 1)
            else:
                output = (Path(spec["folder"]) / "output.txt").read_text(errors="replace")[-2000:]
                how = f"signal {-code}" if code < 0 else f"exit code {code}"
                text = f"its process ended {ATTEMPTS} times without a result, the last time with {how}; out of memory?"
                records.append(worker.failure(spec, text, output))
        return records

    def _start(self, spec: Spec, attempt: int) -> None:
        folder = Path(spec["folder"])
        (folder / "progress.json").unlink(missing_ok=True)
        if worker.finished_record(folder, spec["key"]) is None:
            (folder / "record.json").unlink(missing_ok=True)  # that of an earlier failure
        write_json(folder / "spec.json", spec)
        with (folder / "output.txt").open("ab") as output:
            process = subprocess.Popen(
                [sys.executable, str(Path(worker.__file__)), str(folder / "spec.json")],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env={**os.environ, **_ONE_THREAD},
                start_new_session=True,  # Ctrl-C reaches this process alone, which then stops the others
            )
        self._running[spec["key"]] = (spec, process, attempt)

    def progress(self) -> Mapping[str, dict[str, Any]]:
        """See `Pool`."""
        reported = {key: _read(Path(spec["folder"]) / "progress.json") for key, (spec, *_) in self._running.items()}
        return {key: state or {} for key, state in reported.items()}

    def close(self) -> None:
        """See `Pool`."""
        for _, process, _ in self._running.values():
            process.kill()  # a training can be resumed whatever instant it ends at
        for _, process, _ in self._running.values():
            process.wait()
        self._running.clear()


def _read(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


class DaskPool:
    """The workers of a Dask cluster. They need difflcs, not this folder, and share no disk with this process.

    Where they do share the folder of work, a unit whose worker dies goes on from its last checkpoint on another.

    Args:
        address: of the scheduler, tcp://host:port; or "local:N" for N processes of this machine.
    """

    def __init__(self, address: str):
        try:
            import cloudpickle
            import distributed
        except ImportError as error:
            raise MissingDependencyError(
                'expected the package distributed, not installed; run: pip install "difflcs[reproduce]"'
            ) from error
        for module in (sys.modules[__name__], units, worker):
            cloudpickle.register_pickle_by_value(module)
        self._cluster: Any = None
        if address.startswith("local:"):
            count = address.removeprefix("local:")
            if not count.isdigit() or int(count) < 1:
                raise InvalidInputError(f"dask: expected local:N with N at least 1, got {address!r}; pass local:2")
            self._cluster = distributed.LocalCluster(
                n_workers=int(count),
                threads_per_worker=1,
                dashboard_address=None,  # pyright: ignore[reportArgumentType]
                silence_logs=logging.ERROR,
            )
        elif "://" not in address:
            raise InvalidInputError(f"scheduler: expected an address tcp://host:port, got {address!r}; pass one")
        try:
            self._client = distributed.Client(self._cluster or address, timeout=_CONNECT_SECONDS)
        except (OSError, TimeoutError, ValueError) as error:
            raise SchedulerError(
                f"scheduler: expected a Dask scheduler at {address}, got no connection in {_CONNECT_SECONDS:g} s "
                f"({error}); start one with `dask scheduler`, or correct the address"
            ) from error
        self._futures: dict[str, tuple[Spec, Any]] = {}
        self._progress: dict[str, dict[str, Any]] = {}
        self._lock = threading.Lock()
        self._client.subscribe_topic(_TOPIC, self._hear)

    @property
    def slots(self) -> int:
        """Threads of all workers that are there now."""
        return max(1, sum(info["nthreads"] for info in self._client.scheduler_info(n_workers=-1)["workers"].values()))

    def _hear(self, event: tuple[float, dict[str, Any]]) -> None:
        with self._lock:
            self._progress[event[1]["key"]] = event[1]

    def submit(self, spec: Spec) -> None:
        """See `Pool`."""
        # A worker may die three times with a unit (`distributed.scheduler.allowed-failures`), as in `LocalPool`.
        # A lambda is pickled by value; a function with a name would be looked for in this module, on the worker.
        future = self._client.submit(
            lambda unit: _compute(unit), dict(spec), key=f"{spec['key']}-{os.urandom(4).hex()}", pure=False
        )
        self._futures[spec["key"]] = (spec, future)

    def finished(self) -> list[dict[str, Any]]:
        """See `Pool`."""
        records = []
        for key, (spec, future) in list(self._futures.items()):
            if not future.done():
                continue
            del self._futures[key]
            error = future.exception() if future.status == "error" else None
            if future.status == "finished":
                records.append(future.result())
            else:
                records.append(worker.failure(spec, f"Dask: {future.status}: {error}"))
        return records

    def progress(self) -> Mapping[str, dict[str, Any]]:
        """See `Pool`."""
        with self._lock:
            return {key: dict(state) for key, state in self._progress.items() if key in self._futures}

    def close(self) -> None:
        """See `Pool`."""
        for _, future in self._futures.values():
            future.cancel()
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()


def _compute(spec: Spec) -> dict[str, Any]:
    """What a worker of Dask does with a unit."""
    from distributed import get_worker

    return worker.execute(spec, lambda state: get_worker().log_event(_TOPIC, state))
