"""Matplotlib figures that a notebook displays without pyplot. Apart from `style`, as Matplotlib is
slow to import."""

import io
from collections.abc import Iterator

from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.text import Text

from rigidmd.core.process import PROCESS_LOCK

#: Dots per inch of a figure in a notebook, drawn twice as fine for sharp screens.
DPI = 80
#: Resolution of what is not made of lines in a .svg.
SVG_DPI = 100


class Picture(Figure):
    """A figure of Matplotlib that is not known to pyplot, so that a notebook shows it once, as the
    value of its cell. Texts are not parsed as formulas, as names of users may contain dollar signs.
    Numbers at ticks are."""

    def draw(self, renderer) -> None:
        self._take_texts_as_written()
        super().draw(renderer)

    def lay_out(self, dpi: float) -> None:
        """Arrange the axes once, for files of this resolution: a layout engine lets `savefig` draw
        everything twice."""
        self._take_texts_as_written()
        self.dpi = dpi
        if engine := self.get_layout_engine():
            engine.execute(self)
        with PROCESS_LOCK, rc_context({"figure.constrained_layout.use": False}):
            self.set_layout_engine(None)

    def _take_texts_as_written(self) -> None:
        for text in _texts(self):
            text.set_parse_math(False)

    def data(
        self, kind: str, dpi: float, hashsalt: str = "rigidmd", fonttype: str = "path"
    ) -> bytes:
        """The bytes of a file of this type, which are the same for the same figure. hashsalt,
        fonttype : of an .svg"""
        stream = io.BytesIO()
        is_svg = kind == "svg"
        undated = {"Date": None, "Creator": None} if is_svg else None
        # Matplotlib has one set of settings for all threads
        with PROCESS_LOCK, rc_context({"svg.hashsalt": hashsalt, "svg.fonttype": fonttype}):
            self.savefig(stream, format=kind, dpi=SVG_DPI if is_svg else dpi, metadata=undated)
        return stream.getvalue()

    def png(self) -> tuple[bytes, dict[str, float]]:
        """The figure as PNG, and the width and height at which it is shown."""
        width, height = self.get_size_inches()
        return self.data("png", 2 * DPI), {"width": DPI * width, "height": DPI * height}

    _repr_png_ = png


def _texts(artist: Artist) -> Iterator[Text]:
    """All texts in an artist except the numbers at ticks."""
    if isinstance(artist, Text):
        yield artist
    elif isinstance(artist, Axis):
        yield artist.label
    else:
        for child in artist.get_children():
            yield from _texts(child)
