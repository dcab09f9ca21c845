"""The report on a fit, on systems whose answer is known, and transitions from episodes and logs."""

import numpy as np
import pytest
import torch

from difflcs import LCSModel, Transitions, fit_report
from difflcs.errors import DTypeError, InvalidInputError, NonFiniteError, ShapeError
from difflcs.systems import cart_pole_between_walls
from tests.conftest import linear_system, refuse


def play(system, count=12, length=15, seed=0):
    random = np.random.default_rng(seed)
    u = torch.from_numpy(random.normal(0, 3, (count, length, 1)))
    x0 = torch.from_numpy(random.normal(size=(count, 4)) * (0.05, 0.15, 0.2, 0.3))
    return Transitions.from_episodes(system.rollout(x0, u), u)


def test_the_system_that_made_the_data_has_no_error_and_needs_every_contact():
    system = cart_pole_between_walls()
    data = play(system)
    for each in (system, LCSModel.from_params(system)):
        report = fit_report(each, *data, horizon=16)
        assert report.error.max() < 1e-9
        assert report.linear[3] > 0.05  # the walls turn the pole
        assert (report.without > 10).all()
        lam = system.step(data.x, data.u).lam
        torch.testing.assert_close(report.acts, (lam > 1e-9).double().mean(0))
        assert torch.equal(report.gain > 1e-12, lam > 1e-9)  # each force explains the data in which it acts
        assert report.rollout[:15, 0].max() < 1e-9
        assert report.rollout[15].isnan().all()  # no episode has 16 steps
    assert str(report).splitlines()[4].split()[2:] == ["0.000", f"{report.linear[3]:.3f}"]
    assert "acts in" in str(report)
    assert len(report.plot().axes) == 3


def test_a_system_without_contacts_is_judged_beside_the_affine_one():
    truth, data = cart_pole_between_walls(), play(cart_pole_between_walls())
    report = fit_report(linear_system(truth.A, truth.B, truth.d), *data)
    assert report.gain.shape == (len(data.x), 0)
    assert (report.linear <= report.error + 1e-12).all()  # least squares on these very data
    still = (data.x_next - data.x).square().mean(0).sqrt()
    torch.testing.assert_close(report.step, still)
    spread = data.x.std(0, correction=0)
    torch.testing.assert_close(report.rollout[0, 2], (still / spread).square().mean().sqrt())


def test_rollouts_stay_within_their_episodes():
    data = play(cart_pole_between_walls())
    backwards = fit_report(cart_pole_between_walls(), *(v.flip(0) for v in data), horizon=3)  # no row follows another
    assert not backwards.rollout[0].isnan().any()
    assert backwards.rollout[2].isnan().all()


def test_a_log_and_its_episodes_are_the_same_transitions():
    random = np.random.default_rng(0)
    states = [random.normal(size=(n + 1, 2)) for n in (3, 1, 4)]
    actions = [random.normal(size=(n, 1)) for n in (3, 1, 4)]
    data = Transitions.from_episodes(states, [torch.from_numpy(u) for u in actions])
    assert data.x.shape == (8, 2)
    assert torch.equal(data.x_next[2], torch.from_numpy(states[0][3]))
    log = np.concatenate(states), np.concatenate([[*u, [9.0]] for u in actions]), np.repeat([7, 3, 7], (4, 2, 5))
    for found, expected in zip(Transitions.from_episodes(*log), data, strict=True):
        assert torch.equal(found, expected)
    fit, test = data.split(0.3, seed=1)
    assert len(fit.x) + len(test.x) == 8
    assert len(test.x) in (1, 3, 4)  # a whole episode
    assert not set(fit.x[:, 0].tolist()) & set(test.x[:, 0].tolist())


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda d: Transitions.from_episodes([np.ones((3, 2))], [np.ones((3, 1))]), ShapeError, "one state more"),
        (lambda d: Transitions.from_episodes([np.full((3, 2), np.nan)], [np.ones((2, 1))]), NonFiniteError, "states"),
        (lambda d: Transitions.from_episodes([], []), InvalidInputError, "at least one transition"),
        (lambda d: Transitions.from_episodes(np.ones((3, 2)), np.ones((3, 1)), [0, 0]), ShapeError, "one number"),
        (lambda d: Transitions.from_episodes(np.ones((2, 2)), np.ones((2, 1)), [0, np.nan]), NonFiniteError, "episode"),
        (lambda d: Transitions(*(v[:3] for v in d)).split(), InvalidInputError, "at least two episodes"),
        (lambda d: fit_report(cart_pole_between_walls(), d.x, d.u[1:], d.x_next), ShapeError, "same N"),
        (lambda d: fit_report(cart_pole_between_walls(), d.x, d.u.float(), d.x_next), DTypeError, "u: expected"),
        (lambda d: fit_report(cart_pole_between_walls(), *d, horizon=0), InvalidInputError, "horizon"),
        (lambda d: Transitions.from_episodes([d.x, d.x], [d.u[1:]]), ShapeError, "actions: expected 2 episodes"),
        (lambda d: Transitions.from_episodes([d.x, d.u], [d.u[1:], d.u[1:]]), ShapeError, r"states\[1\]: .*n=4"),
        (lambda d: Transitions.from_episodes([["a"], ["b"]], [[1.0]]), DTypeError, "states: expected real numbers"),
        (lambda d: Transitions.from_episodes([[[1.0, 2.0], [1.0]]], [[[1.0]]]), DTypeError, "states: expected numbers"),
        (lambda d: d.split(seed=-1), InvalidInputError, "seed: expected at least 0"),
        (lambda d: fit_report(LCSModel(4, 1, 2, dtype=torch.float32), *d), DTypeError, "float32 like the system"),
        (lambda d: fit_report(cart_pole_between_walls(), *d, train=d[:2]), InvalidInputError, "train: expected x, u"),
        (lambda d: fit_report(cart_pole_between_walls(), *d, train=(d.x, d.u[1:], d.x)), ShapeError, "train u: .*N="),
        (
            lambda d: fit_report(cart_pole_between_walls(), *d, train=(d.x, d.u * np.nan, d.x)),
            NonFiniteError,
            "train u",
        ),
    ],
)
def test_bad_input(call, error, message):
    refuse(error, message, call, play(cart_pole_between_walls(), 2))
