"""What is in the way of a disc and of the body that it pushes: gaps, places, travel, and plans that keep out."""

import pytest
import torch

from difflcs import GoalCost, LCSMPCLayer
from difflcs.errors import InvalidInputError, ShapeError
from difflcs.physics import Circle, PlanarPushing, Union, box
from difflcs.physics.planar import to_body
from difflcs.planning import DiscPlaces, Obstacles, PlanarTravel
from difflcs.planning.outline import clearance
from tests.conftest import F64, refuse, tensor

BODY, RADIUS = box(-0.5, 0.5, -0.5, 0.5), 0.1
WALL, BALL, TEE = box(-0.1, 0.1, -2.0, 2.0), Circle(0.4), Union((box(-0.6, 0.6, 0, 0.3), box(-0.2, 0.2, 0.3, 1.0)))


def placed(*shapes_and_poses, **options):
    obstacles = Obstacles(BODY, RADIUS, **options)
    shapes, poses = zip(*shapes_and_poses, strict=True)
    obstacles.place(shapes, tensor(poses))
    return obstacles


SCENES = {
    "wall": [(WALL, [1.0, 0.0, 0.1])],
    "ball": [(BALL, [1.1, 0.3, 0.0])],
    "both, and a tee": [(WALL, [1.2, 0.0, 0.0]), (BALL, [-1.3, 0.4, 0.0]), (TEE, [0.2, 2.2, 2.5])],
}


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_a_gap_is_that_to_the_nearest_shape_and_closes_as_the_half_planes_say(scene):
    obstacles, random = placed(*scene), torch.Generator().manual_seed(0)
    points = 2 * (2 * torch.rand(500, 2, dtype=F64, generator=random) - 1)
    exact = torch.stack([clearance(shape, to_body(tensor(pose), points)) for shape, pose in scene]).amin(0)
    gap = obstacles.gap(points)
    near = exact < 0.3
    torch.testing.assert_close(gap[near], exact[near], atol=0.03, rtol=0)
    x = tensor([[0.0, 0.0, 0.0, 0.2, -0.62]])
    rows = obstacles.constraints(x)
    for _ in range(20):
        moved = x + 0.05 * (2 * torch.rand(1, 5, dtype=F64, generator=random) - 1)
        left = (rows.g - (rows.G @ moved.unsqueeze(-1)).squeeze(-1))[0]
        assert abs(left[:-1].min() - (obstacles.body_gap(moved[0, :3]) - obstacles.margin)) < 0.02
        assert left[-1].isinf() or abs(left[-1] - (obstacles.gap(moved[0, 3:5]) - RADIUS - obstacles.margin)) < 0.02


@pytest.mark.parametrize(("wall", "room"), [(0.9, 0.05), (0.55, -0.05)])
def test_a_plan_leaves_the_margin_and_exists_where_body_and_wall_overlap(wall, room):
    cost = GoalCost.reach(5, 2, goal_weight=(1.0, 1.0, 0.3), input_weight=0.02)
    mpc = LCSMPCLayer(PlanarPushing(BODY, RADIUS), cost, 6, -0.2, 0.2, relaxation=1e-4)
    x, goal = tensor([[0.0, 0.0, 0.0, -0.61, 0.0]]), tensor([0.5, 0.0, 0.0])
    obstacles = placed((WALL, [wall, 0.0, 0.0]), margin=0.05)
    plan = mpc(x, goal, constraints=obstacles.constraints(x))
    assert bool(plan.converged.all())
    assert float(obstacles.body_gap(plan.x[0, -1, :3])) == pytest.approx(room, abs=0.01)
    assert float(mpc(x, goal).x[0, -1, 0]) > 0.45


def test_nothing_in_the_way_or_near_makes_no_constraints():
    obstacles = Obstacles(BODY, RADIUS)
    x = tensor([[0.0, 0.0, 0.0, -0.61, 0.0]])
    assert obstacles.margin == pytest.approx(RADIUS / 3)
    refuse(InvalidInputError, "margin: expected", Obstacles, BODY, RADIUS, margin=0.0)
    assert obstacles.constraints(x) is None
    assert obstacles.gap(x[:, :2]).isinf().all()
    assert placed((BALL, [9.0, 0.0, 0.0])).constraints(x) is None
    assert float(placed((Circle(0.1), [0.1, 0.2, 0.0])).body_gap(x[0, :3])) < -0.02  # inside the body
    with pytest.raises(ShapeError, match=r"poses: expected shape \(1, 3\), got \(2, 3\)"):
        obstacles.place([WALL], torch.zeros(2, 3, dtype=F64))


def test_places_in_an_obstacle_are_not_allowed_and_travel_goes_round():
    x = tensor([0.0, 0.0, 0.0, -0.7, 0.6])
    obstacles = placed((WALL, [0.75, 0.0, 0.0]), (BALL, [-1.1, 0.0, 0.0]))
    places = DiscPlaces(BODY, RADIUS, 40, obstacles=obstacles)
    states = places.states(x, places.sample(x))
    torch.testing.assert_close(places.allowed(states), obstacles.gap(states[:, 3:5]) > RADIUS + places.gap)
    assert 10 < int(places.allowed(states).sum()) < 36
    travel, target = PlanarTravel(BODY, RADIUS, 0.2, obstacles=obstacles), tensor([0.0, 0.0, 0.0, -0.7, -0.62])
    free, gaps = PlanarTravel(BODY, RADIUS, 0.2), []
    assert float(free.action(x, target)[1]) < -0.1  # straight, through the ball
    assert bool((travel.distance(x, target[None]) == free.distance(x, target[None])).all())
    for _ in range(40):
        x = torch.cat([x[:3], x[3:5] + travel.action(x, target)])
        gaps.append(torch.minimum(obstacles.gap(x[3:5]), clearance(BODY, to_body(x, x[None, 3:5]))[0]) - RADIUS)
        if travel.arrived(x, target):
            break
    assert travel.arrived(x, target)
    assert float(min(gaps)) > 0.0
    cage = [(box(-0.1, 0.1, -1, 1), [x, 0.0, 0.0]) for x in (-2.0, -1.0)]
    cage += [(box(-0.6, 0.6, -0.1, 0.1), [-1.5, y, 0.0]) for y in (-1.0, 1.0)]
    obstacles.place([shape for shape, _ in cage], tensor([pose for _, pose in cage]))
    assert float(travel.distance(tensor([0.0, 0.0, 0.0, -1.5, 0.0]), target[None])) > 1e5
