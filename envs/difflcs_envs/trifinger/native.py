"""The bridge to the compiled stepper: finds the loaded MuJoCo library and hands over addresses.

Nothing depends on MuJoCo's headers: functions are looked up by name in the library that the Python package has loaded,
fields by the addresses of their NumPy views.
"""

import ctypes
import functools
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from difflcs_envs._native import _stepper as stepper  # pyright: ignore[reportMissingModuleSource]

_FUNCTIONS = ("mj_step1", "mj_step2", "mj_kinematics", "mj_getState")


@functools.cache
def _library() -> tuple[ctypes.CDLL, dict[str, int]] | None:
    """Find the MuJoCo library that this process has loaded, and the addresses of its functions; else None."""
    folder = Path(mujoco.__file__).parent
    for path in sorted([*folder.glob("libmujoco*"), *folder.glob("mujoco.dll")]):
        try:
            # The library is loaded already; asked by the same path, the system returns that one.
            library = ctypes.CDLL(str(path), mode=getattr(os, "RTLD_NOLOAD", 0) | getattr(os, "RTLD_NOW", 0))
            addresses = {name: ctypes.cast(getattr(library, name), ctypes.c_void_p).value for name in _FUNCTIONS}
        except (OSError, AttributeError):
            continue
        if all(addresses.values()):
            return library, {name: address for name, address in addresses.items() if address}
    return None


@contextmanager
def _untimed() -> Iterator[None]:
    """Turn off MuJoCo's stopwatches (`data.timer`): reading the clock takes 8 % of a step."""
    try:
        clock = ctypes.c_void_p.in_dll(_library()[0], "mjcb_time")  # pyright: ignore[reportOptionalSubscript]
    except (TypeError, ValueError):  # no library, or one without this callback
        yield
        return
    before, clock.value = clock.value, None
    try:
        yield
    finally:
        clock.value = before


def make_lane(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    fields: dict[str, np.ndarray],
    warnings: Sequence[int],
    constants: dict[str, float],
) -> stepper.Lane:
    """Bind the compiled stepper to one simulation.

    Args:
        model: The model.
        data: The data.
        fields: Views of the fields of `data` that the stepper reads and writes, each in one piece. The caller keeps
            them (or `data`) alive.
        warnings: Kinds of MuJoCo warnings that mean instability.
        constants: Numbers for the stepper.

    Raises:
        RuntimeError: This version of MuJoCo cannot be bound to: it lacks a function, or lays out its memory otherwise.
    """
    unknown = RuntimeError(
        "Expected a MuJoCo whose library and memory the compiled stepper can use, as those of 3.3.7 to 4.0, got MuJoCo "
        f'{mujoco.__version__}. Install one of these: pip install "mujoco<=4.0"'
    )
    library = _library()
    if library is None or not hasattr(data, "_address"):
        raise unknown
    counters = data.warning.number  # a strided view into the data
    views = [*fields.values(), data.qpos]
    if any(view.dtype != np.float64 or not view.flags.c_contiguous for view in views) or counters.dtype != np.int32:
        raise unknown
    first, stride = counters.ctypes.data, counters.strides[0]
    addresses: dict[str, Any] = {name: view.ctypes.data for name, view in fields.items()}
    addresses |= {
        "model": model._address,
        "data": data._address,
        "warnings": [first + stride * kind for kind in warnings],
    }
    lane = stepper.make_lane(library[1], addresses, constants)
    before = data.time
    data.time = probe = 0.123456789
    same = lane.time == probe and _is_live(data, counters)
    data.time = before
    if not same:
        raise unknown
    return lane


def _is_live(data: mujoco.MjData, counters: np.ndarray) -> bool:
    """Return True if the counters are a view of the data and not a copy."""
    kind = int(mujoco.mjtWarning.mjWARN_INERTIA)
    before = int(data.warning[kind].number)
    data.warning[kind].number = before + 1
    live = int(counters[kind]) == before + 1
    data.warning[kind].number = before
    return live


def step_lanes(
    lanes: Sequence[stepper.Lane], actions: np.ndarray, states: np.ndarray, stable: np.ndarray, threads: int
) -> None:
    """Step every lane by one control period, in native threads, without the GIL.

    Args:
        lanes: The simulations, each once.
        actions: Displacements of the tips [m], (n, 6).
        states: Gets the states, (n, 9); rows of unstable lanes are left alone.
        stable: Gets True for each lane that is still stable, (n,) bool. The caller must restore the others.
        threads: Most threads to use.
    """
    with _untimed():
        stepper.step_lanes(lanes, actions, states, stable, threads)
