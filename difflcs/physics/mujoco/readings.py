"""What is read at the states for which a MuJoCo model's systems are asked."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from difflcs._checks import check_finite, check_positive_definite
from difflcs.physics import complementarity
from difflcs.physics.complementarity import Bounded, Contacts, FreeMotion, Unilateral
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.contacts import MujocoContacts
from difflcs.physics.mujoco.library import count_threads
from difflcs.physics.mujoco.limits import ScaledRows
from difflcs.records import SYSTEM, LCSParams


class Readings(NamedTuple):
    """Contacts and motion that were read at n states.

    Attributes:
        batch: their batch dimensions.
        x: (n, n_x).
        states: (n, nq + nv + na) MuJoCo's.
        qpos: (n, nq).
        tangent: of their rotations, see `MujocoState.tangent`.
        dof_contacts: contacts.
        moved: buffers of the motion.
        doubtful: (n,) True where actions are to be tried.
        after: (n, n_x) what MuJoCo's own step does at the nominal action, see `WholeStep`; None: not asked for.
    """

    batch: torch.Size
    x: Any
    states: Any
    qpos: Any
    tangent: Any
    dof_contacts: MujocoContacts
    moved: Any
    doubtful: Any
    after: Any

    def batched(self, value: Any) -> Any:
        """Give an array (n, ...) the batch dimensions."""
        return value if len(self.batch) == 1 else value.reshape(*self.batch, *value.shape[1:])

    def contacts(self, dof_contacts: MujocoContacts) -> Contacts:
        """Convert derivatives by the degrees of freedom to derivatives by the state; all are tensors."""
        rows = self._of_state(dof_contacts.normal), self._of_state(dof_contacts.tangent)
        return Contacts(*_tensors(dof_contacts.gap, *rows))

    def assemble(
        self, contacts: MujocoContacts, rows: ScaledRows, free: FreeMotion, effect: Any, caps: Any, *more: Any
    ) -> LCSParams:
        """Make the systems of `contact_lcs`, of arrays of n states that are by the degrees of freedom.

        All contacts have friction, up to their caps (n, n_caps). The rows are other constraints, the last of which are
        bounded, with an effect (n, n_x, k), see `Unilateral`. After that are arguments as of `assemble_lcs`.
        """
        none, (soft, cone, length, force, rest) = np.zeros(0), more
        if cone == "anitescu":
            k = rows.gap.shape[1] - rows.bound.shape[1]
            given = dict(zip(("gap", "normal", "tangent", "friction"), contacts[:4], strict=True)) | free._asdict()
            given |= {"other_gap": rows.gap, "other_normal": rows.normal, "bound": rows.bound, "effect": effect}
            given |= {"turn": self.tangent, "rest": rest, "x": self.x, "soft": soft, "cap": caps}
            given = {name: none if v is None else np.ascontiguousarray(v) for name, v in given.items()}
            (n, n_x), n_u, n_bounded = self.x.shape, free.B.shape[-1], rows.bound.shape[1] + caps.shape[1]
            m = complementarity.count_forces(contacts.tangent.shape[1], contacts.tangent.shape[2], cone, k, n_bounded)
            sizes = {"C": (n_x, m), "d": (n_x,), "D": (m, n_x), "E": (m, n_u), "F": (m, m), "c": (m,)}
            found: Any = {name: np.zeros((n, *size)) for name, size in sizes.items()} | {"A": free.A, "B": free.B}
            sure = _mujoco.assemble(count_threads(n), complementarity.DRAG, length, force, given, found)
        else:
            found, sure = self.assemble_in_torch(contacts, rows, free, effect, caps, *more), False
            found = {name: v.contiguous().numpy() for name, v in found.items()}
        found |= {name: self.batched(v) for name, v in found.items() if v.ndim > len(SYSTEM[name])}  # others are shared
        tensors = dict(zip(found, _tensors(*found.values()), strict=True))
        if not sure:
            check_finite(tensors)
            check_positive_definite(tensors["F"])
        return LCSParams.of_checked(tensors)

    def assemble_in_torch(
        self, contacts: MujocoContacts, rows: ScaledRows, free: FreeMotion, effect: Any, caps: Any, *more: Any
    ) -> dict[str, torch.Tensor]:
        """Compute the matrices of `assemble` by `assemble_lcs`, which takes every cone."""
        k, (soft, cone, length, force, rest) = rows.gap.shape[1] - rows.bound.shape[1], more
        first, last = (None, None) if effect is None else (effect[:, :, :k], effect[:, :, k:])
        along = self._of_state(rows.normal)
        limits = Unilateral(*_tensors(rows.gap[:, :k], along[:, :k], first))
        held = Bounded(*_tensors(rows.gap[:, k:], along[:, k:], -rows.bound, rows.bound, last))
        x, mu, soft, rest, caps = _tensors(self.x, contacts.friction, soft, rest, caps)
        of_contacts, moves = self.contacts(contacts), FreeMotion(*_tensors(*free))
        return complementarity.assemble_lcs(
            of_contacts, moves, x, mu, soft, cone, length, force, rest, limits, held, caps
        )

    def to_dofs(self, response: Any) -> Any:
        """Convert a response (..., nv, nv) of the positions of the state to one of the degrees of freedom."""
        return response if self.tangent is None else self.tangent @ response @ self.tangent.swapaxes(-1, -2)

    def _of_state(self, rows: Any) -> Any:
        """Convert derivatives (n, ..., nv) by the degrees of freedom to derivatives by the state."""
        if self.tangent is not None:
            rows = rows @ (self.tangent if rows.ndim == 3 else self.tangent[:, None])
        if still := self.x.shape[-1] - rows.shape[-1]:
            rows = np.concatenate([rows, np.zeros((*rows.shape[:-1], still))], -1)
        return rows


def _tensors(*values: Any) -> list[Any]:
    """Convert arrays to tensors; None stays."""
    return [None if v is None else torch.from_numpy(v) for v in values]
