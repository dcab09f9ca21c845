"""State of an LCS made from a MuJoCo model: the meaning of its numbers, and conversion from and to MuJoCo.

MuJoCo's `qpos` has unit quaternions, which no linear system can have as a state. Where a joint is free or a ball, the
state has the rotation vector r ∈ R³ from a reference orientation q̄ instead: q = q̄ exp(r), in coordinates of the body,
as `mj_integratePos` does. All else is `qpos` itself.
"""

from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from difflcs._checks import check_array, check_kind, check_shape, check_tensor
from difflcs.errors import InvalidInputError, ShapeError
from difflcs.physics.mujoco.native import to_numpy

Array = NDArray[np.float64]
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])  # a factor that makes it of a quaternion
_SUFFIXES = {
    int(mujoco.mjtJoint.mjJNT_FREE): ("_x", "_y", "_z", "_rx", "_ry", "_rz"),
    int(mujoco.mjtJoint.mjJNT_BALL): ("_rx", "_ry", "_rz"),
    int(mujoco.mjtJoint.mjJNT_SLIDE): ("",),
    int(mujoco.mjtJoint.mjJNT_HINGE): ("",),
}


class MujocoState:
    """Order and coordinates of the state: one number for each of MuJoCo's nv degrees of freedom; `qvel` and `act`.

    The coordinate of a slide or a hinge is its `qpos`. A free joint has its position and the rotation vector from its
    orientation in `reference`, a ball the rotation vector alone: below half a turn each orientation has one, and at a
    whole turn the coordinates are singular, so that `tangent` refuses. So give a reference near the motion. `follow`
    moves the reference along: states from before then refer to another orientation. Quaternions are read as MuJoCo
    does: of any length, and of zeros as no rotation.

    Args:
        model: the MuJoCo model.
        reference: (nq,) `qpos` with the orientations from which rotation vectors count; None: `model.qpos0`.
        velocities: True if `qvel` follows the positions, and then `act`. They are MuJoCo's, angular velocities in
            coordinates of the body.

    Attributes:
        names: name of each number of the state: that of the joint (or `joint0`, `joint1` …), for free joints and
            balls with one of the endings _x _y _z _rx _ry _rz; velocities with the ending _velocity; the name of the
            actuator (or `actuator0` …) with the ending _activation.
    """

    def __init__(self, model: Any, reference: ArrayLike | None = None, *, velocities: bool = False):
        check_kind("model", model, mujoco.MjModel, "load one, MjModel.from_xml_path, or compile its MjSpec")
        self.nq, self.nv, self.velocities = int(model.nq), int(model.nv), velocities
        self.na = int(model.na) if velocities else 0
        names: list[str] = []
        plain: list[tuple[int, int]] = []
        self._turning: list[tuple[int, int]] = []  # where quaternions are in qpos, rotation vectors in the state
        for j in range(model.njnt):
            kind, q, v = int(model.jnt_type[j]), int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
            name = model.joint(j).name or f"joint{j}"
            names += [name + suffix for suffix in _SUFFIXES[kind]]
            count = len(_SUFFIXES[kind])
            shifts = count % 3 if count < 6 else 3
            plain += [(q + i, v + i) for i in range(shifts)]
            if count >= 3:
                self._turning.append((q + shifts, v + shifts))
        if velocities:
            driven = np.repeat(np.arange(model.nu), model.actuator_actnum) if self.na else ()
            activated = [f"{model.actuator(i).name or f'actuator{i}'}_activation" for i in driven]
            names += [f"{name}_velocity" for name in names] + activated
        self.names = tuple(names)
        self._of_qpos, self._of_state = np.array(plain, dtype=np.intp).reshape(-1, 2).T
        self.follow(model.qpos0 if reference is None else reference, "reference")

    def follow(self, qpos: ArrayLike, name: str = "qpos") -> None:
        """Let rotation vectors count from the orientations in `qpos` (..., nq) from now on.

        With batch dimensions each state has a reference of its own; they are then the first ones of all states.

        Raises:
            ShapeError, NonFiniteError: numbers that do not fit.
        """
        self._reference = self._array(name, qpos, self.nq).copy()
        for q, _ in self._turning:
            self._reference[..., q : q + 4] = _unit(self._reference[..., q : q + 4])

    def _references(self, batch: tuple[int, ...]) -> Array:
        """Return the reference of each state (*batch, nq), or what is broadcast to it."""
        own = self._reference.shape[:-1]
        if batch == own:
            return self._reference
        if batch[: len(own)] != own:
            raise ShapeError(
                f"x: expected states with the first batch dimensions {own} of the reference of their rotations, got "
                f"{batch}; follow(qpos) with one reference for all, or with those of these states"
            )
        return self._reference.reshape(*own, *[1] * (len(batch) - len(own)), self.nq)

    @property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.names)

    def index(self, name: str) -> int:
        """Return the index of a name in the state.

        Raises:
            KeyError: there is none of that name.
        """
        if name not in self.names:
            raise KeyError(f"expected one of {', '.join(self.names)}, got {name!r}")
        return self.names.index(name)

    def to_state(self, qpos: ArrayLike, qvel: ArrayLike | None = None, act: ArrayLike | None = None) -> Tensor:
        """Convert to states (..., n_x) from `qpos` (..., nq), `qvel` (..., nv) and `act` (..., na), which may be zero.

        Raises:
            ShapeError, NonFiniteError: numbers that do not fit.
        """
        qpos = self._array("qpos", qpos, self.nq)
        x = np.zeros((*qpos.shape[:-1], self.nv))
        x[..., self._of_state] = qpos[..., self._of_qpos]
        reference = self._references(qpos.shape[:-1]) if self._turning else qpos
        for q, v in self._turning:
            there, here = reference[..., q : q + 4], _unit(qpos[..., q : q + 4])
            if (there != here).any():  # something has turned
                x[..., v : v + 3] = _rotation_vector(_multiply(there * _CONJUGATE, here))
        if self.velocities:
            shape = x.shape[:-1]
            for name, values, size in (("qvel", qvel, self.nv), ("act", act, self.na)):
                more = np.zeros(size) if values is None else self._array(name, values, size)
                x = np.concatenate([x, np.broadcast_to(more, (*shape, size))], -1)
        return torch.from_numpy(x)

    def to_mujoco(self, x: Tensor) -> tuple[Array, Array]:
        """Convert states (..., n_x) to `qpos` (..., nq) and `qvel` (..., nv), zero where the state has none.

        The `act` of MuJoCo are the last `na` numbers of the state.

        Raises:
            DTypeError, ShapeError, NonFiniteError: not such states.
        """
        check_tensor("x", x, [("n_x", self.n_x)])
        numbers = to_numpy(x)
        qpos = np.empty((*numbers.shape[:-1], self.nq))
        qpos[:] = self._references(numbers.shape[:-1])
        qpos[..., self._of_qpos] = numbers[..., self._of_state]
        for q, v in self._turning:
            if not numbers[..., v : v + 3].any():
                continue  # nothing has turned
            qpos[..., q : q + 4] = _multiply(qpos[..., q : q + 4], _quaternion(numbers[..., v : v + 3]))
        velocity = numbers[..., self.nv : 2 * self.nv] if self.velocities else np.zeros((*qpos.shape[:-1], self.nv))
        return qpos, velocity

    def flatten(self, x: Tensor, act: Array) -> Array:
        """Convert states (..., n_x) to MuJoCo's (n, nq + nv + na); of states without velocities `act` (na,) is that."""
        (qpos, qvel), n = self.to_mujoco(x), x.shape[:-1].numel()
        if self.na:
            act = to_numpy(x)[..., self.n_x - self.na :].reshape(n, self.na)
        else:
            act = act[None].repeat(n, 0)
        return np.concatenate([qpos.reshape(n, self.nq), qvel.reshape(n, self.nv), act], -1)

    def tangent(self, x: Array) -> Array | None:
        """T (..., nv, nv) of qvel = T ẋ, for positions x (..., nv); None for the identity, where nothing has turned.

        The block of a rotation vector is the right Jacobian of SO(3): 1 − (1 − cos r)/r² [r]× + (r − sin r)/r³ [r]×².
        Its smallest singular value is 2 sin(r/2)/r, as far as which a rotation about another axis moves r.

        Raises:
            InvalidInputError: a rotation is so near to whole turns that no system in these coordinates is of use.
        """
        if not any(x[..., v : v + 3].any() for _, v in self._turning):
            return None
        T = np.broadcast_to(np.eye(self.nv), (*x.shape[:-1], self.nv, self.nv)).copy()
        for _, v in self._turning:
            r = x[..., v : v + 3]
            angle = np.linalg.norm(r, axis=-1)[..., None, None]
            small = angle < 1e-4
            safe = np.where(small, 1.0, angle)
            first = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
            singular = 2 * first < _SINGULAR**2
            if singular.any():
                state = ", ".join(map(str, np.argwhere(singular)[0, :-2]))
                raise InvalidInputError(
                    f"x: expected rotations that are not near a whole turn from the reference, where rotation vectors "
                    f"are singular, got {angle[singular][0]:.6g} rad in {self.names[v]} and the two after it, state "
                    f"{state or 0}; take the shorter rotation to the same place, to_state(*to_mujoco(x)), or move the "
                    f"reference there: the qpos of the data"
                )
            second = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
            turn = np.swapaxes(cross(r[..., None, :], np.eye(3)), -1, -2)  # columns r × e_i
            T[..., v : v + 3, v : v + 3] = np.eye(3) - first * turn + second * (turn @ turn)
        return T

    @staticmethod
    def _array(name: str, value: ArrayLike, size: int) -> Array:
        array = check_array(name, value)
        check_shape(name, torch.from_numpy(array), f"... {size}", remedy="take it from this model's data")
        return array


_SINGULAR = 1e-2  # 3.6 degrees at the first turn
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def _unit(q: Array) -> Array:
    """Normalise quaternions (..., 4), as `mju_normalize4` makes them: no rotation where there is no length."""
    size = np.sqrt((q * q).sum(-1, keepdims=True))  # sooner than np.linalg.norm
    none = size < 1e-15
    return np.where(none, np.array([1.0, 0.0, 0.0, 0.0]), q / np.where(none, 1.0, size))


def _multiply(a: Array, b: Array) -> Array:
    """Multiply quaternions (..., 4)."""
    a0, av, b0, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    return np.concatenate([a0 * b0 - (av * bv).sum(-1, keepdims=True), a0 * bv + b0 * av + cross(av, bv)], -1)


def _quaternion(r: Array) -> Array:
    """Compute exp: the unit quaternion (..., 4) of a rotation vector (..., 3)."""
    half = 0.5 * np.linalg.norm(r, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * r], -1)


def _rotation_vector(q: Array) -> Array:
    """Compute log: the rotation vector (..., 3), of at most half a turn, of a quaternion (..., 4)."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    tiny = sine < 1e-12
    return q[..., 1:] * np.where(tiny, 2.0, angle / np.where(tiny, 1.0, sine))


def cross(a: Array, b: Array) -> Array:
    """Compute cross products of vectors (..., 3), several times as fast as `np.cross`."""
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]
