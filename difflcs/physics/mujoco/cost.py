"""MujocoCost: quadratic costs of where bodies, sites and geoms of a MuJoCo model are, linearised at each state."""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from difflcs._checks import check_number, check_tensor, describe, did_you_mean
from difflcs._fields import TensorFields
from difflcs.cost import QuadraticCost
from difflcs.errors import DTypeError, InvalidInputError, NonFiniteError, ShapeError
from difflcs.physics.mujoco.lcs import MujocoLCS
from difflcs.physics.mujoco.state import cross

__all__ = ["Distance", "Effort", "MujocoCost", "Orientation", "Position", "Posture", "Velocity"]

Weight = float | Sequence[float] | Tensor


@dataclass(frozen=True, eq=False)
class Position:
    """Σ wᵢ (pᵢ − goalᵢ)² of the position p of a body, site or geom [m²].

    Attributes:
        of: its name. Where several have it, the body, then the site; "site:name" and "geom:name" say which.
        goal: (3,) in the world [m]; None: that of each call.
        weight: one number, or one for each axis, of all stages; a tensor that requires grad is learned.
        weight_final: the same of the final state; None: as `weight`.
    """

    of: str
    goal: ArrayLike | None = None
    weight: Weight = 1.0
    weight_final: Weight | None = None


@dataclass(frozen=True, eq=False)
class Orientation:
    """Σ wᵢ rᵢ² of the rotation vector r from the orientation of a body, site or geom to a goal [rad²].

    r is the logarithm of the rotation that is left, in coordinates of the thing, and near the state where the cost is
    asked for it changes as the thing turns.

    Attributes:
        of: its name, as for `Position`.
        goal: (4,) quaternion w, x, y, z of any length; None: that of each call.
        weight: one number, or one for each axis of the thing, of all stages.
        weight_final: the same of the final state; None: as `weight`.
        reach: angle [rad] from which on a goal that is farther away pulls no harder; None: there is none.
    """

    of: str
    goal: ArrayLike | None = None
    weight: Weight = 1.0
    weight_final: Weight | None = None
    reach: float | None = None


@dataclass(frozen=True, eq=False)
class Distance:
    """Σ wᵢ (aᵢ − bᵢ)² of the positions a and b of two bodies, sites or geoms [m²].

    Attributes:
        first, second: their names, as for `Position`.
        weight: one number, or one for each axis of the world, of all stages.
        weight_final: the same of the final state; None: as `weight`.
    """

    first: str
    second: str
    weight: Weight = 1.0
    weight_final: Weight | None = None


@dataclass(frozen=True, eq=False)
class Posture:
    """Σ wᵢ (qᵢ − goalᵢ)² of the coordinates q of slides and hinges [m², rad²].

    Attributes:
        joints: their names; None: all of the model, in its order.
        goal: one number for each joint; None: that of each call.
        weight: one number, or one for each joint, of all stages.
        weight_final: the same of the final state; None: as `weight`.
    """

    joints: Sequence[str] | None = None
    goal: ArrayLike | None = None
    weight: Weight = 1.0
    weight_final: Weight | None = None


@dataclass(frozen=True, eq=False)
class Velocity:
    """Σ wᵢ vᵢ² of the velocities v of joints, where the state has velocities [m²/s², rad²/s²].

    Attributes:
        joints: their names, with all degrees of freedom of free joints and balls; None: all of the model.
        weight: one number, or one for each degree of freedom, of all stages.
        weight_final: the same of the final state; None: as `weight`.
    """

    joints: Sequence[str] | None = None
    weight: Weight = 1.0
    weight_final: Weight | None = None


@dataclass(frozen=True, eq=False)
class Effort:
    """Σ wᵢ uᵢ² of the actions.

    Attributes:
        weight: one number, or one for each action, of all stages.
    """

    weight: Weight = 1.0


Term = Position | Orientation | Distance | Posture | Velocity | Effort
_NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])
_ROUNDING = 1e-13  # of the largest curvature, added to all, as AᵀWA is positive semi-definite up to rounding


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
    linearised gets none.

    Use an object from one thread at a time, as it keeps a private copy of the model's data.

    Args:
        module: the `MujocoLCS` whose states these are, also after the reference of its rotations has moved.
        terms: what costs.

    Attributes:
        n_x, n_u: sizes of the module.
        n_goal: size of the goal of a call. In the order of the terms, it has 3 numbers for each `Position` without a
            goal of its own, 4 for each `Orientation`, one for each joint of a `Posture`.

    Raises:
        InvalidInputError and its kinds: a term does not fit the model.
    """

    def __init__(self, module: MujocoLCS, terms: Sequence[Term]):
        super().__init__()
        if not isinstance(module, MujocoLCS):
            raise DTypeError(f"module: expected a MujocoLCS, got {describe(module)}; pass the one of the system")
        self.n_x, self.n_u = module.n_x, module.n_u
        self._scene = _Scene(module)
        rows = [self._scene.bind(f"terms[{k}] {type(term).__name__}", term) for k, term in enumerate(terms)]
        order = sorted(range(len(rows)), key=lambda k: rows[k].kind)
        self._keep_weights(rows, terms, order)
        self._keep_goals(rows, order)

    def _keep_weights(self, rows: Sequence[_Row], terms: Sequence[Term], order: Sequence[int]) -> None:
        """Register weights: numbers together, and tensors by themselves, as they may be learned."""
        given = {
            (name, k): _weight(f"{row.about}: {name}", getattr(term, name), row.size)
            for k, (row, term) in enumerate(zip(rows, terms, strict=True))
            for name in ("weight", "weight_final")
            if getattr(term, name, None) is not None
        }
        tensors = {key: weight for key, weight in given.items() if isinstance(weight, Tensor)}
        plain = {key: weight for key, weight in given.items() if key not in tensors}
        self._register("weights", torch.from_numpy(np.concatenate([[], *(v.reshape(-1) for v in plain.values())])))
        for (name, k), weight in tensors.items():
            self._register(f"{name}_{k}", weight)
        self._weights = ["weights", *(f"{name}_{k}" for name, k in tensors)]
        found, start = {}, 0  # where each is among the numbers of all
        for key, weight in (plain | tensors).items():
            end = start + int(np.prod(weight.shape))
            found[key], start = np.broadcast_to(np.arange(start, end), (rows[key[1]].size,)), end
        squares = [k for k in order if rows[k].kind != _EFFORT]
        stages = [found["weight", k] for k in squares]
        final = [found.get(("weight_final", k), stage) for k, stage in zip(squares, stages, strict=True)]
        self._of_rows = np.stack([np.concatenate([[], *part]) for part in (stages, final)]).astype(np.intp)
        efforts = [found["weight", k] for k in order if k not in squares]
        self._of_actions = np.reshape(efforts, (-1, self.n_u)).astype(np.intp)

    def _keep_goals(self, rows: Sequence[_Row], order: Sequence[int]) -> None:
        """Keep goals in the order of the rows, and which of them are those of a call, in the order of the terms."""
        self._reach = np.array([[row.reach] for row in rows if row.kind == _TURN])
        self._goals = np.concatenate([[], *(_goal(rows[k]) for k in order)])
        starts = np.cumsum([0, *(rows[k].n_goal for k in order)])
        asked = [starts[order.index(k)] + np.arange(row.n_goal) for k, row in enumerate(rows) if row.goal is None]
        asked = np.concatenate([[], *asked]).astype(np.intp)
        self.n_goal = len(asked)
        self._asked = np.isin(np.arange(len(self._goals)), asked)
        self._of_call = np.zeros(len(self._goals), np.intp)
        self._of_call[asked] = np.arange(self.n_goal)

    @property
    def constant(self) -> bool:
        """Whether the cost is the same at all states."""
        return not (self.n_goal or self._scene.frames)

    def at(self, x: Tensor, goal: Tensor | None = None, context: Tensor | None = None) -> QuadraticCost:
        """The cost of plans from states x (..., n_x) to goals (..., n_goal); no context changes it.

        Raises:
            InvalidInputError and its kinds: states or goals of another size.
        """
        given = [*self._held(self._weights).values(), *self._check_goal(goal)]
        given = [value.to("cpu", torch.float64) for value in given]
        learns = torch.is_grad_enabled() and any(value.requires_grad for value in given)
        of: Any = torch if learns else np  # the formulas below are those of both; NumPy takes a third of the time
        numbers = given if learns else [value.detach().numpy() for value in given]
        flat = of.concatenate([weight.reshape(-1) for weight in numbers[: len(self._weights)]])
        A, offset, turns = map(of.asarray, self._scene.read(x))
        left = offset - self._wanted(of, numbers[len(self._weights) :], turns)
        weight = flat[self._of_rows]
        weighted = 2 * weight[..., None] * A[..., None, :, :]  # (..., 2, rows, n_x), of stages and the final state
        Q = A[..., None, :, :].swapaxes(-1, -2) @ weighted
        q = (left[..., None, None, :] @ weighted)[..., 0, :]
        constant = (weight * left[..., None, :] ** 2).sum(-1)
        Q = Q + (_ROUNDING * abs(Q).max()) * of.eye(self.n_x)
        fields = {"Q": Q[..., 0, :, :], "R": 2 * of.diag(flat[self._of_actions].sum(0)), "Q_final": Q[..., 1, :, :]}
        fields |= {"q": q[..., 0, :], "r": of.zeros(self.n_u), "q_final": q[..., 1, :]}
        fields |= {"constant": constant[..., 1], "constant_stage": constant[..., 0]}
        same = x.dtype is torch.float64 and x.is_cpu
        tensors = {name: torch.as_tensor(value) for name, value in fields.items()}
        return QuadraticCost.of_checked(tensors if same else {k: v.to(x.device, x.dtype) for k, v in tensors.items()})

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

    def _wanted(self, of: Any, goal: list[Any], turns: Any) -> Any:
        """What all rows (..., rows) are to be, where things have the orientations `turns` (..., n, 4)."""
        goals = of.asarray(self._goals)
        if goal:
            goals = of.where(of.asarray(self._asked), goal[0][..., self._of_call], goals)
        n = len(self._reach)
        if not n:
            return goals
        first, last = 3 * self._scene.n_points, 3 * self._scene.n_points + 4 * n
        wanted = goals[..., first:last].reshape(*goals.shape[:-1], n, 4)
        left = _rotation_between(of, turns, wanted, of.asarray(self._reach))
        parts = [goals[..., :first], left.reshape(*left.shape[:-2], 3 * n), goals[..., last:]]
        return of.concatenate([of.broadcast_to(part, (*left.shape[:-2], part.shape[-1])) for part in parts], -1)


def _rotation_between(of: Any, here: Any, goal: Any, reach: Any) -> Any:
    """Compute log(here⁻¹ goal) (..., n, 3) of quaternions (..., n, 4), with angles cut at `reach` (n, 1)."""
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
    return turn * of.where(tiny, 2.0, of.minimum(2 * of.arctan2(sine, sign * cosine), reach) / sine)


def _weight(name: str, value: Weight, size: int) -> Any:
    """A weight: a tensor as it is, anything else as an array."""
    weight: Any = value if isinstance(value, Tensor) else np.array(value, dtype=np.float64)
    check_tensor(name, torch.as_tensor(weight))
    if weight.shape not in ((), (size,)):
        raise ShapeError(f"{name}: expected one number or {size} of them, got {describe(weight)}; see the term")
    if bool((weight < 0).any()):
        raise InvalidInputError(f"{name}: expected at least 0, got {float(weight.min()):g}; change its sign")
    return weight


def _goal(row: _Row) -> Any:
    """The goal of a term's own, zeros where it has none."""
    if row.goal is None:
        return np.zeros(row.n_goal)
    goal = np.array(row.goal, dtype=np.float64)
    if goal.shape != (row.n_goal,):
        raise ShapeError(f"{row.about}: expected a goal of shape ({row.n_goal},), got {goal.shape}; see the term")
    if not np.isfinite(goal).all():
        raise NonFiniteError(f"{row.about}: expected a finite goal, got {goal.tolist()}; find where it comes from")
    return goal


# --- where things are -----------------------------------------------------------------------------------------------

_POINT, _TURN, _COORDINATE, _EFFORT = range(4)
_FRAMES = {
    "body": (mujoco.mjtObj.mjOBJ_BODY, "xpos", "xmat", mujoco.mj_jacBody),
    "site": (mujoco.mjtObj.mjOBJ_SITE, "site_xpos", "site_xmat", mujoco.mj_jacSite),
    "geom": (mujoco.mjtObj.mjOBJ_GEOM, "geom_xpos", "geom_xmat", mujoco.mj_jacGeom),
}


class _Row(NamedTuple):
    """Rows of a term: `size` squares of one kind, with a goal of `n_goal` numbers, None for that of a call."""

    about: str
    kind: int
    size: int
    n_goal: int = 0
    goal: ArrayLike | None = ()
    reach: float = torch.inf


class _Scene:
    """Frames of bodies, sites and geoms, and coordinates, that terms have named; read at states, with Jacobians.

    Rows of points come first, then those of orientations, then those of coordinates.
    """

    def __init__(self, module: MujocoLCS):
        self._module, self._model = module, module._model
        self._data = mujoco.MjData(self._model)
        self.frames: list[tuple[str, int]] = []
        self._points: list[tuple[int, int | None]] = []
        self._turns: list[int] = []
        self._columns: list[int] = []

    @property
    def n_points(self) -> int:
        """Number of points."""
        return len(self._points)

    def bind(self, about: str, term: Term) -> _Row:
        """Find what a term is about."""
        if isinstance(term, Effort):
            return _Row(about, _EFFORT, self._module.n_u)
        if isinstance(term, Position):
            self._points.append((self._frame(about, term.of), None))
            return _Row(about, _POINT, 3, 3, term.goal)
        if isinstance(term, Distance):
            self._points.append((self._frame(about, term.first), self._frame(about, term.second)))
            return _Row(about, _POINT, 3, 3, np.zeros(3))
        if isinstance(term, Orientation):
            self._turns.append(self._frame(about, term.of))
            reach = torch.inf if term.reach is None else check_number(f"{about}: reach", term.reach, strict=True)
            return _Row(about, _TURN, 3, 4, term.goal, reach)
        if not isinstance(term, Posture | Velocity):
            raise DTypeError(
                f"terms: expected Position, Orientation, … or Effort, got {describe(term)}; see MujocoCost"
            )
        moving = isinstance(term, Velocity)
        columns = self._dofs(about, term.joints, turning=moving)
        if moving and not self._module.state.velocities:
            raise InvalidInputError(
                f'{about}: expected a module whose state has velocities (motion="dynamic"), got one of positions; '
                f"leave it out"
            )
        self._columns += [column + self._module.state.nv * moving for column in columns]
        size = len(columns)
        return _Row(about, _COORDINATE, size, size, np.zeros(size) if moving else term.goal)  # pyright: ignore

    def _frame(self, about: str, name: str) -> int:
        """Find the number of a body, site or geom."""
        kind, colon, rest = str(name).partition(":")
        kinds = {kind: rest} if colon and kind in _FRAMES else dict.fromkeys(_FRAMES, str(name))
        for kind, called in kinds.items():
            index = mujoco.mj_name2id(self._model, int(_FRAMES[kind][0]), called)
            if index >= 0:
                if (kind, index) not in self.frames:
                    self.frames.append((kind, index))
                return self.frames.index((kind, index))
        names = (mujoco.mj_id2name(self._model, int(_FRAMES[k][0]), i) for k in kinds for i in self._numbers(k))
        known = [name for name in dict.fromkeys(names) if name]
        raise InvalidInputError(
            f"{about}: expected a {' or '.join(kinds)}, one of {', '.join(known)}, got {describe(name)}"
            f"{did_you_mean(name, known)}; name one of them"
        )

    def _numbers(self, kind: str) -> range:
        return range(getattr(self._model, f"n{kind}"))

    def _dofs(self, about: str, names: Sequence[str] | None, turning: bool) -> list[int]:
        """Find the degrees of freedom of joints; `turning`: also of free joints and balls."""
        model = self._model
        ends = [*map(int, model.jnt_dofadr), int(model.nv)]
        known = {
            model.joint(j).name or f"joint{j}": range(ends[j], ends[j + 1])
            for j in range(model.njnt)
            if turning or ends[j + 1] - ends[j] == 1
        }
        names = list(known) if names is None else [names] if isinstance(names, str) else names
        for name in names:
            if name not in known:
                kinds = "joints" if turning else "slides and hinges"
                raise InvalidInputError(
                    f"{about}: expected {kinds}, among {', '.join(known)}, got {describe(name)}"
                    f"{did_you_mean(name, known)}; name one of them"
                )
        return [dof for name in names for dof in known[name]]

    def read(self, x: Tensor) -> tuple[Any, Any, Any]:
        """Read all rows at states x (..., n_x).

        Returns:
            A (..., rows, n_x) and b (..., rows), so that A x + b is what the terms measure, of rotations the change;
            and orientations (..., turns, 4).
        """
        state, model, data, source = self._module.state, self._model, self._data, self._module._data
        qpos = state.to_mujoco(x)[0].reshape(-1, state.nq)
        flat, nv, n, count = x.detach().double().cpu().numpy(), state.nv, len(qpos), len(self.frames)
        batch, flat = flat.shape[:-1], flat.reshape(n, -1)
        place, turn, moves = np.empty((n, count, 3)), np.empty((n, count, 9)), np.empty((n, count, 2, 3, nv))
        turned = np.empty((n, len(self._turns), 4))
        data.mocap_pos[:], data.mocap_quat[:] = source.mocap_pos, source.mocap_quat
        for i in range(n if count else 0):
            data.qpos[:] = qpos[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            for k, (kind, index) in enumerate(self.frames):
                _, places, turns, differentiate = _FRAMES[kind]
                place[i, k], turn[i, k] = getattr(data, places)[index], getattr(data, turns)[index]
                differentiate(model, data, moves[i, k, 0], moves[i, k, 1], index)
            for j, k in enumerate(self._turns):
                mujoco.mju_mat2Quat(turned[i, j], turn[i, k])
        points, rotations = 3 * self.n_points, 3 * len(self._turns)
        value = np.zeros((n, points + rotations + len(self._columns)))
        A = np.zeros((*value.shape, flat.shape[-1]))
        for j, (first, second) in enumerate(self._points):
            rows = slice(3 * j, 3 * j + 3)
            value[:, rows], A[:, rows, :nv] = place[:, first], moves[:, first, 0]
            if second is not None:
                value[:, rows] -= place[:, second]
                A[:, rows, :nv] -= moves[:, second, 0]
        own = turn.reshape(n, count, 3, 3)[:, self._turns].swapaxes(-1, -2) @ moves[:, self._turns, 1]
        A[:, points : points + rotations, :nv] = own.reshape(n, rotations, nv)
        if count and (tangent := state.tangent(flat[:, :nv])) is not None:
            A[:, :, :nv] = A[:, :, :nv] @ tangent
        offset = value - (A @ flat[..., None])[..., 0]
        A[:, range(points + rotations, value.shape[1]), self._columns] = 1.0
        return A.reshape(*batch, *A.shape[1:]), offset.reshape(*batch, -1), turned.reshape(*batch, *turned.shape[1:])
