"""The problems of the race: with contact, without, and small enough for a global optimum."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from models import Instance, chain_of_carts, diagonal, make, pushing_model, uniform
from models import chain as chain_instance
from models import pushing as pushing_instance
from rivals.problem import INPUTS, Problem

from difflcs import LCSModel, LCSParams, QuadraticCost, solve_lcp
from difflcs.mpc.problem import MPCProblem
from difflcs.systems import block_along_wall, cart_pole_between_walls

RELAXATION = 1e-5
STATES = 77  # what is added to a seed for the states, so that they are not drawn as the models are


def problem(instance: Instance, seed: int) -> Problem:
    """Make the arrays of an instance, as the rivals take them."""
    (x0, *goal), (lcs, cost, horizon, _, limit) = instance.call, instance.layer.values()
    cost = cost(*goal, horizon) if goal else cost
    arrays = {name: value.detach().double().numpy() for name, value in lcs.tensors().items()}
    arrays |= {n: getattr(cost, n).detach().double().numpy() for n in ("Q", "R", "Q_final", "q", "r", "q_final")}
    bound = np.full(lcs.n_u, limit)
    weight = np.random.default_rng(seed).standard_normal(lcs.n_u)
    constant = np.asarray(0.0 if cost.constant is None else cost.constant.detach().numpy())
    return Problem(
        **arrays, u_min=-bound, u_max=bound, x0=x0.numpy(), horizon=horizon, relaxation=RELAXATION,
        constant=constant, weight=weight,
    )  # fmt: skip


def as_mpc(problem: Problem, few: int | None = None) -> MPCProblem:
    """Convert the problem, or its first few elements, to an `MPCProblem`."""
    data: dict[str, Any] = {name: torch.from_numpy(np.ascontiguousarray(getattr(problem, name))) for name in INPUTS}
    mpc = MPCProblem(**data, horizon=problem.horizon, relaxation=problem.relaxation)
    return mpc if few is None else mpc.select(torch.arange(few))


def hard_cost(mpc: MPCProblem, u: torch.Tensor) -> torch.Tensor:
    """Compute the cost (count,) of executing actions with λ·s = 0."""
    states = [mpc.x0]
    for k in range(mpc.horizon):
        stage = mpc.stage(k)
        lam = solve_lcp(stage.F, stage.gap(states[-1], u[:, k])).lam
        states.append(stage.next_state(states[-1], u[:, k], lam))
    return mpc.objective(torch.stack(states, 1), u)


def pushing(lcs: LCSParams, count: int, seed: int, horizon: int = 5) -> Problem:
    """Make a hand around an object, with a goal for each problem."""
    return problem(pushing_instance(lcs, count, seed, horizon), seed)


def cart_pole(count: int, horizon: int, seed: int) -> Problem:
    """Make the cart-pole between soft walls, pushed with up to 20 N."""
    weight = diagonal(1, 10, 0.1, 0.1)
    cost = QuadraticCost(Q=weight, R=diagonal(0.01), Q_final=10 * weight)
    x0 = uniform([0.3, 0.4, 1.0, 2.0], count, seed + STATES)
    return problem(make(cart_pole_between_walls(), cost, horizon, 20.0, x0), seed)


def chain(count: int, carts: int, horizon: int, seed: int) -> Problem:
    """Push the last cart 0.3 m further, through all others, with up to 50 N."""
    return problem(chain_instance(chain_of_carts(carts), horizon, count, seed + STATES), seed)


def with_contact(count: int, seeds: int, first: int = 0) -> dict[str, list[Problem]]:
    """Make the families of the race, one entry for each model or seed of initial states, from `first`."""
    every = range(first, first + seeds)
    cube = LCSModel.from_pretrained("zoo:trifinger-cube").params().detach()
    families = {f"pushing, n_lam {n}": [pushing(pushing_model(n, s), count, s) for s in every] for n in (5, 8)}
    families["learned cube"] = [pushing(cube, count, 10 + s) for s in every]
    families |= {f"cart-pole, H {h}": [cart_pole(count, h, h + s) for s in every] for h in (10, 20, 30)}
    families |= {f"chain of {n}, H {h}": [chain(count, n, h, n + s) for s in every] for n, h in ((4, 10), (10, 10))}
    return families


def without_contact(count: int, seeds: int) -> dict[str, list[Problem]]:
    """Make linear MPC with bounds on the actions: n_lam = 0. All problems of an entry differ in x0 alone."""

    def drop(p: Problem) -> Problem:
        none = {"C": p.C[..., :0], "D": p.D[:0], "E": p.E[:0], "F": p.F[:0, :0], "c": p.c[:0]}
        return replace(p, **none)

    def one_goal(p: Problem) -> Problem:
        return replace(p, q=p.q[0], q_final=p.q_final[0], constant=p.constant[0])

    every = range(seeds)
    return {
        "pushing, H 5": [drop(one_goal(pushing(pushing_model(5, s), count, s))) for s in every],
        "pushing, H 20": [drop(one_goal(pushing(pushing_model(5, s), count, s, horizon=20))) for s in every],
        "cart-pole, H 30": [drop(cart_pole(count, 30, 30 + s)) for s in every],
        "carts, n_x 20, H 20": [drop(chain(count, 10, 20, s)) for s in every],
    }


def small(count: int, seeds: int) -> Iterator[tuple[str, Problem]]:
    """Make problems whose modes a branch and bound can enumerate."""
    families: dict[str, Callable[[int], Problem]] = {
        "cart-pole, H 10 (2^20 modes)": lambda s: cart_pole(count, 10, 10 + s),
        "pushing, n_lam 5, H 3 (2^15)": lambda s: pushing(pushing_model(5, s), count, s, horizon=3),
        "pushing, n_lam 5, H 5 (2^25)": lambda s: pushing(pushing_model(5, s), count, s),
        "pushing, n_lam 8, H 5 (2^40)": lambda s: pushing(pushing_model(8, s), count, s),
        "block along a wall, H 4 (2^20)": lambda s: block(count, 4, s),
    }
    return ((family, make(s)) for family, make in families.items() for s in range(seeds))


def block(count: int, horizon: int, seed: int) -> Problem:
    """Push the block 5 cm along the wall."""
    weight, q = diagonal(100, 10, 0, 0), torch.tensor([-5.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    missed = torch.tensor(0.5 * 100.0 * 0.05**2 * (horizon + 10), dtype=torch.float64)
    cost = QuadraticCost(Q=weight, R=diagonal(1, 1), Q_final=10 * weight, q=q, q_final=10 * q, constant=missed)
    x0 = uniform([0.02, 0.01, 0.02, 0.02], count, seed + STATES)
    x0[:, 1] = x0[:, 1].abs()
    x0[:, 2] -= 0.04
    return problem(make(block_along_wall(), cost, horizon, 0.05, x0), seed)
