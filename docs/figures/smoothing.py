"""Draws smoothing.png: what a larger relaxation and the barrier do to an action and its gradient.

`python docs/figures/smoothing.py`. The system is a finger that pushes a block along a line, n_x 2, n_u 1, n_lam 1:
finger₊ = finger + u, block₊ = block + λ, 0 ≤ λ ⊥ block − finger − u + λ ≥ 0.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import torch

from difflcs import GoalCost, LCSMPCLayer, LCSParams
from difflcs.mpc.backends import BatchedBackend


def tensor(rows: list) -> torch.Tensor:
    """A float64 tensor."""
    return torch.tensor(rows, dtype=torch.float64)


# State (block, finger).
SYSTEM = LCSParams(
    A=tensor([[1, 0], [0, 1]]),
    B=tensor([[0], [1]]),
    C=tensor([[1], [0]]),
    d=tensor([0, 0]),
    D=tensor([[1, -1]]),
    E=tensor([[-1]]),
    F=tensor([[1]]),
    c=tensor([0]),
)
COST = GoalCost.reach(2, 1, goal_weight=(1.0,), input_weight=0.05)
VARIANTS = {
    "exact: relaxation 1e-6": {"relaxation": 1e-6},
    "relaxation 1e-3": {"relaxation": 1e-3},
    "relaxation 1e-6, barrier 1e-3": {"relaxation": 1e-6, "barrier": 1e-3},
    "relaxation 1e-3, barrier 1e-3": {"relaxation": 1e-3, "barrier": 1e-3},
}


def main() -> None:
    """Draw."""
    goal = torch.linspace(0.0, 0.4, 400, dtype=torch.float64).unsqueeze(-1)
    x0 = tensor([[0.0, -0.05]])
    plt.rcParams["font.size"] = 12  # legible on a phone
    figure, axes = plt.subplots(2, 1, figsize=(7, 6), sharex=True, layout="constrained")
    for label, options in VARIANTS.items():
        mpc = LCSMPCLayer(
            SYSTEM, COST, horizon=4, u_min=-0.15, u_max=0.15, backend=BatchedBackend(restarts=16), **options
        )
        leaf = goal.clone().requires_grad_()
        plan = mpc(x0, leaf)
        plan.action.sum().backward()
        axes[0].plot(goal, plan.action.detach(), label=label)
        axes[1].plot(goal, leaf.grad)
    axes[0].axhline(0.15, color="0.7", lw=0.8, zorder=0)
    axes[0].set_ylabel("first action")
    axes[0].legend(frameon=False)
    axes[1].set_ylabel("its derivative by the goal")
    axes[1].set_xlabel("goal of the block (block at 0, finger at −0.05, |u| ≤ 0.15)")
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    path = Path(__file__).with_suffix(".png")
    figure.savefig(path, dpi=150)
    print(f"written to {path.name}")


if __name__ == "__main__":
    main()
