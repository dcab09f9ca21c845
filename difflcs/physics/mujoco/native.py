"""MuJoCo's errors, and the warnings that it only counts, as exceptions of this library; bits of its flags."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, TypeVar, cast

import mujoco
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from difflcs._differentiation import is_wrapped
from difflcs.errors import InvalidInputError, NonFiniteError

Method = TypeVar("Method", bound=Callable[..., Any])
Array = NDArray[np.float64]
TAKEN = ("qpos", "ctrl", "act", "mocap_pos", "mocap_quat", "eq_active", "qfrc_applied", "xfrc_applied")
"""Fields of a caller's data that are used besides the state."""

_LARGE = "x: expected {} below 1e10, got larger ones, which MuJoCo takes for errors; look for what diverges"
_MEMORY = (
    "model: expected memory for all contacts and constraints, got an arena that is full with {arena} bytes, where "
    'MuJoCo drops the others; give it more, <size memory="{more}M"/> (spec.memory of a MjSpec), or a smaller distance'
)
_WARNINGS = {
    "INERTIA": "model: expected an inertia matrix that can be inverted, got one that is nearly singular (degree of "
    "freedom {info}); give its bodies more inertia, or its joint an armature",
    "CONTACTFULL": _MEMORY,
    "CNSTRFULL": _MEMORY,
    "BADQPOS": _LARGE.format("positions"),
    "BADQVEL": _LARGE.format("velocities"),
    "BADQACC": "model: expected accelerations below 1e10, got larger ones of degree of freedom {info}; give what moves "
    "more inertia, or softer springs and servos",
    "BADCTRL": _LARGE.format("controls, here the places of relative servos,"),
}


def to_numpy(tensor: Tensor) -> Array:
    """Read the numbers of states, goals or parameters.

    Raises:
        InvalidInputError: they are inside `torch.func.vmap`, `grad` and the like, where nobody can read them.
    """
    if is_wrapped(tensor := tensor.detach()):
        raise InvalidInputError(
            "x: expected states and goals whose numbers can be read, got some inside a transform of torch.func; pass "
            "batches (..., n_x), and differentiate by backward"
        )
    return tensor.cpu().double().numpy()


def in_turn(method: Method) -> Method:
    """Let one thread after the other into methods of an object with `_turns`, a lock: MuJoCo's data are its own."""

    @functools.wraps(method)
    def alone(self: Any, *args: Any, **options: Any) -> Any:
        with self._turns:
            return method(self, *args, **options)

    return cast(Method, alone)


@functools.cache
def flags(*names: str) -> int:
    """Return the bits of `disableflags` with these names, such as CONTACT."""
    return sum(int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in names)


def least_time(model: Any) -> float:
    """Return the least time constant of constraints [s]: with `refsafe` two time steps, but for the "discrete" ones."""
    discrete = int(getattr(mujoco.mjtIntegrator, "mjINT_DISCRETE", -1))
    free = model.opt.integrator == discrete or model.opt.disableflags & flags("REFSAFE")
    return 0.0 if free else 2.0 * model.opt.timestep


def taken(data: Any) -> SimpleNamespace:
    """Copy the fields of a caller's data that are used."""
    return SimpleNamespace(**{name: np.array(getattr(data, name)) for name in TAKEN})


def copy_taken(into: Any, data: Any) -> None:
    """Copy the fields that are `TAKEN` from one data of a model into another."""
    for name in TAKEN:
        getattr(into, name)[:] = getattr(data, name)


def take_given(into: Any, data: Any) -> None:
    """Copy these fields from the caller's data.

    Raises:
        InvalidInputError, NonFiniteError: data of another model, or numbers that are not finite.
    """
    for name in TAKEN:
        field, values = getattr(into, name), getattr(data, name)
        if values.shape != field.shape:
            raise InvalidInputError(f"data: expected {name} {field.shape}, got {values.shape}; pass MjData(model)")
        if not np.isfinite(values).all():
            raise NonFiniteError(f"data: expected finite numbers in {name}, got NaN or infinity; set it in the data")
        field[:] = values


_KINDS = {int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")): text for name, text in _WARNINGS.items()}


@contextmanager
def native(model: Any, data: Any, where: str) -> Iterator[None]:
    """Raise MuJoCo's errors and warnings at a state as ours; `model` and `data` stay usable whatever happens.

    Raises:
        InvalidInputError: MuJoCo raised an error, or has counted a warning, such as one of contacts that it dropped.
    """
    said = None
    try:
        yield
    except mujoco.FatalError as error:
        said = error
    numbers = data.warning.number.tolist()
    if said is None and not any(numbers):
        return
    kind = numbers.index(max(numbers))
    size = {"arena": int(model.narena), "more": max(64, int(model.narena) >> 18), "info": data.warning.lastinfo[kind]}
    if any(numbers):
        text = _KINDS.get(kind, f"model: expected no warning of MuJoCo, got its number {kind}; see MUJOCO_LOG.TXT")
    else:
        text = _MEMORY if "Alloc" in str(said) else f"model: expected what MuJoCo can compute, got its error {said}"
    kept = taken(data)
    mujoco.mj_resetData(model, data)  # what an error leaves behind, such as a stack that was not given back
    copy_taken(data, kept)
    raise InvalidInputError(f"{text.format(**size)} ({where})") from said
