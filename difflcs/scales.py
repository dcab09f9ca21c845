"""Scaling of data to units of about one, in which an LCS is learned, and back."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from difflcs import _checks, _storage
from difflcs._linalg import matvec
from difflcs._modules import plain_state
from difflcs.errors import CheckpointError, InvalidInputError, ShapeError
from difflcs.lcs import LCSModel, PredictiveModule
from difflcs.records import LCSModule, LCSParams, LCSSequence, system_at

# In units in which states and actions are about one: from 1 on, breaking the contact law is so cheap that it is not
# learned (docs/figures/xi.py).
_XI = 0.01
# Relaxation in parts of the squared step: where a contact switches λ = w = √relaxation, here 0.22 of a step. It gives
# the layer's default of 1e-5 for the paper's fingers, which move by 1.5 cm a step.
_RELAXATION = 0.05

Record = TypeVar("Record", bound=LCSParams | LCSSequence)


@dataclass(frozen=True)
class Scales:
    """Units in which states and actions are about one, x = center + state·x̃ and u = action·ũ, and settings for them.

    Attributes:
        center: (n_x,) mean of the states [unit of each state].
        state: (n_x,) standard deviation of each state [its unit]; 1 for a state that does not vary.
        action: (n_u,) root mean square of each action [its unit], so that zero stays zero; 1 for one never used.
        xi: ξ of `violation_loss` for transitions in these units.
        relaxation: of `LCSMPCLayer` and `solve_lcp`, for a system that was learned in these units: 0.05 times the
            square of a step, the root mean square of (x_next − x)/state of the state that moves most. λ and w have no
            unit, so that it stays the same after `params` has converted the system to the units of the data.
    """

    center: Tensor
    state: Tensor
    action: Tensor
    xi: float
    relaxation: float

    def __post_init__(self) -> None:
        for name in ("center", "state", "action"):
            value = _checks.check_tensor(name, _checks.to_tensor(getattr(self, name)))
            if value.ndim != 1 or (name == "state" and value.shape != self.center.shape):
                raise ShapeError(
                    f"{name}: expected a number for each state or action, got {_checks.describe(value)}; see help"
                )
            if name != "center" and not bool((value > 0).all()):
                raise InvalidInputError(
                    f"{name}: expected units above 0, got {_checks.describe(value)}; 1 where none is known"
                )
            vars(self)[name] = value
        for name in ("xi", "relaxation"):
            vars(self)[name] = _checks.check_number(name, getattr(self, name), strict=True)

    @_checks.takes_arrays
    def normalise(self, x: Tensor, u: Tensor, x_next: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Convert transitions x (..., n_x), u (..., n_u), x_next (..., n_x) to these units."""
        _checks.check_tensor("u", u, [("n_u", len(self.action))])
        return self.states(x), u / self.action.to(u), self.states(x_next, "x_next")

    @_checks.takes_arrays
    def states(self, x: Tensor, name: str = "x") -> Tensor:
        """Convert states (..., n_x) to these units; `name` is their name in an error."""
        _checks.check_tensor(name, x, [("n_x", len(self.state))])
        return (x - self.center.to(x)) / self.state.to(x)

    def params(self, params: Record) -> Record:
        """Convert a system in these units to the units of the data; differentiable.

        A = S Ã S⁻¹, B = S B̃ U⁻¹, C = S C̃, d = S d̃ + m − A m, D = D̃ S⁻¹, E = Ẽ U⁻¹, F = F̃, c = c̃ − D m, with m, S and
        U from center, state and action.
        """
        _checks.check_kind("params", params, (LCSParams, LCSSequence))
        m, S, U = (v.to(params.A) for v in (self.center, self.state, self.action))
        if (params.n_x, params.n_u) != (len(S), len(U)):
            raise InvalidInputError(
                f"params: expected n_x={len(S)} and n_u={len(U)} like the data of these scales, got "
                f"{params.n_x} and {params.n_u}; ask suggest_scales with transitions of this system"
            )
        A, D = S[:, None] * params.A / S, params.D / S
        return replace(
            params,
            A=A,
            B=S[:, None] * params.B / U,
            C=S[:, None] * params.C,
            d=S * params.d + m - matvec(A, m),
            D=D,
            E=params.E / U,
            c=params.c - matvec(D, m),
        )


@_checks.takes_arrays
def suggest_scales(x: Tensor, u: Tensor, x_next: Tensor) -> Scales:
    """Suggest units and settings for learning an LCS; the learned system does not depend on the units of the data.

    The steps of an optimiser such as Adam have a fixed size. If a state is in the hundreds, an offset of 100 takes
    10,000 steps of 0.01; if it is in the thousandths, the noise of these steps hides it. The loss adds the squared
    errors of all states, so that the largest numbers dominate. Neither happens in units in which every state and action
    is about one. Learn there, and convert the system back:

        scales = suggest_scales(x, u, x_next)
        loss = violation_loss(model, *scales.normalise(x, u, x_next), gamma="auto", xi=scales.xi)
        mpc = LCSMPCLayer(scales.params(model.params()), ..., relaxation=scales.relaxation)

    γ is in the units of F, which do not follow from data; `violation_loss` takes the largest allowed as "auto". ξ does
    not depend on a common unit of all states, actions and gaps: violation_loss grows with its square, whatever ξ. It is
    meaningful only if states, forces and gaps are about one, as here.

    Args:
        x: (..., n_x) states.
        u: (..., n_u) actions.
        x_next: (..., n_x) next states.

    Returns:
        `Scales`, on the data's device, without gradients.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError, InvalidInputError: the transitions do not fit each other,
            or no state ever changes.
    """
    for name, value in (("x", x), ("u", u), ("x_next", x_next)):
        _checks.check_tensor(name, value)
        if value.ndim < 2:
            raise InvalidInputError(
                f"{name}: expected shape (..., n) of many transitions, got {_checks.describe(value)}; give a "
                f"batch of them"
            )
    _checks.check_tensor("x_next", x_next, [("n_x", x.shape[-1])], finite=False)
    _checks.check_same_device([("x", x), ("u", u), ("x_next", x_next)])
    batch = _checks.broadcast_batch([("x", x.shape[:-1]), ("u", u.shape[:-1]), ("x_next", x_next.shape[:-1])])
    if batch.numel() < 2:
        raise InvalidInputError(f"x: expected at least two transitions, got {batch.numel()}; give more data")
    x, u, x_next = (v.detach().double().expand(*batch, v.shape[-1]).reshape(-1, v.shape[-1]) for v in (x, u, x_next))
    both = torch.cat([x, x_next])
    center = both.mean(0)
    state, action = both.std(0, correction=0), u.square().mean(0).sqrt()
    # A constant has the spread of its rounding.
    state = torch.where(state > 1e-9 * both.abs().amax(0), state, torch.ones_like(state))
    action = torch.where(action > 0, action, torch.ones_like(action))
    step = float(((x_next - x) / state).square().mean(0).sqrt().max())
    if step == 0:
        raise InvalidInputError("x_next: expected states that change, got x itself; give those of a moving system")
    return Scales(center, state, action, _XI, _RELAXATION * step * step)


class ScaledLCS(PredictiveModule):
    """An `LCSModule` that was learned in units of `Scales`, for states and actions in the units of the data.

    Its parameters are those of the module within, so a layer around it learns in the units of `Scales`. It predicts in
    the units of the data: `forward` and `rollout` are those of `LCSModel`.
    """

    def __init__(self, lcs: LCSModule, scales: Scales):
        super().__init__()
        _checks.check_kind("lcs", lcs, LCSModule)
        _checks.check_kind("scales", scales, Scales)
        self.lcs, self.scales = lcs, scales
        self.n_x, self.n_u, self.n_lam = lcs.n_x, lcs.n_u, lcs.n_lam

    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams | LCSSequence:
        """Return the system in the units of the data; the module within gets states in its units."""
        inner = system_at(self.lcs, None if x is None else self.scales.states(x), context)
        return self.scales.params(inner)

    def _constants(self) -> dict[str, object]:
        return {f"scales.{name}": getattr(self.scales, name).tolist() for name in ("center", "state", "action")}

    def save_pretrained(self, directory: str | os.PathLike[str]) -> None:
        """Write the `LCSModel` within and its scales into a directory, as `LCSModel.save_pretrained` does.

        Raises:
            DTypeError: the module within is no `LCSModel`; save its `state_dict` and the scales yourself.
            NonFiniteError: a matrix has NaN or infinity; what is there stays.
        """
        lcs = _checks.check_kind("lcs", self.lcs, LCSModel, "save its state_dict() and the scales")
        tensors = {f"scales.{name}": getattr(self.scales, name) for name in ("center", "state", "action")}
        tensors |= {f"lcs.{name}": value for name, value in plain_state(lcs).items()}
        numbers = {"xi": self.scales.xi, "relaxation": self.scales.relaxation}
        _checks.check_finite(tensors)
        with _storage.place_to_write(Path(directory), "directory"):
            _storage.save_record(Path(directory), "ScaledLCS", {"lcs": lcs.config(), **numbers}, tensors)

    @classmethod
    def from_pretrained(cls, directory: str | os.PathLike[str]) -> ScaledLCS:
        """Read what `save_pretrained` wrote.

        Raises:
            CheckpointError: files are missing, corrupt or of another kind; nothing is changed.
        """
        config, tensors = _storage.load_record(Path(directory), "ScaledLCS")
        parts = {"lcs": {}, "scales": {}}
        for name, value in tensors.items():
            part, _, rest = name.partition(".")
            parts.setdefault(part, {})[rest] = value
        settings, inner = {name: config.get(name) for name in ("xi", "relaxation")}, config.get("lcs")
        try:
            numbers = {name: _checks.check_number(name, value, strict=True) for name, value in settings.items()}
        except InvalidInputError as error:
            raise CheckpointError(f"{directory}: its scales cannot be used: {error}") from error
        if not isinstance(inner, Mapping):
            raise CheckpointError(f"{directory}: expected the fields of an LCSModel, got {_storage.short(inner)}")
        lcs = LCSModel.from_config(inner, parts["lcs"], str(directory))
        shapes = {"center": lcs.n_x, "state": lcs.n_x, "action": lcs.n_u}
        wanted = {name: ((size,), torch.float64) for name, size in shapes.items()}
        _storage.check_tensors(directory, "scales", parts["scales"], wanted)
        return cls(lcs, Scales(*(parts["scales"][name] for name in shapes), **numbers))
