"""Whether the solver copes with large problems: `python benchmarks/scale.py [--problems 16] [--smoke]`.

Two families, both solved with the default settings from nothing:

- "random": `random_model` of any size, two actions for three states, |u| ≤ 1, x0 ~ N(0, 1). Nothing in it is like a
  robot: contacts couple everything, and larger ones are unstable.
- "carts": a chain of carts between two walls whose first cart must push the last one.

Printed per size: the share of problems solved, iterations, and CPU time per problem and per iteration on one thread.
Iterations are those of one start of a problem, on average. Written as JSON too.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from models import cart_states, chain_of_carts, push_the_last_cart, random_model

from difflcs import LCSParams, QuadraticCost
from difflcs.cli.bench import save
from difflcs.mpc import MPCProblem
from difflcs.mpc.backends import BatchedBackend

RELAXATION = 1e-5
# n_x, n_lam, H
RANDOM = [
    *[(9, n_lam, 10) for n_lam in (2, 5, 8, 12, 20, 30)],
    *[(20, 8, 10), (40, 8, 10), (9, 8, 20), (9, 8, 40), (20, 5, 20), (20, 20, 20), (40, 30, 10), (40, 30, 40)],
]
CARTS = [(carts, horizon) for carts in (2, 4, 10, 20) for horizon in (10, 20, 40)]


@dataclass
class Options:
    """Convergence, iterations and time per iteration by size."""

    problems: int = 16
    """Problems per model."""
    seeds: int = 4
    """Models of each size; the carts have one."""
    out: Path = Path("benchmarks/results/scale.json")
    """Where the JSON goes."""
    smoke: bool = False
    """Everything tiny."""


@dataclass
class Row:
    """What was measured at one size; times are in seconds of CPU."""

    family: str
    n_x: int
    n_u: int
    n_lam: int
    horizon: int
    problems: int
    solved: float
    starts: int
    iterations: float  # of one start; most are given up after a few
    per_problem: float
    per_iteration: float


def posed(lcs: LCSParams, cost: QuadraticCost, horizon: int, limit: float, x0: torch.Tensor) -> MPCProblem:
    """The problem that the layer would hand to a backend."""
    bound = torch.full((lcs.n_u,), limit, dtype=torch.float64)
    fields = {name: getattr(cost, name) for name in ("Q", "R", "Q_final", "q", "r", "q_final")}
    return MPCProblem(
        **lcs.tensors(), **fields, u_min=-bound, u_max=bound, x0=x0, horizon=horizon, relaxation=RELAXATION
    )


def random_problem(n_x: int, n_lam: int, horizon: int, count: int, seed: int) -> MPCProblem:
    """A random model, to be brought to rest."""
    lcs = random_model(n_lam, seed, n_x, n_u=2 * n_x // 3)
    eye = torch.eye(n_x, dtype=torch.float64)
    cost = QuadraticCost(eye, 0.1 * torch.eye(lcs.n_u, dtype=torch.float64), eye)
    x0 = torch.randn(count, n_x, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return posed(lcs, cost, horizon, 1.0, x0)


def carts_problem(carts: int, horizon: int, count: int) -> MPCProblem:
    """Push the last cart 0.3 m further, through all others."""
    lcs = chain_of_carts(carts, dt=0.1)
    cost = push_the_last_cart(carts, horizon, others=0.1)
    x0 = cart_states(carts, count, carts)
    return posed(lcs, cost, horizon, 50.0, x0)


def measure(family: str, problems: list[MPCProblem]) -> Row:
    """Solve problems of one size."""
    backend = BatchedBackend(threads=1)
    started = time.process_time()
    results = [backend.solve(problem, None) for problem in problems]
    spent = time.process_time() - started
    solved = torch.cat([result.solved for result in results])
    iterations = torch.cat([result.iterations for result in results]).double()
    p = problems[0]
    starts = backend.starts(p, guessed=False)
    return Row(
        family=family,
        n_x=p.n_x,
        n_u=p.n_u,
        n_lam=p.n_lam,
        horizon=p.horizon,
        problems=len(solved),
        solved=float(solved.double().mean()),
        starts=starts,
        iterations=float(iterations.mean()) / starts,
        per_problem=spent / len(solved),
        per_iteration=spent / float(iterations.sum()),
    )


def show(row: Row) -> None:
    """Print one line."""
    print(
        f"{row.family:7s} n_x {row.n_x:2d}  n_u {row.n_u:2d}  n_lam {row.n_lam:2d}  H {row.horizon:2d}: "
        f"{100 * row.solved:6.2f} % of {row.problems} solved, {row.starts:2d} starts of {row.iterations:6.1f} "
        f"iterations, "
        f"{1e3 * row.per_problem:9.3f} ms per problem, {1e6 * row.per_iteration:7.1f} us per iteration",
        flush=True,
    )


def main(o: Options) -> None:
    """Measure, print, write."""
    random, carts = RANDOM, CARTS
    if o.smoke:
        o.problems, o.seeds = 4, 1
        random, carts = random[:1], carts[:1]
    rows = []
    for size in random:
        rows.append(measure("random", [random_problem(*size, o.problems, seed) for seed in range(o.seeds)]))
        show(rows[-1])
    for size in carts:
        rows.append(measure("carts", [carts_problem(*size, o.problems * o.seeds)]))
        show(rows[-1])
    solved = sum(row.solved * row.problems for row in rows) / sum(row.problems for row in rows)
    print(f"solved in all: {100 * solved:.2f} %")
    save(o.out, {"solved": solved, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main(tyro.cli(Options))
