"""The table of a sweep: a line for each combination of values, with means and errors over its replicas."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidmd.analysis.source import production_of
from rigidmd.core.statistics import mean, standard_error, with_error
from rigidmd.engines.columns import BODY_COLUMNS
from rigidmd.engines.samples import COLUMNS
from rigidmd.errors import RigidMDError
from rigidmd.io.write import columns_text, nine_digits, write_csv
from rigidmd.run.record import Record, read_record
from rigidmd.studies.sweep.folder import FINISHED, TABLE, Manifest
from rigidmd.studies.sweep.names import short_keys, value_name

if TYPE_CHECKING:
    import pandas

#: Columns of the log whose means say nothing.
LEFT_OUT = {"step", "time", "stage_name", "stage", "drift", "momentum", "orthogonality_error", "heat", "work", "conserved"}
POTENTIAL, DRIFT = "Potential Energy per molecule (kJ/mole)", "Drift (kT/ns per degree of freedom)"
#: Columns that a person reads, where there are any: of molecules, of a body.
MAIN = ("Temperature (K)", POTENTIAL, "Pressure (bar)", "Density (g/mL)", DRIFT)
MAIN_OF_BODY = (
    "theta lowest (rad)", "theta highest (rad)", "energy end (J)", "energy_error largest", "L_size_error largest",
)  # fmt: skip
#: What they are called where there is little room.
SHORT = {POTENTIAL: "U per molecule (kJ/mol)", DRIFT: "drift (kT/ns/d.o.f.)"}
#: Columns of a body that the table leaves out: rotation in its other forms.
NOT_OF_BODY = ("time", "orthogonality_error")

#: A value and its error; None without one.
Measured = tuple[float, float | None]


@dataclass
class Row:
    """A combination of values of all keys but the seed, and what its runs gave.

    runs : value of the seed, None if it is not swept -> column -> value and its own error, of each run
    """

    values: dict[str, Any]
    runs: dict[Any, dict[str, Measured]] = field(default_factory=dict)

    def __getitem__(self, column: str) -> Measured:
        """Mean over the runs, and its standard error over them; of one run its own. NaN without a value."""
        found = [run[column] for run in self.runs.values() if column in run]
        if len(found) < 2:
            return found[0] if found else (nan, None)
        values = np.array([value for value, _ in found])
        if np.ptp(values) == 0:  # where rounding would give it an error
            return float(values[0]), 0.0
        return float(values.mean()), float(standard_error(values))


@dataclass
class Table:
    """What a sweep gave: a row for each combination of values, columns of means and errors.

    table["Temperature (K)"] is a column of means as an array (rows,), table.error("Temperature (K)") of their errors,
    table["seed"] of the values of a key. failed : point -> why it gave nothing
    """

    folder: Path
    keys: list[str]
    rows: list[Row]
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
        """Standard errors of a column of means: over the runs of a row, of a single run its own; NaN without one."""
        self._check(column)
        return np.array([nan if (error := row[column][1]) is None else error for row in self.rows])

    def to_dataframe(self) -> "pandas.DataFrame":
        """The table as sweep.csv has it. Raises ImportError without pandas."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_dataframe() needs pandas: pip install pandas") from None
        head, *lines = self.lines()
        return pandas.DataFrame(lines, columns=head)

    def lines(self) -> list[list[Any]]:
        """Header and rows: values of keys, number of runs, and for each column its mean and its error."""
        bare = [column for column in self.columns if all(row[column][1] is None for row in self.rows)]
        head: list[Any] = [*self.keys, "runs"]
        for column in self.columns:
            head += [column] if column in bare else [column, f"{column} error"]
        found = [head]
        for row in self.rows:
            line = [_cell(row.values[key]) for key in self.keys] + [len(row.runs)]
            for column in self.columns:
                value, error = row[column]
                line += [nine_digits(value)] if column in bare else [nine_digits(value), nine_digits(error)]
            found.append(line)
        return found

    def _check(self, column: str) -> None:
        if column not in self.columns:
            raise KeyError(f"no column {column!r}; there are {', '.join([*self.keys, *self.columns])}")


def _cell(value: Any) -> Any:
    return value if isinstance(value, int | float | str) and not isinstance(value, bool) else value_name(value)


def table_of(folder: Path, manifest: Manifest) -> Table:
    """The table of the points that have finished."""
    rows, columns, failed = [], {}, {}
    for values, points in manifest.combinations():
        row = Row(values)
        for point in points:
            if point.state != FINISHED:
                continue
            try:
                found = measured(read_record(folder / point.folder))
            except RigidMDError as error:
                failed[point.folder] = str(error)
                continue
            row.runs[point.values.get("seed")] = found
            columns |= dict.fromkeys(found)
        rows.append(row)
    return Table(folder, list(rows[0].values) if rows else [], rows, list(columns), failed)


def measured(record: Record) -> dict[str, Measured]:
    """What a run gives: of molecules means over the production of its last stage, of a body figures of its motion.

    Raises OutputError.
    """
    return _of_body(record) if record.is_body else _of_molecules(record)


def _of_molecules(record: Record) -> dict[str, Measured]:
    _, own = production_of(record)
    found: dict[str, Measured] = {}
    for name, values in record.columns.items():
        if name in LEFT_OUT:
            continue
        average, error = mean(values[own])
        if average is None:
            continue
        if np.ptp(values[own]) == 0:
            average, error = float(values[own][0]), 0.0
        found[COLUMNS[name].header] = average, error
        if name == "potential":
            n = len(record.molecules.model.species)
            found[POTENTIAL] = average / n, None if error is None else error / n
    stages = (record.summary or {}).get("stages") or [{}]
    if (drift := stages[-1].get("drift_kT_ns_per_degree_of_freedom")) is not None:
        found[DRIFT] = drift, stages[-1].get("drift_error_kT_ns_per_degree_of_freedom")
    return found


def _of_body(record: Record) -> dict[str, Measured]:
    found: dict[str, Measured] = {}
    for name, values in record.columns.items():
        if (
            name in NOT_OF_BODY
            or name[:2] in ("q1", "q2", "q3", "qw", "qx", "qy", "qz")
            or not np.isfinite(values).all()
        ):
            continue
        unit = BODY_COLUMNS[name].unit if name in BODY_COLUMNS else "1"
        if name.endswith("_error"):
            found[f"{name} largest"] = float(np.abs(values).max()), None
            continue
        figures = {"mean": values.mean(), "lowest": values.min(), "highest": values.max(), "end": values[-1]}
        found |= {f"{name} {word} ({unit})": (float(value), None) for word, value in figures.items()}
    return found


def write_table(table: Table) -> Path:
    """Write sweep.csv. Raises OutputError."""
    write_csv(table.folder / TABLE, table.lines(), csv.QUOTE_NONNUMERIC)
    return table.folder / TABLE


def table_text(table: Table) -> str:
    """The main columns as a person reads them."""
    short = short_keys(table.keys)
    shown = [column for column in (*MAIN, *MAIN_OF_BODY) if column in table.columns]
    lines = [[*short.values(), "runs", *(SHORT.get(column, column) for column in shown)]]
    for row in table.rows:
        cells = [value_name(row.values[key]) for key in table.keys] + [str(len(row.runs))]
        lines.append([*cells, *(_told(row, column) for column in shown)])
    return columns_text(lines, left=())


def _told(row: Mapping[str, Measured] | Row, column: str) -> str:
    value, error = row[column]
    return "-" if not np.isfinite(value) else with_error(value, error)
