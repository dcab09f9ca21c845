"""MujocoLCS: the linear complementarity system of a MuJoCo model at each state."""

from __future__ import annotations

import copy
import threading
from typing import Any, Literal

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from difflcs._checks import check_array, check_choice, check_kind, check_number, check_tensor, takes_arrays
from difflcs.errors import InvalidInputError
from difflcs.physics.complementarity import Cone, Contacts, count_forces, given_states
from difflcs.physics.mujoco.actuators import Actuators, check_model
from difflcs.physics.mujoco.caps import Caps
from difflcs.physics.mujoco.contacts import ContactFinder, Pairs, median_apart, typical_radius
from difflcs.physics.mujoco.correction import WholeStep, correct, find_forces, to_arrays
from difflcs.physics.mujoco.equality import Equality
from difflcs.physics.mujoco.groups import Groups, find_budgets
from difflcs.physics.mujoco.library import Places
from difflcs.physics.mujoco.limits import RowFinder, scale, soften
from difflcs.physics.mujoco.motion import Dynamic
from difflcs.physics.mujoco.native import flags, in_turn, native, take_given, taken, to_numpy
from difflcs.physics.mujoco.nominal import LEAST, Recovery, Situation
from difflcs.physics.mujoco.overlap import find_overlaps
from difflcs.physics.mujoco.quasi_dynamic import QuasiDynamic
from difflcs.physics.mujoco.quasi_static import QuasiStatic
from difflcs.physics.mujoco.readings import Readings
from difflcs.physics.mujoco.servos import Servos
from difflcs.physics.mujoco.state import MujocoState
from difflcs.physics.mujoco.tries import Tries
from difflcs.records import LCSParams, LCSSequence, sequence_along

Motion = Literal["quasi-static", "quasi-dynamic", "dynamic"]


class MujocoLCS:
    """The contact physics of a MuJoCo model as an `LCSModule`: a system linearised at each state.

    Contacts, their Jacobians, the mass matrix and all smooth forces are MuJoCo's. Three motions are offered:

    - "quasi-static": the state is the positions. Joints with actuators move by u, all else only while pushed.
    - "quasi-dynamic": the same state, with gravity and servos that give way, at rest after each step. For grasping.
    - "dynamic": the state is positions and velocities. u is MuJoCo's `ctrl`; that of `position` actuators on joints
      counts from where the joint is, unless `relative` is false. It is linearised at a nominal control, which also
      says what contacts do where friction depends on it: which hold and which slide. What rests in MuJoCo rests here,
      at the depth that its soft contacts have.

    Directions in which no joint can move are not in the Jacobians. Where all joints move in one plane, friction has
    one tangent, in this plane, and contacts across it, such as those of a floor below, are left out.
    Limits of actuators are bounds of the actions, see `action_bounds`, and activation is part of the state. A servo
    that may push much harder than it can against a contact has limits of its force as well. Limits of joints and
    tendons are one-sided constraints; their dry friction (`frictionloss`), which quasi-static motion does without, is a
    bounded force; active equality constraints are part of the motion. All are as soft as MuJoCo's.
    Not in the system, with a `ContactWarning`: rolling friction, surfaces that move or stick. Refused: <adhesion>,
    delay, sleep, springs that yield, height fields and signed distance fields that may touch something, friction that
    differs by direction; in quasi-static motion disabled actuators. The matrices carry no gradient of the state. An
    object keeps one private copy of the model and its data, which several threads use in turn.

    Args:
        model: the MuJoCo model.
        data: its data: what is not in the state is taken from there once (bodies that mocap moves, and the forces
            `qfrc_applied` and `xfrc_applied`, which do nothing in quasi-static motion, like gravity), and `qpos` is
            the reference of rotations, see `MujocoState`; None: the model's initial state.
        motion: see above.
        seconds: of a step [s].
        contacts: how many a state has, the nearest, where there are more of four a pair; missing ones are padded with
            contacts out of reach. None: as many points as the shapes of all pairs may touch in, at most 12, with a
            `ContactWarning` where more touch. By groups: a list of `ContactGroup`, or {("object", "hand"): 10}.
        distance: contacts farther away are left out [m]; None: ten times `length`.
        pairs: geoms, by name or number, or bodies with all their geoms, that may touch; None: as the model says
            (contype, conaffinity, pairs, excludes; none where contacts or constraints are disabled).
        friction: coefficient μ of all contacts; None: that of the geoms, as MuJoCo combines them.
        torsion: False to leave out the torsional friction of contacts with condim 4 or 6, two forces more for each.
        compliance: how far a contact gives way, as a fraction of how far the same force moves the two bodies apart (the
            median over all pairs; at least 0.01 of its own in dynamic motion, and in quasi-dynamic motion if that is
            not more than half the compliance), > 0. It makes F + Fᵀ ≻ 0.
        cone: model of friction, see `difflcs.physics.complementarity`.
        mobility: of a quasi-static motion: "inertia" (the inverse of the mass matrix), "damping" (of the joints'
            damping), or what a unit of force on each degree of freedom does, (nv,) or (nv, nv). Only ratios matter, as
            `compliance` is in parts of it. A body that cannot move along a degree of freedom has 0 there.
        relative: True if the actions of `position` actuators on joints are relative to where these are.
        ctrl: (nu,) nominal control of a dynamic or quasi-dynamic motion, MuJoCo's `ctrl`; `params(x, context)` takes
            one for each state. None: where servos have no force, and for other actuators that of `data`.
        length: unit of gaps for the relaxation of the MPC, see `contact_lcs` [m]; None: the median radius of the
            geoms that move and may touch.
        limits: how many limits of joints and tendons a state has, those that the nominal action comes nearest to; None:
            all, at most 8, with a `ContactWarning` where more act. 0 leaves them out, and limits of forces of servos.
        caps: how many contacts between bodies without drives have a cap of friction, see `caps.py`; 0 in quasi-static
            motion and with another cone. None: where friction may jam. They come first and take two more forces each.

    Attributes:
        state: `MujocoState`, which says what each number of the state is.

    Raises:
        InvalidInputError and its kinds: an argument does not fit, or the model has what is refused.
    """

    def __init__(
        self,
        model: Any,
        data: Any = None,
        *,
        motion: Motion = "quasi-static",
        seconds: float = 0.1,
        contacts: int | Groups | None = None,
        distance: float | None = None,
        pairs: Pairs | None = None,
        friction: float | None = None,
        torsion: bool = True,
        compliance: float = 0.02,
        cone: Cone = "anitescu",
        mobility: Literal["inertia", "damping"] | ArrayLike = "inertia",
        relative: bool = True,
        ctrl: ArrayLike | None = None,
        length: float | None = None,
        limits: int | None = None,
        caps: int | None = None,
    ):
        options = {name: value for name, value in locals().items() if name not in ("self", "model", "data")}
        friction, torsion = _check_options(motion, cone, mobility, friction, torsion, relative, caps, ctrl)
        check_model(model, data, motion)
        self.motion, self.seconds = motion, check_number("seconds", seconds, strict=True)
        self.cone: Cone = cone
        self.compliance = check_number("compliance", compliance, strict=True)
        model, self._turns = copy.copy(model), threading.RLock()
        disabled = int(model.opt.disableflags)
        model.opt.disableflags |= flags("AUTORESET")  # it would lose what data says; see native
        self._model, self._data = model, mujoco.MjData(model)
        if data is not None:
            take_given(self._data, data)
        self._given = disabled, taken(self._data), options
        with native(model, self._data, "in the state of data"):
            mujoco.mj_fwdPosition(model, self._data)
        self._equality, self._places = Equality(model, self._data), Places(model, self._data)
        self._rows = RowFinder(model, self._places, limits, motion != "quasi-static")
        self.state = MujocoState(model, self._data.qpos, velocities=motion == "dynamic")
        stops = limits != 0 and not disabled & flags("CONSTRAINT", "LIMIT")
        self._actuators, self._relative = Actuators(model, stops), relative
        self._quasi_static = motion == "quasi-static"
        self._servos = Servos(model, self._data, self._actuators, relative, self.seconds, motion == "dynamic")
        mobility = mobility if isinstance(mobility, str) else check_array("mobility", mobility)
        if self._quasi_static:
            self._motion: Any = QuasiStatic(model, self._actuators, mobility)
        else:
            kind = Dynamic if motion == "dynamic" else QuasiDynamic
            self._motion = kind(model, self._actuators, self.seconds, relative)
        held = torch.from_numpy(check_array("ctrl", self._data.ctrl if ctrl is None else ctrl))
        nominal = self._actuators.nominal(held, torch.Size())
        self._ctrl = np.where(self._actuators.holds & (ctrl is None), np.nan, nominal)
        length = typical_radius(model) if length is None else check_number("length", length, strict=True)
        distance = 10 * length if distance is None else check_number("distance", distance, strict=True)
        self.length, self._recovery = length, Recovery(model, length)
        budgets = find_budgets(model, contacts, distance)
        plain = motion == "dynamic" and pairs is None and friction is None and torsion
        self._whole = WholeStep(self._motion, limits != 0) if plain else None
        pushed = motion != "dynamic" and model.nu < model.nv and model.ngeom > 1
        more = distance, length, budgets, friction, torsion, pushed
        self._finder = ContactFinder(model, self._data, self._places, pairs, *more, motion == "dynamic")
        caps = 0 if motion == "quasi-static" or cone != "anitescu" else caps
        self._caps = Caps(model, self._servos.moment, self._finder, length, caps)
        model.opt.disableflags |= flags("EQUALITY", "FRICTIONLOSS", "LIMIT")
        self._touching = copy.copy(model)
        self._touching.opt.disableflags &= ~flags("CONTACT")
        with native(model, self._data, "in the state of data"):
            self._give, self._yields = _respond(self, limits != 0)
        self._corrects = self._whole if self.n_lam else None
        self._tries = self._whole and Tries(self._whole, self._places, relative, self._yields)

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is built again, as what is compiled holds addresses."""
        return _rebuild, (copy.copy(self._model), *self._given, taken(self._data), self.state)

    @property
    def n_x(self) -> int:
        """Number of states: nv, or 2 nv + na with velocities."""
        return self.state.n_x

    @property
    def n_u(self) -> int:
        """Number of actions, one for each actuator."""
        return int(self._model.nu)

    @property
    def n_contacts(self) -> int:
        """Number of contacts of every state."""
        return self._finder.n_contacts

    @property
    def n_lam(self) -> int:
        """Number of forces: of contacts, those without friction last, limits, pairs of dry friction, servos, caps."""
        rough, rows = int(self._finder.rough.sum()), self._rows
        more = self.n_contacts - rough + rows.n_limits, rows.n_friction + len(self._servos.those) + self._caps.count
        return count_forces(rough, self._finder.n_tangents, self.cone, *more)

    @in_turn
    def observe(self, data: Any) -> Tensor:
        """Return the state (n_x,) of MuJoCo's data, and let rotations count from the orientations there from now on.

        So each plan of a closed loop begins with rotations of zero, however far things have turned, and what uses
        `state`, such as a `MujocoCost`, counts from there as well. States of before are not those of now. For a batch
        call `state.follow` and `state.to_state` with `qpos` (..., nq). What is not in the state is taken from the data
        as well: where mocap has moved bodies, and the forces `qfrc_applied` and `xfrc_applied`.

        Raises:
            DTypeError, ShapeError, NonFiniteError: no such data.
        """
        check_kind("data", data, mujoco.MjData, "for arrays use state.follow")
        take_given(self._data, data)
        self.state.follow(data.qpos)
        return self.state.to_state(data.qpos, data.qvel, data.act)

    @in_turn
    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """The system at states x (..., n_x).

        Args:
            x: states.
            context: (..., nu) nominal controls of a dynamic motion, in place of those of the module.

        Raises:
            InvalidInputError and its kinds: no state, or of another size.
        """
        read = self._read(x := given_states(x), context)
        contacts, (rough, smooth), rest, step, overlaps = read.dof_contacts, self._finder.parts, None, None, None
        unit, loads = self.length / self._give, None
        if isinstance(self._motion, Dynamic):
            middle = read.moved.middle[:, : self.state.nv]
            step = self._motion.finish(read.moved, read.x, read.tangent, self._equality.read(read.qpos, middle))
            found = self._rows.find(read.qpos, step.place, step.response, middle)
            more = self._recovery, self._give, self.compliance, self.cone == "anitescu"
            at = Situation(step, contacts, self._finder.rough, found, *more)
            overlaps = find_overlaps(self._touching, self._data, read.qpos, at)
            nominal = overlaps.evaluate(at)
            contacts, soft, rows = nominal.contacts, nominal.soft, nominal.rows
            rest = nominal.rest(rough, smooth, self._finder.n_tangents, self.cone, self._caps.count)
            loads, response = nominal.forces[:, rough].sum(-1) if self._caps.count else None, step.response
            free = step.free(nominal.carried)
        else:
            free = self._motion.finish(read.moved, read.x, read.tangent)
            free = self._equality.hold_positions(free, read.x, read.qpos, read.tangent)
            response = np.broadcast_to(read.to_dofs(free.response), (len(read.x), *free.response.shape[-2:]))
            found = self._rows.find(read.qpos, np.zeros_like(read.x), response)
            rows, soft = scale(found, response, self._give), np.full_like(contacts.gap, self.compliance)
        caps = self._caps.limit(contacts, loads, response, unit)
        if n_smooth := contacts.gap[:, smooth].shape[1]:
            rows = rows.after(contacts.gap[:, smooth], contacts.normal[:, smooth])
            contacts = contacts.take(np.s_[:, rough])
        effect = None if step is None else step.effect(rows.normal, rows.impulse)
        soft = soften(rows, found, step, self._give, self.compliance, soft[:, rough])
        system = read.assemble(contacts, rows, free, effect, caps, soft, self.cone, self.length, unit, rest)
        if self.motion == "quasi-dynamic":
            _rest_on_forces(self, system, read, response)
        system = self._servos.limit(system, free, step, read, self.length, self._give)
        if step is not None and overlaps is not None and read.after is not None:
            each, others = count_forces(1, self._finder.n_tangents, self.cone), n_smooth + self._caps.count
            more = rows.bound / unit, found, overlaps.find_hard(rough, each, others), rest != 0
            read.doubtful[:] = correct(to_arrays(system), step, read.after, *more)
        if step is not None and self._tries is not None:
            self._tries.warn(system, read, step)
        return system if x.dtype == torch.float64 and x.is_cpu else system.to(device=x.device, dtype=x.dtype)

    def sequence(self, plan: Any, x: Tensor | None = None) -> LCSSequence:
        """Linearise along the actions of a plan, from its state or from x (..., n_x), see `difflcs.sequence_along`."""
        return sequence_along(self, plan, x)

    def context_along(self, x: Tensor, u: Tensor, context: Tensor | None = None) -> Tensor | None:
        """Return the nominal controls (..., nu) of actions u (..., n_u) at states x (..., n_x) of a plan."""
        return context if self._quasi_static else self.control(x, u)

    @in_turn
    def states_along(self, x: Tensor, u: Tensor) -> Tensor | None:
        """Simulate the states (..., H, n_x) at which actions u (..., H, n_u) of a plan begin, from x (..., n_x).

        None where MuJoCo's own steps are not those of the system, or have no finite numbers.
        """
        return None if self._whole is None else self._whole.follow(self._places, self.state, self.control, x, u)

    @in_turn
    def contacts(self, x: Tensor) -> Contacts:
        """Compute gaps and their derivatives at states x (..., n_x); a missing contact has `distance` and zeros."""
        read = self._read(x)
        return Contacts(*map(read.batched, read.contacts(read.dof_contacts)))

    @takes_arrays
    def control(self, x: Tensor, u: Tensor) -> Tensor:
        """Convert to MuJoCo's `ctrl` (..., nu) actions u (..., n_u) at states x (..., n_x).

        Raises:
            InvalidInputError: quasi-static motion by actuators that are no `position` actuators.
        """
        check_tensor("x", x, [("n_x", self.n_x)])
        check_tensor("u", u, [("n_u", self.n_u)])
        return self._actuators.control(x, u, self._relative, self._quasi_static)

    def action_bounds(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the bounds (..., n_u) of the actions within which actuators do what the system says.

        These are `ctrlrange`, `forcerange` and, of joints with one actuator, `actuatorfrcrange`; in quasi-static motion
        `ctrlrange` and the stops of joints. The layer keeps within them. Infinite where nothing is limited.

        Args:
            x: (..., n_x) states.
        """
        check_tensor("x", x, [("n_x", self.n_x)])
        numbers = to_numpy(x)
        if self._quasi_static:
            bounds = self._actuators.places(numbers)
        else:
            speed = numbers[..., self.state.nv :] if self.state.velocities else np.zeros_like(numbers)
            bounds = self._actuators.bounds(numbers, speed, self._yields, self._relative)
        low, high = (torch.from_numpy(v).to(x) for v in bounds)
        return low, high

    def _read(self, x: Tensor, context: Tensor | None = None) -> Readings:
        states, batch = self.state.flatten(x, self._data.act), x.shape[:-1]
        n, qpos = len(states), states[:, : self.state.nq]
        flat = np.ascontiguousarray(to_numpy(x).reshape(n, self.n_x))
        ctrl = np.repeat(self._ctrl[None], n, 0) if context is None else self._actuators.nominal(context, batch)
        ctrl, found = ctrl.reshape(n, self.n_u), self._caps.order(self._finder.find(qpos))
        tangent = self.state.tangent(flat[:, : self.state.nv])
        moved, after = self._motion.read(self._places, states, ctrl), None
        if isinstance(self._motion, Dynamic):
            moved = self._motion.find_secants(moved, self._places, states, flat)
            if self._corrects is not None:
                after = self._corrects.hold(moved, self._places, states, flat)
        return Readings(batch, flat, states, qpos, tangent, found, moved, np.zeros(n, dtype=bool), after)


def _respond(of: MujocoLCS, limits: bool) -> tuple[float, Any]:
    """Compute how far a unit of force moves two bodies apart that may touch, a median, and `Actuators.yields`."""
    model, data, nv, finder = of._model, of._data, of.state.nv, of._finder
    here = np.concatenate([data.qpos, data.qvel, data.act])[None]
    moved = of._motion.read(of._places, here, of._ctrl[None])
    h = of.seconds if (dynamic := isinstance(of._motion, Dynamic)) else 1.0
    response = h * of._motion.finish(moved, np.zeros((1, of.n_x)), None).response.reshape(-1, nv, nv)[0]
    far = h * response
    if limits and of.n_contacts and not of._quasi_static:
        of._servos.choose(far)
    yields = of._actuators.yields(far, dynamic * response)
    return median_apart(model, data, here[0], response, finder.main_pairs, 3 if finder.axis is None else 2), yields


def _rest_on_forces(of: MujocoLCS, system: LCSParams, read: Readings, response: Any) -> None:
    """Let contacts give way from their forces at the nominal action on, and set the caps of friction by these."""
    rough, smooth = int(of._finder.rough.sum()), int((~of._finder.rough).sum()) + of._caps.count
    count = count_forces(rough, of._finder.n_tangents, of.cone, smooth)
    arrays = to_arrays(system)
    firm, c = np.einsum("...ii->...i", arrays["F"])[..., :count], arrays["c"]
    least = min(LEAST, 0.5 * of.compliance) * (firm - of.compliance)
    more = np.maximum(least - of.compliance, 0.0)
    if len(read.x) and (of._caps.count or more.any()):
        lam = find_forces(arrays, read.batched(read.x), read.batched(read.moved.nominal))
        firm += more
        c[..., :count] -= more * lam[..., :count]
        of._caps.limit_by_forces(c, lam, read, response)


def lcs_from_mujoco(model: Any, data: Any, x: Tensor | None = None, **options: Any) -> LCSParams:
    """Compute the linear complementarity system of a MuJoCo model, linearised at one state or at many.

    Args:
        model: the MuJoCo model.
        data: its data; without x, the system is that of `data.qpos` and `data.qvel`.
        x: (..., n_x) states, in the order of `MujocoState(model, data.qpos)`: positions, and velocities in dynamic
            motion. Where there are free joints or balls, their rotations count from those in `data`.
        **options: those of `MujocoLCS`, such as motion="dynamic", seconds=0.05, contacts=2, friction=0.5. Build a
            `MujocoLCS` where there are many calls.

    Returns:
        The system, with the batch dimensions of x.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """
    check_kind("data", data, mujoco.MjData, "pass mujoco.MjData(model)")
    module = MujocoLCS(model, data, **options)
    return module.params(module.state.to_state(data.qpos, data.qvel, data.act) if x is None else x)


def _check_options(
    motion: Any, cone: Any, mobility: Any, friction: Any, torsion: Any, relative: Any, caps: Any, ctrl: Any
) -> tuple[float | None, bool]:
    check_choice("motion", motion, ("quasi-static", "quasi-dynamic", "dynamic"))
    check_choice("cone", cone, ("anitescu", "stewart-trinkle"))
    if isinstance(mobility, str):
        check_choice("mobility", mobility, ("inertia", "damping"))
    if friction is not None:
        friction = check_number("friction", friction)
    if caps and (motion == "quasi-static" or cone != "anitescu"):
        raise InvalidInputError(
            f"caps: expected none in {motion} motion with the cone {cone!r}, where they do nothing, got {caps!r:.100}; "
            'leave them out, or use motion="dynamic" and the cone "anitescu"'
        )
    if ctrl is not None and motion == "quasi-static":
        raise InvalidInputError(
            f"ctrl: expected none in quasi-static motion, which it does not change, got {ctrl!r:.100};"
            ' leave it out, or use motion="quasi-dynamic" or "dynamic"'
        )
    check_kind("relative", relative, bool)
    return friction, check_kind("torsion", torsion, bool)


def _rebuild(model: Any, disabled: int, first: Any, options: dict[str, Any], now: Any, state: MujocoState) -> MujocoLCS:
    model.opt.disableflags = disabled
    data = mujoco.MjData(model)
    take_given(data, first)
    module = MujocoLCS(model, data, **options)
    take_given(module._data, now)
    module.state = state
    return module
