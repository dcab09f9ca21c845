"""Draws push.gif, the animation of the README: the zoo's model of the cube pushes it to four goals.

`python docs/figures/animation.py`
"""

from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from difflcs import Animation, LCSModel
from difflcs.rl.tasks import get_task

PATH = Path(__file__).parent / "push.gif"
WIDTH, HEIGHT = 600, 450
FRAME_MILLISECONDS = 100  # a step of the environment: real time


def main() -> None:
    """Play one episode per goal."""
    task = get_task("cube")
    policy = task.make_policy(LCSModel.from_pretrained("trifinger-cube"))
    env = task.make_env(render_mode="rgb_array", width=WIDTH, height=HEIGHT).unwrapped
    frames: list[Image.Image] = []
    for seed, goal in enumerate(task.example_goals):
        observation, _ = env.reset(seed=seed, options={"goal": np.array(goal)})
        for _ in range(task.episode_steps):
            state, target = (torch.from_numpy(np.asarray(observation[key], np.float64)) for key in ("state", "goal"))
            with torch.no_grad():
                action = policy(state, target).action
            observation, _, _, _, info = env.step(action.numpy())
            views = [env.picture(), env.picture("top")]
            frame = Image.fromarray(np.concatenate(views, axis=1))
            ImageDraw.Draw(frame).text((12, 8), task.say(info), fill=(20, 20, 30), font_size=28)
            frames.append(frame)
        frames += [frames[-1]] * 5
    Animation(frames, 1000 / FRAME_MILLISECONDS, colors=256).save(PATH)
    print(f"{PATH.name}: {PATH.stat().st_size / 1000:.0f} kB, {len(frames)} frames")


if __name__ == "__main__":
    main()
