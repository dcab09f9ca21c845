"""Optimality conditions of the LCS-MPC, derived in `difflcs.mpc.kkt`: multipliers, and how far they are violated."""

from dataclasses import dataclass

import torch
from torch import Tensor

from difflcs._linalg import matvec
from difflcs._native import TOLERANCES
from difflcs.mpc.problem import STAGES, MPCProblem, StageData
from difflcs.mpc.solution import Primal, largest

# Largest residual of a CONVERGED solution.
CERTIFIED = 1e-6
_AT_PRICE, _CANCELLED, _ANSWERED, _FURTHER = (
    TOLERANCES[name] for name in ("at_price", "cancelled", "answered", "further")
)


@dataclass(frozen=True)
class Multipliers:
    """Multipliers that stationarity assigns to a primal trajectory.

    Attributes:
        s: (batch, H, n_lam) slack of the complementarity.
        p: (batch, H+1, n_x) costates; p[:, 0] is dJ/dx0.
        y: (batch, H, n_lam) multipliers of λ∘s = ε.
        rho: (batch, H, n_lam) y∘λ.
        gradient: (batch, H, n_u) reduced gradient of the cost and the constraints with their multipliers.
    """

    s: Tensor
    p: Tensor
    y: Tensor
    rho: Tensor
    gradient: Tensor


@dataclass(frozen=True)
class Contact:
    """The LU factors of M at one stage, see the derivation; `size` is λ + s."""

    factors: Tensor
    pivots: Tensor
    size: Tensor

    def solve(self, right: Tensor) -> Tensor:
        """Compute M⁻¹ right for matrices."""
        return torch.linalg.lu_solve(self.factors, self.pivots, right)

    def solve_transposed(self, right: Tensor) -> Tensor:
        """Solve (diag s + Fᵀ diag λ) y = right, which is Mᵀ diag(λ+s) y = right."""
        return torch.linalg.lu_solve(self.factors, self.pivots, right.unsqueeze(-1), adjoint=True).squeeze(-1) / (
            self.size
        )


def complete(problem: MPCProblem, primal: Primal) -> Primal:
    """Fill in multipliers of the constraints, zero, if a trajectory has none."""
    return primal if primal.mu is not None else primal._replace(mu=problem.no_multipliers())


def stages_of(problem: MPCProblem) -> list[StageData]:
    """List the data of the stages 0 … H; one record for all if nothing varies."""
    if any(problem.by_stage(name) for name, stages in STAGES.items() if stages):
        return [problem.stage(k) for k in range(problem.horizon + 1)]
    return [problem.stage(0)] * (problem.horizon + 1)


def multipliers(problem: MPCProblem, primal: Primal) -> Multipliers:
    """Compute the multipliers of a trajectory by the backward recursion of the derivation."""
    return backward(problem, complete(problem, primal))[0]


def backward(problem: MPCProblem, primal: Primal) -> tuple[Multipliers, list[Contact]]:
    """Compute the multipliers, and the factors that eliminate λ at each stage."""
    x, u, lam, mu = primal
    steps, data = problem.steps(), stages_of(problem)
    s = steps.gap(*(v.transpose(0, 1) for v in (x[:, :-1], u, lam)))
    force = lam.transpose(0, 1)
    size = force + s
    b = force / size
    # a = s/(λ+s), not 1 − b, which has no digits left where λ is 1e10 times s.
    M = torch.diag_embed(s / size) + b.unsqueeze(-1) * steps.F
    factors, pivots, _ = torch.linalg.lu_factor_ex(M)
    contacts = [Contact(factors[k], pivots[k], size[k]) for k in range(problem.horizon)]
    crossed = bool(problem.S.any())
    p = [matvec(problem.Q_final, x[:, -1]) + problem.q_final]
    if problem.n_c:
        p[0] = p[0] + matvec(data[-1].G_x.mT, mu[:, -1])
    ys, rhos, gradients = [], [], []
    for k in reversed(range(problem.horizon)):
        at = data[k]
        y = contacts[k].solve_transposed(-matvec(at.C.mT, p[-1]))
        rho = y * lam[:, k]
        gradient = matvec(at.R, u[:, k]) + at.r + matvec(at.B.mT, p[-1]) + matvec(at.E.mT, rho)
        costate = matvec(at.Q, x[:, k]) + at.q + matvec(at.A.mT, p[-1]) + matvec(at.D.mT, rho)
        if crossed:
            gradient = gradient + matvec(at.S.mT, x[:, k])
            costate = costate + matvec(at.S, u[:, k])
        if problem.n_c:
            gradient = gradient + matvec(at.G_u.mT, mu[:, k])
            costate = costate + matvec(at.G_x.mT, mu[:, k])
        gradients.append(gradient)
        p.append(costate)
        ys.append(y)
        rhos.append(rho)
    p, y, rho, gradient = (torch.stack(v[::-1], 1) for v in (p, ys, rhos, gradients))
    if problem.barrier > 0:
        below, above = problem.distances(u)
        gradient = gradient + problem.barrier * (1 / above - 1 / below)
    return Multipliers(s.transpose(0, 1), p, y, rho, gradient), contacts


def residual(problem: MPCProblem, primal: Primal, dual: Multipliers) -> Tensor:
    """Compute the largest violation of the optimality conditions, (batch,); without units, infinite for NaN.

    A solution is CONVERGED where this is at most `CERTIFIED`. The maximum, over all steps and components, of:

    - dynamics: |x_{k+1} − (A x_k + B u_k + C λ_k + d)| in parts of Σ|terms|, the sum of the sizes of the terms of the
      right-hand side; likewise x_0 against x0;
    - complementarity: |λ∘s − ε| / (ε + 1e-7·λ·Σ|terms of s|), where the second part leaves room for the rounding of
      s = Dx + Eu + Fλ + c; and 1 where λ is not positive;
    - bounds: the distance of an action to them, in parts of its range u_max − u_min;
    - stationarity in λ: |Cᵀp + s∘y + Fᵀρ| in parts of its Σ|terms|;
    - stationarity in u: |u − clip(u − range·g/G)| / range, the part of its range by which the reduced gradient g would
      still move an action. G is the scale of g: the largest of its Σ|terms|, of range·(Rⱼⱼ + BⱼᵀQBⱼ), which is what
      its weights make of a step across the range, and of a thousandth of |Bⱼ|ᵀP + |Eⱼ|ᵀρ̂ + |Sⱼ|ᵀX, with the `sizes` of
      costates, forces' multipliers and states before they cancel. G does not vanish with the curvature, where flat
      directions count, nor with the costate, which at a vertex is zero but for rounding;
    - constraints: with c = G_x x + G_u u − g and its multiplier m, the size of c where 0 < m < price, that of its
      positive part where m = 0 and of its negative part where m = price, in parts of the row's unit, the largest
      Σ|terms of c| over the stages, or a thousandth of |G_x|X (`row_units`); and 1 where m is outside [0, price].

    An action with an infinite bound has no range; see `ranges` for what stands in its place.
    """
    primal = complete(problem, primal)
    x, u, lam = (v.transpose(0, 1) for v in primal[:3])  # steps first, so that per-element matrices broadcast
    p, y, rho = (v.transpose(0, 1) for v in (dual.p, dual.y, dual.rho))
    s, g = dual.s.transpose(0, 1), dual.gradient.transpose(0, 1)
    low, high = (v.expand_as(primal.u).transpose(0, 1) for v in problem.bounds())
    P = problem.steps()
    x_terms = _terms((P.A, x[:-1]), (P.B, u), (P.C, lam)) + P.d.abs()
    s_terms = _terms((P.D, x[:-1]), (P.E, u), (P.F, lam)) + P.c.abs()
    lam_row = matvec(P.C.mT, p[1:]) + s * y + matvec(P.F.mT, rho)
    lam_terms = _terms((P.C.mT, p[1:]), (P.F.mT, rho)) + (s * y).abs()
    u_terms = gradient_terms(problem, primal, dual).transpose(0, 1)
    width, fixed = ranges(problem, primal.u).transpose(0, 1), high <= low
    scale = torch.maximum(u_terms, width * curvature_at_rest(problem))
    unit = torch.where(width > 0, width, torch.ones_like(width))
    moved = torch.minimum(_parts(g, scale), torch.where(g > 0, u - low, high - u) / unit).clamp_min(0.0)
    violations = [
        _parts(x[0] - problem.x0, problem.x0.abs()).unsqueeze(0),
        _parts(x[1:] - P.next_state(x[:-1], u, lam), x_terms),
        (lam * s - problem.relaxation).abs() / (problem.relaxation + 1e-7 * lam.abs() * s_terms),
        (~(lam > 0)).to(lam.dtype),
        torch.maximum(low - u, u - high).clamp_min(0.0) / unit,
        _parts(lam_row, lam_terms),
        torch.where(fixed, torch.zeros_like(moved), moved) + 0 * g,
    ]
    if problem.n_c:
        violations += _row_violations(problem, primal)
    worst = torch.stack([v.amax((0, 2)) for v in violations if v.shape[2]]).amax(0)  # amax keeps NaN
    return torch.nan_to_num(worst, nan=torch.inf)


def _row_violations(problem: MPCProblem, primal: Primal) -> list[Tensor]:
    mu, price = primal.mu.transpose(0, 1), problem.steps().price
    c = problem.constraints(primal.x, primal.u).transpose(0, 1)
    off = torch.where(mu <= 0, c.clamp_min(0.0), torch.where(mu >= _AT_PRICE * price, (-c).clamp_min(0.0), c.abs()))
    return [_parts(off, row_units(problem, primal)) + 0 * mu, ((mu < 0) | (mu * _AT_PRICE > price)).to(mu.dtype)]


def row_units(problem: MPCProblem, primal: Primal) -> Tensor:
    """Compute the unit (batch, n_c) in which the violation of each constraint is measured.

    It is the largest Σ|terms| over the stages; at least a thousandth of that without cancellation in the states, plus a
    millionth of the row's change by the actions' ranges in a step, which counts beside a wall at zero.
    """
    P, x, u = problem.steps(), primal.x.transpose(0, 1), primal.u.transpose(0, 1)
    terms = _terms((P.G_x, x)) + P.g.abs()
    whole = _terms((P.G_x, state_sizes(problem, primal))) + _CANCELLED * _reach(problem, primal)
    terms[:-1] += _terms((P.G_u, u))
    terms = torch.maximum(terms, _CANCELLED * whole)
    return torch.where(torch.isinf(P.g), torch.zeros_like(terms), terms).amax(0)


def excess(problem: MPCProblem, primal: Primal) -> Tensor:
    """Compute the largest violation (batch,) of the hard constraints, in their rows' units; 0 if they hold."""
    if problem.n_c == 0:
        return torch.zeros(problem.batch, dtype=torch.float64)
    return largest(_parts(_overshoot(problem, primal), row_units(problem, primal)))


def certainly_missed(problem: MPCProblem, primal: Primal) -> Tensor:
    """Return whether a hard constraint is violated by more than rounding, (batch,).

    The threshold is `CERTIFIED` of the row's unit plus its largest change by the actions in a step: if all terms of a
    row vanish, as beside a wall at zero, a rounding error is as large as its unit.
    """
    reach = _reach(problem, primal)
    reach = torch.where(torch.isinf(problem.steps().g), torch.zeros_like(reach), reach)
    unit = row_units(problem, primal) + reach.amax(0)
    return largest(_parts(_overshoot(problem, primal), unit)) > CERTIFIED


def _reach(problem: MPCProblem, primal: Primal) -> Tensor:
    """Compute the largest change of each row by the actions' ranges in a step, (H+1, batch, n_c)."""
    P, width = problem.steps(), ranges(problem, primal.u).transpose(0, 1)
    moved = matvec(P.B.abs(), width)
    reach = _terms((P.G_x, torch.cat([torch.zeros_like(moved[:1]), moved])))
    reach[:-1] += _terms((P.G_u, width))
    return reach


def _overshoot(problem: MPCProblem, primal: Primal) -> Tensor:
    """Compute the violation of each hard constraint, (H+1, batch, n_c); 0 for the others."""
    value = problem.constraints(primal.x, primal.u)
    return torch.where(torch.isinf(prices(problem)), value, 0.0).clamp_min(0.0).transpose(0, 1)


def prices(problem: MPCProblem) -> Tensor:
    """Return the price of a violation of each constraint, (batch, H+1, n_c)."""
    return problem.batch_first("price").expand(problem.batch, problem.horizon + 1, problem.n_c)


def within_prices(problem: MPCProblem, mu: Tensor) -> Tensor:
    """Clip multipliers of the constraints (batch, H+1, n_c) into [0, price]."""
    return torch.minimum(mu.clamp_min(0.0), prices(problem))


def ranges(problem: MPCProblem, u: Tensor) -> Tensor:
    """Compute the range u_max − u_min of each action, (batch, H, n_u).

    If it is infinite: the largest size of the action over the stages, or that of its finite bound if larger.
    """
    low, high = problem.bounds()
    width = high - low
    if not bool(torch.isinf(width).any()):
        return width.expand_as(u)
    finite = [torch.where(torch.isinf(v), torch.zeros_like(v), v).abs() for v in (low, high)]
    size = torch.maximum(u.abs().amax(1, keepdim=True), torch.maximum(*finite))
    return torch.where(torch.isinf(width), size, width).expand_as(u)


def gradient_terms(problem: MPCProblem, primal: Primal, dual: Multipliers) -> Tensor:
    """Compute Σ|terms| (batch, H, n_u) of the reduced gradient, at least a thousandth of that without cancellation."""
    P = problem.steps()
    u, p, rho = (v.transpose(0, 1) for v in (primal.u, dual.p[:, 1:], dual.rho))
    X, costates, forces = sizes(problem, primal, dual)
    terms = _terms((P.R, u), (P.B.mT, p), (P.E.mT, rho)) + P.r.abs()
    whole = _terms((P.B.mT, costates), (P.E.mT, forces))
    if bool(problem.S.any()):
        terms = terms + _terms((P.S.mT, primal.x[:, :-1].transpose(0, 1)))
        whole = whole + _terms((P.S.mT, X))
    if problem.n_c:
        terms = terms + _terms((P.G_u.mT, primal.mu[:, :-1].transpose(0, 1)))
    terms = torch.maximum(terms, _CANCELLED * whole).transpose(0, 1)
    if problem.barrier > 0:
        below, above = problem.distances(primal.u)
        terms = terms + problem.barrier * (1 / below + 1 / above)
        # Next to a bound the barrier is so steep that rounding u moves g.
        width = ranges(problem, primal.u)
        terms = terms + 1e-8 * problem.barrier * width * (below.square().reciprocal() + above.square().reciprocal())
    return terms


def sizes(problem: MPCProblem, primal: Primal, dual: Multipliers) -> tuple[Tensor, Tensor, Tensor]:
    """Compute sizes of the states x_k (H, batch, n_x), costates p_{k+1} (H, batch, n_x) and ρ_k (H, batch, n_lam).

    At a vertex of the constraints a costate may be zero although the terms that it sums are not, or although theirs are
    not. So a size is the largest of: Σ|terms| of the number; the size at the next stage (of a state: the previous one);
    a tenth of |A| times the sizes there, or of the contact's response to the terms there. Along a chain of integrators
    it reaches as far as their rounding does. It grows along the horizon only with the numbers, or if A exceeds ten.
    A contact's response counts 1e-5 of itself: beside a nearly singular F it is so large that only rounding is left.
    """
    X, steps, data = state_sizes(problem, primal), problem.steps(), stages_of(problem)
    u, lam, p, rho, s = (v.transpose(0, 1) for v in (primal.u, primal.lam, dual.p, dual.rho, dual.s))
    # Response of ρ to a unit of Cᵀp, at most that of its contact by itself, times _ANSWERED.
    response = _ANSWERED * (lam / (s + lam * steps.F.abs().sum(-1))).abs()
    stage_terms = _terms((steps.Q, X[:-1]), (steps.A.mT, p[1:]), (steps.D.mT, rho), (steps.S, u)) + steps.q.abs()
    terms = matvec(problem.Q_final.abs(), X[-1]) + problem.q_final.abs()
    if problem.n_c:
        row_terms = _terms((steps.G_x.mT, primal.mu.transpose(0, 1)))
        stage_terms, terms = stage_terms + row_terms[:-1], terms + row_terms[-1]
    size, costates, forces = terms, [], []
    for k in reversed(range(problem.horizon)):
        A, C, D = (getattr(data[k], name).abs().mT for name in "ACD")
        costates.append(size)
        forces.append(response[k] * matvec(C, size))
        further = torch.maximum(matvec(A, size), matvec(D, response[k] * matvec(C, terms)))
        terms = stage_terms[k]
        size = torch.maximum(torch.maximum(terms, size), _FURTHER * further)
    return X[:-1], torch.stack(costates[::-1]), torch.stack(forces[::-1])


def state_sizes(problem: MPCProblem, primal: Primal) -> Tensor:
    """Compute the sizes of the states (H+1, batch, n_x), see `sizes`."""
    P, x, lam, data = problem.steps(), primal.x.transpose(0, 1), primal.lam.transpose(0, 1), stages_of(problem)
    terms = _terms((P.A, x[:-1]), (P.B, primal.u.transpose(0, 1)), (P.C, lam)) + P.d.abs()
    result = [x[0].abs()]
    for k, term in enumerate(terms):
        further = _FURTHER * matvec(data[k].A.abs(), result[-1])
        result.append(torch.maximum(torch.maximum(term, result[-1]), further))
    return torch.stack(result)


def curvature_at_rest(problem: MPCProblem) -> Tensor:
    """Compute each action's curvature from its weight and the next state's, broadcasting with (H, batch, n_u)."""
    data = stages_of(problem)

    def curvature(k: int) -> Tensor:
        at, weight = data[k], problem.Q_final if k == problem.horizon - 1 else data[k + 1].Q
        return at.R.diagonal(dim1=-2, dim2=-1) + (at.B * (weight @ at.B)).sum(-2)

    if data[0] is data[-1]:
        return _stack([curvature(0)] * (problem.horizon - 1) + [curvature(problem.horizon - 1)])
    return _stack([curvature(k) for k in range(problem.horizon)])


def _stack(values: list[Tensor]) -> Tensor:
    """Stack stages (n,) or (batch, n) into (H, 1 or batch, n)."""
    values = [v if v.ndim == 2 else v.unsqueeze(0) for v in values]
    return torch.stack(torch.broadcast_tensors(*values))


def _terms(*products: tuple[Tensor, Tensor]) -> Tensor:
    """Compute Σ|terms| of a sum of products of a matrix and a vector."""
    first, *rest = (matvec(matrix.abs(), vector.abs()) for matrix, vector in products)
    return sum(rest, first)


def _parts(value: Tensor, terms: Tensor) -> Tensor:
    return value.abs() / torch.where(terms > 0, terms, torch.ones_like(terms))
