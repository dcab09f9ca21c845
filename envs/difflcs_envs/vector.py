"""The TriFinger tasks as Gymnasium vector environments: N simulations, stepped in native threads without the GIL.

`gymnasium.make_vec("difflcs/TriFingerMoveCube-v0", num_envs=N)` makes one of these. Environment i of it does what a
single environment with the same seed and actions does, bit for bit.
"""

import functools
import os
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space

from difflcs_envs.checks import checked_array, checked_integer, checked_options
from difflcs_envs.errors import PhysicsWarning
from difflcs_envs.trifinger.base import UNSTABLE, TriFingerEnv
from difflcs_envs.trifinger.env import TriFingerMoveCubeEnv, TriFingerMoveObjectEnv, TriFingerTurnCubeEnv
from difflcs_envs.trifinger.physics import CONTROL_PERIOD, STATE_SIZE, step_all
from difflcs_envs.trifinger.spaces import ACTION_MEANING, continued
from difflcs_envs.trifinger.task import ACTION_LIMIT, ACTION_SIZE, GOAL_SIZE


class TriFingerVectorEnv(VectorEnv[dict[str, np.ndarray], np.ndarray, np.ndarray]):
    """N copies of one TriFinger environment.

    The info arrays have one entry per environment: `success`, `position_error` [m], `yaw_error` [rad], after `step`
    also every term of the reward, `executed_action`, `clipped`, `physics_error`. Entries of environments that have none
    in this step are 0, and `info["_success"]` and so on say which have one, as everywhere in Gymnasium.

    What happens to an environment whose episode has ended (`autoreset_mode`):

    - NEXT_STEP: the next `step` ignores its action and resets it (reward 0). The observation returned at the end of an
      episode is the last one of that episode.
    - DISABLED: `reset(options={"reset_mask": mask})` must be called before the next `step`.

    With SAME_STEP, `gymnasium.make_vec` gives Gymnasium's own `SyncVectorEnv`, which steps them one by one.

    Attributes:
        envs: The single environments. They share one MuJoCo model.
        threads: Most threads that step them.
    """

    metadata: ClassVar[dict[str, Any]] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        **TriFingerEnv.metadata,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        env: TriFingerEnv,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
    ) -> None:
        """Multiply an environment.

        Args:
            env: The first of the environments. It belongs to this object from now on.
            num_envs: Number of environments.
            autoreset_mode: See the class.
            threads: Most threads that step them; None: one per CPU core.
        """
        self.num_envs = checked_integer("num_envs", num_envs)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            raise ValueError("Expected autoreset_mode NEXT_STEP or DISABLED, got SAME_STEP. Use gymnasium.make_vec.")
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}  # pyright: ignore[reportAttributeAccessIssue]
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.threads = cores if threads is None else checked_integer("threads", threads)
        self.envs = [env, *(env.sibling() for _ in range(self.num_envs - 1))]
        self.render_mode = env.render_mode
        self.single_observation_space = env.observation_space
        self.single_action_space = env.action_space
        self.observation_space = batch_space(env.observation_space, self.num_envs)
        self.action_space = batch_space(env.action_space, self.num_envs)
        self._states = np.zeros((self.num_envs, STATE_SIZE))
        self._goals = np.zeros((self.num_envs, GOAL_SIZE))
        self._steps = np.zeros(self.num_envs, dtype=np.int64)
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._began = False

    # --- Gymnasium --------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode in every environment.

        Args:
            seed: One seed per environment; a number s stands for s, s + 1, ...; None goes on with the current ones.
            options: `goal` and `state` as for a single environment, for all of them; `reset_mask` (num_envs,) bool:
                which to reset, the others stay as they are.

        Returns:
            Observations and infos.

        Raises:
            ValueError: The seeds, the mask or another option cannot be used.
        """
        seeds = self._seeds(seed)
        options = checked_options(options)
        mask = self._mask(options.pop("reset_mask", None))
        indices = np.flatnonzero(mask).tolist()
        for i in indices:
            self._reset_one(i, seeds[i], options)
        self._began = self._began or bool(mask.all())
        return self._observations(), self._masked(self._pose_info(), mask)

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Move the fingertips of every environment for 0.1 s.

        Args:
            actions: Displacements of the fingertips [m], (num_envs, 6).

        Returns:
            Observations, rewards, terminations (all False), truncations, infos.

        Raises:
            ValueError: The actions have the wrong shape or are not finite.
            gymnasium.error.ResetNeeded: There was no reset, or (mode DISABLED) an episode has ended.
        """
        requested = checked_array("actions", actions, (self.num_envs, ACTION_SIZE), ACTION_MEANING)
        if not self._began or (self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any()):
            raise ResetNeeded(
                "Expected a running episode in every environment, but some have ended or never began. Call reset() "
                "before step()."
            )
        fresh = self._ended.copy()  # these are reset instead of stepped
        for i in np.flatnonzero(fresh).tolist():
            self._reset_one(i, None, {})
        moving = np.flatnonzero(~fresh)
        executed = requested.clip(-ACTION_LIMIT, ACTION_LIMIT)
        before = self._states.copy()
        results = step_all([self.envs[i].physics for i in moving], executed[moving], self.threads)
        unstable = np.zeros(self.num_envs, dtype=bool)
        for i, after in zip(moving, results, strict=True):
            if after is None:
                unstable[i] = True
            else:
                self._states[i] = continued(before[i], after)
        self._steps[moving] += 1
        truncated = ~fresh & ((self._steps >= self.envs[0].horizon) | unstable)

        rewards, info = self.envs[0].task.outcome(before, executed, self._states, self._goals, truncated)
        info |= {"executed_action": executed, "clipped": (executed != requested).any(axis=1), "physics_error": unstable}
        if fresh.any():
            rewards = np.where(fresh, 0.0, rewards)
        infos = self._masked(info, np.ones(self.num_envs, dtype=bool), only=~fresh)
        self._ended = truncated.copy()
        if unstable.any():
            warnings.warn(
                f"{UNSTABLE} (environments {np.flatnonzero(unstable).tolist()})", PhysicsWarning, stacklevel=2
            )
        return self._observations(), rewards, np.zeros(self.num_envs, dtype=bool), truncated, infos

    def render(self) -> tuple[np.ndarray | None, ...] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw a picture of every environment; None without render mode."""
        if self.render_mode is None:
            return None
        return tuple(env.render() for env in self.envs)

    def close_extras(self, **kwargs: Any) -> None:
        """Free renderers and windows."""
        for env in self.envs:
            env.close()

    # --- copies -----------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        members = self.__dict__.copy()
        first, *others = self.envs
        members["envs"] = first, [env.get_full_state() for env in others]
        return members

    def __setstate__(self, members: dict[str, Any]) -> None:
        self.__dict__.update(members)
        first, others = members["envs"]
        self.envs = [first]
        for full_state in others:
            env = first.sibling()
            env.set_full_state(full_state)
            self.envs.append(env)

    # --- helpers ----------------------------------------------------------------------------------

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None or isinstance(seed, int | np.integer):
            return [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        try:
            seeds = [None if s is None else int(s) for s in seed]
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"Expected a seed as a whole number, {self.num_envs} of them, or None, got {seed!r:.100}. Pass seed=0."
            ) from error
        if len(seeds) != self.num_envs:
            raise ValueError(f"Expected {self.num_envs} seeds, one per environment, got {len(seeds)}. Pass as many.")
        return seeds

    def _mask(self, mask: Any) -> np.ndarray:
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(
                f"Expected options['reset_mask'] as {self.num_envs} booleans, at least one True, got {mask.tolist()}. "
                "Pass a NumPy array of bool."
            )
        return mask

    def _reset_one(self, i: int, seed: int | None, options: dict[str, Any]) -> None:
        env = self.envs[i]
        self._ended[i] = True  # an option that is refused leaves no episode to step
        observation, _ = env.reset(seed=seed, options=options)
        self._states[i], self._goals[i] = observation["state"], observation["goal"]
        self._steps[i], self._ended[i] = 0, False

    def _observations(self) -> dict[str, np.ndarray]:
        observations = {"state": self._states.copy(), "goal": self._goals.copy()}
        if "time_to_go" in self.single_observation_space.spaces:  # pyright: ignore[reportAttributeAccessIssue]
            left = np.where(self._ended, 0, self.envs[0].horizon - self._steps)
            observations["time_to_go"] = (left * CONTROL_PERIOD)[:, None]
        return observations

    def _pose_info(self) -> dict[str, np.ndarray]:
        return self.envs[0].task.pose_info(self._states, self._goals)

    def _masked(self, info: dict[str, np.ndarray], mask: np.ndarray, only: np.ndarray | None = None) -> dict[str, Any]:
        """Convert to Gymnasium's form: `name`, `_name`. Entries other than the pose are of the environments `only`."""
        result: dict[str, Any] = {}
        for name, value in info.items():
            has = mask
            if only is not None and name not in ("success", "position_error", "yaw_error"):
                has = mask & only
                if not has.any():
                    continue
                if not has.all():
                    value = np.where(has if value.ndim == 1 else has[:, None], value, np.zeros((), value.dtype))
            result[name], result[f"_{name}"] = value, has.copy()
        return result


def _multiply(
    env: type[TriFingerEnv],
    num_envs: int = 1,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    threads: int | None = None,
    **arguments: Any,
) -> TriFingerVectorEnv | SyncVectorEnv:
    if AutoresetMode(autoreset_mode) is AutoresetMode.SAME_STEP:
        return SyncVectorEnv([functools.partial(env, **arguments)] * num_envs, autoreset_mode=autoreset_mode)
    return TriFingerVectorEnv(env(**arguments), num_envs, autoreset_mode, threads)


move_cube = functools.partial(_multiply, TriFingerMoveCubeEnv)
move_object = functools.partial(_multiply, TriFingerMoveObjectEnv)
turn_cube = functools.partial(_multiply, TriFingerTurnCubeEnv)
"""Vector entry points for Gymnasium, of the three environments; further arguments are those of the single one."""
