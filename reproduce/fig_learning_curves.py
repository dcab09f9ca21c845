"""Learning curves on the cube: LCS-RL, violation loss only, PPO without warm-up, PDDM.

`python reproduce/fig_learning_curves.py` draws the tracked results; `--rerun --preset smoke|quick|paper` computes them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import report
from paper import CURVES
from records import Cell, Row, select
from report import Draw, Grid
from runs import command_line
from units import METHODS

RECIPES = {"ours": "our recipe", "paper": "the paper's recipe"}
_ONE_RECIPE = {"ppo": "paper", "pddm": "none"}
"""Methods that are the same in both."""


def cells_of(rows: Sequence[Row]) -> dict[str, dict[str, Cell | None]]:
    """Recipe → method → results. Methods that know one recipe only belong to both."""
    return {
        recipe: {method: select(rows, "cube", method, _ONE_RECIPE.get(method, recipe)) for method in METHODS}
        for recipe in RECIPES
    }


def table(cells: dict[str, dict[str, Cell | None]]) -> Grid:
    """What the text of the paper says about the figure, and ours."""
    lines = []
    for recipe, name in RECIPES.items():
        for method, cell in cells[recipe].items():
            if cell is None or (recipe == "paper" and method in _ONE_RECIPE):
                continue
            said = CURVES[method]
            paper = ", ".join(f"{value:g} at {minute:g} min" for minute, value in said.items())
            label = report.NAMES[method] + ("" if method in _ONE_RECIPE else f", {name}")
            peak = f"{report.plus_minus(report.at(cell, 'peak'))} at {cell.peak_minute:g} min"
            numbers = [report.plus_minus(report.at(cell, when)) for when in (6.0, 24.0, "final")]
            lines.append((label, numbers[0], peak, numbers[1], numbers[2], paper))
    header = ("method", "6 min", "peak", "24 min", "final", "paper (from its text)")
    return Grid("Success on the cube, mean ± standard deviation over the seeds [%]", header, tuple(lines))


def draw(options: Draw) -> int:
    """Compute if asked for, then write figure and table; returns the exit code."""
    code, preset, rows, _ = report.script("fig_learning_curves", "curves", options)
    cells = cells_of(rows)
    found = [cell for of_methods in cells.values() for cell in of_methods.values() if cell is not None]
    if not found:
        raise report.nothing("fig_learning_curves", preset, options)
    figure = report.new_figure(10.0, 4.8)
    for axes, (recipe, title) in zip(figure.subplots(1, 2, sharey=True), RECIPES.items(), strict=True):
        for method, cell in cells[recipe].items():
            report.draw_curve(axes, cell, report.NAMES[method], report.COLORS[method])
            if recipe == "paper":
                minutes, values = zip(*CURVES[method].items(), strict=True)
                style = {"marker": "x", "s": 60, "zorder": 5, "clip_on": False}
                axes.scatter(minutes, values, color=report.COLORS[method], **style)
        report.style_axes(axes, title)
        if recipe == "paper":
            axes.scatter([], [], marker="x", color="grey", label="what the paper's text says")
        axes.legend(fontsize=8, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)
    name = report.stem("fig_learning_curves", preset)
    report.write_figure(figure, options.results, name)
    unique = list(dict.fromkeys(found))  # a method with one recipe is on both sides
    report.write_tables(options.results, name, [table(cells)], report.provenance(unique))
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return command_line(Draw, draw, arguments)


if __name__ == "__main__":
    sys.exit(main())
