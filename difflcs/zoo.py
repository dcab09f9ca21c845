"""Learned models that ship with the package, and what is known about each.

    from difflcs import LCSModel, zoo
    lcs = LCSModel.from_pretrained("trifinger-cube")
    print(zoo.card("trifinger-cube").success_rate)

`difflcs zoo` lists them; `difflcs evaluate`, `render` and `train --init` take them as `zoo:trifinger-cube`.

A maintainer adds a finished run, which is evaluated at its end, by

    python -m difflcs.zoo add RUN [NAME] [--force]

in a checkout of the repository with an editable installation. A name is what the task calls its models, with the method
behind it unless that is the default one; without NAME it is made from the run.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflcs import _files, _zoo
from difflcs.errors import CheckpointError, DiffLCSError, InvalidInputError

if TYPE_CHECKING:
    from difflcs.rl.checkpoint import RunDirectory
    from difflcs.rl.rollout import Policy
    from difflcs.rl.training import TrainConfig

__all__ = ["PREFIX", "Learned", "ModelCard", "add", "card", "names", "path"]

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
    remedy = "install difflcs again, or add the run again with `python -m difflcs.zoo add RUN --force`"
    try:
        values = _files.read_json(file)
    except (FileNotFoundError, CheckpointError) as error:
        raise CheckpointError(f"{file}: expected a card, got: {error.args[0]}; {remedy}") from error
    wanted = {f.name for f in fields(ModelCard)}
    if not isinstance(values, dict) or set(values) != wanted:
        got = sorted(values) if isinstance(values, dict) else type(values).__name__
        raise CheckpointError(
            f"{file}: expected the fields {sorted(wanted)} of a card, got {_files.short(got)}; {remedy}"
        )
    kinds = dict.fromkeys(_NUMBERS, (int, float)) | dict.fromkeys(_COUNTS, (int,)) | dict.fromkeys(_WORDS, (str,))
    kinds |= {"object": (dict,), "versions": (dict,), "settings": (dict,)}
    for name, kind in kinds.items():
        if not isinstance(values[name], kind) or isinstance(values[name], bool):
            got = _files.short(values[name])
            raise CheckpointError(f"{file}: expected {kind[0].__name__} for {name}, got {got}; {remedy}")
    ranges = dict.fromkeys(("success_rate", "ci_low", "ci_high"), (0, 1)) | dict.fromkeys(_COUNTS, (0, 2**63))
    for name, (low, high) in {**ranges, "minutes": (0, 1e6)}.items():
        if not low <= values[name] <= high:
            raise CheckpointError(f"{file}: expected {low} to {high:g} for {name}, got {values[name]}; {remedy}")
    check_object(values["object"], file)
    if not all(isinstance(version, str | None) for version in values["versions"].values()):
        raise CheckpointError(f"{file}: expected texts for versions, got {_files.short(values['versions'])}; {remedy}")
    return ModelCard(**values)


def check_object(found: Mapping[str, Any], source: object) -> None:
    """Check what a file says of the object that a model was trained on.

    Raises:
        CheckpointError: something else than texts and numbers.
    """
    if not all(isinstance(value, str | int | float | bool | None) for value in found.values()):
        raise CheckpointError(
            f"{source}: expected texts and numbers that describe an object, got {_files.short(dict(found))}; "
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
            learned = method.rebuild(task, *_files.load_record(path(name), method.kind), name)
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


# --- adding models ----------------------------------------------------------------------------------------------------


def add(run: Path | str, name: str | None = None, *, force: bool = False, root: Path = _zoo.ROOT) -> ModelCard:
    """Put the model of a finished run into the zoo, all at once or not at all.

    Args:
        run: directory of `difflcs train`.
        name: of the model; made from task and method if None.
        force: replace a model of that name.
        root: where the models lie.

    Returns:
        Its card.

    Raises:
        CheckpointError: the run is not finished or was not evaluated at its end, it learned no system for an MPC, or
            there is a model of that name.
        InvalidInputError: the name does not say task and method.
    """
    from difflcs.rl.checkpoint import RunDirectory
    from difflcs.rl.training import stored_config

    directory = RunDirectory.open(run)
    config = stored_config(directory)
    name = _checked_name(name, config)
    if not directory.finished():
        raise CheckpointError(f"{run}: expected a finished run; continue it with: difflcs train --out {run} --resume")
    if config.method.solver is None:
        raise CheckpointError(
            f"{run}: expected a run that learned a system for an MPC, got one of {config.method.name}: "
            f"{config.method.kind}"
        )
    record = directory.learned(config.method.kind)
    content = _card(directory, config, name)
    if (root / name).exists() and not force:
        raise CheckpointError(f"{root / name}: expected no model of that name, got one; replace it with --force")
    root.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=root, prefix=f".{name}.", suffix=".tmp"))
    try:
        new, old = temporary / "new", temporary / "old"
        _files.save_record(new, config.method.kind, *record)
        _files.write_json(new / "card.json", asdict(content))
        if (root / name).exists():
            (root / name).rename(old)
        try:
            new.rename(root / name)
        except OSError:
            if old.exists():
                old.rename(root / name)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return content


def _checked_name(name: str | None, config: TrainConfig) -> str:
    from difflcs.rl.methods import method_names
    from difflcs.rl.tasks import get_task

    task, method = get_task(config.task), config.method.name
    wanted = (task.model_name or task.name) + ("" if method == method_names()[0] else f"-{method}")
    if name is not None and name.removeprefix(_zoo.PREFIX) != wanted:
        raise InvalidInputError(
            f"name: expected {wanted!r} for task {task.name} and method {method}, got {name!r}; leave it out"
        )
    return wanted


def _card(run: RunDirectory, config: TrainConfig, name: str) -> ModelCard:
    stored, rows = run.config(), run.rows()
    last = rows[-1] if rows else {}
    if not last.get("evaluation_goals"):
        raise CheckpointError(
            f"{run.path}: expected an evaluation at the end of {run.log}, got none; train with --final-goals 1000"
        )
    found, versions = stored.get("object", {}), stored.get("versions")
    if not isinstance(found, dict) or not isinstance(versions, dict):
        raise CheckpointError(
            f"{run.path}: expected `object` and `versions` in config.json, got {sorted(stored)}; train it again with "
            f"`difflcs train`, which writes them"
        )
    check_object(found, run.path)
    try:
        rate, low, high = (float(last[f"evaluation_{k}"]) for k in ("success_rate", "ci_low", "ci_high"))
        goals, failures = (int(last[f"evaluation_{k}"]) for k in ("goals", "solver_failures"))
    except (KeyError, ValueError) as error:
        raise CheckpointError(
            f"{run.log}: expected an evaluation in its last row, got {error!r}; train again"
        ) from error
    return ModelCard(
        name=name,
        task=config.task,
        method=config.method.name,
        minutes=config.minutes,
        seed=config.seed,
        success_rate=rate,
        ci_low=low,
        ci_high=high,
        goals=goals,
        evaluation_seed=config.evaluation_seed,
        solver_failures=failures,
        object=found,
        backend=config.method.solver or "",
        version=str(versions.get("difflcs")),
        command=training_command(config, stored.get("init")),
        versions=versions,
        settings=json.loads(json.dumps(config.to_json())),
    )


def training_command(config: TrainConfig, init: object = None) -> str:
    """The command line of a training: task, method, minutes and seed, and what differs from the defaults of today.

    Args:
        config: the training.
        init: what the run started from, as config.json holds it.
    """
    from difflcs.rl.training import TrainConfig

    own, usual = (json.loads(json.dumps(c.to_json())) for c in (config, TrainConfig(method=type(config.method)())))
    words = ["difflcs", "train"]
    for name in ("task", "method", "minutes", "seed"):
        words += _flag(name, own.pop(name))
    words += _differences(own.pop("settings"), usual.pop("settings"))
    words += _differences(own, usual)
    if init is not None:
        source = Path(str(init))  # of a path the last part only: folders of one machine mean nothing elsewhere
        source = source.parent if source.name == "model" else source
        words += ["--init", source.name]
    return shlex.join(words)


def _differences(settings: Mapping[str, Any], usual: Mapping[str, Any], prefix: str = "") -> list[str]:
    words: list[str] = []
    for name, value in settings.items():
        if isinstance(value, dict):
            words += _differences(value, usual.get(name, {}), f"{prefix}{name}.")
        elif name not in usual or value != usual[name]:
            words += _flag(prefix + name, value)
    return words


def _flag(name: str, value: object) -> list[str]:
    name = name.replace("_", "-")
    if isinstance(value, bool):
        group, dot, last = name.rpartition(".")
        return [f"--{name}" if value else f"--{group}{dot}no-{last}"]
    values = value if isinstance(value, list) else [value]
    return [f"--{name}", *(f"{v:g}" if isinstance(v, float) and float(f"{v:g}") == v else str(v) for v in values)]


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m difflcs.zoo add RUN [NAME] [--force]`; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m difflcs.zoo", description="Add learned models to the package.")
    commands = parser.add_subparsers(required=True, metavar="add")
    adding = commands.add_parser("add", help="put the model of a finished run into the zoo")
    adding.add_argument("run", type=Path, metavar="RUN", help="directory of `difflcs train`")
    adding.add_argument("name", nargs="?", metavar="NAME", help="made from task and method by default")
    adding.add_argument("--force", action="store_true", help="replace a model of that name")
    options = parser.parse_args(arguments)
    try:
        content = add(options.run, options.name, force=options.force)
    except (DiffLCSError, OSError) as error:
        print(f"difflcs.zoo: {error}", file=sys.stderr)
        return 2
    print(f"{content}\nwritten: {_zoo.ROOT / content.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
