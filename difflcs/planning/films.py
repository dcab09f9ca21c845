"""Films of policies that plan with known physics, with their decisions drawn in: `difflcs render pusht`."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from difflcs._checks import check_positive_int
from difflcs.errors import InvalidInputError, MissingDependencyError
from difflcs.planning.pusht import PIXELS, SIDE, STEPS, PushTPolicy, make_env
from difflcs.planning.sampling import Decision, Mode

if TYPE_CHECKING:
    from PIL import Image

__all__ = ["FILMS", "picture", "record"]

_PAUSE = 6
"""Frames for which the last picture of an episode is shown."""
_GREEN, _GREY, _BLUE = (0, 158, 115), (150, 150, 150), (0, 114, 178)


def picture(env: Any, policy: PushTPolicy, text: str = "", size: int = 340) -> Image.Image:
    """Draw the environment, and over it the last decision of the policy.

    Places where the disc could be are dots, the greener the more a push from there would gain; that to which it
    travels has a ring. Where it pushes, the planned path of the disc is a line.

    Args:
        env: of `make_env(render_mode="rgb_array")`.
        policy: after `act`.
        text: to write into the upper left corner.
        size: width and height [px].
    """
    from PIL import Image, ImageDraw

    frame = Image.fromarray(env.render()).resize((size, size), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(frame)
    decision = policy.sampling.decision
    if decision is not None:
        _draw(draw, decision, size)
    draw.text((6, 4), text, fill=(20, 20, 30), font_size=max(10, size // 24))
    return frame


def _draw(draw: Any, decision: Decision, size: int) -> None:
    scale, line = size / (SIDE * PIXELS), size / 340

    def dot(point: Tensor, radius: float, **colors: Any) -> None:
        x, y = (scale * PIXELS * point).tolist()
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), **colors)

    scores = decision.scores[1:]
    best = max(float(scores.max()), 1e-12)
    # Dots move with the T while the disc travels.
    for place, score in zip(decision.states[1:, 3:5], scores.tolist(), strict=True):
        share = min(max(score / best, 0.0), 1.0) ** 2
        color = tuple(round(share * a + (1 - share) * b) for a, b in zip(_GREEN, _GREY, strict=True))
        dot(place, line * (1.5 + 2.0 * share), fill=color)
    if decision.mode is Mode.TRAVEL and decision.target is not None:
        dot(decision.target[3:5], 7.0 * line, outline=_BLUE, width=round(2 * line))
    else:
        path = (scale * PIXELS * decision.solution.x[0, :, 3:5]).tolist()
        draw.line([tuple(point) for point in path], fill=_BLUE, width=round(2 * line))


def record(
    path: str | os.PathLike[str], seed: int = 0, episodes: int = 4, size: int = 340, force: bool = False
) -> list[bool]:
    """Play episodes of Push-T and write them as a GIF or an MP4.

    Args:
        path: ends in .gif or .mp4.
        seed: of the first episode.
        episodes: of seeds `seed`, `seed` + 1, …
        size: width and height [px].
        force: replace a file that is there.

    Returns:
        For each episode, True if it was solved.

    Raises:
        InvalidInputError: an ending of another kind, the file is there already, or it cannot be written there.
        MissingDependencyError: gym-pusht, Pillow or imageio is not installed.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".gif", ".mp4") or path.is_dir():
        raise InvalidInputError(f"out: expected the name of a GIF or MP4 file, got {path}; pass --out pusht.gif")
    if path.exists() and not force:
        raise InvalidInputError(f"out: expected a new file, got {path}, which exists; pass --force or another --out")
    episodes = check_positive_int("episodes", episodes)
    needed = ["PIL"] if kind == ".gif" else ["PIL", "imageio", "imageio_ffmpeg"]
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingDependencyError(
            f'expected the package(s) {", ".join(missing)}, not installed; run: pip install "difflcs[scoreboard,viz]"'
        )
    temporary = path.with_name(f".{path.stem}.tmp{kind}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()  # raises here if it cannot be written, before the episodes are played
        temporary.unlink()
    except OSError as error:
        raise InvalidInputError(f"out: expected a place to write {path}, got: {error}; choose another") from error
    env, policy, frames, solved = make_env(render_mode="rgb_array"), PushTPolicy(), [], []
    for i in range(episodes):
        observation, _ = env.reset(seed=seed + i)
        policy.reset()
        success = False
        for step in range(STEPS):
            action = policy.act(observation)
            decision = policy.sampling.decision
            assert decision is not None
            frames.append(picture(env, policy, f"{step / 10:.1f} s  {decision.mode}", size))
            observation, _, success, truncated, info = env.step(action)
            if success or truncated:
                break
        verdict = f"{'solved' if success else 'not solved'}, {100 * info['coverage']:.0f} % covered"
        frames += [picture(env, policy, verdict, size)] * _PAUSE
        solved.append(bool(success))
    env.close()
    try:
        _write(temporary, frames)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return solved


def _write(path: Path, frames: list[Image.Image]) -> None:
    """Write ten frames a second: real time."""
    if path.suffix == ".gif":
        from PIL import Image

        palette = frames[0].quantize(64, dither=Image.Dither.NONE)
        small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
        small[0].save(path, save_all=True, append_images=small[1:], duration=100, loop=0, optimize=True)
        return
    import imageio.v2 as imageio

    writer: Any = imageio.get_writer(path, fps=10, quality=8, macro_block_size=1)
    with writer as video:
        for frame in frames:
            video.append_data(np.asarray(frame))


FILMS: dict[str, Callable[[Path, int, int, bool], list[bool]]] = {
    "pusht": lambda path, seed, episodes, force: record(path, seed, episodes, force=force)
}
"""Name → function of the path, the seed of the first episode, the number of episodes, and True to replace a file. It
returns, for each episode, True if it was solved."""
