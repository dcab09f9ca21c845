"""Shapes, contacts, a body pushed by discs, and what is learned of it."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd.functional import jacobian

from difflcs import LCSModule
from difflcs.errors import DTypeError, FrictionWarning, InvalidInputError, ShapeError
from difflcs.physics import (
    Bounded,
    Circle,
    ContactLCS,
    Contacts,
    ForceDrive,
    FreeMotion,
    Inertia,
    PDDrive,
    PlanarPushing,
    Polygon,
    PositionDrive,
    Unilateral,
    Union,
    box,
    contact_lcs,
)
from difflcs.physics.complementarity import count_forces
from difflcs.physics.learnable import LEARNABLE
from tests.conftest import F64, refuse, tensor

L_SHAPE = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]]


# --- shapes -----------------------------------------------------------------------------------------------------------


def test_distances_to_a_box_are_those_of_geometry():
    found = box(-1, 1, -2, 2).distance(tensor([[3.0, 0.0], [0.5, 0.0], [4.0, 6.0], [1.0, 0.3], [1.0, 2.0]]))
    torch.testing.assert_close(found.distance[:, 0], tensor([2.0, -0.5, 5.0, 0.0, 0.0]))
    torch.testing.assert_close(found.normal[:3, 0], tensor([[1.0, 0.0], [1.0, 0.0], [0.6, 0.8]]))
    torch.testing.assert_close(found.point[:3, 0], tensor([[1.0, 0.0], [1.0, 0.0], [1.0, 2.0]]))
    torch.testing.assert_close(found.normal.norm(dim=-1), torch.ones(5, 1, dtype=F64))


def test_a_polygon_need_not_be_convex_nor_counterclockwise():
    outline = Polygon(tensor(L_SHAPE).flip(0))
    inside = tensor([[0.5, 0.5], [1.5, 0.5], [0.5, 2.5]])
    outside = tensor([[1.5, 1.5], [-0.1, 0.5], [2.5, 3.0], [1.2, 2.0]])
    assert outline.contains(inside).all()
    assert not outline.contains(outside).any()
    torch.testing.assert_close(outline.distance(outside).distance[0, 0], tensor(0.5))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-4, 4), min_size=2, max_size=2), st.integers(0, 2))
def test_the_normal_is_the_gradient_of_the_distance(place, which):
    shape = (Polygon(L_SHAPE), Circle(0.7, (0.3, 0.1)), Union((box(-1, 1, 0, 1), Circle(0.5))))[which]
    point = tensor(place)
    found = shape.distance(point)
    if bool((found.distance.abs() < 1e-3).any()):
        return
    # Where two sides are equally near, the distance has a kink.
    near = shape.distance(point + 1e-4 * torch.randn(20, 2, dtype=F64, generator=torch.Generator().manual_seed(0)))
    if bool(((near.normal - found.normal).norm(dim=-1) > 1e-2).any()):
        return
    gradient = jacobian(lambda p: shape.distance(p).distance, point)
    torch.testing.assert_close(gradient, found.normal, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(found.point + found.distance.unsqueeze(-1) * found.normal, point.expand_as(found.point))


def test_moments_of_what_is_known():
    area, centroid, polar = box(0, 2, 0, 4).moments()
    torch.testing.assert_close(area, tensor(8.0))
    torch.testing.assert_close(centroid, tensor([1.0, 2.0]))
    torch.testing.assert_close(polar, tensor(8.0 * (4 + 16) / 12))
    torch.testing.assert_close(Circle(2.0).gyration, tensor(math.sqrt(2.0)))
    whole, halves = box(0, 2, 0, 4), Union((box(0, 2, 0, 1), Union((box(0, 2, 1, 4),))))
    torch.testing.assert_close(halves.gyration, whole.gyration)
    torch.testing.assert_close(halves.centroid, whole.centroid)
    assert halves.n_parts == 2


TOUCHING = [[0.0, 0.0], [3.0, 1.0], [3.0, 3.0], [1.5, 0.5], [0.0, 3.0]]  # a corner on a side


@pytest.mark.parametrize("dtype", [F64, torch.float32])
@pytest.mark.parametrize("offset", [0.0, 1e3, 1e5])
def test_where_the_origin_is_changes_nothing(offset, dtype):
    """Shapes and points whose numbers are exact far away too."""
    away = offset * torch.tensor([1.0, -2.0], dtype=dtype)
    outline, circle, other = Polygon(torch.tensor(L_SHAPE, dtype=dtype)), Circle(0.5, (1.0, 1.0)), tensor([1.0, 1.0])
    moved = Union((Polygon(outline.vertices + away), Circle(0.5, other + away)))
    for found, wanted in zip(moved.moments(), Union((outline, circle)).moments(), strict=True):
        torch.testing.assert_close(found - (away if found.ndim else 0), wanted, rtol=1e-6, atol=1e-6, check_dtype=False)
    points = torch.randint(-8, 24, (200, 2), generator=torch.Generator().manual_seed(0)).to(dtype) / 8
    far, near = moved.parts[0].distance(points + away), outline.distance(points)
    torch.testing.assert_close(far.distance, near.distance)
    torch.testing.assert_close(far.normal, near.normal)
    turn = tensor([[math.cos(0.7), math.sin(0.7)], [-math.sin(0.7), math.cos(0.7)]])
    Polygon((tensor(TOUCHING) @ turn).to(dtype) + away)
    for wrong, match in (([[0, 0], [1, 1], [3, 3.0]], "an area"), ([[0, 0], [2, 0], [0, 1], [1, 1.0]], "cross")):
        refuse(InvalidInputError, match, Polygon, (tensor(wrong) @ turn).to(dtype) + away)


BAD_SHAPES = [
    (lambda: Polygon([[0.0, 0.0], [1.0, 0.0]]), ShapeError, "vertices: expected"),
    (lambda: Polygon([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), InvalidInputError, "vertices: expected"),
    (lambda: Polygon([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), InvalidInputError, "vertices: expected"),
    (lambda: Polygon("a square"), DTypeError, "vertices: expected"),
    (lambda: Circle(0.0), InvalidInputError, "r: expected"),
    (lambda: Union(("circle",)), DTypeError, r"parts\[0\]: expected Shape"),
    (lambda: Union(()), InvalidInputError, "at least one shape"),
    (lambda: box(1, 0, 0, 1), InvalidInputError, "x_min < x_max"),
    (lambda: box("1", 2, 0, 1), DTypeError, "x_min: expected a number"),
]


@pytest.mark.parametrize(("make", "error", "match"), BAD_SHAPES)
def test_what_is_no_shape_is_refused(make, error, match):
    refuse(error, match, make)


def test_sides_that_cross_are_named_and_those_that_touch_are_allowed():
    star = tensor([[math.cos(4 * math.pi * k / 5), math.sin(4 * math.pi * k / 5)] for k in range(5)])
    refuse(InvalidInputError, "crossing ones from corners 0 and 2; give the corners in the order", Polygon, star)
    turn = torch.linspace(0, 2 * math.pi, 601, dtype=F64)[:-1]
    ring = torch.stack([turn.cos(), turn.sin()], -1)
    Polygon(ring)
    ring[[500, 501]] = ring[[501, 500]]
    refuse(InvalidInputError, "crossing", Polygon, ring)
    hole = tensor([[0, 0], [3, 0], [3, 3], [0, 3], [0, 0], [1, 1], [1, 2], [2, 2], [2, 1], [1, 1]])
    assert bool(Polygon(hole).contains(tensor([[0.5, 1.5], [1.5, 1.5]])).tolist() == [True, False])


def test_a_polygon_can_be_built_of_what_torch_func_differentiates():
    corners = tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    found = torch.func.grad(lambda v: Polygon(v).moments().area)(corners)
    torch.testing.assert_close(found, corners - 0.5)


# --- contacts ---------------------------------------------------------------------------------------------------------


def sliding_block(cone="anitescu", compliance=1e-6, x=None, feet=1, **units):
    """A point of mass 1 on the floor; state (x, z, speeds), steps of 0.1, gravity and a push along x as action."""
    x = torch.zeros(4, dtype=F64) if x is None else x
    h, eye, zero = 0.1, torch.eye(2, dtype=F64), torch.zeros(2, 2, dtype=F64)
    A = torch.cat([torch.cat([eye, h * eye], 1), torch.cat([zero, eye], 1)])
    B = tensor([[h * h, 0.0], [0.0, h * h], [h, 0.0], [0.0, h]])
    response = torch.cat([torch.cat([h * eye, zero], 1), torch.cat([eye, zero], 1)])
    free = FreeMotion(A, B, B @ tensor([0.0, -9.81]), response)
    normal, tangent = tensor([[0.0, 1.0, 0.0, 0.0]] * feet), tensor([[[1.0, 0.0, 0.0, 0.0]]] * feet)
    contacts = Contacts(x[1:2].expand(feet), normal, tangent)
    return contact_lcs(contacts, free, x, friction=0.5, compliance=compliance, cone=cone, **units), x


@pytest.mark.parametrize("cone", ["anitescu", "stewart-trinkle"])
def test_a_push_within_the_cone_moves_nothing_and_units_do_not_matter(cone):
    lcs, x = sliding_block(cone)
    after = lcs.step(x, tensor([4.0, 0.0])).x_next  # friction carries up to 4.9
    torch.testing.assert_close(after, x, rtol=0, atol=2e-5)
    other, u = sliding_block(cone, length=0.03, force=7.0)[0], tensor([6.0, -1.0])
    torch.testing.assert_close(other.step(x, u).x_next, lcs.step(x, u).x_next, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("press", [0.0, 9.81])
def test_a_block_whose_friction_has_a_cap_slides_without_opening(press):
    """Friction follows the load up to a cap, here the impulse of the weight in a step; with more it stays as it is."""
    lcs, x = sliding_block(caps=tensor([0.981]))
    assert lcs.n_lam == count_forces(1, 1, n_bounded=1)
    after = lcs.step(x, tensor([7.0, -press])).x_next
    torch.testing.assert_close(after, (7.0 - 0.5 * 9.81) * tensor([0.01, 0.0, 0.1, 0.0]), rtol=2e-3, atol=1e-4)
    lifted = sliding_block(caps=tensor([0.981]), x=tensor([0.0, 1.0, 0.0, 0.0]))[0]
    after = lifted.step(tensor([0.0, 1.0, 0.0, 0.0]), tensor([7.0, 0.0])).x_next
    torch.testing.assert_close(after[2], tensor(0.7), rtol=0, atol=1e-3)
    refuse(InvalidInputError, "caps: expected positive forces", sliding_block, caps=tensor([0.0]))


def test_a_drag_that_spoils_the_friction_is_told():
    """A block on two feet that share its weight."""
    sliding_block("anitescu", 1e-3, feet=2)
    sliding_block("stewart-trinkle", 0.1, feet=2)
    with pytest.warns(FrictionWarning, match="more than a quarter of a slide"):
        sliding_block("stewart-trinkle", 1e-3, feet=2)


@pytest.mark.parametrize(("cone", "compliance"), [("anitescu", 1e-6), ("stewart-trinkle", 1e-2)])
def test_friction_is_right_at_every_step_of_a_plan(cone, compliance):
    """Gaps and motion are linear here: a plan is what the system of each step's own state says, and the block rests."""
    x = tensor([0.3, 0.0, 1.5, 0.0])
    actions = torch.zeros(15, 2, dtype=F64)
    plan = sliding_block(cone, compliance, x)[0].rollout(x, actions)
    steps = [x]
    for u in actions:
        steps.append(sliding_block(cone, compliance, steps[-1])[0].step(steps[-1], u).x_next)
    torch.testing.assert_close(plan, torch.stack(steps), rtol=1e-6, atol=1e-8)
    speed = plan[:, 2]
    assert (speed[1:] <= speed[:-1] + 1e-6).all()
    assert float(speed[1]) > 0.5
    torch.testing.assert_close(speed[-1], tensor(0.0), rtol=0, atol=0.02)


@pytest.mark.parametrize("cone", ["anitescu", "stewart-trinkle"])
@pytest.mark.parametrize("late", [1.0, 0.5])
@pytest.mark.parametrize("units", [{}, {"length": 0.03, "force": 7.0}])
def test_a_stop_and_dry_friction_beside_a_contact(cone, late, units):
    """A block on the floor, held by 2 N along x before a wall at 5 cm; pushes act at the beginning or all the time."""
    h, friction, still = 0.1, 0.5 if late == 1 else 0.0, {"rtol": 0, "atol": 1e-3}
    A, along = torch.eye(4, dtype=F64) + torch.diag(tensor([h, h]), 2), tensor([[1.0, 0.0, 0.0, 0.0]])
    B = tensor([[h * h * late, 0.0], [0.0, h * h], [h, 0.0], [0.0, h]])
    response = torch.diag_embed(tensor([h, h, 0.0, 0.0])) + torch.diag(tensor([1.0, 1.0]), -2)
    free = FreeMotion(A, B, B @ tensor([0.0, -9.81]), response)
    row, effect = late * along, None if late == 1 else tensor([[h * late], [0.0], [1.0], [0.0]])
    contact = Contacts(tensor([0.0]), tensor([[0.0, 1.0, 0.0, 0.0]]), along[None])

    def step(x, push):
        dry = Bounded(tensor([0.0]), row, tensor([-2.0 * h]), tensor([2.0 * h]), effect)
        stop = Unilateral((0.05 - x[:1]) * late, -row, effect if effect is None else -effect)
        rows = {"bounded": dry, "unilateral": stop, "cone": cone}
        system = contact_lcs(contact, free, x, friction=friction, compliance=1e-5, **rows, **units)
        assert system.n_lam == count_forces(1, 1, cone, 1, 1)
        assert torch.linalg.eigvalsh(system.F + system.F.mT)[0] > 0
        return system.step(x, tensor([push, 0.0])).x_next

    holds = 2.0 + friction * 9.81
    for sign in (-1, 1):
        x = step(torch.zeros(4, dtype=F64), sign * 0.9 * holds)
        torch.testing.assert_close(x, torch.zeros(4, dtype=F64), **still)
        x = step(torch.zeros(4, dtype=F64), sign * (holds + 1.0))  # Anitescu's contact opens, and presses harder
        torch.testing.assert_close(x[2], tensor(sign * h), rtol=0, atol=0.03)
    torch.testing.assert_close(step(tensor([0.04, 0.0, 1.0, 0.0]), 0.0)[0], tensor(0.05), **still)


def test_bad_contacts_are_refused():
    free = FreeMotion(*(torch.eye(2, dtype=F64) for _ in range(2)), torch.zeros(2, dtype=F64), torch.eye(2, dtype=F64))
    contacts = Contacts(tensor([0.0]), tensor([[1.0, 0.0]]), torch.zeros(1, 0, 2, dtype=F64))
    x = torch.zeros(2, dtype=F64)
    for wrong, match in (
        ({"compliance": 0.0}, "compliance: expected finite numbers above 0"),
        ({"friction": -1.0}, "friction: expected"),
        ({"friction": tensor([0.1, 0.2])}, "friction: expected one number"),
        ({"cone": "round"}, "cone: expected one of"),
        ({"length": 0.0}, "length"),
    ):
        refuse(InvalidInputError, match, contact_lcs, contacts, free, x, **{"friction": 0.5, "compliance": 0.1} | wrong)
    one, bound = tensor([0.0]), tensor([1.0])
    crossed = Bounded(one, tensor([[1.0, 0.0]]), bound, -bound)
    with pytest.raises(InvalidInputError, match="lower: expected at most"):
        contact_lcs(contacts, free, x, friction=0.0, compliance=0.1, bounded=crossed)
    with pytest.raises(ShapeError, match=r"unilateral\.normal: expected"):
        contact_lcs(contacts, free, x, friction=0.0, compliance=0.1, unilateral=Unilateral(one, tensor([[1.0]])))
    refuse(DTypeError, "contacts: expected Contacts", contact_lcs, None, free, x, friction=0.0, compliance=0.1)
    with pytest.raises(ShapeError, match=r"contacts\.normal: expected"):
        contact_lcs(contacts._replace(normal=tensor([[1.0]])), free, x, friction=0.0, compliance=0.1)


# --- a body pushed by discs -------------------------------------------------------------------------------------------


def pushing(**values):
    return PlanarPushing(
        box(-0.03, 0.03, -0.03, 0.03), **({"radius": 0.01, "friction": 0.5, "compliance": 1e-6} | values)
    )


DRIVES = {
    "position": {},
    "pd": {"drive": PDDrive(100.0, 20.0, 0.01, 10)},
    "force": {"drive": ForceDrive(0.2, 0.05, 1.0), "inertia": Inertia(0.1, 0.05, 2.0)},
}


@pytest.mark.filterwarnings("ignore::difflcs.errors.FrictionWarning")
@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("cone", ["anitescu", "stewart-trinkle"])
def test_derivatives_of_gaps_are_those_of_autograd(build, name, cone):
    system = pushing(n_discs=2, cone=cone, **DRIVES[name])
    x = 0.05 * build.normal(0)(20, system.n_x)
    x[:, 3:7] += 0.06
    assert isinstance(system, LCSModule)
    found = system.contacts(x)
    gaps = jacobian(lambda x: system.contacts(x).gap.sum(0), x).movedim(0, 1)
    torch.testing.assert_close(found.normal, gaps)
    params = system.params(x)
    assert (params.n_x, params.n_u, params.n_lam) == (system.n_x, system.n_u, system.n_lam)
    assert system.params(x[:0]).D.shape == (0, system.n_lam, system.n_x)
    # The gap of the system, without action and force, is the gap where the free motion leads.
    still = x.clone()
    still[:, 7:] = 0
    start = system.params(still)
    each = {"anitescu": [0, 2], "stewart-trinkle": [0, 4]}[cone]
    gap = start.gap(still, torch.zeros(20, 4, dtype=F64))[:, each]
    if cone == "stewart-trinkle" or name == "position":
        torch.testing.assert_close(system.length * gap, system.contacts(still).gap, rtol=1e-9, atol=1e-12)


def test_what_a_call_without_gradients_prepares_is_not_kept_for_those_with():
    vertices = tensor([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]).requires_grad_()
    gain, place = tensor(0.7).requires_grad_(), tensor([0.08, 0.01])
    outline, x = Polygon(vertices), torch.zeros(5, dtype=F64)
    system = PlanarPushing(box(-0.05, 0.05, -0.05, 0.05), 0.01, drive=PositionDrive(gain=gain))
    with torch.no_grad():
        outline.distance(place)
        system.params(x)
    (slope,) = torch.autograd.grad(outline.distance(place).distance.sum(), vertices)
    torch.testing.assert_close(slope[:, 0], tensor([0.0, -0.4, -0.6, 0.0]))
    assert system.params(x).B.requires_grad
    with torch.no_grad():  # a step of an optimiser
        vertices.mul_(1.2)
        gain.mul_(0.5)
    assert outline.distance(place).distance.item() == pytest.approx(0.02)
    assert system.params(x).B[3, 0].item() == pytest.approx(0.35)


@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize("way", [lambda v, new: v.detach().numpy().__setitem__(slice(None), new),
                                 lambda v, new: v.data.copy_(new), lambda v, new: v.detach().copy_(new)])  # fmt: skip
def test_a_polygon_has_the_corners_that_it_was_made_with_or_those_of_what_is_learned(way, learned):
    corners = tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]).requires_grad_(learned)  # clockwise
    moved, place = tensor([[0.0, 1.0], [4.0, 1.0], [4.0, -3.0], [0.0, 0.0]]), tensor([1.0, -1.0])

    def seen(shape):
        return [
            float(v) for v in (shape.distance(place).distance.detach(), shape.moments().area.detach(), shape.radius)
        ]

    shape, before, after = Polygon(corners), seen(Polygon(corners.detach())), seen(Polygon(moved))
    assert seen(shape) == before != after
    way(corners, moved)
    assert seen(shape) == (after if learned else before)
    way(shape.vertices, moved if learned else moved.flip(0))  # its own
    assert seen(shape) == after


@pytest.mark.parametrize("name", ["position", "force"])
def test_a_system_that_its_owner_changes_is_no_longer_that_of_the_physics(name):
    system = pushing(**DRIVES[name])
    x = torch.full((system.n_x,), 0.1, dtype=F64)
    kept = [value.clone() for value in system.params(x).tensors().values()]
    for value in system.params(x).tensors().values():
        value.mul_(2.0).add_(1.0)
    for value, wanted in zip(system.params(x).tensors().values(), kept, strict=True):
        assert torch.equal(value, wanted)


def test_what_inference_mode_prepares_is_not_kept():
    system = pushing()
    x = torch.zeros(5, dtype=F64)
    with torch.inference_mode():
        system.params(x)
    x = x.clone().requires_grad_()
    system.params(x).step(x, tensor([0.01, 0.0])).x_next.sum().backward()
    assert x.grad is not None


def test_the_physics_follows_a_shape_that_is_learned_as_often_as_gradients_are_taken():
    corners = tensor([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.08]]).requires_grad_()
    system, x = PlanarPushing(Polygon(corners), 0.01, friction=0.3), tensor([0.0, 0.0, 0.2, -0.1, 0.01])
    for _ in range(2):
        system.params(x).C.square().sum().backward()
        with torch.no_grad():
            corners.mul_(1.1)
        fresh = PlanarPushing(Polygon(corners.detach()), 0.01, friction=0.3).params(x).tensors()
        torch.testing.assert_close({k: v.detach() for k, v in system.params(x).tensors().items()}, fresh)


@pytest.mark.parametrize("drive", [PositionDrive(), PDDrive([100.0, 50.0], 20.0, 0.02, 5), ForceDrive(1.0, 0.1, 0.5)])
@pytest.mark.parametrize("inertia", [None, Inertia(1.0, 0.1)])
@pytest.mark.filterwarnings("ignore:There is a performance drop")
def test_states_of_single_precision_and_those_that_are_mapped(drive, inertia):
    system = pushing(n_discs=2, friction=0.4, drive=drive, inertia=inertia)
    x = 0.1 * torch.randn(3, system.n_x, dtype=F64, generator=torch.Generator().manual_seed(0))
    for name, value in system.params(x).tensors().items():
        mapped = torch.vmap(lambda x: getattr(system.params(x), name))(x)  # noqa: B023
        torch.testing.assert_close(mapped, value.expand_as(mapped))
        single = getattr(system.params(x.float()), name)
        torch.testing.assert_close(single, value.float(), rtol=1e-3, atol=1e-4)


def test_another_shape_has_its_own_centre_and_gyration():
    small, large = box(-0.05, 0.05, -0.05, 0.05), box(0.0, 0.2, 0.0, 0.2)
    system, fresh = PlanarPushing(small, 0.01).replace(shape=large), PlanarPushing(large, 0.01)
    torch.testing.assert_close(system.gyration, fresh.gyration)
    torch.testing.assert_close(system.center_of_mass, fresh.center_of_mass)
    assert system.length == fresh.length
    moved = PlanarPushing(small, 0.01).replace(center_of_mass=(0.03, 0.0))
    torch.testing.assert_close(moved.gyration, PlanarPushing(small, 0.01, center_of_mass=(0.03, 0.0)).gyration)
    given = PlanarPushing(small, 0.01, gyration=0.02, center_of_mass=(0.01, 0.0), length=0.04).replace(shape=large)
    assert (float(given.gyration), given.center_of_mass.tolist(), given.length) == (0.02, [0.01, 0.0], 0.04)
    assert ContactLCS(PlanarPushing(small, 0.01), ("outline",)).physics.gyration == PlanarPushing(small, 0.01).gyration


@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_the_centre_of_mass_keeps_its_velocity_wherever_the_origin_is(damping):
    """A body that spins and glides, described from its centre of mass and from another point."""
    speed, spin, centre = (0.2, -0.1), 3.0, (0.03, -0.02)
    found = []
    for origin in ((0.0, 0.0), centre):
        system = pushing(inertia=Inertia(1.0, 0.02, damping), center_of_mass=origin, compliance=0.1)
        x = torch.zeros(system.n_x, dtype=F64)
        x[3:5] = 5.0  # the disc is far away
        x[-3:] = tensor([speed[0] + spin * origin[1], speed[1] - spin * origin[0], spin])
        for _ in range(50):
            x = system.params(x).step(x, torch.zeros(2, dtype=F64)).x_next
        turn = tensor([[x[2].cos(), -x[2].sin()], [x[2].sin(), x[2].cos()]])
        found.append(torch.cat([x[:2] + turn @ tensor(origin), x[2:3], x[-1:]]))
    start = tensor([*centre, 0.0, 0.0])
    torch.testing.assert_close(found[1] - start, found[0], rtol=1e-9, atol=1e-12)


def test_a_body_turns_about_its_centre_of_mass():
    # A push through the centre of mass, which is not in the middle, turns nothing; one through the middle does.
    system = pushing(center_of_mass=(0.0, 0.01), friction=0.0)
    assert system.n_lam == 1  # a force along the normal alone
    x = tensor([[0.0, 0.0, 0.0, -0.04, 0.01], [0.0, 0.0, 0.0, -0.04, 0.0]])
    after = system.params(x).step(x, tensor([0.01, 0.0])).x_next
    torch.testing.assert_close(after[0, :3], tensor([0.01, 0.0, 0.0]), rtol=0, atol=1e-6)
    assert float(after[1, 2]) > 0.05
    # Its yaw turned by itself, its place is that of the origin: both descriptions agree about the centre of mass.
    turned = x.clone()
    turned[:, 2] = math.pi / 2
    turned[:, 3:] = tensor([[-0.01, -0.04], [0.0, -0.04]])
    other = system.params(turned).step(turned, tensor([0.0, 0.01])).x_next
    torch.testing.assert_close(other[:, 2] - math.pi / 2, after[:, 2], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(other[:, 1], after[:, 0], rtol=1e-6, atol=1e-9)


def test_the_pd_drive_is_its_own_simulation():
    drive, target = PDDrive(100.0, 20.0, 0.01, 10), 0.3
    step, course = drive.step(), drive.course()
    p, v = 0.1, 0.5
    got = step.A @ tensor([p, v]) + step.b * (target - p)
    places = course.A @ tensor([p, v]) + course.b * (target - p)
    for i in range(10):
        v += (100 * (target - p) - 20 * v) * 0.01
        p += v * 0.01
        torch.testing.assert_close(places[i], tensor([p, v]))
    torch.testing.assert_close(got, tensor([p, v]))


@pytest.mark.parametrize(
    "drive", [PositionDrive(0.8, 0.1), PositionDrive(torch.rand(2, 2).double()), ForceDrive(2.0, 0.1)]
)
def test_the_course_of_a_drive_ends_where_its_step_does(drive):
    for end, step in zip(drive.course(), drive.step(), strict=True):
        torch.testing.assert_close(end[-1], step)


def test_what_a_drive_gives_way_and_what_the_body_moves():
    """Series of springs: a force f moves the body by f, the disc back by a·f, and closes the gap by r·f."""
    give, soft, gain, command = 0.5, 0.1, 0.8, 0.01
    system = pushing(compliance=soft, friction=0.0, drive=PositionDrive(gain, give))
    x = tensor([0.0, 0.0, 0.0, -0.04, 0.0])
    after = system.params(x).step(x, tensor([command, 0.0])).x_next
    force = gain * command / (1 + give + soft)
    torch.testing.assert_close(after, tensor([force, 0.0, 0.0, -0.04 + gain * command - give * force, 0.0]))


def test_a_point_beside_a_corner_that_is_off_by_rounding_is_not_inside():
    y = torch.linspace(-3e-17, 3e-17, 61, dtype=F64)
    shape = box(-0.48, -0.27, -0.855, -1.4685489743719004e-17)
    assert not bool(shape.contains(torch.stack([torch.full_like(y, -1.2), y], -1)).any())


def test_only_the_nearest_parts_touch():
    parts = tuple(box(a, a + 0.02, -0.01, 0.01) for a in (-0.05, -0.01, 0.03))
    both = [PlanarPushing(Union(parts), 0.005, 2, friction=0.4, nearest=n) for n in (None, 1)]
    x = tensor([[0.0, 0.0, 0.0, -0.04, 0.02, 0.002, 0.03], [0.01, 0.0, 0.3, 0.06, 0.0, -0.07, 0.0]])
    full, near = (system.contacts(x) for system in both)
    assert [system.n_lam for system in both] == [12, 4]
    assert near.gap.shape == (2, 2)
    chosen = full.gap.reshape(2, 2, 3).argmin(-1)
    torch.testing.assert_close(near.gap, full.gap.reshape(2, 2, 3).amin(-1))
    for name in ("normal", "tangent"):
        every = getattr(full, name).reshape(2, 2, 3, -1)
        wanted = every.gather(2, chosen[..., None, None].expand(2, 2, 1, every.shape[-1])).squeeze(2)
        torch.testing.assert_close(getattr(near, name).reshape(2, 2, -1), wanted)
    more = PlanarPushing(Union(parts), 0.005, 2, friction=0.4, nearest=9)
    torch.testing.assert_close(more.contacts(x).gap, full.gap)


STEPS = (0.0005, 0.01, 0.1)


@pytest.mark.parametrize("seconds", STEPS)
@pytest.mark.parametrize("compliance", [1e-6, 0.3])
@pytest.mark.parametrize("mass", [0.1, 10.0])
def test_impacts_are_inelastic_whatever_the_step(seconds, compliance, mass):
    """Of a body with a disc that stays where it is told, and with one that has a mass: the closed form."""
    for drive, after in ((PositionDrive(), 0.0), (ForceDrive(0.5, seconds), mass / (mass + 0.5))):
        system = pushing(drive=drive, compliance=compliance, inertia=Inertia(mass, seconds))
        speed, steps = torch.rand(2, 50, generator=torch.Generator().manual_seed(0), dtype=F64)
        x = torch.zeros(50, system.n_x, dtype=F64)
        x[:, -3] = -0.1 - 3 * speed
        x[:, 3] = -0.04 - 4 * steps * seconds * (0.1 + 3 * speed)  # within four steps it touches
        start = x[:, -3].clone()
        for _ in range(25):
            x = system.params(x).step(x, torch.zeros(50, 2, dtype=F64)).x_next
        assert float((x[:, -3] / start - after).abs().max()) < 0.01
        torch.testing.assert_close(x[:, -2:], torch.zeros(50, 2, dtype=F64), rtol=0, atol=1e-6)
        if drive.order == 2:
            torch.testing.assert_close(mass * x[:, -3] + 0.5 * x[:, 5], mass * start)


@pytest.mark.parametrize("seconds", STEPS)
def test_a_push_with_a_force_is_newtons_and_closes_the_gap_by_what_the_contact_gives(seconds):
    mass, disc, push, compliance, n = 1.0, 0.5, 3.0, 0.02, 20
    system = pushing(
        drive=ForceDrive(disc, seconds), compliance=compliance, inertia=Inertia(mass, seconds), friction=0.0
    )  # fmt: skip
    x = torch.zeros(system.n_x, dtype=F64)
    x[3] = -0.04 + compliance * push * seconds * mass / (mass + disc)
    for _ in range(n):
        params = system.params(x)
        found = params.step(x, tensor([push, 0.0]))
        x = found.x_next
    torch.testing.assert_close(x[[-3, 5]], tensor([n * seconds * push / (mass + disc)] * 2), rtol=1e-6, atol=0)
    force = float((params.C @ found.lam)[-3]) * mass / seconds
    assert force == pytest.approx(push * mass / (mass + disc), rel=1e-6)
    assert float(system.contacts(x).gap) == pytest.approx(-compliance * force * seconds, rel=1e-6)


@pytest.mark.parametrize(
    ("wrong", "error", "match"),
    [({"radius": tensor([0.1, 0.1, 0.1])}, ShapeError, "radius: expected a number or"),
     ({"gyration": 0.0}, InvalidInputError, "gyration: expected"),
     ({"center_of_mass": (0.0,)}, ShapeError, "center_of_mass"),
     ({"drive": "fast"}, DTypeError, "drive: expected Drive"),
     ({"cone": "flat"}, InvalidInputError, "cone: expected"),
     ({"friction": "much"}, DTypeError, "friction: expected real numbers"),
     ({"nearest": 0}, InvalidInputError, "nearest"),
     ({"inertia": "heavy"}, DTypeError, "inertia: expected Inertia"),
     ({"inertia": Inertia(-1.0, 0.1)}, InvalidInputError, "mass: expected numbers above 0, got -1"),
     ({"drive": PDDrive(1.0, -2.0, 0.1, 3)}, InvalidInputError, "damping: expected numbers of at least 0"),
     ({"drive": PDDrive(1.0, 2.0, 0.1, -3)}, InvalidInputError, "substeps: expected at least 1"),
     ({"drive": PDDrive(torch.ones(3).double(), 2.0, 0.1, 3)}, ShapeError, r"drive: expected .*\(3,\)"),
     ({"drive": ForceDrive([1.0, 2.0], 0.1, [1.0] * 3)}, ShapeError, r"damping: its batch dimensions \(3,\)"),
     ({"inertia": Inertia(tensor([1.0, 2.0]), 0.1)}, ShapeError, "mass: expected a number"),
     ({"inertia": Inertia(1.0, 0.1), "drive": ForceDrive(1.0, 0.2)}, InvalidInputError, "steps of 0.2 s .* got 0.1"),
     ({"inertia": Inertia(1.0, 0.1), "drive": PDDrive(1.0, 2.0, 0.1, 2)}, InvalidInputError, "steps of 0.2 s"),
     ({"radius": -0.1}, InvalidInputError, "radius: expected numbers of at least 0"),
     ({"n_discs": 0}, InvalidInputError, "n_discs")],
)  # fmt: skip
def test_a_wrong_description_is_refused(wrong, error, match):
    refuse(error, match, lambda: (system := pushing(**wrong)).params(torch.zeros(system.n_x, dtype=F64)))
    refuse(InvalidInputError, "x: expected states", pushing().params)
    refuse(DTypeError, "shape: expected Shape", PlanarPushing, "box", 0.01)
    with pytest.raises(InvalidInputError, match="compliance: expected numbers of at least 0"):
        pushing(drive=PositionDrive(1.0, -0.1)).params(torch.zeros(5, dtype=F64))
    system = pushing(radius=(radius := tensor(0.1)))
    radius.neg_()  # as an optimiser may do
    refuse(InvalidInputError, "radius: expected numbers of at least 0", system.params, torch.zeros(5).double())


def test_gradients_by_the_physics(build):
    """Of a step with contact, by everything that a ContactLCS can learn."""
    system = ContactLCS(pushing(n_discs=2, compliance=0.1, drive=PositionDrive(0.8, 0.3)), LEARNABLE)
    x = 0.05 * build.normal(0)(3, system.n_x)
    u = 0.02 * build.normal(1)(3, system.n_u)

    def step(*values):
        changes = dict(zip(system.change, values, strict=True))
        found = torch.func.functional_call(system, {f"change.{k}": v for k, v in changes.items()}, (x, u))
        return found * 100

    system.forward = lambda x, u: system.params(x).step(x, u).x_next
    values = [0.1 * build.normal(2)(max(v.numel(), 1)).reshape(v.shape) for v in system.change.values()]
    assert torch.autograd.gradcheck(step, [v.requires_grad_() for v in values], atol=1e-5, rtol=1e-3)


def test_gradients_by_masses_drives_and_states(build):
    """Of the step of a body with inertia that discs with mass push, by all numbers that are there."""
    x = 0.05 * build.normal(0)(3, 14)
    u = 0.02 * build.normal(1)(3, 4)

    def step(mass, damping, disc_mass, disc_damping, friction, vertices, x):
        system = PlanarPushing(
            Polygon(vertices), 0.01, 2, ForceDrive(disc_mass, 0.05, disc_damping), friction=friction, compliance=0.1,
            inertia=Inertia(mass, 0.05, damping), length=0.03,
        )  # fmt: skip
        return 100 * system.params(x).step(x, u).x_next

    vertices = box(-0.03, 0.03, -0.03, 0.03).vertices.clone()
    values = [tensor(0.1), tensor(2.0), tensor(0.2), tensor(1.0), tensor(0.4), vertices, x]
    assert torch.autograd.gradcheck(step, [v.requires_grad_() for v in values], atol=1e-4, rtol=1e-3)


def test_a_moved_outline_keeps_its_directions():
    model = ContactLCS(PlanarPushing(Union((Polygon(L_SHAPE), Circle(1.0))), 0.1, length=1.0), ("outline",))
    with torch.no_grad():
        model.change["outline"].copy_(tensor([0.1, 0.2, 0.3, 0.1, 0.0, -0.1, 0.5]))
    polygon, circle = model.physics.shape.parts
    wanted = [[0.1, -0.1], [2.2, -0.1], [2.2, 1.3], [1.1, 1.3], [1.1, 3.0], [0.1, 3.0]]
    torch.testing.assert_close(polygon.vertices.detach(), tensor(wanted))
    assert float(circle.r.detach()) == 1.5


def test_what_cannot_be_learned_is_refused():
    for physics, learn, match in (
        (pushing(friction=0.0), ("friction",), "friction above 0"),
        (pushing(**DRIVES["pd"]), ("gain",), "PositionDrive"),
        (pushing(**DRIVES["pd"]), ("drive_compliance",), "PositionDrive"),
        (pushing(), ("drive_compliance",), "compliance above 0"),
        (pushing(), ("mass",), "learn: expected some of"),
        (pushing(), ("friction", "friction"), "each once"),
    ):
        refuse(InvalidInputError, match, ContactLCS, physics, learn)
    refuse(DTypeError, "PlanarPushing", ContactLCS, "physics")
