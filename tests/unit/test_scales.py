"""Units suggested from data: the same whatever the units of the data, and a model learns as well in any."""

from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from difflcs import LCSModel, ScaledLCS, suggest_scales
from difflcs.errors import CheckpointError, DeviceError, DTypeError, InvalidInputError, NonFiniteError, ShapeError
from tests.conftest import refuse


@pytest.fixture
def data(build):
    """Transitions of a model, with states far from zero and of unlike sizes."""
    n = build.normal(5)
    x, u = n(200, 4), n(200, 2)
    x_next = build.model(seed=3)(x, u).x_next.detach()
    size, origin = torch.tensor([300.0, 1e-3, 1.0, 40.0]).double(), torch.tensor([1e4, -2.0, 0.0, 7.0]).double()
    return x * size + origin, 1e-2 * u, x_next * size + origin


def test_states_and_actions_are_about_one_in_the_suggested_units(data):
    scales = suggest_scales(*data)
    x, u, x_next = scales.normalise(*data)
    both = torch.cat([x, x_next])
    torch.testing.assert_close(both.mean(0), torch.zeros(4).double(), rtol=0, atol=1e-9)
    torch.testing.assert_close(both.square().mean(0), torch.ones(4).double())
    torch.testing.assert_close(u.square().mean(0), torch.ones(2).double())
    step = (x_next - x).square().mean(0).max()
    assert scales.relaxation == pytest.approx(0.05 * float(step), rel=1e-12)
    assert scales.xi == 0.01


def test_units_of_the_data_do_not_change_the_data_in_the_suggested_ones(data):
    expected = suggest_scales(*data)
    size, origin = torch.tensor([1e3, 1e-2, 57.3, 2.0]).double(), torch.tensor([5.0, 0.1, -1.0, 0.0]).double()
    x, u, x_next = data
    other = size * (x + origin), 0.3 * u, size * (x_next + origin)
    found = suggest_scales(*other)
    torch.testing.assert_close(found.state, size * expected.state)
    torch.testing.assert_close(found.action, 0.3 * expected.action)
    torch.testing.assert_close(found.center, size * (expected.center + origin))
    assert found.xi == expected.xi
    assert found.relaxation == pytest.approx(expected.relaxation, rel=1e-9)
    for left, right in zip(found.normalise(*other), expected.normalise(*data), strict=True):
        torch.testing.assert_close(left, right, rtol=1e-8, atol=1e-8)


def test_a_state_that_never_changes_and_an_action_that_is_never_used_keep_their_unit(data):
    x, u, x_next = (v.clone() for v in data)
    x[:, 1] = x_next[:, 1] = 0.1
    u[:, 0] = 0
    scales = suggest_scales(x, u, x_next)
    assert float(scales.state[1]) == 1
    assert float(scales.action[0]) == 1
    assert float(scales.center[1]) == pytest.approx(0.1)
    assert all(bool(torch.isfinite(v).all()) for v in scales.normalise(x, u, x_next))


@pytest.mark.parametrize("batch", [(), (200,)])
def test_a_system_that_is_brought_back_predicts_the_same_in_the_units_of_the_data(build, data, batch):
    scales = suggest_scales(*data)
    inner = build.params(seed=3, batch=batch)
    x, u, _ = scales.normalise(*data)
    expected = inner.step(x, u)
    found = scales.params(inner).step(*data[:2])
    assert 10 < int((expected.lam > 0).sum()) < 500
    torch.testing.assert_close(scales.states(found.x_next), expected.x_next, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(found.lam, expected.lam, rtol=1e-7, atol=1e-7)
    assert torch.equal(scales.params(inner).F, inner.F)


def test_a_scaled_module_predicts_and_is_saved_with_its_scales(build, data, tmp_path):
    x, u, _ = data
    scaled = ScaledLCS(build.model(seed=3), suggest_scales(*data))
    found = scaled.rollout(x[:5], u[:15].reshape(5, 3, 2))
    torch.testing.assert_close(found[:, 1], scaled.params().step(x[:5], u[:15].reshape(5, 3, 2)[:, 0]).x_next)
    scaled.save_pretrained(tmp_path / "it")
    read = ScaledLCS.from_pretrained(tmp_path / "it")
    assert torch.equal(read(x, u).x_next, scaled(x, u).x_next)
    assert (read.scales.xi, read.scales.relaxation) == (scaled.scales.xi, scaled.scales.relaxation)
    refuse(CheckpointError, "ScaledLCS", LCSModel.from_pretrained, tmp_path / "it")
    refuse(DTypeError, "lcs: expected LCSModel", ScaledLCS(scaled, scaled.scales).save_pretrained, tmp_path / "other")
    scaled.lcs.A.data[0, 0] = torch.nan
    for diverged in (scaled, scaled.lcs):
        refuse(NonFiniteError, "A: expected finite numbers, got 1", diverged.save_pretrained, tmp_path / "it")
    assert torch.equal(ScaledLCS.from_pretrained(tmp_path / "it")(x, u).x_next, read(x, u).x_next)


def test_a_state_dict_of_another_system_with_the_same_parameters_is_refused(data):
    of = [suggest_scales(*data), suggest_scales(*(2 * value + 1 for value in data))]
    saved, other, stiff = (
        ScaledLCS(LCSModel(4, 2, 3, f), scales) for f, scales in ((0.1, of[0]), (0.1, of[1]), (0.2, of[0]))
    )
    saved.load_state_dict(saved.state_dict())
    with pytest.raises(RuntimeError, match=r"scales\.state: expected .* like this ScaledLCS, got .*; build it with"):
        other.load_state_dict(saved.state_dict())
    with pytest.raises(RuntimeError, match=r"lcs\.stiffness: expected 0.2 like this LCSModel, got 0.1 of"):
        stiff.load_state_dict(saved.state_dict())
    stiff.load_state_dict(dict(saved.state_dict()))


def test_a_scaled_module_asks_with_states_in_its_own_units(build, data):
    scales, lcs, context = suggest_scales(*data), LCSModel(4, 2, 3), torch.ones(2)
    lcs.params = Mock(wraps=lcs.params)
    scaled = ScaledLCS(lcs, scales)
    scaled.params(data[0], context)
    scaled.params()
    (x, given), nothing = (call.args for call in lcs.params.call_args_list)
    torch.testing.assert_close(x, scales.normalise(*data)[0])
    assert given is context
    assert nothing == (None, None)


@pytest.mark.parametrize("name", ["x", "u", "x_next"])
def test_transitions_that_cannot_be_used_are_refused(data, name):
    good = dict(zip(("x", "u", "x_next"), data, strict=True))

    def refused(error, match, value):
        refuse(error, match, suggest_scales, **{**good, name: value})

    refused(DTypeError, f"{name}: expected float32 or float64, got .*int64.*; convert", good[name].long())
    refused(DTypeError, rf"{name}: expected a torch.Tensor, got list.*; wrap", [*map(str, good[name][:, 0].tolist())])
    refused(DeviceError, f"{name}: expected a tensor with data.*; move", good[name].to("meta"))
    bad = good[name].clone()
    bad[3, 1] = torch.nan
    refused(NonFiniteError, rf"{name}: expected finite numbers, got 1 .* at index \(3, 1\).*; find", bad)
    refused(InvalidInputError, rf"{name}: expected shape \(\.\.\., n\) of many.*; give a batch", good[name][0])
    refused(ShapeError, "batch dimensions .* do not fit the others", good[name][:7])


def test_too_little_data_and_states_that_never_move_are_refused(data):
    x, u, x_next = data
    with pytest.raises(InvalidInputError, match="expected at least two transitions, got 1; give more data"):
        suggest_scales(x[:1], u[:1], x_next[:1])
    refuse(InvalidInputError, "x_next: expected states that change, got x itself; give", suggest_scales, x, u, x)
    refuse(ShapeError, r"x_next: expected shape \(\.\.\., n_x=4\), got \(200, 3\)", suggest_scales, x, u, x_next[:, :3])


def test_systems_and_data_of_other_sizes_are_refused(build, data):
    scales = suggest_scales(*data)
    with pytest.raises(InvalidInputError, match=r"params: expected n_x=4 and n_u=2 like the data.*got 3 and 2; ask"):
        scales.params(build.params(n_x=3))
    with pytest.raises(ShapeError, match=r"u: expected shape \(\.\.\., n_u=2\), got \(200, 4\)"):
        scales.normalise(data[0], data[0], data[2])
    with pytest.raises(ShapeError, match=r"x_next: expected shape \(\.\.\., n_x=4\), got \(200, 2\)"):
        scales.normalise(*data[:2], data[1])
    assert torch.equal(replace(scales, state=scales.state.numpy()).states(data[0]), scales.states(data[0]))


@pytest.mark.parametrize(
    ("wrong", "error", "match"),
    [
        (lambda s: replace(s, state=-s.state), InvalidInputError, "state: expected units above 0"),
        (lambda s: replace(s, center=s.center[1:]), ShapeError, "state: expected a number for each"),
        (lambda s: s.params(s), DTypeError, "params: expected LCSParams"),
        (lambda s: ScaledLCS(s, s), DTypeError, "lcs: expected LCSModule"),
        (lambda s: LCSModel.from_params(None), DTypeError, "params: expected LCSParams"),
    ],
)
def test_what_is_not_meant_is_refused(data, wrong, error, match):
    refuse(error, match, wrong, suggest_scales(*data))
