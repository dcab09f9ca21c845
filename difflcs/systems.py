"""Two small classic systems with contact: a cart-pole between soft walls, a block pushed along a wall.

They are linear complementarity systems from first principles, not learned: examples, test cases, and a pattern for your
own. Each returns `LCSParams`; `LCSModel.from_params` makes a model of them, to simulate or to learn from. Beside them,
`pushing_cost` is the cost of the paper's own task.

Time steps are semi-implicit: forces change the velocity, the new velocity moves the position, and the gap of a contact
is that at the *end* of the step (Stewart & Trinkle 1996). So a contact acts in the step in which it closes, and
F = (effect of the forces on the gaps) + compliance is symmetric positive definite up to friction.

Every argument of a system is a number or a tensor of one element; the matrices are differentiable in the tensors.
"""

import torch
from torch import Tensor

from difflcs._checks import check_number
from difflcs.cost import GoalCost
from difflcs.records import LCSParams

__all__ = ["block_along_wall", "cart_pole_between_walls", "pushing_cost"]

Number = float | Tensor


def cart_pole_between_walls(
    cart_mass: Number = 1.0,
    pole_mass: Number = 0.1,
    pole_length: Number = 0.5,
    wall_distance: Number = 0.1,
    wall_stiffness: Number = 10.0,
    gravity: Number = 9.81,
    dt: Number = 0.02,
) -> LCSParams:
    """Make an upside-down pendulum on a cart, linearised upright, whose tip may lean on two soft walls.

    | index | state x | unit |
    |-------|---------|------|
    | 0 | position of the cart p | m |
    | 1 | angle of the pole θ, 0 upright, positive towards +p | rad |
    | 2 | velocity of the cart | m/s |
    | 3 | angular velocity of the pole | rad/s |

    The action u is the force on the cart [N], λ = (force of the right wall, of the left wall) on the tip [N]. With the
    tip at p + l θ and walls at ±w, M = cart_mass, m = pole_mass, l = pole_length, k = wall_stiffness,

        p̈ = −(m g/M) θ + u/M,   θ̈ = g (M + m)/(M l) θ − u/(M l) + (λ_left − λ_right)/(m l),
        0 ≤ λ_right ⊥ w − (p + l θ) + λ_right/k ≥ 0,   0 ≤ λ_left ⊥ w + (p + l θ) + λ_left/k ≥ 0.

    A wall is a spring: its force is k times how far the tip has gone in at the end of the step.

    Source: Marcucci & Tedrake, "Warm start of mixed-integer programs for model predictive control of hybrid systems"
    (2021); parameters of Aydinoglu, Preciado & Posa, "Contact-aware controller design for complementarity systems"
    (ICRA 2020), whose angle has the other sign.

    Args:
        cart_mass: M [kg], > 0.
        pole_mass: m [kg] at the tip, > 0.
        pole_length: l [m], > 0.
        wall_distance: w [m] of each wall from the middle, ≥ 0.
        wall_stiffness: k [N/m], > 0.
        gravity: g [m/s²], ≥ 0.
        dt: time step [s], > 0.

    Returns:
        `LCSParams` with n_x 4, n_u 1, n_lam 2, float64.

    Raises:
        InvalidInputError: an argument is out of its range.
    """
    M = _number("cart_mass", cart_mass, strict=True)
    m = _number("pole_mass", pole_mass, strict=True)
    L = _number("pole_length", pole_length, strict=True)
    k = _number("wall_stiffness", wall_stiffness, strict=True)
    h = _number("dt", dt, strict=True)
    w, g = _number("wall_distance", wall_distance), _number("gravity", gravity)
    gravity_effect = _matrix([[0, -m * g / M], [0, g * (M + m) / (M * L)]])  # on (p̈, θ̈), from (p, θ)
    force_effect = _matrix([[1 / M], [-1 / (M * L)]])
    wall_effect = _matrix([[0, 0], [-1 / (m * L), 1 / (m * L)]])
    eye = torch.eye(2, dtype=torch.float64)
    A = torch.cat([torch.cat([eye + h * h * gravity_effect, h * eye], 1), torch.cat([h * gravity_effect, eye], 1)])
    B, C = (torch.cat([h * h * effect, h * effect]) for effect in (force_effect, wall_effect))
    gaps = _matrix([[-1, -L, 0, 0], [1, L, 0, 0]])
    return LCSParams(
        A=A,
        B=B,
        C=C,
        d=torch.zeros(4, dtype=torch.float64),
        D=gaps @ A,
        E=gaps @ B,
        F=gaps @ C + eye / k,
        c=torch.stack([w, w]),
    )


def block_along_wall(
    damping: Number = 10.0,
    friction: Number = 0.3,
    face_angle: Number = 0.5,
    stiffness: Number = 200.0,
    dt: Number = 0.05,
    stick: float = 0.01,
) -> LCSParams:
    """Make a fingertip that pushes a block over an oiled table, on its slanted rear face, along a wall with friction.

    | index | state x | unit |
    |-------|---------|------|
    | 0 | block b, along the wall | m |
    | 1 | block b, away from the wall; 0 touches it | m |
    | 2 | fingertip f, along the wall | m |
    | 3 | fingertip f, away from the wall | m |

    The action u is the displacement of the fingertip in one step [m], (2,). The motion is slow: inertia does not count,
    the oil resists with `damping` times the velocity. The face has the normal n = (cos α, −sin α) and is touched where
    n·(b − f) = 0, so that a push along the wall also presses the block against it; the block does not turn, and the
    face has no end. With the force of the fingertip λ₁, of the wall λ₂, friction λ₃ − λ₄ along the wall, all in N, the
    displacement Δ = b₊ − b, oil β = damping, step h,

        Δ = (h/β) (λ₁ n + (λ₃ − λ₄, λ₂)),   f₊ = f + u,
        0 ≤ λ₁ ⊥ n·(b₊ − f₊) + λ₁/k ≥ 0         the fingertip pushes and never pulls,
        0 ≤ λ₂ ⊥ (b₊)₂ + λ₂/k ≥ 0               neither does the wall,
        0 ≤ λ₃ ⊥  Δ₁ + λ₅ + δ λ₃ ≥ 0            friction against sliding backwards,
        0 ≤ λ₄ ⊥ −Δ₁ + λ₅ + δ λ₄ ≥ 0            and forwards,
        0 ≤ λ₅ ⊥ μ λ₂ − λ₃ − λ₄ + ε λ₅ ≥ 0      at most μ times the pressure; λ₅ is the distance slid [m].

    This is Coulomb's law but for two terms that make F + Fᵀ ≻ 0, without which friction may have several solutions:
    δ = stick·h/β lets a sticking block creep (by 1 % of the way that the oil alone would let it go), and ε λ₅, with
    ε = μ²/2·(N⁻¹)₂₂ where N is F without its last row and column, adds a friction that grows with the speed (F + Fᵀ ≻ 0
    needs more than half this ε).

    Source: time stepping with friction after Stewart & Trinkle (1996); quasi-static pushing after Lynch & Mason (1996).

    Args:
        damping: β [N s/m], > 0.
        friction: μ of block and wall, ≥ 0.
        face_angle: α [rad], 0 for a face across the wall, below π/2.
        stiffness: k [N/m] of fingertip and wall, > 0.
        dt: h [s], > 0.
        stick: how much a sticking block creeps, > 0.

    Returns:
        `LCSParams` with n_x 4, n_u 2, n_lam 5, float64.

    Raises:
        InvalidInputError: an argument is out of its range.
    """
    beta = _number("damping", damping, strict=True)
    k = _number("stiffness", stiffness, strict=True)
    h = _number("dt", dt, strict=True)
    mu, alpha = _number("friction", friction), _number("face_angle", face_angle)
    check_number("pi/2 - face_angle", torch.pi / 2 - float(alpha.detach()), strict=True)
    stick = check_number("stick", stick, strict=True)
    cos, sin = alpha.cos(), alpha.sin()
    directions = _matrix([[cos, -sin], [0, 1], [1, 0], [-1, 0]])  # of λ₁ … λ₄, and of what their gaps measure
    mobility = h / beta
    compliance = torch.diag(torch.stack([1 / k, 1 / k, stick * mobility, stick * mobility]))
    N = mobility * directions @ directions.mT + compliance
    epsilon = 0.5 * mu**2 * torch.linalg.inv(N)[1, 1] + 1e-9  # the constant only matters for μ = 0
    F = torch.cat(
        [
            torch.cat([N, _matrix([[0], [0], [1], [1]])], 1),
            torch.stack([torch.zeros_like(mu), mu, -torch.ones_like(mu), -torch.ones_like(mu), epsilon]).unsqueeze(0),
        ]
    )
    zero = torch.zeros(2, 5, dtype=torch.float64)
    return LCSParams(
        A=torch.eye(4, dtype=torch.float64),
        B=_matrix([[0, 0], [0, 0], [1, 0], [0, 1]]),
        C=torch.cat([mobility * torch.cat([directions.mT, zero[:, :1]], 1), zero]),
        d=torch.zeros(4, dtype=torch.float64),
        D=_matrix([[cos, -sin, -cos, sin], [0, 1, 0, 0], [0] * 4, [0] * 4, [0] * 4]),
        E=_matrix([[-cos, sin], [0, 0], [0, 0], [0, 0], [0, 0]]),
        F=F,
        c=torch.zeros(5, dtype=torch.float64),
    )


def pushing_cost() -> GoalCost:
    """Cost of the paper's MPC, which pushes an object on a table with three fingertips (Eq. 13).

    Stage: 10 Σ‖tip − object‖² + 200 ‖object − goal‖² + 0.3 (yaw − goal yaw)² + 200 ‖u‖²; final: 6, 200 and 1.5.

    Returns:
        A `GoalCost` of states (9,): x, y [m] and yaw [rad] of the object, x, y [m] of the tips; actions (6,): steps of
        the tips [m]; goals (x [m], y [m], yaw [rad]).
    """
    return GoalCost.reach(
        9,
        6,
        goal_weight=(200.0, 200.0, 0.3),
        goal_weight_final=(200.0, 200.0, 1.5),
        input_weight=200.0,
        pairs=[(3 + 2 * finger + axis, axis) for finger in range(3) for axis in range(2)],
        pair_weight=10.0,
        pair_weight_final=6.0,
    )


def _number(name: str, value: Number, strict: bool = False) -> Tensor:
    """Check a scalar and return it as a float64 tensor on the CPU, gradient history kept."""
    if not isinstance(value, Tensor):
        value = check_number(name, value, strict=strict)
    tensor = torch.as_tensor(value, dtype=torch.float64).reshape(())
    check_number(name, float(tensor.detach()), strict=strict)
    return tensor


def _matrix(rows: list[list[Number]] | list[list[int]]) -> Tensor:
    """Make a float64 matrix of numbers and scalar tensors, differentiable in the tensors."""
    return torch.stack([torch.stack([torch.as_tensor(v, dtype=torch.float64) for v in row]) for row in rows])
