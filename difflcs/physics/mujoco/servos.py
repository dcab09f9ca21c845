"""Servos that are told to push harder than they can.

A servo is part of the motion without contact. Where it moves by G Δx in a step, its force is

    τ = α u − r G Δx + what it has at the nominal action,

with its stiffness and its damping over the step in r, and α so that without contact the action does what it does in the
system. Two multipliers for each servo take away what is more than its limits allow:

    0 ≤ p₁ ⊥ upper − (τ − p₁ + p₂) ≥ 0,    0 ≤ p₂ ⊥ (τ − p₁ + p₂) − lower ≥ 0.

They move what the servo moves, by R Gᵀ with the response R of the system, and so act on each other by 1/r − G R Gᵀ,
which is positive as the servo is in R. Their coupling to all other forces is skew, so that F + Fᵀ stays positive
definite. A velocity changes as if the action was smaller.
"""

from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from difflcs.errors import ContactWarning, warn
from difflcs.physics.mujoco.actuators import Actuators
from difflcs.records import LCSParams

Array = NDArray[np.float64]
_WEAK = 0.8  # part of its force that motion leaves of it, below which a servo pushes much harder than it can
_LEAST = 1e-3  # of this part
_DRIVES = 0.2, 3.0  # α, in parts of the gain: else motion is not what the servo makes it, and it has no limits
_GIVES_BACK = 1e-4  # part of what is taken away, for multipliers that are unique


class Servos:
    """The servos of a model that may push much harder than they can: on slides, hinges, and tendons of these alone.

    Args:
        model: the model.
        data: its data, for which `mj_fwdPosition` was called.
        actuators: its actuators.
        relative: actions of servos count from where they are.
        seconds: of a step [s].
        dynamic: True if there are velocities, so that a force of the system is an impulse.

    Attributes:
        those: (k,) their numbers; none before `choose`.
        moment: (nu, nv) derivative of the actuators' lengths.
    """

    def __init__(self, model: Any, data: Any, actuators: Actuators, relative: bool, seconds: float, dynamic: bool):
        self.actuators, self.those = actuators, np.zeros(0, dtype=np.intp)
        self._model, self._relative = model, actuators.servo & relative
        self._seconds, self._dynamic = seconds, dynamic
        self.moment = np.zeros((model.nu, model.nv))
        if model.nu:
            mujoco.mju_sparse2dense(
                self.moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
            )
        self._resists = -actuators.bias - actuators.damping * (dynamic / seconds)

    def choose(self, response: Array) -> None:
        """Choose them by how far a unit of force moves the degrees of freedom in a step, (nv, nv).

        Warns:
            ContactWarning: servos with activation in dynamic motion, and those on anything else, have no limits.
        """
        of, least = self.actuators, np.abs(self.actuators.force).min(0)
        left = 1 - self._resists * ((self.moment @ response) * self.moment).sum(-1)
        weak = of.affine & (left < _WEAK) & (np.ptp(of.range, axis=0) * np.abs(of.gain) > least) & np.isfinite(least)
        limited = of.straight & ~(np.isin(np.arange(len(least)), of.activated) & self._dynamic)
        self.those = np.flatnonzero(weak & limited)
        if (others := np.flatnonzero(weak & ~limited)).size:
            i = int(others[left[others].argmin()])
            warn(
                f"expected servos that push no harder than they can, got actuator {self._model.actuator(i).name or i}, "
                f"which may push up to {1 / max(left[i], _LEAST):.3g} times as hard against a contact, and whose force "
                f"has no limits in the system, as it has activation or is on no joint and no tendon of joints alone: "
                f"take fewer seconds, or keep its actions small",
                ContactWarning,
            )

    def limit(self, system: LCSParams, free: Any, step: Any, read: Any, length: float, give: float) -> LCSParams:
        """Add their multipliers to systems, after all others: p₁ of all, then p₂ of all.

        Args:
            system: the systems, in any batch dimensions.
            free: the motion without contact, in arrays of n states.
            step: the dynamic step, or None.
            read: the states, and the motion as it was read there.
            length: unit of gaps.
            give: how far a unit of force of the system moves contacts.
        """
        those, of, (n, n_x), nu = self.those, self.actuators, read.x.shape, len(self._relative)
        if not (k := len(those)):
            return system
        x, moved, nominal, rows = read.x, read.moved, read.moved.nominal, self.moment[those]
        nv, batch, of_step = rows.shape[1], system.C.shape[:-2], self._seconds if self._dynamic else 1.0

        def along(change: Array) -> Array:
            """Ways (n, k) of servos, by changes of the degrees of freedom in (n, n_x)."""
            return change[:, :nv] @ rows.T

        each = np.broadcast_to(rows, (n, *rows.shape))
        effect = free.response @ rows.T if step is None else step.effect(*2 * [of_step * each])
        gives = (rows * effect[:, :nv].swapaxes(-1, -2)).sum(-1)
        gives = np.where(moves := gives > 0, gives, 1.0)  # equality constraints may hold it wholly
        alone = self._seconds**2 * ((rows @ moved.inverse_mass) * rows).sum(-1)
        gain, bias, own = of.gain[those], of.bias[those], (of.gain * self._relative)[those]
        # Without the servo nothing gives way more than by its inertia.
        r = np.clip(1 / gives - 1 / alone, 1e-9 * self._resists[those], self._resists[those])
        drives = np.moveaxis(rows @ free.B[:, :nv], 0, -1)[np.arange(k), those].T / gives
        reached = (free.A @ x[:, :, None] + free.B @ nominal[:, :, None])[:, :, 0] + free.d
        (low, high), rests = of.force[:, those], along(x) * (own + bias) + nominal[:, those] * gain + of.constant[those]
        if self._dynamic:
            force = rests + along(moved.middle) * bias + along(moved.middle[:, nv:]) * of.damping[those]
            acts = (low <= force) & (force <= high) & (_DRIVES[0] < drives / gain) & (drives / gain < _DRIVES[1])
            drives = np.where(acts, drives, gain)
            effect[:, nv : 2 * nv] = free.B[:, nv : 2 * nv, those] / drives[:, None]
        else:
            force, acts = np.clip(rests, low, high) + along(reached - x) * bias, moves
        # τ by the state afterwards, the state before and the action, in units of the multipliers.
        after, before, by = np.zeros((n, k, n_x)), np.zeros((n, k, n_x)), np.zeros((n, k, nu))
        after[:, :, :nv], before[:, :, :nv] = -r[:, :, None] * rows, (r + bias + own)[:, :, None] * rows
        by[:, np.arange(k), those] = drives
        size = np.sqrt(give * of_step * r)
        scale = acts * size / (length * r)
        effect *= (acts * size * length / (give * of_step))[:, None]
        low, high, force = scale * low, scale * high, scale * force
        after, before, by = (scale[:, :, None] * v for v in (after, before, by))
        rests = force - ((after @ reached[:, :, None] + before @ x[:, :, None] + by @ nominal[:, :, None])[:, :, 0])
        A, B, C, d, D, E, F, c = (v.reshape(n, *v.shape[len(batch) :]).numpy() for v in system.tensors().values())
        inner = np.eye(k) + after @ effect
        parts, directions = np.linalg.eigh(0.5 * (inner + inner.swapaxes(-1, -2)))
        inner = directions * np.maximum(parts, _LEAST)[:, None] @ directions.swapaxes(-1, -2)
        inner = np.kron([[1, -1], [-1, 1]], np.ones((k, k))) * np.tile(inner, (2, 2)) + _GIVES_BACK * np.eye(2 * k)
        state, action, carried = after @ A + before, after @ B + by, after @ C
        rests = rests + (after @ d[:, :, None])[:, :, 0]
        carried = np.concatenate([-carried, carried], 1)
        found = {
            "C": np.concatenate([C, -effect, effect], -1),
            "D": np.concatenate([D, -state, state], 1),
            "E": np.concatenate([E, -action, action], 1),
            "F": np.block([[F, -carried.swapaxes(-1, -2)], [carried, inner]]),
            "c": np.concatenate([c, high - rests + ~acts, rests - low + ~acts], 1),
        }
        numbers = {name: torch.from_numpy(v.reshape(*batch, *v.shape[1:])) for name, v in found.items()}
        return LCSParams.of_checked({**system.tensors(), **numbers})
