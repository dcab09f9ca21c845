"""Backend `batched`: what it promises beyond the conformance suite."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from difflcs import GoalCost, LCSModel, LCSMPCLayer
from difflcs._native import _kernels
from difflcs.errors import InvalidInputError
from difflcs.mpc.backends import BatchedBackend

PAIRS = [(3 + 2 * finger + axis, axis) for finger in range(3) for axis in range(2)]
COST = GoalCost.reach(9, 6, (200.0, 200.0, 0.3), (200.0, 200.0, 1.5), 200.0, PAIRS, 10.0, 6.0)


def pushing(build, n_lam, seed=0, **options):
    backend = BatchedBackend(**options.pop("backend", {}))
    return LCSMPCLayer(build.pushing(seed, n_lam), COST, 5, -0.015, 0.015, backend=backend, **options)


def data(build, count, seed=1):
    n = build.normal(seed)
    return 0.05 * n(count, 9), 0.05 * n(count, 3)


def test_threads_change_nothing_not_even_summed_gradients(build):
    model = LCSModel.from_params(build.pushing(0, 5))
    x0, goal = data(build, 100)
    found = []
    for threads in (1, 2, 5):
        model.zero_grad()
        backend = BatchedBackend(threads=threads)
        plan = LCSMPCLayer(model, COST, 5, -0.015, 0.015, backend=backend)(x0, goal)
        plan.action.square().sum().backward()
        found.append([plan.u.detach(), *(p.grad.clone() for p in model.parameters())])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_it_may_be_used_from_several_threads(build):
    mpc = pushing(build, 5)
    x0, goal = data(build, 16)
    wanted = mpc(x0, goal).u
    with ThreadPoolExecutor(4) as pool:
        assert all(torch.equal(u, wanted) for u in pool.map(lambda _: mpc(x0, goal).u, range(20)))


def test_restarts_are_seeded_and_hardly_ever_worse(build):
    x0, goal = data(build, 60)
    one, eight = (pushing(build, 8, backend={"restarts": n})(x0, goal) for n in (1, 8))
    again = pushing(build, 8, backend={"restarts": 8})(x0, goal)
    other = pushing(build, 8, backend={"restarts": 8, "seed": 1})(x0, goal)
    # The first start is one of the eight, but given up early where another is ahead.
    worse = eight.objective > one.objective * (1 + 1e-9)
    assert int(worse.sum()) <= 2
    assert bool((eight.objective < one.objective - 1e-3).any())
    assert torch.equal(eight.u, again.u)
    assert not torch.equal(eight.u, other.u)


@pytest.mark.parametrize("kind", ["pushing", "random", "untrained"])
def test_nearly_every_problem_is_solved(build, kind):
    x0, goal = data(build, 200)
    generator = torch.Generator().manual_seed(0)
    solved = 0
    for n_lam in (5, 8):
        if kind == "pushing":
            lcs = build.pushing(1, n_lam)
        else:
            lcs = LCSModel(9, 6, n_lam, init_scale=0.3 if kind == "random" else 1e-3, generator=generator)
        with torch.no_grad():
            plan = LCSMPCLayer(lcs, COST, 5, -0.015, 0.015, on_failure="mask")(x0, goal)
        solved += int(plan.converged.sum())
    assert solved >= 399


def plans_and_gradient():
    """Objectives of some plans, and the size of their gradient."""
    g = torch.Generator().manual_seed(0)
    lcs = LCSModel(9, 6, 5, init_scale=0.3, generator=g)
    mpc = LCSMPCLayer(lcs, GoalCost.reach(9, 6, (200.0, 200.0, 0.3), input_weight=200.0), 5, -0.015, 0.015)
    plan = mpc(0.05 * torch.randn(30, 9, generator=g, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    plan.action.sum().backward()
    return [*plan.objective.tolist(), lcs.A.grad.norm().item()]


@pytest.mark.slow
@pytest.mark.parametrize("isa", [isa for isa in ("baseline", "avx2", "avx512") if isa != _kernels.isa()])
def test_every_instruction_set_finds_the_same_plans(isa):
    """Other lanes, other rounding: nearly all plans agree closely, a few meet another optimum."""
    script = [
        "import torch",
        "from difflcs import GoalCost, LCSModel, LCSMPCLayer",
        "from difflcs._native import _kernels",
        inspect.getsource(plans_and_gradient),
        "print(_kernels.isa(), *plans_and_gradient())",
    ]
    command, environment = [sys.executable, "-c", "\n".join(script)], {**os.environ, "DIFFLCS_ISA": isa}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if isa != "baseline" and done.returncode != 0:
        assert "is not available" in done.stderr  # a clear refusal on a CPU without it
        return
    words = done.stdout.split()
    assert (done.returncode, words[0]) == (0, isa), done.stderr
    # This process has the widest set that the CPU has, or the one that the environment names.
    values, wanted = (
        torch.tensor(v, dtype=torch.float64) for v in ([float(w) for w in words[1:]], plans_and_gradient())
    )
    close = (values - wanted).abs() <= 1e-8 * (1 + wanted.abs())
    assert int(close.sum()) >= 29


@pytest.mark.slow
def test_an_unknown_instruction_set_is_refused_with_the_known_ones():
    command = [sys.executable, "-c", "from difflcs._native import _kernels; _kernels.isa()"]
    environment = {**os.environ, "DIFFLCS_ISA": "mmx"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "DIFFLCS_ISA=mmx is not available: expected baseline, avx2 or avx512" in done.stderr


WRONG = {"restarts": 0, "tol": 0.0, "max_iter": 0, "shrink": 1.0, "homotopy": 0.5, "threads": 0, "effort": "huge"}


@pytest.mark.parametrize("name", WRONG)
def test_options_out_of_range_are_refused(name):
    with pytest.raises(InvalidInputError, match=f"{name}: expected"):
        BatchedBackend(**{name: WRONG[name]})
