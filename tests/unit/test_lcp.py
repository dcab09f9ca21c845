"""solve_lcp: right on every P-matrix, differentiable, one element at a time."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

from difflcs import Status, solve_lcp
from difflcs.errors import DoubleBackwardError, SolveWarning


def definite(n, seed, skew=0.0):
    generator = torch.Generator().manual_seed(seed)
    G, H = torch.randn(2, n, n, generator=generator, dtype=torch.float64)
    return G @ G.T + 0.3 * torch.eye(n, dtype=torch.float64) + skew * (H - H.T)


def make(kind, n, seed):
    """One P-matrix of a kind."""
    generator = torch.Generator().manual_seed(seed)
    if kind == "symmetric":
        return definite(n, seed)
    if kind == "unsymmetric":
        return definite(n, seed, skew=1.0)
    if kind == "triangular":  # P, for its principal minors are products of its diagonal
        return torch.eye(n, dtype=torch.float64) + torch.triu(
            3 * torch.rand(n, n, generator=generator, dtype=torch.float64), 1
        )
    if kind == "scaled":  # D₁ · PD · D₂ is P for positive diagonals
        left, right = torch.exp(2 * torch.randn(2, n, generator=generator, dtype=torch.float64))
        return left[:, None] * definite(n, seed, skew=0.5) * right
    if kind == "dominant":  # strictly dominant by rows, positive diagonal; made indefinite by columns of unequal size
        F = torch.rand(n, n, generator=generator, dtype=torch.float64) - 0.5
        F.fill_diagonal_(0)
        F += torch.diag(1.05 * F.abs().sum(1) + 0.01)
        return F * torch.logspace(0, 2, n, dtype=torch.float64)
    raise AssertionError(kind)


KINDS = ["symmetric", "unsymmetric", "triangular", "scaled", "dominant"]
NOT_DEFINITE = ["triangular", "scaled", "dominant"]


def margin(lam, w):
    return float(torch.maximum(lam, w).detach().min())


def assert_equals(solution, lam, w, F, tol=1e-8):
    """Relative error in the units of the problem's own scaling, and as plain norms."""
    scale = F.diagonal(dim1=-2, dim2=-1).sqrt()
    size = (lam * scale).abs().amax(-1, keepdim=True) + (w / scale).abs().amax(-1, keepdim=True)
    assert bool((solution.status == Status.CONVERGED).all())
    assert bool(((solution.lam - lam).abs() * scale <= tol * size + 1e-300).all())
    assert bool(((solution.w - w).abs() / scale <= tol * size + 1e-300).all())
    assert bool(((solution.lam - lam).norm(dim=-1) <= tol * (lam.norm(dim=-1) + 1e-300)).all())


# --- exact values ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
def test_exact_solution_equals_enumeration(build, kind, n):
    Fs = torch.stack([make(kind, n, 100 * n + seed) for seed in range(20)])
    if kind in NOT_DEFINITE and n >= 5:
        assert (torch.linalg.eigvalsh(Fs + Fs.mT)[:, 0] < 0).any()
    q = build.normal(n)(20, n)
    lam, w = (
        torch.stack(v) for v in zip(*(build.enumerate_lcp(F, p) for F, p in zip(Fs, q, strict=True)), strict=True)
    )
    assert_equals(solve_lcp(Fs, q), lam, w, Fs)


@pytest.mark.parametrize("kind", KINDS)
def test_exact_solution_equals_enumeration_up_to_twelve(build, kind):
    for n in (10, 12):
        F, q = make(kind, n, n), build.normal(n)(3, n)
        lam, w = (torch.stack(v) for v in zip(*(build.enumerate_lcp(F, p) for p in q), strict=True))
        assert_equals(solve_lcp(F, q), lam, w, F)


@pytest.mark.parametrize("F_scale", [1e-4, 1.0, 1e3])
@pytest.mark.parametrize("q_scale", [1e-4, 1.0, 1e3])
@pytest.mark.parametrize("kind", ["unsymmetric", "scaled"])
def test_exact_solution_holds_at_every_scale(build, F_scale, q_scale, kind):
    F = F_scale * torch.stack([make(kind, 6, seed) for seed in range(10)])
    q = q_scale * build.normal(7)(10, 6)
    lam, w = (torch.stack(v) for v in zip(*(build.enumerate_lcp(f, p) for f, p in zip(F, q, strict=True)), strict=True))
    assert_equals(solve_lcp(F, q), lam, w, F)


@pytest.mark.parametrize("seed", range(5))
def test_badly_scaled_rows_and_columns_keep_the_accuracy(build, seed):
    n = build.normal(seed)
    D = torch.logspace(-4, 3, 6, dtype=torch.float64)[torch.randperm(6, generator=torch.Generator().manual_seed(seed))]
    F, q = definite(6, seed, skew=0.5), n(6)
    lam, w = build.enumerate_lcp(F, q)
    # D F D, D q has the solution D⁻¹ λ, D w.
    assert_equals(solve_lcp(D[:, None] * F * D, D * q), lam / D, D * w, D[:, None] * F * D)


@pytest.mark.parametrize("kind", KINDS)
def test_q_with_exact_zeros_is_solved(build, kind):
    F = make(kind, 6, 3)
    q = build.normal(3)(16, 6)
    q[torch.rand(16, 6, generator=torch.Generator().manual_seed(0)) < 0.5] = 0
    lam, w = (torch.stack(v) for v in zip(*(build.enumerate_lcp(F, p) for p in q), strict=True))
    assert_equals(solve_lcp(F, q), lam, w, F)


@pytest.mark.parametrize("n", [1, 5, 12])
@pytest.mark.parametrize("kind", KINDS)
def test_q_zero_gives_exactly_zero(n, kind):
    solution = solve_lcp(make(kind, n, 1), torch.zeros(3, n, dtype=torch.float64))
    assert torch.equal(solution.lam, torch.zeros(3, n, dtype=torch.float64))
    assert torch.equal(solution.w, torch.zeros(3, n, dtype=torch.float64))
    assert bool((solution.status == Status.CONVERGED).all())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [2, 6, 12])
def test_degenerate_solutions_are_found(build, kind, n):
    """λ and w are chosen with indices where both vanish; q follows."""
    F = torch.stack([make(kind, n, seed) for seed in range(12)])
    value = build.normal(n)(12, n).abs() + 0.1
    role = torch.randint(0, 3, (12, n), generator=torch.Generator().manual_seed(n))
    lam, w = torch.where(role == 1, value, 0.0), torch.where(role == 2, value, 0.0)
    q = w - (F @ lam[..., None]).squeeze(-1)
    solution = solve_lcp(F, q)
    # q is rounded, so the error is relative to the numbers that cancelled in it.
    assert bool((solution.status == Status.CONVERGED).all())
    torch.testing.assert_close(solution.lam, lam, rtol=1e-8, atol=1e-8)
    assert float(((solution.w - w).abs() / (F.abs() @ lam[..., None]).squeeze(-1).clamp_min(1)).max()) < 1e-8


def test_all_degenerate_neighbours_of_a_vertex_are_found():
    """Every pattern of q in {−1, 0, 1}⁴: the fully degenerate corners of the complementary cones."""
    F = torch.tensor([[2.0, 1, 0, 0], [-1, 2, 1, 0], [0, -1, 2, 1], [0, 0, -1, 2]], dtype=torch.float64)
    q = torch.tensor(list(itertools.product([-1.0, 0.0, 1.0], repeat=4)), dtype=torch.float64)
    lam, w, status = solve_lcp(F, q)
    assert bool((status == Status.CONVERGED).all())
    torch.testing.assert_close(w, lam @ F.T + q, rtol=0, atol=1e-14)
    assert float((lam * w).abs().max()) == 0
    assert float(lam.min()) >= 0
    assert float(w.min()) >= 0


# --- relaxed --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("relaxation", [1e-8, 1e-5, 1e-2, 1.0, 30.0])
@pytest.mark.parametrize("kind", KINDS)
def test_relaxed_product_is_the_relaxation(build, kind, relaxation):
    F = torch.stack([make(kind, 6, seed) for seed in range(10)])
    q = build.normal(5)(10, 6)
    lam, w, status = solve_lcp(F, q, relaxation=relaxation)
    assert bool((status == Status.CONVERGED).all())
    assert float(torch.minimum(lam, w).min()) > 0
    assert float((lam * w - relaxation).abs().max()) <= 1e-10 * max(1.0, relaxation)
    size = (F.abs() @ lam[..., None]).squeeze(-1) + q.abs()
    assert float(((w - (F @ lam[..., None]).squeeze(-1) - q).abs() / size).max()) <= 1e-11


@pytest.mark.parametrize("F_scale", [1e-4, 1.0, 1e3])
@pytest.mark.parametrize("q_scale", [0.0, 1e-4, 1.0, 1e3])
def test_relaxed_solution_holds_at_every_scale(build, F_scale, q_scale):
    F, q = F_scale * definite(5, 0, skew=0.5), q_scale * build.normal(1)(20, 5)
    lam, w, status = solve_lcp(F, q, relaxation=1e-5)
    assert bool((status == Status.CONVERGED).all())
    assert float((lam * w - 1e-5).abs().max()) <= 1e-10
    assert float(((w - lam @ F.T - q).abs() / (lam @ F.abs().T + q.abs())).max()) <= 1e-11


def test_relaxed_solution_tends_to_the_exact_one(build):
    F, q = definite(5, 2, skew=0.5), build.normal(2)(10, 5)
    exact = solve_lcp(F, q).lam
    errors = [float((solve_lcp(F, q, relaxation=10.0**-k).lam - exact).abs().max()) for k in (4, 6, 8, 10)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-8


def test_relaxed_scalar_has_its_closed_form():
    q = torch.linspace(-2, 2, 21, dtype=torch.float64)[:, None]
    lam = solve_lcp(torch.full((1, 1), 3.0, dtype=torch.float64), q, relaxation=1e-3).lam
    root = (q * q + 4 * 3 * 1e-3).sqrt()
    torch.testing.assert_close(lam, torch.where(q > 0, 2e-3 / (q + root), (root - q) / 6), rtol=1e-12, atol=0)


# --- gradients ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("relaxation", [0.0, 1e-3, 1.0])
@pytest.mark.parametrize("shared", [True, False], ids=["shared", "per-element"])
@pytest.mark.parametrize("output", ["lam", "w", "both"])
def test_gradcheck_in_F_and_q(build, relaxation, shared, output):
    F = definite(4, 4, skew=0.5) if shared else torch.stack([definite(4, s, skew=0.5) for s in range(5)])
    q = build.normal(11)(5, 4)
    base = solve_lcp(F, q)
    assert margin(base.lam, base.w) > 1e-4  # strict complementarity: differentiable

    def function(F, q):
        lam, w, _ = solve_lcp(F, q, relaxation=relaxation)
        return {"lam": lam, "w": w, "both": (lam, w)}[output]

    assert gradcheck(function, (F.requires_grad_(), q.requires_grad_()), eps=1e-6, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("kind", NOT_DEFINITE)
def test_gradcheck_on_matrices_that_are_not_definite(build, kind):
    F, q = make(kind, 4, 2).requires_grad_(), build.normal(13)(3, 4).requires_grad_()
    assert margin(*solve_lcp(F, q)[:2]) > 1e-4
    assert gradcheck(lambda F, q: solve_lcp(F, q)[:2], (F, q), eps=1e-7, atol=1e-5, rtol=1e-5)


def test_gradient_of_w_alone_and_of_lam_alone_add_up(build):
    F, q = definite(4, 1, 0.5).requires_grad_(), build.normal(1)(6, 4).requires_grad_()
    a, b = build.normal(2)(2, 6, 4)
    lam, w, _ = solve_lcp(F, q)
    whole = torch.autograd.grad((lam * a).sum() + (w * b).sum(), (F, q), retain_graph=True)
    parts = zip(
        torch.autograd.grad((lam * a).sum(), (F, q), retain_graph=True),
        torch.autograd.grad((w * b).sum(), (F, q)),
        strict=True,
    )
    for one, (left, right) in zip(whole, parts, strict=True):
        torch.testing.assert_close(one, left + right)


def jacobian_q(F, q):
    return torch.autograd.functional.jacobian(lambda p: solve_lcp(F, p).lam, q)


def test_gradient_at_q_zero_is_that_of_the_inactive_piece():
    F = definite(4, 0, skew=0.5).requires_grad_()
    q = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    lam, w, _ = solve_lcp(F, q)
    assert torch.equal(jacobian_q(F.detach(), q.detach()), torch.zeros(4, 4, dtype=torch.float64))
    grad_F, grad_q = torch.autograd.grad((2 * lam + 3 * w).sum(), (F, q))
    assert torch.equal(grad_q, torch.full((4,), 3.0, dtype=torch.float64))
    assert torch.equal(grad_F, torch.zeros(4, 4, dtype=torch.float64))


@pytest.mark.parametrize("seed", range(12))
def test_gradient_at_a_kink_is_the_one_sided_derivative_of_the_inactive_side(build, seed):
    """λ_i = w_i = 0 exactly, because row i of F does not see the active forces."""
    n = build.normal(seed)
    F = definite(5, seed, skew=0.5)
    F[3:, :3] = F[:3, 3:] = 0
    q = n(5)
    q[3:] = 0
    lam, w, _ = solve_lcp(F, q)
    assert torch.equal(torch.maximum(lam, w)[3:], torch.zeros(2, dtype=torch.float64))
    found = jacobian_q(F, q)
    beside = q + torch.tensor([0, 0, 0, 1e-5, 1e-5], dtype=torch.float64)  # w > 0 there: the inactive side
    torch.testing.assert_close(found, jacobian_q(F, beside), rtol=1e-12, atol=1e-14)
    # One-sided difference quotients of the solution itself, exact since it is piecewise linear.
    for i in range(5):
        step = torch.zeros(5, dtype=torch.float64)
        step[i] = 1e-5
        forward = (solve_lcp(F, q + step).lam - lam) / 1e-5
        if i >= 3:
            torch.testing.assert_close(found[:, i], forward, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("seed", range(12))
def test_gradient_at_a_kink_is_an_element_of_the_generalised_jacobian(build, seed):
    """With rounding either side of a kink may be hit; the Jacobian is that of one piece, never a mixture or NaN."""
    F = torch.round(4 * definite(5, seed, skew=0.5)) / 4 + 2 * torch.eye(5, dtype=torch.float64)
    lam = torch.tensor([1.0, 2.0, 0, 0, 0], dtype=torch.float64)
    w = torch.tensor([0, 0, 1.0, 0, 0], dtype=torch.float64)
    q = w - F @ lam  # indices 3 and 4 are degenerate; all numbers are exact in binary
    found = jacobian_q(F, q)
    assert bool(torch.isfinite(found).all())
    pieces = []
    for extra in itertools.product([False, True], repeat=2):
        active = torch.tensor([True, True, False, *extra])
        M = torch.where(active[:, None], F, torch.eye(5, dtype=torch.float64))
        pieces.append(-torch.linalg.solve(M, torch.diag(active.double())))
    assert min(float((found - p).abs().max()) for p in pieces) < 1e-10


def test_gradients_stay_finite_at_random_kinks(build):
    F = torch.stack([definite(5, s, 0.5) for s in range(40)]).requires_grad_()
    role = torch.randint(0, 3, (40, 5), generator=torch.Generator().manual_seed(0))
    value = build.normal(0)(40, 5).abs()
    q = torch.where(role == 2, value, 0.0) - (F @ torch.where(role == 1, value, 0.0)[..., None]).squeeze(-1)
    q = q.detach().requires_grad_()
    for relaxation in (0.0, 1e-14):
        lam, w, _ = solve_lcp(F, q, relaxation=relaxation)
        for gradient in torch.autograd.grad((lam + w).sum(), (F, q)):
            assert bool(torch.isfinite(gradient).all())


def test_shared_gradient_is_the_sum_over_the_batch(build):
    F, q, upstream = definite(4, 3, 0.5), build.normal(3)(7, 4), build.normal(4)(7, 4)
    shared, each = F.clone().requires_grad_(), F.expand(7, 4, 4).clone().requires_grad_()
    (solve_lcp(shared, q).lam * upstream).sum().backward()
    (solve_lcp(each, q).lam * upstream).sum().backward()
    torch.testing.assert_close(shared.grad, each.grad.sum(0), rtol=1e-12, atol=1e-14)


def test_double_backward_is_refused():
    F = definite(3, 0).requires_grad_()
    q = torch.full((3,), -1.0, dtype=torch.float64, requires_grad=True)
    with pytest.raises(DoubleBackwardError, match=r"first derivatives only.*create_graph=False"):
        torch.autograd.grad(solve_lcp(F, q).lam.sum(), q, create_graph=True)


# --- batches --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("relaxation", [0.0, 1e-5])
@pytest.mark.parametrize("shared", [True, False], ids=["shared", "per-element"])
@pytest.mark.parametrize("n", [1, 5, 9, 10, 16])
def test_batch_equals_loop_bitwise(build, relaxation, shared, n):
    F = definite(n, 0, 0.5) if shared else torch.stack([definite(n, s, 0.5) for s in range(37)])
    q = build.normal(n)(37, n)
    whole = solve_lcp(F, q, relaxation=relaxation)
    for i in range(37):
        one = solve_lcp(F if shared else F[i], q[i], relaxation=relaxation)
        assert torch.equal(one.lam, whole.lam[i])
        assert torch.equal(one.w, whole.w[i])


@pytest.mark.parametrize("relaxation", [0.0, 1e-5])
def test_an_element_depends_on_neither_order_nor_size_nor_neighbours(build, relaxation):
    n = build.normal(8)
    F, q = torch.stack([definite(5, s, 0.5) for s in range(300)]), n(300, 5)
    whole = solve_lcp(F, q, relaxation=relaxation)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    mixed = solve_lcp(F[order], q[order], relaxation=relaxation)
    assert torch.equal(mixed.lam, whole.lam[order])
    assert torch.equal(solve_lcp(F[3:20], q[3:20], relaxation=relaxation).lam, whole.lam[3:20])
    # Other neighbours, some of them wild.
    other = q.clone()
    other[1::2] = 1e6 * n(150, 5)
    assert torch.equal(solve_lcp(F, other, relaxation=relaxation).lam[::2], whole.lam[::2])


@pytest.mark.parametrize("relaxation", [0.0, 1e-5])
def test_threads_change_no_bit(build, relaxation):
    F, q = definite(5, 0, 0.5), build.normal(9)(1000, 5)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(solve_lcp(F, q, relaxation=relaxation).lam)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_float32_in_is_float32_out_solved_in_float64(build):
    F, q = definite(5, 1, 0.5).float().requires_grad_(), build.normal(1)(9, 5).float().requires_grad_()
    solution = solve_lcp(F, q)
    exact = solve_lcp(F.detach().double(), q.detach().double())
    assert solution.lam.dtype == solution.w.dtype == torch.float32
    assert torch.equal(solution.lam, exact.lam.float())
    assert torch.equal(solution.w, exact.w.float())
    solution.lam.sum().backward()
    assert F.grad.dtype == q.grad.dtype == torch.float32


def test_unbatched_in_is_unbatched_out(build):
    lam, w, status = solve_lcp(definite(3, 0), build.normal(0)(3))
    assert lam.shape == w.shape == (3,)
    assert status.shape == ()
    assert status.dtype == torch.int8


def test_several_leading_dimensions_are_kept(build):
    q = build.normal(0)(2, 3, 4, 5)
    F = definite(5, 0, 0.5)
    lam, _, status = solve_lcp(F, q)
    assert lam.shape == (2, 3, 4, 5)
    assert status.shape == (2, 3, 4)
    assert torch.equal(lam.reshape(-1, 5), solve_lcp(F, q.reshape(-1, 5)).lam)


def test_leading_dimensions_broadcast(build):
    F = torch.stack([definite(4, s, 0.5) for s in range(3)])
    q = build.normal(0)(2, 1, 4)
    lam = solve_lcp(F, q).lam
    assert lam.shape == (2, 3, 4)
    for i, j in itertools.product(range(2), range(3)):
        assert torch.equal(lam[i, j], solve_lcp(F[j], q[i, 0]).lam)


def test_gradients_of_broadcast_inputs_sum_over_what_was_broadcast(build):
    F = torch.stack([definite(4, s, 0.5) for s in range(3)]).requires_grad_()
    q = build.normal(0)(2, 1, 4).requires_grad_()
    solve_lcp(F, q).lam.square().sum().backward()
    F_full, q_full = (
        F.detach().expand(2, 3, 4, 4).clone().requires_grad_(),
        q.detach().expand(2, 3, 4).clone().requires_grad_(),
    )
    solve_lcp(F_full, q_full).lam.square().sum().backward()
    torch.testing.assert_close(F.grad, F_full.grad.sum(0), rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(q.grad, q_full.grad.sum(1, keepdim=True), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("relaxation", [0.0, 1e-5])
@pytest.mark.parametrize("batch", [(0,), (0, 3), (2, 0)])
def test_an_empty_batch_gives_empty_results_and_zero_gradient(relaxation, batch):
    F = definite(4, 0).requires_grad_()
    q = torch.empty(*batch, 4, dtype=torch.float64, requires_grad=True)
    lam, w, status = solve_lcp(F, q, relaxation=relaxation)
    assert lam.shape == w.shape == (*batch, 4)
    assert status.shape == batch
    lam.sum().backward()
    assert torch.equal(F.grad, torch.zeros(4, 4, dtype=torch.float64))
    assert q.grad.shape == q.shape


def test_memory_layout_does_not_matter(build):
    n = build.normal(0)
    F, q = definite(4, 0, 0.5), n(10, 8)
    expected = solve_lcp(F, q[:, ::2].contiguous()).lam
    assert torch.equal(solve_lcp(F, q[:, ::2]).lam, expected)
    assert torch.equal(solve_lcp(F.T.contiguous().T, q[:, ::2]).lam, expected)
    assert torch.equal(solve_lcp(F, q.T.contiguous().T[:, ::2]).lam, expected)


def test_inputs_are_left_as_they_were(build):
    F, q = definite(4, 0, 0.5), build.normal(0)(10, 4)
    kept = F.clone(), q.clone()
    solve_lcp(F, q)
    solve_lcp(F, q, relaxation=1e-3)
    assert torch.equal(F, kept[0])
    assert torch.equal(q, kept[1])


# --- large problems -------------------------------------------------------------------------------------------------


def make_large(kind, n, seed):
    """F and q of a kind for which pivoting alone needs many steps, or never ends."""
    generator = torch.Generator().manual_seed(seed)
    A, eye = torch.randn(n, n, generator=generator, dtype=torch.float64), torch.eye(n, dtype=torch.float64)
    ones, q = torch.ones(n, n, dtype=torch.float64), torch.randn(n, generator=generator, dtype=torch.float64)
    if kind == "skew":
        return A - A.T + eye, q
    if kind == "degenerate":
        role = torch.randint(0, 3, (n,), generator=generator)
        F = A - A.T + eye
        return F, torch.where(role == 2, q.abs(), 0.0) - F @ torch.where(role == 1, q.abs(), 0.0)
    if kind == "obstacle":
        F = 2 * eye - torch.diag(torch.ones(n - 1).double(), 1) - torch.diag(torch.ones(n - 1).double(), -1)
        return F, F @ (0.5 - 2 * torch.linspace(-1, 1, n, dtype=torch.float64) ** 2)
    murty = eye + 2 * torch.triu(ones, 1)
    return (murty if kind == "murty" else murty.T @ murty), -ones[0]  # else Fathi's


@pytest.mark.parametrize("relaxation", [0.0, 1e-4])
@pytest.mark.parametrize("kind", ["skew", "degenerate", "obstacle", "murty", "fathi"])
def test_large_problems_are_solved_forwards_and_backwards(kind, relaxation):
    for n in (63, 64, 130):
        F, q = (v.requires_grad_() for v in make_large(kind, n, n))
        lam, w, status = solve_lcp(F, q, relaxation, time_limit=60.0)
        (lam.sum() + w.sum()).backward()
        assert bool(torch.isfinite(F.grad).all())
        F, q, lam, w = (v.detach() for v in (F, q, lam, w))
        assert int(status) == Status.CONVERGED
        assert float((lam * w - relaxation).abs().max()) <= 1e-9 * relaxation
        assert float(torch.minimum(lam, w).min()) >= 0
        size = F.abs() @ lam + q.abs()
        assert float(((w - F @ lam - q).abs() / size).max()) <= 1e-12
        batch = solve_lcp(torch.stack([F, torch.eye(n).double()]), torch.stack([q, q]), relaxation)
        assert torch.equal(batch.lam[0], lam)


@pytest.mark.parametrize("relaxation", [0.0, 1e-4])
@pytest.mark.parametrize("n", [3, 40, 300])
def test_what_the_time_does_not_suffice_for_is_max_iter(relaxation, n):
    F, q = (v.requires_grad_() for v in make_large("skew", n, 0))
    with pytest.warns(SolveWarning, match="1 of 1 LCPs.*MAX_ITER: not within time_limit"):
        lam, w, status = solve_lcp(F, q, relaxation, time_limit=1e-9)
    assert int(status) == Status.MAX_ITER
    assert bool(torch.isfinite(lam).all() & torch.isfinite(w).all())
    assert bool((torch.minimum(lam, w) >= 0).all())
    (lam.sum() + w.sum()).backward()
    assert not F.grad.any()
    assert not q.grad.any()
    assert torch.equal(solve_lcp(F, q, relaxation, 60.0).lam, solve_lcp(F, q, relaxation).lam)


# --- failures -------------------------------------------------------------------------------------------------------


def test_an_element_that_is_not_solvable_is_reported_and_spoils_no_other(build):
    F = torch.stack([definite(3, s, 0.5) for s in range(6)])
    q = build.normal(3)(6, 3)
    clean_F, clean_q = F.clone().requires_grad_(), q.clone().requires_grad_()
    clean = solve_lcp(clean_F, clean_q)
    clean.lam.sum().backward()
    F[2], q[2] = -torch.eye(3), -1.0  # −λ − 1 ≥ 0 has no solution
    F.requires_grad_()
    q.requires_grad_()
    with pytest.warns(SolveWarning, match=r"1 of 6 LCPs were not solved.*positive definite.*status"):
        solution = solve_lcp(F, q)
    assert (solution.status != Status.CONVERGED).tolist() == [False, False, True, False, False, False]
    assert bool(torch.isfinite(solution.lam).all())
    assert float(solution.lam.detach().min()) >= 0
    (solution.lam.sum() + solution.w[2].sum()).backward()
    assert torch.equal(F.grad[2], torch.zeros(3, 3, dtype=torch.float64))
    assert torch.equal(q.grad[2], torch.zeros(3, dtype=torch.float64))
    others = [0, 1, 3, 4, 5]
    assert torch.equal(solution.lam[others], clean.lam[others])
    assert torch.equal(F.grad[others], clean_F.grad[others])
    assert torch.equal(q.grad[others], clean_q.grad[others])


def test_an_unsolved_relaxed_element_has_finite_numbers_and_no_gradient():
    F = torch.stack([torch.eye(2), -torch.eye(2)]).double().requires_grad_()
    q = torch.full((2, 2), -1.0, dtype=torch.float64, requires_grad=True)
    with pytest.warns(SolveWarning, match="1 of 2"):
        solution = solve_lcp(F, q, relaxation=1e-3)
    assert (solution.status == Status.CONVERGED).tolist() == [True, False]
    assert bool(torch.isfinite(solution.lam).all())
    (solution.lam + solution.w).sum().backward()
    assert bool(torch.isfinite(F.grad).all())
    assert torch.equal(F.grad[1], torch.zeros(2, 2, dtype=torch.float64))


def test_nan_upstream_of_an_unsolved_element_does_not_spread():
    F = torch.stack([torch.eye(2), -torch.eye(2)]).double().requires_grad_()
    q = torch.full((2, 2), -1.0, dtype=torch.float64, requires_grad=True)
    with pytest.warns(SolveWarning):
        lam = solve_lcp(F, q).lam
    lam.backward(torch.tensor([[1.0, 1.0], [torch.nan, torch.nan]], dtype=torch.float64))
    assert bool(torch.isfinite(F.grad).all())
    assert bool(torch.isfinite(q.grad).all())


def test_converged_is_never_claimed_for_something_else(build):
    """Arbitrary matrices, most of them no P-matrices: an element is solved, or says that it is not."""
    n = build.normal(21)
    F, q = n(400, 4, 4), n(400, 4)
    for relaxation in (0.0, 1e-3):
        with pytest.warns(SolveWarning):
            lam, w, status = solve_lcp(F, q, relaxation=relaxation)
        assert bool(torch.isfinite(lam).all())
        assert bool(torch.isfinite(w).all())
        solved = status == Status.CONVERGED
        assert 0 < int(solved.sum()) < 400
        size = (F.abs() @ lam[..., None]).squeeze(-1) + q.abs()
        error = torch.stack([(w - (F @ lam[..., None]).squeeze(-1) - q).abs() / size, (lam * w - relaxation).abs()])
        assert float(error[:, solved].max()) <= 1e-9
        assert float(torch.minimum(lam, w)[solved].min()) >= 0


# --- invariants -----------------------------------------------------------------------------------------------------

numbers = st.floats(-10, 10, allow_nan=False, width=32)


@st.composite
def problems(draw):
    n = draw(st.integers(1, 6))
    G, H = (np.array(draw(st.lists(numbers, min_size=n * n, max_size=n * n))).reshape(n, n) for _ in range(2))
    q = np.array(draw(st.lists(numbers | st.just(0.0), min_size=n, max_size=n)))
    return torch.from_numpy(0.1 * G @ G.T + np.eye(n) + 0.3 * (H - H.T)), torch.from_numpy(q)


@given(problems())
@settings(max_examples=150, deadline=None)
def test_exact_solutions_are_nonnegative_complementary_and_consistent(problem):
    F, q = problem
    lam, w, status = solve_lcp(F, q)
    assert int(status) == Status.CONVERGED
    assert float(torch.minimum(lam, w).min()) >= 0
    assert float((lam * w).max()) == 0
    size = F.abs() @ lam + q.abs()
    assert bool(((w - F @ lam - q).abs() <= 1e-10 * size + 1e-300).all())


@given(problems(), st.floats(1e-8, 10))
@settings(max_examples=100, deadline=None)
def test_relaxed_solutions_are_positive_and_on_the_path(problem, relaxation):
    F, q = problem
    lam, w, status = solve_lcp(F, q, relaxation=relaxation)
    assert int(status) == Status.CONVERGED
    assert float(torch.minimum(lam, w).min()) > 0
    assert float((lam * w / relaxation - 1).abs().max()) <= 1e-10


@given(problems(), st.integers(-12, 12), st.integers(-12, 12))
@settings(max_examples=100, deadline=None)
def test_scaling_F_and_q_scales_lam(problem, a, b):
    F, q = problem
    lam, w, _ = solve_lcp(F, q)
    scaled = solve_lcp(2.0**a * F, 2.0**b * q)
    torch.testing.assert_close(scaled.lam, 2.0 ** (b - a) * lam, rtol=1e-9, atol=1e-12 * 2.0 ** (b - a))
    torch.testing.assert_close(scaled.w, 2.0**b * w, rtol=1e-9, atol=1e-9 * 2.0**b)
