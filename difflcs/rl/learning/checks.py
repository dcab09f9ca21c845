"""Checks that a module can be trained: a `torch.nn.Module` with parameters that require gradients."""

from typing import Any

from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from difflcs._checks import describe
from difflcs.errors import DTypeError, InvalidInputError
from difflcs.records import LCSModule, LCSParams, LCSSequence
from difflcs.rl.rollout import check_env


def check_module(lcs: object, env: VectorEnv | None = None, name: str = "lcs") -> nn.Module:
    """Raise unless the system can be learned and has the sizes of the environment, if one is passed.

    Args:
        lcs: the system.
        env: with observations Dict(state, goal).
        name: of the argument, for the message.

    Returns:
        The same object.

    Raises:
        DTypeError: no `torch.nn.Module`, or no `LCSModule`.
        InvalidInputError: it is fixed, has no parameter that requires a gradient, or other sizes than the environment.
    """
    if isinstance(lcs, LCSParams | LCSSequence):
        raise InvalidInputError(
            f"{name}: expected a model that can be learned, got fixed {type(lcs).__name__}; use an LCSModel, or an "
            f"LCSModule of your own"
        )
    if not isinstance(lcs, nn.Module) or not isinstance(lcs, LCSModule):
        raise DTypeError(
            f"{name}: expected a torch.nn.Module with n_x, n_u, n_lam and params(x, context), got {describe(lcs)}; see "
            f"difflcs.LCSModule"
        )
    if not any(p.requires_grad for p in lcs.parameters()):
        count = len(list(lcs.parameters()))
        raise InvalidInputError(
            f"{name}: expected a parameter that requires a gradient in {type(lcs).__name__}, got {count} parameters "
            f"and none of that kind; make what is to be learned a torch.nn.Parameter"
        )
    if env is not None:
        spaces: tuple[Any, Any] = (check_env(env).single_observation_space, env.single_action_space)
        wanted, got = (spaces[0]["state"].shape[0], spaces[1].shape[0]), (lcs.n_x, lcs.n_u)
        if got != wanted:
            raise InvalidInputError(
                f"{name}: expected n_x={wanted[0]}, n_u={wanted[1]} like the states and actions of the environment, "
                f"got n_x={got[0]}, n_u={got[1]} of {type(lcs).__name__}; build it for this environment"
            )
    return lcs


def check_learned(learned: object, env: VectorEnv | None = None, name: str = "actor") -> nn.Module:
    """Raise unless the model behind a policy can be trained: a system, see `check_module`, or any network."""
    if isinstance(learned, nn.Module) and not isinstance(learned, LCSModule):
        return learned
    return check_module(learned, env, name)


def check_depends(loss: Tensor) -> None:
    """Raise unless the loss depends on a parameter; torch's own message would speak of a grad_fn."""
    if not loss.requires_grad:
        raise InvalidInputError(
            "lcs: expected a system that depends on the module's parameters, got one without gradient; compute it in "
            "params(x, context) without torch.no_grad(), detach() and .data"
        )
