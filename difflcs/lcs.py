"""Learnable linear complementarity system. The records of its matrices are in `difflcs.records`."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self, TypeGuard

import torch
from torch import Tensor, nn

from difflcs import _checks, _storage
from difflcs._differentiation import runs_eagerly, transforms_active
from difflcs._linalg import product
from difflcs._modules import fresh, plain_state, untouched
from difflcs._recall import Recall, snapshot
from difflcs.constraints import check_bounds
from difflcs.errors import BoundsError, CheckpointError, DTypeError, InvalidInputError, ShapeError
from difflcs.records import SYSTEM, LCSParams, LCSPrediction, advance, check_inputs

_DTYPES = {"float32": torch.float32, "float64": torch.float64}


class PredictiveModule(nn.Module):
    """A module of an LCS that predicts steps and trajectories of it; subclasses have sizes and `params`."""

    n_x: int
    n_u: int
    n_lam: int
    params: Callable[..., Any]

    @runs_eagerly
    @_checks.takes_arrays
    def forward(self, x: Tensor, u: Tensor) -> LCSPrediction:
        """Predict one step through the exact LCP.

        Args:
            x: (..., n_x) states.
            u: (..., n_u) actions; batch dimensions broadcast with those of x.

        Returns:
            x_next (..., n_x) and lam (..., n_lam), differentiable in x, u and every parameter.
        """
        self.check_inputs(x=x, u=u)
        _checks.broadcast_batch([("x", x.shape[:-1]), ("u", u.shape[:-1])])
        return advance(self.params(x), x, u)

    @runs_eagerly
    @_checks.takes_arrays
    def rollout(self, x0: Tensor, u_seq: Tensor) -> Tensor:
        """Predict a trajectory.

        Args:
            x0: (..., n_x) initial states.
            u_seq: (..., T, n_u) actions, T ≥ 0.

        Returns:
            (..., T+1, n_x) states, x0 first.
        """
        _checks.check_shape("u_seq", u_seq, "... T n_u", {"n_u": self.n_u}, "add a dimension of steps")
        self.check_inputs(x0=x0, u_seq=u_seq)
        batch = _checks.broadcast_batch([("x0", x0.shape[:-1]), ("u_seq", u_seq.shape[:-2])])
        states = [x0.expand(*batch, self.n_x)]
        for t in range(u_seq.shape[-2]):
            states.append(self(states[-1], u_seq[..., t, :]).x_next)
        return torch.stack(states, dim=-2)

    def _constants(self) -> dict[str, object]:
        """Return the numbers that make the system together with the parameters; a `state_dict` remembers them."""
        return {}

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if hasattr(destination, "_metadata"):  # torch's place for what is no tensor, such as versions
            destination._metadata[prefix[:-1]]["constants"] = self._constants()

    def _load_from_state_dict(self, state_dict: Any, prefix: str, local_metadata: Any, *others: Any) -> None:
        super()._load_from_state_dict(state_dict, prefix, local_metadata, *others)
        own, saved, errors = self._constants(), local_metadata.get("constants", {}), others[-1]
        errors += [
            f"{prefix}{name}: expected {own[name]} like this {type(self).__name__}, got {saved[name]} of the one that "
            f"was saved; build it with the same, or load dict(state), which has parameters alone"
            for name in own
            if saved.get(name, own[name]) != own[name]
        ]

    def check_inputs(self, **tensors: Tensor) -> None:
        """Check states `x…` and actions `u…` against the model's sizes, dtype-class and device."""
        check_inputs(self.n_x, self.n_u, next(self.parameters()), tensors, owner="model")


class LCSModel(PredictiveModule):
    """A learnable linear complementarity system (Eq. 1 of the paper), F = G Gᵀ + stiffness·I + H − Hᵀ.

    The parametrisation keeps F + Fᵀ ⪰ 2·stiffness·I for any G and H, so that the LCP always has one solution.

    Args:
        n_x: number of states.
        n_u: number of actions.
        n_lam: number of complementarity variables (contacts); 0 for a linear system.
        stiffness: lower bound on the symmetric part of F, > 0.
        init_scale: parameters are drawn uniformly from ±init_scale; c starts at zero.
        learn_c: True if c is learned. The paper's experiments keep it at zero (`False`).
        generator: random generator of the initial parameters; torch's default one if None.
        dtype: float64 (default) or float32.
        action_support: (2, n_u) lower and upper bounds of the actions that the model was fitted to, if
            known: an `LCSMPCLayer` plans within them. A buffer, saved with the model; set it to None to plan without.

    Raises:
        InvalidInputError, DTypeError: a size that is too small, a stiffness that is not positive, another dtype.
        ShapeError, NonFiniteError, BoundsError: an invalid action support.
    """

    kind = "LCSModel"
    """What a file of it says that it is."""
    parameter_names = ("A", "B", "C", "d", "D", "E", "G", "H", "c")

    def __init__(
        self,
        n_x: int,
        n_u: int,
        n_lam: int,
        stiffness: float = 0.1,
        *,
        init_scale: float = 1e-3,
        learn_c: bool = True,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float64,
        action_support: Tensor | None = None,
    ):
        super().__init__()
        self.n_x = _checks.check_positive_int("n_x", n_x)
        self.n_u = _checks.check_positive_int("n_u", n_u)
        self.n_lam = _checks.check_positive_int("n_lam", n_lam, minimum=0)
        self.stiffness = _checks.check_number("stiffness", stiffness, strict=True)
        init_scale = _checks.check_number("init_scale", init_scale)
        _checks.check_kind("generator", generator, (torch.Generator, type(None)), "torch.Generator().manual_seed(0)")
        if dtype not in (torch.float32, torch.float64):
            raise DTypeError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")
        for name, shape in self._shapes(self.n_x, self.n_u, self.n_lam).items():
            draw = torch.rand(shape, generator=generator, dtype=torch.float64)
            value = torch.zeros(shape) if name == "c" else init_scale * (2 * draw - 1)
            self.register_parameter(name, nn.Parameter(value.to(dtype)))
        self.c.requires_grad_(_checks.check_kind("learn_c", learn_c, bool))
        if action_support is not None:
            support = _checks.check_shape("action_support", action_support, f"2 {self.n_u}")
            check_bounds(support[0], support[1])
            action_support = support.detach().to(dtype, copy=True)
        self.register_buffer("action_support", action_support)
        self._made: Recall[tuple[float, Tensor]] = Recall()

    A: nn.Parameter
    B: nn.Parameter
    C: nn.Parameter
    d: nn.Parameter
    D: nn.Parameter
    E: nn.Parameter
    G: nn.Parameter
    H: nn.Parameter
    c: nn.Parameter
    action_support: Tensor | None

    @staticmethod
    def _shapes(x: int, u: int, m: int) -> dict[str, tuple[int, ...]]:
        sizes = {"n_x": x, "n_u": u, "n_lam": m}
        dims = {**SYSTEM, "G": SYSTEM["F"], "H": SYSTEM["F"]}
        return {name: tuple(sizes[dim] for dim in dims[name]) for name in LCSModel.parameter_names}

    def extra_repr(self) -> str:
        """Return the text that print(model) shows."""
        return f"n_x={self.n_x}, n_u={self.n_u}, n_lam={self.n_lam}, stiffness={self.stiffness:g}"

    def _constants(self) -> dict[str, object]:
        return {"stiffness": self.stiffness}

    @property
    @runs_eagerly
    def F(self) -> Tensor:
        """G Gᵀ + stiffness·I + H − Hᵀ, (n_lam, n_lam), differentiable."""
        if self._forward_pre_hooks:
            fresh(self, self.parameter_names)
        G, H = self.G, self.H  # once: a parametrisation may compute another one each time
        eye = torch.eye(self.n_lam, dtype=G.dtype, device=G.device)
        return product(G, G.mT) + self.stiffness * eye + H - H.mT

    @runs_eagerly
    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """Return the system's matrices, differentiable in the parameters; the same for all x and contexts."""
        if self._forward_pre_hooks:
            fresh(self, self.parameter_names)
        parameters: dict[str, Tensor] = self._parameters  # pyright: ignore[reportAssignmentType]
        if tuple(parameters) != self.parameter_names:  # attributes, one by one, would take 5 µs
            parameters = {name: getattr(self, name) for name in self.parameter_names}
        # Without gradient a robot needs one system again and again: it is made and checked once.
        recalls = type(self).F is LCSModel.F and not torch.is_grad_enabled() and not transforms_active()
        tensors = tuple(parameters.values())
        kept = self._made.value(tensors) if recalls else None
        if kept is not None and kept[0] == self.stiffness:
            F = kept[1].clone()
            return LCSParams.of_checked({name: F if name == "F" else parameters[name] for name in SYSTEM})
        before = snapshot(tensors) if recalls else None
        params = LCSParams(**{name: self.F if name == "F" else parameters[name] for name in SYSTEM})
        if recalls:
            self._made.keep((self.stiffness, params.F.clone()), before)
        return params

    @classmethod
    def from_params(cls, params: LCSParams, stiffness: float | None = None) -> LCSModel:
        """Make a learnable model that starts at the matrices of a system.

        Args:
            params: one system, without batch dimensions.
            stiffness: the model's stiffness; by default half the smallest eigenvalue of (F + Fᵀ)/2, or 0.1 without
                contacts. A larger one than that eigenvalue cannot represent F and is refused.

        Returns:
            A model whose `params()` equal `params` up to rounding.
        """
        _checks.check_kind("params", params, LCSParams)
        if len(params.batch_shape):
            raise ShapeError(f"params: expected no batch dimensions, got {tuple(params.batch_shape)}; index one system")
        params = params.detach()
        symmetric = 0.5 * (params.F + params.F.mT).double()
        smallest = float(torch.linalg.eigvalsh(symmetric)[0]) if params.n_lam else float("inf")
        if stiffness is None:
            stiffness = 0.5 * smallest if params.n_lam else 0.1
        stiffness = _checks.check_number("stiffness", stiffness, strict=True)
        if stiffness >= smallest:
            raise InvalidInputError(
                f"stiffness: expected less than the smallest eigenvalue {smallest:.3e} of (F + Fᵀ)/2, got {stiffness:g}"
            )
        model = cls(params.n_x, params.n_u, params.n_lam, stiffness, dtype=params.A.dtype).to(params.A.device)
        G = torch.linalg.cholesky(
            symmetric - stiffness * torch.eye(params.n_lam, dtype=torch.float64, device=symmetric.device)
        )
        H = torch.triu(0.5 * (params.F - params.F.mT), diagonal=1)
        values = {**params.tensors(), "G": G, "H": H}
        with torch.no_grad():
            for name in cls.parameter_names:
                getattr(model, name).copy_(values[name])
        return model

    def config(self) -> dict[str, object]:
        """Return the constructor's arguments to build the model again, without the parameters (JSON types only)."""
        with torch.enable_grad():
            fresh(self, self.parameter_names)
            learn_c = self.c.requires_grad
        return {
            "n_x": self.n_x,
            "n_u": self.n_u,
            "n_lam": self.n_lam,
            "stiffness": self.stiffness,
            "learn_c": learn_c,
            "dtype": str(self.A.dtype).removeprefix("torch."),
        }

    @classmethod
    def from_config(cls, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str) -> Self:
        """Build a model from `config()` and a state dict; `source` names them in the error messages."""
        wanted = {"n_x", "n_u", "n_lam", "stiffness", "learn_c", "dtype"}
        if set(config) != wanted:
            raise CheckpointError(
                f"{source}: expected the fields {sorted(wanted)} of an LCSModel, got {_storage.short(sorted(config))}; "
                f"was it written by LCSModel.save_pretrained?"
            )
        try:
            dtype = _DTYPES[_checks.check_choice("dtype", config["dtype"], tuple(_DTYPES))]
            n_x, n_u = (_checks.check_positive_int(k, config[k]) for k in ("n_x", "n_u"))
            n_lam = _checks.check_positive_int("n_lam", config["n_lam"], minimum=0)
            stiffness = _checks.check_number("stiffness", config["stiffness"], strict=True)
            learn_c = _checks.check_kind("learn_c", config["learn_c"], bool, "save the model again")
        except InvalidInputError as error:
            raise CheckpointError(f"{source}: its configuration cannot be used: {error}") from error
        shapes = cls._shapes(n_x, n_u, n_lam)  # compared before anything of these sizes is made
        if "action_support" in tensors:
            shapes["action_support"] = (2, n_u)
        _storage.check_tensors(source, "a model", tensors, {name: (shape, dtype) for name, shape in shapes.items()})
        support = tensors.get("action_support")
        try:
            with torch.random.fork_rng(devices=[]):  # for initial values, which are replaced
                model = cls(n_x, n_u, n_lam, stiffness, learn_c=learn_c, dtype=dtype, action_support=support)
            model.load_state_dict(dict(tensors))
        except BoundsError as error:
            raise CheckpointError(f"{source}: its action support cannot be used: {error}") from error
        except RuntimeError as error:
            raise CheckpointError(
                f"{source}: expected a class with plain parameters, got {cls.__name__}: {error}; use LCSModel"
            ) from error
        return model

    def save_pretrained(self, directory: str | os.PathLike[str]) -> None:
        """Write `model.safetensors` and `config.json` into a directory, atomically; what is there is replaced.

        For a model that `torch.nn.utils` has parametrised, pruned or normalised, the resulting matrices are written.

        Raises:
            InvalidInputError: the directory cannot be made or written.
            NonFiniteError: a matrix has NaN or infinity; what is there stays.
        """
        _checks.check_finite(plain_state(self))
        with _storage.place_to_write(Path(directory), "directory"):
            _storage.save_record(Path(directory), self.kind, self.config(), plain_state(self))

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str]) -> Self:
        """Read a model that ships with the package, or one that `save_pretrained` wrote.

        Args:
            source: a directory, or a name that `difflcs zoo` lists, such as "trifinger-cube". A path that exists wins
                over a name; "zoo:trifinger-cube" is the name in any case.

        Raises:
            CheckpointError: files are missing, corrupt or of another kind, or no model has this name; nothing is
                changed.
        """
        from difflcs import zoo  # handles files only, and few users need it

        directory = zoo.resolve(source)
        config, tensors = _storage.load_record(directory, cls.kind)
        return cls.from_config(config, tensors, str(directory))


def is_plain(lcs: object) -> TypeGuard[LCSModel]:
    """Return True if the matrices of an LCS are the parameters of an `LCSModel`, and may be read without `params`."""
    return type(lcs) is LCSModel and untouched(lcs)
