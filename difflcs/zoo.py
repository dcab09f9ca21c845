"""Learned models that ship with the package, and what is known about each.

    from difflcs import LCSModel, zoo
    lcs = LCSModel.from_pretrained("trifinger-cube")
    print(zoo.card("trifinger-cube").success_rate)

`difflcs zoo` lists them; `difflcs evaluate`, `render` and `train --init` take them as `zoo:trifinger-cube`.

A maintainer adds a finished run by `python difflcs/_zoo/add.py RUN` in a checkout of the repository.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflcs import _storage, _zoo
from difflcs.errors import CheckpointError

if TYPE_CHECKING:
    from difflcs.rl.checkpoint import RunDirectory
    from difflcs.rl.rollout import Policy

__all__ = ["PREFIX", "Learned", "ModelCard", "card", "names", "path"]

PREFIX = _zoo.PREFIX
"""Before a name it says to the command line and to `LCSModel.from_pretrained`: a model of the zoo, not a path."""

_NUMBERS = ("minutes", "success_rate", "ci_low", "ci_high")
_COUNTS = ("seed", "goals", "evaluation_seed", "solver_failures")
_WORDS = ("name", "task", "method", "backend", "version", "command")


@dataclass(frozen=True)
class ModelCard:
    """Where a model of the zoo comes from and how good it is.

    Attributes:
        name: its name in the zoo.
        task: what it was trained for, and is evaluated on.
        method: how it was learned, as `difflcs train --method` takes it.
        minutes: data [min of simulated time].
        seed: of the training.
        success_rate: successes per goal, without noise.
        ci_low: lower end of the Wilson 95 % interval.
        ci_high: its upper end.
        goals: goals of that evaluation.
        evaluation_seed: their seed.
        solver_failures: MPC solves of that evaluation that did not converge.
        object: what decides whether results can be compared, as the task describes its environment.
        backend: MPC solver of training and evaluation.
        version: of difflcs.
        command: what trained it.
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
        """Where the shape of the object is from, such as built_in, ycb_mesh or stand_in; "" if nobody said."""
        return str(self.object.get("source", ""))

    @property
    def success_text(self) -> str:
        """Success rate, goals and interval, as `difflcs evaluate` prints them."""
        rate, low, high = (100 * value for value in (self.success_rate, self.ci_low, self.ci_high))
        return f"{rate:.1f} % of {self.goals} goals (95 % interval {low:.1f} to {high:.1f} %)"

    def __str__(self) -> str:
        lines = {
            "task": self.task,
            "object": described(self.object),
            "method": f"{self.method}, {self.minutes:g} min of data, seed {self.seed}, backend {self.backend}",
            "success": f"{self.success_text}, goal seed {self.evaluation_seed}",
            "solver": f"{self.solver_failures} solves failed in that evaluation",
            "versions": ", ".join(f"{name} {version}" for name, version in self.versions.items() if version),
            "trained by": self.command,
        }
        return "\n".join([self.name, *(f"  {name:<10} {text}" for name, text in lines.items())])


def names() -> tuple[str, ...]:
    """Names of the models, in alphabetical order."""
    return _zoo.names()


def path(name: str) -> Path:
    """The folder of a model: what `LCSModel.save_pretrained` wrote, and card.json.

    Args:
        name: such as "trifinger-cube" or "zoo:trifinger-cube".

    Raises:
        CheckpointError: no model has this name; the message lists those there are.
    """
    return _zoo.find(name)


def card(name: str) -> ModelCard:
    """The card of a model.

    Raises:
        CheckpointError: no model has this name, or its card is damaged.
    """
    return _read(path(name) / "card.json")


def table(cards: Sequence[ModelCard]) -> str:
    """One line per model."""
    head = ("name", "method", "data", "success", "interval", "goals", "object")
    rows = [
        (
            c.name,
            c.method,
            f"{c.minutes:g} min",
            f"{100 * c.success_rate:.1f} %",
            f"{100 * c.ci_low:.1f} to {100 * c.ci_high:.1f}",
            str(c.goals),
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
        raise CheckpointError(
            f"{file}: expected the fields {sorted(wanted)} of a card, got {_storage.short(got)}; {remedy}"
        )
    kinds = dict.fromkeys(_NUMBERS, (int, float)) | dict.fromkeys(_COUNTS, (int,)) | dict.fromkeys(_WORDS, (str,))
    kinds |= {"object": (dict,), "versions": (dict,), "settings": (dict,)}
    for name, kind in kinds.items():
        if not isinstance(values[name], kind) or isinstance(values[name], bool):
            got = _storage.short(values[name])
            raise CheckpointError(f"{file}: expected {kind[0].__name__} for {name}, got {got}; {remedy}")
    ranges = dict.fromkeys(("success_rate", "ci_low", "ci_high"), (0, 1)) | dict.fromkeys(_COUNTS, (0, 2**63))
    for name, (low, high) in {**ranges, "minutes": (0, 1e6)}.items():
        if not low <= values[name] <= high:
            raise CheckpointError(f"{file}: expected {low} to {high:g} for {name}, got {values[name]}; {remedy}")
    check_object(values["object"], file)
    if not all(isinstance(version, str | None) for version in values["versions"].values()):
        got = _storage.short(values["versions"])
        raise CheckpointError(f"{file}: expected texts for versions, got {got}; {remedy}")
    return ModelCard(**values)


def check_object(found: Mapping[str, Any], source: object) -> None:
    """Check what a file says of the object that a model was trained on.

    Raises:
        CheckpointError: something else than texts and numbers.
    """
    if not all(isinstance(value, str | int | float | bool | None) for value in found.values()):
        raise CheckpointError(
            f"{source}: expected texts and numbers that describe an object, got {_storage.short(dict(found))}; "
            f"restore it from a copy"
        )


def described(found: Mapping[str, Any]) -> str:
    """What decides whether results can be compared, in one line; no hashes."""
    texts = [f"{key.replace('_', ' ')} {value}" for key, value in found.items() if key not in ("name", "sha256")]
    return " ".join([str(found.get("name", "")), f"({', '.join(texts)})" if texts else ""]).strip() or "nothing special"


@dataclass(frozen=True)
class Learned:
    """What `difflcs evaluate` and `render` take: what a run has learned, or a model of the zoo.

    Attributes:
        name: the run directory, or "zoo:NAME".
        task: what it was trained for.
        method: how.
        backend: MPC solver; None without one.
        policy: from states and goals to plans.
        finished: whether the training is.
        object: what it was trained on, as the environment described it; None if it did not.
        run: the run, if it is one.
        card: the card, if it is a model of the zoo.
    """

    name: str
    task: str
    method: str
    backend: str | None
    policy: Policy
    finished: bool
    object: Mapping[str, Any] | None
    run: RunDirectory | None = None
    card: ModelCard | None = None

    @classmethod
    def open(cls, source: Path | str) -> Learned:
        """Load it.

        Args:
            source: run directory, or "zoo:NAME".

        Raises:
            CheckpointError: there is none, or it cannot be used.
        """
        from difflcs.rl.checkpoint import RunDirectory
        from difflcs.rl.methods import get_method
        from difflcs.rl.tasks import get_task
        from difflcs.rl.training import load_policy, stored_config

        name = str(source)
        if name.startswith(PREFIX):
            known = card(name)
            task = get_task(known.task)
            make: Any = get_method(known.method)
            method = make(backend=known.backend)
            learned = method.rebuild(task, *_storage.load_record(path(name), method.kind), name)
            policy = method.policy(task, learned)
            return cls(name, known.task, known.method, known.backend, policy, True, known.object, card=known)
        run = RunDirectory.open(source)
        config, found = stored_config(run), run.config().get("object")
        found = found if isinstance(found, dict) else None
        if found is not None:
            check_object(found, name)
        method = config.method
        return cls(name, config.task, method.name, method.solver, load_policy(run), run.finished(), found, run=run)

    def fits(self, found: Mapping[str, Any]) -> bool:
        """Whether an environment holds what it was trained on, as far as both say; True if that is not known."""
        own = self.object or {}
        return all(own[key] == found[key] for key in own.keys() & found.keys())
