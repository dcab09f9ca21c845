"""Actions that are tried: steps of systems beside MuJoCo's own, and a warning where they are far off.

A system is MuJoCo's at its nominal action. At some states other actions are tried: all over the ranges of actuators, at
their ends and with no control; then in balance, in which a tree of bodies on which constraints act goes on as it is, as
little decides there whether friction holds.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from difflcs.errors import ContactWarning, warn
from difflcs.physics.mujoco.correction import STILL, WholeStep, find_forces, to_arrays
from difflcs.physics.mujoco.library import Places
from difflcs.physics.mujoco.motion import DynamicStep
from difflcs.physics.mujoco.readings import Readings
from difflcs.records import LCSParams

Array = NDArray[np.float64]
_TRIED = 8  # states at which actions are tried, of the first, and each time that a module was asked for twice as many
_ALL_OVER, _LEAST = 128, 32  # actions all over the ranges of one state, or of all together; of each at least
_BEYOND = 1.2  # of the ranges, in which actions are chosen, so that some are at ends
_BALANCED = 8  # actions from which balance is sought
_NEAR = 1e-9  # [m, rad] to a state from which a step is as good as the same
_FARTHER = 0.4  # of the speed before and of what forces do, by which an error is more than that of standing still
_MOST = 1e99  # a velocity whose square is a number
_CREEP = 0.01  # [m/s, rad/s], a speed at which rounding moves what touches in many points
_NEVER = 1e4  # times what moves: motion without constraints that grows beyond all bounds is no measure of errors
_HARDLY = 0.8  # of the motion in MuJoCo, if it is more than `_FARTHER`: what misses so much of it holds still
_NEARLY = 0.005  # of the median change with all actions: an error that is none
_JUMPS = 0.1  # of the velocity of a tree, by which MuJoCo's own step hangs on rounding


class Tries:
    """The actions that a module tries, and how often.

    Args:
        whole: MuJoCo's own steps.
        places: memory for them.
        relative: actions of servos count from where they are.
        yields: see `Actuators.bounds`.

    Attributes:
        asked: how many states the module was asked for.
    """

    def __init__(self, whole: WholeStep, places: Places, relative: bool, yields: Any):
        self.whole, self.places, self.relative, self.yields, self.asked = whole, places, relative, yields, 0
        rows = np.tile(np.arange(_ALL_OVER), (whole.motion.model.nu, 1))
        cube = (np.random.default_rng(0).permuted(rows, axis=1).T[:, None] + 0.5) / _ALL_OVER  # a Latin hypercube
        self._parts = np.clip(_BEYOND * (cube - 0.5) + 0.5, 0.0, 1.0)

    def warn(self, system: LCSParams, read: Readings, step: DynamicStep) -> None:
        """Warn where the system is far off with an action that is tried, or MuJoCo's step hangs on rounding."""
        before, self.asked = self.asked, self.asked + len(read.x)
        more = before.bit_length() < self.asked.bit_length()
        due = more or step.motion.actuators.curved.size > 0
        if not (due or read.doubtful.any()):
            return
        some = np.flatnonzero(read.doubtful | (np.arange(len(read.x)) < _TRIED * due))
        trial = _Trial(self, system, read, step, some)
        size = trial.high - trial.low
        parts = self._parts[: max(_LEAST, _ALL_OVER * more // len(some))]
        u = np.concatenate([trial.low + parts * size, trial.ends, [trial.idle, -trial.zero]])
        trial.run(_balance(u, *trial.run(u), step, some, size))
        trial.warn_of_wrong()
        trial.warn_of_jumps()


class _Trial:
    """Systems at n states of all that were read, those of `some` numbers, with the range (n, nu) of their actions."""

    def __init__(self, tries: Tries, system: LCSParams, read: Readings, step: DynamicStep, some: Any):
        arrays = {k: v.reshape(len(read.x), *v.shape[len(read.batch) :])[some] for k, v in to_arrays(system).items()}
        self.system, self.x, self._states = arrays, read.x[some], read.states[some]
        self._tries, self._motion, self._unstable = tries, step.motion, read.moved.unstable[some]
        self._velocity, self._mass = step.velocity[some], np.linalg.inv(read.moved.inverse_mass[some])
        self._still = np.sqrt(np.diagonal(self._mass, axis1=1, axis2=2) @ step.motion.in_tree)
        self._usual, self._wrong, self._worst = None, np.zeros(len(some), dtype=bool), (0.0, 0)
        actuators, self.idle = step.motion.actuators, step.idle[some]
        bounds = actuators.bounds(self.x, self._velocity, tries.yields, tries.relative)
        self.zero = self._control(np.zeros_like(self.idle))
        ends, zero = actuators.range[:, None] - self.zero, -self.zero
        likely = np.minimum(self.idle, zero) - actuators.usual, np.maximum(self.idle, zero) + actuators.usual
        self.low, self.high = self.ends = np.clip(np.where(np.isfinite(ends), ends, likely), *bounds)

    def _control(self, u: Array) -> Array:
        x = np.broadcast_to(self.x, (*u.shape[:-1], self.x.shape[-1])).copy()
        at = torch.from_numpy(x), torch.from_numpy(u)
        return self._motion.actuators.control(*at, self._tries.relative, False).numpy()

    def _size(self, moved: Array) -> Array:
        """Size (..., n, n_trees) of velocities (..., n, nv), by the energy of each tree of bodies."""
        return np.sqrt(np.maximum(moved * (self._mass @ moved[..., None])[..., 0] @ self._motion.in_tree, 0.0))

    def run(self, u: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Try actions (m, n, nu), made to fit into their ranges in place.

        Returns:
            velocities by MuJoCo and, of the first and where it may be wrong, without constraints (m, n, nv); where
            forces act (n, nv).
        """
        np.clip(u, self.low, self.high, out=u)
        (m, n, _), nv = u.shape, self._velocity.shape[1]
        A, B, C, d = (self.system[name][:, nv : 2 * nv] for name in "ABCd")
        x = np.broadcast_to(self.x, (m, *self.x.shape))
        forces = (C @ find_forces(self.system, x, u)[..., None])[..., 0]
        predicted = ((A @ x[..., None]) + B @ u[..., None])[..., 0] + d + forces
        places, unstable = self._tries.places, np.tile(self._unstable, m)
        ctrl, states = self._control(u).reshape(m * n, -1), np.tile(self._states, (m, 1))
        after = self._tries.whole.simulate(places, states, ctrl)[:, nv : 2 * nv].reshape(m, n, nv)
        off = np.where(np.abs(predicted) < _MOST, predicted, _MOST) - after  # where there is no number as well
        change = self._size(after - self._velocity)
        doubtful = np.any(self._size(off) > _HARDLY * change, -1)
        doubtful[:_BALANCED] = True  # of others nobody asks what forces do
        ways, some = (True, False)[: 1 + self._motion.loosens], np.flatnonzero(doubtful)
        free = np.tile(self._velocity, (len(ways), m, 1, 1))
        for velocities, loose in zip(free, ways, strict=True):
            taken = states[some], ctrl[some], unstable[some], loose
            velocities[doubtful] = self._motion.simulate(places, *taken)[:, nv : 2 * nv]
        self._judge(off, change, free)
        return after, free[0], np.any(np.abs(forces) > STILL, 0)

    def _judge(self, off: Array, change: Array, free: Array) -> None:
        """Remember where velocities are farther from MuJoCo's than those before the step, or hardly change.

        Each tree of bodies counts by itself, as an object may be much lighter than the robot.

        Args:
            off: (m, n, nv) errors.
            change: (m, n, n_trees) sizes of the changes in MuJoCo.
            free: (k, m, n, nv) velocities without constraints in k ways, of which the slowest counts.
        """
        error, alone, speed = (self._size(v) for v in (off, free - self._velocity, self._velocity))
        known, alone = np.nan_to_num(change), np.nan_to_num(alone)
        if self._usual is None:
            self._usual = _NEARLY * np.median(known, 0)  # near balance any error of large actions shows
        least = STILL * self._still + self._usual
        moves = speed + np.where(alone < _NEVER * (speed + known + least), alone, 0.0).min(0)
        most = change + _FARTHER * moves + least
        held = (change > _FARTHER * moves + least) & (error > _HARDLY * change)
        excess = np.nan_to_num((error - np.where(held, 0.0, most)) / most, nan=-np.inf)
        self._wrong |= np.any(excess > 0, (0, 2))
        if excess.max(initial=0.0) > self._worst[0]:
            *at, tree = np.unravel_index(np.argmax(excess), excess.shape)
            moved = off[tuple(at)]
            energy = np.abs(moved * (self._mass[at[1]] @ moved)) * self._motion.in_tree[:, tree]
            self._worst = float(excess.max()), int(np.argmax(energy))

    def warn_of_wrong(self) -> None:
        """Warn where an action was off."""
        if self._wrong.any():
            model, dof = self._motion.model, self._worst[1]
            joint, body = model.joint(model.dof_jntid[dof]), model.body(model.dof_bodyid[dof])
            warn(
                f"expected a system as near to MuJoCo's own step as standing still is, that moves where MuJoCo does, "
                f"also at the ends of the ranges of its actions and between, got one that is farther off, or holds "
                f"still, with such an action in {self._wrong.sum()} of {len(self._wrong)} states, most of all joint "
                f"{joint.name or joint.id!r} of body {body.name or body.id!r}: take fewer seconds, less friction, a "
                f"nominal control near the actions, or a ctrlrange of the actuators without such actions",
                ContactWarning,
            )

    def warn_of_jumps(self) -> None:
        """Warn where MuJoCo's steps at the nominal action lead elsewhere from states that are as good as the same."""
        nq, (n, nv) = self._motion.model.nq, self._velocity.shape
        near, ctrl = np.tile(self._states, (4, 1, 1)), np.tile(self._control(self.idle), (4, 1))
        near[1:, :, :nq] += _NEAR * np.random.default_rng(0).normal(size=(3, n, nq))
        after = self._tries.whole.simulate(self._tries.places, near.reshape(4 * n, -1), ctrl)
        after = after.reshape(4, n, -1)[..., nv : 2 * nv]
        moves = np.maximum(self._size(self._velocity), self._size(after[0]))
        if (apart := (self._size(after - after[0]) > _JUMPS * moves + _CREEP * self._still).any((0, 2))).any():
            warn(
                f"expected steps of MuJoCo that say what a system is like, got some that a change of {_NEAR} m and rad "
                f"leads far away in {apart.sum()} of {len(apart)} states: let its solver converge, with more "
                f"iterations (opt.iterations) or softer constraints (solref, solimp), or take smaller time steps",
                ContactWarning,
            )


def _balance(
    u: Array, after: Array, free: Array, acts: NDArray[np.bool_], step: DynamicStep, some: Any, size: Array
) -> Array:
    """Compute actions in balance, in which a tree of bodies that is in touch goes on as it is.

    What drives alone do says where that is, for one tree of bodies after the other, by the least change of actions in
    parts of their `size` (n, nu).

    Args:
        u: (m, n, nu) actions from which it is sought, the first of these.
        after: (m, n, nv) velocities after these.
        free: (m, n, nv) those without constraints.
        acts: (n, nv) where forces act.
        step: the step, of which `some` n states are meant.
        some: their numbers.
        size: see above.

    Returns:
        (k, n, nu) in balance with all forces, and without those of constraints.
    """
    (n, nv), n_x, in_tree, before = acts.shape, step.x.shape[1], step.motion.in_tree, step.velocity[some]
    by_action, velocities = step.step[some, nv : 2 * nv, n_x:-1], np.stack([after, free])[:, :_BALANCED]
    trees = in_tree.T[in_tree.T @ by_action.any((0, 2))]
    trees = np.resize(trees, (_BALANCED, 1, nv)) * (acts @ in_tree @ in_tree.T)
    weights = trees * np.diagonal(step.inverse_mass[some], axis1=1, axis2=2) ** -0.5
    change = weights * (np.nan_to_num(velocities) - before)
    back = np.linalg.pinv(weights[..., None] * by_action * size[:, None], 1e-6) @ change[..., None]
    return (u[:_BALANCED] - size * back[..., 0]).reshape(2 * _BALANCED, n, -1)
