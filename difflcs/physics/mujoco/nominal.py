"""What contacts do at the nominal action: which close, hold or slide, and what they carry.

A load that acts all the time, such as gravity, moves a body by h²/2 in a step where the impulse that balances it moves
it by h². So a contact that holds the place of a body would leave it with a velocity. Where a contact closes, loads
are therefore impulses at the beginning of the step as well: along the normal; along the tangents where friction
holds; and where a contact slides, along the friction that its normal force brings about.

Compliance, which makes F + Fᵀ ≻ 0, counts from the forces of the nominal action, so that what rests does not creep,
but as slowly as MuJoCo's soft friction lets it. Nor does a contact open that only lies as deep as MuJoCo's soft
contacts do under their load.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from difflcs.lcp import solve_lcp_arrays
from difflcs.physics.mujoco.contacts import Found
from difflcs.physics.mujoco.motion import DynamicStep

Array = NDArray[np.float64]
_USUAL, _LOAD = 0.02, 100.0  # depth of contacts in parts of the length, acceleration [m/s²], both of any load
_SOFTER = 0.03  # of the compliance: how exactly forces are found
_PASSES = 2  # each reduces what is left of compliance and opening by about their parts of the motion


class Nominal(NamedTuple):
    """Contacts as the system of the step has them.

    Attributes:
        found: gaps without the depth that the load makes and with what a slide would open; tangents along the slide.
        forces: (n, n_contacts, n_rays) of the extreme rays of Anitescu's cone, in the order of `contact_lcs` [N s].
        carried: what is added to `DynamicStep.step`, as loads are impulses along contacts.
    """

    found: Found
    forces: Array
    carried: Array


class Recovery:
    """How deep MuJoCo's contacts lie under a load, and how fast they come out, by `solref` and `solimp` of the geoms.

    A contact force at rest is d²/(1 − d) k r over what a unit of force accelerates, at depth r and impedance d.

    Args:
        model: the MuJoCo model.
        length: of what touches [m].
    """

    def __init__(self, model: Any, length: float):
        self._usual = _USUAL * length
        (reference, ratio), impedance = model.geom_solref.T, np.clip(model.geom_solimp[:, :2], 1e-4, 0.9999).T
        time = np.maximum(reference, 2 * model.opt.timestep)  # as MuJoCo's `refsafe`
        given = impedance[1] ** 2 / np.maximum(-reference, 1e-9)
        stiffness = np.where(reference > 0, (impedance[1] * time * ratio) ** 2, given)
        self._time, self._depth = np.sqrt(stiffness), stiffness * (1 - impedance[0]) / impedance[0] ** 2
        damping = np.where(reference > 0, 0.5 * impedance[1] * time, impedance[1] / np.maximum(-ratio, 1e-9))
        pyramid = 1 + (model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL)  # about
        self._creep = pyramid * damping * (1 / impedance[0] - 1) / model.opt.impratio

    def settled(self, gap: Array, geom: NDArray[np.intp], acceleration: Array, seconds: float) -> Array:
        """Gaps (n, n_contacts) of geoms (n, n_contacts, 2) that carry accelerations (n, n_contacts), after a step.

        What is deeper than the load explains, or a load that only the action makes, comes out as fast as MuJoCo's
        contacts recover.
        """
        time, depth = self._time[geom].max(-1), self._depth[geom].max(-1)
        usual = np.minimum(depth * _LOAD, self._usual)
        deeper = np.maximum(-gap - np.clip(depth * acceleration, usual, 5 * self._usual), 0.0)
        return np.where(gap < 0, -deeper * (1 - np.exp(-seconds / time)), gap)

    def crept(self, geom: NDArray[np.intp], acceleration: Array, speed: Array) -> Array:
        """Speeds (n, n_contacts, n_tangents) that stay of `speed`, where friction carries such accelerations."""
        creep = -self._creep[geom].max(-1)[:, :, None] * acceleration
        return np.where(creep * speed > 0, np.sign(speed) * np.minimum(np.abs(speed), np.abs(creep)), 0.0)


class _Rays:
    """The extreme rays of friction cones and the forces along them that keep contacts closed, as in `contact_lcs`."""

    def __init__(self, found: Found, response: Array, give: float, compliance: float):
        slide = found.friction[:, :, None, None] * found.tangent
        normal = found.normal[:, :, None]
        rows = np.stack([normal + slide, normal - slide], 3) if slide.shape[2] else normal[:, :, None]
        n, k = rows.shape[:2]
        self.shape = n, k, max(1, 2 * slide.shape[2])
        self._rows = rows.reshape(n, -1, rows.shape[-1])
        self._moves = response @ self._rows.swapaxes(-1, -2)
        self._F = self._rows @ self._moves / give
        self._F += compliance * np.eye(self._F.shape[-1])
        self._give, self._compliance = give, compliance

    def forces(self, place: Array, gap: Array, rest: Array | float = 0.0) -> tuple[Array, Array]:
        """Forces (n, n_contacts, n_rays) and where they move ζ (n, nv); the compliance counts from forces `rest`."""
        apart = np.repeat(gap, self.shape[2], axis=1) + (self._rows @ place[:, :, None])[:, :, 0]
        rest = np.broadcast_to(rest, self.shape).reshape(apart.shape)
        lam = solve_lcp_arrays(self._F, apart - self._compliance * self._give * rest)[0] / self._give
        return lam.reshape(self.shape), place + (self._moves @ lam[:, :, None])[:, :, 0]


def at_nominal(
    step: DynamicStep,
    found: Found,
    geom: NDArray[np.intp],
    recovery: Recovery,
    give: float,
    compliance: float,
    opens: bool,
) -> Nominal:
    """What contacts do at the nominal action.

    Args:
        step: the motion without contact.
        found: contacts.
        recovery: of MuJoCo's contacts.
        geom: their geoms (n, n_contacts, 2).
        give: how far a unit of impulse moves two bodies apart [m/(N s)].
        compliance: of contacts, in parts of `give`.
        opens: whether the model of friction is Anitescu's, in which a contact that slides opens.
    """
    compliance *= _SOFTER
    if not found.gap.size:
        return Nominal(found, np.zeros((*found.gap.shape, 1)), np.zeros_like(step.step))
    closing = _closing(step.place, step.response, found)
    carried = _carried(step, found, closing, np.zeros(found.tangent.shape[:3]))
    # First all that close hold.
    place, closed = _place(step, carried), np.maximum(found.gap, 0.0)
    found = found._replace(tangent=_turned(found.tangent, np.einsum("nktv,nv->nkt", found.tangent, place)))
    forces, moved = _Rays(found, step.seconds * step.response, give, compliance).forces(place, closed)
    slide, normal = np.einsum("nktv,nv->nkt", found.tangent, moved), forces.sum(-1)
    # The drag of Stewart and Trinkle's model holds what slides.
    slides = _slides(slide, found, place) & opens
    if slides.any() and step.motion.firm.any():
        # What robots touch may hold with another action than the nominal one.
        _, firmly = _Rays(found, step.seconds * step.firm, give, compliance).forces(place, closed)
        slides &= _slides(np.einsum("nktv,nv->nkt", found.tangent, firmly), found, place)
    acceleration = np.einsum("nkv,nvw,nkw->nk", found.normal, step.inverse_mass, found.normal) * normal / step.seconds
    gap = recovery.settled(found.gap, geom, acceleration, step.seconds)
    found = found._replace(tangent=_turned(found.tangent, slide))
    slide = np.einsum("nktv,nv->nkt", found.tangent, moved) * slides[:, :, None]
    if slides.any():  # else it is as before: what holds does not depend on the directions of the tangents
        carried = _carried(step, found, closing, slide)
    rays, place, forces = (
        _Rays(found, step.seconds * step.response, give, compliance),
        _place(step, carried),
        np.zeros_like(forces),
    )
    for _ in range(_PASSES):
        # A contact that slides by s opens by μ s in Anitescu's model, as its gap is n·Δx − μ s.
        opened = gap + found.friction * slides * np.linalg.norm(slide, axis=-1)
        forces, moved = rays.forces(place, opened, forces)
        slide = np.einsum("nktv,nv->nkt", found.tangent, moved)
    # What creeps moves the point from which friction counts, which is that of so much compliance.
    creep = _creeping(step, found, geom, recovery, forces) * ~slides[:, :, None] / (compliance / _SOFTER * give)
    return Nominal(found._replace(gap=opened), forces + creep, carried)


def _creeping(step: DynamicStep, found: Found, geom: NDArray[np.intp], recovery: Recovery, forces: Array) -> Array:
    """How far contacts creep along the rays (n, n_contacts, n_rays) of their `forces`."""
    if not found.tangent.shape[2]:
        return np.zeros_like(forces)
    each = forces.reshape(*found.tangent.shape[:3], 2)
    friction, velocity = found.friction[:, :, None], step.x[:, None, None, found.normal.shape[-1] :]
    gives = ((found.tangent @ step.inverse_mass[:, None]) * found.tangent).sum(-1)
    acceleration = gives * friction * (each[..., 0] - each[..., 1]) / step.seconds
    far = step.seconds * friction * recovery.crept(geom, acceleration, (found.tangent * velocity).sum(-1))
    return np.stack([far, -far], -1).reshape(forces.shape)


def _place(step: DynamicStep, carried: Array) -> Array:
    """ζ (n, nv) afterwards with the nominal action, with `carried` added to the motion without contact."""
    nv = step.place.shape[1]
    return step.place + carried[:, :nv, -1] + (carried[:, :nv, nv : 2 * nv] @ step.x[:, nv:, None])[:, :, 0]


def _closing(place: Array, response: Array, found: Found) -> NDArray[np.bool_]:
    """Which contacts (n, n_contacts) close where bodies go to ζ (n, nv), as those below in a stack are held up."""

    def gap(place: Array) -> Array:
        return found.gap + np.einsum("nkv,nv->nk", found.normal, place)

    closing = gap(place) < 0
    for _ in range(closing.shape[1] * int(closing.any())):
        rows = found.normal * closing[:, :, None]
        held = place + _pushed(response, rows, rows, np.where(closing, -gap(place), 0.0)[:, :, None])[:, :, 0]
        more = closing | (gap(held) < 0)
        if (more == closing).all():
            break
        closing = more
    return closing


def _loaded(acceleration: Array, step: DynamicStep, found: Found) -> NDArray[np.bool_]:
    """Which contacts (n, n_contacts) have a part in what carries the loads, by the accelerations of their forces."""
    loads = step.delayed[:, : step.place.shape[1], -1:]
    parts = [np.abs(found.normal @ loads)[..., 0], *np.abs(found.tangent @ loads[:, None])[..., 0].transpose(2, 0, 1)]
    return acceleration * step.seconds**2 > 0.1 * np.max(parts, (0, 2))[:, None]


def _slides(slide: Array, found: Found, place: Array) -> NDArray[np.bool_]:
    """Which contacts (n, n_contacts) slide by (n, n_contacts, n_tangents), and do not merely creep.

    The measure is what they would do without contact, where bodies go to ζ (n, nv).
    """
    sideways = np.linalg.norm(np.einsum("nktv,nv->nkt", found.tangent, place), axis=-1).max(-1, keepdims=True)
    down = np.abs(np.einsum("nkv,nv->nk", found.normal, place)).max(-1, keepdims=True)
    return np.linalg.norm(slide, axis=-1) > np.maximum(0.2 * sideways, 0.05 * down)


def _carried(step: DynamicStep, found: Found, closing: NDArray[np.bool_], slide: Array) -> Array:
    """What is added to `step.step` where contacts slide by (n, n_contacts, n_tangents) or, with zeros, hold."""
    nv, slides = step.place.shape[1], slide.any(-1)
    tangents = np.moveaxis(found.tangent, 2, 0) * (closing & ~slides & (found.friction > 0))[:, :, None]
    normals = found.normal * closing[:, :, None]
    forces = normals - _drag(step, found, slide) * closing[:, :, None] if slides.any() else normals
    rows, forces = (_by_body(np.concatenate([v, *tangents], 1), step.tree) for v in (normals, forces))
    some = rows.any((0, 2))
    rows, forces = rows[:, some], forces[:, some]
    delayed = np.concatenate([step.delayed[:, :nv], step.delayed[:, nv:]], -1)
    pushed = _pushed(step.response, rows, forces, rows @ delayed)
    return np.concatenate(np.split(pushed, 2, -1), 1)


def _drag(step: DynamicStep, found: Found, slide: Array) -> Array:
    """Friction of contacts that slide, as rows (n, n_contacts, nv) for a unit of normal force."""
    size = np.linalg.norm(slide, axis=-1, keepdims=True)
    drag = np.einsum("nkt,nktv->nkv", slide / np.where(size > 0, size, 1.0), found.tangent)
    drag *= found.friction[:, :, None]
    # Friction that presses what it holds back into the contact could jam it; so much of it is left out.
    gives = found.normal @ step.response
    presses, yields = ((gives * rows).sum(-1) for rows in (drag, found.normal))
    return drag * np.minimum(1.0, 0.7 * yields / np.maximum(presses, 1e-300))[:, :, None]


def _by_body(rows: Array, tree: NDArray[np.intp]) -> Array:
    """Rows (n, k, nv) of pairs of bodies as rows (n, 2 k, nv) of one body each, by the tree (nv,) of each freedom."""
    trees = np.unique(tree)
    if len(trees) == 1:
        return rows
    touched = np.stack([rows[:, :, tree == t].any(-1) for t in trees], -1)
    first, last = touched.argmax(-1), len(trees) - 1 - touched[:, :, ::-1].argmax(-1)
    one = rows * (trees[first][:, :, None] == tree)
    return np.concatenate([one, (rows - one) * (trees[last][:, :, None] == tree)], 1)


def _pushed(response: Array, rows: Array, forces: Array, by: Array) -> Array:
    """How far ζ (n, nv, m) goes when forces along `forces` (n, k, nv) move it along `rows` (n, k, nv) by (n, k, m)."""
    if not rows.size:
        return np.zeros((len(rows), rows.shape[-1], by.shape[-1]))
    gives = response @ forces.swapaxes(-1, -2)
    inner = rows @ gives
    # Contacts of one face are not independent.
    scale = np.trace(inner, axis1=-2, axis2=-1)[:, None, None]
    inner += np.eye(inner.shape[-1]) * np.where(scale > 0, 1e-9 * scale, 1.0)
    return gives @ np.linalg.solve(inner, by)


def _turned(tangent: Array, slide: Array) -> Array:
    """Tangents (n, n_contacts, n_tangents, nv), the first of two along the slide: there the cone of rays is exact."""
    if tangent.shape[2] < 2:
        return tangent
    far = np.linalg.norm(slide, axis=-1, keepdims=True)
    along = np.where(far > 1e-9, slide / np.maximum(far, 1e-9), [1.0, 0.0])
    across = np.stack([-along[..., 1], along[..., 0]], -1)
    return np.stack([along, across], -2) @ tangent
