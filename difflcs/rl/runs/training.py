"""A training run on disk, for any method on any task: create or resume it, iterate, evaluate, log, save."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from gymnasium.vector import VectorEnv

from difflcs._checks import check_kind
from difflcs._optional import require, versions
from difflcs._storage import check_path, short, write_json
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.rl.learning.trainer import Trainer, save_learned
from difflcs.rl.methods import LCSMethod, LCSRLMethod, Method, Work, get_method
from difflcs.rl.methods.base import check_fits
from difflcs.rl.rollout import Policy
from difflcs.rl.runs.checkpoint import RunDirectory, load_checkpoint, replace_run, save_checkpoint, wrap_os_errors
from difflcs.rl.runs.evaluate import Evaluation, evaluate
from difflcs.rl.settings import Settings, bounded, from_json
from difflcs.rl.tasks import TaskSpec, get_task

EnvFactory = Callable[[int], VectorEnv]
"""Number of environments → a vector of them, stepped in lockstep."""
EVALUATION_ENVS = 50
"""Environments of an evaluation: enough to keep the solver's workers busy, few enough to build in a second."""
_DIRECTORY = "runs/{task}-{method}-{seed}"
_LOG = logging.getLogger(__name__)
ITERATIONS = _LOG.getChild("iterations")
"""Logger of the lines about single iterations, which can be silenced without the others."""


@dataclass(frozen=True)
class TrainConfig(Settings):
    """Configuration of a training: task, method, amount of data, and evaluations."""

    task: str = "cube"
    """Name of a task."""
    minutes: float = bounded(6.0, above=0, maximum=1e6)
    """Data to collect [min of simulated time]; one minute on the cube is 600 steps of 0.1 s."""
    seed: int = bounded(0, minimum=0)
    """Seed of everything random in the training."""
    evaluate_at: tuple[float, ...] = bounded((1.0, 2.0, 4.0), minimum=0)
    """Minutes of data after which to evaluate, besides the end; 0 is the untrained model."""
    evaluate_goals: int = bounded(60, minimum=1, maximum=10**6)
    """Goals of these evaluations."""
    final_goals: int = bounded(300, minimum=0, maximum=10**6)
    """Goals of the evaluations at minute 0 and at the end; 0 leaves them out."""
    evaluation_seed: int = bounded(0, minimum=0)
    """Seed of the evaluation goals, the same for every evaluation of the run."""
    method: Method = field(default_factory=LCSRLMethod)
    """The method of learning with its settings; a name stands for the method with its default settings."""

    def __post_init__(self) -> None:
        if isinstance(self.method, str):
            object.__setattr__(self, "method", get_method(self.method)())
        super().__post_init__()

    def to_json(self) -> dict[str, Any]:
        """The configuration in JSON types: the method by its name, its settings beside it."""
        plain = {f.name: getattr(self, f.name) for f in fields(TrainConfig)}
        return {**plain, "method": self.method.name, "settings": asdict(self.method)}

    @classmethod
    def from_json(cls, values: Mapping[str, object]) -> TrainConfig:
        """Rebuild a configuration from JSON.

        Raises:
            CheckpointError: it was written by another version or by something else.
        """
        wanted = {*(f.name for f in fields(TrainConfig)), "settings"}
        name, settings = values.get("method"), values.get("settings")
        if set(values) != wanted or not isinstance(name, str) or not isinstance(settings, dict):
            raise CheckpointError(
                f"config: expected the fields {sorted(wanted)} of a training, got {short(sorted(values))}; use the "
                f"version of difflcs that wrote it"
            )
        try:
            method = from_json(settings, get_method(name))
        except InvalidInputError as error:
            raise CheckpointError(f"config: {error}; is it registered here?") from error
        plain = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k != "settings"}
        try:
            return cls(**{**plain, "method": method})  # pyright: ignore[reportArgumentType]
        except InvalidInputError as error:
            raise CheckpointError(f"config: its values cannot be used: {error}") from error

    def smoke(self) -> TrainConfig:
        """Return a copy that runs in seconds: too little data to learn anything."""
        return replace(
            self,
            minutes=min(self.minutes, 0.5),
            evaluate_at=tuple(v for v in self.evaluate_at if v < 0.5),
            evaluate_goals=min(self.evaluate_goals, 4),
            final_goals=min(self.final_goals, 4),
            method=self.method.smoke(),
        )

    def directory(self, pattern: str | Path = _DIRECTORY) -> Path:
        """A run directory, with {task}, {method} and {seed} filled in."""
        known = {"task": self.task, "method": self.method.name, "seed": self.seed}
        text = str(pattern)
        for name, value in known.items():
            text = text.replace(f"{{{name}}}", str(value))
        return Path(text)


class Reporter:
    """Base of the listeners to a training; override the methods that you need."""

    def started(self, done: int, total: int) -> None:
        """The training starts with `done` of `total` environment steps collected."""

    def stepped(self, env_steps: int) -> None:
        """Environment steps were collected for training."""

    def iterated(self, report: Any) -> None:
        """An iteration ended with the report of the trainer."""

    def evaluating(self, minutes: float, goals: int) -> None:
        """An evaluation starts."""

    def evaluated(self, minutes: float, result: Evaluation) -> None:
        """An evaluation ended."""


def train(
    config: TrainConfig | None = None,
    out: Path | str | None = None,
    *,
    task: TaskSpec | str | None = None,
    make_envs: EnvFactory | None = None,
    init: Path | str | None = None,
    resume: bool = False,
    force: bool = False,
    reporter: Reporter | None = None,
) -> RunDirectory:
    """Train a model and leave a run directory behind.

    It can be interrupted at any time: resumed, it ends with the same parameters as without the interruption. The run
    directory is locked meanwhile. The logger "difflcs" reports iterations and evaluations at level INFO.

    Args:
        config: the configuration; LCS-RL on `task` by default. When resuming, it must equal that of the run.
        out: the run directory, new or empty unless resuming; runs/<task>-<method>-<seed> if None.
        task: the task or its name; beside a configuration it is needed only if its task is not registered.
        make_envs: makes the environments, within the bounds of the task; those of the task if None.
        init: run or model directory, or model of the zoo ("zoo:NAME"), to start from instead of a random model. A
            resumed run keeps its own.
        resume: continue the run in `out`.
        force: replace the run in `out`. It is deleted once the new one has begun, and stays if that fails.
        reporter: for progress bars.

    Returns:
        The finished run.

    Raises:
        InvalidInputError: no task has this name, its environment cannot be made or does not report the task's errors,
            the warm-up uses up the data, `init` does not fit the task, an evaluation would come after the end, or both
            `force` and `resume` are set.
        CheckpointError: `out` is not empty and neither `resume` nor `force` is set, or it is no run, or cannot be
            resumed or written; its last checkpoint is intact.
        InUseError: another process trains in `out`.
        MissingDependencyError: TensorBoard is not installed.
    """
    check_kind("config", config, (TrainConfig, type(None)), "make one, or name the task, train(task=...)")
    spec = get_task(task or (TrainConfig() if config is None else config).task)
    config = TrainConfig(task=spec.name) if config is None else config
    if spec.name != config.task:
        raise InvalidInputError(f"task: expected {config.task!r} as in config, got {spec.name!r}; make them the same")
    out, init = config.directory() if out is None else Path(out), None if init is None else Path(init)
    check_path("out", out)
    narrow = make_envs and (lambda count: spec.narrow(make_envs(count)))  # the task's own are narrow
    run = _Training(config, spec, out, narrow or spec.make_envs, reporter or Reporter())
    if not force:
        with ExitStack() as held:
            return run(init, resume, lambda: None, held)
    if resume:
        raise InvalidInputError("force: expected without resume, got both; one replaces a run, the other continues it")
    if init is not None and init.resolve().is_relative_to(out.resolve()):
        raise InvalidInputError(f"init: expected a model outside the run that is replaced, {out}, got {init}; copy it")
    with replace_run(out) as begun, ExitStack() as held:
        return run(init, resume, begun, held)


def stored_config(run: RunDirectory) -> TrainConfig:
    """The configuration a run was started with.

    Raises:
        CheckpointError: it was written by another version or by something else.
    """
    values = run.config().get("config")
    if not isinstance(values, dict):
        raise CheckpointError(f"{run.path}: expected a configuration in config.json, got {type(values).__name__}")
    return TrainConfig.from_json(values)


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings: dotted name → value."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def load_model(path: Path | str) -> LCSModel:
    """The model of a run directory (finished or not), of `LCSModel.save_pretrained`, or of the zoo ("zoo:NAME").

    Raises:
        CheckpointError: there is none, or the method learned something else.
    """
    path = Path(path)
    if not (os.path.isdir(path / "checkpoints") or os.path.isdir(path / "model")):  # False for what can be no path
        return LCSModel.from_pretrained(path)
    run = RunDirectory.open(path)
    method = stored_config(run).method
    if not method.takes_init:
        raise CheckpointError(
            f"{path}: expected a run that learned an LCSModel, got one of {method.name}: {method.kind}; to "
            f"go on with {method.name}, train it anew for more minutes"
        )
    return LCSModel.from_config(*run.learned(LCSMethod.kind), str(path))


def load_policy(run: RunDirectory | Path | str, task: TaskSpec | None = None) -> Policy:
    """Load the policy of a run: the final one if the run is finished, else that of its latest checkpoint.

    Args:
        run: the run, or its directory.
        task: its task, if it is not to be looked up by its name.

    Raises:
        CheckpointError: there is none, or it does not fit the run's configuration.
    """
    run = run if isinstance(run, RunDirectory) else RunDirectory.open(run)
    config = stored_config(run)
    spec = get_task(config.task if task is None else task)
    learned = config.method.rebuild(spec, *run.learned(config.method.kind), str(run.path))
    return config.method.policy(spec, learned)


class _Training:
    """One call of `train`."""

    def __init__(self, config: TrainConfig, task: TaskSpec, out: Path, make_envs: EnvFactory, reporter: Reporter):
        self.config, self.task, self.out, self.make_envs, self.reporter = config, task, out, make_envs, reporter
        self.opened: list[VectorEnv] = []
        self.total_episodes = count_episodes(config.minutes, task)
        self.total = self.total_episodes * task.episode_steps

    def __call__(self, init: Path | None, resume: bool, begun: Callable[[], object], held: ExitStack) -> RunDirectory:
        """Create or resume the run, and work until it is finished. `begun` is called when nothing can be refused."""
        require("tensorboard")
        method = self.config.method
        method.check(self.config.minutes)
        if init is not None and not method.takes_init:
            raise InvalidInputError(
                f"init: expected none with method {method.name}, which does not start from an LCSModel; leave it out"
            )
        reopened = None
        if resume:  # also a run that was stored before the other check existed
            reopened, init = self._reopen(held)
            if reopened.finished():
                return reopened
        else:
            _check_times(self.config)
        model = None if init is None else load_model(init)
        if model is not None:
            check_fits(model, self.task, init)
        run = self._create(init, held) if reopened is None else reopened
        started = resume and (run.checkpoints / "latest.json").exists()
        state = load_checkpoint(run.checkpoints) if started else None

        def open_envs(count: int) -> VectorEnv:
            self.opened.append(self.make_envs(count))
            _record_object(run, self.task.describe(self.opened[-1]))
            return self.opened[-1]

        refused = reopened is None
        try:
            trainer = method.trainer(Work(self.task, self.config.seed, self.total_episodes, open_envs, model))
            if state is not None:
                trainer.load(state)
            begun()
            refused = False
            self._loop(run, trainer, open_envs, fresh=state is None)
        finally:
            if refused:
                (run.path / "config.json").unlink(missing_ok=True)
            for envs in self.opened:
                envs.close()
        return run

    def _create(self, init: Path | None, held: ExitStack) -> RunDirectory:
        out = self.out
        with wrap_os_errors(out):
            RunDirectory.check_free(out)  # before anything is written there
            out.mkdir(parents=True, exist_ok=True)
            held.enter_context(RunDirectory(out).locked())
            content = {
                "kind": "run",
                "config": self.config.to_json(),
                "init": None if init is None else str(init.resolve() if init.exists() else init),
                "versions": versions(),
            }
            return RunDirectory.create(out, content)

    def _reopen(self, held: ExitStack) -> tuple[RunDirectory, Path | None]:
        run = RunDirectory.open(self.out)
        if not run.finished():
            with wrap_os_errors(self.out):
                held.enter_context(run.locked())
        before, now = (flatten(config.to_json()) for config in (stored_config(run), self.config))
        if changed := [name for name in {**before, **now} if before.get(name) != now.get(name)]:
            name = changed[0]
            raise CheckpointError(
                f"{self.out}: expected {name} = {before.get(name)!r}, as it was started with, got {now.get(name)!r}; "
                f"drop the change"
            )
        source = run.config().get("init")
        if not isinstance(source, str | None):
            raise CheckpointError(f"{self.out}: expected a path as init in config.json, got {short(source)}")
        return run, None if source is None else Path(source)

    def _loop(self, run: RunDirectory, trainer: Trainer, open_envs: EnvFactory, fresh: bool) -> None:
        from torch.utils.tensorboard import SummaryWriter

        config, per_minute, reporter = self.config, self.task.steps_per_minute, self.reporter
        columns = list(dict.fromkeys(f.name for kind in config.method.reports for f in fields(kind)))
        with wrap_os_errors(run.path):
            run.truncate_log(-1 if fresh else trainer.iteration)
        begun = "training" if fresh else f"continuing after {trainer.env_steps / per_minute:.1f} min of data"
        _LOG.info(
            "%s: %s on %s, %g min of data, in %s", begun, config.method.name, config.task, config.minutes, run.path
        )
        reporter.started(trainer.env_steps, self.total)
        evaluation_envs: list[VectorEnv] = []  # made when first needed: one second

        def measure(goals: int) -> Evaluation:
            if not evaluation_envs:
                evaluation_envs.append(open_envs(min(EVALUATION_ENVS, max(config.evaluate_goals, config.final_goals))))
            ITERATIONS.info("evaluating %d goals", goals)
            reporter.evaluating(trainer.env_steps / per_minute, goals)
            seed, steps, errors = config.evaluation_seed, self.task.episode_steps, self.task.errors
            return evaluate(evaluation_envs[0], trainer.policy, goals, seed, steps, errors=errors)

        def finish(report: Any, previous: int) -> None:
            # The row first, then the checkpoint: resuming drops rows after the checkpoint, so none is lost or doubled.
            goals = count_goals_due(config, previous, trainer.env_steps, self.task)
            start = time.perf_counter()
            result = measure(goals) if goals else None
            row = _row(columns, trainer.env_steps, per_minute, report, result, time.perf_counter() - start)
            with wrap_os_errors(run.path):
                run.append(row)
                for name, value in row.items():
                    if isinstance(value, int | float) and name not in ("iteration", "env_steps"):
                        writer.add_scalar(name, value, trainer.env_steps)
                save_checkpoint(run.checkpoints, trainer.iteration, trainer.state_dict())
            minutes = trainer.env_steps / per_minute
            if report is not None:
                told = "".join(f", {name} {value}" for name, value in summarise_report(report).items())
                ITERATIONS.info(
                    "iteration %d, %.1f of %g min of data%s", trainer.iteration, minutes, config.minutes, told
                )
                reporter.iterated(report)
            if result is not None:
                _LOG.info("after %.1f min of data: %s", minutes, result.summary())
                reporter.evaluated(minutes, result)

        with wrap_os_errors(run.path):
            writer = SummaryWriter(str(run.tensorboard), purge_step=0 if fresh else trainer.env_steps + 1)
        try:
            if fresh:
                finish(None, previous=-1)
            while trainer.env_steps < self.total:
                previous = trainer.env_steps
                finish(trainer.step(reporter.stepped), previous)
            with wrap_os_errors(run.path):
                save_learned(trainer.learned, run.model, self.config.method.kind)
        finally:
            with wrap_os_errors(run.path):
                writer.close()


def _check_times(config: TrainConfig) -> None:
    """Raise if evaluations come after the end, except the default ones, which a short training skips."""
    late = [f"{minute:g}" for minute in config.evaluate_at if minute > config.minutes]
    if late and config.evaluate_at != TrainConfig.evaluate_at:
        raise InvalidInputError(
            f"evaluate_at: expected minutes of data up to the {config.minutes:g} of the training, got "
            f"{', '.join(late)}; leave them out, or raise minutes"
        )


def _record_object(run: RunDirectory, current: Mapping[str, Any]) -> None:
    """Record the description of a run's environment. A resumed run must have the same."""
    config = run.config()
    stored = config.get("object")
    if stored is None and current:
        with wrap_os_errors(run.path):
            write_json(run.path / "config.json", {**config, "object": dict(current)})
    elif stored is not None and stored != dict(current):
        raise CheckpointError(
            f"{run.path}: expected the environment it was started with, {stored}, got {dict(current)}; restore it"
        )


def count_episodes(minutes: float, task: TaskSpec) -> int:
    """Count the whole episodes in so many minutes of data, at least one."""
    return max(1, round(minutes * task.steps_per_minute / task.episode_steps))


def count_goals_due(config: TrainConfig, previous: int, now: int, task: TaskSpec) -> int:
    """Return the number of goals to evaluate after the environment steps previous + 1 … now; 0 for no evaluation."""
    if now == 0:
        return config.final_goals if 0 in config.evaluate_at else 0
    if previous < count_episodes(config.minutes, task) * task.episode_steps <= now:
        return config.final_goals
    due = any(previous < minute * task.steps_per_minute <= now for minute in config.evaluate_at)
    return config.evaluate_goals if due else 0


def _row(
    names: list[str], env_steps: int, per_minute: float, report: Any, result: Evaluation | None, seconds: float
) -> dict[str, object]:
    """One row of log.csv; None where there is nothing to tell."""
    known = {"iteration": 0, "env_steps": env_steps} if report is None else asdict(report)
    row: dict[str, object] = {name: known.get(name) for name in ["iteration", "minutes", *names[1:]]}
    row["minutes"] = round(env_steps / per_minute, 6)
    for name in ("success_rate", "ci_low", "ci_high", "goals", "solver_failures"):
        row[f"evaluation_{name}"] = None if result is None else getattr(result, name)
    row["evaluation_seconds"] = None if result is None else seconds
    return row


def summarise_report(report: Any) -> dict[str, str]:
    """Pick the numbers of a trainer's report to show while it trains: name → number, in two digits."""
    names = [name for name in ("loss", "kl", "success") if isinstance(getattr(report, name, None), int | float)]
    return {name: f"{getattr(report, name):.2g}" for name in names}


def sum_seconds(rows: Sequence[Mapping[str, str]]) -> dict[str, float]:
    """Sum the seconds that a run spent on each kind of work over the rows of log.csv: name → seconds."""
    names = [name for name in rows[0] if name.endswith("_seconds")] if rows else []
    return {name.removesuffix("_seconds"): sum(float(row[name] or 0) for row in rows) for name in names}


def load_action_support(run: RunDirectory) -> tuple[torch.Tensor, torch.Tensor]:
    """The action support (n_u,), (n_u,) of the last episodes before the latest checkpoint of a warm-up.

    Raises:
        InvalidInputError: the run has none.
    """
    bounds = load_checkpoint(run.checkpoints).get("bounds")
    if not isinstance(bounds, dict):
        raise InvalidInputError(f"action-support: expected a run in its warm-up, got {run.path}; drop the flag")
    return bounds["low"], bounds["high"]
