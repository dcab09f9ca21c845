"""The table of all commands, and the small ones themselves: `difflcs zoo | assets | bench | doctor`."""

import contextlib
import io
import json
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import torch

from difflcs import zoo
from difflcs._checks import did_you_mean, usable_cpus
from difflcs._optional import require
from difflcs.cli.flags import errors_by_flag
from difflcs.cli.models import Evaluate, Export, Plot, Render
from difflcs.cli.train import Demo, Train, train_command
from difflcs.errors import DiffLCSError, InvalidInputError


@dataclass(frozen=True)
class Zoo:
    """List the learned models that come with difflcs, for use as zoo:NAME."""

    names: tuple[str, ...]
    """Models whose whole cards to show; by default a line for each model."""
    json: bool = False
    """Print the cards as one JSON list."""

    def run(self) -> None:
        """Run the command."""
        cards = [zoo.card(name) for name in self.names or zoo.names()]
        if self.json:
            print(json.dumps([asdict(card) for card in cards], sort_keys=True))
        else:
            print("\n\n".join(map(str, cards)) if self.names else zoo.table(cards))


@dataclass(frozen=True)
class Assets:
    """Fetch the meshes of the YCB objects; without them stand-ins are used."""

    action: Literal["download"]
    """Action on the assets."""
    objects: tuple[str, ...]
    """sugar_box, fish_can, banana, mug, wrench, clamp, large_clamp, extra_large_clamp; by default all."""
    folder: Path | None = None
    """Folder of the assets. By default where the environments look for them."""

    def run(self) -> None:
        """Run the command."""
        require("difflcs_envs", "trimesh", "scipy")
        from difflcs_envs import DifflcsEnvsError
        from difflcs_envs.assets import YCB_DIR_VARIABLE, download

        try:
            download(self.objects or None, self.folder, report=print)
        except (DifflcsEnvsError, ValueError) as error:
            raise InvalidInputError(str(error)) from error
        if self.folder is not None:
            print(f"to use them: export {YCB_DIR_VARIABLE}={self.folder}")

    def interrupted(self) -> str:
        """Return the advice after Ctrl-C."""
        return "run the same command again to continue"


@dataclass(frozen=True)
class Bench:
    """Time the MPC layer here against IPOPT, in less than half a minute."""

    batch: int = 1024
    """Problems per call of backend batched."""
    ipopt_batch: int = 8
    """Problems per call of backend ipopt."""
    repeats: int = 3
    """Timings of each; the best counts."""
    json: bool = False
    """Print one JSON object instead of a table."""
    smoke: bool = False
    """Time a few problems only."""

    def run(self) -> None:
        """Run the command."""
        from difflcs.cli import bench

        threads = usable_cpus()
        sizes = (16, 2, 1) if self.smoke else (self.batch, self.ipopt_batch, self.repeats)
        timings = bench.measure(*sizes, threads=threads)
        if self.json:
            record = {"timings": [{**asdict(t), "ratio": t.ratio} for t in timings], "threads": threads}
            print(json.dumps({**record, "batch": sizes[0], "ipopt_batch": sizes[1], "machine": bench.machine()}))
        else:
            print(bench.table(timings, threads))
            print(
                f"per problem, in batches of {sizes[0]} (ipopt: {sizes[1]}): 9 states, 6 actions, 5 contacts, 5 steps"
            )
            print(", ".join(f"{key} {value}" for key, value in bench.machine().items()))


@dataclass(frozen=True)
class Doctor:
    """Say what works here: solvers, instruction set, extras, pictures, meshes."""

    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        """Run the command."""
        from difflcs.cli import doctor

        return doctor.main(self.json)


_COMMANDS: dict[str, Callable[..., Any]] = {
    "train": Train,
    "evaluate": Evaluate,
    "render": Render,
    "plot": Plot,
    "export": Export,
    "demo": Demo,
    "zoo": Zoo,
    "assets": Assets,
    "bench": Bench,
    "doctor": Doctor,
}


_DESCRIPTION = """Differentiable MPC through learned linear complementarity systems.

  difflcs doctor                                            what works here
  difflcs render zoo:trifinger-cube --out cube.mp4          a learned model
  difflcs train --task cube --minutes 30                    learn one"""


def run(words: Sequence[str]) -> int:
    """Run a command.

    Args:
        words: the command and its flags.

    Returns:
        Exit code: 0, 1 if `doctor` finds the library broken, 2 after an error of ours, 130 after Ctrl-C.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a path may not be valid text
    command: Any = None
    try:
        command = _parse(words)
        torch.set_num_threads(1)  # tensors of 100 × 9 do not gain from threads, and the MPC's workers need the cores
        with _show_log():
            return int(command.run() or 0)
    except DiffLCSError as error:
        print(f"difflcs: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        advice = command.interrupted() if hasattr(command, "interrupted") else "nothing was changed"
        print(f"\ndifflcs: interrupted; {advice}", file=sys.stderr)
        return 130


def _parse(words: Sequence[str]) -> Any:
    """Parse the words into a command with its settings."""
    import tyro

    if words and not words[0].startswith("-") and words[0] not in _COMMANDS:
        near = did_you_mean(words[0], _COMMANDS)
        raise InvalidInputError(f"command: expected one of {', '.join(_COMMANDS)}, got {words[0]!r}{near}; see --help")
    # `train` has settings for which None means something.
    plain = {k: v if k == "train" else Annotated[v, tyro.conf.DisallowNone] for k, v in _COMMANDS.items()}
    if words[:1] == ["train"]:
        plain["train"] = train_command(words[1:])
    with errors_by_flag():
        return tyro.extras.subcommand_cli_from_dict(
            cast(Any, plain),
            prog="difflcs",
            description=_DESCRIPTION,
            args=words,
            config=(
                tyro.conf.PositionalRequiredArgs,
                tyro.conf.PositionalMetavarFromFieldName,
                tyro.conf.FlagCreatePairsOff,
            ),
        )


@contextlib.contextmanager
def _show_log() -> Iterator[None]:
    """Show the log of the library on stderr, one plain line for each record."""
    logger, handler = logging.getLogger("difflcs"), logging.StreamHandler()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(min(logging.INFO, before or logging.INFO))
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
