"""Curves against time: the panels of a run, for its figures, pages and animations."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from textwrap import wrap
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.engines.samples import moving
from rigidmd.features.view.figures.style import (
    COLORS,
    FAINT,
    INK,
    largest_of_parts,
    new_figure,
    open_axis,
    shown_range,
    thin_series,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rigidmd.engines.system import System
    from rigidmd.features.view.figures.picture import Picture

#: Inches: a line of text, the space left and right of an axis.
LINE, LEFT, RIGHT = 0.165, 0.75, 0.2
#: Inches below an axis: without numbers, with them, with numbers and their unit.
GAP, NUMBERS, FOOT = 0.08, 0.3, 0.42
#: Most rows of names of stages.
MOST_ROWS = 5
#: Inches: width of a figure, height of a panel.
WIDTH, HEIGHT = 7.2, 2.1
#: Points of a curve are thinned to twice this number in each stage.
BINS = 600
#: Inches of a letter in a legend.
LETTER = 0.068
#: Ranges below this fraction of the values are rounding.
ROUNDING = 1e-9


class Panel(NamedTuple):
    """Curves on one axis."""

    title: str  # with the unit
    curves: list[tuple[str, np.ndarray]]  # label, values (t,)
    log: bool = False
    least: float = 0.0  # a smaller range is rounding
    level: float | None = None  # a dotted line

    def columns(self, width: float) -> int:
        """How many labels of its legend are next to one another in a width in inches."""
        longest = max(len(label) for label, _ in self.curves)
        return max(1, int(width / (0.45 + LETTER * longest)))

    def head(self, width: float) -> tuple[list[str], int]:
        """Lines of the title above an axis with this width, and the number of legend rows."""
        labels = sum(bool(label) for label, _ in self.curves)
        rows = -(-labels // self.columns(width)) if labels > 1 else 0
        return wrap(self.title, int(width / LETTER)), rows

    def margin_above(self, width: float) -> float:
        """Inches above an axis of this width."""
        lines, rows = self.head(width)
        return LINE * (len(lines) + rows) + 0.12


class Timeline(NamedTuple):
    """The times of samples without those of minimisations, in which no time passes."""

    shown: np.ndarray  # (n,) which of the samples they are
    time: np.ndarray  # (t,)
    stage: np.ndarray  # (t,) indices
    unit: str
    names: tuple[str, ...] = ()  # of the stages

    @property
    def starts(self) -> list[tuple[float, str]]:
        """Where stages begin, and their names."""
        first = [int(np.argmax(self.stage == k)) for k in np.unique(self.stage)]
        return [(float(self.time[k]), self.names[self.stage[k]]) for k in first if self.names]

    def of_stage(self, k: int) -> "Timeline":
        """The times of one stage."""
        part = self.stage == k
        shown = self.shown.copy()
        shown[self.shown] = part
        return Timeline(shown, self.time[part], self.stage[part], self.unit)


#: Rows of panels, each with its times.
Rows = Sequence[Sequence[tuple[Timeline, Panel]]]


def molecular_timeline(system: "System", columns: Mapping[str, np.ndarray]) -> Timeline:
    time, stages, stage = columns["time"], system.scene.stages, columns["stage"].astype(int)
    shown = moving(stages, stage)
    names = tuple(stage.label for stage in stages)
    return Timeline(shown, time[shown], stage[shown], "ps", names)


def molecular_panels(system: "System", columns: Mapping[str, np.ndarray]) -> list[Panel]:
    count = len(system.model.species)
    shown = moving(system.scene.stages, columns["stage"])

    def panel(title: str, labels: dict[str, str], per: int = 1) -> list[Panel]:
        curves = [
            (label, columns[name] / per)
            for name, label in labels.items()
            if name in columns and np.isfinite(columns[name][shown]).any()
        ]
        return [Panel(title, curves)] if curves else []

    per_molecule = "(kJ/mol per molecule)"
    temperatures = {"temperature_translation": "translation", "temperature_rotation": "rotation"}
    found = panel("temperature (K)", temperatures)
    found += panel(f"potential energy {per_molecule}", {"potential": ""}, count)
    found += panel(f"conserved energy since its stage began {per_molecule}", {"drift": ""}, count)
    found += panel("pressure (bar)", {"pressure": ""})
    if "density" in columns and np.ptp(np.nan_to_num(columns["density"])) > 0:
        found += panel("density (g/cm³)", {"density": ""})
        found += panel("edges of the box (Å)", {edge: edge for edge in "abc"})
    return found


def draw_panel(axis: "Axes", times: Timeline, panel: Panel) -> None:
    """Draw the curves of a panel, which break where stages begin."""
    stages, ranges = np.unique(times.stage), []
    for color, (label, values) in zip(cycle(COLORS), panel.curves, strict=False):
        values = values[times.shown]
        for k in stages:
            of_stage = times.stage == k
            thin = largest_of_parts if panel.log else thin_series
            curve = thin(times.time[of_stage], values[of_stage], BINS)
            axis.plot(
                *curve, color=color, lw=0.9, label=label if label and k == stages[0] else None
            )
        if times.names and not panel.log:
            ranges.append(shown_range(values, times.stage))
        else:
            ranges.append((np.nanmin(values), np.nanmax(values)))
    low, high = np.array([limits for limits in ranges if limits] or [(0.0, 0.0)]).T
    low, high = low.min(), high.max()
    axis.set_xlim(times.time[0], times.time[-1])
    if panel.log:
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter("{x:.0e}")
        axis.set_ylim(low / 2 or None, 2 * high or None)
    else:
        margin = 0.05 * (high - low)
        if not high - low > max(panel.least, ROUNDING * max(abs(low), abs(high))):
            margin = 0.05 * max(abs(low), abs(high)) or 1.0
        axis.set_ylim(low - margin, high + margin)
        axis.locator_params(axis="y", nbins=6)
        axis.yaxis.set_major_formatter("{x:.6g}")
    if panel.level is not None:
        axis.axhline(panel.level, color=FAINT, lw=0.8, ls=":")
    for start, _ in times.starts[1:]:
        axis.axvline(start, color=FAINT, lw=0.6, ls=":")
    open_axis(axis, labelsize=8)


def draw_rows(figure: "Picture", rows: Rows, area: Sequence[float]) -> "list[Axes]":
    """Draw rows of panels above one another into an area of a figure, inches: left, bottom, right,
    top. The axes of a column have the same ends. Returns the axes."""
    left, bottom, right, top = area
    size = np.tile(figure.get_size_inches(), 2)
    widths = [(right - left) / len(row) - LEFT - RIGHT for row in rows]
    heads = [
        max(panel.margin_above(width) for _, panel in row)
        for row, width in zip(rows, widths, strict=True)
    ]
    # numbers below the last row, and below rows whose axes end elsewhere
    feet = [GAP if len(row) == 1 else NUMBERS for row in rows[:-1]] + [FOOT]
    height = (top - bottom - sum(heads) - sum(feet)) / len(rows)
    axes, named = [], False
    for row, width, head, foot in zip(rows, widths, heads, feet, strict=True):
        top -= head + height
        for k, (times, panel) in enumerate(row):
            start = left + LEFT + k * (width + LEFT + RIGHT)
            axis = figure.add_axes(tuple(np.array([start, top, width, height]) / size))
            axes.append(axis)
            draw_panel(axis, times, panel)
            _head(axis, panel, width)
            axis.tick_params(labelbottom=foot > GAP)
            if foot == FOOT:
                axis.set_xlabel(f"time ({times.unit})", fontsize=8, color=INK)
            if len(times.starts) > 1 and not named:
                named = True
                _label_stages(axis, times.starts, width)
        top -= foot
    return axes


def _head(axis: "Axes", panel: Panel, width: float) -> None:
    """Draw the title of a panel, and below it the legend."""
    lines, rows = panel.head(width)
    pad = 72 * LINE * rows + 5
    axis.set_title("\n".join(lines), loc="left", fontsize=9, color=INK, pad=pad)
    if rows:
        axis.legend(
            ncols=panel.columns(width),
            fontsize=8,
            labelcolor=INK,
            loc="lower left",
            bbox_to_anchor=(0, 1),
            borderaxespad=0.2,
            frameon=False,
            handlelength=1.4,
            columnspacing=1.2,
            labelspacing=0.2,
        )


def stack(rows: Rows, title: str, height: float = 0.0) -> "Picture":
    """A figure of rows of panels under a title."""
    height = height or HEIGHT * len(rows) + 0.6
    figure = new_figure(WIDTH, height, layout=None, title=title)
    draw_rows(figure, rows, (0.0, 0.02, WIDTH, height - 0.35))
    return figure


def _label_stages(axis: "Axes", starts: Sequence[tuple[float, str]], width: float) -> None:
    """Write the names of stages above the curves where they begin, each in the first free row of an
    axis of this width."""
    left, right = axis.get_xlim()
    ends: list[float] = []  # inches at which the last name of each row ends
    for start, label in starts:
        at, length = width * (start - left) / ((right - left) or 1.0), LETTER * (len(label) + 2)
        before = 2 * at > width and at + length > width  # the name is left of its start
        begin = at - length if before else at
        row = next((k for k, taken in enumerate(ends) if begin >= taken), len(ends))
        if row == MOST_ROWS:
            continue
        ends[row : row + 1] = [begin + length]
        offset, side = (-4, "right") if before else (4, "left")
        axis.annotate(
            label,
            (start, 1),
            (offset, -2 - 10 * row),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            va="top",
            fontsize=8,
            color=FAINT,
            ha=side,
        )
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.1 * len(ends) * (high - low))
