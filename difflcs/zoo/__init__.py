"""Learned models that ship with the package, and their cards. This module handles files only.

    from difflcs import LCSModel, zoo
    lcs = LCSModel.from_pretrained("trifinger-cube")
    print(zoo.card("trifinger-cube").success_rate)

`difflcs zoo` lists them; `difflcs evaluate`, `render` and `train --init` take them as `zoo:trifinger-cube`.

A maintainer adds a finished run by `python reproduce/add_to_zoo.py RUN` in a checkout of the repository.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from difflcs import _storage
from difflcs._checks import did_you_mean
from difflcs.errors import CheckpointError

__all__ = ["MODELS", "PREFIX", "ModelCard", "card", "names", "path"]

PREFIX = "zoo:"
"""Prefix by which the command line and `LCSModel.from_pretrained` know a model of the zoo from a path."""
MODELS = Path(__file__).parent / "models"
"""Folder of the models, each in a folder with config.json, model.safetensors and card.json."""

_MOST = {"minutes": 1e6, "success_rate": 1, "ci_low": 1, "ci_high": 1}
"""Largest values of the numbers of a card; of the others what 63 bits hold."""


@dataclass(frozen=True)
class ModelCard:
    """Origin and quality of a model of the zoo.

    Attributes:
        name: its name in the zoo.
        task: name of its task.
        method: name of its method, as `difflcs train --method` takes it.
        minutes: data [min of simulated time].
        seed: of the training.
        success_rate: successes per goal, without noise.
        ci_low: lower end of the Wilson 95 % interval.
        ci_high: its upper end.
        goals: goals of that evaluation.
        evaluation_seed: their seed.
        solver_failures: MPC solves of that evaluation that did not converge.
        object: description of the environment by its task; results are comparable if it is the same.
        backend: MPC solver of training and evaluation.
        version: of difflcs.
        command: the command that trained it.
        versions: of the packages that decide a result.
        settings: every setting of the training; defaults may change, these do not.
    """

    name: str
    task: str
    method: str
    minutes: float
    seed: int
    success_rate: float
    ci_low: float
    ci_high: float
    goals: int
    evaluation_seed: int
    solver_failures: int
    object: Mapping[str, Any] = field(hash=False)
    backend: str
    version: str
    command: str
    versions: Mapping[str, str | None] = field(hash=False)
    settings: Mapping[str, Any] = field(hash=False)

    @property
    def object_source(self) -> str:
        """Source of the object's shape, such as built_in, ycb_mesh or stand_in; "" if unknown."""
        return str(self.object.get("source", ""))

    @property
    def success_text(self) -> str:
        """Success rate, goals and interval, as `difflcs evaluate` prints them."""
        return success_text(vars(self))

    def __str__(self) -> str:
        lines = {
            "task": self.task,
            "object": describe(self.object),
            "method": f"{self.method}, {self.minutes:g} min of data, seed {self.seed}, backend {self.backend}",
            "success": f"{self.success_text}, goal seed {self.evaluation_seed}",
            "solver": f"{self.solver_failures} solves failed in that evaluation",
            "versions": ", ".join(f"{name} {version}" for name, version in self.versions.items() if version),
            "trained by": self.command,
        }
        return "\n".join([self.name, *(f"  {name:<10} {text}" for name, text in lines.items())])


def names(root: Path = MODELS) -> tuple[str, ...]:
    """Return the names of the models, in alphabetical order."""
    return tuple(sorted(card.parent.name for card in root.glob("[!._]*/card.json")))


def path(name: str) -> Path:
    """Return the folder of a model, with the files of `LCSModel.save_pretrained` and card.json.

    Args:
        name: "trifinger-cube" or "zoo:trifinger-cube".

    Raises:
        CheckpointError: no model has this name; the message lists those there are.
    """
    name = name.removeprefix(PREFIX)
    known = names()
    if name in known:
        return MODELS / name
    advice = f"`difflcs zoo` lists them{did_you_mean(name, known)}"
    raise CheckpointError(f"zoo: expected one of {', '.join(known) or 'no models'}, got {name!r}; {advice}")


def resolve(source: str | os.PathLike[str]) -> Path:
    """Find the directory that a user means.

    "zoo:NAME" is always a model of the zoo. Otherwise a path that exists wins, then a model of the zoo of that name.

    Raises:
        CheckpointError: a name, not a path, that is neither.
    """
    text = os.fsdecode(source)
    if text.startswith(PREFIX):
        return path(text)
    if os.path.exists(text) or Path(text).name != text:  # only one word may be a name
        return Path(text)
    try:
        return path(text)
    except CheckpointError as error:
        raise CheckpointError(f"{text}: no such directory; {error}") from None


def card(name: str) -> ModelCard:
    """Read the card of a model.

    Raises:
        CheckpointError: no model has this name, or its card is damaged.
    """
    return _read(path(name) / "card.json")


def table(cards: Sequence[ModelCard]) -> str:
    """Format one line per model, for a terminal of 80 columns."""
    head = ("name", "method", "data", "success", "object")
    rows = [
        (
            c.name,
            c.method,
            f"{c.minutes:g} min",
            f"{100 * c.success_rate:.1f} % of {c.goals}",
            c.object_source.replace("_", " "),
        )
        for c in cards
    ]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)) for row in (head, *rows)]
    return "\n".join(line.rstrip() for line in lines)


def _read(file: Path) -> ModelCard:
    remedy = "install difflcs again"
    try:
        values = _storage.read_json(file)
    except (FileNotFoundError, CheckpointError) as error:
        raise CheckpointError(f"{file}: expected a card, got: {error.args[0]}; {remedy}") from error
    wanted = {f.name for f in fields(ModelCard)}
    if not isinstance(values, dict) or set(values) != wanted:
        got = sorted(values) if isinstance(values, dict) else type(values).__name__
        raise CheckpointError(f"{file}: expected fields {sorted(wanted)}, got {_storage.short(got)}; {remedy}")
    for f in fields(ModelCard):
        value, kind = values[f.name], {str: str, int: int, float: int | float}.get(f.type, dict)
        if not isinstance(value, kind) or isinstance(value, bool):
            wanted, got = getattr(kind, "__name__", kind), _storage.short(value)
            raise CheckpointError(f"{file}: expected {wanted} for {f.name}, got {got}; {remedy}")
        most = _MOST.get(f.name, 2**63)
        if isinstance(value, int | float) and not 0 <= value <= most:
            raise CheckpointError(f"{file}: expected 0 to {most:g} for {f.name}, got {value}; {remedy}")
    check_object(values["object"], file)
    if not all(isinstance(version, str | None) for version in values["versions"].values()):
        raise CheckpointError(f"{file}: expected texts as versions, got {_storage.short(values['versions'])}; {remedy}")
    return ModelCard(**values)


def check_object(description: Mapping[str, Any], source: object) -> None:
    """Raise unless the description of the object that a model was trained on is usable.

    Raises:
        CheckpointError: something else than texts and numbers.
    """
    if not all(isinstance(value, str | int | float | bool | None) for value in description.values()):
        raise CheckpointError(
            f"{source}: expected texts and numbers that describe an object, got {_storage.short(dict(description))}; "
            f"restore it from a copy"
        )


def success_text(figures: Mapping[str, Any], prefix: str = "") -> str:
    """Format a success rate, its goals and its interval, whose names have this prefix, as every command prints them."""
    rate, low, high = (100 * float(figures[prefix + name]) for name in ("success_rate", "ci_low", "ci_high"))
    return f"{rate:.1f} % of {figures[prefix + 'goals']} goals (95 % interval {low:.1f} to {high:.1f} %)"


def describe(description: Mapping[str, Any]) -> str:
    """Format the description of an object in one line, without hashes."""
    texts = [f"{key.replace('_', ' ')} {value}" for key, value in description.items() if key not in ("name", "sha256")]
    return (
        " ".join([str(description.get("name", "")), f"({', '.join(texts)})" if texts else ""]).strip()
        or "nothing special"
    )
