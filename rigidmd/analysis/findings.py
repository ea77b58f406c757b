"""What analyses find: values with errors, curves, sentences; and how errors are made."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import isfinite
from typing import NamedTuple

import numpy as np

from rigidmd.analysis.history import History
from rigidmd.core.statistics import error_of_mean, with_error
from rigidmd.run.rigid_fit import Kind

#: Blocks of a history whose scatter gives errors. The error of an error is one third.
BLOCKS = 5
#: Groups of molecules at most, whose scatter gives errors too.
GROUPS = 10
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

    def add(self, title: str, values: np.ndarray, errors: np.ndarray) -> None:
        """Add a column with its errors."""
        self.columns[title], self.errors[title] = values, errors


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


def so_far(value: float, error: float | None = None, unit: str = "") -> str:
    """What a run that is too short has given, in words."""
    return f"So far: {with_error(value, error)}{'' if unit in ('', '1') else f' {unit}'}"


def settled(
    name: str, unit: str, value: float, error: float | None, span: float, correlation: float, note: str = "",
    least: float = LEAST,
) -> Value:  # fmt: skip
    """A value made of a stretch of `span`, which has to be `least` correlation times long (both ps)."""
    if not correlation > 0 or not isfinite(value):
        return Value(name, unit, None, None, None, "the frames give no correlation time")
    if (lengths := span / correlation) < least:
        told = (
            f"{span:.3g} ps are {lengths:.2g} correlation times of {correlation:.3g} ps, too short for a value; "
            f"{least:g} of them are {least * correlation:.3g} ps. {so_far(value, error, unit)}"
        )
        return Value(name, unit, None, None, correlation, told)
    if error is None or not isfinite(error):
        return Value(name, unit, None, None, correlation, f"too short for an error. {so_far(value, None, unit)}")
    return Value(name, unit, value, error, correlation, note)


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
    return whole, error_of_mean(parts) if parts else np.full_like(whole, np.nan)


def over_parts(
    history: History, kind: Kind, function: Callable[[History, Kind], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """An array that a function makes of the molecules of a species, and its standard error: the larger of two, from
    blocks of the history and from groups of its molecules. Where motion repeats itself, as that of a gas, blocks are
    alike; where molecules move together, groups are."""
    whole, error = over_blocks(history, lambda part: function(part, kind))
    if (count := min(GROUPS, len(kind.index))) > 1:
        own = (kind._replace(index=kind.index[k::count], sites=kind.sites[k::count]) for k in range(count))
        error = np.fmax(error, error_of_mean([function(history, group) for group in own]))
    return whole, error
