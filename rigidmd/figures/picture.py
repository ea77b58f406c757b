"""Figures of Matplotlib. A notebook shows them, whether or not pyplot is imported there."""

import io
from collections.abc import Iterator

from matplotlib.artist import Artist
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.text import Text

from rigidmd.figures.style import save_figure

#: Dots per inch of a figure in a notebook, drawn twice as fine for sharp screens.
DPI = 80


class Picture(Figure):
    """A figure of Matplotlib, apart from pyplot, so that a notebook shows it once: as the value of its cell.

    Its texts are shown as they are written: a name of a user may hold dollar signs, between which Matplotlib reads a
    formula. Numbers at ticks stay formulas, such as powers of ten.
    """

    def draw(self, renderer) -> None:
        """Draw it."""
        for text in _texts(self):
            text.set_parse_math(False)
        super().draw(renderer)

    def png(self) -> tuple[bytes, dict[str, float]]:
        """It as PNG, and the width and height at which it is shown."""
        stream = io.BytesIO()
        save_figure(self, stream, format="png", dpi=2 * DPI)
        width, height = self.get_size_inches()
        return stream.getvalue(), {"width": DPI * width, "height": DPI * height}

    _repr_png_ = png


def _texts(artist: Artist) -> Iterator[Text]:
    """All texts in an artist but the numbers at ticks."""
    if isinstance(artist, Text):
        yield artist
    elif isinstance(artist, Axis):
        yield artist.label
    else:
        for child in artist.get_children():
            yield from _texts(child)
