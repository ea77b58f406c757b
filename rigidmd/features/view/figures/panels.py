"""Curves against time: the panels of a run, for its figures, pages and animations."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from textwrap import wrap
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.core.statistics import format_signed
from rigidmd.core.toml import Json
from rigidmd.engines.samples import moving
from rigidmd.features.view.figures.style import (
    COLORS,
    FAINT,
    INK,
    TEXT,
    TITLE,
    largest_of_parts,
    new_figure,
    open_axis,
    shown_range,
    thin_series,
)
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rigidmd.engines.system import System
    from rigidmd.features.view.figures.picture import Picture

#: Inches: a line of text, the space left and right of an axis.
LINE, LEFT, RIGHT = 0.165, 1.05, 0.2
#: Inches below an axis: without numbers, with numbers and their unit.
GAP, FOOT = 0.08, 0.42
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
#: Most stages whose drift is drawn, the last ones.
MOST_DRIFTS = 4
PER_MOLECULE, PER_FREEDOM = "kJ/mol per molecule", "kT per degree of freedom"
#: The drift and its error in a summary, in these units.
DRIFT_PER_MOLECULE = "drift_kJ_mol_ns_per_molecule", "drift_error_kJ_mol_ns_per_molecule"
DRIFT_PER_FREEDOM = "drift_kT_ns_per_degree_of_freedom", "drift_error_kT_ns_per_degree_of_freedom"


class Panel(NamedTuple):
    """Curves on one axis."""

    title: str
    curves: list[tuple[str, np.ndarray]]  # label, values (t,)
    unit: str = ""  # the label of the axis
    note: str = ""  # above the curves
    log: bool = False
    least: float = 0.0  # a smaller range is rounding
    level: float | None = None  # a dotted line
    zero: float | None = None  # where errors of exactly 0 are drawn, on a logarithmic axis

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


#: A panel with its times.
TimedPanel = tuple[Timeline, Panel]
#: Rows of panels.
Rows = Sequence[Sequence[TimedPanel]]


def molecular_timeline(system: "System", columns: Mapping[str, np.ndarray]) -> Timeline:
    time, stages, stage = columns["time"], system.scene.stages, columns["stage"].astype(int)
    shown = moving(stages, stage)
    names = tuple(stage.label for stage in stages)
    return Timeline(shown, time[shown], stage[shown], "ps", names)


def molecular_panels(
    system: "System", columns: Mapping[str, np.ndarray], stages: Sequence[Json] = ()
) -> list[TimedPanel]:
    """Temperatures, energies, pressure and box over the run, and the drift of the conserved energy
    in the last stages. stages : of the summary"""
    count = len(system.model.species)
    times = molecular_timeline(system, columns)

    def panel(title: str, unit: str, labels: dict[str, str], per: int = 1) -> list[TimedPanel]:
        curves = [
            (label, columns[name] / per)
            for name, label in labels.items()
            if name in columns and np.isfinite(columns[name][times.shown]).any()
        ]
        return [(times, Panel(title, curves, unit))] if curves else []

    temperatures = {"temperature_translation": "translation", "temperature_rotation": "rotation"}
    found = panel("temperature", "K", temperatures)
    found += panel("potential energy", PER_MOLECULE, {"potential": ""}, count)
    found += drift_panels(system, columns, stages)
    found += panel("pressure", "bar", {"pressure": ""})
    if "density" in columns and np.ptp(np.nan_to_num(columns["density"])) > 0:
        found += panel("density", "g/cm³", {"density": ""})
        found += panel("edges of the box", "Å", {edge: edge for edge in "abc"})
    return found


def drift_panels(
    system: "System", columns: Mapping[str, np.ndarray], stages: Sequence[Json] = ()
) -> list[TimedPanel]:
    """The conserved energy in each of the last stages, each on its own scale, and the line of its
    drift from the summary. stages : of the summary"""
    if "drift" not in columns:
        return []
    times = molecular_timeline(system, columns)
    found = []
    for k in np.unique(times.stage)[-MOST_DRIFTS:].tolist():
        part = times.of_stage(k)
        # an external engine may not report it
        if part.time.size > 1 and np.isfinite(columns["drift"][part.shown]).any():
            stage = stages[k] if k < len(stages) else {}  # {}: of a run that has not ended
            found.append((part, _drift_panel(part, k, columns["drift"], stage, system)))
    return found


def _drift_panel(
    times: Timeline, k: int, drift: np.ndarray, stage: Json, system: "System"
) -> Panel:
    """The conserved energy since a stage began, in kT per degree of freedom as in the summary, and
    the line of its drift. In kJ/mol per molecule without a temperature."""
    title = f"{system.scene.stages[k].label}: conserved energy"
    unit, key, values = PER_MOLECULE, DRIFT_PER_MOLECULE, drift / len(system.model.species)
    thermal = BOLTZMANN / KJ_PER_MOL * (stage.get("temperature_K") or 0.0)
    if thermal > 0 and stage.get(DRIFT_PER_FREEDOM[0]) is not None:
        unit, key = PER_FREEDOM, DRIFT_PER_FREEDOM
        values = drift / (thermal * system.freedom_in(k).total)
    gradient, error = map(stage.get, key)
    if gradient is None or times.time.size <= 2:
        return Panel(title, [("", values)], unit)
    line = np.full(len(values), np.nan)
    line[times.shown] = values[times.shown].mean() + gradient / 1000 * (
        times.time - times.time.mean()
    )
    rate, verdict = (
        text.replace(" ", "\N{NO-BREAK SPACE}")
        for text in (
            format_signed(gradient, error),
            (stage.get("drift_verdict") or "").partition(",")[0],
        )
    )
    note = f"drift {rate} per ns{verdict and f': {verdict}'}"
    return Panel(title, [("", values), ("", line)], unit, note)


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
        if panel.zero is not None and low == panel.zero:
            _label_zero(axis, panel.zero)
    else:
        margin = 0.05 * (high - low)
        if not high - low > max(panel.least, ROUNDING * max(abs(low), abs(high))):
            margin = 0.05 * max(abs(low), abs(high)) or 1.0
        axis.set_ylim(low - margin, high + margin)
        axis.locator_params(axis="y", nbins=6)
        axis.yaxis.set_major_formatter(_tick_text)
    if panel.level is not None:
        axis.axhline(panel.level, color=FAINT, lw=0.8, ls=":")
    for start, _ in times.starts[1:]:
        axis.axvline(start, color=FAINT, lw=0.6, ls=":")
    open_axis(axis, labelsize=TEXT)


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
    # times below the last row, and below rows whose axes end elsewhere
    feet = [GAP if len(row) == 1 else FOOT for row in rows[:-1]] + [FOOT]
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
            _write_note(axis, wrap(panel.note, int(width / LETTER)))
            unit = "\n".join(_balanced(panel.unit, int(height / LETTER)))
            axis.set_ylabel(unit, fontsize=TEXT, color=INK)
            axis.tick_params(labelbottom=foot > GAP)
            if foot == FOOT:
                axis.set_xlabel(f"time ({times.unit})", fontsize=TEXT, color=INK)
            if len(times.starts) > 1 and not named:
                named = True
                _label_stages(axis, times.starts, width)
        top -= foot
    return axes


def _tick_text(value: float, _: float) -> str:
    """A number at a tick, where neighbours such as 5e-05 and 0.0001 have one form."""
    text = f"{value:.6g}"
    if 1e-6 < abs(value) < 1e-4:
        text = np.format_float_positional(float(text), trim="-")
    return text.replace("-", "\N{MINUS SIGN}")


def _balanced(text: str, most: int) -> list[str]:
    """A text in as few lines as fit, of about one length."""
    lines = -(-len(text) // max(1, most))
    return wrap(text, len(text) // lines + 3) if lines > 1 else [text]


def _label_zero(axis: "Axes", zero: float) -> None:
    """Label a power of ten on a logarithmic axis as 0."""
    from matplotlib.ticker import FixedLocator, FuncFormatter

    decades = np.log10(axis.get_ylim()[1] / zero)
    ticks = np.arange(0, decades, max(1, round(decades / 6)))
    axis.yaxis.set_major_locator(FixedLocator(zero * 10.0**ticks))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.0e}" if x > 2 * zero else "0"))


def _write_note(axis: "Axes", lines: Sequence[str]) -> None:
    """Write lines above the curves."""
    if lines:
        style = {"va": "top", "fontsize": TEXT, "color": INK}
        axis.text(0.02, 0.99, "\n".join(lines), transform=axis.transAxes, **style)
        low, high = axis.get_ylim()
        axis.set_ylim(low, high + 0.14 * len(lines) * (high - low))


def _head(axis: "Axes", panel: Panel, width: float) -> None:
    """Draw the title of a panel, and below it the legend."""
    lines, rows = panel.head(width)
    pad = 72 * LINE * rows + 5
    axis.set_title("\n".join(lines), loc="left", fontsize=TITLE, color=INK, pad=pad)
    if rows:
        axis.legend(
            ncols=panel.columns(width),
            fontsize=TEXT,
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
            fontsize=TEXT,
            color=FAINT,
            ha=side,
        )
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.1 * len(ends) * (high - low))
