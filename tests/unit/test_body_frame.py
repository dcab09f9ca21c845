"""An LCS in the frame of a body: its matrices, its Jacobian, its files, the method that learns it, finding the body."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from difflcs import GoalCost, LCSModel, LCSMPCLayer
from difflcs.errors import CheckpointError, InvalidInputError, ShapeError
from difflcs.physics import BodyFrameLCS, Frame, PlanarPushing, box, find_frame
from difflcs.rl import Epochs, FrameMethod, LCSMPCPolicy, Work, get_task
from difflcs.rl.learning.jacobian import system_jacobian
from tests.conftest import refuse

FRAME = Frame(3, (1, 2), ((0, 6), (4, 5)), ((3, 1), (0, 2)))
"""Columns out of order, the last is a plain number."""


@pytest.fixture
def lcs(build):
    model = BodyFrameLCS(8, 5, 3, frame=FRAME, init_scale=0.3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.c.copy_(build.normal(2)(3))
    return model


def test_it_is_what_its_docstring_says(lcs, build):
    x, u = build.normal(0)(8), build.normal(1)(5)
    into = torch.linalg.matrix_exp(x[3] * torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64))
    z, v = x.clone(), u.clone()
    z[[1, 2, 3]] = 0
    for i, j in FRAME.points:
        z[[i, j]] = into @ (x[[i, j]] - x[[1, 2]])
    for i, j in FRAME.vectors:
        v[[i, j]] = into @ u[[i, j]]
    found = lcs(x, u)
    moved = lcs.A @ z + lcs.B @ v + lcs.C @ found.lam + lcs.d
    for i, j in (FRAME.place, *FRAME.points):
        moved[[i, j]] = into.mT @ moved[[i, j]]
    torch.testing.assert_close(found.x_next, x + moved)
    torch.testing.assert_close(lcs.params(x).gap(x, u), lcs.D @ z + lcs.E @ v + lcs.c)
    by_x = torch.autograd.functional.jacobian(lambda at: lcs.params(at).gap(at, 0 * u), x)
    torch.testing.assert_close(lcs.params(x).D, by_x)


def test_its_jacobian_is_that_of_any_module(lcs, build):
    mpc = LCSMPCLayer(lcs, GoalCost.reach(8, 5, (1.0, 1.0), input_weight=0.1), horizon=2, u_min=-1.0, u_max=1.0)
    policy = LCSMPCPolicy(mpc, std=1.0)
    state, goal = build.normal(0)(5, 8), build.normal(1)(5, 2)
    found = policy.jacobian(TensorDict({"state": state, "goal": goal}, [5]))
    torch.testing.assert_close(found, system_jacobian(mpc, state, goal, None, None))


def test_units_change_the_parameters_and_not_the_system(lcs, build):
    x, u = build.normal(0)(20, 8), build.normal(1)(20, 5)
    after = x + 0.01 * build.normal(2)(20, 8)
    lcs.take_units(x, u, x + after)
    system, D = lcs.params(x), lcs.D.clone()
    seen, v, seen_after = lcs.take_units(2 * x, u, after)
    assert not torch.allclose(lcs.D, D)
    torch.testing.assert_close(lcs.params(x).step(x, u).x_next, system.step(x, u).x_next)
    torch.testing.assert_close((seen_after - seen).std(0, correction=0), torch.ones_like(x[0]))
    torch.testing.assert_close(lcs.at_rest().gap(seen, v), lcs.params(2 * x).gap(2 * x, u))


def test_files_and_frames(lcs, tmp_path, build):
    x = build.normal(0)(9, 8)
    lcs.take_units(x, build.normal(1)(9, 5), 2 * x)
    lcs.save_pretrained(tmp_path)
    again = BodyFrameLCS.from_pretrained(tmp_path)
    assert again.frame == FRAME._replace(vectors=((0, 2), (3, 1)))
    torch.testing.assert_close(again.params(x.float()).A, lcs.params(x.float().double()).A, rtol=0, atol=0)
    refuse(CheckpointError, "BodyFrameLCS", LCSModel.from_pretrained, tmp_path)
    for wrong in (FRAME._replace(yaw=8), FRAME._replace(yaw=1), FRAME._replace(vectors=((0, 5),))):
        refuse(InvalidInputError, "frame: expected columns below", BodyFrameLCS, 8, 5, 3, frame=wrong)
    refuse(InvalidInputError, "frame: expected Frame", BodyFrameLCS, 8, 5, 3, frame="xy")
    refuse(InvalidInputError, "x: expected the states of the system", lcs.params)


def test_without_a_frame_it_is_a_constant_lcs(build):
    lcs, x = BodyFrameLCS(4, 2, 3, init_scale=0.3), build.normal(0)(2, 4)
    assert lcs.frame is None
    one, other = (lcs.params(at) for at in x)
    for system in (other, BodyFrameLCS.from_params(one).params(x[0])):
        for name, value in one.tensors().items():
            torch.testing.assert_close(value, getattr(system, name))


@pytest.mark.slow
def test_the_warmup_finds_the_frame_and_goes_on_with_it():
    """With PPO after it: tests/conformance/test_methods.py."""
    task = get_task("cube")
    method = replace(FrameMethod(), warmup=replace(FrameMethod().warmup, epochs=Epochs(100, 5, 100)))
    trainers: Any = [method.trainer(Work(task, 0, 70, task.make_envs)) for _ in range(2)]
    while trainers[0].learned.frame is None:
        trainers[0].step()
    trainers[1].load(trainers[0].state_dict())
    first, second = ([trainer.step(), trainer.learned] for trainer in trainers)
    assert first[1].frame == Frame(2, (0, 1), ((3, 4), (5, 6), (7, 8)), ((0, 1), (2, 3), (4, 5))) == second[1].frame
    assert torch.equal(first[1].A, second[1].A)


@pytest.fixture(scope="module")
def pushes():
    """Transitions of a box that two discs push; the last number of the state is another."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64) - 0.5

    system = PlanarPushing(box(-0.06, 0.06, -0.04, 0.04), 0.015, n_discs=2, friction=0.3, compliance=1e-4)
    x = draw(40, 7) * torch.tensor([0.2, 0.2, 2.0, *[0.2] * 4]) + torch.tensor([0, 0, 0, 0.15, 0, -0.15, 0])
    parts = []
    for _ in range(15):
        u = 0.05 * (x[:, :2].repeat(1, 2) - x[:, 3:]) + 0.03 * draw(40, 4)
        parts.append((x, u, x := system.params(x).step(x, u).x_next))
    x, u, x_next = (torch.cat(part) for part in zip(*parts, strict=True))
    return torch.cat([x, draw(600, 1)], -1), u, torch.cat([x_next, draw(600, 1)], -1)


@pytest.mark.parametrize("seed", range(3))
def test_it_is_found_in_columns_of_any_order(pushes, seed):
    generator = torch.Generator().manual_seed(seed)
    order, inputs = (torch.randperm(n, generator=generator).tolist() for n in (8, 4))
    x, u, x_next = pushes
    frame = find_frame(x[:, order], u[:, inputs], x_next[:, order])
    assert frame is not None
    assert [order[k] for k in (frame.yaw, *frame.place)] == [2, 0, 1]
    assert {(order[i], order[j]) for i, j in frame.points} == {(3, 4), (5, 6)}
    assert {(inputs[i], inputs[j]) for i, j in frame.vectors} == {(0, 1), (2, 3)}


def test_without_a_body_on_a_plane_there_is_none(pushes, build):
    x, u, x_next = pushes
    stirred, degrees = x_next.clone(), torch.ones(8, dtype=torch.float64)
    stirred[:, :3] = x[:, :3] + (x_next - x)[torch.randperm(len(x), generator=torch.Generator().manual_seed(0)), :3]
    degrees[2] = 180 / torch.pi
    few, no_pose = (x[:20], u[:20], x_next[:20]), (x[:, 3:], u, x_next[:, 3:])
    noise = (build.normal(k)(100, n) for k, n in enumerate((8, 4, 8)))
    for transitions in ((x, u, stirred), (x * degrees, u, x_next * degrees), few, no_pose, (x, u, x), noise):
        assert find_frame(*transitions) is None
    refuse(ShapeError, r"u: expected shape \(N=.*, n_u\), got", find_frame, x, u[1:], x_next)
