"""Linear complementarity systems from gaps and contact Jacobians, for every kind of contact physics.

A step without contact is linear, x₊ = A x + B u + d. Contact forces λ along the rows of J change it by W Jᵀ λ, where W
says what a force does to the state. With the gap after the step linearised, the step is an LCS:

    x₊ = A x + B u + d + W Jᵀ λ,    0 ≤ λ ⊥ φ + N (x₊ − x̄) + T (x₊ − x) + R λ ≥ 0,    J = N + T,

with gaps φ and their derivatives N at the state x̄, and the compliance R of the contacts, which makes F + Fᵀ ≻ 0 and λ
unique. A gap has grown since x̄, where it was measured; T, which has the tangents, counts what slides within the step,
so that friction is right at every step of a plan and not at the first alone. Two models of dry friction are offered:

- Anitescu: the rows of J are the extreme rays n ± μ t of the friction cone. F is symmetric. A contact that slides opens
  by μ times the distance that it slides, an error that vanishes with the step.
  (M. Anitescu, "Optimization-based simulation of nonsmooth rigid multibody dynamics", Math. Program. 105, 2006.)
- Stewart-Trinkle: normal force, friction in each direction and sliding distance each have a complementarity condition.
  (D. Stewart, J. Trinkle, "An implicit time-stepping scheme for rigid body dynamics with inelastic collisions and
  Coulomb friction", Int. J. Numer. Methods Eng. 39, 1996.)
  By itself its F + Fᵀ is indefinite. What makes it definite is a drag: friction is at most μ λ_n + ε σ for a sliding
  distance σ, in an open contact too, with the smallest ε that suffices. For one contact ε is about μ²/4 over the
  mobility. Where several contacts share a load it grows as one over their compliance, and little is left of the law:
  a `FrictionWarning` says so, and Anitescu's is the one to use there.
"""

from __future__ import annotations

import warnings
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from difflcs._checks import check_choice, check_number, check_tensor
from difflcs._differentiation import is_wrapped, runs_eagerly
from difflcs._linalg import matvec
from difflcs.errors import FrictionWarning, InvalidInputError, ShapeError
from difflcs.records import LCSParams

__all__ = ["Cone", "Contacts", "FreeMotion", "contact_lcs", "count_forces"]

Cone = Literal["anitescu", "stewart-trinkle"]


class Contacts(NamedTuple):
    """Possible contacts, at some states.

    Attributes:
        gap: (..., n_contacts) signed distances, negative in penetration [length].
        normal: (..., n_contacts, n_x) derivative of each gap with respect to the state.
        tangent: (..., n_contacts, n_tangents, n_x) derivative of how far the contact slides along each tangent with
            respect to the state; one tangent in the plane, two in space, none where there is no friction.
    """

    gap: Tensor
    normal: Tensor
    tangent: Tensor


class FreeMotion(NamedTuple):
    """One step without contact, x₊ = A x + B u + d, and what a force adds to it.

    A quasi-static body has its mobility as `response`; what a controller holds to its path has zeros there. For a state
    of positions and velocities, and mass matrix M, it is [[h M⁻¹, 0], [M⁻¹, 0]] over a step of h: a force is then an
    impulse.

    Attributes:
        A: (..., n_x, n_x).
        B: (..., n_x, n_u).
        d: (..., n_x).
        response: (..., n_x, n_x) change of the next state for a force that is dual to the state: Jᵀ λ.
    """

    A: Tensor
    B: Tensor
    d: Tensor
    response: Tensor


def count_forces(n_contacts: int, n_tangents: int, cone: Cone = "anitescu") -> int:
    """Return n_lam of a system with so many contacts."""
    if n_tangents == 0:
        return n_contacts
    return n_contacts * (2 * n_tangents if cone == "anitescu" else 2 * n_tangents + 2)


@runs_eagerly
def contact_lcs(
    contacts: Contacts,
    free: FreeMotion,
    x: Tensor,
    *,
    friction: float | Tensor,
    compliance: float | Tensor,
    cone: Cone = "anitescu",
    length: float = 1.0,
    force: float | None = None,
    rest: Tensor | None = None,
) -> LCSParams:
    """Build the linear complementarity system of one step with contact, linearised at some states.

    Args:
        contacts: gaps and their derivatives at x.
        free: the step without contact.
        x: (..., n_x) states.
        friction: coefficient μ ≥ 0, one or (..., n_contacts); without tangents it does nothing.
        compliance: gap that a unit of force closes, > 0, one or (..., n_contacts) [length per force].
        cone: model of friction, see above.
        length: unit in which the system counts gaps. The relaxation of the MPC, λ·s, is counted in units of
            length · force, so that with a typical length it does not depend on whether x is in metres or in pixels.
        force: unit in which it counts forces; None: the number of `length`, right for a quasi-static body of mobility
            1.
        rest: (..., n_lam) forces from which the compliance counts, which so close no gap; None: zero.

    Returns:
        The system, one per state: n_lam = n_contacts without tangents, 2 n_tangents per contact with the cone of
        Anitescu, 2 n_tangents + 2 with that of Stewart and Trinkle. In this order, contact by contact: the rays
        n + μ t, n − μ t of each tangent; or the normal force, friction along t and −t of each, the sliding distance.

    Warns:
        FrictionWarning: the drag of the Stewart-Trinkle cone holds back much of a slide, see above.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """
    check_choice("cone", cone, ("anitescu", "stewart-trinkle"))
    length = check_number("length", length, strict=True)
    force = length if force is None else check_number("force", force, strict=True)
    n_x, n_contacts, n_tangents = x.shape[-1], contacts.gap.shape[-1], contacts.tangent.shape[-2]
    _check_shapes(contacts, free, n_x, n_contacts, n_tangents)
    mu = _per_contact("friction", friction, contacts.gap, strict=False)
    soft = _per_contact("compliance", compliance, contacts.gap, strict=True) * (force / length)
    if n_tangents and cone == "stewart-trinkle":
        return _stewart_trinkle(contacts, free, x, mu, soft, length, force, rest)
    rows, gap, softness = _rays(contacts, mu, soft) if n_tangents else (contacts.normal, contacts.gap, soft)
    normals = contacts.normal.repeat_interleave(2 * n_tangents, -2) if n_tangents else rows
    C = (free.response @ rows.mT) * force
    rows, normals = rows / length, normals / length
    F = rows @ C
    F = 0.5 * (F + F.mT) + torch.diag_embed(softness.expand(F.shape[:-1]))
    D = rows @ free.A - (rows - normals)
    c = gap / length + matvec(rows, free.d) - matvec(normals, x)
    c = c if rest is None else c - softness * rest / force
    return LCSParams(A=free.A, B=free.B, C=C, d=free.d, D=D, E=rows @ free.B, F=F, c=c)


def _check_shapes(contacts: Contacts, free: FreeMotion, n_x: int, n_contacts: int, n_tangents: int) -> None:
    of_contacts, of_state = ("n_contacts", n_contacts), ("n_x", n_x)
    check_tensor("contacts.gap", contacts.gap)
    check_tensor("contacts.normal", contacts.normal, [of_contacts, of_state])
    check_tensor("contacts.tangent", contacts.tangent, [of_contacts, ("n_tangents", n_tangents), of_state])
    if free.B.ndim < 2:
        raise ShapeError(f"free.B: expected shape (..., n_x={n_x}, n_u), got {tuple(free.B.shape)}; add dimensions")
    check_tensor("free.B", free.B, [of_state, ("n_u", free.B.shape[-1])])
    for name in ("A", "response"):
        check_tensor(f"free.{name}", getattr(free, name), [of_state, of_state])
    check_tensor("free.d", free.d, [of_state])


def _per_contact(name: str, value: float | Tensor, gap: Tensor, strict: bool) -> Tensor:
    """Expand a coefficient to one for each contact."""
    value = torch.as_tensor(value, dtype=gap.dtype, device=gap.device)
    bad = value <= 0 if strict else value < 0
    if bool(bad.any()) or not bool(torch.isfinite(value).all()):
        limit = "above 0" if strict else "of at least 0"
        raise InvalidInputError(
            f"{name}: expected finite numbers {limit}, got {float(value.min()):g}; give one for all contacts "
            f"or one for each"
        )
    if value.ndim and value.shape[-1] not in (1, gap.shape[-1]):
        raise ShapeError(
            f"{name}: expected one number or (..., n_contacts={gap.shape[-1]}), got {tuple(value.shape)}; give one for "
            f"each contact"
        )
    return value if value.ndim and value.shape[-1] == gap.shape[-1] else value.expand(*value.shape[:-1], gap.shape[-1])


def _rays(contacts: Contacts, mu: Tensor, soft: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the extreme rays n ± μ t of each contact, their gaps and compliances."""
    per = 2 * contacts.tangent.shape[-2]
    normal, slide = contacts.normal.unsqueeze(-2), mu[..., None, None] * contacts.tangent
    rays = torch.stack([normal + slide, normal - slide], -2)  # (..., n_contacts, n_tangents, 2, n_x)
    return rays.flatten(-4, -2), contacts.gap.repeat_interleave(per, -1), soft.repeat_interleave(per, -1)


_LARGE_DRAG = 0.25


def _check_drag(drag: Tensor, W: Tensor, normals: Tensor, mu: Tensor) -> None:
    """Warn of a drag that by itself holds back more than a quarter of a slide, in the median state."""
    if is_wrapped(drag) or not W.numel() or not bool((mu > 0).any()):
        return
    mobility = W.detach()[..., normals + 1, normals + 1].amax(-1)
    part = float((drag.detach() * mobility).median())
    if part > _LARGE_DRAG:
        warnings.warn(
            f"friction by Stewart and Trinkle needs a drag here that gives {part:.2g} times the distance of a slide "
            f'back, as several contacts share a load: use cone="anitescu", or a larger compliance',
            FrictionWarning,
            stacklevel=4,
        )


def _stewart_trinkle(
    contacts: Contacts,
    free: FreeMotion,
    x: Tensor,
    mu: Tensor,
    soft: Tensor,
    length: float,
    force: float,
    rest: Tensor | None,
) -> LCSParams:
    # Forces of a contact: normal, then along ± each tangent; then σ, the distance that it slides:
    #   0 ≤ λ_n ⊥ gap after the step ≥ 0,  0 ≤ β ⊥ σ ± t·slide ≥ 0,  0 ≤ σ ⊥ μ λ_n − Σ β + ε σ ≥ 0.
    # μ λ_n without its transpose makes F + Fᵀ indefinite; ε is what it takes, and not more: friction grows by ε σ.
    n_contacts, n_tangents = contacts.tangent.shape[-3:-1]
    per = 2 * n_tangents + 1
    both = torch.stack([contacts.tangent, -contacts.tangent], -2).flatten(-3, -2)
    rows = torch.cat([contacts.normal.unsqueeze(-2), both], -2).flatten(-3, -2)  # (..., n_contacts · per, n_x)
    C = (free.response @ rows.mT) * force
    rows = rows / length
    is_normal = torch.zeros(per, dtype=x.dtype, device=x.device)
    is_normal[0] = 1.0
    along = (1.0 - is_normal).repeat(n_contacts).unsqueeze(-1) * rows  # the tangents, which count from the step's state
    W = rows @ C
    W = 0.5 * (W + W.mT) + torch.diag_embed(soft.repeat_interleave(per, -1).expand(W.shape[:-1]))
    normals = torch.arange(n_contacts) * per
    inverse = torch.linalg.inv(W)[..., normals[:, None], normals]
    bound = 0.25 * torch.linalg.matrix_norm(mu.unsqueeze(-1) * inverse * mu.unsqueeze(-2))
    _check_drag(bound, W, normals, mu)
    batch, like = W.shape[:-2], {"dtype": W.dtype, "device": W.device}

    size, sigma = per + 1, torch.arange(n_contacts) * (per + 1) + per
    forces = torch.tensor([i * size + j for i in range(n_contacts) for j in range(per)], dtype=torch.long)
    F = torch.zeros(*batch, n_contacts * size, n_contacts * size, **like)
    F[..., forces[:, None], forces] = W
    F[..., sigma, sigma] = (1.05 * bound + 1e-9).unsqueeze(-1).expand(*batch, n_contacts)
    F[..., sigma, sigma - per] = mu.expand(*batch, n_contacts)
    for j in range(1, per):
        F[..., sigma - per + j, sigma] = 1.0
        F[..., sigma, sigma - per + j] = -1.0

    def spread(values: Tensor, dim: int) -> Tensor:
        """Insert zeros into values of the forces, at the places of the sliding distances."""
        shape = list(values.shape)
        shape[dim] = n_contacts * size
        return values.new_zeros(shape).index_copy(dim, forces.to(values.device), values)

    gap = (contacts.gap.unsqueeze(-1) * is_normal).flatten(-2) / length
    c = gap + matvec(rows, free.d) - matvec(rows - along, x)
    c = c if rest is None else c - soft.repeat_interleave(per, -1) * rest[..., forces.to(x.device)] / force
    return LCSParams(
        A=free.A,
        B=free.B,
        C=spread(C, -1),
        d=free.d,
        D=spread(rows @ free.A - along, -2),
        E=spread(rows @ free.B, -2),
        F=F,
        c=spread(c, -1),
    )
