"""Backend `relaxed`: a convex program instead of the complementarity problem, through cvxpylayers."""

from __future__ import annotations

import atexit
import threading
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from difflcs._checks import check_number, check_threads, describe, make_plain
from difflcs._linalg import matvec
from difflcs.errors import DTypeError
from difflcs.lcp import solve_lcp
from difflcs.mpc.backends.base import Backend, Result, check_plain, replace_failed
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.mpc.solution import Primal
from difflcs.status import Status

if TYPE_CHECKING:
    from cvxpylayers.torch import CvxpyLayer  # pyright: ignore[reportPrivateImportUsage]


@dataclass(frozen=True)
class _Graph:
    index: Tensor  # batch elements of this call
    parameters: list[Tensor]  # leaves, in the order of `_parameters`
    outputs: tuple[Tensor, ...]  # x, u, λ, multiplier of s ≥ 0; functions of the leaves


@dataclass(frozen=True)
class _Pass:
    """One convex program and the graphs through which cvxpylayers differentiates it, one per call of the layer."""

    nominal: Tensor  # (batch, H, n_u)
    penalty: float
    graphs: tuple[_Graph, ...]
    plan: Primal
    residual: Tensor  # (batch,)


@dataclass(frozen=True)
class RelaxedResult(Result):
    """A `Result` with the convex programs that led to it.

    Attributes:
        passes: the convex programs, in their order.
    """

    passes: tuple[_Pass, ...] = ()


@dataclass(frozen=True)
class RelaxedBackend(Backend):
    """A convex quadratic program in place of the LCS-MPC, solved and differentiated by cvxpylayers (DIFFCP, Clarabel).

    Dynamics, bounds, λ ≥ 0 and s ≥ 0 stay; λ∘s = relaxation becomes a penalty on its linearisation around the nominal
    trajectory (x̄, ū, λ̄, s̄) that the actions ū cause in the true system:

        min  J(x, u) + ½ Σ_k Σ_i w_ki (α_ki λ̃_ki + β_ki s̃_ki − γ_ki)²
        s.t. x_{k+1} = A x_k + B u_k + C λ_k + d,  s_k = D x_k + E u_k + F λ_k + c,
             λ_k, s_k ≥ 0,  u_min ≤ u_k ≤ u_max,
        α = s̃̄/(λ̃̄ + s̃̄),  β = λ̃̄/(λ̃̄ + s̃̄),  γ = α λ̃̄ + β s̃̄,  λ̃_i = λ_i √F_ii,  s̃_i = s_i/√F_ii,
        w_ki = penalty · C_iᵀ ((H−1−k) Q + Q_final) C_i / F_ii + 0.01.

    An open contact (s̄ > λ̄ ≈ 0) is pulled towards λ = 0, a closed one towards s = 0; to switch has a price. w is what
    an error of one λ̃_i would cost if it stayed in the state to the end, so that the penalty depends on no unit; 0.01
    makes a λ unique that moves no state. The program is always feasible, since F + Fᵀ ≻ 0.

    The first pass has ū = 0 and a small penalty, which lets it make contacts; each further pass has another penalty and
    as ū the plan before it. With a guess there is one pass, the last, with the guess's actions as ū: `mpc(x0,
    guess=solution)` is one more pass.

    It takes one system and cost for all stages, finite bounds, n_lam ≥ 1, no S, no constraints. S gets gradient zero.

    Its plans are not those of the exact backends (`exact` is False): x and λ solve the program, not the LCS.
    Executed in synthetic pushing models, they cost 3 % more than those of `batched` (docs/archive/older_results.md). A
    solve takes 200 to 300 times as long: this backend is for comparison, not for speed.

    Gradients are cvxpylayers' for the program's parameters, chained by torch through the nominal trajectory and the
    passes; they are those of the whole map, a guess held. Q, R and Q_final must enter cvxpy as square roots, whose
    derivative is infinite where they are singular; their gradient is taken from the linear terms instead: a change dQ
    acts on the solution x like the change dQ·x of q. diffcp differentiates a dense matrix; its default, LSQR, did not
    converge on these programs.

    The solver's plan is polished by Newton steps on the program itself. `iterations` counts the passes.

    Attributes:
        penalties: price, in each pass, of leaving the linearised complementarity, relative to the cost of the error
            that it makes.
        residual_tol: largest `kkt_residual` that counts as converged; any other element is NUMERICAL. The residual is
            that of the convex program: the largest of negative s, min(s, multiplier of s ≥ 0) and the projected
            gradient in (u, λ), the last two divided by the largest gradient of the cost in x where that exceeds 1.
            Dynamics, bounds and λ ≥ 0 hold exactly.
        tol: tolerance of the solver itself.
        threads: threads to use; torch's number if None.
    """

    name: ClassVar[str] = "relaxed"
    exact: ClassVar[bool] = False
    requires: ClassVar[tuple[str, ...]] = ("cvxpy", "cvxpylayers")
    install: ClassVar[str] = 'pip install "difflcs[relaxed]"'

    penalties: tuple[float, ...] = (1.0, 100.0)
    residual_tol: float = 1e-6
    tol: float = 1e-10
    threads: int | None = None

    def __post_init__(self) -> None:
        make_plain(self)
        if not isinstance(self.penalties, tuple) or not self.penalties:
            raise DTypeError(f"penalties: expected a tuple of numbers, one per pass, got {describe(self.penalties)}")
        for value in self.penalties:
            check_number("penalties", value)
        for name in ("residual_tol", "tol"):
            check_number(name, getattr(self, name), strict=True)
        check_threads(self.threads)

    def solve(self, problem: MPCProblem, guess: Primal | None) -> RelaxedResult:
        """Solve one pass per penalty, or only the last with a guess.

        Raises:
            InvalidInputError: the problem has what the convex program does not have, see `check_plain`.
        """
        check_plain(problem, self.name)
        started = time.perf_counter()
        batch = problem.batch
        zero = torch.zeros(batch, problem.horizon, problem.n_u, dtype=torch.float64)
        nominal = zero if guess is None else torch.nan_to_num(guess.u, posinf=0.0, neginf=0.0)
        failed = torch.zeros(batch, dtype=torch.bool)
        passes: list[_Pass] = []
        for penalty in self.penalties if guess is None else self.penalties[-1:]:
            passes.append(self._pass(problem, nominal, penalty))
            failed |= ~(passes[-1].residual <= self.residual_tol)
            primal = replace_failed(problem, passes[-1].plan, failed)
            nominal = primal.u
        residual = passes[-1].residual
        return RelaxedResult(
            primal=primal,
            status=torch.where(failed, int(Status.NUMERICAL), int(Status.CONVERGED)).to(torch.int8),
            iterations=torch.full((batch,), len(passes), dtype=torch.int32),
            kkt_residual=torch.nan_to_num(residual, nan=torch.finfo(residual.dtype).max),
            solve_time=torch.full((batch,), (time.perf_counter() - started) / max(batch, 1), dtype=torch.float64),
            passes=tuple(passes),
        )

    def vjp(
        self, problem: MPCProblem, result: Result, grads: tuple[Tensor, Tensor, Tensor, Tensor], solved: Tensor
    ) -> dict[str, Tensor]:
        """Compute the gradients: cvxpylayers' for each pass's parameters, then torch's for the inputs, backwards."""
        assert isinstance(result, RelaxedResult)
        index = torch.nonzero(solved).squeeze(-1)
        inputs = {name: getattr(problem, name).clone().requires_grad_() for name in INPUTS}
        with torch.enable_grad():  # unsolved elements may hold infinities: they take no part
            part = {k: v if problem.shared(k) else v[index] for k, v in inputs.items()}
            x, u = (v[index].requires_grad_() for v in result.primal[:2])
            objective = replace(problem, **part).objective(x, u)
        *total, x_bar, u_bar = _pull([objective], [*inputs.values(), x, u], [grads[3][index]])
        upstream = [v.clone() for v in grads[:3]]
        upstream[0][index] += x_bar
        upstream[1][index] += u_bar
        for step in reversed(result.passes):
            nominal = step.nominal[index].requires_grad_()
            plan = Primal(*(v[index] for v in step.plan))
            with torch.enable_grad():
                parameters = _parameters(part, nominal, problem.relaxation, step.penalty, plan)
            bars = [v.new_zeros(problem.batch, *v.shape[1:]) for v in parameters]
            for graph in step.graphs:
                seeds = [v[graph.index] for v in upstream]
                with _quiet(), _interruptible():
                    parts = torch.autograd.grad(graph.outputs[:3], graph.parameters, seeds, retain_graph=True)
                for bar, value in zip(bars, parts, strict=True):
                    bar[graph.index] = value
            *more, nominal_bar = _pull(parameters, [*inputs.values(), nominal], [bar[index] for bar in bars])
            total = [a + b for a, b in zip(total, more, strict=True)]
            upstream = [torch.zeros_like(v) for v in upstream]
            upstream[1][index] = nominal_bar
        gradients = dict(zip(INPUTS, total, strict=True))
        return {k: 0.5 * (v + v.mT) if k in ("Q", "R", "Q_final") else v for k, v in gradients.items()}

    def _pass(self, problem: MPCProblem, nominal: Tensor, penalty: float) -> _Pass:
        """Solve the batch in one call of the layer; element by element where that raises."""
        start = problem.start(nominal)
        x, lam = problem.rollout(start)
        inputs = {name: getattr(problem, name) for name in INPUTS}
        parameters = _parameters(
            inputs, nominal, problem.relaxation, penalty, Primal(x, start, lam, problem.no_multipliers())
        )
        layer = _layer(problem.n_x, problem.n_u, problem.n_lam, problem.horizon, problem.barrier)
        usable = torch.stack([torch.isfinite(v).flatten(1).all(1) for v in parameters]).all(0)
        index = torch.nonzero(usable).squeeze(-1)
        graphs = self._call(layer, parameters, index) if len(index) else ()
        if not graphs and len(index) > 1:
            graphs = tuple(graph for i in index for graph in self._call(layer, parameters, i.reshape(1)))
        u, lam, mu = (torch.full_like(v, torch.nan) for v in (start, lam, lam))
        for graph in graphs:
            for whole, value in zip((u, lam, mu), graph.outputs[1:], strict=True):
                whole[graph.index] = value.detach()
        plan, residual = _polish(problem, u, lam, mu, *parameters[-3:])
        return _Pass(nominal, penalty, graphs, plan, residual)

    def _call(self, layer: CvxpyLayer, parameters: list[Tensor], index: Tensor) -> tuple[_Graph, ...]:
        """Call the layer once; return nothing if the solver raises."""
        leaves = [v[index].requires_grad_() for v in parameters]
        threads = self.threads or torch.get_num_threads()
        options = {
            "solve_method": "Clarabel",
            "mode": "dense",
            "n_jobs_forward": threads,
            "n_jobs_backward": threads,
            "tol_gap_abs": self.tol,
            "tol_gap_rel": self.tol,
            "tol_feas": self.tol,
        }
        try:
            with torch.enable_grad(), _quiet(), _interruptible():
                outputs = layer(*leaves, solver_args=options)
        except Exception:  # whatever a solver raises stays with its elements
            return ()
        return (_Graph(index, leaves, outputs),)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run torch on one thread: with two, the tiny batched products took 20 times as long on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Join diffcp's threads at exit after Ctrl-C: they finish their element and would abort an ended interpreter."""
    before = set(threading.enumerate())
    try:
        yield
    except KeyboardInterrupt:
        for thread in set(threading.enumerate()) - before:
            atexit.register(thread.join)
        raise


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide the one warning that cvxpylayers 1.2 causes with NumPy 2 at every call."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "__array__ implementation doesn't accept a copy", DeprecationWarning)
        yield


# Weight that makes λ unique where it moves no state. At 1e-3 diffcp's gradient of such a λ is off by 1 % and more.
_TIE = 1e-2
_STEPS = 3  # of Newton, to polish a plan
_PLAIN = ("A", "B", "C", "d", "D", "E", "F", "c", "u_min", "u_max", "x0")


def _weights(horizon: int) -> tuple[str, ...]:
    """List the weights that act on an action or on a state after x0."""
    return ("Q", "R", "Q_final") if horizon > 1 else ("R", "Q_final")


@lru_cache(maxsize=32)
def _layer(n_x: int, n_u: int, n_lam: int, horizon: int, barrier: float) -> CvxpyLayer:
    """Build the program with the parameters of `_parameters`; once for each size."""
    import cvxpy as cp
    from cvxpylayers.torch import CvxpyLayer  # pyright: ignore[reportPrivateImportUsage]

    sizes = {"n_x": n_x, "n_u": n_u, "n_lam": n_lam}
    names = (*_PLAIN, *_weights(horizon))
    p = {name: cp.Parameter(tuple(sizes[dim] for dim in INPUTS[name]), name=name) for name in names}
    x_linear, u_linear = cp.Parameter((horizon, n_x)), cp.Parameter((horizon, n_u))
    x_centre, u_centre = cp.Parameter((horizon, n_x)), cp.Parameter((horizon, n_u))
    alpha, beta, gamma = (cp.Parameter((horizon, n_lam)) for _ in range(3))
    x, u = cp.Variable((horizon + 1, n_x)), cp.Variable((horizon, n_u))
    lam, s = cp.Variable((horizon, n_lam)), cp.Variable((horizon, n_lam))

    positive = s >= 0
    constraints = [x[0] == p["x0"], positive, lam >= 0]
    squares = [cp.multiply(alpha, lam) + cp.multiply(beta, s) - gamma]
    cost = cp.sum(cp.multiply(x_linear, x[1:])) + cp.sum(cp.multiply(u_linear, u))
    for k in range(horizon):
        constraints += [
            x[k + 1] == p["A"] @ x[k] + p["B"] @ u[k] + p["C"] @ lam[k] + p["d"],
            s[k] == p["D"] @ x[k] + p["E"] @ u[k] + p["F"] @ lam[k] + p["c"],
            u[k] >= p["u_min"],
            u[k] <= p["u_max"],
        ]
        root = p["Q_final" if k == horizon - 1 else "Q"]
        squares += [root.T @ x[k + 1] - x_centre[k], p["R"].T @ u[k] - u_centre[k]]
        if barrier > 0:
            cost -= barrier * cp.sum(cp.log(u[k] - p["u_min"]) + cp.log(p["u_max"] - u[k]))
    cost += 0.5 * cp.sum_squares(cp.hstack([cp.vec(v, order="C") for v in squares]))
    used = [p[name] for name in names]
    return CvxpyLayer(
        cp.Problem(cp.Minimize(cost), constraints),
        parameters=[*used, x_linear, u_linear, x_centre, u_centre, alpha, beta, gamma],
        variables=[x, u, lam, positive.dual_variables[0]],
        # Not MOREAU: cvxpylayers 1.2 with it drops `lam >= 0` in silence.
        solver="DIFFCP",
    )


@_one_thread()
def _parameters(
    inputs: Mapping[str, Tensor], nominal: Tensor, relaxation: float, penalty: float, centre: Primal
) -> list[Tensor]:
    """Compute the layer's parameters (batch, ...) from the inputs; differentiable, Q, R, Q_final around `centre` only.

    The quadratic cost enters as ½‖L(z − centre)‖² + (Q·centre + q)ᵀz, which differs from ½zᵀQz + qᵀz by a constant.
    """
    batch, horizon, _ = nominal.shape
    t = {name: v.expand(batch, *v.shape[v.ndim - len(INPUTS[name]) :]) for name, v in inputs.items()}
    alpha, beta, gamma = _linearise(t, nominal, relaxation, penalty)
    weights = [t["Q"]] * (horizon - 1) + [t["Q_final"]]
    linear = [t["q"]] * (horizon - 1) + [t["q_final"]]
    x_linear = torch.stack([matvec(W, centre.x[:, k + 1]) + linear[k] for k, W in enumerate(weights)], 1)
    u_linear = torch.stack([matvec(t["R"], v) + t["r"] for v in centre.u.unbind(1)], 1)
    roots = {name: _root(t[name].detach()) for name in _weights(horizon)}
    x_roots = [roots["Q"] for _ in range(horizon - 1)] + [roots["Q_final"]]
    x_centre = torch.stack([matvec(L.mT, centre.x[:, k + 1]) for k, L in enumerate(x_roots)], 1)
    u_centre = torch.stack([matvec(roots["R"].mT, v) for v in centre.u.unbind(1)], 1)
    plain = [t[name] for name in _PLAIN]
    return [*plain, *roots.values(), x_linear, u_linear, x_centre, u_centre, alpha, beta, gamma]


def _linearise(
    t: Mapping[str, Tensor], nominal: Tensor, relaxation: float, penalty: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the weighted rows α∘λ + β∘s − γ of the penalty, each (batch, H, n_lam)."""
    u = torch.minimum(torch.maximum(nominal, t["u_min"].unsqueeze(1)), t["u_max"].unsqueeze(1))
    horizon = nominal.shape[1]
    unit = t["F"].diagonal(dim1=-2, dim2=-1).sqrt()
    x, rows = t["x0"], []
    for k in range(horizon):
        gap = matvec(t["D"], x) + matvec(t["E"], u[:, k]) + t["c"]
        lam = solve_lcp(t["F"], gap, relaxation=relaxation).lam
        force, slack = lam * unit, relaxation / (lam * unit)
        W = (horizon - 1 - k) * t["Q"] + t["Q_final"]
        moved = (t["C"] * (W @ t["C"])).sum(-2) / unit.square()
        weight = (penalty * moved + _TIE).sqrt() / (force + slack)
        rows.append((weight * slack * unit, weight * force / unit, weight * 2 * relaxation))
        x = matvec(t["A"], x) + matvec(t["B"], u[:, k]) + matvec(t["C"], lam) + t["d"]
    alpha, beta, gamma = (torch.stack(v, 1) for v in zip(*rows, strict=True))
    return alpha, beta, gamma


@_one_thread()
def _pull(outputs: list[Tensor], inputs: list[Tensor], bars: list[Tensor]) -> list[Tensor]:
    """Compute the gradients of the inputs, zero where nothing depends on one."""
    pairs = [(v, bar) for v, bar in zip(outputs, bars, strict=True) if v.requires_grad]
    values, upstream = zip(*pairs, strict=True)
    return list(
        torch.autograd.grad(values, inputs, upstream, retain_graph=True, allow_unused=True, materialize_grads=True)
    )


def _root(matrix: Tensor) -> Tensor:
    """Compute L with L Lᵀ = matrix, for a positive semi-definite one that may be singular."""
    values, vectors = torch.linalg.eigh(matrix)
    return vectors * values.clamp_min(0.0).sqrt().unsqueeze(-2)


@_one_thread()
def _polish(problem: MPCProblem, u: Tensor, lam: Tensor, mu: Tensor, *row: Tensor) -> tuple[Primal, Tensor]:
    """Improve a plan by Newton steps on the program with its active bounds held; each element keeps its best point.

    A conic solver is accurate only to its tolerance, which shows in difference quotients.

    Args:
        problem: the problems.
        u: (batch, H, n_u) solver's actions.
        lam: (batch, H, n_lam) solver's λ.
        mu: (batch, H, n_lam) solver's multiplier of s ≥ 0.
        row: α, β, γ of the penalty.

    Returns:
        The trajectory with exact dynamics, bounds and λ ≥ 0, and its residual (batch,), NaN where the solver gave none.
    """
    best = point = _Point.at(problem, u, lam, mu, *row)
    for _ in range(_STEPS):
        point = _Point.at(problem, *point.newton(problem), *row)
        better = point.residual < best.residual
        primal = (torch.where(better[:, None, None], a, b) for a, b in zip(point.primal, best.primal, strict=True))
        best = replace(best, primal=Primal(*primal), residual=torch.where(better, point.residual, best.residual))
    return best.primal, best.residual


@dataclass(frozen=True)
class _Point:
    """The program in z = (u, λ) alone, at one point: x and s are affine in z."""

    primal: Primal
    mu: Tensor  # (batch, H·n_lam) multiplier of s ≥ 0
    s: Tensor  # (batch, H·n_lam)
    S: Tensor  # (batch, H·n_lam, n) ds/dz
    gradient: Tensor  # (batch, n) of the cost with penalty
    hessian: Tensor  # (batch, n, n) of the same
    low: Tensor  # (batch, n) bounds of z
    high: Tensor
    residual: Tensor  # (batch,)

    @classmethod
    def at(
        cls, problem: MPCProblem, u: Tensor, lam: Tensor, mu: Tensor, alpha: Tensor, beta: Tensor, gamma: Tensor
    ) -> _Point:
        batch, H, n_x, n_u, n_lam = problem.batch, problem.horizon, problem.n_x, problem.n_u, problem.n_lam
        u, lam = problem.clip(u), lam.clamp_min(0.0)
        n = H * (n_u + n_lam)
        gradient, hessian = (torch.zeros(batch, *size, dtype=torch.float64) for size in ((n,), (n, n)))
        X = torch.zeros(batch, n_x, n, dtype=torch.float64)  # dx/dz
        x, slacks, slopes, size = [problem.x0], [], [], torch.ones(batch, dtype=torch.float64)
        for k in range(H):
            in_u = slice(k * n_u, (k + 1) * n_u)
            in_lam = slice(H * n_u + k * n_lam, H * n_u + (k + 1) * n_lam)
            s, S = problem.gap(x[k], u[:, k], lam[:, k]), problem.D @ X
            S[:, :, in_u] += problem.E
            S[:, :, in_lam] += problem.F
            row = beta[:, k, :, None] * S
            row[:, :, in_lam] += torch.diag_embed(alpha[:, k])
            x.append(problem.next_state(x[k], u[:, k], lam[:, k]))
            X = problem.A @ X
            X[:, :, in_u] += problem.B
            X[:, :, in_lam] += problem.C
            last = k == H - 1
            Q, q = (problem.Q_final, problem.q_final) if last else (problem.Q, problem.q)
            state_gradient = matvec(Q, x[-1]) + q
            gradient += matvec(X.mT, state_gradient)
            gradient += matvec(row.mT, alpha[:, k] * lam[:, k] + beta[:, k] * s - gamma[:, k])
            gradient[:, in_u] += matvec(problem.R, u[:, k]) + problem.r
            hessian += X.mT @ (Q @ X) + row.mT @ row
            hessian[:, in_u, in_u] += problem.R
            slacks.append(s)
            slopes.append(S)
            size = torch.maximum(size, state_gradient.abs().amax(-1))
        if problem.barrier > 0:
            below, above = (v.flatten(1) for v in problem.distances(u))
            gradient[:, : H * n_u] += problem.barrier * (1 / above - 1 / below)
            hessian.diagonal(dim1=1, dim2=2)[:, : H * n_u] += problem.barrier * (1 / below**2 + 1 / above**2)
        s, S, mu = torch.cat(slacks, -1), torch.cat(slopes, 1), mu.flatten(1)
        low, high = (v.unsqueeze(-2).expand(batch, H, n_u).flatten(1) for v in (problem.u_min, problem.u_max))
        none = torch.zeros_like(mu)
        low, high = torch.cat([low, none], 1), torch.cat([high, none + torch.inf], 1)
        z = torch.cat([u.flatten(1), lam.flatten(1)], 1)
        projected = z - (z - gradient + matvec(S.mT, mu)).clamp(low, high)
        worst = torch.cat([projected, torch.minimum(s, mu)], 1).abs().amax(-1) / size
        residual = torch.maximum(worst, (-s).amax(-1))
        primal = Primal(torch.stack(x, 1), u, lam, problem.no_multipliers())
        return cls(primal, mu, s, S, gradient, hessian, low, high, residual)

    def newton(self, problem: MPCProblem) -> tuple[Tensor, Tensor, Tensor]:
        """Compute u, λ and multiplier of s ≥ 0 that solve the program if its active constraints are those here."""
        z = torch.cat([self.primal.u.flatten(1), self.primal.lam.flatten(1)], 1)
        in_u = self.primal.u.shape[1] * self.primal.u.shape[2]
        # By Newton's step of one coordinate, so that units do not decide what is active.
        h = self.hessian.diagonal(dim1=1, dim2=2).clamp_min(torch.finfo(torch.float64).tiny)
        moved = z - (self.gradient - matvec(self.S.mT, self.mu)) / h
        held = (moved <= self.low) | (moved >= self.high)
        bound = torch.where(moved <= self.low, self.low, self.high)
        touching = self.s < self.mu * (self.S.square() / h.unsqueeze(1)).sum(-1)
        n, m = z.shape[1], self.s.shape[1]
        K = torch.zeros(len(z), n + m, n + m, dtype=torch.float64)
        K[:, :n, :n], K[:, :n, n:], K[:, n:, :n] = self.hessian, -self.S.mT, self.S
        right = torch.cat([-self.gradient, -self.s], 1)
        # Rows of held z give the step to its bound, those of open s a zero multiplier.
        fixed = torch.cat([held, ~touching], 1)
        K = torch.where(fixed.unsqueeze(-1), torch.eye(n + m, dtype=torch.float64), K)
        right = torch.where(fixed, torch.cat([bound - z, torch.zeros_like(self.s)], 1), right)
        step = torch.nan_to_num(torch.linalg.solve_ex(K, right)[0], nan=0.0, posinf=0.0, neginf=0.0)
        u, lam = (z + step[:, :n]).split([in_u, m], 1)
        u = u.reshape(self.primal.u.shape)
        # With a barrier a step goes at most nine tenths of the way to a bound.
        u = problem.clip_inside(u, self.primal.u) if problem.barrier > 0 else u
        return u, lam.reshape(self.primal.lam.shape), step[:, n:].clamp_min(0.0)
