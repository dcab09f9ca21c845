"""Motion of a MuJoCo model in one step without contact: quasi-static, or with velocities.

With velocities, MuJoCo simulates what a nominal control ū does from the state, and its acceleration is linearised half
way there, with ζ the change of position and ν the velocity:

    ν̇ = a + K ζ + D (ν − ν̄) + B (u − ū),    ζ̇ = ν.

K, D and B are finite differences that `mjd_transitionFD` computes natively: gravity, Coriolis forces, springs, damping,
gears and servos are all in them. What differs from the simulation takes the time steps of the model's own integrator.

A contact force acts as one impulse f at the beginning of the step, implicitly, so that what a stiff servo holds gives
way little: it changes ν by S f and ζ by h S f with S = (M + [h (−M D) + h² (−M K)]₊)⁻¹, where [·]₊ is the part of the
symmetric matrix that resists motion (its positive eigenvalues, in the metric of M). So S is positive definite in every
state and for every step, also where Coriolis forces or an unstable equilibrium would make an implicit step indefinite.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from difflcs.errors import InvalidInputError
from difflcs.physics.complementarity import FreeMotion

Array = NDArray[np.float64]

_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_SCALAR = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
_FIXED, _AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_AFFINE)
_BEYOND = 1e6  # a motion in a step [m, rad] and its velocity that no model has
_MOST, _FEW = 10, 4  # steps that are simulated one by one; where there are more, so many as long ones
_EULER, _RK4, _IMPLICIT, _FAST = (
    int(getattr(mujoco.mjtIntegrator, f"mjINT_{name}")) for name in ("EULER", "RK4", "IMPLICIT", "IMPLICITFAST")
)
_ADVANCE = {
    _EULER: mujoco.mj_Euler,
    _RK4: lambda model, data: mujoco.mj_RungeKutta(model, data, 4),
    _IMPLICIT: mujoco.mj_implicit,
    _FAST: mujoco.mj_implicit,
}


class Actuators:
    """The actuators of a model: which are position servos on joints, and which joints they move.

    Attributes:
        dof: (nu,) degree of freedom of each actuator on a slide or hinge; −1 for others.
        gear: (nu,).
        servo: (nu,) True for a `position` actuator on a slide or hinge.
        offset: (nu,) at which length a servo rests with ctrl = 0, by the constant part of its bias; 0 for others.
        holds: (nu,) True if its force falls to zero at some length, as that of servos on joints, tendons or sites does.
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
        self.holds = linear & (bias != 0)
        self._gain, self._constant, self._bias = np.where(gain != 0, gain, 1.0), constant.copy(), bias.copy()
        self.offset = np.where(self.servo, constant / self._gain, 0.0)

    def balance(self, length: Array) -> Array:
        """Controls (nu,) at which actuators that hold a length have no force at these lengths (nu,); 0 for others."""
        return np.where(self.holds, -(self._constant + self._bias * length) / self._gain, 0.0)


def disabled_actuators(model: Any) -> NDArray[np.bool_]:
    """Return a mask (nu,) of actuators that do nothing, by their groups or a flag of the model."""
    groups = model.actuator_group
    disabled = (groups >= 0) & (groups < 31) & (model.opt.disableactuator >> groups.clip(0, 30) & 1 > 0)
    return disabled | bool(model.opt.disableflags & _flags("ACTUATION"))


def tendon_jacobian(model: Any, data: Any) -> Array:
    """Return the derivative (ntendon, nv) of the tendons' lengths, which newer versions of MuJoCo keep sparse."""
    jacobian = np.zeros((model.ntendon, model.nv))
    if data.ten_J.size == jacobian.size:
        return data.ten_J.reshape(jacobian.shape)
    where = (
        getattr(data if hasattr(data, name) else model, name)
        for name in ("ten_J_rownnz", "ten_J_rowadr", "ten_J_colind")
    )
    mujoco.mju_sparse2dense(jacobian, data.ten_J.reshape(-1), *(v.reshape(-1) for v in where))
    return jacobian


class QuasiStatic:
    """Joints with actuators go where they are told; all else moves only while pushed, by its mobility times the force.

    Args:
        model: a private copy.
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
        """Make a buffer for the inverse mass matrices of n states."""
        return np.zeros((n, self.model.nv, self.model.nv))

    def read(self, i: int, data: Any, arrays: Array, ctrl: Array) -> None:
        """Read the state in `data`, for which `mj_fwdPosition` was called; the controls do not matter."""
        del ctrl
        if self.mobility is None:
            mujoco.mj_solveM(self.model, data, arrays[i], np.eye(self.model.nv))

    def finish(self, arrays: Array, x: Array, tangent: Array | None) -> FreeMotion:
        """Return the motion at states x (n, nv), for the tangent of their rotations."""
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
        tensors = (torch.from_numpy(v) for v in (np.eye(nv), self.B.copy(), np.zeros(nv), response))
        return FreeMotion(*tensors)


class Dynamic:
    """Motion by all forces of MuJoCo except those of its constraints, linearised at each state.

    Args:
        model: a private copy; constraints and limits of controls and actuators are switched off while it is linearised.
        actuators: of the model.
        seconds: of a step [s].
        relative: actions of servos count from where they are.
    """

    def __init__(self, model: Any, actuators: Actuators, seconds: float, relative: bool):
        self.model, self.seconds, self.actuators = model, seconds, actuators
        self.relative = np.flatnonzero(actuators.servo) if relative else np.zeros(0, dtype=np.intp)
        self.moment = np.zeros((model.nu, model.nv))
        self.moment[self.relative, actuators.dof[self.relative]] = actuators.gear[self.relative]
        self.steps = Steps(max(1, round(seconds / model.opt.timestep)), int(model.opt.integrator))
        coarse = self.steps.integrator if self.steps.integrator == _RK4 else _IMPLICIT
        self.simulated = self.steps if self.steps.count <= _MOST else Steps(_FEW, coarse)
        damped = not model.opt.disableflags & _flags("EULERDAMP")
        self.damping = model.dof_damping.copy() if damped else np.zeros(model.nv)
        self.tree = np.array(model.dof_treeid)
        self.firm = np.isin(
            self.tree, np.setdiff1d(self.tree, self.tree[np.setdiff1d(np.arange(model.nv), actuators.dof)])
        )
        self.flags = _flags("CONSTRAINT", "CLAMPCTRL")
        for limited in ("actuator_forcelimited", "actuator_ctrllimited", "jnt_actfrclimited", "tendon_actfrclimited"):
            getattr(model, limited)[:] = 0

    def allocate(self, n: int) -> Linearised:
        """Make buffers for n states."""
        nv, nu = self.model.nv, self.model.nu
        sizes = ((2 * nv,), (self.model.ntendon,), (nv,), (2 * nv, 2 * nv), (2 * nv, nu), (nv, nv), (nu,), (2 * nv,))
        return Linearised(*(np.zeros((n, *size)) for size in sizes))

    def read(self, i: int, data: Any, into: Linearised, ctrl: Array) -> None:
        """Read the state in `data`, for which `mj_fwdPosition` was called, at nominal controls (nu,); NaN: balance."""
        model, options, nv = self.model, self.model.opt, self.model.nv
        before = options.disableflags, options.timestep, options.integrator
        qpos, qvel = data.qpos.copy(), data.qvel.copy()
        mujoco.mj_solveM(model, data, into.inverse_mass[i], np.eye(model.nv))
        data.ctrl[:] = np.where(np.isnan(ctrl), self.actuators.balance(data.actuator_length), ctrl)
        into.nominal[i] = data.ctrl
        into.nominal[i, self.relative] -= data.actuator_length[self.relative]
        half = self.simulated.count // 2
        self._simulate(data, half)
        # With a time step of one second and no implicit part, the next velocity is ν + acceleration.
        options.disableflags |= self.flags | _flags("EULERDAMP")
        options.timestep, options.integrator = 1.0, _EULER
        mujoco.mj_forward(model, data)
        if not np.abs(data.qacc).max() < _BEYOND**1.5:  # a simulation that diverges says nothing
            data.qpos[:], data.qvel[:] = qpos, qvel
            mujoco.mj_forward(model, data)
        mujoco.mj_differentiatePos(model, into.middle[i, :nv], 1.0, qpos, data.qpos)
        into.middle[i, nv:], into.acceleration[i], into.length[i] = data.qvel, data.qacc, data.ten_length
        mujoco.mjd_transitionFD(model, data, 1e-6, 0, into.A[i], into.B[i], None, None)
        options.disableflags, options.timestep, options.integrator = before
        self._simulate(data, self.simulated.count - half)
        mujoco.mj_differentiatePos(model, into.reached[i, :nv], 1.0, qpos, data.qpos)
        into.reached[i, nv:] = data.qvel
        data.qpos[:], data.qvel[:] = qpos, qvel

    def _simulate(self, data: Any, steps: int) -> None:
        """Simulate without the checks of `mj_step`, which warn of a motion that grows."""
        options = self.model.opt
        before = options.disableflags, options.timestep, options.integrator
        options.disableflags, options.timestep = before[0] | self.flags, self.seconds / self.simulated.count
        options.integrator = self.simulated.integrator
        for _ in range(steps):
            mujoco.mj_forward(self.model, data)
            _ADVANCE[self.simulated.integrator](self.model, data)
        options.disableflags, options.timestep, options.integrator = before

    def finish(self, read: Linearised, x: Array) -> DynamicStep:
        """Return the motion at states x (n, 2 nv)."""
        nv, h = self.model.nv, self.seconds
        K, D, B = read.A[:, nv:, :nv], read.A[:, nv:, nv:] - np.eye(nv), read.B[:, nv:]
        # With ν = 0, ζ = 0 and u = ū.
        load = read.acceleration - np.einsum("nij,nj->ni", np.concatenate([K, D], -1), read.middle)
        forces, mass = (
            np.concatenate([K, D, B, load[:, :, None]], -1),
            np.linalg.inv(read.inverse_mass).astype(np.float64),
        )
        response = _implicit_response(mass, K, D, h)
        # Of a step in which a motion grows beyond all bounds, what is linear and explicit says nothing.
        step, implicit = self._steps(mass, forces, self.steps), self._implicit(response @ mass, forces)
        step = np.where((np.abs(step).max((1, 2)) < _BEYOND)[:, None, None], step, implicit)
        # The simulation says what is not linear, by its difference to the same steps of the linear motion.
        same = self.simulated == self.steps
        simulated = step if same else self._steps(mass, forces, self.simulated)
        more = read.reached - _reached(simulated, x)
        step[:, :, -1] += np.where((np.abs(more).max(1) < _BEYOND)[:, None], more, 0.0)
        place = _reached(step, x)[:, :nv]
        return DynamicStep(self, x, step, implicit - step, response, read.inverse_mass, place, read.nominal)

    def _steps(self, mass: Array, forces: Array, steps: Steps) -> Array:
        """(ζ, ν) after the step as a matrix (n, 2 nv, 2 nv + nu + 1) of ζ, ν, u − ū and 1; `forces` is that of ν̇."""
        n, nv, of = forces.shape
        h, one = self.seconds / steps.count, np.zeros((n, of, of))
        if steps.integrator == _RK4:
            unit = np.ones(of)
            unit[nv : 2 * nv] = h  # of (ζ, h ν) the norm, which says what an exponential costs, is less
            one[:, :nv, nv : 2 * nv], one[:, nv : 2 * nv] = h * np.eye(nv), h * forces
            grown: Tensor = torch.linalg.matrix_exp(torch.from_numpy(one * unit[:, None] / unit))
            one = grown.numpy() * unit / unit[:, None]
        else:
            implicit = np.diag(self.damping) if steps.integrator == _EULER else -mass @ forces[:, :, nv : 2 * nv]
            one[:] = np.eye(of)
            one[:, nv : 2 * nv] += h * np.linalg.solve(mass + h * implicit, mass @ forces)
            one[:, :nv] += h * one[:, nv : 2 * nv]
        with np.errstate(over="ignore", invalid="ignore"):
            return np.linalg.matrix_power(one, steps.count)[:, : 2 * nv]

    def _implicit(self, resists: Array, forces: Array) -> Array:
        """Compute the same by one implicit step, which keeps (n, nv, nv) `resists` = S M of the change in velocity."""
        nv, h = self.model.nv, self.seconds
        one = h * forces
        one[:, :, nv : 2 * nv] = np.eye(nv)
        velocity = resists @ one
        place = h * velocity
        place[:, :, :nv] += np.eye(nv)
        return np.concatenate([place, velocity], 1)


class Steps(NamedTuple):
    """Number of MuJoCo's steps in one of ours, and their integrator."""

    count: int
    integrator: int


class Linearised(NamedTuple):
    """Linearised motion of n states.

    Attributes:
        middle: (n, 2 nv) where the nominal control leads in half a step; all is linearised there.
        length: (n, ntendon) of tendons there.
        acceleration: (n, nv) with the nominal control.
        A: (n, 2 nv, 2 nv) transition by position and velocity in one second of Euler's method.
        B: (n, 2 nv, nu) by control.
        inverse_mass: (n, nv, nv).
        nominal: (n, nu) action at which this is.
        reached: (n, 2 nv) where the nominal control leads in a step.
    """

    middle: Array
    length: Array
    acceleration: Array
    A: Array
    B: Array
    inverse_mass: Array
    nominal: Array
    reached: Array


class DynamicStep(NamedTuple):
    """A step from n states.

    Attributes:
        motion: the motion.
        x: (n, 2 nv) the states.
        step: (n, 2 nv, 2 nv + nu + 1) (ζ, ν) afterwards, of ζ, ν, u − ū and 1.
        delayed: (n, 2 nv, 2 nv + nu + 1) difference of an implicit step, with all loads at its beginning, to that.
        response: (n, nv, nv) S.
        inverse_mass: (n, nv, nv).
        place: (n, nv) ζ afterwards with the nominal action.
        idle: (n, nu) the nominal action.
    """

    motion: Dynamic
    x: Array
    step: Array
    delayed: Array
    response: Array
    inverse_mass: Array
    place: Array
    idle: Array

    @property
    def seconds(self) -> float:
        """Duration of the step [s]."""
        return self.motion.seconds

    @property
    def tree(self) -> NDArray[np.intp]:
        """(nv,) degrees of freedom that belong together: those of different trees move each other by contacts alone."""
        return self.motion.tree

    @property
    def firm(self) -> Array:
        """(n, nv, nv) S if bodies with an actuator at every joint do not give way, as may be with another action."""
        loose = ~self.motion.firm
        return self.response * (loose & loose[:, None])

    def free(self, tangent: Array | None, carried: Array | float = 0.0) -> FreeMotion:
        """Motion without contact, with `carried` added to `step`, for the tangent of the state's rotations."""
        motion, x, step = self.motion, self.x, self.step + carried
        n, nv, h = len(x), motion.model.nv, motion.seconds
        # The control of a servo is held through the step, at a distance from where the joint was at its beginning.
        control = step[:, :, 2 * nv : -1]
        step[:, :, :nv] += control @ motion.moment
        step[:, :, -1] -= np.einsum("nij,nj->ni", control, self.idle)
        to_x = np.zeros((n, 2 * nv, 2 * nv))
        to_x[:] = np.eye(2 * nv)
        of_x = to_x
        if tangent is not None:  # ζ = T (r − r̄)
            of_x = to_x.copy()
            of_x[:, :nv, :nv], to_x[:, :nv, :nv] = tangent, np.linalg.inv(tangent)
        at = np.concatenate([x[:, :nv], np.zeros((n, nv))], -1)
        A_x = to_x @ step[:, :, : 2 * nv] @ of_x
        d = at - np.einsum("nij,nj->ni", A_x, at) + np.einsum("nij,nj->ni", to_x, step[:, :, -1])
        impulse, response = self.response, np.zeros((n, 2 * nv, 2 * nv))
        response[:, :, :nv] = to_x @ np.concatenate([h * impulse, impulse], 1) @ to_x[:, :nv, :nv].swapaxes(-1, -2)
        return FreeMotion(*(torch.from_numpy(v) for v in (A_x, to_x @ control, d, response)))

    def effect(self, tangent: Array | None, normal: Array, impulse: Array) -> Array:
        """What forces do to the next state (n, 2 nv, k): ζ moves by h S `normal` (n, k, nv), ν by S `impulse`."""
        h = self.seconds
        place, velocity = (self.response @ rows.swapaxes(-1, -2) for rows in (h * normal, impulse))
        return np.concatenate([place if tangent is None else np.linalg.solve(tangent, place), velocity], 1)


def _reached(step: Array, x: Array) -> Array:
    """Compute (ζ, ν) after a step (n, 2 nv, 2 nv + nu + 1) from ζ = 0 with the velocities of x (n, 2 nv) and u = ū."""
    nv = x.shape[1] // 2
    return step[:, :, -1] + (step[:, :, nv : 2 * nv] @ x[:, nv:, None])[:, :, 0]


def _flags(*names: str) -> int:
    return sum(int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in names)


def _implicit_response(mass: Array, K: Array, D: Array, h: float) -> Array:
    """S (n, nv, nv), the change of velocity by an impulse, with forces that resist motion treated implicitly."""
    lower = np.linalg.cholesky(mass)
    resists = -h * mass @ (D + h * K)
    resists = 0.5 * (resists + resists.swapaxes(-1, -2))
    scaled = np.linalg.solve(lower, np.linalg.solve(lower, resists).swapaxes(-1, -2))
    size, directions = np.linalg.eigh(0.5 * (scaled + scaled.swapaxes(-1, -2)))
    directions = np.linalg.solve(lower.swapaxes(-1, -2), directions)
    return directions / (1 + np.maximum(size, 0.0))[:, None] @ directions.swapaxes(-1, -2)
