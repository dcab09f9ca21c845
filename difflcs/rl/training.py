"""A training run on disk: create or resume it, iterate, evaluate, log, save."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from difflcs._checks import check_choice, check_number, check_positive_int
from difflcs._files import short
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.mpc.backends import get_backend
from difflcs.rl._optional import require, versions
from difflcs.rl._trifinger import N_U, N_X, Task, get_task, pushing_cost, pushing_features
from difflcs.rl.checkpoint import Checkpoint, RunDirectory, load_checkpoint, save_checkpoint
from difflcs.rl.dynamics import Ensemble
from difflcs.rl.evaluate import Evaluation, evaluate
from difflcs.rl.imagination import Imagination, ImaginationConfig
from difflcs.rl.mlp import MLPConfig, MLPController, check_network
from difflcs.rl.pddm import PDDM, PDDMConfig, PDDMIteration, Planner, ensemble_tensors
from difflcs.rl.phases import LCSRL
from difflcs.rl.ppo import PPO, PPOConfig, PPOIteration, network_tensors
from difflcs.rl.rollout import Policy
from difflcs.rl.warmup import Iteration, Warmup, WarmupConfig, config_from_dict

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

EnvFactory = Callable[[int], "VectorEnv"]
"""Number of environments → a vector of them, stepped in lockstep."""
EVALUATION_ENVS = 50
"""Environments of an evaluation: enough to keep the solver's workers busy, few enough to build in a second."""
_MOST_MINUTES = 1e6
"""Longest training [min]: two years of the robot's time."""
METHODS = ("violation", "lcs-rl", "ppo", "ppo-mlp", "pddm")
Trainer = Warmup | PPO | LCSRL | PDDM
"""What trains: objects with `step`, `checkpoint` and `restore`."""
Report = Iteration | PPOIteration | PDDMIteration
"""What their iterations report."""
_WITHOUT_LCS = ("ppo-mlp", "pddm")
_REPORTS: Mapping[str, tuple[type, ...]] = {
    "violation": (Iteration,),
    "lcs-rl": (Iteration, PPOIteration),
    "ppo": (PPOIteration,),
    "ppo-mlp": (PPOIteration,),
    "pddm": (PDDMIteration,),
}


@dataclass(frozen=True)
class TrainConfig:
    """What is trained, on how much data, and when it is evaluated."""

    task: str = "cube"
    """What to do: cube, turn_cube, sugar_box, fish_can, mug, wrench, banana, clamp, large_clamp, extra_large_clamp."""
    method: str = "violation"
    """How to learn: violation is the warm-up phase alone (Algorithm 1), lcs-rl the warm-up and then Algorithm 2, ppo is
    Algorithm 2 from a random model, ppo-mlp the same PPO with a network instead of an MPC, pddm is networks and a
    sampling planner."""
    minutes: float = 6.0
    """Data to collect [min of simulated time]; one minute is 600 steps of 0.1 s."""
    seed: int = 0
    """Seed of everything random in the training."""
    warmup_minutes: float = 3.0
    """Method lcs-rl: data of the warm-up [min], the rest of `minutes` is the main phase's (6 in the paper)."""
    n_lam: int = 8
    """Contacts, that is complementarity variables, of the model; ignored with --init. Models of 5 and of 8 are equally
    good after 6 minutes on the cube: 70 and 71 % in the mean of 6 seeds."""
    stiffness: float = 0.1
    """Lower bound on the symmetric part of the model's F; ignored with --init."""
    init_scale: float = 1e-3
    """Initial parameters are uniform within ± this; ignored with --init."""
    backend: str = "batched"
    """MPC solver: batched, or ipopt, the reference, with which a training takes three times as long."""
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
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Settings of the main phase, for the methods lcs-rl and ppo."""
    imagination: ImaginationConfig = field(default_factory=ImaginationConfig)
    """Settings of the imagined episodes in the main phase, for the methods lcs-rl and ppo."""
    mlp: MLPConfig = field(default_factory=MLPConfig)
    """Settings of the method ppo-mlp."""
    pddm: PDDMConfig = field(default_factory=PDDMConfig)
    """Settings of the method pddm."""

    def __post_init__(self) -> None:
        get_task(self.task)
        check_choice("method", self.method, METHODS)
        for name in ("minutes", "warmup_minutes"):
            if check_number(name, getattr(self, name), strict=True) > _MOST_MINUTES:
                raise InvalidInputError(f"{name}: expected at most {_MOST_MINUTES:g}, got {getattr(self, name):g}")
        check_number("stiffness", self.stiffness, strict=True)
        check_number("init_scale", self.init_scale)
        check_positive_int("n_lam", self.n_lam, maximum=1000)
        check_positive_int("evaluate_goals", self.evaluate_goals, maximum=10**6)
        check_positive_int("final_goals", self.final_goals, minimum=0, maximum=10**6)
        for name in ("seed", "evaluation_seed"):
            check_positive_int(name, getattr(self, name), minimum=0)
        for value in self.evaluate_at:
            check_number("evaluate_at", value)

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> TrainConfig:
        """Rebuild a configuration from JSON.

        Raises:
            CheckpointError: it was written by another version or by something else.
        """
        return config_from_dict(values, cls)

    def smoke(self) -> TrainConfig:
        """The same in seconds: too little data to learn anything."""
        return replace(
            self,
            minutes=min(self.minutes, 0.5),
            warmup_minutes=min(self.warmup_minutes, 0.2),
            evaluate_at=tuple(v for v in self.evaluate_at if v < 0.5),
            evaluate_goals=min(self.evaluate_goals, 4),
            final_goals=min(self.final_goals, 4),
            warmup=replace(self.warmup, first_epochs=20, epochs=2),
            ppo=replace(self.ppo, rollouts=min(self.ppo.rollouts, 3), steps=min(self.ppo.steps, 2)),
            imagination=replace(
                self.imagination,
                iterations=min(self.imagination.iterations, 1),
                rollouts=min(self.imagination.rollouts, 5),
                steps=min(self.imagination.steps, 2),
                first_epochs=2,
                epochs=1,
            ),
            mlp=replace(self.mlp, rollouts=min(self.mlp.rollouts, 5), steps=min(self.mlp.steps, 2)),
            pddm=replace(
                self.pddm,
                random_rollouts=min(self.pddm.random_rollouts, 5),
                rollouts_per_iteration=min(self.pddm.rollouts_per_iteration, 5),
                epochs=min(self.pddm.epochs, 2),
                samples=min(self.pddm.samples, 10),
            ),
        )


class Reporter:
    """Hears what a training does; override what is wanted."""

    def started(self, done: int, total: int) -> None:
        """The training starts with `done` of `total` environment steps collected."""

    def stepped(self, env_steps: int) -> None:
        """Environment steps were collected for training."""

    def iterated(self, iteration: Report) -> None:
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
    force: bool = False,
    reporter: Reporter | None = None,
) -> RunDirectory:
    """Train a model and leave a run directory behind.

    It can be interrupted at any instant; resumed, it ends with the same parameters as if it had not been. The run
    directory is locked meanwhile.

    Args:
        config: what to train. When resuming, the run's own configuration must equal it.
        out: the run directory, new or empty unless resuming.
        make_envs: makes the environments of the task.
        init: run or model directory, or model of the zoo ("zoo:NAME"), to start from, instead of a random model.
        resume: continue the run in `out`.
        force: replace the run in `out`. It is deleted once the new one has begun, and stays if that fails.
        reporter: for progress bars.

    Returns:
        The finished run.

    Raises:
        InvalidInputError: the data is used up by the warm-up, `init` does not fit the task, or `force` and `resume`.
        CheckpointError: `out` holds files and neither `resume` nor `force` is set, or they cannot be resumed from, or
            they are no run, or they cannot be written; the last checkpoint is intact.
        InUseError: another process trains in `out`.
        MissingDependencyError: TensorBoard is not installed.
    """
    reporter = reporter or Reporter()
    if not force:
        with ExitStack() as held:
            return _train(config, out, make_envs, init, resume, reporter, lambda: None, held)
    if resume:
        raise InvalidInputError("force: expected without resume, got both; one replaces a run, the other continues it")
    if init is not None and init.resolve().is_relative_to(out.resolve()):
        raise InvalidInputError(f"init: expected a model outside the run that is replaced, {out}, got {init}; copy it")
    with _replacing(out) as begun, ExitStack() as held:
        return _train(config, out, make_envs, init, resume, reporter, begun, held)


def _train(
    config: TrainConfig,
    out: Path,
    make_envs: EnvFactory,
    init: Path | None,
    resume: bool,
    reporter: Reporter,
    begun: Callable[[], object],
    held: ExitStack,
) -> RunDirectory:
    require("tensorboard")
    task = get_task(config.task)
    if config.method == "lcs-rl" and config.minutes <= config.warmup_minutes:
        raise InvalidInputError(
            f"minutes: expected more than the {config.warmup_minutes:g} of the warm-up with lcs-rl, got "
            f"{config.minutes:g}; pass --minutes 30, or --method violation for a warm-up alone"
        )
    if config.method in _WITHOUT_LCS and init is not None:
        raise InvalidInputError(
            f"init: expected none with method {config.method}, which learns networks instead of an LCSModel"
        )
    if resume:
        run = RunDirectory.open(out)
        if not run.finished():
            with _writing(out):
                held.enter_context(run.locked())
        stored = run.config()
        if stored_config(run) != config:
            raise CheckpointError(
                f"{out}: expected the configuration it was started with, got another; drop the changes"
            )
        if run.finished():
            return run
        source = stored.get("init")
        if not isinstance(source, str | None):
            raise CheckpointError(f"{out}: expected a path as init in config.json, got {short(source)}")
        init = None if source is None else Path(source)
    else:
        get_backend(config.backend)  # clear errors before anything is written
        if init is not None:
            _check_fits(load_model(init), init, config.task)
        with _writing(out):
            RunDirectory.check_free(out)  # before anything is written there
            out.mkdir(parents=True, exist_ok=True)
            held.enter_context(RunDirectory(out).locked())
            run = RunDirectory.create(
                out,
                {
                    "kind": "run",
                    "config": asdict(config),
                    "init": None if init is None else str(init.resolve() if init.exists() else init),
                    "versions": versions(),
                },
            )
    checkpoint = load_checkpoint(run.checkpoints) if resume and (run.checkpoints / "latest.json").exists() else None
    model = _initial_model(config) if init is None else load_model(init)
    opened: list[VectorEnv] = []

    def open_envs(count: int) -> VectorEnv:
        opened.append(make_envs(count))
        return opened[-1]

    try:
        trainer = _make_trainer(config, task, model, open_envs, init is not None)
        if checkpoint is not None:
            trainer.restore(checkpoint)
        begun()
        _loop(config, task, run, trainer, make_envs, reporter, fresh=checkpoint is None)
    finally:
        for envs in opened:
            envs.close()
    return run


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise CheckpointError(
            f"{path}: expected a folder with free space that can be written, got: {error}; mend that and go on with "
            f"--resume, or choose another --out. The last checkpoint is intact"
        ) from error


@contextmanager
def _replacing(out: Path) -> Iterator[Callable[[], object]]:
    """Move the run in `out` aside; calling what is yielded deletes it, otherwise it comes back at the end."""
    out = out.resolve()
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        yield lambda: None
        return
    try:
        RunDirectory.open(out).config()
    except CheckpointError as error:
        raise CheckpointError(f"{error}. --force replaces runs only; choose another --out") from error
    with ExitStack() as held:
        with _writing(out):
            held.enter_context(RunDirectory(out).locked())
            aside = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}.", suffix=".old"))
            os.replace(out, aside / out.name)
            out.mkdir()  # `--out` may be a link to it
        yield from _moved(out, aside)


def _moved(out: Path, aside: Path) -> Iterator[Callable[[], object]]:
    replaced = False

    def discard() -> None:
        nonlocal replaced
        replaced = True
        shutil.rmtree(aside, ignore_errors=True)

    try:
        yield discard
    finally:
        if not replaced:
            shutil.rmtree(out, ignore_errors=True)
            os.replace(aside / out.name, out)
            aside.rmdir()


def _check_fits(model: LCSModel, source: Path, task: str) -> None:
    got = f"n_x={model.n_x}, n_u={model.n_u}, {str(model.A.dtype).removeprefix('torch.')}"
    wanted = f"n_x={N_X}, n_u={N_U}, float64"
    if got != wanted:
        raise InvalidInputError(f"init: expected a model with {wanted}, as task {task} needs, got {got} in {source}")


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
    """The model of a run directory (finished or not), of `LCSModel.save_pretrained`, or of the zoo ("zoo:NAME")."""
    if os.path.isdir(path / "checkpoints") or os.path.isdir(path / "model"):  # False for what can be no path
        return RunDirectory.open(path).load_model()
    return LCSModel.from_pretrained(path)


def load_policy(run: RunDirectory) -> Policy:
    """What a run has learned, as a policy: of a finished run the final one, else that of its latest checkpoint.

    Raises:
        CheckpointError: there is none, or it does not fit the run's configuration.
    """
    config = stored_config(run)
    task = get_task(config.task)
    if config.method not in _WITHOUT_LCS:
        return task.make_policy(run.load_model(), config.backend)
    if config.method == "ppo-mlp":
        return _load_network(run, config, task)
    if run.finished():
        ensemble = Ensemble.from_pretrained(run.model)
    else:
        tensors = ensemble_tensors(load_checkpoint(run.checkpoints))
        ensemble = Ensemble.from_tensors(N_X, N_U, config.pddm.networks, config.pddm.width, tensors, str(run.path))
    high = torch.full((N_U,), task.u_max, dtype=torch.float64)
    return Planner(ensemble, pushing_cost(), config.pddm, -high, high)


def _load_network(run: RunDirectory, config: TrainConfig, task: Task) -> MLPController:
    if run.finished():
        return MLPController.from_pretrained(run.model, pushing_features)
    tensors = network_tensors(load_checkpoint(run.checkpoints))
    check_network(str(run.path), tensors, _n_features(), config.mlp.width, N_U)
    network = _initial_network(config, task)
    network.load_state_dict(tensors)
    return network


def _initial_network(config: TrainConfig, task: Task) -> MLPController:
    high = torch.full((N_U,), task.u_max, dtype=torch.float64)
    generator = torch.Generator().manual_seed(config.seed)
    width, steps = config.mlp.width, task.episode_steps
    return MLPController(pushing_features, _n_features(), -high, high, width, steps, generator)


def _n_features() -> int:
    return len(pushing_features(torch.zeros(N_X), torch.zeros(pushing_cost().n_goal), torch.zeros(())))


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


def _make_trainer(config: TrainConfig, task: Task, model: LCSModel, make_envs: EnvFactory, pretrained: bool) -> Trainer:
    policy = task.make_policy(model, config.backend)
    steps_per_minute = 60.0 / task.step_seconds
    total_episodes = max(1, round(config.minutes * steps_per_minute / task.episode_steps))

    def make_main(first_episode: int, first_iteration: int) -> PPO:
        # Here and not above: TorchRL takes seconds to import, which `difflcs --help` should not wait for.
        from difflcs.rl.policy import make_actor

        mlp = config.method == "ppo-mlp"
        settings = config.mlp if mlp else config.ppo
        envs = make_envs(min(settings.rollouts, max(1, total_episodes - first_episode)))
        imagination = None
        if config.imagination.iterations and not mlp:
            imagination = Imagination(envs, task.outcome, config.imagination, config.seed, task.episode_steps)
        return PPO(
            make_actor(_initial_network(config, task) if mlp else policy, settings),
            envs,
            settings,
            config.seed,
            features=pushing_features,
            total_episodes=total_episodes,
            episode_steps=task.episode_steps,
            first_episode=first_episode,
            first_iteration=first_iteration,
            imagination=imagination,
        )

    if config.method in ("ppo", "ppo-mlp"):
        return make_main(0, 0)
    if config.method == "pddm":
        needed = max(config.pddm.random_rollouts, config.pddm.rollouts_per_iteration)
        return PDDM(
            pushing_cost(),
            make_envs(min(needed, total_episodes)),
            config.pddm,
            config.seed,
            total_episodes=total_episodes,
            episode_steps=task.episode_steps,
        )
    envs = make_envs(max(config.warmup.random_rollouts, config.warmup.rollouts_per_iteration))
    warmup = Warmup(model, policy, envs, config.warmup, config.seed, task.episode_steps, pretrained)
    if config.method == "violation":
        return warmup
    return LCSRL(warmup, round(config.warmup_minutes * steps_per_minute), make_main)


def _loop(
    config: TrainConfig,
    task: Task,
    run: RunDirectory,
    trainer: Trainer,
    make_envs: EnvFactory,
    reporter: Reporter,
    fresh: bool,
) -> None:
    from torch.utils.tensorboard import SummaryWriter

    per_minute = 60.0 / task.step_seconds
    # Whole episodes: the same total as the main phase ends at.
    total = task.episode_steps * max(1, round(config.minutes * per_minute / task.episode_steps))
    columns = _columns(config.method)
    run.truncate_log(-1 if fresh else trainer.iteration)
    reporter.started(trainer.env_steps, total)
    evaluation_envs: list[VectorEnv] = []  # made when first needed: one second

    def measure(goals: int) -> Evaluation:
        if not evaluation_envs:
            evaluation_envs.append(make_envs(min(EVALUATION_ENVS, max(config.evaluate_goals, config.final_goals))))
        reporter.evaluating(trainer.env_steps / per_minute, goals)
        return evaluate(evaluation_envs[0], trainer.policy, goals, config.evaluation_seed, task.episode_steps)

    def finish(iteration: Report | None, previous: int) -> None:
        # The row first, then the checkpoint: resuming drops rows after the checkpoint, so none is lost or doubled.
        goals = goals_due(config, previous, trainer.env_steps, per_minute)
        start = time.perf_counter()
        result = measure(goals) if goals else None
        row = _row(columns, trainer.env_steps, per_minute, iteration, result, time.perf_counter() - start)
        with _writing(run.path):
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
        with _writing(run.path):
            _learned(trainer).save_pretrained(run.model)
    finally:
        writer.close()
        for envs in evaluation_envs:
            envs.close()


def _learned(trainer: Trainer) -> LCSModel | MLPController | Ensemble:
    if isinstance(trainer, PDDM):
        return trainer.ensemble
    return trainer.learned if isinstance(trainer, PPO) else trainer.lcs


def goals_due(config: TrainConfig, previous: int, now: int, per_minute: float) -> int:
    """How many goals to evaluate after collecting the environment steps previous + 1 … now; 0 for none."""
    if now == 0:
        return config.final_goals if 0 in config.evaluate_at else 0
    if previous < round(config.minutes * per_minute) <= now:
        return config.final_goals
    due = any(previous < minute * per_minute <= now for minute in config.evaluate_at)
    return config.evaluate_goals if due else 0


def _columns(method: str) -> list[str]:
    """Columns of log.csv: what the method's phases report, each once."""
    return list(dict.fromkeys(f.name for report in _REPORTS[method] for f in fields(report)))


def _row(
    names: list[str],
    env_steps: int,
    per_minute: float,
    iteration: Report | None,
    result: Evaluation | None,
    seconds: float,
) -> dict[str, object]:
    """One row of log.csv; None where there is nothing to tell."""
    known = {"iteration": 0, "env_steps": env_steps} if iteration is None else asdict(iteration)
    row: dict[str, object] = {name: known.get(name) for name in ["iteration", "minutes", *names[1:]]}
    row["minutes"] = round(env_steps / per_minute, 6)
    for name in ("success_rate", "ci_low", "ci_high", "goals", "solver_failures"):
        row[f"evaluation_{name}"] = None if result is None else getattr(result, name)
    row["evaluation_seconds"] = None if result is None else seconds
    return row


def profile(rows: Sequence[Mapping[str, str]]) -> dict[str, float]:
    """Where the time of a run went: name → seconds, summed over the rows of log.csv."""
    names = [name for name in rows[0] if name.endswith("_seconds")] if rows else []
    return {name.removesuffix("_seconds"): sum(float(row[name] or 0) for row in rows) for name in names}


def saved_bounds(checkpoint: Checkpoint) -> tuple[torch.Tensor, torch.Tensor]:
    """The trust region (n_u,), (n_u,) [m] of the last episodes before a checkpoint."""
    return checkpoint.tensors["u_min"], checkpoint.tensors["u_max"]
