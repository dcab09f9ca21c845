"""The PDDM baseline: ensemble, planner, training, on a system that needs no simulator."""

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from difflcs import GoalCost
from difflcs.errors import InvalidInputError
from difflcs.rl.learning.dynamics import Ensemble, EnsembleSettings
from difflcs.rl.learning.pddm import PDDM, PDDMSettings, Planner
from difflcs.rl.runs.evaluate import evaluate
from difflcs.rl.settings import Epochs, Rollouts
from tests.conftest import refuse
from tests.training.slide import STEPS, U_MAX, make_envs

NETWORKS = EnsembleSettings(networks=2, width=16, epochs=Epochs(20, 20, 16), learning_rate=1e-3)
SMALL = PDDMSettings(rollouts=Rollouts(first=10, each=5), ensemble=NETWORKS, horizon=3, samples=80)


def make_cost() -> GoalCost:
    return GoalCost.reach(1, 1, goal_weight=(200.0,), input_weight=0.01)


def make_pddm(total: int = 25, **changes) -> PDDM:
    return PDDM(make_cost(), make_envs(10), replace(SMALL, **changes), 0, total_episodes=total, episode_steps=STEPS)


def test_pddm_learns_to_reach():
    trainer = make_pddm(total=20)
    env = make_envs(20)
    before = evaluate(env, trainer.policy, 40, 0, STEPS).success_rate
    reports = []
    while trainer.env_steps < 20 * STEPS:
        reports.append(trainer.step())
    assert before < 0.5
    assert evaluate(env, trainer.policy, 40, 0, STEPS).success_rate > 0.9
    assert [report.env_steps for report in reports] == [60, 90, 120]
    refuse(InvalidInputError, "all of them are done", trainer.step)


@pytest.mark.parametrize(("n_x", "n_u", "networks", "width"), [(2, 1, 1, 15), (3, 2, 2, 16), (9, 6, 3, 31)])
def test_a_rollout_is_one_step_after_the_other(n_x, n_u, networks, width):
    draws = torch.Generator().manual_seed(0)
    ensemble = Ensemble(n_x, n_u, networks, width, draws)
    # Far from zero and narrow, so that means and scales matter.
    x = 30 + 0.01 * torch.randn(200, n_x, generator=draws, dtype=torch.float64)
    u = 5 + 0.1 * torch.randn(200, n_u, generator=draws, dtype=torch.float64)
    ensemble.fit(x, u, x + 0.02 * (u[:, :1] - 5), epochs=3, minibatch=20, learning_rate=1e-2, generator=draws)
    actions = u[:60].float().view(20, 3, n_u)
    found = ensemble.rollout(x[0].float(), actions)
    state = x[0].float().expand(networks, 20, n_x)
    torch.testing.assert_close(found[:, :, 0], state)
    with torch.no_grad():
        for t in range(3):
            after = ensemble(found[:, :, t], actions[:, t].expand(networks, -1, -1))
            torch.testing.assert_close(found[:, :, t + 1], after, rtol=0, atol=1e-5)  # 30 has neighbours 2e-6 away
            assert float((after - found[:, :, t]).abs().amax()) > 1e-3
    assert not found.requires_grad


class Exact(Ensemble):
    """x₊ = x + u, exactly."""

    def rollout(self, x0, u):
        states = torch.cat([x0.expand(len(u), 1, -1), x0 + u.cumsum(1)], 1)
        return states.expand(self.networks, *states.shape)


def planner(cost: GoalCost | None = None, **changes) -> Planner:
    bound = torch.full((1,), U_MAX, dtype=torch.float64)
    return Planner(Exact(1, 1, 2, 4), cost or make_cost(), replace(SMALL, **changes), -bound, bound)


@pytest.mark.parametrize("asked", [False, True])
def test_costs_are_those_of_the_mpc(build, asked):
    """The plan is the mean of the sequences it tried, weighted by the objective written out."""
    cost = build.AskedCost(make_cost()) if asked else make_cost()
    plan = planner(cost, kappa=0.02)  # so that more than the best sequence counts
    plan.ensemble.rollout = Mock(wraps=plan.ensemble.rollout)
    x0, goal = torch.tensor([[0.2]], dtype=torch.float64), torch.tensor([[-0.3]], dtype=torch.float64)
    found = plan(x0, goal).action
    actions = plan.ensemble.rollout.call_args.args[1].double()  # (samples, horizon, 1)
    assert actions.shape == (SMALL.samples, SMALL.horizon, 1)
    states = torch.cat([torch.full((SMALL.samples, 1), 0.2), 0.2 + actions.squeeze(-1).cumsum(1)], 1)
    cost = 200 * (states + 0.3).square().sum(1) + 0.01 * actions.square().sum((1, 2))
    weight = torch.softmax(-0.02 * cost, 0)
    torch.testing.assert_close(found[0, 0], (weight * actions[:, 0, 0]).sum(), rtol=1e-4, atol=1e-6)
    assert float(weight.max()) < 0.99


def test_planner_moves_toward_the_goal_within_bounds():
    plan = planner(samples=400)
    state = torch.zeros(3, 1, dtype=torch.float64)
    goal = torch.tensor([[0.3], [-0.3], [0.0]], dtype=torch.float64)
    bound = torch.full((1,), 0.02, dtype=torch.float64)
    action = plan(state, goal).action.squeeze(-1)
    assert action[0] > 0.05
    assert action[1] < -0.05
    assert abs(action[2]) < 0.03
    assert bool((action.abs() <= U_MAX).all())
    for seed in range(30):  # it plans in single precision, which rounds half of the plans across a bound
        plan.begin(seed)
        assert bool((plan(state, goal, u_min=-bound, u_max=bound).action.abs() <= 0.02).all())


def test_planner_remembers_until_it_begins_anew():
    plan = planner()
    state, goal = torch.zeros(2, 1, dtype=torch.float64), torch.full((2, 1), 0.3, dtype=torch.float64)
    first = plan(state, goal).action
    assert not torch.equal(plan(state, goal).action, first)
    refuse(InvalidInputError, "begin", plan, state[:1], goal[:1])
    plan.begin()
    assert torch.equal(plan(state, goal).action, first)
    plan.begin(seed=1)
    assert not torch.equal(plan(state, goal).action, first)


def test_overflowing_predictions_do_not_spoil_the_plan():
    plan = planner()

    class Wild(Exact):
        def rollout(self, x0, u):
            return torch.where((u > 0).any(1, keepdim=True), torch.tensor(math.nan), super().rollout(x0, u))

    plan.ensemble = Wild(1, 1, 2, 4)
    action = plan(torch.zeros(1, 1, dtype=torch.float64), torch.full((1, 1), 0.3, dtype=torch.float64)).action
    assert bool(torch.isfinite(action).all())


def test_networks_drawn_anew_forget_what_they_learned():
    def weights(keep):
        trainer = make_pddm(keep_networks=keep)
        trainer.step()
        first = [w.detach().clone() for w in trainer.ensemble.weights]
        trainer.settings = replace(trainer.settings, ensemble=replace(NETWORKS, epochs=Epochs(1, 1, 10**6)))
        trainer.step()
        return first, [w.detach() for w in trainer.ensemble.weights]

    (kept_first, kept), (anew_first, anew) = weights(True), weights(False)
    # The first training is the same: its networks are those that PDDM is made with.
    assert all(torch.equal(a, b) for a, b in zip(kept_first, anew_first, strict=True))
    # One step of Adam moves no weight by more than its step size, beside which new weights are far away.
    assert all(float((a - b).abs().max()) < 2e-3 for a, b in zip(kept_first, kept, strict=True))
    assert all(float((a - b).abs().max()) > 0.1 for a, b in zip(anew_first, anew, strict=True))
