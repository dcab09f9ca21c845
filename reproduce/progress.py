"""What is seen while units are computed: a live table on a terminal, lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text
from units import Unit

_LINES_SECONDS = 60.0
"""Without a terminal, how often what runs is printed."""


class Display:
    """Shows units. A context manager.

    Args:
        total: units to compute.
        minutes: minutes of data of each.
        console: where to; standard output by default.
    """

    def __init__(self, total: int, minutes: float, console: Console | None = None):
        self.console = console or Console()
        self.total, self.minutes = total, minutes
        self.start = time.monotonic()
        self.started: dict[Unit, float] = {}
        self.durations: dict[str, list[float]] = {}
        self.ended, self.failed = 0, 0
        self._live = Live(console=self.console, refresh_per_second=4) if self.console.is_terminal else None
        self._last_line = self.start

    def __enter__(self) -> Display:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.update(Text(""))
            self._live.stop()

    def end(self, unit: Unit, record: Mapping[str, Any]) -> None:
        """A unit has ended."""
        self.ended += 1
        seconds = time.monotonic() - self.started.pop(unit, time.monotonic())
        if record["error"] is None:
            self.durations.setdefault(unit.method, []).append(seconds)
            last = record["curve"][-1]
            text = f"{100 * last['success']:.1f} % of {last['goals']} goals"
        else:
            self.failed += 1
            text = f"FAILED: {record['error']}"
        # No markup: an error may hold brackets.
        self.console.print(
            f"[{self.ended}/{self.total}] {unit}: {text} ({seconds:.0f} s)", markup=False, highlight=False
        )

    def update(self, running: Mapping[Unit, Mapping[str, Any]], waiting: Sequence[Unit], slots: int) -> None:
        """What runs, with what it last reported, and what waits."""
        for unit in running:
            self.started.setdefault(unit, time.monotonic())
        for unit in set(self.started) - set(running):
            del self.started[unit]
        left = self._left(running, waiting, slots)
        state = (
            f"{self.ended} of {self.total} done, {self.failed} failed, {len(running)} running, {len(waiting)} waiting, "
            f"{_clock(time.monotonic() - self.start)} elapsed, {'about ' + _clock(left) if left else 'unknown'} left"
        )
        if self._live is not None:
            self._live.update(Group(self._table(running), Text(state)))
        elif time.monotonic() - self._last_line > _LINES_SECONDS:
            self._last_line = time.monotonic()
            self.console.print(state, markup=False, highlight=False)

    def _table(self, running: Mapping[Unit, Mapping[str, Any]]) -> Table:
        table = Table(box=None, padding=(0, 2))
        for name in ("running", "data [min]", "success [%]", "elapsed"):
            table.add_column(name, justify="left" if name == "running" else "right")
        for unit, state in running.items():
            success = state.get("success")
            table.add_row(
                str(unit),
                f"{state.get('minutes', 0.0):.1f} of {self.minutes:g}",
                "" if success is None else f"{100 * success:.1f}",
                _clock(time.monotonic() - self.started[unit]),
            )
        return table

    def _left(self, running: Mapping[Unit, Mapping[str, Any]], waiting: Sequence[Unit], slots: int) -> float | None:
        """Seconds left: by method the mean of finished units, else what the speed of running ones promises."""
        known = {method: sum(values) / len(values) for method, values in self.durations.items()}
        for unit, state in running.items():
            if unit.method not in known and state.get("minutes", 0.0) > 0.1 * self.minutes:
                known[unit.method] = (time.monotonic() - self.started[unit]) * self.minutes / state["minutes"]
        if not known:
            return None
        default = sum(known.values()) / len(known)
        left = sum(known.get(unit.method, default) for unit in waiting)
        for unit in running:
            left += max(1.0, known.get(unit.method, default) - (time.monotonic() - self.started[unit]))
        return left / max(1, min(slots, len(running) + len(waiting)))


def _clock(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
