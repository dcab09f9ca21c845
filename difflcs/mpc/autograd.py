"""The MPC as one node of the autograd graph, and its pullback as another.

`Plan` holds one call: how to solve, and, once it is solved, what a gradient needs. Its tensors are the inputs as the
caller gave them, with any batch dimensions. They become numbers (flat batch, float64, CPU) inside the node, where they
are real ones under every transform: `torch.func.vmap` makes of its dimension one more batch dimension in front, and of
a backward pass that it maps over several gradients a loop over them.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import all_finite, check_finite, check_positive_definite, check_tensor
from difflcs._differentiation import transforms_active
from difflcs._fields import check_not_nan
from difflcs.errors import DegenerateWarning, DoubleBackwardError
from difflcs.mpc.backends.base import Backend, Result
from difflcs.mpc.gather import RANKS
from difflcs.mpc.problem import INPUTS, MAY_BE_INFINITE, MPCProblem
from difflcs.mpc.solution import Primal
from difflcs.records import LCSParams, dimensions
from difflcs.status import Status

# What a call gives to the node, in this order; None for what it leaves out.
ARGUMENTS = (*INPUTS, "constant", *(f"guess.{name}" for name in Primal._fields))
_COUNT = len(INPUTS) + 1  # those that are differentiable
_SYMMETRIC = ("Q", "R", "Q_final")
_SYSTEM = frozenset(dimensions(LCSParams))
_COST = ("Q", "R", "S", "Q_final", "q", "r", "q_final", "constant")


class Target(NamedTuple):
    """What the gradient of one input must look like."""

    name: str
    shape: torch.Size
    dtype: torch.dtype
    device: torch.device


@dataclass
class Plan:
    """One call of the layer: how to solve it, and what was found.

    Attributes:
        backend, horizon, relaxation, barrier: see `MPCProblem` and `Backend`.
        by_stage: names of the inputs with a dimension of stages.
        dtype: of x, u, lam and the objective.
        smallest: the narrowest dtype in which a gradient will arrive.
        batch: batch dimensions that all inputs broadcast to; vmap adds its own in front.
        own: whether the outputs must have memory of their own, because a backward pass may follow.
        unseen: whether nothing has looked at the numbers yet, because the inputs were made under a transform.
        problem, constant, result: what was solved, and how; once it is.
    """

    backend: Backend
    horizon: int
    relaxation: float
    barrier: float
    by_stage: frozenset[str]
    dtype: torch.dtype
    smallest: torch.dtype
    batch: tuple[int, ...]
    own: bool
    unseen: bool
    problem: MPCProblem = field(init=False)
    constant: Tensor = field(init=False)
    result: Result = field(init=False)

    def solve(self, tensors: Mapping[str, Tensor], guess: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
        """x, u, lam, mu, objective, status, iterations, kkt_residual, solve_time, violation.

        Each has the batch dimensions first. `tensors` are the inputs by their names, `guess` is one or None four times;
        none of them is wrapped.
        """
        values = self._values(tensors)
        self.constant = values.pop("constant")
        self.problem = MPCProblem(**values, horizon=self.horizon, relaxation=self.relaxation, barrier=self.barrier)
        return self.run(self.flat_guess(guess), tensors["x0"])

    def again(self, changed: Mapping[str, Tensor]) -> Plan:
        """A plan for the same problem with some other inputs, like them in everything but their numbers."""
        values = self._values(changed)
        return self._with(values.pop("constant", self.constant), self.problem.changed(values))

    def at(self, x0: Tensor) -> Plan:
        """The same from other states (batch, n_x), float64 on the CPU."""
        return self._with(self.constant, self.problem.at(x0))

    def private(self) -> Plan:
        """The same in memory of its own, before it is solved."""
        return self._with(self.constant.clone(), self.problem.private())

    def _with(self, constant: Tensor, problem: MPCProblem) -> Plan:
        other = object.__new__(Plan)
        vars(other).update(vars(self), constant=constant, problem=problem)
        vars(other).pop("result", None)
        return other

    def run(self, start: Primal | None, x0: Tensor) -> tuple[Tensor, ...]:
        """What `solve` returns, of the problem as it is, on the device of x0."""
        problem, constant = self.problem, self.constant
        violation = torch.from_numpy(np.zeros(problem.batch))  # before the solve, and by NumPy, as it is faster
        result = self.backend.solve(problem, start)
        if problem.n_c:
            violation = problem.violation(result.primal.x, result.primal.u)
            # Of a failed element the numbers can be so large that products of them are none.
            largest = torch.finfo(self.dtype).max
            violation = violation.nan_to_num(nan=largest, posinf=largest)
        self.result, objective = _within_range(result, self._objective(result), constant, self.dtype)
        result = self.result
        primal, status, floats = result.primal, result.status, (objective, violation)
        if self.own:  # copies: what the caller does with the outputs must not change the gradient
            primal, status = tuple(v.clone() for v in primal), status.clone()
        if self.dtype != torch.float64:
            primal, floats = (tuple(v.to(self.dtype) for v in values) for values in (primal, floats))
            primal = (primal[0], _inside(primal[1], problem), *primal[2:])
        outputs = (*primal, floats[0], status, result.iterations, result.kkt_residual, result.solve_time, floats[1])
        if not x0.is_cpu:
            outputs = tuple(v.to(x0.device) for v in outputs)
        if not self.batch:
            return tuple([v.squeeze(0) for v in outputs])
        return outputs if len(self.batch) == 1 else tuple(v.reshape((*self.batch, *v.shape[1:])) for v in outputs)

    def _objective(self, result: Result) -> Tensor:
        """The cost of the plans (batch,), by the solver where it says it."""
        if result.objective is not None and result.all_converged:
            return result.objective
        objective = self.problem.objective(result.primal.x, result.primal.u)
        if result.objective is None:
            return objective
        return torch.where(result.status == int(Status.CONVERGED), result.objective, objective)

    @property
    def _size(self) -> int:
        return math.prod(self.batch)

    def rank(self, name: str) -> int:
        """Number of dimensions of an input behind those of the batch."""
        return RANKS[name] + (name in self.by_stage)

    def _values(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Name → numbers as `MPCProblem` wants them; checked, as far as nobody did before."""
        values, unchecked, size = {}, {}, self._size
        for name, tensor in tensors.items():
            value = tensor.detach()
            if value.dtype != torch.float64 or not value.is_cpu:
                value = value.to("cpu", torch.float64)
            lead = value.shape[: value.ndim - self.rank(name)]
            if lead or name == "x0":
                own = value.shape[len(lead) :]
                if math.prod(lead) == 1 and name != "x0":
                    value = value.reshape(own)  # shared
                elif lead == self.batch:
                    value = value.reshape(size, *own) if len(lead) != 1 else value
                else:
                    value = value.expand(*self.batch, *own).reshape(size, *own)
            if name in self.by_stage and value.ndim == self.rank(name):
                value = value.unsqueeze(0)
            if name in _SYMMETRIC and not torch.equal(value, value.mT):
                value = 0.5 * (value + value.mT)
            if name in MAY_BE_INFINITE:
                if self.unseen or tensor.requires_grad:
                    check_not_nan(name, value)
            elif self.unseen or name in _COST:
                unchecked[name] = value
            values[name] = value.contiguous()
            # A solution is measured by the system that it was planned with, also after a step of an optimiser.
            if self.own and name in _SYSTEM and values[name].data_ptr() == tensor.data_ptr():
                values[name] = value.clone()
        check_finite(unchecked)
        if self.unseen:
            check_positive_definite(values["F"])
        return values

    def flat_guess(self, tensors: Sequence[Tensor | None]) -> Primal | None:
        """A guess as solvers want it."""
        if tensors[0] is None:
            return None
        flat = []
        for tensor in tensors:
            if tensor is None:  # no multipliers
                flat.append(self.problem.no_multipliers())
                continue
            value = tensor.detach() if tensor.requires_grad else tensor
            if value.dtype != torch.float64 or not value.is_cpu:
                value = value.to("cpu", torch.float64)
            if self.unseen:
                check_tensor("guess", value)
            if not self.batch and value.ndim == 2:
                value = value.unsqueeze(0)
            elif len(self.batch) != 1 or value.ndim != 3:
                value = value.expand(*self.batch, *value.shape[-2:]).reshape(self._size, *value.shape[-2:])
            flat.append(value)
        return Primal(*flat)

    def pull_back(self, targets: Sequence[Target], kept: int, grads: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
        """Gradients of some inputs from those of x, u, lam and the objective.

        Args:
            targets: what each gradient must look like, but for the dimensions that are kept.
            kept: how many dimensions of the batch, from the first, each gradient has in front, unsummed.
            grads: with the batch dimensions; None for zero.
        """
        result, solved = self.result, self.result.solved
        upstream = tuple(self._upstream(i, g) for i, g in enumerate(grads))
        wanted = {target.name for target in targets} - {"constant"}
        problem = self.problem if kept == 0 else self._apart(wanted)

        def vjp(keep: Tensor) -> dict[str, Tensor]:
            return self.backend.vjp(problem, result, upstream, keep)  # pyright: ignore[reportArgumentType]

        gradients = {}
        if wanted:
            # NaN that comes from the caller goes back to the caller, as everywhere in torch; our own would be an error.
            theirs = not _all_finite(upstream, torch.finfo(torch.float64).max)
            gradients = vjp(solved) if theirs else _finite(vjp, solved, torch.finfo(self.smallest).max)
        gradients["constant"] = upstream[3]
        return tuple(self._shaped(target, gradients[target.name], kept) for target in targets)

    def _upstream(self, index: int, grad: Tensor | None) -> Tensor:
        """Gradient of one output, flat; what comes for a failed element is dropped before it can meet the others."""
        like = self.result.primal[index] if index < 3 else self.result.kkt_residual
        if grad is None:
            return torch.zeros_like(like)
        flat = grad.to("cpu", torch.float64).reshape(like.shape)
        return torch.where(self.result.solved.reshape(-1, *[1] * (like.ndim - 1)), flat, 0.0)

    def _apart(self, names: set[str]) -> MPCProblem:
        """The problem with some inputs given for each element, so that each gets a gradient of its own."""
        changed = {}
        for name in names:
            value = getattr(self.problem, name)
            if self.problem.shared(name):
                own = value.shape[value.ndim - self.rank(name) :]
                changed[name] = value.reshape(1, *own).expand(self._size, *own).contiguous()
        return replace(self.problem, **changed)

    def _shaped(self, target: Target, gradient: Tensor, kept: int) -> Tensor:
        """A gradient summed to the shape, and in the dtype and on the device, of its input."""
        name, shape, front = target.name, target.shape, self.batch[:kept]
        if name in _SYMMETRIC:
            gradient = 0.5 * (gradient + gradient.mT)
        if kept or gradient.numel() != math.prod(shape):
            rank = self.rank(name)
            lead, own = shape[: len(shape) - rank], shape[len(shape) - rank :]
            ones = [1] * (len(self.batch) - kept - len(lead))
            gradient = gradient.reshape((*self.batch, *own)).sum_to_size((*front, *ones, *lead, *own))
        return gradient.reshape((*front, *shape)).to(target.device, target.dtype)


def solve(plan: Plan, tensors: Mapping[str, Tensor], guess: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
    """The outputs of `Plan.solve`, as nodes of the graph if there is one."""
    if not plan.own and not plan.unseen:
        return plan.solve(tensors, guess)
    # The style with `setup_context`, which transforms need, costs 20 µs more a call: it reads a signature each time.
    function = _Transformed if transforms_active() else _Eager
    inputs = (tensors.get(name) for name in ARGUMENTS[:_COUNT])
    return function.apply(plan, *inputs, *guess)[:-1]  # pyright: ignore[reportOptionalSubscript]


def _keep(ctx: Any, plan: Plan, tensors: Sequence[Tensor | None], outputs: Sequence[Tensor]) -> None:
    ctx.plan = plan
    # Saved so that autograd refuses what was changed in place; the last output knows which transforms it has met.
    ctx.save_for_backward(*tensors[:_COUNT], outputs[-1])
    ctx.mark_non_differentiable(outputs[3], *outputs[5:])
    ctx.set_materialize_grads(False)


def _witnessed(plan: Plan, tensors: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
    """What was found, and an empty tensor."""
    named = {name: v for name, v in zip(ARGUMENTS, tensors[:_COUNT], strict=False) if v is not None}
    outputs = plan.solve(named, tensors[_COUNT:])
    return *outputs, outputs[0].new_empty((*plan.batch, 0))


class _Eager(torch.autograd.Function):
    @staticmethod
    def forward(ctx, plan: Plan, *tensors: Tensor | None):
        outputs = _witnessed(plan, tensors)
        _keep(ctx, plan, tensors, outputs)
        return outputs

    @staticmethod
    def backward(ctx, *grads: Tensor | None):
        *inputs, witness = ctx.saved_tensors
        needs = ctx.needs_input_grad[1 : 1 + _COUNT]
        grads = (*grads[:3], grads[4])
        none = [None] * (len(ARGUMENTS) - _COUNT)
        if all(g is None for g in grads):
            return None, *[None] * _COUNT, *none
        return None, *_pull_back(ctx.plan, inputs, needs, witness, grads), *none


class _Transformed(torch.autograd.Function):
    @staticmethod
    def forward(plan: Plan, *tensors: Tensor | None):
        return _witnessed(plan, tensors)

    @staticmethod
    def setup_context(ctx, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        _keep(ctx, inputs[0], inputs[1:], output)

    backward = _Eager.backward

    @staticmethod
    def vmap(info, in_dims: tuple, plan: Plan, *tensors: Tensor | None):
        moved = []
        for name, tensor, dim in zip(ARGUMENTS, tensors, in_dims[1:], strict=True):
            if tensor is not None and dim is not None:
                tensor = tensor.movedim(dim, 0)
                rank = 2 if name.startswith("guess") else plan.rank(name)
                lead = tensor.shape[1 : tensor.ndim - rank]
                ones = [1] * (len(plan.batch) - len(lead))  # so that its dimension is the first of the batch
                tensor = tensor.reshape(tensor.shape[0], *ones, *tensor.shape[1:])
            moved.append(tensor)
        plan.batch = (info.batch_size, *plan.batch)
        outputs = _Transformed.apply(plan, *moved)
        return outputs, (0,) * len(outputs)  # pyright: ignore[reportArgumentType]


def _pull_back(
    plan: Plan, inputs: Sequence[Tensor | None], needs: Sequence[bool], witness: Tensor, grads: Sequence[Tensor | None]
) -> list[Tensor | None]:
    """The pullback, whatever transform it runs in."""
    named = zip(ARGUMENTS, inputs, needs, strict=False)
    targets = tuple(Target(k, v.shape, v.dtype, v.device) for k, v, needed in named if needed and v is not None)
    legacy = torch._C._functorch.is_legacy_batchedtensor  # pyright: ignore[reportAttributeAccessIssue]
    if transforms_active():
        # Inside a transform of torch.func every backward pass is recorded; it is refused when it is differentiated.
        found = _Pullback.apply(plan, targets, 0, witness, *grads, *inputs)
    elif torch.is_grad_enabled():
        _refuse()
    elif any(g is not None and legacy(g) for g in grads):
        found = _pull_back_legacy(plan, targets, grads)
    else:
        found = plan.pull_back(targets, 0, grads)
    rest = iter(found)  # pyright: ignore
    return [next(rest) if needed else None for needed in needs]


def _refuse() -> None:
    raise DoubleBackwardError("LCSMPCLayer has first derivatives only; expected create_graph=False")


class _Pullback(torch.autograd.Function):
    """`Plan.pull_back`. The inputs are here so that its result is known to depend on them."""

    @staticmethod
    def forward(plan: Plan, targets: tuple[Target, ...], kept: int, witness: Tensor, *tensors: Tensor | None):
        return plan.pull_back(targets, kept, tensors[:4])

    @staticmethod
    def setup_context(ctx, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx, *_: Tensor):
        _refuse()

    @staticmethod
    def vmap(info, in_dims: tuple, plan: Plan, targets: tuple, kept: int, witness: Tensor, *tensors: Tensor | None):
        grads, inputs, dims = tensors[:4], tensors[4:], in_dims[4:8]
        if in_dims[3] is not None:  # the solve has met this dimension: it is the first of its batch
            front = []
            for grad, dim in zip(grads, dims, strict=True):
                if grad is not None:
                    grad = grad.expand(info.batch_size, *grad.shape) if dim is None else grad.movedim(dim, 0)
                front.append(grad)
            found = _Pullback.apply(plan, targets, kept + 1, witness.movedim(in_dims[3], 0), *front, *inputs)
        else:  # several gradients of one solve
            each = []
            for i in range(info.batch_size):
                one = [g if g is None or dim is None else g.select(dim, i) for g, dim in zip(grads, dims, strict=True)]
                each.append(_Pullback.apply(plan, targets, kept, witness, *one, *inputs))
            found = tuple(torch.stack(parts) for parts in zip(*each, strict=True))
        return found, (0,) * len(targets)


def _pull_back_legacy(plan: Plan, targets: Sequence[Target], grads: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
    """`is_grads_batched` and `jacobian(vectorize=True)` map the backward pass by an older vmap without rules."""
    level = torch._C._vmapmode_increment_nesting() - 1  # pyright: ignore[reportAttributeAccessIssue]
    torch._C._vmapmode_decrement_nesting()  # pyright: ignore[reportAttributeAccessIssue]
    # What does not have its dimension gets one of size 1.
    rows = [None if g is None else torch._remove_batch_dim(g, level, 1, 0) for g in grads]  # pyright: ignore
    count = max(len(row) for row in rows if row is not None)
    each = []
    for i in range(count):
        one = [None if row is None else row[min(i, len(row) - 1)] for row in rows]
        each.append(plan.pull_back(targets, 0, one))
    return tuple(torch._add_batch_dim(torch.stack(parts), 0, level) for parts in zip(*each, strict=True))  # pyright: ignore


def _within_range(result: Result, objective: Tensor, constant: Tensor, dtype: torch.dtype) -> tuple[Result, Tensor]:
    """The objective with its constant; elements whose numbers `dtype` cannot hold become NUMERICAL.

    Those that failed get numbers that it can hold.
    """
    total = objective + constant
    if (
        dtype == torch.float64
        and result.all_converged
        and (math.isfinite(total) if total.numel() == 1 else all_finite(total))
    ):
        return result, total
    largest = torch.finfo(dtype).max
    held = total.abs() <= largest
    if dtype != torch.float64:
        for value in result.primal:
            held &= (value.abs() <= largest).flatten(1).all(1)
    solved = result.solved
    if bool((held & solved).all()):
        return result, total
    status = torch.where(solved & ~held, int(Status.NUMERICAL), result.status).to(torch.int8)
    failed = ~(solved & held)
    rows = failed[:, None, None]
    primal = Primal(*(torch.where(rows, v.clamp(-largest, largest), v) for v in result.primal))
    room = largest / 4 - constant.abs()
    finite = torch.nan_to_num(objective, nan=largest)
    objective = torch.where(failed, torch.maximum(torch.minimum(finite, room), -room), objective)
    return replace(result, primal=primal, status=status), objective + constant


def _inside(u: Tensor, problem: MPCProblem) -> Tensor:
    """Rounded actions (batch, H, n_u), inside the bounds in float64 too where a number of their dtype lies there."""
    u_min, u_max = problem.bounds()
    low, high = u_min.to(u.dtype), u_max.to(u.dtype)
    up, down = torch.full_like(low, torch.inf), torch.full_like(high, -torch.inf)
    low = torch.where(low.double() < u_min, torch.nextafter(low, up), low)
    high = torch.where(high.double() > u_max, torch.nextafter(high, down), high)
    return torch.where(low <= high, torch.minimum(torch.maximum(u, low), high), u)


def _finite(vjp: Callable[[Tensor], dict[str, Tensor]], solved: Tensor, limit: float) -> dict[str, Tensor]:
    """Gradients without the elements whose own are not finite; they are found by halving the batch."""
    gradients = vjp(solved)
    if _all_finite(list(gradients.values()), limit):
        return gradients
    total, dropped = {name: torch.zeros_like(value) for name, value in gradients.items()}, 0
    todo = [torch.nonzero(solved).squeeze(-1)]
    while todo:
        index = todo.pop()
        keep = torch.zeros_like(solved)
        keep[index] = True
        gradients = vjp(keep)
        if _all_finite(list(gradients.values()), limit):
            total = {name: value + gradients[name] for name, value in total.items()}
        elif len(index) > 1:
            todo += [index[: len(index) // 2], index[len(index) // 2 :]]
        else:
            dropped += 1
    warnings.warn(
        f"the gradient of {dropped} of {len(solved)} solutions is not finite and was left out; check the scale of the "
        f"inputs and of the gradient that arrives at the layer",
        DegenerateWarning,
        stacklevel=2,
    )
    return total


def _all_finite(values: Sequence[Tensor], limit: float) -> bool:
    if limit < torch.finfo(torch.float64).max:
        return all(bool((v.abs() <= limit).all()) for v in values)
    return all_finite(*values)
