"""LCSParams and LCSModel: the equations, their gradients, and what a module must survive."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import pytest
import torch
from torch.autograd import gradcheck
from torch.func import functional_call

from difflcs import LCSModel, LCSParams
from difflcs.errors import (
    BoundsError,
    CheckpointError,
    DTypeError,
    InvalidInputError,
    NonFiniteError,
    NotPositiveDefiniteError,
    ShapeError,
)

NAMES = ("A", "B", "C", "d", "D", "E", "G", "H", "c")


@pytest.fixture
def model(build):
    return build.model(seed=3)


@pytest.fixture
def data(build):
    n = build.normal(5)
    return n(6, 4), n(6, 2)


# --- parametrisation ------------------------------------------------------------------------------------------------


def test_F_is_the_formula_of_the_design(model):
    G, H = model.G.detach(), model.H.detach()
    torch.testing.assert_close(
        model.F.detach(), G @ G.T + 0.2 * torch.eye(3, dtype=torch.float64) + H - H.T, rtol=1e-14, atol=1e-14
    )


@pytest.mark.parametrize("scale", [0.0, 1e-3, 1.0, 100.0])
def test_F_plus_its_transpose_is_at_least_twice_the_stiffness(build, scale):
    model = build.model(seed=1, n_lam=6, scale=scale)
    smallest = torch.linalg.eigvalsh(model.F.detach() + model.F.detach().T)[0]
    assert float(smallest) >= 2 * model.stiffness - 1e-9 * max(1, scale**2)


def test_a_new_model_has_the_documented_start():
    model = LCSModel(9, 6, 5, stiffness=0.1, init_scale=1e-3)
    assert {k: tuple(v.shape) for k, v in model.named_parameters()} == {
        "A": (9, 9), "B": (9, 6), "C": (9, 5), "d": (9,), "D": (5, 9), "E": (5, 6), "G": (5, 5), "H": (5, 5), "c": (5,),
    }  # fmt: skip
    assert all(p.dtype == torch.float64 and p.requires_grad for p in model.parameters())
    assert torch.equal(model.c, torch.zeros(5, dtype=torch.float64))
    for name in set(NAMES) - {"c"}:
        value = getattr(model, name).detach()
        assert 0 < float(value.abs().max()) <= 1e-3
    assert not LCSModel(9, 6, 5, learn_c=False).c.requires_grad


def test_the_generator_alone_decides_the_start():
    first, second, other = (LCSModel(3, 2, 2, generator=torch.Generator().manual_seed(s)) for s in (7, 7, 8))
    assert torch.equal(first.A, second.A)
    assert torch.equal(first.H, second.H)
    assert not torch.equal(first.A, other.A)


# --- prediction -----------------------------------------------------------------------------------------------------


def test_forward_equals_the_equations_by_hand(build, model, data):
    x, u = data
    x_next, lam = model(x, u)
    p = {k: v.detach() for k, v in model.params().tensors().items()}
    touching = 0
    for i in range(6):
        q = p["D"] @ x[i] + p["E"] @ u[i] + p["c"]
        expected, _ = build.enumerate_lcp(p["F"], q)
        touching += int((expected > 0).sum())
        torch.testing.assert_close(lam[i].detach(), expected, rtol=1e-9, atol=1e-10)
        by_hand = p["A"] @ x[i] + p["B"] @ u[i] + p["C"] @ expected + p["d"]
        torch.testing.assert_close(x_next[i].detach(), by_hand, rtol=1e-9, atol=1e-10)
    assert 3 < touching < 15


def test_batch_dimensions_of_x_and_u_broadcast(model, data):
    x, u = data
    x_next, lam = model(x[:, None], u)
    assert x_next.shape == (6, 6, 4)
    assert lam.shape == (6, 6, 3)
    torch.testing.assert_close(x_next[2, 4], model(x[2], u[4]).x_next)
    assert model(x[0], u[0]).x_next.shape == (4,)


def test_rollout_repeats_forward(build, model):
    n = build.normal(6)
    x0, u = n(5, 4), 0.3 * n(5, 7, 2)
    xs = model.rollout(x0, u)
    assert xs.shape == (5, 8, 4)
    assert torch.equal(xs[:, 0], x0)
    for t in range(7):
        torch.testing.assert_close(xs[:, t + 1], model(xs[:, t], u[:, t]).x_next)


def test_rollout_takes_unbatched_broadcast_and_empty_sequences(build, model):
    n = build.normal(6)
    assert model.rollout(n(4), n(3, 2)).shape == (4, 4)
    assert model.rollout(n(4), n(5, 3, 2)).shape == (5, 4, 4)
    assert model.rollout(n(5, 1, 4), n(6, 3, 2)).shape == (5, 6, 4, 4)
    assert model.rollout(n(5, 4), n(5, 0, 2)).shape == (5, 1, 4)
    assert model.rollout(n(0, 4), n(0, 3, 2)).shape == (0, 4, 4)


def test_gradcheck_in_x_u_and_every_parameter(build):
    model = build.model(seed=2, n_x=3, n_u=2, n_lam=3)
    n = build.normal(4)
    x, u = n(3, 3).requires_grad_(), n(3, 2).requires_grad_()
    lam = model(x, u).lam
    w = model.params().gap(x, u, lam)
    assert float(torch.maximum(lam, w).detach().min()) > 1e-4
    assert int((lam > 0).sum()) > 2

    def function(x, u, *values):
        return tuple(functional_call(model, dict(zip(NAMES, values, strict=True)), (x, u)))

    values = [getattr(model, k).detach().clone().requires_grad_() for k in NAMES]
    assert gradcheck(function, (x, u, *values), eps=1e-7, atol=1e-6, rtol=1e-5)


def test_gradient_flows_through_a_rollout_to_every_parameter(build, model):
    n = build.normal(6)
    x0 = n(5, 4).requires_grad_()
    u = n(5, 4, 2).requires_grad_()
    model.rollout(x0, u).square().mean().backward()
    for value in (x0, u, *model.parameters()):
        assert float(value.grad.abs().max()) > 0
        assert bool(torch.isfinite(value.grad).all())


def test_float32_model_answers_in_float32(build, data):
    model = build.model(seed=3, dtype=torch.float32)
    x, u = (v.float() for v in data)
    x_next, lam = model(x, u)
    assert x_next.dtype == lam.dtype == torch.float32
    expected = build.model(seed=3)(*data)
    torch.testing.assert_close(x_next.double(), expected.x_next, rtol=1e-4, atol=1e-4)
    x_next.sum().backward()
    assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in model.parameters())


# --- modules --------------------------------------------------------------------------------------------------------


def assert_same_model(left, right, data):
    for name in NAMES:
        assert torch.equal(getattr(left, name), getattr(right, name))
    assert left.config() == right.config()
    assert torch.equal(left(*data).x_next, right(*data).x_next)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_copies_and_pickles_are_the_same_model(model, data, copied):
    assert_same_model(model, copied(model), data)


def test_a_deep_copy_shares_no_memory(model, data):
    before = model(*data).x_next.detach()
    twin = copy.deepcopy(model)
    with torch.no_grad():
        twin.A.add_(1.0)
    assert torch.equal(model(*data).x_next.detach(), before)


def test_state_dict_round_trip(build, model, data):
    other = build.model(seed=99)
    assert set(model.state_dict()) == set(NAMES)
    other.load_state_dict(model.state_dict())
    assert_same_model(model, other, data)


def test_dtype_conversion_by_to(model, data):
    assert model.to(torch.float32)(*(v.float() for v in data)).x_next.dtype == torch.float32


def test_the_repr_names_the_sizes(model):
    assert "n_x=4, n_u=2, n_lam=3, stiffness=0.2" in repr(model)


@pytest.mark.parametrize("stiffness", [None, 1e-3])
@pytest.mark.parametrize("n_lam", [1, 3, 6])
def test_from_params_round_trip(build, stiffness, n_lam):
    params = build.params(seed=4, n_lam=n_lam)
    model = LCSModel.from_params(params, stiffness)
    for name, value in model.params().detach().tensors().items():
        torch.testing.assert_close(value, getattr(params, name), rtol=1e-12, atol=1e-13)
    assert all(p.requires_grad for p in model.parameters())
    if stiffness is not None:
        assert model.stiffness == stiffness


def test_from_params_leaves_the_given_tensors_alone(build):
    params = build.params(seed=4)
    kept = {k: v.clone() for k, v in params.tensors().items()}
    model = LCSModel.from_params(params)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1.0)
    assert all(torch.equal(v, kept[k]) for k, v in params.tensors().items())


def test_from_params_refuses_a_stiffness_that_cannot_represent_F(build):
    params = build.params(seed=4)
    smallest = float(torch.linalg.eigvalsh(0.5 * (params.F + params.F.T))[0])
    with pytest.raises(InvalidInputError, match=rf"less than the smallest eigenvalue {smallest:.3e}.*got 1000"):
        LCSModel.from_params(params, stiffness=1000.0)


def test_from_params_refuses_a_batch_of_systems(build):
    with pytest.raises(ShapeError, match=r"no batch dimensions, got \(2,\)"):
        LCSModel.from_params(build.params(batch=(2,)))


# --- LCSParams ------------------------------------------------------------------------------------------------------


def test_params_are_a_frozen_record(build):
    params = build.params()
    with pytest.raises(dataclasses.FrozenInstanceError):
        params.A = params.A
    assert (params.n_x, params.n_u, params.n_lam) == (4, 2, 3)
    assert list(params.tensors()) == ["A", "B", "C", "d", "D", "E", "F", "c"]


def test_params_batch_shape_broadcasts_the_fields(build):
    tensors = build.lcs_tensors()
    assert LCSParams(**tensors).batch_shape == ()
    each = {**tensors, "d": tensors["d"].expand(5, 4), "F": tensors["F"].expand(2, 1, 3, 3)}
    assert LCSParams(**each).batch_shape == (2, 5)


def test_params_next_state_and_gap_are_the_equations(build):
    params, n = build.params(batch=(5,)), build.normal(1)
    x, u, lam = n(5, 4), n(5, 2), n(5, 3)
    for i in range(5):
        p = {k: v[i] for k, v in params.tensors().items()}
        torch.testing.assert_close(
            params.next_state(x, u, lam)[i], p["A"] @ x[i] + p["B"] @ u[i] + p["C"] @ lam[i] + p["d"]
        )
        torch.testing.assert_close(params.gap(x, u)[i], p["D"] @ x[i] + p["E"] @ u[i] + p["c"])
        torch.testing.assert_close(params.gap(x, u, lam)[i] - params.gap(x, u)[i], p["F"] @ lam[i])


def test_params_with_one_system_per_element_name_the_bad_one(build):
    tensors = build.lcs_tensors(batch=(4,))
    tensors["F"][2] = -torch.eye(3)
    with pytest.raises(NotPositiveDefiniteError, match=r"got smallest eigenvalue -2\.000e\+00 at batch index 2"):
        LCSParams(**tensors)


def test_params_keep_the_gradient_and_detach_drops_it(model):
    params = model.params()
    assert all(v.requires_grad for v in params.tensors().values())
    assert not any(v.requires_grad for v in params.detach().tensors().values())


# --- the actions that a model was fitted to -------------------------------------------------------------------------

SUPPORT = torch.tensor([[-0.1, -0.2], [0.05, 0.3]], dtype=torch.float64)


def test_an_action_support_is_saved_and_can_be_taken_away(tmp_path):
    model = LCSModel(4, 2, 3, action_support=SUPPORT)
    assert "action_support" not in dict(model.named_parameters())
    model.save_pretrained(tmp_path / "model")
    assert torch.equal(LCSModel.from_pretrained(tmp_path / "model").action_support, SUPPORT)
    assert torch.equal(copy.deepcopy(model).action_support, SUPPORT)
    assert model.float().action_support.dtype == torch.float32
    model.action_support = None
    model.double().save_pretrained(tmp_path / "without")
    assert LCSModel.from_pretrained(tmp_path / "without").action_support is None


@pytest.mark.parametrize(
    ("support", "error"),
    [
        (SUPPORT[0], ShapeError),
        (SUPPORT.expand(3, 2, 2), ShapeError),
        (SUPPORT[:, :1], ShapeError),
        (SUPPORT.flip(0), BoundsError),
        (SUPPORT * torch.nan, NonFiniteError),
        ([[0.0, 0.0], [1.0, 1.0]], DTypeError),
    ],
)
def test_an_action_support_that_is_none_is_refused(support, error):
    with pytest.raises(error, match=r"action_support|u_min"):
        LCSModel(4, 2, 3, action_support=support)


def test_a_file_with_a_crossed_action_support_is_refused():
    model = LCSModel(4, 2, 3, action_support=SUPPORT)
    with pytest.raises(CheckpointError, match="here: its action support"):
        LCSModel.from_config(model.config(), {**model.state_dict(), "action_support": SUPPORT.flip(0)}, "here")
