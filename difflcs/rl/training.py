"""A training run on disk: create or resume it, iterate, evaluate, log, save."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from difflcs._checks import check_choice, check_number, check_positive_int
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.rl._optional import require, versions
from difflcs.rl.checkpoint import Checkpoint, RunDirectory, load_checkpoint, save_checkpoint
from difflcs.rl.evaluate import Evaluation, evaluate
from difflcs.rl.tasks import N_U, N_X, Task, get_task
from difflcs.rl.warmup import Iteration, Warmup, WarmupConfig, config_from_dict

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

EnvFactory = Callable[[int], "VectorEnv"]
"""Number of environments → a vector of them, stepped in lockstep."""
EVALUATION_ENVS = 50
"""Environments of an evaluation: enough to keep the solver's workers busy, few enough to build in a second."""
METHODS = ("violation", "lcs-rl", "ppo", "pddm")
_AVAILABLE = ("violation",)


@dataclass(frozen=True)
class TrainConfig:
    """What is trained, on how much data, and when it is evaluated."""

    task: str = "cube"
    """What to manipulate: cube, sugar_box, fish_can, mug, wrench, clamp or banana."""
    method: str = "violation"
    """How to learn: violation (the warm-up phase, Algorithm 1). lcs-rl, ppo and pddm are not available yet."""
    minutes: float = 6.0
    """Data to collect [min of simulated time]; one minute is 600 steps of 0.1 s."""
    seed: int = 0
    """Seed of everything random in the training."""
    n_lam: int = 8
    """Contacts (complementarity variables) of the model; ignored with --init. After 6 minutes on the cube (6 seeds,
    300 goals each): 60 to 79 %, mean 71, with 8; 61 to 76 %, mean 70, with 5."""
    stiffness: float = 0.1
    """Lower bound on the symmetric part of the model's F; ignored with --init."""
    init_scale: float = 1e-3
    """Initial parameters are uniform within ± this; ignored with --init."""
    backend: str = "batched"
    """MPC solver: batched, or ipopt (the reference, three times as long per training)."""
    evaluate_at: tuple[float, ...] = (1.0, 2.0, 4.0)
    """Minutes of data after which to evaluate, besides the end; 0 is the untrained model."""
    evaluate_goals: int = 60
    """Goals of these evaluations."""
    final_goals: int = 300
    """Goals of the evaluations at minute 0 and at the end; 0 leaves them out."""
    evaluation_seed: int = 0
    """Seed of the evaluation goals, the same for every evaluation of the run."""
    warmup: WarmupConfig = field(default_factory=WarmupConfig)
    """Settings of the warm-up phase."""

    def __post_init__(self) -> None:
        get_task(self.task)
        check_choice("method", self.method, METHODS)
        if self.method not in _AVAILABLE:
            raise InvalidInputError(
                f"method: expected {' or '.join(_AVAILABLE)}, got {self.method!r}, which is not available yet"
            )
        check_number("minutes", self.minutes, strict=True)
        check_number("stiffness", self.stiffness, strict=True)
        check_number("init_scale", self.init_scale)
        for name in ("n_lam", "evaluate_goals"):
            check_positive_int(name, getattr(self, name))
        for name in ("seed", "final_goals", "evaluation_seed"):
            check_positive_int(name, getattr(self, name), minimum=0)
        for value in self.evaluate_at:
            check_number("evaluate_at", value)

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> TrainConfig:
        """Rebuild a configuration from JSON.

        Raises:
            CheckpointError: it was written by another version or by something else.
        """
        wanted = {f.name for f in fields(cls)}
        warmup = values.get("warmup")
        if set(values) != wanted or not isinstance(warmup, dict):
            raise CheckpointError(
                f"config.json: expected the fields {sorted(wanted)}, got {sorted(values)}; "
                f"use the version of difflcs that wrote it"
            )
        plain = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        try:
            return cls(**{**plain, "warmup": config_from_dict(warmup)})  # pyright: ignore[reportArgumentType]
        except InvalidInputError as error:
            raise CheckpointError(f"config.json: its values cannot be used: {error}") from error

    def smoke(self) -> TrainConfig:
        """The same in seconds: too little data to learn anything."""
        return replace(
            self,
            minutes=min(self.minutes, 0.5),
            evaluate_at=tuple(v for v in self.evaluate_at if v < 0.5),
            evaluate_goals=min(self.evaluate_goals, 4),
            final_goals=min(self.final_goals, 4),
            warmup=replace(self.warmup, first_epochs=20, epochs=2),
        )


class Reporter:
    """Hears what a training does; override what is wanted."""

    def started(self, done: int, total: int) -> None:
        """The training starts with `done` of `total` environment steps collected."""

    def stepped(self, env_steps: int) -> None:
        """Environment steps were collected for training."""

    def iterated(self, iteration: Iteration) -> None:
        """An iteration ended."""

    def evaluating(self, minutes: float, goals: int) -> None:
        """An evaluation starts."""

    def evaluated(self, minutes: float, result: Evaluation) -> None:
        """An evaluation ended."""


def train(
    config: TrainConfig,
    out: Path,
    make_envs: EnvFactory,
    *,
    init: Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> RunDirectory:
    """Train a model and leave a run directory behind.

    It can be interrupted at any instant; resumed, it ends with the same parameters as if it had not been.

    Args:
        config: what to train. When resuming, the run's own configuration must equal it.
        out: the run directory, new or empty unless resuming.
        make_envs: makes the environments of the task.
        init: run or model directory to start from, instead of a random model.
        resume: continue the run in `out`.
        reporter: for progress bars.

    Returns:
        The finished run.

    Raises:
        CheckpointError: `out` holds files and `resume` is not set, or they cannot be resumed from.
        MissingDependencyError: TensorBoard is not installed.
    """
    require("tensorboard")
    reporter = reporter or Reporter()
    task = get_task(config.task)
    if resume:
        run = RunDirectory.open(out)
        stored = run.config()
        if stored_config(run) != config:
            raise CheckpointError(
                f"{out}: expected the configuration it was started with, got another; drop the changes"
            )
        if run.finished():
            return run
        source = stored.get("init")
        init = None if source is None else Path(str(source))
    else:
        model = None if init is None else load_model(init)  # before anything is written
        run = RunDirectory.create(
            out,
            {
                "kind": "run",
                "config": asdict(config),
                "init": None if init is None else str(init.resolve()),
                "versions": versions(),
            },
        )
    if resume and (run.checkpoints / "latest.json").exists():
        checkpoint = load_checkpoint(run.checkpoints)
        model = checkpoint.model
    else:
        checkpoint = None
        model = _initial_model(config) if init is None else load_model(init)
    policy = task.make_policy(model, config.backend)
    envs = make_envs(max(config.warmup.random_rollouts, config.warmup.rollouts_per_iteration))
    try:
        pretrained = init is not None
        trainer = Warmup(model, policy, envs, config.warmup, config.seed, task.episode_steps, pretrained)
        if checkpoint is not None:
            trainer.restore(checkpoint)
        _loop(config, task, run, trainer, make_envs, reporter, fresh=checkpoint is None)
    finally:
        envs.close()
    return run


def stored_config(run: RunDirectory) -> TrainConfig:
    """The configuration a run was started with.

    Raises:
        CheckpointError: it was written by another version or by something else.
    """
    values = run.config().get("config")
    if not isinstance(values, dict):
        raise CheckpointError(f"{run.path}: expected a configuration in config.json, got {type(values).__name__}")
    return TrainConfig.from_dict(values)


def load_model(path: Path) -> LCSModel:
    """The model of a run directory (finished or not), or of a directory written by `LCSModel.save_pretrained`."""
    if (path / "checkpoints").is_dir() or (path / "model").is_dir():
        return RunDirectory.open(path).load_model()
    return LCSModel.from_pretrained(path)


def _initial_model(config: TrainConfig) -> LCSModel:
    generator = torch.Generator().manual_seed(config.seed)
    return LCSModel(
        N_X,
        N_U,
        config.n_lam,
        config.stiffness,
        init_scale=config.init_scale,
        learn_c=False,
        generator=generator,
    )


def _loop(
    config: TrainConfig,
    task: Task,
    run: RunDirectory,
    trainer: Warmup,
    make_envs: EnvFactory,
    reporter: Reporter,
    fresh: bool,
) -> None:
    from torch.utils.tensorboard import SummaryWriter

    per_minute = 60.0 / task.step_seconds
    total = round(config.minutes * per_minute)
    run.truncate_log(-1 if fresh else trainer.iteration)
    reporter.started(trainer.env_steps, total)
    evaluation_envs: list[VectorEnv] = []  # made when first needed: one second

    def measure(goals: int) -> Evaluation:
        if not evaluation_envs:
            evaluation_envs.append(make_envs(min(EVALUATION_ENVS, max(config.evaluate_goals, config.final_goals))))
        reporter.evaluating(trainer.env_steps / per_minute, goals)
        return evaluate(evaluation_envs[0], trainer.policy, goals, config.evaluation_seed, task.episode_steps)

    def finish(iteration: Iteration | None, previous: int) -> None:
        # The row first, then the checkpoint: resuming drops rows after the checkpoint, so none is lost or doubled.
        goals = goals_due(config, previous, trainer.env_steps, per_minute)
        start = time.perf_counter()
        result = measure(goals) if goals else None
        row = _row(trainer.env_steps, per_minute, iteration, result, time.perf_counter() - start)
        run.append(row)
        for name, value in row.items():
            if isinstance(value, int | float) and name not in ("iteration", "env_steps"):
                writer.add_scalar(name, value, trainer.env_steps)
        save_checkpoint(run.checkpoints, trainer.checkpoint())
        if iteration is not None:
            reporter.iterated(iteration)
        if result is not None:
            reporter.evaluated(trainer.env_steps / per_minute, result)

    writer = SummaryWriter(str(run.tensorboard), purge_step=0 if fresh else trainer.env_steps + 1)
    try:
        if fresh:
            finish(None, previous=-1)
        while trainer.env_steps < total:
            previous = trainer.env_steps
            finish(trainer.step(reporter.stepped), previous)
        trainer.lcs.save_pretrained(run.model)
    finally:
        writer.close()
        for envs in evaluation_envs:
            envs.close()


def goals_due(config: TrainConfig, previous: int, now: int, per_minute: float) -> int:
    """How many goals to evaluate after collecting the environment steps previous + 1 … now; 0 for none."""
    if now == 0:
        return config.final_goals if 0 in config.evaluate_at else 0
    if previous < round(config.minutes * per_minute) <= now:
        return config.final_goals
    due = any(previous < minute * per_minute <= now for minute in config.evaluate_at)
    return config.evaluate_goals if due else 0


def _row(
    env_steps: int, per_minute: float, iteration: Iteration | None, result: Evaluation | None, seconds: float
) -> dict[str, object]:
    """One row of log.csv; None where there is nothing to tell."""
    names = [f.name for f in fields(Iteration)]
    known = {"iteration": 0, "env_steps": env_steps} if iteration is None else asdict(iteration)
    row: dict[str, object] = {name: known.get(name) for name in ["iteration", "minutes", *names[1:]]}
    row["minutes"] = round(env_steps / per_minute, 6)
    for name in ("success_rate", "ci_low", "ci_high", "goals", "solver_failures"):
        row[f"evaluation_{name}"] = None if result is None else getattr(result, name)
    row["evaluation_seconds"] = None if result is None else seconds
    return row


def saved_bounds(checkpoint: Checkpoint) -> tuple[torch.Tensor, torch.Tensor]:
    """The trust region (n_u,), (n_u,) [m] of the last episodes before a checkpoint."""
    return checkpoint.tensors["u_min"], checkpoint.tensors["u_max"]
