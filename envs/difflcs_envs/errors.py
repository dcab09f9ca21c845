"""Errors and warnings of the environments. This package stands alone: nothing here comes from `difflcs`."""

from __future__ import annotations

__all__ = ["INSTALL_HINT", "MissingDependencyError", "PhysicsWarning", "RenderingError"]

INSTALL_HINT = 'pip install "difflcs[envs]"'


class MissingDependencyError(ImportError):
    """A package that the environments need is not installed."""

    def __init__(self, package: str) -> None:
        super().__init__(
            f"The environments need the package '{package}', which is not installed. Install it with: {INSTALL_HINT}",
            name=package,
        )


class RenderingError(RuntimeError):
    """No picture can be drawn on this machine: no display, no OpenGL library, or no OpenGL context."""


class PhysicsWarning(RuntimeWarning):
    """The simulation became unstable; the environment went back to its last finite state and ended the episode."""
