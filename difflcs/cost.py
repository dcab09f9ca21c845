"""Quadratic costs of the MPC: plain, by stage, or mapped from a goal or a reference to follow."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Protocol, Self, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from difflcs import _checks
from difflcs._differentiation import is_wrapped, runs_eagerly
from difflcs._fields import TensorFields, check_by_stage, check_stages, register
from difflcs._linalg import matvec, quadratic
from difflcs._modules import fresh
from difflcs.errors import DTypeError, InvalidInputError, ShapeError

# Number of dimensions of each field, after those of the batch and of the stages.
_DIMENSIONS = {"Q": 2, "R": 2, "Q_final": 2, "q": 1, "r": 1, "q_final": 1, "constant": 0, "S": 2, "constant_stage": 0}
_STAGES = ("Q", "R", "q", "r", "S")


class _Weighted(TensorFields):
    """Base of costs, whose weights are positive semi-definite together."""

    _curved = ("Q", "R", "Q_final")
    _checked: list[int | None] | None = None  # numbers of the last check; None where weights are never checked

    def check_again(self) -> None:
        """Refuse weights that were changed in place since they were checked, and have a negative eigenvalue now."""
        if self._checked is None:
            return
        weights = {k: _checks.check_tensor(k, v) for k, v in self._held(self._curved).items() if v is not None}
        now = [_checks.numbers_of(value) for value in weights.values()]
        if now == self._checked and None not in now:
            return
        for name in ("Q_final",) if "S" in weights else weights:
            check_convex(name, weights[name])
        if "S" in weights:
            check_convex_stages(weights, self.by_stage)
        self._checked = now


class _Quadratic(_Weighted):
    """Base of costs that are quadratic in states and actions."""

    _curved = ("Q", "R", "Q_final", "S")
    Q: Tensor
    R: Tensor
    Q_final: Tensor
    q: Tensor
    r: Tensor
    q_final: Tensor
    constant: Tensor
    S: Tensor | None
    constant_stage: Tensor | None

    @runs_eagerly
    def _fill(self, Q: Tensor, R: Tensor, Q_final: Tensor, check: bool, **others: Tensor | None) -> None:
        for name, value in (("Q", Q), ("R", R), ("Q_final", Q_final)):
            _checks.check_tensor(name, value)
            if value.ndim < 2 or value.shape[-1] != value.shape[-2]:
                raise ShapeError(
                    f"{name}: expected a square matrix (..., n, n), got {_checks.describe(value)}; pass one"
                )
        self.n_x, self.n_u = Q.shape[-1], R.shape[-1]
        fields = {
            "Q": Q,
            "R": R,
            "Q_final": Q_final,
            "q": Q.new_zeros(self.n_x),
            "r": R.new_zeros(self.n_u),
            "q_final": Q.new_zeros(self.n_x),
            "constant": Q.new_zeros(()),
            **{name: value for name, value in others.items() if value is not None},
        }
        x, u = ("n_x", self.n_x), ("n_u", self.n_u)
        dims = {"Q_final": [x, x], "q": [x], "r": [u], "q_final": [x], "constant": [], "S": [x, u]}
        dims["constant_stage"] = []
        for name, dim in dims.items():
            if name in fields:
                _checks.check_tensor(name, fields[name], dim)
        _checks.check_same_device(fields.items())
        if self.by_stage:
            check_stages({k: (fields[k], _DIMENSIONS[k], 0) for k in _STAGES if k in self.by_stage})
        for name in _DIMENSIONS:
            register(self, name, fields.get(name))
        self._checked = [] if check else None
        self.check_again()

    def tensors(self) -> dict[str, Tensor]:
        """Return name → tensor as it was passed, with the constants; S if there is one."""
        fields = self._held(_DIMENSIONS)
        return {name: value for name, value in fields.items() if value is not None}

    def fields(self) -> dict[str, Tensor]:
        """Return name → tensor, with symmetric Q, R and Q_final, without the constant; S if there is one."""
        fields = self.tensors()
        fields = {name: value for name, value in fields.items() if not name.startswith("constant")}
        return {k: 0.5 * (v + v.mT) if k in ("Q", "R", "Q_final") else v for k, v in fields.items()}


class QuadraticCost(_Quadratic):
    """Convex quadratic cost: stage ½xᵀQx + qᵀx + ½uᵀRu + rᵀu + xᵀSu, final ½xᵀQ_final x + q_finalᵀx.

    Every field is shared by the batch or has leading batch dimensions; it is learned if it requires grad (an
    nn.Parameter is registered as one). Only the symmetric parts of Q, R and Q_final matter.

    Args:
        Q: (..., n_x, n_x) ⪰ 0.
        R: (..., n_u, n_u) ⪰ 0; ≻ 0 makes every action unique.
        Q_final: (..., n_x, n_x) ⪰ 0.
        q: (..., n_x), zero if None.
        r: (..., n_u), zero if None.
        q_final: (..., n_x), zero if None.
        constant: (...) added to the objective, zero if None; it changes no action.
        S: (..., n_x, n_u), zero if None; [[Q, S], [Sᵀ, R]] ⪰ 0.
        constant_stage: (...) added to the objective once for each stage, zero if None.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: a field does not fit the others.
        InvalidInputError: Q_final, or Q and R with S, has a negative eigenvalue.
    """

    @_checks.takes_arrays
    def __init__(
        self,
        Q: Tensor,
        R: Tensor,
        Q_final: Tensor,
        q: Tensor | None = None,
        r: Tensor | None = None,
        q_final: Tensor | None = None,
        constant: Tensor | None = None,
        S: Tensor | None = None,
        *,
        constant_stage: Tensor | None = None,
        check: bool = True,
    ):
        super().__init__()
        self._fill(
            Q, R, Q_final, check, q=q, r=r, q_final=q_final, constant=constant, S=S, constant_stage=constant_stage
        )

    @classmethod
    def of_checked(cls, fields: Mapping[str, Tensor]) -> Self:
        """Make a cost of fields that fit each other, all but S; nothing is checked here."""
        cost = cls.__new__(cls)
        nn.Module.__init__(cost)
        cost._buffers.update({name: fields.get(name) for name in _DIMENSIONS})
        cost.n_x, cost.n_u = fields["Q"].shape[-1], fields["R"].shape[-1]
        return cost


class CostSequence(_Quadratic):
    """One convex quadratic cost per stage: the terms of `QuadraticCost`, with weights that change over the horizon.

    Every field has a dimension H of stages before its rows and columns, and before that any batch dimensions, or
    none to be shared by the batch. Q_final, q_final and the constant have no stages.

    Args:
        Q: (..., H, n_x, n_x) ⪰ 0.
        R: (..., H, n_u, n_u) ⪰ 0; ≻ 0 makes every action unique.
        Q_final: (..., n_x, n_x) ⪰ 0.
        q: (..., H, n_x), zero if None.
        r: (..., H, n_u), zero if None.
        q_final: (..., n_x), zero if None.
        constant: (...) added to the objective, zero if None; it changes no action.
        S: (..., H, n_x, n_u), zero if None; [[Q, S], [Sᵀ, R]] ⪰ 0 at each stage.
        by_stage: names of the fields that change; the others are as in a `QuadraticCost`. A constant Q is solved
            faster than H copies of it: `CostSequence(Q, R, Q_final, q=..., by_stage=("q",))`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: a field does not fit the others.
        InvalidInputError: Q_final, or Q and R with S, has a negative eigenvalue; no field is by stage.
    """

    @_checks.takes_arrays
    def __init__(
        self,
        Q: Tensor,
        R: Tensor,
        Q_final: Tensor,
        q: Tensor | None = None,
        r: Tensor | None = None,
        q_final: Tensor | None = None,
        constant: Tensor | None = None,
        S: Tensor | None = None,
        *,
        by_stage: Collection[str] = _STAGES,
        check: bool = True,
    ):
        super().__init__()
        names = [name for name, value in (("Q", Q), ("R", R), ("q", q), ("r", r), ("S", S)) if value is not None]
        self.by_stage = check_by_stage(by_stage, _STAGES, names)
        self._fill(Q, R, Q_final, check, q=q, r=r, q_final=q_final, constant=constant, S=S)

    @property
    def horizon(self) -> int:
        """H, the number of stages."""
        name = min(self.by_stage)
        return getattr(self, name).shape[-1 - _DIMENSIONS[name]]


@runtime_checkable
class CostModule(Protocol):
    """Interface of modules that return the cost near some states: the counterpart of `LCSModule`.

    A layer calls it at each call, a controller at each step. If it is a `torch.nn.Module`, its parameters belong to the
    layer. `isinstance(value, CostModule)` checks for the method alone. A module whose cost is the same at all states
    may have an attribute `constant = True`; then it can be exported. One whose cost approximates a function of the
    state near the states passed has `local = True`; then `LCSMPCLayer(passes=2)` asks it at each state of a plan.
    """

    def at(self, x: Tensor, goal: Tensor | None = None, context: Tensor | None = None) -> QuadraticCost | CostSequence:
        """Return the cost near some states.

        Args:
            x: (..., n_x) initial states of the plans.
            goal: (..., n_goal) of the call, if it has one.
            context: (..., n_context) of the call, which the system also gets.

        Returns:
            The cost of plans from there, shared, or with leading batch dimensions that broadcast with those of x;
            differentiable in the module's parameters.
        """
        ...


@runs_eagerly
def cost_at(
    cost: CostModule, x: Tensor, goal: Tensor | None = None, context: Tensor | None = None
) -> QuadraticCost | CostSequence:
    """Call `cost.at(x, goal, context)` after the hooks of `torch.nn.utils` in the module.

    Raises:
        DTypeError: it returns anything but a cost.
    """
    value = fresh(cost).at(x, goal, context)
    remedy = f"return one of them from {type(cost).__name__}.at"
    return _checks.check_kind("cost", value, (QuadraticCost, CostSequence), remedy)


def check_convex(name: str, matrix: Tensor) -> None:
    """Refuse weights (..., n, n) whose symmetric part has a negative eigenvalue, where their numbers can be read."""
    if is_wrapped(matrix) or not matrix.numel():
        return
    symmetric = 0.5 * (matrix + matrix.mT).detach().double().cpu()
    # Most weights pass a factorisation, a tenth of the cost of their eigenvalues.
    shift = 0.5e-9 * symmetric.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True)
    factored = torch.linalg.cholesky_ex(symmetric + torch.diag_embed(shift.expand(symmetric.shape[:-1])))
    if not bool(factored.info.any()):
        return
    eigenvalues = torch.linalg.eigvalsh(symmetric)
    if bool((eigenvalues[..., 0] < -1e-9 * eigenvalues.abs().amax(-1)).any()):
        raise InvalidInputError(
            f"{name}: expected a positive semi-definite matrix, got smallest eigenvalue "
            f"{float(eigenvalues[..., 0].min()):.3e}; a negative weight makes the cost unbounded: learn w.exp() or L Lᵀ"
        )


def check_convex_stages(fields: Mapping[str, Tensor], by_stage: Collection[str]) -> None:
    """Refuse Q, R and S that together have a negative eigenvalue at a stage."""
    blocks = []
    for name in "QSR":
        value = fields[name].detach()
        blocks.append(value if not by_stage or name in by_stage else value.unsqueeze(-3))
    batch = _checks.broadcast_batch((name, block.shape[:-2]) for name, block in zip("QSR", blocks, strict=True))
    Q, S, R = (block.expand(*batch, *block.shape[-2:]) for block in blocks)
    whole = torch.cat([torch.cat([Q, S], -1), torch.cat([S.mT, R], -1)], -2)
    check_convex("[[Q, S], [Sᵀ, R]]", whole)


class GoalCost(_Weighted):
    """Maps a goal to a `QuadraticCost` whose linear terms are linear in the goal.

    cost(goal) has q = goal_to_q · goal, q_final = goal_to_q_final · goal and the constant ½ goalᵀ K goal, so that costs
    of tracking errors (w‖x_goal − goal‖²) come out with their true value. `follow` maps a goal per stage.

    Args:
        Q: (n_x, n_x) stage weight.
        R: (n_u, n_u) action weight.
        Q_final: (n_x, n_x) final weight.
        goal_to_q: (n_x, n_goal).
        goal_to_q_final: (n_x, n_goal).
        goal_stage: (n_goal, n_goal) constant of one stage, ½ goalᵀ goal_stage goal; zero if None.
        goal_final: (n_goal, n_goal) constant of the final cost; zero if None.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: a field does not fit the others, or has another dtype.
        InvalidInputError: Q, R or Q_final has a negative eigenvalue.
    """

    Q: Tensor
    R: Tensor
    Q_final: Tensor
    goal_to_q: Tensor
    goal_to_q_final: Tensor
    goal_stage: Tensor
    goal_final: Tensor

    @runs_eagerly
    @_checks.takes_arrays
    def __init__(
        self,
        Q: Tensor,
        R: Tensor,
        Q_final: Tensor,
        goal_to_q: Tensor,
        goal_to_q_final: Tensor,
        goal_stage: Tensor | None = None,
        goal_final: Tensor | None = None,
    ):
        super().__init__()
        QuadraticCost(Q.detach(), R.detach(), Q_final.detach())
        self.n_x, self.n_u = Q.shape[-1], R.shape[-1]
        _checks.check_shape("goal_to_q", goal_to_q, "n_x n_goal", {"n_x": self.n_x})
        self.n_goal = goal_to_q.shape[-1]
        square = goal_to_q.new_zeros(self.n_goal, self.n_goal)
        fields = {
            "Q": Q,
            "R": R,
            "Q_final": Q_final,
            "goal_to_q": goal_to_q,
            "goal_to_q_final": goal_to_q_final,
            "goal_stage": square if goal_stage is None else goal_stage,
            "goal_final": square.clone() if goal_final is None else goal_final,
        }
        x, goal = ("n_x", self.n_x), ("n_goal", self.n_goal)
        for name, rows in (("goal_to_q_final", x), ("goal_stage", goal), ("goal_final", goal)):
            _checks.check_tensor(name, fields[name], [rows, goal])
        _checks.check_same_device(fields.items())
        _checks.check_same_dtype(fields)
        for name, value in fields.items():
            register(self, name, value)
        self._checked = []  # and so again in the first plan

    @_checks.takes_arrays
    def forward(self, goal: Tensor, horizon: int = 1) -> QuadraticCost:
        """Compute the cost of one goal per batch element.

        Args:
            goal: (..., n_goal).
            horizon: number of stages, used by the constant only.

        Returns:
            A `QuadraticCost` with q, q_final (..., n_x) and constant (...), differentiable in the goal and the weights.
        """
        return QuadraticCost(**self.at(goal, horizon), check=False)

    @_checks.takes_arrays
    def follow(self, reference: Tensor) -> CostSequence:
        """Compute the cost of goals that move: stage k tracks goal k, the final state the last one.

        Args:
            reference: (..., H+1, n_goal) one goal for each state of the plan, the first for x0.

        Returns:
            A `CostSequence` of which q (..., H, n_x) alone varies by stage, differentiable in the reference and the
            weights.
        """
        return CostSequence(**self.along(reference), by_stage=("q",), check=False)

    def at(self, goal: Tensor, horizon: int) -> dict[str, Tensor]:
        """Compute the fields of the cost of one goal."""
        goal = self._goal("goal", goal, [])
        to_q, to_q_final, stage, final = self.maps().values()
        return {
            **self.weights(),
            "q": matvec(to_q, goal),
            "q_final": matvec(to_q_final, goal),
            "constant": 0.5 * quadratic(horizon * stage + final, goal),
        }

    def along(self, reference: Tensor, horizon: int | None = None) -> dict[str, Tensor]:
        """Compute the fields of the cost of a reference; q has the stages, H of them if the horizon is passed."""
        stages = [] if horizon is None else [("H+1", horizon + 1)]
        reference = self._goal("reference", reference, stages)
        if reference.ndim < 2 or reference.shape[-2] < 2:
            raise ShapeError(
                f"reference: expected shape (..., H+1, n_goal={self.n_goal}) with H ≥ 1, got {tuple(reference.shape)}; "
                f"give one goal for each state of the plan"
            )
        to_q, to_q_final, stage, final = self.maps().values()
        early, last = reference[..., :-1, :], reference[..., -1, :]
        return {
            **self.weights(),
            "q": matvec(to_q, early),
            "q_final": matvec(to_q_final, last),
            "constant": 0.5 * (quadratic(stage, early).sum(-1) + quadratic(final, last)),
        }

    def weights(self) -> dict[str, Tensor]:
        """Return the fields of the cost that no goal changes."""
        held = self._held(("Q", "R", "Q_final"))
        return {**held, "r": held["R"].new_zeros(self.n_u)}

    def maps(self) -> dict[str, Tensor]:
        """Return the maps from a goal to the other fields of the cost."""
        return self._held(("goal_to_q", "goal_to_q_final", "goal_stage", "goal_final"))

    def _goal(self, name: str, value: Tensor, stages: list[tuple[str, int]]) -> Tensor:
        _checks.check_tensor(name, value, [*stages, ("n_goal", self.n_goal)])
        if value.device != self.Q.device:
            _checks.check_same_device([("cost", self.Q), (name, value)])
        return value.to(self.Q.dtype)

    def stage(self, x: Tensor, u: Tensor, goal: Tensor) -> Tensor:
        """Compute the cost of one stage, with its constant: x (..., n_x), u (..., n_u), goal (..., n_goal) → (...)."""
        cost = self(goal, horizon=1)
        squares = quadratic(cost.Q, x) + quadratic(cost.R, u) + quadratic(self.maps()["goal_stage"], goal)
        return 0.5 * squares + (cost.q * x).sum(-1)

    @classmethod
    def reach(
        cls,
        n_x: int,
        n_u: int,
        goal_weight: float | Sequence[float] = 1.0,
        goal_weight_final: float | Sequence[float] | None = None,
        input_weight: float = 1.0,
        pairs: Iterable[tuple[int, int]] = (),
        pair_weight: float = 0.0,
        pair_weight_final: float | None = None,
        *,
        dtype: torch.dtype = torch.float64,
    ) -> GoalCost:
        """Bring the first states to a goal: Σ wⱼ (xⱼ − goalⱼ)² + pair_weight·Σ (xᵢ − xⱼ)² + input_weight·‖u‖².

        Weights multiply squares without a factor ½, as in Eq. 13 of the paper. Pairs pull states together,
        for example fingertips to the object.

        Args:
            n_x: number of states.
            n_u: number of actions.
            goal_weight: weight per goal component (n_goal of them), or one number for all states (n_goal = n_x).
            goal_weight_final: the same for the final state; goal_weight if None.
            input_weight: weight of the actions, > 0.
            pairs: index pairs (i, j) of states.
            pair_weight: weight of the pairs.
            pair_weight_final: the same for the final state; pair_weight if None.
            dtype: float64 or float32.

        Returns:
            A `GoalCost` with n_goal = len(goal_weight).
        """
        n_x, n_u = _checks.check_positive_int("n_x", n_x), _checks.check_positive_int("n_u", n_u)
        input_weight = _checks.check_number("input_weight", input_weight, strict=True)
        if dtype not in (torch.float32, torch.float64):
            raise DTypeError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")
        final_pair = pair_weight if pair_weight_final is None else pair_weight_final
        weights = _weights("goal_weight", goal_weight, n_x)
        finals = weights if goal_weight_final is None else _weights("goal_weight_final", goal_weight_final, n_x)
        if len(finals) != len(weights):
            raise ShapeError(
                f"goal_weight_final: expected {len(weights)} weights like goal_weight, got {len(finals)}; "
                f"use 0 where a component does not count"
            )
        pairs = list(pairs) if isinstance(pairs, Iterable) else [pairs]
        numbers = _checks.check_array("pairs", pairs)
        apart = not pairs or (numbers.shape[1:] == (2,) and bool((numbers[:, 0] != numbers[:, 1]).all()))
        if not (apart and np.isin(numbers, np.arange(n_x)).all()):
            raise InvalidInputError(
                f"pairs: expected pairs of two different indices in 0…{n_x - 1}, got {_checks.describe(pairs)}; "
                f"correct them"
            )
        stage, to_q, constant = _tracking(n_x, weights, pairs, _checks.check_number("pair_weight", pair_weight), dtype)
        final, to_q_final, constant_final = _tracking(
            n_x, finals, pairs, _checks.check_number("pair_weight_final", final_pair), dtype
        )
        R = 2 * input_weight * torch.eye(n_u, dtype=dtype)
        return cls(stage, R, final, to_q, to_q_final, constant, constant_final)


def _weights(name: str, value: float | Sequence[float], n_x: int) -> list[float]:
    try:
        weights = list(value)  # pyright: ignore[reportArgumentType]
    except TypeError:  # a number, or an array or tensor without dimensions
        weights = [value] * n_x
    if not 1 <= len(weights) <= n_x:
        raise ShapeError(f"{name}: expected 1 to n_x={n_x} weights, got {len(weights)}")
    return [_checks.check_number(name, weight) for weight in weights]


def _tracking(
    n_x: int, weights: list[float], pairs: Sequence[tuple[int, int]], pair_weight: float, dtype: torch.dtype
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute Q, G and K of the tracking terms ½xᵀQx + (G goal)ᵀx + ½goalᵀK goal."""
    n_goal = len(weights)
    diagonal = 2 * torch.diag(torch.tensor(weights, dtype=dtype))
    Q = torch.zeros(n_x, n_x, dtype=dtype)
    Q[:n_goal, :n_goal] = diagonal
    to_q = torch.zeros(n_x, n_goal, dtype=dtype)
    to_q[:n_goal] = -diagonal
    for i, j in ((int(i), int(j)) for i, j in pairs):
        difference = torch.zeros(n_x, dtype=dtype)
        difference[i], difference[j] = 1.0, -1.0
        Q += 2 * pair_weight * torch.outer(difference, difference)
    return Q, to_q, diagonal
