"""Gymnasium environments for contact-rich manipulation: the TriFinger robot of LCS-RL (Bui & Posa), and a hand.

Importing this package registers its environments:

    import difflcs_envs
    env = gymnasium.make("difflcs/TriFingerMoveCube-v0")

or, in one line, `gymnasium.make("difflcs_envs:difflcs/TriFingerMoveCube-v0")`. MuJoCo is imported only when an
environment is made.
"""

from difflcs_envs.errors import (
    AssetError,
    DifflcsEnvsError,
    MeshError,
    MissingDependencyError,
    OptionsError,
    PhysicsWarning,
    RenderingError,
    extra,
)

__all__ = [
    "AssetError",
    "DifflcsEnvsError",
    "MeshError",
    "MissingDependencyError",
    "OptionsError",
    "PhysicsWarning",
    "RenderingError",
    "register_envs",
]

_ENTRY_POINTS = {
    "HandTurnObject-v0": ("hand.env:HandTurnObjectEnv", "hand.env:turn_object"),
    "TriFingerMoveCube-v0": ("trifinger.env:TriFingerMoveCubeEnv", "vector:move_cube"),
    "TriFingerMoveObject-v0": ("trifinger.env:TriFingerMoveObjectEnv", "vector:move_object"),
    "TriFingerTurnCube-v0": ("trifinger.env:TriFingerTurnCubeEnv", "vector:turn_cube"),
}


def register_envs() -> None:
    """Register every environment with Gymnasium under the namespace `difflcs/`. Calling it again changes nothing.

    The episode length is an argument of the environments (`horizon`), which truncate by themselves; therefore no
    `max_episode_steps` is registered.

    Raises:
        MissingDependencyError: Gymnasium is not installed.
    """
    with extra():
        import gymnasium
    for name, (single, vector) in _ENTRY_POINTS.items():
        env_id = f"difflcs/{name}"
        if env_id not in gymnasium.registry:
            gymnasium.register(
                id=env_id, entry_point=f"difflcs_envs.{single}", vector_entry_point=f"difflcs_envs.{vector}"
            )


register_envs()
