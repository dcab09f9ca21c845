"""Base of modules that hold the tensors of a problem, each constant over the horizon or one per stage."""

from collections.abc import Collection, Iterable

import torch
from torch import Tensor, nn

from difflcs._checks import check_tensor, describe, describe_shapes
from difflcs._differentiation import is_wrapped
from difflcs._modules import fresh
from difflcs.errors import DTypeError, InvalidInputError, NonFiniteError, ShapeError


def register(module: nn.Module, name: str, value: Tensor | None, persistent: bool = True) -> None:
    """Register a tensor of a module: an nn.Parameter as parameter, any other as buffer."""
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    else:
        module.register_buffer(name, value, persistent=persistent)


class TensorFields(nn.Module):
    """A module whose tensors are registered by kind: nn.Parameter as parameter, any other tensor as buffer.

    Attributes:
        by_stage: names of the fields that have a dimension of stages in front; the others hold at all stages.
    """

    by_stage: frozenset[str] = frozenset()

    def _held(self, names: Iterable[str]) -> dict[str, Tensor]:
        """Return some fields by their names; faster than one attribute after the other."""
        if self._forward_pre_hooks:
            fresh(self, tuple(names))
        held = {**self._buffers, **self._parameters}
        return {name: held[name] if name in held else getattr(self, name) for name in names}  # pyright: ignore

    def extra_repr(self) -> str:
        names = [*dict(self.named_parameters(recurse=False)), *dict(self.named_buffers(recurse=False))]
        return describe_shapes({name: getattr(self, name) for name in names})


def check_by_stage(by_stage: Collection[str], names: Iterable[str], present: Iterable[str]) -> frozenset[str]:
    """Return which of the present fields have a dimension of stages."""
    names = tuple(names)
    if isinstance(by_stage, str) or not isinstance(by_stage, Collection):
        raise DTypeError(f"by_stage: expected a tuple of names like {names[:2]}, got {describe(by_stage)}; add a comma")
    for name in by_stage:
        if name not in names:
            raise InvalidInputError(f"by_stage: expected some of {', '.join(names)}, got {describe(name)}; omit it")
    staged = frozenset(by_stage) & frozenset(present)
    if not staged:
        raise InvalidInputError(
            f"by_stage: expected at least one field by stage, got none of {', '.join(names)}; use the class without "
            f"stages for what is constant"
        )
    return staged


def check_stages(values: dict[str, tuple[Tensor, int, int]]) -> int:
    """Return the horizon that fields by stage agree on.

    Args:
        values: name → tensor, number of its dimensions after the stages, and of its stages beyond H.
    """
    horizon, first = 0, ""
    for name, (value, rank, extra) in values.items():
        if value.ndim <= rank:
            raise ShapeError(
                f"{name}: expected a dimension of stages before its last {rank}, got {describe(value)}; say by "
                f"by_stage which fields have one"
            )
        stages = value.shape[-1 - rank] - extra
        if stages < 1:
            raise ShapeError(
                f"{name}: expected at least {1 + extra} stages, got {stages + extra} in {describe(value)}; give one "
                f"per stage"
            )
        if first and stages != horizon:
            raise ShapeError(
                f"{name}: expected {horizon + extra} stages, for a horizon of {horizon} like {first}, got "
                f"{stages + extra} in {describe(value)}; give as many for each field"
            )
        horizon, first = stages, first or name
    return horizon


def check_not_nan(name: str, value: object, dims: Iterable[tuple[str, int]] = ()) -> Tensor:
    """Check a tensor as `check_tensor` does, but allow infinity."""
    tensor = check_tensor(name, value, list(dims), finite=False)
    if not is_wrapped(tensor) and bool(torch.isnan(tensor.detach()).any()):
        raise NonFiniteError(
            f"{name}: expected numbers or infinity, got {int(torch.isnan(tensor).sum())} NaN of {tensor.numel()}; find "
            f"where they come from before solving"
        )
    return tensor
