"""sweep.png: the main observables of a sweep against a varied key, with their errors."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.figures.style import FAINT, INK, curve_style, open_axis, write_figure
from rigidmd.studies.sweep.folder import FIGURE, SEED, describe_values, short_keys, value_name
from rigidmd.studies.sweep.table import DRIFT, MAIN, MAIN_OF_BODY, SweepRow, Table

DENSITY, PRESSURE = "Density (g/mL)", "Pressure (bar)"
#: Relative error of the density from which on the volume is taken to change: the density is drawn, not the pressure.
CHANGES = 1e-9
MOST_PANELS = 4
#: Inches of a panel; panels in a row; curves in the legend.
WIDTH, HEIGHT, ACROSS, MOST_NAMED = 4.4, 3.0, 2, 20
#: Fraction of the distance between values of the axis over which curves are spread, so that no error bar hides another.
SPREAD = 0.06
#: Ratio of the largest to the smallest value from which on the axis is logarithmic.
DECADES = 100.0


class SweepCurve(NamedTuple):
    """Means (p,) with errors (p,), NaN where there are none, at positions x (p,)."""

    label: str
    x: np.ndarray
    values: np.ndarray
    errors: np.ndarray


class SweepPanel(NamedTuple):
    """Curves of one observable. band : mean and error over all of them"""

    title: str
    curves: list[SweepCurve]
    band: tuple[float, float] | None = None


class HorizontalAxis(NamedTuple):
    """A varied key. names : the values at x = 0, 1, ... if they are not numbers"""

    label: str
    names: list[str] | None = None


def draw_sweep(table: Table, name: str) -> Path | None:
    """Write sweep.png; None without anything to draw. Raises OutputError."""
    shown = _shown(table)
    rows = [row for row in table.rows if row.runs]
    if not shown or not rows:
        return None
    if not table.keys:
        axis, panels = HorizontalAxis(SEED), [_of_replicas(rows[0], column) for column in shown]
    else:
        # the first key with numbers, else the first
        key = next((key for key in table.keys if _is_number([row.values[key] for row in table.rows])), table.keys[0])
        axis, positions = _positions(table, key)
        panels = [SweepPanel(column, _curves(table, rows, key, column, positions)) for column in shown]
    counts = sorted({len(row.runs) for row in rows})
    runs = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    over = f"means over {runs} runs, with" if counts[-1] > 1 else "with"
    has_errors = any(row[column][1] is not None for row in rows for column in shown)
    over = over if table.keys else f"each run, and {over}"
    title = f"{name}: {over} one standard error" if has_errors else name
    write_figure(table.folder / FIGURE, lambda: _figure(title, axis, panels))
    return table.folder / FIGURE


def _shown(table: Table) -> list[str]:
    """Columns that are drawn: the density instead of the pressure where a barostat moves the box."""
    there = [column for column in (*MAIN, *MAIN_OF_BODY) if column in table.columns]
    if DENSITY in there:
        changes = any(
            (run[DENSITY][1] or 0.0) > CHANGES * run[DENSITY][0] for row in table.rows for run in row.runs.values()
        )
        there.remove(PRESSURE if changes and PRESSURE in there else DENSITY)
    if len(there) > MOST_PANELS and DRIFT in there:
        there.remove(DRIFT)
    return there[:MOST_PANELS]


def _is_number(values: list[Any]) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)


def _positions(table: Table, key: str) -> tuple[HorizontalAxis, dict[str, float]]:
    """The axis, and value -> position on it."""
    values = [row.values[key] for row in table.rows]
    if _is_number(values):
        return HorizontalAxis(key), {value_name(value): float(value) for value in values}
    names = list(dict.fromkeys(map(value_name, values)))
    return HorizontalAxis(key, names), {name: float(k) for k, name in enumerate(names)}


def _curves(table: Table, rows: list[SweepRow], key: str, column: str, positions: dict[str, float]) -> list[SweepCurve]:
    """A curve for each combination of the other keys."""
    others = short_keys(other for other in table.keys if other != key)
    groups: dict[str, list[SweepRow]] = {}
    for row in rows:
        groups.setdefault(describe_values({other: row.values[other] for other in others}, others), []).append(row)
    found = []
    for label, members in groups.items():
        points = sorted((positions[value_name(row.values[key])], *_value_and_error(row, column)) for row in members)
        x, values, errors = (np.array(part) for part in zip(*points, strict=True))
        found.append(SweepCurve(label, x, values, errors))
    return found


def _value_and_error(row: SweepRow, column: str) -> tuple[float, float]:
    value, error = row[column]
    return value, np.nan if error is None else error


def _of_replicas(row: SweepRow, column: str) -> SweepPanel:
    """The value of each run with its error, and the mean over all with its error."""
    points = [(float(seed or 0), *run[column]) for seed, run in row.runs.items() if column in run]
    if not points:
        return SweepPanel(column, [SweepCurve("", np.zeros(0), np.zeros(0), np.zeros(0))])
    x, values, errors = (np.array([np.nan if y is None else y for y in part]) for part in zip(*points, strict=True))
    return SweepPanel(column, [SweepCurve("", x, values, errors)], _value_and_error(row, column))


def _figure(title: str, axis: HorizontalAxis, panels: list[SweepPanel]):
    from rigidmd.figures.picture import Picture

    across = min(ACROSS, len(panels))
    down = -(-len(panels) // across)
    figure = Picture(figsize=(WIDTH * across, HEIGHT * down + 0.4), layout="constrained")
    grid = figure.subplots(down, across, squeeze=False)
    for panel_axes, panel in zip(grid.flat, panels, strict=False):
        _draw(panel_axes, axis, panel)
    for panel_axes in grid.flat[len(panels) :]:
        panel_axes.axis("off")
    labels = panels[0].curves
    if 1 < len(labels) <= MOST_NAMED:
        figure.legend(
            *grid.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=8,
            labelcolor=INK,
        )  # fmt: skip
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK)
    return figure


def _draw(panel_axes, axis: HorizontalAxis, panel: SweepPanel) -> None:
    gaps = np.concatenate([np.diff(np.unique(curve.x)) for curve in panel.curves])
    has_bars = any(np.isfinite(curve.errors).any() for curve in panel.curves)
    spread = has_bars * SPREAD * (gaps.min() if len(gaps) else 1.0) / max(1, len(panel.curves) - 1)
    if panel.band is not None:
        middle, error = panel.band
        panel_axes.axhline(middle, color=FAINT, lw=0.9, zorder=0)
        if np.isfinite(error):
            panel_axes.axhspan(middle - error, middle + error, color=FAINT, alpha=0.25, lw=0, zorder=0)
    for k, curve in enumerate(panel.curves):
        shift = spread * (k - (len(panel.curves) - 1) / 2)
        style = curve_style(k)
        joined = {} if panel.band is None and len(curve.x) > 1 else {"ls": "none"}
        panel_axes.errorbar(
            curve.x + shift, curve.values, np.nan_to_num(curve.errors), lw=0.9, ms=3.5, capsize=2.5, elinewidth=0.9,
            label=curve.label, **(style | joined),
        )  # fmt: skip
    panel_axes.set_title(panel.title, loc="left", fontsize=9, color=INK)
    panel_axes.set_xlabel(axis.label, fontsize=9, color=INK)
    if axis.names is not None:
        slanted = max(map(len, axis.names), default=0) > 12
        panel_axes.set_xticks(
            range(len(axis.names)), axis.names, rotation=30 if slanted else 0, ha="right" if slanted else "center"
        )
        panel_axes.set_xlim(-0.5, len(axis.names) - 0.5)
    elif all(float(x).is_integer() for curve in panel.curves for x in curve.x):
        from matplotlib.ticker import MaxNLocator

        panel_axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if _spans_decades(panel):
        panel_axes.set_yscale("log")
    elif not _is_tiny(panel):
        panel_axes.ticklabel_format(axis="y", useOffset=False)
    open_axis(panel_axes, labelsize=8)


def _spans_decades(panel: SweepPanel) -> bool:
    """Whether positive values need a logarithmic axis."""
    values = np.concatenate([curve.values for curve in panel.curves])
    values = values[np.isfinite(values)]
    return bool(len(values) and values.min() > 0 and values.max() > DECADES * values.min())


def _is_tiny(panel: SweepPanel) -> bool:
    """Whether values are so small that they need a power of ten."""
    largest = max((np.nanmax(np.abs(curve.values), initial=0.0) for curve in panel.curves), default=0.0)
    return bool(0 < largest < 1e-3)
