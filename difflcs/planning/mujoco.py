"""Places round a body of any MuJoCo model, paths of end effectors on slides or arms, and trials before it moves.

Needs the extra `envs`. MuJoCo's kinematics say where end effectors are, and the gaps of the `MujocoLCS` itself what is
free of collisions: what may not touch there is not in the way.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from difflcs._checks import check_kind, check_list, check_number, check_positive_int, takes
from difflcs._linalg import one_thread
from difflcs.errors import InvalidInputError
from difflcs.physics.mujoco import MujocoCost, MujocoLCS, Position

__all__ = ["BodyPlaces", "BodyTravel", "Rehearsal"]

_SINGLE = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
_LEAST = 0.3  # of the clearance, that must be left on the way
_COAST = 2.0  # steps in which a robot that is no longer driven comes to rest, about
_POINTS = 8  # of a straight way, at which gaps are asked for


class _Effectors(MujocoCost):
    """Positions of end effectors, which errors call by the argument of `BodyPlaces`."""

    _called = "effectors[{}]"


class BodyPlaces:
    """End effectors of a MuJoCo model round a body of any shape, on slides or at the end of arms.

    A place is where the end effectors are, in coordinates of the body. From all sides an end effector comes straight
    towards the middle of the body, until only the gap is left. Each in turn goes to each place while the others stay.
    Their joints follow by inverse kinematics, within their ranges; the orientation of an end effector is left open.

    Args:
        module: the system, whose contacts say what is in the way.
        body: name of the body that is pushed.
        effectors: names of the end effectors, bodies, sites or geoms; the geoms of these bodies push.
        n_places: at equal angles, for each end effector and each height.
        gap: between an end effector at a place and the body [m]; None: a tenth of `module.length`.
        reach: largest gap at which pushing is considered [m]; None: `module.length`.
        height: of places above the middle of the body [m]; None: as high as the end effector is, so that there is no
            place where it is above or below the body.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(
        self,
        module: MujocoLCS,
        body: str,
        effectors: Sequence[str],
        n_places: int = 16,
        *,
        gap: float | None = None,
        reach: float | None = None,
        height: float | None = None,
    ):
        names = check_list("effectors", effectors, "name bodies, sites or geoms")
        self._cost = _Effectors(module, [Position(name) for name in names])
        self.module, self.n_places = module, check_positive_int("n_places", n_places)
        self.n_x, self.n_effectors, self.n_place = module.n_x, len(names), 3 * len(names)
        self.gap = 0.1 * module.length if gap is None else check_number("gap", gap, strict=True)
        self.reach = module.length if reach is None else check_number("reach", reach)
        self.height = None if height is None else check_number("height", height, -math.inf)
        model = module._model
        self._model, self._data, self._axis = model, mujoco.MjData(model), module._finder.axis
        frames = self._cost._scene.frames
        carriers = [i if kind == "body" else int(getattr(model, f"{kind}_bodyid")[i]) for kind, i in frames]
        self._body = mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_BODY), str(body))
        of, pairs = model.geom_bodyid, np.stack(module._finder.pairs, -1)
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        self._pairs = [pairs[(of[pairs] == [tip, self._body]).all(-1)] for tip in carriers]
        pushed, moved = _dofs_above(model, max(self._body, 0)), set().union(*(_dofs_above(model, t) for t in carriers))
        own = [j for j in range(model.njnt) if model.jnt_type[j] in _SINGLE and model.jnt_dofadr[j] in moved - pushed]
        self.joints = [model.joint(j).name or f"joint{j}" for j in own]
        self._columns, self._pushed = [int(model.jnt_dofadr[j]) for j in own], sorted(pushed - moved)
        if not own or not all(map(len, self._pairs)):
            raise InvalidInputError(
                f"effectors: expected bodies that slides or hinges of their own move, and that may touch the body "
                f"{body!r:.100}, got {names}; name such, and let the module's `pairs` have them"
            )

    @takes(x="n_x")
    def sample(self, x: Tensor) -> Tensor:
        """See `Places`: (n, 3 · n_effectors) in coordinates of the body."""
        points = torch.cat([self.ring(x, k, self.gap) for k in range(len(self._pairs))])
        place, turn = self._pose(x)
        return ((points - place) @ turn).flatten(1)

    @takes(x="n_x", places="n n_place")
    def states(self, x: Tensor, places: Tensor) -> Tensor:
        """See `Places`."""
        place, turn = self._pose(x)
        return self.at(x, places.unflatten(-1, (-1, 3)) @ turn.mT + place)

    @takes(states="... n_x")
    def allowed(self, states: Tensor) -> Tensor:
        """See `Places`."""
        return self.gaps(states) > 0

    @takes(x="n_x")
    def near(self, x: Tensor) -> bool:
        """See `Places`."""
        return bool(self.gaps(x, self._pushed) < self.reach)

    @takes(x="... n_x")
    def points(self, x: Tensor) -> Tensor:
        """Compute where the end effectors are (..., n_effectors, 3) at states x (..., n_x) [m]."""
        A, offset, _ = map(torch.as_tensor, self._cost._scene.read(x, self._cost._rows))
        return ((A @ x.unsqueeze(-1)).squeeze(-1) + offset).unflatten(-1, (-1, 3))

    @takes(x="n_x", points="n n_effectors 3")
    @one_thread()
    def at(self, x: Tensor, points: Tensor) -> Tensor:
        """Find states (n, n_x) at rest near x (n_x,) with end effectors at points (n, n_effectors, 3), or near."""
        states, nv = x.repeat(len(points), 1), self.module.state.nv
        states[:, nv : 2 * nv] = 0.0
        return self._cost.reach(states, points.flatten(1), self.joints)

    @takes(states="... n_x")
    def gaps(self, states: Tensor, of: Sequence[int] | None = None) -> Tensor:
        """Return the smallest gap (...) of the robot at states (..., n_x) [m], with what these columns move, if any."""
        for i, column in enumerate([] if of is None else check_list("of", of, "give columns of positions")):
            check_positive_int(f"of[{i}]", column, 0, self.module.state.nv - 1)
        qpos = self.module.state.to_mujoco(states)[0]
        contacts = self.module._finder.find(qpos.reshape(-1, qpos.shape[-1]))
        counts = (contacts.normal[..., self._columns] != 0).any(-1)
        if of is not None:
            counts &= (contacts.normal[..., [*of]] != 0).any(-1)
        return torch.from_numpy(np.where(counts, contacts.gap, np.inf).min(-1)).reshape(states.shape[:-1])

    @takes(x="n_x")
    def ring(self, x: Tensor, effector: int, gap: float) -> Tensor:
        """Return points (n, n_effectors, 3), one of which goes round the body at a gap, at a state x (n_x,)."""
        check_positive_int("effector", effector, 0, self.n_effectors - 1)
        gap = check_number("gap", gap, strict=True)
        turn, points = self._pose(x)[1].numpy(), self.points(x)
        tip, data, model, pairs = points[effector].numpy(), self._data, self._model, self._pairs[effector]
        middle, start = data.xipos[self._body].copy(), data.geom_xpos.copy()
        axis = np.array([0.0, 0.0, 1.0]) if self._axis is None else self._axis
        first = turn[:, np.abs(axis @ turn).argmin()]
        first = (first - (first @ axis) * axis) / np.linalg.norm(first - (first @ axis) * axis)
        given = self.height if self._axis is None else None
        middle += axis * ((tip - middle) @ axis if given is None else given)
        far, found = 2 * model.stat.extent + gap, []
        for angle in np.arange(self.n_places) * (2 * np.pi / self.n_places):
            out, away, left = np.cos(angle) * first + np.sin(angle) * np.cross(axis, first), far, math.inf
            while away > 0 and left > 0.01 * gap:
                data.geom_xpos[pairs[:, 0]] = start[pairs[:, 0]] + middle + away * out - tip
                left = min(mujoco.mj_geomDistance(model, data, a, b, far, None) for a, b in pairs) - gap
                away -= left
            if away > 0:
                found.append(middle + away * out)
        rows = points.repeat(len(found), 1, 1)
        rows[:, effector] = torch.from_numpy(np.array(found).reshape(-1, 3))
        return rows

    def _pose(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the place (3,) and orientation (3, 3) of the body at a state x (n_x,)."""
        self._data.qpos[:] = self.module.state.to_mujoco(x)[0]
        mujoco.mj_kinematics(self._model, self._data)
        return torch.tensor(self._data.xpos[self._body]), torch.tensor(self._data.xmat[self._body]).reshape(3, 3)


def _dofs_above(model: Any, body: int) -> set[int]:
    """Return the degrees of freedom that move a body."""
    own = model.body_dofadr[body] + np.arange(model.body_dofnum[body])
    return {*map(int, own)} | (_dofs_above(model, model.body_parentid[body]) if body > 0 else set())


class BodyTravel:
    """Paths of the end effectors of `BodyPlaces`: straight, round the body, or over it, the shortest that is free.

    Paths are straight in joint coordinates between corners round the body and above it, and free where the robot's gaps
    stay open. The action is that after which the joints come to rest nearest to the next corner.

    Args:
        places: of the same end effectors.
        clearance: gap at corners of a way [m]; None: three times that of places. On the way it is at least .3 of it,
            or as much as at its ends.
        over: height above the middle of the body at which there is a way over it [m]; None: there is none.
        tolerance: distance to the target at which an end effector has arrived [m]; None: the gap of places.
        step: largest |u| of each action; None: what `module.action_bounds` say.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(
        self,
        places: BodyPlaces,
        *,
        clearance: float | None = None,
        over: float | None = None,
        tolerance: float | None = None,
        step: float | None = None,
    ):
        self.places = check_kind("places", places, BodyPlaces)
        self.n_x, self.over = places.n_x, None if over is None else check_number("over", over)
        self.clearance = 3 * places.gap if clearance is None else check_number("clearance", clearance, strict=True)
        self.tolerance = places.gap if tolerance is None else check_number("tolerance", tolerance, strict=True)
        self.step = math.inf if step is None else check_number("step", step, strict=True)

    @takes(x="n_x", states="... n_x")
    def distance(self, x: Tensor, states: Tensor) -> Tensor:
        """See `Travel`: the straight distance of the end effector that has farthest to go."""
        return (self.places.points(states) - self.places.points(x)).norm(dim=-1).amax(-1)

    @takes(x="n_x", target="n_x")
    def arrived(self, x: Tensor, target: Tensor) -> bool:
        """See `Travel`."""
        return bool(self.distance(x, target) < self.tolerance)

    @takes(x="n_x", target="n_x")
    def action(self, x: Tensor, target: Tensor) -> Tensor:
        """See `Travel`."""
        return self._drive(x, self._corner(x, target)[self.places._columns])

    def _corner(self, x: Tensor, target: Tensor) -> Tensor:
        """Return the state (n_x,) at the next corner of the way to a target (n_x,)."""
        places = self.places
        if bool(self._free(x[None], target[None])[0]):
            return target
        here, there = places.points(torch.stack([x, target]))
        corners = places.ring(x, goes := int((there - here).norm(dim=-1).argmax()), self.clearance)
        legs = [(i, i % len(corners) + 1) for i in range(1, len(corners) + 1)]
        if self.over is not None:
            above = torch.stack([here, here])
            above[:, goes, :2] = torch.stack([here, there])[:, goes, :2]
            above[:, goes, 2] = float(places._data.xipos[places._body, 2]) + self.over
            corners, legs = torch.cat([corners, above]), [*legs, (len(corners) + 1, len(corners) + 2)]
        nodes = torch.cat([x[None], places.at(x, corners), target[None]])
        end, points = len(nodes) - 1, places.points(nodes)
        first, second = torch.tensor([*legs, *((i, j) for i in range(1, end) for j in (0, end))]).T
        leg = (points[first] - points[second]).norm(dim=-1).amax(-1)
        leg = torch.where(self._free(nodes[first], nodes[second]), leg, math.inf)
        lengths = x.new_full((end + 1, end + 1), math.inf)
        lengths[first, second] = lengths[second, first] = leg
        left = torch.where(torch.arange(end + 1) == end, 0.0, lengths[end])
        for _ in range(end):
            left = torch.minimum(left, (lengths + left).amin(1))
        by = lengths[0] + left
        if not bool(by.isfinite().any()):  # the nearest corner leads away from the body
            by[1:end] = (points[1:end] - here).norm(dim=-1).amax(-1)
        return nodes[by.argmin()]

    def _free(self, starts: Tensor, ends: Tensor) -> Tensor:
        """Return a mask (n,) of the straight ways from states (n, n_x) to others on which nothing touches."""
        t = torch.linspace(0.0, 1.0, _POINTS, dtype=starts.dtype)[:, None, None]
        states, columns = starts.repeat(_POINTS, 1, 1), self.places._columns
        states[..., columns] = torch.lerp(starts[:, columns], ends[:, columns], t)
        gap = self.places.gaps(states)
        return (gap >= torch.minimum(gap[0], gap[-1]).clamp(max=_LEAST * self.clearance) - 1e-9).all(0)

    def _drive(self, x: Tensor, goal: Tensor) -> Tensor:
        """Return the action (n_u,) that brings the joints to rest nearest to a goal (n_joints,), as far as it may."""
        module, columns = self.places.module, self.places._columns
        system, rest = module.params(x), torch.eye(module.n_x, dtype=x.dtype)[columns]
        if module.state.velocities:
            rest[range(len(columns)), [module.state.nv + c for c in columns]] = _COAST * module.seconds
        ends = torch.stack([x[columns], goal]) - rest @ (system.A @ x + system.d)
        stay, go = torch.linalg.lstsq(rest @ system.B, ends.mT).solution.mT
        low, high = (bound.clamp(-self.step, self.step) for bound in module.action_bounds(x))
        room = torch.where(go > stay, high - stay, low - stay) / (go - stay)
        part = room[(go - stay).abs() > 1e-12].clamp(0.0, 1.0)
        return (stay + part.amin() * (go - stay) if len(part) else stay).clamp(low, high)


class Rehearsal:
    """Controls tried in a simulator before one is executed: the first is taken that ends about as well as the best.

    A linear system may promise what contacts do not keep. A trial tells, for some steps of the simulator.

    Args:
        model: MuJoCo's, with the time step and options of the trials; those of the robot's simulator may be finer.
        seconds: duration of a trial [s].
        cost: MuJoCo's data → cost of its state.
        gain: a control that ends better than now by this is taken, and no further one is tried.
        slack: cost by which the control that is taken may end worse than the best.
        harm: where a control ends worse than now, but by less than this, the next is trusted to do no harm, untried;
            where all end worse by more, staying is tried, too. 0: each control is tried.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(
        self,
        model: Any,
        seconds: float,
        cost: Callable[[Any], float],
        gain: float,
        slack: float = 0.0,
        harm: float = 0.0,
    ):
        self.model = check_kind("model", model, mujoco.MjModel, "pass the model of the trials")
        self.steps = round(check_number("seconds", seconds, strict=True) / model.opt.timestep)
        self.cost, self._data = cost, mujoco.MjData(model)
        self.gain, self.slack, self.harm = (
            check_number(name, value) for name, value in (("gain", gain), ("slack", slack), ("harm", harm))
        )

    def choose(self, data: Any, controls: Sequence[np.ndarray], stay: np.ndarray | None = None) -> np.ndarray:
        """Choose one of some controls.

        Args:
            data: MuJoCo's, where the robot is.
            controls: (nu,) each, the boldest first.
            stay: (nu,) of staying, see `harm`; None: it is no choice.

        Returns:
            One of them, the very array.
        """
        now, tried, ends = self.cost(data), [], []
        for control in controls:
            trusted = ends != [] and now + self.slack < ends[-1] < now + self.harm
            tried.append(control)
            ends.append(now if trusted else self.end(data, control))
            if ends[-1] < now - self.gain:
                break
        if stay is not None and min(ends) > now + self.harm:
            tried.append(stay)
            ends.append(self.end(data, stay))
        return next(control for control, end in zip(tried, ends, strict=True) if end <= min(ends) + self.slack)

    def end(self, data: Any, control: np.ndarray) -> float:
        """Return the cost of the state in which a control (nu,) ends."""
        mujoco.mj_copyState(self.model, data, self._data, mujoco.mjtState.mjSTATE_INTEGRATION)
        self._data.ctrl[:] = control
        mujoco.mj_step(self.model, self._data, self.steps)
        return self.cost(self._data)
