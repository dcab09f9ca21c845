"""The commands for learned models: `difflcs evaluate | render | plot | export`."""

import json
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from difflcs import zoo
from difflcs._checks import check_positive_int
from difflcs._optional import require, versions
from difflcs._storage import check_place, place_to_write
from difflcs.errors import InvalidInputError
from difflcs.mpc import LCSMPCLayer
from difflcs.mpc.controller_file import constant_cost, constant_system
from difflcs.mpc.export import CONTROLLER, DESCRIPTION, export_controller
from difflcs.rl import TrainedPolicy
from difflcs.rl.runs.evaluate import evaluate
from difflcs.rl.runs.figures import NoPictureError, draw_policy, plot_learning_curve, record_video
from difflcs.rl.runs.progress import bar
from difflcs.rl.runs.training import EVALUATION_ENVS, load_action_support
from difflcs.rl.tasks import TaskSpec, get_task

_SMOKE_GOALS = 4


@dataclass(frozen=True)
class Evaluate:
    """Success rate, without noise, of a learned model or of known physics."""

    model: Path
    """Run directory, zoo:NAME of a model that `difflcs zoo` lists, or a task whose physics is known."""
    goals: int = 1000
    """Random goals, one episode each."""
    seed: int = 0
    """Seed of the goals and initial states."""
    json: bool = False
    """Print one JSON object instead of text."""
    action_support: bool = False
    """Keep the action bounds of the last episodes of a warm-up, instead of the task's full bounds."""
    plot: Path | None = None
    """Folder for pictures of the fit and of an episode, those of `difflcs plot`."""
    smoke: bool = False
    """Try a few goals only."""

    def run(self) -> None:
        """Run the command."""
        goals = min(self.goals, _SMOKE_GOALS) if self.smoke else self.goals
        if self.plot is not None:
            check_place("plot", self.plot)
        learned = TrainedPolicy.open(self.model)
        task = get_task(learned.task)
        bounds = (None, None)
        if self.action_support:
            if learned.run is None:
                raise InvalidInputError(
                    f"action-support: expected a run, whose episodes give the bounds, got {learned.name}; drop the flag"
                )
            bounds = load_action_support(learned.run)
        start = time.perf_counter()
        with closing(task.make_envs(max(1, min(EVALUATION_ENVS, goals)))) as envs:
            description = _describe_env(learned, task, envs)
            policy, steps = learned.policy, task.episode_steps
            with bar(goals * steps, "evaluating") as shown:
                result = evaluate(envs, policy, goals, self.seed, steps, *bounds, shown.update, errors=task.errors)
        seconds = time.perf_counter() - start
        if self.plot is not None:
            draw_policy(learned.policy, task, self.plot, min(goals, EVALUATION_ENVS), self.seed)
        if self.json:
            record = {
                **asdict(result),
                "run": learned.name,
                "task": learned.task,
                "object": description,
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
        print(result.summary())
        for error in task.errors:
            if error.name in result.median_errors:
                print(f"median {error.name.replace('_', ' ')}: {result.median_errors[error.name]:.3g} {error.unit}")
        if learned.card is not None:
            print(f"its card: {learned.card.success_text}, goal seed {learned.card.evaluation_seed}")
        if description:
            print(f"object: {zoo.describe(description)}")
        solver = "" if learned.backend is None else f", backend {learned.backend}"
        print(f"goal seed {result.seed}, {learned.task}{solver}, {seconds:.1f} s, {known_versions()}")


@dataclass(frozen=True)
class Render:
    """Video of a learned model, or of known physics, at work, one episode per goal."""

    model: Path
    """Run directory, zoo:NAME of a model that `difflcs zoo` lists, or a task whose physics is known."""
    goal: tuple[float, ...] | None = None
    """Goals, one after another, each with the numbers that the task wants; by default an example of the task."""
    out: Path = Path("video.mp4")
    """Video to write, an MP4 or a GIF."""
    force: bool = False
    """Replace the video if there is one."""
    seed: int = 0
    """Seed of the initial states."""
    smoke: bool = False
    """Play the first goal only."""

    def run(self) -> None:
        """Run the command."""
        if self.out.suffix.lower() not in (".mp4", ".gif") or self.out.is_dir():
            raise InvalidInputError(f"out: expected the name of an MP4 or GIF, got {self.out}; pass --out video.mp4")
        if self.out.exists() and not self.force:
            raise InvalidInputError(
                f"out: expected a new file, got {self.out}, which exists; pass --force to replace it, or another --out"
            )
        check_place("out", self.out.parent)
        learned = TrainedPolicy.open(self.model)
        task = get_task(learned.task)
        goals = self._goals(task)
        goals = goals[:1] if self.smoke else goals
        reached = film(learned, task, goals, self.out, self.seed)
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
class Plot:
    """Pictures of a learned model: its learning curve, its fit, the contacts in an episode."""

    model: Path
    """Run directory, or zoo:NAME for one of the models that `difflcs zoo` lists."""
    out: Path | None = None
    """Folder for the pictures; by default the run, or the working directory for a model of the zoo."""
    episodes: int = 20
    """Episodes that the fit is judged by."""
    seed: int = 0
    """Seed of their goals and initial states; the first of them is drawn."""
    smoke: bool = False
    """Play two episodes only."""

    def run(self) -> None:
        """Run the command."""
        check_positive_int("episodes", self.episodes)
        learned = TrainedPolicy.open(self.model)
        out = self.out or (Path() if learned.run is None else learned.run.path)
        check_place("out", out)
        written = []
        if learned.run is not None and (rows := learned.run.rows()):
            written.append(out / "learning_curve.png")
            plot_learning_curve(rows, written[0], f"{learned.task}, {learned.method}")
        written += draw_policy(
            learned.policy, get_task(learned.task), out, 2 if self.smoke else self.episodes, self.seed
        )
        print("\n".join(f"written: {path}" for path in written))


@dataclass(frozen=True)
class Export:
    """Write the controller of a learned model for the C library."""

    model: Path
    """Run directory, or zoo:NAME for one of the models that `difflcs zoo` lists."""
    out: Path = Path("export")
    """Directory to write controller.difflcs and controller.json into."""
    force: bool = False
    """Replace a controller that is there."""

    def run(self) -> None:
        """Run the command."""
        if (self.out / CONTROLLER).exists() and not self.force:
            raise InvalidInputError(
                f"out: expected no controller in {self.out}, got one; pass --force to replace it, or another --out"
            )
        learned = TrainedPolicy.open(self.model)
        task = get_task(learned.task)
        mpc = learned.policy
        if not isinstance(mpc, LCSMPCLayer) or None in (constant_system(mpc.lcs), constant_cost(mpc.cost, task.n_x)):
            raise InvalidInputError(
                f"model: expected one that acts by the MPC with the same system and cost at all states, got "
                f"{learned.name} of method {learned.method}; export a run of another method, or act from Python by "
                f"difflcs.rl.TrainedPolicy"
            )
        quantities = {"goal": task.goal, "errors": task.errors}
        about = {
            "model": learned.name,
            "task": task.name,
            "method": learned.method,
            "finished": learned.finished,
            "object": None if learned.object is None else dict(learned.object),
            **{name: [{"name": q.name, "unit": q.unit} for q in known] for name, known in quantities.items()},
        }
        path = export_controller(mpc, self.out, step_seconds=task.step_seconds, about=about)
        if not learned.finished:
            print(f"{learned.name} is not finished: exported its latest checkpoint")
        print(f"written: {path}\nits numbers: {self.out / DESCRIPTION}")


def _describe_env(learned: TrainedPolicy, task: TaskSpec, env: Any) -> dict[str, Any]:
    """Return the description of an environment; print a warning if it differs from that of the training."""
    description = dict(task.describe(env))
    if learned.object is not None and not learned.fits(description):
        print(
            f"difflcs: {learned.name} was trained on {zoo.describe(learned.object)}, here it is "
            f"{zoo.describe(description)}: do not compare their success",
            file=sys.stderr,
        )
    return description


def film(learned: TrainedPolicy, task: TaskSpec, goals: Sequence[Sequence[float]], path: Path, seed: int) -> list[bool]:
    """Play one episode per goal into a video; for each goal, True if it was reached.

    Raises:
        InvalidInputError: a goal is outside the goal space, or the video cannot be written there.
        NoPictureError: the environment cannot be drawn here.
        MissingDependencyError: a package of the extra viz is not installed.
    """
    require("imageio", "imageio_ffmpeg", "PIL")
    try:
        env = task.make_env(render_mode="rgb_array", **task.picture)
    except InvalidInputError as error:
        raise NoPictureError(str(error)) from error
    with closing(env):
        _describe_env(learned, task, env)
        with place_to_write(path):
            return record_video(env, learned.policy, goals, path, task, seed)


def known_versions() -> str:
    """List the packages that decide a result, with their versions, in one line."""
    return ", ".join(f"{name} {version}" for name, version in versions().items() if version is not None)
