"""A body on a plane, pushed by discs: a linear complementarity system at each state, from shapes alone.

The body moves only while it is pushed (quasi-static), or keeps its velocity (`Inertia`). Discs follow their own drive:
to a place, by a PD controller, or by forces. With m discs the state is

    x, y, yaw of the body | x, y of each disc | velocities of the discs, if their drive has any
    | velocities of the body, if it has inertia

and the action two numbers for each disc. Everything is differentiable in the state, the shape and every number here.

Quasi-static: the body moves by its mobility times the force, diag(1, 1, 1/ρ²) about its centre of mass, with the radius
of gyration ρ of the pressure under it; only this ratio matters where discs go where they are told. (K. Lynch, M. Mason,
"Stable pushing: mechanics, controllability, and planning", Int. J. Robot. Res. 15, 1996.)
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from difflcs import _checks
from difflcs._differentiation import is_wrapped, runs_eagerly
from difflcs.errors import InvalidInputError, ShapeError
from difflcs.physics.complementarity import Cone, Contacts, FreeMotion, contact_lcs, count_forces, given_states
from difflcs.physics.shapes import Shape
from difflcs.records import LCSParams

_INSTANTS = 8  # of a step, in `Drive.course`


class DriveStep(NamedTuple):
    """Motion of the discs in one step, by coordinate: (position, velocity)₊ = A (position, velocity) + b u.

    `response` is what an impulse on the coordinate adds. Leading dimensions are (n_discs, 2) or those that broadcast;
    k is 1 without velocities, else 2.

    Attributes:
        A: (..., k, k).
        b: (..., k).
        response: (..., k).
    """

    A: Tensor
    b: Tensor
    response: Tensor


class Drive(ABC):
    """Base of the drives, by which discs follow their action."""

    order: int
    """1: the state has positions of the discs; 2: velocities too."""

    @abstractmethod
    def step(self) -> DriveStep:
        """Return one step."""

    def course(self) -> DriveStep:
        """Return the motion from the begin of a step until each of some instants of it, (n_instants, …) in every field.

        The last instant is its end. By default the discs go evenly.
        """
        step = self.step()
        rest = DriveStep(torch.eye(self.order, dtype=step.A.dtype), step.b.new_zeros(()), step.b.new_zeros(()))
        parts = [i / _INSTANTS for i in range(1, _INSTANTS + 1)]
        return DriveStep(*(torch.stack([a + p * (b - a) for p in parts]) for a, b in zip(rest, step, strict=True)))


@dataclass(frozen=True, eq=False)
class PositionDrive(Drive):
    """A disc that goes where it is told, as far as contact lets it: p₊ = p + gain · u + compliance · force.

    A controller that holds a place is a spring. With none of its compliance in the model, a plan believes that a disc
    moves on while it presses on a body that is blocked, and that two discs can go on squeezing a body between them.

    Attributes:
        gain: fraction of the commanded increment that it moves in a step; a number, (2,) or (n_discs, 2).
        compliance: by how far a unit of force pushes it back, ≥ 0, 0 for a disc that nothing stops; a number, (2,),
            (n_discs, 1) or (n_discs, 2) [length per force, as the mobility of the body is 1 in quasi-static motion].
    """

    gain: float | Tensor = 1.0
    compliance: float | Tensor = 0.0
    order = 1

    def step(self) -> DriveStep:
        """See `Drive`."""
        gain, compliance = _number("gain", self.gain), _number("compliance", self.compliance, 0.0)
        return DriveStep(gain.new_ones(1, 1), gain.unsqueeze(-1), compliance.unsqueeze(-1))


@dataclass(frozen=True, eq=False)
class PDDrive(Drive):
    """A disc driven by a PD controller to a target relative to where it is, u = target − p; contact does not stop it.

    In each of `substeps` of `substep` seconds: v ← v + (stiffness · (target − p) − damping · v) · substep, then
    p ← p + v · substep, with the target held.

    Attributes:
        stiffness: [1/s²].
        damping: [1/s].
        substep: [s].
        substeps: in one step of the system.
    """

    stiffness: float | Tensor
    damping: float | Tensor
    substep: float
    substeps: int
    order = 2

    @property
    def seconds(self) -> float:
        """Of a step of the system."""
        return self.substep * self.substeps

    def step(self) -> DriveStep:
        """See `Drive`."""
        return self._until(_checks.check_positive_int("substeps", self.substeps))

    def course(self) -> DriveStep:
        """See `Drive`: after each substep."""
        each = [self._until(substeps) for substeps in range(1, self.substeps + 1)]
        return DriveStep(*(torch.stack(values) for values in zip(*each, strict=True)))

    def _until(self, substeps: int) -> DriveStep:
        kp, kv = _number("stiffness", self.stiffness, 0.0), _number("damping", self.damping, 0.0)
        _checks.broadcast_batch([("stiffness", kp.shape), ("damping", kv.shape)])
        kp, kv = torch.broadcast_tensors(kp, kv)
        h = _checks.check_number("substep", self.substep, strict=True)
        one, zero = torch.ones_like(kp), torch.zeros_like(kp)
        # (p, v, target)₊ = M (p, v, target), for one substep.
        M = torch.stack(
            [
                torch.stack([1 - kp * h * h, h * (1 - kv * h), kp * h * h], -1),
                torch.stack([-kp * h, 1 - kv * h, kp * h], -1),
                torch.stack([zero, zero, one], -1),
            ],
            -2,
        )
        M = torch.linalg.matrix_power(M, substeps)
        b = M[..., :2, 2]
        zero = torch.zeros_like(b)
        # target = p + u, and p moves with the target where both are shifted: what the target does, p does, too.
        return DriveStep(M[..., :2, :2] + torch.stack([b, zero], -1), b, zero)


@dataclass(frozen=True, eq=False)
class ForceDrive(Drive):
    """A disc of some mass is driven by a force u, and pushed back by what it touches.

    Attributes:
        mass: [kg].
        seconds: of a step.
        damping: rate at which its velocity decays [1/s].
    """

    mass: float | Tensor
    seconds: float
    damping: float | Tensor = 0.0
    order = 2

    def step(self) -> DriveStep:
        """See `Drive`."""
        mass, damping = _number("mass", self.mass, 0.0, True), _number("damping", self.damping, 0.0)
        _checks.broadcast_batch([("mass", mass.shape), ("damping", damping.shape)])
        mass, damping = torch.broadcast_tensors(mass, damping)
        h = _checks.check_number("seconds", self.seconds, strict=True)
        decay = torch.exp(-damping * h)
        one, zero = torch.ones_like(mass), torch.zeros_like(mass)
        A = torch.stack([torch.stack([one, h * decay], -1), torch.stack([zero, decay], -1)], -2)
        impulse = torch.stack([h / mass, 1 / mass], -1)
        return DriveStep(A, impulse * h, impulse)


@dataclass(frozen=True, eq=False)
class Inertia:
    """The body keeps its velocity: its state has velocities, and contact forces are impulses.

    Attributes:
        mass: [kg].
        seconds: of a step.
        damping: rate at which its velocities decay [1/s].
    """

    mass: float | Tensor
    seconds: float
    damping: float | Tensor = 0.0


@dataclass(frozen=True, eq=False)
class PlanarPushing:
    """A body on a plane, pushed by discs; an `LCSModule` whose system depends on the state.

    Attributes:
        shape: outline of the body in its own coordinates.
        radius: of the discs, a number or (n_discs,) [length].
        n_discs: number of discs.
        drive: how they follow their action.
        center_of_mass: (2,) in coordinates of the body; None: the centre of the shape's area.
        gyration: radius of gyration about it [length]; None: that of the shape's area.
        friction: between discs and body, a number or (n_discs,); 0 (a number) for none, which halves n_lam.
        compliance: gap that a unit of force closes, > 0, a number or (n_discs,) [length per force].
        inertia: None for quasi-static motion.
        cone: model of friction, see `difflcs.physics.complementarity`.
        length: unit of gaps for the relaxation of the MPC, see `contact_lcs`; None: the radius of gyration.
        nearest: parts of the shape that each disc can touch in one step, those nearest to it; None: all of them. The
            time of an MPC grows with the contacts, and far parts are out of reach.

    Raises:
        InvalidInputError and its kinds: a value does not fit.
    """

    shape: Shape
    radius: float | Tensor
    n_discs: int = 1
    drive: Drive = PositionDrive()
    center_of_mass: Tensor | Sequence[float] | None = None
    gyration: float | Tensor | None = None
    friction: float | Tensor = 0.0
    compliance: float | Tensor = 0.02
    inertia: Inertia | None = None
    cone: Cone = "anitescu"
    length: float | None = None
    nearest: int | None = None

    def __post_init__(self) -> None:
        _checks.check_kind("shape", self.shape, Shape, "give Circle, Polygon or Union")
        _checks.check_kind("drive", self.drive, Drive, "give PositionDrive(), for example")
        _checks.check_kind("inertia", self.inertia, (Inertia, type(None)))
        _checks.check_positive_int("n_discs", self.n_discs)
        if self.nearest is not None:
            _checks.check_positive_int("nearest", self.nearest)
        _checks.check_choice("cone", self.cone, ("anitescu", "stewart-trinkle"))
        defaults = [name for name in ("center_of_mass", "gyration", "length") if getattr(self, name) is None]
        vars(self)["defaults"] = dict.fromkeys(defaults)
        rough = () if self.frictionless else ("friction",)
        values: dict[str, Any] = {name: self._of_discs(name, getattr(self, name)) for name in ("radius", *rough)}
        values["compliance"] = self._of_discs("compliance", self.compliance, strict=True)
        center = self.shape.centroid if self.center_of_mass is None else self.center_of_mass
        values["center_of_mass"] = _number("center_of_mass", center, sizes=[(2,)])
        if (gyration := self.gyration) is None:
            area, centroid, polar = self.shape.moments()
            gyration = (polar / area + (values["center_of_mass"] - centroid).square().sum()).sqrt()
        values["gyration"] = _number("gyration", gyration, 0.0, strict=True, sizes=[(), (1,)])
        length = float(values["gyration"].detach()) if self.length is None else self.length
        values["length"] = _checks.check_number("length", length, strict=True)
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _of_discs(self, name: str, value: float | Tensor, strict: bool = False) -> Tensor:
        return _number(name, value, 0.0, strict, [(), (self.n_discs,)]).expand(self.n_discs)

    @property
    def frictionless(self) -> bool:
        """True if each contact has one force, along the normal."""
        return isinstance(self.friction, int | float) and self.friction == 0

    @property
    def n_x(self) -> int:
        """Number of states."""
        return 3 + 2 * self.n_discs * self.drive.order + (0 if self.inertia is None else 3)

    @property
    def n_u(self) -> int:
        """Number of actions."""
        return 2 * self.n_discs

    @property
    def n_lam(self) -> int:
        """Number of contact forces."""
        return count_forces(self.n_discs * self.parts_touched, 0 if self.frictionless else 1, self.cone)

    @property
    def parts_touched(self) -> int:
        """Contacts of each disc."""
        return self.shape.n_parts if self.nearest is None else min(self.nearest, self.shape.n_parts)

    def replace(self, **values: Any) -> PlanarPushing:
        """Return a copy with other values; values that were never set follow from the (new) shape."""
        return replace(self, **{**vars(self)["defaults"], **values})

    @runs_eagerly
    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """The system at states x (..., n_x); there is no context.

        Raises:
            InvalidInputError and its kinds: no state, or of another size.
        """
        _checks.check_tensor("x", x := given_states(x), [("n_x", self.n_x)])
        if not x.is_cpu or x.dtype is not torch.float64:  # computed so, as plans are
            return self.params(x.to("cpu", torch.float64), context).to(x.device, x.dtype)
        if any(getattr(self, name).requires_grad for name in vars(self)["defaults"] if name != "length"):
            return self.replace()._params(x)  # they follow a shape that is learned
        return self._params(x)

    def _params(self, x: Tensor) -> LCSParams:
        friction = 0.0 if self.frictionless else self._by_contact(self.friction)
        contacts, free, compliance = self.contacts(x), self._free_motion(x), self._by_contact(self.compliance)
        force = None
        if self.inertia is not None:
            contacts, compliance = _damp(contacts, free.response, compliance)
            mass = float(_number("mass", self.inertia.mass, 0.0, True).detach())
            force = (self.length or 1.0) * mass / float(self.inertia.seconds)
        return contact_lcs(
            contacts,
            free,
            x,
            friction=friction,
            compliance=compliance,
            cone=self.cone,
            length=self.length or 1.0,
            force=force,
        )

    def _by_contact(self, value: Any) -> Tensor:
        return value.repeat_interleave(self.parts_touched)

    def contacts(self, x: Tensor) -> Contacts:
        """Gaps of all discs, and their derivatives; each disc has a contact with each part, or the nearest."""
        _checks.check_tensor("x", x, [("n_x", self.n_x)])
        m, parts, batch = self.n_discs, self.parts_touched, x.shape[:-1]
        discs = x[..., 3 : 3 + 2 * m].reshape(*batch, m, 2)
        nearest = self.shape.distance(to_body(x, discs))
        if parts < self.shape.n_parts:
            kept = nearest.distance.detach().topk(parts, largest=False).indices
            nearest = nearest.select(kept)
        gap = nearest.distance - _number("radius", self.radius, 0.0).unsqueeze(-1)
        cos, sin = x[..., 2].cos()[..., None, None], x[..., 2].sin()[..., None, None]

        def turn(v: Tensor) -> tuple[Tensor, Tensor]:
            return cos * v[..., 0] - sin * v[..., 1], sin * v[..., 0] + cos * v[..., 1]

        (nx, ny), (rx, ry) = turn(nearest.normal), turn(nearest.point)
        tx, ty = -ny, nx

        def rows(vx: Tensor, vy: Tensor) -> Tensor:
            """Derivative of (disc − point of the body beside it) along v by the state: (..., m · parts, n_x)."""
            of_body = torch.stack([-vx, -vy, rx * -vy + ry * vx], -1).reshape(*batch, m * parts, 3)
            own = torch.eye(m, dtype=x.dtype)[:, None, :, None]
            of_discs = own * torch.stack([vx, vy], -1).unsqueeze(-2)
            rest = x.new_zeros(*batch, m * parts, self.n_x - 3 - 2 * m)
            return torch.cat([of_body, of_discs.reshape(*batch, m * parts, 2 * m), rest], -1)

        normal = rows(nx, ny)
        tangent = normal.new_zeros(*normal.shape[:-1], 0, self.n_x) if self.frictionless else rows(tx, ty).unsqueeze(-2)
        return Contacts(gap.reshape(*batch, m * parts), normal, tangent)

    def _center_offset(self, yaw: Tensor) -> Tensor:
        """Compute the vector from the body's origin to its centre of mass (..., 2), in the plane."""
        center: Any = self.center_of_mass
        cos, sin = yaw.cos(), yaw.sin()
        return torch.stack([cos * center[0] - sin * center[1], sin * center[0] + cos * center[1]], -1)

    def _mobility(self, x: Tensor) -> Tensor:
        """Compute the mobility (..., 3, 3): the motion of the pose by a force and a torque dual to it, for mass 1."""
        cx, cy = self._center_offset(x[..., 2]).unbind(-1)
        # The pose is that of the body's origin, which turns about the centre of mass.
        turn = torch.stack([cy, -cx, torch.ones_like(cx)], -1)
        gyration: Any = self.gyration
        plane = torch.diag(x.new_tensor([1.0, 1.0, 0.0]))
        return plane + turn.unsqueeze(-1) * turn.unsqueeze(-2) / gyration.square()

    def _without_contact(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute A and B, and the response of the discs alone."""
        numbers = _plain_numbers(self.drive, self.inertia)
        key, (kept_key, kept) = (numbers, like.dtype, like.device), vars(self).get("kept", (None, None))
        if numbers is not None and key == kept_key:
            return kept[0].clone(), kept[1].clone(), kept[2]  # what a caller gets is theirs
        m, n_x, h = self.n_discs, self.n_x, 0.0
        if self.inertia is not None:
            h = _checks.check_number("seconds", self.inertia.seconds, strict=True)
            _number("mass", self.inertia.mass, 0.0, True, [(), (1,)])
        A = torch.eye(n_x, dtype=like.dtype, device=like.device)
        B, response = A.new_zeros(n_x, 2 * m), A.new_zeros(n_x, n_x)
        step, k = self.drive.step(), self.drive.order
        if h and not math.isclose(own := getattr(self.drive, "seconds", h), h, rel_tol=1e-6):
            raise InvalidInputError(f"inertia: expected steps of {own:g} s like the drive, got {h:g}; make them equal")
        for size in (step.A.shape[:-2], step.b.shape[:-1], step.response.shape[:-1]):
            if size not in ((), (2,), (1, 2), (m, 1), (m, 2), (1, 1), (1,)):
                raise ShapeError(f"drive: expected numbers, (2,), ({m}, 1) or ({m}, 2), got {tuple(size)}; give such")
        places = 3 + torch.arange(2 * m)
        of = [places + 2 * m * i for i in range(k)]  # positions, then velocities
        for i in range(k):
            for j in range(k):
                A[of[i], of[j]] = step.A[..., i, j].to(A).expand(m, 2).reshape(-1)
            B[of[i], torch.arange(2 * m)] = step.b[..., i].to(A).expand(m, 2).reshape(-1)
            response[of[i], places] = step.response[..., i].to(A).expand(m, 2).reshape(-1)
        if self.inertia is not None:
            decay = torch.exp(-_number("damping", self.inertia.damping, 0.0, sizes=[(), (1,), (3,)]).to(A) * h)
            speed = n_x - 3 + torch.arange(3)
            A[torch.arange(3), speed] = h * decay.expand(3)
            A[speed, speed] = decay.expand(3)
        if numbers is not None and not torch.is_inference_mode_enabled():
            vars(self)["kept"] = key, (A.clone(), B.clone(), response)
        return A, B, response

    def _free_motion(self, x: Tensor) -> FreeMotion:
        A, B, response = self._without_contact(x)
        mobility, rest = self._mobility(x), self.n_x - 3
        if self.inertia is None:
            return FreeMotion(A, B, x.new_zeros(self.n_x), response + pad(mobility, (0, rest, 0, rest)))
        h, mass = self.inertia.seconds, _number("mass", self.inertia.mass).to(x)
        response = response + pad(h * mobility / mass, (0, rest, 0, rest)) + pad(mobility / mass, (0, rest, rest, 0))
        return FreeMotion(A, B, self._turning(x, A[-1, -1], h), response)

    def _turning(self, x: Tensor, decay: Tensor, h: float) -> Tensor:
        """Addition (..., n_x) because the centre of mass, not the origin of the body, keeps its velocity."""
        speed = decay * x[..., -1]
        before, after = self._center_offset(x[..., 2]), self._center_offset(x[..., 2] + h * speed)
        across = torch.stack([-before[..., 1], before[..., 0]], -1)  # of which the turn makes the origin's velocity
        across_after = torch.stack([-after[..., 1], after[..., 0]], -1)
        speed = speed.unsqueeze(-1)
        rest = x.new_zeros(*x.shape[:-1], self.n_x - 5)
        place, velocity = before - after + h * speed * across, speed * (across - across_after)
        return torch.cat([place, rest, velocity, torch.zeros_like(speed)], -1)


_MOST = 0.01  # of how far an impulse moves two bodies apart in a step: what a contact gives way at most, and bounces


def _damp(contacts: Contacts, response: Tensor, compliance: Tensor) -> tuple[Contacts, Tensor]:
    """Damp contacts so that they do not bounce in short steps; return how far (..., n_contacts) a force closes each.

    Compliance r alone is a spring: it returns its energy if a step moves a body by less than r times the impulse. A
    damper beside it limits its motion in a step to g < r per impulse. With s = g/r, an impulse f at a gap φ < 0 meets
    φ₊ − (1 − s) φ + s r f = 0, and at rest φ = −r f, as without damper. An open gap counts in full, φ₊ + s r f = 0.
    """
    most = _MOST * ((contacts.normal @ response) * contacts.normal).sum(-1)
    gap = torch.where(contacts.gap < 0, (most / compliance).clamp(0.0, 1.0) * contacts.gap, contacts.gap)
    return contacts._replace(gap=gap), torch.minimum(most, compliance)


def _plain_numbers(*parts: Drive | Inertia | None) -> tuple[float, ...] | None:
    """Return the numbers of the parts; None if one is a tensor, which may be learned or changed in place."""
    if not all(part is None or is_dataclass(part) for part in parts):
        return None
    values = [getattr(part, field.name) for part in parts if part is not None for field in fields(part)]  # pyright: ignore
    return tuple(values) if all(isinstance(value, int | float) for value in values) else None


def to_body(x: Tensor, points: Tensor) -> Tensor:
    """Convert points (..., n, 2) of the plane to coordinates of the body whose pose begins the states x (..., n_x)."""
    cos, sin = x[..., 2:3].cos(), x[..., 2:3].sin()
    dx, dy = (points - x[..., None, :2]).unbind(-1)
    return torch.stack([cos * dx + sin * dy, cos * dy - sin * dx], -1)


def _number(
    name: str, value: Any, least: float = -math.inf, strict: bool = False, sizes: Sequence[tuple[int, ...]] = ()
) -> Tensor:
    """Convert a number of at least (`strict`: above) `least` to a finite float64 tensor; a tensor is not converted.

    `sizes`: those that it may have, where not any.
    """
    if not isinstance(value, Tensor):
        value = torch.from_numpy(_checks.check_array(name, value))
    _checks.check_tensor(name, value)
    if sizes and value.shape not in sizes:
        wanted = " or ".join(str(size) if size else "a number" for size in sizes)
        raise ShapeError(f"{name}: expected {wanted}, got {_checks.describe(value)}; give so many")
    if least > -math.inf and not is_wrapped(value) and bool(((value <= least) if strict else (value < least)).any()):
        raise InvalidInputError(
            f"{name}: expected numbers {'above' if strict else 'of at least'} {least:g}, got {float(value.min()):g}; "
            f"change it"
        )
    return value
