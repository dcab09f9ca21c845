"""The two ready-made systems against solutions known by hand."""

import math

import pytest
import torch

from difflcs import GoalCost, LCSMPCLayer, LCSParams, QuadraticCost, Status, solve_lcp
from difflcs.errors import InvalidInputError
from difflcs.systems import block_along_wall, cart_pole_between_walls

G, MASS, POLE, LENGTH, WALL, K, DT = 9.81, 1.3, 0.2, 0.6, 0.15, 25.0, 0.03
CART_POLE = {
    "cart_mass": MASS,
    "pole_mass": POLE,
    "pole_length": LENGTH,
    "wall_distance": WALL,
    "wall_stiffness": K,
    "dt": DT,
}


def tensor(*values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def step(params: LCSParams, x: torch.Tensor, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    lam = solve_lcp(params.F, params.gap(x, u)).lam
    return params.next_state(x, u, lam), lam


# --- cart-pole ---


def test_cart_pole_moves_freely_between_the_walls():
    """One semi-implicit Euler step of p̈ = −(m g/M) θ + u/M, θ̈ = g (M + m)/(M l) θ − u/(M l), written out."""
    p, angle, v, omega, force = 0.02, 0.05, -0.3, 0.4, 1.7
    after, lam = step(cart_pole_between_walls(**CART_POLE), tensor(p, angle, v, omega), tensor(force))
    v_next = v + DT * (-POLE * G / MASS * angle + force / MASS)
    omega_next = omega + DT * (G * (MASS + POLE) / (MASS * LENGTH) * angle - force / (MASS * LENGTH))
    torch.testing.assert_close(after, tensor(p + DT * v_next, angle + DT * omega_next, v_next, omega_next))
    assert lam.tolist() == [0, 0]


def test_cart_pole_without_force_obeys_its_mass_matrix():
    """M(q) q̈ = gravity: the matrices of the Lagrangian, linearised, not their inverse as in the code."""
    params = cart_pole_between_walls(**CART_POLE)
    x, force = tensor(0.01, -0.04, 0.0, 0.0), 0.8
    acceleration = (step(params, x, tensor(force))[0] - x)[2:] / DT
    mass = tensor([MASS + POLE, POLE * LENGTH], [POLE * LENGTH, POLE * LENGTH**2])
    torch.testing.assert_close(mass @ acceleration, tensor(force, POLE * G * LENGTH * float(x[1])))


@pytest.mark.parametrize("side", [1, -1])
def test_cart_pole_leans_on_a_wall(side: int):
    """At rest the wall carries m g θ, and its force is stiffness × penetration."""
    angle = 0.2 * side
    weight = POLE * G * abs(angle)
    place = side * (WALL + weight / K) - LENGTH * angle
    x = tensor(place, angle, 0.0, 0.0)
    after, lam = step(cart_pole_between_walls(**CART_POLE), x, tensor(POLE * G * angle))
    torch.testing.assert_close(after, x)
    penetration = side * (place + LENGTH * angle) - WALL
    torch.testing.assert_close(lam, tensor(*([K * penetration, 0.0] if side > 0 else [0.0, K * penetration])))
    assert float(lam.max()) == pytest.approx(weight)


def test_cart_pole_balances_by_leaning_on_the_wall():
    """A pole that falls too fast for the motor comes back from the wall; with the wall out of reach it falls."""
    weights = QuadraticCost(
        torch.diag(tensor(10, 10, 1, 1)), 0.1 * torch.eye(1).double(), torch.diag(tensor(100, 100, 10, 10))
    )
    largest, fallen = {}, {}
    for wall in (0.1, 1e3):
        params = cart_pole_between_walls(wall_distance=wall)
        mpc = LCSMPCLayer(params, weights, horizon=25, u_min=-2.0, u_max=2.0)
        x, guess, forces = tensor(0.0, 0.1, 0.0, 0.7), None, []
        for _ in range(100):
            plan = mpc(x, guess=guess)
            assert plan.status == Status.CONVERGED
            guess = plan.shift()
            x, lam = step(params, x, plan.action)
            forces.append(float(lam.max()))
            if x[1].abs() > math.pi / 2:
                break
        largest[wall], fallen[wall] = max(forces), bool(x[1].abs() > 0.02)
    assert fallen == {0.1: False, 1e3: True}
    assert largest[0.1] > 0.1
    assert largest[1e3] == 0


# --- block along a wall ---


def test_block_rests_without_contact():
    x = tensor(0.0, 0.03, -0.1, 0.03)
    after, lam = step(block_along_wall(), x, tensor(0.01, -0.005))
    torch.testing.assert_close(after, x + tensor(0, 0, 0.01, -0.005))
    assert lam.tolist() == [0] * 5


def test_block_moves_with_the_fingertip_on_free_table():
    """Off the wall: λ₁ (h/β + 1/k) = approach along the normal, the block moves by (h/β) λ₁ along it."""
    beta, k, h, angle = 8.0, 150.0, 0.04, 0.6
    params = block_along_wall(damping=beta, stiffness=k, dt=h, face_angle=angle, friction=0.0)
    normal = tensor(math.cos(angle), -math.sin(angle))
    move = tensor(0.006, -0.001)
    after, lam = step(params, tensor(0.2, 0.05, 0.2, 0.05), move)
    force = float(normal @ move) / (h / beta + 1 / k)
    torch.testing.assert_close(lam[:2], tensor(force, 0.0))
    torch.testing.assert_close(after[:2], tensor(0.2, 0.05) + h / beta * force * normal)


def test_block_slides_steadily_along_the_wall():
    """Pushed at a constant speed: β v = λ₁ cos α − friction, λ₂ = λ₁ sin α = k·penetration, friction = μ λ₂ + ε λ₅."""
    beta, k, h, mu, angle = 10.0, 200.0, 0.05, 0.3, 0.5
    params = block_along_wall(beta, mu, angle, k, h)
    x = tensor(0.0, 0.0, 0.0, 0.0)
    for _ in range(300):
        before = x
        x, lam = step(params, x, tensor(0.004, 0.0))
    torch.testing.assert_close(x - before, tensor(0.004, 0.0, 0.004, 0.0), atol=1e-9, rtol=0)
    push, wall, backward, forward, slid = lam.tolist()
    assert wall == pytest.approx(push * math.sin(angle))
    assert wall == pytest.approx(-k * float(x[1]))
    assert backward == 0
    assert forward == pytest.approx(mu * wall + float(params.F[4, 4]) * slid)
    assert beta * 0.004 / h == pytest.approx(push * math.cos(angle) - forward)
    # λ₅ is the distance slid, up to the creep.
    assert slid == pytest.approx(0.004 - 0.01 * h / beta * forward)


def test_friction_holds_the_block():
    """A push within the friction cone sticks (but for 1 % creep); without friction the same push slides."""
    # Almost square to the wall: the push has tan(angle) = 7 times as much pressure as thrust.
    x, move, angle = tensor(0.0, 0.0, 0.0, 0.0), tensor(0.004, 0.0), 1.43
    stuck = step(block_along_wall(friction=0.3, face_angle=angle), x, move)[0]
    free = step(block_along_wall(friction=0.0, face_angle=angle), x, move)[0]
    assert 0 < float(stuck[0]) < 0.02 * float(free[0])


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("angle", [0.0, 0.5, 1.4])
def test_block_has_one_solution_for_every_friction(friction: float, angle: float):
    F = block_along_wall(friction=friction, face_angle=angle).F  # LCSParams refuses it otherwise
    assert float(torch.linalg.eigvalsh(F + F.mT)[0]) > 0


def test_block_arrives():
    """From off the wall to 15 cm along it, with the wall holding."""
    params = block_along_wall()
    cost = GoalCost.reach(4, 2, goal_weight=(100.0, 100.0), input_weight=1.0, pairs=[(0, 2)], pair_weight=1.0)
    mpc = LCSMPCLayer(params, cost, horizon=10, u_min=-0.01, u_max=0.01)
    x, goal, guess, pressed = tensor(0.0, 0.03, -0.02, 0.03), tensor(0.15, 0.0), None, False
    for _ in range(60):
        plan = mpc(x, goal, guess=guess)
        assert plan.status == Status.CONVERGED
        guess = plan.shift()
        x, lam = step(params, x, plan.action)
        pressed |= bool(lam[1] > 0.05)
    assert pressed
    torch.testing.assert_close(x[:2], goal, atol=4e-3, rtol=0)


# --- both ---


@pytest.mark.parametrize("make", [cart_pole_between_walls, block_along_wall])
def test_batches_converge(make):
    """Random states, contacts open and closed: every solve of the batched backend converges."""
    params = make()
    generator = torch.Generator().manual_seed(0)
    x0 = torch.rand(200, 4, generator=generator, dtype=torch.float64) * 0.2 - 0.1
    cost = QuadraticCost(torch.eye(4).double(), 0.1 * torch.eye(params.n_u).double(), 10 * torch.eye(4).double())
    plan = LCSMPCLayer(params, cost, horizon=8, u_min=-0.5, u_max=0.5)(x0)
    assert (plan.status == Status.CONVERGED).all()
    in_contact = (plan.lam > 1e-2).any(-1).any(-1)
    assert in_contact.any()
    assert not in_contact.all()


def test_gradients_of_the_physical_parameters():
    """Next state and planned action by the mass of the pole and the wall's stiffness, against finite differences."""
    x = tensor(0.05, 0.15, 0.0, 0.5)

    def next_state(mass: torch.Tensor, k: torch.Tensor) -> torch.Tensor:
        return step(cart_pole_between_walls(pole_mass=mass, wall_stiffness=k), x, tensor(0.3))[0]

    def action(mass: torch.Tensor, k: torch.Tensor) -> torch.Tensor:
        cost = QuadraticCost(torch.eye(4).double(), torch.eye(1).double(), 10 * torch.eye(4).double())
        params = cart_pole_between_walls(pole_mass=mass, wall_stiffness=k)
        return LCSMPCLayer(params, cost, horizon=5, u_min=-5.0, u_max=5.0)(x).action

    values = (tensor(0.1)[0].requires_grad_(), tensor(10.0)[0].requires_grad_())
    assert torch.autograd.gradcheck(next_state, values)
    assert torch.autograd.gradcheck(action, values, eps=1e-5, atol=1e-5, rtol=1e-3)


def test_gradients_of_friction_and_face():
    x, move = tensor(0.0, 0.0, 0.0, 0.0), tensor(0.004, 0.001)

    def next_state(friction: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
        return step(block_along_wall(friction=friction, face_angle=angle), x, move)[0]

    values = (tensor(0.2)[0].requires_grad_(), tensor(0.5)[0].requires_grad_())
    assert torch.autograd.gradcheck(next_state, values)
    torch.stack([v for v in next_state(*values)]).sum().backward()
    assert all(float(v.grad.abs()) > 0 for v in values)


@pytest.mark.parametrize(
    ("make", "argument"),
    [
        (cart_pole_between_walls, {"cart_mass": 0.0}),
        (cart_pole_between_walls, {"wall_stiffness": -1.0}),
        (cart_pole_between_walls, {"dt": float("nan")}),
        (block_along_wall, {"friction": -0.1}),
        (block_along_wall, {"face_angle": math.pi / 2}),
        (block_along_wall, {"stick": 0.0}),
    ],
)
def test_arguments_out_of_range_are_refused(make, argument):
    with pytest.raises(InvalidInputError, match=next(iter(argument))):
        make(**argument)
