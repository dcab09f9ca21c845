"""Correction of what forces do, by MuJoCo's own step with all constraints at the nominal action.

A force is one impulse in the system; in MuJoCo it acts all through the step, on constraints that are soft, and turn. At
the nominal action the two differ by Δ. As forces λ̄ bring Δ about, C becomes C + Δ wᵀ with wᵀ λ̄ = 1, so that Δ goes when
they go. On each tree of bodies they count by the energy that they bring about, and Δ as far as it is no more than this;
the rest is added to d. F and the gaps stay.

What contacts do depends on friction, which holds with one action and slides with another. So Δ of contacts counts only
where they do worse than nothing, and goes to d: a grip many times as firm as at the nominal action must not make it as
many times as large. All this is computed in `_native/correction.hpp`.
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
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.library import Places, count_threads
from difflcs.physics.mujoco.limits import Rows
from difflcs.physics.mujoco.motion import FAST_MOTION, Dynamic, DynamicStep, Linearised
from difflcs.physics.mujoco.native import flags
from difflcs.physics.mujoco.state import MujocoState
from difflcs.records import LCSParams

Array = NDArray[np.float64]
STILL = 1e-3  # [m/s, rad/s], a speed that is none
_APART = 0.5  # [rad, m] in a step, by which joints go farther without constraints


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
        if read.unstable.any():  # unstable steps may lead anywhere
            after[read.unstable & (np.abs(after).max(1) > FAST_MOTION)] = np.nan
        if (held := (np.abs(read.reached[:, :nv] - after[:, :nv]) > _APART).any(1)).any():
            again = motion.read_by(self._native, places, states[held], ctrl[held])
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


def to_arrays(system: LCSParams) -> dict[str, Array]:
    """Return the numbers of systems, of which those of `LCSParams` that are contiguous are no copies."""
    return {name: v.contiguous().numpy() for name, v in system.tensors().items()}


def find_forces(system: dict[str, Array], x: Array, u: Array, acts: NDArray[np.bool_] | None = None) -> Array:
    """Find the forces (..., n_lam) of systems by the active sets; the first are likely those that `acts` (n, k)."""
    n, m = math.prod(x.shape[:-1]), system["c"].shape[-1]
    lam, found = np.zeros((n, m)), np.zeros(n, dtype=bool)
    if not lam.size:
        return lam.reshape(*x.shape[:-1], m)
    if acts is not None:
        lam[:, : acts.shape[-1]] = acts
    at, by = (np.ascontiguousarray(v.reshape(n, v.shape[-1])) for v in (x, u))
    _mujoco.solve_forces(0.0, count_threads(n), system, at, by, np.zeros(m), np.full(m, np.inf), lam, found)
    if (more := np.flatnonzero(~found)).size:
        F = system["F"].reshape(-1, m, m)[more % (system["F"].size // m**2)]
        lam[more] = solve_lcp(torch.from_numpy(F), torch.from_numpy(lam[more])).lam.numpy()
    return lam.reshape(*x.shape[:-1], m)


def correct(
    system: dict[str, Array], step: DynamicStep, after: Array, bound: Array, rows: Rows, hard: Any, acts: Any
) -> NDArray[np.bool_]:
    """Correct C and d of systems at n states in place; return those (n,) where more is corrected than moves.

    Args:
        system: the systems, in any batch dimensions.
        step: the motion without constraints.
        after: (n, 2 nv + na) after MuJoCo's step, see `WholeStep`; states with NaN stay as they are.
        bound: (n, n_bounded) of dry friction, the forces after those of limits.
        rows: limits and dry friction.
        hard: (n or 1, k) of the k forces of contacts, which are the first; False for those of soft contacts.
        acts: (n, k) True for forces that are likely not zero; those of the limits of servos come after them.
    """
    n, nv = step.place.shape
    lam, doubtful = find_forces(system, step.x, step.idle, acts), np.zeros(n, dtype=bool)
    if step.turn is not None:
        after = np.concatenate([step.turn_back(after[:, :nv, None].copy())[:, :, 0], after[:, nv:]], 1)
    given = step._asdict() | step.motion.fields | system | {"forces": acts.shape[1], "lam": lam, "hard": hard}
    given |= {"after": after, "bound": bound, "normal": np.ascontiguousarray(rows.normal)}
    _mujoco.correct(count_threads(n), STILL, given, doubtful)
    return doubtful
