"""Rules of batches, on healthy problems: broken neighbours change no bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.random import Generator

from difflcs import solve_lcp
from difflcs.errors import DiffLCSError
from tests.conformance.hostile.generators import LCP
from tests.conformance.hostile.targets import INPUTS, REFUSED, Outcome, layer_of, leaves_of, quiet


def _break(problem, rng: Generator):
    """The same problems, each broken in one way: overflow, a nearly skew F, no cost, huge states."""
    if isinstance(problem, LCP):
        F, q = problem.F.copy(), problem.q.copy()
        K = rng.standard_normal(F.shape)
        skew = K - K.swapaxes(-1, -2) + 1e-12 * np.eye(F.shape[-1])
        kind = rng.integers(0, 4, len(q))
        F = np.where((kind == 0)[:, None, None], skew, F)
        F = np.where((kind == 1)[:, None, None], 1e300 * F, F)
        F = np.where((kind == 2)[:, None, None], -F, F)
        return LCP(F, np.where((kind == 3)[:, None], 1e305 * q, q))
    a = {k: v.copy() for k, v in problem.arrays.items()}
    kind = rng.integers(0, 4, problem.count)
    K = rng.standard_normal(a["F"].shape)
    a["F"][kind == 0] = (K - K.swapaxes(-1, -2) + 1e-10 * np.eye(K.shape[-1]))[kind == 0]
    a["A"][kind == 1] *= 1e60
    for name in ("Q", "R", "Q_final", "q", "r", "q_final"):
        a[name][kind == 2] = 0.0
    a["x0"][kind == 3] *= 1e100
    return replace(problem, arrays=a)


def _run(problem) -> list[np.ndarray]:
    """Every number of the results and the gradients that belongs to one element."""
    if isinstance(problem, LCP):
        leaves = {"F": torch.from_numpy(problem.F.copy()), "q": torch.from_numpy(problem.q.copy())}
        for v in leaves.values():
            v.requires_grad_()
        solution = solve_lcp(leaves["F"], leaves["q"], 1e-4)
        out = [solution.lam, solution.w, solution.status]
    else:
        leaves = leaves_of(problem)
        plan = layer_of(problem, leaves)(leaves["x0"])
        out = [plan.status, plan.x, plan.u, plan.lam, plan.objective, plan.kkt_residual, plan.iterations]
    total = sum(v.reshape(len(v), -1).sum(-1) for v in out if v.requires_grad)
    assert isinstance(total, torch.Tensor)
    total.sum().backward()
    return [v.detach().numpy() for v in [*out, *(leaf.grad for leaf in leaves.values() if leaf.grad is not None)]]


def neighbours(problem, rng: Generator, gradients: bool) -> Outcome:
    """Healthy elements beside broken ones: every number of theirs is that of the batch without them, bit for bit."""
    problem = problem.each()
    count = problem.count
    place = rng.permutation(2 * count)
    good, bad = np.sort(place[:count]), np.sort(place[count:])
    broken = _break(problem, rng)

    def merge(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        out = np.empty((2 * count, *a.shape[1:]), a.dtype)
        out[good], out[bad] = a, b
        return out

    if isinstance(problem, LCP):
        mixed = LCP(merge(problem.F, broken.F), merge(problem.q, broken.q))
    else:
        mixed = replace(problem, arrays={k: merge(problem.arrays[k], broken.arrays[k]) for k in INPUTS})
    with quiet(), np.errstate(all="ignore"):
        try:
            alone, together = _run(problem), _run(mixed)
        except DiffLCSError:
            return Outcome(np.full(count, REFUSED), {"neighbours": np.zeros(count)})
    worst = np.zeros(count)
    for a, b in zip(alone, together, strict=True):
        same = (a == b[good]) | ((a != a) & (b[good] != b[good]))
        worst[~same.reshape(count, -1).all(1)] = np.inf
    status = alone[2] if isinstance(problem, LCP) else alone[0]
    return Outcome(status.astype(int), {"neighbours": worst})


RULE_TARGETS = {"neighbours": neighbours}
