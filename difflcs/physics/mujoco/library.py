"""Addresses of MuJoCo's functions and fields, for the compiled part in `_native`, which knows no header of MuJoCo."""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
import ctypes
import functools
import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from difflcs.physics.mujoco._native import _mujoco
from difflcs.physics.mujoco.native import TAKEN

_FUNCTIONS = ("mj_kinematics", "mj_comPos", "mj_geomDistance")
_VARIABLES = ("mjCOLLISIONFUNC", "mju_user_error")
_KINDS, _MOST, _FIRST = int(mujoco.mjtGeom.mjNGEOMTYPES), 128, 10  # doubles of a contact, and those that are read
_FLAT = """
<mujoco><worldbody><geom type="plane" size="1 1 1"/><body><geom type="box" size="1 1 1"/></body></worldbody></mujoco>"""
_OTHER = (
    "MuJoCo: expected a library as that of versions 3.3.7 to 4.0, got {} without {}; install one of these, or build "
    "difflcs for yours"
)


@functools.cache
def library() -> _mujoco.Library:
    """Find the library that Python has loaded.

    Raises:
        ImportError: it has not what is called.
    """
    loaded, missing = None, "a library beside the Python package"
    for path in sorted(Path(mujoco.__file__).parent.glob("libmujoco*")):
        try:  # it is loaded already; asked by the same path, the system returns that one
            loaded = ctypes.CDLL(str(path), mode=getattr(os, "RTLD_NOLOAD", 0) | getattr(os, "RTLD_NOW", 0))
            addresses = {name: ctypes.cast(getattr(loaded, name), ctypes.c_void_p).value for name in _FUNCTIONS}
            addresses |= {name: ctypes.addressof(ctypes.c_void_p.in_dll(loaded, name)) for name in _VARIABLES}
            return _mujoco.Library(addresses, _KINDS, _stride(addresses["mjCOLLISIONFUNC"]))
        except (OSError, AttributeError, ValueError) as error:
            missing = str(error)
    raise ImportError(_OTHER.format(mujoco.__version__, missing))


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
    raise ValueError("contacts of a box and a plane")


class Place:
    """A model and its data for one thread of the compiled part, which changes both.

    Attributes:
        native: their addresses.
    """

    def __init__(self, model: Any, data: Any):
        self.model, self.data = model, data
        fields = {name: getattr(data, name) for name in ("qpos", "geom_xpos", "geom_xmat", "cdof", "subtree_com")}
        addresses = {name: _address(name, value) for name, value in fields.items()}
        addresses |= {"model": model._address, "data": data._address, "ccd_tolerance": _option(model)}
        self.native = _mujoco.Place(addresses)

    def copy(self) -> Place:
        """Make another for the same model."""
        model = copy.copy(self.model)
        return Place(model, mujoco.MjData(model))

    def follow(self, data: Any) -> None:
        """Take from other data what is not in the state."""
        for name in TAKEN:
            getattr(self.data, name)[:] = getattr(data, name)


def _address(name: str, field: np.ndarray) -> int:
    if field.dtype != np.float64 or not field.flags.c_contiguous:
        raise ImportError(_OTHER.format(mujoco.__version__, f"numbers of double precision in {name}"))
    return field.ctypes.data


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
