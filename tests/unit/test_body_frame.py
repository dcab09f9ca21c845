"""An LCS in the frame of a body: its matrices, its Jacobian, its files, and the method that learns it."""

from dataclasses import replace
from typing import Any

import pytest
import torch

pytest.importorskip("torchrl", reason="needs the extra [rl]")
pytest.importorskip("mujoco", reason="needs the extra [envs]")

from tensordict import TensorDict

from difflcs import GoalCost, LCSModel, LCSMPCLayer
from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.physics import BodyFrameLCS
from difflcs.rl import FrameMethod, LCSMPCPolicy, TrainConfig, load_policy, train
from difflcs.rl.learning.jacobian import system_jacobian


@pytest.fixture
def lcs(build):
    model = BodyFrameLCS(7, 4, 3, init_scale=0.3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.c.copy_(build.normal(2)(3))
    return model


def test_it_is_what_its_docstring_says(lcs, build):
    x, u = build.normal(0)(7), build.normal(1)(4)
    turn = torch.linalg.matrix_exp(x[2] * torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64))
    z, v = ((p.view(2, 2) @ turn).flatten() for p in (x[3:] - x[:2].repeat(2), u))
    found = lcs(x, u)
    change = lcs.A @ z + lcs.B @ v + lcs.C @ found.lam + lcs.d
    moved = torch.cat([turn @ change[:2], change[2:3], turn @ change[3:5], turn @ change[5:]])
    torch.testing.assert_close(found.x_next, x + moved)
    torch.testing.assert_close(lcs.params(x).gap(x, u), lcs.D @ z + lcs.E @ v + lcs.c)
    by_x = torch.autograd.functional.jacobian(lambda at: lcs.params(at).gap(at, 0 * u), x)
    torch.testing.assert_close(lcs.params(x).D, by_x)


def test_its_jacobian_is_that_of_any_module(lcs, build):
    mpc = LCSMPCLayer(lcs, GoalCost.reach(7, 4, (1.0, 1.0), input_weight=0.1), horizon=2, u_min=-1.0, u_max=1.0)
    policy = LCSMPCPolicy(mpc, std=1.0)
    state, goal = build.normal(0)(5, 7), build.normal(1)(5, 2)
    found = policy.jacobian(TensorDict({"state": state, "goal": goal}, [5]))
    torch.testing.assert_close(found, system_jacobian(mpc, state, goal, None, None))


def test_units_change_the_parameters_and_not_the_system(lcs, build):
    x, u = build.normal(0)(20, 7), build.normal(1)(20, 4)
    after = x + 0.01 * build.normal(2)(20, 7)
    lcs.take_units(x, u, x + after)
    system, D = lcs.params(x), lcs.D.clone()
    seen, v, seen_after = lcs.take_units(2 * x, u, after)
    assert not torch.allclose(lcs.D, D)
    torch.testing.assert_close(lcs.params(x).step(x, u).x_next, system.step(x, u).x_next)
    torch.testing.assert_close((seen_after - seen).std(0, correction=0), torch.ones_like(x[0]))
    torch.testing.assert_close(lcs.at_rest().gap(seen, v), lcs.params(2 * x).gap(2 * x, u))


def test_files_and_sizes(lcs, tmp_path, build):
    x = build.normal(0)(9, 7)
    lcs.take_units(x, build.normal(1)(9, 4), 2 * x)
    lcs.save_pretrained(tmp_path)
    torch.testing.assert_close(BodyFrameLCS.from_pretrained(tmp_path).params(x).A, lcs.params(x).A, rtol=0, atol=0)
    with pytest.raises(CheckpointError, match="BodyFrameLCS"):
        LCSModel.from_pretrained(tmp_path)
    for sizes in ((3, 2), (6, 2), (7, 3)):
        with pytest.raises(InvalidInputError, match="for each point"):
            BodyFrameLCS(*sizes, 2)
    with pytest.raises(InvalidInputError, match="x: expected the states of the system"):
        lcs.params()


@pytest.mark.slow
def test_the_warmup_alone_will_do(tmp_path):
    """With PPO after it: tests/conformance/test_methods.py."""
    config = TrainConfig(task="cube", method=FrameMethod().smoke(), minutes=0.2, final_goals=3)
    run = train(config, tmp_path / "run")
    assert not any(row["kl"] for row in run.rows())
    policy: Any = load_policy(run)
    assert isinstance(policy.lcs, BodyFrameLCS)
    with pytest.raises(InvalidInputError, match="a planar task for frame-lcs, got turn_cube"):
        train(replace(config, task="turn_cube"), tmp_path / "other")
