"""Native kernels: C++ without torch, one problem per SIMD lane (sources beside this file)."""

from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]

try:
    # What the kernels and the reference in Python compare with; `fields.hpp` says what each means.
    TOLERANCES: dict[str, float] = _kernels.tolerances()
except AttributeError:
    raise ImportError(
        "difflcs: the compiled kernels were built for an older version; build them again, in a checkout by "
        "`pip install -e .`"
    ) from None
