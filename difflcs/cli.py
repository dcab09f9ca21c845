"""The command line: `difflcs train | evaluate | render | demo | assets`.

The only file of the package that knows both the library and the environments.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch

from difflcs._files import write_json
from difflcs.errors import CheckpointError, DiffLCSError, InvalidInputError
from difflcs.rl._optional import require, versions
from difflcs.rl.checkpoint import RunDirectory, load_checkpoint
from difflcs.rl.evaluate import Evaluation, evaluate
from difflcs.rl.figures import plot_learning_curve, record_video
from difflcs.rl.tasks import TASKS, Task, get_task
from difflcs.rl.training import (
    EVALUATION_ENVS,
    Report,
    Reporter,
    TrainConfig,
    load_policy,
    profile,
    saved_bounds,
    stored_config,
    train,
)

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv
    from tqdm import tqdm

Goal = tuple[float, float, float]
_SMOKE_GOALS = 4
_PICTURE = {"width": 640, "height": 480}


@dataclass(frozen=True)
class Train(TrainConfig):
    """Train a model and leave a run directory: model, log, checkpoints."""

    out: Path | None = None
    """Run directory to write; runs/<task>-<method>-<seed> by default."""
    init: Path | None = None
    """Run or model directory to start from, instead of a random model."""
    resume: bool = False
    """Continue the run in --out, with its own settings and to the same result as without interruption."""
    smoke: bool = False
    """Finish in seconds, on too little data to learn anything."""

    def __post_init__(self) -> None:
        """Check nothing yet: `run` does, so that its errors are printed like all others."""

    @property
    def directory(self) -> Path:
        """The run directory."""
        return self.out or Path("runs") / f"{self.task}-{self.method}-{self.seed}"

    def run(self) -> None:
        """Run the command."""
        config = TrainConfig(**{f.name: getattr(self, f.name) for f in fields(TrainConfig)})
        config = config.smoke() if self.smoke else config
        if self.resume:
            config = self._resumed(config)
        with _Progress() as progress:
            run = train(
                config,
                self.directory,
                _env_factory(config.task, self.directory),
                init=self.init,
                resume=self.resume,
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
    """Success rate of a run's model, without noise, with its 95 % interval."""

    run_directory: Path
    """Run directory."""
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
        run = RunDirectory.open(self.run_directory)
        config, policy = stored_config(run), load_policy(run)
        task = get_task(config.task)
        checkpoint = load_checkpoint(run.checkpoints) if self.trust_region or not run.finished() else None
        bounds = saved_bounds(checkpoint) if checkpoint is not None and self.trust_region else (None, None)
        start = time.perf_counter()
        envs = _env_factory(config.task)(max(1, min(EVALUATION_ENVS, goals)))
        try:
            with _bar(goals * task.episode_steps, "evaluating") as bar:
                result = evaluate(envs, policy, goals, self.seed, task.episode_steps, *bounds, after_step=bar.update)
        finally:
            envs.close()
        seconds = time.perf_counter() - start
        if not run.finished() and not self.json:
            print(f"{run.path} is not finished: evaluated its latest checkpoint")
        if self.json:
            record = {
                **asdict(result),
                "run": str(run.path),
                "task": config.task,
                "object": _object(envs),
                "method": config.method,
                "finished": run.finished(),
                "backend": config.backend,
                "trust_region": self.trust_region,
                "seconds": round(seconds, 3),
                "versions": versions(),
            }
            print(json.dumps(record, sort_keys=True))
        else:
            print(_summary(result))
            print(f"object: {_described(_object(envs))}")
            print(f"goal seed {result.seed}, {config.task}, backend {config.backend}, {seconds:.1f} s, {_versions()}")


@dataclass(frozen=True)
class Render:
    """Video of a run's policy, one episode after another."""

    run_directory: Path
    """Run directory."""
    goal: tuple[Goal, ...] = ((0.04, 0.03, 0.3),)
    """Goals: x [m], y [m], yaw [rad] each; within ±0.06 m and ±0.5 rad."""
    out: Path = Path("video.mp4")
    """Video to write."""
    seed: int = 0
    """Seed of the initial states."""
    smoke: bool = False
    """Play the first goal only."""

    def run(self) -> None:
        """Run the command."""
        run = RunDirectory.open(self.run_directory)
        goals = self.goal[:1] if self.smoke else self.goal
        if not goals:
            raise InvalidInputError("goal: expected at least one goal of three numbers, got none")
        reached = _record(run, goals, self.out, self.seed)
        for goal, ok in zip(goals, reached, strict=True):
            print(f"goal {' '.join(f'{v:g}' for v in goal)}: {'reached' if ok else 'missed'}")
        print(f"written: {self.out}")


@dataclass(frozen=True)
class Demo:
    """Learn to push the cube from 6 minutes of data: success before and after, learning curve and video."""

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
        with _Progress() as progress:
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
            reached = _record(run, goals, run.path / "video.mp4", seed=0)
        except _NoPictureError as error:
            return f"none, {error}"  # the rest of the demo needs no OpenGL
        return f"{run.path / 'video.mp4'} ({sum(reached)} of {len(goals)} goals reached in it)"

    def interrupted(self) -> str:
        """What to do after Ctrl-C."""
        return "run the same command again to continue"


class _NoPictureError(DiffLCSError):
    """This machine cannot render."""


@dataclass(frozen=True)
class Assets:
    """Fetch the meshes of the YCB objects from the YCB site. Without them stand-ins of boxes and cylinders are used."""

    action: Literal["download"]
    """What to do."""
    objects: tuple[str, ...]
    """sugar_box, fish_can, banana, mug, wrench, clamp, large_clamp, extra_large_clamp; none for all."""
    folder: Path | None = None
    """Where to; by default where the environments look for them."""

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


_COMMANDS: dict[str, Callable[..., Any]] = {
    "train": Train,
    "evaluate": Evaluate,
    "render": Render,
    "demo": Demo,
    "assets": Assets,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after `difflcs`; those of the process if None.

    Returns:
        Exit code: 0, 2 after an error of ours, 130 after Ctrl-C.
    """
    command: Any = None
    try:
        require("tyro")
        import tyro

        command = tyro.extras.subcommand_cli_from_dict(
            _COMMANDS,
            prog="difflcs",
            description="Differentiable MPC through learned linear complementarity systems.",
            args=arguments,
            config=(tyro.conf.PositionalRequiredArgs, tyro.conf.FlagCreatePairsOff),
        )
        torch.set_num_threads(1)  # tensors of 100 × 9 do not gain from threads, and the MPC's workers need the cores
        command.run()
    except DiffLCSError as error:
        print(f"difflcs: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        advice = command.interrupted() if hasattr(command, "interrupted") else "nothing was changed"
        print(f"\ndifflcs: interrupted; {advice}", file=sys.stderr)
        return 130
    return 0


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


def _record(run: RunDirectory, goals: Sequence[Goal], path: Path, seed: int) -> list[bool]:
    config = stored_config(run)
    task = _registered(config.task)
    require("imageio", "imageio_ffmpeg", "PIL")
    import gymnasium

    from difflcs_envs import RenderingError

    policy = load_policy(run)
    env: gymnasium.Env = gymnasium.make(task.env_id, render_mode="rgb_array", **_PICTURE, **dict(task.env_kwargs))
    try:
        return record_video(env, policy, goals, path, task.episode_steps, task.step_seconds, seed)
    except RenderingError as error:
        raise _NoPictureError(str(error)) from error
    finally:
        env.close()


def _bar(total: int, label: str) -> tqdm:
    require("tqdm")
    from tqdm import tqdm

    return tqdm(total=total, desc=label, unit="step", disable=None, dynamic_ncols=True, leave=False)


class _Progress(Reporter):
    """A progress bar on a terminal, and a line per evaluation everywhere."""

    def __init__(self) -> None:
        self.bar: tqdm | None = None

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def started(self, done: int, total: int) -> None:
        self.bar = _bar(total, "training")
        self.bar.update(done)

    def stepped(self, env_steps: int) -> None:
        if self.bar is not None:
            self.bar.update(env_steps)

    def iterated(self, iteration: Report) -> None:
        if self.bar is not None:
            names = [name for name in ("loss", "kl", "success") if hasattr(iteration, name)]
            self.bar.set_postfix({name: f"{getattr(iteration, name):.2g}" for name in names})

    def evaluating(self, minutes: float, goals: int) -> None:
        if self.bar is not None:
            self.bar.set_description(f"evaluating {goals} goals")

    def evaluated(self, minutes: float, result: Evaluation) -> None:
        if self.bar is not None:
            self.bar.set_description("training")
            self.bar.clear()
        print(f"{minutes:4.1f} min of data: {_summary(result)}", flush=True)


def _summary(result: Evaluation) -> str:
    failures = f"{result.solver_failures} of {result.solves} solves failed"
    return f"success {result}, {failures}" + (f", {result.unstable} episodes unstable" if result.unstable else "")


def _from_row(row: dict[str, str]) -> str:
    rate, low, high = (100 * float(row[f"evaluation_{name}"]) for name in ("success_rate", "ci_low", "ci_high"))
    return f"{rate:.1f} % of {row['evaluation_goals']} goals (95 % interval {low:.1f} to {high:.1f} %)"


def _described(thing: dict[str, Any]) -> str:
    return f"{thing['name']} ({thing['source'].replace('_', ' ')}, {1e3 * thing['mass']:g} g)"


def _versions() -> str:
    return ", ".join(f"{name} {version}" for name, version in versions().items() if version is not None)


if __name__ == "__main__":
    sys.exit(main())
