"""Episodes of a Gymnasium `VectorEnv`, stepped in lockstep."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from torch import Tensor

from difflcs.errors import InvalidInputError, SolveWarning

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv


class Solution(Protocol):
    """What is needed of an `MPCSolution`."""

    @property
    def action(self) -> Tensor:
        """(B, n_u) first actions."""
        ...

    @property
    def converged(self) -> Tensor:
        """(B,) bool."""
        ...


class Policy(Protocol):
    """What is needed of an `LCSMPCLayer`: (B, n_x) states, (B, n_goal) goals, optional bounds (n_u,) → a solution."""

    def __call__(self, x0: Tensor, goal: Tensor, *, u_min: Tensor | None, u_max: Tensor | None) -> Solution:
        """Solve a batch."""
        ...


Act = Callable[[Tensor, Tensor], tuple[np.ndarray, int]]
"""States (B, n_x), goals (B, n_goal) → actions (B, n_u) and the number of failed solves."""


@dataclass(frozen=True)
class Rollouts:
    """Complete episodes.

    Attributes:
        states: (N, T+1, n_x) observed states, the reset's first.
        actions: (N, T, n_u) executed actions.
        rewards: (N, T) rewards, without the info's "reward_completion" (the penalty for an episode that fails).
        goals: (N, n_goal).
        success: (N,) bool: at the goal after the last step.
        errors: name → (N,) errors after the last step, such as "position_error" [m] and "yaw_error" [rad].
        stable: (N,) bool: False where the simulation broke down (NaN, or info "physics_error"); never a success.
        solver_failures: failed solves.
    """

    states: Tensor
    actions: Tensor
    rewards: Tensor
    goals: Tensor
    success: Tensor
    errors: dict[str, Tensor]
    stable: Tensor
    solver_failures: int


def episode_seeds(seed: int, stream: int, first: int, count: int) -> list[int]:
    """Reset seeds of the episodes first … first + count − 1 of one stream.

    Every episode has its own seed, so that nothing of an environment has to be stored to resume a run, and the first
    goals of an evaluation are the same whatever its size or number of environments.
    """
    return [int(np.random.SeedSequence((seed, stream, i)).generate_state(1)[0]) for i in range(first, first + count)]


def action_bounds(env: VectorEnv) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (n_u,) of the action space, float64."""
    space = env.single_action_space
    return np.asarray(space.low, np.float64), np.asarray(space.high, np.float64)  # pyright: ignore[reportAttributeAccessIssue]


def mpc_actions(policy: Policy, u_min: Tensor | None = None, u_max: Tensor | None = None, seed: int = 0) -> Act:
    """Act with the MPC, solved cold; None keeps the policy's own bounds. Failed elements act by its masked output.

    For one call of `collect`: a planner with a memory or noise of its own has a method `begin(seed)`, called here.
    """
    begin = getattr(policy, "begin", None)
    if begin is not None:
        begin(seed)

    def act(state: Tensor, goal: Tensor) -> tuple[np.ndarray, int]:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore", SolveWarning)  # failures are counted and reported instead
            solution = policy(state, goal, u_min=u_min, u_max=u_max)
        return solution.action.numpy(), int((~solution.converged).sum())

    return act


def uniform_actions(env: VectorEnv, rng: np.random.Generator) -> Act:
    """Act uniformly at random within the action space."""
    low, high = action_bounds(env)
    return lambda state, goal: (rng.uniform(low, high, (len(state), len(low))), 0)


def noisy_actions(act: Act, std: float, rng: np.random.Generator) -> Act:
    """Add Gaussian noise of standard deviation `std` [m] to actions."""

    def noisy(state: Tensor, goal: Tensor) -> tuple[np.ndarray, int]:
        action, failures = act(state, goal)
        return action + std * rng.standard_normal(action.shape), failures

    return noisy


def collect(
    env: VectorEnv,
    act: Act,
    seeds: Sequence[int],
    episode_steps: int,
    after_step: Callable[[], object] | None = None,
) -> Rollouts:
    """Run one episode per seed, in lockstep.

    Args:
        env: vector of environments with observation Dict(state, goal) and info "success"; at least as many as seeds.
        act: chooses actions; they are clipped into the action space before they are executed and stored.
        seeds: reset seed of each episode; the environment draws the initial state and the goal from it.
        episode_steps: T, the length of every episode.
        after_step: called after every step.

    Returns:
        One episode per seed.

    Raises:
        InvalidInputError: too many seeds, an episode of another length, or observations that autoreset overwrites.
    """
    n = len(seeds)
    if not 1 <= n <= env.num_envs:
        raise InvalidInputError(f"seeds: expected 1 to num_envs={env.num_envs} of them, got {n}")
    mode = getattr(env.metadata.get("autoreset_mode"), "value", None)
    if mode != "NextStep":  # SameStep hides the last observation, Disabled cannot step beyond a broken episode
        raise InvalidInputError(
            f"env: expected a VectorEnv with autoreset mode NextStep, got {mode}; see gymnasium.make_vec"
        )
    low, high = action_bounds(env)
    # A full reset with seeds clears Gymnasium's autoreset flags; surplus environments repeat the last episode, idle.
    padded = [*seeds, *[seeds[-1]] * (env.num_envs - n)]
    observation, _ = env.reset(seed=padded)  # pyright: ignore[reportArgumentType]  Gymnasium's vectors take a list
    state, goal = (np.array(observation[key][:n], np.float64) for key in ("state", "goal"))
    stable = np.asarray(np.isfinite(state).all(-1))
    states, executed, rewards, failures = [state], [], [], 0
    infos: dict = {}
    for t in range(episode_steps):
        usable = np.where(stable[:, None], state, 0.0)  # a solver must not see NaN
        action, failed = act(torch.from_numpy(usable), torch.from_numpy(goal))
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
        completion = infos.get("reward_completion", np.zeros(env.num_envs))
        rewards.append((np.asarray(reward, np.float64) - np.asarray(completion, np.float64))[:n])
        ended: np.ndarray = np.asarray(terminated, bool)[:n] | np.asarray(truncated, bool)[:n]
        if bool(((ended != (t + 1 == episode_steps)) & stable).any()):
            length = f"one of {t + 1}" if t + 1 < episode_steps else "a longer one"
            raise InvalidInputError(f"episode_steps: expected episodes of {episode_steps} steps, got {length}")
        if after_step is not None:
            after_step()
    if "success" not in infos and stable.any():
        raise InvalidInputError(f"env: expected `success` in the info of a step, got {sorted(infos)}")
    errors = {k: torch.from_numpy(np.asarray(v[:n], np.float64)) for k, v in infos.items() if k.endswith("error")}
    return Rollouts(
        states=torch.from_numpy(np.stack(states, 1)),
        actions=torch.from_numpy(np.stack(executed, 1)),
        rewards=torch.from_numpy(np.stack(rewards, 1)),
        goals=torch.from_numpy(goal),
        success=torch.from_numpy(np.asarray(infos.get("success", stable), bool)[:n] & stable),
        errors=errors,
        stable=torch.from_numpy(stable),
        solver_failures=failures,
    )
