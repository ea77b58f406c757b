"""sweep.png: the main observables of a sweep against a varied key, with their errors."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.figures.style import FAINT, INK, curve_style, new_figure, open_axis, write_figure
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
#: Ratio of the largest to the smallest value from which on the axis is logarithmic; values that need a power of ten.
DECADES, TINY = 100.0, 1e-3


class SweepCurve(NamedTuple):
    """Means (p,) with errors (p,), NaN where there are none, at positions x (p,)."""

    label: str
    x: np.ndarray
    values: np.ndarray
    errors: np.ndarray


def write_sweep_figure(table: Table, name: str) -> Path | None:
    """Write sweep.png; None without anything to draw. Raises OutputError."""
    shown, rows = _shown_columns(table), [row for row in table.rows if row.runs]
    if not shown or not rows:
        return None
    counts = sorted({len(row.runs) for row in rows})
    runs = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    over = f"means over {runs} runs, with" if counts[-1] > 1 else "with"
    over = over if table.keys else f"each run, and {over}"
    has_errors = any(row[column][1] is not None for row in rows for column in shown)
    title = f"{name}: {over} one standard error" if has_errors else name
    write_figure(table.folder / FIGURE, lambda: _figure(table, rows, shown, title))
    return table.folder / FIGURE


def _shown_columns(table: Table) -> list[str]:
    """Columns that are drawn: the density instead of the pressure where a barostat moves the box."""
    there = [column for column in (*MAIN, *MAIN_OF_BODY) if column in table.columns]
    if DENSITY in there:
        runs = [run[DENSITY] for row in table.rows for run in row.runs.values()]
        changes = any((error or 0.0) > CHANGES * value for value, error in runs)
        there.remove(PRESSURE if changes and PRESSURE in there else DENSITY)
    if len(there) > MOST_PANELS and DRIFT in there:
        there.remove(DRIFT)
    return there[:MOST_PANELS]


def _figure(table: Table, rows: list[SweepRow], shown: list[str], title: str):
    """A panel for each column against the first key with numbers, else the first key; without keys against the seed."""
    columns = {key: [row.values[key] for row in table.rows] for key in table.keys}
    numbers = [key for key, values in columns.items() if all(type(value) in (int, float) for value in values)]
    key = [*numbers, *table.keys, SEED][0]
    # the values at x = 0, 1, ... if they are not numbers
    words = list(dict.fromkeys(map(value_name, columns[key]))) if table.keys and not numbers else []
    across = min(ACROSS, len(shown))
    down = -(-len(shown) // across)
    figure = new_figure(WIDTH * across, HEIGHT * down + 0.4)
    axes = list(figure.subplots(down, across, squeeze=False).flat)
    for axis, column in zip(axes, shown, strict=False):
        curves = _curves(table, rows, key, words, column)
        _draw(axis, curves, None if table.keys else rows[0][column])
        axis.set_title(column, loc="left", fontsize=9, color=INK)
        axis.set_xlabel(key, fontsize=9, color=INK)
        if words:
            slanted = max(map(len, words)) > 12
            style = {"rotation": 30, "ha": "right"} if slanted else {"rotation": 0, "ha": "center"}
            axis.set_xticks(range(len(words)), words, **style)
            axis.set_xlim(-0.5, len(words) - 0.5)
        elif all(float(x).is_integer() for curve in curves for x in curve.x):
            axis.locator_params(axis="x", integer=True)
    for axis in axes[len(shown) :]:
        axis.axis("off")
    handles, labels = axes[0].get_legend_handles_labels()
    if 1 < len(labels) <= MOST_NAMED:
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8, labelcolor=INK)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK)
    return figure


def _curves(table: Table, rows: list[SweepRow], key: str, words: list[str], column: str) -> list[SweepCurve]:
    """A curve for each combination of the other keys; without keys the values of the single runs."""
    points: dict[str, list] = {}
    if table.keys:
        others = short_keys(other for other in table.keys if other != key)
        for row in rows:
            x = words.index(value_name(row.values[key])) if words else float(row.values[key])
            label = describe_values({other: row.values[other] for other in others}, others)
            points.setdefault(label, []).append((x, *row[column]))
    else:
        points[""] = [(float(seed or 0), *run[column]) for seed, run in rows[0].runs.items() if column in run]
    return [
        SweepCurve(label, *np.array(sorted(of_label), float).reshape(-1, 3).T) for label, of_label in points.items()
    ]


def _draw(axis, curves: list[SweepCurve], band: tuple[float, float | None] | None) -> None:
    """Draw curves side by side. band : mean and error over all runs, drawn behind them"""
    gaps = np.concatenate([np.diff(np.unique(curve.x)) for curve in curves])
    has_bars = any(np.isfinite(curve.errors).any() for curve in curves)
    spread = has_bars * SPREAD * (gaps.min() if len(gaps) else 1.0) / max(1, len(curves) - 1)
    if band is not None:
        middle, error = band
        axis.axhline(middle, color=FAINT, lw=0.9, zorder=0)
        if error is not None:
            axis.axhspan(middle - error, middle + error, color=FAINT, alpha=0.25, lw=0, zorder=0)
    for k, curve in enumerate(curves):
        shift = spread * (k - (len(curves) - 1) / 2)
        style = curve_style(k) | ({} if band is None and len(curve.x) > 1 else {"ls": "none"})
        bars = {"capsize": 2.5, "elinewidth": 0.9, "label": curve.label}
        axis.errorbar(curve.x + shift, curve.values, np.nan_to_num(curve.errors), lw=0.9, ms=3.5, **bars, **style)
    values = np.concatenate([curve.values for curve in curves])
    values = values[np.isfinite(values)]
    if len(values) and values.min() > 0 and values.max() > DECADES * values.min():
        axis.set_yscale("log")
    elif not 0 < np.abs(values).max(initial=0.0) < TINY:
        axis.ticklabel_format(axis="y", useOffset=False)
    open_axis(axis, labelsize=8)
