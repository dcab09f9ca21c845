"""The examples, on few episodes; that of Judo's cylinder_push on a model like Judo's."""

import box_to_pose
import cylinder_push
import hand_turn
import mixture as m
import numpy as np
import pusher
import pytest
import terminal_value as t
import torch
import trifinger_context

from difflcs import LCSModel
from difflcs.rl import TrainConfig, train

BODY = """<body name="{0}"><joint name="{0}_x" damping="4" type="slide" axis="1 0 0"/>
  <joint name="{0}_y" damping="4" type="slide" axis="0 1 0"/>
  <geom name="{0}" type="cylinder" size=".25 .1" mass="1" friction=".01"/></body>"""
MODEL = f"""<mujoco><option timestep=".02"/><worldbody>{BODY.format("pusher")}{BODY.format("cart")}</worldbody>
  <actuator><position joint="pusher_x" kp="10" ctrlrange="-10 10"/>
  <position joint="pusher_y" kp="10" ctrlrange="-10 10"/></actuator></mujoco>"""

pytestmark = pytest.mark.slow


def test_the_cylinder_comes_to_the_origin(capsys, tmp_path):
    (tmp_path / "model.xml").write_text(MODEL)
    cylinder_push.main(cylinder_push.Options(tmp_path / "model.xml", episodes=1, seed=100))
    assert float(capsys.readouterr().out.split("worst ")[1].split(" cm")[0]) < 3


def test_a_box_is_pushed_to_poses_from_the_wrong_side():
    policy, module = box_to_pose.make_policy()
    episodes = [box_to_pose.play(2000 + k, policy, module) for k in range(10)]
    assert sum(episode.success for episode in episodes) >= 9
    assert np.mean([episode.steps for episode in episodes]) < 45
    assert min(episode.steps for episode in episodes) > 0


def test_a_cylinder_is_turned_in_a_hand_and_filmed(capsys, tmp_path):
    hand_turn.main(hand_turn.Options("cylinder", episodes=2, seed=100, out=tmp_path / "hand.gif"))
    assert "all 2/2" in capsys.readouterr().out
    assert (tmp_path / "hand.gif").stat().st_size > 10_000


def test_three_fingers_find_out_how_large_the_cube_is(capsys):
    reached = []
    for adapt in (False, True):
        trifinger_context.main(trifinger_context.Options(side=3.0, adapt=adapt, goals=24, seed=100))
        reached.append(int(capsys.readouterr().out.split(" of ")[0]))
    assert reached[0] <= 4
    assert reached[1] >= 22


def test_the_arm_of_pusher_does_better_than_nothing(capsys, monkeypatch):
    monkeypatch.setattr(pusher, "STEPS", 25)
    means = []
    for still in (False, True):
        pusher.main(pusher.Options(episodes=2, seed=100, still=still))
        means.append(float(capsys.readouterr().out.split("mean return ")[1].split(" ")[0]))
    assert means[0] > means[1]


def test_a_value_is_found_again_from_its_returns_and_mixed_into_a_cost():
    state, goal = (0.1 * torch.randn(400, n, dtype=torch.float64) for n in (9, 3))
    features, cost = t.pushing_features(), t.get_task("cube").make_cost()
    wanted = [torch.tensor([[3.0, -1.0], [-1.0, 2.0]]).double(), torch.tensor([[0.5]]).double()]
    value = t.with_value(cost, features, wanted, 1.0)
    returns = value(goal, horizon=0)
    returns = 0.5 * ((state @ value.Q_final) * state).sum(-1) + (returns.q_final * state).sum(-1) + returns.constant
    weights, explained = t.fit_value(features, state, goal, returns)
    assert explained > 0.999
    torch.testing.assert_close(weights, wanted, rtol=1e-2, atol=1e-2)
    torch.testing.assert_close(t.with_value(cost, features, wanted, 0.0)(goal, 2).tensors(), cost(goal, 2).tensors())


def test_a_value_is_fitted_after_the_warmup_and_moves_with_the_lcs(tmp_path):
    values = []
    for move in (False, True):
        method = t.ValueMethod(n_lam=3, move=move).smoke()
        lcs = t.ValueLCS.from_pretrained(_train_briefly(method, tmp_path / str(move)))
        values.append(lcs.value.detach())
        goal, cost = torch.ones(3, dtype=torch.float64), t.get_task("cube").make_cost()
        both = t.ValueCost(cost, lcs).at(goal, goal)
        alone = t.with_value(cost, t.pushing_features(), lcs.weights(), 1.0)
        torch.testing.assert_close(both.Q_final, cost.Q_final + alone.Q_final)
        torch.testing.assert_close(both.q_final, cost(goal).q_final + alone(goal).q_final)
    assert all(bool(value[0] > 0) for value in values)
    assert not torch.equal(*values)


def test_a_mixture_is_learned_and_averages_its_systems(tmp_path):
    lcs = m.MixtureLCS.from_pretrained(_train_briefly(m.MixtureMethod(n_lam=3).smoke(), tmp_path))
    x, systems = torch.randn(4, 9, dtype=torch.float64), []
    for k in range(m.COMPONENTS):
        systems.append(LCSModel(9, 6, 3))
        systems[k].load_state_dict({name: getattr(lcs, name)[k] for name in LCSModel.parameter_names})
    weights, F = lcs.weights(x), torch.stack([system.F for system in systems])
    torch.testing.assert_close(lcs.params(x).F, torch.einsum("nk,kij->nij", weights, F))


def _train_briefly(method, out):
    config = TrainConfig(task="cube", method=method, minutes=0.5, final_goals=0, evaluate_at=())
    return train(config, out / "run").model
