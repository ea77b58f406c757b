"""Figures of sweeps: means with errors against a key, a panel for each quantity."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.features.studies.sweep.folder import (
    FIGURE,
    SEED,
    TABLE,
    Manifest,
    describe_values,
    readable_key,
    short_keys,
    value_name,
)
from rigidmd.features.studies.sweep.table import (
    DENSITY,
    DRIFT,
    PRESSURE,
    SweepRow,
    Table,
    main_titles,
    report_of,
    table_of,
)
from rigidmd.features.view.figures.style import (
    FAINT,
    INK,
    TEXT,
    TITLE,
    curve_style,
    open_axis,
    panel_grid,
    write_figure,
)
from rigidmd.io.folder import add_to_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rigidmd.features.view.figures.picture import Picture

#: Relative error of the density from which on the volume is taken to change: the density is drawn,
#: not the pressure.
CHANGES = 1e-9
MOST_PANELS = 4
ANALYSES_FIGURE, MOST_VALUES = "analysis.png", 12  # its number of panels
MOST_NAMED = 20  # curves in the legend
SPREAD = 1 / 36  # inches between neighbouring curves with errors, so that none hides another
LONG_WORD = 12  # letters of a value from which on the values are written at an angle
#: Ratio of the largest to the smallest value from which on the axis is logarithmic; values that
#: need a power of ten.
DECADES, TINY = 100.0, 1e-3


def collect(manifest: Manifest) -> tuple[Table, list[Path]]:
    """The table of the finished points, and the files with table and figure. Raises OutputError."""
    table = table_of(manifest)
    if not table.runs:
        return table, []
    report_of(table.lines()).write(table.folder / TABLE, quote_text=True)
    write_sweep_figure(table, manifest.name)
    files = [table.folder / TABLE, table.folder / FIGURE]
    return table, [path for path in files if path.is_file()]


def write_sweep_figure(table: Table, name: str) -> None:
    """Write sweep.png, if there is anything to draw. Raises OutputError."""
    counts = [row.count for row in table.rows if row.runs]
    columns = _drawn_columns(table)
    if not columns or not counts:
        return
    title = name
    if any(map(table.has_error, columns)):
        runs = f"{min(counts)}" if len({*counts}) == 1 else f"{min(counts)} to {max(counts)}"
        over = f"means over {runs} runs, with" if max(counts) > 1 else "with"
        title = f"{name}: {'' if table.keys else 'each run, and '}{over} one standard error"
    write_figure(table.folder / FIGURE, lambda: draw_table(table, columns), title)


def write_analyses_figure(table: Table, name: str) -> None:
    """Write analysis.png: what analyses measured against the first numerical key. Nothing is
    written for values that only one combination has. Raises OutputError."""
    columns = [name for name in table.columns if np.isfinite(table[name]).sum() > 1][:MOST_VALUES]
    if columns:
        add_to_folder(table.folder, [ANALYSES_FIGURE])
        title = f"{name}: measured by analyses, with one standard error"
        write_figure(table.folder / ANALYSES_FIGURE, lambda: draw_table(table, columns), title)


def axis_label(key: str, together: Iterable[str], short: str = "") -> str:
    """A swept key as the label of an axis, as in the table: with its unit, and with the keys that
    vary together with it. short : the key without what all keys have"""
    label = readable_key(short or key)
    if key != SEED:
        label = f"set {label}"
    others = [other for other in together if other != key]
    return f"{label}\ntogether with {', '.join(others)}" if others else label


def _drawn_columns(table: Table) -> list[str]:
    """Columns that are drawn: the density instead of the pressure where a barostat moves the
    box."""
    columns = table.main_columns()
    omitted = []
    if DENSITY in columns:
        changes = table.error(DENSITY) > CHANGES * table[DENSITY]
        omitted.append(PRESSURE if changes.any() else DENSITY)
    if len(columns) - len(omitted) > MOST_PANELS:
        omitted.append(DRIFT)
    return [column for column in columns if column not in omitted][:MOST_PANELS]


def panels(columns: Sequence[str]) -> "tuple[Picture, list[Axes]]":
    """A figure with a panel for each column."""
    titles = main_titles()
    figure, axes = panel_grid(len(columns), 2 if len(columns) <= MOST_PANELS else 3, 4.4, 3.0, 0.4)
    for axis, column in zip(axes, columns, strict=True):
        title = titles.get(column, column)
        axis.set_title(title, loc="left", fontsize=TITLE, color=INK)
        open_axis(axis, labelsize=TEXT)
    return figure, axes


def add_legend(figure: "Picture", axis: "Axes") -> None:
    """Name the curves of one panel, which all have, if there are several and not too many."""
    handles, labels = axis.get_legend_handles_labels()
    if 1 < len(labels) <= MOST_NAMED:
        figure.legend(
            handles,
            labels,
            loc="outside lower center",
            ncols=4,
            frameon=False,
            fontsize=TEXT,
            labelcolor=INK,
        )


def _is_number(value: object) -> bool:
    return type(value) in (int, float)


def draw_table(table: Table, columns: list[str]) -> "Picture":
    """A panel for each column against the first key with numbers, else the first key. Without keys
    against the seed."""
    rows = [row for row in table.rows if row.runs]
    numbers = [key for key in table.keys if all(_is_number(row.values[key]) for row in rows)]
    key = [*numbers, *table.keys, SEED][0]
    figure, axes = panels(columns)
    if key == SEED:
        for axis, column in zip(axes, columns, strict=True):
            _draw_band(axis, *rows[0][column])
        rows = [SweepRow({SEED: seed}, {seed: run}) for seed, run in rows[0].runs.items()]
        numbers = [SEED]
    if numbers:
        rows.sort(key=lambda row: row.values[key])
    others = short_keys(other for other in table.keys if other != key)
    curves: dict[str, list[SweepRow]] = {}
    for row in rows:
        label = describe_values({other: row.values[other] for other in others}, others)
        curves.setdefault(label, []).append(row)
    values = [row.values[key] for row in rows]
    short = short_keys(table.keys).get(key, key)
    label = axis_label(key, table.together.get(key, ()), short)
    for axis, column in zip(axes, columns, strict=True):
        _draw(axis, curves, key, column)
        axis.set_xlabel(label, fontsize=TITLE, color=INK)
        if numbers and all(float(value).is_integer() for value in values):
            axis.locator_params(axis="x", integer=True)
        elif not numbers and max(len(value_name(value)) for value in values) > LONG_WORD:
            axis.tick_params(axis="x", rotation=20)
    add_legend(figure, axes[0])
    return figure


def _draw_band(axis: "Axes", mean: float, error: float | None) -> None:
    """Draw the mean over all runs, and its error."""
    error = error or 0.0
    axis.axhline(mean, color=FAINT, lw=0.9, zorder=0)
    axis.axhspan(mean - error, mean + error, color=FAINT, alpha=0.25, lw=0, zorder=0)


def _draw(axis: "Axes", curves: dict[str, list[SweepRow]], key: str, column: str) -> None:
    """Draw a column against a key, a curve for each label."""
    from matplotlib.transforms import ScaledTranslation  # slow to import

    drawn = []
    for k, (label, rows) in enumerate(curves.items()):
        x = [row.values[key] for row in rows]
        if not all(map(_is_number, x)):
            x = list(map(value_name, x))
        means, errors = np.array([row[column] for row in rows], float).T
        shift = SPREAD * (k - (len(curves) - 1) / 2)
        offset = ScaledTranslation(shift, 0, axis.figure.dpi_scale_trans)
        curve = axis.errorbar(
            x,
            means,
            np.nan_to_num(errors),
            label=label,
            lw=0.9,
            ms=3.5,
            capsize=2.5,
            elinewidth=0.9,
            **curve_style(k, connected=key != SEED),
        )
        if np.isfinite(errors).any():
            for artist in curve.get_children():
                artist.set_transform(artist.get_transform() + offset)
        drawn += [*means[np.isfinite(means)]]
    if drawn and min(drawn) > 0 and max(drawn) > DECADES * min(drawn):
        axis.set_yscale("log")
    elif not 0 < np.abs(drawn).max(initial=0.0) < TINY:
        axis.ticklabel_format(axis="y", useOffset=False)
