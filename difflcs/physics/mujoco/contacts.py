"""Contacts of a MuJoCo model at many states: gaps and contact Jacobians of the nearest contacts.

They are found in C++ (`_native/finder.hpp`): MuJoCo's own contacts between shapes that have a formula, and the faces of
all others where `mj_geomDistance` says that they are nearest. Here is said which geoms may touch, with what friction,
and how many contacts there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from difflcs._checks import check_list, describe
from difflcs.errors import ContactWarning, InvalidInputError, warn
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.library import Places, library
from difflcs.physics.mujoco.narrow import BOX, CAPSULE, CYLINDER, MESH, NATIVE, PLANE, Array, describe_solid, have_faces
from difflcs.physics.mujoco.native import flags

Pairs = Sequence[tuple[int | str, int | str]]

MOST_CONTACTS = 12  # by default
_NEAR = 0.1  # of the unit of gaps: a contact as near as this is one that counts
_ITERATIONS = 100  # of MuJoCo's distance
_GAP_OFF = tuple(int(part) for part in mujoco.__version__.split(".")[:2]) < (3, 9)

# Of these MuJoCo misses contacts that are apart, so that things would fall through.
_FIELDS = (int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_SDF))
_OVERRIDE = int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)
_POINTS = {  # contacts that a pair of shapes can have, where more than one
    (PLANE, CAPSULE): 2,
    (PLANE, CYLINDER): 4,
    (PLANE, BOX): 4,
    (PLANE, MESH): 4,
    (CAPSULE, CAPSULE): 2,
    (CAPSULE, CYLINDER): 2,
    (CAPSULE, BOX): 2,
    (CAPSULE, MESH): 2,
    (CYLINDER, CYLINDER): 4,
    (CYLINDER, BOX): 4,
    (CYLINDER, MESH): 4,
    (BOX, BOX): 8,
    (BOX, MESH): 4,
    (MESH, MESH): 4,
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

    def take(self, which: Any) -> MujocoContacts:
        """Return those of an index of the first two dimensions."""
        gap, normal, tangent, friction = (values[which] for values in self[:4])
        return MujocoContacts(gap, normal, tangent, friction, self.geom[which])


class Budget(NamedTuple):
    """So many contacts of these pairs.

    Attributes:
        pairs: (ngeom, ngeom) True for those that it is for.
        contacts: their number, the nearest.
        distance: those farther away are left out [m].
        friction: False for contacts without friction.
    """

    pairs: NDArray[np.bool_]
    contacts: int
    distance: float
    friction: bool = True


class ContactFinder:
    """Finds the contacts at many states. It changes the model for this purpose.

    Args:
        model: a private copy.
        data: its data, at which positions have been computed.
        places: of the two.
        pairs: geoms, or bodies with all their geoms, that may touch; None: as the model says.
        distance: contacts farther away are left out [m].
        length: unit of gaps [m].
        contacts: how many a state has, in all or of each budget, of which a pair belongs to one; None: what the shapes
            of the pairs can have, at most `MOST_CONTACTS`, with a `ContactWarning` where more touch.
        friction: coefficient of all; None: that of the geoms.
        torsion: False to leave out torsional friction.
        expected: True to warn if nothing may touch; so are named pairs, and a number of contacts.
        presses: True to find contacts that overlap and can only rub, see `overlap.py`; not in a plane of motion.

    Attributes:
        axis: normal (3,) of the plane in which everything moves, or None.
        pairs: numbers of the geoms that may touch, those of the first and those of the second of each pair.
        main_pairs: those of the first budget.
        rubbing: (ngeom, ngeom) True for those with friction.
        n_contacts: number of contacts of every state.
        n_tangents: of each contact; the third, where there is torsional friction, is the spin about the normal times
            the radius at which sliding friction would hold it back as much.
        rough: (n_contacts,) False for those of budgets without friction, where there is some.
        parts: indices of those with friction and without.
    """

    def __init__(
        self,
        model: Any,
        data: Any,
        places: Places,
        pairs: Pairs | None,
        distance: float,
        length: float,
        contacts: int | Sequence[Budget] | None,
        friction: float | None,
        torsion: bool,
        expected: bool,
        presses: bool,
    ):
        self.model, self.data, self.distance = model, data, distance
        self._warn_within = _NEAR * length if contacts is None else -np.inf
        self.axis = plane_of_motion(model, data)
        self.friction = _coefficients(model, 0) if friction is None else np.full((model.ngeom, model.ngeom), friction)
        self.allowed = _may_touch(model) if pairs is None else _listed(model, pairs)
        self._drop_floors()
        self._rubs = _may_touch(model) & (self.friction > 0) & (presses and self.axis is None)
        _check_contacts(model, self.allowed, friction)
        self._margin = _margins(model) * self.allowed
        self.pairs = first, second = np.nonzero(np.triu(self.allowed))
        asked = len(list(pairs)) > 0 if pairs is not None else expected or contacts is not None
        if asked and not len(first):
            warn(
                "expected geoms that may touch, got none, so that no contact moves anything: let contype and "
                "conaffinity of geoms fit, on bodies that move and are not fixed to each other, and enable contacts",
                ContactWarning,
            )
        if contacts is None:
            contacts = min(MOST_CONTACTS, count_points(model, self.pairs))
        budgets = [Budget(self.allowed, contacts, distance)] if isinstance(contacts, int) else list(contacts)
        self.main_pairs = [side[budgets[0].pairs[first, second]] for side in self.pairs]
        self.n_contacts = sum(budget.contacts for budget in budgets)
        self.rubbing = self.allowed & (self.friction > 0) & np.any([b.pairs for b in budgets if b.friction], 0)
        self.n_tangents = (1 if self.axis is not None else 2) if (self.friction[first, second] > 0).any() else 0
        self._spin = _coefficients(model, 1) / np.where(self.friction > 0, self.friction, np.inf)
        if torsion and self.n_tangents == 2:
            self.n_tangents += bool(self._spin[first, second].any())
        rolling = _coefficients(model, 2)[first, second] * (torsion and self.n_tangents > 1)
        _warn_of_left_out(model, self.allowed, rolling)
        rough = [budget.friction or not self.n_tangents for budget in budgets]
        self.rough = np.repeat(rough, [budget.contacts for budget in budgets])
        self.parts = (np.s_[:], np.s_[:0]) if self.rough.all() else (self.rough, ~self.rough)  # slices copy nothing
        model.opt.ccd_iterations = _ITERATIONS
        model.opt.disableflags &= ~flags("NATIVECCD")
        model.opt.disableflags |= flags("CONTACT")  # MuJoCo need not find any
        self._budgets = len(budgets)
        self._scene, self._places = self._describe_scene(budgets), places

    def _drop_floors(self) -> None:
        """Drop planes that nothing in the plane of motion can approach."""
        if self.axis is None:
            return
        planes = self.model.geom_type == PLANE
        along = np.abs(self.data.geom_xmat.reshape(-1, 3, 3)[:, :, 2] @ self.axis) > 1 - 1e-9
        self.allowed[planes & along] = False
        self.allowed[:, planes & along] = False

    def _describe_scene(self, budgets: Sequence[Budget]) -> _mujoco.Scene:
        """Hand the constants of the model to the compiled part."""
        model, (first, second) = self.model, self.pairs
        of, groups = [], []
        for budget in budgets:
            mine = np.flatnonzero(budget.pairs[first, second])
            begin = sum(map(len, of))
            of.append(mine)
            groups.append((begin, begin + len(mine), budget.contacts, budget.distance))
        chosen = np.concatenate(of)
        first, second, kind = first[chosen], second[chosen], model.geom_type
        formula, boxes = NATIVE[kind[first], kind[second]], (kind[first] == BOX) & (kind[second] == BOX)
        # MuJoCo's functions take the shapes in the order of their kinds.
        swap = formula & (kind[first] > kind[second])
        first, second = np.where(swap, second, first), np.where(swap, first, second)
        faces = have_faces(model, self.data, self.axis)
        meet = faces[first] & faces[second] & (boxes | ~formula)
        solids = np.unique(np.concatenate([first[meet], second[meet]]))
        number = np.full(model.ngeom, -1)
        number[solids] = np.arange(len(solids))
        size = np.minimum(model.geom_rbound[first], model.geom_rbound[second])
        rough = np.repeat([budget.friction for budget in budgets], [len(mine) for mine in of])
        rubs = np.where(self._rubs[first, second] & rough, self._margin[first, second], -np.inf)
        geoms = np.where(kind == PLANE, np.inf, model.geom_rbound), kind, model.body_rootid[model.geom_bodyid], number
        friction, spin = self.friction[first, second] * rough, self._spin[first, second]
        pairs = first, second, formula, boxes, meet, size, friction, spin, rubs
        fields = {
            "nq": model.nq,
            "nv": model.nv,
            "plane": PLANE,
            "tangents": self.n_tangents,
            "axis": [] if self.axis is None else self.axis.tolist(),
            "geoms": list(zip(*(v.tolist() for v in geoms), strict=True)),
            "box": model.geom_aabb.reshape(-1, 6).copy(),
            "moves": find_moving(model)[model.geom_bodyid],
            "solids": [describe_solid(model, int(geom)) for geom in solids],
            "pairs": list(zip(*(v.tolist() for v in pairs), strict=True)),
            "groups": groups,
        }
        return _mujoco.Scene(fields)

    def find(self, qpos: Array) -> MujocoContacts:
        """Find the contacts at positions (n, nq); those that are missing have a gap of `distance`, and zeros.

        Gaps are distances less the margin at which MuJoCo's forces begin.

        Raises:
            InvalidInputError: MuJoCo raised an error.
        """
        n, k, nv = len(qpos), self.n_contacts, self.model.nv
        found = MujocoContacts(
            np.full((n, k), self.distance),
            np.zeros((n, k, nv)),
            np.zeros((n, k, self.n_tangents, nv)),
            np.zeros((n, k)),
            np.zeros((n, k, 2), dtype=np.int64),
        )
        near, within = np.zeros((n, self._budgets), dtype=np.int64), np.full(self._budgets, self._warn_within)
        qpos = np.ascontiguousarray(qpos)
        self._places.check(
            _mujoco.find_contacts(library(), self._scene, self._places.take(n), qpos, within, *found, near), n
        )
        self._warn_of_more(int(near.max(initial=0)))
        if self._margin.any():
            found.gap[:] -= self._margin[found.geom[..., 0], found.geom[..., 1]]
        return found

    def _warn_of_more(self, near: int) -> None:
        """Warn once if near contacts are dropped because their number was left to the default."""
        if near > self.n_contacts:
            warn(
                f"expected at most {self.n_contacts} contacts, got {near} that touch or nearly do; only the nearest "
                f"are kept, so that something may sink or fall: pass contacts={near}, or contacts={self.n_contacts} "
                f"if these are enough",
                ContactWarning,
            )
            self._warn_within = -np.inf


def count_points(model: Any, pairs: Sequence[NDArray[np.intp]]) -> int:
    """Count the contacts that the shapes of pairs of geoms can have."""
    kinds = np.sort(model.geom_type[np.stack(pairs, -1)], axis=-1)
    return sum(_POINTS.get((int(a), int(b)), 1) for a, b in kinds)


def find_moving(model: Any) -> NDArray[np.bool_]:
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


def _coefficients(model: Any, kind: int) -> Array:
    """Return the coefficients (ngeom, ngeom) of sliding (0), torsional (1) or rolling friction (2).

    That of the geom of higher priority, else the larger, or what overrides them; zero where condim has none.
    """
    first, second, dimensions = model.geom_priority[:, None], model.geom_priority[None], (2, 4, 6)[kind]

    def of_pair(values: Any, of_listed: Any) -> Any:
        larger = np.maximum(values[:, None], values[None])
        table = np.where(first == second, larger, np.where(first > second, values[:, None], values[None]))
        table[model.pair_geom1, model.pair_geom2] = table[model.pair_geom2, model.pair_geom1] = of_listed
        return table

    listed, overriding = (0, 2, 3)[kind], model.opt.enableflags & _OVERRIDE
    friction = of_pair(model.geom_friction[:, kind], model.pair_friction[:, listed])
    friction = np.full_like(friction, model.opt.o_friction[listed]) if overriding else friction
    return np.where(of_pair(model.geom_condim, model.pair_dim) >= dimensions, friction, 0.0)


def _margins(model: Any) -> Array:
    """Return the distance (ngeom, ngeom) at which forces of geoms begin, from which MuJoCo before 3.9 took `gap`."""
    geom, pair = model.geom_margin - model.geom_gap * _GAP_OFF, model.pair_margin - model.pair_gap * _GAP_OFF
    table = geom[:, None] + geom
    table[model.pair_geom1, model.pair_geom2] = table[model.pair_geom2, model.pair_geom1] = pair
    return np.full_like(table, model.opt.o_margin) if model.opt.enableflags & _OVERRIDE else table


def _warn_of_left_out(model: Any, allowed: NDArray[np.bool_], rolling: Array) -> None:
    """Warn if pairs (ngeom, ngeom) that may touch have what is left out, such as these coefficients of rolling."""
    left = {
        f"no rolling friction (condim 6), got coefficients of up to {rolling.max(initial=0.0):g}; it is left out, so "
        f"that what rolls goes on rolling: give these geoms and pairs condim 4 if this does not matter": rolling
    }
    for name in ("surfacevel", "adhesion"):  # of MuJoCo 3.11 and later
        of_geoms, of_pairs = (getattr(model, f"{of}_{name}", np.zeros(0)) for of in ("geom", "pair"))
        text = (
            f"surfaces that neither move nor stick, got {name} of geoms that may touch; it is left out: set it to zero"
        )
        left[text] = np.append(of_geoms[allowed.any(0)] if len(of_geoms) else of_geoms, of_pairs)
    for text, values in left.items():
        if values.any():
            warn(f"expected {text}", ContactWarning)


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
    overriding, pairs = model.opt.enableflags & _OVERRIDE, zip(model.pair_geom1, model.pair_geom2, strict=True)
    listed = [(a, b, model.pair_friction[k]) for k, (a, b) in enumerate(pairs) if model.pair_dim[k] > 1]
    for a, b, along in [(*ab, model.opt.o_friction) for ab in np.argwhere(allowed)[:1]] if overriding else listed:
        if allowed[a, b] and along[0] != along[1]:
            raise InvalidInputError(
                f"model: expected the same friction along both tangents of a <pair>, and of <flag override>, got "
                f"{along[0]:g} and {along[1]:g} between geoms {_name(model, a)} and {_name(model, b)}; make them "
                f"equal, or pass friction=..."
            )


def _name(model: Any, geom: int) -> str:
    return repr(model.geom(int(geom)).name) if model.geom(int(geom)).name else str(geom)


def _may_touch(model: Any) -> NDArray[np.bool_]:
    """Return the pairs (ngeom, ngeom) that MuJoCo would test; none where contacts or constraints are disabled."""
    if model.opt.disableflags & flags("CONTACT", "CONSTRAINT"):
        return np.zeros((model.ngeom, model.ngeom), dtype=bool)
    kind, affinity = model.geom_contype, model.geom_conaffinity
    masks = (kind[:, None] & affinity[None]) | (affinity[:, None] & kind[None])
    body = model.geom_bodyid
    weld = model.body_weldid[body]
    parent = model.body_weldid[model.body_parentid[weld]]
    allowed = (masks != 0) & (weld[:, None] != weld[None])
    if not model.opt.disableflags & flags("FILTERPARENT"):
        moving = (weld[:, None] != 0) & (weld[None] != 0)
        allowed &= ~(moving & ((parent[:, None] == weld[None]) | (weld[:, None] == parent[None])))
    for signature in model.exclude_signature:
        excluded = (body[:, None] == signature >> 16) & (body[None] == signature & 0xFFFF)
        allowed &= ~(excluded | excluded.T)
    allowed[model.pair_geom1, model.pair_geom2] = allowed[model.pair_geom2, model.pair_geom1] = True
    moves = find_moving(model)[body].any(-1, keepdims=True)  # mocap bodies do not
    return allowed & (moves | moves.T)


def _listed(model: Any, pairs: Pairs) -> NDArray[np.bool_]:
    """Return the pairs (ngeom, ngeom) that the caller named."""
    allowed = np.zeros((model.ngeom, model.ngeom), dtype=bool)
    for pair in check_list("pairs", pairs, 'give pairs such as [("finger", "box")]'):
        first, second = (find_geoms(model, name) for name in check_pair("pairs", pair))
        allowed[np.ix_(first, second)] = allowed[np.ix_(second, first)] = True
    weld = model.body_weldid[model.geom_bodyid]
    return allowed & (weld[:, None] != weld[None])


def check_pair(name: str, pair: Any) -> Any:
    """Refuse anything but two of something."""
    if not isinstance(pair, Sequence | np.ndarray) or isinstance(pair, str) or len(pair) != 2:
        raise InvalidInputError(f'{name}: expected pairs such as ("finger", "box"), got {describe(pair)}; give two')
    return pair


def find_geoms(model: Any, name: int | str) -> list[int]:
    """Find a geom by its number or name, or all geoms of a body."""
    if isinstance(name, str):
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        geoms = [geom] if geom >= 0 else [g for g in range(model.ngeom) if model.geom_bodyid[g] == body >= 0]
    else:
        geoms = [int(name)] if isinstance(name, int | np.integer) and 0 <= name < model.ngeom else []
    if not geoms:
        raise InvalidInputError(
            f"pairs, contacts: expected names of geoms or bodies, or numbers of geoms below {model.ngeom}, got "
            f"{name!r:.100}; see the names in the model's XML"
        )
    return geoms


def typical_radius(model: Any) -> float:
    """Return the median radius of the geoms that move and may touch."""
    size = model.geom_rbound
    moves = (size > 0) & (model.body_weldid[model.geom_bodyid] != 0)
    touches = moves & ((model.geom_contype | model.geom_conaffinity) != 0)
    chosen = size[touches] if touches.any() else size[moves]
    return float(np.median(chosen)) if len(chosen) else 1.0


def median_apart(model: Any, data: Any, state: Array, response: Any, pairs: Any, dimensions: int) -> float:
    """Compute how far a unit of force moves two geoms of a pair apart, the median, for the response at a state."""
    data.qpos[:] = state[: model.nq]
    mujoco.mj_fwdPosition(model, data)
    jacobians, gives, (first, second) = np.empty((2, 3, model.nv)), np.empty((2, model.ngeom)), pairs
    for geom in range(model.ngeom):
        mujoco.mj_jacGeom(model, data, *jacobians, geom)
        gives[:, geom] = [np.trace(jacobian @ response @ jacobian.T) / dimensions for jacobian in jacobians]
    gives[1] *= model.geom_rbound**2  # a wheel on its axle gives way by its rim alone
    apart = next((way[way > 0] for way in gives[:, first] + gives[:, second] if (way > 0).any()), np.zeros(0))
    if len(first) and not len(apart):
        raise InvalidInputError(
            "model: expected something that contact forces can move, got nothing; what is pushed needs joints "
            "without actuators, and a mobility above 0"
        )
    return float(np.median(apart)) if len(apart) else 1.0
