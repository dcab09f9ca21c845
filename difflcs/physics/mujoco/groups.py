"""Budgets of contacts by groups: how many contacts of which geoms a system has, and whether they have friction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from difflcs._checks import check_number, check_positive_int, describe
from difflcs.errors import InvalidInputError
from difflcs.physics.mujoco.contacts import Budget, find_geoms
from difflcs.records import LCSParams

__all__ = ["ContactGroup", "ContactSelection"]

Array = NDArray[np.float64]


class ContactGroup(NamedTuple):
    """So many contacts of these geoms, the nearest.

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


class ContactSelection:
    """Selects the contacts of each group from all that a state has.

    Args:
        model: the MuJoCo model.
        groups: the groups; a pair of geoms belongs to the first that has one of the two.
        distance: of the module [m].

    Attributes:
        n_contacts: number of contacts of all groups.
        budgets: the same for a `ContactFinder`.
        rough: (n_contacts,) True for those with friction.
        group: (ngeom, ngeom) number of the group of each pair; −1 for none.
    """

    def __init__(self, model: Any, groups: Sequence[ContactGroup], distance: float):
        if not groups or not all(isinstance(group, ContactGroup) for group in groups):
            raise InvalidInputError(
                f"contacts: expected a number, or a list of ContactGroup, got {describe(groups)}; give one at least"
            )
        self.group = np.full((model.ngeom, model.ngeom), -1)
        for i, group in enumerate(groups):
            for one in [group.of] if group.of is None or isinstance(group.of, str | int | tuple) else group.of:
                mine = np.zeros((model.ngeom, model.ngeom), dtype=bool)
                sides = one if isinstance(one, tuple) else (one, None)
                mine[np.ix_(*(_geoms(model, side) for side in sides))] = True
                self.group[(mine | mine.T) & (self.group < 0)] = i
        self.budgets = [
            Budget(
                self.group == i,
                check_positive_int("contacts of a group", group.contacts),
                distance
                if group.distance is None
                else check_number("distance of a group", group.distance, strict=True),
                bool(group.friction),
            )
            for i, group in enumerate(groups)
        ]
        counts = [budget.contacts for budget in self.budgets]
        self.n_contacts = sum(counts)
        self.rough = np.repeat([budget.friction for budget in self.budgets], counts)

    def main(self, pairs: Sequence[NDArray[np.intp]]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the pairs, of two arrays of geoms, that belong to the first group."""
        first, second = pairs
        mine = self.group[first, second] == 0
        return first[mine], second[mine]

    def rows(self, each: int) -> NDArray[np.intp]:
        """Return the numbers of the rows to keep where each contact has so many: all, or the first without friction."""
        rows = np.arange(self.n_contacts * each).reshape(-1, each)
        return np.concatenate([row if rough else row[:1] for row, rough in zip(rows, self.rough, strict=True)])

    def reduce(self, system: LCSParams) -> LCSParams:
        """Keep one row for each contact without friction, whose rays are all the same."""
        if self.rough.all():
            return system
        rows = torch.from_numpy(self.rows(system.n_lam // self.n_contacts))
        C, F = system.C[..., rows], system.F[..., rows[:, None], rows]
        return LCSParams(
            system.A, system.B, C, system.d, system.D[..., rows, :], system.E[..., rows, :], F, system.c[..., rows]
        )


def _geoms(model: Any, of: Any) -> Sequence[int]:
    return range(model.ngeom) if of is None else find_geoms(model, of)
