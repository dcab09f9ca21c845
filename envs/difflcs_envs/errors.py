"""Errors and warnings of the environments. Only `tasks.py` in this package imports `difflcs`."""

from collections.abc import Iterator
from contextlib import contextmanager

INSTALL_HINT = 'pip install "difflcs[envs]"'


class DifflcsEnvsError(Exception):
    """Base of the errors of this package, except plain ValueErrors about arguments."""


class MissingDependencyError(ImportError, DifflcsEnvsError):
    """A package that the environments need is not installed."""

    def __init__(self, package: str) -> None:
        super().__init__(
            f"The environments need the package '{package}', which is not installed. Install it with: {INSTALL_HINT}",
            name=package,
        )


@contextmanager
def extra() -> Iterator[None]:
    """Say of packages that are imported here, but not installed, how to install them."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingDependencyError(error.name or "") from error


class RenderingError(RuntimeError, DifflcsEnvsError):
    """No picture can be drawn on this machine: no display, no OpenGL library, or no OpenGL context."""


class MeshError(ValueError, DifflcsEnvsError):
    """A mesh is missing, broken, or not a solid of a size that the robot can push."""


class OptionsError(ValueError, TypeError, DifflcsEnvsError):
    """The options of `reset` are no dictionary."""


class AssetError(RuntimeError, DifflcsEnvsError):
    """A download failed, or has unexpected content."""


class PhysicsWarning(RuntimeWarning):
    """The simulation became unstable; the environment went back to its last finite state and ended the episode."""
