"""Linear complementarity systems: a record of matrices, and the learnable model."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, NamedTuple, get_type_hints

import torch
from torch import Tensor, nn

from difflcs import _files, _zoo
from difflcs._checks import (
    broadcast_batch,
    check_choice,
    check_number,
    check_positive_int,
    check_same_device,
    check_tensor,
    describe,
)
from difflcs._linalg import matvec
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError, NotPositiveDefiniteError, ShapeError
from difflcs.lcp import solve_lcp

_DTYPES = {"float32": torch.float32, "float64": torch.float64}


def dimensions(record: type) -> dict[str, tuple[str, ...]]:
    """The fields of a record that are tensors, each with the kinds of its trailing dimensions, as annotated there."""
    hints = get_type_hints(record, include_extras=True)
    return {f.name: hints[f.name].__metadata__ for f in fields(record) if hasattr(hints[f.name], "__metadata__")}


@dataclass(frozen=True)
class SystemMatrices:
    """Sizes and equations of whatever holds the matrices of an LCS, shared or one per batch element."""

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
        """A x + B u + C λ + d, (..., n_x)."""
        return matvec(self.A, x) + matvec(self.B, u) + matvec(self.C, lam) + self.d

    def gap(self, x: Tensor, u: Tensor, lam: Tensor | None = None) -> Tensor:
        """D x + E u + c, plus F λ if given, (..., n_lam)."""
        gap = matvec(self.D, x) + matvec(self.E, u) + self.c
        return gap if lam is None else gap + matvec(self.F, lam)


@dataclass(frozen=True)
class LCSParams(SystemMatrices):
    """The matrices of one linear complementarity system, or of one per batch element (Eq. lcs of the paper).

    x₊ = A x + B u + C λ + d,  0 ≤ λ ⊥ D x + E u + F λ + c ≥ 0,  with F + Fᵀ ≻ 0, so that λ is unique.

    Every field may carry leading batch dimensions, or none to be shared by the batch.

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
        NotPositiveDefiniteError: F + Fᵀ is not positive definite; the message gives its smallest eigenvalue.
    """

    def __post_init__(self) -> None:
        for f in fields(self):
            check_tensor(f.name, getattr(self, f.name))
        for name, dims in SYSTEM.items():
            if getattr(self, name).ndim < 2 and len(dims) == 2:
                raise ShapeError(f"{name}: expected a matrix (..., rows, columns), got {describe(getattr(self, name))}")
        for name, dims in SYSTEM.items():
            check_tensor(name, getattr(self, name), [(dim, getattr(self, dim)) for dim in dims], finite=False)
        check_same_device([(f.name, getattr(self, f.name)) for f in fields(self)])
        for f in fields(self):
            if getattr(self, f.name).dtype != self.A.dtype:
                raise DTypeError(
                    f"{f.name}: expected {self.A.dtype} like A, got {describe(getattr(self, f.name))}; "
                    f"convert it with {f.name}.to({self.A.dtype})"
                )
        self.batch_shape  # noqa: B018  raises where the batch dimensions do not fit each other
        check_positive_definite(self.F)

    @property
    def batch_shape(self) -> torch.Size:
        """Leading batch dimensions; empty when every field is shared."""
        return broadcast_batch(
            (name, getattr(self, name).shape[: getattr(self, name).ndim - len(dims)]) for name, dims in SYSTEM.items()
        )

    def tensors(self) -> dict[str, Tensor]:
        """Name → tensor, in the order of the fields."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def detach(self) -> LCSParams:
        """The same numbers without gradient history."""
        return replace(self, **{k: v.detach() for k, v in self.tensors().items()})


# Name → kinds of its dimensions, in the order of every list of these matrices.
SYSTEM = dimensions(SystemMatrices)


def check_positive_definite(F: Tensor) -> None:
    """Refuse F whose symmetric part F + Fᵀ is not positive definite."""
    symmetric = F.detach().double().cpu()
    symmetric = symmetric + symmetric.mT
    if int(torch.linalg.cholesky_ex(symmetric).info.abs().max() if symmetric.numel() else 0) == 0:
        return
    smallest = torch.linalg.eigvalsh(symmetric)[..., 0]
    where = "" if F.ndim == 2 else f" at batch index {int(smallest.argmin())}"
    raise NotPositiveDefiniteError(
        f"F: expected F + Fᵀ positive definite, got smallest eigenvalue {float(smallest.min()):.3e}{where}; "
        f"add to the diagonal of F (LCSModel does it by `stiffness`)"
    )


class LCSPrediction(NamedTuple):
    """One step of an LCS: the next state (..., n_x) and the complementarity variable (..., n_lam)."""

    x_next: Tensor
    lam: Tensor


class LCSModel(nn.Module):
    """A learnable linear complementarity system (Eq. lcs), F = G Gᵀ + stiffness·I + H − Hᵀ.

    The parametrisation keeps F + Fᵀ ⪰ 2·stiffness·I for any G and H, so that the LCP always has one solution.

    Args:
        n_x: number of states.
        n_u: number of actions.
        n_lam: number of complementarity variables (contacts).
        stiffness: lower bound on the symmetric part of F, > 0.
        init_scale: parameters are drawn uniformly from ±init_scale; c starts at zero.
        learn_c: whether c is learned. The paper's experiments keep it at zero (`False`).
        generator: random generator of the initial parameters; torch's default one if None.
        dtype: float64 (default) or float32.

    Raises:
        InvalidInputError, DTypeError: a size below 1, a stiffness that is not positive, another dtype.
    """

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
    ):
        super().__init__()
        self.n_x = check_positive_int("n_x", n_x)
        self.n_u = check_positive_int("n_u", n_u)
        self.n_lam = check_positive_int("n_lam", n_lam)
        self.stiffness = check_number("stiffness", stiffness, strict=True)
        check_number("init_scale", init_scale)
        if dtype not in (torch.float32, torch.float64):
            raise DTypeError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")
        for name, shape in self._shapes(self.n_x, self.n_u, self.n_lam).items():
            draw = torch.rand(shape, generator=generator, dtype=torch.float64)
            value = torch.zeros(shape) if name == "c" else init_scale * (2 * draw - 1)
            self.register_parameter(name, nn.Parameter(value.to(dtype)))
        self.c.requires_grad_(learn_c)

    A: nn.Parameter
    B: nn.Parameter
    C: nn.Parameter
    d: nn.Parameter
    D: nn.Parameter
    E: nn.Parameter
    G: nn.Parameter
    H: nn.Parameter
    c: nn.Parameter

    @staticmethod
    def _shapes(x: int, u: int, m: int) -> dict[str, tuple[int, ...]]:
        sizes = {"n_x": x, "n_u": u, "n_lam": m}
        dims = {**SYSTEM, "G": SYSTEM["F"], "H": SYSTEM["F"]}
        return {name: tuple(sizes[dim] for dim in dims[name]) for name in LCSModel.parameter_names}

    def extra_repr(self) -> str:
        """What print(model) shows."""
        return f"n_x={self.n_x}, n_u={self.n_u}, n_lam={self.n_lam}, stiffness={self.stiffness:g}"

    @property
    def F(self) -> Tensor:
        """G Gᵀ + stiffness·I + H − Hᵀ, (n_lam, n_lam), differentiable."""
        eye = torch.eye(self.n_lam, dtype=self.G.dtype, device=self.G.device)
        return self.G @ self.G.mT + self.stiffness * eye + self.H - self.H.mT

    def params(self) -> LCSParams:
        """The system's matrices, differentiable with respect to the parameters."""
        return LCSParams(self.A, self.B, self.C, self.d, self.D, self.E, self.F, self.c)

    def forward(self, x: Tensor, u: Tensor) -> LCSPrediction:
        """Predict one step through the exact LCP.

        Args:
            x: (..., n_x) states.
            u: (..., n_u) actions; batch dimensions broadcast with those of x.

        Returns:
            x_next (..., n_x) and lam (..., n_lam), differentiable in x, u and every parameter.
        """
        self.check_inputs(x=x, u=u)
        params = self.params()
        gap = params.gap(x, u)
        lam = solve_lcp(params.F, gap).lam
        return LCSPrediction(params.next_state(x, u, lam), lam)

    def rollout(self, x0: Tensor, u_seq: Tensor) -> Tensor:
        """Predict a trajectory.

        Args:
            x0: (..., n_x) initial states.
            u_seq: (..., T, n_u) actions, T ≥ 0.

        Returns:
            (..., T+1, n_x) states, x0 first.
        """
        check_tensor("u_seq", u_seq, [("n_u", self.n_u)])
        if u_seq.ndim < 2:
            raise ShapeError(f"u_seq: expected shape (..., T, n_u={self.n_u}), got {tuple(u_seq.shape)}")
        self.check_inputs(x=x0)
        batch = broadcast_batch([("x0", x0.shape[:-1]), ("u_seq", u_seq.shape[:-2])])
        states = [x0.expand(*batch, self.n_x)]
        for t in range(u_seq.shape[-2]):
            states.append(self(states[-1], u_seq[..., t, :]).x_next)
        return torch.stack(states, dim=-2)

    def check_inputs(self, **tensors: Tensor) -> None:
        """Check states `x…` and actions `u…` against the model's sizes, dtype-class and device."""
        for name, tensor in tensors.items():
            check_tensor(name, tensor, [("n_u", self.n_u)] if name.startswith("u") else [("n_x", self.n_x)])
            if tensor.dtype != self.A.dtype:
                raise DTypeError(
                    f"{name}: expected {self.A.dtype} like the model, got {describe(tensor)}; "
                    f"convert it with {name}.to({self.A.dtype}) or the model with model.to({tensor.dtype})"
                )
        check_same_device([("model", self.A), *tensors.items()])

    @classmethod
    def from_params(cls, params: LCSParams, stiffness: float | None = None) -> LCSModel:
        """A learnable model that starts at given matrices.

        Args:
            params: one system, without batch dimensions.
            stiffness: the model's stiffness; by default half the smallest eigenvalue of (F + Fᵀ)/2. A larger one than
                that eigenvalue cannot represent F and is refused.

        Returns:
            A model whose `params()` equal the given ones up to rounding.
        """
        if len(params.batch_shape):
            raise ShapeError(f"params: expected no batch dimensions, got {tuple(params.batch_shape)}; index one system")
        params = params.detach()
        symmetric = 0.5 * (params.F + params.F.mT).double()
        smallest = float(torch.linalg.eigvalsh(symmetric)[0])
        if stiffness is None:
            stiffness = 0.5 * smallest
        check_number("stiffness", stiffness, strict=True)
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
        """What is needed besides the parameters to build the model again (JSON types only)."""
        return {
            "n_x": self.n_x,
            "n_u": self.n_u,
            "n_lam": self.n_lam,
            "stiffness": self.stiffness,
            "learn_c": self.c.requires_grad,
            "dtype": str(self.A.dtype).removeprefix("torch."),
        }

    @classmethod
    def from_config(cls, config: Mapping[str, object], tensors: Mapping[str, Tensor], source: str) -> LCSModel:
        """Build a model from `config()` and a state dict; `source` names them in the error messages."""
        wanted = {"n_x", "n_u", "n_lam", "stiffness", "learn_c", "dtype"}
        if set(config) != wanted:
            raise CheckpointError(
                f"{source}: expected the fields {sorted(wanted)} of an LCSModel, got {_files.short(sorted(config))}; "
                f"was it written by LCSModel.save_pretrained?"
            )
        try:
            dtype = _DTYPES[check_choice("dtype", config["dtype"], tuple(_DTYPES))]
            n_x, n_u, n_lam = (check_positive_int(k, config[k]) for k in ("n_x", "n_u", "n_lam"))
            stiffness = check_number("stiffness", config["stiffness"], strict=True)
            if not isinstance(config["learn_c"], bool):
                raise DTypeError(
                    f"learn_c: expected true or false, got {describe(config['learn_c'])}; save the model again"
                )
        except InvalidInputError as error:
            raise CheckpointError(f"{source}: its configuration cannot be used: {error}") from error
        wanted_shapes = cls._shapes(n_x, n_u, n_lam)  # compared before anything of these sizes is made
        shapes = {k: tuple(v.shape) for k, v in tensors.items()}
        if shapes != wanted_shapes:
            raise CheckpointError(
                f"{source}: expected tensors {wanted_shapes}, got {shapes}; the file is foreign or corrupt"
            )
        for name, tensor in tensors.items():
            if tensor.dtype != dtype or not bool(torch.isfinite(tensor).all()):
                raise CheckpointError(f"{source}: expected finite {dtype} values in {name}, got {describe(tensor)}")
        model = cls(n_x, n_u, n_lam, stiffness, learn_c=config["learn_c"], dtype=dtype)
        model.load_state_dict(dict(tensors))
        return model

    def save_pretrained(self, directory: str | os.PathLike[str]) -> None:
        """Write `model.safetensors` and `config.json` into a directory, atomically (created if needed)."""
        _files.save_record(Path(directory), "LCSModel", self.config(), self.state_dict())

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str]) -> LCSModel:
        """Read a model that ships with the package, or what `save_pretrained` wrote.

        Args:
            source: a directory, or a name that `difflcs zoo` lists, such as "trifinger-cube". A path that exists wins
                over a name; "zoo:trifinger-cube" is the name in any case.

        Raises:
            CheckpointError: files are missing, corrupt or of another kind, or no model has this name; nothing is
                changed.
        """
        directory = _zoo.resolve(source)
        config, tensors = _files.load_record(directory, "LCSModel")
        return cls.from_config(config, tensors, str(directory))
