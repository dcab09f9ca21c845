"""LCSParams and LCSSequence as records that behave like tensors, and what counts as an LCSModule."""

import pytest
import torch

from difflcs import LCSModel, LCSParams, LCSSequence, solve_lcp
from difflcs.errors import (
    BatchIndexError,
    DiffLCSError,
    DTypeError,
    InvalidInputError,
    NonFiniteError,
    NotPositiveDefiniteError,
    ShapeError,
)
from tests.conftest import refuse

NAMES = ["A", "B", "C", "d", "D", "E", "F", "c"]


def sequence_tensors(build, horizon=5, batch=()):
    """Matrices of all stages, each stage another system."""
    return build.lcs_tensors(seed=7, batch=(*batch, horizon))


@pytest.fixture
def sequence(build):
    return LCSSequence(**sequence_tensors(build))


def assert_same(left, right):
    assert type(left) is type(right)
    for name in NAMES:
        assert torch.equal(getattr(left, name), getattr(right, name)), name


def test_to_changes_the_dtype_of_every_field_and_keeps_the_gradient(build):
    model = build.model(seed=1)
    narrow = model.params().to(torch.float32)
    assert all(v.dtype == torch.float32 for v in narrow.tensors().values())
    torch.cat([v.reshape(-1) for v in narrow.tensors().values()]).sum().backward()
    assert all(p.grad is not None for p in model.parameters())
    params = build.params()
    assert params.to(torch.float64).A is params.A
    assert params.to("cpu", torch.float32, copy=True).A.dtype == torch.float32


@pytest.mark.parametrize("index", [2, -1, slice(1, 3), torch.tensor([3, 0]), [1, 1], torch.tensor([True, False] * 2)])
def test_an_index_is_one_of_the_batch_of_every_field_that_has_it(build, index):
    tensors = build.lcs_tensors(batch=(4,))
    tensors["A"], tensors["c"] = tensors["A"][0], tensors["c"][0]
    found = LCSParams(**tensors)[index]
    for name, value in tensors.items():
        assert torch.equal(getattr(found, name), value if name in "Ac" else value[index]), name
    assert found.A is tensors["A"]


@pytest.mark.parametrize("index", [1, (1, 2), (slice(None), 0), (..., 3), (0, [1, 2]), (None, 1)])
def test_broadcast_batches_are_indexed_as_if_they_were_expanded(build, index):
    tensors = build.lcs_tensors()
    own = {name: tuple(v.shape) for name, v in tensors.items()}
    tensors["d"] = build.normal(1)(4, 4)  # batch (4,)
    tensors["C"] = build.normal(2)(2, 1, 4, 3)  # batch (2, 1)
    found = LCSParams(**tensors)[index]
    for name in "dC":
        whole = tensors[name].expand(2, 4, *own[name])
        picked = torch.arange(8).reshape(2, 4)[index]
        expected = whole.reshape(8, *own[name])[picked]
        assert torch.equal(getattr(found, name), expected), name
    assert found.A.shape == (4, 4)


def test_one_system_has_no_index(build, sequence):
    for record in (build.params(), sequence):
        message = r"expected an index of a batch dimension, got int 0 where every field is shared.*; build it from"
        with pytest.raises(IndexError, match=message) as caught:
            record[0]
        assert isinstance(caught.value, DiffLCSError)
        refuse(BatchIndexError, message, list, record)


@pytest.mark.parametrize("index", [4, -5, (0, 0), (0, ..., 0), torch.tensor([4]), "A", 1.0, torch.tensor([True] * 3)])
def test_an_index_that_is_none_of_the_batch_is_refused(build, index):
    match = r"expected an index of the batch dimensions \(4,\), got .*; index the"
    for record in (build.params(batch=(4,)), LCSSequence(**sequence_tensors(build, batch=(4,)))):
        refuse(BatchIndexError, match, record.__getitem__, index)


def test_a_step_broadcasts_systems_states_and_actions(build):
    params, n = build.params(batch=(3, 1)), build.normal(1)
    x, u = n(4), n(5, 2)
    x_next, lam = params.step(x, u)
    assert x_next.shape == (3, 5, 4)
    assert lam.shape == (3, 5, 3)
    torch.testing.assert_close(x_next[2, 4], params[2, 0].step(x, u[4]).x_next)
    assert params.rollout(x, n(5, 7, 2)).shape == (3, 5, 8, 4)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_a_rollout_through_stages_takes_each_in_its_turn(build, batch):
    sequence, n = LCSSequence(**sequence_tensors(build, 5, batch)), build.normal(6)
    x0, u = n(3, 4), 0.3 * n(5, 2)
    xs = sequence.rollout(x0, u)
    assert xs.shape == (3, 6, 4)
    x = x0
    for k in range(5):
        x = sequence.stage(k).step(x, u[k]).x_next
        assert torch.equal(xs[:, k + 1], x)
    # All stages at once are what each is.
    lam = torch.stack([solve_lcp(sequence.stage(k).F, sequence.stage(k).gap(xs[:, k], u[k])).lam for k in range(5)], 1)
    torch.testing.assert_close(sequence.next_state(xs[:, :5], u, lam), xs[:, 1:])


def test_a_stack_broadcasts_each_field_over_its_batch(build):
    shared, each = build.params(seed=1), build.params(seed=2, batch=(3,))
    mixed = LCSParams(**{**each.tensors(), "A": each.A[0]})
    sequence = LCSSequence.stack([shared, mixed])
    assert sequence.A.shape == (2, 4, 4)
    assert sequence.c.shape == (3, 2, 3)
    assert sequence.batch_shape == (3,)
    for i in range(3):
        assert_same(sequence[i].stage(0), shared)
        assert_same(sequence[i].stage(1), mixed[i])
    assert sequence[1:].batch_shape == (2,)
    assert sequence[1:].horizon == 2


def test_a_stack_refuses_what_does_not_fit(build):
    refuse(InvalidInputError, "expected at least one LCSParams, got none; give", LCSSequence.stack, [])
    with pytest.raises(DTypeError, match=r"systems\[1\]: expected LCSParams, got LCSModel.*; build"):
        LCSSequence.stack([build.params(), build.model()])
    with pytest.raises(ShapeError, match=r"systems\[1\]: expected .*\(4, 2, 3\) like .*, got \(4, 2, 2\); a contact"):
        LCSSequence.stack([build.params(), build.params(n_lam=2)])
    with pytest.raises(ShapeError, match=r"systems\[1\].A: its batch dimensions \(2,\).*systems\[0\].A \(3,\)"):
        LCSSequence.stack([build.params(batch=(3,)), build.params(batch=(2,))])


@pytest.mark.parametrize("k", [5, -6])
def test_there_is_no_stage_beyond_the_horizon(sequence, k):
    refuse(BatchIndexError, rf"k: expected a stage of 0 … 4, got {k}; choose", sequence.stage, k)
    refuse(DTypeError, "k: expected an int", sequence.stage, 1.0)


@pytest.mark.parametrize("name", NAMES)
def test_every_field_needs_its_stages(build, name):
    tensors = sequence_tensors(build)
    short = {**tensors, name: tensors[name][:4]}
    match = "expected shape" if name == "A" else rf"{name}: expected shape \(\.\.\., H=5, .*, got \(4, .*; reshape"
    refuse(ShapeError, match, LCSSequence, **short)
    with pytest.raises(ShapeError, match=rf"{name}: expected a (matrix|vector) \(\.\.\., H, .*; add the missing"):
        LCSSequence(**{**tensors, name: tensors[name][0]})


def test_a_sequence_has_a_stage(build):
    with pytest.raises(ShapeError, match=r"expected at least one stage, got .*; give"):
        LCSSequence(**{k: v[:0] for k, v in sequence_tensors(build).items()})


def test_the_numbers_of_every_stage_are_checked(build):
    tensors = sequence_tensors(build, 3, (2,))
    tensors["F"][1, 2] = -torch.eye(3)
    with pytest.raises(NotPositiveDefiniteError, match=r"got smallest eigenvalue -2\.000e\+00 at batch index \(1, 2\)"):
        LCSSequence(**tensors)
    tensors = sequence_tensors(build, 3)
    tensors["E"][2, 0, 0] = torch.nan
    refuse(NonFiniteError, r"E: expected finite numbers, got 1 .* at index \(2, 0, 0\)", LCSSequence, **tensors)


def test_a_sequence_wants_one_action_a_stage(build, sequence):
    n = build.normal(0)
    with pytest.raises(ShapeError, match=r"u_seq: expected shape \(\.\.\., T=5, n_u=2\), got \(4, 2\); give one"):
        sequence.rollout(n(4), n(4, 2))
    with pytest.raises(ShapeError, match=r"x0: its batch dimensions|u_seq: its batch dimensions \(2,\).*x0 \(3,\)"):
        sequence.rollout(n(3, 4), n(2, 5, 2))


def test_a_model_without_contacts_is_kept_and_learns(build, tmp_path):
    model, n = build.model(n_lam=0), build.normal(0)
    x, u = n(6, 4), n(6, 2)
    model(x, u).x_next.square().sum().backward()
    assert all(float(getattr(model, k).grad.abs().max()) > 0 for k in "ABd")
    assert all(p.grad is not None for p in model.parameters())
    model.save_pretrained(tmp_path)
    again = LCSModel.from_pretrained(tmp_path)
    assert again.n_lam == 0
    assert torch.equal(again(x, u).x_next, model(x, u).x_next)
    assert torch.equal(LCSModel.from_params(model.params())(x, u).x_next, model(x, u).x_next)
    assert LCSModel.from_params(model.params(), stiffness=0.7).stiffness == 0.7
