"""Figures of the curves of analyses."""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.features.view.figures.style import (
    COLORS,
    FAINT,
    INK,
    label_minor_ticks,
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
UNDRAWN = re.compile(r"n .+-.+")  # headers of columns that are in the file and not drawn
ACROSS = 2  # panels in a row


def curve_figure(curve: "Curve") -> "Picture":
    """The figure of a curve: each column with a band of one standard error."""
    figure = new_figure(WIDTH, HEIGHT)
    axis = figure.subplots()
    _draw(axis, curve)
    handles, labels = axis.get_legend_handles_labels()
    if len(labels) > 1:
        figure.legend(
            handles,
            labels,
            loc="outside upper center",
            ncols=2,
            frameon=False,
            fontsize=7,
            handlelength=1.4,
            labelcolor=INK,
        )
    return figure


def curves_figure(curves: "Sequence[Curve]", title: str) -> "Picture":
    """The figure of several curves, a panel for each."""
    figure, axes = panel_grid(len(curves), ACROSS, WIDTH, HEIGHT, 0.3)
    for axis, curve in zip(axes, curves, strict=True):
        _draw(axis, curve)
        if len(axis.get_legend_handles_labels()[1]) > 1:
            axis.legend(frameon=False, fontsize=7, handlelength=1.4, labelcolor=INK)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK)
    return figure


def _draw(axis: "Axes", curve: "Curve") -> None:
    header, x = curve.axis
    shown = [title for title in curve.columns if not UNDRAWN.fullmatch(title)][:MOST_CURVES]
    is_drawn = x > 0 if curve.log[0] else np.ones(len(x), bool)
    if curve.level is not None:
        axis.axhline(curve.level, color=FAINT, lw=0.7)
    for color, title in zip(COLORS, shown, strict=False):
        values = curve.columns[title]
        if curve.bars:
            axis.bar(x, values, color=color, width=0.7)
            continue
        axis.plot(*thin_series(x[is_drawn], values[is_drawn]), color=color, lw=1.0, label=title)
        error = curve.errors.get(title)
        if error is not None and np.isfinite(error).all():
            low, high = (values - error)[is_drawn], (values + error)[is_drawn]
            axis.fill_between(x[is_drawn], low, high, color=color, alpha=0.25, lw=0)
    heights = np.array([curve.columns[title][is_drawn] for title in shown])
    for line, is_log, name, values in (
        (axis.xaxis, curve.log[0], "x", x),
        (axis.yaxis, curve.log[1], "y", heights),
    ):
        if is_log and (values > 0).any():  # an atom at rest has no displacement
            getattr(axis, f"set_{name}scale")("log")
            label_minor_ticks(line)
    axis.set_xlabel(header.replace("(A)", "(Å)").replace("1/A", "1/Å"), fontsize=9, color=INK)
    axis.set_ylabel(curve.label, fontsize=9, color=INK)
    open_axis(axis, labelsize=8)
