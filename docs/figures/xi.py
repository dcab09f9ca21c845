"""Draws xi.png: what is learned by the violation loss with different ξ, on three systems in units of `suggest_scales`.

`python docs/figures/xi.py`. For each system, seeds 0 to 4 (of data and start), each ξ, and one that falls from 10 to
0.001 in the course of the training: 800 transitions in 40 episodes, 1000 steps of Adam. The error is that of
`fit_report` on 20 other episodes. Prints the medians.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from difflcs import LCSModel, LCSParams, Transitions, fit_report, suggest_scales, violation_loss
from difflcs.systems import block_along_wall, cart_pole_between_walls

WEIGHTS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
FALLING = "10 to 0.001"
SEEDS, STEPS = 5, 1000


def block_between_fingers() -> LCSParams:
    """A block on a line between two fingers, as on docs/own_system.md."""
    rows = {
        "A": np.eye(3), "B": [[0, 0], [1, 0], [0, 1]], "C": [[1, -1], [0, 0], [0, 0]], "d": [0, 0, 0],
        "D": [[1, -1, 0], [-1, 0, 1]], "E": [[-1, 0], [0, 1]], "F": [[1.1, -1], [-1, 1.1]], "c": [0, 0],
    }  # fmt: skip
    return LCSParams(**{name: torch.tensor(value, dtype=torch.float64) for name, value in rows.items()})


# Name, system, spread of starts, spread of actions.
CASES = (
    ("block between two fingers", block_between_fingers(), (0.02, 0.05, 0.05), 0.04),
    ("cart-pole between walls", cart_pole_between_walls(), (0.05, 0.15, 0.2, 0.3), 3.0),
    ("block along a wall", block_along_wall(), (0.05, 0.02, 0.05, 0.02), 0.03),
)


def episodes(system: LCSParams, starts: tuple[float, ...], actions: float, count: int, seed: int) -> Transitions:
    """Play episodes of 20 steps with random actions."""
    random = np.random.default_rng(seed)
    x = random.normal(size=(count, system.n_x)) * starts
    u = torch.as_tensor(actions * random.normal(size=(count, 20, system.n_u)))
    return Transitions.from_episodes(system.rollout(torch.as_tensor(x), u), u)


def learn(data: Transitions, n_lam: int, xi: float | str, seed: int):
    """Fit a model from a random start and return it in the units of the data."""
    scales = suggest_scales(*data)
    normal = scales.normalise(*data)
    generator = torch.Generator().manual_seed(seed)
    model = LCSModel(data.x.shape[1], data.u.shape[1], n_lam, init_scale=0.3, generator=generator)
    adam = torch.optim.Adam(model.parameters(), 3e-2)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(adam, STEPS)
    for step in range(STEPS):
        weight = 10.0 * 1e-4 ** min(1.0, step / (0.8 * STEPS)) if isinstance(xi, str) else xi
        adam.zero_grad()
        violation_loss(model, *normal, gamma="auto", xi=weight).backward()
        adam.step()
        decay.step()
    return scales.params(model.params().detach())


def main() -> None:
    """Learn, print and draw."""
    torch.set_num_threads(1)
    plt.rcParams["font.size"] = 12  # legible on a phone
    figure, axes = plt.subplots(3, 1, figsize=(7, 8), layout="constrained", sharex=True)
    for axis, (title, system, starts, actions) in zip(axes, CASES, strict=True):
        found = {xi: [] for xi in (*WEIGHTS, FALLING)}
        for seed in range(SEEDS):
            data, unseen = (episodes(system, starts, actions, n, seed + k) for n, k in ((40, 0), (20, 1000)))
            for xi, errors in found.items():
                report = fit_report(learn(data, system.n_lam, xi, seed), *unseen, train=data, horizon=1)
                errors.append(float(report.error.square().mean().sqrt()))
            linear = float(report.linear.square().mean().sqrt())
        print(
            title,
            {xi: f"{np.median(v):.3f} ({min(v):.3f} to {max(v):.3f})" for xi, v in found.items()},
            linear,
            flush=True,
        )
        places = np.arange(len(found))
        for place, errors in zip(places, found.values(), strict=True):
            axis.plot([place] * SEEDS, errors, "o", color="tab:blue", alpha=0.4, ms=5)
        axis.plot(places, [np.median(v) for v in found.values()], "_", color="tab:blue", ms=16, mew=2)
        axis.axhline(linear, color="tab:orange", label="affine, no contacts")
        labels = [f"{xi:g}" if isinstance(xi, float) else "falling" for xi in found]
        axis.set(title=title, ylabel="error of a step", yscale="log")
        axis.set_xticks(places, labels)
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.yaxis.set_minor_formatter(NullFormatter())
    axes[-1].set_xlabel("ξ")
    axes[0].legend(frameon=False)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=150)


if __name__ == "__main__":
    main()
