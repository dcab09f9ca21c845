"""Sampling-based contact MPC: where to push, when to travel, and how the loop closes on a small planar system."""

import math

import numpy as np
import pytest
import torch

from difflcs import GoalCost, LCSMPCLayer, LCSParams
from difflcs.errors import DTypeError, InvalidInputError, NonFiniteError, ShapeError
from difflcs.physics import PlanarPushing, box
from difflcs.planning import DiscPlaces, Mode, PlanarTravel, SamplingPolicy, SamplingSettings, Workspace
from tests.conftest import F64, refuse, tensor

RADIUS = 0.1
BLOCK = box(-0.5, 0.5, -0.5, 0.5)


class Line:
    """A block on a line, pushed from the left or from the right; state (block, pusher), the pusher goes by u.

    The block is half a unit long to each side. Contact is linearised where the pusher is: 0 ≤ λ ⊥ gap ≥ 0.
    """

    n_x, n_u, n_lam = 2, 1, 1

    def params(self, x, context=None):
        side = torch.sign(x[..., 1] - x[..., 0])  # the pusher is on the right: +1
        one, zero = torch.ones_like(side), torch.zeros_like(side)
        D = torch.stack([-side, side], -1).unsqueeze(-2)  # gap = side (pusher − block) − ½
        return LCSParams(
            A=torch.eye(2, dtype=F64),
            B=tensor([[0.0], [1.0]]),
            C=torch.stack([-side, zero], -1).unsqueeze(-1),
            d=torch.zeros(2, dtype=F64),
            D=D,
            E=side[..., None, None],
            F=1.001 * one[..., None, None],
            c=-0.5 * one.unsqueeze(-1),
        )


class Sides:
    """Places right and left of the block."""

    def __init__(self, allowed=(True, True)):
        self.open = torch.tensor([True, *allowed])

    def sample(self, x):
        return tensor([[0.51], [-0.51]])

    def states(self, x, places):
        return torch.cat([x[:1].expand(len(places), 1), x[0] + places], 1)

    def allowed(self, states):
        return self.open

    def near(self, x):
        return True


class Jump:
    """Travel in one step."""

    def distance(self, x, states):
        return (states[:, 1] - x[1]).abs()

    def action(self, x, target):
        return target[1:] - x[1:]

    def arrived(self, x, target):
        return bool((target[1] - x[1]).abs() < 1e-3)


def on_a_line(places=None, kind=None, **settings):
    cost = GoalCost.reach(2, 1, goal_weight=(1.0,), input_weight=1e-3)
    mpc = LCSMPCLayer(Line(), cost if kind is None else kind(cost), 4, -0.2, 0.2, relaxation=1e-6, on_failure="mask")
    return SamplingPolicy(mpc, places or Sides(), Jump(), SamplingSettings(**settings))


def pushing(workspace=None):
    """A block pushed by a disc, a policy for it."""
    system = PlanarPushing(BLOCK, RADIUS, friction=0.3, compliance=0.02)
    cost = GoalCost.reach(5, 2, goal_weight=(1.0, 1.0, 0.3), input_weight=0.02)
    mpc = LCSMPCLayer(system, cost, 6, -0.2, 0.2, relaxation=1e-4, on_failure="mask")
    places = DiscPlaces(BLOCK, RADIUS, 24, workspace=workspace)
    travel = PlanarTravel(BLOCK, RADIUS, 0.4, workspace=workspace)
    return system, SamplingPolicy(mpc, places, travel, SamplingSettings(travel_price=0.02), angles=(2,))


def move(system, x, u, parts=10):
    """One step in parts, each with contact where it is by then: one part alone takes surfaces for endless planes."""
    for _ in range(parts):
        x = system.params(x).step(x, u / parts).x_next
    return x


def play(system, policy, x, goal, steps, watch=None):
    """The loop, closed on the system itself; ends where the body is at the goal."""
    x = tensor(x)
    policy.reset()
    for step in range(steps):
        u = torch.from_numpy(policy.act(x, goal))
        if watch is not None:
            watch(x, policy.decision)
        x = move(system, x, u)
        if error(x, goal) < 0.03:
            return x, step + 1
    return x, steps


def error(x, goal):
    turn = math.remainder(float(x[2]) - goal[2], 2 * math.pi)
    return math.hypot(float(x[0]) - goal[0], float(x[1]) - goal[1], 0.5 * turn)


# --- one step, on a line ----------------------------------------------------------------------------------------------


def test_it_travels_where_the_pusher_is_on_the_wrong_side_and_pushes_from_there():
    policy, x = on_a_line(), tensor([0.0, 0.51])
    u = policy.act(x, [1.0])
    decision = policy.decision
    assert (decision.mode, decision.began, decision.chosen) == (Mode.TRAVEL, True, 2)
    assert decision.gain < 0.02 < float(decision.gains[2]) / decision.standing
    x[1] += float(u[0])
    torch.testing.assert_close(x, decision.target)
    u = policy.act(x, [1.0])
    assert (policy.decision.mode, policy.decision.began, policy.decision.target) == (Mode.PUSH, False, None)
    assert u[0] > 0.15


@pytest.mark.parametrize("asked", [False, True])
def test_the_cost_of_standing_still_and_what_a_plan_saves_are_those_of_the_mpc(build, asked):
    policy = on_a_line(kind=build.AskedCost if asked else None)
    policy.act([0.2, -0.31], [1.0])
    decision = policy.decision
    assert decision.standing == pytest.approx(5 * 0.8**2)  # four stages and the last
    torch.testing.assert_close(decision.gains, decision.standing - decision.solution.objective)
    assert decision.gain == pytest.approx(float(decision.gains[0]) / decision.standing)


@pytest.mark.parametrize("right", [True, False])
def test_a_place_that_is_not_allowed_is_not_chosen(right):
    policy = on_a_line(Sides(allowed=(right, False)))
    u = policy.act([0.0, 0.51], [1.0])
    assert policy.decision.chosen != 2
    assert float(policy.decision.scores[2]) == -math.inf
    assert policy.decision.mode is Mode.PUSH
    assert np.isfinite(u).all()


def test_a_journey_ends_after_its_patience():
    class Never(Jump):
        def action(self, x, target):
            return torch.zeros(1, dtype=F64)

    policy = on_a_line(patience=3)
    policy.travel = Never()
    modes = []
    for _ in range(9):
        policy.act([0.0, 0.51], [1.0])
        modes.append(policy.decision.mode)
    # The one place that promises anything is then barred for a step, as nothing has come of it.
    assert modes == [Mode.TRAVEL] * 4 + [Mode.PUSH] * 2 + [Mode.TRAVEL] * 3


def test_a_place_from_which_nothing_moved_is_left_for_the_next_best():
    class Two(Sides):
        def sample(self, x):
            return tensor([[-0.51], [-0.53]])

    policy = on_a_line(Two())
    targets = []
    for _ in range(2):  # the block is stuck, whatever is planned
        policy.act([0.0, 0.51], [1.0])
        targets.append(round(float(policy.decision.target[1]), 2))
        policy.act([0.0, targets[-1]], [1.0])
        assert policy.decision.mode is Mode.PUSH
    assert targets == [-0.51, -0.53]


def test_where_pushes_move_nothing_the_robot_looks_for_another_place():
    policy, modes = on_a_line(), []
    for _ in range(7):  # a push from here promises much, but the block is stuck
        policy.act([0.0, -0.51], [1.0])
        modes.append(policy.decision.mode)
    assert modes[:3] == [Mode.PUSH] * 3
    assert Mode.TRAVEL in modes[3:]


def test_what_was_barred_is_open_again_when_the_cost_has_changed():
    policy = on_a_line()
    policy.act([0.0, 0.51], [1.0])
    policy.act([0.0, -0.51], [1.0])
    policy.act([0.0, 0.51], [2.0])
    assert policy.decision.mode is Mode.TRAVEL
    assert float(policy.decision.target[1]) == pytest.approx(-0.51)


@pytest.mark.parametrize(("keep", "mode"), [(0.0, Mode.PUSH), (1.0, Mode.TRAVEL)])
def test_hysteresis_says_when_a_better_place_is_worth_a_journey(keep, mode):
    # From where the pusher is, three tenths away from the block, a plan gains less than from the place beside it.
    policy = on_a_line(keep=keep, switch_price=0.0)
    policy.act([0.0, -0.8], [1.0])
    decision = policy.decision
    assert 0.02 < decision.gain < float(decision.scores.max()) / decision.standing
    assert decision.mode is mode


def test_the_price_of_the_way_is_taken_from_the_gain():
    policy = on_a_line(switch_price=0.1, travel_price=0.25)
    policy.act([0.0, 0.51], [1.0])
    decision = policy.decision
    assert decision.standing == pytest.approx(5.0)
    torch.testing.assert_close(decision.gains[1:] - decision.scores[1:], 5.0 * (0.1 + 0.25 * tensor([0.0, 1.02])))
    assert float(decision.gains[0]) == float(decision.scores[0])


def test_what_is_not_solved_is_not_chosen():
    policy = on_a_line()
    policy.act([0.0, 0.51], [1.0])
    solution = policy.decision.solution
    assert bool(solution.converged.all())
    policy.mpc.backend = type(policy.mpc.backend)(max_iter=1, restarts=1)
    policy.reset()
    policy.act([0.0, 0.51], [1.0])
    failed = ~policy.decision.solution.converged
    assert bool(failed.any())
    assert bool((policy.decision.gains[failed] == -math.inf).all())


# --- the loop, in the plane -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [(0.9, 0.0), (0.0, 0.9)])
def test_a_block_is_pushed_to_its_goal_from_the_wrong_side(start):
    system, policy = pushing()
    seen = []

    def watch(x, decision):
        seen.append(decision.mode)
        assert float(system.contacts(x).gap.min()) > -0.02

    goal = [0.8, 0.4, 0.3]
    x, steps = play(system, policy, [0.0, 0.0, 0.0, *start], goal, 120, watch)
    assert error(x, goal) < 0.03
    assert steps < 120
    assert {Mode.PUSH, Mode.TRAVEL} == set(seen)


def test_goals_that_mean_the_same_angle_are_the_same():
    _, policy = pushing()
    x = [0.0, 0.0, 3.0, -0.61, 0.1]
    first = policy.act(x, [0.3, 0.0, -3.1])
    policy.reset()
    np.testing.assert_allclose(first, policy.act(x, [0.3, 0.0, -3.1 + 4 * math.pi]), rtol=1e-9)
    assert policy.decision.standing < 1.0


def test_bounds_that_depend_on_the_state_hold_the_disc_in_the_workspace():
    workspace = Workspace((-1.0, -1.0), (0.3, 1.0), step=0.2)
    system, policy = pushing(workspace=workspace)
    policy.bounds = workspace.bounds
    x = tensor([0.0, 0.0, 0.0, -0.61, 0.0])
    for _ in range(30):
        x = move(system, x, torch.from_numpy(policy.act(x, [2.0, 0.0, 0.0])))
        assert bool(workspace.contains(x[3:5], margin=-1e-9))
    assert float(x[3]) > 0.25


# --- what is refused --------------------------------------------------------------------------------------------------


def test_bad_input_is_refused():
    policy = on_a_line()
    refuse(ShapeError, "x: expected", policy.act, [0.0, 0.0, 0.0], [1.0])
    refuse(ShapeError, "one robot", policy.act, [[0.0, 0.51]], [1.0])
    refuse(NonFiniteError, "x: expected", policy.act, [math.nan, 0.51], [1.0])
    refuse(ShapeError, "goal", pushing()[1].act, [0.0, 0.0, 0.0, -0.61, 0.0], [1.0, 0.0])
    mpc = LCSMPCLayer(Line(), GoalCost.reach(2, 1), 4)
    refuse(InvalidInputError, "on_failure", SamplingPolicy, mpc, Sides(), Jump())
    for wrong, match in (({"angles": (-1,)}, "angles: .*at least 0"), ({"bounds": 1.0}, "bounds: expected Callable")):
        refuse(InvalidInputError, match, SamplingPolicy, policy.mpc, Sides(), Jump(), **wrong)
    refuse(DTypeError, "places: expected Places", SamplingPolicy, policy.mpc, None, Jump())
    for wrong in (lambda: SamplingPolicy(Line(), Sides(), Jump()), lambda: policy.act(["a", 0.0], [1.0])):
        refuse(DTypeError, r"LCSMPCLayer|x: expected real numbers", wrong)


@pytest.mark.parametrize(
    "bad", [{"keep": 1.5}, {"keep": -0.1}, {"smallest_gain": math.nan}, {"travel_price": -1.0}, {"patience": 0}]
)
def test_settings_out_of_range_are_refused(bad):
    refuse(InvalidInputError, next(iter(bad)), SamplingSettings, **bad)
