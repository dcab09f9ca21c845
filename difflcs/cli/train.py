"""The commands for training: `difflcs train`, whose flags are the settings of its method, and `difflcs demo`."""

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from difflcs._optional import require
from difflcs.cli.flags import find_flags, flag_value
from difflcs.cli.models import film, known_versions
from difflcs.errors import CheckpointError
from difflcs.rl import TrainedPolicy
from difflcs.rl.methods import DEFAULT_METHOD, get_method, method_names
from difflcs.rl.runs.checkpoint import RunDirectory
from difflcs.rl.runs.figures import NoPictureError, plot_learning_curve
from difflcs.rl.runs.progress import Progress
from difflcs.rl.runs.training import TrainConfig, flatten, stored_config, sum_seconds, train
from difflcs.rl.tasks import get_task, is_installed, task_names
from difflcs.zoo import success_text


@dataclass(frozen=True)
class Train(TrainConfig):
    """Train a model and leave a run directory: model, log, checkpoints."""

    out: Path = Path("runs/{task}-{method}-{seed}")
    """Run directory to write; {task}, {method} and {seed} are filled in."""
    init: Path | None = None
    """Run or model directory, or zoo:NAME (see `difflcs zoo`), to start from; a random model if None."""
    resume: bool = False
    """Continue the run in --out, with its own settings and to the same result as without interruption."""
    force: bool = False
    """Replace the run in --out. It is deleted once the new one has begun."""
    smoke: bool = False
    """Finish in seconds, on too little data to learn anything."""
    passed: ClassVar[frozenset[str]] = frozenset()
    """Flags of settings in the command, with which a resumed run is compared."""

    def __post_init__(self) -> None:
        """Check nothing yet: `run` does, so that its errors are printed like all others."""

    def run(self) -> None:
        """Run the command."""
        config = TrainConfig(**{f.name: getattr(self, f.name) for f in fields(TrainConfig)})
        config = config.smoke() if self.smoke else config
        out = self.directory(self.out)
        if self.resume:
            config = self._resumed(config)
        with Progress() as progress:
            run = train(config, out, init=self.init, resume=self.resume, force=self.force, reporter=progress)
        spent = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in sum_seconds(run.rows()).items() if seconds)
        print(f"time: {spent}")
        print(f"finished: {run.path}\nevaluate it with: {self.program(config)} evaluate {shlex.quote(str(run.path))}")

    def _resumed(self, config: TrainConfig) -> TrainConfig:
        stored = stored_config(RunDirectory.open(self.directory(self.out)))
        wanted, before = flatten(config.to_json()), flatten(stored.to_json())
        for name, value in wanted.items():
            flag = name.removeprefix("settings.").replace("_", "-")
            if flag in self.passed and value != before.get(name):
                raise CheckpointError(
                    f"--{flag}: expected {before.get(name)!r}, as {self.directory(self.out)} was started with, got "
                    f"{value!r}; drop the flag, or start another run with another --out"
                )
        if self.init is not None:
            raise CheckpointError("--init: expected it without --resume; a resumed run goes on from its own checkpoint")
        return stored

    def interrupted(self) -> str:
        """Return the advice after Ctrl-C."""
        out = self.directory(self.out)
        if not (out / "config.json").is_file():
            return "nothing was changed"
        program = self.program(stored_config(RunDirectory.open(out)))
        return f"continue with: {program} train --out {shlex.quote(str(out))} --resume"

    @staticmethod
    def program(config: TrainConfig) -> str:
        """Return the command line that knows method and task: that of the script with one of them, or our own."""
        own = type(config.method).__module__.startswith("difflcs.") and is_installed(config.task)
        return "difflcs" if own else f"python {sys.argv[0]}"


def train_command(words: Sequence[str]) -> type[Train]:
    """`Train` with the flags of the method that the words name, or that the run to resume was started with."""
    import tyro

    name = flag_value(words, "--method")
    out = flag_value(words, "--out")
    if name is None and "--resume" in words and out is not None and (Path(out) / "config.json").is_file():
        name = stored_config(RunDirectory.open(Path(out))).method.name
    kind = get_method(name or DEFAULT_METHOD)
    hidden = Annotated[kind, tyro.conf.arg(name="", prefix_name=False)]
    methods = "; ".join(f"{name}: {get_method(name).summary}" for name in method_names())
    chosen: Any = Annotated[
        Literal[method_names()],  # pyright: ignore[reportInvalidTypeForm]
        tyro.conf.arg(name="method", help=f"How to learn: {methods}."),
    ]
    return make_dataclass(
        "Train",
        [
            ("task", Annotated[str, tyro.conf.arg(help=f"What to do: {', '.join(task_names())}.")], TrainConfig.task),
            ("method", hidden, field(default_factory=kind)),
            ("method_name", chosen, field(default=kind.name)),
        ],
        bases=(Train,),
        frozen=True,
        namespace={"__doc__": Train.__doc__, "__post_init__": lambda self: None, "passed": find_flags(words)},
    )


@dataclass(frozen=True)
class Demo:
    """Learn to push the cube from 6 minutes of data; learning curve and video."""

    task: str = TrainConfig.task
    """One of the tasks that `difflcs train --help` lists."""
    out: Path = Path("runs/demo")
    """Run directory. An existing demo is continued, not repeated."""
    seed: int = 0
    """Seed of everything random."""
    smoke: bool = False
    """Finish in seconds, on too little data to learn anything."""

    def run(self) -> None:
        """Run the command."""
        start = time.perf_counter()
        require("matplotlib", "imageio", "imageio_ffmpeg", "PIL")  # before the training, not after
        when = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
        config = TrainConfig(task=self.task, seed=self.seed, evaluate_at=when, evaluate_goals=100)
        config = config.smoke() if self.smoke else config
        resume = (self.out / "config.json").exists()
        if resume:
            print(f"{self.out} exists: continuing it (delete it for a fresh start)")
        with Progress() as progress:
            run = train(config, self.out, resume=resume, reporter=progress)
        rows = run.rows()
        plot_learning_curve(rows, run.path / "learning_curve.png", f"{config.task}, seed {config.seed}: learning")
        goals = get_task(config.task).example_goals
        video = self._video(run, goals[:1] if self.smoke else goals)
        evaluated = [row for row in rows if row["evaluation_goals"]]
        before, after = (success_text(evaluated[i], "evaluation_") for i in (0, -1))
        print(f"\nsuccess before learning: {before}")
        print(f"success after {float(evaluated[-1]['minutes']):g} minutes of data: {after}")
        print(f"learning curve: {run.path / 'learning_curve.png'}\nvideo: {video}\nmodel: {run.model}")
        seconds = time.perf_counter() - start
        print(f"goal seed {config.evaluation_seed}, training seed {config.seed}, {seconds:.0f} s, {known_versions()}")

    def _video(self, run: RunDirectory, goals: Sequence[Sequence[float]]) -> str:
        learned = TrainedPolicy.open(run.path)
        try:
            reached = film(learned, get_task(learned.task), goals, run.path / "video.mp4", seed=0)
        except NoPictureError as error:
            return f"none, {error}"  # the rest of the demo needs no OpenGL
        return f"{run.path / 'video.mp4'} ({sum(reached)} of {len(goals)} goals reached in it)"

    def interrupted(self) -> str:
        """Return the advice after Ctrl-C."""
        return "run the same command again to continue"
