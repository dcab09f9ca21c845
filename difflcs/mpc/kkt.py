r"""Optimality conditions of the LCS-MPC, and their sensitivity. All derivative mathematics of the MPC is here.

Conditions
----------
With s_k = D x_k + E u_k + F λ_k + c, costates p, multipliers y of λ∘s = ε and ν of the action bounds, the Lagrangian is

    L = J(x, u) + Σ_k p_{k+1}ᵀ (A x_k + B u_k + C λ_k + d − x_{k+1}) + y_kᵀ (λ_k ∘ s_k − ε) + ν_kᵀ (u_k − bound).

λ, s > 0 are never active because λ∘s = ε > 0. With ρ_k = y_k ∘ λ_k, stationarity gives, backwards from
p_H = Q_final x_H + q_final,

    λ_k:  (diag s_k + Fᵀ diag λ_k) y_k = −Cᵀ p_{k+1}                                     (solve for y_k)
    u_k:  g_k + ν_k = 0   with   g_k = R u_k + r + Bᵀ p_{k+1} + Eᵀ ρ_k                  (g: reduced gradient dJ/du)
    x_k:  p_k = Q x_k + q + Aᵀ p_{k+1} + Dᵀ ρ_k.

So all multipliers follow from a primal trajectory (x, u, λ) alone, whichever backend found it.

Perturbation (Büskens; Eq. dloss_dtheta of the paper)
-----------------------------------------------------
Write the conditions, with the active bounds held as equations, as K(z, θ) = 0 for z = (x, u, λ, p, y, ν). The implicit
function theorem gives z' = −K_z⁻¹ K_θ. K_z is symmetric, so for an upstream gradient z̄ on the primal part

    θ̄ = −wᵀ K_θ   with   K_z w = z̄,   w = (dx, du, dλ, dp, dy, dν).

K_z w = z̄ is the optimality system of a linear-quadratic problem in (dx, du, dλ): the Hessian of L, the linearised
constraints, and the linear term −z̄. It is solved stage by stage. The linearised complementarity row
s∘dλ + λ∘ds = 0 with ds = D dx + E du + F dλ gives

    dλ = Kλ (dx, du),  ds = Ks (dx, du),   Kλ = −M⁻¹ diag(b) [D E],  M = diag(a) + diag(b) F,
    a = s/(λ+s), b = λ/(λ+s),  Ks = [D E] + F Kλ;

eliminating dλ leaves dx₊ = ([A B] + C Kλ)(dx, du) with the stage Hessian blkdiag(Q, R) + Y,

    Y = Σ_i y_i (Kλ_iᵀ Ks_i + Ks_iᵀ Kλ_i),

which is the exact second derivative of λ. A Riccati recursion over it, rows and columns of active actions replaced by
the identity, yields (dx, du); then dp_k = P_k dx_k + v_k from the value function, dy from the λ row, dν from the u row.

Since K is the gradient of L, wᵀ K_θ is the derivative along w of ∂L/∂θ, whose every term is a product of two of
(x, u, λ, p, ρ) and hence of their directions (dx, du, dλ, dp, dρ), dρ = dy∘λ + y∘dλ. An upstream gradient on the
objective itself needs no solve: dJ*/dθ = ∂L/∂θ (envelope theorem); it enters as dp − J̄·p and dρ − J̄·ρ below.

A logarithmic barrier −μ Σ log(u − u_min) + log(u_max − u) adds −μ/(u − u_min) + μ/(u_max − u) to g and its derivative
to R; no bound is then active, and the bounds get their gradients from these terms.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difflcs._linalg import matvec
from difflcs.mpc.problem import MPCProblem
from difflcs.mpc.solution import Primal

# Largest residual of a solution: what CONVERGED means.
CERTIFIED = 1e-6
# A bound is weakly active where both the distance to it and the Newton step across it are below this part of the range.
_WEAK = 1e-5
# A reduced Hessian counts as singular below this pivot, in units of each action's own curvature. Directions below it
# are held: their sensitivity is zero.
_SINGULAR = 1e-10
# An action with a barrier is differentiated as one at its bound below this part of its range.
_CLOSE = 1e-8


@dataclass(frozen=True)
class Multipliers:
    """Multipliers that stationarity assigns to a primal trajectory.

    Attributes:
        s: (batch, H, n_lam) slack of the complementarity.
        p: (batch, H+1, n_x) costates; p[:, 0] is dJ/dx0.
        y: (batch, H, n_lam) multipliers of λ∘s = ε.
        rho: (batch, H, n_lam) y∘λ.
        gradient: (batch, H, n_u) reduced gradient dJ/du.
    """

    s: Tensor
    p: Tensor
    y: Tensor
    rho: Tensor
    gradient: Tensor


@dataclass(frozen=True)
class Linearisation:
    """The factored matrix K_z at one primal trajectory.

    Attributes:
        primal: the trajectory.
        multipliers: its multipliers.
        lower, upper: (batch, H, n_u) bool: actions held at their lower and upper bound.
        degenerate: (batch,) bool: a bound is weakly active, or the reduced Hessian is singular or indefinite.
        stages: one `_Stage` per step.
    """

    primal: Primal
    multipliers: Multipliers
    lower: Tensor
    upper: Tensor
    degenerate: Tensor
    stages: list[_Stage]


@dataclass(frozen=True)
class _Stage:
    M: Tensor  # LU factors and pivots of M, see the module's derivation
    pivots: Tensor
    size: Tensor  # λ + s
    K_lam: Tensor  # (batch, n_lam, n_x + n_u)
    K_s: Tensor
    A_hat: Tensor  # (batch, n_x, n_x + n_u), [A B] + C K_lam
    P: Tensor  # (batch, n_x, n_x), Hessian of the value function after this step
    Q_xu: Tensor  # (batch, n_x, n_u), active columns zero
    L: Tensor  # (batch, n_u, n_u), Cholesky factor of Q_uu with identity rows for active actions
    free: Tensor  # (batch, n_u), 1 where the action is free


def multipliers(problem: MPCProblem, primal: Primal) -> Multipliers:
    """Multipliers of a trajectory by the backward recursion above."""
    return _backward(problem, primal)[0]


def residual(problem: MPCProblem, primal: Primal, dual: Multipliers) -> Tensor:
    """Largest violation of the optimality conditions, (batch,); without units, and infinite for what is not a number.

    A solution is CONVERGED where this is at most `CERTIFIED`. The maximum, over all steps and components, of

    - dynamics: |x_{k+1} − (A x_k + B u_k + C λ_k + d)| in parts of Σ|terms|, the sum of the sizes of the terms of the
      right-hand side; likewise x_0 against x0;
    - complementarity: |λ∘s − ε| / (ε + 1e-7·λ·Σ|terms of s|), where the second part leaves room for the rounding of
      s = Dx + Eu + Fλ + c; and 1 where λ is not positive;
    - bounds: the distance of an action to them, in parts of its range u_max − u_min;
    - stationarity in λ: |Cᵀp + s∘y + Fᵀρ| in parts of its Σ|terms|;
    - stationarity in u: |u − clip(u − range·g/G)| / range, the part of its range by which the reduced gradient g would
      still move an action. G is the scale of g: the larger of its Σ|terms| and of range·(Rⱼⱼ + BⱼᵀQBⱼ), which is what
      its weights make of a step across the range. G does not vanish with the curvature: flat directions count.
    """
    x, u, lam = (v.transpose(0, 1) for v in primal[:3])  # steps first, so that per-element matrices broadcast
    p, y, rho = (v.transpose(0, 1) for v in (dual.p, dual.y, dual.rho))
    s, g, low, high = dual.s.transpose(0, 1), dual.gradient.transpose(0, 1), problem.u_min, problem.u_max
    P = problem
    x_terms = _terms((P.A, x[:-1]), (P.B, u), (P.C, lam)) + P.d.abs()
    s_terms = _terms((P.D, x[:-1]), (P.E, u), (P.F, lam)) + P.c.abs()
    lam_row = matvec(P.C.mT, p[1:]) + s * y + matvec(P.F.mT, rho)
    lam_terms = _terms((P.C.mT, p[1:]), (P.F.mT, rho)) + (s * y).abs()
    u_terms = _gradient_terms(problem, primal, dual).transpose(0, 1)
    width = high - low
    at_rest = torch.stack([_at_rest(P, P.Q)] * (P.horizon - 1) + [_at_rest(P, P.Q_final)])
    scale = torch.maximum(u_terms, width * (at_rest if at_rest.ndim == 3 else at_rest.unsqueeze(1)))
    unit = torch.where(width > 0, width, torch.ones_like(width))
    moved = torch.minimum(_parts(g, scale), torch.where(g > 0, u - low, high - u) / unit).clamp_min(0.0)
    violations = [
        _parts(x[0] - P.x0, P.x0.abs()).unsqueeze(0),
        _parts(x[1:] - P.next_state(x[:-1], u, lam), x_terms),
        (lam * s - P.relaxation).abs() / (P.relaxation + 1e-7 * lam.abs() * s_terms),
        (~(lam > 0)).to(lam.dtype),
        torch.maximum(low - u, u - high).clamp_min(0.0) / unit,
        _parts(lam_row, lam_terms),
        torch.where(width > 0, moved, torch.zeros_like(moved)) + 0 * g,
    ]
    worst = torch.stack([v.amax((0, 2)) for v in violations]).amax(0)  # amax keeps NaN
    return torch.nan_to_num(worst, nan=torch.inf)


def _terms(*products: tuple[Tensor, Tensor]) -> Tensor:
    """Σ|terms| of a sum of products of a matrix and a vector."""
    first, *rest = (matvec(matrix.abs(), vector.abs()) for matrix, vector in products)
    return sum(rest, first)


def _gradient_terms(problem: MPCProblem, primal: Primal, dual: Multipliers) -> Tensor:
    """Σ|terms| (batch, H, n_u) of the reduced gradient."""
    u, p, rho = (v.transpose(0, 1) for v in (primal.u, dual.p[:, 1:], dual.rho))
    terms = _terms((problem.R, u), (problem.B.mT, p), (problem.E.mT, rho)) + problem.r.abs()
    terms = terms.transpose(0, 1)
    if problem.barrier > 0:
        below, above = problem.distances(primal.u)
        terms = terms + problem.barrier * (1 / below + 1 / above)
        # Next to a bound the barrier is so steep that rounding u moves g.
        width = (problem.u_max - problem.u_min).unsqueeze(-2)
        terms = terms + 1e-8 * problem.barrier * width * (below.square().reciprocal() + above.square().reciprocal())
    return terms


def _parts(value: Tensor, terms: Tensor) -> Tensor:
    return value.abs() / torch.where(terms > 0, terms, torch.ones_like(terms))


def _at_rest(problem: MPCProblem, weight: Tensor) -> Tensor:
    """Curvature (..., n_u) of each action by its own weight and the next state's."""
    return problem.R.diagonal(dim1=-2, dim2=-1) + (problem.B * (weight @ problem.B)).sum(-2)


def _backward(problem: MPCProblem, primal: Primal) -> tuple[Multipliers, list[tuple[Tensor, Tensor, Tensor]]]:
    """Multipliers, and per stage the LU factors of M, their pivots, and λ + s."""
    x, u, lam, _ = primal
    s = problem.gap(*(v.transpose(0, 1) for v in (x[:, :-1], u, lam))).transpose(0, 1)
    size = lam + s
    b = lam / size
    # a = s/(λ+s), not 1 − b, which has no digits left where λ is 1e10 times s.
    M = torch.diag_embed(s / size) + b.unsqueeze(-1) * (problem.F if problem.shared("F") else problem.F.unsqueeze(1))
    factors, pivots, _ = torch.linalg.lu_factor_ex(M)
    stages = [(factors[:, k], pivots[:, k], size[:, k]) for k in range(problem.horizon)]
    p = [matvec(problem.Q_final, x[:, -1]) + problem.q_final]
    ys, rhos, gradients = [], [], []
    for k in reversed(range(problem.horizon)):
        y = _solve_transposed(stages[k], -matvec(problem.C.mT, p[-1]))
        rho = y * lam[:, k]
        gradients.append(
            matvec(problem.R, u[:, k]) + problem.r + matvec(problem.B.mT, p[-1]) + matvec(problem.E.mT, rho)
        )
        p.append(matvec(problem.Q, x[:, k]) + problem.q + matvec(problem.A.mT, p[-1]) + matvec(problem.D.mT, rho))
        ys.append(y)
        rhos.append(rho)
    p, y, rho, gradient = (torch.stack(v[::-1], 1) for v in (p, ys, rhos, gradients))
    if problem.barrier > 0:
        below, above = problem.distances(u)
        gradient = gradient + problem.barrier * (1 / above - 1 / below)
    return Multipliers(s, p, y, rho, gradient), stages


def _solve_transposed(stage: tuple[Tensor, Tensor, Tensor], right: Tensor) -> Tensor:
    """Solve (diag s + Fᵀ diag λ) y = right, which is Mᵀ diag(λ+s) y = right."""
    factors, pivots, size = stage
    return torch.linalg.lu_solve(factors, pivots, right.unsqueeze(-1), adjoint=True).squeeze(-1) / size


def linearise(problem: MPCProblem, primal: Primal) -> Linearisation:
    """Factor K_z at a trajectory: the backward Riccati sweep, with the active set found on the way.

    An action is held at a bound where a Newton step along its own curvature would cross it, g > h·(u − u_min) (above:
    −g > h·(u_max − u)); this orders the bound's multiplier against its distance, whatever the scales.
    """
    n_x = problem.n_x
    dual, lcp = _backward(problem, primal)
    AB = _join(problem.A, problem.B)
    DE = _join(problem.D, problem.E)
    P = problem.Q_final.expand(problem.batch, n_x, n_x)
    width = problem.u_max - problem.u_min
    curvature = barrier_curvature(problem, primal.u)
    stages, lowers, uppers = [], [], []
    degenerate = torch.zeros(problem.batch, dtype=torch.bool)
    sizes = _gradient_terms(problem, primal, dual)
    for k in reversed(range(problem.horizon)):
        factors, pivots, size = lcp[k]
        last = k == problem.horizon - 1
        u, g = primal.u[:, k], dual.gradient[:, k]
        b = (primal.lam[:, k] / size).unsqueeze(-1)
        K_lam = -torch.linalg.lu_solve(factors, pivots, b * DE)
        K_s = DE + problem.F @ K_lam
        A_hat = AB + problem.C @ K_lam
        weighted = dual.y[:, k].unsqueeze(-1) * K_lam
        Y = weighted.mT @ K_s
        hessian = A_hat.mT @ (P @ A_hat) + Y + Y.mT
        hessian[:, :n_x, :n_x] += problem.Q
        hessian[:, n_x:, n_x:] += problem.R + torch.diag_embed(curvature[:, k])
        Q_uu = hessian[:, n_x:, n_x:]
        # The least curvature keeps rounding of a gradient apart from a reason to leave the interior.
        reference = torch.maximum(sizes[:, k], width * (_at_rest(problem, problem.Q_final if last else problem.Q)))
        least = 1e-10 * reference / torch.where(width > 0, width, torch.ones_like(width))
        h = torch.maximum(Q_uu.diagonal(dim1=-2, dim2=-1), least.clamp_min(torch.finfo(torch.float64).tiny))
        to_lower, to_upper, step = u - problem.u_min, problem.u_max - u, g / h
        lower = (step > to_lower) | ((width <= 0) & (g >= 0))
        upper = (-step > to_upper) | ((width <= 0) & (g < 0))
        weak = (torch.minimum(to_lower, to_upper) <= _WEAK * width) & (step.abs() <= _WEAK * width) & (width > 0)
        if problem.barrier > 0:
            # A barrier that keeps no distance to speak of is the bound itself; its steepness is then only rounding.
            largest = torch.maximum(problem.u_min.abs(), problem.u_max.abs())
            close = torch.maximum(_CLOSE * width, 1e-3 * _CLOSE * largest)
            lower = (to_lower <= close) & (to_lower <= to_upper)
            upper = (to_upper <= close) & (to_upper < to_lower)
            weak = torch.zeros_like(weak)
        free = ~(lower | upper)
        L, singular = _cholesky(Q_uu, free)
        degenerate |= weak.any(-1) | singular
        Q_xu = hessian[:, :n_x, n_x:] * free.unsqueeze(-2)
        stages.append(_Stage(factors, pivots, size, K_lam, K_s, A_hat, P, Q_xu, L, free.to(u.dtype)))
        Z = torch.linalg.solve_triangular(L, Q_xu.mT, upper=False)
        P = hessian[:, :n_x, :n_x] - Z.mT @ Z
        lowers.append(lower)
        uppers.append(upper)
    lower, upper = torch.stack(lowers[::-1], 1), torch.stack(uppers[::-1], 1)
    return Linearisation(primal, dual, lower, upper, degenerate, stages[::-1])


def barrier_curvature(problem: MPCProblem, u: Tensor) -> Tensor:
    """Second derivative (batch, H, n_u) of the barrier of the action bounds; zero without a barrier."""
    if problem.barrier == 0:
        return torch.zeros_like(u)
    below, above = problem.distances(u)
    return problem.barrier * (1 / below.square() + 1 / above.square())


def _join(left: Tensor, right: Tensor) -> Tensor:
    batch = torch.broadcast_shapes(left.shape[:-2], right.shape[:-2])
    return torch.cat([left.expand(*batch, *left.shape[-2:]), right.expand(*batch, *right.shape[-2:])], -1)


def _cholesky(Q_uu: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    """Factor Q_uu with identity rows where not free; where it is singular or indefinite, a positive definite stand-in.

    Its eigenvalues are taken in units of each action's own curvature. One near zero becomes so large that its direction
    hardly moves; a negative one is taken by its size.
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


@dataclass(frozen=True)
class _Direction:
    """Solution w of K_z w = z̄."""

    x: Tensor
    u: Tensor
    lam: Tensor
    p: Tensor
    rho: Tensor
    nu: Tensor


def _solve(problem: MPCProblem, lin: Linearisation, x_bar: Tensor, u_bar: Tensor, lam_bar: Tensor) -> _Direction:
    """Solve K_z w = z̄ for upstream gradients on x (batch, H+1, n_x; the first is ignored), u and λ."""
    n_x, horizon = problem.n_x, problem.horizon
    dual = lin.multipliers
    # Backward: linear terms of the value functions, v_k, and the feedforward parts.
    v = -x_bar[:, -1]
    values, feedforward = [v], []
    for k in reversed(range(horizon)):
        stage = lin.stages[k]
        upstream = torch.cat([x_bar[:, k], u_bar[:, k]], -1) + matvec(stage.K_lam.mT, lam_bar[:, k])
        linear = matvec(stage.A_hat.mT, v) - upstream
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
        stage = lin.stages[k]
        feedback = torch.cholesky_solve(matvec(stage.Q_xu.mT, dx).unsqueeze(-1), stage.L).squeeze(-1)
        du = feedforward[k] - feedback
        dw = torch.cat([dx, du], -1)
        dlam, ds = matvec(stage.K_lam, dw), matvec(stage.K_s, dw)
        dx = matvec(stage.A_hat, dw)
        dp = matvec(stage.P, dx) + values[k + 1]
        y, lam = dual.y[:, k], lin.primal.lam[:, k]
        right = lam_bar[:, k] - matvec(problem.C.mT, dp) - y * ds - matvec(problem.F.mT, y * dlam)
        dy = _solve_transposed((stage.M, stage.pivots, stage.size), right)
        drho = dy * lam + y * dlam
        dnu = u_bar[:, k] - matvec(problem.R, du) - matvec(problem.B.mT, dp) - matvec(problem.E.mT, drho)
        for store, value in zip((dxs, dus, dlams, dps, drhos, dnus), (dx, du, dlam, dp, drho, dnu), strict=True):
            store.append(value)
    return _Direction(*(torch.stack(d, 1) for d in (dxs, dus, dlams, dps, drhos, dnus)))


def vjp(
    problem: MPCProblem, lin: Linearisation, grads: tuple[Tensor, Tensor, Tensor, Tensor], solved: Tensor
) -> dict[str, Tensor]:
    """Gradients of every input for upstream gradients on x, u, λ and the objective.

    Args:
        problem: the problems.
        lin: `linearise` at their solutions.
        grads: upstream gradients on x (batch, H+1, n_x), u (batch, H, n_u), lam (batch, H, n_lam), objective (batch,).
        solved: (batch,) bool; elements that are not contribute exactly zero.

    Returns:
        One tensor per name in `INPUTS`, shaped like the input and summed over the batch where the input is shared.
    """
    x_bar, u_bar, lam_bar, objective_bar = grads
    w = _solve(problem, lin, x_bar, u_bar, lam_bar)
    dual = lin.multipliers
    J = objective_bar[:, None, None]

    def keep(value: Tensor) -> Tensor:
        return torch.where(solved[:, None, None], value, torch.zeros_like(value))

    x, u, lam = (keep(v) for v in lin.primal[:3])
    dx, du, dlam = keep(w.x), keep(w.u), keep(w.lam)
    p, rho = keep(dual.p[:, 1:]), keep(dual.rho)
    dp, drho = keep(w.p - J * dual.p[:, 1:]), keep(w.rho - J * dual.rho)
    x_now, dx_now, x_end, dx_end = x[:, :-1], dx[:, :-1], x[:, -1:], dx[:, -1:]
    J = keep(J)

    def outer(name: str, *pairs: tuple[Tensor, Tensor]) -> Tensor:
        # Σ over steps (and over the batch where shared) of left · rightᵀ.
        left, right = (torch.cat(v, 1) for v in zip(*pairs, strict=True))
        if problem.shared(name):
            left, right = left.flatten(0, 1), right.flatten(0, 1)
        return left.mT @ right

    def total(name: str, value: Tensor) -> Tensor:
        return value.sum((0, 1)) if problem.shared(name) else value.sum(1)

    def symmetric(name: str, value: Tensor, direction: Tensor) -> Tensor:
        half = outer(name, (0.5 * J * value - direction, value))
        return 0.5 * (half + half.mT)

    # Bounds: −wᵀK_θ of the rows u − bound = 0, and ∂L/∂bound = −ν = g for the objective. With a barrier, the same
    # for the terms of g and of J that hold the bounds.
    gradient, lower_bar, upper_bar = dual.gradient, torch.zeros_like(u), torch.zeros_like(u)
    if problem.barrier > 0:
        below, above = problem.distances(lin.primal.u)
        gradient = gradient - problem.barrier * (1 / above - 1 / below)
        lower_bar = keep(problem.barrier * (w.u / below.square() + objective_bar[:, None, None] / below))
        upper_bar = keep(problem.barrier * (w.u / above.square() - objective_bar[:, None, None] / above))
    bound = keep(w.nu + objective_bar[:, None, None] * gradient)
    lower_bar = torch.where(lin.lower, bound, lower_bar)
    upper_bar = torch.where(lin.upper, bound, upper_bar)
    x0_bar = matvec(problem.A.mT, dp[:, 0]) + matvec(problem.D.mT, drho[:, 0])
    x0_cost = matvec(problem.Q, x[:, 0]) + problem.q
    return {
        "A": -outer("A", (dp, x_now), (p, dx_now)),
        "B": -outer("B", (dp, u), (p, du)),
        "C": -outer("C", (dp, lam), (p, dlam)),
        "d": -total("d", dp),
        "D": -outer("D", (drho, x_now), (rho, dx_now)),
        "E": -outer("E", (drho, u), (rho, du)),
        "F": -outer("F", (drho, lam), (rho, dlam)),
        "c": -total("c", drho),
        "Q": symmetric("Q", x_now, dx_now),
        "R": symmetric("R", u, du),
        **{name: torch.zeros_like(getattr(problem, name)) for name in ("S", "G_x", "G_u", "g", "price")},
        "Q_final": symmetric("Q_final", x_end, dx_end),
        "q": total("q", J * x_now - dx_now),
        "r": total("r", J * u - du),
        "q_final": total("q_final", J * x_end - dx_end),
        "u_min": total("u_min", lower_bar),
        "u_max": total("u_max", upper_bar),
        "x0": torch.where(solved[:, None], x_bar[:, 0] - x0_bar + J[:, 0] * x0_cost, torch.zeros_like(x0_cost)),
    }


def polish(problem: MPCProblem, primal: Primal, max_iter: int = 6, tol: float = 1e-10) -> Primal:
    """Newton steps on the conditions, active bounds held: the same local optimum to machine precision.

    An interior-point solution is off by its barrier parameter, and finite differences of it and the envelope theorem
    are only as good as that. Actions held at a bound are put onto it; then each step is the sensitivity solve with
    minus the reduced gradient upstream. Every element keeps the best trajectory met, which may be the given one.

    Args:
        problem: the problems.
        primal: nearly optimal trajectories.
        max_iter: most Newton steps; two or three are the rule.
        tol: residual at which an element is left alone.
    """
    zeros = torch.zeros_like(primal.x), torch.zeros_like(primal.lam)
    lin = linearise(problem, primal)
    best, best_residual = primal, residual(problem, primal, lin.multipliers)
    u = primal.u
    for step in range(max_iter + 1):
        if not bool((best_residual > tol).any()):
            break
        if step > 0:
            u = lin.primal.u + _solve(problem, lin, zeros[0], -lin.multipliers.gradient, zeros[1]).u
        if problem.barrier == 0:
            u = torch.where(lin.lower, problem.u_min.unsqueeze(-2), u)
            u = torch.where(lin.upper, problem.u_max.unsqueeze(-2), u)
        # With a barrier a step goes at most nine tenths of the way to a bound.
        u = problem.clip(u) if problem.barrier == 0 else problem.clip_inside(u, lin.primal.u)
        x, lam = problem.rollout(u)
        trial = Primal(x, u, lam, primal.mu)
        lin = linearise(problem, trial)
        trial_residual = residual(problem, trial, lin.multipliers)
        better = trial_residual < best_residual
        best = Primal(*(torch.where(better[:, None, None], a, b) for a, b in zip(trial, best, strict=True)))
        best_residual = torch.where(better, trial_residual, best_residual)
    return best
