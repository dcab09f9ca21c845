"""Speed of the MPC layer on this machine, against IPOPT in the same run: `difflcs bench`."""

import json
import platform
import timeit
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import difflcs
from difflcs import LCSModel, LCSMPCLayer, LCSParams, _storage
from difflcs._checks import check_positive_int
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.mpc.backends import BatchedBackend, IpoptBackend
from difflcs.systems import pushing_cost

ACTION_LIMIT = 0.015
"""Bound of each action [m], as in the pushing tasks."""


@dataclass(frozen=True)
class Timing:
    """Time of one kind of work, per problem, the best of some repetitions.

    Attributes:
        work: name of the work.
        batched: seconds on one core.
        threads: seconds with all threads.
        ipopt: seconds of backend ipopt on one core.
    """

    work: str
    batched: float
    threads: float
    ipopt: float

    @property
    def ratio(self) -> float:
        """Speed as a multiple of IPOPT's, on one core each."""
        return self.ipopt / self.batched


def measure(batch: int, ipopt_batch: int, repeats: int, threads: int) -> list[Timing]:
    """Time the paper's MPC around a synthetic pushing model of 5 contacts: forward, and forward with backward.

    Both backends solve problems of one distribution through the same layer, tensors in, tensors out. Absolute times of
    a shared machine mean little; the ratio says more.

    Args:
        batch: problems per call of backend batched.
        ipopt_batch: problems per call of backend ipopt.
        repeats: timings, the best counts; IPOPT gets a third of them.
        threads: threads of the second timing of backend batched.

    Returns:
        One timing per kind of work.
    """
    for name, value in (("batch", batch), ("ipopt_batch", ipopt_batch), ("repeats", repeats), ("threads", threads)):
        check_positive_int(name, value)
    model = LCSModel.from_params(pushing_model(n_lam=5, seed=0))
    x0, goal = states_and_goals(max(batch, ipopt_batch), seed=1)
    candidates = (
        (BatchedBackend(threads=1), batch, repeats),
        (BatchedBackend(threads=threads), batch, repeats),
        (IpoptBackend(workers=1), ipopt_batch, max(1, repeats // 3)),
    )
    timings = []
    for work, run in (("forward", _solve), ("forward + backward", _differentiate)):
        seconds = []
        for backend, count, times in candidates:
            mpc = LCSMPCLayer(model, pushing_cost(), 5, -ACTION_LIMIT, ACTION_LIMIT, backend=backend, on_failure="mask")
            seconds.append(best(times, lambda mpc=mpc, run=run, n=count: run(mpc, x0[:n], goal[:n])) / count)
        timings.append(Timing(work, *seconds))
    return timings


def _solve(mpc: LCSMPCLayer, x0: Tensor, goal: Tensor) -> None:
    with torch.no_grad():
        mpc(x0, goal)


def _differentiate(mpc: LCSMPCLayer, x0: Tensor, goal: Tensor) -> None:
    mpc.zero_grad()
    mpc(x0, goal).action.square().sum().backward()


def table(timings: Sequence[Timing], threads: int) -> str:
    """Format the timings as text."""
    columns = ("", "batched", f"{threads} threads" if threads > 1 else "", "ipopt", "ipopt / batched")
    rows = [
        (t.work, _short(t.batched), _short(t.threads) if threads > 1 else "", _short(t.ipopt), f"{t.ratio:.0f}×")
        for t in timings
    ]
    lines = ["{:<18}{:>12}{:>12}{:>12}{:>18}".format(*row) for row in (columns, *rows)]
    return "\n".join(lines)


def _short(seconds: float) -> str:
    return f"{1e6 * seconds:.0f} µs" if seconds < 1e-3 else f"{1e3 * seconds:.1f} ms"


def best(repeats: int, work: Callable[[], object]) -> float:
    """Measure the shortest time [s] of several runs, after one that does not count."""
    work()
    return min(timeit.repeat(work, repeat=repeats, number=1))


def smoke_path(path: Path) -> Path:
    """Return the path of a record of `--smoke`, beside the one that is tracked."""
    return path.with_stem(f"{path.stem}-smoke")


def save(path: Path, record: dict) -> None:
    """Write the record of a benchmark as JSON, atomically; its keys keep their order."""
    _storage.write_atomically(path, (json.dumps(record, indent=2, ensure_ascii=False) + "\n").encode())
    print(f"written to {path}")


def machine() -> dict[str, str]:
    """Describe the machine: processor, instruction set and versions."""
    return {
        "cpu": cpu(),
        "instruction set": _kernels.isa(),
        "difflcs": difflcs.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def cpu() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def pushing_model(n_lam: int, seed: int) -> LCSParams:
    """Make a model of fingertips that move as commanded and push an object: n_x 9, n_u 6, random contact directions."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    A = torch.eye(9, dtype=torch.float64) + 0.02 * normal(9, 9)
    B = 0.05 * normal(9, 6)
    B[3:] += torch.eye(6, dtype=torch.float64)
    G, H = 0.5 * normal(n_lam, n_lam), 0.3 * normal(n_lam, n_lam)
    F = G @ G.mT + 0.3 * torch.eye(n_lam, dtype=torch.float64) + H - H.mT
    C, D, E = 0.3 * normal(9, n_lam), normal(n_lam, 9), 2 * normal(n_lam, 6)
    return LCSParams(A, B, C, 0.001 * normal(9), D, E, F, 0.02 * normal(n_lam))


def states_and_goals(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Draw states (count, 9) of a hand around an object near the origin, and goals (count, 3) of the paper's task."""
    generator = torch.Generator().manual_seed(seed)
    angles = torch.deg2rad(torch.tensor([90.0, -30.0, 210.0], dtype=torch.float64))
    home = 0.08 * torch.stack([angles.cos(), angles.sin()], 1).reshape(1, 6)
    state = torch.cat([torch.zeros(1, 3, dtype=torch.float64), home], 1).expand(count, 9)
    noise = 2 * torch.rand(count, 9, generator=generator, dtype=torch.float64) - 1
    size = torch.tensor([0.05, 0.05, 0.3] + [0.03] * 6, dtype=torch.float64)
    goal = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    return state + size * noise, goal * torch.tensor([0.06, 0.06, 0.5], dtype=torch.float64)
