"""The command line: `difflcs train | evaluate | render | demo | zoo | assets | bench | doctor`.

The only file of the package that knows both the library and the environments.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import torch

from difflcs import zoo
from difflcs._files import write_json
from difflcs.errors import CheckpointError, DiffLCSError, InvalidInputError
from difflcs.rl._optional import require, versions
from difflcs.rl._trifinger import TASKS, Task, get_task, pushing_cost
from difflcs.rl.checkpoint import RunDirectory, load_checkpoint
from difflcs.rl.evaluate import evaluate
from difflcs.rl.figures import plot_learning_curve, record_video
from difflcs.rl.progress import Progress, bar, summary
from difflcs.rl.training import (
    EVALUATION_ENVS,
    TrainConfig,
    profile,
    saved_bounds,
    stored_config,
    train,
)
from difflcs.zoo import Learned

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

Goal = tuple[float, float, float]
_SMOKE_GOALS = 4
_PICTURE = {"width": 640, "height": 480}


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

    @property
    def directory(self) -> Path:
        """The run directory."""
        text = str(self.out)
        for name in ("task", "method", "seed"):
            text = text.replace(f"{{{name}}}", str(getattr(self, name)))
        return Path(text)

    def run(self) -> None:
        """Run the command."""
        config = TrainConfig(**{f.name: getattr(self, f.name) for f in fields(TrainConfig)})
        config = config.smoke() if self.smoke else config
        if self.resume:
            config = self._resumed(config)
        with Progress() as progress:
            run = train(
                config,
                self.directory,
                _env_factory(config.task, self.directory),
                init=self.init,
                resume=self.resume,
                force=self.force,
                reporter=progress,
            )
        spent = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in profile(run.rows()).items() if seconds)
        print(f"time: {spent}")
        print(f"finished: {run.path}\nevaluate it with: difflcs evaluate {run.path}")

    def _resumed(self, config: TrainConfig) -> TrainConfig:
        stored = stored_config(RunDirectory.open(self.directory))
        default = TrainConfig()
        for f in fields(TrainConfig):
            wanted, own = getattr(config, f.name), getattr(stored, f.name)
            if wanted not in (own, getattr(default, f.name), getattr(default.smoke(), f.name)):
                flag = f.name.replace("_", "-")
                raise CheckpointError(
                    f"--{flag}: expected {own!r}, as {self.directory} was started with, got {wanted!r}; "
                    f"drop the flag, or start another run with another --out"
                )
        if self.init is not None:
            raise CheckpointError(
                "--init: expected it without --resume; a resumed run continues from its own checkpoint"
            )
        return stored

    def interrupted(self) -> str:
        """What to do after Ctrl-C."""
        return f"continue with: difflcs train --out {self.directory} --resume"


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
    trust_region: bool = False
    """Keep the action bounds of the last training episodes, instead of the task's full bounds."""
    smoke: bool = False
    """Try a few goals only."""

    def run(self) -> None:
        """Run the command."""
        goals = min(self.goals, _SMOKE_GOALS) if self.smoke else self.goals
        learned = Learned.open(self.model)
        task = get_task(learned.task)
        bounds = (None, None)
        if self.trust_region:
            if learned.run is None:
                raise InvalidInputError(
                    f"trust-region: expected a run, whose episodes give the bounds, got {learned.name}; drop the flag"
                )
            bounds = saved_bounds(load_checkpoint(learned.run.checkpoints))
        start = time.perf_counter()
        envs = _env_factory(learned.task)(max(1, min(EVALUATION_ENVS, goals)))
        _compare(learned, _object(envs))
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
                "object": _object(envs),
                "trained_on": learned.object,
                "method": learned.method,
                "finished": learned.finished,
                "backend": learned.backend,
                "trust_region": self.trust_region,
                "card": None if learned.card is None else asdict(learned.card),
                "seconds": round(seconds, 3),
                "versions": versions(),
            }
            print(json.dumps(record, sort_keys=True))
            return
        if not learned.finished:
            print(f"{learned.name} is not finished: evaluated its latest checkpoint")
        print(summary(result))
        if learned.card is not None:
            print(f"its card: {learned.card.success_text}, goal seed {learned.card.evaluation_seed}")
        print(f"object: {_described(_object(envs))}")
        print(f"goal seed {result.seed}, {learned.task}, backend {learned.backend}, {seconds:.1f} s, {_versions()}")


@dataclass(frozen=True)
class Render:
    """Video of a learned model at work, one episode per goal."""

    model: Path
    """Run directory, or zoo:NAME for one of the models that `difflcs zoo` lists."""
    goal: tuple[Goal, ...] = ((0.04, 0.03, 0.3),)
    """Goals: x [m], y [m], yaw [rad] each; within ±0.06 m and ±0.5 rad."""
    out: Path = Path("video.mp4")
    """Video to write, an MP4."""
    force: bool = False
    """Replace the video if there is one."""
    seed: int = 0
    """Seed of the initial states."""
    smoke: bool = False
    """Play the first goal only."""

    def run(self) -> None:
        """Run the command."""
        goals = self.goal[:1] if self.smoke else self.goal
        if not goals:
            raise InvalidInputError("goal: expected at least one goal of three numbers, got none")
        if self.out.suffix.lower() != ".mp4" or self.out.is_dir():
            raise InvalidInputError(f"out: expected the name of an MP4 file, got {self.out}; pass --out video.mp4")
        if self.out.exists() and not self.force:
            raise InvalidInputError(
                f"out: expected a new file, got {self.out}, which exists; pass --force to replace it, or another --out"
            )
        reached = _record(Learned.open(self.model), goals, self.out, self.seed)
        for goal, ok in zip(goals, reached, strict=True):
            print(f"goal {' '.join(f'{v:g}' for v in goal)}: {'reached' if ok else 'missed'}")
        print(f"written: {self.out}")


@dataclass(frozen=True)
class Demo:
    """Learn to push the cube from 6 minutes of data; learning curve and video."""

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
        config = TrainConfig(seed=self.seed, evaluate_at=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0), evaluate_goals=100)
        config = config.smoke() if self.smoke else config
        resume = (self.out / "config.json").exists()
        if resume:
            print(f"{self.out} exists: continuing it (delete it for a fresh start)")
        with Progress() as progress:
            run = train(config, self.out, _env_factory(config.task, self.out), resume=resume, reporter=progress)
        rows = run.rows()
        title = f"{config.task}, seed {config.seed}: learning to push"
        plot_learning_curve(rows, run.path / "learning_curve.png", title)
        goals: tuple[Goal, ...] = ((0.04, 0.03, 0.3), (-0.04, 0.03, -0.3), (0.0, -0.05, 0.4), (0.05, -0.02, 0.0))
        video = self._video(run, goals[:1] if self.smoke else goals)
        evaluated = [row for row in rows if row["evaluation_goals"]]
        print(f"\nsuccess before learning: {_from_row(evaluated[0])}")
        print(f"success after {float(evaluated[-1]['minutes']):g} minutes of data: {_from_row(evaluated[-1])}")
        print(f"learning curve: {run.path / 'learning_curve.png'}\nvideo: {video}\nmodel: {run.model}")
        seconds = time.perf_counter() - start
        print(f"goal seed {config.evaluation_seed}, training seed {config.seed}, {seconds:.0f} s, {_versions()}")

    def _video(self, run: RunDirectory, goals: Sequence[Goal]) -> str:
        try:
            reached = _record(Learned.open(run.path), goals, run.path / "video.mp4", seed=0)
        except _NoPictureError as error:
            return f"none, {error}"  # the rest of the demo needs no OpenGL
        return f"{run.path / 'video.mp4'} ({sum(reached)} of {len(goals)} goals reached in it)"

    def interrupted(self) -> str:
        """What to do after Ctrl-C."""
        return "run the same command again to continue"


class _NoPictureError(DiffLCSError):
    """This machine cannot render."""


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
        timings = bench.measure(pushing_cost(), 5, *sizes, threads=threads)
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
    "demo": Demo,
    "zoo": Zoo,
    "assets": Assets,
    "bench": Bench,
    "doctor": Doctor,
}


_DESCRIPTION = """Differentiable MPC through learned linear complementarity systems.

  difflcs doctor                                            what works here
  difflcs render zoo:trifinger-cube --out cube.mp4          a learned model
  difflcs train --task cube --method lcs-rl --minutes 30    learn one"""


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


def _compare(learned: Learned, found: dict[str, Any]) -> None:
    """Say so if the object of the environment is not the one that the model was trained on."""
    if learned.object is not None and not learned.fits(found):
        print(
            f"difflcs: {learned.name} was trained on {_described(learned.object)}, here it is "
            f"{_described(found)}: do not compare their success; for the meshes see: difflcs assets --help",
            file=sys.stderr,
        )


def _env_factory(name: str, run: Path | None = None) -> Callable[[int], VectorEnv]:
    """Makes the environments of a task; those of a training leave in its config.json what object they hold."""
    task = _registered(name)

    def make(count: int) -> VectorEnv:
        import gymnasium

        from difflcs_envs import DifflcsEnvsError

        try:
            envs = gymnasium.make_vec(task.env_id, num_envs=count, **dict(task.env_kwargs))
        except DifflcsEnvsError as error:
            raise InvalidInputError(f"task {name}: {error}") from error
        if run is not None:
            _note_object(run, _object(envs))
        return envs

    return make


def _object(envs: VectorEnv) -> dict[str, Any]:
    """What the fingers push: name, source (mesh or stand-in), mass, ..."""
    return envs.envs[0].object.describe()  # pyright: ignore[reportAttributeAccessIssue]


def _note_object(run: Path, found: dict[str, Any]) -> None:
    """Record what object a run is trained on. A resumed run must find the same."""
    config = RunDirectory.open(run).config()
    stored = config.get("object")
    if stored is None:
        write_json(run / "config.json", {**config, "object": found})
    elif stored != found:
        raise CheckpointError(
            f"{run}: expected the object it was started with, {stored}, got {found}; set DIFFLCS_YCB_DIR as it was then"
        )


def _registered(name: str) -> Task:
    task = get_task(name)
    require("gymnasium", "mujoco", "difflcs_envs")
    import gymnasium

    import difflcs_envs

    difflcs_envs.register_envs()
    if task.env_id not in gymnasium.registry:
        available = [k for k, v in TASKS.items() if v.env_id in gymnasium.registry]
        raise InvalidInputError(f"task: {name!r} is not available yet; expected one of {', '.join(available)}")
    return task


def _record(learned: Learned, goals: Sequence[Goal], path: Path, seed: int) -> list[bool]:
    task = _registered(learned.task)
    require("imageio", "imageio_ffmpeg", "PIL")
    import gymnasium

    from difflcs_envs import RenderingError

    env: gymnasium.Env = gymnasium.make(task.env_id, render_mode="rgb_array", **_PICTURE, **dict(task.env_kwargs))
    try:
        _compare(learned, cast(Any, env.unwrapped).object.describe())
        return record_video(env, learned.policy, goals, path, task.episode_steps, task.step_seconds, seed)
    except RenderingError as error:
        raise _NoPictureError(str(error)) from error
    except OSError as error:
        raise InvalidInputError(f"out: expected a place to write {path}, got: {error}; choose another") from error
    finally:
        env.close()


def _from_row(row: dict[str, str]) -> str:
    rate, low, high = (100 * float(row[f"evaluation_{name}"]) for name in ("success_rate", "ci_low", "ci_high"))
    return f"{rate:.1f} % of {row['evaluation_goals']} goals (95 % interval {low:.1f} to {high:.1f} %)"


def _described(thing: Mapping[str, Any]) -> str:
    return f"{thing['name']} ({thing['source'].replace('_', ' ')}, {1e3 * thing['mass']:g} g)"


def _versions() -> str:
    return ", ".join(f"{name} {version}" for name, version in versions().items() if version is not None)


if __name__ == "__main__":
    sys.exit(main())
