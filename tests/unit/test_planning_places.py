"""Where end effectors could be, how they get there without touching, and what is in the way of them and the body."""

import functools
import math

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from difflcs import GoalCost, LCSMPCLayer
from difflcs.errors import DTypeError, InvalidInputError, ShapeError
from difflcs.physics import Circle, PDDrive, PlanarPushing, Polygon, Union, box
from difflcs.physics.mujoco import MujocoLCS
from difflcs.physics.planar import to_body
from difflcs.planning import DiscPlaces, Obstacles, PlanarTravel, Workspace
from difflcs.planning.mujoco import BodyPlaces, BodyTravel, Rehearsal
from difflcs.planning.outline import DistanceGrid, clearance, ring
from tests.conftest import F64, refuse, tensor

RADIUS = 0.15
TEE = Union((box(-0.6, 0.6, -0.25, 0.05), box(-0.15, 0.15, 0.05, 0.95)))
SHAPES = {
    "circle": Circle(0.5, (0.3, 0.1)),
    "box": box(-0.5, 0.5, -0.2, 0.2),
    "not convex": Polygon([[0.0, 0.0], [1.0, 0.0], [0.2, 0.2], [0.0, 1.0]]),
    "tee": TEE,
    "apart": Union((box(-0.5, -0.1, -0.2, 0.2), Circle(0.3, (0.4, 0.0)))),
}


# --- curves round a shape ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHAPES)
def test_a_ring_has_its_distance_and_equal_steps_and_goes_round_once(name):
    shape = SHAPES[name]
    points = ring(shape, 0.17, 80)
    torch.testing.assert_close(clearance(shape, points), torch.full((80,), 0.17, dtype=F64))
    steps = (points.roll(-1, 0) - points).norm(dim=1)
    assert float(steps.min()) > 0.6 * float(steps.max())
    # Counterclockwise, once: seen from a point inside, the angles add up to a turn.
    inside = {"not convex": [0.1, 0.1], "apart": [-0.3, 0.0]}.get(name, [0.3, 0.0] if name == "circle" else [0.0, 0.0])
    apart = points - tensor(inside)
    after = apart.roll(-1, 0)
    turns = torch.atan2(apart[:, 0] * after[:, 1] - apart[:, 1] * after[:, 0], (apart * after).sum(1))
    assert float(turns.sum()) == pytest.approx(2 * math.pi)


def test_the_length_of_a_ring_is_that_of_geometry():
    points = ring(box(-0.5, 0.5, -0.2, 0.2), 0.1, 400)
    length = float((points.roll(-1, 0) - points).norm(dim=1).sum())
    assert length == pytest.approx(2 * 1.4 + 2 * math.pi * 0.1, rel=2e-3)


def test_a_ring_is_refused_where_there_is_none():
    refuse(InvalidInputError, "distance", ring, SHAPES["box"], 0.0, 10)
    refuse(InvalidInputError, "n_points", ring, SHAPES["box"], 0.1, 2)
    with pytest.raises(InvalidInputError, match=r"shape: expected parts .* got 2 that are apart; take a larger"):
        ring(SHAPES["apart"], 0.09, 80)  # .2 between them


def test_a_ring_round_a_hole_is_the_outer_one():
    sides = [(2, 4, -1, -0.9), (2, 4, 0.9, 1), (2, 2.1, -1, 1), (3.9, 4, -1, 1)]
    points = ring(Union(tuple(box(*side) for side in sides)), 0.1, 400)
    assert float((points - tensor([3.0, 0.0])).abs().amax(1).min()) > 1.0


# --- places -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (1.0, -2.0, 2.5)])
def test_discs_on_places_have_the_gap_and_are_at_rest(pose):
    system = PlanarPushing(TEE, RADIUS, drive=PDDrive(stiffness=100.0, damping=20.0, substep=0.01, substeps=10))
    places = DiscPlaces(TEE, RADIUS, 40, gap=0.03)
    x = tensor([*pose, 5.0, 5.0, 1.0, -1.0])
    refuse(ShapeError, r"places: expected shape \(n, 2\), got \(7,\); reshape it", places.states, x, x)
    states = places.states(x, places.sample(x))
    assert states.shape == (40, 7)
    torch.testing.assert_close(system.contacts(states).gap.amin(-1), torch.full((40,), 0.03, dtype=F64))
    torch.testing.assert_close(states[:, :3], x[:3].expand(40, 3))
    assert not bool(states[:, 5:].any())
    assert bool(places.allowed(states).all())


def test_near_is_within_reach():
    places = DiscPlaces(box(-1, 1, -1, 1), 0.1, reach=0.2)
    assert places.near(tensor([0.0, 0.0, 0.0, 1.29, 0.0]))
    assert not places.near(tensor([0.0, 0.0, 0.0, 1.31, 0.0]))


def test_places_outside_the_workspace_are_not_allowed():
    workspace = Workspace((-1.0, -1.0), (1.0, 1.0), step=0.1)
    places = DiscPlaces(box(-0.2, 0.2, -0.2, 0.2), 0.1, 40, workspace=workspace, margin=0.1)
    x = tensor([0.8, 0.0, 0.0, 0.0, 0.0])
    states = places.states(x, places.sample(x))
    torch.testing.assert_close(places.allowed(states), states[:, 3] <= 0.9)
    assert 5 < int(places.allowed(states).sum()) < 35


def test_bounds_of_the_workspace_hold_targets_inside():
    workspace = Workspace((0.0, 0.0), (1.0, 2.0), step=0.3)
    low, high = workspace.bounds(tensor([[0, 0, 0, 0.1, 1.0], [0, 0, 0, 0.9, 1.9], [0, 0, 0, 1.2, -0.1]]))
    torch.testing.assert_close(low, tensor([[-0.1, -0.3], [-0.3, -0.3], [-0.3, 0.0]]))
    torch.testing.assert_close(high, tensor([[0.3, 0.3], [0.1, 0.1], [0.0, 0.3]]))


def test_a_workspace_that_is_none_is_refused():
    refuse(InvalidInputError, "low", Workspace, (0.0, 1.0), (1.0, 1.0), step=0.1)
    refuse(ShapeError, "high", Workspace, (0.0, 0.0), (1.0,), step=0.1)
    refuse(InvalidInputError, "step", Workspace, (0.0, 0.0), (1.0, 1.0), step=0.0)
    refuse(DTypeError, "margin", Workspace((0.0, 0.0), (1.0, 1.0), step=0.1).contains, tensor([0.5, 0.5]), "far")


# --- travel -----------------------------------------------------------------------------------------------------------


@functools.cache
def round_the(name):
    return PlanarTravel(SHAPES[name], 0.1, 0.2), DiscPlaces(SHAPES[name], 0.1, 40, gap=0.02)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(sorted(SHAPES)))
def test_a_disc_gets_round_every_shape_without_touching_it(seed, name):
    shape, generator = SHAPES[name], torch.Generator().manual_seed(seed)
    travel, places = round_the(name)
    x = tensor([0.3, -0.2, 1.0, 0.0, 0.0])
    states = places.states(x, places.sample(x))
    first, last = torch.randint(40, (2,), generator=generator).tolist()
    x, target = states[first], states[last]
    for _ in range(60):
        if travel.arrived(x, target):
            break
        u = travel.action(x, target)
        assert float(u.norm()) <= 0.2 + 1e-12
        on_the_way = torch.cat([x.expand(10, -1)[:, :3], x[3:] + torch.linspace(0.1, 1, 10, dtype=F64)[:, None] * u], 1)
        assert float(PlanarPushing(shape, 0.1).contacts(on_the_way).gap.min()) > -1e-3
        x = on_the_way[-1]
    assert travel.arrived(x, target)


def test_distances_on_a_grid_are_those_of_the_shape_but_for_a_part_of_its_cells():
    grid = DistanceGrid(functools.partial(clearance, TEE), TEE.radius + 0.3)
    points = 1.2 * (2 * torch.rand(2000, 2, dtype=F64, generator=torch.Generator().manual_seed(0)) - 1)
    assert float((grid.distance(points) - clearance(TEE, points)).abs().max()) < 0.3 * 2.6 / 160
    assert float(grid.distance(tensor([50.0, 0.0]))) <= 50.0 - 0.6


@pytest.mark.parametrize("stiffness", [40.0, 100.0])
def test_a_disc_goes_round_as_fast_as_its_drive_lets_it_and_touches_nothing(stiffness):
    drive = PDDrive(stiffness, damping=20.0, substep=0.01, substeps=10)
    travel = PlanarTravel(TEE, RADIUS, 5.0, drive=drive, clearance=0.08, workspace=Workspace((-2, -2), (2, 2), step=1))
    places = DiscPlaces(TEE, RADIUS, 40, gap=0.02)
    x = tensor([0.1, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    states = places.states(x, places.sample(x))
    steps = []
    for first in range(0, 40, 8):
        at, target = states[first], states[(first + 20) % 40]
        for step in range(30):
            if travel.arrived(at, target):
                steps.append(step)
                break
            to = at[3:5] + travel.action(at, target)
            assert bool((to.abs() <= 2 + 1e-12).all())
            for _ in range(drive.substeps):
                at = at.clone()
                at[5:] += drive.substep * (drive.stiffness * (to - at[3:5]) - drive.damping * at[5:])
                at[3:5] += drive.substep * at[5:]
                assert float(clearance(TEE, to_body(at, at[None, 3:5]))) > RADIUS + 0.005
    assert len(steps) == 5
    assert max(steps) <= 9


def test_a_disc_goes_straight_where_it_can():
    travel = PlanarTravel(box(-0.5, 0.5, -0.5, 0.5), 0.1, 0.2)
    x, target = tensor([0, 0, 0, 1.0, 1.0]), tensor([0, 0, 0, -1.0, 1.0])
    torch.testing.assert_close(travel.action(x, target), tensor([-0.2, 0.0]))
    torch.testing.assert_close(travel.distance(x, target.unsqueeze(0)), tensor([2.0]))


def test_the_way_round_stays_in_the_workspace():
    shape = box(-0.5, 0.5, -0.5, 0.5)
    x, target = tensor([0, 0, 0, -0.65, 0.1]), tensor([0, 0, 0, 0.65, 0.1])
    free = PlanarTravel(shape, 0.1, 0.2)
    walled = PlanarTravel(shape, 0.1, 0.2, workspace=Workspace((-1.0, -1.0), (1.0, 0.55), step=0.2))
    assert float(free.action(x, target)[1]) > 0
    assert float(walled.action(x, target)[1]) < 0


# --- obstacles --------------------------------------------------------------------------------------------------------


BODY, DISC = box(-0.5, 0.5, -0.5, 0.5), 0.1
WALL, BALL, TOWER = box(-0.1, 0.1, -2.0, 2.0), Circle(0.4), Union((box(-0.6, 0.6, 0, 0.3), box(-0.2, 0.2, 0.3, 1.0)))


def placed(*shapes_and_poses, **options):
    obstacles = Obstacles(BODY, DISC, **options)
    shapes, poses = zip(*shapes_and_poses, strict=True)
    obstacles.place(shapes, tensor(poses))
    return obstacles


SCENES = {
    "wall": [(WALL, [1.0, 0.0, 0.1])],
    "ball": [(BALL, [1.1, 0.3, 0.0])],
    "both, and a tee": [(WALL, [1.2, 0.0, 0.0]), (BALL, [-1.3, 0.4, 0.0]), (TOWER, [0.2, 2.2, 2.5])],
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
        assert left[-1].isinf() or abs(left[-1] - (obstacles.gap(moved[0, 3:5]) - DISC - obstacles.margin)) < 0.02


@pytest.mark.parametrize(("wall", "room"), [(0.9, 0.05), (0.55, -0.05)])
def test_a_plan_leaves_the_margin_and_exists_where_body_and_wall_overlap(wall, room):
    cost = GoalCost.reach(5, 2, goal_weight=(1.0, 1.0, 0.3), input_weight=0.02)
    mpc = LCSMPCLayer(PlanarPushing(BODY, DISC), cost, 6, -0.2, 0.2, relaxation=1e-4)
    x, goal = tensor([[0.0, 0.0, 0.0, -0.61, 0.0]]), tensor([0.5, 0.0, 0.0])
    obstacles = placed((WALL, [wall, 0.0, 0.0]), margin=0.05)
    plan = mpc(x, goal, constraints=obstacles.constraints(x))
    assert bool(plan.converged.all())
    assert float(obstacles.body_gap(plan.x[0, -1, :3])) == pytest.approx(room, abs=0.01)
    assert float(mpc(x, goal).x[0, -1, 0]) > 0.45


def test_nothing_in_the_way_or_near_makes_no_constraints():
    obstacles = Obstacles(BODY, DISC)
    x = tensor([[0.0, 0.0, 0.0, -0.61, 0.0]])
    assert obstacles.margin == pytest.approx(DISC / 3)
    refuse(InvalidInputError, "margin: expected", Obstacles, BODY, DISC, margin=0.0)
    assert obstacles.constraints(x) is None
    assert obstacles.gap(x[:, :2]).isinf().all()
    assert placed((BALL, [9.0, 0.0, 0.0])).constraints(x) is None
    assert float(placed((Circle(0.1), [0.1, 0.2, 0.0])).body_gap(x[0, :3])) < -0.02  # inside the body
    with pytest.raises(ShapeError, match=r"poses: expected shape \(1, 3\), got \(2, 3\)"):
        obstacles.place([WALL], torch.zeros(2, 3, dtype=F64))


def test_places_in_an_obstacle_are_not_allowed_and_travel_goes_round():
    x = tensor([0.0, 0.0, 0.0, -0.7, 0.6])
    obstacles = placed((WALL, [0.75, 0.0, 0.0]), (BALL, [-1.1, 0.0, 0.0]))
    places = DiscPlaces(BODY, DISC, 40, obstacles=obstacles)
    states = places.states(x, places.sample(x))
    torch.testing.assert_close(places.allowed(states), obstacles.gap(states[:, 3:5]) > DISC + places.gap)
    assert 10 < int(places.allowed(states).sum()) < 36
    travel, target = PlanarTravel(BODY, DISC, 0.2, obstacles=obstacles), tensor([0.0, 0.0, 0.0, -0.7, -0.62])
    free, gaps = PlanarTravel(BODY, DISC, 0.2), []
    assert float(free.action(x, target)[1]) < -0.1  # straight, through the ball
    assert bool((travel.distance(x, target[None]) == free.distance(x, target[None])).all())
    for _ in range(40):
        x = torch.cat([x[:3], x[3:5] + travel.action(x, target)])
        gaps.append(torch.minimum(obstacles.gap(x[3:5]), clearance(BODY, to_body(x, x[None, 3:5]))[0]) - DISC)
        if travel.arrived(x, target):
            break
    assert travel.arrived(x, target)
    assert float(min(gaps)) > 0.0
    cage = [(box(-0.1, 0.1, -1, 1), [x, 0.0, 0.0]) for x in (-2.0, -1.0)]
    cage += [(box(-0.6, 0.6, -0.1, 0.1), [-1.5, y, 0.0]) for y in (-1.0, 1.0)]
    obstacles.place([shape for shape, _ in cage], tensor([pose for _, pose in cage]))
    assert float(travel.distance(tensor([0.0, 0.0, 0.0, -1.5, 0.0]), target[None])) > 1e5


# --- bodies of MuJoCo models ------------------------------------------------------------------------------------------


WORLD = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="box" pos=".35 0 .05"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
    <joint axis="0 0 1"/><geom type="box" size=".05 .03 .05"/><geom type="box" pos="0 .05 0" size=".02 .04 .05"/>
  </body>{}</worldbody><actuator>{}</actuator></mujoco>"""
SLIDES = """<body name="tip" pos="0 0 .05"><joint name="a" type="slide" axis="1 0 0" range="-.5 .5"/>
  <joint name="b" type="slide" axis="0 1 0"/><geom type="sphere" size=".015"/></body>"""
ARM = """<body pos="0 0 .35"><joint name="a" axis="0 0 1" range="-3 3"/><joint name="b" axis="0 1 0" range="-2 2"/>
  <geom type="capsule" fromto="0 0 0 .35 0 0" size=".02"/><body pos=".35 0 0"><joint name="c" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .35 0 0" size=".012"/><body pos=".35 0 0"><joint name="d" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .2 0 0" size=".01"/><site name="tip" pos=".2 0 0"/></body></body></body>"""


@pytest.mark.parametrize(("robot", "start"), [(SLIDES, (0.2, 0.0)), (ARM, (0.6, -0.6, 1.2, 0.97))])
def test_places_are_at_the_gap_and_ways_lead_round_the_body_or_over_it_and_touch_nothing(robot, start, monkeypatch):
    servos = "".join(f'<position joint="{joint}" kp="100"/>' for joint in "abcd"[: len(start)])
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(WORLD.format(robot, servos)))
    data.qpos[:] = [0.05, 0.1, 0.7, *start]
    module = MujocoLCS(model, data)
    places = BodyPlaces(module, "box", ["tip"], 12, gap=0.005, height=0.0)
    travel = BodyTravel(places, clearance=0.03, over=0.12, step=0.2)
    x, solve, threads = module.observe(data), torch.linalg.solve, []
    monkeypatch.setattr(torch.linalg, "solve", lambda *of: threads.append(torch.get_num_threads()) or solve(*of))
    torch.set_num_threads(2)
    states = places.states(x, places.sample(x))
    assert {*threads} == {1}  # two take ten times as long on busy cores
    assert torch.get_num_threads() == 2
    assert len(states) == 12
    torch.testing.assert_close(states[:, :3], x[:3].expand(12, 3))
    assert float(states[:, 3].max()) <= (0.5 if robot is SLIDES else 3.0)
    states = states[places.allowed(states)]
    assert 6 <= len(states)
    assert float(places.gaps(states).max()) < 0.0052
    assert robot is ARM or float(places.gaps(states).min()) > 0.0048  # a finger that leans is nearer than its tip
    assert all(places.near(state) for state in states)
    assert not places.near(x)
    x, target = states[0], states[len(states) // 2]
    assert not travel.arrived(x, target)
    for _ in range(40):
        u = travel.action(x, target)
        assert float(u.abs().max()) <= 0.2 + 1e-12
        for _ in range(5):
            x = torch.cat([x[:3], x[3:] + u / 5])
            assert float(places.gaps(x)) > 0
        if travel.arrived(x, target):
            break
    assert travel.arrived(x, target)
    refuse(InvalidInputError, "effectors: expected", BodyPlaces, module, "box", ["box"])
    refuse(InvalidInputError, "may touch the body None", BodyPlaces, module, None, ["tip"])
    refuse(InvalidInputError, "height: expected a number", BodyPlaces, module, "box", ["tip"], height="low")
    refuse(
        InvalidInputError, r"effectors\[0\]: expected a .*'tap' \(did you mean tip", BodyPlaces, module, "box", ["tap"]
    )
    refuse(ShapeError, "states: expected", places.gaps, x[:2])
    refuse(InvalidInputError, r"of\[0\]: expected at most", places.gaps, x, [99])
    refuse(InvalidInputError, "effector: expected at most 0, got 1", places.ring, x, 1, 0.1)


@pytest.mark.filterwarnings("ignore:expected a system as near:difflcs.errors.ContactWarning")  # of ±1 N in 0.1 s
def test_joints_that_move_are_driven_to_where_they_come_to_rest():
    """In two steps, as long as what is no longer driven goes on."""
    model = mujoco.MjModel.from_xml_string(WORLD.format(SLIDES, '<motor joint="a"/><motor joint="b"/>'))
    module = MujocoLCS(model, motion="dynamic", seconds=0.1)
    places = BodyPlaces(module, "box", ["tip"], 12, gap=0.005)
    x = module.observe(mujoco.MjData(model))
    x[8:] = torch.tensor([0.02, -0.01])
    target = x + 0.01 * torch.eye(10, dtype=x.dtype)[3]
    after = module.params(x).step(x, BodyTravel(places, clearance=0.03, step=9.0).action(x, target)).x_next
    torch.testing.assert_close(after[3:5] + 2 * 0.1 * after[8:], target[3:5], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("controls", "options", "chosen", "tried"),
    [
        ([20, 10, 5], {}, 10, 3),
        ([9, 10], {"slack": 0.2}, 9, 2),
        ([9, 10], {"gain": 0.5}, 9, 1),
        ([22, 3], {"harm": 0.5}, 3, 1),  # a little harm: the next is trusted
        ([-20, -10], {"harm": 0.5}, 0, 3),  # all do harm: it stays
    ],
)
def test_the_first_control_that_ends_about_as_well_as_the_best_is_taken(controls, options, chosen, tried):
    body = '<body><joint name="slide" type="slide" damping="1"/><geom size=".1" mass="1e-6"/></body>'
    world = f'<worldbody>{body}</worldbody><actuator><motor joint="slide"/></actuator>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><option gravity='0 0 0' timestep='.01'/>{world}</mujoco>")
    ends, options = [], {"gain": 3.0, **options}
    rehearsal = Rehearsal(model, 0.1, lambda data: ends.append(data.time) or abs(data.qpos[0] - 1), **options)
    data = mujoco.MjData(model)
    arrays = [np.array([float(control)]) for control in controls]
    assert rehearsal.choose(data, arrays, np.zeros(1)) == chosen
    assert (np.round(ends, 9).tolist(), data.time) == ([0.0] + [0.1] * tried, 0.0)
    refuse(InvalidInputError, "seconds: expected", Rehearsal, model, 0.0, len, 0.0)
