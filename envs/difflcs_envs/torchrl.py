"""The TriFinger environments for TorchRL. Nothing is simulated here: Gymnasium's environments are wrapped."""

# TorchRL exports without stubs.
# pyright: reportPrivateImportUsage=false

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium

from difflcs_envs import register_envs
from difflcs_envs.errors import extra

if TYPE_CHECKING:
    from torchrl.envs import EnvBase


def make_env(task: str = "cube", num_envs: int | None = None, **arguments: Any) -> EnvBase:
    """Make a TorchRL environment with `state` (9,), `goal` (3,) and `time_to_go` (1,) [s] in its observation.

    A policy or value function of the finite task needs the time to go: episodes are truncated, not terminated, after
    `horizon` steps.

    Args:
        task: "cube", "turn_cube", the name of a YCB object, the path of a mesh, or a Gymnasium id.
        num_envs: Number of environments in one batch, stepped in native threads; None for one without batch dimension.
        **arguments: Of the Gymnasium environment.

    Returns:
        The environment. Elements of a batch are reset when TorchRL asks for it; nothing resets by itself.

    Raises:
        MissingDependencyError: TorchRL is not installed.
    """
    with extra():
        from torchrl.envs import GymWrapper, RenameTransform, TransformedEnv
    register_envs()
    env_id, arguments = _resolve(task, arguments)
    arguments = {"observe_time": True, **arguments}
    if num_envs is None:
        env = GymWrapper(gymnasium.make(env_id, **arguments))
    else:
        disabled = gymnasium.vector.AutoresetMode.DISABLED
        env = GymWrapper(gymnasium.make_vec(env_id, num_envs=num_envs, autoreset_mode=disabled, **arguments))
    # TorchRL calls the entry `state` of an observation `observation`.
    return TransformedEnv(env, RenameTransform(["observation"], ["state"]))


def _resolve(task: str, arguments: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Gymnasium id and arguments of a task."""
    if task in gymnasium.registry:
        return task, arguments
    if task in ("cube", "turn_cube"):
        name = {"cube": "Move", "turn_cube": "Turn"}[task]
        return f"difflcs/TriFinger{name}Cube-v0", arguments
    # An object that does not exist is refused there, with the list of those that do.
    return "difflcs/TriFingerMoveObject-v0", {"object": task, **arguments}
