"""Frames shown one after another: in a notebook, on its page and in a file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from difflcs._checks import check_number, check_positive_int
from difflcs._optional import require
from difflcs._storage import place_to_write, write_atomically
from difflcs.errors import DTypeError, InvalidInputError

_SAMPLES = 8  # frames that the common palette is made from: the first alone may lack colours of later ones
_KINDS = {".gif": "GIF", ".png": "PNG"}


class Animation:
    """Animation that plays its frames in a loop.

    As the last line of a notebook cell it plays, also in the notebook's HTML and on code hosts, because its picture is
    an animated PNG.

    Args:
        frames: arrays (height, width, 3) of uint8, such as `env.render()` returns, or Pillow images; all of one size.
        fps: frames a second, at least 0.01.
        colors: size of the palette that all frames share, at most 256; fewer make smaller files.
        dither: mix colours that the palette lacks from dots of others; makes larger files.

    Raises:
        DTypeError: a frame is no picture.
        InvalidInputError: there is no frame, frames differ in size, or a number is out of its range.
        MissingDependencyError: Pillow is not installed.
    """

    def __init__(self, frames: Sequence[Any], fps: float, *, colors: int = 64, dither: bool = False):
        require("PIL")
        from PIL import Image

        self.fps, colors = check_number("fps", fps, minimum=0.01), check_positive_int("colors", colors, maximum=256)
        try:
            pictures = [one if isinstance(one, Image.Image) else Image.fromarray(np.asarray(one)) for one in frames]
        except TypeError as error:
            raise DTypeError(
                f"frames: expected arrays (height, width, 3) of uint8, got others: {error}; convert them"
            ) from error
        sizes = sorted({picture.size for picture in pictures})
        if len(sizes) != 1 or 0 in sizes[0]:
            raise InvalidInputError(
                f"frames: expected at least one, all of one size that is not 0, got {len(pictures)} of the sizes "
                f"{sizes}; draw every frame with the same width and height"
            )
        pictures = [picture.convert("RGB") for picture in pictures]
        sample = np.concatenate([np.asarray(picture) for picture in pictures[:: -(-len(pictures) // _SAMPLES)]])
        palette = Image.fromarray(sample).quantize(colors, dither=Image.Dither.NONE)
        mode = Image.Dither.FLOYDSTEINBERG if dither else Image.Dither.NONE
        self._frames = [picture.quantize(palette=palette, dither=mode) for picture in pictures]

    @classmethod
    def draw(cls, figure: Any, draw: Callable[[int], object], frames: int, fps: float, **options: Any) -> Animation:
        """Make an animation of a matplotlib figure: `draw(i)` draws frame i on it, for i from 0 to `frames` - 1.

        The figure is closed, so that a notebook does not show its last state as well.
        """
        drawn = []
        for i in range(frames):
            draw(i)
            figure.canvas.draw()
            drawn.append(np.array(figure.canvas.buffer_rgba())[..., :3])
        if pyplot := sys.modules.get("matplotlib.pyplot"):
            pyplot.close(figure)
        return cls(drawn, fps, **options)

    def save(self, path: str | Path) -> None:
        """Write a GIF or an animated PNG, by the ending of the file's name.

        Raises:
            InvalidInputError: the name ends in neither .gif nor .png, or the file cannot be written.
        """
        path = Path(path)
        kind = _KINDS.get(path.suffix.lower())
        if kind is None:
            raise InvalidInputError(f"path: expected a name that ends in .gif or .png, got {str(path)!r}; rename it")
        with place_to_write(path, "path"):
            write_atomically(path, self._encode(kind))

    def _encode(self, kind: str) -> bytes:
        buffer = BytesIO()
        first, *rest = self._frames
        milliseconds = round(1000 / self.fps)
        first.save(buffer, kind, save_all=True, append_images=rest, duration=milliseconds, loop=0, optimize=True)
        return buffer.getvalue()

    def __repr__(self) -> str:
        return f"Animation({len(self._frames)} frames, {self.fps:g} a second)"

    def _repr_png_(self) -> bytes:
        return self._encode("PNG")
