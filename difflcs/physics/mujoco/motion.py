"""What a MuJoCo model does in one step without contact: quasi-static, or with velocities.

With velocities, MuJoCo's acceleration is linearised where the state is, ζ from there and ν the velocity:

    ν̇ = a + K ζ + D (ν − ν̄) + B u,    ζ̇ = ν.

K, D and B are finite differences that `mjd_transitionFD` computes natively: gravity, Coriolis forces, springs,
damping, gears and servos are all in them. A step of h solves these equations exactly. A contact force acts as one
impulse f at the beginning, through the same equations but implicitly, so that what a stiff servo holds gives way
little: it changes ν by S f and ζ by h S f with S = (1 − h D − h² K)⁻¹ M⁻¹.

A load that acts all the time, such as gravity, moves a body by h²/2 in a step where that impulse moves it by h². So a
contact that balances the place of a body at rest would leave it with a velocity. Where a contact is about to close,
loads are therefore impulses at the beginning too, in the directions that the contact can balance.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from difflcs.errors import InvalidInputError
from difflcs.physics.contacts import FreeMotion
from difflcs.physics.mujoco.contacts import Found

Array = NDArray[np.float64]

_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_SCALAR = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
_FIXED, _AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_AFFINE)
_OFF = ("CONSTRAINT", "CLAMPCTRL", "EULERDAMP")


class Actuators:
    """Which actuators are position servos on joints, and what they move.

    Attributes:
        dof: (nu,) degree of freedom of each actuator on a slide or hinge; −1 for others.
        gear: (nu,).
        servo: (nu,) whether it is a `position` actuator on a slide or hinge.
        offset: (nu,) at which length a servo rests with ctrl = 0, by the constant part of its bias; 0 for others.
    """

    def __init__(self, model: Any):
        joint = model.actuator_trnid[:, 0]
        on_joint = model.actuator_trntype == _JOINT
        self.dof = np.full(model.nu, -1)
        for i in np.flatnonzero(on_joint):
            if model.jnt_type[joint[i]] in _SCALAR:
                self.dof[i] = model.jnt_dofadr[joint[i]]
        self.gear = model.actuator_gear[:, 0].copy()
        gain, (constant, bias) = model.actuator_gainprm[:, 0], model.actuator_biasprm.T[:2]
        linear = (model.actuator_gaintype == _FIXED) & (model.actuator_biastype == _AFFINE) & (gain != 0)
        self.servo = (self.dof >= 0) & linear & (np.abs(gain + bias) <= 1e-9 * np.abs(gain))
        self.offset = np.where(self.servo, constant / np.where(gain != 0, gain, 1.0), 0.0)


class QuasiStatic:
    """Joints with actuators go where they are told; all else moves only while pushed, by its mobility times the force.

    Args:
        model: ours.
        actuators: of the model.
        mobility: "inertia": the inverse of the mass matrix; "damping": of the joints' damping; or what a unit of force
            on each degree of freedom does, (nv,) or (nv, nv).
    """

    def __init__(self, model: Any, actuators: Actuators, mobility: str | Array):
        if not model.nu:
            raise InvalidInputError(
                'model: expected actuators on what is moved, got none; add <position joint="..."/> for each joint'
            )
        if (actuators.dof < 0).any() or len(set(actuators.dof)) < model.nu:
            raise InvalidInputError(
                "model: expected each actuator on a slide or hinge of its own for quasi-static motion, got others; "
                'change them, or use motion="dynamic"'
            )
        self.model = model
        self.pushed = np.setdiff1d(np.arange(model.nv), actuators.dof)
        self.B = np.zeros((model.nv, model.nu))
        self.B[actuators.dof, np.arange(model.nu)] = 1.0
        self.mobility = None if isinstance(mobility, str) and mobility == "inertia" else self._fixed(mobility)

    def _fixed(self, mobility: str | Array) -> Array:
        nv = self.model.nv
        if isinstance(mobility, str):
            damping = self.model.dof_damping[self.pushed]
            if (damping <= 0).any():
                raise InvalidInputError(
                    'mobility: expected damping above 0 of all joints that are pushed with "damping", got '
                    f'{float(damping.min()):g}; set it in the model, use "inertia", or give the mobility'
                )
            fixed = np.zeros(nv)
            fixed[self.pushed] = 1 / damping
        else:
            fixed = np.asarray(mobility, dtype=np.float64)
        fixed = np.diag(fixed) if fixed.ndim == 1 else fixed
        if fixed.shape != (nv, nv) or not np.isfinite(fixed).all():
            raise InvalidInputError(
                f"mobility: expected finite numbers ({nv},) or ({nv}, {nv}), got {fixed.shape}; one for each degree of "
                f"freedom"
            )
        return fixed

    def allocate(self, n: int) -> Array:
        """Inverse mass matrices of n states."""
        return np.zeros((n, self.model.nv, self.model.nv))

    def read(self, i: int, data: Any, arrays: Array) -> None:
        """At the state in `data`, for which `mj_fwdPosition` was called."""
        if self.mobility is None:
            mujoco.mj_solveM(self.model, data, arrays[i], np.eye(self.model.nv))

    def finish(self, arrays: Array, x: Array, tangent: Array | None, found: Found) -> FreeMotion:
        """The motion at states x (n, nv), whatever touches."""
        del found
        n, nv = x.shape
        if self.mobility is None:
            block = np.ix_(np.arange(n), self.pushed, self.pushed)
            response = np.zeros((n, nv, nv))
            # What the servos hold does not give way, so the mass matrix counts without their rows.
            response[block] = np.linalg.inv(np.linalg.inv(arrays)[block])
        else:
            response = self.mobility
        if tangent is not None:
            inverse = np.linalg.inv(tangent)
            response = inverse @ response @ inverse.swapaxes(-1, -2)
        tensors = (torch.from_numpy(v) for v in (np.eye(nv), self.B, np.zeros(nv), response))
        return FreeMotion(*tensors)


class Dynamic:
    """All forces that MuJoCo knows but those of its constraints, linearised at each state.

    Args:
        model: ours; constraints and limits of controls and actuators are switched off while it is linearised.
        actuators: of the model.
        seconds: of a step [s].
        relative: actions of servos count from where they are.
    """

    def __init__(self, model: Any, actuators: Actuators, seconds: float, relative: bool):
        self.model, self.seconds = model, seconds
        self.relative = np.flatnonzero(actuators.servo) if relative else np.zeros(0, dtype=np.intp)
        self.moment = np.zeros((model.nu, model.nv))
        self.moment[self.relative, actuators.dof[self.relative]] = actuators.gear[self.relative]
        # With a time step of one second and no implicit part, the next velocity is ν + acceleration.
        self.flags = sum(int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in _OFF)
        model.opt.timestep, model.opt.integrator = 1.0, mujoco.mjtIntegrator.mjINT_EULER
        for limited in ("actuator_forcelimited", "actuator_ctrllimited", "jnt_actfrclimited", "tendon_actfrclimited"):
            getattr(model, limited)[:] = 0

    def allocate(self, n: int) -> tuple[Array, Array, Array, Array]:
        """Accelerations, transition matrices and inverse mass matrices of n states."""
        nv, nu = self.model.nv, self.model.nu
        return np.zeros((n, nv)), np.zeros((n, 2 * nv, 2 * nv)), np.zeros((n, 2 * nv, nu)), np.zeros((n, nv, nv))

    def read(self, i: int, data: Any, arrays: tuple[Array, Array, Array, Array]) -> None:
        """At the state in `data`, for which `mj_fwdPosition` was called."""
        acceleration, A, B, inverse_mass = arrays
        options, model = self.model.opt, self.model
        mujoco.mj_solveM(model, data, inverse_mass[i], np.eye(model.nv))
        before = options.disableflags
        options.disableflags = before | self.flags
        data.ctrl[:] = 0.0
        data.ctrl[self.relative] = data.actuator_length[self.relative]
        mujoco.mj_forward(model, data)
        acceleration[i] = data.qacc
        mujoco.mjd_transitionFD(model, data, 1e-6, 0, A[i], B[i], None, None)
        options.disableflags = before

    def finish(
        self, arrays: tuple[Array, Array, Array, Array], x: Array, tangent: Array | None, found: Found
    ) -> FreeMotion:
        """The motion at states x (n, 2 nv), with these contacts."""
        n, nv, h = len(x), self.model.nv, self.seconds
        acceleration, A, B, inverse_mass = arrays
        K, D, B = A[:, nv:, :nv], A[:, nv:, nv:] - np.eye(nv), B[:, nv:]
        velocity = x[:, nv:]
        load = acceleration - np.einsum("nij,nj->ni", D, velocity)  # the acceleration with ν = 0, ζ = 0 and u = 0
        step = self._solve(K, D, B, load)
        place = step[:, :nv, -1] + np.einsum("nij,nj->ni", step[:, :nv, nv : 2 * nv], velocity)
        closing = _closing(place, inverse_mass, found)
        step[:, :nv, -1] += _balanced(step[:, :, -1], inverse_mass, found.normal * closing[:, :, None], h)
        # The control of a servo is held through the step, at a distance from where the joint was at its beginning.
        step[:, :, :nv] += step[:, :, 2 * nv : -1] @ self.moment
        to_x = np.zeros((n, 2 * nv, 2 * nv))
        to_x[:] = np.eye(2 * nv)
        of_x = to_x
        if tangent is not None:  # ζ = T (r − r̄)
            of_x = to_x.copy()
            of_x[:, :nv, :nv], to_x[:, :nv, :nv] = tangent, np.linalg.inv(tangent)
        at = np.concatenate([x[:, :nv], np.zeros_like(velocity)], -1)
        A_x = to_x @ step[:, :, : 2 * nv] @ of_x
        d = at - np.einsum("nij,nj->ni", A_x, at) + np.einsum("nij,nj->ni", to_x, step[:, :, -1])
        impulse = np.linalg.solve(np.eye(nv) - h * D - h * h * K, inverse_mass)
        response = np.zeros((n, 2 * nv, 2 * nv))
        response[:, :, :nv] = to_x @ np.concatenate([h * impulse, impulse], 1) @ to_x[:, :nv, :nv].swapaxes(-1, -2)
        tensors = (torch.from_numpy(v) for v in (A_x, to_x @ step[:, :, 2 * nv : -1], d, response))
        return FreeMotion(*tensors)

    def _solve(self, K: Array, D: Array, B: Array, load: Array) -> Array:
        """(ζ, ν) after the step as a matrix (n, 2 nv, 2 nv + nu + 1) of ζ, ν, u and 1."""
        n, nv, size = len(K), K.shape[-1], 2 * K.shape[-1] + B.shape[-1] + 1
        h, rate = self.seconds, np.zeros((n, size, size))
        # Of (ζ, h ν): the norm of the matrix, which says what its exponential costs, is less in this unit.
        rate[:, :nv, nv : 2 * nv] = np.eye(nv)
        rate[:, nv : 2 * nv] = np.concatenate([h * h * K, h * D, h * h * B, h * h * load[:, :, None]], -1)
        grown: Tensor = torch.linalg.matrix_exp(torch.from_numpy(rate))
        step = grown[:, : 2 * nv].numpy()
        step[:, :, nv : 2 * nv] *= h
        step[:, nv:] /= h
        return step


def _closing(place: Array, inverse_mass: Array, found: Found) -> NDArray[np.bool_]:
    """Which contacts (n, n_contacts) close where bodies go to ζ (n, nv), as those below in a stack are held up."""

    def gap(place: Array) -> Array:
        return found.gap + np.einsum("nkv,nv->nk", found.normal, place)

    closing = gap(place) < 0
    for _ in range(closing.shape[1]):
        held = place + _pushed(inverse_mass, found.normal * closing[:, :, None], np.where(closing, -gap(place), 0.0))
        more = closing | (gap(held) < 0)
        if (more == closing).all():
            break
        closing = more
    return closing


def _balanced(moved: Array, inverse_mass: Array, rows: Array, h: float) -> Array:
    """What is added to ζ (n, nv), moved by loads as (ζ, ν) `moved`, where contacts `rows` are about to balance them."""
    nv = moved.shape[-1] // 2
    return _pushed(inverse_mass, rows, (rows @ (h * moved[:, nv:] - moved[:, :nv])[:, :, None])[:, :, 0])


def _pushed(inverse_mass: Array, rows: Array, by: Array) -> Array:
    """How far ζ (n, nv) goes when forces along `rows` (n, n_contacts, nv) move these `by` (n, n_contacts)."""
    if not rows.any():
        return np.zeros((len(rows), rows.shape[-1]))
    gives = inverse_mass @ rows.swapaxes(-1, -2)
    inner = rows @ gives
    # Contacts of one face are not independent.
    scale = np.trace(inner, axis1=-2, axis2=-1)[:, None, None]
    inner += np.eye(inner.shape[-1]) * np.where(scale > 0, 1e-9 * scale, 1.0)
    force = np.linalg.solve(inner, by[:, :, None])
    return (gives @ force)[:, :, 0]
