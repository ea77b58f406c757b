"""The table of a sweep: a line for each combination of values, with means and errors over its replicas."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidmd.analysis.source import production_samples
from rigidmd.core.statistics import format_with_error, mean_and_error, standard_error
from rigidmd.engines.samples import BODY_COLUMNS, COLUMNS
from rigidmd.errors import RigidMDError
from rigidmd.io.table import Column, with_error
from rigidmd.io.table import Table as ReportTable
from rigidmd.io.write import nine_digits
from rigidmd.run.record import Record, read_record
from rigidmd.studies.sweep.folder import FINISHED, Manifest, short_keys, value_name

if TYPE_CHECKING:
    import pandas

#: Columns of the log whose means have no meaning.
LEFT_OUT = {
    "step", "time", "stage_name", "stage", "drift", "momentum", "orthogonality_error", "heat", "work", "conserved",
}  # fmt: skip
POTENTIAL, DRIFT = "Potential Energy per molecule (kJ/mole)", "Drift (kT/ns per degree of freedom)"
#: Columns of the printed table and the figure: for molecules, for a body.
MAIN = ("Temperature (K)", POTENTIAL, "Pressure (bar)", "Density (g/mL)", DRIFT)
MAIN_OF_BODY = (
    "theta lowest (rad)", "theta highest (rad)", "energy end (J)", "energy_error largest", "L_size_error largest",
)  # fmt: skip
#: Short titles for the printed table.
SHORT = {POTENTIAL: "U per molecule (kJ/mol)", DRIFT: "drift (kT/ns/d.o.f.)"}
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
        """Mean over the runs and its standard error; for one run its value and error. NaN without a value."""
        found = [run[column] for run in self.runs.values() if column in run]
        if len(found) < 2:
            return found[0] if found else (nan, None)
        values = np.array([value for value, _ in found])
        if np.ptp(values) == 0:  # where rounding would give it an error
            return float(values[0]), 0.0
        return float(values.mean()), float(standard_error(values))


@dataclass
class Table:
    """Results of a sweep: a row for each combination of values, columns of means and errors.

    table["Temperature (K)"] is a column of means as an array (rows,), table.error("Temperature (K)") of their errors,
    table["seed"] of the values of a key. failed : point -> why it has no results
    """

    folder: Path
    keys: list[str]
    rows: list[SweepRow]
    columns: list[str]
    failed: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        return f"<Table of {len(self)} combinations of {', '.join(self.keys) or 'no keys'} in {self.folder}>"

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of means, or of the values of a key. Raises KeyError with all names."""
        if column in self.keys:
            return np.array([row.values[column] for row in self.rows])
        self._check(column)
        return np.array([row[column][0] for row in self.rows])

    def error(self, column: str) -> np.ndarray:
        """Standard errors of a column of means: over the runs of a row, or of its single run; NaN without one."""
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
        """Values of keys, number of runs, and each column with its error: the table of sweep.csv."""
        columns = [*key_columns(self.keys), Column("runs", lambda row: len(row.runs))]
        for name in self.columns:
            pair = with_error(name, lambda row, name=name: list(map(nine_digits, row[name])), f"{name} error")
            columns += pair if any(row[name][1] is not None for row in self.rows) else pair[:1]
        return ReportTable(columns, self.rows)

    def _check(self, column: str) -> None:
        if column not in self.columns:
            raise KeyError(f"no column {column!r}; there are {', '.join([*self.keys, *self.columns])}")


def key_columns(keys: Iterable[str]) -> list[Column]:
    """The columns of the values of the keys of a combination."""

    def cell(value: Any) -> Any:
        return value if type(value) in (int, float, str) else value_name(value)

    return [Column(key, lambda row, key=key: cell(row.values[key])) for key in keys]


def table_of(folder: Path, manifest: Manifest) -> Table:
    """The table of the points that have finished."""
    rows, columns, failed = [], {}, {}
    for values, points in manifest.combinations():
        row = SweepRow(values)
        for point in points:
            if point.state != FINISHED:
                continue
            try:
                found = summarise_run(read_record(folder / point.folder))
            except RigidMDError as error:
                failed[point.folder] = str(error)
                continue
            row.runs[point.values.get("seed")] = found
            columns |= dict.fromkeys(found)
        rows.append(row)
    return Table(folder, list(rows[0].values) if rows else [], rows, list(columns), failed)


def summarise_run(record: Record) -> dict[str, Measured]:
    """Results of a run: for molecules means over the production of its last stage, for a body figures of its motion.

    Raises OutputError.
    """
    if record.is_body:
        return _summarise_motion(record)
    _, production = production_samples(record)
    found: dict[str, Measured] = {}
    for name, values in record.columns.items():
        if name in LEFT_OUT:
            continue
        average, error = mean_and_error(values[production])
        if average is None:
            continue
        if np.ptp(values[production]) == 0:
            average, error = float(values[production][0]), 0.0
        found[COLUMNS[name].header] = average, error
        if name == "potential":
            n = len(record.molecules.model.species)
            found[POTENTIAL] = average / n, None if error is None else error / n
    stages = (record.summary or {}).get("stages") or [{}]
    if (drift := stages[-1].get("drift_kT_ns_per_degree_of_freedom")) is not None:
        found[DRIFT] = drift, stages[-1].get("drift_error_kT_ns_per_degree_of_freedom")
    return found


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
        figures = {"mean": values.mean(), "lowest": values.min(), "highest": values.max(), "end": values[-1]}
        found |= {f"{name} {word} ({unit})": (float(value), None) for word, value in figures.items()}
    return found


def table_text(table: Table) -> str:
    def text(value: float, error: float | None) -> str:
        return format_with_error(value, error) if np.isfinite(value) else "-"

    short, shown = short_keys(table.keys), [name for name in (*MAIN, *MAIN_OF_BODY) if name in table.columns]
    keys = [Column(short[key], lambda row, key=key: value_name(row.values[key])) for key in table.keys]
    means = [Column(SHORT.get(name, name), lambda row, name=name: text(*row[name])) for name in shown]
    runs = Column("runs", lambda row: str(len(row.runs)))
    return ReportTable([*keys, runs, *means], table.rows).text(left=())
