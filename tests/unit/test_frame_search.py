"""Which columns are a body on a plane and the points that push it, from transitions alone."""

import pytest
import torch

from difflcs.errors import ShapeError
from difflcs.physics import PlanarPushing, box, find_frame
from tests.conftest import refuse


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
