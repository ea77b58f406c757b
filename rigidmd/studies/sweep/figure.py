"""sweep.png: the main observables of a sweep against what was varied, with their errors."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.figures.style import FAINT, INK, bare_axis, curve_style, write_figure
from rigidmd.studies.sweep.folder import FIGURE, SEED
from rigidmd.studies.sweep.names import in_words, short_keys, value_name
from rigidmd.studies.sweep.table import DRIFT, MAIN, MAIN_OF_BODY, Row, Table

DENSITY, PRESSURE = "Density (g/mL)", "Pressure (bar)"
#: Change of the density, as a fraction, from which on it is drawn in place of the pressure.
MOVES = 1e-9
MOST_PANELS = 4
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


def draw_sweep(table: Table, name: str) -> Path | None:
    """Write sweep.png; None without anything to draw. Raises OutputError."""
    shown = _shown(table)
    rows = [row for row in table.rows if row.runs]
    if not shown or not rows:
        return None
    if not table.keys:
        axis, panels = Axis(SEED), [_of_replicas(rows[0], column) for column in shown]
    else:
        key = _across(table)
        axis, places = _places(table, key)
        panels = [Panel(column, _curves(table, rows, key, column, places)) for column in shown]
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
        moves = any(
            (run[DENSITY][1] or 0.0) > MOVES * run[DENSITY][0] for row in table.rows for run in row.runs.values()
        )
        there.remove(PRESSURE if moves and PRESSURE in there else DENSITY)
    if len(there) > MOST_PANELS and DRIFT in there:
        there.remove(DRIFT)
    return there[:MOST_PANELS]


def _across(table: Table) -> str:
    """The key along the axis: the first one with numbers, else the first."""
    return next((key for key in table.keys if _is_number([row.values[key] for row in table.rows])), table.keys[0])


def _is_number(values: list[Any]) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)


def _places(table: Table, key: str) -> tuple[Axis, dict[str, float]]:
    """The axis, and value -> place on it."""
    values = [row.values[key] for row in table.rows]
    if _is_number(values):
        return Axis(key), {value_name(value): float(value) for value in values}
    words = list(dict.fromkeys(map(value_name, values)))
    return Axis(key, words), {word: float(k) for k, word in enumerate(words)}


def _curves(table: Table, rows: list[Row], key: str, column: str, places: dict[str, float]) -> list[Curve]:
    """A curve for each combination of the other keys."""
    others = short_keys(other for other in table.keys if other != key)
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(in_words({other: row.values[other] for other in others}, others), []).append(row)
    found = []
    for label, own in groups.items():
        points = sorted((places[value_name(row.values[key])], *_numbers(row, column)) for row in own)
        x, values, errors = (np.array(part) for part in zip(*points, strict=True))
        found.append(Curve(label, x, values, errors))
    return found


def _numbers(row: Row, column: str) -> tuple[float, float]:
    value, error = row[column]
    return value, np.nan if error is None else error


def _of_replicas(row: Row, column: str) -> Panel:
    """Each run with its own error, and the mean over all with its."""
    points = [(float(seed or 0), *run[column]) for seed, run in row.runs.items() if column in run]
    if not points:
        return Panel(column, [Curve("", np.zeros(0), np.zeros(0), np.zeros(0))])
    x, values, errors = (np.array([np.nan if y is None else y for y in part]) for part in zip(*points, strict=True))
    return Panel(column, [Curve("", x, values, errors)], _numbers(row, column))


def _figure(title: str, axis: Axis, panels: list[Panel]):
    from rigidmd.figures.picture import Picture

    across = min(ACROSS, len(panels))
    down = -(-len(panels) // across)
    figure = Picture(figsize=(WIDTH * across, HEIGHT * down + 0.4), layout="constrained")
    grid = figure.subplots(down, across, squeeze=False)
    for place, panel in zip(grid.flat, panels, strict=False):
        _draw(place, axis, panel)
    for place in grid.flat[len(panels) :]:
        place.axis("off")
    labels = panels[0].curves
    if 1 < len(labels) <= MOST_NAMED:
        figure.legend(
            *grid.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=8,
            labelcolor=INK,
        )  # fmt: skip
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK)
    return figure


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
