"""Every bad input meets a typed error that says what was expected, what came, and how to mend it."""

import re

import numpy as np
import pytest
import torch
from torch import nn
from torch.utils._pytree import tree_leaves

import difflcs
from difflcs import errors as e
from difflcs._checks import check_tensor
from difflcs.mpc import MPCProblem, Primal
from difflcs.mpc.backends import BatchedBackend, IpoptBackend, RelaxedBackend
from difflcs.systems import block_along_wall, cart_pole_between_walls
from tests.conftest import refuse

NAN, INF = float("nan"), float("inf")


def spoil(tensor, value):
    tensor = tensor.detach().clone()
    tensor.reshape(-1)[-1] = value
    return tensor


BAD_TENSORS = {
    "int": (lambda t: torch.zeros(t.shape, dtype=torch.int64), e.DTypeError,
     "expected float32 or float64, got .*int64"),
    "half": (lambda t: t.half(), e.DTypeError, "expected float32 or float64, got .*float16"),
    "bool": (lambda t: torch.zeros(t.shape, dtype=torch.bool), e.DTypeError, "got .*bool"),
    "complex": (lambda t: t.to(torch.complex128), e.DTypeError, "got .*complex128"),
    "list": (lambda t: [*map(str, t.flatten().tolist())], e.DTypeError,
     "(?s)expected a torch.Tensor, got list.*torch.as_tensor"),
    "words": (lambda t: t.numpy().astype(str), e.DTypeError, r"expected a torch.Tensor, got ndarray \(.*\) <U.*wrap"),
    "none": (lambda t: None, (e.DTypeError, e.ShapeError), "expected .*(got|none)"),
    "meta": (lambda t: t.to("meta"), e.DeviceError, r"got .* on meta; move it with .*\.to\('cpu'\)"),
    "nan": (lambda t: spoil(t, NAN), e.NonFiniteError, "expected finite numbers, got 1 NaN or infinite of"),
    "inf": (lambda t: spoil(t, INF), e.NonFiniteError, "expected finite numbers, got 1 NaN or infinite of"),
    "sparse": (lambda t: t.to_sparse(), e.DTypeError, "expected a dense tensor, got .*sparse_coo.*to_dense"),
    "nested": (lambda t: torch.nested.nested_tensor([t], layout=torch.jagged), e.DTypeError,
     "expected a dense tensor, got nested.*to_padded_tensor"),
    "negated": (lambda t: (-1j * t).conj().imag, e.DTypeError, "expected a dense tensor.*resolve_neg"),
    "wide": (lambda t: torch.cat([t, t[..., :1]], -1), e.ShapeError, "expected .*got "),
}  # fmt: skip
# --- tensors --------------------------------------------------------------------------------------------------------

SYSTEM, COST = ("A", "B", "C", "d", "D", "E", "F", "c"), ("Q", "R", "S", "Q_final", "q", "r", "q_final")
ENTRIES = {
    "solve_lcp": ("F", "q"),
    "LCSParams": SYSTEM,
    "violation_loss": ("x", "u", "x_next"),
    "prediction_loss": ("x", "u", "x_next"),
    "forward": ("x", "u"),
    "rollout": ("x0", "u_seq"),
    "QuadraticCost": COST,
    "GoalCost": ("goal",),
    "layer": ("u_min", "u_max"),
    "call": ("x0", "u_min", "u_max", "goal"),
    "guess": ("x", "u", "lam"),
}
# None is no bound, and so is infinity on the right side; None is zero for S and linear terms. Sizes are said by the
# last dimension of q, A, B and F: where these are wider, another argument is blamed.
NO_MISTAKE = {("none", name) for name in ("S", "q", "r", "q_final")}
NO_MISTAKE |= {(bad, name) for bad in ("none", "inf", "nan") for name in ("u_min", "u_max")}
OTHER_BLAMED = {("solve_lcp", "q"), ("LCSParams", "A"), ("LCSParams", "B"), ("LCSParams", "F")}


def entry(build, name, model):
    """A public function that takes tensors by name, and such tensors."""
    n = build.normal(0)
    x, u, goal = n(5, 4), n(5, 2), n(5, 3)
    limits = {"u_min": -torch.ones(2).double(), "u_max": torch.ones(2).double()}
    reach = difflcs.GoalCost.reach(4, 2, goal_weight=(1.0, 1.0, 1.0))
    plan = {"x": torch.zeros(5, 3, 4).double(), "u": torch.zeros(5, 2, 2).double(), "lam": torch.ones(5, 2, 3).double()}
    table = {
        "solve_lcp": lambda: (difflcs.solve_lcp, {"F": torch.eye(3).double(), "q": torch.ones(2, 3).double()}),
        "LCSParams": lambda: (difflcs.LCSParams, build.lcs_tensors()),
        "violation_loss": lambda: (lambda **t: difflcs.violation_loss(model, **t), {"x": x, "u": u, "x_next": x}),
        "prediction_loss": lambda: (lambda **t: difflcs.prediction_loss(model, **t), {"x": x, "u": u, "x_next": x}),
        "forward": lambda: (model, {"x": x, "u": u}),
        "rollout": lambda: (
            lambda **t: (model.rollout(**t), model.params().rollout(**t)),
            {"x0": x, "u_seq": n(5, 3, 2)},
        ),
        "QuadraticCost": lambda: (difflcs.QuadraticCost, build.cost_tensors() | {"S": torch.zeros(4, 2).double()}),
        "GoalCost": lambda: (reach, {"goal": goal}),
        "layer": lambda: (lambda **t: layer(build, **t), limits),
        "call": lambda: (layer(build, lcs=model, cost=reach), {"x0": x, "goal": goal, **limits}),
        "guess": lambda: (lambda **t: layer(build, lcs=model)(x, guess=Primal(**t)), plan),
    }
    return table[name]()


BAD_INPUTS = [
    (function, name, bad)
    for function, names in ENTRIES.items()
    for name in names
    for bad in BAD_TENSORS
    if function == "solve_lcp" or (bad, name) not in NO_MISTAKE
]


@pytest.mark.parametrize(("function", "name", "bad"), BAD_INPUTS)
def test_a_bad_tensor_is_refused_by_its_name(build, function, name, bad):
    model = build.model()
    before = {k: v.clone() for k, v in model.state_dict().items()}
    call, tensors = entry(build, function, model)
    change, error, match = BAD_TENSORS[bad]
    message = refuse(error, match, call, **{**tensors, name: change(tensors[name])})
    assert ";" in message, "no remedy"
    assert name.removesuffix("0") in message or (bad == "wide" and (function, name) in OTHER_BLAMED)
    assert function != "guess" or f"guess.{name}" in message
    assert all(torch.equal(v, before[k]) for k, v in model.state_dict().items())
    assert all(p.grad is None for p in model.parameters())


@pytest.mark.parametrize("function", sorted(ENTRIES.keys() - {"guess"}))
def test_an_array_or_a_list_is_taken_like_a_tensor(build, function):
    call, tensors = entry(build, function, build.model())

    def numbers(**tensors):
        made = call(**tensors)
        made = made.state_dict() if isinstance(made, nn.Module) else getattr(made, "__dict__", made)
        made = made["u"] if function == "call" else made  # a plan knows how long it took
        return [v for v in tree_leaves(made) if isinstance(v, torch.Tensor)]

    arrays = {name: value.numpy()[..., ::-1][..., ::-1] for name, value in tensors.items()}  # torch has no such strides
    for given in (arrays, {name: value.tolist() for name, value in tensors.items()}):
        assert all(map(torch.equal, numbers(**given), numbers(**tensors)))


@pytest.mark.parametrize("name", ["A", "D", "G", "c"])
@pytest.mark.parametrize("function", ["violation_loss", "prediction_loss", "call"])
def test_parameters_that_are_not_finite_are_refused(build, name, function):
    model = build.model()
    call, tensors = entry(build, function, model)
    for value in (NAN, INF):
        with torch.no_grad():
            getattr(model, name).reshape(-1)[0] = value
        for more in ({}, {"gamma": "auto"}) if function == "violation_loss" else ({},):
            refuse(e.NonFiniteError, f"{'F' if name == 'G' else name}: expected finite", call, **tensors, **more)


def layer(build, **changes):
    options = {"lcs": build.params(), "cost": build.cost(), "horizon": 2, "u_min": -0.1, "u_max": 0.1, **changes}
    return difflcs.LCSMPCLayer(**options)


X, ONE, EYE = torch.zeros(4).double(), torch.ones(2).double(), torch.eye(3).double()
SKEW = torch.tensor([[1.0, 3, 0], [0, 1, 0], [0, 0, 1]]).double()
FITS_NOT = {  # what does not fit, the error, and what it says
    "F of another size": (lambda b: difflcs.solve_lcp(EYE, torch.ones(4).double()), e.ShapeError,
     r"F: expected shape \(\.\.\., n=4, n=4\), got \(3, 3\)"),
    "q without dimension": (lambda b: difflcs.solve_lcp(EYE, ONE[0]), e.ShapeError, r"q: expected shape \(\.\.\., n\)"),
    "batches of an LCP": (lambda b: difflcs.solve_lcp(EYE.expand(2, 3, 3), torch.ones(5, 3).double()), e.ShapeError,
     r"batch dimensions.*\(2,\).*\(5,\)|batch dimensions.*\(5,\).*\(2,\)"),
    "a vector for a matrix": (lambda b: difflcs.LCSParams(**{**b.lcs_tensors(), "A": X}), e.ShapeError,
     r"A: expected a matrix .*got \(4,\)"),
    "batches of a system": (
     lambda b: difflcs.LCSParams(**{**b.lcs_tensors(), "d": X.expand(2, 4), "c": torch.ones(5, 3).double()}),
     e.ShapeError, r"batch dimensions \(5,\) do not fit.*d \(2,\)"),
    "mixed dtypes": (lambda b: difflcs.LCSParams(**{**b.lcs_tensors(), "B": torch.zeros(4, 2)}), e.DTypeError,
     "float32.*float64|float64.*float32"),
    "batches of a loss": (lambda b: difflcs.violation_loss(b.model(), X.expand(5, 4), ONE.expand(3, 2), X.expand(5, 4)),
     e.ShapeError, r"batch dimensions \(3,\) do not fit"),
    "data of another dtype": (lambda b: b.model()(X.float(), ONE), e.DTypeError,
     r"x: expected torch.float64 like the model, got .*float32.*model.to\(torch.float32\)"),
    "a sequence without steps": (lambda b: b.model().rollout(X, ONE), e.ShapeError,
     r"u_seq: expected shape \(\.\.\., T, n_u=2\), got \(2,\)"),
    "another dtype of a model": (lambda b: difflcs.LCSModel(2, 2, 2, dtype=torch.float16), e.DTypeError,
     "dtype: expected torch.float32 or torch.float64, got torch.float16"),
    "a guess of another horizon": (lambda b: layer(b)(X, guess=layer(b, horizon=3)(X)), e.ShapeError,
     r"guess.x: expected shape \(\.\.\., H\+1=3, n_x=4\), got \(4, 4\)"),
    "a guess of another batch": (lambda b: layer(b)(X.expand(3, 4), guess=layer(b)(X.expand(2, 4))), e.ShapeError,
     r"guess.x: expected batch dimensions \(3,\) like x0, got \(2,\)"),
    "no guess": (lambda b: layer(b)(X, guess=X), e.DTypeError, "guess: expected an MPCSolution or a Primal"),
    "no mode": (lambda b: layer(b, on_failure="ignore"), e.InvalidInputError,
     "on_failure: expected one of 'raise', 'mask', got 'ignore'"),
    "an action support of other actions": (
     lambda b: layer(b, lcs=(model := b.model(), setattr(model, "action_support", torch.zeros(3, 2).double()))[0])(X),
     e.ShapeError, r"action_support: expected shape \(2, n_u=2\), got \(3, 2\)"),
    "no LCS": (lambda b: layer(b, lcs=nn.Linear(2, 2)), e.DTypeError,
     r"lcs: expected LCSModel, LCSParams, LCSSequence or another LCSModule, got Linear.*; a module needs"),
    "no cost": (lambda b: layer(b)(X, cost=len), e.DTypeError,
     "cost: expected GoalCost, QuadraticCost, CostSequence or another CostModule, got builtin.*; build one"),
    "a cost of other states": (lambda b: layer(b, cost=b.cost(n_x=5)), e.ShapeError, "n_x=4, n_u=2 like.*n_x=5, n_u=2"),
    "a cost of other actions": (lambda b: layer(b, cost=b.cost(n_u=3)), e.ShapeError,
     "n_x=4, n_u=2 like.*n_x=4, n_u=3"),
    "batches of a layer": (lambda b: layer(b, lcs=b.params(batch=(2,)))(X.expand(3, 4)), e.ShapeError,
     r"batch dimensions .* do not fit.*x0 \(3,\)"),
    "a goal of another batch": (
     lambda b: layer(b, cost=difflcs.GoalCost.reach(4, 2))(X.expand(3, 4), reference=X.expand(2, 3, 4)), e.ShapeError,
     r"^reference: its batch dimensions \(2,\) do not fit the others \(x0 \(3,\), reference \(2,\)\)"),
    "a backend that is none": (lambda b: layer(b, backend="gurobi"), e.BackendNotFoundError,
     "expected one of .*'ipopt'.*got 'gurobi'.*register_backend"),
    "infinities that cancel": (lambda b: difflcs.solve_lcp(EYE, torch.tensor([INF, -INF, 0.0]).double()),
     e.NonFiniteError, "q: expected finite numbers, got 2"),
}  # fmt: skip


@pytest.mark.parametrize("case", FITS_NOT)
def test_what_does_not_fit_is_refused(build, case):
    call, error, match = FITS_NOT[case]
    refuse(error, match, call, build)


SET_LATER = {"lcs": None, "cost": len, "horizon": None, "passes": 0, "relaxation": 0, "training_relaxation": 0}
SET_LATER |= {"barrier": None, "on_failure": "ignore", "backend": None, "constraints": [], "bounds": 3, "u_min": "a"}


@pytest.mark.parametrize("name", SET_LATER)
def test_settings_are_checked_when_they_are_changed(build, name):
    refuse(e.InvalidInputError, f"{name}: expected", setattr, layer(build), name, SET_LATER[name])


@pytest.mark.parametrize("bound", [None, 0.05, [0.05, 0.02], np.array([0.05, 0.02])])
def test_a_bound_is_changed_to_what_a_layer_takes(build, bound):
    mpc = layer(build)
    mpc.u_max = bound
    assert torch.equal(mpc(X + 0.2).u, layer(build, u_max=bound)(X + 0.2).u)


@pytest.mark.parametrize("F", [-EYE, 0 * EYE, SKEW])
def test_an_F_that_is_not_positive_definite_is_refused_with_its_eigenvalue(build, F):
    smallest = float(torch.linalg.eigvalsh(F + F.T)[0])
    match = rf"F \+ Fᵀ positive definite, got smallest eigenvalue {re.escape(f'{smallest:.3e}')}.*add to the diagonal"
    refuse(e.NotPositiveDefiniteError, match, lambda: difflcs.LCSParams(**{**build.lcs_tensors(), "F": F}))


def test_finite_numbers_whose_sum_overflows_are_accepted():
    largest = torch.full((3,), torch.finfo(torch.float64).max, dtype=torch.float64)
    assert check_tensor("x", largest) is largest


# --- numbers --------------------------------------------------------------------------------------------------------

NUMBERS = {  # what takes a number by a name, numbers out of its range, and what else it refuses
    "relaxation of an LCP": (lambda b, v: difflcs.solve_lcp(EYE, X[:3], v), (-1e-9, NAN, INF, -INF), "at least 0"),
    "time_limit": (lambda b, v: difflcs.solve_lcp(EYE, X[:3], time_limit=v), (0.0, -1.0, NAN, INF), "above 0"),
    "stiffness": (lambda b, v: difflcs.LCSModel(2, 2, 2, v), (0.0, -0.1, NAN, INF), "above 0"),
    "gamma": (lambda b, v: difflcs.violation_loss(b.model(), X, ONE, X, gamma=v), (0.0, -1.0, NAN, INF), ""),
    "xi": (lambda b, v: difflcs.violation_loss(b.model(), X, ONE, X, xi=v), (0.0, -1.0, NAN, INF), ""),
    "relaxation": (lambda b, v: layer(b, relaxation=v), (0.0, -1e-5, NAN, INF), "above 0"),
    "horizon": (lambda b, v: layer(b, horizon=v), (0, -1), "at least 1"),
    "n_x": (lambda b, v: difflcs.LCSModel(v, 2, 2), (0, -3), "at least 1"),
    "n_u": (lambda b, v: difflcs.LCSModel(2, v, 2), (0, -3), "at least 1"),
    "n_lam": (lambda b, v: difflcs.LCSModel(2, 2, v), (-1, -3), "at least 0"),  # without contacts a system is linear
}


@pytest.mark.parametrize("case", NUMBERS)
def test_a_number_out_of_range_and_what_is_no_number_are_refused(build, case):
    call, wrong, words = NUMBERS[case]
    name = case.split()[0]
    for value in wrong:
        refuse(e.InvalidInputError, rf"{name}: expected .*{words}.*got {re.escape(f'{value:g}')}", call, build, value)
    for value in [True, [0.1], np.True_, 1j, torch.ones(()).requires_grad_(), *(["0.1"] if name != "gamma" else [])]:
        refuse(e.DTypeError, f"{name}: expected a", call, build, value)
    for value in [
        *([None] if case not in ("time_limit", "relaxation") else []),
        *([2.0] if isinstance(wrong[0], int) else []),
    ]:
        refuse(e.DTypeError, f"{name}: expected a", call, build, value)


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
    assert torch.equal(difflcs.solve_lcp(F, q, one, one).lam, difflcs.solve_lcp(F, q, 1.0).lam)
    weights = difflcs.GoalCost.reach(2, 2, goal_weight=one, input_weight=one, pairs=[(0, 1)], pair_weight=one)
    assert torch.equal(weights.Q, difflcs.GoalCost.reach(2, 2, pairs=[(0, 1)], pair_weight=1.0).Q)
    full = torch.ones(2).double()
    assert torch.equal(difflcs.StageBounds(-by_stage, one).u_max, full)
    assert torch.equal(difflcs.LinearConstraints(F, q, weight=one).weight, full)
    assert torch.equal(difflcs.ConstraintSequence(F, by_stage, weight=one, by_stage=("g",)).weight, full)
    data = torch.ones(3, 4).double(), torch.ones(3, 2).double(), torch.ones(3, 4).double()
    model = difflcs.LCSModel(4, np.int64(2), 3, init_scale=one, stiffness=one)
    assert type(model.n_u) is int
    assert torch.isfinite(difflcs.violation_loss(model, *data, gamma=0.1, xi=one))


# --- bounds ---------------------------------------------------------------------------------------------------------


def bound(name):
    return torch.full((2,), -0.1 if name == "u_min" else 0.1, dtype=torch.float64)


@pytest.mark.parametrize("name", ["u_min", "u_max"])
def test_layer_refuses_bounds_that_are_nan_or_allow_nothing_or_no_barrier(build, name):
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
    refuse(e.BoundsError, "expected finite bounds with a barrier.*barrier=0", layer, build, barrier=0.1, **{name: None})


@pytest.mark.parametrize("bounds", [(0.1, -0.1), (0.1, 0.0999)])
def test_layer_refuses_crossed_bounds_with_both_numbers(build, bounds):
    low, high = bounds
    numbers = rf"u_min: expected u_min <= u_max, got {low:g}.*{high:g}.* at index .*; swap or widen"
    refuse(e.BoundsError, numbers, layer, build, u_min=low, u_max=high)
    refuse(e.BoundsError, numbers, layer(build), torch.zeros(4).double(), u_min=low, u_max=high)
    one = torch.tensor([[-1.0, -1], [-1, low]]).double(), torch.tensor([[1.0, 1], [1, high]]).double()
    refuse(e.BoundsError, r"at index \(1, 1\)", layer(build), torch.zeros(2, 4).double(), u_min=one[0], u_max=one[1])


# --- arguments ------------------------------------------------------------------------------------------------------


def full(value, *shape):
    return torch.full(shape, value, dtype=torch.float64)


def problem(build, **change):
    fields = {
        **build.lcs_tensors(), **build.cost_tensors(), "u_min": full(-0.1, 2), "u_max": full(0.1, 2),
        "x0": full(0.0, 5, 4), "horizon": 2, "relaxation": 1e-4,
    }  # fmt: skip
    return MPCProblem(**{**fields, **change})


def rows(build, **change):
    n = build.normal(0)
    return difflcs.LinearConstraints(**{"G": n(3, 4), "g": n(3), "E": n(3, 2), "weight": full(2.0, 3), **change})


def rows_by_stage(build, **change):
    return difflcs.ConstraintSequence(
        **{"G": full(1.0, 4, 3, 4), "g": full(1.0, 4, 3), "E": full(1.0, 3, 3, 2), "weight": 1.0, **change}
    )


def cost_by_stage(build, **change):
    each = [build.cost_tensors(k) for k in range(3)]
    fields = {name: torch.stack([t[name] for t in each]) for name in ("Q", "R", "q", "r")}
    fields |= {k: each[0][k] for k in ("Q_final", "q_final")} | {"S": full(0.0, 3, 4, 2)}
    return difflcs.CostSequence(**{**fields, **change})


LOW, SUPPORT = full(-1.0, 3, 2), torch.tensor([[-0.1, -0.2], [0.05, 0.3]], dtype=torch.float64)
REFUSED = {  # a call that is right as it is, and what it refuses: changed arguments, the error, and what it says
    "MPCProblem": (problem, [
        ({"horizon": 0}, e.InvalidInputError, "horizon: expected at least 1, got 0"),
        ({"horizon": 1.0}, e.DTypeError, "horizon: expected an int"),
        ({"relaxation": 0.0}, e.InvalidInputError, "relaxation: .*above 0, got 0"),
        ({"x0": X}, e.ShapeError, "x0: expected"),
        ({"E": full(0.0, 3, 3)}, e.ShapeError, r"E: expected \(3, 2\) or \(5, 3, 2\) or .*, got \(3, 3\)"),
        ({"E": full(0.0, 5, 3, 3, 2)}, e.ShapeError, r"E: expected .* or \(5, 2, 3, 2\), got \(5, 3, 3, 2\)"),
        ({"S": full(0.0, 2, 4)}, e.ShapeError, r"S: expected \(4, 2\) or .*, got \(2, 4\)"),
        ({"g": full(1.0, 3), "G_x": full(1.0, 2, 4)}, e.ShapeError, r"G_x: expected \(3, 4\) or"),
        ({"g": full(1.0, 1), "price": full(-1.0, 1)}, e.InvalidInputError, "price: .*got -1; "),
        ({"u_min": full(INF, 2)}, e.BoundsError, "u_min"),
        ({"u_max": full(INF, 2), "barrier": 0.1}, e.BoundsError, "finite bounds with a barrier"),
        ({"u_min": ONE}, e.BoundsError, "u_min <= u_max, got 1.*0.1"),
    ]),
    "StageBounds": (lambda b, u_min=LOW, u_max=None: difflcs.StageBounds(u_min, u_max), [
        ({"u_min": full(0.1, 3, 2), "u_max": full(-0.1, 3, 2)}, e.BoundsError,
         r"u_min <= u_max, got 0.1 and -0.1 at index \(0, 0\)"),
        ({"u_min": full(INF, 3, 2)}, e.BoundsError, "u_min: expected at least one action that it allows"),
        ({"u_min": full(-1.0, 2), "u_max": full(1.0, 3, 2)}, e.ShapeError,
         r"u_min: expected a dimension of stages.*got \(2,\)"),
        ({"u_min": full(-1.0, 4, 2), "u_max": full(1.0, 3, 2)}, e.ShapeError,
         "u_min: expected 3 stages.*like u_max, got 4"),
        ({"u_max": full(1.0, 3, 3)}, e.ShapeError, r"u_m..: expected shape \(\.\.\., H=3, n_u="),
        ({"u_min": full(NAN, 3, 2)}, e.NonFiniteError, "u_min: expected numbers or infinity, got 6 NaN of 6"),
        ({"u_min": -1.0, "u_max": 1.0}, e.InvalidInputError, "by_stage: expected at least one field by stage"),
        ({"u_max": "1"}, e.DTypeError, "u_max: expected a torch.Tensor, got str"),
    ]),
    "LinearConstraints": (rows, [
        ({"G": full(1.0, 4)}, e.ShapeError, r"G: expected shape \(\.\.\., n_c, n_x\), got \(4,\)"),
        ({"g": full(1.0, 2)}, e.ShapeError, r"g: expected shape \(\.\.\., n_c=3\), got \(2,\)"),
        ({"E": full(1.0, 2, 2)}, e.ShapeError, r"E: expected shape \(\.\.\., n_c=3, n_u\), got \(2, 2\)"),
        ({"weight": full(1.0, 4)}, e.ShapeError, r"weight: expected shape \(\.\.\., n_c=3\), got \(4,\)"),
        ({"g": full(-INF, 3)}, e.InvalidInputError, "g: expected limits above −∞, got −∞; "),
        ({"weight": 0.0}, e.InvalidInputError, "weight: expected a positive price .*got 0; leave out"),
        ({"weight": -1}, e.InvalidInputError, "weight: expected a positive price .*got -1"),
        ({"weight": NAN}, e.NonFiniteError, "weight: expected numbers or infinity, got 3 NaN"),
        ({"weight": True}, e.DTypeError, "weight: expected a torch.Tensor, got bool"),
        ({"G": full(NAN, 3, 4)}, e.NonFiniteError, "G: expected finite numbers, got 12"),
        ({"E": full(INF, 3, 2)}, e.NonFiniteError, "E: expected finite numbers, got 6"),
        ({"g": full(NAN, 3)}, e.NonFiniteError, "g: expected numbers or infinity, got 3 NaN"),
        ({"g": [1.0, [1.0], True]}, e.DTypeError, "g: expected a torch.Tensor, got list"),
        ({"G": None}, e.DTypeError, "G: expected a torch.Tensor, got NoneType"),
    ]),
    "ConstraintSequence": (rows_by_stage, [
        ({"g": full(1.0, 3)}, e.ShapeError, r"g: expected a dimension of stages .*got \(3,\)"),
        ({"g": full(1.0, 5, 3)}, e.ShapeError, r"g: expected 4 stages, for a horizon of 3 like G, got 5"),
        ({"E": full(1.0, 4, 3, 2)}, e.ShapeError, r"E: expected 3 stages, for a horizon of 3 like G, got 4"),
        ({"G": full(1.0, 1, 3, 4)}, e.ShapeError, "G: expected at least 2 stages, got 1"),
        ({"by_stage": ("h",)}, e.InvalidInputError, "by_stage: expected some of G, g, E, weight, got str 'h'"),
        ({"g": full(-INF, 4, 3)}, e.InvalidInputError, "g: expected limits above −∞"),
    ]),
    "CostSequence": (cost_by_stage, [
        ({"q": X}, e.ShapeError, r"q: expected a dimension of stages .*got \(4,\).*; say by by_stage"),
        ({"q": full(0.0, 5, 4)}, e.ShapeError, r"q: expected 3 stages, .* like Q, got 5.*; give as many"),
        ({"by_stage": ("Q_final",)}, e.InvalidInputError,
         "by_stage: expected some of Q, R, q, r, S, got str 'Q_final'"),
        ({"by_stage": "q"}, e.DTypeError, "by_stage: expected a tuple of names .*got str .q.; add a comma"),
        ({"by_stage": ()}, e.InvalidInputError,
         "by_stage: expected at least one field by stage, got none.*; use the class"),
        ({"S": None, "Q": full(-1.0, 3, 4, 4)}, e.InvalidInputError, "Q: expected a positive semi-definite"),
        ({"S": full(0.0, 3, 2, 4)}, e.ShapeError, r"S: expected shape \(\.\.\., n_x=4, n_u=2\)"),
        ({"S": torch.stack([full(0.0, 4, 2), full(30.0, 4, 2), full(0.0, 4, 2)])}, e.InvalidInputError, r"\[\[Q, S\]"),
    ]),
    "GoalCost.reach": (lambda b, n_x=3, n_u=2, **change: difflcs.GoalCost.reach(n_x, n_u, **change), [
        ({"goal_weight": (1.0, 2.0, 3.0, 4.0)}, e.ShapeError, "goal_weight: expected 1 to n_x=3 weights, got 4"),
        ({"goal_weight": ()}, e.ShapeError, "goal_weight: expected 1 to n_x=3 weights, got 0"),
        ({"goal_weight": -1.0}, e.InvalidInputError, "goal_weight: .*at least 0, got -1"),
        ({"goal_weight": NAN}, e.InvalidInputError, "goal_weight: .*finite.*got nan"),
        ({"goal_weight_final": (1.0, 2.0)}, e.ShapeError, "goal_weight_final: expected 3 weights.*got 2"),
        ({"input_weight": 0.0}, e.InvalidInputError, "input_weight: .*above 0, got 0"),
        ({"pairs": [(0, 3)], "pair_weight": 1.0}, e.InvalidInputError, r"pairs: .*0…2, got list"),
        ({"pairs": [(1, 1)]}, e.InvalidInputError, r"pairs: .*different indices.*\(1, 1\)"),
        ({"pair_weight": -2.0}, e.InvalidInputError, "pair_weight: .*got -2"),
        ({"n_x": 0}, e.InvalidInputError, "n_x: expected at least 1, got 0"),
        ({"dtype": torch.float16}, e.DTypeError, "dtype: expected torch.float32 or torch.float64, got torch.float16"),
    ]),
    "LCSModel": (lambda b, support=SUPPORT: difflcs.LCSModel(4, 2, 3, action_support=support), [
        ({"support": SUPPORT[0]}, e.ShapeError, "action_support|u_min"),
        ({"support": SUPPORT.flip(0)}, e.BoundsError, "action_support|u_min"),
        ({"support": SUPPORT * NAN}, e.NonFiniteError, "action_support|u_min"),
        ({"support": [[0.0, 0.0], [1.0, 1.0]]}, e.DTypeError, "action_support|u_min"),
    ]),
    "cart_pole_between_walls": (lambda b, **change: cart_pole_between_walls(**change), [
        ({"cart_mass": 0.0}, e.InvalidInputError, "cart_mass"),
        ({"wall_stiffness": -1.0}, e.InvalidInputError, "wall_stiffness"),
        ({"dt": NAN}, e.InvalidInputError, "dt"),
    ]),
    "block_along_wall": (lambda b, **change: block_along_wall(**change), [
        ({"friction": -0.1}, e.InvalidInputError, "friction"),
        ({"face_angle": np.pi / 2}, e.InvalidInputError, "face_angle"),
        ({"stick": 0.0}, e.InvalidInputError, "stick"),
    ]),
    "BatchedBackend": (lambda b, **change: BatchedBackend(**change), [
        *(({name: value}, e.InvalidInputError, f"{name}: expected") for name, value in {
            "restarts": 0, "tol": 0.0, "max_iter": 0, "shrink": 1.0, "homotopy": 0.5, "effort": "huge",
        }.items()),
        *(({"threads": n}, e.InvalidInputError, "threads: expected") for n in (0, -1, 10**6, 2**31)),
    ]),
    "IpoptBackend": (lambda b, **change: IpoptBackend(**change), [
        ({"tol": 0.0}, e.InvalidInputError, "tol: .*above 0, got 0"),
        ({"max_iter": 2.5}, e.DTypeError, "max_iter: expected an int, got float 2.5"),
        ({"workers": 0}, e.InvalidInputError, "workers: expected at least 1, got 0"),
        ({"workers": 2**31}, e.InvalidInputError, "workers: expected at most"),
        ({"start": -1.0}, e.InvalidInputError, "start: .*got -1"),
        ({"second_start": 0.0}, e.InvalidInputError, "second_start: .*got 0"),
        ({"mu_init": NAN}, e.InvalidInputError, "mu_init: .*got nan"),
    ]),
    "RelaxedBackend": (lambda b, **change: RelaxedBackend(**change), [
        *(({"penalties": wrong}, e.DTypeError, "penalties") for wrong in ((), 3.0, ("a",))),
        ({"penalties": (-1.0,)}, e.InvalidInputError, "penalties"),
        ({"tol": 0.0}, e.InvalidInputError, "tol"),
        ({"residual_tol": -1.0}, e.InvalidInputError, "residual_tol"),
        ({"threads": 0}, e.InvalidInputError, "threads"),
    ]),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "change", "error", "match"), [(name, *row) for name, (_, rows) in REFUSED.items() for row in rows]
)
def test_arguments_that_do_not_fit_are_refused(build, name, change, error, match):
    call, _ = REFUSED[name]
    call(build)
    message = refuse(error, match, call, build, **change)
    assert ";" in message or "Constraint" not in name, "no remedy"


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
