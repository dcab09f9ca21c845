"""Quasi-dynamic motion of a MuJoCo model: forces against stiffness, drag and inertia, with no velocity between steps.

A step of h begins at rest. The momentum that forces bring about is lost again by its end, so that inertia resists like
a drag M/h beside the damping D of joints, tendons and servos; K is the stiffness of servos and springs:

    (D + M/h) q̇ + K q = f,  q(0) = 0   ⟹   q(h) = R f,   R = φ(h K C⁻¹) h C⁻¹,   C = D + M/h,   φ(z) = (1 − e⁻ᶻ)/z.

R is symmetric and positive definite. What nothing holds moves by h² M⁻¹ f and falls by g h² in a step, as with an
impulse that acts at its beginning; a damped servo of gain k and damping d goes the part 1 − exp(−h k/d) of its way, and
gives way by this part of 1/k; a stiff one goes all of it. (T. Pang, H. J. T. Suh, L. Yang, R. Tedrake, "Global planning
for contact-rich manipulation via local smoothing of quasi-dynamic contact models", IEEE Trans. Robot. 2023, has the
limits D = 0, K = 0 or M = 0, of one implicit step.)

With smooth forces τ at the state x̄, at rest and with the nominal control ū, and actuators that move along the rows of G
with gains k:

    x₊ = x + R (τ + Gᵀ k (u − ū) − K_abs (x − x̄) + Jᵀ λ).

K_abs has no servos whose actions count from where they are. Springs count by their stiffness at x̄ = their reference,
and how gravity changes with x is left out.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from difflcs.errors import InvalidInputError
from difflcs.physics.complementarity import FreeMotion
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.actuators import Actuators, disabled_actuators
from difflcs.physics.mujoco.library import Places, library
from difflcs.physics.mujoco.native import flags

Array = NDArray[np.float64]
GAINS = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
BIASES = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_UNSTABLE = 30.0  # exponent up to which a motion that stiffness drives apart is followed


class Rest(NamedTuple):
    """Forces at rest in n states.

    Attributes:
        force: (n, nv) smooth forces at the nominal control, without those of contacts.
        inverse_mass: (n, nv, nv).
        moment: (n, nu, nv) derivative of the actuators' lengths.
        tendon: (n, ntendon, nv) derivative of the tendons' lengths.
        nominal: (n, nu) action at which this is.
        gain: (n, nu) force of an actuator for a unit of control.
        stiffness: (n, nu) of actuators, for a control that stays.
        damping: (n, nu) of actuators.
    """

    force: Array
    inverse_mass: Array
    moment: Array
    tendon: Array
    nominal: Array
    gain: Array
    stiffness: Array
    damping: Array


class QuasiDynamic:
    """Motion by servos, springs, gravity and given forces, at rest after each step.

    Args:
        model: a private copy.
        actuators: of the model.
        seconds: of a step [s].
        relative: actions of servos count from where they are.
    """

    def __init__(self, model: Any, actuators: Actuators, seconds: float, relative: bool):
        plain = np.isin(model.actuator_gaintype, GAINS) & np.isin(model.actuator_biastype, BIASES)
        if not (plain & actuators.follows).all():
            raise InvalidInputError(
                "model: expected actuators of fixed or affine gain and bias in quasi-dynamic motion, of no activation "
                'but filters, got others, such as muscles; replace them, or use motion="dynamic"'
            )
        self.model, self.seconds, self.actuators = model, seconds, actuators
        self.relative = actuators.servo & relative
        # force = (g₀ + g₁ length + g₂ velocity) control + b₀ + b₁ length + b₂ velocity
        self._gain = (
            model.actuator_gainprm[:, :3] * np.where(model.actuator_gaintype == GAINS[1], 1.0, [[1], [0], [0]]).T
        )
        self._bias = model.actuator_biasprm[:, :3] * (model.actuator_biastype == BIASES[1])[:, None]
        for force in (self._gain, self._bias):
            force[disabled_actuators(model)], force[actuators.drifts, 1] = 0.0, 0.0
        self._native = actuators.describe(model)
        springs, dampers = (not model.opt.disableflags & flags(name) for name in ("SPRING", "DAMPER"))
        self._tendons = model.tendon_stiffness * springs, model.tendon_damping * dampers
        self._servo_damping = getattr(model, "actuator_damping", np.zeros(model.nu)) * dampers
        self._damping = np.diag(model.dof_damping * dampers)
        straight = model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)  # slides and hinges
        self._springs = np.zeros((model.nv, model.nv))
        dofs = model.jnt_dofadr[straight]
        self._springs[dofs, dofs] = model.jnt_stiffness[straight] * springs

    def read(self, places: Places, states: Array, ctrl: Array) -> Rest:
        """Read the motion at states (n, nq + nv + na) of MuJoCo, at nominal controls (n, nu); NaN: balance.

        Raises:
            InvalidInputError: MuJoCo raised an error, or has counted a warning.
        """
        n, nv, nu, tendons = len(states), self.model.nv, self.model.nu, self.model.ntendon
        sizes = (nv, nv), (nv,), (nu,), (nu,), (nu, nv), (tendons, nv)
        arrays = mass, force, held, length, moment, tendon = [np.zeros((n, *size)) for size in sizes]
        taken = library(), self._native, places.take(n), states, np.ascontiguousarray(ctrl)
        places.check(_mujoco.read_rest(*taken, *arrays), n)
        gain = self._gain[:, 0] + self._gain[:, 1] * length
        stiffness = -self._bias[:, 1] - self._gain[:, 1] * held
        damping = np.maximum(-self._bias[:, 2] - self._gain[:, 2] * held, 0.0) + self._servo_damping
        return Rest(force, mass, moment, tendon, held - length * self.relative, gain, stiffness, damping)

    def finish(self, read: Rest, x: Array, tangent: Array | None) -> FreeMotion:
        """Return the motion at states x (n, nv), for the tangent of their rotations."""
        own = read.stiffness * self.relative
        held = self._springs + _along(read.tendon, self._tendons[0]) + _along(read.moment, read.stiffness - own)
        damping = self._damping + _along(read.tendon, self._tendons[1]) + _along(read.moment, read.damping)
        response = respond(np.linalg.inv(read.inverse_mass), damping, held + _along(read.moment, own), self.seconds)
        control = read.moment.swapaxes(-1, -2) * read.gain[:, None]
        force = np.concatenate([control, (read.force - (control @ read.nominal[:, :, None])[:, :, 0])[:, :, None]], -1)
        moved, A = response @ force, np.eye(x.shape[1]) - response @ held
        if tangent is not None:  # ζ = T (r − r̄)
            inverse = np.linalg.inv(tangent)
            moved, A = inverse @ moved, inverse @ A @ tangent
            response = inverse @ response @ inverse.swapaxes(-1, -2)
        d = x - (A @ x[:, :, None])[:, :, 0] + moved[:, :, -1]
        matrices: Any = A, np.ascontiguousarray(moved[:, :, :-1]), d, response
        return FreeMotion(*matrices)


def respond(mass: NDArray[Any], damping: Array, stiffness: Array, seconds: float) -> Array:
    """Compute R (..., nv, nv), how far a unit of force moves in a step, of symmetric matrices (..., nv, nv)."""
    inverse = np.linalg.inv(np.linalg.cholesky(damping + mass / seconds))  # L⁻¹ with C = L Lᵀ
    transposed = inverse.swapaxes(-1, -2)
    rate, modes = np.linalg.eigh(inverse @ stiffness @ transposed)
    z = np.maximum(seconds * rate, -_UNSTABLE)
    part = np.where(np.abs(z) < 1e-9, 1.0, -np.expm1(-z) / np.where(z == 0, 1.0, z))
    modes = transposed @ modes
    return seconds * (modes * part[..., None, :]) @ modes.swapaxes(-1, -2)


def _along(rows: Array, each: Array) -> Array:
    """Sum rowᵀ each row (n, nv, nv) over rows (n, k, nv) with (n, k) or (k,) factors."""
    return rows.swapaxes(-1, -2) @ (each[..., None] * rows) if rows.shape[1] else np.zeros(())
