"""Contacts at the nominal action: which close, hold or slide, and the loads that they carry.

A load that acts all the time, such as gravity, moves a body by h²/2 in a step where the impulse that balances it moves
it by h². So a contact that holds the place of a body would leave it with a velocity. Where a contact closes, loads
are therefore impulses at the beginning of the step as well: along the normal; along the tangents where friction
holds; and where a contact slides, along the friction that its normal force brings about.

Compliance, which makes F + Fᵀ ≻ 0, counts from the forces of the nominal action, so that what rests does not creep,
but as slowly as MuJoCo's soft friction lets it. Nor does a contact open that only lies as deep as MuJoCo's soft
contacts do under their load. All this is computed in `_native/nominal.hpp`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from difflcs.errors import ContactWarning, warn
from difflcs.physics.complementarity import Cone, count_forces
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.contacts import MujocoContacts
from difflcs.physics.mujoco.library import count_threads
from difflcs.physics.mujoco.limits import Rows, ScaledRows
from difflcs.physics.mujoco.motion import DynamicStep
from difflcs.physics.mujoco.native import least_time

Array = NDArray[np.float64]
_USUAL = 0.02  # depth of contacts in parts of the length, under any load
LEAST = 0.01  # compliance of a contact in parts of how far its own forces move it; MuJoCo's is .05 and more


class Nominal(NamedTuple):
    """Contacts as the system of the step has them.

    Attributes:
        contacts: gaps without the depth that the load makes and with what a slide would open; tangents along the slide.
        soft: (n, n_contacts) compliance of contacts, in parts of `give`; at least LEAST of their own.
        forces: (n, n_contacts, n_rays) of the extreme rays of Anitescu's cone, in the order of `contact_lcs` [N s].
        rows: limits and dry friction.
        row_forces: (n, n_rows) of these.
        carried: addition to (ζ, ν) of `DynamicStep.step`, as loads are impulses along contacts.
    """

    contacts: MujocoContacts
    soft: Array
    forces: Array
    rows: ScaledRows
    row_forces: Array
    carried: Array

    def rest(self, rough: Any, smooth: Any, n_tangents: int, cone: Cone, n_caps: int) -> Array:
        """Forces (n, n_lam) from which the compliance counts, as `contact_lcs` has them for a cone."""
        forces, smooth = self.forces[:, rough], self.forces[:, smooth].sum(-1)
        each = count_forces(1, n_tangents, cone)
        if each != forces.shape[-1]:  # Stewart and Trinkle: normal, tangential, and the distance
            forces = np.concatenate([forces.sum(-1, keepdims=True), np.zeros((*forces.shape[:2], each - 1))], -1)
        rays, slid = forces.reshape(len(forces), each * forces.shape[1]), np.zeros(self.rows.bound.shape)
        caps = np.zeros((len(forces), n_caps))  # what has one rests on its rays
        return np.concatenate([rays, caps, smooth, self.row_forces, slid, caps], -1)


class Recovery:
    """Depth of MuJoCo's contacts under a load, and the speed at which they come out, by `solref` and `solimp`.

    A contact force at rest is d²/(1 − d) k r over what a unit of force accelerates, at depth r and impedance d. What is
    deeper than the load explains, or a load that only the action makes, comes out as MuJoCo's contacts recover,
    critically damped, from the speed at which it opens now, as far as depth explains it. Friction creeps.

    Args:
        model: the MuJoCo model.
        length: of what touches [m].

    Attributes:
        usual: depth under any load [m].
        time: (ngeom,) of recovery [s].
        depth: (ngeom,) for a unit of acceleration [s²].
        creep: (ngeom,) speed of creep for a unit of acceleration [s].
        largest: (ngeom,) part of a geom in the largest R of its contacts [1/kg].
    """

    def __init__(self, model: Any, length: float):
        self.usual = _USUAL * length
        (reference, ratio), impedance = model.geom_solref.T, np.clip(model.geom_solimp[:, :2], 1e-4, 0.9999).T
        time = np.maximum(reference, least_time(model))
        direct = impedance[1] ** 2 / np.maximum(-reference, 1e-9)
        stiffness = np.where(reference > 0, (impedance[1] * time * ratio) ** 2, direct)
        self.time, self.depth = np.sqrt(stiffness), stiffness * (1 - impedance[0]) / impedance[0] ** 2
        damping = np.where(reference > 0, 0.5 * impedance[1] * time, impedance[1] / np.maximum(-ratio, 1e-9))
        pyramid = 1 + (model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL)  # about
        self.creep = pyramid * damping * (1 / impedance[0] - 1) / model.opt.impratio
        self.largest = (1 / impedance[0] - 1).max(initial=0.0) * model.body_invweight0[model.geom_bodyid, 0]


class Situation(NamedTuple):
    """Forces and constraints that act in a step from n states.

    Attributes:
        step: the motion without contact.
        contacts: contacts.
        rough: (n_contacts,) False for contacts without friction.
        rows: limits and dry friction.
        recovery: of MuJoCo's contacts.
        give: how far a unit of impulse moves two bodies apart [m/(N s)].
        compliance: of contacts, in parts of `give`.
        opens: True for the friction of Anitescu, in which a contact that slides opens.
    """

    step: DynamicStep
    contacts: MujocoContacts
    rough: NDArray[np.bool_]
    rows: Rows
    recovery: Recovery
    give: float
    compliance: float
    opens: bool


def evaluate_nominal(at: Situation) -> Nominal:
    """Decide which contacts close, hold or slide at the nominal action, and which rows act.

    Where contacts and limits jam each other, they act at the same time, as they would else make things fast.

    Warns:
        ContactWarning: for some states rounding keeps it from finding the forces exactly.
    """
    step, contacts, rows, recovery = at.step, at.contacts, at.rows, at.recovery
    (n, k, t, nv), r = contacts.tangent.shape, rows.gap.shape[1]
    given = contacts._asdict() | {"row_gap": rows.gap, "row_normal": rows.normal, "bend": rows.bend}
    given = {name: np.ascontiguousarray(v) for name, v in (given | rows.soft._asdict()).items()}
    given |= {"row_give": given["give"], "most": given["bound"], "rough": at.rough, "bounded": rows.n_friction}
    given |= step._asdict() | step.motion.fields | vars(recovery)
    given |= {"opens": at.opens, "give": at.give, "compliance": at.compliance, "least": LEAST}
    sizes = {"gap": (r,), "normal": (r, nv), "impulse": (r, nv), "bound": (rows.n_friction,), "unit": (r,)}
    sizes |= {"soft": (k,), "opened": (k,), "turned": (k, t, nv), "forces": (k, max(1, 2 * t)), "row_forces": (r,)}
    found = {name: np.zeros((n, *size)) for name, size in sizes.items()} | {"carried": np.zeros(step.delayed.shape)}
    if missed := _mujoco.evaluate_nominal(count_threads(n), given, found):
        warn(
            f"expected the forces of contacts and limits at the nominal action, found none that fit for {missed} "
            f"of {n} states, so that what touches there may creep: look for bodies of very different mass, "
            f"or pass a larger compliance",
            ContactWarning,
        )
    contacts = MujocoContacts(found["opened"], contacts.normal, found["turned"], contacts.friction, contacts.geom)
    scaled = ScaledRows(*map(found.__getitem__, ScaledRows._fields))
    return Nominal(contacts, found["soft"], found["forces"], scaled, found["row_forces"], found["carried"])
