"""LCSMPCLayer: what a user of PyTorch expects of a layer, and what happens when a solve fails."""

import copy
import gc
import pickle
import warnings
import weakref
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest
import torch
from torch import nn

import difflcs
from difflcs.errors import BatchIndexError, BoundsError, DTypeError, ShapeError, SolveWarning
from difflcs.mpc import MPCProblem, Primal
from difflcs.mpc.backends import Backend, BatchedBackend, certify
from difflcs.mpc.backends.base import Result
from difflcs.mpc.problem import INPUTS
from tests.conftest import refuse

SOLVER = BatchedBackend(threads=1)


@dataclass(frozen=True)
class Flaky(Backend):
    """Solves well, then gives up on chosen elements and returns NaN for them."""

    name = "flaky"
    fail: tuple[int, ...] = ()
    garbage: float = float("nan")

    def solve(self, problem, guess):
        result = SOLVER.solve(problem, guess)
        primal, status = Primal(*(v.clone() for v in result.primal)), result.status.clone()
        for i in self.fail:
            for value in primal:
                value[i] = self.garbage
            status[i] = difflcs.Status.MAX_ITER
        return certify(problem, primal, status, result.iterations, result.solve_time, tol=1e-6)


@dataclass(frozen=True)
class Recorder(Backend):
    """Solves nothing, and keeps what it was asked."""

    name = "recorder"
    seen: list = field(default_factory=list)

    def solve(self, problem, guess):
        self.seen.append((problem, guess))
        B, H = problem.batch, problem.horizon
        primal = Primal(
            torch.zeros(B, H + 1, problem.n_x).double(), torch.zeros(B, H, problem.n_u).double(),
            torch.zeros(B, H, problem.n_lam).double(), problem.no_multipliers(),
        )  # fmt: skip
        zeros = torch.zeros(B, dtype=torch.float64)
        return Result(primal, zeros.to(torch.int8), zeros.to(torch.int32), zeros, zeros)

    @property
    def problem(self) -> MPCProblem:
        return self.seen[-1][0]


@pytest.fixture
def layer(build):
    return difflcs.LCSMPCLayer(
        build.model(seed=3, scale=0.4), build.cost(0), 3, -0.15, 0.15, backend=SOLVER, relaxation=1e-4
    )


@pytest.fixture
def x0(build):
    return 0.2 * build.normal(5)(6, 4)


def make_layer(build, seed=3, **options):
    options = {"lcs": build.params(seed), "cost": build.cost(seed), "backend": SOLVER, "relaxation": 1e-4, **options}
    return difflcs.LCSMPCLayer(horizon=3, u_min=-0.15, u_max=0.15, **options)


# --- shapes ---------------------------------------------------------------------------------------------------------


def test_leading_dimensions_of_states_and_systems_broadcast_and_are_kept(build, layer, x0):
    one, flat, folded = layer(x0[0]), layer(x0), layer(x0.T.contiguous().T.reshape(2, 1, 3, 4))
    assert isinstance(one, difflcs.MPCSolution)
    assert (one.x.shape, one.u.shape, one.lam.shape, one.action.shape) == ((4, 4), (3, 2), (3, 3), (2,))
    for scalar in (one.objective, one.status, one.iterations, one.kkt_residual, one.solve_time, one.converged):
        assert scalar.shape == ()
    assert one.complementarity().shape == one.dynamics_residual().shape == ()
    assert folded.x.shape == (2, 1, 3, 4, 4)
    assert folded.status.shape == folded.objective.shape == folded.complementarity().shape == (2, 1, 3)
    assert torch.equal(one.u, flat.u[0])
    assert torch.equal(folded.u.reshape(6, 3, 2), flat.u)
    grid = difflcs.LCSParams(**{k: v.expand(2, 3, *v.shape) for k, v in layer.lcs.params().tensors().items()})
    assert torch.equal(layer(x0[0], lcs=grid).u, one.u.expand(2, 3, 3, 2))


# --- warm start -----------------------------------------------------------------------------------------------------


def test_a_guess_has_no_gradient_and_changes_none(layer, x0):
    guess = layer(x0)
    layer(x0).action.sum().backward()
    plain = layer.lcs.A.grad.clone()
    layer.zero_grad()
    layer(x0, guess=guess).action.sum().backward()
    torch.testing.assert_close(layer.lcs.A.grad, plain, rtol=1e-4, atol=1e-6)
    layer.requires_grad_(False)
    assert guess.u.requires_grad
    assert not layer(x0, guess=guess).u.requires_grad


# --- bounds ---------------------------------------------------------------------------------------------------------


def test_a_plan_stays_within_the_actions_that_the_model_was_fitted_to(build, layer, x0):
    free = layer(x0).u.detach()
    support = torch.tensor([[-0.02, -0.3], [0.01, 0.03]], dtype=torch.float64)
    layer.lcs.action_support = support
    low, high = layer.limits()
    assert low.tolist() == [-0.02, -0.15]
    assert high.tolist() == [0.01, 0.03]
    held = layer(x0).u.detach()
    assert bool(((held >= low) & (held <= high)).all())
    assert not torch.allclose(held, free)
    other = difflcs.LCSMPCLayer(layer.lcs.params(), layer.cost, 3, low, high, backend=SOLVER, relaxation=1e-4)
    torch.testing.assert_close(held, other(x0).u.detach(), rtol=0, atol=1e-12)
    # What a call asks for comes first, and stages are bounds of one's own.
    torch.testing.assert_close(layer(x0, u_min=-0.15, u_max=0.15).u.detach(), free, rtol=0, atol=1e-12)
    stages = difflcs.StageBounds(torch.full((3, 2), -0.15, dtype=torch.float64), 0.15)
    torch.testing.assert_close(layer(x0, bounds=stages).u.detach(), free, rtol=0, atol=1e-7)
    refuse(BoundsError, "action_support to None", difflcs.LCSMPCLayer, layer.lcs, layer.cost, 3, 0.02, 0.15)
    layer.lcs.action_support = None
    torch.testing.assert_close(layer(x0).u.detach(), free, rtol=0, atol=1e-12)


def test_learned_bounds_at_the_action_support_have_their_gradient(build, x0):
    low, high = (nn.Parameter(torch.full((2,), v, dtype=torch.float64)) for v in (-0.01, 0.01))
    model = build.model(seed=3, scale=0.4)
    layer = difflcs.LCSMPCLayer(model, build.cost(0), 3, low, high, backend=SOLVER, relaxation=1e-4)
    layer(x0).u.sum().backward()
    wanted = low.grad.clone(), high.grad.clone()
    assert float(wanted[0].abs().max()) > 0
    low.grad = high.grad = None
    model.action_support = torch.stack([low, high]).detach()
    layer(x0).u.sum().backward()
    for bound, gradient in zip((low, high), wanted, strict=True):
        torch.testing.assert_close(bound.grad, gradient, rtol=1e-9, atol=1e-12)


# --- failures -------------------------------------------------------------------------------------------------------


def test_raise_names_the_elements_and_their_status(build, x0):
    with pytest.raises(difflcs.SolveError, match=r"2 of 6 .*2 MAX_ITER.*elements 1, 4.*on_failure=\"mask\"") as error:
        make_layer(build, backend=Flaky(fail=(1, 4)))(x0)
    assert error.value.elements == (1, 4)
    assert error.value.status == (difflcs.Status.MAX_ITER, difflcs.Status.MAX_ITER)


@pytest.mark.parametrize("fail", [(1, 4), tuple(range(6))])
@pytest.mark.parametrize("garbage", [float("nan"), 1e300, 7.0])
def test_mask_gives_the_failed_no_gradient_and_leaves_the_others_alone(build, x0, fail, garbage):
    others, results = [i for i in range(6) if i not in fail], []
    for backend, start in ((Flaky(), x0[others]), (Flaky(fail=fail, garbage=garbage), x0)):
        cost = difflcs.QuadraticCost(**build.cost_tensors(3), constant=nn.Parameter(torch.zeros(()).double()))
        layer = make_layer(build, 3, lcs=build.model(3, scale=0.4), cost=cost, backend=backend, on_failure="mask")
        start = start.clone().requires_grad_()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SolveWarning)
            solution = layer(start)
        outputs = (solution.x, solution.u, solution.lam, solution.objective)
        solved = solution.converged.nonzero()[:, 0]  # what comes from elsewhere for the others is NaN
        torch.autograd.backward(outputs, [torch.full_like(v, torch.nan).index_fill(0, solved, 1.0) for v in outputs])
        results.append((solution, start.grad, [p.grad for p in layer.parameters()]))
    (good, good_grad, good_shared), (bad, bad_grad, bad_shared) = results
    for name in ("x", "u", "lam", "objective", "status", "kkt_residual"):
        assert torch.equal(getattr(bad, name)[others], getattr(good, name))
    torch.testing.assert_close(bad_grad[others], good_grad)
    torch.testing.assert_close(bad_shared, good_shared)
    assert not bad_grad[list(fail)].any()
    assert bad.status.tolist() == [difflcs.Status.MAX_ITER if i in fail else difflcs.Status.CONVERGED for i in range(6)]
    for value in (bad.x, bad.u, bad.lam, bad.objective, bad.kkt_residual):
        assert bool(torch.isfinite(value).all())
    assert float(bad.u.detach().abs().max()) <= 0.15
    assert torch.equal(bad.x[:, 0].detach(), x0)


def test_mask_warns_once_per_layer(build, x0):
    layer = make_layer(build, backend=Flaky(fail=(1,)), on_failure="mask")
    with pytest.warns(SolveWarning, match=r"1 of 6 .*MAX_ITER.*element.* 1.*gradient is zero.*warns once") as said:
        layer(x0)
    assert said[0].filename == __file__
    layer(x0)  # filterwarnings = error would raise here


def test_a_backend_that_claims_success_is_judged_by_the_residual(build, x0):
    """`certify` does not take the solver's word."""

    @dataclass(frozen=True)
    class Liar(Backend):
        name = "liar"

        def solve(self, problem, guess):
            result = SOLVER.solve(problem, guess)
            u = result.primal.u.clone()
            u[3] += 0.01
            u[5] = torch.nan
            return certify(
                problem, result.primal._replace(u=u), result.status, result.iterations, result.solve_time, tol=1e-6
            )

    refuse(difflcs.SolveError, r"2 of 6 .*2 NUMERICAL.*elements 3, 5", make_layer(build, backend=Liar()), x0)


# --- what a problem may be ------------------------------------------------------------------------------------------


def recording(build, **options):
    backend = Recorder()
    options = {"lcs": build.params(3), "cost": build.cost(3), "horizon": 3, **options}
    return difflcs.LCSMPCLayer(**options, backend=backend), backend


def test_a_backend_may_have_a_time_limit_that_is_no_option_of_it(build, x0):
    class Limited(Recorder):
        time_limit = 5.0

    backend = Limited()
    difflcs.LCSMPCLayer(build.params(3), build.cost(3), 3, backend=backend)(x0)
    assert len(backend.seen) == 1


@pytest.mark.parametrize("name", ["lcs", "cost", "constraints", "bounds"])
def test_what_a_call_is_given_replaces_the_layers_own(build, x0, name):
    n = build.normal(7)
    rows = [difflcs.LinearConstraints(n(2, 4), torch.full((2,), g).double(), weight=1.0) for g in (1.0, 0.02)]
    bounds = [difflcs.StageBounds(torch.full((3, 2), -b).double(), 0.1) for b in (0.1, 0.02)]
    first = {"lcs": build.params(3), "cost": build.cost(3), "constraints": rows[0], "bounds": bounds[0]}
    other = {"lcs": build.params(4), "cost": build.cost(4), "constraints": rows[1], "bounds": bounds[1]}[name]
    options = {"horizon": 3, "backend": SOLVER, "relaxation": 1e-4}
    layer, built = difflcs.LCSMPCLayer(**first, **options), difflcs.LCSMPCLayer(**{**first, name: other}, **options)
    assert torch.equal(layer(x0, **{name: other}).u, built(x0).u)
    assert not torch.equal(layer(x0).u, built(x0).u)
    assert torch.equal(layer(x0).u, difflcs.LCSMPCLayer(**first, **options)(x0).u)


# --- modules that say the system ------------------------------------------------------------------------------------


def ones(*shape):
    return torch.ones(shape, dtype=torch.float64)


# By keyword what does not fit, the error, and what it says; a layer refuses the first ones too, where it is built.
FITS_NOT_A_LAYER = [
    (lambda b: {"bounds": difflcs.StageBounds(-ones(3, 3), 1.0)}, ShapeError,
     "bounds: expected n_u=2 like the LCS, got n_u=3"),
    (lambda b: {"bounds": difflcs.StageBounds(-ones(5, 2), 1.0)}, ShapeError,
     "bounds: expected 3 stages, the layer's horizon, got 5; give one for each"),
    (lambda b: {"bounds": (-1, 1)}, DTypeError, r"bounds: expected StageBounds, got tuple \(-1, 1\); pass constant"),
    (lambda b: {"bounds": difflcs.StageBounds(-ones(3, 2), 1.0), "u_min": 0.0}, ShapeError,
     "u_min: expected none with bounds, got float 0.0; put it"),
    (lambda b: {"constraints": [difflcs.LinearConstraints(ones(2, 4), ones(2))]}, DTypeError,
     "constraints: expected LinearConstraints or ConstraintSequence, got list"),
    (lambda b: {"constraints": difflcs.LinearConstraints(ones(2, 5), ones(2))}, ShapeError,
     "constraints: expected n_x=4 like the LCS, got n_x=5"),
    (lambda b: {"constraints": difflcs.LinearConstraints(ones(2, 4), ones(2), ones(2, 3))}, ShapeError,
     "constraints: expected n_u=2 like the LCS, got n_u=3"),
    (lambda b: {"constraints": difflcs.ConstraintSequence(ones(2, 4), ones(5, 2), by_stage=("g",))}, ShapeError,
     "constraints: expected 3 stages, .* got 4"),
    (lambda b: {"cost": difflcs.CostSequence(**{**b.cost_tensors(3), "q": ones(4, 4)}, by_stage=("q",))}, ShapeError,
     "cost: expected 3 stages, .* got 4"),
]  # fmt: skip
FITS_NOT_A_CALL = [
    (lambda b: {"lcs": difflcs.LCSSequence.stack([b.params(3)] * 2)}, ShapeError,
     "lcs: expected 3 stages, .*horizon, got 2"),
    (lambda b: {"lcs": b.params(3, n_x=5)}, ShapeError, r"x0: expected shape \(\.\.\., n_x=5\), got \(6, 4\)"),
    (lambda b: {"constraints": difflcs.LinearConstraints(ones(2, 4), ones(5, 2))}, ShapeError,
     r"batch dimensions .* do not fit.*x0 \(6,\)"),
    (lambda b: {"lcs": SimpleNamespace(n_x=4, n_u=2, n_lam=3, params=lambda x, context: {})}, DTypeError,
     "lcs: expected LCSParams or LCSSequence, got dict.*; return one of them from SimpleNamespace.params"),
    (lambda b: {"lcs": SimpleNamespace(n_x=4, n_u=2, n_lam=5, params=lambda x, context: b.params(3))}, ShapeError,
     "lcs: expected n_lam=5 from SimpleNamespace.params, as SimpleNamespace.n_lam says, got 3; correct"),
    (lambda b: {"context": ones(2)}, ShapeError, "context: expected none with LCSParams, .*; pass lcs="),
    (lambda b: {"goal": ones(4)}, ShapeError, "goal: expected none with a QuadraticCost"),
    (lambda b: {"reference": ones(4, 4)}, ShapeError, "reference: expected none with a QuadraticCost"),
]  # fmt: skip
FITS_NO_GOAL = [
    (lambda b: {}, ShapeError, r"goal: expected .*got none; call mpc\(x0, goal\) or mpc\(x0, reference=...\)"),
    (lambda b: {"goal": ones(4), "reference": ones(4, 4)}, ShapeError, "got both"),
    (lambda b: {"reference": ones(3, 4)}, ShapeError, r"reference: .*H\+1=4, n_goal=4\), got \(3, 4"),
]


@pytest.mark.parametrize(("options", "error", "message"), [*FITS_NOT_A_LAYER, *FITS_NOT_A_CALL, *FITS_NO_GOAL])
def test_calls_that_do_not_fit_are_refused(build, x0, options, error, message):
    has_goal = any(message is words for _, _, words in FITS_NO_GOAL)
    layer, backend = recording(build, cost=difflcs.GoalCost.reach(4, 2, 1.0) if has_goal else build.cost(3))
    assert ";" in refuse(error, message, layer, x0, **options(build))
    assert not backend.seen
    if any(message is words for _, _, words in FITS_NOT_A_LAYER):
        with pytest.raises(error):
            recording(build, **options(build))


def test_a_guess_may_leave_out_the_multipliers(build, x0):
    rows = difflcs.LinearConstraints(build.normal(0)(2, 4), torch.ones(2).double())
    layer, backend = recording(build, constraints=rows)
    full = layer(x0)
    assert full.mu.shape == (6, 4, 2)
    none = torch.zeros(6, 4, 2).double()
    for guess, mu in (
        (Primal(full.x, full.u, full.lam), none),
        (Primal(full.x, full.u, full.lam, none + 1), none + 1),
        (recording(build)[0](x0), none),  # a plan without constraints
    ):
        layer(x0, guess=guess)
        assert torch.equal(backend.seen[-1][1].mu, mu)
    with pytest.raises(ShapeError, match=r"guess.mu: expected shape \(\.\.\., H\+1=4, n_c=2\), got \(6, 4, 3\)"):
        layer(x0, guess=Primal(full.x, full.u, full.lam, torch.zeros(6, 4, 3).double()))


def test_learned_bounds_and_constraints_are_saved_and_old_states_are_read(build, x0):
    def make(g, low):
        bounds = difflcs.StageBounds(nn.Parameter(torch.full((3, 2), low).double()), 0.1)
        rows = difflcs.LinearConstraints(build.normal(0)(2, 4), nn.Parameter(torch.full((2,), g).double()))
        return recording(build, lcs=build.model(3), bounds=bounds, constraints=rows)

    (layer, backend), (other, _) = make(1.0, -0.1), make(2.0, -0.2)
    assert {"bounds.u_min", "constraints.g", "constraints.G"} <= set(layer.state_dict())
    layer.load_state_dict(other.state_dict())
    layer(x0)
    assert torch.equal(backend.problem.g, torch.full((2,), 2.0).double())
    assert torch.equal(backend.problem.u_min[0], torch.full((3, 2), -0.2).double())
    plain = recording(build, lcs=build.model(3), u_min=-0.1, u_max=0.1)[0]
    before = {f"lcs.{k}" for k in "ABCdDEGHc"} | {f"cost.{k}" for k in INPUTS if k in build.cost_tensors()}
    assert set(plain.state_dict()) == before | {"cost.constant"}  # as in the first version


def test_a_single_layer_moves_with_its_parts(build, x0):
    rows = difflcs.LinearConstraints(build.normal(0)(2, 4), torch.ones(2).double(), weight=1.0)
    layer, backend = recording(
        build, lcs=build.model(3), constraints=rows, bounds=difflcs.StageBounds(-torch.ones(3, 2), 1.0)
    )
    layer.float()
    assert layer.constraints.G.dtype == layer.bounds.u_min.dtype == torch.float32
    solution = layer(x0.float())
    assert solution.mu.dtype == solution.violation.dtype == torch.float32
    assert backend.problem.G_x.dtype == torch.float64


# --- modules --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_copies_and_pickles_plan_the_same(build, layer, x0, copied):
    for original in (layer, make_layer(build)):
        twin = copied(original)
        assert torch.equal(twin(x0).u, original(x0).u)
        assert repr(twin) == repr(original)
        assert all(part in repr(twin) for part in ("horizon=3", "relaxation=0.0001", "BatchedBackend", "'raise'"))
        assert set(twin.state_dict()) == set(original.state_dict())


def test_a_plan_and_a_system_print_their_shapes_and_how_the_plan_ended(build, layer, x0):
    plans = layer(x0), torch.func.vmap(layer)(x0), layer(x0[:0])
    text = " ".join(map(repr, (*plans, build.params().to(torch.float32))))
    counted = [f"x({len(x0)}, 4, 4)", f"status {len(x0)} CONVERGED; objective ≤ "]
    shown = [*counted, "kkt_residual ≤ ", "x(0, 4, 4)", "c(3,), float32)"]
    assert [part for part in shown if part not in text] == []
    assert len(text) < 1000


def test_plans_are_selected_and_detached(build, x0):
    layer = make_layer(build, lcs=build.params(batch=(2, 3)))
    plan = layer(x0.reshape(2, 3, 4).requires_grad_())
    for index in (1, (0, 2), slice(1), (slice(None), 0), plan.objective > 0, torch.tensor([1, 1, 0])):
        part = plan[index].detach()
        assert torch.equal(part.action, plan.action[index])
        assert torch.equal(part.complementarity(), plan.complementarity()[index])
        assert [plan[index].u.requires_grad, part.u.requires_grad] == [True, False]
    assert [len(one.u) for one in plan] == [3, 3]
    for index in (2, (0, 0, 0), "A", 1.0):
        refuse(BatchIndexError, r"batch dimensions \(2, 3\), got", plan.__getitem__, index)
    refuse(BatchIndexError, r"batch dimensions \(\), got", list, plan[0, 0])
    refuse(BatchIndexError, "outside of vmap", torch.func.vmap(lambda x: layer(x)[...]), x0)


def test_a_plan_is_drawn(layer, x0):
    plan = layer(x0)
    states, actions, forces, gaps = plan.plot(1).axes
    assert torch.equal(torch.as_tensor(states.lines[2].get_ydata()), plan.x[1, :, 2].detach())
    assert len(actions.patches) == 3 * plan.u.shape[-1]  # each with two bounds
    assert len(forces.patches) == len(gaps.patches) == plan.lam.shape[-1]
    assert states.figure._repr_png_().startswith(b"\x89PNG")  # what a notebook shows
    refuse(BatchIndexError, f"a batch of {len(x0)}", plan.plot, len(x0))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["batched", "ipopt"])
def test_a_plan_is_freed_without_the_garbage_collector(build, x0, backend):
    """Outputs kept by their own autograd node would form a cycle: memory would grow from call to call."""
    layer = difflcs.LCSMPCLayer(build.model(seed=3, scale=0.4), build.cost(0), 3, -0.15, 0.15, backend=backend)
    gc.collect()
    gc.disable()
    try:
        plan = layer(x0)
        alive = weakref.ref(plan.problem)
        plan.action.sum().backward()
        del plan
        assert alive() is None
    finally:
        gc.enable()
