"""Systems that bounce, whose plans have many optima: walls, a box, a paddle, an edge, a leg."""

import torch
from models import Instance, chain_of_carts, make, push_the_last_cart, uniform
from torch import Tensor

from difflcs import LCSParams, QuadraticCost

GRAVITY = 9.81  # [m/s²]
Rows = list[list[float]]


def _tensor(rows: Rows | list[float]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def bouncing(
    K: Rows, B: Rows, W: Rows, J: Rows, c: list[float], f: list[float], dt: float, restitution: float
) -> LCSParams:
    """Make q̈ = K q + B u + f in semi-implicit steps h, with impulses λ that change the velocity by W λ.

    Contact i acts where the gap J q + c would close within the step, and bounces: 0 ≤ λ ⊥ (J q + c)/h + J (v₊ + e v) +
    0.001 λ ≥ 0 with the restitution e (Stewart & Trinkle 1996). States are (q, v).
    """
    spring, drive, impulse, gaps, open_by, pull = (_tensor(v) for v in (K, B, W, J, c, f))
    eye = torch.eye(len(pull), dtype=torch.float64)
    change = torch.cat([dt * spring, eye], 1)

    def moved(velocity: Tensor) -> Tensor:
        return torch.cat([dt * velocity, velocity])

    return LCSParams(
        A=torch.cat([torch.cat([eye, 0 * eye], 1), torch.zeros_like(change)]) + moved(change),
        B=moved(dt * drive),
        C=moved(impulse),
        d=moved(dt * pull),
        D=torch.cat([gaps / dt, restitution * gaps], 1) + gaps @ change,
        E=dt * gaps @ drive,
        F=gaps @ impulse + 1e-3 * torch.eye(len(gaps), dtype=torch.float64),
        c=open_by / dt + dt * gaps @ pull,
    )


def reach(lcs: LCSParams, goal: list[float], weight: list[float], horizon: int, limit: float, x0: Tensor) -> Instance:
    """Reach a state, with ten times the weight at the end, by actions up to a limit that cost at most 0.005 each."""
    Q, aim = torch.diag(_tensor(weight)), _tensor(goal)
    R = 0.01 / limit**2 * torch.eye(lcs.n_u, dtype=torch.float64)
    missed = 0.5 * (horizon + 10) * aim @ Q @ aim
    cost = QuadraticCost(Q, R, 10 * Q, q=-Q @ aim, q_final=-10 * Q @ aim, constant=missed)
    return make(lcs, cost, horizon, limit, x0)


def pendulum(count: int, horizon: int) -> Instance:
    """A pole between two walls whose motor is too weak to lift it from either; bouncing swings it up."""
    lcs = bouncing([[GRAVITY]], [[1]], [[-1, 1]], [[-1], [1]], [0.3, 0.3], [0], 1.6 / horizon, 0.9)
    return reach(lcs, [0, 0], [10, 0.1], horizon, 1.5, uniform([0.28, 1.0], count, horizon))


def ball_in_a_box(count: int, horizon: int) -> Instance:
    """A ball in a box 2 m wide and high, with a drive half as strong as its weight."""
    sides = [[1.0, 0], [0, 1], [-1, 0], [0, -1]]
    inwards = [[1.0, 0, -1, 0], [0, 1, 0, -1]]
    lcs = bouncing([[0, 0]] * 2, [[1, 0], [0, 1]], inwards, sides, [1] * 4, [0, -GRAVITY], 0.03, 0.85)
    return reach(lcs, [0.6, 0.5, 0, 0], [10, 10, 0.01, 0.01], horizon, 5.0, uniform([0.9, 0.9, 2, 2], count, horizon))


def juggling(count: int, horizon: int) -> Instance:
    """A paddle of ten times a ball's mass keeps the ball near 1 m above it."""
    lcs = bouncing([[0, 0]] * 2, [[0], [1]], [[1], [-0.1]], [[1, -1]], [0], [-GRAVITY, 0], 0.02, 0.8)
    x0 = uniform([0.3, 0.1, 1.0, 0.3], count, horizon) + _tensor([0.7, 0, 0, 0])
    return reach(lcs, [1.0, 0, 0, 0], [10, 1, 0.1, 0.01], horizon, 40.0, x0)


def pivoting(count: int, horizon: int) -> Instance:
    """A box 0.2 m wide on two edges is tilted about one by a force that acts at half its width, up or down."""
    half, inertia = 0.1, 0.01
    corners = [[1.0, -half], [1, half]]  # heights of the edges, from height and tilt of the middle
    lcs = bouncing(
        [[0, 0]] * 2, [[1], [half / inertia]], [[1, 1], [-half / inertia, half / inertia]], corners, [0, 0],
        [-GRAVITY, 0], 0.02, 0.1,
    )  # fmt: skip
    x0 = uniform([0.0, 0.3, 0.1, 0.5], count, horizon)
    return reach(lcs, [0.03, 0.3, 0, 0], [1, 10, 0.01, 0.01], horizon, 12.0, x0 + 0.11 * _tensor([1, 0, 0, 0]))


def hopper(count: int, horizon: int) -> Instance:
    """A body and a foot with a drive between them that is to reach a height; the foot's gap to the ground."""
    lcs = bouncing(
        [[-20, 20], [80, -80]], [[1], [-4]], [[0], [4]], [[0, 1]], [0.5], [-GRAVITY, -GRAVITY], 0.02, 0.2
    )  # fmt: skip
    x0 = uniform([0.2, 0.1, 0.5, 0.5], count, horizon)
    return reach(lcs, [0.5, 0, 0, 0], [10, 0.1, 0.1, 0.01], horizon, 30.0, x0)


FAMILIES = {
    "pendulum, H 40": lambda count: [pendulum(count, 40)],
    "ball in a box, H 40": lambda count: [ball_in_a_box(count, 40)],
    "juggling, H 60": lambda count: [juggling(count, 60)],
    "pivoting, H 40": lambda count: [pivoting(count, 40)],
    "hopper, H 50": lambda count: [hopper(count, 50)],
    # The first of two carts hits the second, which is to stop 0.3 m further, with a weak drive.
    "2 carts, H 50": lambda count: [
        make(chain_of_carts(2), push_the_last_cart(2, 50), 50, 2.0, uniform([0.3, 0.1, 0.5, 0.2], count, 50))
    ],
}
