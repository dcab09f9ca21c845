"""Contacts of a MuJoCo model at many states: gaps and contact Jacobians from MuJoCo's own collision detection.

MuJoCo finds contacts within a margin, here the distance up to which they matter, and builds the Jacobian of their
constraints natively. That is exact between shapes that have a formula; all others `narrow.py` measures instead. Boxes
it measures too, as what separates faces is not always the shortest way: where MuJoCo's contacts are not as near as the
boxes are, or are missing, those of `narrow.py` count.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from difflcs._checks import describe
from difflcs.errors import ContactWarning, InvalidInputError
from difflcs.physics.mujoco.narrow import NATIVE, Array, Measured, Narrow, Witness, perpendicular, witnesses
from difflcs.physics.mujoco.state import cross

Pairs = Sequence[tuple[int | str, int | str]]

MOST_CONTACTS = 12  # by default
_ENOUGH = 4  # contacts that hold a face, where there is no room for all
_NEAR = 0.1  # of the unit of gaps: a contact as near as this is one that counts
_STILL = 1e-9  # what the normal of a contact moves at most, if nothing can move along it

_THREE = np.arange(3)

_PLANE, _CAPSULE, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("PLANE", "CAPSULE", "CYLINDER", "BOX", "MESH")
)
# Of these MuJoCo misses contacts that are apart, so that things would fall through.
_FIELDS = (int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_SDF))
_DISABLED = int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
_BITS = 31  # of a mask
_OVERRIDE = int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)
_POINTS = {  # contacts that a pair of shapes can have, where more than one
    (_PLANE, _CAPSULE): 2,
    (_PLANE, _CYLINDER): 4,
    (_PLANE, _BOX): 4,
    (_PLANE, _MESH): 4,
    (_CAPSULE, _CAPSULE): 2,
    (_CAPSULE, _CYLINDER): 2,
    (_CAPSULE, _BOX): 2,
    (_CAPSULE, _MESH): 2,
    (_CYLINDER, _CYLINDER): 4,
    (_CYLINDER, _BOX): 4,
    (_CYLINDER, _MESH): 4,
    (_BOX, _BOX): 8,
    (_BOX, _MESH): 4,
    (_MESH, _MESH): 4,
}


class MujocoContacts(NamedTuple):
    """Contacts of n states.

    Attributes:
        gap: (n, n_contacts).
        normal: (n, n_contacts, nv) derivative of the gap by the degrees of freedom.
        tangent: (n, n_contacts, n_tangents, nv).
        friction: (n, n_contacts).
        geom: (n, n_contacts, 2) the geoms.
    """

    gap: Array
    normal: Array
    tangent: Array
    friction: Array
    geom: NDArray[np.intp]


class ContactBuffer(NamedTuple):
    """Contacts that MuJoCo reports at n states, filled one state at a time.

    Attributes:
        gap: (n, n_contacts).
        rows: (n, n_contacts, 3, nv) how the second body moves from the first, along the axes of `frame`.
        frame: (n, n_contacts, 3, 3) its rows are the normal and two tangents.
        geom: (n, n_contacts, 2).
        apart: (n, n_contacts) distance of the points on both bodies whose motion `rows` takes to be that of one point
            in the middle between them.
        axes: (n, nv, 6) around and along which each degree of freedom moves what it moves, at its centre.
        measured: contacts that `narrow.py` measured, before faces are cut: states, pairs, and of all geoms there the
            centres (ngeom, 3), places (ngeom, 3) and turns (ngeom, 3, 3).
    """

    gap: Array
    rows: Array
    frame: Array
    geom: NDArray[np.intp]
    apart: Array
    axes: Array
    measured: list[tuple[int, list[Measured], Array, Array, Array]]


class ContactFinder:
    """Finds the contacts at states that the caller sets in `data`. It changes the model for this purpose.

    Args:
        model: a private copy.
        data: its data, at which positions have been computed.
        pairs: geoms, or bodies with all their geoms, that may touch; None: as the model says.
        distance: contacts farther away are left out [m].
        length: unit of gaps [m].
        contacts: how many a state has; None: what the shapes of the pairs can have, at most `MOST_CONTACTS`, with a
            `ContactWarning` where more touch.
        friction: coefficient of all; None: that of the geoms.

    Attributes:
        axis: normal (3,) of the plane in which everything moves, or None.
        pairs: numbers of the geoms that may touch, those of the first and those of the second of each pair.
    """

    def __init__(
        self,
        model: Any,
        data: Any,
        pairs: Pairs | None,
        distance: float,
        length: float,
        contacts: int | None,
        friction: float | None,
    ):
        self.model, self.data, self.distance = model, data, distance
        self._warn_within = _NEAR * length if contacts is None else -np.inf
        self.axis = plane_of_motion(model, data)
        self.friction = _friction(model, friction)
        self.allowed = _may_touch(model) if pairs is None else _listed(model, pairs)
        self._drop_floors()
        _check_contacts(model, self.allowed, friction)
        self._native = self.allowed & NATIVE[model.geom_type[:, None], model.geom_type[None]]
        _test(model, np.flatnonzero(self.allowed.any(0)), named=pairs is not None)
        self.pairs = first, second = np.nonzero(np.triu(self.allowed))
        kinds = np.sort(model.geom_type[np.stack([first, second], -1)], axis=-1)
        if contacts is None:
            contacts = min(MOST_CONTACTS, sum(_POINTS.get((int(a), int(b)), 1) for a, b in kinds))
        self.n_contacts = contacts
        rough = bool((self.friction[first, second] > 0).any())
        self.n_tangents = (1 if self.axis is not None else 2) if rough else 0
        boxes = (kinds == _BOX).all(-1)
        measured = np.flatnonzero(boxes | ~self._native[first, second])
        self._narrow = Narrow(model, data, first[measured], second[measured], distance, self.axis)
        self._boxes, self._others = np.flatnonzero(boxes[measured]), np.flatnonzero(~boxes[measured])
        self._room = [_POINTS.get((int(a), int(b)), 1) for a, b in kinds[measured]]
        self._turns = _moves(model)[model.geom_bodyid].astype(np.float64)
        self._root = model.body_rootid[model.geom_bodyid]
        # Three rows of the Jacobian for each contact, the normal and two tangents, whatever its friction is.
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        model.geom_condim[:], model.pair_dim[:] = 3, 3
        model.geom_gap[:], model.pair_gap[:] = 0.0, 0.0
        model.opt.enableflags |= _OVERRIDE
        model.opt.o_margin = distance

    def _drop_floors(self) -> None:
        """Drop planes that nothing in the plane of motion can approach."""
        if self.axis is None:
            return
        planes = self.model.geom_type == _PLANE
        along = np.abs(self.data.geom_xmat.reshape(-1, 3, 3)[:, :, 2] @ self.axis) > 1 - 1e-9
        self.allowed[planes & along] = False
        self.allowed[:, planes & along] = False

    def allocate(self, n: int) -> ContactBuffer:
        """Make buffers for n states, with all contacts out of reach."""
        k, nv = self.n_contacts, self.model.nv
        gap = np.full((n, k), self.distance)
        rows, frame, axes = np.zeros((n, k, 3, nv)), np.zeros((n, k, 3, 3)), np.zeros((n, nv, 6))
        return ContactBuffer(gap, rows, frame, np.zeros((n, k, 2), dtype=np.intp), np.zeros((n, k)), axes, [])

    def read(self, i: int, into: ContactBuffer) -> None:
        """Write the contacts of the state in `data`, for which `mj_fwdPosition` was called, into row i."""
        data, count = self.data, self.n_contacts
        contact, jacobian = data.contact, data.efc_J.reshape(-1, self.model.nv)
        gap, geom, address = contact.dist, contact.geom, contact.efc_address
        rows = jacobian[address[:, None] + _THREE] if len(jacobian) else np.zeros((len(gap), 3, self.model.nv))
        frame, usable = contact.frame.reshape(-1, 3, 3), (address >= 0) & self._native[geom[:, 0], geom[:, 1]]
        into.axes[i], measured = data.cdof, []
        if len(self._boxes):
            usable, measured = self._mend_boxes(gap, geom, frame[:, 0], usable)
        # A normal that nothing can move along is that of a body resting on what is outside the plane of motion.
        kept = np.flatnonzero(usable & (np.abs(rows[:, 0]).max(-1, initial=0.0) > _STILL))
        if len(self._others):
            measured = measured + self._nearest(gap[kept])
        if measured:
            poses = data.subtree_com[self._root], data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy()
            into.measured.append((i, measured, *poses))
        if len(kept) > _ENOUGH and len(kept) + sum(self._room[m[0]] for m in measured) > count:
            kept = _spread(contact.pos, geom, gap, kept)
        if len(kept) > count:
            self._warn_of_more(int((gap[kept] <= self._warn_within).sum()))
            kept = np.sort(kept[np.argpartition(gap[kept], count - 1)[:count]])
        k = len(kept)
        into.gap[i, :k], into.rows[i, :k], into.frame[i, :k] = gap[kept], rows[kept], frame[kept]
        into.geom[i, :k], into.apart[i, :k] = geom[kept], gap[kept]

    def _mend_boxes(
        self, gap: Array, geom: Any, normal: Array, usable: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], list[Measured]]:
        """Drop contacts of boxes with a wrong gap or direction; return the mask, and measurements of these boxes."""
        narrow, n = self._narrow, self.model.ngeom
        near = self._boxes[narrow.at_least(self._boxes) < self.distance]
        if not (measured := narrow.measure(near.tolist())):
            return usable, measured
        boxes = witnesses(measured)
        key, keys = geom.min(-1) * n + geom.max(-1), narrow.first[boxes.pair] * n + narrow.second[boxes.pair]
        place = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        of_boxes, nearest = keys[place] == key, np.full(len(keys), np.inf)
        np.minimum.at(nearest, place[of_boxes], gap[of_boxes])
        tolerance = 1e-5 * narrow.size[boxes.pair]
        wrong = np.abs(nearest - boxes.gap) > tolerance
        same = np.abs(np.einsum("ij,ij->i", normal, boxes.normal[place])) > 1 - 1e-10
        for k in np.flatnonzero(of_boxes & ~same & ~wrong[place]):
            wrong[place[k]] |= narrow.boxes_along(geom[k], normal[k]) < boxes.gap[place[k]] - tolerance[place[k]]
        return usable & ~(of_boxes & wrong[place]), [measured[k] for k in np.flatnonzero(wrong)]

    def _nearest(self, gap: Array) -> list[Measured]:
        """Measure pairs that MuJoCo does not test: all within the distance, or those that can be among the nearest."""
        narrow, count = self._narrow, self.n_contacts
        lower = narrow.at_least(self._others)
        reach = np.flatnonzero(lower < self.distance)
        if len(reach) <= count:
            return narrow.measure(self._others[reach].tolist())
        reach = reach[np.argsort(lower[reach])]
        pairs, lower, measured = self._others[reach].tolist(), lower[reach], []
        for start in range(0, len(pairs), count):
            if lower[start] > self._farthest(gap, measured):
                measured = self._moving(measured)
                if lower[start] > self._farthest(gap, measured):
                    break
            measured = measured + narrow.measure(pairs[start : start + count])
        farthest = self._farthest(gap, measured := self._moving(measured))
        return [m for m in measured if m[1] <= farthest]

    def _farthest(self, gap: Array, measured: list[Measured]) -> float:
        """Return the largest gap of a contact to keep, among those of gaps (n,) and the measured ones."""
        gap = np.concatenate([gap, [m[1] for m in measured]])
        enough = len(gap) >= self.n_contacts > 0
        return max(self._warn_within, np.partition(gap, self.n_contacts - 1)[self.n_contacts - 1]) if enough else np.inf

    def _moving(self, measured: list[Measured]) -> list[Measured]:
        """Keep the pairs that can move along the normal."""
        if not measured:
            return measured
        some, data = witnesses(measured), self.data
        rows = self._motion(some, some.normal[:, None], data.cdof[None], data.subtree_com[self._root][None])
        return [m for m, row in zip(measured, rows, strict=True) if np.abs(row).max(initial=0.0) > _STILL]

    def _motion(self, of: Witness, along: Array, axes: Array, centres: Array) -> Array:
        """Motion of the second point relative to the first along directions (n, k, 3), per degree of freedom."""
        geom = np.stack([self._narrow.first[of.pair], self._narrow.second[of.pair]])
        arms = np.stack([of.first, of.second]) - centres[np.arange(len(centres)), geom]
        along = np.broadcast_to(along, (2, *along.shape))
        motion = np.concatenate([cross(arms[:, :, None], along), along], -1) @ axes.swapaxes(-1, -2)
        first, second = motion * self._turns[geom][:, :, None]
        return second - first

    def _with_measured(self, read: ContactBuffer) -> ContactBuffer:
        """Merge the measured contacts into the others, and keep the nearest of each state."""
        states, measured, *poses = zip(*read.measured, strict=True)
        centres, places, turns = map(np.stack, poses)
        where = np.repeat(np.arange(len(states)), [len(m) for m in measured])
        nearest = witnesses([m for some in measured for m in some])
        frame = np.stack([nearest.normal, *perpendicular(nearest.normal)], 1)
        numbers, points = self._narrow.contacts(nearest, frame, where, places, turns)
        where, frame = where[numbers], frame[numbers]
        state = np.array(states)[where]
        rows = self._motion(points, frame, read.axes[state], centres[where])
        geom = np.stack([self._narrow.first[points.pair], self._narrow.second[points.pair]], -1)
        row, slot = np.nonzero(read.frame.any((-1, -2)))
        moves = np.abs(rows[:, 0]).max(-1, initial=0.0) > _STILL
        state = np.concatenate([row, state[moves]])

        def both(before: Any, measured: Any) -> Any:
            return np.concatenate([before[row, slot], measured[moves]])

        gap = both(read.gap, points.gap)
        order = np.lexsort((gap, state))
        rank = np.arange(len(order)) - np.searchsorted(state[order], state[order])
        self._warn_of_more(int(np.bincount(state[gap <= self._warn_within], minlength=1).max()))
        order, rank = order[rank < self.n_contacts], rank[rank < self.n_contacts]
        full = self.allocate(len(read.gap))
        for into, before, measured in (
            (full.gap, read.gap, points.gap),
            (full.rows, read.rows, rows),
            (full.frame, read.frame, frame),
            (full.geom, read.geom, geom),
            (full.apart, read.apart, np.zeros(len(rows))),
        ):
            into[state[order], rank] = both(before, measured)[order]
        return full._replace(axes=read.axes)

    def _warn_of_more(self, near: int) -> None:
        """Warn once if near contacts are dropped because their number was left to the default."""
        if near > self.n_contacts:
            warnings.warn(
                f"expected at most {self.n_contacts} contacts, got {near} that touch or nearly do; only the nearest "
                f"are kept, so that something may sink or fall: pass contacts={near}, or contacts={self.n_contacts} "
                f"if these are enough",
                ContactWarning,
                stacklevel=5,
            )
            self._warn_within = -np.inf

    def finish(self, read: ContactBuffer) -> MujocoContacts:
        """Return the contacts, with the tangents that count."""
        if read.measured:
            read = self._with_measured(read)
        normal, sides, slide = read.frame[:, :, 0], read.frame[:, :, 1:], read.rows[:, :, 1:]
        if self.axis is not None:
            across = cross(self.axis, normal)
            across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
            sides, parts = across[:, :, None], np.einsum("nkij,nkj->nki", sides, across)
            slide = np.einsum("nki,nkiv->nkv", parts, slide)[:, :, None]
        sides, slide = sides[:, :, : self.n_tangents], slide[:, :, : self.n_tangents]
        # MuJoCo's contact is in the middle of the gap; friction acts where the two bodies are, half a gap from there:
        # ω × n gap/2 for each of them, along the tangents.
        lever = np.einsum("nkti,nvi->nktv", cross(normal[:, :, None], sides), read.axes[:, :, :3])
        turned = self._turns[read.geom[:, :, 0]] + self._turns[read.geom[:, :, 1]]
        tangent = slide + 0.5 * read.apart[:, :, None, None] * lever * turned[:, :, None]
        friction = np.where(read.frame.any((-1, -2)), self.friction[read.geom[:, :, 0], read.geom[:, :, 1]], 0.0)
        return MujocoContacts(read.gap, read.rows[:, :, 0], tangent, friction, read.geom)


def _moves(model: Any) -> NDArray[np.bool_]:
    """Return a mask (nbody, nv), True where a degree of freedom moves a body."""
    moves = np.zeros((model.nbody, model.nv), dtype=bool)
    for body in range(1, model.nbody):
        first = model.body_dofadr[body]
        moves[body] = moves[model.body_parentid[body]]
        moves[body, first : first + model.body_dofnum[body]] = True
    return moves


def plane_of_motion(model: Any, data: Any) -> Array | None:
    """Return the normal (3,) of the plane in which all joints move their bodies, or None if there is no such plane."""
    kinds = model.jnt_type
    slides = data.xaxis[kinds == int(mujoco.mjtJoint.mjJNT_SLIDE)]
    hinges = data.xaxis[kinds == int(mujoco.mjtJoint.mjJNT_HINGE)]
    if len(slides) + len(hinges) < len(kinds) or not len(kinds):
        return None
    if len(hinges):
        axis = hinges[0]
    else:
        _, size, directions = np.linalg.svd(slides)
        if (size > 1e-6).sum() != 2:
            return None
        axis = directions[2]
    parallel = np.abs(np.abs(hinges @ axis) - 1) < 1e-9
    return axis.copy() if parallel.all() and (np.abs(slides @ axis) < 1e-9).all() else None


def _spread(places: Array, geom: Any, gap: Array, kept: NDArray[np.intp]) -> NDArray[np.intp]:
    """Select up to four of the contacts `kept` for each pair: the nearest, then each time the farthest from the others.

    Args:
        places: (n, 3) where MuJoCo's contacts are; numbers from n on are the only contacts of their pairs.
        geom: (n or more, 2).
        gap: (n or more,).
        kept: numbers of contacts.
    """
    pair = geom[kept, 0] * (geom.max() + 1) + geom[kept, 1]
    pairs, counts = np.unique(pair, return_counts=True)
    enough = np.ones(len(kept), dtype=bool)
    for crowded in pairs[counts > _ENOUGH]:
        of_pair = np.flatnonzero(pair == crowded)
        at = places[kept[of_pair]]
        few, far = [int(gap[kept[of_pair]].argmin())], np.full(len(at), np.inf)
        while len(few) < _ENOUGH:
            far = np.minimum(far, np.linalg.norm(at - at[few[-1]], axis=-1))
            far[few] = -1.0
            few.append(int(far.argmax()))
        enough[np.delete(of_pair, few)] = False
    return kept[enough]


def _friction(model: Any, friction: float | None) -> Array:
    """Return the coefficients (ngeom, ngeom): that of the geom of higher priority, else the larger, as MuJoCo does."""
    n = model.ngeom
    if friction is not None:
        return np.full((n, n), friction)
    first, second = model.geom_priority[:, None], model.geom_priority[None]

    def of_pair(values: Any) -> Any:
        larger = np.maximum(values[:, None], values[None])
        return np.where(first == second, larger, np.where(first > second, values[:, None], values[None]))

    table = np.where(of_pair(model.geom_condim) > 1, of_pair(model.geom_friction[:, 0]), 0.0)
    for k in range(model.npair):
        a, b = model.pair_geom1[k], model.pair_geom2[k]
        table[a, b] = table[b, a] = model.pair_friction[k, 0] if model.pair_dim[k] > 1 else 0.0
    return table


def _check_contacts(model: Any, allowed: NDArray[np.bool_], friction: float | None) -> None:
    """Raise if pairs (ngeom, ngeom) that may touch have shapes or friction that cannot be represented."""
    fields = np.flatnonzero(np.isin(model.geom_type, _FIELDS) & allowed.any(0))
    if len(fields):
        raise InvalidInputError(
            f"model: expected no height field or signed distance field that may touch something, got geom "
            f"{_name(model, fields[0])}; use a mesh or boxes, or name the pairs that may touch, without it, by "
            f"pairs=[...]"
        )
    if friction is not None:
        return
    if model.opt.enableflags & _OVERRIDE and allowed.any():
        raise InvalidInputError(
            'model: expected the friction of its geoms, got <flag override="enable"/>, which replaces it; pass '
            f"friction={model.opt.o_friction[0]:g}, or take the flag away"
        )
    for k in range(model.npair):
        a, b, along = model.pair_geom1[k], model.pair_geom2[k], model.pair_friction[k, :2]
        if allowed[a, b] and model.pair_dim[k] > 1 and along[0] != along[1]:
            raise InvalidInputError(
                f"model: expected the same friction along both tangents of a <pair>, got {along[0]:g} and {along[1]:g} "
                f"between geoms {_name(model, a)} and {_name(model, b)}; make them equal, or pass friction=..."
            )


def _name(model: Any, geom: int) -> str:
    return repr(model.geom(int(geom)).name) if model.geom(int(geom)).name else str(geom)


def _may_touch(model: Any) -> NDArray[np.bool_]:
    """Return the pairs (ngeom, ngeom) that MuJoCo would test; none where contacts or constraints are disabled."""
    if model.opt.disableflags & _DISABLED:
        return np.zeros((model.ngeom, model.ngeom), dtype=bool)
    kind, affinity = model.geom_contype, model.geom_conaffinity
    masks = (kind[:, None] & affinity[None]) | (affinity[:, None] & kind[None])
    body = model.geom_bodyid
    weld = model.body_weldid[body]
    parent = model.body_weldid[model.body_parentid[weld]]
    allowed = (masks != 0) & (weld[:, None] != weld[None])
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        moving = (weld[:, None] != 0) & (weld[None] != 0)
        allowed &= ~(moving & ((parent[:, None] == weld[None]) | (weld[:, None] == parent[None])))
    for signature in model.exclude_signature:
        excluded = (body[:, None] == signature >> 16) & (body[None] == signature & 0xFFFF)
        allowed &= ~(excluded | excluded.T)
    allowed[model.pair_geom1, model.pair_geom2] = allowed[model.pair_geom2, model.pair_geom1] = True
    return allowed


def _listed(model: Any, pairs: Pairs) -> NDArray[np.bool_]:
    """Return the pairs (ngeom, ngeom) that the caller named."""
    allowed = np.zeros((model.ngeom, model.ngeom), dtype=bool)
    for pair in pairs:
        if isinstance(pair, str) or len(pair) != 2:
            raise InvalidInputError(f'pairs: expected pairs such as ("finger", "box"), got {describe(pair)}; give two')
        first, second = (find_geoms(model, name) for name in pair)
        allowed[np.ix_(first, second)] = allowed[np.ix_(second, first)] = True
    weld = model.body_weldid[model.geom_bodyid]
    return allowed & (weld[:, None] != weld[None])


def find_geoms(model: Any, name: int | str) -> list[int]:
    """Find a geom by its number or name, or all geoms of a body."""
    if isinstance(name, str):
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        geoms = [geom] if geom >= 0 else [g for g in range(model.ngeom) if model.geom_bodyid[g] == body >= 0]
    else:
        geoms = [name] if 0 <= name < model.ngeom else []
    if not geoms:
        raise InvalidInputError(
            f"pairs: expected names of geoms or bodies, or numbers of geoms below {model.ngeom}, got {name!r:.100}; "
            f"see the names in the model's XML"
        )
    return geoms


def _test(model: Any, geoms: Any, named: bool) -> None:
    """Let MuJoCo test these geoms where their shapes have a formula: by the flags and masks of the model, or all."""
    masks = np.stack([model.geom_type, model.geom_contype, model.geom_conaffinity], -1)[geoms]
    if named:
        model.opt.disableflags &= ~_DISABLED
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
        model.exclude_signature[:] = -1
        masks[:, 1:] = 1
    groups, of = np.unique(masks, axis=0, return_inverse=True)
    if len(groups) > _BITS:  # too many to tell apart: more are tested than count
        groups, of = np.unique(masks * [1, 0, 0] + [0, 1, 1], axis=0, return_inverse=True)
    kind, contype, affinity = groups.T
    tested = NATIVE[kind[:, None], kind[None]] & (((contype[:, None] & affinity) | (affinity[:, None] & contype)) != 0)
    bits, of = 1 << np.arange(len(groups)), of.reshape(-1)
    for of_geom, of_body, values in (
        (model.geom_contype, model.body_contype, bits),
        (model.geom_conaffinity, model.body_conaffinity, tested @ bits),
    ):
        of_geom[:], of_body[:] = 0, 0
        of_geom[geoms] = values[of]
        np.bitwise_or.at(of_body, model.geom_bodyid[geoms], of_geom[geoms])
