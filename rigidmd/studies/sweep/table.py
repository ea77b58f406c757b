"""The table of a sweep, a line for each combination of values with means and errors over its
replicas; its figure."""

import csv
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidmd.analysis.files import read_table
from rigidmd.analysis.rigid_frames import earlier_production, production_samples
from rigidmd.core.display import Displayed
from rigidmd.core.statistics import format_with_error, mean_and_error, standard_error
from rigidmd.engines.samples import BODY_COLUMNS, IN_LOGS, NOT_AVERAGED
from rigidmd.errors import RigidMDError
from rigidmd.figures.style import FAINT, INK, curve_style, open_axis, panel_grid, write_figure
from rigidmd.io.folder import add_to_folder
from rigidmd.io.write import Column, nine_digits, with_error
from rigidmd.io.write import Table as ReportTable
from rigidmd.run.record import Record, read_record
from rigidmd.scene.stage import Stage
from rigidmd.studies.sweep.folder import (
    FIGURE,
    SEED,
    TABLE,
    Manifest,
    describe_values,
    short_keys,
    value_name,
)

if TYPE_CHECKING:
    import pandas

POTENTIAL, DRIFT = "Potential Energy per molecule (kJ/mole)", "Drift (kT/ns per degree of freedom)"
#: Columns of the printed table and the figure: for molecules, for a body.
MAIN = ("Temperature (K)", POTENTIAL, "Pressure (bar)", "Density (g/mL)", DRIFT)
MAIN_OF_BODY = (
    "theta lowest (rad)",
    "theta highest (rad)",
    "energy end (J)",
    "energy_error largest",
    "L_size_error largest",
)
SHORT = {
    POTENTIAL: "U per molecule (kJ/mol)",
    DRIFT: "drift (kT/ns/d.o.f.)",
}  # short titles for the printed table
#: Columns of a body that are not in the table; nor are the entries of Q and of the quaternion.
NOT_OF_BODY = ("time", "orthogonality_error")

#: A value and its error, or None.
Measured = tuple[float, float | None]


@dataclass
class SweepRow:
    """A combination of values of all keys but the seed, and the results of its runs."""

    values: dict[str, Any]
    #: Value of the seed, None if it is not swept -> column -> value and error of that run.
    runs: dict[Any, dict[str, Measured]] = field(default_factory=dict)

    def __getitem__(self, column: str) -> Measured:
        """Mean over the runs and its standard error; for one run its value and error. NaN without a
        value."""
        found = [run[column] for run in self.runs.values() if column in run]
        if len(found) < 2:
            return found[0] if found else (nan, None)
        values = np.array([value for value, _ in found])
        if np.ptp(values) == 0:  # a constant has no error, which rounding would give it
            return float(values[0]), None
        return float(values.mean()), float(standard_error(values))


@dataclass
class Table(Displayed):
    """Results of a sweep: a row for each combination of values, columns of means and errors.

    table["Temperature (K)"] is a column of means as an array (rows,), table.error("Temperature
    (K)") of their errors, table["seed"] of the values of a key. failed : point -> why it has no
    results. runs : point that has finished -> folder of its run, for `rigidmd.read_run`
    """

    folder: Path
    keys: list[str]
    rows: list[SweepRow]
    columns: list[str]
    failed: dict[str, str] = field(default_factory=dict)
    runs: dict[str, Path] = field(default_factory=dict)
    #: Key -> the keys that vary together with it, itself included.
    together: dict[str, list[str]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        return (
            f"<Table of {len(self)} combinations of {', '.join(self.keys) or 'no keys'} in"
            f" {self.folder}>"
        )

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of means, or of the values of a key. Raises KeyError with all names."""
        if column in self.keys:
            return np.array([row.values[column] for row in self.rows])
        self._check(column)
        return np.array([row[column][0] for row in self.rows])

    def error(self, column: str) -> np.ndarray:
        """Standard errors of a column of means: over the runs of a row, or of its single run; NaN
        without one."""
        self._check(column)
        return np.array([nan if (error := row[column][1]) is None else error for row in self.rows])

    def to_dataframe(self) -> "pandas.DataFrame":
        """The table of sweep.csv. Raises ImportError without pandas."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_dataframe() needs pandas: pip install pandas") from None
        table = self.as_columns()
        rows = list(map(table.values, table.rows))
        return pandas.DataFrame(rows, columns=[column.header for column in table.columns])

    def as_columns(self) -> ReportTable:
        """Values of keys, number of runs, and each column with its error: the table of
        sweep.csv."""
        columns = [*key_columns(self.keys), Column("runs", lambda row: len(row.runs))]
        for name in self.columns:
            pair = with_error(
                name, lambda row, name=name: list(map(nine_digits, row[name])), f"{name} error"
            )
            columns += pair if any(row[name][1] is not None for row in self.rows) else pair[:1]
        return ReportTable(columns, self.rows)

    def _check(self, column: str) -> None:
        if column not in self.columns:
            raise KeyError(
                f"no column {column!r}; there are {', '.join([*self.keys, *self.columns])}"
            )


def key_columns(keys: Iterable[str]) -> list[Column]:
    """The columns of the values of the keys of a combination."""

    def cell(value):
        return value if type(value) in (int, float, str) else value_name(value)

    return [Column(key, lambda row, key=key: cell(row.values[key])) for key in keys]


def table_of(folder: Path, manifest: Manifest, with_analyses: bool = False) -> Table:
    """The table of the points that have finished. with_analyses : also of the values of analyses in
    their folders"""
    rows, columns, failed, runs = [], {}, {}, {}
    for values, points in manifest.combinations():
        row = SweepRow(values)
        for point in points:
            if point.state != "finished":
                continue
            try:
                found = summarise_run(read_record(folder / point.folder))
                if with_analyses:
                    values = [
                        v
                        for entry in read_table(folder / point.folder).values()
                        for v in entry.values
                    ]
                    found |= {v.header: (v.value, v.error) for v in values if v.value is not None}
            except RigidMDError as error:
                failed[point.folder] = str(error)
                continue
            row.runs[point.values.get("seed")] = found
            runs[point.folder] = folder / point.folder
            columns |= dict.fromkeys(found)
        rows.append(row)
    return Table(
        folder,
        list(rows[0].values) if rows else [],
        rows,
        list(columns),
        failed,
        runs,
        manifest.keys,
    )


def summarise_run(record: Record) -> dict[str, Measured]:
    """Results of a run: means over the production of molecules, figures of the motion of a body.
    Raises OutputError."""
    if record.is_body:
        return _summarise_motion(record)
    _, production = production_samples(record)
    found = _means_of(record, production)
    for stage, samples in earlier_production(record):
        means = _means_of(record, samples)
        found |= {
            f"{stage.label}: {header}": means[header] for header in _of_interest(means, stage)
        }
    stages = (record.summary or {}).get("stages") or [{}]
    if (drift := stages[-1].get("drift_kT_ns_per_degree_of_freedom")) is not None:
        found[DRIFT] = drift, stages[-1].get("drift_error_kT_ns_per_degree_of_freedom")
    return found


def _means_of(record: Record, production: np.ndarray) -> dict[str, Measured]:
    """Means of the columns of the log over some samples. A constant has no error."""
    found: dict[str, Measured] = {}
    described = record.log.described
    for name, values in record.columns.items():
        if name in NOT_AVERAGED:
            continue
        average, error = mean_and_error(values[production])
        if average is None:
            continue
        if np.ptp(values[production]) == 0:
            average, error = float(values[production][0]), None
        found[described[name].header] = average, error
        if name == "potential":
            n = len(record.system.model.species)
            found[POTENTIAL] = average / n, None if error is None else error / n
    return found


def _of_interest(means: dict[str, Measured], stage: Stage) -> list[str]:
    """Columns of an earlier stage: its main averages, and the box if it changes."""
    of_box = [IN_LOGS[name].header for name in ("volume", "a", "b", "c", "alpha", "beta", "gamma")]
    wanted = [*MAIN, *(of_box if stage.changes_box else [])]
    return [
        header for header in wanted if header in means and (header != DENSITY or stage.changes_box)
    ]


def _summarise_motion(record: Record) -> dict[str, Measured]:
    found: dict[str, Measured] = {}
    for name, values in record.columns.items():
        is_rotation = name[:2] in ("q1", "q2", "q3", "qw", "qx", "qy", "qz")
        if name in NOT_OF_BODY or is_rotation or not np.isfinite(values).all():
            continue
        unit = BODY_COLUMNS[name].unit if name in BODY_COLUMNS else "1"
        if name.endswith("_error"):
            found[f"{name} largest"] = float(np.abs(values).max()), None
            continue
        figures = {
            "mean": values.mean(),
            "lowest": values.min(),
            "highest": values.max(),
            "end": values[-1],
        }
        found |= {
            f"{name} {word} ({unit})": (float(value), None) for word, value in figures.items()
        }
    return found


def collect(folder: Path, manifest: Manifest) -> tuple[Table, list[Path]]:
    """The table of the finished points, and the files with table and figure. Raises OutputError."""
    table = table_of(folder, manifest)
    if not any(row.runs for row in table.rows):
        return table, []
    table.as_columns().write(folder / TABLE, csv.QUOTE_NONNUMERIC)
    files = [folder / TABLE, write_sweep_figure(table, manifest.name)]
    return table, [path for path in files if path is not None and path.is_file()]


def table_text(table: Table) -> str:
    return main_columns(table).text(left=())


def main_columns(table: Table) -> ReportTable:
    """The table that is printed and displayed: keys, number of runs, and the main columns with
    their errors."""

    def text(value: float, error: float | None) -> str:
        return format_with_error(value, error) if np.isfinite(value) else "-"

    short = short_keys(table.keys)
    shown = [name for name in (*MAIN, *MAIN_OF_BODY) if name in table.columns] + _earlier_densities(
        table
    )
    keys = [
        Column(short[key], lambda row, key=key: value_name(row.values[key])) for key in table.keys
    ]
    means = [
        Column(SHORT.get(name, name), lambda row, name=name: text(*row[name])) for name in shown
    ]
    return ReportTable([*keys, Column("runs", lambda row: str(len(row.runs))), *means], table.rows)


DENSITY, PRESSURE = "Density (g/mL)", "Pressure (bar)"
#: Relative error of the density from which on the volume is taken to change: the density is drawn,
#: not the pressure.
CHANGES = 1e-9
MOST_PANELS = 4
#: Inches of a panel; panels in a row; curves in the legend.
WIDTH, HEIGHT, ACROSS, MOST_NAMED = 4.4, 3.0, 2, 20
#: Fraction of the distance between values of the axis over which curves are spread, so that no
#: error bar hides another.
SPREAD = 0.06
#: Ratio of the largest to the smallest value from which on the axis is logarithmic; values that
#: need a power of ten.
DECADES, TINY = 100.0, 1e-3


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


ANALYSES_FIGURE = "analysis.png"
MOST_VALUES = 12  # panels of the figure of analyses


def write_analyses_figure(folder: Path, manifest: Manifest, rows: list[SweepRow]) -> None:
    """Write analysis.png: what analyses measured against the first numerical key. Nothing is
    written for values that only one combination has. Raises OutputError.

    rows : of the values of each combination, as results of a single run
    """
    count = {
        column: sum(column in run for row in rows for run in row.runs.values())
        for row in rows
        for column in row.runs[None]
    }
    shown = [column for column, times in count.items() if times > 1][:MOST_VALUES]
    keys = [key for key in manifest.keys if key != SEED]
    table = Table(folder, keys, rows, shown, together=manifest.keys)
    if shown:
        add_to_folder(folder, [ANALYSES_FIGURE])
        title = f"{manifest.name}: measured by analyses, with one standard error"
        write_figure(folder / ANALYSES_FIGURE, lambda: _figure(table, rows, shown, title))


def _earlier_densities(table: Table) -> list[str]:
    """Columns of densities of stages before the last one."""
    return [column for column in table.columns if column.endswith(f": {DENSITY}")]


#: Last parts of keys -> units on axes.
UNITS = {
    "K": "K",
    "fs": "fs",
    "ps": "ps",
    "A": "Å",
    "bar": "bar",
    "g_cm3": "g/cm³",
    "nm": "nm",
    "s": "s",
    "kg": "kg",
    "m": "m",
    "kJ_mol": "kJ/mol",
    "V_per_nm": "V/nm",
    "per_ps": "1/ps",
    "deg": "°",
    "u": "u",
    "rad": "rad",
}


def axis_label(key: str, together: Iterable[str]) -> str:
    """A swept key as the label of an axis: with its unit, and with the keys that vary together with
    it."""
    *place, name = key.split(".")
    ends = [end for end in UNITS if name.endswith(f"_{end}")]
    end = max(ends, key=len, default="")
    words = name.removesuffix(f"_{end}").replace("_", " ")
    label = " ".join(
        [words, *(["of", ".".join(place)] if place else []), *([f"({UNITS[end]})"] if end else [])]
    )
    others = [other for other in together if other != key]
    return f"{label}\ntogether with {', '.join(others)}" if others else label


def _shown_columns(table: Table) -> list[str]:
    """Columns that are drawn: the density instead of the pressure where a barostat moves the
    box."""
    there = [column for column in (*MAIN, *MAIN_OF_BODY) if column in table.columns]
    if DENSITY in there:
        runs = [run[DENSITY] for row in table.rows for run in row.runs.values()]
        changes = any((error or 0.0) > CHANGES * value for value, error in runs)
        there.remove(PRESSURE if changes and PRESSURE in there else DENSITY)
    there += _earlier_densities(table)
    if len(there) > MOST_PANELS and DRIFT in there:
        there.remove(DRIFT)
    return there[:MOST_PANELS]


def _figure(table: Table, rows: list[SweepRow], shown: list[str], title: str):
    """A panel for each column against the first key with numbers, else the first key; without keys
    against the seed."""
    columns = {key: [row.values[key] for row in table.rows] for key in table.keys}
    numbers = [
        key
        for key, values in columns.items()
        if all(type(value) in (int, float) for value in values)
    ]
    key = [*numbers, *table.keys, SEED][0]
    # the values at x = 0, 1, ... if they are not numbers
    words = list(dict.fromkeys(map(value_name, columns[key]))) if table.keys and not numbers else []
    figure, axes = panel_grid(len(shown), ACROSS, WIDTH, HEIGHT, 0.4)
    for axis, column in zip(axes, shown, strict=True):
        curves = _curves(table, rows, key, words, column)
        _draw(axis, curves, None if table.keys else rows[0][column])
        axis.set_title(column, loc="left", fontsize=9, color=INK)
        axis.set_xlabel(axis_label(key, table.together.get(key, ())), fontsize=9, color=INK)
        if words:
            slanted = max(map(len, words)) > 12
            style = {"rotation": 30, "ha": "right"} if slanted else {"rotation": 0, "ha": "center"}
            axis.set_xticks(range(len(words)), words, **style)
            axis.set_xlim(-0.5, len(words) - 0.5)
        elif all(float(x).is_integer() for at, _, _ in curves.values() for x in at):
            axis.locator_params(axis="x", integer=True)
    handles, labels = axes[0].get_legend_handles_labels()
    if 1 < len(labels) <= MOST_NAMED:
        figure.legend(
            handles,
            labels,
            loc="outside lower center",
            ncols=4,
            frameon=False,
            fontsize=8,
            labelcolor=INK,
        )
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK)
    return figure


def _curves(
    table: Table, rows: list[SweepRow], key: str, words: list[str], column: str
) -> dict[str, np.ndarray]:
    """Positions, means and errors (3, p), NaN where there are none, for each combination of the
    other keys."""
    points: dict[str, list] = {}
    if table.keys:
        others = short_keys(other for other in table.keys if other != key)
        for row in rows:
            x = words.index(value_name(row.values[key])) if words else float(row.values[key])
            label = describe_values({other: row.values[other] for other in others}, others)
            points.setdefault(label, []).append((x, *row[column]))
    else:
        points[""] = [
            (float(seed or 0), *run[column]) for seed, run in rows[0].runs.items() if column in run
        ]
    return {
        label: np.array(sorted(found), float).reshape(-1, 3).T for label, found in points.items()
    }


def _draw(axis, curves: dict[str, np.ndarray], band: tuple[float, float | None] | None) -> None:
    """Draw curves side by side. band : mean and error over all runs, drawn behind them"""
    curves = {label: points[:, np.isfinite(points[1])] for label, points in curves.items()}
    gaps = np.concatenate([np.diff(np.unique(x)) for x, _, _ in curves.values()])
    has_bars = any(np.isfinite(errors).any() for _, _, errors in curves.values())
    spread = has_bars * SPREAD * (gaps.min() if len(gaps) else 1.0) / max(1, len(curves) - 1)
    if band is not None:
        middle, error = band
        axis.axhline(middle, color=FAINT, lw=0.9, zorder=0)
        if error is not None:
            axis.axhspan(middle - error, middle + error, color=FAINT, alpha=0.25, lw=0, zorder=0)
    for k, (label, (x, means, errors)) in enumerate(curves.items()):
        shift = spread * (k - (len(curves) - 1) / 2)
        style = curve_style(k) | ({} if band is None and len(x) > 1 else {"ls": "none"})
        bars = {"capsize": 2.5, "elinewidth": 0.9, "label": label}
        axis.errorbar(x + shift, means, np.nan_to_num(errors), lw=0.9, ms=3.5, **bars, **style)
    values = np.concatenate([means for _, means, _ in curves.values()])
    values = values[np.isfinite(values)]
    if len(values) and values.min() > 0 and values.max() > DECADES * values.min():
        axis.set_yscale("log")
    elif not 0 < np.abs(values).max(initial=0.0) < TINY:
        axis.ticklabel_format(axis="y", useOffset=False)
    open_axis(axis, labelsize=8)
