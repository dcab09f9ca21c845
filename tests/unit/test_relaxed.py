"""Backend `relaxed`: its convex program, gradient and failures; more of all three in test_backends.py."""

import pytest
import torch

from difflcs import Status
from difflcs.errors import InvalidInputError, SolveWarning
from difflcs.mpc import MPCProblem, Primal
from difflcs.mpc.backends import RelaxedBackend
from tests.conformance.cases import Case
from tests.conformance.problems import badly_scaled, contact, make
from tests.conformance.problems import solve as solve_problem
from tests.conftest import refuse


def tensors(build, **options):
    return make(build, **{"batch": 4, **options}).inputs


def solve(t, backend="relaxed", guess=None, **options):
    return solve_problem(Case(t), backend, guess=guess, **options)


def without_contact(build, **options):
    t = tensors(build, **options)
    return {**t, "C": torch.zeros_like(t["C"])}


# --- the plan -------------------------------------------------------------------------------------------------------


@pytest.fixture
def calls(monkeypatch):
    """Replaces calls of cvxpylayers by a function of (its own call, *arguments)."""
    from cvxpylayers.torch import CvxpyLayer

    forward = CvxpyLayer.forward

    def replace(function):
        monkeypatch.setattr(
            CvxpyLayer,
            "forward",
            lambda layer, *leaves, **options: function(lambda: forward(layer, *leaves, **options), *leaves),
        )

    return replace


def test_forces_are_never_negative_although_many_would_pay(build, calls):
    """Cvxpylayers 1.2 with its MOREAU solver drops `x >= 0`: λ = −0.2 came back as solved."""
    t = tensors(build, seed=1, batch=6)
    t["c"] = t["c"] + 1.0  # far from contact
    seen = []  # what cvxpylayers itself returns, before anything is made exact
    calls(lambda call, *_: seen.append(call()) or seen[-1])
    sol = solve(t, RelaxedBackend(penalties=(0.0,)))
    assert bool(sol.converged.all())
    assert float(sol.lam.min()) >= 0.0
    raw = torch.cat([z.detach()[:, 6:] for z, _ in seen])  # λ, after the 3 x 2 actions
    assert float(raw.min()) > -1e-6
    # A λ at zero is held there by its bound: nothing else in this program stops it.
    assert 0.3 < float((raw < 1e-6).double().mean()) < 1.0


@pytest.mark.parametrize(("bound", "barrier"), [(0.05, 0.0), (50.0, 0.0), (0.15, 1e-3)])
def test_without_contact_the_plan_is_the_exact_one(build, bound, barrier):
    t = without_contact(build, seed=3, bound=bound)
    mine, exact = (solve(t, backend, barrier=barrier) for backend in ("relaxed", "batched"))
    assert bool(mine.converged.all())
    assert float(mine.u.abs().max()) < bound or not barrier
    torch.testing.assert_close(mine.u, exact.u, rtol=0, atol=1e-4)
    torch.testing.assert_close(mine.x, exact.x, rtol=0, atol=1e-4)
    torch.testing.assert_close(mine.objective, exact.objective, rtol=1e-4, atol=1e-4)


def test_the_plan_does_not_depend_on_units(build):
    scaled = badly_scaled(build).inputs
    U, plain = scaled["u_max"] / 0.15, contact(build).inputs
    torch.testing.assert_close(solve(scaled).u / U, solve(plain).u, rtol=1e-6, atol=1e-8)


def test_a_guess_makes_one_pass(build):
    t = tensors(build)
    first = solve(t)
    assert first.iterations.tolist() == [2] * 4
    assert solve(t, guess=first).iterations.tolist() == [1] * 4
    wild = Primal(*(1e3 * torch.ones_like(v.detach()) for v in (first.x, first.u, first.lam)))
    assert bool(solve(t, guess=wild).converged.all())


# --- the gradient ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("guessed", [False, True])
def test_every_gradient_is_that_of_all_passes_with_the_guess_held(build, guessed):
    t, n, h = tensors(build, seed=4, batch=2), build.normal(41), 1e-6
    options = {"guess": solve(t)} if guessed else {}
    leaves = {k: v.clone().requires_grad_() for k, v in t.items()}
    sol = solve(leaves, **options)
    weights = [n(*v.shape) for v in (sol.x, sol.u, sol.lam)]

    def value(sol):
        parts = [(w * v).sum() for w, v in zip(weights, (sol.x, sol.u, sol.lam), strict=True)]
        return sum(parts) + sol.objective.sum()

    value(sol).backward()
    for k, v in t.items():
        direction = 0.1 * n(*v.shape)
        if k in ("Q", "R", "Q_final"):
            direction = 0.5 * (direction + direction.mT)
        moved = [float(value(solve({**t, k: v + sign * h * direction}, **options))) for sign in (1, -1)]
        quotient, found = (moved[0] - moved[1]) / (2 * h), float((leaves[k].grad * direction).sum())
        assert abs(found - quotient) <= 1e-3 * max(abs(quotient), 1e-2), k


def test_singular_weights_have_finite_right_gradients(build):
    t = tensors(build, seed=5, batch=2)
    t["Q"] = torch.diag(torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    leaf = t["Q"].clone().requires_grad_()
    solve({**t, "Q": leaf}).u.sum().backward()
    direction, h = torch.diag(torch.tensor([0.0, 1.0, 1.0, 1.0], dtype=torch.float64)), 1e-5
    ahead, here = solve({**t, "Q": t["Q"] + h * direction}).u.sum(), solve(t).u.sum()
    torch.testing.assert_close((leaf.grad * direction).sum(), (ahead - here) / h, rtol=1e-2, atol=1e-3)


# --- failures -------------------------------------------------------------------------------------------------------


@pytest.fixture
def fussy(calls):
    """A solver that raises for a whole batch and for an element whose contacts are far away; tells of each call."""
    sizes = []

    def solver(call, *leaves):
        sizes.append(len(leaves[0]))
        if len(leaves[0]) > 1 or bool((leaves[4].abs() > 10).any()):
            raise RuntimeError("Solver returned status Infeasible")
        return call()

    return lambda: calls(solver) or sizes


def test_a_batch_that_raises_is_solved_element_by_element(build, fussy):
    t = tensors(build)
    leaves = [{k: v.clone().requires_grad_() for k, v in t.items()} for _ in range(2)]
    whole = solve(leaves[0])
    sizes = fussy()
    parts = solve(leaves[1])
    assert sizes == [4, 1, 1, 1, 1] * 2  # in both passes
    torch.testing.assert_close(parts.u, whole.u, rtol=1e-9, atol=1e-11)
    for plan in (whole, parts):
        plan.u.sum().backward()
    for k in t:
        torch.testing.assert_close(leaves[0][k].grad, leaves[1][k].grad, rtol=1e-6, atol=1e-8)


def test_a_failed_element_is_masked_and_spoils_nothing(build, fussy):
    t = tensors(build)
    expected = solve(t)
    fussy()
    marked = {**t, "x0": t["x0"].clone()}
    marked["x0"][2, 0] = 123.0
    leaves = {k: v.clone().requires_grad_() for k, v in marked.items()}
    with pytest.warns(SolveWarning, match="1 of 4 MPC problems were not solved: 1 NUMERICAL"):
        sol = solve(leaves, on_failure="mask")
    ok = Status.CONVERGED
    assert sol.status.tolist() == [ok, ok, Status.NUMERICAL, ok]
    others = torch.tensor([0, 1, 3])
    torch.testing.assert_close(sol.u[others], expected.u[others], rtol=1e-9, atol=1e-11)
    for value in (sol.x, sol.u, sol.lam, sol.objective, sol.kkt_residual):
        assert bool(torch.isfinite(value).all())
    assert bool((sol.u[2].abs() <= 0.15).all())
    (sol.u.sum() + sol.objective.sum()).backward()
    assert bool(torch.isfinite(torch.cat([v.grad.flatten() for v in leaves.values()])).all())
    assert torch.equal(leaves["x0"].grad[2], torch.zeros(4, dtype=torch.float64))
    assert float(leaves["x0"].grad[0].abs().max()) > 0


def test_a_residual_beyond_the_tolerance_is_not_converged(build):
    with pytest.warns(SolveWarning, match="NUMERICAL"):
        sol = solve(tensors(build), RelaxedBackend(residual_tol=1e-300), on_failure="mask")
    assert not bool(sol.converged.any())


def no_contact(t):
    sizes = {"C": (4, 0), "D": (0, 4), "E": (0, 2), "F": (0, 0), "c": (0,)}
    return {name: torch.zeros(size, dtype=torch.float64) for name, size in sizes.items()}


ROW = {
    name: torch.ones(size, dtype=torch.float64)
    for name, size in {"G_x": (1, 4), "G_u": (1, 2), "g": 1, "price": 1}.items()
}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            lambda t: {"B": t["B"].expand(1, 3, 4, 2)},
            "B: expected the same at every stage with .*'relaxed', got one per",
        ),
        (lambda t: {"u_max": t["u_max"].expand(4, 3, 2)}, "u_max: expected the same at every stage"),
        (lambda t: {"u_min": t["u_min"] - torch.inf}, "u_min: expected finite bounds"),
        (lambda t: {"S": torch.ones(4, 2).double()}, "S: expected zero"),
        (lambda t: ROW, "constraints: expected none"),
        (no_contact, "n_lam: expected at least 1"),
    ],
)
def test_what_the_program_does_not_have_is_refused(build, calls, change, match):
    calls(lambda call, *_: pytest.fail("something was solved"))
    t = tensors(build)
    problem = MPCProblem(**{**t, **change(t)}, horizon=3, relaxation=1e-4)
    refuse(InvalidInputError, match + r".*; use backend='batched' or 'ipopt'", RelaxedBackend().solve, problem, None)
