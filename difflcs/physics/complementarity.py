"""Linear complementarity systems from gaps and contact Jacobians, for every kind of contact physics.

A step without contact is linear, x₊ = A x + B u + d. Contact forces λ along the rows of J change it by W Jᵀ λ, where W
says what a force does to the state. With the gap after the step linearised, the step is an LCS:

    x₊ = A x + B u + d + W Jᵀ λ,    0 ≤ λ ⊥ φ + N (x₊ − x̄) + T (x₊ − x) + R λ ≥ 0,    J = N + T,

with gaps φ and their derivatives N at the state x̄, and the compliance R of the contacts, which makes F + Fᵀ ≻ 0 and λ
unique. N multiplies the motion since x̄, where the gap was measured. T holds the tangents and multiplies the motion
within the step, so that friction is right at every step of a plan. Two models of dry friction are offered:

- Anitescu: the rows of J are the extreme rays n ± μ t of the friction cone. F is symmetric. A contact that slides opens
  by μ times the distance that it slides, an error that vanishes with the step.
  (M. Anitescu, "Optimization-based simulation of nonsmooth rigid multibody dynamics", Math. Program. 105, 2006.)
  Where the load of a contact is known, friction may grow with it up to a cap only: with more load the contact slides
  without opening (`caps`). Its rays then share σ ≥ 0, and one more force ν acts along the normal alone:
  0 ≤ λ ⊥ gap along the rays + σ ≥ 0,  0 ≤ σ ⊥ cap − Σ λ + ε σ ≥ 0,  0 ≤ ν ⊥ gap ≥ 0. F + Fᵀ ≻ 0 as before.
- Stewart-Trinkle: normal force, friction in each direction and sliding distance each have a complementarity condition.
  (D. Stewart, J. Trinkle, "An implicit time-stepping scheme for rigid body dynamics with inelastic collisions and
  Coulomb friction", Int. J. Numer. Methods Eng. 39, 1996.)
  By itself its F + Fᵀ is indefinite. A drag makes it definite: friction is at most μ λ_n + ε σ for a sliding distance
  σ, in an open contact too, with the smallest sufficient ε. For one contact ε is about μ²/4 over the mobility. If
  several contacts share a load, ε grows as one over their compliance and the law is far from Coulomb's: a
  `FrictionWarning` says so; use Anitescu's model there.
"""

from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import (
    broadcast_batch,
    check_array,
    check_choice,
    check_kind,
    check_number,
    check_shape,
    check_tensor,
    describe,
)
from difflcs._differentiation import is_wrapped, runs_eagerly
from difflcs._linalg import matvec
from difflcs.errors import DTypeError, FrictionWarning, InvalidInputError, ShapeError, warn
from difflcs.records import LCSParams

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


class Unilateral(NamedTuple):
    """One-sided constraints without friction: limits of joints and tendons, contacts of frictionless pairs.

    Each has one multiplier, 0 ≤ λ ⊥ gap after the step ≥ 0, where a contact with friction has one for each ray.

    Attributes:
        gap: (..., n_unilateral) distance from acting, negative where it is passed.
        normal: (..., n_unilateral, n_x) derivative of each gap with respect to the state.
        effect: (..., n_x, n_unilateral) what a unit of each force adds to the next state; None: what it does as an
            impulse at the beginning of the step, response @ normalᵀ. F stays definite if normal @ effect is symmetric
            and positive semidefinite, over the rows of all contacts and constraints.
    """

    gap: Tensor
    normal: Tensor
    effect: Tensor | None = None


class Bounded(NamedTuple):
    """Forces that hold something in place as far as they can: dry friction in joints and tendons, drives with limits.

    A force τ in [lower, upper] keeps w = offset + slide · (x₊ − x) at zero; with w > 0 it is `lower`, with w < 0 it is
    `upper`. Each has two multipliers, λ = τ − lower and the way s = [−w]₊ that is slid against `upper`:

        0 ≤ λ ⊥ w + s ≥ 0,    0 ≤ s ⊥ upper − lower − λ + ε s ≥ 0.

    The coupling of λ and s is skew, so that any ε > 0 makes F + Fᵀ ≻ 0. Because of ε the force passes `upper` by ε s:
    a drag, chosen so that it gives back at most a thousandth of the way s.

    Attributes:
        offset: (..., n_bounded) zero for friction, less what may creep in a step.
        slide: (..., n_bounded, n_x) derivative of the way with respect to the state.
        lower: (..., n_bounded) least force along `slide`.
        upper: (..., n_bounded) largest force, at least `lower`.
        effect: (..., n_x, n_bounded) see `Unilateral`.
    """

    offset: Tensor
    slide: Tensor
    lower: Tensor
    upper: Tensor
    effect: Tensor | None = None


DRAG = 1e-3  # part of a way that the drag of a bounded force gives back


def given_states(x: Tensor | None) -> Tensor:
    """Return x; a system without a state has no contacts.

    Raises:
        InvalidInputError: no states.
    """
    if x is None:
        raise InvalidInputError("x: expected states (..., n_x), as contacts depend on them, got None; pass x")
    return x


def count_forces(
    n_contacts: int, n_tangents: int, cone: Cone = "anitescu", n_unilateral: int = 0, n_bounded: int = 0
) -> int:
    """Return n_lam of a system with so many contacts, one-sided constraints, and bounded forces or caps of friction."""
    rays = 2 * n_tangents if cone == "anitescu" else 2 * n_tangents + 2
    return n_contacts * (rays if n_tangents else 1) + n_unilateral + 2 * n_bounded


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
    unilateral: Unilateral | None = None,
    bounded: Bounded | None = None,
    caps: Tensor | None = None,
) -> LCSParams:
    """Build the linear complementarity system of one step with contact, linearised at some states.

    Args:
        contacts: gaps and their derivatives at x.
        free: the step without contact.
        x: (..., n_x) states.
        friction: coefficient μ ≥ 0, one or (..., n_contacts); without tangents it does nothing.
        compliance: gap that a unit of force closes, > 0 [length per force], one, or one for each contact, then each
            one-sided constraint, then each bounded force.
        cone: model of friction, see above.
        length: unit in which the system counts gaps. The relaxation of the MPC, λ·s, is counted in units of
            length · force, so that with a typical length it does not depend on whether x is in metres or in pixels.
        force: unit in which it counts forces; None: the number of `length`, right for a quasi-static body of mobility
            1.
        rest: (..., n_lam) forces from which the compliance counts, which so close no gap (of a bounded force τ itself;
            what stands in the place of its s does nothing); None: zero.
        unilateral: one-sided constraints without friction, scaled so that a unit of each gap is a `length`.
        bounded: bounded forces, scaled likewise.
        caps: (..., n_caps) of the first contacts in Anitescu's cone, > 0: normal forces up to which friction grows.

    Returns:
        The system, one per state. A contact has one multiplier without tangents, 2 n_tangents with the cone of
        Anitescu, 2 n_tangents + 2 with that of Stewart and Trinkle. In this order, contact by contact: the rays
        n + μ t, n − μ t of each tangent; or the normal force, friction along t and −t of each, the sliding distance.
        Then one for the frictionless force of each contact with a cap, one for each one-sided constraint, λ of all
        bounded forces, s of all, σ of all caps. `count_forces` counts them.

    Warns:
        FrictionWarning: the drag of the Stewart-Trinkle cone holds back much of a slide, see above.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """
    check_choice("cone", cone, ("anitescu", "stewart-trinkle"))
    length = check_number("length", length, strict=True)
    force = length if force is None else check_number("force", force, strict=True)
    _check(x, contacts, free, unilateral, bounded)
    n_contacts, n_tangents = contacts.tangent.shape[-3:-1]
    mu = _per_row("friction", friction, contacts.gap, strict=False)
    others = [0 if m is None else m[0].shape[-1] for m in (unilateral, bounded)]
    if caps is not None:
        caps = check_shape("caps", caps, "... n_caps").to(x)
        bad = not is_wrapped(caps) and not bool((caps > 0).all())
        if bad or cone != "anitescu" or not n_tangents or caps.shape[-1] > n_contacts:
            raise InvalidInputError(
                f"caps: expected positive forces of at most {n_contacts} contacts with tangents, in Anitescu's cone, "
                f"got {describe(caps)}; give one for each of the first contacts, or none"
            )
    n_caps = 0 if caps is None else caps.shape[-1]
    if rest is not None:
        n_lam = count_forces(n_contacts, n_tangents, cone, others[0], others[1] + n_caps)
        check_shape("rest", rest, "... n_lam", {"n_lam": n_lam})
    of_all = contacts.gap.new_empty(n_contacts + sum(others))
    soft = _per_row("compliance", compliance, of_all, strict=True) * (force / length)
    return LCSParams(**assemble_lcs(contacts, free, x, mu, soft, cone, length, force, rest, unilateral, bounded, caps))


def assemble_lcs(
    contacts: Contacts,
    free: FreeMotion,
    x: Tensor,
    mu: Tensor,
    soft: Tensor,
    cone: Cone,
    length: float,
    force: float,
    rest: Tensor | None = None,
    unilateral: Unilateral | None = None,
    bounded: Bounded | None = None,
    caps: Tensor | None = None,
) -> dict[str, Tensor]:
    """Compute the matrices of `contact_lcs` by name, of its arguments; nothing is checked.

    There is friction `mu` (..., n_contacts), and `soft` (..., n), the compliance of each contact, one-sided constraint
    and bounded force in units of length / force.
    """
    n_contacts, n_tangents = contacts.gap.shape[-1], contacts.tangent.shape[-2]
    n_caps = 0 if caps is None else caps.shape[-1]
    smooth = Unilateral(contacts.gap[..., :n_caps], contacts.normal[..., :n_caps, :])
    more = [m for m in (smooth, unilateral, bounded) if m is not None and m[0].shape[-1]]
    stewart_trinkle = cone == "stewart-trinkle" and n_tangents > 0 and n_contacts > 0
    directions = _normals_and_tangents if stewart_trinkle else _rays
    rows, normals, gap = directions(contacts, mu) if n_tangents else (contacts.normal, contacts.normal, contacts.gap)
    each = rows.shape[-2] // max(n_contacts, 1)
    softness = soft[..., :n_contacts].repeat_interleave(each, -1)
    C = (free.response @ rows.mT) * force
    if more:
        effects = [free.response @ m[1].mT if m.effect is None else m.effect for m in more]
        counted = [m[1] if isinstance(m, Unilateral) else torch.zeros_like(m[1]) for m in more]
        rows, normals = _join(-2, rows, *(m[1] for m in more)), _join(-2, normals, *counted)
        gap, softs = _join(-1, gap, *(m[0] for m in more)), (softness, soft[..., :n_caps], soft[..., n_contacts:])
        softness = torch.cat(softs, -1)
        C = _join(-1, C, *(effect * force for effect in effects))
    rows, normals = rows / length, normals / length
    F = rows @ C
    F, forces = 0.5 * (F + F.mT) + torch.diag_embed(softness), np.arange(F.shape[-1])
    D = rows @ free.A - (rows - normals)
    c = gap / length + matvec(rows, free.d) - matvec(normals, x)
    if stewart_trinkle:
        forces += np.minimum(forces // each, n_contacts)
    c = c if rest is None else c - softness * rest[..., forces] / force
    system = _Rows(C, free.d, D, rows @ free.B, F, c)
    if stewart_trinkle:
        system = _limit_friction(system, mu, each, torch.from_numpy(forces).to(F.device))
    if n_caps or (bounded is not None and bounded.offset.shape[-1]):
        none = system.c[..., :0]
        low, high = (none, none) if bounded is None else (v / force for v in bounded[2:4])
        system = _bound(system, low, high, none if caps is None else caps / force, each)
    return {"A": free.A, "B": free.B, **system._asdict()}


class _Rows(NamedTuple):
    """Fields of `LCSParams` that contacts change."""

    C: Tensor
    d: Tensor
    D: Tensor
    E: Tensor
    F: Tensor
    c: Tensor


def _bound(system: _Rows, lower: Tensor, upper: Tensor, caps: Tensor, each: int) -> _Rows:
    """Give the last forces, of any sign in `system`, their bounds: they become λ + lower, and s is added.

    And the first contacts, of `each` so many forces, caps of their sum (..., n_caps), by σ after s. For both see
    `Bounded`: 0 ≤ s ⊥ most − Σ λ + ε s ≥ 0.
    """
    C, d, D, E, F, c = system
    n, n_caps, n_lam = lower.shape[-1], caps.shape[-1], F.shape[-1]
    d, c = d + matvec(C[..., n_lam - n :], lower), c + matvec(F[..., n_lam - n :], lower)
    most, last = _join(-1, upper - lower, caps), torch.arange(n_lam - n, n_lam)
    forces = torch.cat([last, torch.arange(n_caps * each)])
    groups = n_lam + torch.cat([torch.arange(n), n + torch.arange(n_caps).repeat_interleave(each)])
    added, first = n_lam + torch.arange(n + n_caps), torch.cat([last, each * torch.arange(n_caps)])
    larger = F.new_zeros(*F.shape[:-2], n_lam + n + n_caps, n_lam + n + n_caps)
    larger[..., :n_lam, :n_lam] = F
    larger[..., forces, groups], larger[..., groups, forces] = 1.0, -1.0
    larger[..., added, added] = DRAG / F.diagonal(dim1=-2, dim2=-1)[..., first]
    columns, rows = (0, n + n_caps), (0, 0, 0, n + n_caps)
    C, D, E = (torch.nn.functional.pad(v, by) for v, by in ((C, columns), (D, rows), (E, rows)))
    return _Rows(C, d, D, E, larger, _join(-1, c, most))


def _join(dim: int, *parts: Tensor) -> Tensor:
    """Concatenate along a dimension tensors whose dimensions before it broadcast."""
    batch = broadcast_batch([("part", part.shape[:dim]) for part in parts])
    alike = (p if p.shape[:dim] == batch else p.expand(*batch, *p.shape[dim:]) for p in parts)
    return torch.cat(tuple(alike), dim)


_SHAPES: dict[Any, str] = {
    Contacts: "n_contacts, n_contacts n_x, n_contacts n_tangents n_x",
    FreeMotion: "n_x n_x, n_x n_u, n_x, n_x n_x",
    Unilateral: "n_unilateral, n_unilateral n_x, n_x n_unilateral",
    Bounded: "n_bounded, n_bounded n_x, n_bounded, n_bounded, n_x n_bounded",
}


def _check(x: Tensor, contacts: Any, free: Any, unilateral: Any, bounded: Any) -> None:
    """Check the states and the records of `contact_lcs`."""
    n_x, batches = check_shape("x", x, "... n_x").shape[-1], [("x", x.shape[:-1])]
    given = {"contacts": contacts, "free": free, "unilateral": unilateral, "bounded": bounded}
    for (of, record), (kind, shapes) in zip(given.items(), _SHAPES.items(), strict=True):
        if record is None and kind in (Unilateral, Bounded):
            continue
        sizes: dict[str, int] = {"n_x": n_x}
        for field, value, shape in zip(kind._fields, check_kind(of, record, kind), shapes.split(", "), strict=True):
            if value is None and field == "effect":
                continue
            value = check_shape(name := f"{of}.{field}", value, f"... {shape}", sizes)
            if value.dtype != x.dtype:
                raise DTypeError(f"{name}: expected {x.dtype} like x, got {describe(value)}; convert one of them")
            sizes.setdefault(shape.split()[-1], value.shape[-1])
            batches.append((name, value.shape[: value.ndim - len(shape.split())]))
    broadcast_batch(batches)
    if bounded is not None and not is_wrapped(crossed := bounded.lower > bounded.upper) and bool(crossed.any()):
        raise InvalidInputError(
            "bounded.lower: expected at most the upper bound, got more; exchange them, or give both the same value"
        )


def _per_row(name: str, value: float | Tensor, gap: Tensor, strict: bool) -> Tensor:
    """Expand a coefficient to one for each contact, or each row."""
    value = value if isinstance(value, Tensor) else torch.from_numpy(check_array(name, value))
    value = check_tensor(name, value, finite=False).to(gap)
    bad = value <= 0 if strict else value < 0
    if not is_wrapped(value) and (bool(bad.any()) or not bool(torch.isfinite(value).all())):
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


def _rays(contacts: Contacts, mu: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the extreme rays n ± μ t of each contact, what of them counts from x̄, and their gaps."""
    n, n_tangents, n_x = contacts.tangent.shape[-3:]
    normal, slide = contacts.normal[..., None, :], mu[..., None, None] * contacts.tangent
    rays = torch.stack([normal + slide, normal - slide], -2)  # (..., n_contacts, n_tangents, 2, n_x)
    normals = contacts.normal.repeat_interleave(2 * n_tangents, -2)
    gap = contacts.gap.repeat_interleave(2 * n_tangents, -1)
    return rays.reshape(*rays.shape[:-4], 2 * n * n_tangents, n_x), normals, gap


def _normals_and_tangents(contacts: Contacts, mu: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the same of the directions n, t and −t of each contact, with a gap along n alone."""
    normal, (*batch, n, k, n_x) = contacts.normal[..., None, :], contacts.tangent.shape
    both = torch.stack([contacts.tangent, -contacts.tangent], -2).reshape(*batch, n, 2 * k, n_x)
    still = torch.zeros_like(both)
    gap = torch.cat([contacts.gap[..., None], still[..., 0]], -1)
    rows, normals = (torch.cat([normal, v], -2).reshape(*batch, n * (1 + 2 * k), n_x) for v in (both, still))
    return rows, normals, gap.reshape(*batch, n * (1 + 2 * k))


_LARGE_DRAG = 0.25


def _check_drag(drag: Tensor, W: Tensor, normals: Tensor, mu: Tensor) -> None:
    """Warn of a drag that by itself holds back more than a quarter of a slide, in the median state."""
    if is_wrapped(drag) or not W.numel() or not (is_wrapped(mu) or bool((mu > 0).any())):
        return
    mobility = W.detach()[..., normals + 1, normals + 1].amax(-1)
    part = float((drag.detach() * mobility).median())
    if part > _LARGE_DRAG:
        warn(
            "friction by Stewart and Trinkle needs a drag here that gives more than a quarter of a slide back, as "
            'several contacts share a load: take fewer contacts, cone="anitescu", or a larger compliance',
            FrictionWarning,
        )


def _limit_friction(system: _Rows, mu: Tensor, per: int, forces: Tensor) -> _Rows:
    """Add the distance σ that each contact slides, after its `per` forces, which go to the places `forces`."""
    # Forces of a contact: normal, then along ± each tangent; then σ, the distance that it slides:
    #   0 ≤ λ_n ⊥ gap after the step ≥ 0,  0 ≤ β ⊥ σ ± t·slide ≥ 0,  0 ≤ σ ⊥ μ λ_n − Σ β + ε σ ≥ 0.
    # μ λ_n without its transpose makes F + Fᵀ indefinite; ε is what it takes, and not more: friction grows by ε σ.
    C, d, D, E, W, c = system
    n_contacts = mu.shape[-1]
    normals = torch.arange(n_contacts, device=W.device) * per
    inverse = torch.linalg.inv(W)[..., normals[:, None], normals]
    bound = 0.25 * torch.linalg.matrix_norm(mu.unsqueeze(-1) * inverse * mu.unsqueeze(-2))
    _check_drag(bound, W, normals, mu)
    batch, n_lam = W.shape[:-2], W.shape[-1] + n_contacts

    sigma = normals + torch.arange(1, n_contacts + 1, device=W.device) + per - 1
    F = W.new_zeros(*batch, n_lam, n_lam)
    F[..., forces[:, None], forces] = W
    F[..., sigma, sigma] = (1.05 * bound + 1e-9).unsqueeze(-1).expand(*batch, n_contacts)
    F[..., sigma, sigma - per] = mu.expand(*batch, n_contacts)
    for j in range(1, per):
        F[..., sigma - per + j, sigma] = 1.0
        F[..., sigma, sigma - per + j] = -1.0

    def spread(values: Tensor, dim: int) -> Tensor:
        """Insert zeros into values of the forces, at the places of the sliding distances."""
        shape = list(values.shape)
        shape[dim] = n_lam
        return values.new_zeros(shape).index_copy(dim, forces, values)

    return _Rows(spread(C, -1), d, spread(D, -2), spread(E, -2), F, spread(c, -1))
