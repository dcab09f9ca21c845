"""MujocoCost: quadratic costs of where bodies, sites and geoms of a MuJoCo model are, linearised at each state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from difflcs._checks import (
    broadcast_batch,
    check_array,
    check_kind,
    check_list,
    check_number,
    check_shape,
    check_tensor,
    describe,
    did_you_mean,
)
from difflcs._fields import TensorFields, register
from difflcs.cost import QuadraticCost
from difflcs.errors import DTypeError, InvalidInputError, ShapeError
from difflcs.physics.mujoco.lcs import MujocoLCS
from difflcs.physics.mujoco.native import in_turn, to_numpy
from difflcs.physics.mujoco.state import cross

Weight = float | Sequence[float] | Tensor


@dataclass(frozen=True, eq=False)
class _Squares:
    """Squares with weights: one number, or one for each square, of all stages, and of the final state (None: the same).

    A tensor that requires grad is learned.
    """

    _: KW_ONLY
    weight: Weight = 1.0
    weight_final: Weight | None = None


@dataclass(frozen=True, eq=False)
class Position(_Squares):
    """Σ wᵢ (pᵢ − goalᵢ)² of the position p of a body, site or geom [m²].

    Attributes:
        of: its name. If several have it, the body is meant, then the site; "site:name" and "geom:name" say which.
        goal: (3,) in the world [m]; None: that of each call.
    """

    of: str
    goal: ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class Orientation(_Squares):
    """Σ wᵢ rᵢ² of the rotation vector r from the orientation of a body, site or geom to a goal [rad²].

    r is the logarithm of the remaining rotation, in coordinates of the object; near the state where the cost is
    linearised it is taken to change as the object turns.

    Attributes:
        of: its name, as for `Position`.
        goal: (4,) quaternion w, x, y, z of any length, zero for no rotation; None: that of each call.
        reach: angle [rad] beyond which a goal pulls no harder; None: no limit.
    """

    of: str
    goal: ArrayLike | None = None
    reach: float | None = None


@dataclass(frozen=True, eq=False)
class Distance(_Squares):
    """Σ wᵢ (aᵢ − bᵢ)² of the positions a and b of two bodies, sites or geoms [m²].

    Attributes:
        first, second: their names, as for `Position`.
    """

    first: str
    second: str


@dataclass(frozen=True, eq=False)
class Posture(_Squares):
    """Σ wᵢ (qᵢ − goalᵢ)² of the coordinates q of slides and hinges [m², rad²].

    Attributes:
        joints: their names; None: all of the model, in its order.
        goal: one number for each joint; None: that of each call.
    """

    joints: Sequence[str] | None = None
    goal: ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class Velocity(_Squares):
    """Σ wᵢ vᵢ² of the velocities v of joints, where the state has velocities [m²/s², rad²/s²].

    Attributes:
        joints: their names, with all degrees of freedom of free joints and balls; None: all of the model.
    """

    joints: Sequence[str] | None = None


@dataclass(frozen=True, eq=False)
class Effort:
    """Σ wᵢ uᵢ² of the actions, with one weight or one for each action."""

    weight: Weight = 1.0


Term = Position | Orientation | Distance | Posture | Velocity | Effort
_NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])
_ROUNDING = 1e-13  # of the largest curvature, added to all, as AᵀWA is positive semi-definite up to rounding
_DAMPING, _STEPS, _TURN_STEP = 1e-4, 40, 0.3  # of inverse kinematics: part of the largest curvature; the most; [rad]


class MujocoCost(TensorFields):
    """Costs in task space, as a `CostModule`: sums of squares, linearised at each state (Gauss–Newton).

        cost = MujocoCost(module, [
            Position("cube", goal=(0.0, 0.0, 0.05), weight=100.0),
            Orientation("cube", weight=7.5, reach=1.6),  # its quaternion comes with each call
            Distance("cube", "fingertip", weight=1.0),
            Effort(0.2),
        ])
        mpc = LCSMPCLayer(module, cost, horizon=4)
        plan = mpc(x, quaternion)

    Weights multiply squares without a factor ½, as those of `GoalCost.reach`; those of stages count at x₀ … x_{H−1},
    the final ones at x_H. Value and gradient at the state are those of the squares. Second derivatives are 2 AᵀWA with
    Jacobians A of MuJoCo. Weights that require grad, and goals of a call, get gradients; the state where squares are
    linearised gets none. Use an object from one thread at a time, as it keeps a private copy of the model's data.

    Args:
        module: the `MujocoLCS` whose states these are, also after the reference of its rotations has moved.
        terms: the terms of the cost.

    Attributes:
        n_x, n_u: sizes of the module.
        n_goal: size of the goal of a call. In the order of the terms, it has 3 numbers for each `Position` without a
            goal of its own, 4 for each `Orientation`, one for each joint of a `Posture`.
        constant: whether the cost is the same at all states.
        local: True; with several passes it is linearised along the plan, see `CostModule`.

    Raises:
        InvalidInputError and its kinds: a term does not fit the model.
    """

    local = True
    _called = "terms[{}] {}"  # what errors call a term by its number and kind

    def __init__(self, module: MujocoLCS, terms: Sequence[Term]):
        super().__init__()
        check_kind("module", module, MujocoLCS, "pass the one of the system")
        if not isinstance(terms, Sequence) or not terms:
            raise DTypeError(f"terms: expected a list of Position, Orientation, …, got {describe(terms)}; give some")
        self.n_x, self.n_u = module.n_x, module.n_u
        self._scene = _Scene(module)
        rows = [self._scene.bind(self._called.format(k, type(term).__name__), term) for k, term in enumerate(terms)]
        ends = np.cumsum([0, *(row.size for row in rows)])
        weights = np.zeros((2, ends[-1]))  # of stages and of the final state
        self._learned: list[tuple[str, Any]] = []
        for k, (row, term) in enumerate(zip(rows, terms, strict=True)):
            for name, stages in (("weight", slice(None)), ("weight_final", 1)):
                weight = _weight(f"{row.about}: {name}", getattr(term, name, None), row.size)
                at = stages, slice(ends[k], ends[k + 1])
                if isinstance(weight, Tensor):
                    register(self, f"{name}_{k}", weight)
                    self._learned.append((f"{name}_{k}", at))
                elif weight is not None:
                    weights[at] = weight
        register(self, "weights", torch.from_numpy(weights))
        kinds = np.array([row.kind for row in rows for _ in range(row.size)], int)
        self._squares, efforts = np.flatnonzero(kinds != _EFFORT), np.flatnonzero(kinds == _EFFORT)
        self._efforts = efforts.reshape(sum(row.kind == _EFFORT for row in rows), self.n_u)
        self._rows = [row for row in rows if row.kind != _EFFORT]
        self.n_goal = sum(row.n_goal for row in self._rows if row.goal is None)
        self.constant = not (self.n_goal or self._scene.frames)

    def at(self, x: Tensor, goal: Tensor | None = None, context: Tensor | None = None) -> QuadraticCost:
        """The cost of plans from states x (..., n_x) to goals (..., n_goal); no context changes it.

        Raises:
            InvalidInputError and its kinds: states or goals of another size, or a weight that was learned below 0.
        """
        given = [*self._held(["weights", *(name for name, _ in self._learned)]).values(), *self._check_goal(goal)]
        given = [value.to("cpu", torch.float64) for value in given]
        learns = torch.is_grad_enabled() and any(value.requires_grad for value in given)
        of: Any = torch if learns else np  # the formulas below are those of both; NumPy takes a third of the time
        arrays: list[Any] = given if learns else [to_numpy(value) for value in given]
        weights, *others = arrays
        weights = weights + 0  # a copy
        for (_, at), value in zip(self._learned, others, strict=False):
            weights[at] = value
        if self._learned and bool((weights < 0).any()):
            raise InvalidInputError(
                f"weight: expected at least 0 of weights that are learned, got {float(weights.min()):g}; clamp them "
                f"after each step of the optimiser"
            )
        weight, effort = weights[:, self._squares], weights[0, self._efforts].sum(0)
        A, offset, turns = self._scene.read(x, self._rows)
        if learns:
            A, offset, turns = map(torch.from_numpy, (A, offset, turns))
        left = offset - self._wanted(of, others[-1] if self.n_goal else None, turns)
        weighted = 2 * weight[..., None] * A[..., None, :, :]  # (..., 2, rows, n_x), of stages and the final state
        Q = A[..., None, :, :].swapaxes(-1, -2) @ weighted
        q = (left[..., None, None, :] @ weighted)[..., 0, :]
        constant = (weight * left[..., None, :] ** 2).sum(-1)
        Q = Q + _ROUNDING * of.amax(abs(Q), (-3, -2, -1), keepdims=True) * of.eye(self.n_x)
        fields = {"Q": Q[..., 0, :, :], "R": 2 * of.diag(effort), "Q_final": Q[..., 1, :, :], "q": q[..., 0, :]}
        fields |= {"r": of.zeros(self.n_u), "q_final": q[..., 1, :]}
        fields |= {"constant": constant[..., 1], "constant_stage": constant[..., 0]}
        tensors = fields if learns else {name: torch.from_numpy(np.asarray(v)) for name, v in fields.items()}
        if x.dtype is not torch.float64 or not x.is_cpu:
            tensors = {name: value.to(x.device, x.dtype) for name, value in tensors.items()}
        return QuadraticCost.of_checked(tensors)

    def reach(self, x: Tensor, goal: Tensor | None, joints: Sequence[str], margin: float = 0.0) -> Tensor:
        """Inverse kinematics: states (..., n_x) near x (..., n_x) in which joints make the cost of stages small.

        Gauss–Newton, damped, within the ranges of the joints. What it finds may be a local minimum.

        Args:
            x: where it begins.
            goal: (..., n_goal), as for `at`.
            joints: names of the slides and hinges that move.
            margin: how far they stay from the ends of their ranges [m, rad].

        Raises:
            InvalidInputError and its kinds: an argument does not fit.
        """
        columns, model, margin = self._scene.dofs("joints", joints), self._scene._model, check_number("margin", margin)
        given, x = x, check_tensor("x", x, [("n_x", self.n_x)]).to("cpu", torch.float64, copy=True)
        numbers = model.dof_jntid[columns]
        limited, turns = model.jnt_limited[numbers, None], model.jnt_type[numbers] == int(mujoco.mjtJoint.mjJNT_HINGE)
        low, high = torch.from_numpy(
            np.where(limited, model.jnt_range[numbers] + [margin, -margin], [-np.inf, np.inf])
        ).T
        most = torch.from_numpy(np.where(turns, _TURN_STEP, np.inf))
        for _ in range(_STEPS if columns and x.numel() else 0):
            near, at = self.at(x, goal), x[..., columns]
            slope = ((near.Q @ x.unsqueeze(-1)).squeeze(-1) + near.q)[..., columns]
            curve = near.Q[..., columns, :][..., columns]
            free = (~((at <= low) & (slope > 0) | (at >= high) & (slope < 0))).to(x)
            damping = _DAMPING * curve.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True) + _ROUNDING
            curve = curve * free.unsqueeze(-1) * free.unsqueeze(-2) + torch.diag_embed(damping + 1 - free)
            step = -torch.linalg.solve(curve, free * slope)
            step *= (most / step.abs()).amin(-1, keepdim=True).clamp(max=1.0)
            x[..., columns] = (at + step).clamp(low, high)
            if float(step.abs().max()) < 1e-4:
                break
        return x.to(given)

    def _check_goal(self, goal: Tensor | None) -> list[Tensor]:
        """The goal of a call, if there is to be one."""
        if not self.n_goal and goal is not None:
            raise ShapeError(
                f"goal: expected none, as all terms have goals of their own, got {describe(goal)}; leave out the goal "
                f"of a term to give it with each call"
            )
        if self.n_goal and goal is None:
            raise ShapeError(
                f"goal: expected (..., n_goal={self.n_goal}) for terms without a goal of their own, got none; call "
                f"mpc(x0, goal)"
            )
        return [] if goal is None else [check_tensor("goal", goal, [("n_goal", self.n_goal)])]

    def _wanted(self, of: Any, goal: Any, turns: Any) -> Any:
        """Compute the targets of all rows (..., rows), where frames have the orientations `turns` (..., frames, 4)."""
        parts, start = [of.zeros(0)], 0
        for row in self._rows:
            if row.goal is None:
                wanted, start = goal[..., start : start + row.n_goal], start + row.n_goal
            else:
                wanted = of.asarray(row.goal)
            if row.kind == _TURN:
                wanted = _rotation_between(of, turns[..., row.where[0], :], wanted, row.reach)
            parts.append(wanted)
        shape = broadcast_batch([("goal", part.shape[:-1]) for part in parts])
        fits = [p if p.shape[:-1] == shape else of.broadcast_to(p, (*shape, p.shape[-1])) for p in parts]
        return of.concatenate(fits, -1)


def _rotation_between(of: Any, here: Any, goal: Any, reach: float) -> Any:
    """Compute log(here⁻¹ goal) (..., 3) of quaternions (..., 4), with an angle of at most `reach`."""
    square = (goal * goal).sum(-1)[..., None]
    none = square < 1e-30  # no rotation, as MuJoCo reads it
    goal = of.where(none, of.asarray(_NO_ROTATION), goal / of.sqrt(of.where(none, 1.0, square)))
    w, v, goal_w, goal_v = here[..., :1], here[..., 1:], goal[..., :1], goal[..., 1:]
    cosine = w * goal_w + (v * goal_v).sum(-1)[..., None]
    sign = of.where(cosine < 0, -1.0, 1.0)
    turn = sign * (w * goal_v - goal_w * v - cross(v, goal_v))
    square = (turn * turn).sum(-1)[..., None]
    tiny = square < 1e-24
    sine = of.sqrt(of.where(tiny, 1.0, square))
    angle = 2 * of.arctan2(sine, sign * cosine)
    return turn * of.where(tiny, 2.0, of.where(angle > reach, reach, angle) / sine)


def _weight(name: str, value: Weight | None, size: int) -> Any:
    """A weight: a tensor as it is, anything else as an array."""
    if value is None:
        return None
    weight: Any = value if isinstance(value, Tensor) else check_array(name, value)
    check_tensor(name, torch.as_tensor(weight))
    if weight.shape not in ((), (size,)):
        raise ShapeError(f"{name}: expected one number or {size} of them, got {describe(weight)}; see the term")
    if bool((weight < 0).any()):
        raise InvalidInputError(f"{name}: expected at least 0, got {float(weight.min()):g}; change its sign")
    return weight


# --- where things are -----------------------------------------------------------------------------------------------

_POINT, _TURN, _COORDINATE, _EFFORT = range(4)
_FRAMES = {
    "body": (mujoco.mjtObj.mjOBJ_BODY, "xpos", "xmat", mujoco.mj_jacBody),
    "site": (mujoco.mjtObj.mjOBJ_SITE, "site_xpos", "site_xmat", mujoco.mj_jacSite),
    "geom": (mujoco.mjtObj.mjOBJ_GEOM, "geom_xpos", "geom_xmat", mujoco.mj_jacGeom),
}


class _Row(NamedTuple):
    """Rows of a term: `size` squares of one kind, of the frames or the columns of the state `where`.

    The goal has `n_goal` numbers; None: that of a call.
    """

    about: str
    kind: int
    size: int
    where: Sequence[int] = ()
    n_goal: int = 0
    goal: ArrayLike | None = None
    reach: float = torch.inf

    def checked(self) -> _Row:
        """The same with its goal as an array."""
        if self.goal is None:
            return self
        goal = check_array(f"{self.about}: goal", self.goal)
        check_shape(f"{self.about}: goal", torch.from_numpy(goal), str(self.n_goal), remedy="see the term")
        return self._replace(goal=goal)


class _Scene:
    """Frames of bodies, sites and geoms, and coordinates, that terms have named."""

    def __init__(self, module: MujocoLCS):
        self._module, self._model = module, module._model
        self._data = mujoco.MjData(self._model)
        self.frames: list[tuple[str, int]] = []

    @property
    def _turns(self) -> Any:
        return self._module._turns

    def bind(self, about: str, term: Term) -> _Row:
        """Find what a term is about."""
        if isinstance(term, Effort):
            return _Row(about, _EFFORT, self._module.n_u)
        if isinstance(term, Position):
            return _Row(about, _POINT, 3, [self._frame(about, term.of)], 3, term.goal).checked()
        if isinstance(term, Distance):
            pair = [self._frame(about, name) for name in (term.first, term.second)]
            return _Row(about, _POINT, 3, pair, 3, np.zeros(3))
        if isinstance(term, Orientation):
            reach = torch.inf if term.reach is None else check_number(f"{about}: reach", term.reach, strict=True)
            return _Row(about, _TURN, 3, [self._frame(about, term.of)], 4, term.goal, reach).checked()
        if not isinstance(term, Posture | Velocity):
            raise DTypeError(f"{about}: expected Position, Orientation, … or Effort, got {describe(term)}; build one")
        columns = self.dofs(about, term.joints, turning=isinstance(term, Velocity))
        size, state = len(columns), self._module.state
        if isinstance(term, Posture):
            return _Row(about, _COORDINATE, size, columns, size, term.goal).checked()
        if not state.velocities:
            raise InvalidInputError(
                f'{about}: expected a module whose state has velocities (motion="dynamic"), got one of positions; '
                f"leave it out"
            )
        return _Row(about, _COORDINATE, size, [state.nv + column for column in columns], size, np.zeros(size))

    def _frame(self, about: str, name: str) -> int:
        """Find the number of a body, site or geom."""
        kind, _, rest = str(name).partition(":")
        kinds = {kind: rest} if kind in _FRAMES and rest else dict.fromkeys(_FRAMES, str(name))
        for kind, called in kinds.items():
            index = mujoco.mj_name2id(self._model, int(_FRAMES[kind][0]), called)
            if index >= 0:
                if (kind, index) not in self.frames:
                    self.frames.append((kind, index))
                return self.frames.index((kind, index))
        everything = [(int(_FRAMES[k][0]), i) for k in kinds for i in range(getattr(self._model, f"n{k}"))]
        raise _unknown(about, " or ".join(kinds), (mujoco.mj_id2name(self._model, *one) for one in everything), name)

    def dofs(self, about: str, names: Sequence[str] | None, turning: bool = False) -> list[int]:
        """Find the degrees of freedom of joints; `turning`: also of free joints and balls."""
        model, state = self._model, self._module.state
        ends = [*map(int, model.jnt_dofadr), state.nv]
        known = {
            model.joint(j).name or f"joint{j}": range(ends[j], ends[j + 1])
            for j in range(model.njnt)
            if turning or ends[j + 1] - ends[j] == 1
        }
        names = list(known) if names is None else [names] if isinstance(names, str) else names
        for name in (names := check_list(about, names, "name joints, or leave them out")):
            if not isinstance(name, str) or name not in known:
                raise _unknown(about, "joint" if turning else "slide or hinge", known, name)
        return [dof for name in names for dof in known[name]]

    @in_turn
    def read(self, x: Tensor, rows: Sequence[_Row]) -> tuple[Any, Any, Any]:
        """Read rows at states x (..., n_x).

        Returns:
            A (..., rows, n_x) and b (..., rows), so that A x + b is what the rows measure, of rotations the change;
            and orientations (..., frames, 4).
        """
        state, model, data, source = self._module.state, self._model, self._data, self._module._data
        qpos = state.to_mujoco(x)[0].reshape(-1, state.nq)
        flat, nv, n, count = to_numpy(x), state.nv, len(qpos), len(self.frames)
        batch, flat = flat.shape[:-1], flat.reshape(n, flat.shape[-1])
        place, turn, moves = np.empty((n, count, 3)), np.empty((n, count, 9)), np.empty((n, count, 2, 3, nv))
        turns, turning = np.zeros((n, count, 4)), {row.where[0] for row in rows if row.kind == _TURN}
        data.mocap_pos[:], data.mocap_quat[:] = source.mocap_pos, source.mocap_quat
        for i in range(n if count else 0):
            data.qpos[:] = qpos[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            for k, (kind, index) in enumerate(self.frames):
                _, places, mats, differentiate = _FRAMES[kind]
                place[i, k] = getattr(data, places)[index]
                if k in turning:
                    turn[i, k] = getattr(data, mats)[index]
                    mujoco.mju_mat2Quat(turns[i, k], turn[i, k])
                differentiate(model, data, moves[i, k, 0], moves[i, k, 1], index)
        if (tangent := state.tangent(flat[:, :nv])) is not None and count:
            moves = moves @ tangent[:, None, None]
        value, start = np.zeros((n, sum(row.size for row in rows))), 0
        A = np.zeros((*value.shape, flat.shape[-1]))
        for row in rows:
            at, start = slice(start, start + row.size), start + row.size
            if row.kind == _COORDINATE:
                A[:, range(at.start, at.stop), row.where] = 1.0
                value[:, at] = flat[:, row.where]
            elif row.kind == _TURN:
                k = row.where[0]
                A[:, at, :nv] = turn[:, k].reshape(n, 3, 3).swapaxes(-1, -2) @ moves[:, k, 1]
            else:
                value[:, at], A[:, at, :nv] = place[:, row.where[0]], moves[:, row.where[0], 0]
                for k in row.where[1:]:
                    value[:, at] -= place[:, k]
                    A[:, at, :nv] -= moves[:, k, 0]
        offset = value - (A @ flat[..., None])[..., 0]
        A, offset, turns = (value.reshape(*batch, *value.shape[1:]) for value in (A, offset, turns))
        return A, offset, turns


def _unknown(about: str, kinds: str, known: Any, name: object) -> InvalidInputError:
    """The error of a name that is none of those there are."""
    known = [each for each in dict.fromkeys(known) if each]
    return InvalidInputError(
        f"{about}: expected a {kinds}, one of {', '.join(known)}, got {describe(name)}{did_you_mean(name, known)}; "
        f"name one of them"
    )
