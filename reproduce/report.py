"""What the tables and figures share: which results, how they are written, and the numbers in README.md."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import records
import runs
from records import Cell, ResultsError, Row
from rich.console import Console
from rich.table import Table
from stats import Comparison, Summary, compare, summarise
from units import get_preset, shared_code

from difflcs._files import write_atomically
from difflcs.errors import CheckpointError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

README = Path(__file__).parent / "README.md"
NAMES: Mapping[str, str] = {
    "lcs-rl": "LCS-RL",
    "violation": "violation only",
    "ppo": "PPO without warm-up",
    "pddm": "PDDM",
}
COLORS: Mapping[str, str] = {"lcs-rl": "#d55e00", "violation": "#0072b2", "ppo": "#e69f00", "pddm": "#009e73"}
"""Okabe–Ito: red, blue, orange, green as in the paper, told apart by colour-blind readers."""
MISSING = "—"


@dataclass(frozen=True)
class Draw(runs.Compute):
    """Options of the scripts that draw tables and figures."""

    rerun: bool = False
    """Compute what is missing, with the amounts of --preset; then draw."""


def load(options: Draw, script: str) -> tuple[str, list[Row], list[Row]]:
    """The results to draw.

    Args:
        options: of the script.
        script: its name, for the error.

    Returns:
        Name of the preset, rows with meshes (and the cube), rows with stand-ins.

    Raises:
        ResultsError: there are none, or they are of another version.
    """
    wanted = ["paper", "quick", "smoke"] if options.preset is None else [get_preset(options.preset).name]
    for name in wanted:
        rows, stand_ins = (records.read(records.path_of(options.results, name, flag)) for flag in (False, True))
        if rows or stand_ins:
            return name, rows, stand_ins
    raise nothing(script, " or ".join(wanted), options)


def nothing(script: str, preset: str, options: Draw) -> ResultsError:
    """The error where there are no results to draw."""
    return ResultsError(
        f"{options.results}: expected results of {preset} for {script}, found none; compute them with: python "
        f"reproduce/{script}.py --rerun --preset {options.preset or 'quick'}"
    )


@dataclass(frozen=True)
class Grid:
    """A table of text.

    Attributes:
        title: what it shows.
        header: names of the columns.
        rows: the cells.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def terminal(self) -> Table:
        """For the terminal."""
        table = Table(title=self.title, title_justify="left", box=None, padding=(0, 1))
        for number, name in enumerate(self.header):
            table.add_column(name, justify="right" if number else "left")
        for row in self.rows:
            table.add_row(*row)
        return table

    def markdown(self) -> str:
        """For Markdown."""
        lines = [self.header, ("---",) * len(self.header), *self.rows]
        return f"**{self.title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"

    def latex(self) -> str:
        """For LaTeX, with the package booktabs."""
        lines = [" & ".join(map(_latex, row)) + r" \\" for row in (self.header, *self.rows)]
        columns = "l" + "c" * (len(self.header) - 1)
        body = "\n".join(["\\toprule", lines[0], "\\midrule", *lines[1:], "\\bottomrule"])
        return f"% {self.title}\n\\begin{{tabular}}{{{columns}}}\n{body}\n\\end{{tabular}}\n"


def _latex(text: str) -> str:
    for old, new in (("%", r"\%"), ("_", r"\_"), ("±", r"$\pm$"), ("−", "$-$"), ("×", r"$\times$"), ("<", "$<$")):
        text = text.replace(old, new)
    return text.replace(MISSING, "---")


def plus_minus(values: Summary | tuple[float, float] | None) -> str:
    """Mean ± standard deviation, as in the paper."""
    if values is None:
        return MISSING
    mean, sd = (values.mean, values.sd) if isinstance(values, Summary) else values
    return f"{mean:.1f}" if math.isnan(sd) else f"{mean:.1f} ± {sd:.1f}"


def difference(comparison: Comparison | None) -> tuple[str, str]:
    """Mean difference with its 95 % interval, and the p-value."""
    if comparison is None:
        return MISSING, MISSING
    found = comparison.difference
    mean = _signed(found.mean)
    if found.n < 2:
        return f"{mean} (one seed)", MISSING
    p = "< 0.001" if comparison.p < 0.001 else f"{comparison.p:.3f}"
    return f"{mean} [{_signed(found.low)}, {_signed(found.high)}]", p


def _signed(value: float) -> str:
    return f"{value:+.1f}".replace("-", "−")


def at(cell: Cell | None, when: str | float) -> Summary | None:
    """Success [%] over the seeds after some minutes of data.

    Args:
        cell: one method on one object.
        when: "peak" (where the mean over the seeds is highest), "final", or minutes of data.

    Returns:
        None if there is no such evaluation.
    """
    values = _values(cell, when)
    return summarise(list(values.values())) if values else None


def paired(a: Cell | None, b: Cell | None, when: str | float) -> Comparison | None:
    """Compare a with b over the seeds that both have, each at its own `when` (see `at`).

    Returns:
        None where they cannot be compared: other goals, another object, or other code of what they have in common.
    """
    if a is None or b is None or _conditions(a) != _conditions(b):
        return None
    ours, theirs = _values(a, when), _values(b, when)
    seeds = sorted(set(ours) & set(theirs))
    return compare([ours[seed] for seed in seeds], [theirs[seed] for seed in seeds]) if seeds else None


def _conditions(cell: Cell) -> set[tuple[object, ...]]:
    return {
        (row.task, row.goals, row.evaluation_seed, shared_code(row.code), row.source, row.mass) for row in cell.rows
    }


def _values(cell: Cell | None, when: str | float) -> dict[int, float]:
    if cell is None:
        return {}
    minute = cell.peak_minute if when == "peak" else max(cell.minutes) if when == "final" else float(when)
    return cell.at(minute)


def provenance(cells: Sequence[Cell | None]) -> list[str]:
    """Where the numbers come from, and what is not as it should be; one sentence each."""
    found = [cell for cell in cells if cell is not None]
    rows = [row for cell in found for row in cell.rows]
    units = {row.key: row for row in rows}.values()
    amounts = sorted({f"{count(cell)} × {cell.rows[0].goals} goals" for cell in found})
    objects = sorted({f"{row.source.replace('_', ' ')} {1000 * row.mass:g} g" for row in rows})
    seconds = sum(row.train_seconds + row.evaluation_seconds for row in units)
    notes = [
        f"Ours: {', '.join(amounts)}, the same goals for all; objects: {', '.join(objects)}.",
        f"Computed: {len(units)} trainings in {seconds / 3600:.1f} core hours, {seconds / len(units):.0f} s each on "
        f"average, on {', '.join(_distinct(rows, 'machine'))}, until {max(row.finished for row in rows)[:10]}; "
        f"{'; '.join(_distinct(rows, 'versions'))}; code {', '.join(_distinct(rows, 'code'))}.",
    ]
    codes = {(row.method, row.code) for row in rows}
    mixed = len(codes) > len({row.method for row in rows}) or len({shared_code(row.code) for row in rows}) > 1
    if mixed or len(amounts) > 1:
        notes.append("Not everything was computed on as many seeds and goals, or with one code for each method:")
        notes += [f"- {_name(cell)}: {len(cell.seeds)} × {cell.rows[0].goals}, {cell.rows[0].code}" for cell in found]
    notes += [
        f"{_name(cell)}: {cell.left_out} trainings of other settings left out." for cell in found if cell.left_out
    ]
    return notes


def _distinct(rows: Sequence[Row], name: str) -> list[str]:
    return sorted({str(getattr(row, name)) for row in rows})


def _name(cell: Cell) -> str:
    unit = cell.rows[0].unit
    return str(unit).rpartition(", seed")[0]


def count(cell: Cell) -> str:
    """How many seeds it has."""
    return "1 seed" if len(cell.seeds) == 1 else f"{len(cell.seeds)} seeds"


def stem(script: str, preset: str, stand_in: bool = False) -> str:
    """Name of an output: plain for the paper's amounts, with the preset's name otherwise."""
    return script + ("" if preset == "paper" else f"-{preset}") + ("-stand-in" if stand_in else "")


def write_tables(folder: Path, name: str, grids: Sequence[Grid], notes: Sequence[str]) -> None:
    """Print tables with their notes; write them as Markdown and LaTeX, and into README.md where they belong there."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=160)
    for grid in grids:
        console.print(grid.terminal())
        console.print()
    for note in notes:
        console.print(note, markup=False, highlight=False)
    markdown = "\n".join([grid.markdown() for grid in grids]) + "\n" + "\n".join(notes) + "\n"
    latex = "\n".join([grid.latex() for grid in grids] + [f"% {note}" for note in notes]) + "\n"
    write_atomically(folder / f"{name}.md", markdown.encode())
    write_atomically(folder / f"{name}.tex", latex.encode())
    print(f"written: {folder / name}.md, .tex")
    if folder.resolve() == records.RESULTS.resolve():
        update_readme(name, markdown)


def update_readme(name: str, markdown: str, readme: Path | None = None) -> None:
    """Replace what stands between `<!-- results: NAME -->` and `<!-- end -->`; nothing where there is no such mark."""
    readme = readme or README
    text = readme.read_text()
    before, mark, rest = text.partition(f"<!-- results: {name} -->\n")
    _, end, after = rest.partition("<!-- end -->")
    if mark and not end:
        raise ResultsError(f"{readme}: expected <!-- end --> after {mark.strip()}, found none; put it back")
    new = f"{before}{mark}\n{markdown}\n{end}{after}"
    if mark and new != text:
        write_atomically(readme, new.encode())


def new_figure(width: float, height: float) -> Figure:
    """A figure [inch] that needs no screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def draw_curve(axes: Axes, cell: Cell | None, label: str, color: str, dashed: bool = False) -> None:
    """Mean success against minutes of data, with the 95 % t-interval over the seeds; of two seeds, both instead.

    A t-interval of two values is as wide as the axes and would hide the curves.
    """
    if cell is None:
        return
    points = [(minute, summarise(list(cell.at(minute).values()))) for minute in cell.minutes]
    x = [minute for minute, _ in points]
    style = {"color": color, "lw": 2, "ls": "--" if dashed else "-", "marker": "o", "ms": 3}
    axes.plot(x, [found.mean for _, found in points], label=f"{label} ({count(cell)})", **style)
    if len(cell.seeds) == 2:
        for seed in cell.seeds:
            axes.plot(x, [cell.at(minute)[seed] for minute in cell.minutes], color=color, lw=0.8, alpha=0.6)
    elif len(cell.seeds) > 2:
        low, high = ([getattr(found, end) for _, found in points] for end in ("low", "high"))
        axes.fill_between(x, low, high, color=color, alpha=0.2, lw=0)


def style_axes(axes: Axes, title: str) -> None:
    """Percent against minutes."""
    axes.set(title=title, xlabel="data [min]", ylabel="success [%]", ylim=(0, 102))
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def write_figure(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure as PNG and PDF, atomically and without a date: the same numbers give the same files."""
    for suffix, metadata in (("png", {"Software": None}), ("pdf", {"CreationDate": None})):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, metadata=metadata)
        try:
            write_atomically(folder / f"{name}.{suffix}", buffer.getvalue())
        except OSError as error:
            raise CheckpointError(f"{folder}: expected a folder that can be written, got: {error}") from error
    print(f"written: {folder / name}.png, .pdf")


def script(name: str, artefact: str, options: Draw) -> tuple[int, str, list[Row], list[Row]]:
    """What every drawing script begins with: compute if that is asked for, then load.

    Returns:
        Exit code of the computation, name of the preset, rows with meshes, rows with stand-ins.
    """
    code = 0
    if options.rerun:
        code = runs.run(options, [artefact])
        options = Draw(preset=options.preset or "quick", results=options.results)
    return code, *load(options, name)
