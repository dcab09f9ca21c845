"""The command line: `difflcs train | evaluate | render | export | demo | zoo | assets | bench | doctor`.

Tasks and methods are known by their registries only; the flags of `train` are made of the settings of its method.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, make_dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import torch

from difflcs import zoo
from difflcs._renamed import refuse_flags_of_before
from difflcs.errors import CheckpointError, DiffLCSError, InvalidInputError
from difflcs.export import Export
from difflcs.planning.films import FILMS
from difflcs.rl._optional import require, versions
from difflcs.rl.checkpoint import RunDirectory
from difflcs.rl.evaluate import evaluate
from difflcs.rl.figures import NoPictureError, plot_learning_curve, record_video
from difflcs.rl.methods import get_method, method_names
from difflcs.rl.progress import Progress, bar, summary
from difflcs.rl.tasks import TaskSpec, get_task
from difflcs.rl.training import EVALUATION_ENVS, TrainConfig, profile, saved_bounds, stored_config, train
from difflcs.zoo import Learned

_SMOKE_GOALS = 4


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
        spent = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in profile(run.rows()).items() if seconds)
        print(f"time: {spent}")
        print(f"finished: {run.path}\nevaluate it with: difflcs evaluate {run.path}")

    def _resumed(self, config: TrainConfig) -> TrainConfig:
        stored = stored_config(RunDirectory.open(self.directory(self.out)))
        default = TrainConfig(method=type(config.method)())
        wanted, own, usual, small = (_flat(c.to_json()) for c in (config, stored, default, default.smoke()))
        for name, value in wanted.items():
            if value not in (own.get(name), usual[name], small[name]):
                flag, run = name.removeprefix("settings.").replace("_", "-"), self.directory(self.out)
                raise CheckpointError(
                    f"--{flag}: expected {own.get(name)!r}, as {run} was started with, got {value!r}; "
                    f"drop the flag, or start another run with another --out"
                )
        if self.init is not None:
            raise CheckpointError(
                "--init: expected it without --resume; a resumed run continues from its own checkpoint"
            )
        return stored

    def interrupted(self) -> str:
        """What to do after Ctrl-C."""
        return f"continue with: difflcs train --out {self.directory(self.out)} --resume"


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def _train_command(words: Sequence[str]) -> type[Train]:
    """`Train` with the flags of the method that the words name, or that the run to resume was started with."""
    import tyro

    name = _value(words, "--method")
    out = _value(words, "--out")
    if name is None and "--resume" in words and out is not None and (Path(out) / "config.json").is_file():
        name = stored_config(RunDirectory.open(Path(out))).method.name
    kind = get_method(name or method_names()[0])
    hidden = Annotated[kind, tyro.conf.arg(name="", prefix_name=False)]
    chosen: Any = Annotated[
        Literal[method_names()],  # pyright: ignore[reportInvalidTypeForm]
        tyro.conf.arg(name="method", help=_methods()),
    ]
    return make_dataclass(
        "Train",
        [("method", hidden, field(default_factory=kind)), ("method_name", chosen, field(default=kind.name))],
        bases=(Train,),
        frozen=True,
        namespace={"__doc__": Train.__doc__, "__post_init__": lambda self: None},
    )


def _methods() -> str:
    return "How to learn: " + "; ".join(f"{name}: {get_method(name).summary}" for name in method_names()) + "."


def _value(words: Sequence[str], flag: str) -> str | None:
    """What follows a flag, as `--flag value` or `--flag=value`."""
    for word, following in zip_longest(words, words[1:]):
        if word == flag:
            return following
        if word.startswith(f"{flag}="):
            return word.partition("=")[2]
    return None


@dataclass(frozen=True)
class Evaluate:
    """Success rate of a learned model, without noise, with its 95 % interval."""

    model: Path
    """Run directory, or zoo:NAME for one of the models that `difflcs zoo` lists."""
    goals: int = 1000
    """Random goals, one episode each."""
    seed: int = 0
    """Seed of the goals and initial states."""
    json: bool = False
    """Print one JSON object instead of text."""
    action_support: bool = False
    """Keep the action bounds of the last episodes of a warm-up, instead of the task's full bounds."""
    smoke: bool = False
    """Try a few goals only."""

    def run(self) -> None:
        """Run the command."""
        goals = min(self.goals, _SMOKE_GOALS) if self.smoke else self.goals
        learned = Learned.open(self.model)
        task = get_task(learned.task)
        bounds = (None, None)
        if self.action_support:
            if learned.run is None:
                raise InvalidInputError(
                    f"action-support: expected a run, whose episodes give the bounds, got {learned.name}; drop the flag"
                )
            bounds = saved_bounds(learned.run)
        start = time.perf_counter()
        envs = task.make_envs(max(1, min(EVALUATION_ENVS, goals)))
        found = _compare(learned, task, envs)
        try:
            with bar(goals * task.episode_steps, "evaluating") as shown:
                result = evaluate(
                    envs, learned.policy, goals, self.seed, task.episode_steps, *bounds, after_step=shown.update
                )
        finally:
            envs.close()
        seconds = time.perf_counter() - start
        if self.json:
            record = {
                **asdict(result),
                "run": learned.name,
                "task": learned.task,
                "object": found,
                "trained_on": learned.object,
                "method": learned.method,
                "finished": learned.finished,
                "backend": learned.backend,
                "action_support": self.action_support,
                "card": None if learned.card is None else asdict(learned.card),
                "seconds": round(seconds, 3),
                "versions": versions(),
            }
            print(json.dumps(record, sort_keys=True))
            return
        if not learned.finished:
            print(f"{learned.name} is not finished: evaluated its latest checkpoint")
        print(summary(result))
        for error in task.errors:
            if error.name in result.median_errors:
                print(f"median {error.name.replace('_', ' ')}: {result.median_errors[error.name]:.3g} {error.unit}")
        if learned.card is not None:
            print(f"its card: {learned.card.success_text}, goal seed {learned.card.evaluation_seed}")
        if found:
            print(f"object: {zoo.described(found)}")
        solver = "" if learned.backend is None else f", backend {learned.backend}"
        print(f"goal seed {result.seed}, {learned.task}{solver}, {seconds:.1f} s, {_versions()}")


@dataclass(frozen=True)
class Render:
    """Video of a learned model at work, one episode per goal; or of Push-T."""

    model: Path
    """Run directory, or zoo:NAME for one of the models that `difflcs zoo` lists; or pusht, which has no goals."""
    goal: tuple[float, ...] | None = None
    """Goals, one after another, each with the numbers that the task wants; by default an example of the task."""
    out: Path = Path("video.mp4")
    """Video to write, an MP4; with pusht also a GIF."""
    force: bool = False
    """Replace the video if there is one."""
    seed: int = 0
    """Seed of the initial states."""
    smoke: bool = False
    """Play the first goal only."""

    def run(self) -> None:
        """Run the command."""
        if str(self.model) in FILMS:
            return FILMS[str(self.model)](self.out, self.seed, 1 if self.smoke else 4, self.force)
        if self.out.suffix.lower() != ".mp4" or self.out.is_dir():
            raise InvalidInputError(f"out: expected the name of an MP4 file, got {self.out}; pass --out video.mp4")
        if self.out.exists() and not self.force:
            raise InvalidInputError(
                f"out: expected a new file, got {self.out}, which exists; pass --force to replace it, or another --out"
            )
        learned = Learned.open(self.model)
        task = get_task(learned.task)
        goals = self._goals(task)
        goals = goals[:1] if self.smoke else goals
        reached = _record(learned, task, goals, self.out, self.seed)
        for goal, ok in zip(goals, reached, strict=True):
            print(f"goal {' '.join(f'{v:g}' for v in goal)}: {'reached' if ok else 'missed'}")
        print(f"written: {self.out}")

    def _goals(self, task: TaskSpec) -> list[tuple[float, ...]]:
        size = task.n_goal
        if self.goal and len(self.goal) % size == 0:
            return [self.goal[i : i + size] for i in range(0, len(self.goal), size)]
        if self.goal is None and task.example_goals:
            return [task.example_goals[0]]
        names = ", ".join(f"{q.name} [{q.unit}]" for q in task.goal) or f"{size} numbers"
        raise InvalidInputError(f"goal: expected {names} for each goal of {task.name}, got {self.goal}; pass --goal")


@dataclass(frozen=True)
class Demo:
    """Learn to push the cube from 6 minutes of data; learning curve and video."""

    task: str = TrainConfig.task
    """What to do: the name of a task."""
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
        method = get_method("violation")()
        config = TrainConfig(task=self.task, method=method, seed=self.seed, evaluate_at=when, evaluate_goals=100)
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
        print(f"\nsuccess before learning: {_from_row(evaluated[0])}")
        print(f"success after {float(evaluated[-1]['minutes']):g} minutes of data: {_from_row(evaluated[-1])}")
        print(f"learning curve: {run.path / 'learning_curve.png'}\nvideo: {video}\nmodel: {run.model}")
        seconds = time.perf_counter() - start
        print(f"goal seed {config.evaluation_seed}, training seed {config.seed}, {seconds:.0f} s, {_versions()}")

    def _video(self, run: RunDirectory, goals: Sequence[Sequence[float]]) -> str:
        learned = Learned.open(run.path)
        try:
            reached = _record(learned, get_task(learned.task), goals, run.path / "video.mp4", seed=0)
        except NoPictureError as error:
            return f"none, {error}"  # the rest of the demo needs no OpenGL
        return f"{run.path / 'video.mp4'} ({sum(reached)} of {len(goals)} goals reached in it)"

    def interrupted(self) -> str:
        """What to do after Ctrl-C."""
        return "run the same command again to continue"


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
    """What to do."""
    objects: tuple[str, ...]
    """sugar_box, fish_can, banana, mug, wrench, clamp, large_clamp, extra_large_clamp; by default all."""
    folder: Path | None = None
    """Where to put them. By default where the environments look for them."""

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
        """What to do after Ctrl-C."""
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
        from difflcs import bench

        threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        sizes = (16, 2, 1) if self.smoke else (self.batch, self.ipopt_batch, self.repeats)
        timings = bench.measure(bench.pushing_cost(), 5, *sizes, threads=threads)
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
        from difflcs import doctor

        return doctor.main(self.json)


_COMMANDS: dict[str, Callable[..., Any]] = {
    "train": Train,
    "evaluate": Evaluate,
    "render": Render,
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after `difflcs`; those of the process if None.

    Returns:
        Exit code: 0, 1 if `doctor` finds the library broken, 2 after an error of ours, 130 after Ctrl-C.
    """
    command: Any = None
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if words[:1] == ["doctor"] and importlib.util.find_spec("tyro") is None:  # it is there to say such things
            return int(Doctor("--json" in words).run())
        require("tyro")
        import tyro

        # `train` has settings for which None means something.
        plain = {k: v if k == "train" else Annotated[v, tyro.conf.DisallowNone] for k, v in _COMMANDS.items()}
        if words[:1] in (["train"], ["evaluate"]):
            refuse_flags_of_before(words[1:])
        if words[:1] == ["train"]:
            plain["train"] = _train_command(words[1:])
        command = tyro.extras.subcommand_cli_from_dict(
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
        torch.set_num_threads(1)  # tensors of 100 × 9 do not gain from threads, and the MPC's workers need the cores
        return int(command.run() or 0)
    except DiffLCSError as error:
        print(f"difflcs: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        advice = command.interrupted() if hasattr(command, "interrupted") else "nothing was changed"
        print(f"\ndifflcs: interrupted; {advice}", file=sys.stderr)
        return 130


def _compare(learned: Learned, task: TaskSpec, env: Any) -> dict[str, Any]:
    """What an environment holds; says so if it is not what the model was trained on."""
    found = dict(task.describe(env))
    if learned.object is not None and not learned.fits(found):
        print(
            f"difflcs: {learned.name} was trained on {zoo.described(learned.object)}, here it is "
            f"{zoo.described(found)}: do not compare their success",
            file=sys.stderr,
        )
    return found


def _record(learned: Learned, task: TaskSpec, goals: Sequence[Sequence[float]], path: Path, seed: int) -> list[bool]:
    require("imageio", "imageio_ffmpeg", "PIL")
    try:
        env = task.make_env(render_mode="rgb_array", **task.picture)
    except InvalidInputError as error:
        raise NoPictureError(str(error)) from error
    try:
        _compare(learned, task, env)
        return record_video(env, learned.policy, goals, path, task, seed)
    except OSError as error:
        raise InvalidInputError(f"out: expected a place to write {path}, got: {error}; choose another") from error
    finally:
        env.close()


def _from_row(row: dict[str, str]) -> str:
    rate, low, high = (100 * float(row[f"evaluation_{name}"]) for name in ("success_rate", "ci_low", "ci_high"))
    return f"{rate:.1f} % of {row['evaluation_goals']} goals (95 % interval {low:.1f} to {high:.1f} %)"


def _versions() -> str:
    return ", ".join(f"{name} {version}" for name, version in versions().items() if version is not None)


if __name__ == "__main__":
    sys.exit(main())
