"""Soft contacts: overlaps in which MuJoCo's force depends on its softness, and hardly on what it moves.

In a row J of a contact with depth r, velocity v and acceleration a, MuJoCo's force is (k d r − b v − a)/R. Its R comes
from the inertia of the bodies in the model's initial state. Where A = J M⁻¹ Jᵀ is far smaller, as along a normal across
the rail of a drawer, or of a finger that lies inside the hand near its axis, the force is that of a spring and damper,
whatever moves, and friction has what it presses. These contacts have this force in a step, and friction the compliance
R/b, less than this where the step ends before it has yielded so far, which takes about 1/b.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from difflcs.physics.complementarity import count_forces
from difflcs.physics.mujoco.limits import give_way
from difflcs.physics.mujoco.native import native
from difflcs.physics.mujoco.nominal import Nominal, Situation, evaluate_nominal

Array = NDArray[np.float64]
_SOFT = 3.0  # R in parts of A, above which a contact is soft
_LEAST, _MOST = 1e-4, 1e4  # compliance in parts of how far contacts give way


class Overlaps(NamedTuple):
    """Soft contacts of n states.

    Attributes:
        soft: (n, n_contacts) True for those that are soft; all have one row where there are none.
        gap: (n, n_contacts) from which the rays of soft contacts count [m].
        compliance: (n, n_contacts) of soft contacts, in parts of how far they give way.
    """

    soft: NDArray[np.bool_]
    gap: Array
    compliance: Array

    def find_hard(self, rough: Any, each: int, others: int) -> NDArray[np.bool_]:
        """Mask (n, k) of forces, `each` of rough contacts and then others: False for those of soft contacts."""
        rays = np.repeat(~self.soft[:, rough], each, 1)
        return np.concatenate([rays, np.ones((len(rays), others), dtype=bool)], 1)

    def evaluate(self, at: Situation) -> Nominal:
        """Evaluate all else at the nominal action, with friction that holds, and add the soft contacts of a step."""
        if not self.soft.any():
            return evaluate_nominal(at)
        normal, hard = at.contacts.normal, ~self.soft[:, :, None]
        nominal = evaluate_nominal(at._replace(contacts=at.contacts._replace(normal=normal * hard)))
        gap = np.where(self.soft, self.gap, nominal.contacts.gap)
        contacts = nominal.contacts._replace(gap=gap, normal=normal)
        soft = np.where(self.soft, self.compliance, nominal.soft)
        return nominal._replace(contacts=contacts, soft=soft, forces=nominal.forces * hard)


def find_overlaps(model: Any, data: Any, qpos: Array, at: Situation) -> Overlaps:
    """Find the soft contacts at positions (n, nq), with MuJoCo's parameters.

    Args:
        model: a model that has contacts and no other constraints.
        data: for the computation.
        qpos: positions.
        at: what acts there.

    Raises:
        InvalidInputError: MuJoCo raised an error.
    """
    contacts, none = at.contacts, np.zeros((1, len(at.rough)))
    soft = (contacts.gap < 0) & (contacts.friction > 0) & at.rough
    if soft.any():
        moves = give_way(contacts.normal, at.step.inverse_mass)
        soft &= at.recovery.largest[contacts.geom].sum(-1) > _SOFT * moves
    if not soft.any():
        return Overlaps(none > 0, none, none)
    geoms, firm, force = np.sort(contacts.geom, -1), np.zeros_like(moves), np.zeros_like(moves)
    for i in np.flatnonzero(soft.any(-1)):
        with native(model, data, f"in state {i} of {len(qpos)}"):
            data.qpos[:] = qpos[i]
            mujoco.mj_fwdPosition(model, data)
        for contact in data.contact:
            row, mine = contact.efc_address, (geoms[i] == np.sort(contact.geom)).all(-1)
            if row < 0 or not mine.any():
                continue
            edges = 2 * (contact.dim - 1) * (model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL)
            of_normal, of_tangent = data.efc_R[row], data.efc_R[row + (contact.dim > 1)]
            if edges:
                of_normal, of_tangent = of_normal / edges, of_normal / (2 * contact.friction[0] ** 2)
            stiffness, damping, impedance = np.maximum(data.efc_KBIP[row, :3], 1e-9)
            depth = data.efc_margin[row] - data.efc_pos[row]
            share = mine * (of_normal > _SOFT * moves[i]) / mine.sum()
            firm[i] += share * damping / -np.expm1(-damping * at.step.seconds) / of_tangent
            force[i] += share * stiffness * impedance * depth / of_normal
    soft &= force > 0
    compliance = np.clip(2 * contacts.friction**2 / np.maximum(at.give * firm, 1e-99), _LEAST, _MOST)
    rays = count_forces(1, contacts.tangent.shape[2]) if at.opens else 1
    gap = -at.give * compliance * at.step.seconds * force / rays
    return Overlaps(soft, gap, compliance)
