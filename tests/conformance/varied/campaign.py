"""Random problems of every form: `batched` against `ipopt`, an own judge of both, and gradients against differences.

python -m tests.conformance.varied.campaign --first 0 --count 100
python -m tests.conformance.varied.campaign --first 17 --count 1 --verbose
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from difflcs import Status
from difflcs.mpc import Primal, kkt
from difflcs.mpc.backends import BatchedBackend, IpoptBackend
from difflcs.mpc.problem import INPUTS
from tests.conformance.varied.generators import Case, random_case
from tests.conformance.varied.judges import conditions, objective

BATCHED, IPOPT = BatchedBackend(threads=1), IpoptBackend(workers=1)
LIMIT = 1e-6


@dataclass
class Report:
    """Counts, the largest of every figure, and what to look at: (what, seed, element, figure)."""

    counts: Counter = field(default_factory=Counter)
    worst: dict[str, float] = field(default_factory=dict)
    findings: list[tuple[str, int, int, float]] = field(default_factory=list)

    def note(self, name: str, value: float) -> None:
        """Keep the largest."""
        self.worst[name] = max(self.worst.get(name, 0.0), value)

    def find(self, what: str, seed: int, i: int, value: float = 0.0) -> None:
        """Something wrong."""
        self.counts[f"! {what}"] += 1
        self.findings.append((what, seed, i, value))


def exactly(report: Report, case: Case, seed: int, result):
    """The result with multipliers that rounding keeps off their price put onto it."""
    mu, price = result.primal.mu, kkt.prices(case.problem())
    off = (mu != price) & ((mu - price).abs() < 1e-12 * price)
    for i in torch.nonzero(off.flatten(1).any(1)).flatten().tolist():
        report.find("multiplier next to its price", seed, i)
    return replace(result, primal=result.primal._replace(mu=torch.where(off, price, mu)))


def judge(report: Report, case: Case, seed: int, name: str, result) -> None:
    """Every solved element meets all conditions, by the library's residual and by the own judge."""
    problem = case.problem()
    residual = kkt.residual(problem, result.primal, kkt.multipliers(problem, result.primal))
    x, u, lam, mu = (v.numpy() for v in result.primal)
    cost = problem.objective(*result.primal[:2])
    for i in range(case.batch):
        status = Status(int(result.status[i]))
        report.counts[f"{name} {status.name}"] += 1
        if not all(np.isfinite(v[i]).all() for v in (x, u, lam, mu)):
            report.find(f"{name}: not finite", seed, i)
        if not status.solved:
            continue
        report.note(f"{name} residual", float(residual[i]))
        if not residual[i] <= LIMIT:
            report.find(f"{name}: residual", seed, i, float(residual[i]))
        if float(residual[i]) > max(1e-7, 2 * float(result.kkt_residual[i])):
            report.find(f"{name}: residual is more than it says", seed, i, float(residual[i]))
        for part, value in conditions(case, i, x[i], u[i], lam[i], mu[i]).items():
            report.note(f"{name} {part}", value)
            if not value <= 2 * LIMIT:
                report.find(f"{name}: {part}", seed, i, value)
        mine = objective(case, i, x[i], u[i])
        if abs(mine - float(cost[i])) > 1e-9 * (1 + abs(mine)):
            report.find("objective", seed, i, mine - float(cost[i]))


def compare(report: Report, case: Case, seed: int) -> None:
    """`batched` against `ipopt`: both judged, the optima compared, and what one calls infeasible tried by the other."""
    problem = case.problem()
    mine, other = BATCHED.solve(problem, None), IPOPT.solve(problem, None)
    mine = exactly(report, case, seed, mine)
    judge(report, case, seed, "batched", mine)
    judge(report, case, seed, "ipopt", other)
    report.counts["problems"] += case.batch
    report.counts["with constraints"] += case.batch * (problem.n_c > 0)
    low, high = (v.expand_as(mine.primal.u) for v in problem.bounds())
    at_bound = ((mine.primal.u <= low) | (mine.primal.u >= high)).flatten(1).any(1)
    report.counts["with an action at a bound"] += int(at_bound.sum())
    values = [problem.objective(*r.primal[:2]) for r in (mine, other)]
    if problem.n_c:
        active = (mine.primal.mu > 0).flatten(1).any(1) & mine.solved
        held = ((mine.primal.mu > 0) & (mine.primal.mu < kkt.prices(problem))).flatten(1).any(1) & mine.solved
        fined = (mine.primal.mu >= kkt.prices(problem)).flatten(1).any(1) & mine.solved
        for name, mask in (("active", active), ("held", held), ("fined", fined)):
            report.counts[f"batched with a row {name}"] += int(mask.sum())
    for i in range(case.batch):
        a, b = bool(mine.solved[i]), bool(other.solved[i])
        report.counts[f"batched {'solved' if a else 'not'}, ipopt {'solved' if b else 'not'}"] += 1
        if a and b:
            difference = float((values[0][i] - values[1][i]) / (1 + values[1][i].abs()))
            apart = float((mine.primal.u[i] - other.primal.u[i]).abs().max())
            if apart < 1e-4:
                report.counts["same optimum"] += 1
                report.note("same optimum: objectives apart", abs(difference))
                if abs(difference) > 1e-6:
                    report.find("objective of one optimum", seed, i, difference)
            else:
                better = "equal" if abs(difference) < 1e-8 else "batched lower" if difference < 0 else "ipopt lower"
                report.counts[f"other optimum: {better}"] += 1
                if problem.n_lam == 0 and abs(difference) > 1e-7:
                    report.find("convex, and other optimum", seed, i, difference)
    for name, one, two in (("batched", mine, other), ("ipopt", other, mine)):
        said = one.status == Status.INFEASIBLE
        report.counts[f"{name} infeasible"] += int(said.sum())
        for i in torch.nonzero(said).flatten().tolist():
            if case.witness is not None:
                report.find(f"{name}: infeasible, and a plan is known", seed, i)
            elif bool(two.solved[i]):
                report.find(f"{name}: infeasible, and the other solves it", seed, i)
        both = said & (two.status == Status.INFEASIBLE)
        report.counts["both infeasible"] += int(both.sum()) if name == "batched" else 0
    unsolved = torch.nonzero(~mine.solved & ~other.solved).flatten()
    if len(unsolved):  # IPOPT again from the plan of `batched`
        part = problem.select(unsolved)
        again = IPOPT.solve(part, Primal(*(v[unsolved] for v in mine.primal)))
        for j, i in enumerate(unsolved.tolist()):
            if bool(again.solved[j]):
                report.find("unsolved by both, and ipopt solves it from the plan of batched", seed, i)
    solved = torch.nonzero(mine.status == Status.CONVERGED).flatten()[:1]
    if len(solved):  # a minimum is one for IPOPT too
        part = problem.select(solved)
        again = IPOPT.solve(part, Primal(*(v[solved] for v in mine.primal)))
        for j, i in enumerate(solved.tolist()):
            gain = float(values[0][i] - part.objective(*again.primal[:2])[j])
            report.counts["ipopt from the plan of batched"] += 1
            if bool(again.solved[j]) and gain > 1e-6 * (1 + abs(float(values[0][i]))):
                report.find("ipopt leaves the plan of batched for a lower cost", seed, i, gain)


def gradients(report: Report, case: Case, seed: int, count: int = 2) -> None:
    """Every input of some elements against central differences of re-solves; the kernel against `kkt.vjp`."""
    problem = case.problem()
    result = exactly(Report(), case, seed, BATCHED.solve(problem, None))
    rng = np.random.default_rng([seed, 19])

    def upstream(batch: int):
        shapes = ((problem.horizon + 1, problem.n_x), (problem.horizon, problem.n_u), (problem.horizon, problem.n_lam))
        return tuple(torch.from_numpy(rng.standard_normal((batch, *s))) for s in (*shapes, ()))

    grads = upstream(problem.batch)
    native = BATCHED.vjp(problem, result, grads, result.solved)
    reference = kkt.vjp(problem, kkt.linearise(problem, result.primal), grads, result.solved)
    for name in INPUTS:
        if native[name].numel():
            size = float(reference[name].abs().max())
            apart = float((native[name] - reference[name]).abs().max()) / max(size, 1e-12)
            report.note("native against kkt.vjp", apart)
            report.counts["adjoints compared"] += 1
            if not apart <= 1e-6:
                report.find(f"native against kkt.vjp: {name}", seed, -1, apart)
    index = torch.nonzero(result.status == Status.CONVERGED).flatten()[:count]
    if len(index):
        _differences(report, case, seed, index, upstream(len(index)), rng)


def _direction(name: str, value: np.ndarray, rng) -> np.ndarray:
    z = rng.standard_normal(value.shape)
    if name in ("Q", "R", "Q_final"):
        root = np.sqrt(np.maximum(np.diagonal(value, axis1=-2, axis2=-1), 0))
        z = 0.5 * (z + z.swapaxes(-1, -2)) * root[..., :, None] * root[..., None, :]
    size = np.where(np.isfinite(value), np.maximum(np.abs(value), 0.1), 0.0)
    return z * (size if name not in ("Q", "R", "Q_final") else 1.0)


def _differences(report: Report, case: Case, seed: int, index, grads, rng, step: float = 1e-5) -> None:
    own = case.own()
    part = replace(own, arrays={k: v[index.numpy()] for k, v in own.arrays.items()}, witness=None)
    problem = part.problem()
    base = BATCHED.solve(problem, None)
    ours = BATCHED.vjp(problem, base, grads, base.solved)
    names = [name for name in INPUTS if name in part.arrays and part.arrays[name].size]
    directions = {name: _direction(name, part.arrays[name], rng) for name in names}
    stacked = {name: [] for name in part.arrays}
    for moved in names:
        for sign in (step, -step):
            for name, value in part.arrays.items():
                with np.errstate(invalid="ignore"):
                    change = np.where(np.isfinite(value), sign * directions[moved], 0.0) if name == moved else 0.0
                stacked[name].append(value + change)
    copies = replace(part, arrays={name: np.concatenate(v) for name, v in stacked.items()}).problem()
    times = 2 * len(names)
    guess = Primal(*(v.repeat(times, 1, 1) for v in base.primal))
    again = BATCHED.solve(copies, guess)
    plan = kkt.polish(copies, again.primal, tol=1e-14)
    wide = [w.repeat(times, *[1] * (w.ndim - 1)) for w in grads]
    values = sum(((w * v).sum((1, 2)) for w, v in zip(wide[:3], plan[:3], strict=True)), torch.zeros(copies.batch))
    values = (values + wide[3] * copies.objective(plan.x, plan.u)).reshape(len(names), 2, len(index))
    low, high = (v.expand_as(plan.u) for v in copies.bounds())
    price = kkt.prices(copies)
    marks = [plan.u <= low + 1e-9, plan.u >= high - 1e-9, plan.mu > 1e-9, plan.mu >= price * (1 - 1e-9)]
    active = torch.cat([m.flatten(1) for m in marks], 1).reshape(len(names), 2, len(index), -1)
    near = (plan.u.reshape(len(names), 2, *base.primal.u.shape) - base.primal.u).abs().amax((1, 3, 4)) < 1e-3
    low, high = (v.expand_as(base.primal.u) for v in problem.bounds())
    price = kkt.prices(problem)
    there = [base.primal.u <= low + 1e-9, base.primal.u >= high - 1e-9, base.primal.mu > 1e-9]
    there = torch.cat([m.flatten(1) for m in (*there, base.primal.mu >= price * (1 - 1e-9))], 1)
    steady = (active == there).all(-1).all(1) & near & again.solved.reshape(len(names), 2, -1).all(1)
    for j, name in enumerate(names):
        quotient = (values[j, 0] - values[j, 1]) / (2 * step)
        terms = (ours[name] * torch.from_numpy(directions[name])).flatten(1)
        for i in range(len(index)):
            report.counts["differences"] += 1
            if not bool(steady[j, i]):
                report.counts["differences: active set changes, left out"] += 1
                continue
            floor = 1e-3 * (1 + float(values[j, 0, i].abs()))
            error = abs(float(terms[i].sum() - quotient[i])) / max(abs(float(quotient[i])), floor)
            report.counts["differences compared"] += 1
            report.note("differences", error)
            if not error <= 1e-3:
                report.find(f"gradient of {name}", seed, int(index[i]), error)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--count", type=int, default=20, help="number of seeds; each a batch of one form")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--only", default="", help="compare or gradients")
    parser.add_argument("--verbose", action="store_true", help="print the findings of every seed at once")
    options = parser.parse_args()
    torch.set_num_threads(1)
    report, started = Report(), time.perf_counter()
    for seed in range(options.first, options.first + options.count):
        before = len(report.findings)
        case = random_case(seed, options.batch)
        if options.only in ("", "compare"):
            compare(report, case, seed)
        if options.only in ("", "gradients"):
            gradients(report, case, seed)
        for what, _, i, value in report.findings[before:]:
            print(f"seed {seed} element {i}: {what} {value:.3g}", flush=True)
        if options.verbose or seed % 20 == 19:
            print(f"-- seed {seed}, {time.perf_counter() - started:.0f} s", flush=True)
    for name, count in sorted(report.counts.items()):
        print(f"{count:8} {name}")
    for name, value in sorted(report.worst.items()):
        print(f"{value:10.2e} largest {name}")


if __name__ == "__main__":
    main()
