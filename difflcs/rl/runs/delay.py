"""Actions that come late, as on a robot whose planning takes time; and planning from where it will be by then."""

from collections import deque
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from difflcs._checks import check_positive_int, describe
from difflcs.errors import DTypeError
from difflcs.records import LCSModule, LCSParams, system_at
from difflcs.rl.rollout import Act

Predict = Callable[..., Tensor]
"""States (B, n_x), actions (B, n_u) → states one step later. A context, where there is one, is the third argument."""


def make_predictor(model: LCSModule | LCSParams) -> Predict:
    """Make a function that predicts one step of an LCS through its exact LCP, without gradient."""

    def predict(state: Tensor, action: Tensor, context: Tensor | None = None) -> Tensor:
        with torch.no_grad():
            system = model if isinstance(model, LCSParams) else system_at(model, state, context)
            if not isinstance(system, LCSParams):
                raise DTypeError(f"model: expected a system for one step, LCSParams, got {describe(system)}")
            return system.step(state, action).x_next

    return predict


def delay_actions(act: Act, n_u: int, steps: int = 1, predict: Predict | None = None) -> Act:
    """Make a policy whose actions are executed some steps late. Until the first plan is there, the action is zero.

    For one call of `difflcs.rl.rollout.collect`.

    Args:
        act: plans from states.
        n_u: size of an action.
        steps: by how many steps an action is late; 0: it is not.
        predict: brings a state forward by the actions that are under way, so that the plan begins where it will be
            executed. None: it begins at the state as observed.
    """
    steps = check_positive_int("steps", steps, minimum=0)
    under_way: deque[np.ndarray] = deque()

    def late(state: Tensor, goal: Tensor, *context: Tensor) -> tuple[np.ndarray, np.ndarray]:
        if not under_way:
            under_way.extend([np.zeros((len(state), n_u))] * steps)
        if predict is not None:
            for action in under_way:
                state = predict(state, torch.from_numpy(action), *context)
        planned, failed = act(state, goal, *context)
        under_way.append(planned)
        return under_way.popleft(), failed

    return late
