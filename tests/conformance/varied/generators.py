"""Random LCS-MPC problems of every form, one seeded batch of equal shape each. NumPy only, but for the free plan."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.random import Generator

from difflcs.mpc.backends import BatchedBackend
from difflcs.mpc.problem import STAGES
from tests.conformance.cases import Case

INF = np.inf


def random_case(seed: int, batch: int = 8, n_lam: int | None = None, rows: bool = True) -> Case:
    """A batch whose sizes, forms and numbers follow from the seed: n_x 2 to 12, n_lam 0 to 12, H 1 to 40."""
    rng = np.random.default_rng([seed, 18])
    n_x, n_u = int(rng.integers(2, 13)), int(rng.integers(1, 5))
    drawn = 0 if rng.random() < 0.15 else int(rng.integers(1, 13))
    n_lam = drawn if n_lam is None else n_lam
    horizon = int(np.round(np.exp(rng.uniform(0, np.log(40)))))
    form = _Form(rng, batch, horizon)
    eye, weight, root = np.eye(n_x), rng.standard_normal((n_x, n_x)), rng.standard_normal((n_lam, n_lam))
    contact = min(1.0, (3 / max(n_lam, 1)) ** 0.5)
    Q = weight @ weight.T / n_x + 0.1 * eye
    normal = rng.standard_normal
    base = {
        "A": 0.9 * eye + 0.3 / n_x * normal((n_x, n_x)),
        "B": 0.5 * normal((n_x, n_u)),
        "C": 0.3 * contact * normal((n_x, n_lam)),
        "d": 0.05 * normal(n_x),
        "D": 0.6 * normal((n_lam, n_x)),
        "E": 0.5 * normal((n_lam, n_u)),
        "F": 0.3 * root @ root.T / max(n_lam, 1) ** 0.5 + 0.5 * np.eye(n_lam),
        "c": 0.3 * normal(n_lam),
        "q": 0.1 * normal(n_x),
        "r": 0.05 * normal(n_u),
        "q_final": 0.1 * normal(n_x),
    }
    arrays = {name: form.vary(name, value) for name, value in base.items()}
    arrays |= {name: form.scale(name, value) for name, value in (("Q", Q), ("R", 0.2 * np.eye(n_u)))}
    arrays["Q_final"] = form.scale("Q_final", 2 * Q)
    cross = 0.05 * normal((n_x, n_u)) / n_x**0.5 if rng.random() < 0.5 else np.zeros((n_x, n_u))
    arrays["S"] = form.scale("S", cross)
    low, high = -rng.uniform(0.2, 1.5, n_u), rng.uniform(0.2, 1.5, n_u)
    low[rng.random(n_u) < 0.3] = -INF
    high[rng.random(n_u) < 0.3] = INF
    arrays |= {"u_min": form.scale("u_min", low), "u_max": form.scale("u_max", high)}
    arrays["x0"] = normal((batch, n_x))
    case = Case(arrays, horizon, float(rng.choice([1e-3, 1e-4, 1e-5])))
    return _constrained(case, rng, form) if rows and rng.random() < 0.9 else case


@dataclass(frozen=True)
class _Form:
    """Which inputs are given per element or by stage."""

    rng: Generator
    batch: int
    horizon: int

    def lead(self, name: str) -> tuple[int, ...]:
        own, staged = self.rng.random() < 0.4, self.rng.random() < 0.5 and STAGES[name] != ""
        stages = self.horizon + (STAGES[name] == "H+1")
        if staged:
            return (self.batch if own else 1, stages)
        return (self.batch,) if own else ()

    def vary(self, name: str, value: np.ndarray) -> np.ndarray:
        lead = self.lead(name)
        size = 0.05 / max(value.shape[-1], 1) ** 0.5
        return value + size * self.rng.standard_normal((*lead, *value.shape)) if lead else value

    def scale(self, name: str, value: np.ndarray) -> np.ndarray:
        """Another size at each: definite matrices stay definite."""
        lead = self.lead(name)
        factor = self.rng.uniform(0.6, 1.4, (*lead, *[1] * value.ndim)) if lead else 1.0
        return np.array(value * factor)


def _constrained(case: Case, rng: Generator, form: _Form) -> Case:
    """Rows that the plan without them violates. Two thirds of the cases keep a plan that is known to meet them."""
    n_x, n_u = case.inputs["B"].shape[-2:]
    n_c, batch, horizon = int(rng.integers(1, 5)), case.count, case.horizon
    G_x = rng.standard_normal((n_c, n_x)) * (rng.random((n_c, 1)) < 0.9)
    G_u = 0.5 * rng.standard_normal((n_c, n_u)) * ((rng.random((n_c, 1)) < 0.5) | ~G_x.any(1, keepdims=True))
    price = np.where(rng.random(n_c) < 0.5, INF, np.exp(rng.uniform(-4, 2, n_c)))
    arrays = {**case.inputs, "G_x": form.vary("G_x", G_x) * (G_x != 0), "G_u": form.vary("G_u", G_u) * (G_u != 0)}
    arrays["price"] = form.scale("price", price)
    arrays["g"] = np.zeros(n_c)
    problem = replace(case, inputs=arrays).problem()
    # Of a plant that runs away a thousand iterations from each start would take a minute.
    free = BatchedBackend(threads=1, max_iter=200).solve(case.problem(), None).primal
    known = rng.random() < 0.67
    noise = torch.from_numpy(rng.standard_normal((batch, horizon, n_u)))
    u = problem.clip(free.u + 0.3 * (0.1 + free.u.abs().mean()) * noise) if known else free.u
    x, _ = problem.rollout(u)
    c = problem.constraints(x, u).numpy()
    slack = 0.2 * np.abs(rng.standard_normal(c.shape)) * (rng.random(c.shape) < 0.7)
    if not known:  # perhaps nothing can meet them
        slack = -np.abs(rng.choice([0.02, 0.1, 0.3]) * c)
    if rng.random() < 0.4:  # one limit for all stages
        g = np.where(np.arange(horizon + 1)[:, None] == 0, -INF, c + slack).max(1, keepdims=True)
        g = np.broadcast_to(g, c.shape).copy()
        g[:, 0] = np.maximum(g[:, 0], c[:, 0] + 0.1)
    else:
        g = c + slack
        # At most half of the actions are spoken for at each stage, or nothing would be left to choose.
        g[rng.random(g.shape) < max(0.5, 1 - 0.5 * n_u / n_c)] = INF
    g[:, 0] = np.maximum(g[:, 0], c[:, 0]) if known else INF
    return replace(case, inputs={**arrays, "g": g}, witness=u.numpy() if known else None)
