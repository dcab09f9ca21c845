"""Rules of batches, on healthy LCPs: broken neighbours change no bit. Of plans: `forms.untouched`."""

from __future__ import annotations

import numpy as np
import torch
from numpy.random import Generator

from difflcs import solve_lcp
from difflcs.errors import DiffLCSError
from tests.conformance.hostile.generators import LCP
from tests.conformance.hostile.targets import REFUSED, Outcome, quiet


def _break(problem: LCP, rng: Generator) -> LCP:
    """The same problems, each broken in one way: overflow, a nearly skew F, a negative one, a huge q."""
    K = rng.standard_normal(problem.F.shape)
    skew = K - K.swapaxes(-1, -2) + 1e-12 * np.eye(problem.F.shape[-1])
    kind = rng.integers(0, 4, problem.count)[:, None, None]
    F = np.select([kind == 0, kind == 1, kind == 2], [skew, 1e300 * problem.F, -problem.F], problem.F)
    return LCP(F, np.where(kind[..., 0] == 3, 1e305 * problem.q, problem.q))


def _run(problem: LCP) -> list[np.ndarray]:
    """Every number of the results and the gradients that belongs to one element."""
    leaves = [torch.from_numpy(v.copy()).requires_grad_() for v in (problem.F, problem.q)]
    solution = solve_lcp(*leaves, 1e-4)
    (solution.lam.sum() + solution.w.sum()).backward()
    results = (solution.status, solution.lam, solution.w, *(leaf.grad for leaf in leaves))
    return [v.detach().numpy() for v in results if v is not None]


def neighbours(problem: LCP, rng: Generator, gradients: bool) -> Outcome:
    """Healthy elements beside broken ones: every number of theirs is that of the batch without them, bit for bit."""
    problem = problem.each()
    place = rng.permutation(2 * problem.count)
    broken = _break(problem, rng)
    mixed = LCP(*(np.concatenate(pair)[place] for pair in ((problem.F, broken.F), (problem.q, broken.q))))
    good = np.argsort(place)[: problem.count]
    with quiet(), np.errstate(all="ignore"):
        try:
            alone, together = _run(problem), _run(mixed)
        except DiffLCSError:
            return Outcome(np.full(problem.count, REFUSED), {"neighbours": np.zeros(problem.count)})
    same = [np.equal(a, b[good]).reshape(problem.count, -1).all(1) for a, b in zip(alone, together, strict=True)]
    return Outcome(alone[0].astype(int), {"neighbours": np.where(np.all(same, axis=0), 0.0, np.inf)})


RULE_TARGETS = {"neighbours": neighbours}
