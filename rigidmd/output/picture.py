"""Figures that a notebook shows, whether or not pyplot is imported there."""

import io

from matplotlib.figure import Figure

from rigidmd.output.figure import save_figure

#: Dots per inch of a figure in a notebook, drawn twice as fine for sharp screens.
DPI = 80


class Picture(Figure):
    """A figure of Matplotlib, apart from pyplot, so that a notebook shows it once: as the value of its cell."""

    def png(self) -> tuple[bytes, dict[str, float]]:
        """It as PNG, and the width and height at which it is shown."""
        stream = io.BytesIO()
        save_figure(self, stream, format="png", dpi=2 * DPI)
        width, height = self.get_size_inches()
        return stream.getvalue(), {"width": DPI * width, "height": DPI * height}

    _repr_png_ = png
