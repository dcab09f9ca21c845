"""What the campaign runs: each target solves one batch, has it judged, and says what became of every element."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.random import Generator

from difflcs import LCSModel, LCSMPCLayer, Status, solve_lcp, violation_loss
from difflcs.errors import DiffLCSError, DiffLCSWarning
from difflcs.mpc import Primal
from difflcs.mpc.backends import IpoptBackend
from difflcs.mpc.problem import INPUTS
from tests.conformance import problems
from tests.conformance.cases import Case
from tests.conformance.hostile import checks
from tests.conformance.hostile.generators import LCP, Loss

REFUSED = -1  # in place of a status: a typed error


@dataclass
class Outcome:
    """One batch, judged.

    Attributes:
        status: (count,) `Status`, or REFUSED.
        ratios: check → (count,) violation / limit; above 1 is silent. Only what was promised of that element counts.
        compared: number of gradients that were compared with differences.
    """

    status: np.ndarray
    ratios: checks.Ratios
    compared: int = 0

    @property
    def solved(self) -> np.ndarray:
        return (self.status == Status.CONVERGED) | (self.status == Status.DEGENERATE)

    @property
    def worst(self) -> np.ndarray:
        return np.stack(list(self.ratios.values())).max(0)

    def add_gradients(self, index: np.ndarray, ratio: np.ndarray, compared: int) -> None:
        """Judge the gradients of some elements as well."""
        self.ratios["gradient"] = np.zeros(len(self.status))
        self.ratios["gradient"][index] = ratio
        self.compared = compared

    @staticmethod
    def join(parts: list[Outcome]) -> Outcome:
        names = dict.fromkeys(name for part in parts for name in part.ratios)
        status = np.concatenate([p.status for p in parts])
        zero = {name: [p.ratios.get(name, np.zeros(len(p.status))) for p in parts] for name in names}
        return Outcome(status, {k: np.concatenate(v) for k, v in zero.items()}, sum(p.compared for p in parts))


@contextmanager
def quiet():
    """Without the library's own warnings: they say what the status says."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DiffLCSWarning)
        yield


def refused_one_by_one(run: Callable[..., Outcome], problem) -> Outcome:
    """An error ends a whole batch: halve it until only those elements that cause it are out.

    A typed error is a refusal. Any other one is a failure: nobody can catch it on purpose, and it says nothing.
    """
    try:
        return run(problem)
    except Exception as error:
        if problem.count == 1:
            typed = isinstance(error, DiffLCSError)
            return Outcome(np.array([REFUSED]), {"untyped error": np.array([0.0 if typed else np.inf])})
        half = problem.count // 2
        parts = (problem.select(slice(None, half)), problem.select(slice(half, None)))
        return Outcome.join([refused_one_by_one(run, part) for part in parts])


def _numpy(value: torch.Tensor) -> np.ndarray:
    return value.detach().numpy()


def _rounding(*pairs: tuple[torch.Tensor, torch.Tensor]) -> np.ndarray:
    """float32 is solved in float64: 0 where the one is the other, rounded, else ∞."""
    same = [(one == other.to(one.dtype)).reshape(len(one), -1).all(1).numpy() for one, other in pairs]
    return np.where(np.all(same, axis=0), 0.0, np.inf)


def promised(ratios: checks.Ratios, solved: np.ndarray) -> checks.Ratios:
    """Conditions hold for solved elements; finite numbers, and actions within their bounds, for all."""
    of_all = ("finite", "finite gradient", "bounds")
    return {k: v if k in of_all else np.where(solved, v, 0.0) for k, v in ratios.items()}


# ---- solve_lcp ------------------------------------------------------------------------------------------------------


def lcp_target(
    problem: LCP, rng: Generator, gradients: bool, relaxation: float | None = None, dtype=np.float64
) -> Outcome:
    """`relaxation` None: exact or one of three, drawn."""
    chosen = float(rng.choice([0.0, 1e-3, 1e-5, 1e-8])) if relaxation is None else relaxation
    problem = problem.cast(dtype)
    if not (np.isfinite(problem.F).all() and np.isfinite(problem.q).all()):  # too large for float32
        problem = LCP(np.nan_to_num(problem.F), np.nan_to_num(problem.q))
    done = refused_one_by_one(lambda part: _lcp(part, chosen, dtype), problem)
    if gradients and dtype == np.float64:
        index = np.flatnonzero(done.solved)[:8]
        if len(index):
            ratio, compared = _lcp_differences(problem.select(index).each(), chosen, rng)
            done.add_gradients(index, ratio, compared)
    return done


def _lcp(problem: LCP, relaxation: float, dtype) -> Outcome:
    F, q = (torch.from_numpy(v).requires_grad_() for v in (problem.F, problem.q))
    with quiet():
        solution = solve_lcp(F, q, relaxation)
    (solution.lam.sum() + solution.w.sum()).backward()
    status, wide = solution.status.numpy().astype(int), problem.cast(np.float64)
    with quiet():
        judged = solve_lcp(torch.from_numpy(wide.F), torch.from_numpy(wide.q), relaxation)
    ratios = checks.judge_lcp(wide, _numpy(judged.lam), _numpy(judged.w), relaxation)
    ratios["finite"] = checks.finite(_numpy(solution.lam), _numpy(solution.w))
    ratios["rounding"] = _rounding((solution.lam, judged.lam), (solution.w, judged.w))
    gradient = checks.finite(q.grad.numpy())
    if F.ndim == 3:
        gradient = np.maximum(gradient, checks.finite(F.grad.numpy()))
    elif not bool(torch.isfinite(F.grad).all()) and not gradient.any():
        gradient = _who(lambda part: part.each(), lambda part: _lcp(part, relaxation, dtype), problem)
    ratios["finite gradient"] = gradient
    return Outcome(status, promised(ratios, status == Status.CONVERGED))


def _who(each, run, problem) -> np.ndarray:
    """Whose gradient made the shared one infinite: that of the elements alone; the first where only the sum is."""
    alone = run(each(problem)).ratios["finite gradient"]
    if not alone.any():
        alone = alone.copy()
        alone[0] = np.inf
    return alone


def _lcp_differences(problem: LCP, relaxation: float, rng: Generator) -> tuple[np.ndarray, int]:
    """Directional derivatives against central differences, F along D F D, q along its own size."""
    count, n = problem.q.shape
    dF, dq = rng.standard_normal((count, n)), rng.standard_normal((count, n))
    weights = rng.standard_normal((2, count, n))

    def moved(step: float) -> LCP:
        D = 1 + step * dF
        return LCP(D[:, :, None] * problem.F * D[:, None], problem.q * (1 + step * dq))

    def values(p: LCP) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with quiet():
            solution = solve_lcp(torch.from_numpy(p.F), torch.from_numpy(p.q), relaxation)
        return solution.lam.numpy(), solution.w.numpy(), solution.status.numpy()

    F, q = (torch.from_numpy(v.copy()).requires_grad_() for v in (problem.F, problem.q))
    with quiet(), np.errstate(all="ignore"):
        solution = solve_lcp(F, q, relaxation)
        lam, w = solution.lam.detach().numpy(), solution.w.detach().numpy()
        # Each output in units of its own size, so that no large one hides a small one; all w may be zero.
        units = [np.abs(lam).max(-1, keepdims=True), np.abs(np.concatenate([w, problem.q], -1)).max(-1, keepdims=True)]
        seeds = [torch.from_numpy(a / np.maximum(b, 1e-300)) for a, b in zip(weights, units, strict=True)]
        torch.autograd.backward([solution.lam, solution.w], seeds)
        direction = (dF[:, :, None] + dF[:, None]) * problem.F
        terms = np.concatenate([(F.grad.numpy() * direction).reshape(count, -1), q.grad.numpy() * problem.q * dq], 1)

        def difference(step: float) -> tuple[np.ndarray, np.ndarray]:
            high, low = values(moved(step)), values(moved(-step))
            change = sum((seed.numpy() * (a - b)).sum(-1) for seed, a, b in zip(seeds, high[:2], low[:2], strict=True))
            same = (high[2] == 0) & (low[2] == 0) & (((high[0] > 0) == (low[0] > 0)).all(-1))
            # Where F is not definite there can be many solutions: both must stay next to this one.
            far = 1e-6 * np.abs(lam).max(-1, keepdims=True) + np.abs(high[0] - low[0])
            same &= (np.abs(0.5 * (high[0] + low[0]) - lam) <= far).all(-1)
            return change / (2 * step), same

        return _compare(terms, difference, 1e-6)


def _compare(terms: np.ndarray, difference, step: float, of_terms: float = 1e-7) -> tuple[np.ndarray, int]:
    """|sum of terms − difference| in units of 1e-3 of both, where two step sizes agree on the difference.

    Both count as at least `of_terms` of the sizes of the terms, which may cancel.
    """
    with np.errstate(all="ignore"):
        exact = terms.sum(-1)
        (first, usable), (second, also) = difference(step), difference(step / 4)
        size = np.abs(first) + np.abs(second) + 1e-7 * np.abs(terms).sum(-1)
        # They agree beyond what the rounding of the terms can feign.
        both = np.abs(first) + np.abs(second) + 1e-12 * np.abs(terms).sum(-1)
        usable = usable & also & (np.abs(first - second) <= 1e-4 * both) & np.isfinite(size)
        error = np.where(usable, np.abs(exact - second), 0.0)
        unit = size + np.abs(exact) + of_terms * np.abs(terms).sum(-1)
        return np.where(usable & (error > 0), error / (1e-3 * unit + 1e-300), 0.0), int(usable.sum())


# ---- LCSMPCLayer ----------------------------------------------------------------------------------------------------

layer_of = partial(problems.layer_of, on_failure="mask")


def leaves_of(problem: Case) -> dict[str, torch.Tensor]:
    """Every input as a tensor that requires a gradient."""
    return {k: torch.from_numpy(np.array(problem.inputs[k])).requires_grad_() for k in INPUTS if k in problem.inputs}


def solve_mpc(problem: Case, dtype, backend, guess, judge) -> Outcome:
    """Plan, differentiate and judge."""
    leaves = leaves_of(problem)
    with quiet(), np.errstate(all="ignore"):
        layer = layer_of(problem, leaves, backend=backend)
        plan = layer(leaves["x0"], guess=guess(problem, layer, leaves["x0"]))
        (plan.x.mean((-1, -2)) + plan.u.mean((-1, -2)) + plan.lam.sum((-1, -2)) + plan.objective).sum().backward()
        judged, wide = plan, problem.cast(np.float64)
        if dtype != np.float64:
            doubles = leaves_of(wide)
            judged = layer_of(wide, doubles, backend=backend)(doubles["x0"])
    names, status = ("x", "u", "lam", "objective", "mu", "violation"), plan.status.numpy().astype(int)
    ratios = judge(wide, *(_numpy(getattr(judged, k)) for k in names))
    ratios["finite"] = checks.finite(*(_numpy(getattr(plan, k)) for k in (*names, "kkt_residual")))
    # Bounds are rounded inwards, or to their neighbours where that crosses.
    low, high = (wide.by_stage()[k] for k in ("u_min", "u_max"))
    inner_low, inner_high = low.astype(dtype), high.astype(dtype)
    inner_low = np.where(inner_low < low, np.nextafter(inner_low, dtype(np.inf)), inner_low)
    inner_high = np.where(inner_high > high, np.nextafter(inner_high, dtype(-np.inf)), inner_high)
    u = _numpy(judged.u).astype(dtype).clip(np.minimum(inner_low, inner_high), np.maximum(inner_low, inner_high))
    rounded = [torch.from_numpy(u) if k == "u" else getattr(judged, k) for k in names]
    ratios["rounding"] = _rounding(*zip([getattr(plan, k) for k in names], rounded, strict=True))
    gradient = np.zeros(problem.count)
    shared_bad = False
    for name, leaf in leaves.items():
        if leaf.grad is None:
            continue
        if problem.shared(name):
            shared_bad |= not bool(torch.isfinite(leaf.grad).all())
        else:
            gradient = np.maximum(gradient, checks.finite(leaf.grad.numpy()))
    if shared_bad and not gradient.any():
        again = lambda part: solve_mpc(part, dtype, backend, guess, judge)  # noqa: E731
        gradient = _who(lambda part: part.each(), again, problem)
    ratios["finite gradient"] = gradient
    outcome = Outcome(status, ratios)
    outcome.ratios = promised(ratios, outcome.solved)
    return outcome


def cold(problem: Case, layer: LCSMPCLayer, x0: torch.Tensor):
    return None


def shift(problem: Case, layer: LCSMPCLayer, x0: torch.Tensor):
    """Its own plan, one step later."""
    with torch.no_grad():
        return layer(x0).shift()


def _from_other_actions(actions, forces=lambda problem, lam: lam):
    def guess(problem: Case, layer: LCSMPCLayer, x0: torch.Tensor):
        with torch.no_grad():
            plan = layer(x0)
        low, high = (torch.as_tensor(v).expand_as(plan.u[:, 0]).unsqueeze(1) for v in (layer.u_min, layer.u_max))
        u = actions(plan.u, low, high).expand_as(plan.u).to(plan.u.dtype)
        return Primal(plan.x, u, forces(problem, plan.lam))

    return guess


# The vertex opposite to its own plan, and λ with the roles of λ and s exchanged; actions in the middle of their ranges.
opposite = _from_other_actions(
    lambda u, low, high: torch.where(u - low > high - u, low, high),
    lambda problem, lam: (problem.relaxation / lam.clamp_min(1e-30)).clamp_max(1e30),
)
interior = _from_other_actions(lambda u, low, high: 0.37 * low + 0.63 * high)


def mpc_target(
    problem: Case, rng: Generator, gradients: bool,
    guess=cold, dtype=np.float64, barrier: float = 0.0, backend="batched", judge=checks.judge_mpc,
) -> Outcome:  # fmt: skip
    """`barrier` is a part of the cost of the plain problems, which is of size 1."""
    if barrier > 0:
        low, high = problem.full()["u_min"], problem.full()["u_max"]
        if not (high > low).all():  # a barrier needs a range
            problem = problem.changed(u_min=low, u_max=np.where(high > low, high, low + 1.0))
        problem = replace(problem, barrier=barrier * float(rng.choice([1.0, 0.1, 10.0])))
    problem = _castable(problem, dtype)
    chosen = interior if guess is opposite and rng.random() < 0.3 else guess
    done = refused_one_by_one(lambda part: solve_mpc(part, dtype, backend, chosen, judge), problem)
    if gradients and dtype == np.float64 and backend != "relaxed":
        low, high = problem.full()["u_min"], problem.full()["u_max"]
        # Gradients are promised for inputs between 1e-30 and 1e30 only.
        sizes = [np.where(v == 0, 1.0, np.abs(v)).reshape(problem.count, -1) for v in problem.full().values()]
        sane = np.all([(v.max(1) < 1e30) & (v.max(1) > 1e-30) for v in sizes], axis=0)
        # float64 itself resolves a range of 1e-12 beside bounds of 1 to four digits.
        fine = ((high == low) | (high - low > 1e-8 * (np.abs(low) + np.abs(high)))).all(-1)
        index = np.flatnonzero((done.status == Status.CONVERGED) & fine & sane)[:4]
        if len(index):
            ratio, compared = _mpc_differences(problem.select(index).each(), backend, rng)
            done.add_gradients(index, ratio, compared)
    return done


def _castable(problem: Case, dtype) -> Case:
    if dtype == np.float64:
        return problem
    small = problem.cast(dtype)
    finite = {k: np.nan_to_num(v) for k, v in small.inputs.items()}
    # Rounding must not make bounds cross.
    finite["u_max"] = np.maximum(finite["u_max"], finite["u_min"])
    if problem.numbers:  # which have no dtype
        finite |= {k: problem.inputs[k] for k in ("u_min", "u_max")}
    return replace(small, inputs=finite)


def _mpc_differences(problem: Case, backend, rng: Generator) -> tuple[np.ndarray, int]:
    """Directional derivatives against central differences of re-solves that start from the solution.

    Matrices of the cost and F go along D M D with D = I + step·diag, which keeps them definite; bounds by a part of
    their range; everything else by a part of its own size.
    """
    count = problem.count
    a = problem.inputs
    draws = {k: rng.standard_normal(v.shape[:2] if k in ("Q", "R", "Q_final", "F") else v.shape) for k, v in a.items()}

    def moved(step: float) -> Case:
        new = {}
        for k, v in a.items():
            if k in ("Q", "R", "Q_final", "F"):
                D = 1 + step * draws[k]
                new[k] = D[:, :, None] * v * D[:, None]
            elif k in ("u_min", "u_max"):
                new[k] = v + step * draws[k] * (a["u_max"] - a["u_min"])
            else:
                new[k] = v * (1 + step * draws[k])
        return replace(problem, inputs=new, answer=None)

    def direction(k: str) -> np.ndarray:
        if k in ("Q", "R", "Q_final", "F"):
            return (draws[k][:, :, None] + draws[k][:, None]) * a[k]
        return draws[k] * (a["u_max"] - a["u_min"] if k in ("u_min", "u_max") else a[k])

    leaves = leaves_of(problem)
    with quiet(), np.errstate(all="ignore"):
        try:
            plan = layer_of(problem, leaves, backend=backend)(leaves["x0"])
        except DiffLCSError:
            return np.zeros(count), 0
        names = ("x", "u", "lam")
        values = [getattr(plan, k) for k in names]
        # Each output in units of its own size, or of what the actions can make of it where it is zero.
        width = torch.from_numpy(np.abs(np.stack([a["u_min"], a["u_max"]])).max((0, 2)))
        reach = width * torch.from_numpy(np.abs(a["B"]).max((1, 2)))
        effort = width**2 * torch.from_numpy(np.abs(a["R"]).max((1, 2)))
        seeds = []
        for v, floor in zip([*values, plan.objective], [reach, width, 0 * width, effort], strict=True):
            size = torch.maximum(v.detach().reshape(count, -1).abs().amax(1), 1e-3 * floor).clamp_min(1e-300)
            draw = torch.from_numpy(np.asarray(rng.standard_normal(v.shape)))
            seeds.append(draw / size.reshape(-1, *[1] * (v.ndim - 1)))
        torch.autograd.backward([*values, plan.objective], seeds)
        gradients = {k: leaf.grad.numpy() for k, leaf in leaves.items() if leaf.grad is not None}
        terms = np.concatenate([(g * direction(k)).reshape(count, -1) for k, g in gradients.items()], 1)
        guess = Primal(*(v.detach() for v in values))
        solved = (plan.status == Status.CONVERGED).numpy()
        found = (_numpy(v) for v in (*values, plan.objective))
        solved &= checks.judge_mpc(problem, *found)["stationarity"] <= 1e-2  # else it is not the point of its gradient

        def solve(step: float):
            shifted = moved(step)
            tensors = leaves_of(shifted)
            with torch.no_grad():
                return layer_of(shifted, tensors, backend=backend)(tensors["x0"], guess=guess)

        def difference(step: float) -> tuple[np.ndarray, np.ndarray]:
            try:
                high, low = solve(step), solve(-step)
            except DiffLCSError:
                return np.zeros(count), np.zeros(count, bool)
            change = torch.zeros(count, dtype=torch.float64)
            for name, seed in zip((*names, "objective"), seeds, strict=True):
                product = seed * (getattr(high, name) - getattr(low, name))
                change += product.reshape(count, -1).sum(-1)
            same = solved & (high.converged & low.converged).numpy()
            # Both must stay on the branch of the solution, and solve their own problems to far less than a step.
            base, up, down = (_numpy(v.u) for v in (plan, high, low))
            width = np.maximum(np.abs(a["u_max"] - a["u_min"])[:, None], 1e-300)
            scale = np.minimum(width, np.abs(base).max((1, 2), keepdims=True))  # a range of 1e8 hides another optimum
            jump = np.abs(0.5 * (up + down) - base) > 1e-6 * scale + np.abs(up - down)
            same &= ~jump.any((1, 2))
            for sign, found in ((1, high), (-1, low)):
                numbers = (_numpy(v) for v in (found.x, found.u, found.lam, found.objective))
                ratios = checks.judge_mpc(moved(sign * step), *numbers)
                same &= (np.stack(list(ratios.values())).max(0) <= 1) & (ratios["stationarity"] <= 1e-3)
            return (change / (2 * step)).numpy(), same

        return _compare(terms, difference, 1e-5)


# ---- violation_loss -------------------------------------------------------------------------------------------------


def model_of(problem: Loss, dtype=torch.float64) -> LCSModel:
    n_x, n_u = problem.system["B"].shape
    model = LCSModel(n_x, n_u, problem.system["C"].shape[-1], stiffness=problem.stiffness, dtype=dtype)
    with torch.no_grad():
        for name, value in problem.system.items():
            getattr(model, name).copy_(torch.from_numpy(value))
    return model


def loss_target(problem: Loss, rng: Generator, gradients: bool) -> Outcome:
    """Value against an own inner solution, gradient against differences of that."""
    done = refused_one_by_one(_loss, problem)
    index = np.flatnonzero(done.solved)[:4]
    if gradients and len(index):
        ratio, compared = _loss_differences(problem.select(index), rng)
        done.add_gradients(index, ratio, compared)
    return done


def _loss(problem: Loss) -> Outcome:
    model = model_of(problem)
    data = [torch.from_numpy(v).requires_grad_() for v in (problem.x, problem.u, problem.x_next)]
    value = violation_loss(model, *data, gamma=problem.gamma, xi=problem.xi, reduction="none")
    value.sum().backward()
    ratios = checks.judge_loss(problem, value.detach().numpy())
    gradient = checks.finite(*(v.grad.numpy() for v in data if v.grad is not None))
    if not all(p.grad is None or bool(torch.isfinite(p.grad).all()) for p in model.parameters()):
        gradient[:] = np.inf
    ratios["finite gradient"] = gradient
    return Outcome(np.zeros(problem.count, int), ratios)


def _loss_differences(problem: Loss, rng: Generator) -> tuple[np.ndarray, int]:
    draws = {k: rng.standard_normal(v.shape) for k, v in problem.system.items()}
    data = {k: rng.standard_normal(getattr(problem, k).shape) for k in ("x", "u", "x_next")}

    def moved(step: float) -> Loss:
        system = {k: v * (1 + step * draws[k]) for k, v in problem.system.items()}
        return replace(problem, system=system, **{k: getattr(problem, k) * (1 + step * v) for k, v in data.items()})

    def value(p: Loss) -> float:
        return float((checks.inner_minimum(p)[0] * weight).sum())  # also where the bound on γ falls below it with F

    model = model_of(problem)
    tensors = [torch.from_numpy(v).requires_grad_() for v in (problem.x, problem.u, problem.x_next)]
    loss = violation_loss(model, *tensors, gamma=problem.gamma, xi=problem.xi, reduction="none")
    weight = 1 / loss.detach().clamp_min(1e-300).numpy()
    (loss * torch.from_numpy(weight)).sum().backward()
    gradients = {k: p.grad.numpy() for k, p in model.named_parameters() if p.grad is not None}
    terms = [(g * draws[k] * problem.system[k]).ravel() for k, g in gradients.items()]
    for name, leaf in zip(data, tensors, strict=True):
        terms.append((leaf.grad.numpy() * data[name] * getattr(problem, name)).ravel())

    def difference(step: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([(value(moved(step)) - value(moved(-step))) / (2 * step)]), np.array([True])

    # The dual of a stiff contact is a difference of nearly equal numbers: its gradient is good to parts of its terms.
    ratio, compared = _compare(np.concatenate(terms)[None], difference, 1e-5, of_terms=0.1)
    return np.repeat(ratio, problem.count), compared * problem.count


LCP_TARGETS = {
    "exact": partial(lcp_target, relaxation=0.0),
    "relaxed 1e-3": partial(lcp_target, relaxation=1e-3),
    "relaxed 1e-5": partial(lcp_target, relaxation=1e-5),
    "relaxed 1e-8": partial(lcp_target, relaxation=1e-8),
    "float32": partial(lcp_target, dtype=np.float32),
}
MPC_TARGETS = {
    "batched": mpc_target,
    "warm": partial(mpc_target, guess=shift),
    "opposite": partial(mpc_target, guess=opposite),
    "float32": partial(mpc_target, dtype=np.float32),
    "barrier": partial(mpc_target, barrier=1e-2),
}
SLOW_TARGETS = {
    "ipopt": partial(mpc_target, backend=IpoptBackend(workers=1)),
    "relaxed": partial(mpc_target, backend="relaxed", judge=checks.judge_relaxed_program),
}
LOSS_TARGETS = {"violation_loss": loss_target}
