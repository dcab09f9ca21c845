"""Pictures of the environments by one command: `python -m difflcs_envs.gallery [FOLDER]`.

Writes `objects.png`, a sheet of every object seen from the front and from above, and `push.mp4`, in which the fingers
push each of them. Each picture says whether the object is the YCB mesh or a stand-in.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from difflcs_envs import DifflcsEnvsError, register_envs
from difflcs_envs.errors import MissingDependencyError
from difflcs_envs.ycb import YCB

if TYPE_CHECKING:
    from difflcs_envs.trifinger.env import TriFingerEnv

__all__ = ["contact_sheet", "main", "push_video"]

GOAL = (0.04, 0.03, 0.4)  # x [m], y [m], yaw [rad]
SLOWEST = 3  # frames per step of 0.1 s: the video runs at a third of real time


def _environments(width: int, height: int) -> Iterator[tuple[str, TriFingerEnv]]:
    """Every task and object, with its label."""
    import gymnasium

    register_envs()
    picture = {"render_mode": "rgb_array", "width": width, "height": height, "reset_noise": 0.0}
    makers = [("cube", "difflcs/TriFingerMoveCube-v0", {}), ("turn cube", "difflcs/TriFingerTurnCube-v0", {})]
    makers += [(name, "difflcs/TriFingerMoveObject-v0", {"object": name}) for name in YCB]
    for name, env_id, arguments in makers:
        env: TriFingerEnv = gymnasium.make(env_id, **arguments, **picture).unwrapped  # pyright: ignore[reportAssignmentType]
        yield f"{name} ({env.object.source.replace('_', ' ')})", env
        env.close()


def _goal(env: TriFingerEnv) -> list[float]:
    x, y, yaw = env.task.goal_high
    return [min(GOAL[0], x), min(GOAL[1], y), min(GOAL[2], yaw)]


def _labelled(picture: np.ndarray, text: str) -> np.ndarray:
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((6, 4), text, fill=(20, 20, 30), font_size=14)
    return np.asarray(image)


def contact_sheet(path: Path, width: int = 320, height: int = 240) -> None:
    """Draw every object from the front and from above into one picture, two pairs to a row."""
    from PIL import Image

    tiles = []
    for label, env in _environments(width, height):
        env.reset(seed=0, options={"goal": _goal(env)})
        tiles.append(np.concatenate([_labelled(env.picture(), label), env.picture("top")], axis=1))
    if len(tiles) % 2:
        tiles.append(np.full_like(tiles[0], 255))
    rows = [np.concatenate(tiles[i : i + 2], axis=1) for i in range(0, len(tiles), 2)]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(path)


def push_video(path: Path, width: int = 320, height: int = 240, steps: int = 12) -> None:
    """Film the fingers closing in on every object and pushing it in turns."""
    import imageio.v2 as imageio

    path.parent.mkdir(parents=True, exist_ok=True)
    with imageio.get_writer(path, fps=10 * SLOWEST, macro_block_size=None) as video:
        for label, env in _environments(width, height):
            state = env.reset(seed=0, options={"goal": _goal(env)})[0]["state"]
            for step in range(steps):
                arms = state[3:].reshape(3, 2) - state[:2]
                action = -0.015 * arms / np.linalg.norm(arms, axis=1, keepdims=True)
                action[np.arange(3) != step // 4 % 3] *= 0.3  # one finger pushes harder than the others
                state = env.step(action.ravel())[0]["state"]
                for _ in range(SLOWEST):
                    video.append_data(_labelled(env.picture(), label))  # pyright: ignore[reportAttributeAccessIssue]


def main(arguments: list[str] | None = None) -> int:
    """Run the command. Returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m difflcs_envs.gallery", description="Pictures of every object.")
    parser.add_argument("folder", nargs="?", default="gallery", type=Path, help="where to write (default: gallery)")
    folder: Path = parser.parse_args(arguments).folder
    try:
        for package in ("PIL", "imageio", "imageio_ffmpeg"):
            try:
                __import__(package)
            except ImportError as error:
                raise MissingDependencyError(package) from error
        contact_sheet(folder / "objects.png")
        push_video(folder / "push.mp4")
    except DifflcsEnvsError as error:
        print(f"gallery: {error}", file=sys.stderr)
        return 2
    print(f"written: {folder / 'objects.png'}, {folder / 'push.mp4'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
