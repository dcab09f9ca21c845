"""Gradients of plans against central differences: the perturbed copies of a problem are one large batch."""

import itertools
import warnings

import torch

from difflcs.errors import SolveWarning
from difflcs.mpc import Primal, kkt

STEP = 1e-6


def weigh(sol, weights):
    """One number per element from all differentiable outputs."""
    x, u, lam, objective = weights
    parts = (x * sol.x).sum((1, 2)) + (u * sol.u).sum((1, 2)) + (lam * sol.lam).sum((1, 2))
    return parts + objective * sol.objective


def direction_of(name, value, n):
    """A direction in proportion to the value, so that badly scaled inputs are stepped by what is small for them.

    Nothing that is infinite moves.
    """
    direction = n(*value.shape)
    if name in ("Q", "R", "Q_final", "F"):  # by rows and columns, so that they stay positive definite
        root = value.diagonal(dim1=-2, dim2=-1).sqrt()
        direction = direction * root[..., :, None] * root[..., None, :]
        return direction if name == "F" else 0.5 * (direction + direction.mT)
    return torch.where(value.abs() < torch.inf, direction * torch.where(value == 0, 0.1, value.abs()), 0.0)


def moves(build, solve, problem, base, backend):
    """Directions of all inputs, and the plans of copies with each moved by ±STEP, from the plans of `base`."""
    n, each = build.normal(41), problem.each()
    directions = {k: direction_of(k, v, n) for k, v in each.inputs.items()}
    copies = [
        {**each.inputs, k: each.inputs[k] + torch.where(directions[k] == 0, 0.0, sign * STEP * directions[k])}
        for k, sign in itertools.product(directions, (1, -1))
    ]
    stacked = {k: torch.cat([c[k] for c in copies]) for k in directions}
    guess = Primal(*(v.detach().repeat(len(copies), 1, 1) for v in (base.x, base.u, base.lam, base.mu)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SolveWarning)
        return directions, solve(each, backend, tensors=stacked, guess=guess, on_failure="mask")


def compare(build, solve, problem, base, backend, directions, moved):
    """Compare the gradient by every input, and return in how many of them anything moved."""
    each, n, names, B = problem.each(), build.normal(42), tuple(directions), problem.count
    weights = [n(*v.shape) for v in (base.x, base.u, base.lam)] + [n(B)]
    leaves = {k: v.clone().requires_grad_() for k, v in each.inputs.items()}
    # All from the same start, so that all end in the same local optimum.
    sol = solve(each, backend, tensors=leaves, guess=base)
    gradients = torch.autograd.grad(weigh(sol, weights).sum(), [leaves[k] for k in names])

    # A difference quotient needs more digits than a user: a few Newton steps onto the same optimum.
    plan = kkt.polish(moved.problem, Primal(moved.x, moved.u, moved.lam, moved.mu), tol=1e-14)
    times, (x, u, lam) = 2 * len(names), plan[:3]
    wide = [w.repeat(times, *[1] * (w.ndim - 1)) for w in weights]
    values = (wide[0] * x).sum((1, 2)) + (wide[1] * u).sum((1, 2)) + (wide[2] * lam).sum((1, 2))
    values = (values + wide[3] * moved.problem.objective(x, u)).reshape(len(names), 2, B)
    low, high = moved.problem.bounds()
    price = moved.problem.price
    price = price if price.ndim == 3 or price.ndim == 1 else price.unsqueeze(1)
    marks = [u <= low + 1e-9, u >= high - 1e-9, plan.mu > 1e-9, plan.mu > price * (1 - 1e-9)]
    active = torch.cat([mark.flatten(1) for mark in marks], 1).reshape(len(names), 2, B, -1)
    width = (high - low).clamp_max(1.0).expand(u.shape)
    apart = (u - sol.u.detach().repeat(times, 1, 1)).abs() / width
    steady = (active[:, 0] == active[:, 1]).all(-1) & (apart.amax((1, 2)).reshape(len(names), 2, B).amax(1) < 1e-3)
    steady &= moved.converged.reshape(len(names), 2, B).all(1)
    assert float(steady.double().mean()) > 0.9

    some = 0
    for i, (k, gradient) in enumerate(zip(names, gradients, strict=True)):
        quotient = (values[i, 0] - values[i, 1]) / (2 * STEP)
        found = (gradient * directions[k]).flatten(1).sum(1)
        # Numbers that are zero up to the rounding of the difference quotient carry no relative error.
        floor = 1e-4 * float((values[i, 0].abs() + 1).max())
        error = ((found - quotient).abs() / quotient.abs().clamp_min(floor))[steady[i]]
        assert float(error.median()) <= 1e-4, (k, found, quotient)
        assert float(error.quantile(0.75)) <= 1e-3, (k, found, quotient)
        some += int((quotient.abs() > floor).sum() > 0)
        assert bool(torch.isfinite(gradient).all())
    return some
