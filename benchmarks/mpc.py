"""How fast backend `batched` is, against IPOPT in the same run: `python benchmarks/mpc.py [--smoke]`.

Prints one table and writes it as JSON with machine, versions and instruction set. Every speed is also a ratio to IPOPT
through the same layer, on the same problems, on one core; absolute times of a shared machine mean little.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import casadi
import numpy as np
import torch
import tyro
from models import ACTION_LIMIT, MODELS, pushing_model, states_and_goals

import difflcs
from difflcs import LCSModel, LCSMPCLayer, LCSParams, solve_lcp, violation_loss
from difflcs._native import _kernels
from difflcs.bench import best, cpu, save
from difflcs.mpc.backends import BatchedBackend, IpoptBackend
from difflcs_envs.tasks import pushing_cost


@dataclass
class Options:
    """Benchmark of the MPC backends."""

    batch: int = 2048
    """Problems per call of backend batched."""
    ipopt_batch: int = 48
    """Problems that IPOPT solves."""
    share: int = 10_000
    """Problems of the convergence count, spread over the models."""
    models: tuple[Path, ...] = ()
    """Learned models to add to the convergence count: directories such as RUN/model."""
    repeats: int = 5
    """Timings; the best counts."""
    out: Path = Path("benchmarks/results/mpc.json")
    """Where the JSON goes."""
    smoke: bool = False
    """Everything tiny: seconds instead of minutes."""


def layer(model: LCSModel | LCSParams, backend: BatchedBackend | IpoptBackend) -> LCSMPCLayer:
    """The paper's MPC around a model."""
    return LCSMPCLayer(model, pushing_cost(), 5, -ACTION_LIMIT, ACTION_LIMIT, backend=backend, on_failure="mask")


def mpc_times(n_lam: int, o: Options) -> dict[str, float]:
    """Seconds per problem of every way to solve it, one core, tensors in, tensors out."""
    model = LCSModel.from_params(pushing_model(n_lam, seed=0))
    x0, goal = states_and_goals(o.batch, seed=1)
    few = slice(0, o.ipopt_batch)
    ours, ipopt = layer(model, BatchedBackend(threads=1)), layer(model, IpoptBackend(workers=1))

    def solve(mpc: LCSMPCLayer, part: slice):
        with torch.no_grad():
            return mpc(x0[part], goal[part])

    def follow(mpc: LCSMPCLayer, part: slice) -> Callable[[], object]:
        """One step later in the receding horizon, 1 mm of disturbance, warm-started by the shifted plan."""
        plan = solve(mpc, part)
        later = plan.x[:, 1] + 1e-3 * torch.randn(plan.x[:, 1].shape, generator=torch.Generator().manual_seed(2))
        guess = plan.shift()

        def work() -> object:
            with torch.no_grad():
                return mpc(later, goal[part], guess=guess)

        return work

    def solve_and_differentiate(mpc: LCSMPCLayer, part: slice) -> None:
        model.zero_grad()
        mpc(x0[part], goal[part]).action.square().sum().backward()

    every = slice(0, o.batch)
    slow = max(1, o.repeats // 3)
    return {
        "cold": best(o.repeats, lambda: solve(ours, every)) / o.batch,
        "warm": best(o.repeats, follow(ours, every)) / o.batch,
        "gradient": best(o.repeats, lambda: solve_and_differentiate(ours, every)) / o.batch,
        "ipopt cold": best(slow, lambda: solve(ipopt, few)) / o.ipopt_batch,
        "ipopt warm": best(slow, follow(ipopt, few)) / o.ipopt_batch,
        "ipopt gradient": best(slow, lambda: solve_and_differentiate(ipopt, few)) / o.ipopt_batch,
    }


def convergence(o: Options) -> tuple[int, int]:
    """Problems solved to the tolerance, and their number, over pushing, random, untrained and given models."""
    solved = total = 0
    models = [make(n_lam, seed) for make in MODELS.values() for n_lam in (5, 8) for seed in range(4)]
    models += [LCSModel.from_pretrained(path).params().detach() for path in o.models]
    count = max(1, o.share // len(models))
    for i, model in enumerate(models):
        x0, goal = states_and_goals(count, seed=100 + i)
        with torch.no_grad():
            plan = layer(model, BatchedBackend(tol=1e-6))(x0, goal)
        solved += int(plan.converged.sum())
        total += count
    return solved, total


def general_path(o: Options) -> dict[int, float]:
    """Seconds per problem for n_lam 4 … 9: sizes 5 and 8 have compile-time code, the others the general one."""
    times = {}
    for n_lam in range(4, 10):
        x0, goal = states_and_goals(o.batch, seed=1)
        mpc = layer(pushing_model(n_lam, seed=0), BatchedBackend(threads=1))
        with torch.no_grad():
            iterations = float(mpc(x0, goal).iterations.double().mean())
            seconds = best(o.repeats, lambda mpc=mpc, x0=x0, goal=goal: mpc(x0, goal))
        times[n_lam] = seconds / o.batch / iterations
    return times


def threads(o: Options) -> float:
    """Speed of two threads over one."""
    x0, goal = states_and_goals(o.batch, seed=1)
    model = pushing_model(5, seed=0)
    one, two = (layer(model, BatchedBackend(threads=n)) for n in (1, 2))
    with torch.no_grad():
        return best(o.repeats, lambda: one(x0, goal)) / best(o.repeats, lambda: two(x0, goal))


def violation_times(o: Options, count: int) -> tuple[float, float]:
    """Seconds for `violation_loss` with its gradient on `count` transitions: ours, and a loop over CasADi + qpOASES.

    The loop is how the prior work does it: one QP per transition, then one call for the gradient of the loss at its
    solution.
    """
    n_lam, gamma, xi = 5, 0.1, 0.01
    generator = torch.Generator().manual_seed(0)
    model = LCSModel(9, 6, n_lam, init_scale=0.3, generator=generator)
    x, u, x_next = (torch.randn(count, n, generator=generator, dtype=torch.float64) for n in (9, 6, 9))

    def ours() -> None:
        model.zero_grad()
        violation_loss(model, x, u, x_next, gamma, xi).backward()

    p = {k: v.detach().numpy() for k, v in model.params().tensors().items()}
    weight = 1 / (gamma * xi)
    coupling = np.eye(n_lam) / xi - weight * p["F"].T
    Q = np.block([[p["C"].T @ p["C"] + weight * p["F"].T @ p["F"], coupling], [coupling.T, weight * np.eye(n_lam)]])
    free = x.numpy() @ p["A"].T + u.numpy() @ p["B"].T + p["d"] - x_next.numpy()
    gap = x.numpy() @ p["D"].T + u.numpy() @ p["E"].T + p["c"]
    q = np.hstack([free @ p["C"] + weight * gap @ p["F"], -weight * gap])
    solver = casadi.conic(
        "qp",
        "qpoases",
        {"h": casadi.Sparsity.dense(2 * n_lam, 2 * n_lam), "a": casadi.Sparsity(0, 2 * n_lam)},
        {"printLevel": "none"},
    )
    symbols = {k: casadi.SX.sym(k, *(v.shape if v.ndim == 2 else (len(v), 1))) for k, v in p.items()}
    data = [casadi.SX.sym(name, n) for name, n in (("x", 9), ("u", 6), ("x_next", 9), ("z", 2 * n_lam))]
    lam, phi = data[3][:n_lam], data[3][n_lam:]
    r = symbols["A"] @ data[0] + symbols["B"] @ data[1] + symbols["C"] @ lam + symbols["d"] - data[2]
    e = symbols["D"] @ data[0] + symbols["E"] @ data[1] + symbols["F"] @ lam + symbols["c"] - phi
    loss = casadi.dot(r, r) / 2 + (casadi.dot(lam, phi) + casadi.dot(e, e) / (2 * gamma)) / xi
    gradients = [casadi.gradient(loss, symbol) for symbol in symbols.values()]
    differentiate = casadi.Function("gradient", [*symbols.values(), *data], gradients)
    H, parameters = casadi.DM(Q), [casadi.DM(v) for v in p.values()]

    def peer() -> None:
        for i, row in enumerate(q):
            z = solver(h=H, g=row, lbx=0.0)["x"]
            differentiate(*parameters, x[i].numpy(), u[i].numpy(), x_next[i].numpy(), z)

    return best(3 * o.repeats, ours), best(max(1, o.repeats // 2), peer)


def lcp_time(o: Options) -> float:
    """Seconds for 100 000 LCPs with n = 8, each with its own matrix."""
    count = 2_000 if o.smoke else 100_000
    generator = torch.Generator().manual_seed(0)
    G = torch.randn(count, 8, 8, generator=generator, dtype=torch.float64)
    F = G @ G.mT + 0.1 * torch.eye(8, dtype=torch.float64) + G - G.mT
    q = torch.randn(count, 8, generator=generator, dtype=torch.float64)
    return best(o.repeats, lambda: solve_lcp(F, q))


def main(o: Options) -> None:
    """Measure, print, write."""
    if o.smoke:
        o.batch, o.ipopt_batch, o.share, o.repeats = 64, 4, 240, 1
    torch.set_num_threads(1)
    rows: list[tuple[str, str, str]] = []
    numbers: dict[str, object] = {}
    for n_lam in (5, 8):
        t = mpc_times(n_lam, o)
        numbers[f"n_lam {n_lam}"] = t
        for name, target in (("cold", 150), ("warm", 400), ("gradient", 120)):
            # The target of the warm start is against IPOPT's cold start, as every throughput target.
            reference = t["ipopt gradient"] if name == "gradient" else t["ipopt cold"]
            ratio = reference / t[name]
            label = "forward + backward" if name == "gradient" else f"forward, {name} start"
            rows.append(
                (f"n_lam {n_lam}, {label}", f"{1e6 * t[name]:.1f} µs", f"{ratio:.0f}× IPOPT (target {target}×)")
            )
            numbers[f"n_lam {n_lam} {name} ratio"] = ratio
        ratio = t["ipopt warm"] / t["warm"]
        rows.append((f"n_lam {n_lam}, both warm", "", f"{ratio:.0f}× IPOPT"))
    general = general_path(o)
    numbers["seconds per iteration by n_lam"] = general
    worst = max(general[4] / general[5], general[6] / general[8], general[7] / general[8])
    rows.append(
        ("general code at n_lam 4, 6, 7 against compiled 5, 8, 8", "", f"{worst:.2f}× per iteration (limit 2×)")
    )
    solved, total = convergence(o)
    numbers["converged"], numbers["converged of"] = solved, total
    rows.append(("projected gradient < 1e-6", f"{solved} of {total}", f"{100 * solved / total:.2f} % (target 99.9 %)"))
    numbers["two threads"] = threads(o)
    rows.append(("two threads", "", f"{numbers['two threads']:.2f}× one (target 1.7×)"))
    for count in (100, 1000):
        ours, peer = violation_times(o, count)
        numbers[f"violation loss {count}"], numbers[f"qpoases loop {count}"] = ours, peer
        label = f"violation_loss with gradient, {count} transitions"
        rows.append((label, f"{1e3 * ours:.2f} ms", f"{peer / ours:.0f}× CasADi/qpOASES loop (target 50×)"))
    numbers["lcp"] = lcp_time(o)
    rows.append(("solve_lcp, 100 000 problems, n 8", f"{numbers['lcp']:.3f} s", ""))
    versions = {"difflcs": difflcs.__version__, "torch": torch.__version__, "casadi": casadi.__version__}
    record = {
        "machine": {"cpu": cpu(), "cores": os.cpu_count(), "instruction set": _kernels.isa()},
        "versions": {"python": platform.python_version(), **versions},
        "options": {
            "batch": o.batch,
            "ipopt_batch": o.ipopt_batch,
            "repeats": o.repeats,
            "learned models": len(o.models),
        },
        "results": numbers,
    }
    print(f"{record['machine']['cpu']}, {_kernels.isa()}, one core, batch {o.batch}; IPOPT on {o.ipopt_batch}")
    for row in rows:
        print(f"{row[0]:56s} {row[1]:>14s}   {row[2]}")
    save(o.out, record)


if __name__ == "__main__":
    main(tyro.cli(Options))
