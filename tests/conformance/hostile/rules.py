"""Rules of autograd and of batches, on healthy problems: in-place changes, second derivatives, broken neighbours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.random import Generator

from difflcs import solve_lcp, violation_loss
from difflcs.errors import DiffLCSError, DoubleBackwardError
from tests.conformance.hostile.generators import LCP, MPC, Loss
from tests.conformance.hostile.targets import INPUTS, REFUSED, Outcome, layer_of, leaves_of, model_of, quiet

Tensors = dict[str, torch.Tensor]
# Leaves → named outputs, and what is a function of them.
Function = Callable[[Tensors], Tensors]


def _function(problem) -> tuple[Tensors, Function]:
    """The library's function of one problem: its leaves, and what maps leaves to outputs."""
    if isinstance(problem, LCP):
        leaves = {"F": torch.from_numpy(np.array(problem.F)), "q": torch.from_numpy(np.array(problem.q))}

        def lcp(t: Tensors) -> Tensors:
            solution = solve_lcp(t["F"], t["q"], 1e-4)
            return {"lam": solution.lam, "w": solution.w}

        return leaves, lcp
    if isinstance(problem, MPC):

        def mpc(t: Tensors) -> Tensors:
            plan = layer_of(problem, t)(t["x0"])
            return {k: getattr(plan, k) for k in ("x", "u", "lam", "objective", "action")}

        return {k: v.detach() for k, v in leaves_of(problem).items()}, mpc
    assert isinstance(problem, Loss)
    model = model_of(problem)
    leaves = {k: torch.from_numpy(np.array(getattr(problem, k))) for k in ("x", "u", "x_next")}
    leaves |= {k: v.detach().clone() for k, v in model.named_parameters()}

    def loss(t: Tensors) -> Tensors:
        other = model_of(problem)
        for name in problem.system:  # the very tensors, as parameters
            setattr(other, name, torch.nn.Parameter(t[name], requires_grad=t[name].requires_grad))
        t["model"] = other  # pyright: ignore[reportArgumentType]
        value = violation_loss(other, t["x"], t["u"], t["x_next"], gamma=problem.gamma, xi=problem.xi)
        return {"loss": value}

    return leaves, loss


def _gradients(leaves: Tensors) -> list[torch.Tensor]:
    model = leaves.get("model")
    own = [p.grad for p in model.parameters()] if isinstance(model, torch.nn.Module) else []
    found = [v.grad for k, v in leaves.items() if k != "model"] + own
    return [g.clone() for g in found if g is not None]


def in_place(problem, rng: Generator, gradients: bool) -> Outcome:
    """One tensor of each problem is changed between forward and backward: an error, or the very same gradient."""
    broken = np.zeros(problem.count)
    for i in range(problem.count):
        broken[i] = np.inf if _changed(problem.select(slice(i, i + 1)), rng) else 0.0
    return Outcome(np.zeros(problem.count, int), {"in place": broken})


def _changed(problem, rng: Generator) -> bool:
    values, function = _function(problem)
    with quiet(), torch.no_grad():
        names = list(function({k: v.clone() for k, v in values.items()}))
    tensor = str(rng.choice([*values, *names]))
    constant = rng.random() < 0.3  # the changed tensor needs no gradient itself
    seeds = {name: rng.standard_normal() for name in names}
    found = []
    for in_place_ in (False, True):
        leaves = {k: v.clone().requires_grad_(not (constant and k == tensor)) for k, v in values.items()}
        with quiet():
            out = function(leaves)
            if tensor in names and in_place_:
                out[tensor].mul_(1.5).add_(0.01)
            elif tensor == "action":  # a view of u: who reads u reads the change
                u = out["u"]
                out["u"] = torch.cat([(1.5 * u[..., :1, :] + 0.01), u[..., 1:, :]], -2)
                out["action"] = out["u"][..., 0, :]
            elif tensor == "u" and "action" in names:
                out["u"] = 1.5 * out["u"] + 0.01
                out["action"] = out["u"][..., 0, :]
            elif tensor in names:
                out[tensor] = 1.5 * out[tensor] + 0.01
            total = torch.stack([seeds[k] * v.square().sum() for k, v in out.items()]).sum()
            if in_place_ and tensor in leaves:
                with torch.no_grad():
                    own = leaves.get("model")
                    target = getattr(own, tensor) if own is not None and tensor in problem.system else leaves[tensor]
                    target.mul_(1.3).add_(0.01)
            try:
                total.backward()
            except (RuntimeError, DiffLCSError):
                if in_place_:
                    return False
                raise
        found.append(_gradients(leaves))
    return not all(torch.allclose(a, b, rtol=1e-12, atol=1e-14) for a, b in zip(*found, strict=True))


def double_backward(problem, rng: Generator, gradients: bool) -> Outcome:
    """Second derivatives are refused with `DoubleBackwardError`, never wrong."""
    broken = np.full(problem.count, np.inf)
    for i in range(problem.count):
        values, function = _function(problem.select(slice(i, i + 1)))
        leaves = {k: v.clone().requires_grad_() for k, v in values.items()}
        with quiet():
            total = torch.stack([v.square().sum() for v in function(leaves).values()]).sum()
            try:
                wanted = [v for k, v in leaves.items() if k in ("q", "x0", "x")]
                torch.autograd.grad(total, wanted, create_graph=True)
            except DoubleBackwardError:
                broken[i] = 0.0
    return Outcome(np.zeros(problem.count, int), {"double backward": broken})


# ---- neighbours -----------------------------------------------------------------------------------------------------


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


RULE_TARGETS = {"neighbours": neighbours, "in-place": in_place, "double backward": double_backward}
