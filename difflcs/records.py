"""Records of matrices: one linear complementarity system, one per batch element, one per stage of a horizon."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, Self, get_type_hints, runtime_checkable

import torch
from torch import Tensor

from difflcs._checks import (
    broadcast_batch,
    check_dims,
    check_finite,
    check_integer,
    check_kind,
    check_positive_definite,
    check_same_device,
    check_same_dtype,
    check_shape,
    check_tensor,
    describe,
    describe_shapes,
    numbers_of,
    takes_arrays,
    to_tensor,
)
from difflcs._differentiation import runs_eagerly
from difflcs._linalg import matvec
from difflcs._modules import fresh
from difflcs.errors import BatchIndexError, DTypeError, InvalidInputError, ShapeError
from difflcs.lcp import solve_lcp


def dimensions(record: type) -> dict[str, tuple[str, ...]]:
    """Return the tensor fields of a record, each with the kinds of its trailing dimensions, as annotated there."""
    hints = get_type_hints(record, include_extras=True)
    return {f.name: hints[f.name].__metadata__ for f in fields(record) if hasattr(hints[f.name], "__metadata__")}


@dataclass(frozen=True)
class SystemMatrices:
    """Sizes and equations of a record that holds the matrices of an LCS, shared or one per batch element."""

    A: Annotated[Tensor, "n_x", "n_x"]
    B: Annotated[Tensor, "n_x", "n_u"]
    C: Annotated[Tensor, "n_x", "n_lam"]
    d: Annotated[Tensor, "n_x"]
    D: Annotated[Tensor, "n_lam", "n_x"]
    E: Annotated[Tensor, "n_lam", "n_u"]
    F: Annotated[Tensor, "n_lam", "n_lam"]
    c: Annotated[Tensor, "n_lam"]

    @property
    def n_x(self) -> int:
        """Number of states."""
        return self.A.shape[-1]

    @property
    def n_u(self) -> int:
        """Number of actions."""
        return self.B.shape[-1]

    @property
    def n_lam(self) -> int:
        """Number of complementarity variables."""
        return self.F.shape[-1]

    def next_state(self, x: Tensor, u: Tensor, lam: Tensor) -> Tensor:
        """Compute A x + B u + C λ + d, (..., n_x)."""
        return matvec(self.A, x) + matvec(self.B, u) + matvec(self.C, lam) + self.d

    def gap(self, x: Tensor, u: Tensor, lam: Tensor | None = None) -> Tensor:
        """Compute D x + E u + c, plus F λ unless lam is None, (..., n_lam)."""
        gap = matvec(self.D, x) + matvec(self.E, u) + self.c
        return gap if lam is None else gap + matvec(self.F, lam)


def index_batch(name: str, value: Tensor, batch: torch.Size, index: Any) -> Tensor:
    """Index a tensor of a record `name`, whose first dimensions are the batch, in these alone."""
    key = index if isinstance(index, tuple) else (index,)
    try:
        return value[(*key, *[slice(None)] * (value.ndim - len(batch)))]
    except (IndexError, TypeError) as error:
        raise BatchIndexError(
            f"{name}: expected an index of the batch dimensions {tuple(batch)}, got {describe(index)}: {error}; index "
            f"the elements of the batch, and a tensor by its name"
        ) from error


# Name → kinds of its dimensions, in the order of every list of these matrices.
SYSTEM = dimensions(SystemMatrices)


class LCSPrediction(NamedTuple):
    """One step of an LCS: the next state (..., n_x) and the complementarity variable (..., n_lam)."""

    x_next: Tensor
    lam: Tensor


@dataclass(frozen=True)
class _Record(SystemMatrices):
    """Base of records of matrices: they are checked when made, and behave like one tensor."""

    # Dimensions of every field between those of the batch and its rows and columns.
    _STAGES: ClassVar[tuple[str, ...]] = ()

    @runs_eagerly
    def __post_init__(self) -> None:
        tensors: dict[str, Any] = {name: to_tensor(value) for name, value in self.tensors().items()}
        vars(self).update(tensors)
        for name, value in tensors.items():
            check_tensor(name, value, finite=False)
        check_finite(tensors)
        rank = len(self._STAGES)
        for name, dims in SYSTEM.items():
            if tensors[name].ndim < rank + len(dims):
                labels = ", ".join(("...", *self._STAGES, *(("rows", "columns") if len(dims) == 2 else dims)))
                kind = "a matrix" if len(dims) == 2 else "a vector"
                raise ShapeError(f"{name}: expected {kind} ({labels}), got {describe(tensors[name])}; add the missing")
        sizes = {dim: getattr(self, dim) for dim in ("n_x", "n_u", "n_lam")}
        stages = [("H", self.A.shape[-3])] if rank else []
        if stages and not stages[0][1]:
            raise ShapeError(f"A: expected at least one stage, got {describe(self.A)}; give H ≥ 1 matrices")
        for name, dims in SYSTEM.items():
            check_dims(name, tensors[name], [*stages, *((dim, sizes[dim]) for dim in dims)])
        check_same_device(tensors.items())
        check_same_dtype(tensors)
        self.batch_shape  # noqa: B018  raises where the batch dimensions do not fit each other
        check_positive_definite(self.F)
        vars(self)["_checked"] = numbers_of(self.F)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({describe_shapes(self.tensors())})"

    def check_again(self) -> None:
        """Refuse F if it was changed in place since it was checked, and is no longer positive definite."""
        if (now := numbers_of(self.F)) is not None and vars(self).get("_checked") != now:
            check_positive_definite(self.F)
            vars(self)["_checked"] = now

    @classmethod
    def of_checked(cls, tensors: Mapping[str, Tensor], like: Self | None = None) -> Self:
        """Make a record of tensors that have been checked, all together, or with the F of `like`; it checks nothing."""
        record = object.__new__(cls)
        vars(record).update(vars(like) if like is not None else {"_checked": numbers_of(tensors["F"])}, **tensors)
        return record

    def _rank(self, name: str) -> int:
        """Count a field's dimensions after those of the batch: stages, rows and columns."""
        return len(self._STAGES) + len(SYSTEM[name])

    @property
    def batch_shape(self) -> torch.Size:
        """Leading batch dimensions; empty when every field is shared."""
        return broadcast_batch((k, v.shape[: v.ndim - self._rank(k)]) for k, v in self.tensors().items())

    def tensors(self) -> dict[str, Tensor]:
        """Return name → tensor, in the order of the fields."""
        return {name: getattr(self, name) for name in SYSTEM}

    def detach(self) -> Self:
        """Return the same numbers without gradient history."""
        return self._map(lambda v: v.detach())

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Convert the system to another dtype or device; the arguments are those of `torch.Tensor.to`."""
        return self._map(lambda v: v.to(*args, **kwargs))

    def _map(self, function: Callable[[Tensor], Tensor]) -> Self:
        return replace(self, **{k: function(v) for k, v in self.tensors().items()})

    def __getitem__(self, index: Any) -> Self:
        """Select systems of a batch: an integer, slice, tensor, or a tuple of these, of the batch dimensions alone.

        A field that is shared by the batch stays shared. Broadcast dimensions are indexed as if they were expanded.

        Raises:
            BatchIndexError: there are no batch dimensions, or not these.
        """
        batch, values = self.batch_shape, {}
        if not batch:
            raise BatchIndexError(
                f"{type(self).__name__}: expected an index of a batch dimension, got {describe(index)} where "
                f"every field is shared by the batch; build it from tensors with leading batch dimensions"
            )
        for name, value in self.tensors().items():
            if own := value.ndim - self._rank(name):
                value = value.expand(*batch, *value.shape[own:])
                value = index_batch(type(self).__name__, value, batch, index)
            values[name] = value
        return type(self)(**values)

    def __iter__(self) -> Iterator[Self]:
        """Iterate over the systems along the first batch dimension."""
        if not self.batch_shape:
            self[0]  # raises: without this, a loop over one system would do nothing
        return (self[i] for i in range(self.batch_shape[0]))

    def check_inputs(self, **tensors: Tensor) -> None:
        """Check states `x…` and actions `u…` against the sizes, dtype and device of the matrices."""
        check_inputs(self.n_x, self.n_u, self.A, tensors)

    def _fits(self, **batches: torch.Size) -> torch.Size:
        return broadcast_batch([("the system", self.batch_shape), *batches.items()])

    def _rollout(self, x0: Tensor, u_seq: Tensor, stage: Callable[[int], LCSParams], **horizon: int) -> Tensor:
        """Predict a trajectory by the system of each step; T=… if it has a number of its own."""
        check_shape("u_seq", u_seq, "... T n_u", {"n_u": self.n_u, **horizon}, "give one action for each step")
        self.check_inputs(x0=x0, u_seq=u_seq)
        states = [x0.expand(*self._fits(x0=x0.shape[:-1], u_seq=u_seq.shape[:-2]), self.n_x)]
        for t in range(u_seq.shape[-2]):
            states.append(advance(stage(t), states[-1], u_seq[..., t, :]).x_next)
        return torch.stack(states, dim=-2)


@dataclass(frozen=True, repr=False)
class LCSParams(_Record):
    """The matrices of one linear complementarity system, or of one per batch element (Eq. 1 of the paper).

    x₊ = A x + B u + C λ + d,  0 ≤ λ ⊥ D x + E u + F λ + c ≥ 0,  with F + Fᵀ ≻ 0, so that λ is unique.

    Every field may carry leading batch dimensions, or none to be shared by the batch. A system without contacts has
    n_lam = 0. `params[i]` are some systems of a batch, `params.to(torch.float32)` is the record in another dtype.

    Attributes:
        A: (..., n_x, n_x) autonomous dynamics.
        B: (..., n_x, n_u) effect of actions.
        C: (..., n_x, n_lam) effect of the complementarity variable (contact forces).
        d: (..., n_x) constant drift.
        D: (..., n_lam, n_x) gap per state.
        E: (..., n_lam, n_u) gap per action.
        F: (..., n_lam, n_lam) gap per force.
        c: (..., n_lam) constant gap.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: a field does not fit the others.
        NotPositiveDefiniteError: F + Fᵀ is not positive definite; the message gives its smallest eigenvalue. Under
            `torch.func.vmap` and its like, numbers cannot be read here; they are where an LCP or a loss is solved.
    """

    @runs_eagerly
    @takes_arrays
    def step(self, x: Tensor, u: Tensor) -> LCSPrediction:
        """Predict one step through the exact LCP.

        Args:
            x: (..., n_x) states.
            u: (..., n_u) actions; batch dimensions broadcast with those of x and of the matrices.

        Returns:
            x_next (..., n_x) and lam (..., n_lam), differentiable in x, u and every matrix.
        """
        self.check_inputs(x=x, u=u)
        self._fits(x=x.shape[:-1], u=u.shape[:-1])
        return advance(self, x, u)

    @runs_eagerly
    @takes_arrays
    def rollout(self, x0: Tensor, u_seq: Tensor) -> Tensor:
        """Predict a trajectory.

        Args:
            x0: (..., n_x) initial states.
            u_seq: (..., T, n_u) actions, T ≥ 0.

        Returns:
            (..., T+1, n_x) states, x0 first; batch dimensions of x0, u_seq and the matrices broadcast.
        """
        return self._rollout(x0, u_seq, lambda _: self)


@dataclass(frozen=True, repr=False)
class LCSSequence(_Record):
    """One linear complementarity system per stage of a horizon H, e.g. linearised along a trajectory.

    x_{k+1} = A_k x_k + B_k u_k + C_k λ_k + d_k,  0 ≤ λ_k ⊥ D_k x_k + E_k u_k + F_k λ_k + c_k ≥ 0,  k = 0 … H − 1.

    Every field has a dimension H of stages before its rows and columns, and before that any batch dimensions, or none
    to be shared by the batch. `next_state` and `gap` take all stages at once: x (..., H, n_x).

    Attributes:
        A: (..., H, n_x, n_x) autonomous dynamics.
        B: (..., H, n_x, n_u) effect of actions.
        C: (..., H, n_x, n_lam) effect of the complementarity variable (contact forces).
        d: (..., H, n_x) constant drift.
        D: (..., H, n_lam, n_x) gap per state.
        E: (..., H, n_lam, n_u) gap per action.
        F: (..., H, n_lam, n_lam) gap per force.
        c: (..., H, n_lam) constant gap.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError, NotPositiveDefiniteError: as for `LCSParams`.
    """

    _STAGES: ClassVar[tuple[str, ...]] = ("H",)

    @property
    def horizon(self) -> int:
        """H, the number of stages."""
        return self.A.shape[-3]

    @classmethod
    def stack(cls, systems: Sequence[LCSParams]) -> LCSSequence:
        """Make a sequence from one system per stage, in their order; batch dimensions of each field broadcast.

        Raises:
            InvalidInputError, DTypeError, ShapeError: no systems, something else, or of different sizes.
        """
        systems = list(systems)
        if not systems:
            raise InvalidInputError("systems: expected at least one LCSParams, got none; give one for each stage")
        for k, system in enumerate(systems):
            if not isinstance(system, LCSParams):
                raise DTypeError(f"systems[{k}]: expected LCSParams, got {describe(system)}; build one for each stage")
            sizes, expected = ((s.n_x, s.n_u, s.n_lam) for s in (system, systems[0]))
            if sizes != expected:
                raise ShapeError(
                    f"systems[{k}]: expected n_x, n_u, n_lam = {expected} like systems[0], got {sizes}; a contact that "
                    f"a stage lacks gets zeros in C, D and E, and ones in c and the diagonal of F"
                )
        values = {}
        for name, dims in SYSTEM.items():
            each = [getattr(system, name) for system in systems]
            batch = broadcast_batch((f"systems[{k}].{name}", v.shape[: v.ndim - len(dims)]) for k, v in enumerate(each))
            shape = each[0].shape[each[0].ndim - len(dims) :]
            check_same_device((f"systems[{k}].{name}", v) for k, v in enumerate(each))
            values[name] = torch.stack([v.expand(*batch, *shape) for v in each], dim=-1 - len(dims))
        return cls(**values)

    def stage(self, k: int) -> LCSParams:
        """Return the system of stage k, 0 ≤ k < H; negative ones count from the end."""
        k = check_integer("k", k)
        if not -self.horizon <= k < self.horizon:
            raise BatchIndexError(f"k: expected a stage of 0 … {self.horizon - 1}, got {k}; choose another")
        return LCSParams(**{n: v.select(v.ndim - self._rank(n), k) for n, v in self.tensors().items()})

    @runs_eagerly
    @takes_arrays
    def rollout(self, x0: Tensor, u_seq: Tensor) -> Tensor:
        """Predict a trajectory through the stages.

        Args:
            x0: (..., n_x) initial states.
            u_seq: (..., H, n_u) actions, one per stage.

        Returns:
            (..., H+1, n_x) states, x0 first; batch dimensions of x0, u_seq and the matrices broadcast.
        """
        return self._rollout(x0, u_seq, self.stage, T=self.horizon)


@runtime_checkable
class LCSModule(Protocol):
    """Interface of modules that return the system at some states: a learned model, or one from physics and a context.

    Layers, losses and training take any; most are `torch.nn.Module`s. `isinstance(value, LCSModule)` checks for the
    four names.
    """

    @property
    def n_x(self) -> int:
        """Number of states."""
        ...

    @property
    def n_u(self) -> int:
        """Number of actions."""
        ...

    @property
    def n_lam(self) -> int:
        """Number of complementarity variables."""
        ...

    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams | LCSSequence:
        """Return the system at some states.

        Args:
            x: (..., n_x) states, if the caller has them. A module that needs them raises an error if they are missing.
            context: (..., n_context) further quantities that it depends on.

        Returns:
            The matrices, shared, or with leading batch dimensions that broadcast with those of x; differentiable in
            the module's parameters.
        """
        ...


@runs_eagerly
def system_at(lcs: LCSModule, x: Tensor | None, context: Tensor | None = None) -> LCSParams | LCSSequence:
    """Call `lcs.params(x, context)` after the hooks of `torch.nn.utils` in the module."""
    return fresh(lcs).params(x, context)


@runs_eagerly
def sequence_along(lcs: LCSModule, plan: Any, x0: Tensor | None = None, context: Tensor | None = None) -> LCSSequence:
    """Linearise a module along the motion that it predicts for the actions of a plan.

    It is asked anew in each state that these actions lead to, where one system holds the contacts of one state through
    the whole horizon. So what comes into reach on the way is in it, and a side that is left, is not. States that a plan
    itself predicts serve less well: where its system was wrong, it may see one body inside another.

    Args:
        lcs: the module. Where it has a method `context_along(x, u, context)`, that says the context of each stage, such
            as a nominal control. Where it has one `states_along(x, u)`, that says all the states at once, or None.
        plan: an `MPCSolution`, or a `Primal` such as `solution.shift()`.
        x0: (..., n_x) states to begin at; None: those of the plan.
        context: (..., n_context) see `LCSModule.params`.

    Returns:
        One system per stage, differentiable in what the module learns and, at stage 0, as `params` is in x0. The states
        where the module is asked are no functions of anything.

    Raises:
        DTypeError: the module does not return `LCSParams`.
    """
    lcs, u = check_kind("lcs", lcs, LCSModule), check_shape("plan.u", getattr(plan, "u", plan), "... H n_u").detach()
    x0 = check_shape("x0", plan.x[..., 0, :] if x0 is None else x0, "... n_x", {"n_x": lcs.n_x})
    x = x0.expand(*broadcast_batch([("plan.u", u.shape[:-2]), ("x0", x0.shape[:-1])]), lcs.n_x)
    context_along, systems = getattr(lcs, "context_along", None), []
    states_along = getattr(lcs, "states_along", None)
    if context_along is not None and states_along is not None and (states := states_along(x, u)) is not None:
        states = torch.cat([x.unsqueeze(-2), states[..., 1:, :]], -2)
        system = system_at(lcs, states, context_along(states, u, context)).tensors()
        shapes = {name: value.shape[value.ndim - len(SYSTEM[name]) :] for name, value in system.items()}
        return LCSSequence(**{name: v.expand(*states.shape[:-1], *shapes[name]) for name, v in system.items()})
    for k in range(u.shape[-2]):
        stage_context = context if context_along is None else context_along(x, u[..., k, :], context)
        system = system_at(lcs, x, stage_context)
        if not isinstance(system, LCSParams):
            raise DTypeError(f"lcs: expected LCSParams from {type(lcs).__name__}.params, got {describe(system)}")
        systems.append(system)
        with torch.no_grad():
            x = advance(system, *(v.to(system.A.dtype) for v in (x, u[..., k, :]))).x_next.to(x)
    return LCSSequence.stack(systems)


def advance(system: SystemMatrices, x: Tensor, u: Tensor) -> LCSPrediction:
    """Advance a system by one step, for states and actions that were checked."""
    lam = solve_lcp(system.F, system.gap(x, u)).lam
    return LCSPrediction(system.next_state(x, u, lam), lam)


def check_inputs(n_x: int, n_u: int, like: Tensor, tensors: Mapping[str, Tensor], owner: str = "system") -> None:
    """Check states `x…` and actions `u…` against sizes, and the dtype and device of another tensor."""
    for name, tensor in tensors.items():
        check_tensor(name, tensor, [("n_u", n_u)] if name.startswith("u") else [("n_x", n_x)])
        if tensor.dtype != like.dtype:
            raise DTypeError(
                f"{name}: expected {like.dtype} like the {owner}, got {describe(tensor)}; "
                f"convert it with {name}.to({like.dtype}) or the {owner} with {owner}.to({tensor.dtype})"
            )
    check_same_device([(owner, like), *tensors.items()])
