"""The two ready-made systems against solutions known by hand."""

import math

import pytest
import torch

from difflcs.systems import block_along_wall, cart_pole_between_walls
from tests.conftest import tensor

G, MASS, POLE, LENGTH, WALL, K, DT = 9.81, 1.3, 0.2, 0.6, 0.15, 25.0, 0.03
CART_POLE = {
    "cart_mass": MASS,
    "pole_mass": POLE,
    "pole_length": LENGTH,
    "wall_distance": WALL,
    "wall_stiffness": K,
    "dt": DT,
}


def test_cart_pole_moves_freely_between_the_walls():
    """One semi-implicit Euler step of p̈ = −(m g/M) θ + u/M, θ̈ = g (M + m)/(M l) θ − u/(M l), written out."""
    p, angle, v, omega, force = 0.02, 0.05, -0.3, 0.4, 1.7
    after, lam = cart_pole_between_walls(**CART_POLE).step(tensor([p, angle, v, omega]), tensor([force]))
    v_next = v + DT * (-POLE * G / MASS * angle + force / MASS)
    omega_next = omega + DT * (G * (MASS + POLE) / (MASS * LENGTH) * angle - force / (MASS * LENGTH))
    torch.testing.assert_close(after, tensor([p + DT * v_next, angle + DT * omega_next, v_next, omega_next]))
    assert lam.tolist() == [0, 0]


@pytest.mark.parametrize("side", [1, -1])
def test_cart_pole_leans_on_a_wall(side: int):
    """At rest the wall carries m g θ, and its force is stiffness × penetration."""
    angle = 0.2 * side
    weight = POLE * G * abs(angle)
    place = side * (WALL + weight / K) - LENGTH * angle
    x = tensor([place, angle, 0.0, 0.0])
    after, lam = cart_pole_between_walls(**CART_POLE).step(x, tensor([POLE * G * angle]))
    torch.testing.assert_close(after, x)
    penetration = side * (place + LENGTH * angle) - WALL
    torch.testing.assert_close(lam, tensor([*([K * penetration, 0.0] if side > 0 else [0.0, K * penetration])]))
    assert float(lam.max()) == pytest.approx(weight)


def test_block_moves_with_the_fingertip_on_free_table():
    """Off the wall: λ₁ (h/β + 1/k) = approach along the normal, the block moves by (h/β) λ₁ along it."""
    beta, k, h, angle = 8.0, 150.0, 0.04, 0.6
    params = block_along_wall(damping=beta, stiffness=k, dt=h, face_angle=angle, friction=0.0)
    normal = tensor([math.cos(angle), -math.sin(angle)])
    move = tensor([0.006, -0.001])
    after, lam = params.step(tensor([0.2, 0.05, 0.2, 0.05]), move)
    force = float(normal @ move) / (h / beta + 1 / k)
    torch.testing.assert_close(lam[:2], tensor([force, 0.0]))
    torch.testing.assert_close(after[:2], tensor([0.2, 0.05]) + h / beta * force * normal)


def test_block_slides_steadily_along_the_wall():
    """Pushed at a constant speed: β v = λ₁ cos α − friction, λ₂ = λ₁ sin α = k·penetration, friction = μ λ₂ + ε λ₅."""
    beta, k, h, mu, angle = 10.0, 200.0, 0.05, 0.3, 0.5
    params = block_along_wall(beta, mu, angle, k, h)
    x = tensor([0.0, 0.0, 0.0, 0.0])
    for _ in range(300):
        before = x
        x, lam = params.step(x, tensor([0.004, 0.0]))
    torch.testing.assert_close(x - before, tensor([0.004, 0.0, 0.004, 0.0]), atol=1e-9, rtol=0)
    push, wall, backward, forward, slid = lam.tolist()
    assert wall == pytest.approx(push * math.sin(angle))
    assert wall == pytest.approx(-k * float(x[1]))
    assert backward == 0
    assert forward == pytest.approx(mu * wall + float(params.F[4, 4]) * slid)
    assert beta * 0.004 / h == pytest.approx(push * math.cos(angle) - forward)
    # λ₅ is the distance slid, up to the creep.
    assert slid == pytest.approx(0.004 - 0.01 * h / beta * forward)


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("angle", [0.0, 0.5, 1.4])
def test_block_has_one_solution_for_every_friction(friction: float, angle: float):
    F = block_along_wall(friction=friction, face_angle=angle).F  # LCSParams refuses it otherwise
    assert float(torch.linalg.eigvalsh(F + F.mT)[0]) > 0
