"""QuadraticCost and GoalCost: their value, convexity and gradients."""

import re

import pytest
import torch
from torch import nn

from difflcs import CostSequence, GoalCost, LCSMPCLayer, QuadraticCost
from difflcs.errors import DTypeError, InvalidInputError, ShapeError
from difflcs.systems import pushing_cost
from tests.conformance import judges
from tests.conftest import refuse


def evaluate(cost, x, u, i=...):
    """The objective of a cost, or of element i of a sequence of linear terms, written out; x (H+1, n_x), u (H, n_u)."""
    terms = {name: value[i] if name in ("q", "q_final") else value for name, value in cost.fields().items()}
    return float(judges.cost(terms, x, u) + cost.constant[i])


def paper(x, u, goal):
    """Eq. 13, literally: cube x, y, yaw, then three fingertips."""

    def near(x, weight):
        return weight * sum(float((x[3 + 2 * i : 5 + 2 * i] - x[:2]).square().sum()) for i in range(3))

    def stage(x, u):
        return (
            near(x, 10.0)
            + 200.0 * float((x[:2] - goal[:2]).square().sum())
            + 0.3 * float((x[2] - goal[2]).square())
            + 200.0 * float(u.square().sum())
        )

    aim = 200.0 * float((x[-1, :2] - goal[:2]).square().sum()) + 1.5 * float((x[-1, 2] - goal[2]).square())
    final = near(x[-1], 6.0) + aim
    return sum(stage(x[k], u[k]) for k in range(len(u))) + final


@pytest.mark.parametrize("seed", range(5))
def test_reach_is_the_cost_of_the_paper_with_its_constant(build, seed):
    n = build.normal(seed)
    x, u, goal = n(6, 9), n(5, 6), n(3)
    assert evaluate(pushing_cost()(goal, horizon=5), x, u) == pytest.approx(paper(x, u, goal), rel=1e-12)


def test_goals_of_any_batch_shape(build):
    cost, goal = pushing_cost(), build.normal(0)(2, 5, 3)
    mapped = cost(goal, horizon=4)
    assert mapped.q.shape == mapped.q_final.shape == (2, 5, 9)
    assert mapped.constant.shape == (2, 5)
    torch.testing.assert_close(mapped.q[1, 3], cost(goal[1, 3]).q)


def test_only_the_symmetric_parts_matter(build):
    tensors = build.cost_tensors(0)
    skew = build.normal(0)(4, 4)
    bent = QuadraticCost(**{**tensors, "Q": tensors["Q"] + skew - skew.T})
    torch.testing.assert_close(bent.fields()["Q"], tensors["Q"])


def test_parameters_are_learned_and_plain_tensors_are_buffers(build):
    tensors = build.cost_tensors(0)
    cost = QuadraticCost(**{**tensors, "Q": nn.Parameter(tensors["Q"])})
    assert [name for name, _ in cost.named_parameters()] == ["Q"]
    assert {name for name, _ in cost.named_buffers()} == {"R", "Q_final", "q", "r", "q_final", "constant"}
    assert "Q(4, 4)" in repr(cost)


@pytest.mark.parametrize("name", ["Q", "R", "Q_final"])
def test_a_weight_with_a_negative_eigenvalue_is_refused(build, name):
    tensors = build.cost_tensors(0)
    tensors[name] = tensors[name] - 10 * torch.eye(len(tensors[name]))
    smallest, expected = torch.linalg.eigvalsh(tensors[name])[0], f"{name}: expected a positive semi-definite"
    refuse(InvalidInputError, f"{expected}.*{re.escape(f'{smallest:.3e}')}", QuadraticCost, **tensors)
    for kind in (nn.Parameter, torch.Tensor.requires_grad_, torch.Tensor.detach):
        learned = {**build.cost_tensors(0), name: kind(build.cost_tensors(0)[name])}
        mpc = LCSMPCLayer(build.params(), QuadraticCost(**learned), 3, -1.0, 1.0)
        with torch.no_grad():
            learned[name].copy_(tensors[name])  # as an optimiser does, or somebody who tries weights
        refuse(InvalidInputError, expected, mpc, torch.zeros(4).double())


def test_a_goal_cost_has_one_dtype():
    cost = pushing_cost()
    fields = cost.Q, cost.R.float(), cost.Q_final, *cost.maps().values()
    refuse(DTypeError, "R: expected torch.float64 like Q", GoalCost, *fields)


def test_semidefinite_weights_are_accepted():
    eye, ones = torch.eye(2, dtype=torch.float64), torch.ones(3, 3, dtype=torch.float64)
    QuadraticCost(ones, eye, 0 * ones)  # rank one, eigenvalues rounded around zero
    QuadraticCost(eye, eye, eye, S=eye)  # ‖x + u‖², whose Hessian is singular
    refuse(InvalidInputError, r"smallest eigenvalue -1\.000e-06", QuadraticCost, eye, eye, eye, S=(1 + 1e-6) * eye)


# --- cross terms ----------------------------------------------------------------------------------------------------


def test_without_cross_terms_there_is_no_field_for_them(build):
    cost = build.cost(0)
    assert cost.S is None
    assert "S" not in cost.state_dict() | cost.fields() | cost.tensors()
    learned = QuadraticCost(**build.cost_tensors(0), S=nn.Parameter(0.1 * build.normal(1)(4, 2)))
    assert [name for name, _ in learned.named_parameters()] == ["S"]
    assert "S" in learned.fields()


@pytest.mark.parametrize("batch", [(), (3,)])
def test_cross_terms_that_make_the_cost_indefinite_are_refused(build, batch):
    tensors = build.cost_tensors(0, batch=batch)
    S = 0.1 * build.normal(1)(4, 2)  # shared where the others are not
    QuadraticCost(**tensors, S=S)
    Q, R = (tensors[k].reshape(-1, *tensors[k].shape[-2:])[-1] for k in ("Q", "R"))
    whole = torch.cat([torch.cat([Q, 30 * S], -1), torch.cat([30 * S.T, R], -1)], -2)
    assert float(torch.linalg.eigvalsh(whole)[0]) < -1
    with pytest.raises(InvalidInputError, match=r"\[\[Q, S\], \[Sᵀ, R\]\]: expected a positive semi-definite.*-\d"):
        QuadraticCost(**tensors, S=30 * S)
    QuadraticCost(**tensors, S=30 * S, check=False)
    cost = QuadraticCost(**tensors, S=nn.Parameter(S))
    cost.S.data.mul_(30)  # as an optimiser does
    mpc = LCSMPCLayer(build.params(), cost, 3, -1.0, 1.0)
    refuse(InvalidInputError, r"\[\[Q, S\], \[Sᵀ, R\]\]: expected", mpc, torch.zeros(*batch, 4).double())


# --- references ---------------------------------------------------------------------------------------------------


def test_following_a_reference_is_tracking_each_goal(build):
    cost, n = pushing_cost(), build.normal(4)
    x, u, reference = n(6, 9), n(5, 6), n(2, 6, 3)
    followed = cost.follow(reference)
    assert isinstance(followed, CostSequence)
    assert followed.by_stage == {"q"}  # a preview does not multiply the weights
    assert followed.q.shape == (2, 5, 9)
    assert followed.horizon == 5
    for i in range(2):
        expected = sum(float(cost.stage(x[k], u[k], reference[i, k])) for k in range(5))
        final = cost(reference[i, -1], horizon=0)
        expected += float(0.5 * x[-1] @ final.Q_final @ x[-1] + final.q_final @ x[-1] + final.constant)
        assert evaluate(followed, x, u, i) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("shape", [(3,), (1, 3), (6, 2)])
def test_references_of_other_shapes_are_refused(build, shape):
    with pytest.raises(ShapeError, match=r"reference: expected .*n_goal=3"):
        pushing_cost().follow(torch.zeros(shape, dtype=torch.float64))
