"""Checks of what users hand to the environments: arguments, options of `reset`, actions.

Every complaint is a ValueError that says what was expected, what came, and what to do.
"""

import math
import numbers
from collections.abc import Mapping
from typing import Any

import numpy as np

from difflcs_envs.errors import OptionsError


def checked_array(name: str, value: Any, shape: tuple[int, ...], meaning: str) -> np.ndarray:
    """Return a finite float64 array of a shape, or raise a ValueError."""
    expected = f"Expected {name} = {meaning}, finite, shape {shape}"
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{expected}, got {value!r:.200}. Pass numbers.") from error
    if array.shape != shape:
        raise ValueError(f"{expected}, got shape {array.shape}. Pass {' x '.join(map(str, shape))} numbers.")
    if not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array)).tolist()
        raise ValueError(f"{expected}, got NaN or infinity at {bad}. Find out where they come from.")
    return array


def checked_number(name: str, value: Any, low: float, high: float = math.inf, low_open: bool = False) -> float:
    """Return a finite float within bounds, or raise a ValueError."""
    number = float(value) if isinstance(value, numbers.Real) and not isinstance(value, bool) else math.nan
    if not math.isfinite(number) or not low <= number <= high or (low_open and number == low):
        bounds = f"{'>' if low_open else '>='} {low:g}" + (f" and <= {high:g}" if math.isfinite(high) else "")
        raise ValueError(f"Expected {name} to be a finite number {bounds}, got {value!r}. Choose one in this range.")
    return number


def checked_integer(name: str, value: Any) -> int:
    """Return a positive int, or raise a ValueError."""
    if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
        raise ValueError(f"Expected {name} to be a whole number >= 1, got {value!r}. Choose a value in this range.")
    return int(value)


def checked_options(options: Any) -> dict[str, Any]:
    """Return a copy of the options of `reset`, empty for None.

    Raises:
        OptionsError: They are no dictionary.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise OptionsError(
            f"Expected options as a dictionary, got {type(options).__name__}: {options!r:.100}. Pass "
            "options={'goal': [x, y, yaw]}."
        )
    return dict(options)
