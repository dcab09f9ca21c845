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
    return {name: version(name) for name in _REPORTED}


def version(package: str) -> str | None:
    """Return the version of a package, or None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
