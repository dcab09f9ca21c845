r"""Optimality conditions of the LCS-MPC, and their sensitivity. All derivative mathematics of the MPC is here.

The conditions themselves are in `difflcs.mpc.conditions`, the sweeps of the sensitivity in `difflcs.mpc.riccati`.

Conditions
----------
With s_k = D x_k + E u_k + F λ_k + c, costates p, multipliers y of λ∘s = ε and ν of the action bounds, the Lagrangian is

    L = J(x, u) + Σ_k p_{k+1}ᵀ (A x_k + B u_k + C λ_k + d − x_{k+1}) + y_kᵀ (λ_k ∘ s_k − ε) + ν_kᵀ (u_k − bound)
        + Σ_k m_kᵀ c_k   with   c_k = G_x x_k + G_u u_k − g, without actions at k = H.

λ, s > 0 are never active because λ∘s = ε > 0. The multipliers m of the constraints are unknowns like x, u and λ; a
violation costs `price`, so 0 ≤ m ≤ price, where a hard constraint has an infinite price, and

    m = 0 and c ≤ 0 (inactive),   0 < m < price and c = 0 (held),   m = price and c ≥ 0 (fined).

A fined constraint has price·c in the objective, which is the term mᵀc of L. With ρ_k = y_k ∘ λ_k, stationarity gives,
backwards from p_H = Q_final x_H + q_final + G_xᵀ m_H,

    λ_k:  (diag s_k + Fᵀ diag λ_k) y_k = −Cᵀ p_{k+1}                                     (solve for y_k)
    u_k:  g_k + ν_k = 0   with   g_k = R u_k + r + Sᵀ x_k + Bᵀ p_{k+1} + Eᵀ ρ_k + G_uᵀ m_k    (g: reduced gradient)
    x_k:  p_k = Q x_k + q + S u_k + Aᵀ p_{k+1} + Dᵀ ρ_k + G_xᵀ m_k.

So all other multipliers follow from a primal trajectory (x, u, λ) and m alone, whatever backend solved for it. Every
matrix and vector but Q_final and q_final may change with the stage k; the index is left out.

Perturbation (Büskens), which Eq. 8 of the paper needs
------------------------------------------------------
Write the conditions, with the active bounds and the held constraints as equations, as K(z, θ) = 0 for
z = (x, u, λ, p, y, ν, m). The implicit function theorem gives z' = −K_z⁻¹ K_θ. K_z is symmetric, so for an upstream
gradient z̄ on the primal part

    θ̄ = −wᵀ K_θ   with   K_z w = z̄,   w = (dx, du, dλ, dp, dy, dν, dm).

K_z w = z̄ is the optimality system of a linear-quadratic problem in (dx, du, dλ): the Hessian of L, the linearised
constraints, and the linear term −z̄. It is solved stage by stage. The linearised complementarity row
s∘dλ + λ∘ds = 0 with ds = D dx + E du + F dλ gives

    dλ = Kλ (dx, du),  ds = Ks (dx, du),   Kλ = −M⁻¹ diag(b) [D E],  M = diag(a) + diag(b) F,
    a = s/(λ+s), b = λ/(λ+s),  Ks = [D E] + F Kλ;

eliminating dλ leaves dx₊ = ([A B] + C Kλ)(dx, du) with the stage Hessian [[Q, S], [Sᵀ, R]] + Y,

    Y = Σ_i y_i (Kλ_iᵀ Ks_i + Ks_iᵀ Kλ_i),

which is the exact second derivative of λ. A Riccati recursion over it, rows and columns of active actions replaced by
the identity, yields (dx, du); then dp_k = P_k dx_k + v_k from the value function, dy from the λ row, dν from the u row.

Held constraints, a (dx, du) = 0 with the rows a = [G_x G_u] of each stage, enter as an augmented Lagrangian: the stage
Hessian gets aᵀ σ a, the linear term aᵀ dm, and each solve dm ← dm + σ a (dx, du), which leaves of a (dx, du) the part
1/(1 + σV), V = a K⁻¹ aᵀ. With σ = 1e5/V, row by row, two or three solves bring it to rounding.

Since K is the gradient of L, wᵀ K_θ is the derivative along w of ∂L/∂θ, whose every term is a product of two of
(x, u, λ, p, ρ, m) and hence of their directions (dx, du, dλ, dp, dρ, dm), dρ = dy∘λ + y∘dλ. Of a fined constraint
dm = 0, and its price is one of θ: it takes the place of m. An upstream gradient on the objective itself needs no
solve: dJ*/dθ = ∂L/∂θ (envelope theorem); it enters as dp − J̄·p, dρ − J̄·ρ and dm − J̄·m below.

A logarithmic barrier −μ Σ log(u − u_min) + log(u_max − u) adds −μ/(u − u_min) + μ/(u_max − u) to g and its derivative
to R; no bound is then active, and the bounds get their gradients from these terms.
"""

import torch
from torch import Tensor

from difflcs._linalg import matvec
from difflcs.mpc.conditions import CERTIFIED, Multipliers, complete, multipliers, residual, within_prices
from difflcs.mpc.problem import MPCProblem
from difflcs.mpc.riccati import Linearisation, linearise, solve
from difflcs.mpc.solution import Primal

__all__ = ["CERTIFIED", "Linearisation", "Multipliers", "linearise", "multipliers", "polish", "residual", "vjp"]


def vjp(
    problem: MPCProblem, lin: Linearisation, grads: tuple[Tensor, Tensor, Tensor, Tensor], solved: Tensor
) -> dict[str, Tensor]:
    """Compute the gradients of every input for upstream gradients on x, u, λ and the objective.

    Args:
        problem: the problems.
        lin: `linearise` at their solutions.
        grads: upstream gradients on x (batch, H+1, n_x), u (batch, H, n_u), lam (batch, H, n_lam), objective (batch,).
        solved: (batch,) bool; elements that are not contribute exactly zero.

    Returns:
        One tensor per name in `INPUTS`, shaped like the input: summed over the batch where it is shared, and over the
        stages if they share it.
    """
    x_bar, u_bar, lam_bar, objective_bar = grads
    w = solve(problem, lin, x_bar, u_bar, lam_bar)
    dual, first = lin.multipliers, problem.stage(0)
    J = objective_bar[:, None, None]

    def keep(value: Tensor) -> Tensor:
        return torch.where(solved[:, None, None], value, torch.zeros_like(value))

    x, u, lam, m = (keep(v) for v in lin.primal)
    dx, du, dlam = keep(w.x), keep(w.u), keep(w.lam)
    p, rho = keep(dual.p[:, 1:]), keep(dual.rho)
    dp, drho, dm = keep(w.p - J * dual.p[:, 1:]), keep(w.rho - J * dual.rho), keep(w.mu - J * lin.primal.mu)
    x_now, dx_now, x_end, dx_end = x[:, :-1], dx[:, :-1], x[:, -1:], dx[:, -1:]
    J = keep(J)

    def outer(name: str, *pairs: tuple[Tensor, Tensor]) -> Tensor:
        # Σ over steps (and over the batch where shared) of left · rightᵀ.
        if problem.by_stage(name):
            left, right = (torch.stack(v, -1) for v in zip(*pairs, strict=True))
            if problem.shared(name):
                left, right = (v.movedim(0, -1).flatten(-2).unsqueeze(0) for v in (left, right))
            return left @ right.mT
        left, right = (torch.cat(v, 1) for v in zip(*pairs, strict=True))
        if problem.shared(name):
            left, right = left.flatten(0, 1), right.flatten(0, 1)
        return left.mT @ right

    def total(name: str, value: Tensor) -> Tensor:
        if problem.by_stage(name):
            return value.sum(0, keepdim=True) if problem.shared(name) else value
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
    x0_bar = matvec(first.A.mT, dp[:, 0]) + matvec(first.D.mT, drho[:, 0]) + matvec(first.S, du[:, 0])
    rows = {name: torch.zeros_like(getattr(problem, name)) for name in ("G_x", "G_u", "g", "price")}
    if problem.n_c:
        x0_bar = x0_bar + matvec(first.G_x.mT, dm[:, 0])
        # A fined constraint has price·c in the objective; any other has no term there.
        fine = keep(J * problem.constraints(lin.primal.x, lin.primal.u) - problem.rows(w.x, w.u))
        rows = {
            "G_x": -outer("G_x", (dm, x), (m, dx)),
            "G_u": -outer("G_u", (dm[:, :-1], u), (m[:, :-1], du)),
            "g": total("g", dm),
            "price": total("price", torch.where(lin.fined, fine, torch.zeros_like(fine))),
        }
    x0_cost = matvec(first.Q, x[:, 0]) + first.q + matvec(first.S, u[:, 0])
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
        "S": outer("S", (J * x_now - dx_now, u), (-x_now, du)),
        "Q_final": symmetric("Q_final", x_end, dx_end),
        "q": total("q", J * x_now - dx_now),
        "r": total("r", J * u - du),
        "q_final": total("q_final", J * x_end - dx_end),
        "u_min": total("u_min", lower_bar),
        "u_max": total("u_max", upper_bar),
        **rows,
        "x0": torch.where(solved[:, None], x_bar[:, 0] - x0_bar + J[:, 0] * x0_cost, torch.zeros_like(x0_cost)),
    }


# Residual below which a Newton step either halves it or has reached rounding.
_NEARLY_ROUNDED = 1e-8


def polish(problem: MPCProblem, primal: Primal, max_iter: int | None = None, tol: float = 1e-10) -> Primal:
    """Improve solutions to machine precision by Newton steps on the conditions, active bounds and constraints held.

    An interior-point solution is off by its barrier parameter, and finite differences of it and the envelope theorem
    are only as good as that. Actions held at a bound are put onto it, and constraints that are not held get their
    multiplier, zero or the price; then each step is the sensitivity solve with minus the reduced gradient upstream and
    minus the constraint where it is held. Every element keeps its best trajectory, which may be the first, and
    is left alone once its residual is below 1e-8 and a step no longer halves it: that is rounding.

    Args:
        problem: the problems.
        primal: nearly optimal trajectories.
        max_iter: limit of Newton steps, 6 if None, and 12 with constraints; two or three are usual, more if a
            constraint is hardly active.
        tol: residual at which an element is left alone.
    """
    primal = complete(problem, primal)
    zeros = torch.zeros_like(primal.x), torch.zeros_like(primal.lam)
    low, high = problem.bounds()
    lin = linearise(problem, primal)
    best, best_residual = primal, residual(problem, primal, lin.multipliers)
    u, mu = primal.u, primal.mu
    steps = max_iter if max_iter is not None else 12 if problem.n_c else 6
    open_ = torch.ones_like(best_residual, dtype=torch.bool)
    for step in range(steps + 1):
        open_ &= best_residual > tol
        if not bool(open_.any()):
            break
        if step > 0:
            off = -problem.constraints(lin.primal.x, lin.primal.u)
            w = solve(problem, lin, zeros[0], -lin.multipliers.gradient, zeros[1], off)
            u = lin.primal.u + w.u
            mu = within_prices(problem, torch.where(lin.held, lin.primal.mu + w.mu, lin.row_multipliers(problem)))
        if problem.barrier == 0:
            u = torch.where(lin.lower, low, u)
            u = torch.where(lin.upper, high, u)
        # With a barrier a step goes at most nine tenths of the way to a bound.
        u = problem.clip(u) if problem.barrier == 0 else problem.clip_inside(u, lin.primal.u)
        x, lam = problem.rollout(u)
        trial = Primal(x, u, lam, mu)
        lin = linearise(problem, trial)
        updated = lin.row_multipliers(problem)
        if not torch.equal(updated, mu):  # a constraint has left or joined the active ones
            trial = trial._replace(mu=updated)
            lin = linearise(problem, trial)
        trial_residual = residual(problem, trial, lin.multipliers)
        better = open_ & (trial_residual < best_residual)
        if step > 0:
            open_ &= (best_residual > _NEARLY_ROUNDED) | (trial_residual < 0.5 * best_residual)
        best = Primal(*(torch.where(better[:, None, None], a, b) for a, b in zip(trial, best, strict=True)))
        best_residual = torch.where(better, trial_residual, best_residual)
    return best
