"""An LCS in the frame of a body on a plane: what it learns at one pose of the body holds at all of them."""

import torch
from torch import Tensor

from difflcs._checks import check_tensor, describe
from difflcs._differentiation import runs_eagerly
from difflcs._modules import fresh
from difflcs.errors import InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.records import LCSParams

__all__ = ["BodyFrameLCS"]

_POSE = 3  # x, y, yaw


class BodyFrameLCS(LCSModel):
    """A learnable LCS in the frame of a body on a plane, an `LCSModule` whose system follows the body.

    A state is the pose (x, y, yaw) [m, m, rad] of the body, and after it points (x, y) of the same plane, such as
    fingertips; an action is vectors (x, y) in that plane. With z the points and v the vectors in the axes of the body,
    and R the rotation from these to the axes of the plane,

        x₊ = x + R (A z + B v + C λ + d),  0 ≤ λ ⊥ D z + E v + F λ + c ≥ 0,

    where R leaves the yaw as it is. So a push has the same effect wherever the body is and however it is turned, while
    a constant LCS has to be right for all poses at once. `params(x)` is this system with R as at x and z linearised
    there: exact at x, and in the steps of a plan as long as the body turns little.

    Args:
        n_x: number of states, 3 + 2 for each point, at least one.
        n_u: number of actions, 2 for each vector.
        n_lam: number of complementarity variables.
        stiffness: see `LCSModel`.
        **options: see `LCSModel`. The distance at which a point touches the body is in c, which should be learned.

    Raises:
        InvalidInputError: sizes that are no pose and points, or no vectors; and as for `LCSModel`.
    """

    kind = "BodyFrameLCS"
    batched = True
    """Whether the parameters may have batch dimensions, those of the states."""

    def __init__(self, n_x: int, n_u: int, n_lam: int, stiffness: float = 0.1, **options):
        if not (isinstance(n_x, int) and n_x > _POSE and n_x % 2 and isinstance(n_u, int) and n_u % 2 == 0):
            raise InvalidInputError(
                f"n_x, n_u: expected 3 + 2 for each point and 2 for each vector of the plane, got {describe(n_x)} and "
                f"{describe(n_u)}; the state is (x, y, yaw) of the body, then (x, y) of each point"
            )
        super().__init__(n_x, n_u, n_lam, stiffness, **options)
        unit, pairs = torch.eye(n_x, dtype=self.A.dtype), (n_x - _POSE) // 2
        places = torch.cat([unit[:2], unit[_POSE:]])
        self.register_buffer("_places", places, persistent=False)
        self.register_buffer("_yaw", unit[2:_POSE], persistent=False)
        self.register_buffer("_relative", unit[_POSE:] - places[:2].repeat(pairs, 1), persistent=False)

    _places: Tensor  # rows of the unit matrix: all places in a state, its yaw; and points from the body's place
    _yaw: Tensor
    _relative: Tensor

    @staticmethod
    def _shapes(x: int, u: int, m: int) -> dict[str, tuple[int, ...]]:
        return {**LCSModel._shapes(x, u, m), "A": (x, x - _POSE), "D": (m, x - _POSE)}

    @runs_eagerly
    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """Return the system at states x (..., n_x), differentiable in them and in the parameters; there is no context.

        Raises:
            InvalidInputError: no states.
        """
        if x is None:
            raise InvalidInputError("x: expected the states of the system, got None; pass them")
        check_tensor("x", x, [("n_x", self.n_x)])
        if self._forward_pre_hooks:
            fresh(self, self.parameter_names)
        cos, sin = x[..., 2].cos(), x[..., 2].sin()
        turn = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)  # axes of plane to body
        into = _blocks(turn, (self.n_x - _POSE) // 2)
        z = _apply(into, _apply(self._relative, x))
        by_yaw = torch.stack([z[..., 1::2], -z[..., ::2]], -1).flatten(-2)
        by_x = into @ self._relative + by_yaw.unsqueeze(-1) * self._yaw
        R = self._places.mT @ _blocks(turn.mT, len(self._places) // 2) @ self._places + self._yaw.mT @ self._yaw
        A = R @ self.A @ by_x + torch.eye(self.n_x, dtype=x.dtype, device=x.device)
        D, inputs = self.D @ by_x, _blocks(turn, self.n_u // 2)
        return LCSParams(
            A=A,
            B=R @ self.B @ inputs,
            C=R @ self.C,
            d=x + _apply(R, _apply(self.A, z) + self.d) - _apply(A, x),
            D=D,
            E=self.E @ inputs,
            F=self.F,
            c=self.c + _apply(self.D, z) - _apply(D, x),
        )


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _blocks(matrix: Tensor, count: int) -> Tensor:
    """Repeat matrices (..., 2, 2) on a diagonal of `count` blocks."""
    unit = torch.eye(count, dtype=matrix.dtype, device=matrix.device)
    return (unit[:, None, :, None] * matrix[..., None, :, None, :]).flatten(-2).flatten(-3, -2)
