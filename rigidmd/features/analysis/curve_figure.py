"""Figures of the curves of analyses."""

import re
from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.features.view.figures.style import (
    COLORS,
    DASHES,
    FAINT,
    INK,
    TEXT,
    TITLE,
    head,
    label_ticks,
    new_figure,
    open_axis,
    panel_grid,
    thin_series,
)

if TYPE_CHECKING:
    from rigidmd.features.analysis.result import Curve
    from rigidmd.features.view.figures.picture import Picture
    from rigidmd.features.view.figures.style import Axes

WIDTH, HEIGHT, MOST_CURVES = 5.2, 3.2, 10  # size of a figure, inches, and most curves in it
NEIGHBOURS = re.compile(r"n .+-.+")  # headers of numbers of neighbours, on the axis on the right
#: The axis of neighbours ends at the number within the highest peak of g(r), times this.
MOST_NEIGHBOURS = 5.0
ACROSS = 2  # panels in a row
FEW_POINTS = 12  # with markers


def curve_figure(curve: "Curve", title: str = "") -> "Picture":
    """The figure of a curve: each column with a band of one standard error."""
    figure = new_figure(WIDTH, HEIGHT, title=title)
    _draw(figure.subplots(), curve)
    return figure


def curves_figure(curves: "Sequence[Curve]", title: str) -> "Picture":
    """The figure of several curves, a panel for each."""
    figure, axes = panel_grid(len(curves), ACROSS, WIDTH, HEIGHT, 0.3)
    for axis, curve in zip(axes, curves, strict=True):
        _draw(axis, curve)
    head(figure, title)
    return figure


def _draw(axis: "Axes", curve: "Curve") -> None:
    header, x = curve.axis
    neighbours = [title for title in curve.columns if NEIGHBOURS.fullmatch(title)]
    if len(neighbours) == len(curve.columns):
        neighbours = []
    shown = [title for title in curve.columns if title not in neighbours][:MOST_CURVES]
    is_drawn = x > 0 if curve.log[0] else np.ones(len(x), bool)
    if curve.level is not None:
        axis.axhline(curve.level, color=FAINT, lw=0.7)
    for k, title in enumerate(shown):
        color, dashes = divmod(k, curve.per_color)
        _draw_column(axis, curve, title, is_drawn, COLORS[color % len(COLORS)], DASHES[dashes])
    heights = np.array([curve.columns[title][is_drawn] for title in shown])
    for line, is_log, name, values in (
        (axis.xaxis, curve.log[0], "x", x),
        (axis.yaxis, curve.log[1], "y", heights),
    ):
        if is_log and (values > 0).any():  # an atom at rest has no displacement
            getattr(axis, f"set_{name}scale")("log")
            label_ticks(line)
    label = header.replace("(A)", "(Å)").replace("1/A", "1/Å").replace("Time (", "time (")
    axis.set_xlabel(label, fontsize=TITLE, color=INK)
    axis.set_ylabel(curve.label, fontsize=TITLE, color=INK)
    open_axis(axis, labelsize=TEXT)
    if heights.size:
        _set_range(axis, curve, shown, heights)
    if neighbours:
        _draw_neighbours(axis, curve, shown, neighbours[:MOST_CURVES])
    if curve.power is not None:
        _draw_power(axis, curve.power, x[is_drawn], heights)
    if len(axis.get_legend_handles_labels()[1]) > 1:
        columns = curve.per_color if curve.per_color < len(shown) else 1
        style = {"fontsize": TEXT, "labelcolor": INK, "frameon": False}
        axis.legend(handlelength=2.0, ncols=columns, columnspacing=1.2, **style)


def _draw_column(
    axis: "Axes", curve: "Curve", title: str, is_drawn: np.ndarray, color: str, dashes: tuple
) -> None:
    """Draw a column with its band, or as bars."""
    x, values, error = curve.axis[1], curve.columns[title], curve.errors.get(title)
    if curve.bars:
        axis.bar(x, values, color=color, width=0.7)
        return
    style = {"color": color, "lw": 1.0, "ls": (0, dashes) if dashes else "-"}
    style["label"] = title.replace("A^2", "Å²").replace("cm3", "cm³")
    if is_drawn.sum() <= FEW_POINTS:
        style |= {"marker": "o", "ms": 3.0}
    axis.plot(*thin_series(x[is_drawn], values[is_drawn]), **style)
    if error is not None and np.isfinite(error).all():
        low, high = (values - error)[is_drawn], (values + error)[is_drawn]
        axis.fill_between(x[is_drawn], low, high, color=color, alpha=0.25, lw=0)


def _set_range(axis: "Axes", curve: "Curve", shown: "Sequence[str]", heights: np.ndarray) -> None:
    """Set the range of y to the values and the bands of their later half: errors of the first
    values of a running mean are large. Some start at 0."""
    if not curve.log[1] and not curve.bars:
        late = slice(heights.shape[1] // 2, None)
        ends = [heights.min(), heights.max()]
        for title, error in curve.errors.items():
            if title in shown and np.isfinite(error).all():
                late_values = curve.columns[title][late]
                ends += [(late_values - error[late]).min(), (late_values + error[late]).max()]
        if curve.level is not None:
            ends.append(curve.level)
        low, high = min(ends), max(ends)
        if high > low:
            axis.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
    if curve.from_zero:
        axis.set_ylim(bottom=0.0)


def _draw_neighbours(
    axis: "Axes", curve: "Curve", shown: "Sequence[str]", neighbours: "Sequence[str]"
) -> None:
    """Draw the running coordination numbers on an axis on the right, in the colours of g(r)."""
    right, x = axis.twinx(), curve.axis[1]
    within = []
    for color, pair, title in zip(cycle(COLORS), shown, neighbours, strict=False):
        right.plot(x, curve.columns[title], color=color, lw=0.9, ls=(0, DASHES[1]))
        within.append(curve.columns[title][curve.columns[pair].argmax()])
    right.set_ylim(0.0, MOST_NEIGHBOURS * max(within) or 1.0)
    right.set_ylabel("neighbours within r (dashed)", fontsize=TITLE, color=INK)
    right.spines[["top", "left"]].set_visible(False)
    right.spines["right"].set_color(INK)
    right.tick_params(colors=INK, labelsize=TEXT)
    if all(curve.columns[title].min() >= 0 for title in shown):
        axis.set_ylim(bottom=0.0)


def _draw_power(axis: "Axes", power: float, x: np.ndarray, heights: np.ndarray) -> None:
    """Draw a power of x through the last point of the first curve."""
    if len(x) and heights.size and heights[0, -1] > 0:
        line = heights[0, -1] * (x / x[-1]) ** power
        axis.plot(x, line, color=FAINT, lw=0.9, ls=(0, DASHES[2]), label=f"slope {power:g}")
