"""The compiled part of `difflcs.physics.mujoco`: contacts, motion and forces at many states, on threads."""

try:
    from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]

    _mujoco.make_steps  # noqa: B018  the newest
except (ImportError, AttributeError):
    raise ImportError(
        "difflcs: expected the compiled part of difflcs.physics.mujoco of this version, got none or an older one; "
        "build it, in a checkout by `pip install -e .`"
    ) from None

__all__ = ["_mujoco"]
