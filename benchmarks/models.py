"""Problems the benchmarks solve: synthetic pushing models, random ones, the zoo, a cart-pole, carts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from difflcs import LCSModel, LCSParams, QuadraticCost
from difflcs.cli.bench import ACTION_LIMIT, pushing_model, states_and_goals
from difflcs.systems import cart_pole_between_walls, pushing_cost


def random_model(n_lam: int, seed: int, n_x: int = 9, n_u: int = 6) -> LCSParams:
    """Make an `LCSModel` with random parameters of size 0.3, without structure."""
    generator = torch.Generator().manual_seed(seed)
    return LCSModel(n_x, n_u, n_lam, init_scale=0.3, generator=generator).params().detach()


def chain_of_carts(carts: int, dt: float = 0.05, stiffness: float = 100.0) -> LCSParams:
    """Make carts of 1 kg, 0.2 m apart, between walls 1 m away; the first is pushed, the others hit by their neighbours.

    States are displacements [m] and velocities [m/s]; n_lam = carts + 1 gaps, semi-implicit as in `difflcs.systems`.
    """
    eye = torch.eye(carts, dtype=torch.float64)
    gaps = torch.cat([eye[:1], eye[1:] - eye[:-1], -eye[-1:]])
    c = torch.full((carts + 1,), 0.2, dtype=torch.float64)
    c[[0, -1]] = 1.0
    A = torch.cat([torch.cat([eye, dt * eye], 1), torch.cat([0 * eye, eye], 1)])
    B, C = torch.cat([dt * dt * eye[:, :1], dt * eye[:, :1]]), torch.cat([dt * dt * gaps.T, dt * gaps.T])
    measured = torch.cat([gaps, 0 * gaps], 1)
    F = measured @ C + torch.eye(carts + 1, dtype=torch.float64) / stiffness
    zero = torch.zeros(2 * carts, dtype=torch.float64)
    return LCSParams(A=A, B=B, C=C, d=zero, D=measured @ A, E=measured @ B, F=F, c=c)


def push_the_last_cart(carts: int, horizon: int, others: float = 0.0) -> QuadraticCost:
    """Make the cost of the last cart's distance to 0.3 m further, little on the first and `others` on the others."""
    weight = torch.full((2 * carts,), 0.01, dtype=torch.float64)
    weight[1:carts] = others
    weight[0], weight[carts - 1] = 0.1, 10.0
    q = torch.zeros(2 * carts, dtype=torch.float64)
    q[carts - 1] = -0.3 * 10.0
    missed = torch.tensor(0.5 * 10.0 * 0.3**2 * (horizon + 10), dtype=torch.float64)
    Q = torch.diag(weight)
    return QuadraticCost(Q, diagonal(1e-4), 10 * Q, q=q, q_final=10 * q, constant=missed)


@dataclass(frozen=True)
class Instance:
    """A batch of problems: arguments of `LCSMPCLayer` and of its call."""

    layer: dict[str, Any]
    call: tuple[Tensor, ...]


def make(lcs: LCSParams, cost: Any, horizon: int, limit: float, *call: Tensor) -> Instance:
    """Make an instance with actions between −limit and limit."""
    return Instance({"lcs": lcs, "cost": cost, "horizon": horizon, "u_min": -limit, "u_max": limit}, call)


def uniform(size: list[float], count: int, seed: int) -> Tensor:
    """Draw states (count, n_x) between −size and size."""
    generator = torch.Generator().manual_seed(seed)
    half = torch.tensor(size, dtype=torch.float64)
    return half * (2 * torch.rand(count, len(size), generator=generator, dtype=torch.float64) - 1)


def diagonal(*weights: float) -> Tensor:
    """Make a diagonal matrix."""
    return torch.diag(torch.tensor(weights, dtype=torch.float64))


def pushing(lcs: LCSParams, count: int, seed: int, horizon: int = 5) -> Instance:
    """Make the task of the cube: its cost, and actions of 15 mm."""
    return make(lcs, pushing_cost(), horizon, ACTION_LIMIT, *states_and_goals(count, seed))


def to_rest(lcs: LCSParams, horizon: int, count: int, seed: int, final: float = 1.0) -> Instance:
    """Bring any model to rest; `final` is the weight of its last state."""
    eye = torch.eye(lcs.n_x, dtype=torch.float64)
    cost = QuadraticCost(eye, 0.1 * torch.eye(lcs.n_u, dtype=torch.float64), final * eye)
    x0 = torch.randn(count, lcs.n_x, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return make(lcs, cost, horizon, 1.0, x0)


def _cart_pole(horizon: int, dt: float, stiffness: float, count: int) -> Instance:
    """Make a cart-pole that stays upright, or leans on a wall."""
    lcs = cart_pole_between_walls(dt=dt, wall_stiffness=stiffness)
    cost = QuadraticCost(diagonal(1, 1, 0.1, 0.1), diagonal(0.01), diagonal(100, 100, 1, 1))
    x0 = uniform([0.02, 0.05, 0.1, 0.3], count, horizon)
    return make(lcs, cost, horizon, 10.0, x0)


def chain(lcs: LCSParams, horizon: int, count: int, seed: int, others: float = 0.0) -> Instance:
    """Push the last cart 0.3 m further, through all others; see `push_the_last_cart`."""
    carts = lcs.n_x // 2
    x0 = uniform([0.3] * carts + [0.5] * carts, count, seed)  # some touch or overlap
    return make(lcs, push_the_last_cart(carts, horizon, others), horizon, 50.0, x0)


OBJECTS = ("cube", "mug", "wrench", "banana")

# `count` problems of each of a family's models.
FAMILIES: dict[str, Callable[[int], list[Instance]]] = {
    "pushing, n_lam 5": lambda count: [pushing(pushing_model(5, seed), count, seed) for seed in range(4)],
    "pushing, n_lam 8": lambda count: [pushing(pushing_model(8, seed), count, seed) for seed in range(4)],
    "zoo": lambda count: [
        pushing(LCSModel.from_pretrained(f"zoo:trifinger-{name}").params().detach(), count, 10 + i)
        for i, name in enumerate(OBJECTS)
    ],
    "random, n_lam 5, H 10": lambda count: [to_rest(random_model(5, seed), 10, count, seed, 10.0) for seed in range(4)],
    "cart-pole, H 30": lambda count: [_cart_pole(30, 0.04, stiffness, count) for stiffness in (10.0, 100.0)],
    "cart-pole, H 50": lambda count: [_cart_pole(50, 0.02, stiffness, count) for stiffness in (10.0, 100.0)],
    "4 carts": lambda n: [chain(chain_of_carts(4), 20, n, 24), chain(chain_of_carts(4, 0.1, 1e3), 10, n, 14)],
    "10 carts": lambda count: [chain(chain_of_carts(10, 0.1, k), h, count, 10 + h) for k, h in ((1e2, 20), (1e3, 10))],
}
