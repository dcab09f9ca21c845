"""Budgets of contacts by groups: how many contacts of which geoms a system has, and whether they have friction."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from difflcs._checks import check_kind, check_list, check_number, check_positive_int, describe
from difflcs.errors import InvalidInputError
from difflcs.physics.mujoco.contacts import Budget, check_pair, find_geoms

Array = NDArray[np.float64]
_MOST = 2000  # contacts, whose matrices have a gigabyte and more


class ContactGroup(NamedTuple):
    """A number of contacts of some geoms, the nearest ones.

    Attributes:
        of: geoms by name or number, or bodies with all their geoms: contacts in which one of them takes part; a pair of
            them, ("cup", "palm"): their contacts with each other; or a list of such. None: all contacts that belong to
            no group before.
        contacts: their number.
        friction: False for contacts without friction, which take one row of the system each.
        distance: those farther away are left out [m]; None: that of the module.
    """

    of: str | int | Sequence[str | int | tuple[str | int, str | int]] | None
    contacts: int
    friction: bool = True
    distance: float | None = None


Groups = Sequence[ContactGroup] | Mapping[Any, int]
"""Groups, or the number of contacts of each `ContactGroup.of`: {("object", "hand"): 10}."""


def find_budgets(model: Any, contacts: int | Groups | None, distance: float) -> int | list[Budget] | None:
    """Return the budgets of groups for a `ContactFinder`, or the number of contacts that is given in place of groups.

    Args:
        model: the MuJoCo model.
        contacts: the groups; a pair of geoms belongs to the first that has one of the two.
        distance: of the module [m].
    """
    if isinstance(contacts, Mapping):
        contacts = [ContactGroup(*group) for group in contacts.items()]
    if not isinstance(contacts, Sequence):
        return None if contacts is None else check_positive_int("contacts", contacts, maximum=_MOST)
    if not contacts or not all(isinstance(group, ContactGroup) for group in contacts):
        raise InvalidInputError(
            f"contacts: expected a number, a list of ContactGroup, or a number for each pair of geoms or bodies, got "
            f'{describe(contacts)}; give one at least, as in {{("object", "hand"): 10}}'
        )
    number = np.full((model.ngeom, model.ngeom), -1)  # of the group of each pair
    for i, group in enumerate(contacts):
        of = [group.of] if group.of is None or isinstance(group.of, str | int | tuple) else group.of
        for one in check_list("of of a group", of, "name geoms or bodies"):
            mine = np.zeros((model.ngeom, model.ngeom), dtype=bool)
            sides = check_pair("of of a group", one) if isinstance(one, tuple) else (one, None)
            geoms = (range(model.ngeom) if side is None else find_geoms(model, side) for side in sides)
            mine[np.ix_(*geoms)] = True
            number[(mine | mine.T) & (number < 0)] = i
    return [
        Budget(
            number == i,
            check_positive_int("contacts of a group", group.contacts, maximum=_MOST),
            distance if group.distance is None else check_number("distance of a group", group.distance, strict=True),
            check_kind("friction of a group", group.friction, bool),
        )
        for i, group in enumerate(contacts)
    ]
