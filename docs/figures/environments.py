"""Draws cube.png, push.png and objects.png: the environments. `python docs/figures/environments.py`.

Stand-ins are drawn even where YCB meshes are installed, so that the pictures are the same on every machine.
"""

from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image, ImageDraw

import difflcs_envs
from difflcs_envs.ycb import YCB

FOLDER = Path(__file__).parent
GOAL = [0.04, 0.03, 0.4]  # x [m], y [m], yaw [rad]
WIDTH, HEIGHT = 640, 480


def make(env_id: str, **arguments):
    """An environment to be drawn, just reset."""
    env = gymnasium.make(
        env_id, render_mode="rgb_array", width=WIDTH, height=HEIGHT, reset_noise=0.0, **arguments
    ).unwrapped
    high = env.task.goal_high
    env.reset(seed=0, options={"goal": np.minimum(GOAL, high)})
    return env


def views(env) -> np.ndarray:
    """The scene from the front and from above, side by side."""
    return np.concatenate([env.picture(), env.picture("top")], axis=1)


def push_in(state: np.ndarray, finger: int) -> np.ndarray:
    """All fingers move towards the object, one of them further than the others."""
    arms = state[3:].reshape(3, 2) - state[:2]
    action = -0.015 * arms / np.linalg.norm(arms, axis=1, keepdims=True)
    action[np.arange(3) != finger] *= 0.3
    return action.ravel()


def labelled(picture: np.ndarray, text: str) -> np.ndarray:
    """A picture with a word in its corner."""
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((12, 8), text, fill=(20, 20, 30), font_size=28)
    return np.asarray(image)


def save(name: str, rows: list[np.ndarray]) -> None:
    """Write pictures one below the other."""
    path = FOLDER / name
    Image.fromarray(np.concatenate(rows)).save(path, optimize=True)
    print(f"{name}: {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Draw all."""
    difflcs_envs.register_envs()
    env = make("difflcs/TriFingerMoveCube-v0")
    save("cube.png", [views(env)])
    state = env.reset(seed=0, options={"goal": GOAL})[0]["state"]
    frames = [labelled(env.render(), "0")]
    for step in range(1, 11):
        state = env.step(push_in(state, finger=2))[0]["state"]
        if step % 2 == 0:
            frames.append(labelled(env.render(), str(step)))
    save("push.png", [np.concatenate(frames[i : i + 3], axis=1) for i in (0, 3)])
    env.close()

    tiles = []
    for name in YCB:
        env = make("difflcs/TriFingerMoveObject-v0", object=name, object_source="stand_in")
        tiles.append(labelled(env.render(), name.replace("_", " ")))
        env.close()
    env = make("difflcs/TriFingerTurnCube-v0")
    tiles.append(labelled(env.render(), "turn cube"))
    env.close()
    save("objects.png", [np.concatenate(tiles[i : i + 3], axis=1) for i in range(0, len(tiles), 3)])


if __name__ == "__main__":
    main()
