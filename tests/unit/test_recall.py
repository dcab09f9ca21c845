"""What a layer and a model remember of an earlier call: no change of a number goes unnoticed, however it is made."""

import copy
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter

import numpy as np
import pytest
import torch

from difflcs import GoalCost, LCSModel, LCSMPCLayer, LCSParams, LinearConstraints, QuadraticCost, StageBounds
from difflcs._linalg import product
from difflcs.errors import BoundsError, DTypeError, NonFiniteError, NotPositiveDefiniteError, ShapeError
from difflcs.mpc import Primal
from difflcs.mpc.backends import BatchedBackend
from tests.conftest import draw, refuse

HORIZON = 4


def make_model(seed=0):
    return LCSModel(4, 2, 3, init_scale=0.3, generator=torch.Generator().manual_seed(seed))


def make_cost():
    return GoalCost.reach(4, 2, goal_weight=(10.0, 5.0), input_weight=0.1)


def make_layer(model=None, cost=None, **kwargs):
    half = torch.full((2,), 0.5).double()
    limits = {} if "bounds" in kwargs else {"u_min": -half, "u_max": half}
    return LCSMPCLayer(make_model() if model is None else model, cost or make_cost(), HORIZON, **limits, **kwargs)


X, GOAL = 0.3 * draw(1, 4, seed=1), 0.3 * draw(1, 2, seed=2)
FIELDS = ("x", "u", "lam", "mu", "objective", "status", "kkt_residual", "violation")


def plan(layer, *inputs, **kwargs):
    with torch.no_grad():
        return layer(*inputs, **kwargs)


def assert_same(found, expected):
    for name in FIELDS:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def assert_as_fresh(layer, *inputs, **kwargs):
    """A layer that was used before gives what one without a memory gives, bit for bit."""
    assert_same(plan(layer, *inputs, **kwargs), plan(copy.deepcopy(layer), *inputs, **kwargs))


def add_to_one(p):
    p.data[(-1,) * p.ndim] += 0.01  # of a diagonal, as weights are to stay definite


CHANGES = {
    "in place": lambda p: p.mul_(1.5),
    "in place of data": lambda p: p.data.mul_(1.5),
    "other data": lambda p: setattr(p, "data", 1.5 * p.data),
    "data that was changed back": lambda p: (p.data.mul_(1.5), p.data.mul_(1 / 1.5)),
    "one number": add_to_one,
    "as an array": lambda p: np.multiply(p.detach().numpy(), 1.5, out=p.detach().numpy()),
    "transposed": lambda p: setattr(p, "data", p.data.T) if p.ndim == 2 and p.shape == p.mT.shape else p.data.mul_(1.5),
}


def with_everything():
    """A layer with a learned model, a goal cost, bounds, an action support and constraints that hold."""
    rows = LinearConstraints(draw(2, 4), 0.1 * draw(2).abs(), E=draw(2, 2, seed=4), weight=torch.ones(2).double())
    layer = make_layer(constraints=rows)
    layer.lcs.action_support = torch.tensor([[-0.4, -0.6], [0.4, 0.6]]).double()
    return layer, (5 * X, 5 * GOAL)


def with_a_plain_cost():
    eye = torch.eye(4).double()
    cost = QuadraticCost(eye, eye[:2, :2], 2 * eye, draw(4), draw(2), draw(4), torch.ones(()).double())
    return make_layer(cost=cost), (X,)


TENSORS = {
    with_everything: [
        *(f"lcs.{name}" for name in (*"ABCdDEGHc", "action_support")),
        *(f"cost.{name}" for name in ("Q", "R", "Q_final", "goal_to_q", "goal_to_q_final", "goal_stage", "goal_final")),
        *(f"constraints.{name}" for name in ("G", "g", "E", "weight")),
        *("u_min", "u_max"),
    ],
    with_a_plain_cost: [f"cost.{name}" for name in ("Q", "R", "Q_final", "q", "r", "q_final", "constant")],
}


@pytest.mark.parametrize(
    ("make", "name", "change"),
    [(make, name, change) for make, names in TENSORS.items() for name in names for change in CHANGES
     if change == "one number" or name in ("lcs.A", "lcs.c", "cost.Q", "constraints.G", "u_max")],
)  # fmt: skip
def test_a_changed_number_is_noticed(make, name, change):
    layer, inputs = make()
    before = plan(layer, *inputs)
    with torch.no_grad():
        CHANGES[change](attrgetter(name)(layer))
    assert_as_fresh(layer, *inputs)
    if change == "as an array" and name not in ("lcs.c", "u_min", "u_max"):
        assert not torch.equal(plan(layer, *inputs).objective, before.objective)


def test_changed_goals_and_states_are_noticed():
    layer, goal, x = make_layer(), GOAL.clone(), X.clone()
    for i in range(4):
        assert_as_fresh(layer, x, goal)
        (goal if i % 2 else x).mul_(1.2)
    assert_as_fresh(layer, x[0], goal[0])
    assert_as_fresh(layer, x, goal[0])
    assert_as_fresh(layer, x[0], goal)
    assert plan(layer, x[0], goal).u.shape == (1, HORIZON, 2)
    assert plan(layer, x[0], goal[0]).u.shape == (HORIZON, 2)
    assert plan(layer, x[None], goal).u.shape == (1, 1, HORIZON, 2)
    assert_as_fresh(layer, x.expand(3, -1), goal)
    assert_as_fresh(layer, 0.1 * draw(3, 4), 0.1 * draw(3, 2))
    assert_as_fresh(layer, x, reference=0.1 * draw(1, HORIZON + 1, 2))
    assert_as_fresh(layer, x.float(), goal.float())
    assert_as_fresh(layer, x, goal.float())


def test_arguments_of_a_call_are_noticed():
    layer, other, limit = make_layer(), make_model(seed=5), 0.2 * torch.ones(HORIZON, 2).double()
    for kwargs in (
        {"lcs": other},
        {"lcs": LCSModel(4, 2, 5, init_scale=0.3, generator=torch.Generator().manual_seed(6))},
        {"lcs": other.params().detach()},
        {"u_max": 0.1},
        {"bounds": StageBounds(-limit, limit)},
        {"cost": GoalCost.reach(4, 2, goal_weight=(1.0, 5.0), input_weight=0.2)},
        {},
    ):
        assert_as_fresh(layer, X, GOAL, **kwargs)


def test_a_loop_asks_neither_model_nor_cost_again(monkeypatch):
    """Else what this file tests would be slower than it could be, and its tests would test nothing."""
    asked = []
    for kind, name in ((LCSModel, "params"), (GoalCost, "at")):
        original = getattr(kind, name)
        monkeypatch.setattr(
            kind, name, lambda *args, original=original, name=name: asked.append(name) or original(*args)
        )
    layer, guess = make_layer(), None
    for state, goal, expected in (
        (X, GOAL, ["params", "at"]),
        (2 * X, GOAL, []),
        (X, GOAL, []),
        (X, 2 * GOAL, ["at"]),  # a goal that moves
        (2 * X, GOAL, ["at"]),
        (X[0], GOAL, ["params", "at"]),  # other shapes
    ):
        goal = GOAL if goal is GOAL else goal.clone()
        found = plan(layer, state, goal, guess=guess if state.ndim == 2 else None)
        assert asked == expected
        assert_same(found, plan(copy.deepcopy(layer), state, goal, guess=guess if state.ndim == 2 else None))
        guess = found.shift()
        asked.clear()


def test_other_settings_and_parts_are_noticed():
    layer = make_layer(training_relaxation=1e-2)
    params = make_model(seed=7).params().detach()
    for change in (
        layer.eval,
        layer.train,
        layer.eval,
        lambda: setattr(layer, "relaxation", 1e-4),
        lambda: setattr(layer, "barrier", 1e-3),
        lambda: setattr(layer.lcs, "stiffness", 0.7),
        lambda: setattr(layer, "lcs", make_model(seed=5)),
        lambda: setattr(layer.lcs, "action_support", torch.tensor([[-0.1, -0.2], [0.1, 0.2]]).double()),
        lambda: setattr(layer.lcs, "action_support", None),
        lambda: layer.lcs.register_parameter("A", torch.nn.Parameter(0.9 * layer.lcs.A.detach())),
        lambda: setattr(layer, "cost", GoalCost.reach(4, 2, goal_weight=(1.0, 5.0), input_weight=0.2)),
        lambda: setattr(layer, "u_max", torch.full((2,), 0.1).double()),
        lambda: setattr(layer, "backend", BatchedBackend(tol=1e-3)),
        lambda: setattr(layer, "constraints", LinearConstraints(draw(1, 4), 0.01 * draw(1).abs(), weight=2.0)),
        lambda: setattr(layer, "constraints", None),
        lambda: (delattr(layer, "lcs"), setattr(layer, "lcs", params)),
        lambda: params.A.mul_(0.9),
        lambda: setattr(layer, "lcs", make_model(seed=8).params().detach()),
        lambda: (delattr(layer.cost, "Q"), setattr(layer.cost, "Q", 3 * layer.cost.Q_final)),  # no buffer any more
        lambda: layer.cost.Q.mul_(1.5),
        lambda: setattr(layer, "horizon", HORIZON + 1),
    ):
        plan(layer, X, GOAL)
        change()
        assert_as_fresh(layer, X, GOAL)
        assert_as_fresh(layer, X, GOAL)


def test_systems_that_are_given_to_each_call():
    layer = make_layer()
    layer.lcs.action_support = torch.tensor([[-0.1, -0.2], [0.1, 0.2]]).double()  # holds for its own model alone
    systems = [make_model(seed).params().detach() for seed in range(3)]
    several = LCSParams(**{k: torch.stack([s.tensors()[k] for s in systems]) for k in systems[0].tensors()})
    other = LCSModel(4, 2, 5, init_scale=0.3, generator=torch.Generator().manual_seed(6)).params().detach()
    for state in (X, X.expand(3, -1)):
        for lcs in (systems[0], systems[1], systems[1], None, systems[2], other, systems[0], layer.lcs, None):
            assert_as_fresh(layer, 5 * state, 5 * GOAL, lcs=lcs)
            assert_as_fresh(layer, 4 * state, 5 * GOAL, lcs=lcs)
    for lcs in (several, several[[2, 1, 0]], systems[0]):
        assert_as_fresh(layer, X.expand(3, -1), GOAL, lcs=lcs)
    systems[0].A.mul_(0.9)
    assert_as_fresh(layer, X.expand(3, -1), GOAL, lcs=systems[0])
    learned = make_model().params()
    layer(X.expand(3, -1), GOAL, lcs=learned).objective.sum().backward()
    refuse(ShapeError, "cost", plan, layer, X, GOAL, lcs=LCSModel(4, 1, 3).params().detach())


def test_what_becomes_differentiable_is_noticed():
    cost = make_cost()
    layer = make_layer(make_model().params().detach(), cost)
    for _ in range(2):
        assert not layer(X, GOAL).objective.requires_grad  # with gradients on, but nothing to differentiate
    for tensor in (cost.Q, layer.u_max, GOAL.clone(), X.clone()):
        tensor.requires_grad_()
        x, goal = (tensor if v.shape == tensor.shape else v for v in (X, GOAL))
        layer(x, goal).objective.sum().backward()
        assert tensor.grad is not None
        tensor.requires_grad_(False)
        assert not layer(X, GOAL).objective.requires_grad


def test_a_guess_is_checked_in_a_loop_too():
    layer = make_layer()
    guess = plan(layer, X, GOAL).shift()
    expected = plan(copy.deepcopy(layer), X, GOAL, guess=guess)
    for given in (guess, Primal(*guess[:3]), Primal(*(v.mT.contiguous().mT for v in guess)), expected):
        assert_same(plan(layer, X, GOAL, guess=given), plan(copy.deepcopy(layer), X, GOAL, guess=given))
    single = Primal(*(v.float() for v in guess))
    assert_same(plan(layer, X, GOAL, guess=single), plan(copy.deepcopy(layer), X, GOAL, guess=single))
    for kind, wrong, match in (
        (NonFiniteError, guess._replace(x=guess.x * torch.nan), "guess.x"),
        (NonFiniteError, guess._replace(u=guess.u / 0), "guess.u"),
        (ShapeError, guess._replace(lam=guess.lam[:, 1:]), "guess.lam"),
        (DTypeError, tuple(guess), "guess"),
    ):
        refuse(kind, match, plan, layer, X, GOAL, guess=wrong)
    refuse(DTypeError, "goal", plan, layer, X, ["0.1", "0.2"])
    assert_same(plan(layer, X.tolist(), GOAL.tolist()), plan(layer, X, GOAL))


def test_what_a_caller_does_with_results_changes_nothing():
    layer = make_layer()
    guess = plan(layer, X, GOAL).shift()
    expected = plan(copy.deepcopy(layer), X, GOAL, guess=guess)
    for _ in range(2):
        found = plan(layer, X, GOAL, guess=guess)
        assert_same(found, expected)
        for name in FIELDS:
            getattr(found, name).zero_()
        with torch.no_grad():
            layer.lcs.params().F.zero_()
            made = layer.cost(GOAL)
            made.q.zero_()
            made.constant.zero_()


def test_errors_are_those_of_a_first_call():
    def refused(kind, match, change, *inputs):
        layer = make_layer()
        for used in (layer, copy.deepcopy(layer)):
            if used is layer:
                plan(used, X, GOAL)
            with torch.no_grad():
                change(used)
                refuse(kind, match, used, *inputs)

    refused(NonFiniteError, "^x0", lambda layer: None, X * torch.nan, GOAL)
    refused(DTypeError, "^x0: expected a dense", lambda layer: None, X.to_sparse(), GOAL)
    refused(NonFiniteError, "^goal", lambda layer: None, X, GOAL * torch.inf)
    refused(NonFiniteError, "^A", lambda layer: layer.lcs.A.data.fill_(torch.nan), X, GOAL)
    refused(NonFiniteError, "^Q", lambda layer: layer.cost.Q.fill_(torch.nan), X, GOAL)
    refused(DTypeError, "^Q.*bfloat16", lambda layer: layer.cost.bfloat16(), X, GOAL)
    refused(NonFiniteError, "^q", lambda layer: layer.cost.goal_to_q.fill_(torch.inf), X, GOAL)
    refused(BoundsError, "u_min", lambda layer: layer.u_max.fill_(-1.0), X, GOAL)
    refused(ShapeError, "batch dimensions", lambda layer: None, X.expand(2, -1), GOAL.expand(3, -1))
    refused(NotPositiveDefiniteError, "^F", lambda layer: setattr(layer.lcs, "stiffness", -9.0), X, GOAL)


def test_a_module_of_ones_own_is_asked_each_time():
    class Scaled(LCSModel):
        gain = 1.0

        @property
        def F(self):
            return self.gain * super().F

    class Offset(GoalCost):
        def at(self, goal, horizon):
            return super().at(goal + self.offset, horizon)

    model = Scaled(4, 2, 3, init_scale=0.3, generator=torch.Generator().manual_seed(0))
    cost = Offset(**{name: getattr(make_cost(), name) for name in (*"QR", "Q_final", "goal_to_q", "goal_to_q_final")})
    cost.offset = 0.0
    layer = make_layer(model, cost)
    first = plan(layer, X, GOAL)
    model.gain = 2.0
    second = plan(layer, X, GOAL)
    assert not torch.equal(first.x, second.x)
    cost.offset = 0.1
    assert not torch.equal(second.x, plan(layer, X, GOAL).x)
    assert_as_fresh(layer, X, GOAL)


def test_bounds_of_ones_own_are_asked_each_time():
    class Narrowing(LCSMPCLayer):
        width = 0.5

        def limits(self, system=None):
            low, high = super().limits(system)
            return low * self.width, high * self.width

    layer = Narrowing(make_model(), make_cost(), HORIZON, -0.5, 0.5)
    for width in (0.5, 0.5, 0.1):
        layer.width = width
        assert float(plan(layer, 9 * X, 9 * GOAL).u.abs().max()) == pytest.approx(0.5 * width)


def test_inference_mode_and_no_grad_take_turns():
    layer = make_layer()
    expected = plan(make_layer(), X, GOAL)
    for _ in range(2):
        with torch.inference_mode():
            assert_same(layer(X, GOAL), expected)
        assert_same(plan(layer, X, GOAL), expected)
        with torch.no_grad():
            params = layer.lcs.params()
        u = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
        params.step(X, u).x_next.sum().backward()  # F may be saved for a backward pass
        layer(X, GOAL).objective.sum().backward()


def test_threads_share_a_layer():
    layer = make_layer()
    models = [make_model(seed) for seed in range(4)]
    expected = [plan(make_layer(model), X, GOAL) for model in models]

    def work(i):
        with torch.no_grad():
            return [layer(X, GOAL, lcs=models[(i + k) % 4]) for k in range(40)]

    with ThreadPoolExecutor(4) as pool:
        for i, found in enumerate(pool.map(work, range(4))):
            for k, solution in enumerate(found):
                assert_same(solution, expected[(i + k) % 4])


def test_what_another_thread_changes_while_a_plan_is_made_is_noticed(monkeypatch):
    layer = make_layer()

    def meanwhile(*factors):
        monkeypatch.undo()
        return product(*factors), layer.lcs.G.data.mul_(1.5)

    monkeypatch.setattr("difflcs.lcs.product", lambda *factors: meanwhile(*factors)[0])
    plan(layer, X, GOAL)
    assert_as_fresh(layer, X, GOAL)
