"""Draws zoo/NAME.png: steps of an episode of every LCS-RL model of the zoo. `python docs/figures/zoo.py`.

Objects are scanned meshes only where these are installed (`difflcs assets download` or DIFFLCS_YCB_DIR).
"""

from pathlib import Path

import gymnasium
import numpy as np
import torch
from PIL import Image, ImageDraw

from difflcs import LCSModel, LCSMPCLayer, zoo
from difflcs.rl import get_task

FOLDER = Path(__file__).parent / "zoo"
STEPS = (0, 3, 7, 20)


def frames(name: str, task_name: str) -> list[np.ndarray]:
    """Pictures from above at some steps of an episode."""
    task = get_task(task_name)
    mpc = LCSMPCLayer(
        LCSModel.from_pretrained(name), task.make_cost(), task.horizon, u_min=task.u_min, u_max=task.u_max
    )
    make = gymnasium.make(task.env, render_mode="rgb_array", width=300, height=240, **task.env_kwargs)
    env, pictures = make.unwrapped, []
    observation, _ = env.reset(seed=0, options={"goal": task.example_goals[0]})
    for step in range(task.episode_steps + 1):
        if step in STEPS:
            image = Image.fromarray(env.picture("top"))
            text = f"{step * task.step_seconds:.1f} s"
            ImageDraw.Draw(image).text((6, 4), text, fill=(20, 20, 30), font_size=15)
            pictures.append(np.asarray(image))
        if step < task.episode_steps:
            x, goal = (torch.from_numpy(observation[key]) for key in ("state", "goal"))
            with torch.no_grad():
                observation = env.step(mpc(x, goal).action.numpy())[0]
    make.close()
    return pictures


def main() -> None:
    """Draw all."""
    FOLDER.mkdir(exist_ok=True)
    for name in zoo.names():
        card = zoo.card(name)
        if card.method != "lcs-rl":
            continue
        image = Image.fromarray(np.concatenate(frames(name, card.task), axis=1))
        path = FOLDER / f"{name}.png"
        image.quantize(96, dither=Image.Dither.NONE).save(path, optimize=True)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
