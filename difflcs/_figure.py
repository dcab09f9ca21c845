"""A figure as wide as a page, legible on a phone; imported where something is drawn, as matplotlib may be missing."""

from io import BytesIO
from typing import Any

from matplotlib.figure import Figure

FONT: dict[Any, Any] = {"font.size": 12}
"""Settings of matplotlib to draw with: `with rc_context(FONT)`."""


class PageFigure(Figure):
    """A figure 7 inches wide, which a notebook shows, whether pyplot was imported or not.

    Args:
        height: [inches].
    """

    def __init__(self, height: float):
        super().__init__(figsize=(7.0, height), dpi=150, layout="constrained")

    def _repr_png_(self) -> bytes:
        return to_png(self)


def to_png(figure: Figure) -> bytes:
    """Return a figure as the bytes of a PNG file."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
