"""Results of analyses: values with errors, curves, notes, and how errors are estimated."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import isfinite
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.core.display import Displayed
from rigidmd.core.plain_text import did_you_mean_first
from rigidmd.core.statistics import (
    correlation_time,
    error_of_mean,
    format_with_error,
    mean_and_error,
)
from rigidmd.features.analysis.rigid_frames import RigidFrames
from rigidmd.features.analysis.runs import Measured, Runs
from rigidmd.io.run_files import Bounded
from rigidmd.run.rigid_fit import Kind

if TYPE_CHECKING:
    import pandas

    from rigidmd.features.view.figures.picture import Picture

#: Blocks of frames whose scatter gives errors. The error of an error is one third.
BLOCKS = 5
MAX_GROUPS = 10  # groups of molecules at most, whose scatter gives errors too
#: Minimum length of a run for a value in correlation times of the whole system. For those of single
#: molecules, of which there are many, it is `BLOCKS`, because each block should be one correlation
#: time long.
MIN_CORRELATION_TIMES = 20.0


class Value(NamedTuple):
    """A value with its standard error, or a note on why there is none.

    Attributes
    ----------
    name : str
        What it is
    unit : str
        Unit of value and error. "1" or empty for numbers
    value : float or None
        The value. None if the run is too short
    error : float or None
        Standard error
    correlation_ps : float or None
        Correlation time of the data, ps
    note : str
        Remark, or the reason for no value
    """

    name: str
    unit: str
    value: Bounded | None
    error: Bounded | None
    correlation_ps: Bounded | None = None
    note: str = ""

    @property
    def header(self) -> str:
        """Name and unit, for tables."""
        return f"{self.name} ({self.unit})" if self.unit not in ("", "1") else self.name

    def __str__(self) -> str:
        if self.value is None:
            return f"{self.name}: {self.note}"
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        note = f" ({self.note})" if self.note else ""
        return f"{self.name}: {format_with_error(self.value, self.error)}{unit}{note}"


@dataclass(eq=False, repr=False)
class Curve:
    """Columns over an axis: one CSV file, one figure.

    Attributes
    ----------
    file : str
        Stem of its files
    axis : tuple of str and ndarray
        Header and values (p,)
    label : str
        Title of the vertical axis
    columns : dict of str to ndarray
        Header -> values (p,)
    errors : dict of str to ndarray
        Errors (p,) under the same headers, where there are any
    log : tuple of bool
        Whether axes are logarithmic: of x, of y
    level : float or None
        A level to draw, such as 1 of g(r)
    bars : bool
        Whether the axis is of integers, and bars are drawn
    per_color : int
        This number of neighbouring columns have one colour, and other dashes
    power : float or None
        The exponent of a power of x to draw, such as 1 of a displacement by diffusion
    from_zero : bool
        Whether the axis of y starts at 0
    """

    file: str
    axis: tuple[str, np.ndarray]
    label: str
    columns: dict[str, np.ndarray]
    errors: dict[str, np.ndarray] = field(default_factory=dict)
    log: tuple[bool, bool] = (False, False)
    level: float | None = None
    bars: bool = False
    per_color: int = 1
    power: float | None = None
    from_zero: bool = False

    def __repr__(self) -> str:
        """Short: the numbers of a curve would flood a screen."""
        return (
            f"<Curve {self.file}: {', '.join(self.columns)} against {self.axis[0]},"
            f" {len(self.axis[1])} points>"
        )

    @property
    def table(self) -> dict[str, np.ndarray]:
        """The columns of its CSV file: the axis, and each column followed by its errors."""
        table = dict([self.axis])
        for header, values in self.columns.items():
            table[header] = values
            if header in self.errors:
                table[f"{header} error"] = self.errors[header]
        return table

    def add(self, title: str, values: np.ndarray, errors: np.ndarray) -> None:
        """Add a column.

        Parameters
        ----------
        title : str
            Header of the column
        values : ndarray
            Values (p,)
        errors : ndarray
            Standard errors (p,)
        """
        self.columns[title], self.errors[title] = values, errors


@dataclass(eq=False, repr=False)
class AnalysisResult(Displayed):
    """The result of an analysis: values, curves, notes. A notebook displays them with a figure.

    result["g OW-OW"] is a column of its curves, result.value("D of spce") a value. result.plot() is
    a figure, result.to_dataframe() a table.

    Attributes
    ----------
    name : str
        Name of the analysis
    about : str
        Its title
    values : list of Value
        Numbers with their errors
    curves : list of Curve
        Columns over an axis
    notes : list of str
        Remarks on the data
    """

    name: str
    about: str
    values: list[Value] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of its curves. Raises KeyError with all names."""
        known: dict[str, np.ndarray] = {}
        for curve in self.curves:
            known |= curve.table
        if column not in known:
            raise KeyError(f"no column {column!r}{did_you_mean_first(column, known)}")
        return known[column]

    def value(self, name: str = "") -> Value:
        """A value by its name.

        Parameters
        ----------
        name : str, optional
            Name of the value. Default: the first one

        Returns
        -------
        Value
            `value`, `error`, `unit` and, if the run is too short for a value, `note`

        Raises
        ------
        KeyError
            With all names.
        """
        for value in self.values:
            if name in ("", value.name):
                return value
        known = [value.name for value in self.values]
        raise KeyError(f"no value {name!r}{did_you_mean_first(name, known)}")

    def plot(self, curve: str = "") -> "Picture":
        """A Matplotlib figure of its curves, which a notebook displays and `savefig` writes, as
        PNG, SVG or PDF by the extension. Bands are of one standard error.

        Parameters
        ----------
        curve : str, optional
            Name of one of `curves`. Default: a panel for each

        Returns
        -------
        Picture
            A Matplotlib figure

        Raises
        ------
        KeyError
            For an unknown curve.
        ValueError
            Without curves.
        """
        from rigidmd.features.analysis.curve_figure import curve_figure, curves_figure

        if not self.curves:
            raise ValueError(
                f"the analysis {self.name} has no curves: {'; '.join(map(str, self.values))}"
            )
        if curve or len(self.curves) == 1:
            shown = self._curve(curve)
            return curve_figure(shown, self.title_of(shown))
        return curves_figure(self.curves, self.about)

    def title_of(self, curve: Curve) -> str:
        """The title of the figure of one of its curves.

        Parameters
        ----------
        curve : Curve
            One of `curves`

        Returns
        -------
        str
            What the analysis is, or of several curves the label of this one
        """
        return self.about if len(self.curves) == 1 else curve.label.partition(" (")[0]

    def to_dataframe(self, curve: str = "") -> "pandas.DataFrame":
        """The columns of a curve with their errors, as in its CSV file. Without curves, the values.

        Parameters
        ----------
        curve : str, optional
            Name of one of `curves`. Default: the first

        Returns
        -------
        pandas.DataFrame
            A line for each point of the axis, or for each value

        Raises
        ------
        KeyError
            For an unknown curve.
        ImportError
            Without pandas.
        """
        try:
            import pandas
        except ImportError:
            raise ImportError("to_dataframe() needs pandas: pip install pandas") from None
        if self.curves or curve:
            return pandas.DataFrame(self._curve(curve).table)
        return pandas.DataFrame(self.values, columns=list(Value._fields))

    def _curve(self, name: str) -> Curve:
        """The curve of this name. Without a name the first. Raises KeyError with all names."""
        for curve in self.curves:
            if name in ("", curve.file):
                return curve
        known = [curve.file for curve in self.curves]
        raise KeyError(f"no curve {name!r}{did_you_mean_first(name, known)}")

    def __str__(self) -> str:
        curves = [f"{', '.join(curve.columns)} against {curve.axis[0]}" for curve in self.curves]
        lines = [*self.values, *([] if self.values else curves), *self.notes]
        return "\n".join([f"{self.about}:", *(f"  {line}" for line in lines)])

    __repr__ = __str__


def too_short(
    name: str, unit: str, value: float, error: float | None, why: str, tau: float | None = None
) -> Value:
    """No value, because the run is too short: why it is, and the value so far. tau : correlation
    time (ps)"""
    so_far = f"{format_with_error(value, error)}{'' if unit in ('', '1') else f' {unit}'}"
    return Value(name, unit, None, None, tau, f"{why}. So far: {so_far}")


def with_error(value: Value) -> Value:
    """A value that has an error, or else none, because the run is too short."""
    if value.value is None or (value.error is not None and isfinite(value.error)):
        return value
    why = "too short for an error"
    return too_short(value.name, value.unit, value.value, None, why, value.correlation_ps)


def converged_value(
    name: str,
    unit: str,
    value: float,
    error: float | None,
    span: float,
    correlation: float,
    note: str = "",
    least: float = MIN_CORRELATION_TIMES,
) -> Value:
    """A value from a run of length `span`, which has to be `least` correlation times long (both
    ps)."""
    if not correlation > 0 or not isfinite(value):
        return Value(name, unit, None, None, None, "the frames give no correlation time")
    if (lengths := span / correlation) < least:
        why = (
            f"{span:.3g} ps are {lengths:.2g} correlation times of {correlation:.3g} ps, too short"
            f" for a value; {least:g} of them are {least * correlation:.3g} ps"
        )
        return too_short(name, unit, value, error, why, correlation)
    return with_error(Value(name, unit, value, error, correlation, note))


Array = Callable[[np.ndarray], np.ndarray]


def _unchanged(values: np.ndarray) -> np.ndarray:
    return values


def with_block_error(
    runs: Runs, measure: Callable[[RigidFrames], np.ndarray], conclude: Array = _unchanged
) -> Measured:
    """An array computed from frames, and its standard error: for one run from blocks of at least
    two frames, for several runs from their scatter.

    measure : means over some frames; conclude : function of the means over all of them
    """
    if runs.are_several:
        return runs.estimate([measure(run) for run in runs.members], conclude)
    frames = runs.first
    value = np.asarray(conclude(measure(frames)), float)
    size = len(frames) // BLOCKS
    blocks = range(len(frames) - size * BLOCKS, len(frames), size) if size > 1 else ()
    parts = [np.asarray(conclude(measure(frames[k : k + size])), float) for k in blocks]
    return value, error_of_mean(parts) if parts else np.full_like(value, np.nan)


def with_group_error(
    runs: Runs,
    kind: Kind,
    measure: Callable[[RigidFrames, Kind], np.ndarray],
    conclude: Array = _unchanged,
) -> Measured:
    """An array computed from the molecules of a species, and its standard error: for one run the
    larger of two estimates, from blocks of frames and from groups of molecules; of several runs
    from their scatter. Blocks are too similar in a gas, groups where molecules move together."""
    value, error = with_block_error(runs, lambda part: measure(part, kind), conclude)
    if (count := min(MAX_GROUPS, len(kind.index))) > 1 and not runs.are_several:
        groups = (
            kind._replace(index=kind.index[k::count], sites=kind.sites[k::count])
            for k in range(count)
        )
        error = np.fmax(
            error, error_of_mean([conclude(measure(runs.first, group)) for group in groups])
        )
    return value, error


def mean_of_series(runs: Runs, series: list[np.ndarray]) -> tuple[float, float | None]:
    """Mean of a number for each frame, and its standard error.

    series : the numbers (f,) of each run
    """
    if runs.are_several:
        value, error = runs.estimate([values.mean() for values in series], _unchanged)
        return float(value), float(error)
    value, error = mean_and_error(series[0])
    return (float(series[0].mean()) if value is None else value), error


def correlation_time_of(runs: Runs, series: list[np.ndarray]) -> float:
    """Correlation time (ps) of a number for each frame, mean over runs.

    series : the numbers (f,) of each run
    """
    pairs = zip(series, runs.members, strict=True)
    times = [correlation_time(values, run.span / (len(run) - 1)) for values, run in pairs]
    return float(runs.mean(times))
