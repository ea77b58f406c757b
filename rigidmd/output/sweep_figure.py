"""sweep.png: the main observables of a sweep against what was varied, with their errors."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.output.figure import FAINT, INK, bare_axis, curve_style, write_figure

#: Inches of a panel; panels beside each other; curves in the legend.
WIDTH, HEIGHT, ACROSS, MOST_NAMED = 4.4, 3.0, 2, 20
#: Share of the distance between places of the axis over which curves stand beside each other, so that bars do not hide.
ASIDE = 0.06
#: Largest over smallest value from which on the axis is logarithmic.
DECADES = 100.0


class Curve(NamedTuple):
    """Means (p,) with errors (p,), NaN where there are none, at places (p,)."""

    label: str
    x: np.ndarray
    values: np.ndarray
    errors: np.ndarray


class Panel(NamedTuple):
    """Curves of one observable. band : mean and error over all of them"""

    title: str
    curves: list[Curve]
    band: tuple[float, float] | None = None


class Axis(NamedTuple):
    """What was varied. words : the values at places 0, 1, ... if they are no numbers"""

    label: str
    words: list[str] | None = None


def draw_sweep(path: Path, title: str, axis: Axis, panels: list[Panel]) -> None:
    """Write the figure. Raises OutputError."""
    from rigidmd.output.picture import Picture

    across = min(ACROSS, len(panels))
    down = -(-len(panels) // across)
    figure = Picture(figsize=(WIDTH * across, HEIGHT * down + 0.4), layout="constrained")
    grid = figure.subplots(down, across, squeeze=False)
    for place, panel in zip(grid.flat, panels, strict=False):
        _draw(place, axis, panel)
    for place in grid.flat[len(panels) :]:
        place.axis("off")
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK)
    labels = panels[0].curves
    if 1 < len(labels) <= MOST_NAMED:
        figure.legend(
            *grid.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=8,
            labelcolor=INK,
        )  # fmt: skip
    write_figure(path, lambda: figure)


def _draw(place, axis: Axis, panel: Panel) -> None:
    gaps = np.concatenate([np.diff(np.unique(curve.x)) for curve in panel.curves])
    has_bars = any(np.isfinite(curve.errors).any() for curve in panel.curves)
    aside = has_bars * ASIDE * (gaps.min() if len(gaps) else 1.0) / max(1, len(panel.curves) - 1)
    if panel.band is not None:
        middle, error = panel.band
        place.axhline(middle, color=FAINT, lw=0.9, zorder=0)
        if np.isfinite(error):
            place.axhspan(middle - error, middle + error, color=FAINT, alpha=0.25, lw=0, zorder=0)
    for k, curve in enumerate(panel.curves):
        shift = aside * (k - (len(panel.curves) - 1) / 2)
        style = curve_style(k)
        joined = {} if panel.band is None and len(curve.x) > 1 else {"ls": "none"}
        place.errorbar(
            curve.x + shift, curve.values, np.nan_to_num(curve.errors), lw=0.9, ms=3.5, capsize=2.5, elinewidth=0.9,
            label=curve.label, **(style | joined),
        )  # fmt: skip
    place.set_title(panel.title, loc="left", fontsize=9, color=INK)
    place.set_xlabel(axis.label, fontsize=9, color=INK)
    if axis.words is not None:
        slanted = max(map(len, axis.words), default=0) > 12
        place.set_xticks(
            range(len(axis.words)), axis.words, rotation=30 if slanted else 0, ha="right" if slanted else "center"
        )
        place.set_xlim(-0.5, len(axis.words) - 0.5)
    elif all(float(x).is_integer() for curve in panel.curves for x in curve.x):
        from matplotlib.ticker import MaxNLocator

        place.xaxis.set_major_locator(MaxNLocator(integer=True))
    if _spans_decades(panel):
        place.set_yscale("log")
    elif not _is_tiny(panel):
        place.ticklabel_format(axis="y", useOffset=False)
    bare_axis(place, labelsize=8)


def _spans_decades(panel: Panel) -> bool:
    """Whether positive values have sizes that one linear axis does not show."""
    values = np.concatenate([curve.values for curve in panel.curves])
    values = values[np.isfinite(values)]
    return bool(len(values) and values.min() > 0 and values.max() > DECADES * values.min())


def _is_tiny(panel: Panel) -> bool:
    """Whether values are so small that they need a power of ten."""
    largest = max((np.nanmax(np.abs(curve.values), initial=0.0) for curve in panel.curves), default=0.0)
    return bool(0 < largest < 1e-3)
