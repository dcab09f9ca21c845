"""Equality constraints of a MuJoCo model, which have no forces of their own in the system.

MuJoCo's are soft: with the derivative E of the violation r their force is f = (−b E ν − k d r − E ν̇)/R. They are part
of dynamic motion as MuJoCo simulates and linearises it, in which other forces meet more mass, by Eᵀ E/R, and damping,
by Eᵀ b E/R. Without velocities, with the response S, 1 − S Eᵀ (E S Eᵀ)⁺ E projects the motion, and what forces do to
it, to where they hold.
"""

import copy
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from difflcs.errors import ContactWarning, warn
from difflcs.physics.complementarity import FreeMotion
from difflcs.physics.mujoco.native import copy_taken, flags, native

Array = NDArray[np.float64]
_FIRMEST = 1e-8  # least R, in parts of what it stands beside
_FAR = 1.0  # motion to where constraints hold [m, rad], beyond which nothing about it is linear
_ROUNDING = 1e-12  # part of the response without constraints, up to which something does not move
_DEPENDENT = 1e-9  # part of the largest singular value below which rows say the same


class EqualityRows(NamedTuple):
    """Equality constraints of n states.

    Attributes:
        gap: (n, k) r.
        normal: (n, k, nv) its derivative E by the degrees of freedom.
        damping: (n, k) b [1/s].
        firm: (n, k) R.
    """

    gap: Array
    normal: Array
    damping: Array
    firm: Array


class Equality:
    """The equality constraints of a model that are active.

    Args:
        model: the model.
        data: its data, from which what is active, and where mocap bodies are, is taken at each state.
    """

    def __init__(self, model: Any, data: Any):
        self._taken, self.model = data, copy.copy(model)
        self.model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
        self.model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)  # others may know R only later in a step
        self.model.opt.disableflags |= flags("CONTACT", "LIMIT", "FRICTIONLOSS")
        self.data = mujoco.MjData(self.model)

    def read(self, qpos: Array, moved: Array | None = None) -> EqualityRows | None:
        """Read the constraints at positions (n, nq) that have moved by ζ (n, nv); None: there are none.

        Raises:
            InvalidInputError: MuJoCo raised an error.
        """
        model, data, rows = self.model, self.data, []
        if not (model.neq and self._taken.eq_active.any() and len(qpos)):
            return None
        copy_taken(data, self._taken)
        for i, q in enumerate(qpos):
            with native(model, data, f"in state {i} of {len(qpos)}"):
                data.qpos[:] = q
                if moved is not None:
                    mujoco.mj_integratePos(model, data.qpos, moved[i], 1.0)
                mujoco.mj_fwdPosition(model, data)
                if not data.nefc:
                    return None
                jacobian = data.efc_J.reshape(-1, model.nv)
                gives = np.empty_like(jacobian)
                mujoco.mj_solveM(model, data, gives, jacobian)
                firm = np.maximum(data.efc_R, _FIRMEST * (gives * jacobian).sum(-1))
                rows.append([v.copy() for v in (data.efc_pos, jacobian, data.efc_KBIP[:, 1], firm)])
        return EqualityRows(*map(np.stack, zip(*rows, strict=True)))

    def hold_positions(self, free: FreeMotion, x: Array, qpos: Array, tangent: Array | None) -> FreeMotion:
        """Return a motion of positions x (n, nv), which are qpos (n, nq), that keeps to the constraints."""
        rows = self.read(qpos)
        if rows is None:
            return free
        matrices: Any = free
        A, B, d, response = matrices
        E = rows.normal if tangent is None else rows.normal @ tangent
        pushed = response @ E.swapaxes(-1, -2)
        by = pushed @ np.linalg.pinv(E @ pushed, _DEPENDENT, hermitian=True)  # which moves along rows by given ways
        along = np.eye(x.shape[1]) - by @ E
        back = by @ ((E @ x[:, :, None])[:, :, 0] - rows.gap)[:, :, None]
        moved = np.abs(by @ rows.gap[:, :, None])
        if (far := moved.max()) > _FAR:
            joint = self.model.joint(self.model.dof_jntid[moved.max(0).argmax()])
            warn(
                f"expected equality constraints that nearly hold, got some that move joint {joint.name or joint.id!r} "
                f"by {far:.3g} in a step, where nothing is linear: begin where they hold, or switch them off in data",
                ContactWarning,
            )
        d = (along @ d[..., None] + back)[:, :, 0]
        held = along @ response
        moves = np.diagonal(held, axis1=1, axis2=2) > _ROUNDING * np.trace(response, axis1=-2, axis2=-1)[..., None]
        matrices = along @ A, along @ B, d, held * moves[:, None] * moves[:, :, None]
        return FreeMotion(*matrices)
