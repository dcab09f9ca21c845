"""Every bad input meets a typed error that says what was expected, what came, and how to mend it."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from torch import nn

from difflcs import (
    ConstraintSequence,
    DiffLCSError,
    GoalCost,
    LCSModel,
    LCSMPCLayer,
    LCSParams,
    LinearConstraints,
    QuadraticCost,
    StageBounds,
    prediction_loss,
    solve_lcp,
    violation_loss,
)
from difflcs import errors as e
from difflcs._checks import check_tensor
from difflcs.mpc import MPCProblem, Primal
from difflcs.mpc.backends import BatchedBackend, IpoptBackend

SOLVER = IpoptBackend(workers=1)
NAN, INF = float("nan"), float("inf")


def refuse(error, match, function, *args, **kwargs):
    with pytest.raises(error, match=match) as caught:
        function(*args, **kwargs)
    assert isinstance(caught.value, DiffLCSError)
    # The typed errors are also what a Python user would catch.
    if isinstance(caught.value, e.InvalidInputError):
        assert isinstance(caught.value, ValueError)
    return str(caught.value)


def spoil(tensor, value):
    tensor = tensor.detach().clone()
    tensor.reshape(-1)[-1] = value
    return tensor


BAD_TENSORS = {
    "int": (
        lambda t: torch.zeros(t.shape, dtype=torch.int64),
        e.DTypeError,
        "expected float32 or float64, got .*int64",
    ),
    "half": (lambda t: t.half(), e.DTypeError, "expected float32 or float64, got .*float16"),
    "bool": (lambda t: torch.zeros(t.shape, dtype=torch.bool), e.DTypeError, "got .*bool"),
    "complex": (lambda t: t.to(torch.complex128), e.DTypeError, "got .*complex128"),
    "list": (lambda t: t.tolist(), e.DTypeError, "(?s)expected a torch.Tensor, got list.*torch.as_tensor"),
    "numpy": (lambda t: t.numpy(), e.DTypeError, "(?s)expected a torch.Tensor, got ndarray.*torch.as_tensor"),
    "none": (lambda t: None, (e.DTypeError, e.ShapeError), "expected .*(got|none)"),
    "meta": (lambda t: t.to("meta"), e.DeviceError, r"got .* on meta; move it with .*\.to\('cpu'\)"),
    "nan": (lambda t: spoil(t, NAN), e.NonFiniteError, "expected finite numbers, got 1 NaN or infinite of"),
    "inf": (lambda t: spoil(t, INF), e.NonFiniteError, "expected finite numbers, got 1 NaN or infinite of"),
    "sparse": (lambda t: t.to_sparse(), e.DTypeError, "expected a dense tensor, got .*sparse_coo.*to_dense"),
    "nested": (
        lambda t: torch.nested.nested_tensor([t], layout=torch.jagged),
        e.DTypeError,
        "expected a dense tensor, got nested.*to_padded_tensor",
    ),
    "negated": (lambda t: (-1j * t).conj().imag, e.DTypeError, "expected a dense tensor.*resolve_neg"),
    "wide": (lambda t: torch.cat([t, t[..., :1]], -1), e.ShapeError, "expected .*got "),
}
every_bad_tensor = pytest.mark.parametrize("bad", BAD_TENSORS)


def check(bad, name, function):
    """`function(change)` must refuse the change of the argument called `name`."""
    change, error, match = BAD_TENSORS[bad]
    message = refuse(error, match, function, change)
    assert name in message
    assert ";" in message, "no remedy"


def bad_tensors_for(names, allowed=()):
    """Every way to spoil every name, without the pairs that are no mistake."""
    pairs = [(bad, name) for bad in BAD_TENSORS for name in names if (bad, name) not in allowed]
    return pytest.mark.parametrize(("bad", "name"), pairs)


# --- solve_lcp ------------------------------------------------------------------------------------------------------


# A wider q is q of another size: F is then blamed.
@bad_tensors_for(["F", "q"], allowed=[("wide", "q")])
def test_solve_lcp_refuses(bad, name):
    inputs = {"F": torch.eye(3, dtype=torch.float64), "q": torch.ones(2, 3, dtype=torch.float64)}
    check(bad, name, lambda change: solve_lcp(**{**inputs, name: change(inputs[name])}))


def test_solve_lcp_names_the_sizes_that_do_not_fit():
    F = torch.eye(3, dtype=torch.float64)
    refuse(e.ShapeError, r"F: expected shape \(\.\.\., n=4, n=4\), got \(3, 3\)", solve_lcp, F, torch.ones(4).double())
    refuse(e.ShapeError, r"q: expected shape \(\.\.\., n\)", solve_lcp, F, torch.tensor(1.0).double())
    refuse(e.ShapeError, r"batch dimensions.*\(2,\).*\(5,\)|batch dimensions.*\(5,\).*\(2,\)", solve_lcp,
           F.expand(2, 3, 3), torch.ones(5, 3).double())  # fmt: skip


@pytest.mark.parametrize("relaxation", [-1e-9, NAN, INF, -INF])
def test_solve_lcp_refuses_a_negative_or_infinite_relaxation(relaxation):
    F, q = torch.eye(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    match = rf"relaxation: expected a finite number at least 0, got {re.escape(repr(relaxation))}"
    refuse(e.InvalidInputError, match, solve_lcp, F, q, relaxation)


@pytest.mark.parametrize("relaxation", ["0.1", None, True, [0.1], np.True_, 1j, torch.ones(()).requires_grad_()])
def test_solve_lcp_refuses_a_relaxation_that_is_no_number(relaxation):
    F, q = torch.eye(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    refuse(e.DTypeError, "relaxation: expected a number, got", solve_lcp, F, q, relaxation)


@pytest.mark.parametrize("limit", [0.0, -1.0, NAN, INF, "1", True])
def test_solve_lcp_refuses_a_time_limit(limit):
    F, q = torch.eye(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    refuse(e.InvalidInputError, "time_limit: expected a", solve_lcp, F, q, time_limit=limit)


# --- numbers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "one", [np.float32(1), np.float16(1), np.int64(1), np.array(1.0), torch.tensor(1), torch.ones(())]
)
def test_a_number_of_numpy_or_torch_is_a_number(build, one):
    F, q, by_stage = torch.eye(2).double(), -torch.ones(2).double(), torch.ones(2, 2).double()
    backend = BatchedBackend(max_iter=np.int32(9), tol=one, time_limit=one)
    mpc = layer(build, horizon=np.int64(2), u_max=one, relaxation=one, training_relaxation=one, barrier=one, u_min=-1)
    for value in (backend.max_iter, mpc.horizon):
        assert type(value) is int
    for value in (backend.tol, backend.time_limit, mpc.relaxation, mpc.training_relaxation, mpc.barrier):
        assert type(value) in (int, float)
        assert value == 1
    assert torch.equal(solve_lcp(F, q, one, one).lam, solve_lcp(F, q, 1.0).lam)
    weights = GoalCost.reach(2, 2, goal_weight=one, input_weight=one, pairs=[(0, 1)], pair_weight=one)
    assert torch.equal(weights.Q, GoalCost.reach(2, 2, pairs=[(0, 1)], pair_weight=1.0).Q)
    full = torch.ones(2).double()
    assert torch.equal(StageBounds(-by_stage, one).u_max, full)
    assert torch.equal(LinearConstraints(F, q, weight=one).weight, full)
    assert torch.equal(ConstraintSequence(F, by_stage, weight=one, by_stage=("g",)).weight, full)
    data = torch.ones(3, 4).double(), torch.ones(3, 2).double(), torch.ones(3, 4).double()
    model = LCSModel(4, np.int64(2), 3, init_scale=one, stiffness=one)
    assert type(model.n_u) is int
    assert torch.isfinite(violation_loss(model, *data, gamma=0.1, xi=one))


@pytest.mark.parametrize("truth", [True, np.True_, torch.tensor(True)])
def test_true_is_no_number(build, truth):
    matrix = torch.eye(2).double()
    for name in ("horizon", "u_max", "relaxation", "barrier"):
        refuse(e.DTypeError, f"{name}: expected a", layer, build, **{name: truth})
    refuse(e.DTypeError, "goal_weight: expected a number", GoalCost.reach, 2, 2, truth)
    refuse(e.DTypeError, "weight: expected a torch.Tensor", LinearConstraints, matrix, matrix[0], weight=truth)
    refuse(e.DTypeError, "tol: expected a number", BatchedBackend, tol=truth)


def test_a_layer_refuses_sparse_states_also_after_others(build):
    mpc, x0 = layer(build, backend="batched"), torch.zeros(4, dtype=torch.float64)
    with torch.no_grad():
        mpc(x0)
        refuse(e.DTypeError, "x0: expected a dense tensor", mpc, x0.to_sparse())


def test_a_layer_refuses_F_that_was_spoiled_in_place(build):
    system, x0 = build.params(), torch.zeros(4, dtype=torch.float64)
    for mpc, given in ((layer(build, lcs=system), {}), (layer(build, backend="batched"), {"lcs": build.params()})):
        mpc(x0, **given)
        given.get("lcs", system).F[0, 0] = -1
        refuse(e.NotPositiveDefiniteError, "F: expected F", mpc, x0, **given)


# --- LCSParams ------------------------------------------------------------------------------------------------------


@every_bad_tensor
@pytest.mark.parametrize("name", ["A", "B", "C", "d", "D", "E", "F", "c"])
def test_params_refuse(build, bad, name):
    tensors = build.lcs_tensors()
    if (bad, name) in (("wide", "A"), ("wide", "B"), ("wide", "F")):
        # These decide n_x, n_u and n_lam; another field is then blamed.
        change, error, match = BAD_TENSORS[bad]
        refuse(error, match, lambda: LCSParams(**{**tensors, name: change(tensors[name])}))
        return
    check(bad, name, lambda change: LCSParams(**{**tensors, name: change(tensors[name])}))


def test_params_refuse_vectors_for_matrices_and_batches_that_do_not_fit(build):
    tensors = build.lcs_tensors()
    refuse(
        e.ShapeError,
        r"A: expected a matrix .*got \(4,\)",
        lambda: LCSParams(**{**tensors, "A": torch.ones(4).double()}),
    )
    uneven = {**tensors, "d": tensors["d"].expand(2, 4), "c": tensors["c"].expand(5, 3)}
    refuse(e.ShapeError, r"batch dimensions \(5,\) do not fit.*d \(2,\)", lambda: LCSParams(**uneven))


def test_params_refuse_mixed_dtypes(build):
    tensors = build.lcs_tensors()
    refuse(
        e.DTypeError, "float32.*float64|float64.*float32", lambda: LCSParams(**{**tensors, "B": tensors["B"].float()})
    )


@pytest.mark.parametrize("F", [-torch.eye(3), torch.zeros(3, 3), torch.tensor([[1.0, 3, 0], [0, 1, 0], [0, 0, 1]])])
def test_params_refuse_F_that_is_not_positive_definite_with_its_eigenvalue(build, F):
    F = F.double()
    smallest = float(torch.linalg.eigvalsh(F + F.T)[0])
    match = rf"F \+ Fᵀ positive definite, got smallest eigenvalue {re.escape(f'{smallest:.3e}')}.*add to the diagonal"
    refuse(e.NotPositiveDefiniteError, match, lambda: LCSParams(**{**build.lcs_tensors(), "F": F}))


# --- LCSModel -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["n_x", "n_u", "n_lam"])
def test_model_refuses_sizes(name):
    sizes = {"n_x": 2, "n_u": 2, "n_lam": 2}
    least = 0 if name == "n_lam" else 1  # without contacts a system is linear
    for value in (least - 1, -3):
        refuse(
            e.InvalidInputError, f"{name}: expected at least {least}, got {value}", LCSModel, **{**sizes, name: value}
        )
    for value in (2.0, "2", None, True):
        refuse(e.DTypeError, f"{name}: expected an int, got {type(value).__name__}", LCSModel, **{**sizes, name: value})


@pytest.mark.parametrize("stiffness", [0.0, -0.1, NAN, INF])
def test_model_refuses_a_stiffness_that_is_not_positive(stiffness):
    match = rf"stiffness: expected a finite number above 0, got {re.escape(repr(stiffness))}"
    refuse(e.InvalidInputError, match, LCSModel, 2, 2, 2, stiffness)


def test_model_refuses_another_dtype():
    match = "dtype: expected torch.float32 or torch.float64, got torch.float16"
    refuse(e.DTypeError, match, LCSModel, 2, 2, 2, dtype=torch.float16)


@every_bad_tensor
@pytest.mark.parametrize("name", ["x", "u", "x_next"])
@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_losses_refuse(build, bad, name, function):
    model, n = build.model(), build.normal(0)
    inputs = {"x": n(5, 4), "u": n(5, 2), "x_next": n(5, 4)}
    before = {k: v.clone() for k, v in model.state_dict().items()}
    check(bad, name, lambda change: function(model, **{**inputs, name: change(inputs[name])}))
    assert all(torch.equal(v, before[k]) for k, v in model.state_dict().items())
    assert all(p.grad is None for p in model.parameters())


@every_bad_tensor
@pytest.mark.parametrize("name", ["x", "u"])
def test_forward_refuses(build, bad, name):
    model, n = build.model(), build.normal(0)
    inputs = {"x": n(5, 4), "u": n(5, 2)}
    check(bad, name, lambda change: model(**{**inputs, name: change(inputs[name])}))


@every_bad_tensor
@pytest.mark.parametrize("name", ["x0", "u_seq"])
def test_rollout_refuses(build, bad, name):
    model, n = build.model(), build.normal(0)
    inputs = {"x0": n(5, 4), "u_seq": n(5, 3, 2)}
    check(bad, name.split("0")[0], lambda change: model.rollout(**{**inputs, name: change(inputs[name])}))


def test_rollout_refuses_a_sequence_without_steps(build):
    refuse(e.ShapeError, r"u_seq: expected shape \(\.\.\., T, n_u=2\), got \(2,\)", build.model().rollout,
           torch.zeros(4).double(), torch.zeros(2).double())  # fmt: skip


def test_a_models_dtype_is_not_mixed_with_the_datas(build):
    refuse(e.DTypeError, r"x: expected torch.float64 like the model, got .*float32.*model.to\(torch.float32\)",
           build.model(), torch.zeros(4), torch.zeros(2).double())  # fmt: skip


@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_losses_refuse_batches_that_do_not_fit(build, function):
    n = build.normal(0)
    match = r"batch dimensions \(3,\) do not fit"
    refuse(e.ShapeError, match, function, build.model(), n(5, 4), n(3, 2), n(5, 4))


@pytest.mark.parametrize("name", ["A", "D", "G", "c"])
@pytest.mark.parametrize("value", [NAN, INF])
@pytest.mark.parametrize("function", [violation_loss, prediction_loss])
def test_losses_refuse_parameters_that_are_not_finite(build, name, value, function):
    model, n = build.model(), build.normal(0)
    with torch.no_grad():
        getattr(model, name).reshape(-1)[0] = value
    match = "F: expected finite" if name == "G" else f"{name}: expected finite"
    refuse(e.NonFiniteError, match, function, model, n(5, 4), n(5, 2), n(5, 4))


@pytest.mark.parametrize("name", ["gamma", "xi"])
def test_violation_loss_refuses_weights(build, name):
    n = build.normal(0)
    data = n(5, 4), n(5, 2), n(5, 4)
    for value in (0.0, -1.0, NAN, INF):
        refuse(e.InvalidInputError, f"{name}: expected", violation_loss, build.model(), *data, **{name: value})
    for value in ("0.1", None):
        refuse(e.DTypeError, f"{name}: expected a number, got", violation_loss, build.model(), *data, **{name: value})


# --- costs ----------------------------------------------------------------------------------------------------------


# None is zero for the linear terms.
@bad_tensors_for(
    ["Q", "R", "Q_final", "q", "r", "q_final"], allowed=[("none", "q"), ("none", "r"), ("none", "q_final")]
)
def test_quadratic_cost_refuses(build, bad, name):
    tensors = build.cost_tensors()
    check(bad, name, lambda change: QuadraticCost(**{**tensors, name: change(tensors[name])}))


@every_bad_tensor
def test_goal_cost_refuses_goals(build, bad):
    cost = build.paper_cost()
    check(bad, "goal", lambda change: cost(change(torch.zeros(2, 3, dtype=torch.float64))))


# --- LCSMPCLayer ----------------------------------------------------------------------------------------------------


def layer(build, **changes):
    options = {
        "lcs": build.params(), "cost": build.cost(), "horizon": 2, "u_min": -0.1, "u_max": 0.1, "backend": SOLVER,
        **changes,
    }  # fmt: skip
    return LCSMPCLayer(**options)


@every_bad_tensor
def test_layer_refuses_states(build, bad):
    mpc = layer(build, lcs=build.model())
    before = {k: v.clone() for k, v in mpc.state_dict().items()}
    check(bad, "x0", lambda change: mpc(change(torch.zeros(3, 4, dtype=torch.float64))))
    assert all(torch.equal(v, before[k]) for k, v in mpc.state_dict().items())


@every_bad_tensor
def test_layer_refuses_goals(build, bad):
    mpc = LCSMPCLayer(build.pushing(), build.paper_cost(), 2, -0.1, 0.1, backend=SOLVER)
    goal = torch.zeros(3, 3, dtype=torch.float64)
    check(bad, "goal", lambda change: mpc(torch.zeros(3, 9, dtype=torch.float64), change(goal)))


def bound(name):
    return torch.full((2,), -0.1 if name == "u_min" else 0.1, dtype=torch.float64)


# None is no bound, and so is infinity on the right side; other tests are about the wrong side, and NaN.
UNBOUNDED = [(bad, name) for bad in ("none", "inf", "nan") for name in ("u_min", "u_max")]


@bad_tensors_for(["u_min", "u_max"], allowed=UNBOUNDED)
def test_layer_refuses_bounds(build, bad, name):
    check(bad, name, lambda change: layer(build, **{name: change(bound(name))}))


@bad_tensors_for(["u_min", "u_max"], allowed=UNBOUNDED)
def test_layer_refuses_bounds_of_a_call(build, bad, name):
    x0 = torch.zeros(4, dtype=torch.float64)
    check(bad, name, lambda change: layer(build)(x0, **{name: change(bound(name))}))


@pytest.mark.parametrize("name", ["u_min", "u_max"])
def test_layer_refuses_bounds_that_are_nan_or_allow_nothing(build, name):
    x0, mpc = torch.zeros(4, dtype=torch.float64), layer(build, u_min=None, u_max=None)
    broken, nowhere = spoil(bound(name), NAN), INF if name == "u_min" else -INF
    for function in (lambda v: layer(build, **{"u_min": None, "u_max": None, name: v}), lambda v: mpc(x0, **{name: v})):
        refuse(e.NonFiniteError, f"{name}: expected numbers or infinity, got 1 NaN of 2; ", function, broken)
        refuse(e.NonFiniteError, f"{name}: expected numbers or infinity, got 2 NaN of 2; ", function, NAN)
        refuse(e.BoundsError, f"{name}: expected at least one action that it allows", function, nowhere)
    learned = nn.Parameter(bound(name))
    mpc = layer(build, **{name: learned})
    with torch.no_grad():
        learned[1] = NAN
    refuse(e.NonFiniteError, f"{name}: expected numbers or infinity, got 1 NaN", mpc, x0)


@pytest.mark.parametrize("name", ["u_min", "u_max"])
def test_a_barrier_refuses_bounds_that_are_infinite(build, name):
    refuse(e.BoundsError, "expected finite bounds with a barrier.*barrier=0", layer, build, barrier=0.1, **{name: None})


@every_bad_tensor
@pytest.mark.parametrize("name", ["x", "u", "lam"])
def test_layer_refuses_guesses(build, bad, name):
    mpc = layer(build)
    zeros = {
        "x": torch.zeros(3, 3, 4).double(),
        "u": torch.zeros(3, 2, 2).double(),
        "lam": torch.ones(3, 2, 3).double(),
    }

    def function(change):
        mpc(torch.zeros(3, 4, dtype=torch.float64), guess=Primal(**{**zeros, name: change(zeros[name])}))

    check(bad, f"guess.{name}", function)


def test_layer_refuses_a_guess_of_another_horizon_batch_or_type(build):
    x0 = torch.zeros(3, 4, dtype=torch.float64)
    longer = layer(build, horizon=3)(x0)
    refuse(
        e.ShapeError,
        r"guess.x: expected shape \(\.\.\., H\+1=3, n_x=4\), got \(3, 4, 4\)",
        layer(build),
        x0,
        guess=longer,
    )
    fewer = layer(build)(x0[:2])
    refuse(
        e.ShapeError, r"guess.x: expected batch dimensions \(3,\) like x0, got \(2,\)", layer(build), x0, guess=fewer
    )
    refuse(e.DTypeError, "guess: expected an MPCSolution or a Primal", layer(build), x0, guess=longer.u)


@pytest.mark.parametrize("bounds", [(0.1, -0.1), (0.1, 0.0999)])
def test_layer_refuses_crossed_bounds_with_both_numbers(build, bounds):
    low, high = bounds
    numbers = rf"u_min: expected u_min <= u_max, got {low:g}.*{high:g}.* at index .*; swap or widen"
    refuse(e.BoundsError, numbers, layer, build, u_min=low, u_max=high)
    refuse(e.BoundsError, numbers, layer(build), torch.zeros(4).double(), u_min=low, u_max=high)
    one = torch.tensor([[-1.0, -1], [-1, low]]).double(), torch.tensor([[1.0, 1], [1, high]]).double()
    refuse(e.BoundsError, r"at index \(1, 1\)", layer(build), torch.zeros(2, 4).double(), u_min=one[0], u_max=one[1])


@pytest.mark.parametrize("horizon", [0, -1])
def test_layer_refuses_a_horizon_below_one(build, horizon):
    refuse(e.InvalidInputError, f"horizon: expected at least 1, got {horizon}", layer, build, horizon=horizon)


@pytest.mark.parametrize("horizon", [2.0, "5", None, True, torch.tensor(3)])
def test_layer_refuses_a_horizon_that_is_no_int(build, horizon):
    refuse(e.DTypeError, "horizon: expected an int, got", layer, build, horizon=horizon)


@pytest.mark.parametrize("relaxation", [0.0, -1e-5, NAN, INF])
def test_layer_refuses_a_relaxation_that_is_not_positive(build, relaxation):
    match = rf"relaxation: expected a finite number above 0, got {re.escape(repr(relaxation))}"
    refuse(e.InvalidInputError, match, layer, build, relaxation=relaxation)


@pytest.mark.parametrize("relaxation", ["1e-5", None])
def test_layer_refuses_a_relaxation_that_is_no_number(build, relaxation):
    refuse(e.DTypeError, "relaxation: expected a number, got", layer, build, relaxation=relaxation)


def test_layer_refuses_another_word_for_on_failure(build):
    refuse(
        e.InvalidInputError,
        "on_failure: expected one of 'raise', 'mask', got 'ignore'",
        layer,
        build,
        on_failure="ignore",
    )


def test_layer_refuses_what_is_no_lcs_or_no_cost(build):
    lcs = r"lcs: expected LCSModel, LCSParams, LCSSequence or another LCSModule, got Linear.*; a module needs"
    cost = "cost: expected GoalCost, QuadraticCost or CostSequence, got function.*; build one"
    refuse(e.DTypeError, lcs, layer, build, lcs=nn.Linear(2, 2))
    refuse(e.DTypeError, cost, layer, build, cost=lambda x: x)
    x0 = torch.zeros(4, dtype=torch.float64)
    refuse(e.DTypeError, lcs, layer(build), x0, lcs=nn.Linear(2, 2))
    refuse(e.DTypeError, cost, layer(build), x0, cost=lambda x: x)


def test_layer_refuses_a_cost_of_another_size(build):
    refuse(
        e.ShapeError, "cost: expected n_x=4, n_u=2 like the LCS, got n_x=5, n_u=2", layer, build, cost=build.cost(n_x=5)
    )
    refuse(
        e.ShapeError, "cost: expected n_x=4, n_u=2 like the LCS, got n_x=4, n_u=3", layer, build, cost=build.cost(n_u=3)
    )


def test_layer_refuses_a_goal_too_much_and_a_goal_too_little(build):
    goal = torch.zeros(3, dtype=torch.float64)
    refuse(e.ShapeError, "goal: expected none with a QuadraticCost", layer(build), torch.zeros(4).double(), goal)
    mpc = LCSMPCLayer(build.pushing(), build.paper_cost(), 2, -0.1, 0.1, backend=SOLVER)
    refuse(e.ShapeError, r"goal: expected \(\.\.\., n_goal=3\) with a GoalCost, got none", mpc, torch.zeros(9).double())


def test_layer_refuses_batches_that_do_not_fit(build):
    mpc = layer(build, lcs=build.params(batch=(2,)))
    refuse(e.ShapeError, r"batch dimensions .* do not fit.*x0 \(3,\)", mpc, torch.zeros(3, 4).double())


def test_layer_refuses_an_unknown_backend(build):
    refuse(e.BackendNotFoundError, "expected one of .*'ipopt'.*got 'gurobi'", layer, build, backend="gurobi")


def test_a_model_whose_parameters_went_bad_is_refused_by_the_layer(build):
    model = build.model()
    mpc = layer(build, lcs=model)
    with torch.no_grad():
        model.B[0, 0] = NAN
    refuse(e.NonFiniteError, "B: expected finite numbers, got 1", mpc, torch.zeros(4).double())


def test_a_learned_bound_that_crossed_is_refused_by_the_layer(build):
    high = nn.Parameter(torch.full((2,), 0.1, dtype=torch.float64))
    mpc = layer(build, u_max=high)
    with torch.no_grad():
        high[1] = -0.2
    refuse(e.BoundsError, r"-0\.1.*-0\.2", mpc, torch.zeros(4).double())


# --- MPCProblem -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"horizon": 0}, e.InvalidInputError, "horizon: expected at least 1, got 0"),
        ({"horizon": 1.0}, e.DTypeError, "horizon: expected an int"),
        ({"relaxation": 0.0}, e.InvalidInputError, "relaxation: .*above 0, got 0"),
        ({"x0": torch.zeros(4).double()}, e.ShapeError, "x0: expected"),
        ({"E": torch.zeros(3, 3).double()}, e.ShapeError, r"E: expected \(3, 2\) or \(5, 3, 2\) or .*, got \(3, 3\)"),
        (
            {"E": torch.zeros(5, 3, 3, 2).double()},
            e.ShapeError,
            r"E: expected .* or \(5, 2, 3, 2\), got \(5, 3, 3, 2\)",
        ),
        ({"S": torch.zeros(2, 4).double()}, e.ShapeError, r"S: expected \(4, 2\) or .*, got \(2, 4\)"),
        ({"g": torch.ones(3).double(), "G_x": torch.ones(2, 4).double()}, e.ShapeError, r"G_x: expected \(3, 4\) or"),
        ({"g": torch.ones(1).double(), "price": -torch.ones(1).double()}, e.InvalidInputError, "price: .*got -1; "),
        ({"u_min": torch.full((2,), INF).double()}, e.BoundsError, "u_min"),
        ({"u_max": torch.full((2,), INF).double(), "barrier": 0.1}, e.BoundsError, "finite bounds with a barrier"),
        ({"u_min": torch.ones(2).double()}, e.BoundsError, "u_min <= u_max, got 1.*0.1"),
    ],
)
def test_problem_refuses(build, change, error, match):
    limit = torch.full((2,), 0.1, dtype=torch.float64)
    fields = {
        **build.lcs_tensors(), **build.cost_tensors(), "u_min": -limit, "u_max": limit,
        "x0": torch.zeros(5, 4, dtype=torch.float64), "horizon": 2, "relaxation": 1e-4,
    }  # fmt: skip
    MPCProblem(**fields)
    refuse(error, match, lambda: MPCProblem(**{**fields, **change}))


def test_infinities_that_cancel_are_refused_and_finite_numbers_that_overflow_are_not():
    largest = torch.full((3,), torch.finfo(torch.float64).max, dtype=torch.float64)
    assert check_tensor("x", largest) is largest
    refuse(e.NonFiniteError, "x: expected finite numbers, got 2", check_tensor, "x", torch.tensor([INF, -INF, 0.0]))


# --- the error tree -------------------------------------------------------------------------------------------------


def test_the_error_tree_is_one_users_can_catch():
    assert issubclass(e.DTypeError, TypeError)
    assert issubclass(e.InvalidInputError, ValueError)
    assert issubclass(e.SolveError, RuntimeError)
    assert issubclass(e.MissingDependencyError, ImportError)
    assert issubclass(e.BackendNotFoundError, LookupError)
    assert issubclass(e.DiffLCSWarning, UserWarning)
    found = [v for v in vars(e).values() if isinstance(v, type) and issubclass(v, Exception)]
    assert len(found) > 10
    for kind in found:
        assert issubclass(kind, e.DiffLCSError | e.DiffLCSWarning)
