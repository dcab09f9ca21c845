"""Base classes of the methods, and their registry.

A method is a frozen dataclass whose fields are its settings, with the recommended ones as defaults. Once its module is
imported, `train(...)` and the command line know it: `difflcs train --method mine --epochs 20`, `evaluate`,
`render`; and the conformance suite of the methods tests it. `LCSMethod` is the base of those that learn an `LCSModel`,
`Method` of all others. docs/contributing.md adds one.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, TypeVar

import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from difflcs._checks import did_you_mean
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.mpc import LCSMPCLayer
from difflcs.mpc.backends import get_backend
from difflcs.records import LCSModule
from difflcs.rl.learning.trainer import Trainer
from difflcs.rl.rollout import Policy
from difflcs.rl.settings import Settings, bounded
from difflcs.rl.tasks import TaskSpec, single_start_backend


@dataclass(frozen=True)
class Work:
    """The task of a training and the means for it.

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


_FEW = {
    "warmup_minutes": 0.2,
    "fit_minutes": 0.2,
    "rollouts": 3,
    "first": 5,
    "each": 2,
    "steps": 2,
    "iterations": 1,
    "samples": 10,
}
"""Most that a smoke test has of a setting, in whichever group it is."""
Group = TypeVar("Group", bound=Settings)


def _few(settings: Group) -> Group:
    """Limit the numbers in a group of settings, and in the groups within it."""
    limited = {}
    for name, value in vars(settings).items():
        if isinstance(value, Settings):
            limited[name] = _few(value)
        elif name in _FEW and isinstance(value, int | float):
            limited[name] = min(value, _FEW[name])
    return replace(settings, **limited)


@dataclass(frozen=True)
class Method(Settings, ABC):
    """Base of the methods of learning. Subclass as a frozen dataclass whose fields are its settings.

    Attributes:
        name: its name, on the command line too.
        version: raised whenever the same settings give another result.
        summary: what it does, in one line.
        reports: dataclasses that its trainer's `step` returns; their fields are the columns of log.csv.
        kind: kind of the record that the learned model is written as.
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
        """Make the trainer, which learns one iteration at a time and returns reports of the types in `reports`."""

    @abstractmethod
    def rebuild(self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str) -> Any:
        """Rebuild the learned model from its configuration and its tensors; `source` names them in the error messages.

        Raises:
            CheckpointError: they do not fit each other or the task.
        """

    @abstractmethod
    def policy(self, task: TaskSpec, learned: Any) -> Policy:
        """Make the policy of the learned model, without noise."""

    @property
    def solver(self) -> str | None:
        """Name of the MPC's backend, which is the setting `backend`; None where there is no MPC."""
        return getattr(self, "backend", None)

    def check(self, minutes: float) -> None:
        """Raise if the method cannot be trained, before anything is written.

        Raises:
            InvalidInputError: the minutes of data do not fit the settings, or a solver is missing.
        """
        if self.solver is not None:
            get_backend(self.solver)

    def smoke(self) -> Self:
        """Return a copy that runs in seconds: too little of everything, see `_FEW`, to learn anything."""
        return _few(self)


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
    model: ClassVar[type[LCSModel]] = LCSModel
    learn_c: ClassVar[bool] = False

    def rebuild(
        self, task: TaskSpec, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str
    ) -> LCSModule:
        """See `Method`."""
        lcs = self.model.from_config(config, tensors, source)
        check_fits(lcs, task, source, CheckpointError)
        return lcs

    def policy(self, task: TaskSpec, learned: LCSModule) -> LCSMPCLayer:
        """See `Method`."""
        return task.make_policy(learned, single_start_backend(self.backend))

    def initial(self, work: Work) -> LCSModule:
        """Make the model to start from. Override it, with `kind` and `rebuild`, to learn a module of your own."""
        if work.init is not None:
            return work.init
        return self.model(
            work.task.n_x,
            work.task.n_u,
            self.n_lam,
            self.stiffness,
            init_scale=self.init_scale,
            learn_c=self.learn_c,
            generator=torch.Generator().manual_seed(work.seed),
        )


def check_fits(lcs: LCSModel, task: TaskSpec, source: object, error: type[Exception] = InvalidInputError) -> None:
    """Raise `error` unless a model has the sizes of the task and double precision."""
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
    """Names of the methods, in the order in which they were registered."""
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
