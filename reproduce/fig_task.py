"""The task: the TriFinger with cube and goal, and steps 1, 5, 8, 13, 17, 20 of a trajectory of an LCS-RL model.

`python reproduce/fig_task.py` takes the newest LCS-RL model of the cube that the other scripts have trained, or that of
`--run RUN`; `--rerun --preset smoke|quick|paper` trains one.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import report
import runs
import torch
import worker
from runs import command_line
from units import Unit

from difflcs import LCSModel
from difflcs.errors import InvalidInputError
from difflcs.rl.checkpoint import RunDirectory
from difflcs.rl.evaluate import EVALUATION_STREAM
from difflcs.rl.rollout import Policy, episode_seeds, mpc_actions
from difflcs.rl.tasks import get_task
from difflcs.rl.training import load_policy, stored_config

if TYPE_CHECKING:
    from difflcs_envs.trifinger.env import TriFingerEnv

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


def find_policy(options: DrawTask) -> tuple[Policy, str]:
    """The policy to show, and where its model comes from.

    The only place that decides which model is taken.

    Raises:
        InvalidInputError: there is none.
    """
    if options.run is not None:
        directory = RunDirectory.open(options.run)
        task = stored_config(directory).task
        if task != "cube":
            raise InvalidInputError(f"run: expected a run of the cube, got one of {task}; pass another")
        return load_policy(directory), str(options.run)
    record = _newest(options.work)
    if record is None:
        raise InvalidInputError(
            f"{options.work}: expected an LCS-RL model of the cube, found none; pass --run RUN, a directory of "
            f"`difflcs train --task cube --method lcs-rl --minutes 30`, or train one with: python "
            f"reproduce/fig_task.py --rerun --preset quick"
        )
    with tempfile.TemporaryDirectory() as folder:
        worker.write_files(Path(folder), record["model"])
        model = LCSModel.from_pretrained(folder)
    return get_task("cube").make_policy(model), f"{Unit(**record['unit'])} ({options.work / record['key']})"


def _newest(work: Path) -> dict[str, Any] | None:
    """Of the finished LCS-RL units on the cube the one with the most data, then the newest."""
    found, wanted = [], asdict(Unit("cube", "lcs-rl", "ours", 0))
    for path in work.glob("*/record.json"):
        record = worker.finished_record(path.parent, path.parent.name)
        if record is not None and {**record["unit"], "seed": 0} == wanted:
            found.append(record)
    return max(found, key=lambda record: (record["config"]["minutes"], record["finished"]), default=None)


def trajectory(env: TriFingerEnv, policy: Policy) -> tuple[np.ndarray, dict[int, np.ndarray], bool]:
    """One noise-free episode to an evaluation goal, with pictures.

    Returns:
        The scene at the start from the front; the `STEPS` from above; whether the goal was reached. It is the first
        goal that is far enough away and reached, or the last one tried.
    """
    from difflcs_envs.trifinger.rendering import SceneRenderer

    scene, pictures, reached = np.zeros(0), {}, False
    renderer = SceneRenderer(env.model, *SIZE)
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
    return scene, pictures, reached


def draw(options: DrawTask) -> int:
    """Train if asked for, then write the figure; returns the exit code."""
    import gymnasium

    import difflcs_envs

    code = 0
    if options.rerun:
        one = replace(options, seeds=1, methods=("lcs-rl",), recipes=("ours",))
        code = runs.run(one, ["curves"])
    policy, origin = find_policy(options)
    difflcs_envs.register_envs()
    task = get_task("cube")
    made = gymnasium.make(task.env_id, width=SIZE[0], height=SIZE[1], **dict(task.env_kwargs))
    env: TriFingerEnv = made.unwrapped  # pyright: ignore[reportAssignmentType]
    try:
        scene, pictures, reached = trajectory(env, policy)
    finally:
        made.close()
    figure = report.new_figure(11.0, 4.4)
    left, right = cast(Any, figure.subfigures(1, 2, width_ratios=(1.15, 1.0)))
    axes = left.subplots()
    axes.imshow(scene)
    axes.set_title("(a) the task: push the cube to the transparent pose", fontsize=10)
    axes.axis("off")
    right.suptitle(f"(b) a trajectory of LCS-RL, {'goal reached' if reached else 'goal missed'}", fontsize=10)
    for part, (step, picture) in zip(right.subplots(2, 3).flat, pictures.items(), strict=True):
        side = int(0.65 * min(picture.shape[:2]))  # the rest is empty table
        top, start = ((size - side) // 2 for size in picture.shape[:2])
        part.imshow(picture[top : top + side, start : start + side])
        part.set_title(f"step {step}", fontsize=9)
        part.axis("off")
    report.write_figure(figure, options.results, "fig_task")
    print(f"model: {origin}; goal {'reached' if reached else 'missed'}")
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return command_line(DrawTask, draw, arguments)


if __name__ == "__main__":
    sys.exit(main())
