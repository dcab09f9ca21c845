"""Correction of what forces do, by MuJoCo's own step with all constraints at the nominal action.

A force is one impulse in the system; in MuJoCo it acts all through the step, on constraints that are soft, and turn. At
the nominal action the two differ by Δ. As forces λ̄ bring Δ about, C becomes C + Δ wᵀ with wᵀ λ̄ = 1, so that Δ goes when
they go. On each tree of bodies they count by the energy that they bring about, and Δ as far as it is no more than this;
the rest is added to d. F and the gaps stay.

What contacts do depends on friction, which holds with one action and slides with another. So Δ of contacts counts only
where they do worse than nothing, and goes to d: a grip many times as firm as at the nominal action must not make it as
many times as large.
"""

import math
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from difflcs._checks import broadcast_batch, check_shape, check_tensor
from difflcs.errors import InvalidInputError
from difflcs.lcp import solve_lcp
from difflcs.physics.mujoco.library import Places
from difflcs.physics.mujoco.limits import Rows
from difflcs.physics.mujoco.motion import FAST_MOTION, Dynamic, DynamicStep, Linearised
from difflcs.physics.mujoco.native import flags
from difflcs.physics.mujoco.nominal import solve_forces
from difflcs.physics.mujoco.state import MujocoState
from difflcs.records import LCSParams

Array = NDArray[np.float64]
_FAR, _SMALL = 0.3, 0.1  # of the motion and what forces do to a tree, and to all: an error that is worth a look
_JAMS = 30.0  # times what there is to move: forces of contacts that press against each other
STILL = 1e-3  # [m/s, rad/s], a speed that is none
_WORSE = 0.25  # of all motion, by which contacts are worse than nothing where Δ counts wholly
_SLIGHT = 0.2  # of all motion, up to which Δ of contacts counts wholly, if no robot presses them; up to twice: in part
_APART = 0.5  # [rad, m] in a step, by which joints go farther without constraints
_HELD = 10.0  # times the speed before and the change in MuJoCo: all motion, where contacts hold against larger forces


class WholeStep:
    """MuJoCo's own steps, with all constraints.

    Args:
        motion: the motion, of a model whose flags are its own.
        limits: False if joints and tendons have none.
    """

    def __init__(self, motion: Dynamic, limits: bool):
        self.model, self.motion = motion.model, motion
        self._native = motion.describe(motion.steps, 0 if limits else flags("LIMIT"))

    def simulate(self, places: Places, states: Array, ctrl: Array) -> Array:
        """Return ζ, ν and the change of activation (n, 2 nv + na) after a step; NaN where MuJoCo warns or raises.

        Args:
            places: with what is not in the states.
            states: (n, nq + nv + na) qpos, qvel and act.
            ctrl: (n, nu) controls.
        """
        try:
            return self.motion.run(self._native, places, states, ctrl)
        except InvalidInputError:  # the systems stand without a correction
            return np.full((len(states), 2 * self.model.nv + self.model.na), np.nan)

    def hold(self, read: Linearised, places: Places, states: Array, x: Array) -> Array:
        """Simulate at the nominal controls; linearise half way there what goes much farther without constraints."""
        motion, nv = self.motion, self.model.nv
        ctrl = read.nominal + x[:, :nv] @ motion.moment.T
        after = self.simulate(places, states, ctrl)
        after[read.unstable & (np.abs(after).max(1) > FAST_MOTION)] = np.nan  # unstable steps may lead anywhere
        if (held := (np.abs(read.reached - after)[:, :nv] > _APART).any(1)).any():
            again = motion.read_by(self._native, places, states[held], ctrl[held])
            again.unstable[:] = motion.find_unstable(again)
            for name in ("middle", "acceleration", "rates", "unstable"):
                getattr(read, name)[held] = getattr(again, name)
            read.reached[held] = np.nan  # without constraints it leads elsewhere
            straight = np.setdiff1d(np.arange(read.secant.shape[2]), motion.actuators.curved)
            read.secant[np.ix_(held, np.arange(read.secant.shape[1]), straight)] = np.inf
        return after

    def follow(self, places: Places, state: MujocoState, control: Any, x: Tensor, u: Tensor) -> Tensor | None:
        """Follow states (..., H, n_x) from x (..., n_x), one before each of actions u (..., H, n_u).

        None where MuJoCo warns or raises. `control` converts actions at states.
        """
        check_tensor("x", x, [("n_x", state.n_x)])
        check_shape("u", u, "... H n_u", {"n_u": self.model.nu})
        x = x.expand(*broadcast_batch([("x", x.shape[:-1]), ("u", u.shape[:-2])]), state.n_x)
        found, states = [x.detach()], state.flatten(x, np.zeros(0))
        to = state.nq, state.nq + state.nv
        for action in u.detach().unbind(-2)[:-1]:
            ctrl = control(found[-1], action).double().cpu().reshape(len(states), self.model.nu).contiguous().numpy()
            after = self.simulate(places, states, ctrl)
            if not np.isfinite(after).all():
                return None
            for one, change in zip(states, after, strict=True):
                mujoco.mj_integratePos(self.model, one[: to[0]], change[: state.nv], 1.0)
            states[:, to[0] : to[1]] = after[:, state.nv : 2 * state.nv]
            states[:, to[1] :] += after[:, 2 * state.nv :]
            found.append(state.to_state(*np.split(states.reshape(*x.shape[:-1], states.shape[1]), to, -1)).to(x))
        return torch.stack(found, -2)


def find_forces(system: LCSParams, x: Array, u: Array, acts: NDArray[np.bool_] | None = None) -> Array:
    """Find forces (..., n_lam) of systems at states and actions by the active sets.

    The first forces of each are likely those that `acts` (..., k) says.
    """
    D, E, F, c = (v.numpy() for v in (system.D, system.E, system.F, system.c))
    gap = _times(D, x) + _times(E, u) + c
    m = gap.shape[-1]
    q, F = gap.reshape(math.prod(gap.shape[:-1]), m), F.reshape(math.prod(F.shape[:-2]), m, m)
    start = np.maximum(-q, 0.0)
    if acts is not None:
        start[:, acts.shape[-1] :], start[:, : acts.shape[-1]] = 0.0, acts.reshape(len(q), acts.shape[-1])
    lam, found = solve_forces(F, q, np.zeros_like(q), np.full_like(q, np.inf), start)
    if (more := np.flatnonzero(~found)).size:
        lam[more] = solve_lcp(torch.from_numpy(F[more % len(F)]), torch.from_numpy(q[more])).lam.numpy()
    return lam.reshape(gap.shape)


def _times(matrix: Array, vector: Array) -> Array:
    """Multiply matrices (..., rows, columns) with vectors (..., columns), in a quarter of torch's time."""
    return (matrix @ vector[..., None])[..., 0]


def correct(
    system: LCSParams, step: DynamicStep, after: Array, bound: Array, rows: Rows, hard: Any, acts: Any
) -> tuple[LCSParams, NDArray[np.bool_]]:
    """Correct C and d of systems at n states; return them, and those (n,) where more is corrected than moves.

    Args:
        system: the systems, in any batch dimensions.
        step: the motion without constraints.
        after: (n, 2 nv + na) after MuJoCo's step, see `WholeStep`; states with NaN stay as they are.
        bound: (n, n_bounded) of dry friction, the forces after those of limits.
        rows: limits and dry friction.
        hard: (n, k) of the k forces of contacts, which are the first; False for those of soft contacts.
        acts: (..., k) True for forces that are likely not zero; those of the limits of servos come after them.
    """
    x, nv, batch = step.x, step.place.shape[1], system.C.shape[:-2]
    at = [v.reshape(*batch, v.shape[1]) for v in (x, step.idle)]
    found = find_forces(system, at[0], at[1], acts)
    A, B, C, d = (v.numpy() for v in (system.A, system.B, system.C, system.d))
    known = C, d, _times(A, at[0]) + _times(B, at[1]) + _times(C, found) + d, found
    C, d, predicted, lam = (v.reshape(len(x), *v.shape[len(batch) :]) for v in known)
    C, of_servos = C[:, :, : acts.shape[-1]], C[:, :, acts.shape[-1] :]
    lam = lam[:, : C.shape[2]]
    n_bounded, lower = bound.shape[1], np.zeros_like(lam)
    n_contacts, n_limits = hard.shape[1], rows.gap.shape[1] - n_bounded
    lower[:, n_contacts + n_limits :][:, :n_bounded] = -bound
    C, d, forces = C.copy(), d.copy(), lam + lower
    place = step.turn_back(after[:, :nv, None].copy())[:, :, 0]
    change = np.concatenate([place, after[:, nv : 2 * nv] - x[:, nv : 2 * nv]], 1)
    known = np.isfinite(change).all(1, keepdims=True)
    change = np.where(known, change, 0.0)
    wrong = np.where(known, x[:, : 2 * nv] + change - predicted[:, : 2 * nv], 0.0)
    mass = step.motion.in_tree / np.diagonal(step.inverse_mass, axis1=1, axis2=2)[:, :, None]

    energy = mass.swapaxes(-1, -2) @ (C[:, nv : 2 * nv] * forces[:, None]) ** 2
    energy[:, :, :n_contacts] *= hard[:, None]  # soft contacts press all the time, whatever moves
    total = np.maximum(energy.sum(-1), 1e-20)
    free = predicted - (C @ forces[:, :, None])[:, :, 0] - x
    # Sizes (n, n_trees) of velocities by their energy: what is wrong, before, the change, and that without forces.
    off, before, changed, alone = (
        np.sqrt((v[:, None, nv : 2 * nv] ** 2 @ mass)[:, 0]) for v in (wrong, x, change, free)
    )
    moves = before + changed
    motion = before + np.minimum(alone, _HELD * moves)
    worse = (off - changed) / (_WORSE * motion + 1e-9)
    slight = (2 - off / (_SLIGHT * motion + 1e-9)) * (not step.motion.firm.any())
    share = energy[:, :, :n_contacts].sum(-1) / total
    # What contacts jam stands with any action.
    pressed = np.maximum(1.0, np.sqrt(total) / np.maximum(_JAMS * (before + alone), 1e-300))
    counts = 1 - share / pressed * (1 - np.clip(np.maximum(worse, slight), 0.0, 1.0))
    least = np.maximum(_FAR * (moves + alone), _SMALL * (moves + alone).sum(1, keepdims=True))
    doubtful = (off > np.maximum(moves, least) + STILL * np.sqrt(mass.sum(1))).any(1)
    # A difference that grew with a force that actions change by far would be many times as large with some. Dry
    # friction far below its bound is whatever holds, so it does not grow with this either.
    of_rows = slice(n_contacts, n_contacts + n_limits + n_bounded)
    does = np.abs((rows.normal.swapaxes(-1, -2) * C[:, nv : 2 * nv, of_rows] * forces[:, None, of_rows]).sum(1))
    changes = np.abs(rows.normal @ step.step[:, nv : 2 * nv, x.shape[1] : -1]) @ step.motion.actuators.reach
    firm = does / np.maximum(does + changes, 1e-300)
    firm[:, n_limits:] *= np.abs(forces[:, of_rows][:, n_limits:]) / np.maximum(bound, 1e-300)
    energy[:, :, of_rows] *= firm[:, None]
    grow = energy.sum(-1)
    due = (1 - share) * np.minimum(1.0, np.sqrt(total) / np.maximum(off, 1e-15)) * grow / total
    part = energy / np.where(forces != 0, forces, 1.0)[:, None] / np.maximum(grow, 1e-20)[:, :, None]
    both = np.tile(step.motion.of_tree, 2)
    by_forces = (wrong * due[:, both])[:, :, None] * part[:, both]
    C[:, : 2 * nv] += by_forces
    d[:, : 2 * nv] += (by_forces @ lower[:, :, None])[:, :, 0] + wrong * (counts - due)[:, both]
    C = np.concatenate([C, of_servos], -1)
    C, d = (torch.from_numpy(v).reshape(*batch, *v.shape[1:]) for v in (C, d))
    return LCSParams.of_checked({"C": C, "d": d}, like=system), doubtful
