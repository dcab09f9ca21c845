"""Add the model of a finished run to the zoo: `python reproduce/add_to_zoo.py RUN [--force]`, in a checkout.

The run has to be one that learned a system for an MPC and was evaluated at its end. Its model gets the name that its
task has for models, with the method behind it unless that is the default one. No part of the wheel.
"""

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import tyro

from difflcs import zoo
from difflcs.errors import CheckpointError, DiffLCSError
from difflcs.rl import write_atomically
from difflcs.rl.methods import DEFAULT_METHOD
from difflcs.rl.runs.checkpoint import RunDirectory
from difflcs.rl.runs.training import TrainConfig, flatten, stored_config
from difflcs.rl.tasks import get_task


def add(run: Path | str, *, force: bool = False, root: Path = zoo.MODELS) -> zoo.ModelCard:
    """Add the model of a finished run to the zoo, with its card.

    Args:
        run: directory of `difflcs train`.
        force: replace a model of that name.
        root: where the models lie.

    Raises:
        CheckpointError: the run is not finished or was not evaluated at its end, it learned no system for an MPC, or
            there is a model of that name.
    """
    directory = RunDirectory.open(run)
    config = stored_config(directory)
    if not directory.finished():
        raise CheckpointError(f"{run}: expected a finished run; continue it with: difflcs train --out {run} --resume")
    if config.method.solver is None:
        raise CheckpointError(
            f"{run}: expected a run that learned a system for an MPC, got one of {config.method.name}: "
            f"{config.method.kind}"
        )
    task, method = get_task(config.task), config.method.name
    name = (task.model_name or task.name) + ("" if method == DEFAULT_METHOD else f"-{method}")
    card = _card(directory, config, name)
    if (root / name).exists() and not force:
        raise CheckpointError(f"{root / name}: expected no model of that name, got one; replace it with --force")
    directory.learned(config.method.kind)  # complete and undamaged
    files = {file: (directory.model / file).read_bytes() for file in ("config.json", "model.safetensors")}
    files["card.json"] = (json.dumps(asdict(card), indent=2, sort_keys=True) + "\n").encode()
    for file, content in files.items():
        write_atomically(root / name / file, content)
    return card


def _card(run: RunDirectory, config: TrainConfig, name: str) -> zoo.ModelCard:
    stored: Any = run.config()
    rows = run.rows()
    last = rows[-1] if rows else {}
    if not last.get("evaluation_goals"):
        raise CheckpointError(
            f"{run.path}: expected an evaluation at the end of {run.log}, got none; train with --final-goals 1000"
        )
    described, versions = stored.get("object", {}), stored["versions"]
    zoo.check_object(described, run.path)
    numbers: dict[str, Any] = {k: float(last[f"evaluation_{k}"]) for k in ("success_rate", "ci_low", "ci_high")}
    numbers |= {k: int(last[f"evaluation_{k}"]) for k in ("goals", "solver_failures")}
    return zoo.ModelCard(
        name=name,
        task=config.task,
        method=config.method.name,
        minutes=config.minutes,
        seed=config.seed,
        **numbers,
        evaluation_seed=config.evaluation_seed,
        object=described,
        backend=config.method.solver or "",
        version=str(versions["difflcs"]),
        command=training_command(config, stored.get("init")),
        versions=versions,
        settings=json.loads(json.dumps(config.to_json())),
    )


def training_command(config: TrainConfig, init: object = None) -> str:
    """Make the command line of a training: task, method, minutes, seed, and settings that differ from today's defaults.

    Args:
        config: the training.
        init: what the run started from, as config.json holds it.
    """
    settings, usual = (
        flatten(json.loads(json.dumps(c.to_json()))) for c in (config, TrainConfig(method=type(config.method)()))
    )
    told = {name: settings.pop(name) for name in ("task", "method", "minutes", "seed")}
    told |= {name: value for name, value in settings.items() if name not in usual or value != usual[name]}
    words = ["difflcs", "train", *(word for name, value in told.items() for word in _flag(name, value))]
    if init is not None:
        source = Path(str(init))  # of a path the last part only: folders of one machine mean nothing elsewhere
        source = source.parent if source.name == "model" else source
        words += ["--init", source.name]
    return shlex.join(words)


def _flag(name: str, value: object) -> list[str]:
    name = name.removeprefix("settings.").replace("_", "-")
    if isinstance(value, bool):
        group, dot, last = name.rpartition(".")
        return [f"--{name}" if value else f"--{group}{dot}no-{last}"]
    values = value if isinstance(value, list) else [value]
    return [f"--{name}", *(f"{v:g}" if isinstance(v, float) and float(f"{v:g}") == v else str(v) for v in values)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script; return the exit code."""
    try:
        card = tyro.cli(add, args=arguments, config=(tyro.conf.PositionalRequiredArgs, tyro.conf.FlagCreatePairsOff))
    except (DiffLCSError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    print(f"{card}\nwritten: {zoo.MODELS / card.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
