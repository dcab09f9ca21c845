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
    for kind in ("gif", "png"):
        film.save(tmp_path / f"film.{kind}")
        with Image.open(tmp_path / f"film.{kind}") as picture:
            assert (picture.format.lower(), picture.n_frames) == (kind, 4)
    refuse(InvalidInputError, r"ends in \.gif or \.png", film.save, tmp_path / "film.mp4")


@pytest.mark.parametrize("frames", [[], [FRAMES[0], FRAMES[0][:4]]], ids=["none", "two sizes"])
def test_frames_that_are_no_film_are_refused(frames):
    refuse(InvalidInputError, "of one size", Animation, frames, fps=10)
