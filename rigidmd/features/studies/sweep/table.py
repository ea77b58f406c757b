"""The table of a sweep: a line for each combination of values with means and errors over its
replicas."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, nan
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.display import Displayed
from rigidmd.core.plain_text import did_you_mean_first
from rigidmd.core.quantities import QUANTITIES, with_means
from rigidmd.core.statistics import format_with_error, mean_and_error, standard_error
from rigidmd.core.toml import Json
from rigidmd.engines.system import System
from rigidmd.errors import RigidMDError
from rigidmd.features.analysis.files import TableEntry
from rigidmd.features.analysis.result import AnalysisResult
from rigidmd.features.analysis.rigid_frames import earlier_production, production_samples
from rigidmd.features.studies.kind_study import Measured, studies, study_of
from rigidmd.features.studies.sweep.folder import (
    SEED,
    Manifest,
    readable_key,
    short_keys,
    value_name,
)
from rigidmd.io.write import Cell, Column, ReportTable, nine_digits
from rigidmd.run.record import Record, read_record

if TYPE_CHECKING:
    import pandas

POTENTIAL, PRESSURE, DENSITY, DRIFT = (
    QUANTITIES[name].mean_header for name in ("potential", "pressure", "density", "drift")
)


def main_titles() -> dict[str, str]:
    """The main columns, and their titles in the printed table and the figure."""
    return {row.mean_header: mean.brief or row.header for row, mean in with_means() if mean.is_main}


@dataclass
class SweepRow:
    """A combination of values for all keys except the seed, and the results of its runs."""

    values: Json
    #: Value of the seed, None if it is not swept -> column -> value and error of that run.
    runs: dict[object, dict[str, Measured]] = field(default_factory=dict)
    together: int = 0  # number of runs whose common results are those of one run here

    @property
    def count(self) -> int:
        """Number of runs."""
        return self.together or len(self.runs)

    def __getitem__(self, column: str) -> Measured:
        """Mean over the runs and its standard error. For one run its value and error. NaN without a
        value."""
        measured = [run[column] for run in self.runs.values() if column in run]
        if len(measured) < 2:
            return measured[0] if measured else (nan, None)
        values = np.array([value for value, _ in measured])
        if np.ptp(values) == 0:  # a constant has no error, which rounding would give it
            return float(values[0]), None
        return float(values.mean()), float(standard_error(values))


@dataclass
class Table(Displayed):
    """Results of a sweep: a row for each combination of values, columns of means and errors.

    table["Temperature (K)"] is a column of means as an array (rows,), table.error("Temperature
    (K)") of their errors, table["seed"] of the values of a key.

    Attributes
    ----------
    folder : Path
        Folder of the sweep
    keys : list of str
        Dotted keys that vary
    rows : list of SweepRow
        Combinations of values with their results
    columns : list of str
        Headers of the columns of means
    failed : dict of str to str
        Point -> why it has no results
    runs : dict of str to Path
        Point that has finished -> folder of its run, for `rigidmd.read_run`
    together : dict of str to list of str
        Key -> the keys that vary together with it, itself included
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
        keys = ", ".join(self.keys) or "no keys"
        return f"<Table of {len(self)} combinations of {keys} in {self.folder}>"

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of means, or of the values of a key. Raises KeyError with all names."""
        if column in self.keys:
            return np.array([row.values[column] for row in self.rows])
        return self._measured(column)[:, 0]

    def error(self, column: str) -> np.ndarray:
        """Standard errors of a column of means: over the runs of a row, or of its single run.

        Parameters
        ----------
        column : str
            Header of the column

        Returns
        -------
        ndarray
            Errors (rows,). NaN where there is none

        Raises
        ------
        KeyError
            With all names.
        """
        return self._measured(column)[:, 1]

    def _measured(self, column: str) -> np.ndarray:
        if column not in self.columns:
            known = [*self.keys, *self.columns]
            raise KeyError(f"no column {column!r}{did_you_mean_first(column, known)}")
        return np.array([row[column] for row in self.rows], float).reshape(-1, 2)

    def has_error(self, column: str) -> bool:
        """Whether a column of means has errors.

        Parameters
        ----------
        column : str
            Header of the column

        Returns
        -------
        bool
            True if one of its rows has an error
        """
        return bool(np.isfinite(self.error(column)).any())

    def to_dataframe(self) -> "pandas.DataFrame":
        """The table of sweep.csv.

        Returns
        -------
        pandas.DataFrame
            A line for each combination of values

        Raises
        ------
        ImportError
            Without pandas.
        """
        try:
            import pandas
        except ImportError:
            raise ImportError("to_dataframe() needs pandas: pip install pandas") from None
        return pandas.DataFrame(self.lines())

    def lines(self) -> list[dict[str, Cell]]:
        """The lines of sweep.csv: values of keys, number of runs, and each column with its error.

        Returns
        -------
        list of dict
            Header -> cell, for each line
        """
        with_error = {name for name in self.columns if self.has_error(name)}
        lines = []
        for row in self.rows:
            line = key_cells(row.values) | {"runs": row.count}
            for name in self.columns:
                mean, error = row[name]
                line[name] = nine_digits(mean)
                if name in with_error:
                    line[f"{name} error"] = nine_digits(error)
            lines.append(line)
        return lines

    def brief(self) -> ReportTable:
        """The table that is printed and displayed: keys, number of runs, and the main columns with
        their errors.

        Returns
        -------
        ReportTable
            Its `text()` is for a terminal
        """
        short = short_keys(self.keys)
        headers = {key: f"set {readable_key(short[key])}" for key in self.keys}
        titles = main_titles()
        lines = []
        for row in self.rows:
            line = {headers[key]: value_name(value) for key, value in row.values.items()}
            line["runs"] = str(row.count)
            for name in self.main_columns():
                mean, error = row[name]
                text = format_with_error(mean, error) if isfinite(mean) else "-"
                line[titles.get(name, name)] = text
            lines.append(line)
        return report_of(lines)

    def main_columns(self) -> list[str]:
        """The columns that are printed and drawn: the main ones, and the densities of stages before
        the last one.

        Returns
        -------
        list of str
            Headers of columns
        """
        earlier = [column for column in self.columns if column.endswith(f": {DENSITY}")]
        more = [name for _, study in studies() for name in study.main_columns]
        return [name for name in (*main_titles(), *more) if name in self.columns] + earlier


def report_of(lines: Sequence[Mapping[str, Cell]]) -> ReportTable:
    """A table of lines with the same headers."""
    headers = lines[0] if lines else ()
    return ReportTable([Column(header, itemgetter(header)) for header in headers], lines)


def key_cells(values: Json) -> dict[str, Cell]:
    """The values of the keys of a combination, as cells of a file."""
    return {
        key: value if type(value) in (int, float, str) else value_name(value)
        for key, value in values.items()
    }


def table_of(manifest: Manifest) -> Table:
    """The table of the points that have finished."""
    keys = [key for key in manifest.keys if key != SEED]
    table = Table(manifest.folder, keys, [], [], together=manifest.keys)
    columns: dict[str, None] = {}
    for values, points in manifest.combinations():
        table.rows.append(SweepRow(values))
        for point in points:
            folder = manifest.folder / point.folder
            if point.state != "finished":
                continue
            try:
                results = summarise_run(read_record(folder))
            except RigidMDError as error:
                table.failed[point.folder] = str(error)
                continue
            table.rows[-1].runs[point.values.get(SEED)] = results
            table.runs[point.folder] = folder
            columns |= dict.fromkeys(results)
    table.columns[:] = columns
    return table


def measured_values(results: Iterable[AnalysisResult | TableEntry]) -> dict[str, Measured]:
    """The values of results of analyses by their headers."""
    return {
        value.header: (value.value, value.error)
        for result in results
        for value in result.values
        if value.value is not None
    }


def summarise_run(record: Record) -> dict[str, Measured]:
    """Results of a run, of molecules the means over the production. Raises OutputError."""
    if study := study_of(record.scene):
        return study.summarise(record)
    _, production = production_samples(record)
    results = _means_of(record, production)
    of_box = [row.header for row in QUANTITIES.values() if row.of_box]
    for stage, samples in earlier_production(record):
        means = _means_of(record, samples)
        for header in dict.fromkeys([*main_titles(), *of_box]):
            if header in means and (stage.changes_box or header not in of_box):
                results[f"{stage.label}: {header}"] = means[header]
    last = ((record.summary or {}).get("stages") or [{}])[-1]
    for row, mean in with_means():
        if not row.is_averaged and (value := last.get(mean.key.format(""))) is not None:
            results[row.mean_header] = value, last.get(mean.key.format("_error"))
    return results


def _means_of(record: Record[System], samples: np.ndarray) -> dict[str, Measured]:
    """Means of the columns of the log over some samples. A constant has no error."""
    means: dict[str, Measured] = {}
    described = record.log.described
    for name, values in record.columns.items():
        row = described[name]
        average, error = mean_and_error(values[samples]) if row.is_averaged else (None, None)
        if average is None:
            continue
        means[row.header] = average, error or None
        if row.mean and row.mean.per_molecule:
            n = len(record.system.model.species)
            means[row.mean_header] = average / n, None if error is None else error / n
    return means
