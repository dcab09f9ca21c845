"""The task: the TriFinger with cube and goal, and steps 1, 5, 8, 13, 17, 20 of a trajectory of an LCS-RL model.

`python reproduce/fig_task.py` takes the model of the zoo, or that of `--run RUN`; `--rerun --preset smoke|quick|paper`
trains one as the other scripts do, or takes the one that they have trained.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import records
import report
import torch
from matplotlib.figure import Figure
from runs import command_line, run

from difflcs.errors import InvalidInputError
from difflcs.rl import TrainedPolicy, get_task
from difflcs.rl.rollout import Policy, mpc_actions
from difflcs.rl.seeding import Stream, episode_seeds

STEPS = (1, 5, 8, 13, 17, 20)
"""Steps that the paper shows."""
SIZE = (1280, 960)
"""Width and height of the pictures [pixel]."""
TRIES, LEAST_WAY, LEAST_TURN = 20, 0.04, 0.2
"""Goals tried until one is so far away [m], [rad] and reached."""


@dataclass(frozen=True)
class DrawTask(report.Draw):
    """Options of the script."""

    run: Path = Path("zoo:trifinger-cube")
    """Run directory of `difflcs train --task cube` whose model to take, or zoo:NAME."""


def newest(work: Path) -> Path:
    """Find the finished LCS-RL unit on the cube with the most data, then the newest."""
    finished = {path.parent / "run": records.read(path) for path in work.glob("cube-lcs-rl-ours-*/result.csv")}
    if not finished:
        raise InvalidInputError(f"{work}: expected an LCS-RL model of the cube, found none; drop --rerun")
    return max(finished, key=lambda run: (finished[run]["at"].max(), finished[run].finished.max()))


def trajectory(policy: Policy) -> tuple[np.ndarray, dict[int, np.ndarray], bool]:
    """Run a noise-free episode; return the scene at its start, `STEPS` from above, and whether the goal was reached.

    It is to the first evaluation goal that is far enough away and reached, or the last one tried.
    """
    from difflcs_envs.rendering import SceneRenderer

    env: Any = get_task("cube").make_env(width=SIZE[0], height=SIZE[1]).unwrapped
    renderer, scene, pictures, reached = SceneRenderer(env.model, *SIZE), np.zeros(0), {}, False
    try:
        for seed in episode_seeds(0, Stream.EVALUATION, 0, TRIES):
            observation, _ = env.reset(seed=seed)
            goal, state = observation["goal"], observation["state"]
            far = np.hypot(*(goal[:2] - state[:2])) > LEAST_WAY and abs(goal[2] - state[2]) > LEAST_TURN
            if reached or not far:
                continue
            scene, pictures, act = renderer.render(env.data, "front"), {}, mpc_actions(policy)
            for step in range(1, STEPS[-1] + 1):
                action, _ = act(*(torch.tensor(value, dtype=torch.float64)[None] for value in (state, goal)))
                observation, _, _, _, info = env.step(action[0])
                state, reached = observation["state"], bool(info["success"])
                if step in STEPS:
                    pictures[step] = renderer.render(env.data, "top")
    finally:
        renderer.close()
        env.close()
    return scene, pictures, reached


def draw(options: DrawTask) -> int:
    """Train if asked for, then write the figure; return the exit code."""
    code = run(replace(options, seeds=1, methods=("lcs-rl",), recipes=("ours",)), ["curves"]) if options.rerun else 0
    learned = TrainedPolicy.open(newest(options.work) if options.rerun else options.run)
    if learned.task != "cube":
        raise InvalidInputError(f"run: expected a model of the cube, got one of {learned.task}; pass another")
    scene, pictures, reached = trajectory(learned.policy)
    outcome = f"goal {'reached' if reached else 'missed'}"
    figure = Figure((11.0, 4.4), dpi=150, layout="constrained")
    left, right = cast(Any, figure.subfigures(1, 2, width_ratios=(1.15, 1.0)))
    right.suptitle(f"(b) a trajectory of LCS-RL, {outcome}", fontsize=10)
    side = int(0.65 * min(SIZE))  # the rest is empty table
    top, start = ((size - side) // 2 for size in reversed(SIZE))
    shown = [(left.subplots(), "(a) the task: push the cube to the transparent pose", scene)]
    for axes, (step, picture) in zip(right.subplots(2, 3).flat, pictures.items(), strict=True):
        shown.append((axes, f"step {step}", picture[top : top + side, start : start + side]))
    for axes, title, picture in shown:
        axes.imshow(picture)
        axes.set_title(title, fontsize=10 if picture is scene else 9)
        axes.axis("off")
    preset = (options.preset or "quick") if options.rerun else "paper"
    report.write_figure(figure, options.results, "fig_task" + f"-{preset}" * (preset != "paper"))
    print(f"model: {learned.name}; {outcome}")
    return code


if __name__ == "__main__":
    sys.exit(command_line(DrawTask, draw))
