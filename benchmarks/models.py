"""Problems the benchmarks solve: synthetic pushing models, random models and untrained ones."""

from __future__ import annotations

import torch

from difflcs import LCSModel, LCSParams
from difflcs.bench import ACTION_LIMIT, pushing_model, states_and_goals

__all__ = ["ACTION_LIMIT", "MODELS", "pushing_model", "random_model", "states_and_goals", "untrained_model"]


def random_model(n_lam: int, seed: int) -> LCSParams:
    """An `LCSModel` with parameters of size 0.3: no structure at all."""
    generator = torch.Generator().manual_seed(seed)
    return LCSModel(9, 6, n_lam, init_scale=0.3, generator=generator).params().detach()


def untrained_model(n_lam: int, seed: int) -> LCSParams:
    """An `LCSModel` as training starts with it: parameters of size 1e-3."""
    generator = torch.Generator().manual_seed(seed)
    return LCSModel(9, 6, n_lam, generator=generator).params().detach()


MODELS = {"pushing": pushing_model, "random": random_model, "untrained": untrained_model}
