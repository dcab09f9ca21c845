"""An LCS in the frame of a body on a plane: what it learns at one pose of the body holds at all of them."""

import torch
from torch import Tensor, nn

from difflcs._checks import check_tensor, describe
from difflcs._differentiation import runs_eagerly
from difflcs._modules import fresh
from difflcs.errors import InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.records import SYSTEM, LCSParams

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
    there: exact at x, and in the steps of a plan as long as the body turns little. The parameters are these matrices in
    the units of the data that they are fitted to, see `take_units`.

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
        self.units.requires_grad_(False).fill_(1.0)[: 2 * pairs] = 0.0

    units: nn.Parameter
    """Units of the parameters, see `take_units`: mean and scale of z, scales of v and of the change of the state."""
    _places: Tensor  # rows of the unit matrix: all places in a state, its yaw; and points from the body's place
    _yaw: Tensor
    _relative: Tensor

    @staticmethod
    def _shapes(x: int, u: int, m: int) -> dict[str, tuple[int, ...]]:
        points = x - _POSE
        return {**LCSModel._shapes(x, u, m), "A": (x, points), "D": (m, points), "units": (2 * points + u + x,)}

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
        turn = _turn(x)
        into = _blocks(turn, (self.n_x - _POSE) // 2)
        z = _apply(into, _apply(self._relative, x))
        by_yaw = torch.stack([z[..., 1::2], -z[..., ::2]], -1).flatten(-2)
        by_x = into @ self._relative + by_yaw.unsqueeze(-1) * self._yaw
        R = self._to_plane(turn)
        own = self._in_si()
        A = R @ own["A"] @ by_x + torch.eye(self.n_x, dtype=x.dtype, device=x.device)
        D, inputs = own["D"] @ by_x, _blocks(turn, self.n_u // 2)
        return LCSParams(
            A=A,
            B=R @ own["B"] @ inputs,
            C=R @ own["C"],
            d=x + _apply(R, _apply(own["A"], z) + own["d"]) - _apply(A, x),
            D=D,
            E=own["E"] @ inputs,
            F=own["F"],
            c=own["c"] + _apply(own["D"], z) - _apply(D, x),
        )

    def take_units(self, x: Tensor, u: Tensor, x_next: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Give the parameters the units of some transitions, for a fit to them: in metres it would leave contact out.

        Only the first call changes the system. `at_rest()` is that of all transitions that are returned, and a loss
        takes a third of the time of one with `params(x)`.

        Args:
            x: (N, n_x) states.
            u: (N, n_u) actions.
            x_next: (N, n_x) next states.

        Returns:
            The transitions in these units, standardised, as seen from the body, itself at the origin.
        """
        with torch.no_grad():
            turn, old = _turn(x), self._in_si()
            z = _apply(_blocks(turn, (self.n_x - _POSE) // 2) @ self._relative, x)
            v, change = _apply(_blocks(turn, self.n_u // 2), u), _apply(self._to_plane(turn).mT, x_next - x)
            # What moves less than a micrometre rests, and is no unit.
            units = [z.mean(0), *(one.std(0, correction=0).clamp_min(1e-6) for one in (z, v, change))]
            drawn = bool((self.units[self.n_x - _POSE :] == 1).all())
            self.units.copy_(torch.cat(units))
            middle, by_z, by_v, by_change = units
            if not drawn:
                self.d.copy_(old["d"] + _apply(old["A"], middle))
                self.c.copy_(old["c"] + _apply(old["D"], middle))
                for name, unit in self._scales().items():
                    getattr(self, name).copy_((self.d if name == "d" else old[name]) / unit)
            seen = torch.cat([torch.zeros_like(x[:, :_POSE]), (z - middle) / by_z], -1)
            return seen, v / by_v, seen + change / by_change

    def _scales(self) -> dict[str, Tensor]:
        """Return the units of the matrices."""
        points = self.n_x - _POSE
        _, z, v, change = self.units.split([points, points, self.n_u, self.n_x])
        rows = change[:, None]
        return {"A": rows / z, "B": rows / v, "C": rows, "d": change, "D": 1 / z, "E": 1 / v}

    def _in_si(self) -> dict[str, Tensor]:
        """Return the matrices in metres and radians."""
        own = {name: getattr(self, name) * unit for name, unit in self._scales().items()}
        own["d"] = own["d"] - _apply(own["A"], self.units[: self.n_x - _POSE])
        return {**own, "F": self.F, "c": self.c - _apply(own["D"], self.units[: self.n_x - _POSE])}

    def at_rest(self) -> LCSParams:
        """Return the system in the units of `take_units`, of states whose pose is zero."""
        A = self.A @ self._relative + torch.eye(self.n_x, dtype=self.A.dtype, device=self.A.device)
        system = {name: getattr(self, name) for name in SYSTEM}
        return LCSParams(**{**system, "A": A, "D": self.D @ self._relative})

    def _to_plane(self, turn: Tensor) -> Tensor:
        """Return R of the axes of the plane in those of the body."""
        return self._places.mT @ _blocks(turn.mT, len(self._places) // 2) @ self._places + self._yaw.mT @ self._yaw


def _turn(x: Tensor) -> Tensor:
    """Return the (..., 2, 2) matrices from the axes of the plane to those of the body."""
    cos, sin = x[..., 2].cos(), x[..., 2].sin()
    return torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _blocks(matrix: Tensor, count: int) -> Tensor:
    """Repeat matrices (..., 2, 2) on a diagonal of `count` blocks."""
    unit = torch.eye(count, dtype=matrix.dtype, device=matrix.device)
    return (unit[:, None, :, None] * matrix[..., None, :, None, :]).flatten(-2).flatten(-3, -2)
