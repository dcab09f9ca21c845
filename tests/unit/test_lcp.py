"""solve_lcp: differentiable, one element at a time.

Signs, equations and complementarity, which make a solution of every P-matrix, and gradients of easy, degenerate, badly
scaled, large and impossible LCPs are judged by the campaign in tests/conformance/hostile.
"""

import itertools

import pytest
import torch
from torch.autograd import gradcheck

from difflcs import Status, solve_lcp
from difflcs.errors import SolveWarning
from tests.conftest import draw


def definite(n, seed, skew=0.5):
    G, H = draw(2, n, n, seed=seed)
    return G @ G.T + 0.3 * torch.eye(n, dtype=torch.float64) + skew * (H - H.T)


@pytest.mark.parametrize("relaxation", [0.0, 1e-3, 1.0])
@pytest.mark.parametrize("shared", [True, False], ids=["shared", "per-element"])
def test_gradcheck_in_F_and_q(build, relaxation, shared):
    F = definite(4, 4) if shared else torch.stack([definite(4, s) for s in range(5)])
    q = build.normal(11)(5, 4)
    base = solve_lcp(F, q)
    assert float(torch.maximum(base.lam, base.w).min()) > 1e-4  # strict complementarity: differentiable
    inputs = (F.requires_grad_(), q.requires_grad_())
    assert gradcheck(lambda F, q: solve_lcp(F, q, relaxation)[:2], inputs, eps=1e-6, atol=1e-6, rtol=1e-6)


def jacobian_q(F, q):
    return torch.autograd.functional.jacobian(lambda p: solve_lcp(F, p).lam, q)


@pytest.mark.parametrize("seed", range(4))
def test_gradient_at_a_kink_is_the_one_sided_derivative_of_the_inactive_side(build, seed):
    """λ_i = w_i = 0 exactly, because row i of F does not see the active forces."""
    F, q = definite(5, seed), build.normal(seed)(5)
    F[3:, :3] = F[:3, 3:] = 0
    q[3:] = 0
    lam, w, _ = solve_lcp(F, q)
    assert torch.equal(torch.maximum(lam, w)[3:], torch.zeros(2, dtype=torch.float64))
    found = jacobian_q(F, q)
    beside = q + torch.tensor([0, 0, 0, 1e-5, 1e-5], dtype=torch.float64)  # w > 0 there: the inactive side
    torch.testing.assert_close(found, jacobian_q(F, beside), rtol=1e-12, atol=1e-14)
    for i in (3, 4):  # one-sided difference quotients of the solution itself, exact since it is piecewise linear
        step = 1e-5 * torch.eye(5, dtype=torch.float64)[i]
        torch.testing.assert_close(found[:, i], (solve_lcp(F, q + step).lam - lam) / 1e-5, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("relaxation", [0.0, 1e-5])
@pytest.mark.parametrize("n", [1, 9, 10, 16, 64])
def test_batch_equals_loop_bitwise_whatever_the_threads(build, relaxation, n):
    F, q = torch.stack([definite(n, s) for s in range(19)]), build.normal(n)(19, n)
    for threads in (1, 3):
        torch.set_num_threads(threads)
        whole = solve_lcp(F, q, relaxation=relaxation)
        for i in range(19):
            one = solve_lcp(F[i], q[i], relaxation=relaxation)
            assert torch.equal(one.lam, whole.lam[i])
            assert torch.equal(one.w, whole.w[i])


def test_leading_dimensions_broadcast_and_gradients_sum_over_them(build):
    F = torch.stack([definite(4, s) for s in range(3)]).requires_grad_()
    q = build.normal(0)(2, 1, 4).requires_grad_()
    lam, w, status = solve_lcp(F, q)
    assert lam.shape == w.shape == (2, 3, 4)
    assert (status.shape, status.dtype) == ((2, 3), torch.int8)
    grads = torch.autograd.grad(lam.square().sum(), (F, q))
    total = [torch.zeros_like(v) for v in (F, q)]
    for i, j in itertools.product(range(2), range(3)):
        alone = solve_lcp(F[j], q[i, 0])
        assert alone.status.shape == ()
        assert torch.equal(lam[i, j], alone.lam)
        total = [a + b for a, b in zip(total, torch.autograd.grad(alone.lam.square().sum(), (F, q)), strict=True)]
    torch.testing.assert_close(list(grads), total, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("relaxation", [0.0, 1e-5])
@pytest.mark.parametrize("batch", [(0,), (2, 0)])
def test_an_empty_batch_gives_empty_results_and_zero_gradient(relaxation, batch):
    F = definite(4, 0).requires_grad_()
    q = torch.empty(*batch, 4, dtype=torch.float64, requires_grad=True)
    lam, w, status = solve_lcp(F, q, relaxation=relaxation)
    assert lam.shape == w.shape == (*batch, 4)
    assert status.shape == batch
    lam.sum().backward()
    assert torch.equal(F.grad, torch.zeros(4, 4, dtype=torch.float64))
    assert q.grad.shape == q.shape


@pytest.mark.parametrize("relaxation", [0.0, 1e-4])
@pytest.mark.parametrize("n", [3, 40, 300])
def test_what_the_time_does_not_suffice_for_is_max_iter(build, relaxation, n):
    F, q = definite(n, 0, skew=1.0).requires_grad_(), build.normal(0)(n).requires_grad_()
    with pytest.warns(SolveWarning, match="1 of 1 LCPs.*MAX_ITER: not within time_limit"):
        lam, w, status = solve_lcp(F, q, relaxation, time_limit=1e-9)
    assert int(status) == Status.MAX_ITER
    assert bool((torch.isfinite(lam) & torch.isfinite(w) & (torch.minimum(lam, w) >= 0)).all())
    (lam.sum() + w.sum()).backward()
    assert not F.grad.any()
    assert not q.grad.any()
    assert torch.equal(solve_lcp(F, q, relaxation, 60.0).lam, solve_lcp(F, q, relaxation).lam)


@pytest.mark.parametrize("relaxation", [0.0, 1e-3])
def test_an_element_that_is_not_solvable_is_reported_and_spoils_no_other(build, relaxation):
    F = torch.stack([definite(3, s) for s in range(6)])
    q = build.normal(3)(6, 3)
    clean_F, clean_q = F.clone().requires_grad_(), q.clone().requires_grad_()
    clean = solve_lcp(clean_F, clean_q, relaxation)
    clean.lam.sum().backward()
    F[2], q[2] = -torch.eye(3), -1.0  # −λ − 1 ≥ 0 has no solution
    F[4], q[4] = 1e300 * F[4], 1e305 * q[4]
    F[5] = F[5] - F[5].T + 1e-12 * torch.eye(3)
    F.requires_grad_()
    q.requires_grad_()
    with pytest.warns(SolveWarning, match=r"2 of 6 LCPs were not solved.*positive definite.*status"):
        solution = solve_lcp(F, q, relaxation)
    assert (solution.status != Status.CONVERGED).tolist() == [False, False, True, False, True, False]
    assert bool(torch.isfinite(solution.lam).all())
    assert float(solution.lam.detach().min()) >= 0
    upstream = torch.ones_like(solution.lam)
    upstream[2] = torch.nan
    torch.autograd.backward((solution.lam, solution.w), (upstream, torch.where(upstream.isnan(), torch.nan, 0.0)))
    assert torch.equal(F.grad[2], torch.zeros(3, 3, dtype=torch.float64))
    assert torch.equal(q.grad[2], torch.zeros(3, dtype=torch.float64))
    others = [0, 1, 3]
    assert torch.equal(solution.lam[others], clean.lam[others])
    assert torch.equal(F.grad[others], clean_F.grad[others])
    assert torch.equal(q.grad[others], clean_q.grad[others])
