"""Tasks: descriptions of environments for training, evaluation and pictures. Other packages register theirs here.

A package publishes its tasks without being imported first by an entry point of the group "difflcs.tasks", a function
without arguments that registers them: docs/own_system.md makes one.
"""

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import metadata
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import gymnasium
import torch
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from difflcs import _checks
from difflcs._optional import require
from difflcs.cost import CostModule, GoalCost
from difflcs.errors import DTypeError, InvalidInputError, ShapeError
from difflcs.mpc import LCSMPCLayer
from difflcs.mpc.backends import Backend, BatchedBackend, get_backend
from difflcs.records import LCSModule

ENTRY_POINTS = "difflcs.tasks"
"""Group of entry points that register tasks."""

Features = Callable[..., Tensor]
"""States (..., n_x), goals (..., n_goal), elapsed fractions of the episode (...) → (..., n) inputs of a network.

Contexts (..., n_context) are the fourth argument where the environment gives any.
"""


def compute_features(
    features: Features, state: Tensor, goal: Tensor, elapsed: Tensor, context: Tensor | None
) -> Tensor:
    """Compute the features of states, and of their contexts if there are any; raise if they are not finite."""
    seen = (state, goal, elapsed)
    return _checks.check_tensor("features", features(*seen) if context is None else features(*seen, context))


def count_features(features: Features, *sizes: Sequence[int]) -> int:
    """Count what features return, for a state, a goal, an elapsed fraction and perhaps a context of these sizes.

    Raises:
        DTypeError, ShapeError: they take other arguments, or return no tensor (..., n).
    """
    seen = [torch.zeros(2, *size, dtype=torch.float64) for size in sizes]
    try:
        inspect.signature(features).bind(*seen)
    except TypeError as error:
        wanted = ", ".join(("state", "goal", "elapsed", "context")[: len(sizes)])
        raise DTypeError(
            f"features: expected a function ({wanted}) → (..., n), got {_checks.describe(features)}: {error}"
        ) from error
    of_two = features(*seen)
    found = _checks.check_tensor("features", of_two, finite=False)
    if found.shape[:-1] != (2,):
        raise ShapeError(f"features: expected (2, n) of two states, got {tuple(found.shape)}; return (..., n)")
    return found.shape[-1]


class Outcome(Protocol):
    """Computes reward and success of a transition, without a simulation; for arrays and tensors of any batch shape."""

    def __call__(self, state: Any, action: Any, after: Any, goal: Any, ended: Any, /) -> tuple[Any, Any]:
        """Judge transitions.

        Args:
            state: (..., n_x) before.
            action: (..., n_u) that is executed.
            after: (..., n_x) state after it.
            goal: (..., n_goal).
            ended: (...) bool, or one for all: the episode ends with this step.

        Returns:
            Reward (...) as the environment gives it, and success (...) bool: `after` is at the goal.
        """
        ...


class Quantity(NamedTuple):
    """A number with a meaning: one component of a goal, or an error that the environment reports in its info."""

    name: str
    unit: str


@dataclass(frozen=True, kw_only=True)
class PhysicsSpec:
    """Known physics of a task, for methods that start from it.

    Attributes:
        make_system: makes the `LCSModule`, a torch.nn.Module with the numbers as they are guessed, such as a
            `difflcs.physics.ContactLCS`. Called when it is needed: nothing is simulated at import.
        scale: (n_x,) sizes of errors of the states that count alike in a fit [unit of the state].
        make_cost: makes the cost that an MPC with this system plans with; None: that of the task. What is a good plan
            in a few steps depends on what the system knows; the rewards stay those of the task.
        horizon: steps that it plans ahead; None: that of the task.
        relaxation: product λ·s of its complementarity, in the units of the system; None: that of the task.
        told: description of the knowledge it has of the task, to be stated beside its results.

    Raises:
        InvalidInputError: a number does not fit.
        DTypeError: a value that is no function where one is expected.
    """

    make_system: Callable[[], Any]
    scale: tuple[float, ...]
    make_cost: Callable[[], GoalCost | CostModule] | None = None
    horizon: int | None = None
    relaxation: float | None = None
    told: str = ""

    def __post_init__(self) -> None:
        _checks.make_plain(self)
        for name in ("make_system", "make_cost"):
            value = getattr(self, name)
            if not callable(value) and not (name == "make_cost" and value is None):
                raise DTypeError(f"{name}: expected a function, got {type(value).__name__}; see difflcs.rl.PhysicsSpec")
        for value in self.scale:
            _checks.check_number("scale", value, strict=True)
        if self.horizon is not None:
            _checks.check_positive_int("horizon", self.horizon, maximum=10**6)
        if self.relaxation is not None:
            _checks.check_number("relaxation", self.relaxation, strict=True)


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """One task.

    Attributes:
        name: what it is called, on the command line too.
        summary: what is to be done, in one sentence.
        env: Gymnasium id, with its module ("my_package:Push-v0") if that registers it, or a function that makes one
            environment from keyword arguments. Observations Dict(state=Box(n_x), goal=Box(n_goal)), actions Box(n_u),
            all float64; episodes of fixed length that end by truncation; `success` in every step's info; a goal can be
            chosen by `reset(options={"goal": …})`; everything random comes from the seed of `reset`.
        env_kwargs: keyword arguments of the environment.
        make_cost: makes the cost of the MPC, whose sizes are those of the task: a `GoalCost`, or a `CostModule` with
            n_x, n_u and n_goal, such as a `MujocoCost`.
        u_min: lower bounds of the action, one number or n_u of them [units of the action].
        u_max: upper bounds of the action.
        horizon: steps that the MPC plans ahead.
        relaxation: product λ·s of the MPC's complementarity.
        episode_steps: steps of one episode.
        step_seconds: duration of one step [s].
        features: what the value network sees, scaled to about one; a function as `Features` says.
        outcome: reward and success of a transition, the environment's own; a function as `Outcome` says.
        n_context: size of the context, such as the mass of a block, that the environment gives in its observations
            Dict(state, goal, context=Box(n_context)), the same for a whole episode; 0: it gives none.
        failure_penalty: penalty within that reward in the last step of an episode without success. Nothing is
            subtracted here: PPO must know how much of that one reward is not the cost of a step, see `RewardScale`.
        goal: names and units of the components of a goal.
        errors: names and units of the errors in the environment's info, which must have all of them after an episode;
            the names end in `_error`.
        caption: the info of a step → the caption of its picture; None: the errors.
        picture: keyword arguments of the environment for pictures to be looked at, such as their size.
        example_goals: goals to show what was learned, the best one first.
        describe: environment (single or vector) → what decides whether results can be compared, in JSON types, such as
            the object and its mass. A resumed run must find the same.
        requires: import names of the packages that the environment needs.
        threaded: the vector environment takes the argument `threads`.
        model_name: what its models are called in the zoo; None: as the task.
        physics: what is known of its physics, for methods that start from it; None: nothing.

    Raises:
        InvalidInputError: a value does not fit.
        DTypeError: a value that is no function where one is expected.
    """

    name: str
    env: str | Callable[..., gymnasium.Env]
    make_cost: Callable[[], GoalCost | CostModule]
    u_min: float | Sequence[float]
    u_max: float | Sequence[float]
    horizon: int
    episode_steps: int
    step_seconds: float
    features: Features
    outcome: Outcome
    n_context: int = 0
    summary: str = ""
    env_kwargs: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}), hash=False)
    relaxation: float = 1e-5
    failure_penalty: float = 0.0
    goal: tuple[Quantity, ...] = ()
    errors: tuple[Quantity, ...] = ()
    caption: Callable[[Mapping[str, Any]], str] | None = None
    picture: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}), hash=False)
    example_goals: tuple[tuple[float, ...], ...] = ()
    describe: Callable[[Any], Mapping[str, Any]] = lambda env: {}
    requires: tuple[str, ...] = ()
    threaded: bool = False
    model_name: str | None = None
    physics: PhysicsSpec | None = None

    def __post_init__(self) -> None:
        _checks.make_plain(self)
        if not isinstance(self.name, str) or not self.name.replace("_", "").replace("-", "").isalnum():
            raise InvalidInputError(
                f"name: expected letters, digits, '-' and '_', got {self.name!r:.100}; it becomes a part of file names"
            )
        for name in ("horizon", "episode_steps"):
            _checks.check_positive_int(name, getattr(self, name), maximum=10**6)
        _checks.check_positive_int("n_context", self.n_context, minimum=0, maximum=10**6)
        for name in ("step_seconds", "relaxation"):
            _checks.check_number(name, getattr(self, name), strict=True)
        _checks.check_number("failure_penalty", self.failure_penalty)
        for name in ("env", "make_cost", "features", "outcome", "describe"):
            value = getattr(self, name)
            if isinstance(value, GoalCost) or not (callable(value) or (name == "env" and isinstance(value, str))):
                raise DTypeError(f"{name}: expected a function, got {type(value).__name__}; see difflcs.rl.TaskSpec")
        _checks.check_kind("physics", self.physics, (PhysicsSpec, type(None)), "wrap what makes the system in one")
        for name in ("u_min", "u_max"):
            if (shape := torch.as_tensor(getattr(self, name)).shape) not in ((), (1,), (self.n_u,)):
                raise InvalidInputError(
                    f"{name}: expected one number or n_u={self.n_u} of them, as the cost has actions of that size, got "
                    f"shape {tuple(shape)}; change one of them"
                )
        low, high = self.bounds
        if not bool((low < high).all()):
            raise InvalidInputError(f"u_min: expected u_min < u_max, got {self.u_min} and {self.u_max}; swap them")
        for label, names in (("goal", self.goal), *(("example_goals", one) for one in self.example_goals)):
            if names and len(names) != self.n_goal:
                raise InvalidInputError(
                    f"{label}: expected {self.n_goal} entries, as the cost has goals of that size, got {len(names)}"
                )

    # --- sizes ---

    @functools.cached_property
    def _cost(self) -> Any:
        cost = self.make_cost()
        if not all(hasattr(cost, name) for name in ("at", "n_x", "n_u", "n_goal")):
            raise DTypeError(
                f"make_cost: expected it to return a GoalCost, or a CostModule with n_x, n_u and n_goal, got "
                f"{type(cost).__name__}"
            )
        return cost

    @property
    def n_x(self) -> int:
        """Size of a state."""
        return self._cost.n_x

    @property
    def n_u(self) -> int:
        """Size of an action."""
        return self._cost.n_u

    @property
    def n_goal(self) -> int:
        """Size of a goal."""
        return self._cost.n_goal

    @functools.cached_property
    def n_features(self) -> int:
        """Number of features."""
        sizes = (self.n_x,), (self.n_goal,), (), (self.n_context,)
        return count_features(self.features, *sizes[: 3 + (self.n_context > 0)])

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds (n_u,) of the action, float64."""
        low, high = (torch.as_tensor(value, dtype=torch.float64) for value in (self.u_min, self.u_max))
        return low.expand(self.n_u).clone(), high.expand(self.n_u).clone()

    @property
    def steps_per_minute(self) -> float:
        """Environment steps in one minute of data."""
        return 60.0 / self.step_seconds

    # --- what is built for it ---

    def make_env(self, **kwargs: Any) -> gymnasium.Env:
        """Make one environment, for example with `render_mode="rgb_array"`.

        Raises:
            MissingDependencyError: a package that it needs is not installed.
            InvalidInputError: it cannot be made.
        """
        with self._making() as arguments:
            make = functools.partial(gymnasium.make, self.env) if isinstance(self.env, str) else self.env
            return make(**arguments, **kwargs)

    def make_envs(self, count: int, threads: int | None = None) -> VectorEnv:
        """Make a vector of environments, stepped in lockstep.

        Args:
            count: how many.
            threads: most threads that step them, if the task knows that; None: its default.

        Raises:
            MissingDependencyError: a package that it needs is not installed.
            InvalidInputError: they cannot be made, or would clip actions within the bounds of the task.
        """
        with self._making() as arguments:
            if not isinstance(self.env, str):
                envs: VectorEnv = gymnasium.vector.SyncVectorEnv([functools.partial(self.env, **arguments)] * count)
            else:
                if self.threaded and threads is not None:
                    arguments["threads"] = threads
                envs = gymnasium.make_vec(self.env, num_envs=count, **arguments)
        return self.narrow(envs)

    def narrow(self, envs: VectorEnv) -> VectorEnv:
        """Make the bounds of the task the action space of environments, which are closed if they do not fit.

        So nothing is executed beyond the bounds: no random action, and no noise.
        """
        try:
            space: Any = self._check_spaces(envs.single_observation_space, envs.single_action_space)
        except InvalidInputError:
            envs.close()
            raise
        envs.single_action_space, envs.action_space = space, batch_space(space, envs.num_envs)
        return envs

    def _check_spaces(self, seen: Any, space: Any) -> Any:
        """Return the space of actions within the bounds.

        Raises:
            InvalidInputError: spaces of the environment have other sizes, or it would clip the planned actions.
        """
        shapes = {name: one.shape for name, one in getattr(seen, "spaces", {}).items()}
        for name, size in (("state", self.n_x), ("goal", self.n_goal)):
            if shapes.get(name) != (size,):
                raise InvalidInputError(
                    f"task {self.name}: expected an environment whose observations are a Dict with a {name} of shape "
                    f"({size},), as the cost has {name}s of that size, got {seen}; change one of them"
                )
        if (found := shapes.get("context", (0,))) != (self.n_context,):
            raise InvalidInputError(
                f"task {self.name}: expected n_context={found[-1]}, the size of the context in the observations of its "
                f"environment, or 0 without one, got {self.n_context}; change one of them"
            )
        if getattr(space, "shape", None) != (self.n_u,) or not hasattr(space, "low"):
            raise InvalidInputError(
                f"task {self.name}: expected an environment whose action space is a Box of shape ({self.n_u},), as the "
                f"cost has actions of that size, got {space}; change one of them"
            )
        (low, high), margin = self.bounds, 1e-6  # a Box often has 32 bits
        least, most = (torch.as_tensor(value, dtype=torch.float64) for value in (space.low, space.high))
        if bool((low < least - margin * least.abs()).any() or (high > most + margin * most.abs()).any()):
            raise InvalidInputError(
                f"task {self.name}: expected u_min and u_max within the action space of its environment, which clips "
                f"what is outside, got {low.tolist()} to {high.tolist()} and {least.tolist()} to {most.tolist()}; "
                f"narrow the bounds, or widen the space"
            )
        low, high = (bound.clamp(least, most).numpy().astype(space.dtype) for bound in self.bounds)
        return type(space)(low, high, dtype=space.dtype)

    @contextmanager
    def _making(self) -> Iterator[dict[str, Any]]:
        require("gymnasium", *self.requires)
        try:
            yield dict(self.env_kwargs)
        except Exception as error:  # whatever an environment of others may raise
            raise InvalidInputError(
                f"task {self.name}: its environment cannot be made: {type(error).__name__}: {error}"
            ) from error

    def make_policy(
        self, lcs: LCSModule, backend: str | Backend = "batched", plan: PhysicsSpec | None = None
    ) -> LCSMPCLayer:
        """Make the MPC around a model; unsolved elements are masked, never raised, so that they cannot end a training.

        It has cost, horizon and relaxation of the task, or those of `plan` where that has any.
        """
        low, high = self.bounds
        return LCSMPCLayer(
            lcs,
            ((plan and plan.make_cost) or self.make_cost)(),
            horizon=(plan and plan.horizon) or self.horizon,
            u_min=low,
            u_max=high,
            backend=backend,
            relaxation=(plan and plan.relaxation) or self.relaxation,
            on_failure="mask",
        )

    def say(self, info: Mapping[str, Any]) -> str:
        """Return the caption of a step in a picture: that of the task, else the errors in the info."""
        if self.caption is not None:
            return self.caption(info)
        known = [(q, info[q.name]) for q in self.errors if q.name in info]
        return ", ".join(f"{q.name.replace('_', ' ')} {float(value):.3g} {q.unit}".strip() for q, value in known)


def single_start_backend(name: str) -> Backend:
    """Return a solver by its name as trainings use it: `batched` tries one start, along a short homotopy.

    With three starts it finds another plan in one state of seven and takes twice as long. Learning follows the plans of
    one start, and plans that jump from optimum to optimum when the system changes a little teach little.
    """
    backend = get_backend(name)
    if isinstance(backend, BatchedBackend):
        return replace(backend, restarts=1, homotopy=backend.homotopy or 100.0)
    return backend


# --- registry ---------------------------------------------------------------------------------------------------------

_REGISTRY: dict[str, TaskSpec] = {}
_INSTALLED: set[str] = set()
"""Names of those of installed packages, which every program knows."""
_FAILED: dict[str, str] = {}
"""Entry points that could not be loaded → why."""


def register_task(spec: TaskSpec) -> TaskSpec:
    """Make a task available under its name, in place of one of that name.

    Raises:
        DTypeError: not a `TaskSpec`.
    """
    _checks.check_kind("spec", spec, TaskSpec)
    _REGISTRY[spec.name] = spec
    return spec


@functools.cache
def _load_entry_points() -> None:
    registered = dict(_REGISTRY)  # registered in this program: what is installed does not replace it
    for entry in metadata.entry_points(group=ENTRY_POINTS):
        try:
            entry.load()()
        except Exception as error:  # a broken package of others must not take the rest with it
            _FAILED[f"{entry.name} = {entry.value}"] = f"{type(error).__name__}: {error}"
    _INSTALLED.update(name for name, spec in _REGISTRY.items() if registered.get(name) is not spec)
    _REGISTRY.update(registered)


def task_names() -> tuple[str, ...]:
    """Names of all tasks, those of installed packages first."""
    _load_entry_points()
    return tuple(_REGISTRY)


def is_installed(task: str) -> bool:
    """Tell whether a task is one of an installed package, or one that this program alone has registered."""
    _load_entry_points()
    return task in _INSTALLED


def get_task(task: str | TaskSpec) -> TaskSpec:
    """The task itself, or the registered one of that name.

    Raises:
        InvalidInputError: no task has this name.
    """
    if isinstance(task, TaskSpec):
        return task
    known = task_names()
    if task not in known:
        failed = "".join(f"; the entry point {name} could not be loaded: {why}" for name, why in _FAILED.items())
        raise InvalidInputError(
            f"task: expected one of {', '.join(known) or 'no tasks'}, got {task!r:.200}"
            f"{_checks.did_you_mean(task, known)}; add your own with difflcs.rl.register_task{failed}"
        )
    return _REGISTRY[task]
