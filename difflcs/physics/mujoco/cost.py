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
        self._scene = scene = _Scene(module)
        rows = [scene.bind(f"terms[{k}] {type(term).__name__}", term) for k, term in enumerate(terms)]
        order = sorted(range(len(rows)), key=lambda k: rows[k].kind)
        goals, asked, start = [], {}, 0
        for k in order:
            row, term = rows[k], terms[k]
            for name in ("weight", "weight_final"):
                if (weight := getattr(term, name, None)) is not None:
                    self._register(f"{name}_{k}", _weight(f"{row.about}: {name}", weight, row.size))
            if row.goal is None:
                asked[k] = range(start, start + row.n_goal)
            goals.append(np.zeros(row.n_goal) if row.goal is None else _goal(row))
            start += row.n_goal
        self._parts = [(k, rows[k].size) for k in order if rows[k].kind != _EFFORT]
        self._efforts = [k for k in order if rows[k].kind == _EFFORT]
        self._reach = torch.tensor([row.reach for row in rows if row.kind == _TURN], dtype=torch.float64)
        self._goals = torch.from_numpy(np.concatenate([np.zeros(0), *goals]))
        self._asked = torch.tensor([i for k in sorted(asked) for i in asked[k]], dtype=torch.long)
        self.n_goal = len(self._asked)

    @property
    def constant(self) -> bool:
        """Whether the cost is the same at all states."""
        return not (self.n_goal or self._scene.frames)

    def at(self, x: Tensor, goal: Tensor | None = None, context: Tensor | None = None) -> QuadraticCost:
        """The cost of plans from states x (..., n_x) to goals (..., n_goal); no context changes it.

        Raises:
            InvalidInputError and its kinds: states or goals of another size.
        """
        value, jacobian, turns = self._scene.read(x)
        batch, here = x.shape[:-1], x.detach().to("cpu", torch.float64)
        A = torch.from_numpy(jacobian).reshape(*batch, *jacobian.shape[1:])
        target = self._target(goal, torch.from_numpy(turns).reshape(*batch, *turns.shape[1:]))
        left = torch.from_numpy(value).reshape(*batch, -1) - (A @ here.unsqueeze(-1)).squeeze(-1) - target
        weight, effort = self._weights()
        weighted = 2 * weight.unsqueeze(-1) * A.unsqueeze(-3)  # (..., 2, rows, n_x) of stages and the final state
        Q = A.unsqueeze(-3).mT @ weighted
        largest = Q.detach().diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None]
        Q = Q + _ROUNDING * largest * torch.eye(self.n_x, dtype=torch.float64)
        q = (left[..., None, None, :] @ weighted).squeeze(-2)
        constant = (weight * left.unsqueeze(-2) ** 2).sum(-1)
        fields = {"Q": Q[..., 0, :, :], "R": 2 * torch.diag(effort), "Q_final": Q[..., 1, :, :]}
        fields |= {"q": q[..., 0, :], "q_final": q[..., 1, :]}
        fields |= {"constant": constant[..., 1], "constant_stage": constant[..., 0]}
        if x.dtype != torch.float64 or not x.is_cpu:
            fields = {name: tensor.to(x.device, x.dtype) for name, tensor in fields.items()}
        return QuadraticCost(**fields, check=False)

    def _target(self, goal: Tensor | None, turns: Tensor) -> Tensor:
        """What is wanted of all rows (..., rows), with orientations `turns` (..., n, 4)."""
        goals, asked = self._goals, self.n_goal
        if (goal is not None) != bool(asked):
            raise ShapeError(
                f"goal: expected (..., n_goal={asked}) for the terms without a goal of their own, got none; call "
                f"mpc(x0, goal)"
                if asked
                else f"goal: expected none, as all terms have one of their own, got {describe(goal)}; leave out the "
                f"goal of a term to give it with each call"
            )
        if goal is not None:
            goal = check_tensor("goal", goal, [("n_goal", asked)]).to("cpu", torch.float64)
            goals = goals.expand(*goal.shape[:-1], -1).index_copy(-1, self._asked, goal)
        if not len(self._reach):
            return goals
        points, n = 3 * self._scene.n_points, len(self._reach)
        wanted = goals[..., points : points + 4 * n].reshape(*goals.shape[:-1], n, 4)
        left = _rotation_between(turns, wanted, self._reach).flatten(-2)
        others = (goals[..., :points], goals[..., points + 4 * n :])
        others = [part.expand(*left.shape[:-1], -1) for part in others]
        return torch.cat([others[0], left, others[1]], -1)

    def _weights(self) -> tuple[Tensor, Tensor]:
        """Weights (2, rows) of the squares, at stages and at the final state, and those of the actions (n_u,)."""
        held = self._held([*self._buffers, *self._parameters])
        held = {name: weight.to("cpu", torch.float64) for name, weight in held.items()}
        effort = sum((held[f"weight_{k}"] for k in self._efforts), torch.zeros(self.n_u, dtype=torch.float64))
        stages = [held[f"weight_{k}"].expand(size) for k, size in self._parts]
        final = [held.get(f"weight_final_{k}", held[f"weight_{k}"]).expand(size) for k, size in self._parts]
        none = effort.new_zeros(0)
        return torch.stack([torch.cat([none, *stages]), torch.cat([none, *final])]), effort


def _rotation_between(here: Tensor, goal: Tensor, reach: Tensor) -> Tensor:
    """Compute log(here⁻¹ goal) (..., n, 3) of quaternions (..., n, 4), with angles cut at `reach` (n,)."""
    size = torch.linalg.vector_norm(goal, dim=-1, keepdim=True)
    none = size < 1e-15  # no rotation, as MuJoCo reads it
    goal = torch.where(none, goal.new_tensor([1.0, 0, 0, 0]), goal / torch.where(none, 1.0, size))
    w, v, goal_w, goal_v = here[..., :1], here[..., 1:], goal[..., :1], goal[..., 1:]
    cosine = w * goal_w + (v * goal_v).sum(-1, keepdim=True)
    turn = w * goal_v - goal_w * v - torch.linalg.cross(*torch.broadcast_tensors(v, goal_v))
    sign = torch.where(cosine < 0, -1.0, 1.0)
    sine = torch.linalg.vector_norm(turn, dim=-1, keepdim=True)
    angle, tiny = 2 * torch.atan2(sine, sign * cosine), sine < 1e-12
    cut = torch.minimum(angle, reach.unsqueeze(-1))
    return sign * turn * torch.where(tiny, 2.0, cut / torch.where(tiny, 1.0, sine))


def _weight(name: str, value: Weight, size: int) -> Tensor:
    weight = value if isinstance(value, Tensor) else torch.from_numpy(np.array(value, dtype=np.float64))
    check_tensor(name, weight)
    if weight.shape not in ((), (size,)):
        raise ShapeError(f"{name}: expected one number or {size} of them, got {describe(weight)}; see the term")
    if bool((weight.detach() < 0).any()):
        raise InvalidInputError(f"{name}: expected at least 0, got {float(weight.detach().min()):g}; change its sign")
    return weight


def _goal(row: _Row) -> Any:
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
            f"{did_you_mean(name, known)}"
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
                    f"{did_you_mean(name, known)}"
                )
        return [dof for name in names for dof in known[name]]

    def read(self, x: Tensor) -> tuple[Any, Any, Any]:
        """Read all rows at states x (..., n_x), of which there are n.

        Returns:
            Values (n, rows), zero for orientations; their derivatives (n, rows, n_x); orientations (n, turns, 4).
        """
        state, model, data, source = self._module.state, self._model, self._data, self._module._data
        qpos = state.to_mujoco(x)[0].reshape(-1, state.nq)
        flat, nv, n = x.detach().double().cpu().reshape(len(qpos), -1).numpy(), state.nv, len(qpos)
        count = len(self.frames)
        place, turn, moves = np.empty((n, count, 3)), np.empty((n, count, 9)), np.empty((n, count, 2, 3, nv))
        data.mocap_pos[:], data.mocap_quat[:] = source.mocap_pos, source.mocap_quat
        for i in range(n if count else 0):
            data.qpos[:] = qpos[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            for k, (kind, index) in enumerate(self.frames):
                _, places, turns, differentiate = _FRAMES[kind]
                place[i, k], turn[i, k] = getattr(data, places)[index], getattr(data, turns)[index]
                differentiate(model, data, moves[i, k, 0], moves[i, k, 1], index)
        points, rotations = 3 * self.n_points, 3 * len(self._turns)
        value = np.zeros((n, points + rotations + len(self._columns)))
        jacobian = np.zeros((*value.shape, flat.shape[-1]))
        for j, (first, second) in enumerate(self._points):
            rows = slice(3 * j, 3 * j + 3)
            value[:, rows], jacobian[:, rows, :nv] = place[:, first], moves[:, first, 0]
            if second is not None:
                value[:, rows] -= place[:, second]
                jacobian[:, rows, :nv] -= moves[:, second, 0]
        turned = turn.reshape(n, count, 3, 3)[:, self._turns]
        own = turned.swapaxes(-1, -2) @ moves[:, self._turns, 1]
        jacobian[:, points : points + rotations, :nv] = own.reshape(n, rotations, nv)
        if count and (tangent := state.tangent(flat[:, :nv])) is not None:
            jacobian[:, :, :nv] = jacobian[:, :, :nv] @ tangent
        value[:, points + rotations :] = flat[:, self._columns]
        jacobian[:, range(points + rotations, value.shape[1]), self._columns] = 1.0
        quaternions = np.empty((n, len(self._turns), 4))
        for i, j in np.ndindex(quaternions.shape[:2]):
            mujoco.mju_mat2Quat(quaternions[i, j], turned[i, j].ravel())
        return value, jacobian, quaternions
