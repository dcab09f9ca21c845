"""Contacts at the nominal action: which close, hold or slide, and the loads that they carry.

A load that acts all the time, such as gravity, moves a body by h²/2 in a step where the impulse that balances it moves
it by h². So a contact that holds the place of a body would leave it with a velocity. Where a contact closes, loads
are therefore impulses at the beginning of the step as well: along the normal; along the tangents where friction
holds; and where a contact slides, along the friction that its normal force brings about.

Compliance, which makes F + Fᵀ ≻ 0, counts from the forces of the nominal action, so that what rests does not creep,
but as slowly as MuJoCo's soft friction lets it. Nor does a contact open that only lies as deep as MuJoCo's soft
contacts do under their load.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from difflcs.errors import ContactWarning, warn
from difflcs.physics.complementarity import Cone, count_forces
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.contacts import MujocoContacts
from difflcs.physics.mujoco.limits import Followed, Rows, ScaledRows, find_load, follow, give_way, scale
from difflcs.physics.mujoco.motion import Dynamic, DynamicStep

Array = NDArray[np.float64]
_USUAL, _LOAD = 0.02, 100.0  # depth of contacts in parts of the length, acceleration [m/s²], both of any load
_LEAST = 0.01  # compliance of a contact in parts of how far its own forces move it; MuJoCo's is .05 and more
_SOFTER = 0.03  # of the compliance: how exactly forces are computed
_GAINS = 1.0  # of the speeds before the step and without contact, which contacts and limits do not make faster
_ACTS = 0.6, 1.25  # part of a step in which a force moves things; from 0.5 on an impact would bounce with its speed
_PRESSED = 0.4, 10.0  # the same of what drives press against a limit
_PASSES = 2  # each reduces what is left of compliance and opening by about their parts of the motion


class Nominal(NamedTuple):
    """Contacts as the system of the step has them.

    Attributes:
        contacts: gaps without the depth that the load makes and with what a slide would open; tangents along the slide.
        forces: (n, n_contacts, n_rays) of the extreme rays of Anitescu's cone, in the order of `contact_lcs` [N s].
        rows: limits and dry friction.
        row_forces: (n, n_rows) of these.
        carried: addition to (ζ, ν) of `DynamicStep.step`, as loads are impulses along contacts.
    """

    contacts: MujocoContacts
    forces: Array
    rows: ScaledRows
    row_forces: Array
    carried: Array

    def rest(self, rough: NDArray[np.bool_], n_tangents: int, cone: Cone, n_caps: int) -> Array:
        """Forces (n, n_lam) from which the compliance counts, as `contact_lcs` has them for a cone."""
        forces, smooth = self.forces[:, rough], self.forces[:, ~rough].sum(-1)
        each = count_forces(1, n_tangents, cone)
        if each != forces.shape[-1]:  # Stewart and Trinkle: normal, tangential, and the distance
            forces = np.concatenate([forces.sum(-1, keepdims=True), np.zeros((*forces.shape[:2], each - 1))], -1)
        rays, slid = forces.reshape(len(forces), each * forces.shape[1]), np.zeros_like(self.rows.bound)
        caps = np.zeros((len(forces), n_caps))  # what has one rests on its rays
        return np.concatenate([rays, caps, smooth, self.row_forces, slid, caps], -1)


class Recovery:
    """Depth of MuJoCo's contacts under a load, and the speed at which they come out, by `solref` and `solimp`.

    A contact force at rest is d²/(1 − d) k r over what a unit of force accelerates, at depth r and impedance d.

    Args:
        model: the MuJoCo model.
        length: of what touches [m].
    """

    def __init__(self, model: Any, length: float):
        self._usual = _USUAL * length
        (reference, ratio), impedance = model.geom_solref.T, np.clip(model.geom_solimp[:, :2], 1e-4, 0.9999).T
        time = np.maximum(reference, 2 * model.opt.timestep)  # as MuJoCo's `refsafe`
        direct = impedance[1] ** 2 / np.maximum(-reference, 1e-9)
        stiffness = np.where(reference > 0, (impedance[1] * time * ratio) ** 2, direct)
        self._time, self._depth = np.sqrt(stiffness), stiffness * (1 - impedance[0]) / impedance[0] ** 2
        damping = np.where(reference > 0, 0.5 * impedance[1] * time, impedance[1] / np.maximum(-ratio, 1e-9))
        pyramid = 1 + (model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL)  # about
        self._creep = pyramid * damping * (1 / impedance[0] - 1) / model.opt.impratio

    def settled(self, gap: Array, geom: NDArray[np.intp], acceleration: Array, speed: Array, seconds: float) -> Array:
        """Gaps (n, n_contacts) of geoms (n, n_contacts, 2) that carry accelerations (n, n_contacts), after a step.

        What is deeper than the load explains, or a load that only the action makes, comes out as MuJoCo's contacts
        recover, critically damped, from the `speed` (n, n_contacts) at which it opens now, as far as depth explains it.
        """
        time, depth = self._time[geom].max(-1), self._depth[geom].max(-1)
        usual = np.minimum(depth * _LOAD, self._usual)
        deeper = np.maximum(-gap - np.clip(depth * acceleration, usual, 5 * self._usual), 0.0)
        part, most = seconds / time, deeper / time
        moved = deeper * (1 - (1 + part) * np.exp(-part)) + np.clip(speed, -most, most) * seconds * np.exp(-part)
        return np.where(gap < 0, -moved, gap)

    def crept(self, geom: NDArray[np.intp], acceleration: Array, speed: Array) -> Array:
        """Part (n, n_contacts, n_tangents) of `speed` that remains as friction carries such accelerations."""
        creep = -self._creep[geom].max(-1)[:, :, None] * acceleration
        return np.where(creep * speed > 0, np.sign(speed) * np.minimum(np.abs(speed), np.abs(creep)), 0.0)


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

    @property
    def soft(self) -> Array:
        """Compliance (n, n_contacts) of each contact of the system, in parts of `give`, with _LEAST of its own.

        A contact that is far stiffer than what it moves, as those of light links are, makes plans creep.
        """
        response, (_, normal, tangent) = self.step.seconds * self.step.response, self.contacts[:3]
        own = give_way(normal, response)
        if tangent.shape[2]:  # along the rays of its cone
            own = own + self.contacts.friction**2 * give_way(tangent, response[:, None]).max(-1)
        return np.maximum(self.compliance, _LEAST * own / self.give)

    def rays(self, contacts: MujocoContacts, rows: ScaledRows, response: Array) -> _Rays:
        """Return the rays of contacts and rows as they are found to act, for forces that are nearly exact."""
        return _Rays(contacts, self.rough, rows, self.step.seconds * response, self.give, _SOFTER * self.compliance)


class _Rays:
    """The extreme rays of friction cones and rows, and the forces that keep them closed, as in `contact_lcs`."""

    def __init__(
        self,
        contacts: MujocoContacts,
        rough: NDArray[np.bool_],
        rows: ScaledRows,
        response: Array,
        give: float,
        compliance: float,
    ):
        slide = contacts.friction[:, :, None, None] * contacts.tangent
        normal = contacts.normal[:, :, None]
        rays = np.stack([normal + slide, normal - slide], 3) if slide.shape[2] else normal[:, :, None]
        n, k = rays.shape[:2]
        self.shape = n, k, max(1, 2 * slide.shape[2])
        self._kept = np.flatnonzero(rough[:, None] | (np.arange(self.shape[2]) == 0))  # one where all are the same
        self._rows = np.concatenate([rays.reshape(n, k * self.shape[2], rays.shape[-1])[:, self._kept], rows.normal], 1)
        self._gives = (response / give) @ self._rows.swapaxes(-1, -2)
        self._F, forces = self._rows @ self._gives, np.arange(self._rows.shape[1])
        self._F[:, forces, forces] += compliance
        self._give, self._compliance, self._of_rows = give, compliance, rows.gap
        unbounded = np.full((n, self._rows.shape[1] - rows.bound.shape[1]), np.inf)
        self._low = np.concatenate([np.zeros_like(unbounded), -give * rows.bound], 1)
        self._high = np.concatenate([unbounded, give * rows.bound], 1)

    def forces(self, place: Array, gap: Array, rest: Array | float = 0.0) -> tuple[Array, Array]:
        """Forces (n, m) of rays and rows, and where they move ζ (n, nv); the compliance counts from forces `rest`.

        Warns:
            ContactWarning: for some states rounding keeps it from finding them exactly.
        """
        apart = np.concatenate([gap[:, self._kept // self.shape[2]], self._of_rows], 1)
        start = np.zeros_like(apart) + rest * self._give
        apart = apart + (self._rows @ place[:, :, None])[:, :, 0] - self._compliance * start
        lam, found = solve_forces(self._F, apart, self._low, self._high, start, self._compliance)
        if missed := int((~found).sum()):
            warn(
                f"expected the forces of contacts and limits at the nominal action, found none that fit for {missed} "
                f"of {len(gap)} states, so that what touches there may creep: look for bodies of very different mass, "
                f"or pass a larger compliance",
                ContactWarning,
            )
        return lam / self._give, place + (self._gives @ lam[:, :, None])[:, :, 0]

    def impulse(self, forces: Array, rows: ScaledRows) -> Array:
        """Impulse (n, nv, 1) on the degrees of freedom by forces (n, m)."""
        along = np.concatenate([self._rows[:, : len(self._kept)], rows.impulse], 1)
        return along.swapaxes(-1, -2) @ forces[:, :, None]

    def split(self, forces: Array) -> tuple[Array, Array]:
        """Forces of contacts (n, n_contacts, n_rays) and of rows (n, n_rows)."""
        of_contacts = np.zeros((len(forces), self.shape[1] * self.shape[2]))
        of_contacts[:, self._kept] = forces[:, : len(self._kept)]
        return of_contacts.reshape(self.shape), forces[:, len(self._kept) :]


def solve_forces(
    F: Array, q: Array, low: Array, high: Array, start: Array, compliance: float = 0.0
) -> tuple[Array, NDArray[np.bool_]]:
    """Find λ (n, m) between bounds where q + F λ (n, m) is zero within them, and else presses λ against them.

    So 0 ≤ λ ⊥ q + F λ ≥ 0 between 0 and infinity; between −b and b it is dry friction. Return λ, and a mask (n,) of
    those that were found. The matrices F (k, m, m) are taken in turn. With a compliance, which F has on its diagonal,
    it is symmetric. Within their bounds are probably those that are so in `start`.
    """
    lam, found = np.array(start, dtype=np.float64, order="C"), np.zeros(len(q), dtype=bool)
    if q.size:
        threads = max(1, min(len(q), torch.get_num_threads()))
        F, q, low, high = (np.ascontiguousarray(values) for values in (F, q, low, high))
        _mujoco.solve_forces(compliance, threads, F, q, low, high, lam, found)
    return lam, found | (not q.size)


def _settle(at: Situation, at_once: NDArray[np.bool_]) -> tuple[ScaledRows, Array]:
    """Find where limits and friction hold; return them, and (n, n_rows, nv) those that hold all the time.

    In the states `at_once` (n,) they act at the beginning of the step, as contacts do.
    """
    step, contacts, rows, give = at.step, at.contacts, at.rows, at.give
    h, nv, k = step.seconds, step.place.shape[1], rows.gap.shape[1] - rows.n_friction
    response, is_limit = h * step.response, np.arange(rows.gap.shape[1]) < k
    if not rows.gap.size:
        return scale(rows, rows.gap, 1.0, response, give, h), rows.normal
    # First a step with all loads at its beginning, as forces are: limits hold at zero, what creeps goes on creeping.
    speed = (rows.normal @ step.velocity[:, :, None])[:, :, 0]
    creeps = np.abs(speed) < np.where(is_limit, 0.0, rows.soft.bound) * rows.soft.yields(1.0, np.inf)
    gap = np.where(is_limit, np.maximum(rows.gap, 0.0) + 2 * rows.bend, -h * speed * creeps)
    scaled = scale(rows, gap, 1.0, response, give, h)
    rays = at.rays(contacts, scaled, step.response)
    forces, moved = rays.forces(step.reached(step.delayed)[0], np.maximum(contacts.gap, 0.0))
    forces = rays.split(forces)[1]
    after_bend = (rows.normal @ moved[:, :, None])[:, :, 0] + 2 * rows.bend
    load = find_load(step, rows.normal, rows.bend, after_bend / h, forces * scaled.unit)
    # The same with the action that presses a limit most.
    by_action = step.step[:, :, step.x.shape[1] : -1]
    far, fast = rows.normal @ by_action[:, :nv], rows.normal @ by_action[:, nv : 2 * nv]
    faster = np.abs(fast) @ step.motion.actuators.reach
    harder = np.stack([np.zeros_like(faster), faster]) * (1 + h * load.drag) / h
    gap, load = np.broadcast_to(rows.gap, harder.shape), load._replace(acceleration=load.acceleration - harder)
    both = follow(gap, speed, load, rows.soft, h, step.motion.steps.count)
    after, most = (Followed(*(v[i] for v in both)) for i in range(2))
    inside = np.abs(forces[:, k:]) < 0.999 * scaled.bound
    holds = after.holds & np.concatenate([forces[:, :k] > 0, inside], 1)
    # A limit holds at the depth that it has after the step, friction after its creep.
    depth = np.minimum(rows.gap + after.moved, 0.0)
    gap = np.where(is_limit, rows.gap + 2 * rows.bend - depth, -after.moved * holds)
    # Between the nominal action and the one that presses it most, a limit gives way as MuJoCo's does on average.
    late = np.where(holds, 1.0, (far * fast).sum(-1) / np.maximum(h * (fast * fast).sum(-1), 1e-300))
    gives = (after.speed - most.speed) / np.maximum(faster, 1e-300)
    pressed, part = is_limit & most.acts & (faster > 0) & ~at_once[:, None], np.clip(after.part, *_ACTS)
    part = np.where(pressed, np.clip(late / np.maximum(1 - gives, 0.05), *_PRESSED), part)
    # What is reached in the step has its gap where the force stops it as at the nominal action.
    stopped = after.speed - (speed + h * load.acceleration[0]) / (1 + h * load.drag)
    gap = np.where(pressed & after.acts & (rows.gap > 0), gap - (part - after.part) * h * stopped, gap)
    part = np.where(~is_limit & after.stops | at_once[:, None], 1.0, part)
    return scale(rows, gap, part, response, give, h), rows.normal * holds[:, :, None]


def evaluate_nominal(at: Situation) -> Nominal:
    """Decide which contacts close, hold or slide at the nominal action, and which rows act.

    Where contacts and limits jam each other, they act at the same time, as they would else make things fast.
    """
    step, contacts, rows = at.step, at.contacts, at.rows
    if not contacts.gap.size and not rows.gap.size:
        settled = scale(rows, rows.gap, 1.0, step.seconds * step.response, at.give, step.seconds)
        return Nominal(contacts, np.zeros((*contacts.gap.shape, 1)), settled, rows.gap, np.zeros_like(step.delayed))
    nominal, velocity = _evaluate(at, np.zeros(len(step.x), dtype=bool))
    if rows.gap.size and contacts.gap.size:
        inverse = np.diagonal(step.inverse_mass, axis1=1, axis2=2)
        speeds = step.velocity, step.reached(np.zeros_like(step.delayed))[1], velocity
        before, alone, after = (np.sqrt((v * v / inverse).sum(-1)) for v in speeds)
        jams = after > _GAINS * (before + alone)
        if jams.any():
            nominal, _ = _evaluate(at, jams)
    return nominal


def _evaluate(at: Situation, at_once: NDArray[np.bool_]) -> tuple[Nominal, Array]:
    """Do so, and return the velocities (n, nv) after the step; for states `at_once` (n,) see `_settle`."""
    step, contacts, recovery = at.step, at.contacts, at.recovery
    settled, held = _settle(at, at_once)
    closing = _find_closing(step.place, step.response, contacts, held)
    carried = _compute_carried(step, contacts, closing, np.zeros(contacts.tangent.shape[:3]), held)
    # First all that close hold.
    place, closed = step.reached(carried)[0], np.maximum(contacts.gap, 0.0)
    contacts = contacts._replace(
        tangent=_turn_tangents(contacts.tangent, np.einsum("nktv,nv->nkt", contacts.tangent, place))
    )
    rays = at.rays(contacts, settled, step.response)
    forces, moved = rays.forces(place, closed)
    slide, normal = np.einsum("nktv,nv->nkt", contacts.tangent, moved), rays.split(forces)[0].sum(-1)
    # The drag of Stewart and Trinkle's model holds what slides.
    slides = _find_sliding(slide, contacts, place) & at.opens
    if slides.any() and step.motion.firm.any():
        # What robots touch may hold with another action than the nominal one, with which they do not give way.
        loose = ~step.motion.firm
        _, firmly = at.rays(contacts, settled, step.response * (loose & loose[:, None])).forces(place, closed)
        slides &= _find_sliding(np.einsum("nktv,nv->nkt", contacts.tangent, firmly), contacts, place)
    acceleration = give_way(contacts.normal, step.inverse_mass) * normal / step.seconds
    speed = (contacts.normal @ step.velocity[:, :, None])[:, :, 0]
    gap = recovery.settled(contacts.gap, contacts.geom, acceleration, speed, step.seconds)
    contacts = contacts._replace(tangent=_turn_tangents(contacts.tangent, slide))
    slide = np.einsum("nktv,nv->nkt", contacts.tangent, moved) * slides[:, :, None]
    if slides.any():  # else it is as before: what holds does not depend on the directions of the tangents
        carried = _compute_carried(step, contacts, closing, slide, held)
    rays = at.rays(contacts, settled, step.response)
    (place, velocity), forces = step.reached(carried), np.zeros_like(forces)
    for _ in range(_PASSES):
        # A contact that slides by s opens by μ s in Anitescu's model, as its gap is n·Δx − μ s.
        opened = gap + contacts.friction * slides * np.linalg.norm(slide, axis=-1)
        forces, moved = rays.forces(place, opened, forces)
        slide = np.einsum("nktv,nv->nkt", contacts.tangent, moved)
    of_contacts, of_rows = rays.split(forces)
    # What creeps moves the point from which friction counts, which is that of so much compliance.
    creep = _compute_creep(step, contacts, recovery, of_contacts) * ~slides[:, :, None]
    creep /= at.soft[:, :, None] * at.give
    velocity = velocity + (step.response @ rays.impulse(forces, settled))[:, :, 0]
    return Nominal(contacts._replace(gap=opened), of_contacts + creep, settled, of_rows, carried), velocity


def _compute_creep(step: DynamicStep, contacts: MujocoContacts, recovery: Recovery, forces: Array) -> Array:
    """Compute the creep of contacts along the rays (n, n_contacts, n_rays) of their `forces`."""
    if not contacts.tangent.shape[2]:
        return np.zeros_like(forces)
    each = forces.reshape(*contacts.tangent.shape[:3], 2)
    friction, velocity = contacts.friction[:, :, None], step.velocity[:, None, None]
    gives = give_way(contacts.tangent, step.inverse_mass[:, None])
    acceleration = gives * friction * (each[..., 0] - each[..., 1]) / step.seconds
    far = step.seconds * friction * recovery.crept(contacts.geom, acceleration, (contacts.tangent * velocity).sum(-1))
    return np.stack([far, -far], -1).reshape(forces.shape)


def _find_closing(place: Array, response: Array, contacts: MujocoContacts, held: Array) -> NDArray[np.bool_]:
    """Find the contacts (n, n_contacts) that close as bodies move by ζ (n, nv), stacked bodies held up in turn.

    The rows `held` (n, k, nv) do not move.
    """
    if held.any():
        place = place + _push(response, held, held, -held @ place[:, :, None])[:, :, 0]
    gap = contacts.gap + (contacts.normal @ place[:, :, None])[:, :, 0]
    closing = gap < 0
    for _ in range(closing.shape[1] * int(closing.any())):
        rows = np.concatenate([contacts.normal * closing[:, :, None], held], 1)
        by = np.concatenate([np.where(closing, -gap, 0.0), np.zeros(held.shape[:2])], 1)
        more = closing | (gap + (contacts.normal @ _push(response, rows, rows, by[:, :, None]))[:, :, 0] < 0)
        if (more == closing).all():
            break
        closing = more
    return closing


def _find_sliding(slide: Array, contacts: MujocoContacts, place: Array) -> NDArray[np.bool_]:
    """Return a mask (n, n_contacts) of contacts whose slides (n, n_contacts, n_tangents) are more than creep.

    The measure is what they would do without contact, where bodies go to ζ (n, nv).
    """
    sideways = np.linalg.norm(np.einsum("nktv,nv->nkt", contacts.tangent, place), axis=-1).max(
        -1, keepdims=True, initial=0.0
    )
    down = np.abs(np.einsum("nkv,nv->nk", contacts.normal, place)).max(-1, keepdims=True, initial=0.0)
    return np.linalg.norm(slide, axis=-1) > np.maximum(0.2 * sideways, 0.05 * down)


def _compute_carried(
    step: DynamicStep, contacts: MujocoContacts, closing: NDArray[np.bool_], slide: Array, held: Array
) -> Array:
    """Compute the addition to `step.step` where contacts slide by (n, n_contacts, n_tangents) or, with zeros, hold.

    The rows `held` (n, k, nv) hold.
    """
    nv, slides = step.place.shape[1], slide.any(-1)
    tangents = np.moveaxis(contacts.tangent, 2, 0) * (closing & ~slides & (contacts.friction > 0))[:, :, None]
    # What touches without a load may have one with another action.
    normals = contacts.normal * (closing | (contacts.gap < 0))[:, :, None]
    forces = normals - _compute_drag(step, contacts, slide) * closing[:, :, None] if slides.any() else normals
    rows, forces = (_split_by_body(np.concatenate([v, *tangents, held], 1), step.motion) for v in (normals, forces))
    # As far along the rows as what is delayed.
    pushed = _push(step.response, rows, forces, rows)[:, None] @ step.delayed.reshape(len(rows), 2, nv, -1)
    return pushed.reshape(step.delayed.shape)


def _compute_drag(step: DynamicStep, contacts: MujocoContacts, slide: Array) -> Array:
    """Compute the friction of contacts that slide, as rows (n, n_contacts, nv) for a unit of normal force."""
    size = np.linalg.norm(slide, axis=-1, keepdims=True)
    drag = np.einsum("nkt,nktv->nkv", slide / np.where(size > 0, size, 1.0), contacts.tangent)
    drag *= contacts.friction[:, :, None]
    # Friction that presses what it holds back into the contact could jam it; so much of it is left out.
    gives = contacts.normal @ step.response
    presses, yields = ((gives * rows).sum(-1) for rows in (drag, contacts.normal))
    return drag * np.minimum(1.0, 0.7 * yields / np.maximum(presses, 1e-300))[:, :, None]


def _split_by_body(rows: Array, motion: Dynamic) -> Array:
    """Split rows (n, k, nv) of pairs of bodies into rows (n, 2 k, nv) of one body each, by the trees of the motion."""
    tree, trees = motion.tree, motion.trees
    if len(trees) == 1:
        return rows
    touched = np.stack([rows[:, :, tree == t].any(-1) for t in trees], -1)
    first, last = touched.argmax(-1), len(trees) - 1 - touched[:, :, ::-1].argmax(-1)
    one = rows * (trees[first][:, :, None] == tree)
    return np.concatenate([one, (rows - one) * (trees[last][:, :, None] == tree)], 1)


def _push(response: Array, rows: Array, forces: Array, by: Array) -> Array:
    """Motion ζ (n, nv, m) when forces along `forces` (n, k, nv) move it along `rows` (n, k, nv) by (n, k, m)."""
    moved = np.empty((len(rows), rows.shape[2], by.shape[2]))
    response, rows, forces, by = (np.ascontiguousarray(values) for values in (response, rows, forces, by))
    _mujoco.push(response, rows, forces, by, moved)
    return moved


def _turn_tangents(tangent: Array, slide: Array) -> Array:
    """Turn the first of tangents (n, n_contacts, n_tangents, nv) along the slide: there the cone is exact."""
    count = tangent.shape[2]
    if count < 2:
        return tangent
    far = np.linalg.norm(slide, axis=-1, keepdims=True)
    along = np.where(far > 1e-9, slide / np.maximum(far, 1e-9), np.eye(count)[0])
    # A reflection takes the first one there, or to the other side.
    normal = along + np.where(along[..., :1] < 0, -1.0, 1.0) * np.eye(count)[0]
    turned = 2 * normal[..., None] * normal[..., None, :] / (normal**2).sum(-1)[..., None, None] - np.eye(count)
    return turned @ tangent
