"""mpc/kkt.py against judges that call nothing of it: the Lagrangian's derivative along a rollout, in NumPy.

Its gradients, `kkt.vjp`, are compared with differences of plans and with those of the kernels in tests/conformance.
"""

import numpy as np
import pytest
import torch

from difflcs.mpc import Primal, kkt
from difflcs.mpc.backends import IpoptBackend
from tests.conformance.hostile import checks
from tests.conformance.varied.generators import random_case


def residual_of(problem, primal):
    return kkt.residual(problem, primal, kkt.multipliers(problem, primal))


@pytest.mark.parametrize("seed", range(8))
def test_the_reduced_gradient_is_that_of_the_lagrangian_along_the_rollout(build, seed):
    case, n = random_case(seed, batch=3), build.normal(seed)
    problem = case.problem()
    u = problem.clip(0.1 * n(3, problem.horizon, problem.n_u))  # anywhere, not at a solution
    x, lam = problem.rollout(u)
    mu = n(3, problem.horizon + 1, problem.n_c).abs() * torch.isfinite(problem.g)
    found = kkt.multipliers(problem, Primal(x, u, lam, mu)).gradient
    t, trajectory = case.by_stage(), [v.numpy() for v in (x, u, lam)]
    s, terms = checks.affine(t, "DEFc", *trajectory)
    off = np.abs(trajectory[2] * s - case.relaxation) / (case.relaxation + 1e-7 * trajectory[2] * terms)
    assert off.max(initial=0.0) < 1e-7
    expected, size = checks.reduced_gradient(t, *trajectory, s, mu.numpy())
    assert float(np.abs((found.numpy() - expected) / size).max()) < 1e-9


@pytest.fixture(scope="module")
def solved():
    """A problem without constraints, and its plans."""
    problem = random_case(0, batch=4, rows=False).problem()
    result = IpoptBackend(workers=1).solve(problem, None)
    assert bool(result.solved.all())
    return problem, result.primal


def test_the_residual_vanishes_at_a_solution_and_sees_each_violation(solved):
    problem, primal = solved
    assert float(residual_of(problem, primal).max()) < 1e-8
    for name in ("x", "u", "lam"):
        value = getattr(primal, name).clone()
        value[2, 1, 0] += 0.01
        found = residual_of(problem, primal._replace(**{name: value}))
        assert float(found[2]) > 1e-5
        assert float(found[[0, 1, 3]].max()) < 1e-8
    low, high = problem.bounds()
    beyond = torch.where(torch.isfinite(high), high + 0.5, primal.u)
    assert bool(torch.isfinite(high).any())
    assert float(residual_of(problem, primal._replace(u=beyond)).min()) >= 0.5 - 1e-12
    u = torch.zeros_like(primal.u).clamp(low, high)
    x, lam = problem.rollout(u)
    assert float(residual_of(problem, Primal(x, u, lam)).min()) > 1e-4  # it can be done, and is not optimal


def test_a_trajectory_may_leave_out_the_multipliers_of_constraints(solved):
    problem, (x, u, lam, mu) = solved
    assert torch.equal(residual_of(problem, Primal(x, u, lam)), residual_of(problem, Primal(x, u, lam, mu)))
    assert kkt.polish(problem, Primal(x, u, lam)).mu.shape == mu.shape


@pytest.mark.parametrize("noise", [1e-7, 1e-4])
def test_polish_brings_a_rough_solution_to_machine_precision(build, solved, noise):
    (problem, exact), n = solved, build.normal(4)
    rough = Primal(*(v + noise * n(*v.shape) for v in exact))
    rough = rough._replace(u=problem.clip(rough.u), lam=rough.lam.clamp_min(1e-9))
    polished = kkt.polish(problem, rough)
    assert float(residual_of(problem, polished).max()) < 1e-9
    torch.testing.assert_close(polished.u, exact.u, rtol=0, atol=1e-7)


def test_polish_never_makes_anything_worse(build, solved):
    problem, primal = solved
    u = problem.clip(build.normal(4)(*primal.u.shape))
    x, lam = problem.rollout(u)
    for start in (Primal(x, u, lam), Primal(x + 1, u, lam), primal):
        before = residual_of(problem, start)
        assert bool((residual_of(problem, kkt.polish(problem, start)) <= before).all())
