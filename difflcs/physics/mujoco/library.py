"""Addresses of MuJoCo's functions and fields, for the compiled part in `_native`, which knows no header of MuJoCo."""

import copy
import ctypes
import functools
import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.native import copy_taken, native

_FUNCTIONS = (
    "mj_kinematics mj_comPos mj_fwdPosition mj_geomDistance mj_solveM mj_forwardSkip mj_RungeKutta "
    "mj_differentiatePos mj_integratePos mj_checkPos mj_checkVel mj_checkAcc mj_Euler mj_implicit"
).split()
_FIELDS = (
    "qpos qvel act ctrl qacc_warmstart geom_xpos geom_xmat cdof subtree_com actuator_length qacc act_dot qfrc_smooth "
    "qfrc_constraint qfrc_applied ten_length"
).split()
_VARIABLES = ("mjCOLLISIONFUNC", "mju_user_error", "mjcb_time")
_KINDS, _MOST, _FIRST = int(mujoco.mjtGeom.mjNGEOMTYPES), 128, 10  # doubles of a contact, and those that are read
_FLAT = """
<mujoco><worldbody><geom type="plane" size="1 1 1"/><body><geom type="box" size="1 1 1"/></body></worldbody></mujoco>"""
_OTHER = (
    "MuJoCo: expected a library as that of versions 3.3.7 to 4.0, got {} without {}; install one of these, or build "
    "difflcs for yours"
)


@functools.cache
def addresses() -> dict[str, int]:
    """Return the addresses of functions and variables of the library that Python has loaded.

    Raises:
        ImportError: it has not what is called.
    """
    missing = "a library beside the Python package"
    for path in sorted(Path(mujoco.__file__).parent.glob("libmujoco*")):
        try:  # it is loaded already; asked by the same path, the system returns that one
            loaded = ctypes.CDLL(str(path), mode=getattr(os, "RTLD_NOLOAD", 0) | getattr(os, "RTLD_NOW", 0))
            found = {name: ctypes.cast(getattr(loaded, name), ctypes.c_void_p).value or 0 for name in _FUNCTIONS}
            return found | {name: ctypes.addressof(ctypes.c_void_p.in_dll(loaded, name)) for name in _VARIABLES}
        except (OSError, AttributeError, ValueError) as error:
            missing = str(error)
    raise ImportError(_OTHER.format(mujoco.__version__, missing))


@functools.cache
def library() -> _mujoco.Library:
    """Return these functions for the compiled part."""
    return _mujoco.Library(addresses(), _KINDS, _stride(addresses()["mjCOLLISIONFUNC"]))


def _stride(table: Any) -> int:
    """Find how many doubles a contact has: those of a box in a plane have the same depth and normal."""
    model = mujoco.MjModel.from_xml_string(_FLAT)
    data, found = mujoco.MjData(model), np.zeros(50 * _MOST)
    mujoco.mj_kinematics(model, data)
    of_plane = int(mujoco.mjtGeom.mjGEOM_PLANE) * _KINDS
    address = (ctypes.c_void_p * _KINDS**2).from_address(table)[of_plane + int(mujoco.mjtGeom.mjGEOM_BOX)]
    pointer, number = ctypes.c_void_p, ctypes.c_int
    collide = ctypes.CFUNCTYPE(number, pointer, pointer, pointer, number, number, ctypes.c_double)(address or 0)
    if address and collide(model._address, data._address, found.ctypes.data, 0, 1, 0.0) == 4:
        for stride in range(_FIRST, _MOST + 1):
            if np.array_equal(found[: 4 * stride].reshape(4, stride)[:, [0, 4, 5, 6]], [[-1, 0, 0, 1]] * 4):
                return stride
    raise ImportError(_OTHER.format(mujoco.__version__, "contacts of a box and a plane as they were"))


class Place:
    """A model and its data for one thread of the compiled part, which changes both.

    Attributes:
        native: their addresses.
    """

    def __init__(self, model: Any, data: Any):
        self.model, self.data = model, data
        found: dict[str, Any] = {name: _address(name, getattr(data, name)) for name in _FIELDS}
        warnings, nv, n = data.warning.number, model.nv, model.ntendon
        moment = data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        names = ("ten_J_rownnz", "ten_J_rowadr", "ten_J_colind") * (data.ten_J.size != n * nv)  # in newer versions
        where = (getattr(data if hasattr(data, name) else model, name) for name in names)
        found["moment"] = _describe_sparse(model.nu, nv, *moment)
        found["tendon"] = _describe_sparse(n, nv, data.ten_J, *where)
        found |= {"model": model._address, "data": data._address, "ccd_tolerance": _option(model)}
        found |= {"warnings": warnings.ctypes.data, "kinds": len(warnings), "stride": warnings.strides[0] // 4}
        self.native = _mujoco.Place(found)


class Places:
    """Memory in which states are computed: the caller's model and data, and as many copies as there are threads.

    Args:
        model: a private copy, which does not change any more.
        data: its data.
    """

    def __init__(self, model: Any, data: Any):
        self._all = [Place(model, data)]

    def take(self, n: int) -> list[_mujoco.Place]:
        """Return places for n states, with all that is not in the state as in the first."""
        first, threads = self._all[0], count_threads(n)
        while len(self._all) < threads:
            model = copy.copy(first.model)
            self._all.append(Place(model, mujoco.MjData(model)))
        for place in self._all[1:threads]:
            copy_taken(place.data, first.data)
        return [place.native for place in self._all[:threads]]

    def check(self, outcome: tuple[int, int, str], n: int) -> None:
        """Raise what MuJoCo said.

        Raises:
            InvalidInputError: MuJoCo raised an error, or has counted a warning, at one of n states.
        """
        state, thread, said = outcome
        if state >= 0:
            place, self._all = self._all[thread], self._all[:1]
            first = self._all[0]
            with native(first.model, first.data, f"in state {state} of {n}"):
                for name in ("number", "lastinfo"):
                    getattr(first.data.warning, name)[:] = getattr(place.data.warning, name)
                if said:
                    raise mujoco.FatalError(said)


def count_threads(n: int) -> int:
    """Count the threads for n states."""
    return min(n, torch.get_num_threads()) if n > 1 else 1


def _address(name: str, field: np.ndarray, kind: type = np.float64) -> int:
    if field.dtype != kind or not field.flags.c_contiguous:
        raise ImportError(_OTHER.format(mujoco.__version__, f"numbers of {np.dtype(kind)} in {name}"))
    return field.ctypes.data


def _describe_sparse(rows: int, size: int, values: np.ndarray, *where: np.ndarray) -> dict[str, int]:
    """Describe a matrix (rows, size) by its values and where they are: counts, beginnings and columns of the rows."""
    places = [_address("rows that are sparse", field, np.int32) for field in where] or [0, 0, 0]
    found = {"rows": rows, "size": size, "values": _address("a matrix", values)}
    return found | dict(zip(("counts", "starts", "columns"), places, strict=True))


def _option(model: Any) -> int:
    """Find the address of `ccd_tolerance`: the number before `gravity` that changes with it."""
    options, before = model.opt, model.opt.ccd_tolerance
    places = (ctypes.c_double * 16).from_address(options.gravity.ctypes.data - 128)
    fits = set(range(16))
    for value in (0.1234567, 0.7654321):
        options.ccd_tolerance = value
        fits &= {k for k in fits if places[k] == value}
    options.ccd_tolerance = before
    if len(fits) != 1:
        raise ImportError(_OTHER.format(mujoco.__version__, "the option ccd_tolerance"))
    return ctypes.addressof(places) + 8 * fits.pop()
