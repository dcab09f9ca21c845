"""Frames become a picture that plays in a notebook, and a file."""

import io

import numpy as np
import pytest
from PIL import Image

from difflcs import Animation
from difflcs.errors import InvalidInputError
from tests.conftest import refuse

FRAMES = [np.full((6, 8, 3), shade, np.uint8) for shade in (0, 90, 250)]


def test_a_notebook_is_given_an_animated_png():
    with Image.open(io.BytesIO(Animation(FRAMES, fps=10)._repr_png_())) as picture:
        assert picture.format == "PNG"
        assert (picture.n_frames, picture.size, picture.info["duration"]) == (3, (8, 6), 100)
        picture.seek(2)  # the palette has colours that the first frame lacks
        assert np.abs(np.asarray(picture.convert("RGB"), int) - FRAMES[2]).max() < 8


def test_a_drawn_figure_is_saved_by_its_ending_and_closed(tmp_path):
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(1, 1))
    film = Animation.draw(figure, lambda i: axes.plot([0, i]), 4, fps=5)
    assert not pyplot.fignum_exists(figure.number)
    assert repr(film) == "Animation(4 frames, 5 a second)"
    for kind in ("gif", "PNG"):
        film.save(tmp_path / f"film.{kind}")
        with Image.open(tmp_path / f"film.{kind}") as picture:
            assert (picture.format, picture.n_frames) == (kind.upper(), 4)
    refuse(InvalidInputError, r"ends in \.gif or \.png", film.save, tmp_path / "film.mp4")
    refuse(InvalidInputError, "expected a place to write", film.save, tmp_path / "film.gif" / "film.gif")


@pytest.mark.parametrize(
    ("frames", "options", "message"),
    [
        ([], {}, "of one size"),
        ([FRAMES[0][:0]], {}, "of one size that is not 0"),
        ([FRAMES[0], FRAMES[0][:4]], {}, "of one size"),
        ([FRAMES[0] / 255], {}, "frames: expected arrays .* of uint8"),
        (FRAMES, {"fps": 0.001}, "fps: expected a finite number at least 0.01"),
        (FRAMES, {"colors": 257}, "colors: expected at most 256"),
    ],
)
def test_what_is_no_film_is_refused(frames, options, message):
    refuse(InvalidInputError, message, Animation, frames, **{"fps": 10, **options})
