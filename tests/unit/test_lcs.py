"""LCSParams and LCSModel: the equations, their gradients, and what a module must survive."""

import copy

import pytest
import torch

from difflcs import LCSModel
from difflcs.errors import CheckpointError, InvalidInputError, ShapeError
from tests.conftest import refuse


def test_a_new_model_has_the_documented_start():
    model = LCSModel(9, 6, 5, stiffness=0.1, init_scale=1e-3)
    assert {k: tuple(v.shape) for k, v in model.named_parameters()} == {
        "A": (9, 9), "B": (9, 6), "C": (9, 5), "d": (9,), "D": (5, 9), "E": (5, 6), "G": (5, 5), "H": (5, 5), "c": (5,),
    }  # fmt: skip
    assert all(p.dtype == torch.float64 and p.requires_grad for p in model.parameters())
    assert torch.equal(model.c, torch.zeros(5, dtype=torch.float64))
    for name in set(LCSModel.parameter_names) - {"c"}:
        value = getattr(model, name).detach()
        assert 0 < float(value.abs().max()) <= 1e-3
    assert not LCSModel(9, 6, 5, learn_c=False).c.requires_grad


@pytest.mark.parametrize("stiffness", [None, 1e-3])
@pytest.mark.parametrize("n_lam", [1, 3, 6])
def test_from_params_round_trip(build, stiffness, n_lam):
    params = build.params(seed=4, n_lam=n_lam)
    kept = {k: v.clone() for k, v in params.tensors().items()}
    model = LCSModel.from_params(params, stiffness)
    for name, value in model.params().detach().tensors().items():
        torch.testing.assert_close(value, kept[name], rtol=1e-12, atol=1e-13)
    assert all(p.requires_grad for p in model.parameters())
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1.0)
    assert all(torch.equal(v, kept[k]) for k, v in params.tensors().items())
    if stiffness is not None:
        assert model.stiffness == stiffness


def test_from_params_refuses_what_no_model_represents(build):
    params = build.params(seed=4)
    smallest = float(torch.linalg.eigvalsh(0.5 * (params.F + params.F.T))[0])
    with pytest.raises(InvalidInputError, match=rf"less than the smallest eigenvalue {smallest:.3e}.*got 1000"):
        LCSModel.from_params(params, stiffness=1000.0)
    refuse(ShapeError, r"no batch dimensions, got \(2,\)", LCSModel.from_params, build.params(batch=(2,)))


SUPPORT = torch.tensor([[-0.1, -0.2], [0.05, 0.3]], dtype=torch.float64)


def test_an_action_support_is_saved_and_can_be_taken_away(tmp_path):
    model = LCSModel(4, 2, 3, action_support=SUPPORT)
    assert "action_support" not in dict(model.named_parameters())
    model.save_pretrained(tmp_path / "model")
    refuse(InvalidInputError, "expected a place to write", model.save_pretrained, tmp_path / "model" / "config.json")
    assert torch.equal(LCSModel.from_pretrained(tmp_path / "model").action_support, SUPPORT)
    assert torch.equal(copy.deepcopy(model).action_support, SUPPORT)
    assert model.float().action_support.dtype == torch.float32
    model.action_support = None
    model.double().save_pretrained(tmp_path / "without")
    assert LCSModel.from_pretrained(tmp_path / "without").action_support is None


def test_a_file_with_a_crossed_action_support_is_refused():
    model = LCSModel(4, 2, 3, action_support=SUPPORT)
    with pytest.raises(CheckpointError, match="here: its action support"):
        LCSModel.from_config(model.config(), {**model.state_dict(), "action_support": SUPPORT.flip(0)}, "here")
