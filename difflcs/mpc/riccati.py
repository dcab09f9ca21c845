"""The Riccati sweeps of the sensitivity: K_z factored at a trajectory, and solved for upstream gradients.

The derivation stands in `difflcs.mpc.kkt`, which offers the names of this file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from difflcs._linalg import matvec
from difflcs._native import TOLERANCES
from difflcs.mpc.conditions import (
    Contact,
    Multipliers,
    backward,
    complete,
    curvature_at_rest,
    gradient_terms,
    prices,
    ranges,
    row_units,
    stages_of,
)
from difflcs.mpc.problem import MPCProblem, StageData
from difflcs.mpc.solution import Primal

_WEAK, _SINGULAR, _CLOSE, _DEPENDENT = (TOLERANCES[name] for name in ("weak", "singular", "close", "dependent"))
# Weight of a held constraint in the augmented Hessian, in units of the row's curvature; each pass of the refinement
# divides the row's remainder by it. It costs the other directions as many digits as it has.
_HOLD = 1e5
# Largest number of passes, and the relative change of the multipliers at which they end.
_PASSES = 10
_UNCHANGED = 1e-13


@dataclass(frozen=True)
class Linearisation:
    """The factored matrix K_z at one primal trajectory.

    Attributes:
        primal: the trajectory.
        multipliers: its multipliers.
        lower, upper: (batch, H, n_u) bool: actions held at their lower and upper bound.
        degenerate: (batch,) bool: a bound or a constraint is weakly active, the constraints held depend on each other,
            or the reduced Hessian is singular or indefinite.
        held: (batch, H+1, n_c) bool: constraints held with equality.
        fined: (batch, H+1, n_c) bool: soft constraints that are violated and pay their price.
        stages: one `_Stage` per step.
    """

    primal: Primal
    multipliers: Multipliers
    lower: Tensor
    upper: Tensor
    degenerate: Tensor
    held: Tensor
    fined: Tensor
    stages: list[_Stage]
    weight: Tensor  # (batch, H+1, n_c), of held constraints in the augmented Hessian

    def row_multipliers(self, problem: MPCProblem) -> Tensor:
        """Return the multipliers of the constraints, (batch, H+1, n_c): zero if inactive, the price if fined."""
        price = prices(problem)
        return torch.where(self.held, self.primal.mu, torch.where(self.fined, price, torch.zeros_like(price)))


class _Eliminated(NamedTuple):
    """One stage with λ eliminated: the part that does not depend on later stages."""

    contact: Contact
    K_lam: Tensor  # (batch, n_lam, n_x + n_u)
    K_s: Tensor
    A_hat: Tensor  # (batch, n_x, n_x + n_u), [A B] + C K_lam
    hessian: Tensor  # (batch, n_x + n_u, n_x + n_u), of the stage's terms


@dataclass(frozen=True)
class _Stage:
    eliminated: _Eliminated
    P: Tensor  # (batch, n_x, n_x), Hessian of the value function after this step
    Q_xu: Tensor  # (batch, n_x, n_u), active columns zero
    L: Tensor  # (batch, n_u, n_u), Cholesky factor of Q_uu with identity rows for active actions
    free: Tensor  # (batch, n_u), 1 where the action is free


def linearise(problem: MPCProblem, primal: Primal) -> Linearisation:
    """Factor K_z at a trajectory: the backward Riccati sweep, which determines the active set on the way.

    An action is held at a bound where a Newton step along its curvature would cross it, g > h·(u − u_min) (above:
    −g > h·(u_max − u)); this orders the bound's multiplier against its distance, whatever the scales. In the same way a
    constraint is held where 0 < m + c/V < price. V = a K⁻¹ aᵀ, of the row a = [G_x G_u] in the problem without
    constraints, is how far a unit more of its multiplier m moves it. Above the price it is fined.
    """
    primal = complete(problem, primal)
    dual, contacts = backward(problem, primal)
    data = stages_of(problem)
    eliminated = _eliminate(problem, primal, dual, contacts, data)
    bounds = _Bounds.at(problem, primal, dual)
    stages, singular = _sweep(problem, eliminated, data, bounds)
    weak = torch.stack(bounds.weak).any(0)
    none = torch.zeros(primal.mu.shape, dtype=torch.bool)
    lower, upper = torch.stack(bounds.lower[::-1], 1), torch.stack(bounds.upper[::-1], 1)
    lin = Linearisation(primal, dual, lower, upper, weak, none, none, stages, torch.zeros_like(primal.mu))
    if not problem.n_c:
        return replace(lin, degenerate=weak | singular)
    curved = lin
    if bool(singular.any()):
        # At a vertex the rows hold directions without curvature. To tell which, actions get that of their range.
        free, damping = [stage.free > 0 for stage in stages], bounds.across * singular[:, None, None]
        curved = replace(lin, stages=_sweep(problem, eliminated, data, free, damping=damping)[0])
    return _hold_rows(problem, lin, data, singular, _spread(curved, data))


def _eliminate(
    problem: MPCProblem, primal: Primal, dual: Multipliers, contacts: list[Contact], data: list[StageData]
) -> list[_Eliminated]:
    n_x, crossed = problem.n_x, bool(problem.S.any())
    curvature = barrier_curvature(problem, primal.u)
    stages: list[_Eliminated] = []
    for k, contact in enumerate(contacts):
        at = data[k]
        if k == 0 or data[k] is not data[k - 1]:
            AB, DE = _join(at.A, at.B), _join(at.D, at.E)
        b = (primal.lam[:, k] / contact.size).unsqueeze(-1)
        K_lam = -contact.solve(b * DE)
        K_s = DE + at.F @ K_lam
        weighted = dual.y[:, k].unsqueeze(-1) * K_lam
        Y = weighted.mT @ K_s
        hessian = Y + Y.mT
        hessian[:, :n_x, :n_x] += at.Q
        hessian[:, n_x:, n_x:] += at.R + torch.diag_embed(curvature[:, k])
        if crossed:
            hessian[:, :n_x, n_x:] += at.S
            hessian[:, n_x:, :n_x] += at.S.mT
        stages.append(_Eliminated(contact, K_lam, K_s, AB + at.C @ K_lam, hessian))
    return stages


class _Bounds:
    """Active set of the action bounds, determined from the last stage to the first as the curvature becomes known."""

    def __init__(
        self, problem: MPCProblem, primal: Primal, gradient: Tensor, terms: Tensor, width: Tensor, *least: Tensor
    ):
        self.problem, self.u, self.width, (self.least, self.across) = problem, primal.u, width, least
        self.gradient, self.terms = gradient, terms
        self.low, self.high = (v.expand_as(primal.u) for v in problem.bounds())
        self.lower: list[Tensor] = []
        self.upper: list[Tensor] = []
        self.weak: list[Tensor] = []

    @classmethod
    def at(cls, problem: MPCProblem, primal: Primal, dual: Multipliers) -> _Bounds:
        width, rest = ranges(problem, primal.u), curvature_at_rest(problem).transpose(0, 1)
        # The least curvature keeps rounding of a gradient apart from a reason to leave the interior.
        terms = gradient_terms(problem, primal, dual)
        across = torch.maximum(terms, width * rest) / torch.where(width > 0, width, torch.ones_like(width))
        least = (1e-10 * across).clamp_min(torch.finfo(torch.float64).tiny)
        # With constraints the curvature may be negative at a solution, or zero: only along them it is not.
        least = torch.maximum(least, rest) if problem.n_c else least
        return cls(problem, primal, dual.gradient, terms, width, least, across)

    def free(self, k: int, Q_uu: Tensor) -> Tensor:
        """Return which actions (batch, n_u) are free at stage k, by their curvature."""
        u, g, width, low, high = (v[:, k] for v in (self.u, self.gradient, self.width, self.low, self.high))
        h = torch.maximum(Q_uu.diagonal(dim1=-2, dim2=-1), self.least[:, k])
        to_lower, to_upper, step, fixed = u - low, high - u, g / h, high <= low
        # With constraints, the remainder of a gradient that cancels does not hold an action at its bound.
        held = g / torch.maximum(h, self.across[:, k]) if self.problem.n_c else step
        lower = (held > to_lower) | (fixed & (g >= 0))
        upper = (-held > to_upper) | (fixed & (g < 0))
        # With one bound, at zero, and at rest there in all steps, the action has no size: the gradient alone decides.
        small = torch.where(width > 0, step.abs() <= _WEAK * width, g.abs() <= _WEAK * self.terms[:, k])
        weak = (torch.minimum(to_lower, to_upper) <= _WEAK * width) & small & ~fixed
        if self.problem.barrier > 0:
            # A barrier that keeps no distance to speak of is the bound itself; its steepness is then only rounding.
            close = torch.maximum(_CLOSE * width, 1e-3 * _CLOSE * torch.maximum(low.abs(), high.abs()))
            lower = (to_lower <= close) & (to_lower <= to_upper)
            upper = (to_upper <= close) & (to_upper < to_lower)
            weak = torch.zeros_like(weak)
        self.lower.append(lower)
        self.upper.append(upper)
        self.weak.append(weak.any(-1))
        return ~(lower | upper)


def _sweep(
    problem: MPCProblem,
    eliminated: list[_Eliminated],
    data: list[StageData],
    bounds: _Bounds | list[Tensor],
    weight: Tensor | None = None,
    damping: Tensor | None = None,
) -> tuple[list[_Stage], Tensor]:
    """Run the backward Riccati sweep; also return whether a reduced Hessian is singular or indefinite, (batch,).

    Args:
        problem: the problems.
        eliminated: the stages with λ eliminated.
        data: the original stages.
        bounds: the bounds that decide which actions are free, or the free actions, (batch, n_u) per stage.
        weight: (batch, H+1, n_c) of each constraint in the Hessian; none if None.
        damping: (batch, H, n_u) curvature to add to the actions; none if None.
    """
    n_x = problem.n_x
    P = problem.Q_final.expand(problem.batch, n_x, n_x)
    if weight is not None:
        P = P + data[-1].G_x.mT @ (weight[:, -1].unsqueeze(-1) * data[-1].G_x)
    stages: list[_Stage] = []
    degenerate = torch.zeros(problem.batch, dtype=torch.bool)
    for k in reversed(range(problem.horizon)):
        A_hat = eliminated[k].A_hat
        hessian = A_hat.mT @ (P @ A_hat) + eliminated[k].hessian
        if weight is not None:
            row = _join(data[k].G_x, data[k].G_u)
            hessian = hessian + row.mT @ (weight[:, k].unsqueeze(-1) * row)
        Q_uu = hessian[:, n_x:, n_x:]
        if damping is not None:
            Q_uu = Q_uu + torch.diag_embed(damping[:, k])
        free = bounds.free(k, Q_uu) if isinstance(bounds, _Bounds) else bounds[k]
        L, singular = _cholesky(Q_uu, free)
        degenerate |= singular
        Q_xu = hessian[:, :n_x, n_x:] * free.unsqueeze(-2)
        stages.append(_Stage(eliminated[k], P, Q_xu, L, free.to(L.dtype)))
        Z = torch.linalg.solve_triangular(L, Q_xu.mT, upper=False)
        P = hessian[:, :n_x, :n_x] - Z.mT @ Z
    return stages[::-1], degenerate


def _hold_rows(
    problem: MPCProblem, lin: Linearisation, data: list[StageData], singular: Tensor, spread: Tensor
) -> Linearisation:
    """Determine which constraints are held, and repeat the sweep with those held.

    `singular` (batch,) says whether the Hessian is singular; it counts for elements without a held constraint, as the
    others need a regular Hessian only along the held rows.
    """
    mu, price = lin.primal.mu, prices(problem)
    c = problem.constraints(lin.primal.x, lin.primal.u)
    above = mu * spread + c
    most = torch.where(torch.isinf(price), torch.inf, price * spread)  # not ∞·0
    fined = above >= most
    held = (above > 0) & ~fined & (spread > 0)
    # Weakly active: c, and the multiplier's distance to the end of its range in the same unit, are both near zero.
    close = _WEAK * row_units(problem, lin.primal).unsqueeze(1)
    off_end = torch.minimum(mu * spread, torch.where(torch.isinf(price), torch.inf, (price - mu) * spread)).abs()
    weak = ((c.abs() <= close) & (off_end <= close) & (close > 0)).flatten(1).any(1)
    weak |= lin.degenerate
    lin = replace(lin, held=held, fined=fined, degenerate=weak | singular)
    if not bool(held.any()):
        return lin
    weight = torch.where(held, _HOLD / torch.where(held, spread, torch.ones_like(spread)), torch.zeros_like(spread))
    free = [stage.free > 0 for stage in lin.stages]
    stages, along = _sweep(problem, [stage.eliminated for stage in lin.stages], data, free, weight)
    singular = torch.where(held.flatten(1).any(1), along, singular)
    lin = replace(lin, stages=stages, weight=weight)
    return replace(lin, degenerate=weak | singular | _dependent(problem, lin, spread))


def _spread(lin: Linearisation, data: list[StageData]) -> Tensor:
    """Compute V = diag(a K⁻¹ aᵀ) of every constraint, (batch, H+1, n_c), in the problem without constraints.

    K⁻¹ is the covariance of (dx, du) if each Q_uu is the inverse covariance of the actions around their feedback.
    """
    batch, _, n_x = lin.primal.x.shape
    moved = torch.zeros(batch, n_x, n_x, dtype=torch.float64)
    variances = []
    for at, stage in zip(data, lin.stages, strict=False):
        feedback = -torch.cholesky_solve(stage.Q_xu.mT, stage.L)
        A, B = stage.eliminated.A_hat.split([n_x, feedback.shape[-2]], -1)
        by_state, by_action = at.G_x + at.G_u @ feedback, _scaled(at.G_u, stage)
        variances.append((by_state * (by_state @ moved)).sum(-1) + by_action.square().sum(-2))
        closed, root = A + B @ feedback, _scaled(B, stage)
        moved = closed @ moved @ closed.mT + root.mT @ root
    variances.append((data[-1].G_x * (data[-1].G_x @ moved)).sum(-1))
    return torch.stack(variances, 1)


def _scaled(matrix: Tensor, stage: _Stage) -> Tensor:
    """Compute L⁻¹ matrixᵀ for a matrix that acts on the free actions."""
    return torch.linalg.solve_triangular(stage.L, (matrix * stage.free.unsqueeze(-2)).mT, upper=False)


def _dependent(problem: MPCProblem, lin: Linearisation, spread: Tensor) -> Tensor:
    """Return whether the held rows depend on each other, (batch,): a right-hand side of theirs cannot be met."""
    spots = torch.arange(lin.held[0].numel(), dtype=torch.float64).reshape(lin.held.shape[1:])
    target = torch.where(lin.held, (1.5 + spots.cos()) * spread.clamp_min(0.0).sqrt(), 0.0)
    x_bar, u_bar, lam_bar, _ = (torch.zeros_like(v) for v in lin.primal)
    direction = solve(problem, lin, x_bar, u_bar, lam_bar, target)
    remainder = _along(problem, lin, direction) - target
    return (remainder.abs() > _DEPENDENT * target).flatten(1).any(1)


def barrier_curvature(problem: MPCProblem, u: Tensor) -> Tensor:
    """Compute the second derivative (batch, H, n_u) of the barrier of the action bounds; zero without a barrier."""
    if problem.barrier == 0:
        return torch.zeros_like(u)
    below, above = problem.distances(u)
    return problem.barrier * (1 / below.square() + 1 / above.square())


def _join(left: Tensor, right: Tensor) -> Tensor:
    batch = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
    return torch.cat([left.expand(*batch, *left.shape[-2:]), right.expand(*batch, *right.shape[-2:])], -1)


def _cholesky(Q_uu: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    """Factor Q_uu with identity rows where not free; where it is singular or indefinite, a positive definite stand-in.

    Its eigenvalues are in units of each action's curvature. One near zero becomes so large that its direction
    hardly moves; a negative one is replaced by its absolute value.
    """
    diagonal = Q_uu.diagonal(dim1=-2, dim2=-1)
    unit = torch.where(free & (diagonal > 0), diagonal, torch.ones_like(diagonal)).sqrt()
    eye = torch.eye(Q_uu.shape[-1], dtype=Q_uu.dtype)
    mask = free.unsqueeze(-1) & free.unsqueeze(-2)
    symmetric = 0.5 * (Q_uu + Q_uu.mT) / unit.unsqueeze(-1) / unit.unsqueeze(-2)
    scaled = torch.where(mask, symmetric, eye)
    L, info = torch.linalg.cholesky_ex(scaled)
    pivots = L.diagonal(dim1=-2, dim2=-1).square().amin(-1)
    singular = (info != 0) | ~(pivots > _SINGULAR)
    if bool(singular.any()):
        bad = torch.nonzero(singular).squeeze(-1)
        values, vectors = torch.linalg.eigh(torch.nan_to_num(scaled[bad], posinf=0.0, neginf=0.0))
        flat = values.abs() <= 10 * _SINGULAR * values.abs().amax(-1, keepdim=True)
        lifted = torch.where(flat, 1 / _SINGULAR, values.abs())
        L = L.clone()
        L[bad] = torch.linalg.cholesky_ex((vectors * lifted.unsqueeze(-2)) @ vectors.mT).L
    return L * unit.unsqueeze(-1), singular


class Direction(NamedTuple):
    """Solution w of K_z w = z̄: x (batch, H+1, n_x), u, lam, p of x_1 … x_H, rho, nu and mu (batch, H+1, n_c)."""

    x: Tensor
    u: Tensor
    lam: Tensor
    p: Tensor
    rho: Tensor
    nu: Tensor
    mu: Tensor


def solve(
    problem: MPCProblem, lin: Linearisation, x_bar: Tensor, u_bar: Tensor, lam_bar: Tensor, target: Tensor | None = None
) -> Direction:
    """Solve K_z w = z̄ for upstream gradients on x, u and λ.

    Args:
        problem: the problems.
        lin: `linearise` at a trajectory.
        x_bar: (batch, H+1, n_x); the first is ignored.
        u_bar: (batch, H, n_u).
        lam_bar: (batch, H, n_lam).
        target: (batch, H+1, n_c) required G_x dx + G_u du of the held constraints; zero if None.
    """
    if not bool(lin.held.any()):
        return _solve(problem, lin, x_bar, u_bar, lam_bar)
    G_x, G_u = problem.batch_first("G_x"), problem.batch_first("G_u")
    target = torch.zeros_like(lin.weight) if target is None else torch.where(lin.held, target, 0.0)
    mu, best = torch.zeros_like(lin.weight), None
    # √V, in units of which multipliers of different rows compare.
    unit = torch.where(lin.held, _HOLD / torch.where(lin.held, lin.weight, 1.0), 0.0).sqrt()
    least = torch.full((problem.batch,), torch.inf, dtype=torch.float64)
    for _ in range(_PASSES):
        force, before = mu - lin.weight * target, mu
        direction = _solve(problem, lin, x_bar - matvec(G_x.mT, force), u_bar - matvec(G_u.mT, force[:, :-1]), lam_bar)
        along = lin.weight * _along(problem, lin, direction)
        # The multiplier of this direction; ν lacks the part in the augmented Hessian.
        mu = force + along
        direction = direction._replace(mu=mu, nu=direction.nu - matvec(G_u.mT, along[:, :-1]))
        change, size = (((v.abs() * unit).flatten(1).amax(1)) for v in (mu - before, mu))
        better = change < least
        best = direction if best is None else _choose(better, direction, best)
        least = torch.where(better, change, least)
        if not bool((better & (change > _UNCHANGED * size)).any()):
            break
    assert best is not None
    return best


def _choose(mask: Tensor, left: Direction, right: Direction) -> Direction:
    return Direction(*(torch.where(mask[:, None, None], a, b) for a, b in zip(left, right, strict=True)))


def _along(problem: MPCProblem, lin: Linearisation, w: Direction) -> Tensor:
    """Compute G_x dx + G_u du of the held constraints, (batch, H+1, n_c); zero elsewhere."""
    moved = problem.rows(w.x, w.u)
    return torch.where(lin.held, moved, torch.zeros_like(moved))


def _solve(problem: MPCProblem, lin: Linearisation, x_bar: Tensor, u_bar: Tensor, lam_bar: Tensor) -> Direction:
    """Run one backward and one forward sweep; constraints enter only through their weight in the Hessian."""
    n_x, horizon = problem.n_x, problem.horizon
    dual, data = lin.multipliers, stages_of(problem)
    crossed = bool(problem.S.any())
    # Backward: linear terms of the value functions, v_k, and the feedforward parts.
    v = -x_bar[:, -1]
    values, feedforward = [v], []
    for k in reversed(range(horizon)):
        stage = lin.stages[k]
        upstream = torch.cat([x_bar[:, k], u_bar[:, k]], -1) + matvec(stage.eliminated.K_lam.mT, lam_bar[:, k])
        linear = matvec(stage.eliminated.A_hat.mT, v) - upstream
        right = (linear[:, n_x:] * stage.free).unsqueeze(-1)
        step = -torch.cholesky_solve(right, stage.L).squeeze(-1)
        feedforward.append(step)
        v = linear[:, :n_x] + matvec(stage.Q_xu, step)
        values.append(v)
    values, feedforward = values[::-1], feedforward[::-1]
    # Forward: the direction itself, dual part included.
    dx = torch.zeros_like(x_bar[:, 0])
    dxs, dus, dlams, dps, drhos, dnus = [dx], [], [], [], [], []
    for k in range(horizon):
        stage, eliminated, at = lin.stages[k], lin.stages[k].eliminated, data[k]
        feedback = torch.cholesky_solve(matvec(stage.Q_xu.mT, dx).unsqueeze(-1), stage.L).squeeze(-1)
        du = feedforward[k] - feedback
        dw = torch.cat([dx, du], -1)
        dlam, ds = matvec(eliminated.K_lam, dw), matvec(eliminated.K_s, dw)
        across = matvec(at.S.mT, dx) if crossed else 0.0
        dx = matvec(eliminated.A_hat, dw)
        dp = matvec(stage.P, dx) + values[k + 1]
        y, lam = dual.y[:, k], lin.primal.lam[:, k]
        right = lam_bar[:, k] - matvec(at.C.mT, dp) - y * ds - matvec(at.F.mT, y * dlam)
        drho = eliminated.contact.solve_transposed(right) * lam + y * dlam
        dnu = u_bar[:, k] - matvec(at.R, du) - matvec(at.B.mT, dp) - matvec(at.E.mT, drho) - across
        for store, value in zip((dxs, dus, dlams, dps, drhos, dnus), (dx, du, dlam, dp, drho, dnu), strict=True):
            store.append(value)
    parts = [torch.stack(d, 1) for d in (dxs, dus, dlams, dps, drhos, dnus)]
    return Direction(*parts, mu=torch.zeros_like(lin.weight))
