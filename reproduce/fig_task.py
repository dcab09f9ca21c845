"""The task: the TriFinger with cube and goal, and steps 1, 5, 8, 13, 17, 20 of a trajectory of an LCS-RL model.

`python reproduce/fig_task.py` takes the newest LCS-RL model of the cube that the other scripts have trained, or that of
`--run RUN`; `--rerun --preset smoke|quick|paper` trains one.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import records
import report
import torch
import units
from matplotlib.figure import Figure
from runs import command_line, run
from units import Unit

from difflcs.errors import InvalidInputError
from difflcs.rl.checkpoint import RunDirectory
from difflcs.rl.evaluate import EVALUATION_STREAM
from difflcs.rl.rollout import Policy, episode_seeds, mpc_actions
from difflcs.rl.training import load_policy, stored_config

STEPS = (1, 5, 8, 13, 17, 20)
"""Those that the paper shows."""
SIZE = (1280, 960)
"""Width and height of the pictures [pixel]."""
TRIES = 20
"""Goals tried until one needs a real push and is reached."""
LEAST_WAY, LEAST_TURN = 0.04, 0.2
"""[m] and [rad] by which the cube has to move in the trajectory that is shown."""


@dataclass(frozen=True)
class DrawTask(report.Draw):
    """Options of the script."""

    run: Path | None = None
    """Run directory of `difflcs train --task cube` whose model to take."""


def find_run(options: DrawTask) -> Path:
    """The run whose model is shown: the one asked for, or of the finished LCS-RL units on the cube the newest.

    Raises:
        InvalidInputError: there is none.
    """
    if options.run is not None:
        task = stored_config(RunDirectory.open(options.run)).task
        if task != "cube":
            raise InvalidInputError(f"run: expected a run of the cube, got one of {task}; pass another")
        return options.run
    wanted = asdict(Unit("cube", "lcs-rl", "ours", 0)) | {"seed": "*"}
    found = {
        path.parent / "run": records.read(path)
        for path in options.work.glob("-".join((*map(str, wanted.values()), "*/result.csv")))
    }
    if not found:
        raise InvalidInputError(
            f"{options.work}: expected an LCS-RL model of the cube, found none; pass --run RUN, a directory of "
            f"`difflcs train --task cube --method lcs-rl --minutes 30`, or train one with: python "
            f"reproduce/fig_task.py --rerun --preset quick"
        )
    return max(found, key=lambda run: (found[run]["at"].max(), found[run].finished.max()))  # the most data, the newest


def trajectory(policy: Policy) -> tuple[np.ndarray, dict[int, np.ndarray], bool]:
    """One noise-free episode to an evaluation goal, with pictures.

    Returns:
        The scene at the start from the front; the `STEPS` from above; whether the goal was reached. It is the first
        goal that is far enough away and reached, or the last one tried.
    """
    from difflcs_envs.trifinger.rendering import SceneRenderer

    env = units.make_env("cube", width=SIZE[0], height=SIZE[1])
    renderer, scene, pictures, reached = SceneRenderer(env.model, *SIZE), np.zeros(0), {}, False
    try:
        for seed in episode_seeds(0, EVALUATION_STREAM, 0, TRIES):
            observation, _ = env.reset(seed=seed)
            goal, state = observation["goal"], observation["state"]
            far = np.hypot(*(goal[:2] - state[:2])) > LEAST_WAY and abs(goal[2] - state[2]) > LEAST_TURN
            if reached or not far:
                continue
            scene, pictures = renderer.render(env.data, "front"), {}
            act = mpc_actions(policy)
            for step in range(1, STEPS[-1] + 1):
                action, _ = act(torch.from_numpy(state[None].copy()), torch.from_numpy(goal[None].copy()))
                observation, _, _, _, info = env.step(action[0])
                state, reached = observation["state"], bool(info["success"])
                if step in STEPS:
                    pictures[step] = renderer.render(env.data, "top")
    finally:
        renderer.close()
        env.close()
    return scene, pictures, reached


def draw(options: DrawTask) -> int:
    """Train if asked for, then write the figure; returns the exit code."""
    one = replace(options, seeds=1, methods=("lcs-rl",), recipes=("ours",))
    code = run(one, ["curves"]) if options.rerun else 0
    path = find_run(options)
    scene, pictures, reached = trajectory(load_policy(RunDirectory.open(path)))
    figure = Figure((11.0, 4.4), dpi=150, layout="constrained")
    left, right = cast(Any, figure.subfigures(1, 2, width_ratios=(1.15, 1.0)))
    axes = left.subplots()
    axes.imshow(scene)
    axes.set_title("(a) the task: push the cube to the transparent pose", fontsize=10)
    axes.axis("off")
    right.suptitle(f"(b) a trajectory of LCS-RL, goal {'reached' if reached else 'missed'}", fontsize=10)
    for part, (step, picture) in zip(right.subplots(2, 3).flat, pictures.items(), strict=True):
        side = int(0.65 * min(picture.shape[:2]))  # the rest is empty table
        top, start = ((size - side) // 2 for size in picture.shape[:2])
        part.imshow(picture[top : top + side, start : start + side])
        part.set_title(f"step {step}", fontsize=9)
        part.axis("off")
    report.write_figure(figure, options.results, "fig_task")
    print(f"model: {path}; goal {'reached' if reached else 'missed'}")
    return code


if __name__ == "__main__":
    sys.exit(command_line(DrawTask, draw))
