"""The campaign: every class of hostile problems over every target, each returned element judged.

    python -m tests.conformance.hostile.campaign --count 1000000 --out results.jsonl
    python -m tests.conformance.hostile.campaign --markdown results.jsonl --fill
    python -m tests.conformance.hostile.campaign --only "mpc-flat/warm" --seed 0 --index 17

A run appends one line per chunk to its file and, started again, goes on from there. A chunk depends on the class, the
seed and its number alone, so that seed and index of an element give it back.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
import zlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

from difflcs import Status
from tests.conformance.hostile import forms, generators, targets
from tests.conformance.hostile.targets import Outcome


@dataclass(frozen=True)
class Cell:
    """One row of the table: a class of problems and a target. A chunk of it is `size` problems of one shape."""

    problems: str
    target: str
    size: int
    share: float  # of the count, relative to the others

    @property
    def name(self) -> str:
        return f"{self.problems}/{self.target}"

    @property
    def small(self) -> bool:
        return self.target in targets.SLOW_TARGETS

    def chunk(self, seed: int, number: int):
        """Problems of one chunk, and the generator for what else is drawn."""
        key = zlib.crc32(f"{self.problems} {'small' if self.small else ''}".encode())
        rng = np.random.default_rng([seed, key, number])
        with np.errstate(all="ignore"):
            problems = _GENERATORS[self.problems](rng, self.size, self.small)
        return problems, np.random.default_rng([seed, key, number, 1])

    def run(self, seed: int, number: int, gradients: bool = True) -> Outcome:
        problems, rng = self.chunk(seed, number)
        return _TARGETS[self.kind][self.target](problems, rng, gradients)

    @property
    def kind(self) -> str:
        return self.problems.split("-")[0]


_GENERATORS = {**generators.LCP_CLASSES, **generators.MPC_CLASSES, **generators.LOSS_CLASSES, **forms.FORM_CLASSES}
_TARGETS = {
    "lcp": targets.LCP_TARGETS,
    "mpc": {**targets.MPC_TARGETS, **targets.SLOW_TARGETS},
    "loss": targets.LOSS_TARGETS,
    "form": forms.FORM_TARGETS,
}
CELLS = [
    *(Cell(p, t, 256, 2.0) for p in generators.LCP_CLASSES if p != "lcp-large" for t in targets.LCP_TARGETS),
    *(Cell("lcp-large", t, 8, 0.02) for t in targets.LCP_TARGETS),
    *(Cell(p, t, 128, 1.0) for p in generators.MPC_CLASSES for t in targets.MPC_TARGETS),
    *(Cell(p, "ipopt", 8, 0.01) for p in generators.MPC_CLASSES),
    *(Cell(p, "relaxed", 8, 0.005) for p in generators.MPC_CLASSES),
    *(Cell(p, t, 64, 0.25) for p in generators.LOSS_CLASSES for t in targets.LOSS_TARGETS),
    *(Cell(p, t, 24, 0.05) for p in forms.FORM_CLASSES for t in forms.FORM_TARGETS),
]


@dataclass
class Record:
    """What became of one chunk, or of many."""

    cell: str
    seed: int
    chunk: int = -1
    tried: int = 0
    converged: int = 0
    degenerate: int = 0
    flagged: int = 0
    silent: int = 0
    compared: int = 0  # gradients against differences
    worst: float = 0.0  # largest violation / limit of what was promised and kept or not
    by_check: dict[str, int] = field(default_factory=dict)
    failures: list[tuple[int, str, float]] = field(default_factory=list)  # index, check, violation / limit
    seconds: float = 0.0  # of CPU

    def add(self, other: Record) -> None:
        for name in ("tried", "converged", "degenerate", "flagged", "silent", "compared", "seconds"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.worst = max(self.worst, other.worst)
        for name, count in other.by_check.items():
            self.by_check[name] = self.by_check.get(name, 0) + count
        self.failures = (self.failures + other.failures)[:1000]

    @property
    def solved_share(self) -> float:
        return (self.converged + self.degenerate) / max(self.tried, 1)


def run_chunk(cell: Cell, seed: int, number: int, gradients: bool = True) -> Record:
    started = time.process_time()
    outcome = cell.run(seed, number, gradients)
    silent = np.flatnonzero(outcome.worst > 1)
    first = [max(outcome.ratios, key=lambda name: outcome.ratios[name][i]) for i in silent]
    by_check = {name: int((ratio > 1).sum()) for name, ratio in outcome.ratios.items()}
    start = number * cell.size
    failures = [(start + int(i), name, float(outcome.worst[i])) for i, name in zip(silent, first, strict=True)]
    return Record(
        cell=cell.name,
        seed=seed,
        chunk=number,
        tried=len(outcome.status),
        converged=int((outcome.status == Status.CONVERGED).sum()),
        degenerate=int((outcome.status == Status.DEGENERATE).sum()),
        flagged=int((~outcome.solved).sum()),
        silent=len(silent),
        compared=outcome.compared,
        worst=float(outcome.worst.max(initial=0.0)),
        by_check={k: v for k, v in by_check.items() if v},
        failures=failures[:20],
        seconds=time.process_time() - started,
    )


def plan(count: int, cells: list[Cell]) -> Iterator[tuple[Cell, int]]:
    """Chunks of a run, the cells in turn, so that an early end has a bit of everything."""
    total = sum(cell.share for cell in cells)
    chunks = {cell: max(1, round(count * cell.share / total / cell.size)) for cell in cells}
    for number in range(max(chunks.values(), default=0)):
        yield from ((cell, number) for cell in cells if number < chunks[cell])


def line(record: Record) -> str:
    """One line of a results file."""
    return json.dumps(asdict(record))


def reproduction(record: Record) -> str:
    """The command that shows the first silent failure of a record."""
    index = record.failures[0][0] if record.failures else 0
    return f'python -m tests.conformance.hostile.campaign --only "{record.cell}" --seed {record.seed} --index {index}'


def read(path: Path) -> list[Record]:
    """Records of a results file; a line cut by a kill is dropped."""
    records = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            records.append(Record(**json.loads(line)))
        except (json.JSONDecodeError, TypeError):
            continue
    return records


def markdown(records: list[Record]) -> str:
    """The table of docs/promises.md: one row per class, all targets together."""
    rows = {cell.problems: Record(cell.problems, 0) for cell in CELLS}
    total = Record("all", 0)
    for record in records:
        problems = record.cell.split("/")[0]
        rows.setdefault(problems, Record(problems, 0)).add(record)
        total.add(record)
    lines = ["| problems | tried | solved [%] | flagged | gradients compared | silent |", "|---|---|---|---|---|---|"]
    for row in (*(row for row in rows.values() if row.tried), total):
        solved = f"{100 * row.solved_share:.1f}"
        lines.append(f"| {row.cell} | {row.tried} | {solved} | {row.flagged} | {row.compared} | {row.silent} |")
    return "\n".join(lines)


PAGE = Path("docs/promises.md")


def fill(page: Path, name: str, table: str) -> None:
    """Put a table between the marks of a page."""
    begin, end = (f"<!-- {name}: {where} -->\n" for where in ("begin", "end"))
    before, rest = page.read_text().split(begin)
    page.write_text(f"{before}{begin}{table}\n{end}{rest.split(end)[1]}")


def _work(cell: Cell, seed: int, number: int) -> Record:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of NumPy and cvxpylayers, about the overflows that are asked for
        return run_chunk(cell, seed, number)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20000, help="problems in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of results, one line per chunk; a run goes on from it")
    parser.add_argument("--only", default="", help="cells that contain this, such as mpc-flat or mpc-flat/warm")
    parser.add_argument("--index", type=int, help="show this one element of --only")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--markdown", type=Path, help="print the table of a results file and end")
    parser.add_argument(
        "--fill", type=Path, nargs="?", const=PAGE, help=f"with --markdown: put it into this page instead, {PAGE}"
    )
    options = parser.parse_args()
    if options.markdown:
        records = read(options.markdown)
        if options.fill:
            fill(options.fill, "campaign", markdown(records))
        print(markdown(records))
        return
    exact = [cell for cell in CELLS if cell.name == options.only]
    cells = exact or [cell for cell in CELLS if options.only in cell.name]
    if not cells:
        raise SystemExit(f"--only: no such class or target among {', '.join(c.name for c in CELLS)}")
    if options.index is not None:
        show(cells[0], options.seed, options.index)
        return
    records = read(options.out) if options.out else []
    records = [r for r in records if r.seed == options.seed]
    done = {(r.cell, r.chunk) for r in records}
    todo = [(cell, number) for cell, number in plan(options.count, cells) if (cell.name, number) not in done]
    file = options.out.open("a") if options.out else None
    if file and options.out.stat().st_size and not options.out.read_text().endswith("\n"):
        file.write("\n")  # a kill cut the last line
    started, last = time.perf_counter(), 0.0
    # Processes of their own, one thread each: a crash of a solver ends the run with an error, never in silence.
    alone = {"mp_context": get_context("spawn"), "initializer": torch.set_num_threads, "initargs": (1,)}
    with ProcessPoolExecutor(options.workers, **alone) as pool:
        futures = [pool.submit(_work, cell, options.seed, number) for cell, number in todo]
        for k, future in enumerate(as_completed(futures)):
            record = future.result()
            records.append(record)
            if file:
                file.write(line(record) + "\n")
                file.flush()
            for index, check, worst in record.failures[:3]:
                print(f"SILENT {record.cell} --seed {record.seed} --index {index}: {check}, {worst:.3g} of its limit")
            if time.perf_counter() - last > 30:
                last = time.perf_counter()
                print(f"{k + 1} of {len(todo)} chunks, {last - started:.0f} s", flush=True)
    print(markdown(records))


def show(cell: Cell, seed: int, index: int) -> None:
    """One element, alone: what it returns, and how far each promise is from its limit."""
    number, i = divmod(index, cell.size)
    problems, rng = cell.chunk(seed, number)
    whole = cell.run(seed, number)
    alone = _TARGETS[cell.kind][cell.target](problems.select(slice(i, i + 1)), rng, True)
    print(f"{cell.name}, seed {seed}, index {index} (chunk {number}, element {i})")
    for label, outcome, j in (("in its batch", whole, i), ("alone", alone, 0)):
        status = int(outcome.status[j])
        print(f"{label}: {Status(status).name if status >= 0 else 'REFUSED'}")
        for name, ratio in outcome.ratios.items():
            print(f"  {name:28} {ratio[j]:.3g} of its limit")


if __name__ == "__main__":
    main()
