"""Episodes of a Gymnasium `VectorEnv`, stepped in lockstep, in one record for all methods."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import check_positive_int, describe, to_tensor
from difflcs.constraints import StageBounds
from difflcs.errors import DegenerateWarning, DTypeError, InvalidInputError, NonFiniteError, SolveWarning

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv
    from tensordict import TensorDict

TRANSITIONS = ("state", "action", "goal")
"""Keys of the episodes that are kept to learn from, besides `CONTEXT` if the environment has one."""
CONTEXT = "context"
"""Key of the quantities that the system depends on besides its state, constant in an episode: a mass, a gain."""


@dataclass(frozen=True)
class PolicyOutput:
    """Output of policies without a solver.

    Attributes:
        action: (B, n_u) first actions.
        converged: (B,) True: there is nothing that could fail.
    """

    action: Tensor
    converged: Tensor


class Policy(Protocol):
    """Maps states (B, n_x), goals (B, n_goal) and optional bounds (n_u,) to plans, as an `LCSMPCLayer` does.

    A context (B, n_context), if the environment has one, is passed by the keyword `context`. A function or module that
    takes no bounds is a policy, too; and so is one that returns actions (B, n_u), also as a NumPy array.
    """

    def __call__(self, x0: Tensor, goal: Tensor, *, u_min: Tensor | None, u_max: Tensor | None) -> Any:
        """Return something with an `action` (B, n_u) and `converged` (B,) bool, or actions."""
        ...


def _takes_bounds(policy: Any) -> bool:
    """Return whether a policy takes bounds; raise unless it can be called with states and goals."""
    try:
        taken = inspect.signature(getattr(policy, "forward", policy))
        taken.bind_partial(None, None)
    except TypeError as error:
        raise DTypeError(f"policy: expected a function of states and goals, got {describe(policy)}: {error}") from error
    return any(p.name == "u_min" or p.kind is p.VAR_KEYWORD for p in taken.parameters.values())


Act = Callable[..., tuple[np.ndarray, np.ndarray]]
"""States (B, n_x), goals (B, n_goal) → actions (B, n_u) and, for each, True if its solve failed (B,).

A context (B, n_context), if the environment has one, is the third argument.
"""


def action_bounds(env: VectorEnv, policy: object = None) -> tuple[Tensor, Tensor]:
    """Return the bounds (n_u,) of the action space, float64, within those of a policy that has its own.

    Of bounds by stage those of the first are meant, as its action is executed; of one for each element the widest.
    """
    space: Any = env.single_action_space
    low, high = (torch.from_numpy(np.asarray(bound, np.float64)) for bound in (space.low, space.high))
    staged = getattr(policy, "bounds", None)
    own: list[Any] = [getattr(policy, name, None) for name in ("u_min", "u_max")]
    if isinstance(staged, StageBounds):
        own = [bound[..., 0, :] for bound in staged.by_steps()]
    if all(isinstance(bound, Tensor) and bound.shape[-1:] == low.shape for bound in own):
        least, most = (bound.detach().double().cpu().reshape(-1, len(low)) for bound in own)
        low, high = least.amin(0).clamp(low, high), most.amax(0).clamp(low, high)
    return low, high


def check_env(env: object) -> Any:
    """Raise unless an environment is a vector of some with observations Dict(state, goal)."""
    space = getattr(env, "single_observation_space", None)
    if not {"state", "goal"} <= {*getattr(space, "keys", tuple)()}:
        raise InvalidInputError(
            f"env: expected a VectorEnv with observations Dict(state, goal), got {describe(env)}, of {space}; use "
            "gymnasium.vector.SyncVectorEnv([make] * 10), of environments with such observations"
        )
    return env


def elapsed_fractions(episode_steps: int) -> Tensor:
    """(T + 1,) fraction of the episode that has passed at each state, from 0 to 1."""
    return torch.linspace(0, 1, episode_steps + 1, dtype=torch.float64)


@contextmanager
def ignore_solver_warnings() -> Iterator[None]:
    """Ignore the solver's warnings: failures are counted and reported instead."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SolveWarning)
        warnings.simplefilter("ignore", DegenerateWarning)
        yield


def mpc_actions(policy: Policy, u_min: Tensor | None = None, u_max: Tensor | None = None, seed: int = 0) -> Act:
    """Act with the MPC, solved cold, within its own bounds where None. Failed elements act by its masked output.

    For one call of `collect`: a planner that has memory or draws noise has a method `begin(seed)`, called here.
    """
    actor: Any = policy
    actor = actor.controller if hasattr(actor, "learned") else actor  # the mean of a Gaussian
    if hasattr(actor, "begin"):
        actor.begin(seed)
    bounds: Any = {"u_min": u_min, "u_max": u_max} if _takes_bounds(actor) else {}
    if not bounds and not (u_min is u_max is None):
        raise InvalidInputError("u_min, u_max: expected none with a policy that takes none, got some; clip its actions")

    def act(state: Tensor, goal: Tensor, context: Tensor | None = None) -> tuple[np.ndarray, np.ndarray]:
        keywords: Any = bounds if context is None else {**bounds, CONTEXT: context}
        with torch.no_grad(), ignore_solver_warnings():
            found: Any = to_tensor(actor(state, goal, **keywords))
        if hasattr(found, "converged"):
            return found.action.numpy(), (~found.converged).numpy()
        if not isinstance(found, Tensor) or found.shape[:-1] != state.shape[:1]:
            wanted = f"plans or actions ({len(state)}, n_u)"
            raise DTypeError(
                f"policy: expected it to return {wanted}, got {describe(found)}; return one for each state"
            )
        return found.double().numpy(), np.zeros(len(state), bool)

    return act


def uniform_actions(env: VectorEnv, rng: np.random.Generator, policy: object = None) -> Act:
    """Act uniformly at random within `action_bounds`."""
    low, high = (bound.numpy() for bound in action_bounds(env, policy))
    return lambda state, *_: (rng.uniform(low, high, (len(state), len(low))), np.zeros(len(state), bool))


def noisy_actions(act: Act, std: float, rng: np.random.Generator) -> Act:
    """Add Gaussian noise of standard deviation `std` [units of the action] to actions."""

    def noisy(*observed: Tensor) -> tuple[np.ndarray, np.ndarray]:
        action, failed = act(*observed)
        return action + std * rng.standard_normal(action.shape), failed

    return noisy


def collect(
    env: VectorEnv,
    act: Act,
    seeds: Sequence[int],
    episode_steps: int,
    after_step: Callable[[], object] | None = None,
    policy: object = None,
) -> TensorDict:
    """Run one episode per seed, in lockstep.

    Args:
        env: vector of environments with observation Dict(state, goal), or Dict(state, goal, context), and info
            "success"; at least as many as seeds.
        act: chooses actions; they are clipped into the `action_bounds` of env and policy, then executed and stored.
        seeds: reset seed of each episode; the environment draws the initial state and the goal from it.
        episode_steps: T, the length of every episode.
        after_step: called after every step.
        policy: has bounds that hold besides those of the action space, as an `LCSMPCLayer` may.

    Returns:
        One episode per seed:

        | key | shape | |
        |-----|-------|-|
        | "state" | (N, T+1, n_x) | observed, the reset's first |
        | "action" | (N, T, n_u) | executed |
        | "reward" | (N, T) | as the environment gave it |
        | "goal" | (N, n_goal) | |
        | "context" | (N, n_context) | where the environment gives one |
        | "success" | (N,) bool | at the goal after the last step |
        | "stable" | (N,) bool | False where the simulation broke down (NaN, or info "physics_error"): no success |
        | "failures" | (N,) int | failed solves |
        | ("errors", name) | (N,) | what remains after the last step, of each entry of the info that ends in `_error` |

    Raises:
        InvalidInputError: too many seeds, or negative ones, an episode of another length, observations that autoreset
            overwrites, a context that changes during an episode, a reward that is not finite, or a success that is no
            bool.
        DTypeError: actions of another size than the action space, or a policy in place of `mpc_actions(policy)`.
    """
    from tensordict import TensorDict  # takes a second

    if isinstance(act, torch.nn.Module) or not callable(act):
        raise DTypeError(f"act: expected a function of state and goal, got {type(act).__name__}; use mpc_actions(act)")
    seeds = [check_positive_int("seeds", seed, minimum=0) for seed in seeds]
    n = len(seeds)
    _check_env(env, n)
    low, high = (bound.numpy() for bound in action_bounds(env, policy))
    # A full reset with seeds clears Gymnasium's autoreset flags; surplus environments repeat the last episode, idle.
    padded = [*seeds, *[seeds[-1]] * (env.num_envs - n)]
    observation, _ = env.reset(seed=padded)  # pyright: ignore[reportArgumentType]  Gymnasium's vectors take a list
    state, goal = (np.array(observation[key][:n], np.float64) for key in ("state", "goal"))
    context = np.array(observation[CONTEXT][:n], np.float64) if CONTEXT in observation else None
    constant = [torch.from_numpy(value) for value in (goal, context) if value is not None]
    stable = np.asarray(np.isfinite(state).all(-1))
    states, executed, rewards, failures = [state], [], [], np.zeros(n, np.int64)
    infos: dict = {}
    for t in range(episode_steps):
        usable = np.where(stable[:, None], state, 0.0)  # a solver must not see NaN
        action, failed = act(torch.from_numpy(usable), *constant)
        if action.shape != (n, len(low)):
            wanted = f"({n}, n_u={len(low)}), as the action space has them"
            raise DTypeError(f"policy: expected actions {wanted}, got {action.shape}; return all numbers of each")
        action = np.clip(action, low, high)
        batch = np.zeros((env.num_envs, len(low)))
        batch[:n] = action
        observation, reward, terminated, truncated, infos = env.step(batch)
        state = np.array(observation["state"][:n], np.float64)
        broken = np.asarray(infos.get("physics_error", np.zeros(env.num_envs)), bool)[:n]
        stable &= np.isfinite(state).all(-1) & ~broken
        failures += failed
        states.append(state)
        executed.append(action)
        rewards.append(np.array(reward, np.float64)[:n])
        if len(bad := rewards[-1][stable & ~np.isfinite(rewards[-1])]):
            raise NonFiniteError(f"env: expected finite rewards, got {bad[0]} in step {t + 1}; bound what it can be")
        ended: np.ndarray = np.asarray(terminated, bool)[:n] | np.asarray(truncated, bool)[:n]
        if bool(((ended != (t + 1 == episode_steps)) & stable).any()):
            length = f"one of {t + 1}" if t + 1 < episode_steps else "a longer one"
            raise InvalidInputError(
                f"episode_steps: expected episodes of {episode_steps} steps, got {length}; pass their number"
            )
        if context is not None and (np.asarray(observation[CONTEXT])[:n] != context)[stable].any():
            raise InvalidInputError(
                f"env: expected the same context in a whole episode, got another in step {t + 1}; what changes belongs "
                f"into the state"
            )
        if after_step is not None:
            after_step()
    if "success" not in infos and stable.any():
        raise InvalidInputError(f"env: expected `success` in the info of a step, got {sorted(infos)}")
    success = np.array([_success(one) for one in infos.get("success", stable)[:n]], bool) & stable
    reported = (k for k in infos if k.endswith("_error") and not k.startswith("_") and k != "physics_error")
    errors = {k: torch.from_numpy(np.asarray(infos[k][:n], np.float64)) for k in reported}
    record: dict[str, Any] = {
        "state": torch.from_numpy(np.stack(states, 1)),
        "action": torch.from_numpy(np.stack(executed, 1)),
        "reward": torch.from_numpy(np.stack(rewards, 1)),
        "goal": torch.from_numpy(goal),
        "success": torch.from_numpy(success),
        "stable": torch.from_numpy(stable),
        "failures": torch.from_numpy(failures),
        "errors": TensorDict(errors, [n]),  # pyright: ignore[reportArgumentType]
    }
    if context is not None:
        record[CONTEXT] = torch.from_numpy(context)
    return TensorDict(record, [n])


def _success(value: object) -> bool:
    """Return the `success` of an info; None if it has none."""
    if not (value is None or (isinstance(value, bool | int | float | np.bool_ | np.number) and value in (0, 1))):
        raise InvalidInputError(
            f"env: expected True or False as `success` in the info, got {describe(value)}; see `collect`"
        )
    return bool(value)


def _check_env(env: VectorEnv, episodes: int) -> None:
    if not 1 <= episodes <= check_env(env).num_envs:
        raise InvalidInputError(f"seeds: expected 1 to num_envs={env.num_envs} of them, got {episodes}")
    mode = getattr(env.metadata.get("autoreset_mode"), "value", None)
    if mode != "NextStep":  # SameStep hides the last observation, Disabled cannot step beyond a broken episode
        raise InvalidInputError(
            f"env: expected a VectorEnv with autoreset mode NextStep, got {mode}; see gymnasium.make_vec"
        )


def make_empty_record(env: VectorEnv, episode_steps: int) -> TensorDict:
    """Make a record of `TRANSITIONS`, and of the context if there is one, for an environment, without episodes yet."""
    from tensordict import TensorDict

    space: Any = env.single_observation_space
    n_x, n_u = space["state"].shape[0], env.single_action_space.shape[0]  # pyright: ignore[reportOptionalSubscript]
    sizes = ((episode_steps + 1, n_x), (episode_steps, n_u), space["goal"].shape)
    shapes: dict[str, Any] = dict(zip(TRANSITIONS, sizes, strict=True))
    if has_context(env):
        shapes[CONTEXT] = space[CONTEXT].shape
    empty = {name: torch.zeros(0, *size, dtype=torch.float64) for name, size in shapes.items()}
    return TensorDict(empty, [0])  # pyright: ignore[reportArgumentType]


def append_episodes(known: TensorDict, episodes: TensorDict, keep: int | None = None) -> TensorDict:
    """Append episodes to a record of `TRANSITIONS`, without those marked as not stable.

    Args:
        known: a record of `TRANSITIONS`.
        episodes: another, or one of `collect`.
        keep: newest episodes to keep; None: all.

    Raises:
        InvalidInputError: there is no episode in either.
    """
    stable = episodes[episodes["stable"]] if "stable" in episodes.keys() else episodes
    names = _stored_keys(known)
    record: Any = torch.cat([known, stable.select(*names)])  # pyright: ignore[reportCallIssue, reportArgumentType]
    if not len(record):
        raise InvalidInputError("env: expected a stable simulation, got NaN or a physics error in every episode")
    return record if keep is None else record[-keep:]


def episodes_to_state(episodes: TensorDict) -> dict[str, Tensor]:
    """Return a record of `TRANSITIONS` as a part of a state, see `difflcs.rl.learning.state_tree`."""
    return {name: episodes[name] for name in _stored_keys(episodes)}


def _stored_keys(episodes: TensorDict) -> list[str]:
    return [name for name in (*TRANSITIONS, CONTEXT) if name in episodes.keys()]


def episodes_from_state(state: Mapping[str, Tensor]) -> TensorDict:
    """Rebuild a record from what `episodes_to_state` returned."""
    from tensordict import TensorDict

    return TensorDict(dict(state), [len(state["state"])])  # pyright: ignore[reportArgumentType]


def transitions(episodes: TensorDict) -> tuple[Tensor, Tensor, Tensor]:
    """Return the states (N·T, n_x), actions (N·T, n_u) and next states (N·T, n_x) of a record of episodes."""
    state = episodes["state"]
    return state[:, :-1].flatten(0, 1), episodes["action"].flatten(0, 1), state[:, 1:].flatten(0, 1)


def windows(states: Tensor, actions: Tensor, length: int) -> tuple[Tensor, Tensor]:
    """Cut all windows (M, length + 1, n_x), (M, length, n_u) out of episodes (N, T + 1, n_x), (N, T, n_u)."""
    return states.unfold(1, length + 1, 1).mT.flatten(0, 1), actions.unfold(1, length, 1).mT.flatten(0, 1)


def contexts(episodes: TensorDict) -> Tensor | None:
    """Return the contexts (N·T, n_context) of the `transitions` of a record of episodes; None if it has none."""
    if CONTEXT not in episodes.keys():
        return None
    return episodes[CONTEXT].unsqueeze(1).expand(-1, episodes["action"].shape[1], -1).flatten(0, 1)


def observed_transitions(episodes: TensorDict) -> tuple[Tensor, Tensor, Tensor]:
    """Return `transitions` for networks: the contexts, if there are any, are appended to the states."""
    (state, action, after), context = transitions(episodes), contexts(episodes)
    return append_context(state, context), action, append_context(after, context)


def append_context(state: Tensor, context: Tensor | None) -> Tensor:
    """Append the contexts to states (..., n_x), for networks: (..., n_x + n_context)."""
    return state if context is None else torch.cat([state, context], -1)


def has_context(env: VectorEnv) -> bool:
    """Return True if the observations of an environment have a context."""
    space: Any = env.single_observation_space
    return CONTEXT in space.keys()
