"""Problems the benchmarks solve: synthetic pushing models, random models and untrained ones."""

from __future__ import annotations

import torch
from torch import Tensor

from difflcs import LCSModel, LCSParams

ACTION_LIMIT = 0.015  # [m]


def pushing_model(n_lam: int, seed: int) -> LCSParams:
    """Fingertips that move as told and push an object they touch: n_x 9, n_u 6, random contact directions."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    A = torch.eye(9, dtype=torch.float64) + 0.02 * normal(9, 9)
    B = 0.05 * normal(9, 6)
    B[3:] += torch.eye(6, dtype=torch.float64)
    G, H = 0.5 * normal(n_lam, n_lam), 0.3 * normal(n_lam, n_lam)
    F = G @ G.mT + 0.3 * torch.eye(n_lam, dtype=torch.float64) + H - H.mT
    C, D, E = 0.3 * normal(9, n_lam), normal(n_lam, 9), 2 * normal(n_lam, 6)
    return LCSParams(A, B, C, 0.001 * normal(9), D, E, F, 0.02 * normal(n_lam))


def random_model(n_lam: int, seed: int) -> LCSParams:
    """An `LCSModel` with parameters of size 0.3: no structure at all."""
    generator = torch.Generator().manual_seed(seed)
    return LCSModel(9, 6, n_lam, init_scale=0.3, generator=generator).params().detach()


def untrained_model(n_lam: int, seed: int) -> LCSParams:
    """An `LCSModel` as training starts with it: parameters of size 1e-3."""
    generator = torch.Generator().manual_seed(seed)
    return LCSModel(9, 6, n_lam, generator=generator).params().detach()


MODELS = {"pushing": pushing_model, "random": random_model, "untrained": untrained_model}


def states_and_goals(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """States (count, 9) of a hand around an object near the origin, and goals (count, 3) of the paper's task space."""
    generator = torch.Generator().manual_seed(seed)
    angles = torch.deg2rad(torch.tensor([90.0, -30.0, 210.0], dtype=torch.float64))
    home = 0.08 * torch.stack([angles.cos(), angles.sin()], 1).reshape(1, 6)
    state = torch.cat([torch.zeros(1, 3, dtype=torch.float64), home], 1).expand(count, 9)
    noise = 2 * torch.rand(count, 9, generator=generator, dtype=torch.float64) - 1
    size = torch.tensor([0.05, 0.05, 0.3] + [0.03] * 6, dtype=torch.float64)
    goal = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    return state + size * noise, goal * torch.tensor([0.06, 0.06, 0.5], dtype=torch.float64)
