"""LearnableMujocoLCS: the physics of a MuJoCo model with numbers of the model that are learned."""

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from difflcs._checks import broadcast_batch, check_tensor, did_you_mean
from difflcs._differentiation import Solver, runs_eagerly, solve
from difflcs._modules import fresh
from difflcs.errors import InvalidInputError
from difflcs.physics.mujoco.lcs import MujocoLCS
from difflcs.physics.mujoco.narrow import BOX, CAPSULE, CYLINDER, ELLIPSOID, SPHERE
from difflcs.physics.mujoco.native import flags, to_numpy
from difflcs.physics.mujoco.quasi_dynamic import BIASES, GAINS
from difflcs.records import SYSTEM, LCSParams

Array = NDArray[np.float64]


class _Kind(NamedTuple):
    """A quantity of MuJoCo's model.

    Attributes:
        of: what has it: body, geom, pair, actuator or joint; none for the compliance, which is ours.
        fields: of `MjModel`, with the columns that belong to it.
        offset: whether it changes by a vector, in parts of the length, where else it has a factor.
    """

    of: str
    fields: tuple[tuple[str, slice], ...]
    offset: bool = False


_ALL = slice(0, 3)
_KINDS = {
    "mass": _Kind("body", (("body_mass", _ALL), ("body_inertia", _ALL))),
    "inertia": _Kind("body", (("body_inertia", _ALL),)),
    "center_of_mass": _Kind("body", (("body_ipos", _ALL),), offset=True),
    "friction": _Kind("geom", (("geom_friction", slice(0, 1)),)),
    "torsional_friction": _Kind("geom", (("geom_friction", slice(1, 2)),)),
    "pair_friction": _Kind("pair", (("pair_friction", slice(0, 2)),)),
    "size": _Kind("geom", (("geom_size", _ALL),)),
    "offset": _Kind("geom", (("geom_pos", _ALL),), offset=True),
    "gain": _Kind("actuator", (("actuator_gainprm", _ALL), ("actuator_biasprm", _ALL))),
    "servo_damping": _Kind("actuator", (("actuator_biasprm", slice(2, 3)),)),
    "damping": _Kind("joint", (("dof_damping", slice(0, 1)),)),
    "frictionloss": _Kind("joint", (("dof_frictionloss", slice(0, 1)),)),
    "armature": _Kind("joint", (("dof_armature", slice(0, 1)),)),
    "stiffness": _Kind("joint", (("jnt_stiffness", slice(0, 1)),)),
    "compliance": _Kind("", ()),
}
_COUNTS = {"body": "nbody", "geom": "ngeom", "pair": "npair", "actuator": "nu", "joint": "njnt"}
_STEP, _STATE_STEP = 3e-3, 1e-4  # of the differences: of parameters, which are of size 1, and of states and controls
_LARGEST = 700  # of a logarithm whose factor is a number, and not zero
_SIZED = (SPHERE, CAPSULE, CYLINDER, ELLIPSOID, BOX)


class _Entry(NamedTuple):
    """Parameters of one quantity: its kind, a name and the numbers of what has it, their place and count."""

    kind: str
    name: str
    ids: list[int]
    start: int
    count: int


class LearnableMujocoLCS(nn.Module):
    """A MuJoCo model whose numbers are learned; an `LCSModule` like `MujocoLCS`.

    Learn it by `violation_loss` or `prediction_loss` from transitions, or through an `LCSMPCLayer` by PPO. The matrices
    are differentiable in the parameters, in the states and in the nominal controls: by central differences, two systems
    of changed models for each number, all states at once. Where contacts differ on one side, only the other counts.

    The parameters are one dimensionless vector: logarithms of factors, and offsets as fractions of `length`. They start
    at zero, at the model that was passed.

    Args:
        model: the MuJoCo model.
        data: see `MujocoLCS`.
        learn: what to learn, each a kind or a pair (kind, name). Of bodies: `mass` (and inertia with it), `inertia`,
            `center_of_mass` (3). Of geoms, by their name or that of their body: `friction`, `torsional_friction`,
            `size` (each size of one geom, one factor of several; without its mass), `offset` (3). Of a `<pair>`:
            `pair_friction`. Of actuators: `gain`, of a servo its damping with it, and `servo_damping`. Of joints:
            `damping`, `frictionloss`, `armature`, `stiffness`. Besides, `compliance`. Without a name, or with "*", one
            factor is for all that have some.
        **options: those of `MujocoLCS`.

    Attributes:
        change: the parameters (n,).
        state: `MujocoState`.
        n_x, n_u, n_lam: sizes of the system.

    Raises:
        InvalidInputError and its kinds: an unknown kind or name, one twice, one without such a quantity, or an argument
            that `MujocoLCS` refuses.
    """

    def __init__(self, model: Any, data: Any = None, *, learn: Sequence[str | tuple[str, str]], **options: Any):
        super().__init__()
        first = MujocoLCS(model, data, **options)
        self._model, self.state = copy.copy(model), first.state
        self.n_x, self.n_u, self.n_lam = first.n_x, first.n_u, first.n_lam
        self._data = mujoco.MjData(model) if data is None else copy.copy(data)
        fixed = {"length": first.length, "caps": first._caps.count}
        self._options = {"compliance": first.compliance, **options, **fixed}
        if self._options.get("contacts") is None:  # the first has warned if these are too few
            self._options["contacts"] = first.n_contacts or None
        self._entries: list[_Entry] = []
        pairs = [(one, "*") if isinstance(one, str) else one for one in learn] if isinstance(learn, Sequence) else []
        known = all(isinstance(one, Sequence) and [*map(type, one)] == [str, str] for one in pairs)
        if not (pairs and known) or len(set(map(tuple, pairs))) < len(pairs) or isinstance(learn, str):
            raise InvalidInputError(
                f"learn: expected kinds or pairs (kind, name), each once, got {learn!r:.200}; name what is uncertain"
            )
        for kind, name in pairs:
            self._entries.append(self._entry(kind, name))
        self.change = nn.Parameter(torch.zeros(sum(e.count for e in self._entries), dtype=torch.float64))
        self._built: tuple[bytes, MujocoLCS] = self.change.detach().numpy().tobytes(), first

    def _entry(self, kind: str, name: str) -> _Entry:
        if kind not in _KINDS:
            raise InvalidInputError(
                f"learn: expected one of {', '.join(_KINDS)}, got {kind!r:.100}{did_you_mean(kind, _KINDS)}"
            )
        start, of = sum(e.count for e in self._entries), _KINDS[kind]
        if kind == "friction" and self._options.get("friction") is not None:
            raise InvalidInputError("learn: expected no friction=... where it is learned, got one; set that of geoms")
        if kind == "compliance":
            return _Entry(kind, name, [], start, 1)
        model, ids = self._model, list(range(getattr(self._model, _COUNTS[of.of])))
        if name != "*":
            kinds = (getattr(mujoco.mjtObj, f"mjOBJ_{what.upper()}") for what in (of.of, "body"))
            one, body = (mujoco.mj_name2id(model, what, name) for what in kinds)
            ids = [one] if one >= 0 else [g for g in ids if of.of == "geom" and model.geom_bodyid[g] == body]
        if of.fields[0][0].startswith("dof"):
            ids = [i for i in range(model.nv) if model.dof_jntid[i] in ids]
        if of.of == "actuator":  # whose force is linear in their numbers
            plain = np.isin(model.actuator_gaintype, GAINS) & np.isin(model.actuator_biastype, BIASES)
            ids = [i for i in ids if plain[i]]
        if kind == "size":
            ids = [i for i in ids if int(model.geom_type[i]) in _SIZED]
        ids = ids if of.offset else [i for i in ids if _columns(model, *of.fields[0])[i].any()]
        if not ids:
            raise InvalidInputError(
                f"learn: expected the name of a {of.of} with a {kind} to learn, got "
                f"{'a model that has none' if name == '*' else repr(name):.100}; see the names in the model's XML"
            )
        if kind == "center_of_mass" and model.body_simple[ids].any():
            raise InvalidInputError(
                f"learn: expected a body whose centre of mass may leave its frame, got {name!r:.100}, which MuJoCo has "
                f'compiled as a simple one; write <body simple="false"> in its MJCF'
            )
        sizes = np.count_nonzero(model.geom_size[ids[0]]) if kind == "size" and len(ids) == 1 else 1
        return _Entry(kind, name, ids, start, 3 if of.offset else int(sizes))

    @property
    def physics(self) -> MujocoLCS:
        """The physics as it is learned by now."""
        return self._build(to_numpy(fresh(self, ("change",)).change), keep=True)

    def mujoco_model(self) -> Any:
        """Return a copy of MuJoCo's model with what is learned, but for the compliance."""
        return self._changed(to_numpy(self.change))

    def observe(self, data: Any) -> Tensor:
        """See `MujocoLCS.observe`."""
        x, reference = self.physics.observe(data), self._data.qpos.copy()
        self._data = copy.copy(data)
        self._data.qpos[:] = reference  # where the median of the responses is taken
        return x

    def control(self, x: Tensor, u: Tensor) -> Tensor:
        """See `MujocoLCS.control`."""
        return self.physics.control(x, u)

    def action_bounds(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """See `MujocoLCS.action_bounds`; they carry no gradient."""
        return self.physics.action_bounds(x)

    def states_along(self, x: Tensor, u: Tensor) -> Tensor | None:
        """See `MujocoLCS.states_along`."""
        return self.physics.states_along(x, u)

    def context_along(self, x: Tensor, u: Tensor, context: Tensor | None = None) -> Tensor | None:
        """See `MujocoLCS.context_along`."""
        return self.physics.context_along(x, u, context)

    @runs_eagerly
    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """The system at states x (..., n_x), with nominal controls (..., nu) of a dynamic motion.

        Raises:
            InvalidInputError and its kinds: no state, or of another size.
        """
        if x is None:
            return self.physics.params(x, context)  # which says what is missing
        check_tensor("x", x, [("n_x", self.n_x)])
        change = fresh(self, ("change",)).change
        given = (change, x) if context is None else (change, x, check_tensor("context", context, [("n_u", self.n_u)]))
        return LCSParams(*solve(_Matrices(self, x.dtype, len(given)), *given))

    def slopes_along(self, weights: Sequence[Tensor], x: Tensor, context: Tensor | None = None) -> Tensor:
        """Compute the slopes (m, ..., n) of m weighted sums of the matrices by each parameter, at each state.

        `weights` has those of each matrix, (m, ...) and its size, in the order of `LCSParams`; the rest is as in
        `params`.
        """
        given = (self.change, x) if context is None else (self.change, x, context)
        matrices = _Matrices(self, x.dtype, len(given))
        matrices.solve(given, transformed=False)
        return matrices.slopes(given, 0, weights)

    def summary(self) -> dict[str, list[float]]:
        """Return what is learned: factors of the model's values, or offsets in its units of length."""
        change, found = self.change.detach().tolist(), {}
        for kind, name, _, start, count in self._entries:
            part = np.array(change[start : start + count])
            found[f"{kind} {name}"] = (self._options["length"] * part if _KINDS[kind].offset else np.exp(part)).tolist()
        return found

    def config(self) -> dict[str, Any]:
        """Return what is learned and from where, in JSON types."""
        guess = [[_columns(self._model, *f)[e.ids].tolist() for f in _KINDS[e.kind].fields] for e in self._entries]
        return {"learn": [[e.kind, e.name] for e in self._entries], "guess": guess, "nq": self.state.nq}

    def _changed(self, change: Array) -> Any:
        """Return a copy of the model with changed numbers."""
        model = copy.copy(self._model)
        for kind, name, ids, start, count in self._entries:
            part, of = change[start : start + count], _KINDS[kind]
            if not (np.abs(part) < _LARGEST).all():
                raise InvalidInputError(
                    f"change: expected logarithms of factors, and offsets, from -{_LARGEST} to {_LARGEST}, got "
                    f"{part.tolist()} of {kind} {name}; set them back, and learn in smaller steps"
                )
            for field, columns in of.fields:
                values = _columns(model, field, columns)
                if of.offset:
                    values[ids] += self._options["length"] * part
                else:
                    values[ids, : None if count == 1 else count] *= np.exp(part)
            if kind == "size":  # what is around them is at most that much larger
                model.geom_rbound[ids] *= np.exp(part).max()
                model.geom_aabb[ids, 3:] *= np.exp(part).max()
            if of.offset:  # MuJoCo need not compute frames that are the same
                model.geom_sameframe[:], model.site_sameframe[:] = 0, 0
                model.body_sameframe[ids if of.of == "body" else []] = 0
        if any(_KINDS[e.kind].of == "geom" for e in self._entries):  # the boxes of its tree are those of before
            model.opt.disableflags |= flags("MIDPHASE")
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def _build(self, change: Array, keep: bool = False) -> MujocoLCS:
        """Make the physics of some parameters; the last one that was kept is at hand."""
        key = change.tobytes()
        kept = self._built  # once: another thread may keep something else
        if kept[0] == key:
            return kept[1]
        model = self._changed(change)
        factors = {e.kind: float(np.exp(change[e.start])) for e in self._entries if e.kind == "compliance"}
        compliance = self._options["compliance"] * factors.get("compliance", 1.0)
        built = MujocoLCS(model, self._data, **{**self._options, "compliance": compliance})
        built.state = self.state
        if built._tries is not None:
            built._tries.asked = 1 << 62  # what actions do was tried with the first module
        built._servos.those = kept[1]._servos.those
        if keep:
            self._built = key, built
        return built


class _Matrices(Solver):
    """Parameters (n,), states (..., n_x) and perhaps nominal controls (..., nu) → the matrices of the systems."""

    name, differentiable, keeps = "LearnableMujocoLCS", len(SYSTEM), True

    def __init__(self, learnable: LearnableMujocoLCS, dtype: torch.dtype, inputs: int):
        self.learnable, self.dtype = learnable, dtype
        self.ranks = (1,) * inputs  # pyright: ignore[reportAttributeAccessIssue]

    def solve(self, tensors: Sequence[Tensor], transformed: bool) -> tuple[Tensor, ...]:
        """See `Solver`."""
        self.found = self._evaluate([v.detach().double().cpu() for v in tensors], keep=True)
        return tuple(value.to(tensors[1].device, self.dtype, copy=True) for value in self.found)

    def _evaluate(self, tensors: Sequence[Tensor], keep: bool = False) -> list[Tensor]:
        """Compute the matrices, each with all batch dimensions."""
        change, x, *context = tensors
        if change.ndim > 1:
            raise InvalidInputError("change: expected parameters that the batch shares, got some for each; use a loop")
        batch = broadcast_batch([("x", x.shape[:-1]), *(("context", v.shape[:-1]) for v in context)])
        physics = self.learnable._build(change.numpy(), keep)
        system = physics.params(x.expand(*batch, -1), *context)
        own = {name: len(dims) for name, dims in SYSTEM.items()}
        return [v.expand(*batch, *v.shape[v.ndim - own[name] :]) for name, v in system.tensors().items()]

    def pullback(
        self,
        tensors: Sequence[Tensor],
        outputs: Sequence[Tensor],
        grads: Sequence[Tensor | None],
        needs: Sequence[bool],
    ) -> list[Tensor | None]:
        """See `Solver`."""
        found: list[Tensor | None] = []
        for i, needed in enumerate(needs):
            slopes = self.slopes(tensors, i, grads) if needed and tensors[i].shape[-1] else None
            found.append(slopes if i or slopes is None else slopes.reshape(-1, slopes.shape[-1]).sum(0))
        return found

    def slopes(self, tensors: Sequence[Tensor], i: int, grads: Sequence[Tensor | None]) -> Tensor:
        """Compute the slopes of the matrices along `grads`, which may be several, by each number of input i."""
        plain = [v.detach().double().cpu() for v in tensors]
        upstream = [None if g is None else g.double().cpu() for g in grads]
        ranks = [len(dims) for dims in SYSTEM.values()]

        def moved(j: int, step: float) -> Tensor:
            """Compute how far a step of number j moves the matrices, along the gradient, for each state."""
            changed = list(plain)
            changed[i] = plain[i].clone()
            changed[i][..., j] += step
            pairs = zip(self._evaluate(changed), self.found, upstream, ranks, strict=True)
            return sum(((a - b) * g).flatten(g.ndim - r).sum(-1) for a, b, g, r in pairs if g is not None)  # pyright: ignore

        step = _STATE_STEP if i else _STEP
        return torch.stack([slope(moved(j, step), moved(j, -step)) / step for j in range(plain[i].shape[-1])], -1)


def slope(ahead: Tensor, behind: Tensor) -> Tensor:
    """The rate of a change by differences to both sides; where a contact comes or goes on one, that of the other."""
    behind = -behind
    smaller = torch.where(ahead.abs() < behind.abs(), ahead, behind)
    jump = (ahead - behind).abs() > 0.5 * torch.maximum(ahead.abs(), behind.abs())
    return torch.where(jump, smaller, 0.5 * (ahead + behind))


def _columns(model: Any, name: str, columns: slice) -> Array:
    """Return columns of a field of the model, to be changed in place."""
    values = getattr(model, name)
    return values.reshape(len(values), -1)[:, columns]
