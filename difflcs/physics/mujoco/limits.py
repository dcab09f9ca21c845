"""Limits and dry friction of joints and tendons: rows of the system that are no contacts.

A row has a velocity v = J ν and a force along Jᵀ, one-sided at a limit, between bounds in dry friction. MuJoCo's are
soft: with A = J M⁻¹ Jᵀ, impedance d and the regularisation R = (1 − d)/d · A₀ of the model, a row on which all else
brings about the acceleration a goes by

    v̇ = a + A/(A + R) (−b v − k d r − a),

its part after a being a force within the bounds. Followed through a step, in `_native/nominal.hpp`, this says how deep
a limit is passed or how far friction creeps, when in the step the force acts, and whether it does so all the time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from difflcs._checks import check_positive_int
from difflcs.errors import ContactWarning, warn
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.library import Places, library
from difflcs.physics.mujoco.motion import DynamicStep
from difflcs.physics.mujoco.native import flags, least_time

Array = NDArray[np.float64]
MOST_LIMITS = 8  # by default
_BALL, _SLIDE = int(mujoco.mjtJoint.mjJNT_BALL), int(mujoco.mjtJoint.mjJNT_SLIDE)


class Softness(NamedTuple):
    """MuJoCo's parameters of rows, (k,) of a model's or (n, k) of chosen ones.

    Attributes:
        stiffness: k, zero of friction [1/s²].
        damping: b [1/s].
        impedance: (..., 5) solimp.
        give: A₀, the inverse mass that MuJoCo estimates.
        margin: distance at which a limit begins to act.
        bound: largest force of friction; infinite for limits.
    """

    stiffness: Array
    damping: Array
    impedance: Array
    give: Array
    margin: Array
    bound: Array

    def yields(self, mass: Array | float, seconds: float) -> Array:
        """Speed (n, k) for a unit of force at which friction that holds creeps after a time, where A is `mass`."""
        d = self.impedance[..., 0].clip(1e-4, 0.9999)
        firm = (1 - d) / d * self.give
        rate = self.damping * mass / np.maximum(mass + firm, 1e-300)
        return firm / self.damping * -np.expm1(-rate * seconds)


class Rows(NamedTuple):
    """Rows of n states, k − n_friction of limits and then those of dry friction.

    Attributes:
        gap: (n, k) distance from where the limit acts; zero for friction.
        normal: (n, k, nv) derivative of the gap, or of the way that rubs, by the degrees of freedom.
        bend: (n, k) how much more the gap of a tendon grows in the step than its derivative says.
        soft: softness, (k,) or (n, k).
        n_friction: number of rows of friction.
    """

    gap: Array
    normal: Array
    bend: Array
    soft: Softness
    n_friction: int


class ScaledRows(NamedTuple):
    """Rows as the system has them, in units of a force that moves them as far as it moves contacts.

    Attributes:
        gap: (n, k) distance to where the row holds.
        normal: (n, k, nv) derivative; what the force does to ζ is h S of it.
        impulse: (n, k, nv) what the force does to ν is S of it.
        bound: (n, n_friction) largest force of friction.
        unit: (n, k) impulse along `Rows.normal` of a unit of force.
    """

    gap: Array
    normal: Array
    impulse: Array
    bound: Array
    unit: Array

    def after(self, gap: Array, normal: Array) -> ScaledRows:
        """Return these rows after contacts without friction, of gaps (n, k) and their derivatives (n, k, nv)."""
        unit = np.concatenate([np.ones_like(gap), self.unit], 1)
        along, impulse = (np.concatenate([normal, rows], 1) for rows in (self.normal, self.impulse))
        return ScaledRows(np.concatenate([gap, self.gap], 1), along, impulse, self.bound, unit)


class RowFinder:
    """Finds the rows at states.

    Args:
        model: a private copy, before its flags are changed.
        places: of the model and its data.
        limits: how many limits a state has, those nearest to acting; None: of all joints and tendons that have some, at
            most `MOST_LIMITS`, with a `ContactWarning` where more act.
        friction: False if dry friction is left out.
    """

    def __init__(self, model: Any, places: Places, limits: int | None, friction: bool):
        self.model, self._places = model, places
        disabled = model.opt.disableflags
        limits_act, rubs = (not disabled & flags("CONSTRAINT", name) for name in ("LIMIT", "FRICTIONLOSS"))
        most = MOST_LIMITS if limits is None else check_positive_int("limits", limits, minimum=0)
        limits_act = limits_act and most > 0
        limited = model.jnt_limited.astype(bool) & (model.jnt_type != int(mujoco.mjtJoint.mjJNT_FREE)) & limits_act
        self._joints = np.flatnonzero(limited & (model.jnt_type >= _SLIDE))
        self._balls = np.flatnonzero(limited & (model.jnt_type == _BALL))
        self._tendons = np.flatnonzero(model.tendon_limited.astype(bool) & limits_act)
        rubs = rubs and friction
        self._rubbing = np.flatnonzero(model.dof_frictionloss * rubs > 0)
        self._rubbing_tendons = np.flatnonzero(model.tendon_frictionloss * rubs > 0)
        self.n_friction = len(self._rubbing) + len(self._rubbing_tendons)
        joints, tendons = np.concatenate([self._joints, self._balls]), self._tendons
        of_limits = len(joints) + len(tendons)
        self._warn = limits is None
        self.n_limits = min(of_limits, most)
        self._range = np.concatenate([model.jnt_range[joints], model.tendon_range[tendons]])
        self._range[len(self._joints) : len(joints), 0] = -np.inf  # balls have the largest angle alone
        dofs, rubbing, rubbing_tendons = model.jnt_dofadr[joints], self._rubbing, self._rubbing_tendons
        self._addresses, unit = model.jnt_qposadr[self._joints], np.eye(model.nv)
        self._along, self._rubs = np.zeros((of_limits, model.nv)), unit[rubbing]
        self._along[: len(self._joints)] = unit[dofs[: len(self._joints)]]
        self._soft = Softness(
            *_reference(
                model,
                np.concatenate([model.jnt_solref[joints], model.tendon_solref_lim[tendons],
                                model.dof_solref[rubbing], model.tendon_solref_fri[rubbing_tendons]]),
                impedance := np.concatenate([model.jnt_solimp[joints], model.tendon_solimp_lim[tendons],
                                             model.dof_solimp[rubbing], model.tendon_solimp_fri[rubbing_tendons]]),
                of_limits,
            ),
            impedance,
            np.concatenate([model.dof_invweight0[dofs], model.tendon_invweight0[tendons],
                            model.dof_invweight0[rubbing], model.tendon_invweight0[rubbing_tendons]]),
            np.concatenate([model.jnt_margin[joints], model.tendon_margin[tendons], np.zeros(self.n_friction)]),
            np.concatenate([np.full(of_limits, np.inf), model.dof_frictionloss[rubbing],
                            model.tendon_frictionloss[rubbing_tendons]]),
        )  # fmt: skip

    def find(self, qpos: Array, place: Array, response: Array, middle: Array | None = None) -> Rows:
        """Find the rows, of limits those that are nearest to acting.

        Args:
            qpos: (n, nq) positions.
            place: (n, nv) ζ after the step, without the rows.
            response: (n, nv, nv) what a unit of force does to ζ or ν.
            middle: (n, nv) ζ in the middle of the step, if it has velocities.

        Raises:
            InvalidInputError: MuJoCo raised an error.
        """
        n, nv = place.shape
        if not (self.n_limits or self.n_friction):
            none = np.zeros((n, 0))
            return Rows(none, np.zeros((n, 0, nv)), none, self._soft, 0)
        (normal, gap, bend, tendons), soft = self._limits(qpos, place, middle), self._soft
        if self.n_limits < gap.shape[1]:
            gives = give_way(normal, response)
            after = np.minimum(gap, gap + (normal @ place[:, :, None])[:, :, 0])
            self._warn_of_more(after)
            # What does not give way cannot act.
            after = np.where(gives > 0, after / np.sqrt(np.maximum(gives, 1e-300)), np.inf)
            chosen = np.sort(np.argpartition(after, self.n_limits, -1)[:, : self.n_limits])
            normal, gap, bend = (values[np.arange(n)[:, None], chosen] for values in (normal, gap, bend))
            rows = np.concatenate([chosen, np.tile(np.arange(len(self._range), len(soft.bound)), (n, 1))], 1)
            soft = Softness(*(values[rows] for values in soft))
        if self.n_friction:
            rubbing = np.repeat(self._rubs[None], n, 0)
            normal = np.concatenate([normal, rubbing, tendons[:, self._rubbing_tendons]], 1)
            gap, bend = (np.concatenate([values, np.zeros((n, self.n_friction))], 1) for values in (gap, bend))
        return Rows(gap, normal, bend, soft, self.n_friction)

    def _limits(self, qpos: Array, place: Array, middle: Array | None) -> tuple[Array, Array, Array, Array]:
        """Return of all limits, of the nearer side after the step, derivatives (n, k, nv), gaps (n, k) and bends.

        And the derivatives (n, ntendon, nv) of all tendons' lengths.
        """
        model, n = self.model, len(place)
        k, balls = len(self._joints), len(self._balls)
        value, along = np.zeros((n, len(self._range))), np.repeat(self._along[None], n, 0)
        value[:, :k] = qpos[:, self._addresses]
        for row, joint in enumerate(self._balls, k):
            address, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            quaternion = qpos[:, address : address + 4]
            quaternion = quaternion * np.where(quaternion[:, :1] < 0, -1.0, 1.0)
            sine = np.linalg.norm(quaternion[:, 1:], axis=-1)
            value[:, row] = 2 * np.arctan2(sine, quaternion[:, 0])
            along[:, row, dof : dof + 3] = quaternion[:, 1:] / np.maximum(sine, 1e-12)[:, None]
        length, tendons = self._read_tendons(qpos)
        value[:, k + balls :], along[:, k + balls :] = length[:, self._tendons], tendons[:, self._tendons]
        lower, upper = value - self._range[:, 0], self._range[:, 1] - value
        moved = (along @ place[:, :, None])[:, :, 0]
        side = np.where(lower + moved < upper - moved, 1.0, -1.0)
        gap, bend = np.where(side > 0, lower, upper) - self._soft.margin[: len(self._range)], np.zeros(side.shape)
        if middle is not None and len(self._tendons):
            halfway = qpos.copy()
            for q, change in zip(halfway, middle, strict=True):
                mujoco.mj_integratePos(model, q, change, 1.0)
            longer = self._read_tendons(halfway)[0] - length - (tendons @ middle[:, :, None])[:, :, 0]
            bend[:, k + balls :] = 4 * side[:, k + balls :] * longer[:, self._tendons]
        return side[:, :, None] * along, gap, bend, tendons

    def _read_tendons(self, qpos: Array) -> tuple[Array, Array]:
        """Return lengths (n, ntendon) of tendons at positions (n, nq), and their derivatives (n, ntendon, nv)."""
        n, count = len(qpos), self.model.ntendon
        length, tendons = np.zeros((n, count)), np.zeros((n, count, self.model.nv))
        if len(self._tendons) + len(self._rubbing_tendons):
            taken = library(), self._places.take(n), np.ascontiguousarray(qpos)
            self._places.check(_mujoco.read_tendons(*taken, length, tendons), n)
        return length, tendons

    def _warn_of_more(self, after: Array) -> None:
        """Warn once if limits that act at the nominal action are dropped because of the default number."""
        acting = int((after < 0).sum(-1).max(initial=0))
        if self._warn and acting > self.n_limits:
            warn(
                f"expected at most {self.n_limits} limits of joints and tendons that act in a step, got {acting}; only "
                f"the nearest are kept, so that others are passed: pass limits={acting}, or limits={self.n_limits} if "
                f"these are enough",
                ContactWarning,
            )
            self._warn = False


def scale(rows: Rows, response: Array, give: float) -> ScaledRows:
    """Scale rows so that a unit of force moves each as far as it moves contacts; those that cannot move get zeros.

    Args:
        rows: the rows, of motion without velocities.
        response: (n, nv, nv) what a force does to the degrees of freedom.
        give: how far contacts move by it.
    """
    gives = give_way(rows.normal, response)
    least = 1e-9 * (rows.normal**2).sum(-1) * np.trace(response, axis1=-2, axis2=-1)[:, None]
    unit = np.where(gives > least, np.sqrt(give / np.where(gives > least, gives, 1.0)), 0.0)
    along, of_friction = unit[:, :, None] * rows.normal, unit[:, unit.shape[1] - rows.n_friction :]
    bound = rows.soft.bound[..., unit.shape[1] - rows.n_friction :] / np.where(of_friction > 0, of_friction, 1.0)
    return ScaledRows(unit * rows.gap, along, along, bound, unit)


def soften(
    rows: ScaledRows, found: Rows, step: DynamicStep | None, give: float, compliance: float, contacts: Array
) -> Array:
    """Compliance (n, n_contacts + k) of contacts and rows; friction in a step with velocities creeps as MuJoCo's."""
    soft = np.concatenate([contacts, np.full(rows.gap.shape, compliance)], 1)
    if step is not None and (n := found.n_friction):
        creeps = found.soft.yields(give_way(found.normal, step.inverse_mass), step.seconds)[:, -n:] / give
        soft[:, -n:] = np.maximum(compliance, rows.unit[:, -n:] ** 2 * creeps)
    return soft


def give_way(rows: Array, response: Array) -> Array:
    """Compute how far a unit of force along each of rows (n, k, nv) moves it (n, k), by responses (n, nv, nv)."""
    return ((rows @ response) * rows).sum(-1)


def _reference(model: Any, reference: Array, impedance: Array, of_limits: int) -> tuple[Array, Array]:
    """Compute k and b (k,) of solref (k, 2) and solimp (k, 5); the first `of_limits` have a stiffness."""
    most = np.clip(impedance[:, 1], 1e-4, 0.9999)
    time, ratio = reference.T
    time = np.where(time > 0, np.maximum(time, least_time(model)), time)
    standard = time > 0
    inverse = 1 / np.where(standard, most * time, 1.0)
    stiffness = np.where(standard, (inverse / np.where(standard, ratio, 1.0)) ** 2, -time / most**2)
    stiffness[of_limits:] = 0.0
    return stiffness, np.where(standard, 2 * inverse, -ratio / most)
