"""Draws push.gif, the animation of the README: the zoo's model of the cube pushes it to four goals.

`python docs/figures/animation.py`
"""

from pathlib import Path

import gymnasium
import numpy as np
import torch
from PIL import Image, ImageDraw

import difflcs_envs
from difflcs import LCSModel
from difflcs.rl import get_task

PATH = Path(__file__).parent / "push.gif"
GOALS = [(0.04, 0.03, 0.3), (-0.04, 0.03, -0.3), (0.0, -0.05, 0.4), (0.05, -0.02, 0.0)]  # x [m], y [m], yaw [rad]
WIDTH, HEIGHT = 300, 225
FRAME_MILLISECONDS = 100  # a step of the environment: real time


def main() -> None:
    """Play one episode per goal."""
    difflcs_envs.register_envs()
    task = get_task("cube")
    policy = task.make_policy(LCSModel.from_pretrained("trifinger-cube"))
    env = gymnasium.make(task.env_id, render_mode="rgb_array", width=WIDTH, height=HEIGHT).unwrapped
    frames: list[Image.Image] = []
    for seed, goal in enumerate(GOALS):
        observation, _ = env.reset(seed=seed, options={"goal": np.array(goal)})
        for _ in range(task.episode_steps):
            state, target = (torch.from_numpy(np.asarray(observation[key], np.float64)) for key in ("state", "goal"))
            with torch.no_grad():
                action = policy(state, target).action
            observation, _, _, _, info = env.step(action.numpy())
            views = [env.picture(), env.picture("top")]
            frame = Image.fromarray(np.concatenate(views, axis=1))
            text = f"off by {1000 * info['position_error']:.0f} mm, {info['yaw_error']:.2f} rad"
            ImageDraw.Draw(frame).text((6, 4), text, fill=(20, 20, 30), font_size=14)
            frames.append(frame)
        frames += [frames[-1]] * 5
    palette = frames[0].quantize(64, dither=Image.Dither.NONE)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    small[0].save(PATH, save_all=True, append_images=small[1:], duration=FRAME_MILLISECONDS, loop=0, optimize=True)
    print(f"{PATH.name}: {PATH.stat().st_size / 1000:.0f} kB, {len(frames)} frames")


if __name__ == "__main__":
    main()
