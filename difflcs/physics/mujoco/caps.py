"""Caps of friction: where the load of a contact is known, friction grows with it up to one and a half times that load.

In Anitescu's cone what slides opens by μ times its way. A body that a finger pushes over a floor therefore rises along
the finger, where it has to move away, and with friction of 1 on both sides it can do neither. Between bodies without
drives, such as an object and the floor, the nominal action says what a contact carries. Beyond this load, and half as
much again, friction stays as it is, and the contact slides without opening; see `complementarity.py`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from difflcs._checks import check_positive_int
from difflcs.physics.complementarity import count_forces
from difflcs.physics.mujoco.contacts import ContactFinder, MujocoContacts, count_points, find_moving
from difflcs.physics.mujoco.limits import give_way
from difflcs.physics.mujoco.readings import Readings

Array = NDArray[np.float64]
_MOST = 1.5  # times the load at the nominal action, up to which friction grows
_JAMS = 0.4  # product of the friction of a drive and of what it pushes the body over, from which on a cap is due
_NEAR, _STEEP = 0.25, 0.5  # of the unit of gaps: what a drive touches; cosine between it and what it presses onto
_FREE = 100.0  # times the load and the unit of force of the system: there is no cap


class Caps:
    """Which contacts have a cap, and which cap: of those with friction the first `count`, ordered to this end.

    Args:
        model: the model.
        moment: (nu, nv) derivative of the actuators' lengths.
        finder: of its contacts.
        length: unit of gaps [m].
        count: number of contacts with a cap; None: where friction may jam, as many as may touch there.
    """

    def __init__(self, model: Any, moment: Array, finder: ContactFinder, length: float, count: int | None):
        tree, moves = np.array(model.dof_treeid), find_moving(model)[model.geom_bodyid]
        self._near = _NEAR * length
        self._driven = np.isin(tree, tree[moment.any(0)])
        robot = np.any(moves[:, self._driven], 1)
        self._rough, touch = np.flatnonzero(finder.rough), finder.rubbing
        self._loose = touch & ~robot & ~robot[:, None]
        presses, jams = np.where(touch & robot, finder.friction, 0.0).max(1, initial=0.0), np.zeros_like(touch)
        for joined in moves[~robot].T @ moves[~robot]:  # degrees of freedom of one body, and of what hangs on it
            mine = np.any(moves[:, joined], 1)
            jams |= (mine | mine[:, None]) & (finder.friction * presses[mine].max(initial=0.0) >= _JAMS)
        places = len(self._rough) * bool(finder.n_tangents)
        points = count_points(model, np.nonzero(np.triu(self._loose & jams)))
        self.count = min(points, places) if count is None else check_positive_int("caps", count, 0, places)

    def order(self, contacts: MujocoContacts) -> MujocoContacts:
        """Put contacts between bodies without drives first, of those with friction."""
        if not self.count:
            return contacts
        to = np.tile(np.arange(contacts.gap.shape[1]), (len(contacts.gap), 1))
        last = ~self._loose[tuple(np.moveaxis(contacts.geom[:, self._rough], -1, 0))]
        to[:, self._rough] = self._rough[np.argsort(last, -1, kind="stable")]
        return contacts.take((np.arange(len(to))[:, None], to))

    def limit(self, contacts: MujocoContacts, loads: Array | None, response: Array, unit: float) -> Array:
        """Caps (n, count) by loads (n, k) of contacts with friction at the nominal action, and the unit of force.

        What a drive touches that can press a body onto such a contact may make its load far larger: there is no cap.
        """
        caps, some = np.full((len(contacts.gap), self.count), _FREE * unit), self._rough[: self.count]
        if loads is None or not self.count:
            return caps
        load = loads[:, : self.count] * self._loose[tuple(np.moveaxis(contacts.geom[:, some], -1, 0))]
        normals = contacts.normal[:, some]
        near = contacts.normal[:, :, self._driven].any(-1) & (contacts.gap < self._near)
        touches = contacts.normal * near[..., None] * ~self._driven
        carries = (load[:, None] @ normals) * (touches != 0)  # of what is touched
        along = ((touches @ response) * carries).sum(-1)
        steep = -along > _STEEP * np.sqrt(give_way(touches, response) * give_way(carries, response))
        joined = (normals != 0).astype(float) @ (touches != 0).swapaxes(-1, -2) > 0
        pressed = np.any(joined & steep[:, None], -1)
        return np.where((load > 0) & ~pressed, _MOST * load, caps + _FREE * load)

    def limit_by_forces(self, c: Array, lam: Array, read: Readings, response: Array) -> None:
        """Set the caps in c (..., n_lam) of systems without velocities by their forces lam at the nominal action."""
        if not self.count:
            return
        n, rays = len(read.x), count_forces(len(self._rough), read.dof_contacts.tangent.shape[2])
        forces = lam.reshape(n, lam.shape[-1])
        loads = forces[:, :rays].reshape(n, len(self._rough), -1).sum(-1)
        loads[:, : self.count] += forces[:, rays : rays + self.count]
        c[..., -self.count :] = read.batched(self.limit(read.dof_contacts, loads, response, 1.0))
