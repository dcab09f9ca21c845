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
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import torch
from torch import Tensor

from difflcs._checks import check_number, check_threads, describe, make_plain
from difflcs._linalg import matvec, one_thread
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
    parameters: list[Tensor]  # leaves, as `_parameters` lists them
    z: Tensor  # (elements, n) function of the leaves


class _Pass(NamedTuple):
    """One convex program and the graphs through which cvxpylayers differentiates it, one per call of the layer."""

    nominal: Tensor  # (batch, H, n_u)
    penalty: float
    graphs: list[_Graph]
    z: Tensor  # (batch, n) the solution


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

    cvxpylayers has the program in u and λ alone. Its gradients for the parameters of that program are chained by torch
    through the nominal trajectory and the passes; they are those of the whole map, a guess held. diffcp differentiates
    a dense matrix; its default, LSQR, did not converge on these programs.

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
        inputs = {name: getattr(problem, name) for name in INPUTS}
        failed = torch.zeros(batch, dtype=torch.bool)
        passes: list[_Pass] = []
        for penalty in self.penalties if guess is None else self.penalties[-1:]:
            program = _condense(inputs, nominal, problem.relaxation, penalty)
            graphs, z, mu = self._call_layer(problem, program)
            primal, residual = _polish(problem, program, z, mu)
            passes.append(_Pass(nominal, penalty, graphs, torch.cat([v.flatten(1) for v in primal[1:3]], 1)))
            failed |= ~(residual <= self.residual_tol)
            primal = replace_failed(problem, primal, failed)
            nominal = primal.u
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
        total = [torch.zeros_like(v) for v in inputs.values()]
        bars = [v[index] for v in grads]
        for step in reversed(result.passes):
            nominal, z = (v[index].requires_grad_() for v in (step.nominal, step.z))
            with torch.enable_grad():  # unsolved elements may hold infinities: they take no part
                part = {k: v if problem.shared(k) else v[index] for k, v in inputs.items()}
                program = _condense(part, nominal, problem.relaxation, step.penalty)
                u, lam = program.split(z)
                x = matvec(program.X, torch.cat([z, torch.ones_like(z[:, :1])], 1).unsqueeze(1))
                parameters = _parameters(program, z)
                outputs = [x, u, lam, replace(problem, **part).objective(x, u)] if len(bars) > 1 else [u]
            *direct, z_bar = _pull(outputs, [*inputs.values(), z], bars)
            seeds = z.new_zeros(problem.batch, z.shape[1]).index_copy(0, index, z_bar)
            parameter_bars = [v.new_zeros(problem.batch, *v.shape[1:]) for v in parameters]
            for graph in step.graphs:
                with _cvxpylayers():
                    parts = torch.autograd.grad(graph.z, graph.parameters, seeds[graph.index], retain_graph=True)
                for bar, value in zip(parameter_bars, parts, strict=True):
                    bar[graph.index] = value
            bars = [v[index] for v in parameter_bars[_HELD:]]
            *more, nominal_bar = _pull(parameters[_HELD:], [*inputs.values(), nominal], bars)
            total = [a + b + c for a, b, c in zip(total, direct, more, strict=True)]
            bars = [nominal_bar]
        gradients = dict(zip(INPUTS, total, strict=True))
        return {k: 0.5 * (v + v.mT) if k in ("Q", "R", "Q_final") else v for k, v in gradients.items()}

    def _call_layer(self, problem: MPCProblem, program: _Program) -> tuple[list[_Graph], Tensor, Tensor]:
        """Solve the batch in one call of the layer; element by element where that raises.

        Returns:
            The graphs, z (batch, n) and the multiplier of s ≥ 0 (batch, H·n_lam), NaN where the solver gave none.
        """
        n_s, n = program.S.shape[1], program.S.shape[2] - 1
        parameters = _parameters(program, program.nominal)
        layer = _layer(n, program.u_min.shape[1], n_s, problem.barrier)
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
        usable = torch.stack([torch.isfinite(v).flatten(1).all(1) for v in parameters]).all(0)
        graphs: list[_Graph] = []
        z, mu = (torch.full((problem.batch, size), torch.nan, dtype=torch.float64) for size in (n, n_s))
        waiting = [torch.nonzero(usable).squeeze(-1)]
        while waiting and len(index := waiting.pop(0)):
            leaves = [v[index].requires_grad_() for v in parameters]
            try:
                with torch.enable_grad(), _cvxpylayers():
                    outputs = layer(*leaves, solver_args=options)
            except Exception:  # whatever a solver raises stays with its elements
                waiting += index.split(1) if len(index) > 1 else ()
                continue
            graphs.append(_Graph(index, leaves, outputs[0]))
            z[index], mu[index] = (v.detach() for v in outputs)
        return graphs, z, mu


@contextmanager
def _cvxpylayers() -> Iterator[None]:
    """Call cvxpylayers without the one warning that version 1.2 causes with NumPy 2 at every call.

    After Ctrl-C diffcp's threads are joined at exit: they finish their element and would abort an ended interpreter.
    """
    before = set(threading.enumerate())
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "__array__ implementation doesn't accept a copy", DeprecationWarning)
            yield
    except KeyboardInterrupt:
        for thread in set(threading.enumerate()) - before:
            atexit.register(thread.join)
        raise


# Weight that makes λ unique where it moves no state. At 1e-3 diffcp's gradient of such a λ is off by 1 % and more.
_TIE = 1e-2
_STEPS = 3  # of Newton, to polish a plan
_HELD = 2  # the first parameters, which have no gradient of their own


class _Program(NamedTuple):
    """The program in z = (u, λ) alone, n numbers: x and s are affine in z. Matrices act on (z, 1)."""

    X: Tensor  # (batch, H + 1, n_x, n + 1) the states
    S: Tensor  # (batch, H·n_lam, n + 1) s
    W: Tensor  # (batch, n + 1, n + 1) symmetric: ½ (z, 1)ᵀ W (z, 1) is the cost with the penalty, up to a constant
    u_min: Tensor  # (batch, H·n_u)
    u_max: Tensor
    nominal: Tensor  # (batch, n) z of the nominal trajectory

    def split(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Split z into u (batch, H, n_u) and λ (batch, H, n_lam)."""
        horizon = self.X.shape[1] - 1
        u, lam = z.split([self.u_min.shape[1], self.S.shape[1]], 1)
        return u.unflatten(1, (horizon, -1)), lam.unflatten(1, (horizon, -1))

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Return the bounds (batch, n) of z."""
        least = self.S.new_zeros(self.S.shape[:2])
        return torch.cat([self.u_min, least], 1), torch.cat([self.u_max, least + torch.inf], 1)


@one_thread()
def _condense(t: Mapping[str, Tensor], nominal: Tensor, relaxation: float, penalty: float) -> _Program:
    """Build the program; differentiable in the inputs and the nominal actions (batch, H, n_u)."""
    batch, horizon, n_u = nominal.shape
    n_lam = t["F"].shape[-1]
    n = horizon * (n_u + n_lam)
    eye = torch.eye(n + 1, dtype=torch.float64)
    of_u, of_lam, one = eye.split([horizon * n_u, horizon * n_lam, 1])
    U, L = of_u.unflatten(0, (horizon, n_u)), of_lam.unflatten(0, (horizon, n_lam))
    low, high = (t[k].expand(batch, n_u).unsqueeze(1).expand(batch, horizon, n_u) for k in ("u_min", "u_max"))
    u_bar = torch.minimum(torch.maximum(nominal, low), high)
    unit = t["F"].diagonal(dim1=-2, dim2=-1).sqrt()

    def constant(vector: Tensor) -> Tensor:
        return vector.unsqueeze(-1) * one

    def quadratic(matrix: Tensor, vector: Tensor, rows: Tensor) -> Tensor:
        linear = rows.mT @ constant(vector)
        return rows.mT @ matrix @ rows + linear + linear.mT

    lams: list[Tensor] = []
    x_bar, X, S, W = t["x0"], [constant(t["x0"])], [], eye.new_zeros(batch, n + 1, n + 1)
    for k in range(horizon):
        gap = matvec(t["D"], x_bar) + matvec(t["E"], u_bar[:, k]) + t["c"]
        lam = solve_lcp(t["F"], gap, relaxation=relaxation).lam
        x_bar = matvec(t["A"], x_bar) + matvec(t["B"], u_bar[:, k]) + matvec(t["C"], lam) + t["d"]
        lams.append(lam)
        force, slack = lam * unit, relaxation / (lam * unit)
        rest = (horizon - 1 - k) * t["Q"] + t["Q_final"]
        moved = (t["C"] * (rest @ t["C"])).sum(-2) / unit.square()
        weight = (penalty * moved + _TIE).sqrt() / (force + slack)
        alpha, beta, gamma = weight * slack * unit, weight * force / unit, weight * 2 * relaxation
        S.append(t["D"] @ X[k] + t["E"] @ U[k] + t["F"] @ L[k] + constant(t["c"]))
        X.append(t["A"] @ X[k] + t["B"] @ U[k] + t["C"] @ L[k] + constant(t["d"]))
        row = alpha.unsqueeze(-1) * L[k] + beta.unsqueeze(-1) * S[k] - constant(gamma)
        of_x = ("Q_final", "q_final") if k == horizon - 1 else ("Q", "q")
        W = W + quadratic(t[of_x[0]], t[of_x[1]], X[k + 1]) + quadratic(t["R"], t["r"], U[k]) + row.mT @ row
    z_bar = torch.cat([u_bar.flatten(1), *lams], 1)
    return _Program(torch.stack(X, 1), torch.cat(S, 1), W, low.flatten(1), high.flatten(1), z_bar)


def _parameters(program: _Program, around: Tensor) -> list[Tensor]:
    """List the layer's parameters (batch, ...), with the cost ½‖Lᵀ(z − around)‖² + gᵀz for any `around` (batch, n).

    The root L has an infinite derivative where the Hessian H is singular, so it is held: a change dH acts on the
    solution z like the change dH·z of g. Derivatives are right around the solution.
    """
    H, S = program.W[:, :-1, :-1], program.S
    values, vectors = torch.linalg.eigh(torch.nan_to_num(H.detach(), nan=0.0, posinf=0.0, neginf=0.0))
    L = vectors * values.clamp_min(0.0).sqrt().unsqueeze(-2)
    centre, g = matvec(L.mT, around.detach()), matvec(H, around) + program.W[:, :-1, -1]
    return [L, centre, g, S[..., :-1], S[..., -1], program.u_min, program.u_max]


@lru_cache(maxsize=32)
def _layer(n: int, n_u: int, n_s: int, barrier: float) -> CvxpyLayer:
    """Build the layer for the parameters of `_parameters`, once for each size; n_u actions come first in z."""
    import cvxpy as cp
    from cvxpylayers.torch import CvxpyLayer  # pyright: ignore[reportPrivateImportUsage]

    sizes = ((n, n), (n,), (n,), (n_s, n), (n_s,), (n_u,), (n_u,))
    L, centre, g, S, s, u_min, u_max = parameters = [cp.Parameter(size) for size in sizes]
    z = cp.Variable(n)
    positive = S @ z + s >= 0
    cost = 0.5 * cp.sum_squares(L.T @ z - centre) + g @ z
    if barrier > 0:
        cost -= barrier * cp.sum(cp.log(z[:n_u] - u_min) + cp.log(u_max - z[:n_u]))
    return CvxpyLayer(
        cp.Problem(cp.Minimize(cost), [positive, z[:n_u] >= u_min, z[:n_u] <= u_max, z[n_u:] >= 0]),
        parameters=parameters,
        variables=[z, positive.dual_variables[0]],
        # Not MOREAU: cvxpylayers 1.2 with it drops the bound of λ in silence.
        solver="DIFFCP",
    )


@one_thread()
def _pull(outputs: list[Tensor], inputs: list[Tensor], bars: list[Tensor]) -> list[Tensor]:
    """Compute the gradients of the inputs, zero where nothing depends on one."""
    options = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
    return list(torch.autograd.grad(outputs, inputs, bars, **options))


@one_thread()
def _polish(problem: MPCProblem, program: _Program, z: Tensor, mu: Tensor) -> tuple[Primal, Tensor]:
    """Improve a plan by Newton steps on the program with its active bounds held; each element keeps its best point.

    A conic solver is accurate only to its tolerance, which shows in difference quotients. Of its plan z and multiplier
    of s ≥ 0 a trajectory is made with exact dynamics, bounds and λ ≥ 0. Its residual (batch,) is NaN where there is no
    plan.
    """
    best = point = _Point.at(problem, program, z, mu)
    for _ in range(_STEPS):
        point = _Point.at(problem, program, *point.newton(problem, program))
        better = point.residual < best.residual
        pairs = zip(point, best, strict=True)
        best = _Point(*(torch.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old) for new, old in pairs))
    u, lam = program.split(best.z)
    return Primal(best.x, u, lam, problem.no_multipliers()), best.residual


class _Point(NamedTuple):
    """The program at one point inside the bounds."""

    z: Tensor  # (batch, n)
    mu: Tensor  # (batch, H·n_lam) multiplier of s ≥ 0
    x: Tensor  # (batch, H + 1, n_x)
    s: Tensor  # (batch, H·n_lam)
    gradient: Tensor  # (batch, n) of the cost with penalty
    hessian: Tensor  # (batch, n, n) of the same
    residual: Tensor  # (batch,)

    @classmethod
    def at(cls, problem: MPCProblem, program: _Program, z: Tensor, mu: Tensor) -> _Point:
        z = z.clamp(*program.bounds())
        u, lam = program.split(z)
        states, slacks = [problem.x0], []
        for k in range(problem.horizon):
            slacks.append(problem.gap(states[k], u[:, k], lam[:, k]))
            states.append(problem.next_state(states[k], u[:, k], lam[:, k]))
        x, s = torch.stack(states, 1), torch.cat(slacks, 1)
        gradient, hessian = matvec(program.W[:, :-1, :-1], z) + program.W[:, :-1, -1], program.W[:, :-1, :-1].clone()
        if problem.barrier > 0:
            below, above = (v.flatten(1) for v in problem.distances(u))
            gradient[:, : below.shape[1]] += problem.barrier * (1 / above - 1 / below)
            hessian.diagonal(dim1=1, dim2=2)[:, : below.shape[1]] += problem.barrier * (1 / below**2 + 1 / above**2)
        stages = matvec(problem.batch_first("Q"), x[:, 1:-1]) + problem.batch_first("q")
        last = matvec(problem.Q_final, x[:, -1]) + problem.q_final
        size = torch.cat([stages, last.unsqueeze(1)], 1).abs().amax((1, 2)).clamp_min(1.0)
        moved = (z - gradient + matvec(program.S[..., :-1].mT, mu)).clamp(*program.bounds())
        worst = torch.cat([z - moved, torch.minimum(s, mu)], 1).abs().amax(1) / size
        return cls(z, mu, x, s, gradient, hessian, torch.maximum(worst, (-s).amax(1)))

    def newton(self, problem: MPCProblem, program: _Program) -> tuple[Tensor, Tensor]:
        """Compute z and the multiplier of s ≥ 0 that solve the program if its active constraints are those here."""
        z, S, (low, high) = self.z, program.S[..., :-1], program.bounds()
        # By Newton's step of one coordinate, so that units do not decide what is active.
        h = self.hessian.diagonal(dim1=1, dim2=2).clamp_min(torch.finfo(torch.float64).tiny)
        moved = z - (self.gradient - matvec(S.mT, self.mu)) / h
        held = (moved <= low) | (moved >= high)
        touching = self.s < self.mu * (S.square() / h.unsqueeze(1)).sum(-1)
        n, m = z.shape[1], self.s.shape[1]
        K = torch.zeros(len(z), n + m, n + m, dtype=torch.float64)
        K[:, :n, :n], K[:, :n, n:], K[:, n:, :n] = self.hessian, -S.mT, S
        right = torch.cat([-self.gradient, -self.s], 1)
        # Rows of held z give the step to its bound, those of open s a zero multiplier.
        fixed = torch.cat([held, ~touching], 1)
        K = torch.where(fixed.unsqueeze(-1), torch.eye(n + m, dtype=torch.float64), K)
        right = torch.where(fixed, torch.cat([moved.clamp(low, high) - z, torch.zeros_like(self.s)], 1), right)
        step = torch.nan_to_num(torch.linalg.solve_ex(K, right)[0], nan=0.0, posinf=0.0, neginf=0.0)
        new = z + step[:, :n]
        if problem.barrier > 0:  # a step goes at most nine tenths of the way to a bound
            u, lam = program.split(new)
            new = torch.cat([problem.clip_inside(u, program.split(z)[0]).flatten(1), lam.flatten(1)], 1)
        return new, step[:, n:].clamp_min(0.0)
