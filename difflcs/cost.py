"""Quadratic costs of the MPC, plain or mapped from a goal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

from difflcs._checks import check_number, check_positive_int, check_same_device, check_tensor, describe
from difflcs.errors import DTypeError, InvalidInputError, ShapeError


class _TensorFields(nn.Module):
    """A module whose tensors are registered by kind: nn.Parameter as parameter, any other tensor as buffer."""

    def _register(self, name: str, value: Tensor) -> None:
        if isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        else:
            self.register_buffer(name, value)

    def extra_repr(self) -> str:
        names = [*dict(self.named_parameters(recurse=False)), *dict(self.named_buffers(recurse=False))]
        return ", ".join(f"{name}{tuple(getattr(self, name).shape)}" for name in names)


class QuadraticCost(_TensorFields):
    """Convex quadratic cost: stage ½xᵀQx + qᵀx + ½uᵀRu + rᵀu, final ½xᵀQ_final x + q_finalᵀx.

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

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: a field does not fit the others.
        InvalidInputError: Q, R or Q_final has a negative eigenvalue.
    """

    Q: Tensor
    R: Tensor
    Q_final: Tensor
    q: Tensor
    r: Tensor
    q_final: Tensor
    constant: Tensor

    def __init__(
        self,
        Q: Tensor,
        R: Tensor,
        Q_final: Tensor,
        q: Tensor | None = None,
        r: Tensor | None = None,
        q_final: Tensor | None = None,
        constant: Tensor | None = None,
        *,
        check: bool = True,
    ):
        super().__init__()
        for name, value in (("Q", Q), ("R", R), ("Q_final", Q_final)):
            check_tensor(name, value)
            if value.ndim < 2 or value.shape[-1] != value.shape[-2]:
                raise ShapeError(
                    f"{name}: expected a square matrix (..., n, n), got {describe(value)}; pass the weight matrix"
                )
        self.n_x, self.n_u = Q.shape[-1], R.shape[-1]
        fields = {
            "Q": Q,
            "R": R,
            "Q_final": Q_final,
            "q": Q.new_zeros(self.n_x) if q is None else q,
            "r": R.new_zeros(self.n_u) if r is None else r,
            "q_final": Q.new_zeros(self.n_x) if q_final is None else q_final,
            "constant": Q.new_zeros(()) if constant is None else constant,
        }
        x, u = ("n_x", self.n_x), ("n_u", self.n_u)
        dims = {"Q_final": [x, x], "q": [x], "r": [u], "q_final": [x], "constant": []}
        for name, dim in dims.items():
            check_tensor(name, fields[name], dim)
        check_same_device(fields.items())
        if check:
            for name in ("Q", "R", "Q_final"):
                _check_convex(name, fields[name])
        for name, value in fields.items():
            self._register(name, value)

    def fields(self) -> dict[str, Tensor]:
        """Name → tensor, with symmetric Q, R and Q_final, without the constant."""
        symmetric = {k: 0.5 * (v + v.mT) for k, v in (("Q", self.Q), ("R", self.R), ("Q_final", self.Q_final))}
        return {**symmetric, "q": self.q, "r": self.r, "q_final": self.q_final}


def _check_convex(name: str, matrix: Tensor) -> None:
    symmetric = 0.5 * (matrix + matrix.mT).detach().double().cpu()
    eigenvalues = torch.linalg.eigvalsh(symmetric)
    if eigenvalues.numel() and bool((eigenvalues[..., 0] < -1e-9 * eigenvalues.abs().amax(-1)).any()):
        raise InvalidInputError(
            f"{name}: expected a positive semi-definite matrix, got smallest eigenvalue "
            f"{float(eigenvalues[..., 0].min()):.3e}; a negative weight makes the cost unbounded"
        )


class GoalCost(_TensorFields):
    """Maps a goal to a `QuadraticCost` whose linear terms are linear in the goal.

    cost(goal) has q = goal_to_q · goal, q_final = goal_to_q_final · goal and the constant ½ goalᵀ K goal, so that costs
    of tracking errors (w‖x_goal − goal‖²) come out with their true value.

    Args:
        Q: (n_x, n_x) stage weight.
        R: (n_u, n_u) action weight.
        Q_final: (n_x, n_x) final weight.
        goal_to_q: (n_x, n_goal).
        goal_to_q_final: (n_x, n_goal).
        goal_stage: (n_goal, n_goal) constant of one stage, ½ goalᵀ goal_stage goal; zero if None.
        goal_final: (n_goal, n_goal) constant of the final cost; zero if None.
    """

    Q: Tensor
    R: Tensor
    Q_final: Tensor
    goal_to_q: Tensor
    goal_to_q_final: Tensor
    goal_stage: Tensor
    goal_final: Tensor

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
        check_tensor("goal_to_q", goal_to_q)
        if goal_to_q.ndim != 2:
            raise ShapeError(f"goal_to_q: expected (n_x={self.n_x}, n_goal), got {describe(goal_to_q)}")
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
        for name in ("goal_to_q", "goal_to_q_final"):
            check_tensor(name, fields[name], [x, goal])
        for name in ("goal_stage", "goal_final"):
            check_tensor(name, fields[name], [goal, goal])
        check_same_device(fields.items())
        for name, value in fields.items():
            self._register(name, value)

    def forward(self, goal: Tensor, horizon: int = 1) -> QuadraticCost:
        """The cost of one goal per batch element.

        Args:
            goal: (..., n_goal).
            horizon: number of stages, used by the constant only.

        Returns:
            A `QuadraticCost` with q, q_final (..., n_x) and constant (...), differentiable in the goal and the weights.
        """
        check_tensor("goal", goal, [("n_goal", self.n_goal)])
        if goal.device != self.Q.device:
            check_same_device([("cost", self.Q), ("goal", goal)])
        goal = goal.to(self.Q.dtype)
        weight = horizon * self.goal_stage + self.goal_final
        return QuadraticCost(
            self.Q,
            self.R,
            self.Q_final,
            q=goal @ self.goal_to_q.mT,
            q_final=goal @ self.goal_to_q_final.mT,
            constant=0.5 * (goal * (goal @ weight.mT)).sum(-1),
            check=False,
        )

    def stage(self, x: Tensor, u: Tensor, goal: Tensor) -> Tensor:
        """The cost of one stage, its constant included: states (..., n_x), actions (..., n_u), goals (...) → (...)."""
        cost = self(goal, horizon=1)
        quadratic = 0.5 * ((x @ cost.Q) * x).sum(-1) + 0.5 * ((u @ cost.R) * u).sum(-1)
        return quadratic + (cost.q * x).sum(-1) + 0.5 * (goal * (goal @ self.goal_stage.mT)).sum(-1)

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

        Weights multiply squares without a factor ½, as in Eq. cost_function of the paper. Pairs pull states together,
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
        check_positive_int("n_x", n_x)
        check_positive_int("n_u", n_u)
        check_number("input_weight", input_weight, strict=True)
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
        pairs = list(pairs)
        stage, to_q, constant = _tracking(n_x, weights, pairs, check_number("pair_weight", pair_weight), dtype)
        final, to_q_final, constant_final = _tracking(
            n_x, finals, pairs, check_number("pair_weight_final", final_pair), dtype
        )
        R = 2 * input_weight * torch.eye(n_u, dtype=dtype)
        return cls(stage, R, final, to_q, to_q_final, constant, constant_final)


def _weights(name: str, value: float | Sequence[float], n_x: int) -> list[float]:
    weights = [float(value)] * n_x if isinstance(value, int | float) else [float(v) for v in value]
    if not 1 <= len(weights) <= n_x:
        raise ShapeError(f"{name}: expected 1 to n_x={n_x} weights, got {len(weights)}")
    for weight in weights:
        check_number(name, weight)
    return weights


def _tracking(
    n_x: int, weights: list[float], pairs: list[tuple[int, int]], pair_weight: float, dtype: torch.dtype
) -> tuple[Tensor, Tensor, Tensor]:
    """½xᵀQx + (G goal)ᵀx + ½goalᵀK goal of the tracking terms: Q, G, K."""
    n_goal = len(weights)
    diagonal = 2 * torch.diag(torch.tensor(weights, dtype=dtype))
    Q = torch.zeros(n_x, n_x, dtype=dtype)
    Q[:n_goal, :n_goal] = diagonal
    to_q = torch.zeros(n_x, n_goal, dtype=dtype)
    to_q[:n_goal] = -diagonal
    for i, j in pairs:
        if not (0 <= i < n_x and 0 <= j < n_x and i != j):
            raise InvalidInputError(f"pairs: expected two different indices in 0…{n_x - 1}, got ({i}, {j})")
        difference = torch.zeros(n_x, dtype=dtype)
        difference[i], difference[j] = 1.0, -1.0
        Q += 2 * pair_weight * torch.outer(difference, difference)
    return Q, to_q, diagonal
