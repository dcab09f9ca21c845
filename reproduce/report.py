"""Common parts of the tables and figures: selection of results, format of numbers, and output."""

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import records
import runs
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from recipes import PROTOCOLS, RECIPES
from records import Cell
from stats import IQM, Estimate, bootstrap, p_value, wilson
from units import PRESETS

from difflcs.errors import CheckpointError
from difflcs.rl import write_atomically

README = Path(__file__).parent / "README.md"
NAMES = {"lcs-rl": "LCS-RL", "violation": "violation only", "ppo": "PPO without warm-up", "pddm": "PDDM"}
COLORS = {"lcs-rl": "#d55e00", "violation": "#0072b2", "ppo": "#e69f00", "pddm": "#009e73"}
"""Okabe–Ito: red, blue, orange, green as in the paper, told apart by colour-blind readers."""
MISSING = "—"
FEWEST = 3
"""Seeds that a sentence about a paired difference takes: the interval of two is their range, and says nothing."""
UNTOLD = f"not compared, having fewer than {FEWEST} seeds or other goals"
"""Note for numbers without an interval."""
STATISTICS = "Brackets and p are explained in reproduce/README.md, section Statistics."
Tables = dict[str, pd.DataFrame]
"""Title → table of text."""
Drawing = Callable[[pd.DataFrame, Path, str], bool]
"""Draws rows into files of a folder and a name; returns whether there was something to draw."""


@dataclass(frozen=True)
class Draw(runs.Compute):
    """Options of the scripts that draw tables and figures."""

    rerun: bool = False
    """Compute what is missing, with the amounts of --preset; then draw."""


def main(name: str, artefact: str, draw: Drawing, words: Sequence[str] | None = None) -> int:
    """Run a drawing script: compute if asked for, then draw, stand-ins apart; return the exit code."""

    def action(options: Draw) -> int:
        amounts = ("seeds", "goals", "objects", "methods", "recipes", "missing")
        if not options.rerun and (given := [amount for amount in amounts if getattr(options, amount)]):
            raise CheckpointError(
                f"{', '.join(given)}: expected with --rerun alone, got without; results are drawn whole"
            )
        code = runs.run(options, [artefact]) if options.rerun else 0
        preset = options.preset or ("quick" if options.rerun else None)
        wanted = [preset] if preset else list(PRESETS)
        for one in wanted:
            drawn = False
            for stand_in in (False, True):
                rows = records.read(records.path_of(options.results, one, stand_in))
                stem = name + ("" if one == "paper" else f"-{one}") + ("-stand-in" if stand_in else "")
                drawn |= draw(rows, options.results, stem)
            if drawn:
                return code
        raise CheckpointError(
            f"{options.results}: expected results of {' or '.join(wanted)} for {name}, found none; compute them with: "
            f"python reproduce/{name}.py --rerun --preset {preset or 'quick'}"
        )

    return runs.command_line(Draw, action, words)


Pairs = Mapping[str, tuple[Cell | None, Cell | None]]
"""Comparisons: name → its two results."""


def name_of(method: str, recipe: str, start: str = "scratch", protocol: Any = "full") -> str:
    """Name a method in tables: its recipe, start and deployment."""
    label = "" if (method, recipe) == ("pddm", "ours") else RECIPES[recipe].label
    begins = "" if start == "scratch" else f"from the {start}'s model"
    deployed = "" if protocol == "full" else PROTOCOLS[protocol]
    return ", ".join(filter(None, [NAMES[method], label, begins, deployed]))


def at(cell: Cell | None, when: str | float) -> Estimate | None:
    """Return the success [%] at some minute, see `Cell.minute`; None if there is no such evaluation."""
    values = [] if cell is None else list(cell.at(when))
    if cell is None or not values:
        return None
    return wilson(values[0], cell.goals(when)) if len(values) == 1 else bootstrap([values])


def over_objects(cells: Sequence[Cell | None], when: str | float) -> Estimate | None:
    """Compute the interquartile mean over objects and seeds; None if an object is missing or was not evaluated."""
    values = [[] if cell is None else list(cell.at(when)) for cell in cells]
    return bootstrap(values, IQM) if all(values) else None


def mean_over(cells: Sequence[Cell | None], when: str | float) -> float:
    """Compute the mean success over the objects that have results; -1 without any."""
    means = [cell.at(when).mean() for cell in cells if cell is not None]
    return sum(means) / len(means) if means else -1.0


def paired(a: Cell | None, b: Cell | None, when: str | float) -> list[float]:
    """Compute the success of a − b [%] for each seed of both; none if they differ in goals, object or version.

    Peaks may be of different goals: at the end there are more of them than on the way.
    """
    conditions = ["task", "evaluation_seed", "source", "mass"]
    if a is None or b is None or any(a.first[name] != b.first[name] for name in conditions):
        return []
    if a.first.method == b.first.method and a.first.version != b.first.version:
        return []
    if a.at(when).empty or b.at(when).empty:
        return []
    if when != "peak" and a.goals(when) != b.goals(when):
        return []
    return list((a.at(when) - b.at(when)).dropna())


def paired_estimate(a: Cell | None, b: Cell | None, when: str | float) -> Estimate | None:
    """Compute the mean of `paired`, with its interval from `FEWEST` seeds on; None if nothing can be compared."""
    values = paired(a, b, when)
    if len(values) < FEWEST:
        return Estimate(sum(values) / len(values)) if values else None
    return bootstrap([values])


def listed(names: Sequence[str]) -> str:
    """Join names in a sentence, such as "mug, wrench and banana"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1] if names else "none"]))


def sides(differences: Mapping[str, Estimate | None]) -> tuple[list[str], list[str], list[str], list[str]]:
    """Sort names by their difference: above zero, below it, on either side by its interval, or without one."""
    known = {name: value for name, value in differences.items() if value is not None and not math.isnan(value.low)}
    above = [name for name, value in known.items() if value.low > 0]
    below = [name for name, value in known.items() if value.high < 0]
    either = [name for name in known if name not in above and name not in below]
    return above, below, either, [name for name in differences if name not in known]


def verdict(differences: Mapping[str, Estimate | None], against: str = "on", unlike: str = "on") -> str:
    """Describe where a difference is above or below zero or undecided, by the intervals; and what was not compared.

    `against` and `unlike` are the words between a finding and its names, which are objects by default.
    """
    *told, unknown = sides(differences)
    ways = (f"better {against}", f"worse {against}", f"not to be told apart {unlike}")
    parts = [
        f"{how} all {len(names)}" if len(names) == len(differences) else f"{how} {len(names)} ({listed(names)})"
        for how, names in zip(ways, told, strict=True)
        if names
    ]
    return ", ".join([*parts, f"{UNTOLD}: {listed(unknown)}"] if unknown else parts)


def verdicts(pairs: Pairs, when: Mapping[str, str | float], *words: str) -> dict[str, str]:
    """Describe the differences of pairs at each time, see `verdict`."""
    apart = {label: {name: paired_estimate(*pair, at_) for name, pair in pairs.items()} for label, at_ in when.items()}
    return {label: verdict(differences, *words) for label, differences in apart.items()}


def bullets(sentences: Sequence[str]) -> list[str]:
    """Format notes as a list."""
    return ["", *(f"- {sentence}" for sentence in sentences), ""] if sentences else []


def say(estimate: Estimate | None, signed: bool = False) -> str:
    """Format a number with its interval."""
    if estimate is None:
        return MISSING
    value, low, high = (f"{x:{'+' if signed else ''}z.1f}".replace("-", "−") for x in estimate)
    return value if math.isnan(estimate.low) else f"{value} [{low}, {high}]"


def say_difference(differences: Sequence[float]) -> tuple[str, str]:
    """Format the mean difference with its interval, and the p-value."""
    if not differences:
        return MISSING, MISSING
    p = p_value(differences)
    text = MISSING if math.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"
    return say(bootstrap([differences]), signed=True), text


def differences(heading: str, pairs: Pairs, when: Mapping[str, str | float]) -> pd.DataFrame:
    """Make a row for each pair a − b, paired by seed, with its p, at each time."""
    columns = {heading: list(pairs)}
    for label, at_ in when.items():
        means, ps = zip(*(say_difference(paired(*pair, at_)) for pair in pairs.values()), strict=True)
        columns |= {f"{label}: difference": list(means), f"{label}: p": list(ps)}
    return pd.DataFrame(columns)


def provenance(cells: Sequence[Cell | None]) -> list[str]:
    """Describe the origin of the numbers: amounts computed, machines, and versions of each method."""
    used = list(dict.fromkeys(cell for cell in cells if cell is not None))
    rows = pd.concat([cell.rows for cell in used])
    units = rows.drop_duplicates(records.IDENTITY)
    seconds = units.train_seconds + units.evaluation_seconds
    goals = ", ".join(map(str, rows.evaluation_seed.unique()))
    objects = (units.source.str.replace("_", " ") + units.mass.map(" {:g} kg".format)).unique()
    notes = [
        STATISTICS,
        f"Computed: {len(units)} trainings in {seconds.sum() / 3600:.1f} core hours, {seconds.mean():.0f} s each on "
        f"average, on {', '.join(units.machine.unique())}, until {units.finished.max()[:10]}; "
        f"{'; '.join(units.versions.unique())}; objects: {', '.join(objects)}; "
        f"goals of seed {goals}, where they are fewer the first of them.",
        "Every number is of one version of its method:",
    ]
    tasks: dict[str, dict[str, None]] = {}
    for cell in used:
        first = cell.first
        label = name_of(first.method, first.recipe, first.start, first.protocol)
        left_out = f"; {cell.left_out} trainings of others left out" if cell.left_out else ""
        line = f"{label}: version {first.version}, {cell.amount}{left_out}"
        tasks.setdefault(line, {})[first.task.replace("_", " ")] = None
    return notes + [f"- {line} ({', '.join(names)})" for line, names in tasks.items()]


def write_tables(
    folder: Path, name: str, tables: Tables, notes: Sequence[str], figures: Mapping[str, str] | None = None
) -> None:
    """Print tables with their notes; write them as Markdown, and into README.md if it has their mark.

    Args:
        folder: where to.
        name: of the files.
        tables: title → table.
        notes: below them, each a paragraph or a line of a list.
        figures: names of figures in the same folder → what they show, for README.md.
    """
    blocks = [
        f"**{title}**\n\n{table.to_markdown(index=False, tablefmt='github', disable_numparse=True)}\n"
        for title, table in tables.items()
    ]
    markdown = "\n".join(blocks) + "\n" + "\n".join(notes) + "\n"
    print(markdown)
    write_atomically(folder / f"{name}.md", markdown.encode())
    print(f"written: {folder / name}.md")
    if folder.resolve() == records.RESULTS.resolve():
        pictures = "".join(f"![{shown}](results/{figure}.png)\n\n" for figure, shown in (figures or {}).items())
        update_readme(name, pictures + markdown)


def update_readme(name: str, markdown: str) -> None:
    """Replace the text between `<!-- results: NAME -->` and `<!-- end -->`; do nothing without such a mark."""
    text = README.read_text()
    before, mark, rest = text.partition(f"<!-- results: {name} -->\n")
    _, end, after = rest.partition("<!-- end -->")
    if mark and not end:
        raise CheckpointError(f"{README}: expected <!-- end --> after {mark.strip()}, found none; put it back")
    new = f"{before}{mark}\n{markdown}\n{end}{after}"
    if mark and new != text:
        write_atomically(README, new.encode())


def draw_curves(axes: Axes, title: str, curves: Sequence[tuple[Cell | None, str, str, str]]) -> None:
    """Draw success against minutes of data really collected, for cells with their labels, colours and line styles.

    Thick the mean over the seeds, with its interval as a band; thin the single seeds.
    """
    for cell, label, color, style in curves:
        if cell is not None:
            minutes, points = cell.minutes, pd.DataFrame([at(cell, minute) for minute in cell.scores])
            axes.plot(
                minutes, points.value, style, label=f"{label} ({cell.seeds})", color=color, lw=2, marker="o", ms=3
            )
            axes.fill_between(minutes, points.low, points.high, color=color, alpha=0.2, lw=0)
            if len(cell.scores) > 1:
                axes.plot(minutes, cell.scores.T, style, color=color, lw=0.5, alpha=0.5)
    axes.set(title=title, xlabel="data [min]", ylabel="success [%]", ylim=(0, 102), xlim=(0, None))
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def write_figure(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure as PNG and PDF, atomically and without a date: the same numbers give the same files."""
    for suffix, metadata in (("png", {"Software": None}), ("pdf", {"CreationDate": None})):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, metadata=metadata)
        write_atomically(folder / f"{name}.{suffix}", buffer.getvalue())
    print(f"written: {folder / name}.png, .pdf")
