"""Tensors of modules whose parameters the tools of `torch.nn.utils` have replaced.

`parametrize` makes a property of a parameter: it is enough to read tensors by their names. `prune`, and `weight_norm`
and `spectral_norm` of old, keep an attribute in the place of a parameter. A hook computes it whenever the module is
called, so code that uses another method of a module has to run the hooks first.
"""

from collections.abc import Collection
from typing import Any, TypeVar

from torch import Tensor, nn
from torch.nn.utils.spectral_norm import SpectralNorm
from torch.nn.utils.weight_norm import WeightNorm

from difflcs.errors import InvalidInputError

M = TypeVar("M")


def untouched(module: nn.Module) -> bool:
    """Return whether the tensors of a module are its parameters and buffers as they are."""
    return "parametrizations" not in module._modules and Tensor not in map(type, vars(module).values())


def fresh(module: M, names: Collection[str] = ()) -> M:
    """Run the hooks of `torch.nn.utils` in a module and its parts, and return it; anything else is returned as it is.

    Args:
        module: the module, or any other object.
        names: names of its tensors. No other hook may compute one, as it may expect arguments.

    Raises:
        InvalidInputError: another hook stands before `forward`, and an attribute in the place of one of these tensors.
    """
    for part in module.modules() if isinstance(module, nn.Module) else ():
        if part._forward_pre_hooks:
            for hook in _hooks(part):
                hook(part, ())
            if len(_hooks(part)) < len(part._forward_pre_hooks) and not vars(part).keys().isdisjoint(names):
                raise InvalidInputError(
                    f"{type(part).__name__}: expected parameters, got a forward_pre_hook and attributes in the place "
                    f"of {sorted(vars(part).keys() & names)}, which only a call of the module would compute; use "
                    f"torch.nn.utils.parametrize"
                )
    return module


def plain_state(module: nn.Module) -> dict[str, Tensor]:
    """Make the state dict that a module would have if its tensors were parameters, for a new one of its class."""
    state = fresh(module).state_dict()
    for path, part in module.named_modules():
        at = f"{path}." if path else ""
        hooked = [getattr(hook, "name", None) or hook._tensor_name for hook in _hooks(part)]
        parts = {f"{at}{name}_{end}" for name in hooked for end in ("orig", "mask", "g", "v", "u")}
        state = {k: v for k, v in state.items() if k not in parts and not k.startswith(f"{at}parametrizations.")}
        parametrised: Any = part._modules.get("parametrizations") or ()
        made = [*hooked, *parametrised]
        state |= {at + name: getattr(part, name).detach() for name in made}
    return state


def _hooks(module: nn.Module) -> list[Any]:
    """List the hooks by which torch computes a tensor before each call."""
    if not module._forward_pre_hooks:
        return []
    from torch.nn.utils.prune import BasePruningMethod

    kinds = (BasePruningMethod, SpectralNorm, WeightNorm)
    return [hook for hook in module._forward_pre_hooks.values() if isinstance(hook, kinds)]
