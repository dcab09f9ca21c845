"""The compiled part of `difflcs.physics.mujoco`: contacts at many states, on threads."""

try:
    from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
except ImportError:
    raise ImportError(
        "difflcs: expected the compiled contacts of MuJoCo models, got an installation without them; build them, in a "
        "checkout by `pip install -e .`"
    ) from None

__all__ = ["_mujoco"]
