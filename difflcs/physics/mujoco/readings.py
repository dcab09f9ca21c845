"""What is read at the states for which a MuJoCo model's systems are asked."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from difflcs.physics.complementarity import Bounded, Contacts, Unilateral
from difflcs.physics.mujoco.contacts import MujocoContacts
from difflcs.physics.mujoco.limits import ScaledRows


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
        return value.reshape(*self.batch, *value.shape[1:])

    def contacts(self, dof_contacts: MujocoContacts) -> Contacts:
        """Convert derivatives by the degrees of freedom to derivatives by the state."""
        return Contacts(
            self.batched(dof_contacts.gap), self._of_state(dof_contacts.normal), self._of_state(dof_contacts.tangent)
        )

    def constraints(self, rows: ScaledRows, effect: Any) -> dict[str, Any]:
        """Return rows that are no contacts as arguments of `contact_lcs`; `effect` (n, n_x, k) as there."""
        k = rows.gap.shape[1] - rows.bound.shape[1]
        gap, along = self.batched(rows.gap), self._of_state(rows.normal)
        effects = [None, None] if effect is None else [self.batched(effect[:, :, :k]), self.batched(effect[:, :, k:])]
        bound, found = self.batched(rows.bound), {}
        if k:
            found["unilateral"] = Unilateral(gap[..., :k], along[..., :k, :], effects[0])
        if rows.bound.shape[1]:
            found["bounded"] = Bounded(gap[..., k:], along[..., k:, :], -bound, bound, effects[1])
        return found

    def to_dofs(self, response: Any) -> Any:
        """Convert a response (..., nv, nv) of the positions of the state to one of the degrees of freedom."""
        return response if self.tangent is None else self.tangent @ response @ self.tangent.swapaxes(-1, -2)

    def _of_state(self, rows: Any) -> Any:
        """Convert derivatives (n, ..., nv) by the degrees of freedom to derivatives by the state."""
        if self.tangent is not None:
            rows = rows @ (self.tangent if rows.ndim == 3 else self.tangent[:, None])
        if still := self.x.shape[-1] - rows.shape[-1]:
            rows = np.concatenate([rows, np.zeros((*rows.shape[:-1], still))], -1)
        return self.batched(rows)
