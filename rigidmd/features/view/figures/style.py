"""Functions for all figures: the palette, new figures and their files, thinning of long curves."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from rigidmd.core.files import atomic_file
from rigidmd.errors import RigidMDError, RigidMDWarning

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

    from rigidmd.features.view.figures.picture import Picture

#: Colours of curves. Each two differ by at least 25 in the Lab space, also for viewers who lack the
#: pigment of red or of green.
PALETTE = {
    "cool": "#2b6f9e",
    "warm": "#c8553d",
    "amber": "#e0a019",
    "ink": "#1f2430",
    "green": "#1fc88a",
    "navy": "#0d358d",
    "violet": "#9298ff",
    "cyan": "#10c5d1",
}
#: The same on dark pages.
DARK_PALETTE = {
    "cool": "#89c4ff",
    "warm": "#e16642",
    "amber": "#eeb500",
    "ink": "#e6e8ee",
    "green": "#08fa9b",
    "navy": "#2751fa",
    "violet": "#768aff",
    "cyan": "#429b9f",
}
COLORS = tuple(PALETTE.values())
COOL, WARM, AMBER, INK, *_ = COLORS
#: Points: size of text, of titles of panels and of figures.
TEXT, TITLE, HEADING = 8.0, 9.0, 11.0
#: Numbers at logarithmic ticks from which to which they are not powers of ten.
PLAIN = 0.01, 1000.0
FAINT = "#8a8f99"  # of what is not a curve: frames, notes, the backs of things
MARKERS = "os^Dv*PX<>"
DASHES = ((), (5, 1.5), (1.5, 1.2), (6, 1.5, 1.5, 1.5))


def curve_style(k: int, *, connected: bool = True) -> dict:
    """Style of the k-th of many curves: the colours of the palette, then other dashes and markers.
    Without lines if the points are not connected."""
    rounds, color = divmod(k, len(COLORS))
    dashes = DASHES[rounds % len(DASHES)]
    marker = MARKERS[(color + 3 * rounds) % len(MARKERS)]
    line = (0, dashes) if dashes else "-"
    return {"color": COLORS[color], "ls": line if connected else "none", "marker": marker}


def head(figure: "Picture", title: str) -> None:
    """Put a title above all axes of a figure, on the left."""
    figure.suptitle(title, color=INK, x=0.01, ha="left", fontsize=HEADING)


@contextmanager
def drawing(path: Path) -> Iterator[None]:
    """Context in which an error of drawing becomes a warning, as results do not depend on pictures.
    The errors of this package are raised."""
    try:
        yield
    except RigidMDError:
        raise
    except Exception as error:  # Matplotlib raises many types
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        warnings.warn(f"{path} cannot be drawn: {reason}", RigidMDWarning, stacklevel=2)


def write_figure(path: Path, draw: "Callable[[], Picture]", title: str = "") -> None:
    """Draw a figure and write it under a title; see `drawing`. Raises OutputError."""
    with drawing(path):
        figure = draw()
        if title:
            head(figure, title)
        save_files(figure, path.with_suffix(""), [path.suffix[1:]])


def save_files(figure: "Picture", stem: Path, suffixes: Sequence[str]) -> list[Path]:
    """Write a figure as files of these types, with the same bytes for the same figure. Raises
    OutputError."""
    figure.lay_out(150)
    paths = [stem.with_name(f"{stem.name}.{suffix}") for suffix in suffixes]
    for path in paths:
        with atomic_file(path) as temporary:
            temporary.write_bytes(figure.data(path.suffix[1:], 150))
    return paths


def new_figure(
    width: float,
    height: float,
    layout: Literal["constrained"] | None = "constrained",
    title: str = "",
    dpi: float | None = None,
) -> "Picture":
    """An empty figure of this size, inches, under a title."""
    from rigidmd.features.view.figures.picture import Picture  # Matplotlib is slow to import

    figure = Picture(figsize=(width, height), layout=layout, dpi=dpi)
    if title:
        head(figure, title)
    return figure


def panel_grid(
    count: int, across: int, width: float, height: float, margin: float
) -> "tuple[Picture, list[Axes]]":
    """A figure of panels in rows of at most `across`, and the axes of the panels. Inches: of a
    panel, and below all."""
    across = min(across, max(1, count))
    down = max(1, -(-count // across))
    figure = new_figure(width * across, height * down + margin)
    axes = list(figure.subplots(down, across, squeeze=False).flat)
    for axis in axes[count:]:
        axis.set_visible(False)
    return figure, axes[:count]


def open_axis(
    axis: "Axes", labelsize: float | str = "medium", which: Literal["major", "both"] = "major"
) -> None:
    """Draw an axis without its frame on top and right, with labels of this size, in ink."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[:].set_color(INK)
    axis.tick_params(colors=INK, labelsize=labelsize, which=which)


def thin_series(
    time: np.ndarray, values: np.ndarray, bins: int = 1500
) -> tuple[np.ndarray, np.ndarray]:
    """A long series reduced to the lowest and highest value of each of its parts, whose curve is
    the same."""
    size = len(time) // bins
    if size < 4:
        return time, values
    starts = np.arange(0, len(time) // size * size, size)
    parts = values[: len(starts) * size].reshape(-1, size)
    extremes = np.unique(
        np.concatenate([starts + parts.argmin(1), starts + parts.argmax(1), [0, len(time) - 1]])
    )
    return time[extremes], values[extremes]


def largest_of_parts(
    time: np.ndarray, values: np.ndarray, bins: int
) -> tuple[np.ndarray, np.ndarray]:
    """A long series of errors reduced to the largest value in each part."""
    size = -(-len(time) // bins)
    return time[::size], np.fmax.reduceat(values, np.arange(0, len(time), size))


def shown_range(values: np.ndarray, stage: np.ndarray) -> tuple[float, float] | None:
    """Limits of the axis of a curve (n,): the range in the second halves of the stages, and as much
    above and below, because the starts of stages would flatten the rest. None if the range is 0."""
    late = np.concatenate(
        [part[len(part) // 2 :] for part in (values[stage == k] for k in np.unique(stage))]
    )
    late, values = late[np.isfinite(late)], values[np.isfinite(values)]
    if len(late) == 0 or not (span := float(np.ptp(late))) > 0:
        return None
    low, high = max(values.min(), late.min() - span), min(values.max(), late.max() + span)
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def label_ticks(line: "Axis") -> None:
    """Label a logarithmic axis (`axis.xaxis` or `.yaxis`) by plain numbers, powers of ten if they
    are small or large, and between powers of ten if it has fewer than two of them."""
    from matplotlib.ticker import LogFormatterSciNotation

    class Plain(LogFormatterSciNotation):
        def __call__(self, x, pos=None):
            text = super().__call__(x, pos)
            return f"{x:g}" if text and PLAIN[0] <= x <= PLAIN[1] else text

    line.set_major_formatter(Plain(labelOnlyBase=False))
    line.set_minor_formatter(Plain(minor_thresholds=(1.0, 0.5)))
    line.set_tick_params(which="both", labelsize=TEXT)
