"""Hostile problems of every form: stages, constraints, open bounds, xᵀSu, no contact; judged as the others are.

The batches come from `tests.conformance.varied`, each element with inputs of its own, and are then spoilt.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.random import Generator

from difflcs import Status
from difflcs.errors import DiffLCSError
from tests.conformance.cases import Case, rank
from tests.conformance.hostile import checks
from tests.conformance.hostile.generators import by_name
from tests.conformance.hostile.targets import (
    REFUSED,
    Outcome,
    cold,
    layer_of,
    leaves_of,
    quiet,
    refused_one_by_one,
    shift,
    solve_mpc,
)
from tests.conformance.varied import programs
from tests.conformance.varied.generators import random_case

ROWS = ("G_x", "G_u", "g", "price")
INF = np.inf


def _spoilt(case: Case, **arrays) -> Case:
    """Other inputs: nothing is known about what is possible."""
    never = np.zeros(case.count, bool)
    return replace(case.changed(**arrays), impossible=never, possible=never)


def plain(rng: Generator, count: int, small: bool = False) -> Case:
    """Nothing hostile: any size, form and constraint."""
    return _form(rng, count)


def _form(rng: Generator, count: int, need_rows: bool = False, **options) -> Case:
    while True:
        case = random_case(int(rng.integers(1 << 30)), count, **options)
        if case.horizon <= 12 and ("g" in case.inputs or not need_rows):
            break
    known = np.full(count, case.witness is not None or "g" not in case.inputs)
    return replace(case.each(), witness=None, impossible=np.zeros(count, bool), possible=known)


def _staged_rows(rng: Generator, count: int) -> tuple[Case, dict[str, np.ndarray]]:
    """A form whose rows are all given by stage."""
    form = _form(rng, count, need_rows=True)
    arrays = {}
    for name in ROWS:
        value, stages = form.inputs[name], form.horizon + (name != "G_u")
        if value.ndim == rank(name) + 1:
            value = np.repeat(value[:, None], stages, 1)
        arrays[name] = value.copy()
    return form, arrays


def zero_rows(rng: Generator, count: int, small: bool = False) -> Case:
    """Rows of zeros: 0 ≤ g says nothing, 0 ≤ −g is impossible, and costs price·g where it is soft."""
    form, a = _staged_rows(rng, count)
    j = int(rng.integers(a["g"].shape[-1]))
    a["G_x"][..., j, :] = 0.0
    a["G_u"][..., j, :] = 0.0
    a["g"][..., j] = rng.choice([0.0, 1e-3, 1.0, INF], (count, 1))
    bad = rng.random(count) < 0.3
    a["g"][bad, -1, j] = -1e-2
    done = _spoilt(form, **a)
    return replace(done, impossible=bad & np.isinf(a["price"][:, -1, j]))


def opposite_rows(rng: Generator, count: int, small: bool = False) -> Case:
    """Rows twice, rows with both signs (an equation), and rows that contradict each other by 1e-9 … 1."""
    form, a = _staged_rows(rng, count)
    kind, gap = rng.integers(0, 3, count), 10.0 ** rng.uniform(-9, 0, count)
    sign = np.where(kind == 0, 1.0, -1.0)[:, None, None]
    shift = np.where(kind == 2, gap, 0.0)[:, None, None]
    twice = {k: np.concatenate([v, sign[..., None] * v if k in ("G_x", "G_u") else v], 2) for k, v in a.items()}
    second = np.where(np.isinf(a["g"]), INF, sign * a["g"] - shift)
    return _spoilt(form, **{**twice, "g": np.concatenate([a["g"], second], 2)})


def prices(rng: Generator, count: int, small: bool = False) -> Case:
    """Prices of 1e-300, 1e-30, 1e30, 1e300 and hard ones beside each other."""
    form, a = _staged_rows(rng, count)
    return _spoilt(form, price=rng.choice([1e-300, 1e-30, 1.0, 1e8, 1e30, 1e300, INF], a["price"].shape))


def limits(rng: Generator, count: int, small: bool = False) -> Case:
    """Limits of ±1e300, ±1e30 and none beside each other."""
    form, a = _staged_rows(rng, count)
    spoilt = rng.random(a["g"].shape) < 0.2
    return _spoilt(form, g=np.where(spoilt, rng.choice([1e300, -1e300, 1e30, -1e30, INF, 0.0], spoilt.shape), a["g"]))


def first_stage(rng: Generator, count: int, small: bool = False) -> Case:
    """Constraints at stage 0 alone, about x0 and the first actions: met or not whatever follows."""
    form, a = _staged_rows(rng, count)
    a["g"][:, 1:] = INF
    there = np.einsum("bij,bj->bi", a["G_x"][:, 0], form.inputs["x0"])
    a["g"][:, 0] = there + rng.choice([-1.0, -1e-8, 0.0, 1e-8, 1.0], there.shape)
    blind = rng.random() < 0.5
    if blind:
        a["G_u"][:] = 0.0
    done = _spoilt(form, **a)
    beyond = (there - a["g"][:, 0] > 1e-2) & np.isinf(a["price"][:, 0])
    return replace(done, impossible=beyond.any(1) if blind else np.zeros(count, bool))


def not_numbers(rng: Generator, count: int, small: bool = False) -> Case:
    """NaN or −∞ in one input of some elements, ∞ where none is allowed: to be refused before anything is solved."""
    form = _form(rng, count)
    arrays = {k: v.copy() for k, v in form.inputs.items()}
    name = str(rng.choice([k for k, v in arrays.items() if v[0].size]))
    chosen = rng.random(count) < 0.3
    value = np.nan if name in ("u_min", "u_max", "g", "price") else rng.choice([np.nan, INF, -INF])
    flat = arrays[name].reshape(count, -1)
    flat[chosen, rng.integers(flat.shape[1])] = value
    return _spoilt(form, **{name: flat.reshape(arrays[name].shape)})


def extreme(rng: Generator, count: int, small: bool = False) -> Case:
    """One input times 1e±(50 … 300) in some elements."""
    form = _form(rng, count)
    name = str(rng.choice(list(form.inputs)))
    value = form.inputs[name].copy()
    factor = 10.0 ** (rng.uniform(50, 300) * rng.choice([-1, 1]))
    chosen = rng.random(count) < 0.5
    with np.errstate(over="ignore"):
        value[chosen] = value[chosen] * factor
    if name == "price":
        value = np.maximum(value, 1e-300)
    return _spoilt(form, **{name: value})


def no_contact(rng: Generator, count: int, small: bool = False) -> Case:
    """n_lam = 0: a quadratic program, of which INFEASIBLE must be true."""
    return _form(rng, count, n_lam=0)


def vertex(rng: Generator, count: int, small: bool = False) -> Case:
    """Hardly curved: linear programs, R = 0, soft absolute values, R of 1e-10 … 1e-4; limits at zero; n_lam = 0.

    What is summed to the gradient cancels to rounding at a vertex, and states at rest are rounding.
    """
    form = _form(rng, count, need_rows=True, n_lam=0)
    a = {k: v.copy() for k, v in form.inputs.items()}
    for name in ("Q", "R", "S", "Q_final"):
        a[name] *= 0.0
    for name in ("q", "r", "q_final"):
        a[name] = rng.standard_normal(a[name].shape) * (name == "q_final" or rng.random() < 0.5)
    # Beyond what its plan needs, so that what was possible still is.
    a["u_min"], a["u_max"] = (np.where(np.isinf(a[k]), 50.0 * sign, a[k]) for k, sign in (("u_min", -1), ("u_max", 1)))
    kind = rng.integers(4)
    if kind == 1:
        a["Q"] += np.diag(rng.integers(0, 2, a["Q"].shape[-1]))
        a["q"] *= 0.0
    elif kind == 2:
        a |= {"G_x": np.concatenate([a["G_x"], -a["G_x"]], -2), "G_u": np.concatenate([a["G_u"], -a["G_u"]], -2)}
        a["g"] = np.concatenate([a["g"], -np.where(np.isinf(a["g"]), -INF, a["g"])], -1) * rng.integers(0, 2)
        a["price"] = np.tile(10.0 ** rng.uniform(-2, 1, a["price"].shape), 2)
    elif kind == 3:
        a["R"] += 10.0 ** rng.uniform(-10, -4) * np.eye(a["R"].shape[-1])
    return form.changed(**a)


def judge(form: Case, *numbers: np.ndarray) -> checks.Ratios:
    """Promises of a solution, and of a linear program its optimum."""
    case = form
    if "price" in case.inputs:  # from 1e300 on a constraint is hard, see `Constraints`
        price = case.inputs["price"]
        case = case.changed(price=np.where(price >= 1e300, INF, price))
    found = checks.judge_mpc(case, *numbers)
    if not case.inputs["c"].size:
        gaps = [programs.above_optimum(case, i, u) for i, u in enumerate(numbers[1])]
        found["optimum of a linear program"] = np.array([0.0 if gap is None else gap / 1e-6 for gap in gaps])
    return found


def form_target(form: Case, rng: Generator, gradients: bool, guess=cold) -> Outcome:
    """Solve, differentiate and judge; also whether a status is true."""
    done = refused_one_by_one(lambda part: solve_mpc(part, np.float64, "batched", guess, judge), form)
    done.ratios["solved what is impossible"] = np.where(done.solved & form.impossible, INF, 0.0)
    if not form.inputs["c"].size:
        wrong = (done.status == Status.INFEASIBLE) & form.possible
        done.ratios["false INFEASIBLE of a convex program"] = np.where(wrong, INF, 0.0)
    return done


def untouched(form: Case, rng: Generator, gradients: bool) -> Outcome:
    """What becomes of some elements leaves the others as they are, bit for bit, gradients of x0 included."""
    spoilt = np.zeros(form.count, bool)
    spoilt[rng.permutation(form.count)[: max(1, form.count // 3)]] = True
    arrays = {k: v.copy() for k, v in form.inputs.items()}
    kind = rng.integers(4)
    with np.errstate(over="ignore"):
        if kind == 0 and "g" in arrays:
            arrays["g"][spoilt] = -1e3
        elif kind == 1 and "price" in arrays:
            arrays["price"][spoilt] = rng.choice([1e-300, 1e300])
        elif kind == 2:
            arrays["x0"][spoilt] *= 1e300
        else:
            arrays["B"][spoilt] *= 1e200
    both = []
    for case in (form, form.changed(**arrays)):
        leaves = leaves_of(case)
        with quiet(), np.errstate(all="ignore"):
            try:
                plan = layer_of(case, leaves)(leaves["x0"])
            except DiffLCSError:
                return Outcome(np.full(form.count, REFUSED), {"untouched": np.zeros(form.count)})
            (plan.u.sum() + plan.objective.sum()).backward()
        both.append([v.detach().numpy() for v in (plan.x, plan.u, plan.lam, plan.mu, plan.status, leaves["x0"].grad)])
    changed = np.zeros(form.count, bool)
    for a, b in zip(*both, strict=True):
        changed |= (a != b).reshape(form.count, -1).any(1)
    return Outcome(both[0][4].astype(int), {"untouched": np.where(changed & ~spoilt, np.inf, 0.0)})


FORM_CLASSES: dict[str, Callable[..., Case]] = by_name(
    plain, no_contact, zero_rows, opposite_rows, prices, limits, first_stage, not_numbers, extreme, vertex,
    prefix="form-",
)  # fmt: skip
FORM_TARGETS = {"batched": form_target, "warm": partial(form_target, guess=shift), "untouched": untouched}
