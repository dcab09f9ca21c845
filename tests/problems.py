"""Random MPC problems of every kind, built field by field as `MPCProblem` takes them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from difflcs.mpc.backends import BatchedBackend
from difflcs.mpc.problem import INPUTS, STAGES, MPCProblem

SYSTEM = ("A", "B", "C", "d", "D", "E", "F", "c")


@dataclass(frozen=True)
class Kind:
    """What a problem has.

    Attributes:
        by_stage: system, cost and bounds vary by stage.
        own: every element has a system of its own.
        cross: the cost has xᵀSu.
        unbounded: actions have no bounds but one.
        rows: constraints of a stage.
        price: of their violation; infinite for hard ones.
        tight: by how much, in parts of its size, the plan without constraints violates them.
    """

    n_x: int = 4
    n_u: int = 2
    n_lam: int = 3
    horizon: int = 6
    batch: int = 20
    by_stage: bool = False
    own: bool = False
    cross: bool = False
    unbounded: bool = False
    rows: int = 0
    price: float = torch.inf
    tight: float = 0.1
    relaxation: float = 1e-4


KINDS = {
    "plain": Kind(),
    "cross": Kind(cross=True),
    "by stage": Kind(by_stage=True),
    "own": Kind(own=True),
    "own by stage": Kind(own=True, by_stage=True, cross=True),
    "unbounded": Kind(unbounded=True),
    "no contacts": Kind(n_lam=0),
    "constraints": Kind(rows=2),
    "soft constraints": Kind(rows=2, price=0.5, tight=0.3),
    "everything": Kind(own=True, by_stage=True, cross=True, unbounded=True, rows=2),
    "the paper's sizes": Kind(n_x=9, n_u=6, n_lam=5, horizon=4, rows=2, own=True),
}


def random_problem(seed: int, kind: Kind) -> MPCProblem:
    """A batch of stable systems with contacts that act, and constraints that the plan without them violates."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> Tensor:
        return torch.from_numpy(rng.standard_normal(shape))

    def varied(value: Tensor, by_stage: bool, own: bool, scale: float = 0.05) -> Tensor:
        lead = ((kind.batch if own else 1), kind.horizon) if by_stage else (kind.batch,) if own else ()
        return value + scale * normal(*lead, *value.shape) if lead else value

    n_x, n_u, n_lam = kind.n_x, kind.n_u, kind.n_lam
    eye, root, weight = torch.eye(n_x).double(), normal(n_lam, n_lam), normal(n_x, n_x)
    system = {
        "A": 0.9 * eye + 0.3 / n_x * normal(n_x, n_x),
        "B": 0.5 * normal(n_x, n_u),
        "C": 0.3 * normal(n_x, n_lam),
        "d": 0.05 * normal(n_x),
        "D": 0.6 * normal(n_lam, n_x),
        "E": 0.5 * normal(n_lam, n_u),
        "F": 0.3 * root @ root.mT + 0.5 * torch.eye(n_lam).double(),
        "c": 0.3 * normal(n_lam),
    }
    fields = {name: varied(value, kind.by_stage, kind.own) for name, value in system.items()}
    Q = weight @ weight.mT / n_x + 0.1 * eye
    high = torch.full((n_u,), torch.inf if kind.unbounded else 1.0).double()
    low = -high
    if kind.unbounded:
        low[0] = -1.0
    fields |= {
        "Q": Q + torch.linspace(0, 0.5, kind.horizon).double()[:, None, None] * eye if kind.by_stage else Q,
        "R": 0.2 * torch.eye(n_u).double(),
        "Q_final": 2 * Q,
        "q": varied(0.1 * normal(n_x), kind.by_stage, kind.by_stage),
        "r": 0.05 * normal(n_u),
        "q_final": 0.1 * normal(n_x),
        "u_min": varied(low, kind.by_stage, False),
        "u_max": varied(high, kind.by_stage, False),
        "x0": normal(kind.batch, n_x),
    }
    if kind.by_stage:
        fields["Q"] = fields["Q"].unsqueeze(0)
    if kind.cross:
        fields["S"] = 0.05 * normal(n_x, n_u)
    problem = MPCProblem(**fields, horizon=kind.horizon, relaxation=kind.relaxation)
    return constrained(problem, rng, kind) if kind.rows else problem


def constrained(problem: MPCProblem, rng: np.random.Generator, kind: Kind) -> MPCProblem:
    """The same problems with constraints from stage 1 on, each of which the plan without them violates."""
    plan = BatchedBackend().solve(problem, None).primal
    G_x = torch.from_numpy(rng.standard_normal((kind.rows, problem.n_x)))
    G_u = 0.3 * torch.from_numpy(rng.standard_normal((kind.rows, problem.n_u)))
    price = torch.full((kind.rows,), kind.price).double()
    g = torch.full((problem.batch, problem.horizon + 1, kind.rows), torch.inf).double()
    free = replace(problem, G_x=G_x, G_u=G_u, g=torch.zeros(kind.rows).double(), price=price)
    top = free.constraints(plan.x, plan.u)[:, 1:].amax(1)
    g[:, 1:] = (top - kind.tight * top.abs()).unsqueeze(1)
    return replace(free, g=g)


def stated_by_stage(problem: MPCProblem) -> MPCProblem:
    """The same problem with every field that may be given by stage given so."""
    fields = {}
    for name in INPUTS:
        value = getattr(problem, name)
        if STAGES[name] and not problem.by_stage(name) and value.numel():
            value = (value.unsqueeze(0) if problem.shared(name) else value).unsqueeze(1)
            fields[name] = value.expand(-1, problem.stages(name), *value.shape[2:]).contiguous()
    return replace(problem, **fields)
