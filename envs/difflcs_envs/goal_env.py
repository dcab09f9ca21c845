"""Base class of environments with goals: what of Gymnasium's reset, step and render is the same for every robot."""

import warnings
from abc import abstractmethod
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from difflcs_envs.checks import checked_array, checked_options
from difflcs_envs.errors import PhysicsWarning
from difflcs_envs.goal_task import GoalTask
from difflcs_envs.rendering import SceneRenderer


class GoalEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """An environment whose actions, within ± a limit, lead from a state nearer to a goal.

    Attributes:
        task: Success and reward.
        horizon: Steps of an episode.
        width, height: Size of pictures [pixel].
        model, data: MuJoCo's.
    """

    dt: ClassVar[float]
    """Duration of one step [s]."""
    action_limit: ClassVar[float]
    action_meaning: ClassVar[str]
    unstable: ClassVar[str]
    """What is said where the simulation became unstable."""
    task: GoalTask
    model: Any
    data: Any
    horizon: int
    width: int
    height: int
    _state: np.ndarray
    _goal: np.ndarray
    _steps: int | None = None  # steps made in this episode; None: reset is needed
    _renderer: SceneRenderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the random generator; None goes on with the current one.
            options: May hold `goal` and `state`, see the class.

        Returns:
            Observation and info.

        Raises:
            OptionsError: The options are no dictionary.
            ValueError: An option is unknown, has the wrong shape, or is outside what the robot and the task allow.
        """
        options = checked_options(options)
        super().reset(seed=seed)
        goal, state = options.pop("goal", None), options.pop("state", None)
        if options:
            raise ValueError(f"Expected options 'goal' and 'state', got also {sorted(options, key=str)}. Remove them.")
        self._steps = None  # an option that is refused below leaves no episode to step
        info = self._start(goal, state)
        self._steps = 0
        return self._observation(), info

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Execute an action for 0.1 s.

        Args:
            action: See the class, (n,).

        Returns:
            Observation, reward, terminated (always False), truncated, info.

        Raises:
            ValueError: The action has the wrong shape or is not finite.
            gymnasium.error.ResetNeeded: No episode is running.
        """
        if self._steps is None:
            raise ResetNeeded("Expected a running episode, but it has ended or never began. Call reset() first.")
        assert self.action_space.shape is not None
        requested = checked_array("action", action, self.action_space.shape, self.action_meaning)
        executed = requested.clip(-self.action_limit, self.action_limit)
        before, after = self._state, self._simulate(executed)
        self._state = before.copy() if after is None else after
        self._steps += 1
        truncated = self._steps >= self.horizon or after is None

        reward, outcome = self.task.outcome(before, executed, self._state, self._goal, truncated)
        info: dict[str, Any] = {name: value.item() for name, value in outcome.items()}
        info["executed_action"] = executed
        info["clipped"] = bool((executed != requested).any())
        info["physics_error"] = after is None
        if truncated:
            self._steps = None
        if after is None:
            warnings.warn(self.unstable, PhysicsWarning, stacklevel=2)
        self._stepped(info)
        return self._observation(), float(reward), False, truncated, info

    @abstractmethod
    def _start(self, goal: Any, state: Any) -> dict[str, Any]:
        """Start at a goal and in a state, None where they are not given; return the info.

        It makes the same draws always, so that an option passed now does not change the episodes after it.
        """

    @abstractmethod
    def _simulate(self, action: np.ndarray) -> np.ndarray | None:
        """Execute an action within the limit; return the state after it, None where the simulation became unstable."""

    def _observation(self) -> dict[str, np.ndarray]:
        """Return what is observed now, in arrays of its own."""
        return {"state": self._state.copy(), "goal": self._goal.copy()}

    def _stepped(self, info: dict[str, Any]) -> None:
        """Do what else belongs to a step, and add to its info."""

    def _pose_info(self) -> dict[str, Any]:
        return {name: value.item() for name, value in self.task.pose_info(self._state, self._goal).items()}

    def picture(self, camera: str = "front") -> np.ndarray:
        """Draw the scene off screen, whatever the render mode.

        Args:
            camera: "front" or "top".

        Returns:
            A new picture, uint8 (height, width, 3).

        Raises:
            RenderingError: No OpenGL on this machine. The message says what to install.
        """
        if self._renderer is None:
            self._renderer = SceneRenderer(self.model, self.width, self.height)
        return self._renderer.render(self.data, camera)

    def close(self) -> None:
        """Free the renderer. May be called again."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
