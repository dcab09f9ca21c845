"""ContactLCS: contact physics whose numbers are learned."""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor, nn

from difflcs._checks import check_kind, check_list
from difflcs._differentiation import runs_eagerly
from difflcs._modules import fresh
from difflcs.errors import InvalidInputError
from difflcs.physics.planar import PlanarPushing, PositionDrive
from difflcs.physics.shapes import Circle, Polygon, Shape, Union
from difflcs.records import LCSParams

LEARNABLE = ("center_of_mass", "gyration", "friction", "compliance", "radius", "gain", "drive_compliance", "outline")
"""The quantities that a `ContactLCS` can learn."""


class ContactLCS(nn.Module):
    """A body pushed by discs whose physics is learned: a dozen parameters, where an `LCSModel` has hundreds.

    It is an `LCSModule`. Its system follows the state: contacts are where the shapes are. So it is learned from little
    data, by `violation_loss` or `prediction_loss` from transitions, or through an `LCSMPCLayer` by PPO.

    All parameters are dimensionless and of one scale, so that one learning rate suffices: logarithms of positive
    quantities, and distances as fractions of `length`. They start at zero, at the physics that was passed.

    Args:
        physics: the known or guessed physics.
        learn: the quantities to learn, among `center_of_mass` (2), `gyration` (1), `friction` (one for each disc),
            `compliance` (one for each disc), `radius` of each disc, `gain` of a `PositionDrive` (each disc and axis)
            and its `drive_compliance` (each disc), and `outline`: each side of a polygon moves along its normal, each
            circle has another radius.

    Attributes:
        n_x, n_u, n_lam: numbers of states, actions and contact forces.

    Raises:
        DTypeError, InvalidInputError: no `PlanarPushing`, an unknown name, one named twice, gain or compliance of
            another drive, or friction or a compliance of the drive where there is none.
    """

    def __init__(self, physics: PlanarPushing, learn: Sequence[str] = LEARNABLE[:-2]):
        super().__init__()
        check_kind("physics", physics, PlanarPushing, "build one from shapes")
        self.learn = tuple(check_list("learn", learn, f"name some of {', '.join(LEARNABLE)}"))
        unknown = [name for name in self.learn if not isinstance(name, str) or name not in LEARNABLE]
        if unknown or len(set(self.learn)) < len(self.learn):
            raise InvalidInputError(
                f"learn: expected some of {', '.join(LEARNABLE)}, each once, got {learn!r:.200}; name what is uncertain"
            )
        if "friction" in self.learn and physics.frictionless:
            raise InvalidInputError(
                "learn: expected friction above 0 where it is learned, got friction 0 in the physics; guess a value, "
                "or leave it out"
            )
        if {"gain", "drive_compliance"} & set(self.learn) and not isinstance(physics.drive, PositionDrive):
            raise InvalidInputError(
                f"learn: expected a PositionDrive where its gain or compliance is learned, got "
                f"{type(physics.drive).__name__}; leave them out"
            )
        if "drive_compliance" in self.learn and not bool((_drive(physics)[1] > 0).all()):
            raise InvalidInputError(
                "learn: expected a drive with compliance above 0 where it is learned, got 0; guess a value, or leave "
                "it out"
            )
        self.guess = physics
        self.n_x, self.n_u, self.n_lam = physics.n_x, physics.n_u, physics.n_lam
        discs = physics.n_discs
        sizes = {
            "center_of_mass": (2,),
            "gyration": (),
            "friction": (discs,),
            "compliance": (discs,),
            "radius": (discs,),
            "gain": (discs, 2),
            "drive_compliance": (discs, 1),
            "outline": (_count_sides(physics.shape),),
        }
        self.change = nn.ParameterDict(
            {name: nn.Parameter(torch.zeros(sizes[name], dtype=torch.float64)) for name in self.learn}
        )

    @property
    def physics(self) -> PlanarPushing:
        """The current physics, differentiable in the learned parameters."""
        guess, change = self.guess, {name: v.cpu() for name, v in fresh(self.change, self.learn).items()}
        length = guess.length or 1.0
        values: dict[str, Any] = {name: getattr(guess, name) for name in ("center_of_mass", "gyration", "length")}
        values |= {
            name: getattr(guess, name) * change[name].exp()
            for name in ("gyration", "friction", "compliance", "radius")
            if name in change
        }
        if "center_of_mass" in change:
            values["center_of_mass"] = guess.center_of_mass + length * change["center_of_mass"]
        if "gain" in change or "drive_compliance" in change:
            drive = zip(_drive(guess), ("gain", "drive_compliance"), strict=True)
            values["drive"] = PositionDrive(*(v * change[name].exp() if name in change else v for v, name in drive))
        if "outline" in change:
            values["shape"] = _move_sides(guess.shape, iter(length * change["outline"]))
        return guess.replace(**values) if change else guess

    @runs_eagerly
    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """The system at states x (..., n_x); there is no context."""
        return self.physics.params(x, context)

    def summary(self) -> dict[str, Any]:
        """Return the learned quantities as numbers in the units of the physics."""
        now = self.physics
        learned: dict[str, Any] = {}
        for name in self.learn:
            value: Any
            if name in ("gain", "drive_compliance"):
                value = _drive(now)[name != "gain"]
            elif name == "outline":
                value = (now.length or 1.0) * self.change["outline"]
            else:
                value = getattr(now, name)
            learned[name] = value.detach().tolist()
        return learned

    def config(self) -> dict[str, Any]:
        """Return what the constructor needs to build it again, in JSON types."""
        return {"learn": list(self.learn), "guess": _plain(self.guess)}


def _plain(value: Any) -> Any:
    """Convert numbers, tensors and dataclasses to JSON types."""
    if isinstance(value, Tensor):
        return value.detach().tolist()
    if is_dataclass(value) and not isinstance(value, type):
        return {"kind": type(value).__name__, **{f.name: _plain(getattr(value, f.name)) for f in fields(value)}}
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value


def _drive(physics: PlanarPushing) -> tuple[Tensor, Tensor]:
    """Return gain and compliance of a `PositionDrive`."""
    drive: Any = physics.drive
    return torch.as_tensor(drive.gain, dtype=torch.float64), torch.as_tensor(drive.compliance, dtype=torch.float64)


def _count_sides(shape: Shape) -> int:
    if isinstance(shape, Union):
        return sum(_count_sides(part) for part in shape.parts)
    return len(shape.vertices) if isinstance(shape, Polygon) else 1


def _move_sides(shape: Shape, outward: Any) -> Shape:
    """Move the sides of a shape by the next numbers, each along its normal."""
    if isinstance(shape, Union):
        return Union(tuple(_move_sides(part, outward) for part in shape.parts))
    if isinstance(shape, Circle):
        return Circle(shape.r + next(outward), shape.center)
    if not isinstance(shape, Polygon):
        raise InvalidInputError(
            f"learn: expected Circle, Polygon or Union where the outline is learned, got {type(shape).__name__}; leave "
            f"the outline out"
        )
    vertices = shape.corners
    side = vertices.roll(-1, 0) - vertices
    normal = torch.stack([side[:, 1], -side[:, 0]], -1) / side.norm(dim=1, keepdim=True)
    by = torch.stack([next(outward) for _ in range(len(vertices))])
    # A corner stays on both of its sides: n₁·δ = h₁, n₀·δ = h₀. Where they are nearly parallel, on their mean.
    before, after = normal.roll(1, 0), normal
    cosine = (before * after).sum(-1)
    h0, h1 = by.roll(1, 0), by
    across = 1 - cosine.square()
    straight = across < 0.05
    safe = torch.where(straight, torch.ones_like(across), across)
    sharp = ((h0 - cosine * h1) / safe).unsqueeze(-1) * before + ((h1 - cosine * h0) / safe).unsqueeze(-1) * after
    flat = (0.5 * (h0 + h1)).unsqueeze(-1) * (before + after) / (1 + cosine).clamp_min(0.5).unsqueeze(-1)
    return Polygon(vertices + torch.where(straight.unsqueeze(-1), flat, sharp))
