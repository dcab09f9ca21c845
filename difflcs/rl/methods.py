"""Methods: how something is learned. Others register theirs here.

    @register_method
    @dataclass(frozen=True)
    class Mine(LCSMethod):
        name, version, summary, reports = "mine", 1, "…", (MyReport,)
        epochs: int = bounded(10, minimum=1)

        def trainer(self, work): ...

A method is a frozen dataclass whose fields are its settings; the default instance is the method as it is meant. Where
this was imported, `train(...)` and the command line know it: `difflcs train --method mine --epochs 20`, `evaluate`,
`render`; and the conformance suite of the methods tests it. `LCSMethod` is the base of those that learn an `LCSModel`,
`Method` of all others.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

import torch
from torch import Tensor

from difflcs._checks import did_you_mean
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError
from difflcs.lcs import LCSModel, LCSModule
from difflcs.mpc.backends import get_backend
from difflcs.rl.dynamics import Ensemble
from difflcs.rl.lcs_rl import LCSRL
from difflcs.rl.mlp import MLPController
from difflcs.rl.model_rollouts import ModelRollouts, ModelRolloutSettings
from difflcs.rl.pddm import PDDM, PDDMReport, PDDMSettings, Planner
from difflcs.rl.ppo import PPO, PPOReport
from difflcs.rl.ppo_settings import PPOSettings, make_ppo
from difflcs.rl.rollout import Policy
from difflcs.rl.settings import MOST_WIDTH, Adam, Epochs, Rollouts, Settings, bounded, group
from difflcs.rl.tasks import TaskSpec, one_start
from difflcs.rl.trainer import Trainer
from difflcs.rl.warmup import Warmup, WarmupReport, WarmupSettings

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from difflcs.mpc import LCSMPCLayer


@dataclass(frozen=True)
class Work:
    """What a method is to learn, and with what.

    Attributes:
        task: the task.
        seed: of everything random.
        total_episodes: episodes of the whole training.
        make_envs: makes that many environments, which the training closes.
        init: the model to start from, of the task's sizes; None: a random one.
    """

    task: TaskSpec
    seed: int
    total_episodes: int
    make_envs: Callable[[int], VectorEnv]
    init: LCSModel | None = None


@dataclass(frozen=True)
class Method(Settings, ABC):
    """How something is learned. Subclass as a frozen dataclass whose fields are its settings.

    Attributes:
        name: its name, on the command line too.
        version: raised whenever the same settings give another result.
        summary: what it does, in one line.
        reports: dataclasses that its trainer's `step` returns; their fields are the columns of log.csv.
        kind: of the record that what it learned is written as.
        takes_init: whether it can start from an `LCSModel`.
    """

    name: ClassVar[str]
    version: ClassVar[int]
    summary: ClassVar[str]
    reports: ClassVar[tuple[type, ...]]
    kind: ClassVar[str]
    takes_init: ClassVar[bool] = False

    @abstractmethod
    def trainer(self, work: Work) -> Trainer:
        """What learns: one iteration at a time, with reports of the types in `reports`."""

    @abstractmethod
    def rebuild(self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str) -> Any:
        """What was learned, out of its configuration and its tensors; `source` names them in the error messages.

        Raises:
            CheckpointError: they do not fit each other or the task.
        """

    @abstractmethod
    def policy(self, task: TaskSpec, learned: Any) -> Policy:
        """What acts by what was learned, without noise."""

    @property
    def solver(self) -> str | None:
        """Name of the MPC's backend; None where there is no MPC."""
        return None

    def check(self, minutes: float) -> None:
        """Refuse what cannot be trained, before anything is written.

        Raises:
            InvalidInputError: the minutes of data do not fit the settings, or a solver is missing.
        """

    def smoke(self) -> Self:
        """The same in seconds: too little of everything to learn anything."""
        return self


@dataclass(frozen=True)
class LCSMethod(Method):
    """A method that learns an `LCSModel` and acts by the MPC around it."""

    n_lam: int = bounded(8, minimum=1, maximum=1000)
    """Contacts, that is complementarity variables, of the model; ignored with --init."""
    stiffness: float = bounded(0.1, above=0)
    """Lower bound on the symmetric part of the model's F; ignored with --init."""
    init_scale: float = bounded(1e-3, minimum=0)
    """Initial parameters are uniform within ± this; ignored with --init."""
    backend: str = "batched"
    """MPC solver: batched, or ipopt, the reference, which takes many times as long for a plan."""

    kind: ClassVar[str] = "LCSModel"
    takes_init: ClassVar[bool] = True

    @property
    def solver(self) -> str:
        """See `Method`."""
        return self.backend

    def check(self, minutes: float) -> None:
        """See `Method`."""
        get_backend(self.backend)

    def rebuild(
        self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str
    ) -> LCSModule:
        """See `Method`."""
        lcs = LCSModel.from_config(config, tensors, source)
        check_fits(lcs, task, source, CheckpointError)
        return lcs

    def policy(self, task: TaskSpec, learned: LCSModule) -> LCSMPCLayer:
        """See `Method`."""
        return task.make_policy(learned, one_start(self.backend))

    def initial(self, work: Work) -> LCSModule:
        """The model to start from. Override it, with `kind` and `rebuild`, to learn a module of your own."""
        if work.init is not None:
            return work.init
        return LCSModel(
            work.task.n_x,
            work.task.n_u,
            self.n_lam,
            self.stiffness,
            init_scale=self.init_scale,
            learn_c=False,
            generator=torch.Generator().manual_seed(work.seed),
        )


def check_fits(lcs: LCSModel, task: TaskSpec, source: object, error: type[Exception] = InvalidInputError) -> None:
    """Refuse a model of other sizes than a task's, or in single precision, by an error of the given kind."""
    got = f"n_x={lcs.n_x}, n_u={lcs.n_u}, {str(lcs.A.dtype).removeprefix('torch.')}"
    wanted = f"n_x={task.n_x}, n_u={task.n_u}, float64"
    if got != wanted:
        raise error(f"init: expected a model with {wanted}, as task {task.name} needs, got {got} in {source}")


# --- registry ---------------------------------------------------------------------------------------------------------

_REGISTRY: dict[str, type[Method]] = {}


Registered = TypeVar("Registered", bound=type[Method])


def register_method(method: Registered) -> Registered:
    """Make a method available under its `name`; usable as a class decorator.

    Raises:
        DTypeError: not a `Method` subclass with name, version, summary and reports.
    """
    wanted = {"name": str, "version": int, "summary": str, "reports": tuple, "kind": str}
    if not (isinstance(method, type) and issubclass(method, Method)) or not all(
        isinstance(getattr(method, name, None), kind) for name, kind in wanted.items()
    ):
        raise DTypeError(f"method: expected a subclass of Method with {', '.join(wanted)}, got {method!r}")
    _REGISTRY[method.name] = method
    return method


def method_names() -> tuple[str, ...]:
    """Names of the methods; the first is the default of `difflcs train`."""
    return tuple(_REGISTRY)


def get_method(name: str) -> type[Method]:
    """The method of a name; its default instance is `get_method(name)()`.

    Raises:
        InvalidInputError: no method has this name.
    """
    if name not in _REGISTRY:
        raise InvalidInputError(
            f"method: expected one of {', '.join(_REGISTRY)}, got {name!r:.200}{did_you_mean(name, _REGISTRY)}; add "
            f"your own with difflcs.rl.register_method"
        )
    return _REGISTRY[name]


# --- the methods of the paper and their reference points --------------------------------------------------------------


def _warmup(work: Work, lcs: LCSModule, policy: Policy, settings: WarmupSettings) -> Warmup:
    envs = work.make_envs(max(settings.rollouts.first, settings.rollouts.each))
    return Warmup(lcs, policy, envs, settings, work.seed, work.task.episode_steps, work.init is not None)


def main_phase(
    work: Work,
    controller: LCSMPCLayer | MLPController,
    settings: PPOSettings,
    models: ModelRolloutSettings | None,
    first_episode: int = 0,
    first_iteration: int = 0,
) -> PPO:
    """PPO by its settings, from the episodes and iterations done before."""
    # Here and not above: TorchRL takes seconds to import, which `difflcs --help` should not wait for.
    from difflcs.rl.policy import make_actor

    task = work.task
    envs = work.make_envs(min(settings.rollouts, max(1, work.total_episodes - first_episode)))
    rollouts = None
    if models is not None and models.iterations:
        rollouts = ModelRollouts(envs, task.outcome, models, work.seed, task.episode_steps)
    return make_ppo(
        make_actor(controller, settings.std, settings.covariance),
        envs,
        settings,
        work.seed,
        features=task.features,
        total_episodes=work.total_episodes,
        episode_steps=task.episode_steps,
        first_episode=first_episode,
        first_iteration=first_iteration,
        failure_penalty=task.failure_penalty,
        models=rollouts,
    )


def _few(settings: Rollouts) -> Rollouts:
    return replace(settings, first=min(settings.first, 5), each=min(settings.each, 5))


def _short(settings: Epochs, first: int, each: int) -> Epochs:
    return replace(settings, first=min(settings.first, first), each=min(settings.each, each))


def _short_warmup(settings: WarmupSettings) -> WarmupSettings:
    return replace(settings, rollouts=_few(settings.rollouts), epochs=_short(settings.epochs, 20, 2))


def short_main(settings: PPOSettings, rollouts: int = 3) -> PPOSettings:
    """The main phase in seconds, see `Method.smoke`."""
    return replace(settings, rollouts=min(settings.rollouts, rollouts), steps=min(settings.steps, 2))


def short_models(settings: ModelRolloutSettings) -> ModelRolloutSettings:
    """Model rollouts in seconds, see `Method.smoke`."""
    return replace(
        settings,
        iterations=min(settings.iterations, 1),
        rollouts=min(settings.rollouts, 5),
        steps=min(settings.steps, 2),
        ensemble=replace(settings.ensemble, epochs=_short(settings.ensemble.epochs, 2, 1)),
    )


@register_method
@dataclass(frozen=True)
class LCSRLMethod(LCSMethod):
    """LCS-RL: the warm-up (Algorithm 1), and then PPO through the MPC (Algorithm 2), with model rollouts."""

    warmup_minutes: float = bounded(3.0, above=0, maximum=1e6)
    """Data of the warm-up [min], the rest is the main phase's (6 in the paper)."""
    warmup: WarmupSettings = group(WarmupSettings, keep_support=True)
    """Settings of the warm-up phase."""
    ppo: PPOSettings = group(PPOSettings)
    """Settings of the main phase."""
    models: ModelRolloutSettings = group(ModelRolloutSettings)
    """Settings of the model rollouts in the main phase."""

    name: ClassVar[str] = "lcs-rl"
    version: ClassVar[int] = 2
    summary: ClassVar[str] = "the warm-up (Algorithm 1), and then PPO through the MPC (Algorithm 2)"
    reports: ClassVar[tuple[type, ...]] = (WarmupReport, PPOReport)

    def check(self, minutes: float) -> None:
        """See `Method`."""
        super().check(minutes)
        if minutes <= self.warmup_minutes:
            raise InvalidInputError(
                f"minutes: expected more than the {self.warmup_minutes:g} of the warm-up with lcs-rl, got "
                f"{minutes:g}; pass --minutes 30, or --method violation for a warm-up alone"
            )

    def trainer(self, work: Work) -> LCSRL:
        """See `Method`."""
        lcs = self.initial(work)
        policy = self.policy(work.task, lcs)
        return LCSRL(
            _warmup(work, lcs, policy, self.warmup),
            round(self.warmup_minutes * work.task.steps_per_minute),
            lambda episodes, iterations: main_phase(work, policy, self.ppo, self.models, episodes, iterations),
        )

    def smoke(self) -> Self:
        """See `Method`."""
        return replace(
            self,
            warmup_minutes=min(self.warmup_minutes, 0.2),
            warmup=_short_warmup(self.warmup),
            ppo=short_main(self.ppo),
            models=short_models(self.models),
        )


@register_method
@dataclass(frozen=True)
class ViolationMethod(LCSMethod):
    """The warm-up (Algorithm 1) alone: a model fitted by the violation loss."""

    warmup: WarmupSettings = group(WarmupSettings)
    """Settings of the warm-up."""

    name: ClassVar[str] = "violation"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "the warm-up (Algorithm 1) alone: a model fitted by the violation loss"
    reports: ClassVar[tuple[type, ...]] = (WarmupReport,)

    def trainer(self, work: Work) -> Warmup:
        """See `Method`."""
        lcs = self.initial(work)
        return _warmup(work, lcs, self.policy(work.task, lcs), self.warmup)

    def smoke(self) -> Self:
        """See `Method`."""
        return replace(self, warmup=_short_warmup(self.warmup))


@register_method
@dataclass(frozen=True)
class PPOMethod(LCSMethod):
    """PPO through the MPC (Algorithm 2) without a warm-up."""

    ppo: PPOSettings = group(PPOSettings)
    """Settings of PPO."""
    models: ModelRolloutSettings = group(ModelRolloutSettings)
    """Settings of the model rollouts."""

    name: ClassVar[str] = "ppo"
    version: ClassVar[int] = 2
    summary: ClassVar[str] = "PPO through the MPC (Algorithm 2) without a warm-up"
    reports: ClassVar[tuple[type, ...]] = (PPOReport,)

    def trainer(self, work: Work) -> PPO:
        """See `Method`."""
        return main_phase(work, self.policy(work.task, self.initial(work)), self.ppo, self.models)

    def smoke(self) -> Self:
        """See `Method`."""
        return replace(self, ppo=short_main(self.ppo), models=short_models(self.models))


@register_method
@dataclass(frozen=True)
class PPOMLPMethod(Method):
    """The same PPO with a network instead of an MPC. Its settings are CleanRL's for continuous actions, where known."""

    width: int = bounded(64, minimum=1, maximum=MOST_WIDTH)
    """Width of the two hidden layers of the policy's network."""
    ppo: PPOSettings = group(
        PPOSettings,
        steps=40,
        minibatch=300,
        update="adam",
        adam=Adam(3e-4, (0.9, 0.999)),
        step_factor=1.0,
        final_step=0.01,
        clip=0.2,
        zeta=0.95,
        covariance="diagonal",
        std_learning_rate=3e-4,
    )
    """Settings of PPO: ten passes over 60 episodes of 20 steps in each iteration."""

    name: ClassVar[str] = "ppo-mlp"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "the same PPO with a network instead of an MPC"
    reports: ClassVar[tuple[type, ...]] = (PPOReport,)
    kind: ClassVar[str] = "MLP"

    def trainer(self, work: Work) -> PPO:
        """See `Method`."""
        task, generator = work.task, torch.Generator().manual_seed(work.seed)
        sizes = (task.n_features, *task.bounds, self.width, task.episode_steps)
        return main_phase(work, MLPController(task.features, *sizes, generator), self.ppo, None)

    def rebuild(
        self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str
    ) -> MLPController:
        """See `Method`."""
        network = MLPController.from_config(config, tensors, source, task.features)
        got, wanted = (network.n_features, len(network.u_min)), (task.n_features, task.n_u)
        if got != wanted:
            raise CheckpointError(f"{source}: expected {wanted} features and actions of {task.name}, got {got}")
        return network

    def policy(self, task: TaskSpec, learned: MLPController) -> MLPController:
        """See `Method`."""
        return learned

    def smoke(self) -> Self:
        """See `Method`."""
        return replace(self, ppo=short_main(self.ppo, 5))


@register_method
@dataclass(frozen=True)
class PDDMMethod(Method):
    """PDDM: networks, and a planner that samples actions."""

    pddm: PDDMSettings = group(PDDMSettings)
    """Settings of PDDM."""

    name: ClassVar[str] = "pddm"
    version: ClassVar[int] = 2
    summary: ClassVar[str] = "PDDM: networks, and a planner that samples actions"
    reports: ClassVar[tuple[type, ...]] = (PDDMReport,)
    kind: ClassVar[str] = "dynamics"

    def trainer(self, work: Work) -> PDDM:
        """See `Method`."""
        needed = max(self.pddm.rollouts.first, self.pddm.rollouts.each)
        return PDDM(
            work.task.make_cost(),
            work.make_envs(min(needed, work.total_episodes)),
            self.pddm,
            work.seed,
            total_episodes=work.total_episodes,
            episode_steps=work.task.episode_steps,
        )

    def rebuild(
        self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str
    ) -> Ensemble:
        """See `Method`."""
        ensemble = Ensemble.from_config(config, tensors, source)
        if (ensemble.n_x, ensemble.n_u) != (task.n_x + task.n_context, task.n_u):
            raise CheckpointError(f"{source}: expected networks of the sizes of {task.name}, got others")
        return ensemble

    def policy(self, task: TaskSpec, learned: Ensemble) -> Planner:
        """See `Method`."""
        return Planner(learned, task.make_cost(), self.pddm, *task.bounds)

    def smoke(self) -> Self:
        """See `Method`."""
        ensemble, own = self.pddm.ensemble, self.pddm
        return replace(
            self,
            pddm=replace(
                own,
                rollouts=_few(own.rollouts),
                samples=min(own.samples, 10),
                ensemble=replace(ensemble, epochs=_short(ensemble.epochs, 2, 2)),
            ),
        )
