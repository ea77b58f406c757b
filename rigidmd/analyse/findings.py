"""What analyses find: values with errors, curves, sentences; and how errors are made."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import isfinite
from typing import NamedTuple

import numpy as np

from rigidmd.analyse.history import History
from rigidmd.measure.drift import inefficiency

#: Blocks of a history whose scatter gives errors. The error of an error is one third.
BLOCKS = 5
#: Correlation times that a stretch must hold before it gives a value: those of the whole system, and those of single
#: molecules, which are many and of which each block should see one at least.
LEAST, LEAST_EACH = 20.0, float(BLOCKS)


class Value(NamedTuple):
    """A value with its standard error, or the sentence that tells why there is none.

    correlation_ps : time over which what it is made of forgets itself
    """

    name: str
    unit: str
    value: float | None
    error: float | None
    correlation_ps: float | None = None
    note: str = ""

    def __str__(self) -> str:
        if self.value is None:
            return f"{self.name}: {self.note}"
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        told = f" ({self.note})" if self.note else ""
        return f"{self.name}: {with_error(self.value, self.error)}{unit}{told}"


@dataclass(eq=False)
class Curve:
    """Columns over an axis: one CSV file, one figure.

    file : stem of its files
    axis : header and values (p,)
    columns, errors : header -> values (p,); errors under the same headers, where there are any
    log : whether axes are logarithmic: of x, of y
    level : a level to draw, such as 1 of g(r)
    bars : whether the axis counts, so that bars are drawn
    """

    file: str
    axis: tuple[str, np.ndarray]
    label: str
    columns: dict[str, np.ndarray]
    errors: dict[str, np.ndarray] = field(default_factory=dict)
    log: tuple[bool, bool] = (False, False)
    level: float | None = None
    bars: bool = False


@dataclass(eq=False)
class Finding:
    """What an analysis found: values, curves, notes.

    finding["g OW-OW"] is a column of its curves, finding.value("D of spce") a value.
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
            known |= {curve.axis[0]: curve.axis[1]} | curve.columns
            known |= {f"{header} error": error for header, error in curve.errors.items()}
        if column not in known:
            raise KeyError(f"no column {column!r}; there are {', '.join(known)}")
        return known[column]

    def value(self, name: str = "") -> Value:
        """The value of this name; without a name the first. Raises KeyError with all names."""
        for value in self.values:
            if name in ("", value.name):
                return value
        raise KeyError(f"no value {name!r}; there are {', '.join(value.name for value in self.values)}")

    def __str__(self) -> str:
        curves = [f"{', '.join(curve.columns)} against {curve.axis[0]}" for curve in self.curves]
        lines = [*self.values, *([] if self.values else curves), *self.notes]
        return "\n".join([f"{self.about}:", *(f"  {line}" for line in lines)])

    __repr__ = __str__


def with_error(value: float, error: float | None) -> str:
    """Such as 2.51 ± 0.04: two digits of the error."""
    if error is None or not isfinite(error):
        return f"{value:.4g}"
    if error <= 0:
        return f"{value:.6g}"
    places = 1 - int(np.floor(np.log10(error)))
    if -6 <= places <= 8 and abs(value) < 1e6:
        return f"{value:.{max(0, places)}f} ± {error:.{max(0, places)}f}"
    return f"{value:.4g} ± {error:.1e}"


def settled(
    name: str, unit: str, value: float, error: float, span: float, correlation: float, note: str = "",
    least: float = LEAST,
) -> Value:  # fmt: skip
    """A value made of a stretch of `span`, which has to be `least` correlation times long (both ps)."""
    if not correlation > 0 or not isfinite(value):
        return Value(name, unit, None, None, None, "the frames give no correlation time")
    if (lengths := span / correlation) < least:
        told = f"this run is {lengths:.2g} correlation times ({correlation:.3g} ps) long: too short for a value"
        return Value(name, unit, None, None, correlation, told)
    return Value(name, unit, value, error if isfinite(error) else None, correlation, note)


def blocks(history: History, count: int = BLOCKS) -> list[History]:
    """A history in parts of equal length, without the first frames where it does not divide; none where a part would
    have less than two frames."""
    size = len(history) // count
    if size < 2:
        return []
    first = len(history) - size * count
    return [history.part(first + k * size, first + (k + 1) * size) for k in range(count)]


def over_blocks(history: History, function: Callable[[History], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """An array that a function makes of a history, and its standard error, from what it makes of blocks."""
    whole = np.asarray(function(history), float)
    parts = [np.asarray(function(part), float) for part in blocks(history)]
    if len(parts) < 2:
        return whole, np.full_like(whole, np.nan)
    return whole, np.std(parts, axis=0, ddof=1) / np.sqrt(len(parts))


def correlation_time(values: np.ndarray, interval: float) -> float:
    """Integrated correlation time of a series, in units of `interval`: half its inefficiency."""
    return 0.5 * interval * inefficiency(values - values.mean())
