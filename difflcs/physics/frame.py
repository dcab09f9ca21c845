"""An LCS in the frame of a body on a plane: what it learns at one pose of the body holds at all of them."""

from typing import Any, Self

import torch
from torch import Tensor, nn

from difflcs._checks import check_integer, check_kind, check_list, check_shape, check_tensor
from difflcs._differentiation import runs_eagerly
from difflcs._modules import fresh
from difflcs.errors import InvalidInputError
from difflcs.lcs import LCSModel
from difflcs.physics.frame_search import Frame, find_frame
from difflcs.records import SYSTEM, LCSParams

__all__ = ["BodyFrameLCS"]

_KNOWN = ("units", "yaw", "seen", "turn", "turn_u")  # parameters that are not learned


class BodyFrameLCS(LCSModel):
    """A learnable LCS in the frame of a body on a plane, an `LCSModule` whose system follows the body.

    A `Frame` says which numbers of a state are the pose of the body and points of the same plane, such as fingertips,
    and which numbers of an action are vectors in it. With z the state as seen from the body, v the action in its axes,
    and R the rotation from these to the axes of the plane,

        x₊ = x + R (A z + B v + C λ + d),  0 ≤ λ ⊥ D z + E v + F λ + c ≥ 0.

    In z, points count from the body and the pose is zero; R leaves plain numbers and the yaw as they are. So a push has
    the same effect wherever the body is and however it is turned, while a constant LCS has to be right for all poses at
    once. `params(x)` is this system with R as at x and z linearised there: exact at x, and in the steps of a plan as
    long as the body turns little. Without a frame, z is x, v is u, R is 1, and this is a constant LCS. The parameters
    are these matrices in the units of the data that they are fitted to, see `take_units`.

    Args:
        n_x: number of states.
        n_u: number of actions.
        n_lam: number of complementarity variables.
        stiffness: see `LCSModel`.
        frame: the columns of the body; None: they are not known, see `take_frame`.
        **options: see `LCSModel`. The distance at which a point touches the body is in c, which should be learned.

    Raises:
        InvalidInputError: a frame with other columns than these; and as for `LCSModel`.
    """

    kind = "BodyFrameLCS"
    batched = True
    """Whether the parameters may have batch dimensions, those of the states."""

    def __init__(
        self, n_x: int, n_u: int, n_lam: int, stiffness: float = 0.1, *, frame: Frame | None = None, **options
    ):
        super().__init__(n_x, n_u, n_lam, stiffness, **options)
        for name in _KNOWN:
            getattr(self, name).requires_grad_(False).zero_()
        self.units[n_x:], self.seen[range(n_x), range(n_x)] = 1.0, 1.0
        self._initial = {name: value.clone() for name, value in self.state_dict().items() if name != "action_support"}
        self._start(frame)

    units: nn.Parameter
    """Units of the parameters, see `take_units`: mean and scale of z, scales of v and of the change of the state."""
    yaw: nn.Parameter  # (n_x,) picks the yaw from a state; what is known of the frame is saved, and not learned
    seen: nn.Parameter  # (n_x, n_x) makes points of a state count from the body, and its pose zero
    turn: nn.Parameter  # (n_x, n_x) turns all pairs of a state by a right angle, and makes plain numbers zero
    turn_u: nn.Parameter  # (n_u, n_u) the same of an action

    @staticmethod
    def _shapes(x: int, u: int, m: int) -> dict[str, tuple[int, ...]]:
        frame = {"units": (3 * x + u,), "yaw": (x,), "seen": (x, x), "turn": (x, x), "turn_u": (u, u)}
        return {**LCSModel._shapes(x, u, m), **frame}

    @torch.no_grad()
    def _start(self, frame: Frame | None) -> None:
        """Begin with the first parameters in a frame."""
        for name, value in self._initial.items():
            getattr(self, name).copy_(value)
        if frame is None:
            return
        check_kind("frame", frame, Frame)
        points, vectors = (
            check_list(f"frame.{name}", getattr(frame, name), "give pairs of columns", tuple)
            for name in Frame._fields[2:]
        )
        pairs = (check_kind("frame.place", frame.place, tuple, "give two columns"), *points)
        states, inputs = [frame.yaw, *sum(pairs, ())], [*sum(vectors, ())]
        for used, size in ((states, self.n_x), (inputs, self.n_u)):
            apart = {check_integer("frame", column) for column in used} & {*range(size)}
            if len(apart) < len(used) or any(len(pair) != 2 for pair in (*pairs, *vectors)):
                raise InvalidInputError(f"frame: expected columns below {size}, each of them once, got {frame}")
        self.yaw[frame.yaw] = 1.0
        self.seen[states[:3]] = 0.0
        for matrix, turned in ((self.turn, pairs), (self.turn_u, frame.vectors)):
            for i, j in turned:
                matrix[j, i], matrix[i, j] = 1.0, -1.0
        for pair in frame.points:
            self.seen[pair, frame.place] = -1.0

    @property
    def frame(self) -> Frame | None:
        """The columns of the body; None: this is a constant LCS."""
        if not bool(self.yaw.any()):
            return None
        pairs, vectors = (sorted((i, j) for j, i in (m > 0).nonzero().tolist()) for m in (self.turn, self.turn_u))
        place = next(pair for pair in pairs if not bool(self.seen[pair[0]].any()))
        pairs.remove(place)
        return Frame(int(self.yaw.argmax()), place, tuple(pairs), tuple(vectors))

    def take_frame(self, x: Tensor, u: Tensor, x_next: Tensor) -> bool:
        """Look for the frame in transitions, see `find_frame`. If it is another one, start anew in it and return True.

        Args:
            x: (N, n_x) states.
            u: (N, n_u) actions.
            x_next: (N, n_x) next states.
        """
        frame = find_frame(*self._transitions(x=x, u=u, x_next=x_next))
        if frame is None or frame == self.frame:
            return False
        self._start(frame)
        return True

    def _transitions(self, **given: Tensor) -> list[Tensor]:
        """Check transitions (N, n_x), (N, n_u), (N, n_x), and convert them to the dtype of the parameters."""
        N = check_shape("x", given["x"], "N n_x", {"n_x": self.n_x}).shape[0]
        sizes, of = {"n_x": self.n_x, "n_u": self.n_u, "N": N}, {"u": "N n_u"}
        return [check_shape(name, value, of.get(name, "N n_x"), sizes).to(self.A) for name, value in given.items()]

    @runs_eagerly
    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """Return the system at states x (..., n_x), differentiable in them and in the parameters; there is no context.

        Raises:
            InvalidInputError: no states.
        """
        if x is None:
            raise InvalidInputError("x: expected the states of the system, got None; pass them")
        x = check_tensor("x", x, [("n_x", self.n_x)]).to(self.A)
        if self._forward_pre_hooks:
            fresh(self, self.parameter_names)
        yaw = x @ self.yaw
        R = _rotation(self.turn, yaw)
        z = _apply(R.mT @ self.seen, x)
        by_x = R.mT @ self.seen - _apply(self.turn, z).unsqueeze(-1) * self.yaw
        own = self._in_si()
        A = R @ own["A"] @ by_x + torch.eye(self.n_x, dtype=x.dtype, device=x.device)
        D, inputs = own["D"] @ by_x, _rotation(self.turn_u, yaw).mT
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
        x, u, x_next = self._transitions(x=x, u=u, x_next=x_next)
        with torch.no_grad():
            old, yaw = self._in_si(), x @ self.yaw
            back = _rotation(self.turn, yaw).mT
            z, change = _apply(back @ self.seen, x), _apply(back, x_next - x)
            v = _apply(_rotation(self.turn_u, yaw).mT, u)
            # What moves less than a micrometre rests, and is no unit.
            units = [z.mean(0), *(one.std(0, correction=0).clamp_min(1e-6) for one in (z, v, change))]
            drawn = bool((self.units[self.n_x :] == 1).all())
            self.units.copy_(torch.cat(units))
            middle, by_z, by_v, by_change = units
            if not drawn:
                self.d.copy_(old["d"] + _apply(old["A"], middle))
                self.c.copy_(old["c"] + _apply(old["D"], middle))
                for name, unit in self._scales().items():
                    getattr(self, name).copy_((self.d if name == "d" else old[name]) / unit)
            seen = (z - middle) / by_z
            return seen, v / by_v, seen + change / by_change

    def _scales(self) -> dict[str, Tensor]:
        """Return the units of the matrices."""
        _, z, v, change = self.units.split([self.n_x, self.n_x, self.n_u, self.n_x])
        rows = change[:, None]
        return {"A": rows / z, "B": rows / v, "C": rows, "d": change, "D": 1 / z, "E": 1 / v}

    def _in_si(self) -> dict[str, Tensor]:
        """Return the matrices in metres and radians."""
        own = {name: getattr(self, name) * unit for name, unit in self._scales().items()}
        own["d"] = own["d"] - _apply(own["A"], self.units[: self.n_x])
        return {**own, "F": self.F, "c": self.c - _apply(own["D"], self.units[: self.n_x])}

    def at_rest(self) -> LCSParams:
        """Return the system of the transitions of `take_units`."""
        system = {name: getattr(self, name) for name in SYSTEM}
        return LCSParams(**{**system, "A": self.A + torch.eye(self.n_x, dtype=self.A.dtype, device=self.A.device)})

    @classmethod
    def from_params(cls, params: LCSParams, stiffness: float | None = None) -> Self:
        """See `LCSModel`. There is no frame."""
        model: Any = super().from_params(params, stiffness)
        with torch.no_grad():
            model.A -= torch.eye(model.n_x, dtype=model.A.dtype, device=model.A.device)
        return model


def _rotation(turn: Tensor, angle: Tensor) -> Tensor:
    """Return the (..., n, n) rotations by angles (...) of the pairs that `turn` turns by a right angle."""
    sin, cos = angle.sin()[..., None, None], angle.cos()[..., None, None]
    return torch.eye(len(turn), dtype=turn.dtype, device=turn.device) + sin * turn + (1 - cos) * (turn @ turn)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
