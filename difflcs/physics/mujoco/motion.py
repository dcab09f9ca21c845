"""Motion of a MuJoCo model with velocities in one step without contact.

MuJoCo simulates what a nominal control ū does from the state, and its acceleration is linearised half
way there, with ζ the change of position and ν the velocity:

    ν̇ = a + K ζ + D (ν − ν̄) + B (u − ū),    ζ̇ = ν.

K, D and B are finite differences like those of `mjd_transitionFD`, of several trees of bodies at once, with gravity,
Coriolis forces, springs, servos. What differs from the simulation takes the time steps of the model's own integrator.
Where actuators have activation, ζ stands for its change as well where it acts, and ν̇ for its rate where it changes.
An actuator at a limit of its control or force has a constant force. Where joints turn far, B is that of the simulation.

A contact force acts as one impulse f at the beginning of the step, implicitly, so that what a stiff servo holds gives
way little: it changes ν by S f and ζ by h S f with S = (M + [h (−M D) + h² (−M K)]₊)⁻¹, where [·]₊ is the part of the
symmetric matrix that resists motion (its positive eigenvalues, in the metric of M). So S is positive definite in every
state and for every step, also where Coriolis forces or an unstable equilibrium would make an implicit step indefinite.
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from difflcs._checks import check_positive_int
from difflcs.errors import InvalidInputError
from difflcs.physics.complementarity import FreeMotion
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.actuators import Actuators
from difflcs.physics.mujoco.library import Places, addresses, count_threads, library
from difflcs.physics.mujoco.native import flags, least_time

Array = NDArray[np.float64]

FAST_MOTION = 100.0  # a motion in a step [m, rad] or velocity that may be that of unstable steps
_FINER = 4  # how many steps for one of MuJoCo's where these are unstable
_LONGEST = 100_000  # time steps in one step of the system, far more than any plan is for
_MOST, _FEW = 50, 25  # steps that are simulated one by one; where there are more, so many as long ones
_EULER, _RK4, _IMPLICIT, _FAST, _DISCRETE = (  # the last in MuJoCo 3.14 and later
    int(getattr(mujoco.mjtIntegrator, f"mjINT_{name}", -1))
    for name in ("EULER", "RK4", "IMPLICIT", "IMPLICITFAST", "DISCRETE")
)
_HINGE, _FAR = int(mujoco.mjtJoint.mjJNT_HINGE), 0.5  # turn of it in a step [rad], in which what drives do changes
_DIFFERENCE = 1e-6, 1e-4  # in parts of the size of actions; with equality constraints, which are solved less exactly
_GROWS = 30.0  # by how much a motion that is stable in truth may grow in a step
_WAYS = {_EULER: 0, _RK4: 2, _DISCRETE: 3}  # of `Way` in _native/step.hpp; 1: others
_ADVANCE = {_EULER: "mj_Euler", _IMPLICIT: "mj_implicit", _FAST: "mj_implicit", _DISCRETE: "mj_Euler"}


class Dynamic:
    """Motion by all forces of MuJoCo except those of its constraints, linearised at each state.

    Args:
        model: a private copy; constraints are switched off while it is linearised.
        actuators: of the model.
        seconds: of a step [s].
        relative: actions of servos count from where they are.
    """

    def __init__(self, model: Any, actuators: Actuators, seconds: float, relative: bool):
        self.model, self.seconds, self.actuators = model, seconds, actuators
        self.relative = np.flatnonzero(actuators.servo) if relative else np.zeros(0, dtype=np.intp)
        self.moment = np.zeros((model.nu, model.nv))
        self.moment[self.relative, actuators.dof[self.relative]] = actuators.gear[self.relative]
        count = check_positive_int("seconds, in time steps", max(1, round(seconds / model.opt.timestep)), 1, _LONGEST)
        self.steps = Steps(count, int(model.opt.integrator))
        coarse = self.steps.integrator if self.steps.integrator in (_RK4, _DISCRETE) else _IMPLICIT
        self.simulated = self.steps if self.steps.count <= _MOST or model.neq else Steps(_FEW, coarse)
        damped = not model.opt.disableflags & flags("EULERDAMP")
        self.finer = Steps(_FINER * self.simulated.count, _IMPLICIT)
        self._models: list[Any] = []
        self._disabled, self._described = int(model.opt.disableflags), {}
        # Euler's steps grow by g each where h times the rate of damping, or h²/2 of stiffness, is this much.
        g = _GROWS ** (1 / self.simulated.count)
        most = (1 + g) ** 2 / (2 * g) * (1.39 if self.simulated.integrator == _RK4 else 1)
        fields: dict[str, Any] = {"nv": model.nv, "na": model.na, "nu": model.nu, "seconds": seconds, "most": most}
        fields |= {"damping": (model.dof_damping * damped).tolist(), "brakes": actuators.brakes.tolist()}
        kinds = self.steps, self.simulated, self.finer
        steps = [(k, _WAYS.get(way, 1), actuators.durations(seconds / k).tolist()) for k, way in kinds]
        self._dynamics = _mujoco.Dynamics(fields | {"steps": steps})
        tree = model.dof_treeid.astype(np.int64)  # degrees of freedom of different trees meet by contacts alone
        trees, of_tree = np.unique(tree, return_inverse=True)
        self.in_tree = tree[:, None] == trees  # (nv, n_trees)
        firm = ~np.isin(tree, tree[np.setdiff1d(np.arange(model.nv), actuators.dof)])  # trees with drives everywhere
        self.fields: dict[str, Any] = {"tree": tree, "of_tree": of_tree, "trees": len(trees), "seconds": seconds}
        self.fields |= {"firm": firm, "presses": bool(firm.any()), "reach": actuators.reach, "steps": count}
        self._hinges = model.nv + np.flatnonzero(model.jnt_type[model.dof_jntid] == _HINGE)
        self._bends = np.isin(np.arange(model.nu), actuators.curved)
        self.flags = flags("CONTACT", "LIMIT", "FRICTIONLOSS") if model.neq else flags("CONSTRAINT")
        # Whether it moves otherwise without constraints.
        self.loosens = model.neq > 0 or self.steps.integrator in (_RK4, _DISCRETE)

    def _native(self, steps: Steps, loose: bool = False) -> _mujoco.Motion:
        """Describe steps once; `loose`: without constraints, implicit, as stiff drives that nothing holds overshoot."""
        if (steps, loose) not in self._described:
            kind = (Steps(steps.count, _IMPLICIT), flags("CONSTRAINT")) if loose else (steps, self.flags)
            self._described[steps, loose] = self.describe(*kind)
        return self._described[steps, loose]

    def read(self, places: Places, states: Array, ctrl: Array) -> Linearised:
        """Read the motion at states (n, nq + nv + na) of qpos, qvel and act, at controls (n, nu); NaN: balance.

        Raises:
            InvalidInputError: MuJoCo raised an error, or has counted a warning.
        """
        read = self.read_by(self._native(self.simulated), places, states, ctrl)
        if (unstable := read.unstable.copy()).any():
            again = self.read_by(self._native(self.finer), places, states[unstable], ctrl[unstable])
            for values, better in zip(read, again, strict=True):
                values[unstable] = better
            read.unstable[:] = unstable
        return read

    def find_secants(self, read: Linearised, places: Places, states: Array, x: Array) -> Linearised:
        """Add lines nearest to ends and middles of ranges, for actuators whose force is not linear in the control.

        Where a joint turns far in a step, what is linear half way says little, and differences of the simulation stand
        for all actuators. The states are those of MuJoCo and of the system, (n, n_x).
        """
        curved, bends, moment = self.actuators.curved, self._bends, self.moment
        fast = (self.seconds * np.abs(x[:, self._hinges]) > _FAR).any(-1) & ~read.unstable
        if not (fast.any() or curved.size):
            return read
        ctrl = read.nominal + x[:, : moment.shape[1]] @ moment.T
        low, high = self.actuators.range[:, None] - ctrl
        size = _DIFFERENCE[bool(self.model.neq)] * self.actuators.reach
        near = np.where(high > -low, np.minimum(high, size), np.maximum(low, -size))
        ends = np.zeros((4 if curved.size else 1, *ctrl.shape))
        if curved.size:
            ends[:, :, curved] = np.stack([low, high, 0.5 * low, 0.5 * high])[:, :, curved]
        ends[0] += near * (fast[:, None] & ~bends)
        secants = np.repeat(np.where(ends.any(0), 0.0, np.inf)[:, None], x.shape[1], 1)
        weights = ends / np.maximum((ends**2).sum(0), 1e-300)
        for kind in (bends, ~bends):
            _, state, i = those = np.nonzero(ends * kind)
            if not i.size:
                continue
            other = ctrl[state]
            other[np.arange(len(i)), i] += ends[those]
            taken, steps = (places, states[state], other), self._native(self.simulated)
            after = self.simulate(*taken, read.unstable[state]) if bends[i[0]] else self.run(steps, *taken)
            with np.errstate(over="ignore", invalid="ignore"):
                change = (after - read.reached[state]) * weights[those][:, None]
            np.add.at(secants.swapaxes(1, 2), (state, i), change)
        return read._replace(secant=secants)

    def simulate(
        self, places: Places, states: Array, ctrl: Array, unstable: NDArray[np.bool_], loose: bool = False
    ) -> Array:
        """Return ζ, ν and the change of activation (n, n_x) after a step at controls (n, nu), see `read`.

        What becomes fast is simulated in finer steps as well, as drives may be stiffer with another action. Where it is
        `loose`, there are no equality constraints either.
        """
        after = np.full((len(states), 2 * self.model.nv + self.model.na), np.inf)
        for steps, some in ((self.simulated, ~unstable), (self.finer, None)):
            some = ~(np.abs(after).max(1) < FAST_MOTION) if some is None else some
            if some.any():
                after[some] = self.run(self._native(steps, loose), places, states[some], ctrl[some])
        return after

    def run(self, described: _mujoco.Motion, places: Places, states: Array, ctrl: Array) -> Array:
        """Do so by the steps that are `described`; NaN where MuJoCo warns."""
        after = np.empty((len(states), 2 * self.model.nv + self.model.na))
        taken = places.take(len(after)), states, ctrl, after
        places.check(_mujoco.simulate(library(), described, *taken), len(after))
        return after

    def read_by(self, described: _mujoco.Motion, places: Places, states: Array, ctrl: Array) -> Linearised:
        """Read it by the steps that are `described`, stable or not."""
        n, nv, nu, na = len(states), self.model.nv, self.model.nu, self.model.na
        n_x = 2 * nv + na
        sizes = ((n_x,), (n_x - nv,), (n_x - nv, n_x + nu), (nv, nv), (nu,), (n_x,))
        arrays = (np.zeros((n, *size)) for size in sizes)
        read = Linearised(*arrays, unstable=np.zeros(n, dtype=bool), secant=np.zeros((n, n_x, 0)))
        taken = self._dynamics, places.take(n), states, np.ascontiguousarray(ctrl), read._asdict()
        places.check(_mujoco.read_motion(library(), described, *taken), n)
        if na:
            self.actuators.even_out(read.nominal, states[:, -na:] + read.middle[:, -na:], read.rates)
        return read

    def describe(self, steps: Steps, disabled: int) -> _mujoco.Motion:
        """Describe for the compiled part how the motion is simulated and linearised, and what balances actuators.

        Args:
            steps: of the simulation.
            disabled: flags of what it leaves out.
        """
        simulated = self._copy(disabled | flags("EULERDAMP") * (steps.integrator == _DISCRETE))
        simulated.opt.timestep, simulated.opt.integrator = self.seconds / steps.count, steps.integrator
        address = addresses().get(_ADVANCE.get(steps.integrator, ""), 0)
        return self.actuators.describe(simulated, self.relative, self._linearised, steps.count, address)

    def _copy(self, disabled: int) -> Any:
        """A copy of the model as it was at first; equality constraints are as soft as in the model's own steps."""
        self._models.append(model := copy.copy(self.model))
        model.opt.disableflags = self._disabled | disabled
        softened = model.eq_solref[:, 0] > 0
        model.eq_solref[softened, 0] = np.maximum(model.eq_solref[softened, 0], least_time(self.model))
        return model

    @cached_property
    def _linearised(self) -> Any:
        """The model with a time step of one second and no implicit part: the next velocity is ν + acceleration."""
        model = self._copy(self.flags | flags("EULERDAMP", "REFSAFE"))
        model.opt.timestep, model.opt.integrator = 1.0, _EULER
        model.opt.solver, model.opt.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 1e-15
        self.actuators.unlimit_rates(model)
        return model

    def finish(self, read: Linearised, x: Array, tangent: Array | None, equality: Any = None) -> DynamicStep:
        """Return the motion at states x (n, n_x), for the tangent of their rotations, with soft `EqualityRows`.

        Raises:
            InvalidInputError: rounding leaves no factor of a mass matrix.
        """
        (n, n_x), nv, nu = x.shape, self.model.nv, self.model.nu
        given = read._asdict() | {"x": x, "normal": np.zeros((n, 0, nv)), "damping": x[:, :0], "firm": x[:, :0]}
        given |= equality._asdict() if equality is not None else {}
        sizes = {"step": (n_x, n_x + nu + 1), "delayed": (2 * nv, n_x + nu + 1), "response": (nv, nv)}
        sizes |= {"inverse_mass": (nv, nv), "place": (nv,)}
        found = {name: np.empty((n, *size)) for name, size in sizes.items()}
        if not _mujoco.make_steps(count_threads(n), self._dynamics, given, found):
            raise InvalidInputError(
                "model: expected a mass matrix that double precision can factor, got one that is singular by rounding; "
                "make the lightest bodies heavier, or add armature to their joints"
            )
        turn = None if tangent is None else _find_turn(tangent)
        return DynamicStep(self, x, **found, idle=read.nominal, turn=turn)


class Steps(NamedTuple):
    """Number of MuJoCo's steps in one of ours, and their integrator."""

    count: int
    integrator: int


class Linearised(NamedTuple):
    """Linearised motion of n states.

    Attributes:
        middle: (n, n_x) where the nominal control leads in half a step, as ζ, ν and the change of the activation na;
            all is linearised there.
        acceleration: (n, nv + na) rates of velocities and activation with the nominal control.
        rates: (n, nv + na, n_x + nu) of velocities and activation, by position, velocity, activation and control.
        inverse_mass: (n, nv, nv).
        nominal: (n, nu) action at which this is.
        reached: (n, n_x) where the nominal control leads in a step.
        unstable: (n,) True where this is in finer steps, as the model's are unstable.
        secant: (n, n_x, nu) what a unit of control brings about, infinite where it is as linearised; (n, n_x, 0): all.
    """

    middle: Array
    acceleration: Array
    rates: Array
    inverse_mass: Array
    nominal: Array
    reached: Array
    unstable: NDArray[np.bool_]
    secant: Array


class DynamicStep(NamedTuple):
    """A step from n states.

    Attributes:
        motion: the motion.
        x: (n, n_x) the states: positions, velocities, activation.
        step: (n, n_x, n_x + nu + 1) ζ, ν and the change of activation afterwards, of these, u − ū and 1.
        delayed: (n, 2 nv, n_x + nu + 1) difference of an implicit step, with all loads at its beginning, to (ζ, ν).
        response: (n, nv, nv) S.
        inverse_mass: (n, nv, nv).
        place: (n, nv) ζ afterwards with the nominal action.
        idle: (n, nu) the nominal action.
        turn: numbers (k,) of what has turned, its block (n, k, k) of T in ζ = T (r − r̄), that of T⁻¹; None: nothing.
    """

    motion: Dynamic
    x: Array
    step: Array
    delayed: Array
    response: Array
    inverse_mass: Array
    place: Array
    idle: Array
    turn: tuple[Any, Any, Any] | None

    @property
    def seconds(self) -> float:
        """Duration of the step [s]."""
        return self.motion.seconds

    @property
    def velocity(self) -> Array:
        """(n, nv) velocities."""
        nv = self.place.shape[1]
        return self.x[:, nv : 2 * nv]

    def turn_back(self, change: Array) -> Array:
        """Convert changes of ζ (n, nv or more, k) to those of the state's positions, in place."""
        if self.turn is not None:
            those, _, back = self.turn
            change[:, those] = back @ change[:, those]
        return change

    def free(self, carried: Array) -> FreeMotion:
        """Motion without contact, with `carried` added to (ζ, ν)."""
        motion, at, step, turned = self.motion, self.x.copy(), self.step.copy(), self.response
        n_x, nv, response = at.shape[1], turned.shape[1], np.zeros((*at.shape, at.shape[1]))
        step[:, : 2 * nv] += carried
        self.turn_back(step)
        A, B, d = step[:, :, :n_x].copy(), step[:, :, n_x:-1].copy(), step[:, :, -1:]
        # The control of a servo is held through the step, at a distance from where the joint was at its beginning.
        if motion.relative.size:
            A[:, :, :nv] += B @ motion.moment
        if self.turn is not None:
            those, tangent, back = self.turn
            A[:, :, those], turned = A[:, :, those] @ tangent, turned.copy()
            turned[:, :, those] = turned[:, :, those] @ back.swapaxes(-1, -2)
        at[:, nv : 2 * nv] = 0.0
        at += (d - B @ self.idle[:, :, None] - A @ at[:, :, None])[:, :, 0]
        response[:, :nv, :nv], response[:, nv : 2 * nv, :nv] = self.turn_back(motion.seconds * turned), turned
        matrices: Any = A, B, at, response
        return FreeMotion(*matrices)

    def effect(self, normal: Array, impulse: Array) -> Array:
        """Compute what forces add to the next state (n, n_x, k): ζ gets h S `normal` (n, k, nv), ν S `impulse`."""
        nv, change = self.place.shape[1], np.zeros((*self.x.shape, normal.shape[1]))
        change[:, :nv] = self.response @ (self.seconds * normal).swapaxes(-1, -2)
        change[:, nv : 2 * nv] = self.response @ impulse.swapaxes(-1, -2)
        return self.turn_back(change)


def _find_turn(tangent: Array) -> tuple[Any, Any, Any]:
    """Find the block of T (n, nv, nv) that is not that of the identity, see `DynamicStep.turn`."""
    differs: Any = np.any(tangent != np.eye(tangent.shape[1]), 0)
    those = np.flatnonzero(differs.any(0) | differs.any(1))
    block = tangent[:, those[:, None], those]
    return those, block, np.linalg.inv(block)
