"""A figure as wide as a page, legible on a phone; imported where something is drawn, as matplotlib may be missing."""

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO

from matplotlib import rc_context
from matplotlib.figure import Figure


class PageFigure(Figure):
    """A figure 7 inches wide, which a notebook shows, whether pyplot was imported or not."""

    def _repr_png_(self) -> bytes:
        return to_png(self)


@contextmanager
def page_figure() -> Iterator[PageFigure]:
    """Make a figure; what is drawn on it meanwhile has its font."""
    with rc_context({"font.size": 12}):
        yield PageFigure(figsize=(7.0, 6.5), dpi=150, layout="constrained")


def to_png(figure: Figure) -> bytes:
    """Return a figure as the bytes of a PNG file."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
