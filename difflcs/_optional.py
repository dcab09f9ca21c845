"""Optional packages: one clear error instead of a traceback."""

import importlib.util
from importlib import metadata

from difflcs.errors import MissingDependencyError

INSTALL = 'pip install "difflcs[rl,envs,viz]"'
_REPORTED = ("difflcs", "torch", "numpy", "casadi", "gymnasium", "mujoco", "torchrl")


def require(*packages: str) -> None:
    """Check that packages can be imported, without importing them.

    Raises:
        MissingDependencyError: one is not installed; the message has the line that installs it.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingDependencyError(f"expected the package(s) {', '.join(missing)}, not installed; run: {INSTALL}")


def versions() -> dict[str, str | None]:
    """List the versions of the packages that decide a result; None for one that is not installed."""
    installed: dict[str, str | None] = {}
    for name in _REPORTED:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            installed[name] = None
    return installed
